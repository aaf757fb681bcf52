"""Which of two triangles a ray meets first, exactly: a float64 filter, then integers.

A ray from the eye along r = q - eye meets the plane of a, b, c at parameter t = D / S, with
D = (a - eye) . N, S = r . N, N = (b - a) x (c - a). Surfaces that lie in one plane tie, and the lower
index is seen; in float64 alone they would be mixed pixel by pixel.
"""

import numpy as np

from penumbra.kernels._jit import helper
from penumbra.kernels.exact import _accumulate, _fill_row, _multiply, _row_range, _sign
from penumbra.kernels.predicates import (
    DET_BOUND,
    UNDECIDED,
    UNDERFLOW,
    UNIT_ROUNDOFF,
    orient3d_sign,
    sign_of,
)


@helper
def _triple_product(px, py, pz, corners):
    """p . N of nine corner coordinates, and its bound, for a rounded difference p."""
    ux, uy, uz = corners[3] - corners[0], corners[4] - corners[1], corners[5] - corners[2]
    vx, vy, vz = corners[6] - corners[0], corners[7] - corners[1], corners[8] - corners[2]
    ax, bx = uy * vz, uz * vy
    ay, by = uz * vx, ux * vz
    az, bz = ux * vy, uy * vx
    value = px * (ax - bx) + py * (ay - by) + pz * (az - bz)
    size = abs(px) * (abs(ax) + abs(bx)) + abs(py) * (abs(ay) + abs(by)) + abs(pz) * (abs(az) + abs(bz))
    return value, DET_BOUND * size + UNDERFLOW * (1.0 + abs(px) + abs(py) + abs(pz))


@helper
def _depth_order_filter(new, old, ex, ey, ez, qx, qy, qz):
    """Sign of t_new - t_old where float64 suffices, otherwise UNDECIDED."""
    rx, ry, rz = qx - ex, qy - ey, qz - ez
    d_new, d_new_error = _triple_product(new[0] - ex, new[1] - ey, new[2] - ez, new)
    d_old, d_old_error = _triple_product(old[0] - ex, old[1] - ey, old[2] - ez, old)
    s_new, s_new_error = _triple_product(rx, ry, rz, new)
    s_old, s_old_error = _triple_product(rx, ry, rz, old)
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
def _is_corner(corners, x, y, z):
    for k in range(0, 9, 3):
        if corners[k] == x and corners[k + 1] == y and corners[k + 2] == z:
            return True
    return False


@helper
def _in_one_plane(new, old):
    """Whether two triangles, nine coordinates each, are exactly coplanar."""
    for axis in range(3):
        height = old[axis]
        if (
            old[axis + 3] == height
            and old[axis + 6] == height
            and new[axis] == height
            and new[axis + 3] == height
            and new[axis + 6] == height
        ):
            return True
    for k in range(0, 9, 3):
        x, y, z = new[k], new[k + 1], new[k + 2]
        # A shared corner costs nothing here and microseconds in integers.
        if _is_corner(old, x, y, z):
            continue
        sign = orient3d_sign(
            old[0], old[1], old[2], old[3], old[4], old[5], old[6], old[7], old[8], x, y, z
        )
        if sign != 0:
            return False
    return True


@helper
def _fill_cross(u, v, pair, out):
    """Set out (3, n_limbs) to the cross product of two vectors of numbers."""
    for k in range(3):
        i = (k + 1) % 3
        j = (k + 2) % 3
        _multiply(u[i], v[j], out[k])
        _multiply(u[j], v[i], pair)
        _accumulate(out[k], pair, True)


@helper
def _fill_dot(u, v, pair, out):
    """Set the number out to the dot product of two vectors of numbers."""
    out[:] = np.uint64(0)
    for k in range(3):
        _multiply(u[k], v[k], pair)
        _accumulate(out, pair, False)


@helper
def _depth_order_exact(new, old, ex, ey, ez, qx, qy, qz):
    """Sign of t_new - t_old in integers; both triangles are hit, neither plane contains the eye."""
    plus = np.empty((7, 3))
    minus = np.empty((7, 3))
    eye = (ex, ey, ez)
    through = (qx, qy, qz)
    for k in range(3):
        plus[0, k], minus[0, k] = new[k], eye[k]
        plus[1, k], minus[1, k] = old[k], eye[k]
        plus[2, k], minus[2, k] = through[k], eye[k]
        plus[3, k], minus[3, k] = new[k + 3], new[k]
        plus[4, k], minus[4, k] = new[k + 6], new[k]
        plus[5, k], minus[5, k] = old[k + 3], old[k]
        plus[6, k], minus[6, k] = old[k + 6], old[k]
    lows = np.empty(7, np.int64)
    highs = np.empty(7, np.int64)
    for row in range(7):
        low, row_bits = _row_range(plus[row], minus[row])
        lows[row], highs[row] = low, low + row_bits
    # The two rows of D are compared with each other, so they share one scale; each N has one anyway.
    lows[0] = lows[1] = min(lows[0], lows[1])
    highs[0] = highs[1] = max(highs[0], highs[1])
    bits = np.int64(12)
    for row in range(1, 7):
        bits += highs[row] - lows[row]
    n_limbs = bits // 32 + 1
    rows = np.zeros((7, 3, n_limbs), np.uint64)
    for row in range(7):
        _fill_row(rows[row], plus[row], minus[row], lows[row])
    pair = np.empty(n_limbs, np.uint64)
    normals = np.empty((2, 3, n_limbs), np.uint64)
    _fill_cross(rows[3], rows[4], pair, normals[0])
    _fill_cross(rows[5], rows[6], pair, normals[1])
    d_new, d_old, s_new, s_old, total = np.empty((5, n_limbs), np.uint64)
    _fill_dot(rows[0], normals[0], pair, d_new)
    _fill_dot(rows[1], normals[1], pair, d_old)
    _fill_dot(rows[2], normals[0], pair, s_new)
    _fill_dot(rows[2], normals[1], pair, s_old)
    _multiply(d_new, s_old, total)
    _multiply(d_old, s_new, pair)
    _accumulate(total, pair, True)
    return _sign(total) * _sign(s_new) * _sign(s_old)


@helper
def depth_order(new, old, ex, ey, ez, qx, qy, qz):
    """Exact sign of t_new - t_old for two triangles (nine coordinates each) that the ray to q meets.

    Returns (sign, coplanar): `coplanar` says that the two tie for every ray.
    """
    sign = _depth_order_filter(new, old, ex, ey, ez, qx, qy, qz)
    if sign != UNDECIDED:
        return sign, False
    if _in_one_plane(new, old):
        return np.int64(0), True
    return _depth_order_exact(new, old, ex, ey, ez, qx, qy, qz), False
