"""The order of blockers: areas, curve, surface-area splits and boxes against slow, plain computations."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from penumbra import ordering
from penumbra.kernels.order import fill_axis_orders, sort_by_surface_area


def _is_flat(triangle: np.ndarray) -> bool:
    """Whether the corners lie on one line, in rationals."""
    a, b, c = [[Fraction(float(x)) for x in corner] for corner in triangle]
    u = [q - p for p, q in zip(a, b, strict=True)]
    v = [q - p for p, q in zip(a, c, strict=True)]
    return all(u[i] * v[j] == u[j] * v[i] for i, j in ((0, 1), (1, 2), (2, 0)))


def _areas(triangles: np.ndarray) -> np.ndarray:
    u, v = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    return np.linalg.norm(np.cross(u, v), axis=1) / 2


def test_areas_and_centres(rng: np.random.Generator) -> None:
    triangles = rng.normal(size=(1000, 3, 3)) * 10.0 ** rng.uniform(-6, 6, size=(1000, 1, 1))
    found = ordering.measure(triangles)
    np.testing.assert_allclose(found.areas, _areas(triangles), rtol=1e-12)
    middle = (triangles.min(axis=1) + triangles.max(axis=1)) / 2
    np.testing.assert_allclose(found.centres, middle, rtol=1e-12)


@given(arrays(np.int8, (5, 3, 3)), st.sampled_from([1.0, 0.1, 2.0**-1000, 2.0**-1074, 1e300]))
def test_zero_area_is_decided_exactly(numbers: np.ndarray, scale: float) -> None:
    triangles = numbers.astype(np.float64) * scale
    found = ordering.measure(triangles)
    assert [bool(area < 0) for area in found.areas] == [_is_flat(t) for t in triangles]
    assert np.isfinite(found.centres).all()


def test_slivers_are_kept_and_lines_are_not() -> None:
    a, b = np.array([0.1, 0.2, 0.3]), np.array([0.7, -0.4, 1.9])
    # A middle that is rounded is off the line by a rounding error, or happens to lie on it.
    triangles = np.array([[a, b, a + (b - a) * t] for t in np.linspace(0, 1, 101)])
    found = ordering.measure(triangles)
    assert [bool(area < 0) for area in found.areas] == [_is_flat(t) for t in triangles]
    assert 1 <= (found.areas < 0).sum() < 101


@pytest.mark.parametrize("scale", [1.0, 1e-3, 2.0**-990, 1e307])
def test_curve_goes_from_cell_to_neighbour(scale: float) -> None:
    cells = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    bounds = np.array([[0.0] * 3, [8.0] * 3]) * scale
    keys = ordering.curve_keys((cells + 0.5) * scale, bounds)
    assert len(set(keys.tolist())) == len(cells)
    walk = cells[np.argsort(keys)]
    assert (np.abs(np.diff(walk, axis=0)).sum(axis=1) == 1).all()


def test_curve_keys_of_the_extremes() -> None:
    bounds = np.array([[-1.7e308] * 3, [1.7e308] * 3])
    keys = ordering.curve_keys(np.concatenate([bounds, np.zeros((1, 3))]), bounds)
    assert len(set(keys.tolist())) == 3
    point = np.array([[3.0, 4.0, 5.0]])
    assert ordering.curve_keys(point, np.repeat(point, 2, axis=0)).tolist() == [0]


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 10**6)), unique=True))
def test_sort_by_key_then_id(pairs: list[tuple[int, int]]) -> None:
    keys = np.array([key for key, _ in pairs], np.uint64)
    ids = np.array([i for _, i in pairs], np.int64)
    order = ordering.sort_by_key(keys, ids)
    assert [pairs[i] for i in order] == sorted(pairs)


def _half_area(boxes: list[np.ndarray]) -> float:
    size = np.max([b[3:] for b in boxes], axis=0) - np.min([b[:3] for b in boxes], axis=0)
    return float(size[0] * size[1] + size[1] * size[2] + size[2] * size[0])


def _reference_order(boxes: list[np.ndarray], members: list[int]) -> list[list[int]]:
    """Runs of 16 in order, by the definition: every split at a multiple of 16**k, boxes from scratch."""
    if len(members) <= 16:
        return [sorted(members)]
    unit = 16
    while unit * 16 < len(members):
        unit *= 16
    best: tuple[float, list[int], list[int]] | None = None
    n_parts = -(-len(members) // unit)
    for axis in range(3):
        along = sorted(members, key=lambda t: (boxes[t][axis] + boxes[t][axis + 3], t))
        for parts in range(1, n_parts):
            left, right = along[: parts * unit], along[parts * unit :]
            cost = _half_area([boxes[t] for t in left]) * parts
            cost += _half_area([boxes[t] for t in right]) * (n_parts - parts)
            if best is None or cost < best[0]:
                best = (cost, left, right)
    assert best is not None
    return _reference_order(boxes, best[1]) + _reference_order(boxes, best[2])


@pytest.mark.parametrize("n", [1, 2, 15, 16, 17, 31, 33, 255, 256, 257, 300, 519])
def test_surface_area_order_is_the_cheapest_at_every_split(rng: np.random.Generator, n: int) -> None:
    # Multiples of 1/32 in the unit cube: the sums and products of float32 are exact, so ties are ties.
    low = rng.integers(0, 29, size=(n, 3))
    boxes = np.concatenate([low, low + rng.integers(0, 4, size=(n, 3))], axis=1).astype(np.float32) / 32
    orders = np.empty((3, n), np.int32)
    fill_axis_orders(boxes, orders)
    sort_by_surface_area(boxes, orders)
    runs = [sorted(orders[0, i : i + 16].tolist()) for i in range(0, n, 16)]
    assert runs == _reference_order([box.astype(np.float64) for box in boxes], list(range(n)))


@pytest.mark.parametrize("n", [1, 15, 16, 17, 4095, 4096, 4097, 9000])
def test_boxes_of_runs(rng: np.random.Generator, n: int) -> None:
    triangles = rng.normal(size=(n, 3, 3))
    ids = rng.permutation(n).astype(np.int64)
    chunk = ordering.order_chunk(triangles, ids)
    row_of = {int(i): row for row, i in enumerate(ids)}
    np.testing.assert_array_equal(chunk.vertices, triangles[[row_of[int(i)] for i in chunk.ids]])
    for run, boxes in ((16, chunk.boxes_16), (256, chunk.boxes_256), (4096, chunk.boxes_4096)):
        parts = [chunk.vertices[i : i + run].reshape(-1, 3) for i in range(0, n, run)]
        np.testing.assert_array_equal(boxes, [[p.min(axis=0), p.max(axis=0)] for p in parts])


def test_order_makes_small_boxes(rng: np.random.Generator) -> None:
    """Patches of a sphere: random order, curve, surface-area order; each with far smaller boxes."""
    n = 20000
    centres = rng.normal(size=(n, 1, 3))
    centres /= np.linalg.norm(centres, axis=2, keepdims=True)
    triangles = centres + rng.normal(size=(n, 3, 3)) * 0.005
    measures = ordering.measure(triangles)
    bounds = np.array([measures.centres.min(axis=0), measures.centres.max(axis=0)])
    ids = np.arange(n)
    curve = ordering.sort_by_key(ordering.curve_keys(measures.centres, bounds), ids)

    def cost(chunk: object) -> float:
        size = chunk.boxes_16[:, 1] - chunk.boxes_16[:, 0]  # type: ignore[attr-defined]
        return float((size * np.roll(size, 1, axis=1)).sum())

    random = cost(ordering.order_chunk(triangles, ids, sort=False))
    by_curve = cost(ordering.order_chunk(triangles[curve], curve, sort=False))
    by_area = cost(ordering.order_chunk(triangles[curve], curve))
    assert by_curve < random / 20
    assert by_area < by_curve * 0.8


@pytest.mark.parametrize("scale", [1e-300, 1e-40, 1.0, 1e40, 1e300])
def test_order_does_not_depend_on_scale(rng: np.random.Generator, scale: float) -> None:
    triangles = rng.integers(-500, 500, size=(700, 3, 3)).astype(np.float64)
    exact = 2.0 ** np.round(np.log2(scale))
    plain = ordering.order_chunk(triangles, np.arange(700))
    scaled = ordering.order_chunk(triangles * exact, np.arange(700))
    np.testing.assert_array_equal(plain.ids, scaled.ids)


def test_coincident_triangles_keep_their_order() -> None:
    triangles = np.repeat(np.eye(3)[None], 5000, axis=0)
    chunk = ordering.order_chunk(triangles, np.arange(5000))
    assert sorted(chunk.ids.tolist()) == list(range(5000))
    again = ordering.order_chunk(triangles, np.arange(5000))
    np.testing.assert_array_equal(chunk.ids, again.ids)


def test_kernels_have_one_signature() -> None:
    from penumbra.kernels import order

    ordering.order_chunk(np.eye(3)[None], np.arange(1))
    for name in ("fill_measures", "fill_triangle_boxes", "fill_unit_boxes", "sort_by_surface_area"):
        assert len(getattr(order, name).signatures) == 1, name
