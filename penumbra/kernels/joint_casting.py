"""The joint descent: leaves of 16 receivers through the hierarchy of a chunk in light space.

A box seen from a receiver covers an interval of s and one of t on the light; it is left when every
sample there is blocked already, for the whole leaf first, then for each receiver.
"""

import numpy as np

from penumbra.kernels._jit import inlined, kernel
from penumbra.kernels.bits import ZERO, lowest_bit, popcount64
from penumbra.kernels.borrow import borrow
from penumbra.kernels.cluster import cast_pair, decide_lanes, prefetch_cluster, prepare_cluster
from penumbra.kernels.counters import CLUSTER_TESTS, CLUSTERS_VISITED, LEAVES_VISITED, TREE_NODES_VISITED
from penumbra.kernels.lanes import (
    any_bit,
    bits_above,
    bits_not_below,
    choose,
    greater,
    lesser,
    load,
    splat,
    store,
    to_integers,
)

N_BINS = 128
_FAR = np.float32(1e25)
_LAST_BIN = np.float32(N_BINS - 1)
_NEAR = np.float32(1e-20)
_TABLE = N_BINS * 4


@inlined
def _cover(x0, y0, z0, x1, y1, z1, rx0, ry0, rz0, rx1, ry1, rz1, extent, border, bins, at):
    """Lanes whose box may cover part of a block of the light, seen from receivers in a box; fill their bins.

    A point of the box at depth z is seen at r + (p - r) k, k = rz / (rz - z); k is 1 on the light and
    without bound beside the receiver. extent (6,): the block's least s, t, greatest s, t, bins per s, t.
    """
    above = rz1 - z0
    beside = rz0 - z1
    zero, far = splat(np.float32(0.0)), splat(_FAR)
    alive = bits_above(above, zero)
    near = bits_above(beside, splat(_NEAR))
    k0 = rz1 / above
    k1 = choose(near, rz0 / beside, far)
    to_left, to_right = x0 - rx1, x1 - rx0
    s0 = rx1 + lesser(to_left * k0, to_left * k1)
    s1 = rx0 + greater(to_right * k0, to_right * k1)
    to_left, to_right = y0 - ry1, y1 - ry0
    t0 = ry1 + lesser(to_left * k0, to_left * k1)
    t1 = ry0 + greater(to_right * k0, to_right * k1)
    s0, t0 = s0 - splat(extent[0] + border), t0 - splat(extent[1] + border)
    s1, t1 = s1 - splat(extent[0] - border), t1 - splat(extent[1] - border)
    alive &= bits_not_below(s1, zero) & bits_not_below(t1, zero)
    alive &= bits_not_below(splat(extent[2] - extent[0]), s0)
    alive &= bits_not_below(splat(extent[3] - extent[1]), t0)
    per_s, per_t, last = splat(extent[4]), splat(extent[5]), splat(_LAST_BIN)
    store(bins, at, to_integers(lesser(greater(s0 * per_s, zero), last)))
    store(bins, at + 16, to_integers(lesser(greater(s1 * per_s, zero), last)))
    store(bins, at + 32, to_integers(lesser(greater(t0 * per_t, zero), last)))
    store(bins, at + 48, to_integers(lesser(greater(t1 * per_t, zero), last)))
    return alive


@inlined
def _samples_between(tables, table, bins, level, lane):
    """Samples in the bins that a lane covers, as a vector of four words."""
    samples = load(tables, table + np.int64(bins[level, 0, lane]) * 4)
    samples = samples & load(tables, table + _TABLE + np.int64(bins[level, 1, lane]) * 4)
    samples = samples & load(tables, table + 2 * _TABLE + np.int64(bins[level, 2, lane]) * 4)
    return samples & load(tables, table + 3 * _TABLE + np.int64(bins[level, 3, lane]) * 4)


@inlined
def _cast_cluster(tree, leaves, light, block, cluster, leaf, extent, scratch, counters):
    """Cast one cluster on the receivers of a leaf; returns whether any of them was tested."""
    counters[CLUSTERS_VISITED] += 1
    node, lane = cluster >> 4, cluster & 15
    nodes = tree.nodes
    rx, ry, rz = (
        load(leaves.places, leaf * 48),
        load(leaves.places, leaf * 48 + 16),
        load(leaves.places, leaf * 48 + 32),
    )
    alive = _cover(
        splat(nodes[node, 0, lane]), splat(nodes[node, 1, lane]), splat(nodes[node, 2, lane]),
        splat(nodes[node, 3, lane]), splat(nodes[node, 4, lane]), splat(nodes[node, 5, lane]),
        rx, ry, rz, rx, ry, rz, extent, np.float32(light.border), scratch.bins, 192,
    )  # fmt: skip
    alive &= (np.int64(1) << np.int64(leaves.count[leaf])) - 1
    counters[CLUSTER_TESTS] += popcount64(np.uint64(alive))
    prefetch_cluster(tree, cluster)
    n_pairs = np.int64(0)
    while alive != 0:
        slot = lowest_bit(np.uint64(alive))
        alive &= alive - 1
        samples = _samples_between(light.tables, scratch.tables[slot], scratch.bins, 3, slot) & load(
            scratch.open, slot * 4
        )
        # Without a branch: whether a receiver has such samples is a coin toss.
        store(scratch.wanted, n_pairs * 4, samples)
        scratch.slots[n_pairs] = slot
        n_pairs += np.int64(any_bit(samples))
    if n_pairs > 0:
        prepare_cluster(tree, leaves, light, cluster, leaf, scratch)
    for pair in range(n_pairs):
        if tree.careful[cluster] != 0:
            decide_lanes(
                tree, leaves, light, block, cluster, np.int64(tree.careful[cluster]), leaf, pair,
                scratch, counters,
            )  # fmt: skip
        if tree.fast[cluster] != 0:
            cast_pair(tree, leaves, light, block, cluster, leaf, pair, extent, scratch, counters)
    return n_pairs > 0


