"""The demo's scene, made of numbers alone: an open gallery whose arcade stands between a low light and us.

Units are metres, y is up. It has what soft shadows are judged by: columns that touch the floor (contact
shadows), a lattice and a leafy tree (thin blockers, near and far from what they shade), spheres, walls.
"""

from pathlib import Path

import numpy as np

from penumbra.arrays import Float64Array
from penumbra.io.atomic import atomic_path
from penumbra.io.ply_writer import write_ply

SCENE_NAME = "demo.toml"
MESH_NAME = "demo.ply"

SCENE_TEXT = f"""\
# The demo scene of penumbra: an open gallery, a low light outside its arcade and the sky above.
[[geometry]]
path = "{MESH_NAME}"

[camera]
eye = [-1.35, 2.05, 6.4]
look_at = [0.0, 1.05, -1.2]
vfov = 48
resolution = [960, 640]

[[light]]
name = "sun"
type = "rect"
corner = [13.0, 6.6, 5.0]
edge_u = [-0.30, 0.84, -0.12]
edge_v = [0.33, 0.0, -0.83]
samples = 256
radiance = 1500.0

[[light]]
name = "sky"
type = "rect"
corner = [-2.0, 11.0, -3.0]
edge_u = [3.0, 0.0, 0.0]
edge_v = [0.0, 0.0, 5.0]
samples = 64
radiance = 12.0
"""

# The gallery: a wall at the left, the arcade at the right, an end wall; the camera looks along -z.
_WALL_X, _ARCADE_X, _END_Z, _FRONT_Z = -2.6, 2.4, -8.0, 7.0
_SPRING_Y, _TOP_Y, _DEPTH, _SPAN = 2.35, 4.3, 0.46, 3.0
_COLUMN_Z = (4.0, 1.0, -2.0, -5.0, -8.0)

# Radius and height around the column's axis, from its base to its capital.
_COLUMN_PROFILE = np.array(
    [
        (0.30, 0.14), (0.33, 0.17), (0.33, 0.22), (0.29, 0.25), (0.26, 0.28), (0.28, 0.31), (0.24, 0.34),
        (0.205, 0.40), (0.205, 0.95), (0.198, 1.5), (0.185, 1.98), (0.21, 2.00), (0.21, 2.03), (0.19, 2.05),
        (0.20, 2.10), (0.25, 2.17), (0.31, 2.21), (0.33, 2.22), (0.33, 2.25),
    ]
)  # fmt: skip

# Centre and radius of the spheres.
_SPHERES = (
    ((0.75, 0.5, 1.5), 0.5),
    ((-0.35, 0.2, 2.6), 0.2),
    ((-1.75, 0.3, 0.6), 0.3),
    ((-0.9, 0.13, 1.55), 0.13),
    ((-0.6, 1.75, -3.2), 0.42),
)

# The two triangles of a quadrilateral.
_QUAD = [(0, 1, 2), (0, 2, 3)]


def write_demo_scene(folder: Path) -> Path:
    """Write the mesh (PLY) and the scene file into a folder; returns the path of the scene file."""
    # Vertices are shared, and told apart as they are written.
    corners = demo_triangles().reshape(-1, 3).astype(np.float32)
    vertices, inverse = np.unique(corners, axis=0, return_inverse=True)
    write_ply(
        folder / MESH_NAME, vertices, inverse.reshape(-1, 3), "the demo scene of penumbra, metres, y up"
    )
    with atomic_path(folder / SCENE_NAME) as temporary:
        temporary.write_text(SCENE_TEXT)
    return folder / SCENE_NAME


