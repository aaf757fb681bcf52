"""Scenes made for benchmarks, after those of Laine & Aila 2005 (figure 4 and table 2), and their files.

`grids`: wire lattices, few triangles and wide penumbrae. `flowers`: a field of plants, many small
triangles. `atrium`: two storeys of columns, arches and balusters around a court with grass, as in SPONZA.
Each is there with four times the light's area, too: `grids-4x` and so on.
"""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from penumbra.arrays import Float64Array
from penumbra.errors import SceneError
from penumbra.io.atomic import atomic_path, temporary_folder
from penumbra.io.ply_writer import write_ply
from penumbra.measure.scaling_shapes import Mesh, box, rotated, sheet, snapped_mesh, subdivided, tube, turned

Vector = tuple[float, float, float]
_LARGER = "-4x"
_LARGER_EDGES = 2.0


class NamedScene(NamedTuple):
    """A scene file and what its rows are called."""

    name: str
    path: Path


class View(NamedTuple):
    """Camera and light of a made scene; the light shines down."""

    eye: Vector
    look_at: Vector
    vfov: float
    light_centre: Vector
    light_size: tuple[float, float]
    """Along x and z."""


def grids(n_layers: int = 7, n_wires: int = 26, n_segments: int = 33) -> Mesh:
    """Stacked lattices of thin wires over a floor: 12 n_layers n_wires n_segments + 2 triangles."""
    parts = [_ground(12.0)]
    along, across, up = np.eye(3)[[0, 2, 1]] * (1.0, 0.02, 0.02)
    for layer in range(n_layers):
        half, height = 3.2 - 0.2 * layer, 1.0 + 0.5 * layer
        places = np.linspace(-half, half, n_segments + 1)[:, None] * along
        offsets = np.linspace(-half, half, n_wires)[:, None, None] * (0.0, 0.0, 1.0)
        wires = places + offsets
        for crossing in (0, 1):
            middle = (0.0, height - 0.045 * crossing, 0.0)
            angle = 0.12 * layer + 0.5 * np.pi * crossing
            parts.append(rotated(tube(wires + middle, across, up, 3), angle))
    return snapped_mesh(parts)


def flowers(n_side: int = 60, seed: int = 3) -> Mesh:
    """A field of n_side x n_side plants of two kinds, leaning and turned at random, no two alike."""
    rng = np.random.default_rng(seed)
    kinds = (_daisy(), _tulip())
    parts = [_ground(14.0)]
    cell = 16.0 / n_side
    for row, column in np.ndindex(n_side, n_side):
        x, z = (np.array([column, row]) + rng.random(2)) * cell - 8.0
        plant = rotated(kinds[rng.integers(2)] * rng.uniform(0.65, 1.2), rng.uniform(0, 2 * np.pi))
        lean = rng.normal(0.0, 0.16, 2)
        plant = plant + plant[..., 1:2] * (lean[0], 0.0, lean[1])
        parts.append(plant + (x, 0.0, z))
    return snapped_mesh(parts)


def atrium(n_bays: int = 8, n_blades: int = 30_000, seed: int = 5) -> Mesh:
    """A court between two arcades of two storeys each, with galleries, balustrades, drapes and grass."""
    rng = np.random.default_rng(seed)
    parts = [sheet(_grid((-13.0, 0.0, -7.0), (26.0, 0.0, 0.0), (0.0, 0.0, 14.0), 24, 12))]
    parts += [box((-13, 0, side - 0.2), (13, 9, side + 0.2)) for side in (-7.0, 7.0)]
    parts += [box((side - 0.2, 0, -7), (side + 0.2, 9, 7)) for side in (-13.0, 13.0)]
    posts = np.linspace(-10.0, 10.0, n_bays + 1)
    for foot, height in ((0.0, 4.0), (4.4, 3.6)):
        for z in (-3.0, 3.0):
            parts += [_column(height * 0.68) + (x, foot, z) for x in posts]
            parts += [
                _arch(b - a, height * 0.32) + (0.5 * (a + b), foot + height * 0.68, z)
                for a, b in zip(posts, posts[1:], strict=False)
            ]
            parts.append(_gallery(foot + height, z))
    for z in (-3.0, 3.0):
        parts += [_baluster() + (x, 4.4, z) for x in np.linspace(-10.0, 10.0, 16 * n_bays + 1)]
        parts.append(box((-10.2, 5.2, z - 0.1), (10.2, 5.3, z + 0.1)))
        parts += [
            _drape() + (0.5 * (a + b), 4.1, z * 0.93) for a, b in zip(posts[::2], posts[1::2], strict=False)
        ]
    parts.append(_grass(n_blades, rng))
    return snapped_mesh(parts)


