"""2: coarse blocker sorting: the histogram of areas, and which of its bins make a bucket.

Casting large blockers first finds large shadows early (Laine and Aila 2005, section 3.3).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from penumbra.arrays import Float64Array, Int64Array

# The bins of infinite and of zero area (after rounding): next to those of the largest and least float64.
_LARGEST_BIN = 512
_SMALLEST_BIN = -537

# Bins in one band, a factor 4096 in area. Narrow buckets tear apart neighbours that belong in one small
# box: with bands of 3 bins the boxes of runs have 10 to 60 % more surface than unsorted ones (Sponza,
# dragon, small house, office), with 6 bins 0 to 20 %.
_BAND_BINS = 6


def bounds_of(boxes: Sequence[Float64Array] | Float64Array) -> Float64Array:
    """Bounds (2, 3) of boxes (2, 3); zeros for none."""
    if not len(boxes):
        return np.zeros((2, 3))
    stacked = np.asarray(boxes)
    return np.array([stacked[:, 0].min(axis=0), stacked[:, 1].max(axis=0)])


def area_bins(areas: Float64Array) -> Int64Array:
    """Bin of each area: one bin for each factor 4, bin b holds 4**b / 2 up to 2 * 4**b."""
    _, exponents = np.frexp(areas)
    bins = exponents.astype(np.int64) >> 1
    bins[areas == np.inf] = _LARGEST_BIN
    bins[areas == 0.0] = _SMALLEST_BIN
    return bins


@dataclass
class AreaBin:
    """What is known of the triangles in one bin of the histogram."""

    n_triangles: int = 0
    least_area: float = np.inf
    largest_area: float = 0.0
    centre_bounds: Float64Array = field(default_factory=lambda: np.array([[np.inf] * 3, [-np.inf] * 3]))
    """(2, 3) bounds of the centres of the triangles' boxes."""

    def add(self, areas: Float64Array, centres: Float64Array) -> None:
        """Count triangles of this bin, at least one."""
        self.n_triangles += len(areas)
        self.least_area = min(self.least_area, float(areas.min()))
        self.largest_area = max(self.largest_area, float(areas.max()))
        # Column by column: a reduction over rows of three is a hundred times slower (400 ns a row).
        for axis in range(3):
            column = centres[:, axis]
            self.centre_bounds[0, axis] = min(self.centre_bounds[0, axis], column.min())
            self.centre_bounds[1, axis] = max(self.centre_bounds[1, axis], column.max())


def split_by_bin(
    areas: Float64Array, centres: Float64Array, sort: bool, histogram: dict[int, AreaBin]
) -> Iterator[tuple[int, Int64Array]]:
    """Yield each area bin with its rows, ascending, and count them; areas below 0 are in no bin.

    Without `sort`, all are in bin 0.
    """
    rows = np.flatnonzero(areas >= 0)
    if len(rows) == 0:
        return
    bins = area_bins(areas[rows]) if sort else np.zeros(len(rows), np.int64)
    # Integers of 16 bits are sorted by radix.
    order = np.argsort(bins.astype(np.int16), kind="stable")
    rows, bins = rows[order], bins[order]
    starts = np.flatnonzero(np.diff(bins, prepend=bins[:1] - 1))
    for first, last in zip(starts, [*starts[1:], len(bins)], strict=True):
        number = int(bins[first])
        part = rows[first:last]
        histogram.setdefault(number, AreaBin()).add(areas[part], centres[part])
        yield number, part


class Bucket(NamedTuple):
    """Adjacent bins that are stored together."""

    bins: tuple[int, ...]
    n_triangles: int
    area_range: tuple[float, float]
    centre_bounds: Float64Array


def merge_bins(histogram: Mapping[int, AreaBin], max_buckets: int, least_triangles: int) -> list[Bucket]:
    """Buckets from large area to small: all bins, each bucket a run of neighbours.

    Starts from bands of equal width, one of them round the median area, and joins the bucket with the
    fewest triangles to the smaller of its neighbours until there are at most `max_buckets` and none has
    fewer than `least_triangles`.
    """
    groups = _bands(histogram)
    while len(groups) > 1:
        counts = [sum(histogram[number].n_triangles for number in group) for group in groups]
        smallest = counts.index(min(counts))
        if len(groups) <= max_buckets and counts[smallest] >= least_triangles:
            break
        neighbours = [i for i in (smallest - 1, smallest + 1) if 0 <= i < len(groups)]
        left, right = sorted((smallest, min(neighbours, key=counts.__getitem__)))
        groups[left : right + 1] = [groups[left] + groups[right]]
    return [_bucket(histogram, tuple(group)) for group in groups]


def _bands(histogram: Mapping[int, AreaBin]) -> list[list[int]]:
    """Bins from large to small, in runs of _BAND_BINS; the median triangle is in the middle of its run."""
    numbers = sorted(histogram, reverse=True)
    if not numbers:
        return []
    counts = np.cumsum([histogram[number].n_triangles for number in numbers])
    median = numbers[int(np.searchsorted(counts, counts[-1] / 2))]
    bands: dict[int, list[int]] = {}
    for number in numbers:
        bands.setdefault((number - median + _BAND_BINS // 2) // _BAND_BINS, []).append(number)
    return list(bands.values())


def _bucket(histogram: Mapping[int, AreaBin], numbers: tuple[int, ...]) -> Bucket:
    bins = [histogram[number] for number in numbers]
    return Bucket(
        numbers,
        sum(b.n_triangles for b in bins),
        (min(b.least_area for b in bins), max(b.largest_area for b in bins)),
        bounds_of([b.centre_bounds for b in bins]),
    )
