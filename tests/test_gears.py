"""The parts of backend "gears": camera C, the grid, shadow volumes as boxes of cells, batches of pairs."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from backends import assert_every_bit, cast_scene, masks_of
from scenes import LIGHTS, SmallScene, large_scene, light_named, scene_of, transformed

import penumbra
from penumbra import CastOptions, IngestOptions, PointLight, RectLight
from penumbra.errors import SceneError
from penumbra.image import header_attributes
from penumbra.ingest import blockers_in_memory
from penumbra.kernels.shadow_grid import bound_volumes, count_cells, fill_cells
from penumbra.measure.stability_cases import cases_named
from penumbra.measure.stability_scene import SceneSize, hard_scene
from penumbra.receiver_grid import ShadowGrid, make_grids
from penumbra.stats import Stats

OPTIONS = {
    "one cell": CastOptions(grid_resolution=1),
    "three cells": CastOptions(grid_resolution=3),
    "more cells than receivers": CastOptions(grid_resolution=300),
    "regular": CastOptions(grid_resolution=7, grid_spacing="regular"),
    "eye in the light": CastOptions(grid_resolution=7, grid_eye=0.0),
    "eye far off": CastOptions(grid_resolution=7, grid_eye=50.0),
    "far extrusion": CastOptions(grid_resolution=7, correct_extrusion=False),
    "a pair at a time": CastOptions(grid_resolution=7, pair_bytes=4),
    "blocked ones kept": CastOptions(grid_resolution=7, umbra_bits=False),
    "binned again at once": CastOptions(grid_resolution=7, rebuild_fraction=1e-9, pair_bytes=64),
    "groups of 64": CastOptions(grid_resolution=7, group_size=64),
}
PLACES = [(1.0, 0.0), (1e-6, 1e4), (1e6, 0.0), (1.0, 1e6), (1e-150, 0.0)]
FAMILIES = ("soup", "lattice", "around_the_light", "in_the_light_plane", "on_blockers", "close_to_the_light")


def grid_of(points: np.ndarray, light: RectLight | PointLight, extent: float, **how: Any) -> list[ShadowGrid]:
    """Grids of all receivers."""
    settings = {"resolution": 9, "eye_distance": 0.5, "spacing": "quantile"} | how
    return make_grids(
        points,
        np.arange(len(points)),
        light.light_samples(32),
        two_sided=light.two_sided,
        blocker_extent=extent,
        **settings,
    )


def assignments(grid: ShadowGrid, triangles: np.ndarray, correct: bool) -> list[set[int]]:
    """Blockers assigned to each cell, the one outside the image last."""
    n = len(triangles)
    rects, nearest, counts = np.empty((n, 4), np.int32), np.empty(n), np.empty(n, np.int64)
    error = grid.camera.error
    bound_volumes(triangles, 0, n, grid.camera, grid.grid, correct, rects, nearest, counts)
    found = np.zeros(len(grid.grid.far) + 1, np.int64)
    count_cells(0, n, rects, nearest, grid.grid, error, found)
    assert found.sum() == counts.sum()
    begin = np.concatenate([[0], np.cumsum(found)])
    pairs = np.empty(begin[-1], np.int32)
    fill_cells(0, n, rects, nearest, grid.grid, error, begin[:-1].copy(), pairs)
    return [set(pairs[a:b].tolist()) for a, b in zip(begin, begin[1:], strict=False)]


def cells_of_receivers(grid: ShadowGrid, n_receivers: int) -> np.ndarray:
    """Cell of each receiver, -1 for those of another grid."""
    cell = np.full(n_receivers, -1)
    cell[grid.grid.rows] = np.repeat(np.arange(len(grid.grid.far) + 1), np.diff(grid.grid.first))
    return cell


@pytest.mark.parametrize("options", OPTIONS)
@pytest.mark.parametrize("family", FAMILIES)
def test_no_option_changes_a_bit(family: str, options: str) -> None:
    light = light_named("square above, two-sided", 40, sets=2)
    assert_every_bit(scene_of(family, light), "gears", options=OPTIONS[options])


@pytest.mark.parametrize("name", LIGHTS)
@pytest.mark.parametrize("correct", [True, False])
@pytest.mark.parametrize(
    ("scale", "offset"), [(1.0, 0.0), (1e-6, 1e4), (1e6, 0.0), (1.0, 1e6), (1e-150, 0.0)]
)
def test_receivers_in_a_shadow_volume_are_in_its_cells(
    name: str, correct: bool, scale: float, offset: float, rng: np.random.Generator
) -> None:
    light = light_named(name, 16, sets=4)
    n = 400
    triangles = rng.uniform([-2, -2, -1], [2, 2, 5], (n, 1, 3)) + rng.normal(0, 0.4, (n, 3, 3))
    inside = np.einsum("tk,tkc->tc", rng.dirichlet([1, 1, 1], n), triangles)
    samples = rng.choice(light.sample_points.reshape(-1, 3), n)
    points = samples + (inside - samples) * rng.uniform(1.0, 4.0, (n, 1)) ** 2
    scene = transformed(SmallScene(points, triangles, light), scale, offset)
    points, triangles, light = scene.points, np.ascontiguousarray(scene.triangles), scene.light
    if not light.two_sided:
        front = (points - light.corner) @ np.cross(light.edge_u, light.edge_v) > 0
        points, triangles = points[front], np.ascontiguousarray(triangles[front])
    if not len(points):
        return
    grids = grid_of(points, light, float(np.abs(triangles).max()))
    assert sum(len(grid.grid.rows) for grid in grids) == len(points)
    for grid in grids:
        assigned = assignments(grid, triangles, correct)
        cells = cells_of_receivers(grid, len(points))
        missing = [r for r in np.flatnonzero(cells >= 0) if r not in assigned[cells[r]]]
        # Only where rounding moved a receiver off its segment may it have left the shadow.
        for r in missing:
            pair = replace(scene, points=points[r : r + 1], triangles=triangles[r : r + 1])
            assert not masks_of(pair, "reference", index=np.array([r])).any()
        assert len(missing) < 0.05 * len(points) or offset > 0


def test_grid_is_used_not_left(rng: np.random.Generator) -> None:
    light = RectLight((-1, -1, 4), (0, 2, 0), (2, 0, 0), samples=64)
    points = np.concatenate([rng.uniform(-4, 4, (3000, 2)), np.zeros((3000, 1))], axis=1)
    centres = rng.uniform([-4, -4, 0.2], [4, 4, 1], (500, 1, 3))
    triangles = centres + rng.normal(0, 0.1, (500, 3, 3))
    stats = cast_scene(SmallScene(points, triangles, light), "gears").stats.as_dict()
    assert stats["receivers_outside_grid"] == 0
    assert stats["cells"] == 128 * 128
    assert stats["pairs_blocking"] <= stats["pairs_tested"] + stats["pairs_covering"]
    assert stats["pairs_tested"] <= stats["pairs_assigned"] < 0.05 * len(points) * len(triangles)
    assert stats["most_receivers_in_cell"] * stats["cells_used"] >= len(points)


def test_correction_of_the_extrusion_saves_assignments(rng: np.random.Generator) -> None:
    light = RectLight((-1, -1, 4), (0, 2, 0), (2, 0, 0), samples=64)
    near = np.concatenate([rng.uniform(-4, 0, (2000, 2)), np.zeros((2000, 1))], axis=1)
    deep = np.concatenate([rng.uniform(2, 4, (2000, 2)), np.full((2000, 1), -20.0)], axis=1)
    triangles = rng.uniform([-4, -4, 1], [0, 0, 2], (300, 1, 3)) + rng.normal(0, 0.1, (300, 3, 3))
    scene = SmallScene(np.concatenate([near, deep]), triangles, light)
    counted = [
        cast_scene(scene, "gears", options=CastOptions(correct_extrusion=correct, umbra_bits=False)).stats
        for correct in (True, False)
    ]
    corrected, whole = [stats.as_dict() for stats in counted]
    assert corrected["pairs_assigned"] < whole["pairs_assigned"]
    assert corrected["pairs_blocking"] == whole["pairs_blocking"]


def test_pairs_stay_within_their_memory() -> None:
    scene = large_scene(500, 400, light_named("square above", 64))
    whole = cast_scene(scene, "gears")
    parts = cast_scene(scene, "gears", options=CastOptions(pair_bytes=4000))
    assert np.array_equal(whole.masks, parts.masks)
    pairs, batches = whole.stats.counters["cell_pairs"], parts.stats.counters["batches"]
    assert whole.stats.counters["batches"] == 1
    assert batches >= parts.stats.counters["cell_pairs"] // 1000 > 1
    assert pairs >= parts.stats.counters["cell_pairs"]


def test_each_side_of_a_two_sided_light_has_its_camera(rng: np.random.Generator) -> None:
    light = RectLight((-1, -1, 0), (0, 2, 0), (2, 0, 0), samples=16, two_sided=True)
    points = rng.uniform([-3, -3, -3], [3, 3, 3], (200, 3))
    front, back = grid_of(points, light, 3.0)
    normal = np.cross(light.edge_u, light.edge_v)
    assert (points[front.grid.rows] @ normal >= 0).all()
    assert (points[back.grid.rows] @ normal < 0).all()
    assert len(front.grid.rows) + len(back.grid.rows) == len(points)
    assert front.camera.eye[2] < 0 and back.camera.eye[2] < 0


@pytest.mark.parametrize("size", [1.0, 1e-3, 1e-9, 0.0])
def test_eye_converges_to_the_light(size: float) -> None:
    """GEARS section 3.1: as the light becomes a point, C becomes the camera of the irregular z-buffer."""
    light = RectLight((-size / 2, -size / 2, 4), (0, size, 0), (size, 0, 0), samples=16, two_sided=True)
    (grid,) = grid_of(np.random.default_rng(3).uniform([-2, -2, -1], [2, 2, 0], (50, 3)), light, 3.0)
    assert np.abs(grid.camera.eye).max() <= size
    assert (grid.camera.eye[2] < 0) == (size > 0)


def test_assignments_converge_to_those_of_a_point() -> None:
    """A shrinking light needs ever fewer pairs, and no more than the point in the end."""
    scene = large_scene(4000, 300, RectLight((-1, -1, 4), (0, 2, 0), (2, 0, 0), samples=16, two_sided=True))
    counted = []
    for size in (2.0, 0.5, 1e-2, 1e-9):
        light = RectLight((-size / 2, -size / 2, 4), (0, size, 0), (size, 0, 0), samples=16, two_sided=True)
        stats = cast_scene(replace(scene, light=light), "gears", options=CastOptions(umbra_bits=False)).stats
        counted.append(stats.counters["pairs_assigned"])
    point = cast_scene(
        replace(scene, light=PointLight((0, 0, 4))), "gears", options=CastOptions(umbra_bits=False)
    ).stats.counters["pairs_assigned"]
    assert counted == sorted(counted, reverse=True)
    assert abs(counted[-1] - point) <= 0.01 * point


def test_chunks_that_reach_no_cell_are_not_read(rng: np.random.Generator) -> None:
    light = RectLight((-1, -1, 4), (0, 2, 0), (2, 0, 0), samples=16)
    points = np.concatenate([rng.uniform(-1, 1, (100, 2)), np.zeros((100, 1))], axis=1)
    away = rng.uniform([50, 50, 1], [60, 60, 3], (200, 1, 3)) + rng.normal(0, 0.1, (200, 3, 3))
    between = rng.uniform([-1, -1, 1], [1, 1, 3], (200, 1, 3)) + rng.normal(0, 0.1, (200, 3, 3))
    triangles = np.concatenate([away, between])
    blockers = blockers_in_memory(triangles, IngestOptions(chunk_triangles=50))
    scene = SmallScene(points, triangles, light)
    result = cast_scene(scene, "gears", blockers)
    assert np.array_equal(result.masks, masks_of(scene, "reference"))
    assert result.stats.counters["bytes_skipped"] > 0
    assert result.stats.counters["bytes_read"] + result.stats.counters["bytes_skipped"] == blockers.n_bytes


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_threads_change_nothing(threads: int) -> None:
    scene = large_scene(700, 300, light_named("skewed", 100, sets=3))
    assert np.array_equal(
        masks_of(scene, "gears", threads=threads, options=CastOptions(pair_bytes=4096)),
        masks_of(scene, "hpc"),
    )


@pytest.mark.parametrize(
    "wrong",
    [
        {"grid_resolution": 0},
        {"grid_resolution": 5000},
        {"grid_spacing": "even"},
        {"grid_eye": -1.0},
        {"grid_eye": float("nan")},
        {"pair_bytes": 0},
    ],
)
def test_options_out_of_range_are_named(wrong: dict[str, Any]) -> None:
    with pytest.raises(SceneError, match=next(iter(wrong))):
        CastOptions(**wrong)


def test_no_receiver_and_no_blocker() -> None:
    light = light_named("square above", 16)
    assert penumbra.cast(np.zeros((0, 3)), np.zeros((0, 3, 3)), light, backend="gears").masks.shape == (0, 1)
    result = penumbra.cast(np.zeros((5, 3)), np.zeros((0, 3, 3)), light, backend="gears")
    assert (result.visibility == 1).all()


def test_seconds_are_named_as_those_of_hpc_and_steps_are_parts_of_them() -> None:
    scene = large_scene(3000, 300, light_named("square above", 16))
    gears = cast_scene(scene, "gears", options=CastOptions(rebuild_fraction=1e-9)).stats
    assert list(gears.seconds) == list(cast_scene(scene, "hpc").stats.seconds) == ["hierarchy", "cast"]
    steps = {f"cast_{step}" for step in ("bound", "count", "prefix_sum", "fill", "rasterise", "bin")}
    assert set(gears.step_seconds) == steps
    assert 0 < sum(gears.step_seconds.values()) <= gears.seconds["cast"]
    numbers = gears.as_dict()
    assert all(0 <= numbers[f"seconds_{step}"] <= numbers["seconds_cast"] for step in steps)
    # The time of all: nothing counts twice, of one run or of two.
    assert header_attributes({"lights": [{"name": "key"}]}, gears, "")["penumbra:seconds"] == pytest.approx(
        gears.seconds["hierarchy"] + gears.seconds["cast"]
    )
    both = Stats("gears")
    for _ in range(2):
        both.merge(gears)
    assert both.step_seconds == {step: 2 * seconds for step, seconds in gears.step_seconds.items()}


@pytest.mark.parametrize("seed", range(4))
def test_a_light_with_thickness_hides_behind_deeper_blockers(seed: int) -> None:
    """Edges parallel but for 1e-9: some samples are deeper than the dust around, and than what hides them."""
    hard = hard_scene(cases_named(["light-is-a-sliver"])[0], SceneSize(1024, 128, 64), seed)
    scene = SmallScene(hard.points, hard.triangles, hard.light, None, hard.own)
    assert np.array_equal(masks_of(scene, "gears"), masks_of(scene, "reference"))


def _rotated(rng: np.random.Generator) -> np.ndarray:
    axes: np.ndarray = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return axes


def test_one_sample_of_a_light_far_larger_than_the_scene() -> None:
    """The sample is far from the light's centre: rounding there must not pass for rounding at the sample."""
    n_blocked = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        axes, size = _rotated(rng), (1e4, 1e6)[seed % 2]
        u, v = axes[0] * size, axes[1] * size
        corner = -RectLight((0, 0, 0), u, v, samples=1, sets=1, seed=seed).sample_points[0, 0]
        light = RectLight(corner, u, v, samples=1, sets=1, seed=seed, two_sided=True)
        sample = light.sample_points[0, 0]
        centre = sample + 4.0 * (axes[2] + 0.3 * rng.normal(size=2) @ axes[:2])
        spread = rng.normal(size=(1, 3, 2)) * 4.0 * 10.0 ** rng.uniform(-6, -0.5)
        triangles = centre + spread @ axes[:2]
        middle = triangles.mean(axis=1)
        points = middle + (middle - sample) / 4.0 * size * 2.0**-53 * rng.uniform(0.1, 1)
        scene = SmallScene(points, triangles, light)
        masks = masks_of(scene, "reference")
        assert np.array_equal(masks_of(scene, "gears", options=CastOptions(grid_resolution=4)), masks)
        n_blocked += int(masks.any())
    assert n_blocked > 20


