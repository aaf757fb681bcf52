"""The joint descent: light space, leaves, projected boxes, and scenes made against its float32 bounds."""

import numba
import numpy as np
import pytest
from backends import assert_every_bit
from scenes import SmallScene

import penumbra
from penumbra.api import cast
from penumbra.arrays import Receivers
from penumbra.facing import face_light
from penumbra.ingest import blockers_in_memory
from penumbra.joint import JointReceivers, joint_cast
from penumbra.kernels.joint_casting import N_BINS, _cover, _samples_between
from penumbra.kernels.lanes import load, splat, store
from penumbra.kernels.receiver_leaves import sort_keys
from penumbra.light_space import light_space
from penumbra.lights import RectLight
from penumbra.options import CastOptions

LIGHTS = {
    "square": RectLight([-0.5, 3, -0.5], [1, 0, 0], [0, 0, 1], samples=256, sets=3),
    "skewed": RectLight([-1, 2, -1], [2, 0.3, 0], [0.7, 0.2, 2], samples=300, sets=2),
    "narrow": RectLight([0, 3, 0], [1, 0, 0], [0, 0, 1e-3], samples=70, sets=1),
    "far": RectLight([1000, 3000, 1000], [1, 0, 0], [0, 0, 1], samples=64, sets=2),
}


def receivers_at(points: np.ndarray, own: np.ndarray | None = None) -> Receivers:
    n = len(points)
    return Receivers(points, np.zeros((0, 3)), np.full(n, -1) if own is None else own, np.arange(n))


def sides_of(points: np.ndarray, light: RectLight, triangles: np.ndarray) -> list[JointReceivers]:
    receivers = receivers_at(points)
    return joint_cast(
        receivers, face_light(receivers, light, 32), light, blockers_in_memory(triangles), 1
    ).sides


def both_ways(points: np.ndarray, triangles: np.ndarray, light: RectLight, **arguments: object) -> dict:
    """Counters of the joint descent, after its masks are compared with exact brute force."""
    expected = cast(points, triangles, light, backend="reference", **arguments).masks
    found = cast(points, triangles, light, **arguments)
    assert np.array_equal(found.masks, expected)
    one_at_a_time = cast(points, triangles, light, options=CastOptions(joint_triangles=1 << 40), **arguments)
    assert np.array_equal(one_at_a_time.masks, expected)
    assert one_at_a_time.stats.counters["cluster_pairs"] == 0
    return found.stats.counters


@pytest.mark.parametrize("n", [1, 17, 5000])
def test_keys_are_sorted_as_numpy_sorts_them(n, rng):
    keys = rng.integers(0, 1 << rng.choice([3, 44]), n).astype(np.uint64)
    order, spare = np.empty((2, n), np.int64)
    sort_keys(keys.copy(), order, np.empty(n, np.uint64), spare)
    assert np.array_equal(order, np.argsort(keys, kind="stable"))


@pytest.mark.parametrize("name", LIGHTS)
def test_leaves_hold_every_receiver_once_at_its_place(name, rng):
    light = LIGHTS[name]
    points = rng.normal(size=(1000, 3)) * [2, 1, 2] - [0, 2, 0]
    (side,) = sides_of(points, light, rng.normal(size=(5, 3, 3)))
    leaves, space = side.leaves, side.light
    used = (np.arange(16) < leaves.count[:, None]).ravel()
    assert np.array_equal(np.sort(leaves.row[used]), np.arange(1000))
    expected = ((points[leaves.row] - space.origin) @ space.matrix.T).reshape(-1, 16, 3).transpose(0, 2, 1)
    reach = np.abs(expected).max()
    centre = leaves.centres[:, :3].astype(float) + leaves.centres[:, 3:]
    assert np.abs(centre[:, :, None] + leaves.offsets - expected).max() < 1e-6 * np.abs(leaves.offsets).max()
    assert np.abs(leaves.places - expected).max() <= 2.0**-24 * reach
    assert (leaves.boxes[:, :3] == leaves.places.min(axis=2)).all()
    assert (leaves.boxes[:, 3:] == leaves.places.max(axis=2)).all()
    assert (leaves.reaches[:, 1] >= np.abs(expected).max(axis=2).sum(axis=1) + 1).all()
    assert (leaves.reaches[:, 0] >= np.abs(leaves.offsets).max(axis=2).sum(axis=1)).all()


