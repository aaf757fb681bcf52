"""3: the rasteriser: triangles into the z-buffer of a band of rows, every decision exact.

Coverage is decided by the signs of `raster_setup`, depth by `depth_order`; the z-buffer keeps an
interval that surely holds the depth, as float32, and only overlapping intervals are looked at again.
Nothing depends on the order of the triangles, on bands or on windows.
"""

from typing import NamedTuple

import numpy as np

from penumbra.arrays import Float32Array, Float64Array, Int64Array
from penumbra.kernels._jit import helper, kernel
from penumbra.kernels.depth_order import depth_order
from penumbra.kernels.predicates import UNDECIDED
from penumbra.kernels.raster_setup import set_up_triangle, through
from penumbra.kernels.vec3 import load_triangle, side_of, side_of_if_sure

LANES = 16
# Rows of the lane buffer: least and greatest weight, and bounds of the ray parameter.
_LOW, _HIGH, _NEAR, _FAR = 0, 1, 2, 3
# Counters, by index.
PIXELS_TESTED, ESCALATED_EXACT, DEPTHS_COMPARED = 0, 1, 2
N_COUNTERS = 3


class ZBand(NamedTuple):
    """The z-buffer of some rows of a window; one thread writes it."""

    near: Float32Array  # (rows, width) the ray parameter of the nearest hit lies in [near, far];
    far: Float32Array  # (rows, width) both inf where nothing is hit
    own: Int64Array  # (rows, width) triangle index of the nearest hit, -1 for none
    vertices: Float64Array  # (rows, width, 9) its corners; undefined where own is -1
    left: int  # x and
    top: int  # y of the upper left pixel, in the full picture


@helper
def _narrow(function, y, left, right):
    """Pixels of [left, right) of row y where a function may be >= -bound, or one more at each end."""
    value, step, step_y, bound = function
    if not bound < np.inf:
        return left, right
    value += y * step_y
    if step == 0.0:
        return (left, right) if value >= -bound else (left, left)
    edge = (-bound - value) / step
    if step > 0.0:
        if edge >= right:
            return left, left
        return (np.int64(np.floor(edge)), right) if edge > left else (left, right)
    if edge < left:
        return left, left
    return (left, np.int64(np.ceil(edge)) + 1) if edge < right - 1 else (left, right)


@helper
def _row_span(functions, y, left, right):
    """Narrow [left, right) of row y to the pixels that the three edges may let through."""
    left, right = _narrow(functions[0], y, left, right)
    left, right = _narrow(functions[1], y, left, right)
    return _narrow(functions[2], y, left, right)


@helper
def _fill_lanes(functions, depth, depth_error, least, greatest, x, y, n, lanes):
    """Evaluate pixels (x .. x + n - 1, y), n <= 16: rows of `lanes` are bounds of weight and depth.

    lanes[LOW] > 0: surely inside; lanes[HIGH] < 0: surely outside; the hit's ray parameter is in
    [lanes[NEAR], lanes[FAR]], which is also within the triangle's own range [least, greatest].
    """
    f0, f1, f2, f3 = functions
    v0, v1, v2, v3 = f0[0] + y * f0[2], f1[0] + y * f1[2], f2[0] + y * f2[2], f3[0] + y * f3[2]
    for k in range(n):
        column = float(x + k)
        w0, w1, w2 = v0 + column * f0[1], v1 + column * f1[1], v2 + column * f2[1]
        lanes[_LOW, k] = min(w0 - f0[3], w1 - f1[3], w2 - f2[3])
        lanes[_HIGH, k] = min(w0 + f0[3], w1 + f1[3], w2 + f2[3])
        slope = v3 + column * f3[1]
        lanes[_NEAR, k] = max((depth - depth_error) / (slope + f3[3]), least)
        # A slope that may be zero bounds nothing.
        far = (depth + depth_error) / (slope - f3[3])
        lanes[_FAR, k] = min(far, greatest) if slope > f3[3] else greatest


@helper
def _may_be_inside(eye, a, b, q, side, counters):
    """Whether q is not beyond the plane through the eye and the edge a, b, exactly."""
    sign = side_of_if_sure(eye, a, b, q)
    if sign == UNDECIDED:
        counters[ESCALATED_EXACT] += 1
        sign = side_of(eye, a, b, q)
    return sign * side <= 0


