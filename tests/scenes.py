"""Small test scenes as numpy arrays: each family aims at one way of getting a visibility bit wrong.

A family is a function of a random generator and a light; it returns a SmallScene that the exact judge
can decide bit by bit. Receivers are around z = 0, blockers mostly between, the light around z = 4.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from penumbra import PointLight, RectLight
from penumbra.lights import Light

Floats = NDArray[np.float64]
Rng = np.random.Generator


@dataclass(frozen=True, eq=False)
class SmallScene:
    """What `penumbra.cast` is given: receivers, blockers (T, 3, 3) and a light."""

    points: Floats
    triangles: Floats
    light: Light
    normals: Floats | None = None
    own: NDArray[np.int64] | None = None


# corner, edge_u, edge_v, two_sided; emission is along cross(edge_u, edge_v).
_LIGHTS: dict[str, tuple[Any, Any, Any, bool]] = {
    "square above": ((-1, -1, 4), (0, 2, 0), (2, 0, 0), False),
    "square above, two-sided": ((-1, -1, 4), (0, 2, 0), (2, 0, 0), True),
    "rectangle aside": ((3, -0.25, 1), (0, 0.5, 0), (0, 0, 3), False),
    "skewed": ((-1.3, -0.7, 3.9), (0.2, 1.7, 0.4), (2.1, 0.9, -0.3), False),
    "rotated": ((-0.4, -1.1, 4.2), (-0.62, 1.31, 0.74), (1.57, 0.55, 0.3), False),
    "sliver": ((-1, 0.1, 4), (1e-7, 1e-7, 0), (2, 1, 1), True),
    "line": ((-1, 0, 4), (2, 0, 0), (0, 0, 0), True),
    "parallel edges": ((-1, 0, 4), (2, 0, 0), (1, 0, 0), True),
    "point": ((0, 0, 4), (0, 0, 0), (0, 0, 0), True),
    "zero area, single-sided": ((-1, 0, 4), (2, 0, 0), (0, 0, 0), False),
}
LIGHTS = tuple(_LIGHTS)


def light_named(name: str, samples: int, sets: int = 1, seed: int = 7) -> RectLight:
    """One of the lights of LIGHTS."""
    corner, edge_u, edge_v, two_sided = _LIGHTS[name]
    return RectLight(corner, edge_u, edge_v, samples=samples, sets=sets, seed=seed, two_sided=two_sided)


def transformed(scene: SmallScene, scale: float, offset: float) -> SmallScene:
    """The scene scaled, then moved by (offset, -offset, offset / 2), rounded as float64 rounds."""
    move = np.array([1.0, -1.0, 0.5]) * offset
    light: Any = scene.light
    if isinstance(light, PointLight):
        vectors = {"position": light.position * scale + move}
    else:
        vectors = {
            "corner": light.corner * scale + move,
            "edge_u": light.edge_u * scale,
            "edge_v": light.edge_v * scale,
        }
    return replace(
        scene,
        points=scene.points * scale + move,
        triangles=scene.triangles * scale + move,
        light=replace(light, **vectors),
    )


def random_triangles(rng: Rng, n_triangles: int, size: float = 1.0) -> Floats:
    """Triangles of about a size between receivers and light."""
    centres = rng.uniform([-1, -1, 0.3], [1, 1, 3.7], (n_triangles, 3))
    return centres[:, None] + rng.normal(0, size / 2, (n_triangles, 3, 3))


def receivers_below(rng: Rng, n_receivers: int) -> Floats:
    """Points around z = 0."""
    return rng.uniform([-2, -2, -0.5], [2, 2, 0.5], (n_receivers, 3))


def _samples(rng: Rng, light: RectLight, n_samples: int) -> Floats:
    """Some of the light's sample points, of any set."""
    return rng.choice(light.sample_points.reshape(-1, 3), n_samples)


def soup(rng: Rng, light: RectLight) -> SmallScene:
    """Triangles of all sizes in general position."""
    triangles = np.concatenate([random_triangles(rng, 2, 3.0), random_triangles(rng, 4, 0.7)])
    return SmallScene(receivers_below(rng, 8), triangles, light)


def lattice(rng: Rng, light: RectLight) -> SmallScene:
    """Small whole coordinates: many points on common planes and lines, zero-area blockers among them."""
    return SmallScene(
        rng.integers(-2, 3, (10, 3)).astype(float), rng.integers(-2, 5, (8, 3, 3)).astype(float), light
    )