@pytest.mark.parametrize("name", LIGHTS)
def test_light_space_takes_the_samples_to_the_unit_square(name):
    light = LIGHTS[name]
    points = np.array([[0.0, 0, 0], [1, 1, 1]])
    space = light_space(light, 1.0, points, points)
    corners = light.corner + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) @ np.stack(
        [light.edge_u, light.edge_v]
    )
    placed = (corners - space.origin) @ space.matrix.T
    assert np.allclose(placed[:, :2], [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]], atol=1e-9)
    assert np.abs(placed[:, 2]).max() < 1e-9
    assert np.array_equal(np.unpackbits(space.full.view(np.uint8)).sum(), light.samples)
    inside = np.abs(space.parameters) <= 0.5
    assert inside.all()


def test_lights_without_a_space_are_cast_all_the_same(rng):
    points, triangles = rng.uniform(-1, 1, (30, 3)), rng.uniform(-1, 1, (40, 3, 3)) + [0, 1, 0]
    for edges in (([0, 0, 0], [0, 0, 0]), ([1, 0, 0], [2, 0, 0]), ([1e-12, 0, 0], [0, 0, 1e-12])):
        light = RectLight([0.1, 2.3, 0.2], *edges, samples=16, two_sided=True)
        assert both_ways(points, triangles, light)["cluster_pairs"] == 0


@numba.njit
def _covered(box, places, extent, border, tables, bins, words):
    """Samples (4,) that a box may cover from each of 16 places; box and places in light space."""
    alive = _cover(
        splat(box[0]), splat(box[1]), splat(box[2]), splat(box[3]), splat(box[4]), splat(box[5]),
        _lanes(places, 0), _lanes(places, 1), _lanes(places, 2),
        _lanes(places, 0), _lanes(places, 1), _lanes(places, 2),
        (extent[0], extent[1], extent[2], extent[3], extent[4], extent[5]), border, bins, 0,
    )  # fmt: skip
    for slot in range(16):
        if (alive >> slot) & 1:
            store(words, slot * 4, _samples_between(tables, 0, bins, 0, slot))


@numba.njit
def _lanes(places, axis):
    return load(places, axis * 16)


def test_projected_boxes_keep_every_sample_that_a_point_inside_blocks(rng):
    """Points of a box are put on segments from receivers to samples: those samples must be kept."""
    light = RectLight([-0.5, 3, -0.5], [1, 0, 0], [0, 0, 1], samples=256, sets=1)
    receivers = rng.uniform(-2, 2, (64, 3)) * [1, 0.5, 1]
    space = light_space(light, 1.0, receivers, np.array([[-3.0, -3, -3], [3, 3, 3]]))
    kept = wanted = 0
    for _ in range(300):
        r = rng.uniform([-2, -2, 0.5], [2, 2, 4], (16, 3))
        spread = rng.choice([0.0, 1e-4, 0.05, 0.5])
        sample = rng.integers(0, 256)
        lane = rng.integers(0, 16)
        target = np.append(space.parameters[0, 0, :, sample].astype(float), 0)
        share = rng.choice([1e-6, 0.01, 0.3, 0.9])
        middle = r[lane] + share * (target - r[lane])
        low, high = middle - spread * rng.random(3), middle + spread * rng.random(3)
        reach = 2.0**-22 * (np.abs(low) + np.abs(high)) + space.slack
        box = np.concatenate([low - reach, high + reach]).astype(np.float32)
        box[2] = max(box[2], 0)
        words = np.zeros((16, 4), np.uint64)
        places = np.ascontiguousarray(r.T, dtype=np.float32)
        _covered(
            box, places, space.extents[0], np.float32(space.border), space.tables,
            np.zeros((1, 4, 16), np.int32), words,
        )  # fmt: skip
        bits = np.unpackbits(words.view(np.uint8), bitorder="little").reshape(16, 256)
        assert bits[lane, sample]
        if share >= 0.3 and spread <= 1e-4:
            kept += bits[lane].sum()
            wanted += 1
    # And boxes that are points but for rounding keep few other samples.
    assert kept < 3 * wanted
    assert N_BINS <= 256


