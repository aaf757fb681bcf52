"""Scenes whose visibility is known in closed form, for each backend.

The light is the unit square [0, 1]^2 at z = 2 with K = n * n samples, one in each of n * n square
strata; receivers are at z = 0 and blockers in planes of constant z = 1. From a receiver (x, y) a blocker
point (p, q) covers the light point (2p - x, 2q - y): the covered part of the light is known, and only
strata that its border crosses can count wrongly, each by less than 1 / K.
"""

from itertools import pairwise

import numpy as np
import pytest
from backends import BACKENDS, cast_scene, masks_of
from scenes import Floats, SmallScene

from penumbra import RectLight

FAR = 1000.0

pytestmark = pytest.mark.parametrize("backend", BACKENDS)


def unit_light(n: int, sets: int = 1, two_sided: bool = False) -> RectLight:
    """The unit square at z = 2, shining down, n * n samples."""
    return RectLight((0, 0, 2), (0, 1, 0), (1, 0, 0), samples=n * n, sets=sets, two_sided=two_sided)


def rectangle(x0: float, x1: float, y0: float, y1: float, z: float = 1.0) -> Floats:
    """A rectangle of constant z as two triangles."""
    a, b, c, d = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
    return np.array([[a, b, c], [a, c, d]])


def disc(x: float, y: float, radius: float, n_sides: int = 720) -> tuple[Floats, float]:
    """A regular polygon of constant z = 1 as a fan, and its area."""
    angles = np.linspace(0.0, 2.0 * np.pi, n_sides + 1)
    rim = np.stack([x + radius * np.cos(angles), y + radius * np.sin(angles), np.ones(n_sides + 1)], axis=1)
    rim[-1] = rim[0]
    triangles = np.array([[[x, y, 1.0], a, b] for a, b in pairwise(rim)])
    return triangles, 0.5 * n_sides * np.sin(2.0 * np.pi / n_sides) * radius**2


def below(n_receivers: int, rng: np.random.Generator) -> Floats:
    """Points (n, 3) at z = 0 around the light's shadow."""
    return np.column_stack([rng.uniform(-0.5, 1.5, (n_receivers, 2)), np.zeros(n_receivers)])


def covered(low: Floats, high: Floats) -> Floats:
    """Length of the part of [low, high] in [0, 1]."""
    return np.clip(high, 0.0, 1.0) - np.clip(low, 0.0, 1.0)


@pytest.mark.parametrize("n", [4, 8, 10, 16])
@pytest.mark.parametrize("axis", [0, 1])
def test_half_plane_gives_a_linear_ramp(backend: str, n: int, axis: int, rng: np.random.Generator) -> None:
    edge = 0.4
    limits = [(-FAR, edge), (-FAR, FAR)] if axis == 0 else [(-FAR, FAR), (-FAR, edge)]
    points = below(400, rng)
    scene = SmallScene(points, rectangle(*limits[0], *limits[1]), unit_light(n))
    # The border is one straight line along the strata: it crosses n of them at most, so 1 / n.
    ramp = 1.0 - np.clip(2.0 * edge - points[:, axis], 0.0, 1.0)
    error = cast_scene(scene, backend).visibility - ramp
    assert np.abs(error).max() <= 1.0 / n
    assert np.abs(error[(ramp == 0) | (ramp == 1)]).max() == 0.0


def test_half_plane_bits_are_an_inequality_of_sample_coordinates(
    backend: str, rng: np.random.Generator
) -> None:
    light = unit_light(16)
    points = below(200, rng)
    masks = masks_of(SmallScene(points, rectangle(-FAR, 0.4, -FAR, FAR), light), backend)
    bits = np.unpackbits(masks.view(np.uint8), axis=1, bitorder="little").astype(bool)
    assert np.array_equal(bits, light.sample_points[0, :, 0] + points[:, :1] <= 0.8)


def test_many_sample_sets_average_to_the_ramp(backend: str, rng: np.random.Generator) -> None:
    # In each of the n crossed strata the sample is blocked or not: a standard deviation of at most
    # sqrt(n) / 2 / K, over 200 sets that use independent samples.
    n, n_sets = 8, 200
    points = np.tile([[0.3, 0.2, 0.0]], (4000, 1))
    scene = SmallScene(points, rectangle(-FAR, 0.37, -FAR, FAR), unit_light(n, sets=n_sets))
    result = cast_scene(scene, backend)
    of_set = [result.visibility[result.sample_set == s][0] for s in np.unique(result.sample_set)]
    assert len(of_set) > 190
    assert abs(np.mean(of_set) - 0.56) < 5.0 * np.sqrt(n) / 2.0 / n**2 / np.sqrt(len(of_set))


