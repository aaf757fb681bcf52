"""Blockers of a grid cell rasterised onto the masks of its receivers by edge planes (GEARS section 4.2).

A cell's list of blockers is a superset of what its receivers need: on real scenes three of four pairs,
or more, block nothing. So eight blockers at a time are set up in float64 lanes, and those that cannot cover
any of the light as seen from a receiver are dropped; the others go the way of every backend (`hard_shadow`).
"""

import numpy as np

from penumbra.arrays import Blocker
from penumbra.kernels._jit import helper, inlined, kernel
from penumbra.kernels.bits import ONE, ZERO, lowest_bit
from penumbra.kernels.borrow import borrow
from penumbra.kernels.counters import (
    ESCALATED_F64,
    PAIRS_ASSIGNED,
    PAIRS_BLOCKING,
    PAIRS_COVERING,
    PAIRS_TESTED,
    UMBRA_RECEIVERS_SKIPPED,
)
from penumbra.kernels.hard_shadow import (
    EDGE_BOUND,
    LANE_BOUND,
    SMALLEST_EDGE,
    block_group,
    fill_edges,
    fill_normal,
    groups_reached,
    light_side,
    receiver_side,
)
from penumbra.kernels.lanes import bits_above, bits_not_below, greater, load, pick, splat, store
from penumbra.kernels.predicates import DET_BOUND, UNDERFLOW
from penumbra.kernels.segment import segment_is_blocked

# Blockers set up at a time: their lanes stay in the second-level cache while all receivers of a cell pass.
BLOCK = 256
# Rows of the lanes: vertices, edge vectors and their lengths, normal and its permanents, the light's side.
_VERTEX, _EDGE, _LENGTH, _NORMAL, _PERMANENT, _SIDE = 0, 9, 18, 21, 24, 27
N_ROWS = 28
N_LANES = 8
_ALL = np.uint64(255)
# Products of three coordinates below this do not overflow on the way.
_LARGEST_TRUSTED = 1e90