SCENES: dict[str, tuple[Callable[[], Mesh], View]] = {
    "grids": (grids, View((8.6, 7.4, 10.8), (0.0, 1.1, 0.0), 40.0, (0.1, 9.2, 0.2), (3.0, 3.0))),
    "flowers": (flowers, View((0.6, 6.0, 12.6), (0.0, 0.1, 0.9), 42.0, (-4.6, 9.6, -4.2), (2.0, 2.0))),
    "atrium": (atrium, View((-8.6, 2.6, 1.7), (2.0, 2.6, -1.6), 62.0, (0.4, 14.0, 0.1), (4.0, 2.4))),
}
NAMES = tuple(name + suffix for name in SCENES for suffix in ("", _LARGER))
"""Every scene that can be named."""


def write_scene(name: str, folder: Path, levels: int = 0) -> NamedScene:
    """Write a named scene's mesh, subdivided `levels` times, and its scene file; returns the latter.

    A mesh that is there already is used again. Raises SceneError for a name that is not in NAMES.
    """
    if name not in NAMES:
        raise SceneError(f"there is no scene {name!r}: use a scene file, or one of {' '.join(NAMES)}")
    base = name.removesuffix(_LARGER)
    make, view = SCENES[base]
    mesh_name = f"{base}-{levels}.ply" if levels else f"{base}.ply"
    if not (folder / mesh_name).exists():
        mesh = subdivided(make(), levels)
        write_ply(folder / mesh_name, *mesh, comment=f"the benchmark scene {base} of penumbra")
    path = folder / f"{name}.toml"
    with atomic_path(path) as temporary:
        temporary.write_text(_scene_text(mesh_name, view, _LARGER_EDGES if name != base else 1.0))
    return NamedScene(name, path)


@contextmanager
def named_scenes(names: Sequence[str], scratch: Path | None = None) -> Iterator[list[NamedScene]]:
    """Scene files as they are and named scenes as files, in a folder that is there meanwhile; all if none.

    Raises SceneError for what is neither.
    """
    with temporary_folder(scratch or Path(tempfile.gettempdir())) as folder:
        found = []
        for name in names or NAMES:
            path = Path(name)
            found.append(NamedScene(path.stem, path) if path.is_file() else write_scene(name, folder))
        yield found


def _scene_text(mesh: str, view: View, larger: float) -> str:
    (width, depth), (x, y, z) = view.light_size, view.light_centre
    width, depth = larger * width, larger * depth
    return f"""\
[[geometry]]
path = "{mesh}"

[camera]
eye = {list(view.eye)}
look_at = {list(view.look_at)}
vfov = {view.vfov}
resolution = [1280, 960]

[[light]]
name = "key"
type = "rect"
corner = {[x - 0.5 * width, y, z - 0.5 * depth]}
edge_u = [{width}, 0.0, 0.0]
edge_v = [0.0, 0.0, {depth}]
samples = 256
radiance = 10.0
"""


def _ground(half: float) -> Float64Array:
    return sheet(_grid((-half, 0.0, -half), (2.0 * half, 0.0, 0.0), (0.0, 0.0, 2.0 * half), 1, 1))


def _grid(corner: Vector, edge_u: Vector, edge_v: Vector, n_u: int, n_v: int) -> Float64Array:
    """Points (n_v + 1, n_u + 1, 3) of a parallelogram, which face up for edges along x and z."""
    u = np.linspace(0.0, 1.0, n_u + 1)[None, :, None]
    v = np.linspace(0.0, 1.0, n_v + 1)[:, None, None]
    points: Float64Array = np.asarray(corner) + u * np.asarray(edge_u) + v * np.asarray(edge_v)
    return points


def _blade(root: Vector, heading: float, rise: float, length: float, width: float, n: int) -> Float64Array:
    """A leaf or petal, creased along its middle, that rises and then bends down: 4 n triangles."""
    s = np.linspace(0.0, 1.0, n + 1)[:, None]
    out = np.array([np.cos(heading), 0.0, np.sin(heading)])
    side = np.array([-out[2], 0.0, out[0]])
    middle = length * (s * np.cos(rise) * out + (s * np.sin(rise) - 0.6 * s**2) * (0.0, 1.0, 0.0))
    # Narrow and not pointed at both ends: no triangle is without area.
    half = width * (0.15 + 0.85 * np.sin(np.pi * np.sqrt(s)) ** 2)
    edges = [middle - half * side, middle - 0.3 * half * (0.0, 1.0, 0.0), middle + half * side]
    return sheet(np.asarray(root) + np.stack(edges, axis=1))


def _stem(height: float) -> tuple[Float64Array, Float64Array]:
    """A bent stem (36 triangles) and its upper end."""
    s = np.linspace(0.0, 1.0, 7)[:, None]
    axis = height * s * (0.0, 1.0, 0.0) + 0.1 * s**2 * (1.0, 0.0, 0.4)
    radius = 0.02 - 0.01 * s
    return tube(axis, radius * (1.0, 0.0, 0.0), radius * (0.0, 0.0, 1.0), 3), axis[-1]


