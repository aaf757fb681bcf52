"""Hierarchical penumbra casting: one blocker through the receivers of a tile (HPC figure 3).

Letters A to D are the optimizations of HPC section 3.3, each behind its switch.
"""

import numpy as np

from penumbra.arrays import Blocker
from penumbra.kernels._jit import helper, inlined, kernel
from penumbra.kernels.bits import ONE, ZERO, popcount64
from penumbra.kernels.borrow import borrow
from penumbra.kernels.counters import (
    BLOCKERS_CULLED,
    BLOCKERS_TESTED,
    GROUP_VOLUMES_BUILT,
    LIGHT_VOLUMES_BUILT,
    NODES_VISITED,
    PAIRS_TESTED,
    PLANE_BOX_TESTS,
    PLANE_POINT_TESTS,
    UMBRA_GROUPS_SKIPPED,
    UMBRA_NODES_SKIPPED,
    UMBRA_RECEIVERS_SKIPPED,
)
from penumbra.kernels.hard_shadow import (
    block_group,
    fill_edges,
    fill_normal,
    light_side,
    receiver_side,
)
from penumbra.kernels.masks import (
    MASK_UMBRA,
    group_bits,
    is_full,
    node_is_umbra,
    release_mask,
    take_mask,
    update_inner_umbra,
    update_leaf_umbra,
)
from penumbra.kernels.penumbra_volume import (
    ALL_PLANES,
    VOLUME_SIZE,
    clip_box,
    contains_point,
    fill_volume,
    light_gap,
)
from penumbra.kernels.shaft import blockers_to_skip

# What cast_blockers stopped for.
DONE = np.int64(0)
POOL_EMPTY = np.int64(1)
REBUILD = np.int64(2)


@helper
def _build_group_volumes(blocker, light, scratch, counters):
    """C: penumbra volumes of all groups (HPC figure 3, line 62)."""
    blocker, light, scratch = borrow(blocker), borrow(light), borrow(scratch)
    n_groups = light.full_groups.shape[0]
    choices = scratch.choices[1]
    for group in range(n_groups):
        choices[:] = scratch.choices[0]
        scratch.group_found[group] = fill_volume(
            blocker, scratch.normal, light, 1 + group, choices, scratch.group_volumes[group]
        )
    counters[GROUP_VOLUMES_BUILT] += n_groups


@inlined
def _cast_on_receiver(blocker, slot, level, bvh, pool, light, group_size, switches, scratch, counters):
    """Test a receiver inside V_L against the active groups; -1: pool empty, 1: a group became full."""
    row = bvh.row[slot]
    place = pool.place[row]
    x, y, z = bvh.points[slot, 0], bvh.points[slot, 1], bvh.points[slot, 2]
    side = np.int64(0)
    group_filled = np.int64(0)
    light_norm = (
        abs(light.edge_u[0]) + abs(light.edge_u[1]) + abs(light.edge_u[2])
        + abs(light.edge_v[0]) + abs(light.edge_v[1]) + abs(light.edge_v[2])
    )  # fmt: skip
    for k in range(scratch.n_active[level]):
        group = np.int64(scratch.active_group[level, k])
        full = light.full_groups[group]
        known = group_bits(pool, place, group, group_size) & full
        if known == full and switches.umbra_bits:
            counters[UMBRA_GROUPS_SKIPPED] += 1
            continue
        active = scratch.active_planes[level, k] & scratch.group_found[group]
        counters[PLANE_POINT_TESTS] += popcount64(np.uint64(active))
        if active != 0 and not contains_point(scratch.group_volumes, group * VOLUME_SIZE, active, x, y, z):
            continue
        if side == 0:
            side = receiver_side(blocker.corners, scratch.normal, x, y, z, counters)
            if side == 0 or side == blocker.side:
                return group_filled
            counters[PAIRS_TESTED] += 1
            fill_edges(blocker, scratch.normal, side, x, y, z, light, light_norm, scratch.edges)
        sample_set = np.int64(bvh.sample_set[slot])
        new = ~known & block_group(
            blocker, side, x, y, z, scratch.edges, light, sample_set, group, group_size, known, counters
        )
        if new == ZERO:
            continue
        if place < 0:
            place = take_mask(pool, row, counters)
            if place < 0:
                return np.int64(-1)
        bit = group * group_size
        pool.masks[place, bit >> 6] |= new << np.uint64(bit & 63)
        if known | new == full:
            group_filled = np.int64(1)
    if group_filled == 1 and switches.umbra_bits and is_full(pool, place):
        pool.state[1] += 1
        if switches.lazy_masks:
            release_mask(pool, row, counters)
        else:
            pool.place[row] = MASK_UMBRA
    return group_filled