@helper
def _is_hidden(band, left, top, right, bottom, least):
    """Whether every pixel of a small box already shows something nearer than `least`."""
    if (right - left) * (bottom - top) > LANES:
        return False
    # Both sides rounded to float32: rounding keeps the order of what it keeps apart.
    nearest = np.float32(least)
    for row in range(top - band.top, bottom - band.top):
        for column in range(left - band.left, right - band.left):
            if not band.far[row, column] < nearest:
                return False
    return True


@helper
def _wins(eye, q, triangle, own, before, vertices, tied_with, counters):
    """Whether a hit is seen rather than the one before it, whose depth is too close for float32.

    Also returns the coplanar triangle met last: comparing with it again needs no depths.
    """
    if before == tied_with:
        return own < before, tied_with
    counters[DEPTHS_COMPARED] += 1
    order, coplanar = depth_order(triangle, load_triangle(vertices), eye, q)
    return order < 0 or (order == 0 and own < before), (before if coplanar else tied_with)


@helper
def _rasterise_lanes(view, band, triangle, own, side, lanes, x, y, n, tied_with, counters):
    """Put up to 16 evaluated pixels of one row into the z-buffer; returns the coplanar triangle met last."""
    row = y - band.top
    a, b, c = triangle
    for k in range(n):
        if lanes[_HIGH, k] < 0.0:
            continue
        column = x + k - band.left
        near, far = np.float32(lanes[_NEAR, k]), np.float32(lanes[_FAR, k])
        if near > band.far[row, column]:
            continue
        q = through(view, float(x + k), float(y))
        if not (
            lanes[_LOW, k] > 0.0
            or (
                _may_be_inside(view.eye, a, b, q, side, counters)
                and _may_be_inside(view.eye, b, c, q, side, counters)
                and _may_be_inside(view.eye, c, a, q, side, counters)
            )
        ):
            continue
        before = band.own[row, column]
        seen = before < 0 or far < band.near[row, column]
        vertices = band.vertices[row, column]
        if not seen:
            seen, tied_with = _wins(view.eye, q, triangle, own, before, vertices, tied_with, counters)
        if seen:
            band.near[row, column] = near
            band.far[row, column] = far
            band.own[row, column] = own
            vertices[0], vertices[1], vertices[2] = a
            vertices[3], vertices[4], vertices[5] = b
            vertices[6], vertices[7], vertices[8] = c
    return tied_with


@kernel
def rasterise(vertices, ids, survivors, boxes, depths, view, band, counters):
    """Rasterise the surviving triangles of a chunk into one band.

    vertices float64 (n, 9), ids int64 (n,); survivors, boxes, depths from `fill_boxes`; counters int64
    (N_COUNTERS,) are added to.
    """
    lanes = np.empty((4, LANES))
    last_row = band.top + band.own.shape[0]
    for s in range(survivors.shape[0]):
        top, bottom = max(boxes[s, 1], band.top), min(boxes[s, 3], last_row)
        if top >= bottom:
            continue
        left, right = boxes[s, 0], boxes[s, 2]
        least, greatest = depths[s, 0], depths[s, 1]
        if _is_hidden(band, left, top, right, bottom, least):
            continue
        own = ids[survivors[s]]
        triangle = load_triangle(vertices[survivors[s]])
        side, functions, depth, error = set_up_triangle(view, triangle[0], triangle[1], triangle[2])
        if side == 0:
            continue
        tied_with = np.int64(-1)
        for y in range(top, bottom):
            start, stop = left, right
            # Three divisions a row pay off only against more than one block of lanes.
            if right - left > LANES:
                start, stop = _row_span(functions, float(y), left, right)
            counters[PIXELS_TESTED] += max(stop - start, 0)
            for x in range(start, stop, LANES):
                n = min(LANES, stop - x)
                _fill_lanes(functions, depth, error, least, greatest, x, float(y), n, lanes)
                tied_with = _rasterise_lanes(
                    view, band, triangle, own, side, lanes, x, y, n, tied_with, counters
                )