@helper
def _fill_lanes(chunk, blockers, first, count, light, extent, normal, lanes):
    """Put blockers[first : first + count] into lanes (N_ROWS, BLOCK), the last vector padded with copies."""
    chunk, light, lanes = borrow(chunk), borrow(light), borrow(lanes)
    for i in range((count + N_LANES - 1) // N_LANES * N_LANES):
        tri = chunk.vertices[blockers[first + min(i, count - 1)]]
        fill_normal(tri, normal)
        for k in range(3):
            after = (k + 1) % 3
            length = 0.0
            for axis in range(3):
                edge = tri[after, axis] - tri[k, axis]
                lanes[_VERTEX + 3 * k + axis, i] = tri[k, axis]
                lanes[_EDGE + 3 * k + axis, i] = edge
                length += abs(edge)
            lanes[_LENGTH + k, i] = length
        for axis in range(3):
            lanes[_NORMAL + axis, i] = normal[axis]
            lanes[_PERMANENT + axis, i] = normal[3 + axis]
        lanes[_SIDE, i] = float(light_side(tri, normal, light, extent))


@inlined
def _row(lanes, row, i):
    """Eight blockers of a row."""
    return load(lanes, row * lanes.shape[1] + i)


@inlined
def _size(x, y, z):
    """Sum of magnitudes."""
    zero = splat(0.0)
    return greater(x, zero - x) + greater(y, zero - y) + greater(z, zero - z)


@inlined
def _classify(lanes, i, x, y, z, gx, gy, gz, ux, uy, uz, vx, vy, vz, reach, tiny, found):
    """Bits of eight blockers: those that may hide some of a parallelogram from a receiver, or hide it all.

    Returns (may hide, hide all, ready): of the last, found (3, 4, 8) holds A, B, C and bound of the edges.

    (x, y, z): the receiver; g: centre of the parallelogram seen from there; u, v: its edges. The functions
    are those of `fill_edges`, with the same bound: reach, times the size of w x e (w: vertex seen from the
    receiver, e: edge), and tiny, for what underflows. They are scaled to at most 1.
    """
    zero = splat(0.0)
    hx, hy, hz = _row(lanes, 0, i) - splat(x), _row(lanes, 1, i) - splat(y), _row(lanes, 2, i) - splat(z)
    # Of the blocker's plane over the receiver: its sign is opposite to the receiver's side.
    height = (
        hx * _row(lanes, _NORMAL, i) + hy * _row(lanes, _NORMAL + 1, i) + hz * _row(lanes, _NORMAL + 2, i)
    )
    bound = splat(DET_BOUND) * (
        greater(hx, zero - hx) * _row(lanes, _PERMANENT, i)
        + greater(hy, zero - hy) * _row(lanes, _PERMANENT + 1, i)
        + greater(hz, zero - hz) * _row(lanes, _PERMANENT + 2, i)
    ) + splat(UNDERFLOW) * (splat(1.0) + _size(hx, hy, hz))
    flip = pick(height, zero, splat(1.0), splat(-1.0))
    unsure = bits_not_below(bound, greater(height, zero - height))
    opposite = height * _row(lanes, _SIDE, i)
    outside = np.int64(0)
    inside = bits_above(opposite, bound)
    ready = inside
    for k in range(3):
        wx = _row(lanes, 3 * k, i) - splat(x)
        wy = _row(lanes, 3 * k + 1, i) - splat(y)
        wz = _row(lanes, 3 * k + 2, i) - splat(z)
        ex, ey = _row(lanes, _EDGE + 3 * k, i), _row(lanes, _EDGE + 3 * k + 1, i)
        ez = _row(lanes, _EDGE + 3 * k + 2, i)
        cx, cy, cz = wy * ez - wz * ey, wz * ex - wx * ez, wx * ey - wy * ex
        a = flip * (cx * splat(gx) + cy * splat(gy) + cz * splat(gz))
        b = cx * splat(ux) + cy * splat(uy) + cz * splat(uz)
        c = cx * splat(vx) + cy * splat(vy) + cz * splat(vz)
        spread = splat(0.5) * (greater(b, zero - b) + greater(c, zero - c))
        error = _size(wx, wy, wz) * _row(lanes, _LENGTH + k, i) * splat(reach) + splat(tiny)
        outside |= bits_above(zero, a + spread + error)
        inside &= bits_above(a - spread, error)
        largest = greater(greater(a, zero - a), greater(greater(b, zero - b), greater(c, zero - c)))
        ready &= bits_above(largest, splat(SMALLEST_EDGE))
        scale = splat(1.0) / largest
        store(found, 32 * k, a * scale)
        store(found, 32 * k + 8, flip * b * scale)
        store(found, 32 * k + 16, flip * c * scale)
        store(found, 32 * k + 24, error * scale)
    outside = (outside & ~unsure) | bits_above(zero - opposite, bound)
    return np.uint64(~outside & 255), np.uint64(inside), np.uint64(ready)


@inlined
def _is_full(masks, r, full):
    """Whether the receiver has every sample blocked."""
    missing = ZERO
    for word in range(full.shape[0]):
        missing |= masks[r, word] ^ full[word]
    return missing == ZERO


@inlined
def _take_edges(found, lane, edges):
    """Edge functions of a blocker from its lane: `fill_edges` of a blocker whose plane misses the light."""
    for k in range(3):
        edges[k, 0] = np.float32(found[k, 0, lane])
        edges[k, 1] = np.float32(found[k, 1, lane])
        edges[k, 2] = np.float32(found[k, 2, lane])
        edges[k, 3] = LANE_BOUND + np.float32(1.001 * found[k, 3, lane])
    edges[3, 0] = np.float32(1.0)
    edges[3, 1] = edges[3, 2] = edges[3, 3] = np.float32(0.0)


@inlined
def _side_of(tri, lane, scratch, x, y, z, counters):
    """Exact side of a blocker's plane on which a receiver lies; leaves the normal in the scratch."""
    for axis in range(6):
        scratch.normal[axis] = scratch.lanes[_NORMAL + axis, lane]
    return receiver_side(tri, scratch.normal, x, y, z, counters)


@inlined
def _block_samples(blocker, side, r, x, y, z, raster, light, edges, counters):
    """OR into the mask of receiver r the bits that a blocker blocks, whose edge functions are given."""
    counters[PAIRS_TESTED] += 1
    found = ZERO
    masks, size = raster.masks, raster.group_size
    sample_set = np.int64(raster.sample_sets[r])
    n_groups = light.full_groups.shape[0]
    for first in range(0, n_groups, 16):
        reached = np.uint64(groups_reached(edges, raster.group_boxes, first))
        while reached != ZERO:
            group = first + lowest_bit(reached)
            reached &= reached - ONE
            if group >= n_groups:
                break
            bit = group * size
            known = (masks[r, bit >> 6] >> np.uint64(bit & 63)) & light.full_groups[group]
            if raster.skip_blocked and known == light.full_groups[group]:
                continue
            blocked = block_group(
                blocker, side, x, y, z, edges, light, sample_set, group, size, known, counters
            )
            found |= blocked
            masks[r, bit >> 6] |= blocked << np.uint64(bit & 63)
    if found != ZERO:
        counters[PAIRS_BLOCKING] += 1


@inlined
def _rasterise_run(r, start, count, raster, chunk, blockers, light, scratch, counters):
    """Rasterise blockers[start : start + count], which are in the lanes, onto the mask of receiver r."""
    o, u, v = light.origin, light.edge_u, light.edge_v
    light_norm = abs(u[0]) + abs(u[1]) + abs(u[2]) + abs(v[0]) + abs(v[1]) + abs(v[2])
    x, y, z = raster.points[r, 0], raster.points[r, 1], raster.points[r, 2]
    gx, gy, gz = o[0] - x, o[1] - y, o[2] - z
    length = abs(gx) + abs(gy) + abs(gz) + light_norm
    reach, tiny = EDGE_BOUND * length + light.residual, UNDERFLOW * (1.0 + length)
    lanes, edges = scratch.lanes, scratch.edges
    for i in range(0, count, N_LANES):
        left, covering, ready = _classify(
            lanes, i, x, y, z, gx, gy, gz, u[0], u[1], u[2], v[0], v[1], v[2], reach, tiny, scratch.found
        )
        if not raster.extent < _LARGEST_TRUSTED:
            left, covering, ready = _ALL, ZERO, ZERO
        if count - i < N_LANES:
            left &= (ONE << np.uint64(count - i)) - ONE
        while left != ZERO:
            bit = lowest_bit(left)
            left &= left - ONE
            t = blockers[start + i + bit]
            if raster.own[r] == chunk.ids[t]:
                continue
            if (covering >> np.uint64(bit)) & ONE != ZERO:
                counters[PAIRS_COVERING] += 1
                counters[PAIRS_BLOCKING] += 1
                raster.masks[r, :] = raster.full
                if raster.skip_blocked:
                    return
                continue
            light_at = np.int64(lanes[_SIDE, i + bit])
            blocker = Blocker(chunk.vertices[t], chunk.ids[t], light_at, raster.extent, np.inf)
            side = -light_at
            if (ready >> np.uint64(bit)) & ONE != ZERO:
                _take_edges(scratch.found, bit, edges)
            else:
                side = _side_of(blocker.corners, i + bit, scratch, x, y, z, counters)
                if side == 0 or side == light_at:
                    continue
                fill_edges(blocker, scratch.normal, side, x, y, z, light, light_norm, edges)
            _block_samples(blocker, side, r, x, y, z, raster, light, edges, counters)


@inlined
def _is_hidden(r, start, count, raster, chunk, blockers, light, scratch, counters):
    """Whether one of blockers[start : start + count], which are in the lanes, hides the one sample from r."""
    x, y, z = raster.points[r, 0], raster.points[r, 1], raster.points[r, 2]
    sample = light.points[raster.sample_sets[r], 0]
    gx, gy, gz = sample[0] - x, sample[1] - y, sample[2] - z
    length = abs(gx) + abs(gy) + abs(gz)
    reach, tiny = EDGE_BOUND * length, UNDERFLOW * (1.0 + length)
    for i in range(0, count, N_LANES):
        left, hiding, _ = _classify(
            scratch.lanes, i, x, y, z, gx, gy, gz, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, reach, tiny, scratch.found
        )
        if not raster.extent < _LARGEST_TRUSTED:
            left, hiding = _ALL, ZERO
        if count - i < N_LANES:
            left &= (ONE << np.uint64(count - i)) - ONE
        while left != ZERO:
            bit = lowest_bit(left)
            left &= left - ONE
            t = blockers[start + i + bit]
            if raster.own[r] == chunk.ids[t]:
                continue
            counters[PAIRS_TESTED] += 1
            hidden = (hiding >> np.uint64(bit)) & ONE != ZERO
            if not hidden:
                counters[ESCALATED_F64] += 1
                tri = chunk.vertices[t]
                side = _side_of(tri, i + bit, scratch, x, y, z, counters)
                hidden = side != 0 and segment_is_blocked(
                    side, x, y, z, sample[0], sample[1], sample[2], tri, counters
                )
            if hidden:
                counters[PAIRS_BLOCKING] += 1
                return True
    return False


@kernel
def rasterise(slots, grid, raster, chunk, begin, blockers, light, scratch, counters):
    """Rasterise onto the masks of receivers slots[0] to slots[1] of the grid the blockers of their cells.

    begin (n_cells + 2,) and blockers: the runs of the cells, as places in the chunk. A light of one sample
    has no row of samples to test: its bit is known from the planes (GEARS section 4.2). Returns how many
    receivers have become blocked for all samples.
    """
    grid, raster, chunk, light = borrow(grid), borrow(raster), borrow(chunk), borrow(light)
    begin, blockers, scratch, counters = borrow(begin), borrow(blockers), borrow(scratch), borrow(counters)
    n_full = np.int64(0)
    slot = np.int64(slots[0])
    cell = np.searchsorted(grid.first, slot, side="right") - 1
    while slot < slots[1]:
        while grid.first[cell + 1] <= slot:
            cell += 1
        last_slot = min(np.int64(slots[1]), grid.first[cell + 1])
        for start in range(begin[cell], begin[cell + 1], BLOCK):
            count = min(np.int64(BLOCK), begin[cell + 1] - start)
            _fill_lanes(chunk, blockers, start, count, light, raster.extent, scratch.normal, scratch.lanes)
            for s in range(slot, last_slot):
                r = grid.rows[s]
                if raster.skip_blocked and _is_full(raster.masks, r, raster.full):
                    counters[UMBRA_RECEIVERS_SKIPPED] += 1
                    continue
                counters[PAIRS_ASSIGNED] += count
                if light.n_samples > 1:
                    _rasterise_run(r, start, count, raster, chunk, blockers, light, scratch, counters)
                elif _is_hidden(r, start, count, raster, chunk, blockers, light, scratch, counters):
                    raster.masks[r, 0] = ONE
                n_full += np.int64(_is_full(raster.masks, r, raster.full))
        slot = last_slot
    return n_full
