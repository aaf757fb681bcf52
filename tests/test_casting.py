"""The parts of the casting engine: hierarchy, penumbra volumes, shaft, lanes; and what its switches save."""

from dataclasses import replace

import numba
import numpy as np
import pytest

from penumbra.api import cast
from penumbra.arrays import Blocker, Receivers
from penumbra.errors import MemoryLimitError
from penumbra.facing import full_mask
from penumbra.kernels import _jit, lanes
from penumbra.kernels.borrow import borrow
from penumbra.kernels.hard_shadow import fill_normal
from penumbra.kernels.penumbra_volume import contains_point, fill_volume, light_gap
from penumbra.kernels.receiver_bvh import build_bvh
from penumbra.lights import RectLight, sample_sets_of
from penumbra.options import CastOptions
from penumbra.receivers import ReceiverTile, split_into_tiles

# No joint descent of receivers and blockers: what the switches are about.
ONE_AT_A_TIME = CastOptions(joint_triangles=1 << 40)


def build(points: np.ndarray, leaf_size: int):
    """Hierarchy over all points."""
    n = len(points)
    order = np.arange(n, dtype=np.int32)
    boxes = np.empty((2 * n + 1, 6))
    first, count, child = (np.empty(2 * n + 1, np.int32) for _ in range(3))
    n_nodes, depth = build_bvh(points, order, leaf_size, boxes, first, count, child)
    return order, boxes[:n_nodes], first[:n_nodes], count[:n_nodes], child[:n_nodes], depth


POINT_SETS = {
    "one": lambda rng: rng.random((1, 3)),
    "few": lambda rng: rng.random((17, 3)),
    "many": lambda rng: rng.random((5000, 3)),
    "flat": lambda rng: rng.random((3000, 3)) * [1, 0, 1],
    "line": lambda rng: rng.random((3000, 1)) ** 9 * [1, 0, 0],
    "one place": lambda rng: np.full((3000, 3), 0.1),
    "two places": lambda rng: np.repeat([[0.0, 0, 0], [1e300, 1, 1]], 1500, axis=0),
    "geometric": lambda rng: 2.0 ** -np.arange(0, 1000, 0.25)[:, None] * [1, 1, 0],
}


@pytest.mark.parametrize("name", POINT_SETS)
@pytest.mark.parametrize("leaf_size", [1, 16])
def test_hierarchy_holds_every_point_once_and_tightly(name, leaf_size, rng):
    points = POINT_SETS[name](rng)
    order, boxes, first, count, child, depth = build(points, leaf_size)
    assert sorted(order) == list(range(len(points)))
    level = np.ones(len(boxes), int)
    for node in range(len(boxes)):
        members = points[order[first[node] : first[node] + count[node]]]
        assert np.array_equal(boxes[node], np.concatenate([members.min(0), members.max(0)]))
        left = child[node]
        if left < 0:
            assert 1 <= count[node] <= leaf_size
            continue
        assert first[left] == first[node] and first[left + 1] == first[node] + count[left]
        assert count[left] + count[left + 1] == count[node]
        level[left : left + 2] = level[node] + 1
    assert depth == level.max()
    assert depth < 200


def test_most_leaves_are_full_vectors(rng):
    *_, count, child, _ = build(rng.random((20000, 3)), 16)
    leaves = count[child < 0]
    assert (leaves == 16).mean() > 0.8


def test_tiles_partition_the_live_rows(rng):
    points, live = rng.random((5000, 3)), np.flatnonzero(rng.random(5000) < 0.7)
    tiles = split_into_tiles(points, live, 300)
    assert max(map(len, tiles)) <= 300
    assert np.array_equal(np.sort(np.concatenate(tiles)), live)


@numba.njit
def _volume(tri, light, polygon, extent, reach, points, inside):
    planes = np.empty((4, 8))
    normal, choices = np.empty(6), np.full(7, -1)
    fill_normal(tri, normal)
    gap = light_gap(tri, light)
    if gap <= 0.0:
        inside[:] = True
        return
    blocker = Blocker(tri, 0, 0, extent, reach / gap)
    found = fill_volume(blocker, normal, light, polygon, choices, planes)
    for r in range(points.shape[0]):
        inside[r] = contains_point(planes, 0, found, points[r, 0], points[r, 1], points[r, 2])