def axis_aligned(rng: Rng, light: RectLight) -> SmallScene:
    """Blockers in coordinate planes; the first edges pass exactly over segments to samples."""
    points, samples = receivers_below(rng, 8).round(1), _samples(rng, light, 4)
    points[:4, 0] = samples[:, 0]
    heights = rng.uniform(0.5, 3.5, 4)
    edges = np.zeros((4, 3, 3))
    edges[:, :, 0] = samples[:, :1] + np.array([0.0, 0.0, 1.5]) * rng.choice([-1, 1], (4, 1))
    edges[:, :, 1] = rng.uniform(-1, 1, (4, 1)) + np.array([-1.0, 1.0, 0.0])
    edges[:, :, 2] = heights[:, None]
    values = np.concatenate([points, samples, np.array([[-1.0, 0, 1], [1, 1, 3]])])
    upright = np.stack([rng.choice(values[:, k], (3, 3)) for k in range(3)], axis=-1)
    for row, axis in enumerate([0, 1, 0]):
        upright[row, :, axis] = upright[row, 0, axis]
    return SmallScene(points, np.concatenate([edges, upright]), light)


def slivers(rng: Rng, light: RectLight) -> SmallScene:
    """Needles: two corners close together, or three nearly on a line."""
    a, b = rng.uniform([-2, -2, 1], [2, 2, 3], (2, 8, 3))
    thin = 10.0 ** rng.uniform(-16, -2, (8, 1)) * rng.normal(0, 1, (8, 3))
    near_end = np.where(rng.random((8, 1)) < 0.5, b, a + (b - a) * rng.random((8, 1)))
    return SmallScene(receivers_below(rng, 8), np.stack([a, b, near_end + thin], axis=1), light)


def shared_edges(rng: Rng, light: RectLight) -> SmallScene:
    """A closed fan whose middle vertex, and points of whose spokes, lie on segments to samples."""
    middle = rng.uniform([-0.5, -0.5, 1], [0.5, 0.5, 3])
    angles = np.sort(rng.uniform(0, 2 * np.pi, 5))
    rim = middle + np.stack([np.cos(angles), np.sin(angles), rng.normal(0, 0.2, 5)], axis=1)
    fan = np.stack([np.broadcast_to(middle, (5, 3)), rim, np.roll(rim, -1, axis=0)], axis=1)
    on_spokes = middle + (rim - middle) * rng.choice([0.0, 0.5, 0.25], (5, 1))
    points = 2.0 * on_spokes - _samples(rng, light, 5)
    return SmallScene(np.concatenate([points, receivers_below(rng, 3)]), fan, light)


def coplanar_neighbours(rng: Rng, light: RectLight) -> SmallScene:
    """A plane cut into triangles; receivers in the same plane, and behind its inner edges and vertices."""
    along, across = rng.integers(-4, 5, (2, 3)) / 4.0 + np.diag([0.0, 1.0, 0.0])[:2] + np.eye(3)[:2] * 0.125
    origin = np.append(rng.integers(-1, 2, 2), rng.integers(2, 6)) / 2.0
    s, t = np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij")
    grid = origin + s[..., None] * along + t[..., None] * across
    cells = [(grid[i, j], grid[i + 1, j], grid[i + 1, j + 1], grid[i, j + 1]) for i in (0, 1) for j in (0, 1)]
    triangles = np.array([corners for a, b, c, d in cells for corners in ((a, b, c), (a, c, d))])
    weights = np.concatenate([rng.integers(-8, 9, (4, 2)) / 4.0, [[0, 0], [0.5, 0.5], [0, 0.5], [-0.25, 0]]])
    points = origin + weights[:, :1] * along + weights[:, 1:] * across
    points[4:] = 2.0 * points[4:] - _samples(rng, light, 4)
    return SmallScene(points, triangles, light)


def around_the_light(rng: Rng, light: RectLight) -> SmallScene:
    """Blockers through the light, touching samples of it, in its plane, beside it and behind it."""
    corner, u, v = light.corner, light.edge_u, light.edge_v
    in_plane = corner + rng.uniform(-1, 2, (3, 1)) * u + rng.uniform(-1, 2, (3, 1)) * v
    through = corner + 0.5 * u + 0.4 * v + rng.normal(0, 0.7, (2, 3, 3))
    touching = random_triangles(rng, 3)
    touching[:, 0] = _samples(rng, light, 3)
    touching[2, 1] = touching[1, 0]
    behind = in_plane + np.array([0.0, 0.0, 0.5])
    own_rectangle = np.array([[corner, corner + u, corner + u + v], [corner, corner + u + v, corner + v]])
    triangles = np.concatenate([[in_plane], through, touching, [behind], own_rectangle])
    return SmallScene(receivers_below(rng, 8), triangles, light)


