"""Camera C and its grid: receivers to cells, shadow volumes of blockers to boxes of cells (GEARS 3.1).

All is in the frame of the light, where camera C looks along z and light and image plane share their
axes. There a sample l, a point q of a blocker at depth z_q and a receiver r in its shadow satisfy

    r = l + k (q - l),   k = (z_r - z_l) / (z_q - z_l) >= 1,   image of r: (r - eye) / (z_r - z_eye).

The image moves monotonically with z_r, and linearly with l and q at a given depth: so a shadow volume
projects into the box of its extremal points, the blocker's vertices and their extrusions from the
corners of the light to the farthest receiver. Boxes are conservative under rounding: every bound is
widened by what its own rounding can be, and what cannot be bounded gets the whole axis.
"""

import numpy as np

from penumbra.kernels._jit import helper, inlined, kernel
from penumbra.kernels.borrow import borrow
from penumbra.kernels.predicates import UNIT_ROUNDOFF

# Receivers whose place in the image is less certain than this, in units of their depth, are left out of it.
_LEAST_CERTAIN = 1e-6
_ROUNDING = 16.0 * UNIT_ROUNDOFF


@helper
def _to_frame(camera, x, y, z):
    """Coordinates of a point in the frame of the light."""
    a, o = camera.axes, camera.origin
    dx, dy, dz = x - o[0], y - o[1], z - o[2]
    return (
        a[0, 0] * dx + a[0, 1] * dy + a[0, 2] * dz,
        a[1, 0] * dx + a[1, 1] * dy + a[1, 2] * dz,
        a[2, 0] * dx + a[2, 1] * dy + a[2, 2] * dz,
    )


@kernel
def project_receivers(points, rows, camera, image, depth, bounds):
    """Set image (n, 2) and depth (n,) of the given rows of points; returns (slack, nearest).

    A receiver that camera C does not see, in or behind the plane through its eye, gets nan as image.
    bounds (6,) becomes the box of the receivers in the frame. Source: GEARS section 3.1, step 3.2.
    """
    camera, bounds = borrow(camera), borrow(bounds)
    bounds[:3] = np.inf
    bounds[3:] = -np.inf
    slack = 0.0
    nearest = np.inf
    for i in range(rows.shape[0]):
        r = rows[i]
        x, y, z = _to_frame(camera, points[r, 0], points[r, 1], points[r, 2])
        bounds[0], bounds[3] = min(bounds[0], x), max(bounds[3], x)
        bounds[1], bounds[4] = min(bounds[1], y), max(bounds[4], y)
        bounds[2], bounds[5] = min(bounds[2], z), max(bounds[5], z)
        ahead = z - camera.eye[2]
        depth[i] = z
        image[i, 0] = image[i, 1] = np.nan
        if not ahead > 2.0 * camera.error:
            continue
        u, v = (x - camera.eye[0]) / ahead, (y - camera.eye[1]) / ahead
        size = 1.0 + abs(u) + abs(v)
        uncertain = size * (2.0 * camera.error / ahead + _ROUNDING)
        if not uncertain < _LEAST_CERTAIN * size:
            continue
        image[i, 0], image[i, 1] = u, v
        slack = max(slack, uncertain)
        nearest = min(nearest, ahead)
    return slack, nearest


@helper
def _cell_of(lines, value):
    """Cell of an axis that holds a value: the last whose lower boundary is not above it."""
    low = np.int64(0)
    high = np.int64(lines.shape[0] - 1)
    while high - low > 1:
        middle = (low + high) >> 1
        if lines[middle] <= value:
            low = middle
        else:
            high = middle
    return low


@kernel
def bin_receivers(rows, image, depth, lines_x, lines_y, cell, far, first, sorted_rows):
    """Sort rows by cell: fills first (n_cells + 2,), sorted_rows (n,) and far (n_cells,), the paper's 3.2."""
    n_x = lines_x.shape[0] - 1
    n_cells = far.shape[0]
    far[:] = -np.inf
    first[:] = 0
    for i in range(rows.shape[0]):
        c = np.int64(n_cells)
        if image[i, 0] == image[i, 0]:
            c = _cell_of(lines_y, image[i, 1]) * n_x + _cell_of(lines_x, image[i, 0])
            far[c] = max(far[c], depth[i])
        cell[i] = c
        first[c + 1] += 1
    for c in range(n_cells + 1):
        first[c + 1] += first[c]
    place = first[: n_cells + 1].copy()
    for i in range(rows.shape[0]):
        sorted_rows[place[cell[i]]] = rows[i]
        place[cell[i]] += 1


