"""Hard shadow volumes of one blocker, tested for a whole row of light samples at once.

The hard shadow volume of a blocker and a sample l is bounded by the blocker's plane and three planes
through l and an edge (HPC section 3.1); a receiver r is inside iff four determinants have the right
sign. Read with r fixed they are linear in l: over a planar light each is A + B s + C t. So the
planes of all samples never need to be stored (8 sets of 256 would take 128 KB a blocker), and 16
samples fit one vector of float32 lanes. A, B, C are computed in float64; only their last step is
float32, with a bound; what falls inside the bound is decided by `segment`.
"""

import numpy as np

from penumbra.kernels._jit import helper, inlined
from penumbra.kernels.bits import ONE, ZERO, lowest_bit, popcount64
from penumbra.kernels.counters import ESCALATED_EXACT, ESCALATED_F64, SAMPLES_TESTED
from penumbra.kernels.lanes import bits_above, bits_not_below, lesser, load, splat
from penumbra.kernels.penumbra_volume import cross
from penumbra.kernels.predicates import (
    DET_BOUND,
    OVERFLOW,
    UNDECIDED,
    UNDERFLOW,
    UNIT_ROUNDOFF,
    orient3d_exact,
    sign_of,
)
from penumbra.kernels.segment import segment_is_blocked

# Lanes: coefficients scaled to at most 1, |s|, |t| <= 1/2. In units of 2**-24 the rounding of A, B, C
# gives 2, of s and t 1, of the two products 1, of the two sums 3.5: 7.5, so 8.
LANE_BOUND = np.float32(8.0 * 2.0**-24)
# Float64 part: edge vectors 1, cross product 4, light vectors 1, dot product 3, of each term; doubled.
EDGE_BOUND = 20.0 * UNIT_ROUNDOFF
SMALLEST_EDGE = 1e-250
LARGEST_EDGE = 1e250


@helper
def fill_normal(tri, normal):
    """Set normal (6,): normal (b - a) x (c - a), and the permanents of its three components."""
    ux, uy, uz = tri[1, 0] - tri[0, 0], tri[1, 1] - tri[0, 1], tri[1, 2] - tri[0, 2]
    vx, vy, vz = tri[2, 0] - tri[0, 0], tri[2, 1] - tri[0, 1], tri[2, 2] - tri[0, 2]
    normal[0], normal[1], normal[2] = cross(ux, uy, uz, vx, vy, vz)
    normal[3] = abs(uy * vz) + abs(uz * vy)
    normal[4] = abs(uz * vx) + abs(ux * vz)
    normal[5] = abs(ux * vy) + abs(uy * vx)


@inlined
def receiver_side(tri, normal, x, y, z, counters):
    """Exact side of the blocker's plane on which a receiver lies: -1, 0 or 1."""
    px, py, pz = x - tri[0, 0], y - tri[0, 1], z - tri[0, 2]
    permanent = abs(px) * normal[3] + abs(py) * normal[4] + abs(pz) * normal[5]
    tiny = UNDERFLOW * (1.0 + abs(px) + abs(py) + abs(pz))
    side = sign_of(px * normal[0] + py * normal[1] + pz * normal[2], DET_BOUND * permanent + tiny)
    if side == UNDECIDED:
        counters[ESCALATED_EXACT] += 1
        side = orient3d_exact(
            tri[0, 0], tri[0, 1], tri[0, 2], tri[1, 0], tri[1, 1], tri[1, 2],
            tri[2, 0], tri[2, 1], tri[2, 2], x, y, z,
        )  # fmt: skip
    return side


@helper
def light_side(tri, normal, light, extent):
    """Side of the blocker's plane on which every sample of the light lies for certain, or 0."""
    lowest = np.inf
    highest = -np.inf
    for j in range(4):
        height = (
            normal[0] * (light.corners[0, j, 0] - tri[0, 0])
            + normal[1] * (light.corners[0, j, 1] - tri[0, 1])
            + normal[2] * (light.corners[0, j, 2] - tri[0, 2])
        )
        lowest = min(lowest, height)
        highest = max(highest, height)
    permanent = normal[3] + normal[4] + normal[5]
    if not permanent * extent < OVERFLOW:
        return np.int64(0)
    bound = permanent * (32.0 * UNIT_ROUNDOFF * extent + 4.0 * light.residual) + UNDERFLOW * (1.0 + extent)
    if lowest > bound:
        return np.int64(1)
    return np.int64(-1) if highest < -bound else np.int64(0)


@inlined
def set_edge(k, a, b, c, error, edges):
    """Store one function scaled to at most 1, with the bound of its lanes."""
    largest = max(max(abs(a), abs(b)), abs(c))
    # The sum is not finite where any of the three is not; a maximum may pass over a nan.
    total = abs(a) + abs(b) + abs(c)
    if not (total > SMALLEST_EDGE and total < LARGEST_EDGE and error < LARGEST_EDGE):
        # Nothing is known: every lane is left open.
        edges[k, 0] = edges[k, 1] = edges[k, 2] = np.float32(0.0)
        edges[k, 3] = np.float32(np.inf)
        return
    scale = 1.0 / largest
    edges[k, 0] = np.float32(a * scale)
    edges[k, 1] = np.float32(b * scale)
    edges[k, 2] = np.float32(c * scale)
    edges[k, 3] = LANE_BOUND + np.float32(1.001 * error * scale)


