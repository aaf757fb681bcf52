"""3: what the rasteriser knows before it visits a pixel: the view, pixel boxes, edge functions.

Triangles are never projected: pixel (x, y) looks from the eye through

    q = eye + ((d0 + y * dy) + x * dx)        (float64, in this order, component by component)

and sees a triangle a, b, c iff the three weights w0 = r . (pb x pc), w1 = r . (pc x pa) and
w2 = r . (pa x pb), with r = q - eye and p = corner - eye, all have the sign of pa . (pb x pc) or are
zero: r is then a non-negative combination of the corners, so the hit lies in the closed triangle and
in front of the eye, whatever the triangle does behind it (Olano and Greer 1997, "Triangle scan
conversion using 2D homogeneous coordinates"). Nothing is clipped, and divided only for the boxes.
"""

from typing import NamedTuple

import numpy as np

from penumbra.kernels._jit import helper, kernel
from penumbra.kernels.predicates import UNDERFLOW, UNIT_ROUNDOFF
from penumbra.kernels.vec3 import (
    absolute,
    cross,
    cross_permanent,
    dot,
    load_triangle,
    minus,
    scaled,
    side_of,
)

# |D - computed| is at most 8 u times the permanent (1 for pa, 4 for the normal, 3 for the sum); twice that.
DEPTH_BOUND = 16.0 * UNIT_ROUNDOFF
# A corner nearer to the plane of the eye than this share of its distance is not divided by its depth.
LEAST_SLOPE = 2.0**-16

Vector = tuple[float, float, float]


class View(NamedTuple):
    """Camera and window as kernels read them; made by `penumbra.visible`."""

    eye: Vector  # world space
    d0: Vector  # direction through pixel (0, 0); forward times any direction is 1
    dx: Vector  # step of the direction from pixel to pixel, right
    dy: Vector  # the same, down
    window: tuple[int, int, int, int]  # x0, y0, x1, y1, half-open, pixels of the full picture
    to_depth: Vector  # times a point relative to the eye: its depth h,
    to_column: Vector  # h * x
    to_row: Vector  # and h * y, for the pixel (x, y) where it is seen
    ray_error: Vector  # bound of |linear form - (q - eye)| and of all rounding around it
    underflow: float  # absolute error of an edge function when its products underflow
    box_slack: float  # relative error of depth and pixel position, far more than rounding can do
    box_margin: float  # pixels by which rounding of q can move a pixel's ray
    depth_slack: float  # relative error of h at a hit as the ray's parameter


@helper
def through(view, x, y):
    """The point q of pixel (x, y); the order of operations is part of the definition."""
    return (
        view.eye[0] + ((view.d0[0] + y * view.dy[0]) + x * view.dx[0]),
        view.eye[1] + ((view.d0[1] + y * view.dy[1]) + x * view.dx[1]),
        view.eye[2] + ((view.d0[2] + y * view.dy[2]) + x * view.dx[2]),
    )


@helper
def _project(view, corner):
    """Depth h, h * pixel x, h * pixel y and 1-norm of a corner relative to the eye."""
    p = minus(corner, view.eye)
    size = abs(p[0]) + abs(p[1]) + abs(p[2])
    return dot(view.to_depth, p), dot(view.to_column, p), dot(view.to_row, p), size


@helper
def _beyond(low, high, depths, values, error):
    """Whether all three corners have pixel value / depth surely below `low`, or all surely above `high`."""
    below = max(values[0] - low * depths[0], values[1] - low * depths[1], values[2] - low * depths[2])
    above = min(values[0] - high * depths[0], values[1] - high * depths[1], values[2] - high * depths[2])
    return below < -error or above > error


@helper
def _pixel_range(low, high, values, error):
    """Whole pixels of [low, high) that lie between three values, each within error: half-open."""
    first = max(np.ceil(min(values[0], values[1], values[2]) - error), float(low))
    last = min(np.floor(max(values[0], values[1], values[2]) + error), float(high - 1))
    if first > last:
        return low, low
    return np.int64(first), np.int64(last) + 1


@helper
def _norm(a):
    return max(abs(a[0]), abs(a[1]), abs(a[2]))