def test_edges_through_samples_are_decided_beyond_float32(rng):
    """Corners on segments from receivers to samples: float32 cannot tell on which side those samples are."""
    light = RectLight([-0.5, 3, -0.5], [1, 0, 0], [0, 0, 1], samples=64, sets=1)
    points = rng.uniform(-1, 1, (48, 3)) * [1, 0, 1]
    samples = light.sample_points[0]
    receiver, sample = rng.integers(0, 48, (90, 3)), rng.integers(0, 64, (90, 3))
    share = rng.uniform(0.2, 0.8, (90, 3, 1))
    triangles = points[receiver] + share * (samples[sample] - points[receiver])
    for scale, shift in ((1.0, 0.0), (2.0**-20, 0.0), (2.0**20, 0.0), (1.0, 1024.0)):
        moved = RectLight(light.corner * scale + shift, [scale, 0, 0], [0, 0, scale], samples=64, sets=1)
        counters = both_ways(points * scale + shift, triangles * scale + shift, moved)
        assert counters["cluster_pairs"] > 0
        assert counters["escalated_f64"] > 0


def test_coincident_coplanar_and_straddling_blockers(rng):
    """Copies of the receivers' own triangles, walls through the plane of the light, and blockers in it."""
    floor = np.array([[[-2, 0, 2], [2, 0, 2], [2, 0, -2]], [[-2, 0, 2], [2, 0, -2], [-2, 0, -2]]], float)
    tilted = rng.uniform(-1, 1, (6, 3, 3)) + [0, 1, 0]
    walls = rng.uniform(-1, 1, (20, 3, 3)) * [1, 2, 1] + [0, 3, 0]
    ceiling = floor + [0, 3, 0]
    triangles = np.concatenate([floor, floor, tilted, tilted, walls, ceiling])
    weights = rng.dirichlet([1, 1, 1], (len(triangles), 4))
    points = np.einsum("tnk,tkc->tnc", weights, triangles).reshape(-1, 3)
    points += rng.choice([0, 1e-15, -1e-15, 1e-5], points.shape)
    own = np.repeat(np.arange(len(triangles)), 4)
    for two_sided in (False, True):
        light = RectLight([-0.5, 3, -0.5], [1, 0, 0], [0, 0, 1], samples=100, sets=2, two_sided=two_sided)
        counters = both_ways(points, triangles, light, own=own)
        assert counters["pairs_escalated"] > 0


def test_ordinary_lanes_are_seldom_left_open(rng):
    points = np.column_stack([rng.uniform(-1, 1, 4000), np.zeros(4000), rng.uniform(-1, 1, 4000)])
    grass = rng.uniform([-1, 0.2, -1], [1, 1.5, 1], (5000, 1, 3)) + rng.normal(size=(5000, 3, 3)) * 0.03
    light = RectLight([-0.5, 3, -0.5], [1, 0, 0], [0, 0, 1], samples=256)
    counters = penumbra.cast(points, grass, light).stats.counters
    assert 0 < counters["escalated_f64"] < 1e-3 * counters["lanes_tested"]


@pytest.mark.parametrize("roll", range(3))
@pytest.mark.parametrize("turn", [False, True])
def test_samples_in_one_row(roll: int, turn: bool) -> None:
    """All samples share one t: an edge parallel to the light's side must not meet an interval without end."""
    edge_u, edge_v = ((0, 0, 0.01), (4, 0, 0)) if turn else ((4, 0, 0), (0, 0, 0.01))
    light = RectLight((-2, 3, 0), edge_u, edge_v, samples=16, sets=1, pattern="regular", two_sided=True)
    triangle = np.roll(np.array([[0.0, 1, -1], [1.0, 1, 0], [0.0, 1, 1]]), roll, axis=0)
    points = np.array([[0.1, 0, 0.0], [0.3, 0, 0.1], [-0.3, 0, 0.2]])
    assert assert_every_bit(SmallScene(points, triangle[None], light), "hpc").any()