@inlined
def _narrow_groups(node, level, bvh, volumes_built, light, switches, scratch, counters):
    """Fill the active groups of a level from those of the level above (HPC figure 3, lines 37 to 45)."""
    n_active = 0
    for k in range(scratch.n_active[level - 1]):
        group = np.int64(scratch.active_group[level - 1, k])
        planes = scratch.active_planes[level - 1, k]
        if switches.umbra_bits and bvh.umbra[node, group >> 6] & (ONE << np.uint64(group & 63)):
            counters[UMBRA_GROUPS_SKIPPED] += 1
            continue
        if volumes_built:
            planes &= scratch.group_found[group]
            if planes != 0:
                counters[PLANE_BOX_TESTS] += popcount64(np.uint64(planes))
                left = clip_box(scratch.group_volumes, group * VOLUME_SIZE, planes, bvh.boxes, node)
                if left < 0:
                    continue
                if switches.active_planes:
                    planes = left
        scratch.active_group[level, n_active] = group
        scratch.active_planes[level, n_active] = planes
        n_active += 1
    scratch.n_active[level] = n_active
    return n_active


@inlined
def _cast_on_leaf(blocker, node, level, built, bvh, pool, light, group_size, switches, scratch, counters):
    """Test the receivers of a leaf; returns (status: -1 pool empty, 1 a group became full; volumes built)."""
    status = np.int64(0)
    planes = scratch.light_planes[level]
    for slot in range(bvh.first[node], bvh.first[node] + bvh.n_slots[node]):
        place = pool.place[bvh.row[slot]]
        if place == MASK_UMBRA:
            counters[UMBRA_RECEIVERS_SKIPPED] += 1
            continue
        if bvh.own[slot] == blocker.id:
            continue
        if planes != 0:
            counters[PLANE_POINT_TESTS] += popcount64(np.uint64(planes))
            x, y, z = bvh.points[slot, 0], bvh.points[slot, 1], bvh.points[slot, 2]
            if not contains_point(scratch.light_volume, 0, planes, x, y, z):
                continue
        if not built:
            _build_group_volumes(blocker, light, scratch, counters)
            built = True
        found = _cast_on_receiver(
            blocker, slot, level, bvh, pool, light, group_size, switches, scratch, counters
        )
        if found < 0:
            return np.int64(-1), built
        status |= found
    return status, built


@helper
def _start_blocker(tri, tri_id, shaft, light, scratch, counters):
    """Build V_L, activate all groups, and return the Blocker (HPC figure 3, lines 30 to 33)."""
    shaft, light, scratch = borrow(shaft), borrow(light), borrow(scratch)
    fill_normal(tri, scratch.normal)
    extent = shaft.extent
    for k in range(3):
        for axis in range(3):
            extent = max(extent, abs(tri[k, axis]))
    gap = light_gap(tri, light)
    amplify = shaft.reach / gap if gap > 0.0 else np.inf
    blocker = Blocker(tri, tri_id, light_side(tri, scratch.normal, light, extent), extent, amplify)
    choices = scratch.choices[0]
    choices[:] = -1
    if amplify < np.inf:
        scratch.light_planes[0] = fill_volume(
            blocker, scratch.normal, light, 0, choices, scratch.light_volume
        )
    else:
        # The blocker touches the light: no plane can be trusted, every receiver is tested.
        scratch.light_planes[0] = 0
        scratch.group_found[:] = 0
    counters[LIGHT_VOLUMES_BUILT] += 1
    n_groups = light.full_groups.shape[0]
    for group in range(n_groups):
        scratch.active_group[0, group] = group
        scratch.active_planes[0, group] = ALL_PLANES
    scratch.n_active[0] = n_groups
    return blocker


