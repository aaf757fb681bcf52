"""The judge itself, against cases decided by hand, closed forms, and a second rational method."""

import ast
from fractions import Fraction
from itertools import permutations
from pathlib import Path

import numpy as np
import oracle
import pytest

TRIANGLE = ((0, 0, 0), (4, 0, 0), (0, 4, 0))

# Segment end points, and whether TRIANGLE blocks the open segment between them.
BY_HAND = {
    "through the inside": ((1, 1, -1), (1, 1, 1), True),
    "oblique, through the inside": ((0, 0, -1), (2, 2, 1), True),
    "through an edge": ((1, 0, -1), (1, 0, 1), True),
    "through the long edge": ((2, 2, -1), (2, 2, 1), True),
    "through a vertex": ((0, 0, -1), (0, 0, 1), True),
    "past the long edge": ((2, 3, -1), (2, 3, 1), False),
    "past a vertex": ((-1, -1, -1), (-1, -1, 1), False),
    "ends before the plane": ((1, 1, 1), (1, 1, 3), False),
    "starts on the triangle": ((1, 1, 0), (1, 1, 1), False),
    "ends on the triangle": ((1, 1, -1), (1, 1, 0), False),
    "starts on an edge": ((1, 0, 0), (1, 0, 1), False),
    "starts on a vertex": ((0, 4, 0), (1, 1, 1), False),
    "both ends on the triangle": ((1, 1, 0), (2, 1, 0), False),
    "in the plane, across": ((-1, 1, 0), (5, 1, 0), False),
    "in the plane, along an edge": ((-1, 0, 0), (5, 0, 0), False),
    "in the plane, away from it": ((7, 7, 0), (8, 9, 0), False),
    "parallel to the plane": ((-1, 1, 1), (5, 1, 1), False),
    "starts in the plane outside": ((5, 5, 0), (1, 1, 1), False),
    "no length": ((1, 1, 0), (1, 1, 0), False),
    "no length, off the plane": ((1, 1, 1), (1, 1, 1), False),
}

# Corners on one line, or in one point.
ZERO_AREA = [
    ((0, 0, 0), (4, 4, 0), (2, 2, 0)),
    ((0, 0, 0), (4, 4, 0), (0, 0, 0)),
    ((1, 1, 0), (1, 1, 0), (1, 1, 0)),
    ((1, 1, -5), (1, 1, 5), (1, 1, 0)),
]


@pytest.mark.parametrize("case", BY_HAND)
def test_cases_decided_by_hand(case: str) -> None:
    r, sample, blocked = BY_HAND[case]
    for corners in permutations(TRIANGLE):
        assert oracle.segment_meets_triangle(r, sample, corners) == blocked
        assert oracle.segment_meets_triangle(sample, r, corners) == blocked


@pytest.mark.parametrize("corners", ZERO_AREA)
def test_zero_area_blocks_nothing(corners: tuple[tuple[int, int, int], ...]) -> None:
    assert not oracle.segment_meets_triangle((1, 1, -1), (1, 1, 1), corners)
    assert not oracle.segment_meets_triangle((1, 2, -1), (3, 2, 1), corners)


def by_clipping(r: tuple[int, ...], sample: tuple[int, ...], corners: list[tuple[int, ...]]) -> bool:
    """The same question by another way: the meeting point in fractions against three planes.

    Each plane holds an edge and is perpendicular to the triangle.
    """
    edges = [[q - p for p, q in zip(corners[0], corner, strict=True)] for corner in corners[1:]]
    normal = oracle.cross(*edges)
    offset = oracle.dot(normal, corners[0])
    low, high = oracle.dot(normal, r) - offset, oracle.dot(normal, sample) - offset
    if low == high or not 0 < Fraction(-low, high - low) < 1:
        return False
    s = Fraction(-low, high - low)
    meeting = [p + s * (q - p) for p, q in zip(r, sample, strict=True)]
    for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
        inward = oracle.cross(normal, [q - p for p, q in zip(start, end, strict=True)])
        if oracle.dot(inward, [m - p for m, p in zip(meeting, start, strict=True)]) < 0:
            return False
    return True


def test_agrees_with_another_method_where_much_is_zero(rng: np.random.Generator) -> None:
    blocked = 0
    for corner_range in (2, 3, 5):
        for row in rng.integers(-corner_range, corner_range + 1, (4000, 15)):
            r, sample, a, b, c = (tuple(int(x) for x in row[k : k + 3]) for k in range(0, 15, 3))
            expected = by_clipping(r, sample, [a, b, c])
            assert oracle.segment_meets_triangle(r, sample, (a, b, c)) == expected, (r, sample, a, b, c)
            blocked += expected
    assert blocked > 200


def test_vertical_segments_over_a_right_triangle() -> None:
    size = 12
    for x in range(-2, size + 3):
        for y in range(-2, size + 3):
            expected = x >= 0 and y >= 0 and x + y <= size
            corners = ((0, 0, 3), (size, 0, 3), (0, size, 3))
            assert oracle.segment_meets_triangle((x, y, 0), (x, y, 7), corners) == expected


