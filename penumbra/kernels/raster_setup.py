"""What the rasteriser knows before it visits a pixel: the view, pixel boxes of triangles, edge functions.

Rays are never projected triangles: pixel (x, y) looks from the eye through

    q = eye + ((d0 + y * dy) + x * dx)        (float64, in this order, component by component)

and sees a triangle a, b, c iff the three weights w0 = r . (pb x pc), w1 = r . (pc x pa) and
w2 = r . (pa x pb), with r = q - eye and p = corner - eye, all have the sign of pa . (pb x pc) or are
zero: r is then a non-negative combination of the corners, so the hit lies in the closed triangle and
in front of the eye, whatever the triangle does behind it (Olano and Greer 1997, "Triangle scan
conversion using 2D homogeneous coordinates", section 3). Nothing is clipped or divided.
"""

from typing import NamedTuple

import numpy as np

from penumbra.arrays import Float64Array, Int64Array
from penumbra.kernels._jit import helper, kernel
from penumbra.kernels.predicates import UNDERFLOW, UNIT_ROUNDOFF, orient3d_sign

# |D - computed| is at most 8 u times the permanent (1 for pa, 4 for the normal, 3 for the sum); twice that.
DEPTH_BOUND = 16.0 * UNIT_ROUNDOFF
# A corner nearer to the plane of the eye than this share of its distance is not divided by its depth.
LEAST_SLOPE = 2.0**-16


class View(NamedTuple):
    """Camera and window as kernels read them; made by `penumbra.visible`."""

    eye: Float64Array  # (3,) world space
    d0: Float64Array  # (3,) direction through pixel (0, 0); forward times any direction is 1
    dx: Float64Array  # (3,) step of the direction from pixel to pixel, right
    dy: Float64Array  # (3,) the same, down
    window: Int64Array  # (4,) x0, y0, x1, y1, half-open, pixels of the full picture
    to_pixel: Float64Array  # (3, 3) rows give depth h, h * x and h * y of a point relative to the eye
    ray_error: Float64Array  # (3,) bound of |linear form - (q - eye)| and of all rounding around it
    underflow: float  # absolute error of an edge function when its products underflow
    box_slack: float  # relative error of `to_pixel`, far more than rounding can do
    box_margin: float  # pixels by which rounding of q can move a pixel's ray
    depth_slack: float  # relative error of h at a hit as the ray's parameter


@helper
def _project(view, x, y, z):
    """Depth h, h * pixel x, h * pixel y and 1-norm of a point relative to the eye."""
    m = view.to_pixel
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z,
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z,
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z,
        abs(x) + abs(y) + abs(z),
    )


@helper
def _outside_one_side(low, high, ha, hb, hc, ca, cb, cc, error):
    """Whether all corners have their pixel coordinate, as h * c, surely below low or surely above high."""
    below = max(ca - low * ha, cb - low * hb, cc - low * hc)
    above = min(ca - high * ha, cb - high * hb, cc - high * hc)
    return below < -error or above > error


@helper
def _pixel_range(low, high, ca, cb, cc, error):
    """Whole pixels of [low, high) that values ca, cb, cc, each within error, can span: half-open."""
    first = max(np.ceil(min(ca, cb, cc) - error), float(low))
    last = min(np.floor(max(ca, cb, cc) + error), float(high - 1))
    if first > last:
        return low, low
    return np.int64(first), np.int64(last) + 1


@kernel
def fill_boxes(vertices, view, first, last, out_survivors, out_boxes, out_depths):
    """Find which triangles of vertices[first:last] may cover a pixel centre of the window, and where.

    Survivors are packed from index `first` on: out_survivors int64 (n,) triangle, out_boxes int64 (n, 4)
    half-open pixel box x0, y0, x1, y1 (conservative), out_depths float64 (n, 2) bounds of the ray
    parameter of any hit. Returns how many there are. A triangle that comes close to the plane of the
    eye, or crosses it, gets the whole window unless it lies beyond one side of it.
    """
    count = 0
    x0, y0, x1, y1 = view.window[0], view.window[1], view.window[2], view.window[3]
    ex, ey, ez = view.eye[0], view.eye[1], view.eye[2]
    row_h = max(abs(view.to_pixel[0, 0]), abs(view.to_pixel[0, 1]), abs(view.to_pixel[0, 2]))
    row_xy = 0.0
    for k in range(3):
        row_xy = max(row_xy, abs(view.to_pixel[1, k]), abs(view.to_pixel[2, k]))
    for i in range(first, last):
        v = vertices[i]
        ha, xa, ya, size_a = _project(view, v[0, 0] - ex, v[0, 1] - ey, v[0, 2] - ez)
        hb, xb, yb, size_b = _project(view, v[1, 0] - ex, v[1, 1] - ey, v[1, 2] - ez)
        hc, xc, yc, size_c = _project(view, v[2, 0] - ex, v[2, 1] - ey, v[2, 2] - ez)
        size = max(size_a, size_b, size_c)
        error = view.box_slack * row_h * size
        nearest, farthest = min(ha, hb, hc), max(ha, hb, hc)
        if farthest < -error:
            continue
        left, top, right, bottom = x0, y0, x1, y1
        if nearest > LEAST_SLOPE * size:
            xa, xb, xc, ya, yb, yc = xa / ha, xb / hb, xc / hc, ya / ha, yb / hb, yc / hc
            reach = max(abs(xa), abs(xb), abs(xc), abs(ya), abs(yb), abs(yc))
            pixels = view.box_margin + view.box_slack * (size / nearest) * (row_xy + row_h * reach)
            left, right = _pixel_range(x0, x1, xa, xb, xc, pixels)
            top, bottom = _pixel_range(y0, y1, ya, yb, yc, pixels)
            if left >= right or top >= bottom:
                continue
        else:
            # One pixel further out than the outermost centres, which covers `box_margin`.
            side = view.box_slack * size * (row_xy + row_h * (1.0 + max(x1, y1)))
            if _outside_one_side(x0 - 1.0, float(x1), ha, hb, hc, xa, xb, xc, side):
                continue
            if _outside_one_side(y0 - 1.0, float(y1), ha, hb, hc, ya, yb, yc, side):
                continue
        k = first + count
        out_survivors[k] = i
        out_boxes[k, 0], out_boxes[k, 1], out_boxes[k, 2], out_boxes[k, 3] = left, top, right, bottom
        out_depths[k, 0] = max((nearest - error) * (1.0 - view.depth_slack), 0.0)
        out_depths[k, 1] = (farthest + error) * (1.0 + view.depth_slack)
        count += 1
    return count


