"""3: which of two triangles a ray meets first, exactly: a float64 filter, then integers.

A ray from the eye along r = q - eye meets the plane of a, b, c at parameter t = D / S, with
D = (a - eye) . N, S = r . N, N = (b - a) x (c - a). Surfaces that lie in one plane tie, and the lower
index is seen; in float64 alone they would be mixed pixel by pixel.
"""

import numpy as np

from penumbra.kernels._jit import helper
from penumbra.kernels.exact import ADD, SUBTRACT, accumulate, fill_row, integer_sign, multiply, row_range
from penumbra.kernels.predicates import DET_BOUND, UNDECIDED, UNDERFLOW, UNIT_ROUNDOFF, sign_of
from penumbra.kernels.vec3 import absolute, cross, cross_permanent, dot, minus, side_of

# Rows of the integer matrix: a - eye of both triangles, the ray, and the edges of both triangles.
_NEW, _OLD, _RAY, _NEW_AB, _NEW_AC, _OLD_AB, _OLD_AC = range(7)
_N_ROWS = 7


@helper
def _triple_product(p, normal, permanent):
    """Dot product p . normal of rounded differences, and the bound of its error."""
    size = absolute(p)
    bound = DET_BOUND * dot(size, permanent) + UNDERFLOW * (1.0 + size[0] + size[1] + size[2])
    return dot(p, normal), bound


@helper
def _depth(triangle, eye, ray):
    """D, its bound, S and its bound, of one triangle."""
    a, b, c = triangle
    ab, ac = minus(b, a), minus(c, a)
    normal, permanent = cross(ab, ac), cross_permanent(ab, ac)
    depth, depth_error = _triple_product(minus(a, eye), normal, permanent)
    slope, slope_error = _triple_product(ray, normal, permanent)
    return depth, depth_error, slope, slope_error


@helper
def _order_if_sure(new, old, eye, q):
    """Sign of t_new - t_old where float64 suffices, otherwise UNDECIDED."""
    ray = minus(q, eye)
    d_new, d_new_error, s_new, s_new_error = _depth(new, eye, ray)
    d_old, d_old_error, s_old, s_old_error = _depth(old, eye, ray)
    if abs(s_new) <= s_new_error or abs(s_old) <= s_old_error:
        return UNDECIDED
    left, right = d_new * s_old, d_old * s_new
    bound = (
        abs(d_new) * s_old_error
        + d_new_error * (abs(s_old) + s_old_error)
        + abs(d_old) * s_new_error
        + d_old_error * (abs(s_new) + s_new_error)
        + 4.0 * UNIT_ROUNDOFF * (abs(left) + abs(right))
    )
    sign = sign_of(left - right, 1.001 * bound + UNDERFLOW)
    if sign != UNDECIDED and (s_new > 0.0) != (s_old > 0.0):
        sign = -sign
    return sign


@helper
def _is_in_plane(triangle, p):
    """Whether a point lies exactly in the plane of a triangle."""
    a, b, c = triangle
    # A shared corner, or a plane across an axis, costs nothing here and microseconds in integers.
    if p in (a, b, c):
        return True
    if (a[0] == b[0] == c[0] == p[0]) or (a[1] == b[1] == c[1] == p[1]) or (a[2] == b[2] == c[2] == p[2]):
        return True
    return side_of(a, b, c, p) == 0


@helper
def _fill_cross(u, v, pair, out):
    """Set out (3, n_limbs) to the cross product of two vectors of numbers."""
    for k in range(3):
        i = (k + 1) % 3
        j = (k + 2) % 3
        multiply(u[i], v[j], out[k])
        multiply(u[j], v[i], pair)
        accumulate(out[k], pair, SUBTRACT)


@helper
def _fill_dot(u, v, pair, out):
    """Set the number out to the dot product of two vectors of numbers."""
    out[:] = np.uint64(0)
    for k in range(3):
        multiply(u[k], v[k], pair)
        accumulate(out, pair, ADD)


@helper
def _integer_rows(new, old, eye, q):
    """The rows as integers, uint64 (7, 3, n_limbs), long enough for a product of two determinants."""
    ends = new[0], old[0], q, new[1], new[2], old[1], old[2]
    starts = eye, eye, eye, new[0], new[0], old[0], old[0]
    plus, minus = np.empty((_N_ROWS, 3)), np.empty((_N_ROWS, 3))
    for row in range(_N_ROWS):
        plus[row, 0], plus[row, 1], plus[row, 2] = ends[row]
        minus[row, 0], minus[row, 1], minus[row, 2] = starts[row]
    lows, highs = np.empty(_N_ROWS, np.int64), np.empty(_N_ROWS, np.int64)
    for row in range(_N_ROWS):
        low, row_bits = row_range(plus[row], minus[row])
        lows[row], highs[row] = low, low + row_bits
    # D_new * S_old is compared with D_old * S_new: the first two rows must share a scale, and every
    # other row is in both products.
    lows[_NEW] = lows[_OLD] = min(lows[_NEW], lows[_OLD])
    highs[_OLD] = max(highs[_NEW], highs[_OLD])
    bits = np.int64(12)
    for row in range(_OLD, _N_ROWS):
        bits += highs[row] - lows[row]
    rows = np.zeros((_N_ROWS, 3, bits // 32 + 1), np.uint64)
    for row in range(_N_ROWS):
        fill_row(rows[row], plus[row], minus[row], lows[row])
    return rows


@helper
def _order_in_integers(new, old, eye, q):
    """Sign of t_new - t_old; both triangles are hit, neither plane contains the eye."""
    rows = _integer_rows(new, old, eye, q)
    n_limbs = rows.shape[2]
    pair = np.empty(n_limbs, np.uint64)
    normal = np.empty((3, n_limbs), np.uint64)
    numbers = np.empty((5, n_limbs), np.uint64)
    d_new, s_new, d_old, s_old, total = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    _fill_cross(rows[_NEW_AB], rows[_NEW_AC], pair, normal)
    _fill_dot(rows[_NEW], normal, pair, d_new)
    _fill_dot(rows[_RAY], normal, pair, s_new)
    _fill_cross(rows[_OLD_AB], rows[_OLD_AC], pair, normal)
    _fill_dot(rows[_OLD], normal, pair, d_old)
    _fill_dot(rows[_RAY], normal, pair, s_old)
    multiply(d_new, s_old, total)
    multiply(d_old, s_new, pair)
    accumulate(total, pair, SUBTRACT)
    return integer_sign(total) * integer_sign(s_new) * integer_sign(s_old)


@helper
def depth_order(new, old, eye, q):
    """Exact sign of t_new - t_old for two triangles (a, b, c) that the ray from the eye to q meets.

    Returns (sign, coplanar): `coplanar` says that the two tie for every ray.
    """
    sign = _order_if_sure(new, old, eye, q)
    if sign != UNDECIDED:
        return sign, False
    if _is_in_plane(old, new[0]) and _is_in_plane(old, new[1]) and _is_in_plane(old, new[2]):
        return np.int64(0), True
    return _order_in_integers(new, old, eye, q), False