def test_the_last_bit_of_a_coordinate_decides() -> None:
    edge = np.array([[[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]]])
    above = np.array([0.1, 0.0, 2.0])
    for y, blocked in ((0.0, [0]), (np.nextafter(0.0, 1.0), [0]), (np.nextafter(0.0, -1.0), [])):
        point = np.array([0.1, y, 0.0])
        assert oracle.blocked_samples(point, edge, above[None]) == blocked


def test_integers_keep_every_bit_at_every_scale() -> None:
    values = [5e-324, 1e-310, 0.1, -3.0, 2.0**60, 1.7e308]
    (numbers,) = oracle.integers(values)
    for value, number in zip(values, numbers, strict=True):
        assert Fraction(number, numbers[0]) == Fraction(value) / Fraction(5e-324)


def test_looking_near_the_segment_only_changes_nothing(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    centres = rng.uniform(-1, 1, (3000, 1, 3))
    triangles = centres + rng.normal(0, 0.03, (3000, 3, 3))
    triangles[:4] = rng.uniform(-1, 1, (4, 3, 3))
    for point, sample in rng.uniform(-1.2, 1.2, (12, 2, 3)):
        boxes = np.stack([triangles.min(axis=1), triangles.max(axis=1)], axis=1)
        pieces = oracle._near_segment(point, sample, boxes)
        with monkeypatch.context() as patch:
            patch.setattr(oracle, "_MANY", len(triangles) + 1)
            one_box = oracle._near_segment(point, sample, boxes)
        assert set(pieces) <= set(one_box)
        left_out = triangles[np.setdiff1d(one_box, pieces)]
        assert not oracle._any_blocks(point, sample, left_out[:300])


def test_masks_put_bits_where_the_contract_says() -> None:
    samples = np.stack([np.full(70, 0.25), np.linspace(0.0, 6.9, 70), np.full(70, 2.0)], axis=1)
    # Above the point, the samples 0 to 20 (y from 0 to 2) are seen through y from 0 to 1.
    blocker = np.array([[[-9.0, 0.0, 1.0], [9.0, 0.0, 1.0], [0.0, 1.0, 1.0]]])
    point = np.array([[0.25, 0.0, 0.0]])
    light = ((0.0, 0.0, 2.0), (0.0, 7.0, 0.0), (1.0, 0.0, 0.0))  # shines downwards
    found = oracle.masks(point, blocker, samples[None], np.zeros(1, int), light=light, two_sided=False)
    # At x = 0.125 the slanted sides end at y = 1 - 0.125 / 9: sample 19 is seen at 0.95, 20 at 1.0.
    assert found.tolist() == [[(1 << 20) - 1, 0]]


def test_masks_of_receivers_that_do_not_face_the_light() -> None:
    samples = np.array([[[0.0, 0.0, 2.0], [1.0, 0.0, 2.0], [-1.0, 0.0, 2.0]]])
    nothing = np.zeros((0, 3, 3))
    light = ((-1.0, -1.0, 2.0), (0.0, 2.0, 0.0), (2.0, 0.0, 0.0))

    def mask(point: list[float], normal: list[float] | None, two_sided: bool) -> int:
        normals = None if normal is None else np.array([normal])
        rows = np.zeros(1, int)
        found = oracle.masks(
            np.array([point]), nothing, samples, rows, light=light, two_sided=two_sided, normals=normals
        )
        return int(found[0, 0])

    assert mask([0, 0, 0], None, False) == 0
    assert mask([0, 0, 2], None, False) == 0b111  # in the plane of the light
    assert mask([0, 0, 3], None, False) == 0b111  # behind it
    assert mask([0, 0, 3], None, True) == 0
    assert mask([0, 0, 0], [1, 0, 0], False) == 0b101  # n . (l - r) is 0, 1 and -1
    assert mask([0, 0, 0], [0, 0, -1], False) == 0b111


def test_own_triangle_is_left_out_by_its_id() -> None:
    blocker = np.array([[[-9.0, -9.0, 1.0], [9.0, -9.0, 1.0], [0.0, 9.0, 1.0]]])
    point, sample = np.zeros(3), np.array([[0.0, 0.0, 2.0]])
    assert oracle.blocked_samples(point, blocker, sample) == [0]
    assert oracle.blocked_samples(point, blocker, sample, left_out=-1) == [0]
    assert oracle.blocked_samples(point, blocker, sample, left_out=0) == []
    assert oracle.blocked_samples(point, blocker, sample, left_out=7, ids=np.array([7])) == []
    assert oracle.blocked_samples(point, blocker, sample, left_out=0, ids=np.array([7])) == [0]


def test_imports_nothing_under_test() -> None:
    tree = ast.parse(Path(oracle.__file__).read_text())
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    imported |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert imported == {"collections.abc", "numpy", "numpy.typing"}