@pytest.mark.parametrize("n", [8, 16])
def test_parallel_rectangle_gives_the_product_of_two_ramps(
    backend: str, n: int, rng: np.random.Generator
) -> None:
    x0, x1, y0, y1 = 0.3, 0.55, 0.35, 0.8
    points = below(400, rng)
    scene = SmallScene(points, rectangle(x0, x1, y0, y1), unit_light(n))
    x, y = points[:, 0], points[:, 1]
    expected = 1.0 - covered(2 * x0 - x, 2 * x1 - x) * covered(2 * y0 - y, 2 * y1 - y)
    # Each side whose line passes over the light crosses n strata at most.
    crossing = [(2.0 * side - at > 0.0) & (2.0 * side - at < 1.0) for side, at in ((x0, x), (x1, x))]
    crossing += [(2.0 * side - at > 0.0) & (2.0 * side - at < 1.0) for side, at in ((y0, y), (y1, y))]
    bound = np.sum(crossing, axis=0) / n
    assert (np.abs(cast_scene(scene, backend).visibility - expected) <= bound + 1e-6).all()
    assert (bound == 0.0).any()


def test_disc_covers_its_area(backend: str) -> None:
    n = 32
    blocker, area = disc(0.5, 0.5, 0.15)
    points = np.array([[0.5, 0.5, 0.0], [0.4, 0.55, 0.0], [0.37, 0.36, 0.0]])
    visibility = cast_scene(SmallScene(points, blocker, unit_light(n)), backend).visibility
    # The border is a circle of diameter 0.6: a convex curve m strata wide and high crosses at most
    # 4 (m + 1) of them. The samples in them err independently: six standard deviations.
    crossed = 4 * (np.ceil(0.6 * n) + 1)
    assert np.abs(visibility - (1.0 - 4.0 * area)).max() < 6.0 * 0.5 * np.sqrt(crossed) / n**2


def test_disc_behind_a_straight_edge_covers_all_but_its_segment(backend: str) -> None:
    n, radius, edge = 32, 0.15, 0.42
    blocker, area = disc(0.5, 0.5, radius)
    scene = SmallScene(
        np.array([[0.5, 0.5, 0.0]]),
        np.concatenate([blocker, rectangle(-FAR, edge, -FAR, FAR, z=1.0)]),
        unit_light(n),
    )
    # The half-plane x <= edge hides a segment of the disc: radius^2 (a - sin a cos a), cos a = d / radius.
    half_angle = np.arccos((0.5 - edge) / radius)
    segment = radius**2 * (half_angle - np.sin(half_angle) * np.cos(half_angle))
    expected = 1.0 - ((2 * edge - 0.5) + 4.0 * (area - segment))
    crossed = 4 * (np.ceil(0.6 * n) + 1) + n
    visibility = cast_scene(scene, backend).visibility
    assert np.abs(visibility - expected).max() < 6.0 * 0.5 * np.sqrt(crossed) / n**2