@helper
def _pixel_box(view, depths, columns, rows, nearest, size):
    """Half-open pixel box x0, y0, x1, y1 that holds what the window can see of three projected corners.

    A triangle that comes close to the plane of the eye, or crosses it, gets the whole window unless it
    lies beyond one side of it.
    """
    x0, y0, x1, y1 = view.window
    position_norm = max(_norm(view.to_column), _norm(view.to_row))
    depth_norm = _norm(view.to_depth)
    if nearest > LEAST_SLOPE * size:
        x = columns[0] / depths[0], columns[1] / depths[1], columns[2] / depths[2]
        y = rows[0] / depths[0], rows[1] / depths[1], rows[2] / depths[2]
        reach = max(_norm(x), _norm(y))
        error = view.box_slack * (size / nearest) * (position_norm + depth_norm * reach)
        left, right = _pixel_range(x0, x1, x, view.box_margin + error)
        top, bottom = _pixel_range(y0, y1, y, view.box_margin + error)
        return left, top, right, bottom
    # One pixel further out than the outermost centres, which covers `box_margin`.
    error = view.box_slack * size * (position_norm + depth_norm * (1.0 + max(x1, y1)))
    if _beyond(x0 - 1.0, float(x1), depths, columns, error) or _beyond(
        y0 - 1.0, float(y1), depths, rows, error
    ):
        return x0, y0, x0, y0
    return x0, y0, x1, y1


@kernel
def fill_boxes(vertices, view, first, last, out_survivors, out_boxes, out_depths):
    """Find which triangles of vertices[first:last] may cover a pixel centre of the window, and where.

    vertices float64 (n, 9). Survivors are packed from index `first` on: out_survivors int64 (n,)
    triangle, out_boxes int64 (n, 4) pixel box (conservative), out_depths float64 (n, 2) bounds of the
    ray parameter of any hit. Returns how many there are. Triangles wholly behind the eye are dropped.
    """
    kept = first
    for i in range(first, last):
        a, b, c = load_triangle(vertices[i])
        depth_a, column_a, row_a, size_a = _project(view, a)
        depth_b, column_b, row_b, size_b = _project(view, b)
        depth_c, column_c, row_c, size_c = _project(view, c)
        size = max(size_a, size_b, size_c)
        error = view.box_slack * _norm(view.to_depth) * size
        nearest, farthest = min(depth_a, depth_b, depth_c), max(depth_a, depth_b, depth_c)
        if farthest < -error:
            continue
        depths, columns, rows = (
            (depth_a, depth_b, depth_c),
            (column_a, column_b, column_c),
            (row_a, row_b, row_c),
        )
        left, top, right, bottom = _pixel_box(view, depths, columns, rows, nearest, size)
        if left >= right or top >= bottom:
            continue
        out_survivors[kept] = i
        out_boxes[kept, 0], out_boxes[kept, 1] = left, top
        out_boxes[kept, 2], out_boxes[kept, 3] = right, bottom
        out_depths[kept, 0] = max((nearest - error) * (1.0 - view.depth_slack), 0.0)
        out_depths[kept, 1] = (farthest + error) * (1.0 + view.depth_slack)
        kept += 1
    return kept - first


@helper
def _linear(view, normal, permanent):
    """The function r . normal of the pixel: its value at (0, 0), steps in x and y, and error bound.

    At (x, y) it is (value + y * step_y) + x * step_x. The bound counts 4 roundings of each component of
    the normal (a cross product of differences), 6 of the evaluation and 4 of q for each unit of
    |d0| + |x dx| + |y dy|, and 1 for each unit of the eye; `ray_error` holds 32 and 4.
    """
    bound = dot(permanent, view.ray_error) + view.underflow
    return dot(normal, view.d0), dot(normal, view.dx), dot(normal, view.dy), bound


@helper
def _weight(view, sign, p, edge):
    return _linear(view, scaled(cross(p, edge), sign), cross_permanent(p, edge))


@helper
def set_up_triangle(view, a, b, c):
    """Side of the eye, linear functions w0, w1, w2 and S = r . normal, D, and the bound of D's error.

    The functions have the sign that makes D positive, so inside means w >= 0, and D / S is the ray
    parameter of the hit. `side` 0: edge-on, unseen. Sums that overflow become functions that decide nothing.
    """
    side = side_of(a, b, c, view.eye)
    sign = -float(side)
    pa, pb, pc = minus(a, view.eye), minus(b, view.eye), minus(c, view.eye)
    ab, ca = minus(b, a), minus(a, c)
    # p x edge and not p x p: the error then scales with the edge and not with the distance squared.
    w0 = _weight(view, sign, pb, minus(c, b))
    w1 = _weight(view, sign, pc, ca)
    w2 = _weight(view, sign, pa, ab)
    normal, permanent = scaled(cross(ca, ab), sign), cross_permanent(ca, ab)
    slope = _linear(view, normal, permanent)
    depth = dot(pa, normal)
    size = absolute(pa)
    bound = DEPTH_BOUND * dot(size, permanent) + UNDERFLOW * (1.0 + size[0] + size[1] + size[2])
    # A bound is above u times the largest value of its function, so 2**60 of them finite is enough.
    if not (w0[3] + w1[3] + w2[3] + slope[3] + bound) * 2.0**60 < np.inf:
        nothing = (0.0, 0.0, 0.0, np.inf)
        return side, (nothing, nothing, nothing, nothing), 1.0, 0.0
    return side, (w0, w1, w2, slope), depth, bound
