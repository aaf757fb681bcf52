"""Hard shadows of a point light: one blocker through the receivers of a tile (HPC figure 3 without groups).

The hard shadow volume of a blocker and a point l is bounded by three planes through l and an edge, and
by the blocker's plane as a cap (HPC section 3.1). With p = r - l a receiver r is inside iff the four
numbers n . p + d, n of an edge being (a - l) x (b - a) and its d zero, have the right sign: they are the
determinants of the definition of a bit. The bound on their rounding is the same for all receivers of a
tile, so a volume tells three things of a box or a point: outside for certain, inside of a plane for
certain, or open. A plane is active while it is open; a receiver or a whole node that no active plane is
left of is blocked, and what a receiver leaves open is decided by `segment`. Rounding is monotonic: the
numbers of a box's corners enclose those of every receiver in it, as they are computed.
"""

import numpy as np

from penumbra.kernels._jit import helper, inlined, kernel
from penumbra.kernels.bits import ONE, ZERO, popcount64
from penumbra.kernels.borrow import borrow
from penumbra.kernels.casting import DONE, REBUILD
from penumbra.kernels.counters import (
    BLOCKERS_CULLED,
    BLOCKERS_TESTED,
    ESCALATED_F64,
    LIGHT_VOLUMES_BUILT,
    NODES_VISITED,
    PAIRS_TESTED,
    PLANE_BOX_TESTS,
    PLANE_POINT_TESTS,
    SAMPLES_TESTED,
    UMBRA_NODES_SKIPPED,
    UMBRA_RECEIVERS_SKIPPED,
)
from penumbra.kernels.lanes import bits_above, greater, lesser, load, splat
from penumbra.kernels.masks import MASK_UMBRA, update_inner_umbra
from penumbra.kernels.predicates import OVERFLOW, UNDERFLOW, UNIT_ROUNDOFF
from penumbra.kernels.segment import plane_side, segment_is_blocked
from penumbra.kernels.shaft import blockers_to_skip

_EDGES_AND_CAP = np.int64(15)
# Roundings of a term of n . p: differences and cross product 4, p 1, product 1, sums 2; a term of d, which
# is only that of the cap, has two sums more: 10. The rest is for the rounding of the bound itself.
_BOUND = 12.0 * UNIT_ROUNDOFF


@helper
def _set_plane(k, ux, uy, uz, vx, vy, vz, flip, ox, oy, oz, shaft, volume):
    """Put n = flip * (u x v), d = n . o and the bound of n . p + d for receivers of the tile at place k."""
    a, b, c, d, e, f = uy * vz, uz * vy, uz * vx, ux * vz, ux * vy, uy * vx
    # The shaft's box holds the tile and the light.
    px = shaft.box[3] - shaft.box[0] + abs(ox)
    py = shaft.box[4] - shaft.box[1] + abs(oy)
    pz = shaft.box[5] - shaft.box[2] + abs(oz)
    size = (abs(a) + abs(b)) * px + (abs(c) + abs(d)) * py + (abs(e) + abs(f)) * pz
    if size < OVERFLOW:
        nx, ny, nz = flip * (a - b), flip * (c - d), flip * (e - f)
        volume[0, k], volume[1, k], volume[2, k] = nx, ny, nz
        volume[3, k] = nx * ox + ny * oy + nz * oz
        volume[4, k] = _BOUND * size + UNDERFLOW * (1.0 + px + py + pz)
    else:
        # Nothing is known: the plane stays open everywhere.
        volume[0, k] = volume[1, k] = volume[2, k] = volume[3, k] = 0.0
        volume[4, k] = np.inf


