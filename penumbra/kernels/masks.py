"""Masks on demand (HPC section 3.3 D) and umbra bits of groups, receivers and nodes (A)."""

import numpy as np

from penumbra.kernels._jit import helper, inlined, kernel
from penumbra.kernels.bits import ONE, ZERO
from penumbra.kernels.borrow import borrow
from penumbra.kernels.counters import MASKS_ALLOCATED, MASKS_RELEASED

MASK_NONE = np.int32(-1)
MASK_UMBRA = np.int32(-2)
_WORD = np.int64(64)


@inlined
def group_bits(pool, place, group, group_size):
    """The group's bits of a mask, lowest bit first."""
    if place < 0:
        return ZERO
    bit = group * group_size
    return pool.masks[place, bit >> 6] >> np.uint64(bit & 63)


@inlined
def is_full(pool, place):
    """Whether a mask has every sample blocked."""
    missing = ZERO
    for word in range(pool.full.shape[0]):
        missing |= pool.masks[place, word] ^ pool.full[word]
    return missing == ZERO


@inlined
def take_mask(pool, row, counters):
    """D: a cleared mask for a receiver, or -1 if the pool is empty."""
    if pool.state[0] == 0:
        return np.int32(-1)
    pool.state[0] -= 1
    place = pool.free[pool.state[0]]
    pool.masks[place, :] = ZERO
    pool.place[row] = place
    counters[MASKS_ALLOCATED] += 1
    return place


@inlined
def release_mask(pool, row, counters):
    """D: give back the mask of a receiver in full umbra."""
    pool.free[pool.state[0]] = pool.place[row]
    pool.state[0] += 1
    pool.place[row] = MASK_UMBRA
    counters[MASKS_RELEASED] += 1


@inlined
def node_is_umbra(bvh, node, n_groups):
    """A: whether all groups are blocked for all receivers below a node."""
    for word in range(bvh.umbra.shape[1]):
        n_bits = min(_WORD, n_groups - word * _WORD)
        full = ~ZERO if n_bits == _WORD else (ONE << np.uint64(n_bits)) - ONE
        if bvh.umbra[node, word] != full:
            return False
    return True


@helper
def update_leaf_umbra(bvh, node, pool, light, group_size):
    """A: group-umbra bits of a leaf, the AND over its receivers (HPC figure 3, lines 77 to 80)."""
    bvh, pool, light = borrow(bvh), borrow(pool), borrow(light)
    n_groups = light.full_groups.shape[0]
    for word in range(bvh.umbra.shape[1]):
        bvh.umbra[node, word] = ZERO
    for group in range(n_groups):
        full = light.full_groups[group]
        all_blocked = True
        for slot in range(bvh.first[node], bvh.first[node] + bvh.n_slots[node]):
            place = pool.place[bvh.row[slot]]
            if place != MASK_UMBRA and (group_bits(pool, place, group, group_size) & full) != full:
                all_blocked = False
                break
        if all_blocked:
            bvh.umbra[node, group >> 6] |= ONE << np.uint64(group & 63)


@helper
def update_inner_umbra(node, bvh):
    """A: group-umbra bits of an inner node, the AND of its children (HPC figure 3, lines 50 to 54)."""
    left = bvh.child[node]
    for word in range(bvh.umbra.shape[1]):
        bvh.umbra[node, word] = bvh.umbra[left, word] & bvh.umbra[left + 1, word]


@kernel
def fill_umbra(bvh, n_nodes, pool, light, group_size):
    """Group-umbra bits of all nodes of a new hierarchy, children before parents."""
    for k in range(n_nodes):
        node = n_nodes - 1 - k
        if bvh.child[node] < 0:
            update_leaf_umbra(bvh, node, pool, light, group_size)
        else:
            update_inner_umbra(node, bvh)
