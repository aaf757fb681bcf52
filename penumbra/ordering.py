"""2: how blockers are ordered, in arrays: area, place along a curve, surface-area order, boxes of runs.

Every function depends on nothing but its arguments and breaks ties by id, so a store does not depend
on the memory or the batches it was made with.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from penumbra.arrays import BlockerChunk, Float64Array, Int64Array, UInt64Array
from penumbra.io.buckets import AreaBin, Bucket, bounds_of, merge_bins
from penumbra.kernels.order import (
    RUN,
    fill_axis_orders,
    fill_box_boxes,
    fill_curve_keys,
    fill_measures,
    fill_triangle_boxes,
    fill_unit_boxes,
    sort_by_surface_area,
)
from penumbra.options import IngestOptions


class Measures(NamedTuple):
    """What decides where triangles go."""

    areas: Float64Array  # (n,), -1 where exactly zero
    centres: Float64Array  # (n, 3) centres of the boxes


def choose_buckets(histogram: Mapping[int, AreaBin], options: IngestOptions) -> list[Bucket]:
    """Buckets for a histogram of areas, from large triangles to small."""
    # A bucket smaller than this is better off in its neighbour: every chunk costs a read and a descent.
    return merge_bins(histogram, options.max_buckets, least_triangles=options.chunk_triangles // 4)


def measure(vertices: Float64Array) -> Measures:
    """Areas and box centres of triangles float64 (n, 3, 3)."""
    found = Measures(np.empty(len(vertices)), np.empty((len(vertices), 3)))
    fill_measures(vertices, *found)
    return found


def curve_keys(centres: Float64Array, bounds: Float64Array) -> UInt64Array:
    """Places along a Hilbert curve through bounds (2, 3) of centres (n, 3)."""
    keys = np.empty(len(centres), np.uint64)
    fill_curve_keys(centres, bounds, keys)
    return keys


def bucket_keys(centres: Float64Array, ids: Int64Array, bounds: Float64Array, sort: bool) -> UInt64Array:
    """What a bucket is sorted by: places along the curve; the ids where input order is to be kept."""
    return curve_keys(centres, bounds) if sort else ids.astype(np.uint64)


def sort_by_key(keys: UInt64Array, ids: Int64Array) -> Int64Array:
    """Order that sorts by key, then by id."""
    # The quick unstable sort, then by id where keys are equal, which is rare: a lexsort of everything
    # takes ten times as long.
    order = np.argsort(keys)
    in_order = keys[order]
    is_tied = np.zeros(len(keys), np.bool_)
    is_tied[1:] = in_order[1:] == in_order[:-1]
    is_tied[:-1] |= is_tied[1:]
    places = np.flatnonzero(is_tied)
    if len(places):
        tied = order[places]
        order[places] = tied[np.lexsort((ids[tied], in_order[places]))]
    return order


def order_chunk(vertices: Float64Array, ids: Int64Array, sort: bool = True) -> BlockerChunk:
    """One chunk of blockers float64 (n, 3, 3), n > 0, in surface-area order, with the boxes of its runs.

    `sort=False` keeps the order.
    """
    if sort:
        order = _surface_area_order(vertices)
        vertices, ids = np.take(vertices, order, axis=0), np.take(ids, order)
    boxes_16 = _triangle_boxes(vertices)
    boxes_256 = merge_boxes(boxes_16)
    return BlockerChunk(vertices, ids, boxes_16, boxes_256, merge_boxes(boxes_256))


def _triangle_boxes(vertices: Float64Array) -> Float64Array:
    boxes = np.empty((_n_runs(len(vertices)), 2, 3))
    fill_triangle_boxes(vertices, boxes)
    return boxes


def merge_boxes(boxes: Float64Array) -> Float64Array:
    """Boxes of runs of 16 boxes (n, 2, 3)."""
    merged = np.empty((_n_runs(len(boxes)), 2, 3))
    fill_box_boxes(boxes, merged)
    return merged


def _n_runs(n: int) -> int:
    return -(-n // RUN)


def _surface_area_order(vertices: Float64Array) -> Int64Array:
    boxes_4096 = merge_boxes(merge_boxes(_triangle_boxes(vertices)))
    boxes = np.empty((len(vertices), 6), np.float32)
    orders = np.empty((3, len(vertices)), np.int32)
    fill_unit_boxes(vertices, bounds_of(boxes_4096), boxes)
    fill_axis_orders(boxes, orders)
    sort_by_surface_area(boxes, orders)
    order: Int64Array = orders[0].astype(np.int64)
    return order
