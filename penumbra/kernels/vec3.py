"""Vectors as tuples of three float64: indexing them is free in compiled code, and short in source.

Arrays would do as well but for compile time: numba spends ten times as long on `v[0, 2]` of an array.
"""

import numpy as np

from penumbra.kernels._jit import helper
from penumbra.kernels.predicates import orient3d_filter, orient3d_sign


@helper
def load_triangle(v):
    """Corners a, b, c of an array of nine coordinates."""
    return (v[0], v[1], v[2]), (v[3], v[4], v[5]), (v[6], v[7], v[8])


@helper
def minus(a, b):
    """Difference a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@helper
def dot(a, b):
    """Dot product, summed from x to z."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@helper
def cross(a, b):
    """Cross product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@helper
def scaled(a, factor):
    """The vector times a number."""
    return a[0] * factor, a[1] * factor, a[2] * factor


@helper
def absolute(a):
    """Absolute value of each component."""
    return abs(a[0]), abs(a[1]), abs(a[2])


@helper
def cross_permanent(a, b):
    """The sums of absolute products whose differences are the cross product: its error grows with them."""
    return (
        abs(a[1] * b[2]) + abs(a[2] * b[1]),
        abs(a[2] * b[0]) + abs(a[0] * b[2]),
        abs(a[0] * b[1]) + abs(a[1] * b[0]),
    )


@helper
def unit(a):
    """The vector at length 1; zeros for a vector without a direction (zero, infinite or nan)."""
    largest = max(abs(a[0]), abs(a[1]), abs(a[2]))
    if not 0.0 < largest < np.inf:
        return 0.0, 0.0, 0.0
    # Divided by its largest component first: squares of 1e-200 would underflow.
    a = a[0] / largest, a[1] / largest, a[2] / largest
    length = np.sqrt(dot(a, a))
    return a[0] / length, a[1] / length, a[2] / length


@helper
def side_of(a, b, c, p):
    """Exact side, -1, 0 or 1, of the plane of a, b, c on which p lies (`orient3d_sign`)."""
    return orient3d_sign(a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2], p[0], p[1], p[2])


@helper
def side_of_if_sure(a, b, c, p):
    """`side_of` where float64 suffices, otherwise UNDECIDED."""
    return orient3d_filter(a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2], p[0], p[1], p[2])
