"""Scenes that break shadow algorithms, made of numbers alone: the same for the same seed."""

from collections.abc import Sequence

import numpy as np

from penumbra.arrays import Float64Array
from penumbra.errors import SceneError
from penumbra.lights import RectLight
from penumbra.measure.stability_point_cases import POINT_CASES, POINT_ORDINARY
from penumbra.measure.stability_scene import (
    Case,
    HardScene,
    Rng,
    SceneSize,
    general_blockers,
    general_receivers,
    halves,
    on_grid,
    scene_of,
    torn_sheet,
)

CORNER = np.array([-1.0, -1.0, 4.0])
# A rectangle that is tilted: no coordinate difference in its plane is zero by itself.
EDGE_U = np.array([0.0, 2.0, 0.5])
EDGE_V = np.array([2.0, 0.0, 0.0])


def cases_named(names: Sequence[str]) -> tuple[Case, ...]:
    """The cases of some names, in the order of CASES; all for no name. Raises SceneError for others."""
    unknown = set(names) - {case.name for case in CASES}
    if unknown:
        known = ", ".join(case.name for case in CASES)
        raise SceneError(f"there is no case {min(unknown)!r}: use {known}")
    return tuple(case for case in CASES if not names or case.name in names)


def ordinary_of(case: Case) -> Case:
    """The case in general position that the times of a case are over: that with the same type of light."""
    return POINT_ORDINARY if case.has_point_light else ORDINARY


def ordinary(rng: Rng, size: SceneSize) -> HardScene:
    """Triangles, receivers and samples in general position: what the hard cases are timed against."""
    points, blockers = general_receivers(rng, size.n_receivers), general_blockers(rng, size.n_blockers)
    return scene_of(points, blockers, _light(rng, size))


def through_the_light(rng: Rng, size: SceneSize) -> HardScene:
    """Half of the blockers pass through the light."""
    n_through = size.n_blockers // 2
    inside = _in_light_plane(rng.integers(1, 16, (n_through, 2)) / 16.0)
    first, second = on_grid(rng.normal(0, 0.5, (2, n_through, 3)), 64)
    # The point inside the light is (a + b + 2 c) / 4.
    through = np.stack([first, second, -0.5 * (first + second)], axis=1) + inside[:, None]
    blockers = np.concatenate([through, general_blockers(rng, size.n_blockers - n_through)])
    return scene_of(general_receivers(rng, size.n_receivers), blockers, _light(rng, size))


def touching_the_light(rng: Rng, size: SceneSize) -> HardScene:
    """Each blocker has a vertex, an edge between two, or the middle of an edge at light samples."""
    light = _light(rng, size, exact=True)
    # Two samples each, never the same one: the blocker would have no area.
    first, step = (
        rng.integers(0, size.n_samples, size.n_blockers),
        rng.integers(1, size.n_samples, size.n_blockers),
    )
    at_sample = light.sample_points[0][np.stack([first, (first + step) % size.n_samples], axis=1)]
    reach = on_grid(rng.normal([0, 0, -1], [0.7, 0.7, 0.5], (size.n_blockers, 2, 3)), 64)
    triangles = at_sample[:, :1] + np.concatenate([np.zeros_like(reach[:, :1]), reach], axis=1)
    triangles[1::3, 1] = at_sample[1::3, 1]
    triangles[2::3, 0] = at_sample[2::3, 0] - reach[2::3, 0]
    return scene_of(general_receivers(rng, size.n_receivers), triangles, light)


def in_the_light_plane(rng: Rng, size: SceneSize) -> HardScene:
    """Half of the blockers lie in the plane of the light: over it, beside it, and equal to its halves."""
    n_flat = size.n_blockers // 8
    flat = _in_light_plane(rng.integers(-8, 25, (n_flat, 3, 2)) / 16.0)
    flat[:2] = _in_light_plane(np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], float))[
        : len(flat)
    ]
    blockers = np.concatenate([flat, general_blockers(rng, size.n_blockers - n_flat)])
    return scene_of(general_receivers(rng, size.n_receivers), blockers, _light(rng, size, exact=True))


def receivers_on_planes(rng: Rng, size: SceneSize) -> HardScene:
    """Every receiver lies in the plane of a blocker, inside of it, at its rim or beside it."""
    blockers = general_blockers(rng, size.n_blockers, cells=16)
    a, b, c = np.moveaxis(rng.choice(blockers, size.n_receivers), 1, 0)
    weights = rng.integers(-8, 13, (2, size.n_receivers, 1)) / 8.0
    return scene_of(a + weights[0] * (b - a) + weights[1] * (c - a), blockers, _light(rng, size))


