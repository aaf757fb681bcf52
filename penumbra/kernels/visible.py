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
from penumbra.kernels.predicates import UNDECIDED, orient3d_exact, orient3d_filter
from penumbra.kernels.raster_setup import set_up_triangle

LANES = 16
# Rows of the lane buffer: least and greatest weight, and bounds of the ray parameter.
_LOW, _HIGH, _NEAR, _FAR = 0, 1, 2, 3
# Counters, by index.
PIXELS_TESTED, ESCALATED_EXACT, DEPTHS_COMPARED = 0, 1, 2
N_COUNTERS = 3


class ZBand(NamedTuple):
    """The z-buffer of some rows of a window; one thread writes it."""

    corner: Int64Array  # (2,) x and y of its upper left pixel in the full picture
    near: Float32Array  # (rows, width) the ray parameter of the nearest hit lies in [near, far];
    far: Float32Array  # (rows, width) both inf where nothing is hit
    own: Int64Array  # (rows, width) triangle index of the nearest hit, -1 for none
    vertices: Float64Array  # (rows, width, 9) its corners; undefined where own is -1


@helper
def _narrow(a, step, bound, left, right):
    """Pixels of [left, right) where a + x * step may be >= -bound; may return a pixel too many at each end."""
    if step == 0.0:
        return (left, right) if a >= -bound else (left, left)
    edge = (-bound - a) / step
    if step > 0.0:
        if edge >= right:
            return left, left
        return (np.int64(np.floor(edge)), right) if edge > left else (left, right)
    if edge < left:
        return left, left
    return (left, np.int64(np.ceil(edge)) + 1) if edge < right - 1 else (left, right)


@helper
def _row_span(planes, y, left, right):
    """Narrow [left, right) of row y to the pixels that the three edges may let through."""
    for edge in range(3):
        a = planes[edge, 0] + y * planes[edge, 2]
        if left < right and planes[edge, 3] < np.inf:
            left, right = _narrow(a, planes[edge, 1], planes[edge, 3], left, right)
    return left, right


@helper
def _fill_lanes(planes, depth, depth_error, least, greatest, x, y, n, lanes):
    """Evaluate pixels (x .. x + n - 1, y), n <= 16: rows of `lanes` are bounds of weight and depth.

    lanes[LOW] > 0: surely inside; lanes[HIGH] < 0: surely outside; the hit's ray parameter is in
    [lanes[NEAR], lanes[FAR]], which is also within the triangle's own range [least, greatest].
    """
    a0, b0, e0 = planes[0, 0] + y * planes[0, 2], planes[0, 1], planes[0, 3]
    a1, b1, e1 = planes[1, 0] + y * planes[1, 2], planes[1, 1], planes[1, 3]
    a2, b2, e2 = planes[2, 0] + y * planes[2, 2], planes[2, 1], planes[2, 3]
    a3, b3, e3 = planes[3, 0] + y * planes[3, 2], planes[3, 1], planes[3, 3]
    for k in range(n):
        column = float(x + k)
        w0, w1, w2 = a0 + column * b0, a1 + column * b1, a2 + column * b2
        lanes[_LOW, k] = min(w0 - e0, w1 - e1, w2 - e2)
        lanes[_HIGH, k] = min(w0 + e0, w1 + e1, w2 + e2)
        slope = a3 + column * b3
        # A slope that may be zero gives inf or a negative quotient; a hit has a positive one.
        far = (depth + depth_error) / (slope - e3)
        lanes[_NEAR, k] = max((depth - depth_error) / (slope + e3), least)
        lanes[_FAR, k] = min(far, greatest) if slope > e3 else greatest


@helper
def _covers(v, side, ex, ey, ez, qx, qy, qz, counters):
    """Whether the ray from the eye through q meets the closed triangle, exactly; side: where the eye is."""
    for i in range(3):
        j = (i + 1) % 3
        sign = orient3d_filter(
            ex, ey, ez, v[i, 0], v[i, 1], v[i, 2], v[j, 0], v[j, 1], v[j, 2], qx, qy, qz
        )
        if sign == UNDECIDED:
            counters[ESCALATED_EXACT] += 1
            sign = orient3d_exact(
                ex, ey, ez, v[i, 0], v[i, 1], v[i, 2], v[j, 0], v[j, 1], v[j, 2], qx, qy, qz
            )
        if sign * side > 0:
            return False
    return True