def _daisy() -> Float64Array:
    """A tall plant with many flat petals around a dome: 244 triangles."""
    stem, top = _stem(0.95)
    leaves = [_blade((0.0, 0.1 + 0.13 * k, 0.0), 2.4 * k, 0.9, 0.42, 0.06, 4) for k in range(5)]
    petals = [_blade((*top,), 2 * np.pi * k / 12, 0.35, 0.24, 0.05, 2) for k in range(12)]
    dome = turned([(0.08, 0.0), (0.06, 0.04), (0.01, 0.06)], 8) + top
    return np.concatenate([stem, *leaves, *petals, dome])


def _tulip() -> Float64Array:
    """A low plant with long leaves and a closed cup: 260 triangles."""
    stem, top = _stem(0.6)
    leaves = [_blade((0.0, 0.02, 0.0), 1.6 * k, 1.2, 0.75, 0.055, 8) for k in range(4)]
    petals = [_blade((*top,), 2 * np.pi * k / 6, 1.35, 0.3, 0.09, 4) for k in range(6)]
    return np.concatenate([stem, *leaves, *petals])


def _column(height: float) -> Float64Array:
    """A round column with base and capital between two square slabs."""
    inner = height - 0.3
    profile = [(0.34, 0.15), (0.36, 0.2), (0.33, 0.26), (0.28, 0.28), (0.3, 0.33), (0.25, 0.4)]
    profile += [(0.25 - 0.05 * t, 0.4 + (inner - 0.55) * t) for t in (0.25, 0.5, 0.75, 1.0)]
    profile += [(0.24, inner - 0.12), (0.22, inner - 0.05), (0.3, inner + 0.08), (0.34, inner + 0.15)]
    slabs = [box((-0.38, y, -0.38), (0.38, y + 0.15, 0.38)) for y in (0.0, height - 0.15)]
    return np.concatenate([turned(profile, 24), *slabs])


def _arch(span: float, rise: float) -> Float64Array:
    """The wall above a round opening between two columns: a slab from its spring line up."""
    angle = np.linspace(0.0, np.pi, 25)[:, None]
    half = 0.5 * span
    opening = np.concatenate([-np.cos(angle) * (half - 0.3), np.sin(angle) * (rise - 0.25)], axis=1)
    reach = np.maximum(abs(np.cos(angle)) / half, np.sin(angle) / rise)
    outline = np.concatenate([-np.cos(angle), np.sin(angle)], axis=1) / reach
    loop = [(opening, -0.25), (outline, -0.25), (outline, 0.25), (opening, 0.25), (opening, -0.25)]
    return sheet(np.stack([np.insert(line, 2, z, axis=1) for line, z in loop], axis=1))


def _gallery(height: float, z: float) -> Float64Array:
    """The slab over an arcade, from its front to the outer wall, with small blocks under its edge."""
    front, back = (z - 0.35, 7.0) if z > 0 else (-7.0, z + 0.35)
    edge = front if z > 0 else back
    blocks = [
        box((x, height, edge - 0.1), (x + 0.12, height + 0.12, edge + 0.1))
        for x in np.linspace(-12.8, 12.6, 90)
    ]
    return np.concatenate([box((-13.0, height + 0.12, front), (13.0, height + 0.4, back)), *blocks])


def _baluster() -> Float64Array:
    profile = [
        (0.06, 0.0),
        (0.06, 0.06),
        (0.03, 0.12),
        (0.055, 0.28),
        (0.055, 0.4),
        (0.025, 0.6),
        (0.05, 0.8),
    ]
    return turned(profile, 8)


def _drape() -> Float64Array:
    """Cloth that hangs in folds, 1.6 wide and 1.8 long."""
    cloth = _grid((-0.8, 0.0, 0.0), (1.6, 0.0, 0.0), (0.0, -1.8, 0.0), 28, 12)
    folds = 0.08 * np.sin(11.0 * cloth[..., 0]) * (1.0 - 0.3 * cloth[..., 1])
    return sheet(cloth + folds[..., None] * (0.0, 0.0, 1.0))


def _grass(n_blades: int, rng: np.random.Generator) -> Float64Array:
    """Blades of four triangles on the floor of the court."""
    place = np.stack(
        [rng.uniform(-9.5, 9.5, n_blades), np.zeros(n_blades), rng.uniform(-2.2, 2.2, n_blades)], axis=1
    )
    heading = rng.uniform(0.0, 2.0 * np.pi, n_blades)
    side = np.stack([np.cos(heading), 0.0 * heading, np.sin(heading)], axis=1) * 0.012
    bend = rng.normal(0.0, 0.07, (n_blades, 3)) * (1.0, 0.0, 1.0)
    height = rng.uniform(0.15, 0.4, n_blades)[:, None] * (0.0, 1.0, 0.0)
    rows = [place + t * height + t * t * bend for t in (0.0, 0.5, 1.0)]
    edges = [
        [row - width * side, row + width * side] for row, width in zip(rows, (1.0, 0.8, 0.2), strict=True)
    ]
    return sheet(np.stack([np.stack(pair, axis=1) for pair in edges], axis=1))