@helper
def _span(q, eye, low, high, ahead, near, k_low, k_high, error):
    """Image interval along one axis of all receivers behind a vertex, up to a depth.

    q: the vertex; low, high: the light; ahead, near: distances of the last depth and of the vertex from
    the eye's plane; k_low, k_high: bounds of k at the last depth. Widened by all rounding.
    """
    start = (q - eye) / near
    slack = 2.0 * (error + error * abs(start)) / near + _ROUNDING * abs(start)
    first, last = start - slack, start + slack
    from_low, from_high = q - low, q - high
    a, b = low + from_low * k_low, low + from_low * k_high
    c, d = high + from_high * k_low, high + from_high * k_high
    size = abs(low) + abs(high) + abs(eye) + (abs(from_low) + abs(from_high)) * k_high
    slack = (2.0 * error * k_high + _ROUNDING * size) / ahead
    first = min(first, (min(min(a, b), min(c, d)) - eye) / ahead - slack)
    last = max(last, (max(max(a, b), max(c, d)) - eye) / ahead + slack)
    return first, last


@helper
def _beyond(q_low, q_high, eye, low, high, nearest, ahead):
    """Image interval along one axis of what a volume that reaches the light's plane can shadow.

    k has no bound there, but where all of the blocker is beyond the light on one side, its shadow is
    beyond the blocker: one end of the interval remains.
    """
    first, last = -np.inf, np.inf
    if q_low > high:
        first = (q_low - eye) / (ahead if q_low > eye else nearest)
        first -= _ROUNDING * abs(first)
    if q_high < low:
        last = (q_high - eye) / (ahead if q_high < eye else nearest)
        last += _ROUNDING * abs(last)
    return first, last


@inlined
def _image_box(n_corners, camera, grid, depth, nearest_vertex, box, work):
    """Set box (4,) to image bounds of a shadow volume up to a depth; corners: `work` (n, 3)."""
    light, eye, error = camera.light, camera.eye, camera.error
    ahead = depth - eye[2]
    box[0] = box[2] = np.inf
    box[1] = box[3] = -np.inf
    if nearest_vertex - light[5] > 2.0 * error and ahead > 0.0:
        for k in range(n_corners):
            z = work[k, 2]
            near = z - eye[2]
            k_low = k_high = 1.0
            last = near
            if depth > z:
                k_low = max(1.0, (depth - light[2]) / (z + error - light[2]))
                k_high = (depth - light[2]) / (z - error - light[5])
                last = ahead
            low, high = _span(work[k, 0], eye[0], light[0], light[3], last, near, k_low, k_high, error)
            box[0], box[1] = min(box[0], low), max(box[1], high)
            low, high = _span(work[k, 1], eye[1], light[1], light[4], last, near, k_low, k_high, error)
            box[2], box[3] = min(box[2], low), max(box[3], high)
    else:
        for axis in range(2):
            q_low = q_high = work[0, axis]
            for k in range(1, n_corners):
                q_low, q_high = min(q_low, work[k, axis]), max(q_high, work[k, axis])
            low, high = _beyond(
                q_low - error, q_high + error, eye[axis], light[axis], light[3 + axis], grid.nearest, ahead
            )
            box[2 * axis], box[2 * axis + 1] = low, high
    # Written so that a bound that is not a number gives the whole axis.
    for end in range(0, 4, 2):
        box[end] = box[end] - grid.slack if box[end] > -np.inf else -np.inf
        box[end + 1] = box[end + 1] + grid.slack if box[end + 1] < np.inf else np.inf


@inlined
def _cells_of_box(box, grid, rect):
    """Set rect (4,) to the cells x0, x1, y0, y1 (inclusive) of an image box; False if it misses the grid."""
    x, y = grid.lines_x, grid.lines_y
    n_x, n_y = x.shape[0] - 1, y.shape[0] - 1
    if box[0] > x[n_x] or box[1] < x[0] or box[2] > y[n_y] or box[3] < y[0]:
        return False
    rect[0], rect[1] = _cell_of(x, box[0]), _cell_of(x, box[1])
    rect[2], rect[3] = _cell_of(y, box[2]), _cell_of(y, box[3])
    return True


@inlined
def _farthest(rect, grid):
    """Depth of the farthest receiver in a rectangle of cells."""
    n_x = grid.lines_x.shape[0] - 1
    far = -np.inf
    for y in range(rect[2], rect[3] + 1):
        for x in range(rect[0], rect[1] + 1):
            far = max(far, grid.far[y * n_x + x])
    return far