@helper
def _is_hidden(band, left, top, right, bottom, least):
    """Whether every pixel of a small box already shows something nearer than `least`."""
    if (right - left) * (bottom - top) > LANES:
        return False
    for row in range(top - band.corner[1], bottom - band.corner[1]):
        for column in range(left - band.corner[0], right - band.corner[0]):
            if not band.far[row, column] < least:
                return False
    return True


@helper
def _through(view, x, y):
    """The point q that the ray of pixel (x, y) goes through; the order of operations is part of the result."""
    return (
        view.eye[0] + ((view.d0[0] + y * view.dy[0]) + x * view.dx[0]),
        view.eye[1] + ((view.d0[1] + y * view.dy[1]) + x * view.dx[1]),
        view.eye[2] + ((view.d0[2] + y * view.dy[2]) + x * view.dx[2]),
    )


@helper
def _wins(view, band, row, column, corners, own, near, far, tied_with, q, counters):
    """Whether a hit is seen rather than what the z-buffer holds, and which triangle it ties with everywhere."""
    before = band.own[row, column]
    if before < 0 or far < band.near[row, column]:
        return True, tied_with
    if before == tied_with:
        return own < before, tied_with
    counters[DEPTHS_COMPARED] += 1
    order, coplanar = depth_order(
        corners,
        band.vertices[row, column],
        view.eye[0],
        view.eye[1],
        view.eye[2],
        q[0],
        q[1],
        q[2],
    )
    return order < 0 or (order == 0 and own < before), (before if coplanar else tied_with)


@helper
def _rasterise_lanes(view, band, v, corners, own, side, lanes, x, y, n, tied_with, counters):
    """Put up to 16 evaluated pixels of one row into the z-buffer; returns the coplanar triangle met last."""
    row = y - band.corner[1]
    for k in range(n):
        if lanes[_HIGH, k] < 0.0:
            continue
        column = x + k - band.corner[0]
        near, far = np.float32(lanes[_NEAR, k]), np.float32(lanes[_FAR, k])
        if near > band.far[row, column]:
            continue
        q = _through(view, float(x + k), float(y))
        if not lanes[_LOW, k] > 0.0 and not _covers(
            v, side, view.eye[0], view.eye[1], view.eye[2], q[0], q[1], q[2], counters
        ):
            continue
        seen, tied_with = _wins(view, band, row, column, corners, own, near, far, tied_with, q, counters)
        if seen:
            band.near[row, column] = near
            band.far[row, column] = far
            band.own[row, column] = own
            for c in range(9):
                band.vertices[row, column, c] = corners[c]
    return tied_with


@kernel
def rasterise(vertices, ids, survivors, boxes, depths, view, band, counters):
    """Rasterise the surviving triangles of a chunk into one band.

    vertices float64 (n, 3, 3), ids int64 (n,); survivors, boxes, depths from `fill_boxes`; counters
    int64 (N_COUNTERS,) are added to.
    """
    planes = np.empty((4, 4))
    lanes = np.empty((4, LANES))
    first_row, last_row = band.corner[1], band.corner[1] + band.own.shape[0]
    for s in range(survivors.shape[0]):
        top, bottom = max(boxes[s, 1], first_row), min(boxes[s, 3], last_row)
        if top >= bottom:
            continue
        left, right = boxes[s, 0], boxes[s, 2]
        least, greatest = depths[s, 0], depths[s, 1]
        if _is_hidden(band, left, top, right, bottom, least):
            continue
        i = survivors[s]
        v = vertices[i]
        side, depth, depth_error = set_up_triangle(view, v, planes)
        if side == 0:
            continue
        corners = v.reshape(9)
        tied_with = np.int64(-1)
        for y in range(top, bottom):
            start, stop = left, right
            # Three divisions a row pay off only against more than one block of lanes.
            if right - left > LANES:
                start, stop = _row_span(planes, float(y), left, right)
            counters[PIXELS_TESTED] += stop - start
            for x in range(start, stop, LANES):
                n = min(LANES, stop - x)
                _fill_lanes(planes, depth, depth_error, least, greatest, x, float(y), n, lanes)
                tied_with = _rasterise_lanes(
                    view, band, v, corners, ids[i], side, lanes, x, y, n, tied_with, counters
                )