def receivers_on_edges(rng: Rng, size: SceneSize) -> HardScene:
    """A hilly surface and receivers on its edges; half of them know one of their triangles."""
    return _on_hills(rng, size, np.array([[4, 4, 0], [0, 2, 6], [7, 0, 1]]) / 8.0)


def receivers_on_vertices(rng: Rng, size: SceneSize) -> HardScene:
    """A hilly surface and receivers at its vertices; half of them know one of their triangles."""
    return _on_hills(rng, size, np.eye(3))


def receivers_in_the_light_plane(rng: Rng, size: SceneSize) -> HardScene:
    """Receivers in the plane of the light, a quarter at its samples; blockers through and in the plane."""
    light = _light(rng, size, exact=True, two_sided=True)
    points = _in_light_plane(rng.integers(-16, 25, (size.n_receivers, 2)) / 8.0)
    points[::4] = rng.choice(light.sample_points[0], len(points[::4]))
    parameters = rng.integers(-24, 41, (size.n_blockers, 1, 2)) + rng.integers(-6, 7, (size.n_blockers, 3, 2))
    blockers = _in_light_plane(parameters / 16.0)
    blockers[::2, 0, 2] += 0.5
    blockers[::2, 1, 2] -= 0.5
    return scene_of(points, blockers, light)


def grazing(rng: Rng, size: SceneSize) -> HardScene:
    """A sheet of triangles with holes; from each receiver, a sample lies exactly behind a vertex or edge."""
    light = _light(rng, size, exact=True)
    sheet = torn_sheet(rng, size.n_blockers)
    weights = rng.choice(np.array([[4, 0, 0], [2, 2, 0], [1, 3, 0]]) / 4.0, size.n_receivers)
    behind = np.einsum("rk,rkc->rc", weights, rng.choice(sheet, size.n_receivers))
    times = rng.choice([1.0, 3.0], (size.n_receivers, 1))
    samples = rng.choice(light.sample_points[0], size.n_receivers)
    return scene_of(behind + times * (behind - samples), sheet, light)


def slivers(rng: Rng, size: SceneSize) -> HardScene:
    """Needles, and three corners almost on a line: 1e1 to 1e16 times as long as they are wide."""
    a, b = rng.uniform([-2, -2, 1], [2, 2, 3], (2, size.n_blockers, 3))
    wide = 10.0 ** rng.uniform(-16, -1, (size.n_blockers, 1)) * rng.normal(0, 1, (size.n_blockers, 3))
    along = np.where(rng.random((size.n_blockers, 1)) < 0.5, 1.0, rng.random((size.n_blockers, 1)))
    blockers = np.stack([a, b, a + (b - a) * along + wide], axis=1)
    return scene_of(general_receivers(rng, size.n_receivers), blockers, _light(rng, size))


def light_is_a_line(rng: Rng, size: SceneSize) -> HardScene:
    """A light with one edge of length zero; half of the blockers have it in their planes."""
    return _flat_light(rng, size, EDGE_V, np.zeros(3))


def light_is_folded(rng: Rng, size: SceneSize) -> HardScene:
    """A light with parallel edges, no wider than a line; half of the blockers have it in their planes."""
    return _flat_light(rng, size, EDGE_V, -0.5 * EDGE_V)


def edges_are_zero(rng: Rng, size: SceneSize) -> HardScene:
    """A rect light with both edges of length zero; half of the blockers have it in their planes."""
    return _flat_light(rng, size, np.zeros(3), np.zeros(3))


def light_is_a_sliver(rng: Rng, size: SceneSize) -> HardScene:
    """A light 1e9 times as long as wide; half of receivers and blockers are dust of its width around it."""
    width = 2.0**-30
    light = RectLight(
        CORNER,
        EDGE_V,
        np.array([0.0, 0.5, 2.0]) * width - 0.5 * EDGE_V,
        samples=size.n_samples,
        sets=8,
        seed=int(rng.integers(2**31)),
        two_sided=True,
    )
    n_points, n_blockers = size.n_receivers // 2, size.n_blockers // 2
    points, triangles = rng.normal(0, width, (n_points, 3)), rng.normal(0, width, (n_blockers, 3, 3))
    points += CORNER + rng.uniform(-1, 2, (n_points, 1)) * EDGE_V
    triangles += CORNER + rng.uniform(-1, 2, (n_blockers, 1, 1)) * EDGE_V
    return scene_of(
        np.concatenate([points, general_receivers(rng, size.n_receivers - n_points)]),
        np.concatenate([triangles, general_blockers(rng, size.n_blockers - n_blockers)]),
        light,
    )