@inlined
def fill_edges(blocker, normal, side, x, y, z, light, light_norm, edges):
    """Set edges (4, 4): functions A + B s + C t, >= 0 where the sample may be blocked, and their bounds.

    side: the receiver's side of the blocker's plane (not 0); light_norm: |edge_u|_1 + |edge_v|_1.
    The fourth function, the plane of the blocker, is needed only where the light straddles it.
    """
    tri = blocker.corners
    u, v, o = light.edge_u, light.edge_v, light.origin
    gx, gy, gz = o[0] - x, o[1] - y, o[2] - z
    length = abs(gx) + abs(gy) + abs(gz) + light_norm
    reach = EDGE_BOUND * length + light.residual
    tiny = UNDERFLOW * (1.0 + length)
    flip = -float(side)
    for k in range(3):
        i = k + 1 if k < 2 else 0
        wx, wy, wz = tri[k, 0] - x, tri[k, 1] - y, tri[k, 2] - z
        ex, ey, ez = tri[i, 0] - tri[k, 0], tri[i, 1] - tri[k, 1], tri[i, 2] - tri[k, 2]
        nx, ny, nz = cross(wx, wy, wz, ex, ey, ez)
        nx, ny, nz = nx * flip, ny * flip, nz * flip
        size = (abs(wx) + abs(wy) + abs(wz)) * (abs(ex) + abs(ey) + abs(ez))
        set_edge(
            k,
            nx * gx + ny * gy + nz * gz,
            nx * u[0] + ny * u[1] + nz * u[2],
            nx * v[0] + ny * v[1] + nz * v[2],
            size * reach + tiny,
            edges,
        )
    if blocker.side == 0:
        nx, ny, nz = normal[0] * flip, normal[1] * flip, normal[2] * flip
        hx, hy, hz = o[0] - tri[0, 0], o[1] - tri[0, 1], o[2] - tri[0, 2]
        length = abs(hx) + abs(hy) + abs(hz) + light_norm
        reach = EDGE_BOUND * length + light.residual
        set_edge(
            3,
            nx * hx + ny * hy + nz * hz,
            nx * u[0] + ny * u[1] + nz * u[2],
            nx * v[0] + ny * v[1] + nz * v[2],
            (normal[3] + normal[4] + normal[5]) * reach + UNDERFLOW * (1.0 + length),
            edges,
        )
    else:
        edges[3, 0] = np.float32(1.0)
        edges[3, 1] = edges[3, 2] = edges[3, 3] = np.float32(0.0)


@inlined
def test_samples(edges, straddles, parameters, sample_set, first, n_samples):
    """Bits of a group's samples that are blocked for certain, and of those that may be."""
    a0, b0, c0 = splat(edges[0, 0]), splat(edges[0, 1]), splat(edges[0, 2])
    a1, b1, c1 = splat(edges[1, 0]), splat(edges[1, 1]), splat(edges[1, 2])
    a2, b2, c2 = splat(edges[2, 0]), splat(edges[2, 1]), splat(edges[2, 2])
    bound = max(max(edges[0, 3], edges[1, 3]), max(edges[2, 3], edges[3, 3]))
    above, below = splat(bound), splat(-bound)
    n_padded = parameters.shape[2]
    start = sample_set * 2 * n_padded + first
    blocked = np.uint64(0)
    possible = np.uint64(0)
    for row in range(0, n_samples, 16):
        s = load(parameters, start + row)
        t = load(parameters, start + n_padded + row)
        f = lesser(lesser(a0 + b0 * s + c0 * t, a1 + b1 * s + c1 * t), a2 + b2 * s + c2 * t)
        if straddles:
            f = lesser(f, splat(edges[3, 0]) + splat(edges[3, 1]) * s + splat(edges[3, 2]) * t)
        blocked |= np.uint64(bits_above(f, above)) << np.uint64(row)
        possible |= np.uint64(bits_not_below(f, below)) << np.uint64(row)
    return blocked, possible


@inlined
def groups_reached(edges, boxes, first):
    """Bits of 16 light sample groups, from `first` on, that a blocker may reach as seen from a receiver.

    boxes (4, n) float32: centre s, t and half widths of each group in light parameters. Twice the bound of
    the lanes: four products and four sums, of numbers that are at most 2.
    """
    s, t = load(boxes, first), load(boxes, boxes.shape[1] + first)
    half_s, half_t = load(boxes, 2 * boxes.shape[1] + first), load(boxes, 3 * boxes.shape[1] + first)
    reached = np.int64(0xFFFF)
    for k in range(3):
        a, b, c = edges[k, 0], edges[k, 1], edges[k, 2]
        most = splat(a) + splat(b) * s + splat(c) * t + splat(abs(b)) * half_s + splat(abs(c)) * half_t
        reached &= bits_not_below(most, splat(-(edges[k, 3] + LANE_BOUND)))
    return reached


@inlined
def block_group(blocker, side, x, y, z, edges, light, sample_set, group, n_samples, known, counters):
    """Bits of one group that the blocker blocks for a receiver; `known` are blocked already."""
    full = light.full_groups[group]
    first = group * n_samples
    counters[SAMPLES_TESTED] += popcount64(full & ~known)
    blocked, possible = test_samples(edges, blocker.side == 0, light.parameters, sample_set, first, n_samples)
    left_open = possible & ~blocked & ~known & full
    if left_open != ZERO:
        counters[ESCALATED_F64] += popcount64(left_open)
        while left_open != ZERO:
            lane = lowest_bit(left_open)
            left_open &= left_open - ONE
            point = light.points[sample_set, first + lane]
            if segment_is_blocked(side, x, y, z, point[0], point[1], point[2], blocker.corners, counters):
                blocked |= ONE << np.uint64(lane)
    return blocked & full