@pytest.mark.parametrize("grid", [None, 4])
def test_penumbra_volume_holds_every_shadowed_receiver(grid, rng):
    """Receivers are put behind the blocker on lines from actual samples, so that all are in shadow."""
    light = RectLight([-1, 2, -1], [2, 0.3, 0], [0, 0.2, 2], samples=64)
    samples = light.light_samples(32)
    tight = 0
    for _ in range(300):
        tri = rng.normal(size=(3, 3)) * rng.choice([0.01, 0.3, 2]) + rng.uniform(-2, 2, 3)
        if grid:
            tri = np.round(tri * grid) / grid
        group = rng.integers(0, 3)
        run = slice(0, 64) if group == 0 else slice(32 * (group - 1), 32 * group)
        n = 40
        target = (rng.dirichlet([1, 1, 1], n)[:, :, None] * tri).sum(1)
        target[:3] = tri
        origin = light.sample_points[rng.integers(0, 8, n), rng.integers(run.start, run.stop, n)]
        points = target + rng.exponential(2, (n, 1)) * (target - origin)
        extent = max(np.abs(points).max(), np.abs(tri).max(), 3.0)
        reach = np.linalg.norm(points - origin, axis=1).max()
        inside = np.empty(n, np.bool_)
        _volume(tri, samples, group, extent, reach, points, inside)
        assert inside.all()
        elsewhere = rng.uniform(-4, 4, (n, 3))
        _volume(tri, samples, group, extent, 2 * reach, elsewhere, inside)
        tight += (~inside).sum()
    assert tight > 0.5 * 300 * 40


def test_shaft_keeps_every_box_that_a_segment_meets(rng):
    light = RectLight([1, 3, 1], [1, 0, 0.5], [0, 0.5, 1], samples=16)
    points = rng.uniform(-1, 0, (50, 3))
    receivers = Receivers(points, np.zeros((0, 3)), np.full(50, -1), np.arange(50))
    sets = sample_sets_of(receivers.index, 0, light.sets)
    tile = ReceiverTile(
        np.arange(50), receivers, sets, light.light_samples(32), full_mask(16),
        blocker_extent=10.0, group_size=32, leaf_receivers=16, lazy_masks=True,
    )  # fmt: skip
    tile.build()
    ends = light.sample_points[rng.integers(0, 8, 50), rng.integers(0, 16, 50)]
    on_way = points + rng.random((50, 1)) * (ends - points)
    boxes = np.stack([on_way - 1e-3 * rng.random((50, 3)), on_way], axis=1)
    assert tile.touches(boxes).all()
    far = rng.uniform(-6, 6, (500, 3))
    assert tile.touches(np.stack([far, far + 0.01], axis=1)).mean() < 0.3


@numba.njit
def _lane_operations(x, y, out, bits):
    x, y = borrow(x), borrow(y)
    a, b = lanes.load(x, 0), lanes.load(y, 0)
    c = lanes.lesser(a + b * lanes.splat(x[1]), a - b)
    d = lanes.greater(c, b)
    bits[0] = lanes.bits_above(d, a)
    bits[1] = lanes.bits_not_below(c, a)
    for k in range(out.shape[0]):
        out[k] = lanes.bits_above(d, lanes.splat(out[k]))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_lanes_compute_what_numpy_computes(dtype, rng):
    n = 16 if dtype == np.float32 else 8
    x, y = rng.normal(size=(2, n)).astype(dtype)
    y[3], x[5] = np.inf, np.nan
    thresholds = rng.normal(size=5).astype(dtype)
    out, bits = thresholds.copy(), np.zeros(2, np.int64)
    _lane_operations(x, y, out, bits)
    with np.errstate(invalid="ignore"):
        first, second = x + y * x[1], x - y
        c = np.where(first < second, first, second)
        d = np.where(c > y, c, y)
        assert bits[0] == sum(1 << k for k in range(n) if d[k] > x[k])
        assert bits[1] == sum(1 << k for k in range(n) if c[k] >= x[k])
        assert list(out) == [sum(1 << k for k in range(n) if d[k] > t) for t in thresholds]


def _wall_and_grass(rng):
    """A wall that puts half of the receivers in umbra, and many small blockers behind and beside it."""
    wall = np.array([[[-3, 1, -3], [0, 1, -3], [0, 1, 3]], [[-3, 1, -3], [0, 1, 3], [-3, 1, 3]]], float)
    grass = rng.uniform([-2, 0.2, -2], [2, 0.8, 2], (2000, 1, 3)) + rng.normal(size=(2000, 3, 3)) * 0.05
    points = np.column_stack([rng.uniform(-1.5, 1.5, 3000), np.zeros(3000), rng.uniform(-1.5, 1.5, 3000)])
    return (
        points,
        np.concatenate([grass, wall]),
        RectLight([-0.5, 4, -0.5], [1, 0, 0], [0, 0, 1], samples=256),
    )