def below_the_receivers(rng: Rng, light: RectLight) -> SmallScene:
    """Blockers behind the receivers, between them, and ending exactly in their height."""
    points = receivers_below(rng, 8)
    triangles = random_triangles(rng, 7, 2.0) - np.array([0, 0, 2.0])
    triangles[:4, 0] = points[:4] + np.array([0.2, 0.1, 0.0])
    return SmallScene(points, triangles, light)


def on_blockers(rng: Rng, light: RectLight) -> SmallScene:
    """Receivers at vertices, on edges and inside of blockers, some of which are their own."""
    triangles = np.concatenate([random_triangles(rng, 4, 2.0), rng.integers(-2, 4, (3, 3, 3)).astype(float)])
    weights = np.array([[4, 0, 0], [2, 2, 0], [0, 1, 3], [2, 1, 1], [1, 1, 2], [0, 4, 0]]) / 4.0
    lies_on = rng.integers(0, len(triangles), 10)
    points = np.einsum("rk,rkc->rc", rng.choice(weights, 10), triangles[lies_on])
    return SmallScene(points, triangles, light, own=np.where(rng.random(10) < 0.5, lies_on, -1))


def in_the_light_plane(rng: Rng, light: RectLight) -> SmallScene:
    """Receivers in the plane of the light, on it, and at its samples."""
    s, t = rng.integers(-4, 9, (2, 5, 1)) / 4.0
    points = light.corner + s * light.edge_u + t * light.edge_v
    samples = _samples(rng, light, 2)
    triangles = random_triangles(rng, 5, 2.0) + np.array([0, 0, 1.5])
    return SmallScene(np.concatenate([points, samples, receivers_below(rng, 2)]), triangles, light)


def planes_through_receivers(rng: Rng, light: RectLight) -> SmallScene:
    """Blockers seen edge-on: their planes hold a receiver, a sample, or both."""
    points, samples = receivers_below(rng, 8), _samples(rng, light, 8)
    share = rng.choice([0.25, 0.5, 0.75, 1.0, 2.0], (8, 2, 1))
    free = random_triangles(rng, 8)[:, 0]
    first = points + share[:, 0] * (free - points)
    second = points + share[:, 1] * (np.where(rng.random((8, 1)) < 0.5, samples, free) - points)
    beyond, elsewhere = points + 2.0 * (first - points), random_triangles(rng, 8)[:, 1]
    third = np.where(rng.random((8, 1)) < 0.5, beyond, elsewhere)
    return SmallScene(points, np.stack([first, second, third], axis=1), light)


def corners_on_segments(rng: Rng, light: RectLight) -> SmallScene:
    """Corners and edges of blockers half way, or three quarters, from receivers to samples."""
    vertices = (_samples(rng, light, 8) + receivers_below(rng, 8).round(2)) / 2.0
    samples = _samples(rng, light, 8)
    points = np.concatenate([2.0 * vertices[:4] - samples[:4], 4.0 * vertices[4:] - 3.0 * samples[4:]])
    directions = rng.integers(-2, 3, (8, 2, 3)) / 2.0
    others = vertices[:, None] + directions
    others[::2, 0] = 2.0 * vertices[::2] - others[::2, 1]  # the vertex is then the middle of an edge
    first = np.where((np.arange(8) % 2 == 0)[:, None], vertices + directions[:, 1][:, ::-1], vertices)
    return SmallScene(points, np.concatenate([first[:, None], others], axis=1), light)


def near_misses(rng: Rng, light: RectLight) -> SmallScene:
    """As corners_on_segments, but off by about what float32 resolves: what its lanes must leave open."""
    scene = corners_on_segments(rng, light)
    shifts = rng.normal(0, 1, (8, 1, 3)) * 10.0 ** rng.uniform(-8.5, -6.5, (8, 1, 1))
    return replace(scene, triangles=scene.triangles + shifts)


def close_to_the_light(rng: Rng, light: RectLight) -> SmallScene:
    """Blockers that almost touch a sample, and receivers far behind their corners and edges."""
    samples = _samples(rng, light, 8)
    gaps = 10.0 ** rng.uniform(-9, -2, (8, 1))
    vertices = samples + gaps * (rng.uniform(-1, 1, (8, 3)) - np.array([0, 0, 1.5]))
    sizes = 10.0 ** rng.uniform(-9, 1, (8, 1, 1))
    others = vertices[:, None] + rng.normal(0, 1, (8, 2, 3)) * sizes
    blockers = np.concatenate([vertices[:, None], others], axis=1)
    hiding = np.concatenate([vertices, 0.5 * (blockers[:, 0] + blockers[:, 1]), others[:, 0]])
    away = hiding - np.tile(samples, (3, 1))
    points = hiding + away * (10.0 ** rng.uniform(-1, 1, (24, 1)) / np.abs(away).max(axis=1, keepdims=True))
    return SmallScene(points, blockers, light)