ORDINARY = Case("ordinary", "general position", ordinary)
CASES = (
    ORDINARY,
    Case("through-the-light", "blockers pass through the light", through_the_light),
    Case("touching-the-light", "blockers touch light samples with vertices and edges", touching_the_light),
    Case("in-the-light-plane", "blockers in the plane of the light", in_the_light_plane),
    Case("receivers-on-planes", "receivers in the planes of blockers", receivers_on_planes),
    Case("receivers-on-edges", "receivers on the edges of a surface", receivers_on_edges),
    Case("receivers-on-vertices", "receivers at the vertices of a surface", receivers_on_vertices),
    Case("receivers-in-light-plane", "receivers in the plane of the light", receivers_in_the_light_plane),
    Case("grazing", "segments exactly through vertices and edges", grazing),
    Case("grazing-within-an-ulp", "the same, every coordinate up to one ulp off", grazing, nudged=True),
    Case("slivers", "triangles 1e1 to 1e16 times as long as wide", slivers),
    Case("light-is-a-line", "a light without width", light_is_a_line),
    Case("light-is-folded", "a light with parallel edges", light_is_folded),
    Case("light-is-a-sliver", "a light 1e9 times as long as wide, and dust around it", light_is_a_sliver),
    Case("edges-are-zero", "a rect light whose edges are both zero", edges_are_zero),
    *POINT_CASES,
)


def _light(rng: Rng, size: SceneSize, *, exact: bool = False, two_sided: bool = False) -> RectLight:
    """The light; `exact`: its samples are multiples of a power of two, the same for every receiver."""
    return RectLight(
        CORNER,
        EDGE_U,
        EDGE_V,
        samples=size.n_samples,
        sets=1 if exact else 8,
        seed=int(rng.integers(2**31)),
        pattern="regular" if exact else "jittered",
        two_sided=two_sided,
    )


def _in_light_plane(parameters: Float64Array) -> Float64Array:
    """Points (..., 3) of the plane of the light; (..., 2) parameters from 0 to 1 are on the light."""
    points: Float64Array = CORNER + parameters[..., :1] * EDGE_U + parameters[..., 1:] * EDGE_V
    return points


def _hills(rng: Rng, n_blockers: int) -> Float64Array:
    """Triangles of a height field that throws shadows on itself."""
    n_rows = int(np.ceil(np.sqrt(n_blockers / 2)))
    x, y = np.meshgrid(np.arange(n_rows + 1), np.arange(n_rows + 1), indexing="ij")
    height = rng.integers(0, 9, x.shape) / 4.0
    return halves(np.stack([x * 0.5 - 2.0, y * 0.5 - 2.0, height], axis=-1))[:n_blockers]


def _on_hills(rng: Rng, size: SceneSize, weights: Float64Array) -> HardScene:
    hills = _hills(rng, size.n_blockers)
    lies_on = rng.integers(0, len(hills), size.n_receivers)
    points = np.einsum("rk,rkc->rc", rng.choice(weights, size.n_receivers), hills[lies_on])
    own = np.where(rng.random(size.n_receivers) < 0.5, lies_on, -1)
    return scene_of(points, hills, _light(rng, size), own)


def _flat_light(rng: Rng, size: SceneSize, edge_u: Float64Array, edge_v: Float64Array) -> HardScene:
    """A two-sided light of zero area (one-sided, it would light nothing) above ordinary blockers."""
    light = RectLight(
        CORNER, edge_u, edge_v, samples=size.n_samples, sets=8, seed=int(rng.integers(2**31)), two_sided=True
    )
    n_edge_on = size.n_blockers // 8
    # One corner on the line of the light or between it and the other two, which are on a parallel line.
    below = general_blockers(rng, n_edge_on)[:, 0]
    direction = edge_u if edge_u.any() else np.array([0.5, 0.25, 0.0])
    along = direction * rng.choice([-1.0, -0.5, 0.5, 1.0, 2.0], (2, n_edge_on, 1))
    down = rng.choice([0.0, 0.25, 0.5, 0.75], (n_edge_on, 1)) * (below - CORNER)
    edge_on = np.stack([below, CORNER + along[0] + down, below + 0.5 * along[1]], axis=1)
    return scene_of(
        general_receivers(rng, size.n_receivers),
        np.concatenate([edge_on, general_blockers(rng, size.n_blockers - n_edge_on)]),
        light,
    )