def test_a_horizontal_normal_sees_the_half_of_the_light_before_it(backend: str) -> None:
    light = unit_light(16)
    points = np.array([[0.25, 0.5, 0.0], [0.5, 0.5, 0.0], [-1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    normals = np.tile([1e-3, 0.0, 0.0], (4, 1))
    scene = SmallScene(points, np.zeros((0, 3, 3)), light, normals)
    assert cast_scene(scene, backend).visibility.tolist() == [0.75, 0.5, 1.0, 0.0]


def box(n_cells: int, half: float, rotation: Floats) -> Floats:
    """A closed box around the origin, each side n_cells * n_cells quads; neighbours share their vertices."""
    steps = np.linspace(-half, half, n_cells + 1)
    quads = []
    for axis in range(3):
        for side in (-half, half):
            for s0, s1 in pairwise(steps):
                for t0, t1 in pairwise(steps):
                    quads.append(np.insert([[s0, t0], [s1, t0], [s1, t1], [s0, t1]], axis, side, axis=1))
    corners = np.array(quads) @ rotation.T
    return np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])


def rotation_of(rng: np.random.Generator) -> Floats:
    """A random rotation matrix."""
    q, _ = np.linalg.qr(rng.normal(0, 1, (3, 3)))
    return q


@pytest.mark.parametrize("n_cells", [1, 4])
@pytest.mark.parametrize("turned", [False, True])
def test_a_closed_box_round_the_light_does_not_leak(
    backend: str, n_cells: int, turned: bool, rng: np.random.Generator
) -> None:
    rotation = rotation_of(rng) if turned else np.eye(3)
    light = RectLight((-0.5, -0.25, 0), (1, 0, 0), (0, 0.5, 0.1), samples=100, two_sided=True)
    directions = rng.normal(0, 1, (1200, 3))
    directions /= np.abs(directions).max(axis=1, keepdims=True)
    distances = rng.choice([1.0 + 1e-12, 1.0 + 1e-6, 1.5, 4.0, 1e3, 1e6], (1200, 1))
    # Towards vertices, along edges and in the planes of the sides, too.
    on_grid = rng.integers(-4, 5, (800, 3)) / 2.0
    on_grid = on_grid[np.abs(on_grid).max(axis=1) > 1.0]
    points = np.concatenate([directions * distances, on_grid]) @ rotation.T
    masks = masks_of(SmallScene(points, box(n_cells, 1.0 - 1e-13, rotation), light), backend)
    assert np.bitwise_count(masks).sum(axis=1).tolist() == [100] * len(points)


def test_points_on_a_convex_box_see_all_that_is_inside(backend: str) -> None:
    light = RectLight((-0.5, -0.25, 0), (1, 0, 0), (0, 0.5, 0.1), samples=100, two_sided=True)
    sides = np.array([[1.0, s, t] for s in (-1, -0.5, 0, 0.25, 1) for t in (-1, -0.5, 0, 0.25, 1)])
    points = np.concatenate([np.roll(sides * sign, axis, axis=1) for sign in (-1, 1) for axis in range(3)])
    for n_cells in (1, 4):
        assert not masks_of(SmallScene(points, box(n_cells, 1.0, np.eye(3)), light), backend).any()


def sheet(rng: np.random.Generator, n_cells: int, bumps: float) -> Floats:
    """A triangulated sheet about z = 1 over [-1, 2]^2, vertices moved at random and shared."""
    x, y = np.meshgrid(*[np.linspace(-1.0, 2.0, n_cells + 1)] * 2, indexing="ij")
    grid = np.stack([x, y, np.ones_like(x)], axis=-1)
    grid[1:-1, 1:-1, :2] += rng.uniform(-0.3, 0.3, (n_cells - 1, n_cells - 1, 2)) * 3.0 / n_cells
    grid[1:-1, 1:-1, 2] += bumps * rng.uniform(-1, 1, (n_cells - 1, n_cells - 1))
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3, 3)


def test_blocker_and_complement_see_the_whole_light_together(backend: str, rng: np.random.Generator) -> None:
    triangles = sheet(rng, 12, 0.0)
    first = rng.random(len(triangles)) < 0.5
    points, light = below(150, rng), unit_light(16)
    one, other = (cast_scene(SmallScene(points, triangles[part], light), backend) for part in (first, ~first))
    # A segment meets the plane once; through a shared edge both would block it, but no sample is there.
    assert not (one.masks & other.masks).any()
    assert np.bitwise_count(one.masks | other.masks).sum() == 150 * 256
    assert (one.visibility + other.visibility == 1.0).all()
    assert 0.0 < one.visibility.mean() < 1.0


def test_a_sheet_of_any_shape_has_no_cracks(backend: str, rng: np.random.Generator) -> None:
    scene = SmallScene(below(150, rng), sheet(rng, 12, 0.3), unit_light(16))
    assert np.bitwise_count(masks_of(scene, backend)).sum() == 150 * 256


def test_full_light_and_full_umbra(backend: str, rng: np.random.Generator) -> None:
    points, light = below(100, rng), unit_light(10)
    elsewhere = np.concatenate(
        [
            rectangle(-FAR, FAR, -FAR, FAR, z=-0.5),
            rectangle(-FAR, FAR, -FAR, FAR, z=2.5),
            rectangle(-FAR, FAR, -FAR, FAR, z=2.0),
            rectangle(-FAR, FAR, -FAR, FAR, z=0.0),
            rectangle(5.0, 6.0, 5.0, 6.0, z=1.0),
        ]
    )
    assert not masks_of(SmallScene(points, elsewhere, light), backend).any()
    roof = np.concatenate([elsewhere, rectangle(-2.0, 3.0, -2.0, 3.0, z=1.9)])
    assert (cast_scene(SmallScene(points, roof, light), backend).visibility == 0.0).all()