@helper
def _fill_volume(tri, side, lx, ly, lz, shaft, volume):
    """Set volume (5, 8), rows nx, ny, nz, d, bound: the edges and the cap, positive inside.

    side: the light's side of the blocker's plane, not 0.
    """
    tri, shaft, volume = borrow(tri), borrow(shaft), borrow(volume)
    flip = -float(side)
    for k in range(3):
        i = k + 1 if k < 2 else 0
        ax, ay, az = tri[k, 0], tri[k, 1], tri[k, 2]
        _set_plane(
            k, ax - lx, ay - ly, az - lz, tri[i, 0] - ax, tri[i, 1] - ay, tri[i, 2] - az,
            flip, 0.0, 0.0, 0.0, shaft, volume,
        )  # fmt: skip
    ax, ay, az = tri[0, 0], tri[0, 1], tri[0, 2]
    _set_plane(
        3, tri[1, 0] - ax, tri[1, 1] - ay, tri[1, 2] - az, tri[2, 0] - ax, tri[2, 1] - ay, tri[2, 2] - az,
        flip, lx - ax, ly - ay, lz - az, shaft, volume,
    )  # fmt: skip


@inlined
def _clip_box(volume, active, boxes, node, lx, ly, lz):
    """Active planes that a node's box leaves open, or -1 if the box is wholly outside one."""
    nx, ny, nz, d, bound = (
        load(volume, 0),
        load(volume, 8),
        load(volume, 16),
        load(volume, 24),
        load(volume, 32),
    )
    x0, x1 = nx * splat(boxes[node, 0] - lx), nx * splat(boxes[node, 3] - lx)
    y0, y1 = ny * splat(boxes[node, 1] - ly), ny * splat(boxes[node, 4] - ly)
    z0, z1 = nz * splat(boxes[node, 2] - lz), nz * splat(boxes[node, 5] - lz)
    farthest = (greater(x0, x1) + greater(y0, y1)) + (greater(z0, z1) + d)
    if bits_above(splat(0.0) - bound, farthest) & active:
        return np.int64(-1)
    nearest = (lesser(x0, x1) + lesser(y0, y1)) + (lesser(z0, z1) + d)
    return active & ~bits_above(nearest, bound)


@inlined
def _clip_point(volume, active, px, py, pz):
    """Active planes that a receiver leaves open, or -1 if it is outside one."""
    height = (load(volume, 0) * splat(px) + load(volume, 8) * splat(py)) + (
        load(volume, 16) * splat(pz) + load(volume, 24)
    )
    bound = load(volume, 32)
    if bits_above(splat(0.0) - bound, height) & active:
        return np.int64(-1)
    return active & ~bits_above(height, bound)


@helper
def _is_blocked(tri, side, x, y, z, lx, ly, lz, counters):
    """The definition of a bit, for a light on `side` (not 0) of the blocker's plane."""
    tri, counters = borrow(tri), borrow(counters)
    receiver_side = plane_side(
        tri[0, 0], tri[0, 1], tri[0, 2], tri[1, 0], tri[1, 1], tri[1, 2],
        tri[2, 0], tri[2, 1], tri[2, 2], x, y, z, counters,
    )  # fmt: skip
    if receiver_side != -side:
        return False
    return segment_is_blocked(receiver_side, x, y, z, lx, ly, lz, tri, counters)


@inlined
def _cast_on_receivers(tri, tri_id, side, node, planes, bvh, pool, lx, ly, lz, skip_umbra, volume, counters):
    """Test the receivers below a node; returns whether the node came to be fully in umbra by this."""
    all_blocked = True
    n_before = pool.state[1]
    for slot in range(bvh.first[node], bvh.first[node] + bvh.n_slots[node]):
        row = bvh.row[slot]
        known = pool.place[row] == MASK_UMBRA
        if known and skip_umbra:
            counters[UMBRA_RECEIVERS_SKIPPED] += 1
            continue
        if bvh.own[slot] == tri_id:
            all_blocked = False
            continue
        x, y, z = bvh.points[slot, 0], bvh.points[slot, 1], bvh.points[slot, 2]
        left_open = np.int64(0)
        if planes != 0:
            counters[PLANE_POINT_TESTS] += popcount64(np.uint64(planes))
            left_open = _clip_point(volume, planes, x - lx, y - ly, z - lz)
            if left_open < 0:
                all_blocked = False
                continue
        counters[PAIRS_TESTED] += 1
        if known:
            continue
        counters[SAMPLES_TESTED] += 1
        if left_open != 0:
            counters[ESCALATED_F64] += 1
            if not _is_blocked(tri, side, x, y, z, lx, ly, lz, counters):
                all_blocked = False
                continue
        pool.place[row] = MASK_UMBRA
        pool.state[1] += 1
    return all_blocked and pool.state[1] > n_before


