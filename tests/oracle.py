"""The independent judge of visibility bits: their definition in exact integers.

Imports nothing under test. Every float64 is an integer times a power of two, so a whole scene times a
large enough power of two is integers, and nothing is ever rounded. It is not decided by the signs that
the kernels use: the point where the segment meets the blocker's plane is computed as a rational, and
then its barycentric coordinates.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Integers = list[int]

# From this many candidates on, it pays to cut the segment into pieces and look at the box of each.
_MANY = 256
_PIECES = 64
# Positions along a segment are rounded a few times, by 2**-53 of the largest coordinate each time.
_PIECE_PADDING = 2.0**-45


class Count:
    """How many exact segment-triangle predicates this process has evaluated."""

    predicates = 0


def segment_meets_triangle(
    r: Sequence[int], sample: Sequence[int], triangle: Sequence[Sequence[int]]
) -> bool:
    """Whether the open segment (r, sample) meets the closed triangle without lying in its plane.

    All coordinates are exact numbers (int or Fraction). Solves r + s (sample - r) = a + u e1 + v e2 and
    asks for 0 < s < 1, u >= 0, v >= 0, u + v <= 1.
    """
    Count.predicates += 1
    a, b, c = triangle
    e1 = _minus(b, a)
    e2 = _minus(c, a)
    normal = cross(e1, e2)
    from_a_to_r = _minus(r, a)
    from_a_to_sample = _minus(sample, a)
    height_r = dot(normal, from_a_to_r)
    height_sample = dot(normal, from_a_to_sample)
    if height_r * height_sample >= 0:  # also a triangle of zero area, whose normal is zero
        return False
    # s = height_r / (height_r - height_sample) is between 0 and 1; the meeting point minus a, times weight:
    weight = height_r - height_sample
    meeting = [height_r * q - height_sample * p for p, q in zip(from_a_to_r, from_a_to_sample, strict=True)]
    axis = next(k for k in range(3) if normal[k])
    i, j = (axis + 1) % 3, (axis + 2) % 3
    scale = weight * normal[axis]  # normal[axis] is the determinant of e1 and e2 in the axes i and j
    u = meeting[i] * e2[j] - meeting[j] * e2[i]
    v = e1[i] * meeting[j] - e1[j] * meeting[i]
    if scale < 0:
        scale, u, v = -scale, -u, -v
    return u >= 0 and v >= 0 and u + v <= scale


def masks(
    points: NDArray[np.float64],
    triangles: NDArray[np.floating],
    samples: NDArray[np.float64],
    sample_set: NDArray[np.integer],
    *,
    light: tuple[Sequence[float], Sequence[float], Sequence[float]],
    two_sided: bool,
    normals: NDArray[np.float64] | None = None,
    own: NDArray[np.int64] | None = None,
    ids: NDArray[np.int64] | None = None,
) -> NDArray[np.uint64]:
    """Every bit of R receivers, uint64 (R, ceil(K / 64)); sample i is bit i % 64 of word i // 64.

    points (R, 3), triangles (T, 3, 3), samples (sets, K, 3), sample_set (R,); light is its corner,
    edge_u and edge_v; normals (R, 3); own (R,) and ids (T,), which are 0 to T - 1 by default.
    """
    n_samples = samples.shape[1]
    result = np.zeros((len(points), -(-n_samples // 64)), np.uint64)
    for row in range(len(points)):
        bits = blocked_samples(
            points[row],
            triangles,
            samples[sample_set[row]],
            light=None if two_sided else light,
            normal=None if normals is None else normals[row],
            left_out=None if own is None else int(own[row]),
            ids=ids,
        )
        for sample in bits:
            result[row, sample // 64] |= np.uint64(1 << (sample % 64))
    return result


def blocked_samples(
    point: NDArray[np.float64],
    triangles: NDArray[np.floating],
    samples: NDArray[np.float64],
    *,
    light: tuple[Sequence[float], Sequence[float], Sequence[float]] | None = None,
    normal: NDArray[np.float64] | None = None,
    left_out: int | None = None,
    ids: NDArray[np.int64] | None = None,
) -> list[int]:
    """Numbers of the samples (K, 3) that are blocked for one point, ascending.

    light: corner, edge_u and edge_v of a single-sided light, None for a two-sided one. left_out: id of
    the triangle that the point lies on.
    """
    if light is not None and not _in_front(point, light):
        return list(range(len(samples)))
    if left_out is not None:
        known = np.arange(len(triangles)) if ids is None else ids
        triangles = triangles[known != left_out]
    boxes = np.stack([triangles.min(axis=1), triangles.max(axis=1)], axis=1)
    blocked = []
    for number, sample in enumerate(samples):
        turned_away = normal is not None and not _faces(point, normal, sample)
        if turned_away or _any_blocks(point, sample, triangles[_near_segment(point, sample, boxes)]):
            blocked.append(number)
    return blocked


def integers(*arrays: NDArray[np.floating] | Sequence[float]) -> list[list[int]]:
    """The numbers of each array, flat, all times the same power of two that makes them integers."""
    ratios = [[float(x).as_integer_ratio() for x in np.asarray(array).ravel()] for array in arrays]
    common = max((bottom for ratio in ratios for _, bottom in ratio), default=1)
    return [[top * (common // bottom) for top, bottom in ratio] for ratio in ratios]


def dot(a: Sequence[int], b: Sequence[int]) -> int:
    """Scalar product of two exact vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Sequence[int], b: Sequence[int]) -> Integers:
    """Vector product of two exact vectors."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _minus(a: Sequence[int], b: Sequence[int]) -> Integers:
    return [a[0] - b[0], a[1] - b[1], a[2] - b[2]]


def _in_front(point: NDArray[np.float64], light: Sequence[Sequence[float]]) -> bool:
    """Whether a single-sided light shines towards the point: det(edge_u, edge_v, point - corner) > 0."""
    p, corner, edge_u, edge_v = integers(point, *light)
    return dot(cross(edge_u, edge_v), _minus(p, corner)) > 0


def _faces(point: NDArray[np.float64], normal: NDArray[np.float64], sample: NDArray[np.float64]) -> bool:
    p, q = integers(point, sample)
    (n,) = integers(normal)
    return dot(n, _minus(q, p)) > 0


def _any_blocks(
    point: NDArray[np.float64], sample: NDArray[np.float64], triangles: NDArray[np.floating]
) -> bool:
    p, q, corners = integers(point, sample, triangles)
    for first in range(0, len(corners), 9):
        a, b, c = corners[first : first + 3], corners[first + 3 : first + 6], corners[first + 6 : first + 9]
        if segment_meets_triangle(p, q, (a, b, c)):
            return True
    return False


def _near_segment(
    point: NDArray[np.float64], sample: NDArray[np.float64], boxes: NDArray[np.floating]
) -> NDArray[np.intp]:
    """Numbers of the boxes (T, 2, 3) that the segment may meet; leaves out none that it meets.

    Comparisons of float64 numbers are exact. The boxes of the segment's pieces are rounded, and
    enlarged by much more than that.
    """
    near = np.flatnonzero(_overlap(np.minimum(point, sample), np.maximum(point, sample), boxes))
    if len(near) < _MANY:
        return near
    positions = point + np.linspace(0.0, 1.0, _PIECES + 1)[:, None] * (sample - point)
    positions[-1] = sample
    padding = _PIECE_PADDING * max(np.abs(point).max(), np.abs(sample).max())
    candidates = boxes[near]
    meets = np.zeros(len(near), bool)
    for first, last in zip(positions[:-1], positions[1:], strict=True):
        meets |= _overlap(np.minimum(first, last) - padding, np.maximum(first, last) + padding, candidates)
    return near[meets]


def _overlap(
    low: NDArray[np.float64], high: NDArray[np.float64], boxes: NDArray[np.floating]
) -> NDArray[np.bool_]:
    overlap: NDArray[np.bool_] = ((boxes[:, 1] >= low) & (boxes[:, 0] <= high)).all(axis=1)
    return overlap