def demo_triangles() -> Float64Array:
    """All triangles of the scene, float64 (T, 3, 3), world space, metres; the same at every call."""
    parts = [
        *_floor(np.random.default_rng(1)),
        _box((_WALL_X - 0.4, -0.1, _END_Z - 0.4), (_WALL_X, _TOP_Y + 0.5, _FRONT_Z)),
        _box((_WALL_X, -0.1, _END_Z - 0.4), (_ARCADE_X + 0.6, _TOP_Y + 0.5, _END_Z)),
        _box((_ARCADE_X - 0.34, _TOP_Y, _END_Z), (_ARCADE_X + 0.34, _TOP_Y + 0.24, _FRONT_Z)),
        *(_column(z) for z in _COLUMN_Z),
        *(_arch(z - _SPAN / 2) for z in (_COLUMN_Z[0] + _SPAN, *_COLUMN_Z[:-1])),
        *_lattice(_COLUMN_Z[1] - _SPAN / 2),
        *(radius * _unit_sphere(5) + centre for centre, radius in _SPHERES),
        *_tree(np.random.default_rng(4), np.array([3.7, 0.0, 2.0])),
    ]
    return np.concatenate(parts)


def _floor(rng: np.random.Generator) -> list[Float64Array]:
    """Stone slabs with joints between them, not quite level, on plain ground."""
    slabs = [_box((-6.0, -0.3, _END_Z - 1), (14.0, -0.03, _FRONT_Z + 3))]
    size, joint = 0.8, 0.014
    for row, z in enumerate(np.arange(_END_Z, _FRONT_Z + 2, size)):
        for x in np.arange(_WALL_X - (row % 2) * size / 2, 6.0, size):
            top = rng.uniform(-0.004, 0.004)
            slabs.append(_box((x, -0.1, z), (x + size - joint, top, z + size - joint)))
    return slabs


def _column(z: float) -> Float64Array:
    """A round column of the arcade on a square plinth, with a square slab on its capital."""
    plinth = _box((_ARCADE_X - 0.36, 0.0, z - 0.36), (_ARCADE_X + 0.36, 0.14, z + 0.36))
    slab = _box((_ARCADE_X - 0.36, 2.25, z - 0.36), (_ARCADE_X + 0.36, _SPRING_Y, z + 0.36))
    angle = np.linspace(0, 2 * np.pi, 65)
    radius, height = _COLUMN_PROFILE.T
    rings = np.stack(
        [
            _ARCADE_X + np.outer(radius, np.cos(angle)),
            np.repeat(height[:, None], len(angle), axis=1),
            z + np.outer(radius, np.sin(angle)),
        ],
        axis=2,
    )
    return np.concatenate([plinth, *(_strip(a, b) for a, b in zip(rings, rings[1:], strict=False)), slab])


def _arch(z: float) -> Float64Array:
    """The wall above the opening centred at z: a slab with a half circle cut out from below."""
    radius, half, rise = _SPAN / 2 - 0.3, _SPAN / 2, _TOP_Y - _SPRING_Y
    corner = np.arctan2(rise, half)
    angle = np.sort(np.concatenate([np.linspace(0, np.pi, 41), [corner, np.pi - corner]]))
    along, up = np.cos(angle), np.sin(angle)
    # The slab's outline, seen from the centre of the circle in the same directions.
    reach = np.minimum(half / np.maximum(abs(along), 1e-9), rise / np.maximum(up, 1e-9))
    inner_front, outer_front, inner_back, outer_back = (
        np.stack([np.full_like(angle, _ARCADE_X + side), _SPRING_Y + r * up, z + r * along], axis=1)
        for side in (-_DEPTH / 2, _DEPTH / 2)
        for r in (np.full_like(angle, radius), reach)
    )
    return np.concatenate(
        [_strip(inner_front, outer_front), _strip(inner_back, outer_back), _strip(inner_front, inner_back)]
    )


def _lattice(z: float) -> list[Float64Array]:
    """A lattice of crossed bars that fills the lower part of the opening centred at z."""
    y0, y1, z0, z1 = 0.14, _SPRING_Y - 0.35, z - _SPAN / 2 + 0.2, z + _SPAN / 2 - 0.2
    bars = []
    for slope, layer in ((1, -0.02), (-1, 0.02)):
        for offset in np.arange(-4.0, 4.0, 0.24):
            # The bar follows z - z_mid = slope * (y - y0) + offset, cut off at the frame.
            y_at = sorted((edge - (z0 + z1) / 2 - offset) / slope + y0 for edge in (z0, z1))
            low, high = max(y0, y_at[0]), min(y1, y_at[1])
            if high - low > 0.02:
                z_low, z_high = ((z0 + z1) / 2 + slope * (y - y0) + offset for y in (low, high))
                bars.append(_bar((_ARCADE_X + layer, low, z_low), (_ARCADE_X + layer, high, z_high), 0.045))
    corners = [(_ARCADE_X, y, z_edge) for y, z_edge in ((y0, z0), (y0, z1), (y1, z1), (y1, z0))]
    return bars + [_bar(a, b, 0.07) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]