@helper
def _set_linear(view, planes, row, sign, px, py, pz, ux, uy, uz):
    """Write planes[row] for the function sign * r . (p x u), and return the normal with its permanents.

    planes[row] = value at pixel (0, 0), step in x, step in y, error bound: the function at (x, y) is
    (value + y * step_y) + x * step_x. The bound counts 4 roundings of each normal component, 6 of the
    evaluation and 4 of q per unit of `|d0| + |x dx| + |y dy|`, plus 1 per unit of the eye; `ray_error`
    holds 32 and 4.
    """
    ax, bx = py * uz, pz * uy
    ay, by = pz * ux, px * uz
    az, bz = px * uy, py * ux
    nx, ny, nz = sign * (ax - bx), sign * (ay - by), sign * (az - bz)
    mx, my, mz = abs(ax) + abs(bx), abs(ay) + abs(by), abs(az) + abs(bz)
    planes[row, 0] = nx * view.d0[0] + ny * view.d0[1] + nz * view.d0[2]
    planes[row, 1] = nx * view.dx[0] + ny * view.dx[1] + nz * view.dx[2]
    planes[row, 2] = nx * view.dy[0] + ny * view.dy[1] + nz * view.dy[2]
    planes[row, 3] = mx * view.ray_error[0] + my * view.ray_error[1] + mz * view.ray_error[2] + view.underflow
    return nx, ny, nz, mx, my, mz


@helper
def set_up_triangle(view, v, planes):
    """Fill the linear functions of a triangle and return (sign, D, bound of D); sign 0: edge-on, unseen.

    v: float64 (3, 3) corners. planes float64 (4, 4): the weights w0, w1, w2, then S = r . normal, whose
    ratio D / S is the ray parameter of the hit; all with the sign that makes D positive, so that inside
    means w >= 0. D and S may be off by their bounds. Sums that overflow become functions that decide nothing.
    """
    ex, ey, ez = view.eye[0], view.eye[1], view.eye[2]
    side = orient3d_sign(
        v[0, 0], v[0, 1], v[0, 2], v[1, 0], v[1, 1], v[1, 2], v[2, 0], v[2, 1], v[2, 2], ex, ey, ez
    )
    if side == 0:
        return side, 0.0, 0.0
    sign = -float(side)
    ax, ay, az = v[0, 0] - ex, v[0, 1] - ey, v[0, 2] - ez
    bx, by, bz = v[1, 0] - ex, v[1, 1] - ey, v[1, 2] - ez
    cx, cy, cz = v[2, 0] - ex, v[2, 1] - ey, v[2, 2] - ez
    ux, uy, uz = v[1, 0] - v[0, 0], v[1, 1] - v[0, 1], v[1, 2] - v[0, 2]
    wx, wy, wz = v[2, 0] - v[0, 0], v[2, 1] - v[0, 1], v[2, 2] - v[0, 2]
    # p x (edge) and not p x p: the error then scales with the edge and not with the distance squared.
    _set_linear(view, planes, 0, sign, bx, by, bz, v[2, 0] - v[1, 0], v[2, 1] - v[1, 1], v[2, 2] - v[1, 2])
    _set_linear(view, planes, 1, sign, cx, cy, cz, -wx, -wy, -wz)
    _set_linear(view, planes, 2, sign, ax, ay, az, ux, uy, uz)
    nx, ny, nz, mx, my, mz = _set_linear(view, planes, 3, sign, ux, uy, uz, wx, wy, wz)
    depth = ax * nx + ay * ny + az * nz
    bound = DEPTH_BOUND * (abs(ax) * mx + abs(ay) * my + abs(az) * mz) + UNDERFLOW * (
        1.0 + abs(ax) + abs(ay) + abs(az)
    )
    total = planes[0, 3] + planes[1, 3] + planes[2, 3] + planes[3, 3] + bound
    # The bounds are above u times the largest value of their functions, so 2**60 of them finite is enough.
    if not total * 2.0**60 < np.inf:
        planes[:, :3] = 0.0
        planes[:, 3] = np.inf
        return side, 1.0, 0.0
    return side, depth, bound
