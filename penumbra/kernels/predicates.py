"""Signs that decide every visibility bit: a float64 filter with a proven bound, then exact integers.

The bound of a 3 x 3 determinant of rounded differences is (7 + 56 u) u times its permanent, u = 2**-53
(Shewchuk 1997, section 4.3, `o3derrboundA`), enlarged to 8 u; a term for products that underflow is
added, so that the filter is right at every scale. Overflow gives inf or nan, which decides nothing
and leaves the sign to the integers.
"""

import numpy as np

from penumbra.kernels._jit import helper
from penumbra.kernels.exact import exact_det_sign, exact_dot_sign

UNIT_ROUNDOFF = 2.0**-53
DET_BOUND = 8.0 * UNIT_ROUNDOFF
DOT_BOUND = 6.0 * UNIT_ROUNDOFF
# An underflowing product is off by at most 2**-1074; three more factors of slack cover the sums.
UNDERFLOW = 1e-300
# Sums of products below this cannot have overflowed on the way.
OVERFLOW = 1e300
UNDECIDED = np.int64(2)


@helper
def sign_of(value, bound):
    """Sign of a value known to within +-bound: -1 or 1, or UNDECIDED."""
    if value > bound:
        return np.int64(1)
    if value < -bound:
        return np.int64(-1)
    return UNDECIDED


@helper
def det_filter(px, py, pz, ux, uy, uz, vx, vy, vz):
    """Sign of p . (u x v) for rounded differences p, u, v, or UNDECIDED."""
    a = uy * vz
    b = uz * vy
    c = uz * vx
    d = ux * vz
    e = ux * vy
    f = uy * vx
    det = px * (a - b) + py * (c - d) + pz * (e - f)
    permanent = abs(px) * (abs(a) + abs(b)) + abs(py) * (abs(c) + abs(d)) + abs(pz) * (abs(e) + abs(f))
    tiny = UNDERFLOW * (1.0 + abs(px) + abs(py) + abs(pz))
    return sign_of(det, DET_BOUND * permanent + tiny)


@helper
def orient3d_filter(ax, ay, az, bx, by, bz, cx, cy, cz, px, py, pz):
    """`orient3d_sign` where float64 suffices, otherwise UNDECIDED."""
    return det_filter(px - ax, py - ay, pz - az, bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az)


@helper
def orient3d_exact(ax, ay, az, bx, by, bz, cx, cy, cz, px, py, pz):
    """`orient3d_sign` in integers."""
    plus = np.empty((3, 3))
    minus = np.empty((3, 3))
    plus[0, 0], plus[0, 1], plus[0, 2] = px, py, pz
    plus[1, 0], plus[1, 1], plus[1, 2] = bx, by, bz
    plus[2, 0], plus[2, 1], plus[2, 2] = cx, cy, cz
    for row in range(3):
        minus[row, 0], minus[row, 1], minus[row, 2] = ax, ay, az
    return exact_det_sign(plus, minus)


@helper
def orient3d_sign(ax, ay, az, bx, by, bz, cx, cy, cz, px, py, pz):
    """Exact sign of (p - a) . ((b - a) x (c - a)): 1 where p sees a, b, c turn counter-clockwise."""
    sign = orient3d_filter(ax, ay, az, bx, by, bz, cx, cy, cz, px, py, pz)
    if sign == UNDECIDED:
        sign = orient3d_exact(ax, ay, az, bx, by, bz, cx, cy, cz, px, py, pz)
    return sign


@helper
def dot_difference_sign(nx, ny, nz, px, py, pz, qx, qy, qz):
    """Exact sign of n . (p - q)."""
    x = nx * (px - qx)
    y = ny * (py - qy)
    z = nz * (pz - qz)
    sign = sign_of(x + y + z, DOT_BOUND * (abs(x) + abs(y) + abs(z)) + UNDERFLOW)
    if sign == UNDECIDED:
        normal = np.empty(3)
        plus = np.empty(3)
        minus = np.empty(3)
        normal[0], normal[1], normal[2] = nx, ny, nz
        plus[0], plus[1], plus[2] = px, py, pz
        minus[0], minus[1], minus[2] = qx, qy, qz
        sign = exact_dot_sign(normal, plus, minus)
    return sign


@helper
def edges_side_sign(ux, uy, uz, vx, vy, vz, px, py, pz, qx, qy, qz):
    """Exact sign of (p - q) . (u x v): the side of the plane through q along u and v on which p lies."""
    sign = det_filter(px - qx, py - qy, pz - qz, ux, uy, uz, vx, vy, vz)
    if sign == UNDECIDED:
        plus = np.empty((3, 3))
        minus = np.zeros((3, 3))
        plus[0, 0], plus[0, 1], plus[0, 2] = px, py, pz
        plus[1, 0], plus[1, 1], plus[1, 2] = ux, uy, uz
        plus[2, 0], plus[2, 1], plus[2, 2] = vx, vy, vz
        minus[0, 0], minus[0, 1], minus[0, 2] = qx, qy, qz
        sign = exact_det_sign(plus, minus)
    return sign


@helper
def _minor_is_zero(a, b, c, d, plus, minus, axis):
    """Whether a * d - b * c, a component of the cross product of two differences, is exactly zero."""
    left = a * d
    right = b * c
    bound = 4.0 * UNIT_ROUNDOFF * (abs(left) + abs(right)) + UNDERFLOW
    if abs(left - right) > bound:
        return False
    for k in range(3):
        plus[0, k] = 1.0 if k == axis else 0.0
    return exact_det_sign(plus, minus) == 0


@helper
def is_zero_area(ax, ay, az, bx, by, bz, cx, cy, cz):
    """Whether the triangle's three corners lie on one line, exactly."""
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    plus = np.zeros((3, 3))
    minus = np.zeros((3, 3))
    plus[1, 0], plus[1, 1], plus[1, 2] = bx, by, bz
    plus[2, 0], plus[2, 1], plus[2, 2] = cx, cy, cz
    for row in range(1, 3):
        minus[row, 0], minus[row, 1], minus[row, 2] = ax, ay, az
    return (
        _minor_is_zero(uy, uz, vy, vz, plus, minus, 0)
        and _minor_is_zero(uz, ux, vz, vx, plus, minus, 1)
        and _minor_is_zero(ux, uy, vx, vy, plus, minus, 2)
    )