@inlined
def _bound(corners, camera, grid, correct, box, work, rect):
    """Cells that the shadow volume of some points (n, 3) may touch; (found any, its nearest depth).

    Where `correct`, the volume is extruded only to the farthest receiver of the cells that the volume
    up to the farthest of all touches (GEARS section 3.1, figure 5).
    """
    n_corners = corners.shape[0]
    error = camera.error
    nearest = np.inf
    for k in range(n_corners):
        work[k, 0], work[k, 1], work[k, 2] = _to_frame(camera, corners[k, 0], corners[k, 1], corners[k, 2])
        nearest = min(nearest, work[k, 2])
    # What reaches the depth of the light may hide it from receivers that are no deeper than the blocker.
    if not nearest - camera.light[5] > 2.0 * error:
        nearest = min(nearest, grid.box[2])
    # Outside the hull of light and receivers nothing is blocked.
    for axis in range(3):
        low = high = work[0, axis]
        for k in range(1, n_corners):
            low, high = min(low, work[k, axis]), max(high, work[k, axis])
        if low - error > grid.box[3 + axis] or high + error < grid.box[axis]:
            return False, nearest
    _image_box(n_corners, camera, grid, grid.depth + error, nearest, box, work)
    if not _cells_of_box(box, grid, rect):
        return False, nearest
    if correct:
        far = _farthest(rect, grid) + error
        if far + error < nearest:
            return False, nearest
        if far < grid.depth + error:
            _image_box(n_corners, camera, grid, far, nearest, box, work)
            if not _cells_of_box(box, grid, rect):
                return False, nearest
    return True, nearest


@inlined
def _is_touched(grid, cell, nearest, error):
    """Whether a cell has a receiver that is as deep as the nearest point of a blocker."""
    return grid.far[cell] + 2.0 * error >= nearest


@kernel
def bound_volumes(vertices, first, last, camera, grid, correct, rects, nearest, counts):
    """Bound the shadow volumes of blockers first to last of (n, 3, 3), and count the cells they touch.

    Fills rects (n, 4) with the cells x0, x1, y0, y1 (inclusive), nearest (n,) with the least depth, and
    counts (n,) with the cells in the rectangle that hold a receiver which is deep enough.
    """
    vertices, camera, grid = borrow(vertices), borrow(camera), borrow(grid)
    rects, nearest, counts = borrow(rects), borrow(nearest), borrow(counts)
    box, work = np.empty(4), np.empty((8, 3))
    n_x = grid.lines_x.shape[0] - 1
    n_cells = grid.far.shape[0]
    outside = np.int64(1 if grid.first[n_cells + 1] > grid.first[n_cells] else 0)
    for t in range(first, last):
        rect = rects[t]
        found, nearest[t] = _bound(vertices[t], camera, grid, correct, box, work, rect)
        count = np.int64(0)
        if found:
            for y in range(rect[2], rect[3] + 1):
                for x in range(rect[0], rect[1] + 1):
                    if _is_touched(grid, y * n_x + x, nearest[t], camera.error):
                        count += 1
        if count == 0:
            rect[:] = -1
            rect[0] = rect[2] = 0
        counts[t] = count + outside


@kernel
def any_cell_touched(box, camera, grid, correct):
    """Whether the shadow volume of a box (2, 3) of blockers may touch a cell that holds a receiver."""
    camera, grid = borrow(camera), borrow(grid)
    n_cells = grid.far.shape[0]
    if grid.first[n_cells + 1] > grid.first[n_cells]:
        return True
    corners = np.empty((8, 3))
    for k in range(8):
        for axis in range(3):
            corners[k, axis] = box[(k >> axis) & 1, axis]
    rect = np.empty(4, np.int32)
    found, nearest = _bound(corners, camera, grid, correct, np.empty(4), np.empty((8, 3)), rect)
    return found and _farthest(rect, grid) + 2.0 * camera.error >= nearest


@kernel
def count_cells(first, last, rects, nearest, grid, error, found):
    """Add to found (n_cells + 1,) the blockers first to last that each cell is assigned."""
    rects, grid, found = borrow(rects), borrow(grid), borrow(found)
    n_x = grid.lines_x.shape[0] - 1
    n_cells = grid.far.shape[0]
    outside = grid.first[n_cells + 1] > grid.first[n_cells]
    for t in range(first, last):
        for y in range(rects[t, 2], rects[t, 3] + 1):
            for x in range(rects[t, 0], rects[t, 1] + 1):
                if _is_touched(grid, y * n_x + x, nearest[t], error):
                    found[y * n_x + x] += 1
        if outside:
            found[n_cells] += 1


@kernel
def fill_cells(first, last, rects, nearest, grid, error, place, blockers):
    """Write blockers first to last into the runs of their cells, from place (n_cells + 1,) on.

    Together with `count_cells` this is the sort of (blocker, cell) pairs by cell, as a counting sort.
    """
    rects, grid, place, blockers = borrow(rects), borrow(grid), borrow(place), borrow(blockers)
    n_x = grid.lines_x.shape[0] - 1
    n_cells = grid.far.shape[0]
    outside = grid.first[n_cells + 1] > grid.first[n_cells]
    for t in range(first, last):
        for y in range(rects[t, 2], rects[t, 3] + 1):
            for x in range(rects[t, 0], rects[t, 1] + 1):
                cell = y * n_x + x
                if _is_touched(grid, cell, nearest[t], error):
                    blockers[place[cell]] = t
                    place[cell] += 1
        if outside:
            blockers[place[n_cells]] = t
            place[n_cells] += 1
