"""The definition of a visibility bit as five exact signs, for one receiver, blocker and light sample."""

import numpy as np

from penumbra.kernels._jit import helper
from penumbra.kernels.counters import ESCALATED_EXACT
from penumbra.kernels.predicates import UNDECIDED, det_filter, orient3d_exact, orient3d_filter


@helper
def plane_side(ax, ay, az, bx, by, bz, cx, cy, cz, px, py, pz, counters):
    """Exact side (-1, 0, 1) of the plane of a, b, c on which p lies."""
    side = orient3d_filter(ax, ay, az, bx, by, bz, cx, cy, cz, px, py, pz)
    if side == UNDECIDED:
        counters[ESCALATED_EXACT] += 1
        side = orient3d_exact(ax, ay, az, bx, by, bz, cx, cy, cz, px, py, pz)
    return side


@helper
def edge_side(rx, ry, rz, ax, ay, az, bx, by, bz, lx, ly, lz, counters):
    """Exact sign of (l - r) . ((a - r) x (b - a)): on which side the line r l passes the line a b.

    The normal is built from the edge vector, so that its error scales with the edge and not with
    the square of the distance.
    """
    sign = det_filter(lx - rx, ly - ry, lz - rz, ax - rx, ay - ry, az - rz, bx - ax, by - ay, bz - az)
    if sign == UNDECIDED:
        counters[ESCALATED_EXACT] += 1
        sign = orient3d_exact(rx, ry, rz, ax, ay, az, bx, by, bz, lx, ly, lz)
    return sign


@helper
def segment_is_blocked(side_r, rx, ry, rz, lx, ly, lz, tri, counters):
    """Whether the open segment (r, l) meets the closed triangle tri (3, 3), not lying in its plane.

    side_r is the receiver's exact side of the plane, not 0. The two endpoints must be strictly on
    either side; then the segment crosses the plane once, and it does so inside the closed triangle
    iff the three edges are passed on one side, or touched.
    """
    ax, ay, az = tri[0, 0], tri[0, 1], tri[0, 2]
    bx, by, bz = tri[1, 0], tri[1, 1], tri[1, 2]
    cx, cy, cz = tri[2, 0], tri[2, 1], tri[2, 2]
    if plane_side(ax, ay, az, bx, by, bz, cx, cy, cz, lx, ly, lz, counters) * side_r >= 0:
        return False
    if edge_side(rx, ry, rz, ax, ay, az, bx, by, bz, lx, ly, lz, counters) * side_r > 0:
        return False
    if edge_side(rx, ry, rz, bx, by, bz, cx, cy, cz, lx, ly, lz, counters) * side_r > 0:
        return False
    return edge_side(rx, ry, rz, cx, cy, cz, ax, ay, az, lx, ly, lz, counters) * side_r <= np.int64(0)