@helper
def _cast_blocker(tri, tri_id, shaft, bvh, pool, light, switches, scratch, counters):
    """Cast one blocker through the hierarchy."""
    shaft, bvh, pool, light = borrow(shaft), borrow(bvh), borrow(pool), borrow(light)
    scratch, counters, tri = borrow(scratch), borrow(counters), borrow(tri)
    counters[BLOCKERS_TESTED] += 1
    lx, ly, lz = light.origin[0], light.origin[1], light.origin[2]
    side = plane_side(
        tri[0, 0], tri[0, 1], tri[0, 2], tri[1, 0], tri[1, 1], tri[1, 2],
        tri[2, 0], tri[2, 1], tri[2, 2], lx, ly, lz, counters,
    )  # fmt: skip
    if side == 0:
        return
    stack, volume = scratch.stack, scratch.volume
    _fill_volume(tri, side, lx, ly, lz, shaft, volume)
    counters[LIGHT_VOLUMES_BUILT] += 1
    umbra_changed = False
    stack[0, 0], stack[0, 1] = 0, _EDGES_AND_CAP
    height = 1
    while height > 0:
        height -= 1
        node = np.int64(stack[height, 0])
        planes = np.int64(stack[height, 1])
        if node < 0:
            if umbra_changed:
                update_inner_umbra(~node, bvh)
            continue
        if switches.umbra_bits and bvh.umbra[node, 0] != ZERO:
            counters[UMBRA_NODES_SKIPPED] += 1
            continue
        counters[NODES_VISITED] += 1
        counters[PLANE_BOX_TESTS] += popcount64(np.uint64(planes))
        left_open = _clip_box(volume, planes, bvh.boxes, node, lx, ly, lz)
        if left_open < 0:
            continue
        if switches.active_planes:
            planes = left_open
        if planes == 0 or bvh.child[node] < 0:
            if _cast_on_receivers(
                tri, tri_id, side, node, planes, bvh, pool, lx, ly, lz, switches.umbra_bits, volume, counters
            ):
                bvh.umbra[node, 0] = ONE
                umbra_changed = True
            continue
        if switches.umbra_bits:
            stack[height, 0] = ~node
            height += 1
        stack[height, 0], stack[height, 1] = bvh.child[node] + 1, planes
        stack[height + 1, 0], stack[height + 1, 1] = bvh.child[node], planes
        height += 2


@kernel
def cast_blockers_from_point(chunk, start, rebuild_at, shaft, bvh, pool, light, switches, scratch, counters):
    """Cast the blockers of a chunk from `start` on; returns (where it stopped, DONE | REBUILD).

    A bit is the receiver's place in the mask pool: MASK_UMBRA is blocked; no mask is ever taken. Stops
    when `rebuild_at` receivers have become blocked since the hierarchy was built.
    """
    chunk, shaft, bvh, pool = borrow(chunk), borrow(shaft), borrow(bvh), borrow(pool)
    light, scratch, counters = borrow(light), borrow(scratch), borrow(counters)
    n_blockers = chunk.ids.shape[0]
    t = np.int64(start)
    while t < n_blockers:
        skip = blockers_to_skip(shaft, chunk, t)
        if skip > 0:
            counters[BLOCKERS_CULLED] += skip
            t += skip
            continue
        _cast_blocker(chunk.vertices[t], chunk.ids[t], shaft, bvh, pool, light, switches, scratch, counters)
        t += 1
        if pool.state[1] >= rebuild_at:
            return t, REBUILD
    return n_blockers, DONE