def _tree(rng: np.random.Generator, root: Float64Array) -> list[Float64Array]:
    """A small tree: limbs that fork into thinner limbs, the last of which bear leaves."""
    parts: list[Float64Array] = []
    limbs = [(root, np.array([-0.05, 1.0, -0.05]), 1.25, 0.06, 5)]
    while limbs:
        start, direction, length, radius, forks = limbs.pop()
        end = start + length * direction / np.linalg.norm(direction)
        parts.append(_bar(start, end, 2 * radius, sides=7))
        if forks <= 2:
            parts += [_leaf(start + (end - start) * t, rng) for t in rng.uniform(0.2, 1.0, 4)]
        if forks:
            for _ in range(3):
                turned = direction / np.linalg.norm(direction) + rng.normal(0, 0.5, 3) + (0, 0.05, 0)
                limbs.append((end, turned, length * rng.uniform(0.66, 0.82), radius * 0.62, forks - 1))
    return parts


def _leaf(stem: Float64Array, rng: np.random.Generator) -> Float64Array:
    """A pointed leaf folded along its middle, (4, 3, 3)."""
    along, across = rng.normal(size=(2, 3)) + ((0, -0.5, 0), (0, 0, 0))
    along *= rng.uniform(0.08, 0.13) / np.linalg.norm(along)
    across -= along * (across @ along) / (along @ along)
    across *= 0.028 / np.linalg.norm(across)
    fold = 0.25 * np.cross(along, across) / 0.1
    tip, middle = stem + along, stem + 0.45 * along
    left, right = middle + across + fold, middle - across + fold
    return np.array([(stem, middle, left), (middle, tip, left), (stem, right, middle), (middle, right, tip)])


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Float64Array:
    """An axis-aligned box, (12, 3, 3)."""
    box: Float64Array = low + np.subtract(high, low) * _UNIT_BOX
    return box


def _bar(start: object, end: object, width: float, sides: int = 4) -> Float64Array:
    """A straight prism between two points, open at its ends, (2 * sides, 3, 3)."""
    start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, np.eye(3)[np.argmin(abs(axis))])
    side /= np.linalg.norm(side)
    angle = np.linspace(0, 2 * np.pi, sides + 1) + np.pi / sides
    ring = width / 2 * (np.outer(np.cos(angle), side) + np.outer(np.sin(angle), np.cross(axis, side)))
    return _strip(start + ring, end + ring)


def _strip(a: Float64Array, b: Float64Array) -> Float64Array:
    """Triangles between two polylines (n, 3) of equal length, (2 * (n - 1), 3, 3)."""
    quads = np.stack([a[:-1], a[1:], b[1:], b[:-1]], axis=1)
    return quads[:, _QUAD].reshape(-1, 3, 3)


def _unit_sphere(subdivisions: int) -> Float64Array:
    """An octahedron whose faces are divided again and again, pushed out to the sphere."""
    x, y, z = np.eye(3)
    triangles = np.array([(sx * x, sy * y, sz * z) for sx in (1, -1) for sy in (1, -1) for sz in (1, -1)])
    for _ in range(subdivisions):
        a, b, c = np.moveaxis(triangles, 1, 0)
        ab, bc, ca = a + b, b + c, c + a
        corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        triangles = np.concatenate([np.stack(corner, axis=1) for corner in corners])
        triangles /= np.linalg.norm(triangles, axis=2, keepdims=True)
    return triangles


# Corners in the order of the bits of their index (x, y, z), and the six faces of the unit box.
_UNIT_CORNERS = np.array(list(np.ndindex(2, 2, 2)), dtype=np.float64)
_UNIT_FACES = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
_UNIT_BOX = _UNIT_CORNERS[_UNIT_FACES][:, _QUAD].reshape(-1, 3, 3)