@helper
def _cast_blocker(tri, tri_id, shaft, bvh, pool, light, group_size, switches, scratch, counters):
    """Cast one blocker through the hierarchy; False if the mask pool ran empty."""
    shaft, bvh, pool, light = borrow(shaft), borrow(bvh), borrow(pool), borrow(light)
    scratch, counters, tri = borrow(scratch), borrow(counters), borrow(tri)
    counters[BLOCKERS_TESTED] += 1
    blocker = borrow(_start_blocker(tri, tri_id, shaft, light, scratch, counters))
    built = blocker.amplify == np.inf
    if not built and not switches.lazy_volumes:
        _build_group_volumes(blocker, light, scratch, counters)
        built = True
    umbra_changed = False
    stack = scratch.stack
    stack[0, 0], stack[0, 1] = 0, 1
    height = 1
    while height > 0:
        height -= 1
        node = np.int64(stack[height, 0])
        level = np.int64(stack[height, 1])
        if node < 0:
            if umbra_changed:
                update_inner_umbra(~node, bvh)
            continue
        if switches.umbra_bits and node_is_umbra(bvh, node, light.full_groups.shape[0]):
            counters[UMBRA_NODES_SKIPPED] += 1
            continue
        counters[NODES_VISITED] += 1
        planes = scratch.light_planes[level - 1]
        if planes != 0:
            counters[PLANE_BOX_TESTS] += popcount64(np.uint64(planes))
            left = clip_box(scratch.light_volume, 0, planes, bvh.boxes, node)
            if left < 0:
                continue
            if switches.active_planes:
                planes = left
        scratch.light_planes[level] = planes
        if _narrow_groups(node, level, bvh, built, light, switches, scratch, counters) == 0:
            continue
        if bvh.child[node] >= 0:
            if switches.umbra_bits:
                stack[height, 0], stack[height, 1] = ~node, level
                height += 1
            stack[height, 0], stack[height, 1] = bvh.child[node] + 1, level + 1
            stack[height + 1, 0], stack[height + 1, 1] = bvh.child[node], level + 1
            height += 2
            continue
        status, built = _cast_on_leaf(
            blocker, node, level, built, bvh, pool, light, group_size, switches, scratch, counters
        )
        if status < 0:
            return False
        if status > 0 and switches.umbra_bits:
            update_leaf_umbra(bvh, node, pool, light, group_size)
            umbra_changed = True
    return True


@kernel
def cast_blockers(chunk, start, rebuild_at, shaft, bvh, pool, light, group_size, switches, scratch, counters):
    """Cast the blockers of a chunk from `start` on; returns (where it stopped, DONE | POOL_EMPTY | REBUILD).

    Runs of 4096, 256 and 16 blockers outside the tile's shaft are passed over at once. Stops when the
    mask pool is empty (the blocker is to be cast again: setting its bits twice is harmless), and when
    `rebuild_at` receivers have reached full umbra.
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
        if not _cast_blocker(
            chunk.vertices[t], chunk.ids[t], shaft, bvh, pool, light, group_size, switches, scratch, counters
        ):
            return t, POOL_EMPTY
        t += 1
        if pool.state[1] >= rebuild_at:
            return t, REBUILD
    return n_blockers, DONE
