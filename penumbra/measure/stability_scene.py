"""What the scenes of `bench stability` are made of: a case, its scene, and parts that several cases share.

Most coordinates are small multiples of a power of two, so that what is meant to lie on a plane, an edge
or a vertex lies there exactly. Receivers are around z = 0, blockers between, the light around z = 4.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from penumbra.arrays import Float64Array, Int64Array
from penumbra.lights import Light, PointLight

Rng = np.random.Generator

# Each direction of an offset is different, so that no plane of the scene stays where it was.
OFFSET_DIRECTION = np.array([1.0, -1.0, 0.5])


@dataclass(frozen=True)
class SceneSize:
    """How many receivers, blockers and light samples a scene has: R, T and K >= 2."""

    n_receivers: int
    n_blockers: int
    n_samples: int

    @property
    def n_point_receivers(self) -> int:
        """Receivers of a scene with a point light: more, for each has but one bit."""
        return 8 * self.n_receivers


@dataclass(frozen=True, eq=False)
class HardScene:
    """What `penumbra.cast` is given: points and normals (R, 3), triangles (T, 3, 3), a light, own (R,)."""

    points: Float64Array
    triangles: Float64Array
    light: Light
    own: Int64Array
    normals: Float64Array | None = None

    @property
    def n_bits(self) -> int:
        """Bits that a cast of the scene decides."""
        return len(self.points) * self.light.samples

    def transformed(self, scale: float, offset: float) -> "HardScene":
        """The scene times `scale`, moved by `offset` along each of OFFSET_DIRECTION; float64 rounds."""
        move = OFFSET_DIRECTION * offset
        return replace(
            self,
            points=self.points * scale + move,
            triangles=self.triangles * scale + move,
            light=_transformed_light(self.light, scale, move),
        )


@dataclass(frozen=True)
class Case:
    """A kind of scene: its name, what is hard about it, and what makes it."""

    name: str
    what: str
    make: Callable[[Rng, SceneSize], HardScene]
    nudged: bool = False
    """Move every coordinate of receivers and blockers by one ulp up or down, or not, in the end."""
    has_point_light: bool = False


def hard_scene(
    case: Case, size: SceneSize, seed: int = 0, scale: float = 1.0, offset: float = 0.0
) -> HardScene:
    """The scene of a case, scaled and then moved; the same seed gives the same scene."""
    rng = np.random.default_rng([seed, *case.name.encode()])
    scene = case.make(rng, size).transformed(scale, offset)
    if case.nudged:
        scene = replace(scene, points=_nudged(rng, scene.points), triangles=_nudged(rng, scene.triangles))
    return scene


def on_grid(values: Float64Array, cells: int) -> Float64Array:
    """Values rounded to multiples of 1 / cells."""
    rounded: Float64Array = np.round(values * cells) / cells
    return rounded


def general_receivers(rng: Rng, n_receivers: int) -> Float64Array:
    """Points around z = 0."""
    return on_grid(rng.uniform([-2, -2, -0.5], [2, 2, 0.5], (n_receivers, 3)), 1024)


def general_blockers(rng: Rng, n_blockers: int, cells: int = 1024) -> Float64Array:
    """Triangles between receivers and light, of about a fifth of the size of the scene."""
    centres = rng.uniform([-1.5, -1.5, 1], [1.5, 1.5, 3], (n_blockers, 1, 3))
    return on_grid(centres + rng.normal(0, 0.25, (n_blockers, 3, 3)), cells)


def scene_of(
    points: Float64Array,
    triangles: Float64Array,
    light: Light,
    own: Int64Array | None = None,
    normals: Float64Array | None = None,
) -> HardScene:
    """A scene with contiguous arrays; receivers know no triangle of theirs where `own` is None."""
    if own is None:
        own = np.full(len(points), -1)
    return HardScene(np.ascontiguousarray(points), np.ascontiguousarray(triangles), light, own, normals)


def torn_sheet(rng: Rng, n_blockers: int) -> Float64Array:
    """Triangles of a tilted plane cut along a lattice: the half of its cells that chance has left."""
    along, across, origin = np.array([[0.375, 0, 0.125], [0, 0.375, -0.0625], [-1.5, -1.5, 2.0]])
    n_rows = int(np.ceil(np.sqrt(2 * n_blockers)))
    lattice = np.stack(np.meshgrid(np.arange(n_rows + 1), np.arange(n_rows + 1), indexing="ij"), axis=-1)
    lattice = lattice * (8.0 / 2.0 ** np.ceil(np.log2(n_rows)))
    triangles = halves(origin + lattice[..., :1] * along + lattice[..., 1:] * across)
    return triangles[np.sort(rng.permutation(len(triangles))[:n_blockers])]


def halves(grid: Float64Array) -> Float64Array:
    """Triangles (2 n m, 3, 3) of the cells of a grid of points (n + 1, m + 1, 3)."""
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    corners = np.stack([a, b, c, a, c, d], axis=2)
    return corners.reshape(-1, 3, 3)


def _transformed_light(light: Light, scale: float, move: Float64Array) -> Light:
    if isinstance(light, PointLight):
        return replace(light, position=light.position * scale + move)
    return replace(
        light,
        corner=light.corner * scale + move,
        edge_u=light.edge_u * scale,
        edge_v=light.edge_v * scale,
    )


def _nudged(rng: Rng, values: Float64Array) -> Float64Array:
    steps = rng.integers(-1, 2, values.shape)
    nudged: Float64Array = np.where(
        steps == 0, values, np.nextafter(values, np.where(steps > 0, np.inf, -np.inf))
    )
    return nudged