@inlined
def _open_samples(leaves, light, block, leaf, scratch):
    """Fill scratch.open from the masks; returns whether any sample of the leaf is open."""
    n_words = light.n_words
    any_open = ZERO
    n_blocks = light.full.shape[0]
    for slot in range(leaves.count[leaf]):
        sample_set = np.int64(leaves.sample_set[leaves.row[leaf * 16 + slot]])
        scratch.tables[slot] = (sample_set * n_blocks + block) * (4 * _TABLE)
    for word in range(4):
        at = block * 4 + word
        union = ZERO
        for slot in range(leaves.count[leaf]):
            bits = ZERO
            if at < n_words:
                bits = light.full[block, word] & ~leaves.masks[leaves.row[leaf * 16 + slot], at]
            scratch.open[slot, word] = bits
            union |= bits
        scratch.open[16, word] = union
        any_open |= union
    return any_open != ZERO


@inlined
def _close_samples(leaves, light, block, leaf, scratch):
    """Write what is blocked into the masks; returns whether any sample of the leaf is still open."""
    any_open = ZERO
    for word in range(4):
        at = block * 4 + word
        if at < light.n_words:
            for slot in range(leaves.count[leaf]):
                row = leaves.row[leaf * 16 + slot]
                leaves.masks[row, at] = light.full[block, word] & ~scratch.open[slot, word]
                any_open |= scratch.open[slot, word]
    return any_open != ZERO


@inlined
def _unite_open(leaves, leaf, scratch):
    for word in range(4):
        union = ZERO
        for slot in range(leaves.count[leaf]):
            union |= scratch.open[slot, word]
        scratch.open[16, word] = union


@inlined
def _cast_leaf(tree, leaves, light, block, leaf, scratch, counters):
    """Cast a chunk on one leaf and one block of samples; returns whether samples are left open."""
    if not _open_samples(leaves, light, block, leaf, scratch):
        return False
    counters[LEAVES_VISITED] += 1
    e, b = light.extents[block], leaves.boxes[leaf]
    extent = (e[0], e[1], e[2], e[3], e[4], e[5])
    rx0, ry0, rz0 = splat(b[0]), splat(b[1]), splat(b[2])
    rx1, ry1, rz1 = splat(b[3]), splat(b[4]), splat(b[5])
    border = np.float32(light.border)
    nodes = tree.nodes
    table = (np.int64(light.parameters.shape[0]) * light.full.shape[0] + block) * (4 * _TABLE)
    changed = False
    for root in range(tree.first_node[2], tree.first_node[3]):
        # The node in hand and its children not yet visited, by level.
        level = np.int64(2)
        node0 = node1 = np.int64(0)
        node2 = np.int64(root)
        left0 = left1 = left2 = np.int64(0)
        node = node2
        enter = True
        while level < 3:
            if enter:
                counters[TREE_NODES_VISITED] += 1
                at = node * 96
                left = _cover(
                    load(nodes, at), load(nodes, at + 16), load(nodes, at + 32),
                    load(nodes, at + 48), load(nodes, at + 64), load(nodes, at + 80),
                    rx0, ry0, rz0, rx1, ry1, rz1, extent, border, scratch.bins, level * 64,
                )  # fmt: skip
                if level == 2:
                    node2, left2 = node, left
                elif level == 1:
                    node1, left1 = node, left
                else:
                    node0, left0 = node, left
                enter = False
            left = left2 if level == 2 else (left1 if level == 1 else left0)
            if left == 0:
                level += 1
                continue
            lane = lowest_bit(np.uint64(left))
            left &= left - 1
            if level == 2:
                left2 = left
                parent = node2
            elif level == 1:
                left1 = left
                parent = node1
            else:
                left0 = left
                parent = node0
            samples = _samples_between(light.tables, table, scratch.bins, level, lane) & load(
                scratch.open, 64
            )
            if not any_bit(samples):
                continue
            child = (parent - tree.first_node[level]) * 16 + lane
            if level > 0:
                level -= 1
                node = tree.first_node[level] + child
                enter = True
                continue
            if _cast_cluster(tree, leaves, light, block, child, leaf, extent, scratch, counters):
                changed = True
                _unite_open(leaves, leaf, scratch)
    if not changed:
        return True
    return _close_samples(leaves, light, block, leaf, scratch)


@kernel
def cast_leaves(tree, leaves, light, first, last, scratch, counters):
    """Cast a chunk on the leaves first to last (not included) that are not done."""
    tree, leaves, light = borrow(tree), borrow(leaves), borrow(light)
    scratch, counters = borrow(scratch), borrow(counters)
    for leaf in range(first, last):
        if leaves.is_done[leaf]:
            continue
        is_open = False
        for block in range(light.full.shape[0]):
            if _cast_leaf(tree, leaves, light, block, leaf, scratch, counters):
                is_open = True
        if not is_open:
            leaves.is_done[leaf] = 1