def facing(rng: Rng, light: RectLight) -> SmallScene:
    """Normals at right angles to directions to samples, exactly or nearly, of all lengths."""
    points = receivers_below(rng, 10)
    directions = _samples(rng, light, 10) - points
    normals = np.cross(directions, rng.normal(0, 1, (10, 3)))
    points[:3, 2] = light.corner[2]
    normals[:3] = [[0, 0, 1], [0, 0, -1], [0, 0, 3]]
    normals[3:6] = rng.integers(-2, 3, (3, 3)) + np.array([0, 0, 5])
    normals[6:] *= np.array([1e-300, 1e-3, 1e3, 1e150])[:, None]
    return SmallScene(points, random_triangles(rng, 3), light, normals=normals)


def nearly_touching(rng: Rng, light: RectLight) -> SmallScene:
    """Receivers a rounding error away from blockers, on either side, and blockers as close to samples."""
    triangles = random_triangles(rng, 6, 2.0)
    triangles[4:, 0] = np.nextafter(_samples(rng, light, 2), rng.choice([-9.0, 9.0], (2, 3)))
    points = triangles[rng.integers(0, 6, 8)].mean(axis=1)
    points = points * (1.0 + rng.choice([-1, 0, 1, 2], (8, 3)) * 2.0**-52)
    return SmallScene(points, triangles, light)


def degenerate_blockers(rng: Rng, light: RectLight) -> SmallScene:
    """Blockers with equal corners or corners on one line among sound ones."""
    triangles = random_triangles(rng, 6, 2.0)
    triangles[0, 1] = triangles[0, 0]
    triangles[1, :] = triangles[1, 0]
    triangles[2] = np.array([1.0, 1, 2]) + np.array([0.0, 1.0, 3.0])[:, None] * np.array([-1.0, 0.5, 0])
    return SmallScene(receivers_below(rng, 8), triangles, light)


FAMILIES: dict[str, Callable[[Rng, RectLight], SmallScene]] = {
    family.__name__: family
    for family in (
        soup,
        lattice,
        axis_aligned,
        slivers,
        shared_edges,
        coplanar_neighbours,
        around_the_light,
        below_the_receivers,
        on_blockers,
        in_the_light_plane,
        planes_through_receivers,
        corners_on_segments,
        near_misses,
        close_to_the_light,
        facing,
        nearly_touching,
        degenerate_blockers,
    )
}


def scene_of(family: str, light: RectLight, seed: int = 0) -> SmallScene:
    """A scene of a family, the same for the same seed."""
    return FAMILIES[family](np.random.default_rng([seed, *family.encode()]), light)


def large_scene(n_receivers: int, n_triangles: int, light: RectLight, seed: int = 3) -> SmallScene:
    """Too large for the judge: what is compared with itself when something that must not matter changes.

    Coordinates are multiples of 2**-10; a fifth of the triangles are large, receivers have normals and
    some lie on their own triangle.
    """
    rng = np.random.default_rng(seed)
    small = random_triangles(rng, n_triangles - n_triangles // 5, 0.3)
    triangles = np.concatenate([small, random_triangles(rng, n_triangles // 5, 1.2)])
    points = receivers_below(rng, n_receivers)
    own = np.full(n_receivers, -1)
    own[::4] = rng.integers(0, n_triangles, len(own[::4]))
    points[::4] = triangles[own[::4]].mean(axis=1)
    normals = rng.normal(0, 1, (n_receivers, 3)) + np.array([0, 0, 2.0])
    return SmallScene(on_grid(points), on_grid(triangles), light, on_grid(normals), own)


def on_grid(values: Floats) -> Floats:
    """Values rounded to multiples of 2**-10."""
    return np.round(values * 1024.0) / 1024.0


def write_ply(path: Path, triangles: Floats) -> Path:
    """A binary PLY of the triangles, in float64, three vertices each."""
    n_triangles = len(triangles)
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {3 * n_triangles}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {n_triangles}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.zeros(n_triangles, np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    faces["count"] = 3
    faces["corners"] = np.arange(3 * n_triangles).reshape(-1, 3)
    path.write_bytes(header.encode() + triangles.astype("<f8").tobytes() + faces.tobytes())
    return path