def test_a_blocker_within_an_ulp_of_its_receiver() -> None:
    """One receiver, one blocker parallel to a rotated light: no neighbour hides a bound that is too tight."""
    n_blocked = 0
    for seed in range(600):
        rng = np.random.default_rng(seed)
        axes, centre = _rotated(rng), rng.normal(size=3)
        corner = centre - 0.5 * axes[0] - 0.5 * axes[1]
        light = RectLight(corner, axes[0], axes[1], samples=16, sets=1, two_sided=True)
        far = 10.0 ** rng.integers(0, 4)
        middle = centre + far * (rng.uniform(0.5, 1) * axes[2] + rng.normal(size=2) @ axes[:2])
        spread = rng.normal(size=(1, 3, 2)) * far * 10.0 ** rng.uniform(-12, 0)
        triangles = middle + spread @ axes[:2]
        sample = light.sample_points[0, rng.integers(0, 16)]
        on = triangles.mean(axis=1)
        behind = np.spacing(far) * rng.choice([0.5, 1, 1.5, 2])
        scene = SmallScene(on + (on - sample) / np.linalg.norm(on - sample) * behind, triangles, light)
        masks = masks_of(scene, "reference")
        assert np.array_equal(masks_of(scene, "gears", options=CastOptions(grid_resolution=300)), masks)
        n_blocked += int(masks.any())
    assert n_blocked > 50