def test_each_switch_keeps_the_bits_and_shows_its_worth(rng):
    """HPC section 3.3: what A, B, C, D and the coarse sorting save, in counters."""
    points, blockers, light = _wall_and_grass(rng)
    base = cast(points, blockers, light, options=ONE_AT_A_TIME)
    saved = {
        "umbra_bits": "pairs_tested",
        "active_planes": "plane_box_tests",
        "lazy_volumes": "group_volumes_built",
        "lazy_masks": "mask_bytes",
        "sort": "pairs_tested",
    }
    for switch, counter in saved.items():
        other = cast(points, blockers, light, options=replace(ONE_AT_A_TIME, **{switch: False}))
        assert np.array_equal(base.masks, other.masks), switch
        assert base.stats.counters[counter] < other.stats.counters[counter], switch
    assert base.stats.counters["rebuilds"] > 0
    assert base.stats.counters["masks_released"] > 1000


def test_engine_equals_brute_force_where_masks_and_hierarchies_change_often(rng):
    points, blockers, light = _wall_and_grass(rng)
    points, blockers = points[:300], blockers[-400:]
    expected = cast(points, blockers, light, backend="reference").masks
    for options in (
        replace(ONE_AT_A_TIME, tile_receivers=40, leaf_receivers=3, rebuild_fraction=0.01),
        replace(ONE_AT_A_TIME, group_size=64, rebuild_fraction=1.0),
    ):
        assert np.array_equal(cast(points, blockers, light, options=options).masks, expected)


@numba.njit
def _gap(tri, light):
    return light_gap(tri, light)


def test_gap_is_never_more_than_the_distance_to_the_light(rng):
    """Also for edges that are parallel up to rounding, whose cross product is no normal of the light."""
    for trial in range(400):
        u = rng.normal(size=3)
        v = rng.normal() * u * (1 + 1e-16 * rng.normal(size=3)) if trial % 2 else rng.normal(size=3)
        light = RectLight(rng.normal(size=3), u, v, samples=16, sets=2)
        points = light.sample_points.reshape(-1, 3)
        near = points[rng.integers(len(points))] + rng.normal(size=3) * 10.0 ** rng.uniform(-12, 0)
        tri = near + np.concatenate([np.zeros((1, 3)), rng.normal(size=(2, 3))])
        closest = np.linalg.norm(points - tri[0], axis=1).min()
        assert _gap(tri, light.light_samples(32)) <= closest


def test_lights_with_nearly_parallel_edges_equal_brute_force(rng):
    for _ in range(60):
        u = rng.normal(size=3)
        light = RectLight(rng.normal(size=3), u, u * rng.normal() * (1 + 2e-16), samples=33, two_sided=True)
        ends = light.sample_points[0, rng.integers(33, size=40)]
        near = ends + rng.normal(size=(40, 3)) * 10.0 ** rng.uniform(-11, 0, (40, 1))
        blockers = near[:, None, :] + rng.normal(size=(40, 3, 3)) * 10.0 ** rng.uniform(-9, 0, (40, 1, 1))
        # Receivers behind edges of blockers, seen from samples: on the border of many shadows.
        edge = blockers[:, 0] + rng.random((40, 1)) * (blockers[:, 1] - blockers[:, 0])
        points = edge + rng.exponential(2, (40, 1)) * (edge - ends)
        expected = cast(points, blockers, light, backend="reference").masks
        assert np.array_equal(cast(points, blockers, light).masks, expected)


@pytest.mark.parametrize("width", [1e-310, 5e-324, 1e-200, 1.7e308])
def test_hierarchy_of_points_that_differ_by_almost_nothing_or_overflow(width, rng):
    points = rng.uniform(-1, 1, (200, 3)) * width
    order, *_ = build(points, 4)
    assert sorted(order) == list(range(200))


def test_samples_of_a_light_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        RectLight([0, 0, 0], [1, 0, 0], [0, 1, 0]).sample_points[0, 0] = 1.0


def test_memory_counts_blockers_and_light_samples(rng):
    points, triangles = rng.random((10, 3)), rng.random((100_000, 3, 3))
    light = RectLight([0, 2, 0], [1, 0, 0], [0, 0, 1], samples=16)
    with pytest.raises(MemoryLimitError, match="25.0 MiB|24.8 MiB"):
        cast(points, triangles, light, memory="20MiB")
    many = RectLight([0, 2, 0], [1, 0, 0], [0, 0, 1], samples=65536, sets=64)
    with pytest.raises(MemoryLimitError):
        cast(points, triangles[:2], many, memory="100MiB")


def test_kernel_cache_changes_with_the_kernels_wherever_it_is(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    before = _jit.cache_folder()
    assert before.is_relative_to(tmp_path)
    monkeypatch.setattr(_jit, "_sources_hash", lambda: "another")
    assert _jit.cache_folder() != before


def test_kernel_cache_falls_back_where_its_folder_cannot_be_made(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    folder = _jit.cache_folder()
    assert folder.is_relative_to(tmp_path) and not folder.is_relative_to(tmp_path / "file")
