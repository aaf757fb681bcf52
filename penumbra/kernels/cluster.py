"""One receiver against a cluster of 16 blockers in light space, one blocker a lane.

Seen from receiver r, edge k of a blocker is the function n_k . (l - r) of sample l, n_k = (v_k - r) x e_k.
Sample l is blocked where all three have the sign of (v - r) . (v_1 - v_0) x (v_2 - v_1): then the line
r l meets the blocker, and meets it ahead of r. It meets it before l, too, unless the blocker may reach the
plane of the light: such blockers have a fourth function.

Rounding, in units of u = 2**-24 times (|w| + E) E G, w = v_0 - r, E the length of the edges, G >= |l - r|:
w (from the centre of the leaf, then from the receiver, |w| the sum of both) 3.1 and its edge 1, products
and difference 2 give 6.2 for n_0 and n_2; n_1 = N - n_0 - n_2 adds them, N and two roundings: 17.5; the
function adds 6 for its own products and sums, s and t: below 24, of the 32 that are allowed for. The
error of places in light space beyond that is `doubt`, added to |w|.
"""

import numpy as np

from penumbra.kernels._jit import helper, inlined
from penumbra.kernels.bits import ONE, ZERO, lowest_bit, popcount64
from penumbra.kernels.borrow import borrow
from penumbra.kernels.counters import (
    CLUSTER_PAIRS,
    ESCALATED_F64,
    LANES_TESTED,
    PAIRS_ESCALATED,
    TRIANGLE_MAJOR,
)
from penumbra.kernels.hard_shadow import fill_normal, receiver_side
from penumbra.kernels.lanes import (
    bits_above,
    bits_equal,
    bits_not_below,
    choose,
    greater,
    lesser,
    load,
    magnitude,
    muladd,
    prefetch,
    splat,
    store,
    with_sign,
)
from penumbra.kernels.light_space import N_LANES
from penumbra.kernels.segment import segment_is_blocked

_ROUNDOFF = 2.0**-24
_NEVER = np.float32(-1e30)
_TINY = np.float32(1e-30)
_LOW_HALF = np.int64(0xFFFFFFFF)
_LANE = np.uint64(0xFFFF)
# With more samples than this, lanes are first dropped by the rectangle around them.
_FEW = 6
# The rectangle is a little larger than the bins, for the rounding of its sides.
_MARGIN = np.float32(0.01)
_NEXT = np.float32(1.01)
# With more than this, one blocker against 16 samples at a time may be cheaper.
_SOME = 10


@helper
def decide_lane(tree, leaves, light, block, cluster, lane, row, word, candidates, scratch, counters):
    """Which candidates of a word one blocker blocks, decided in world space: float64, then exactly."""
    tree, leaves, light = borrow(tree), borrow(leaves), borrow(light)
    scratch, counters = borrow(scratch), borrow(counters)
    t = cluster * 16 + lane
    if tree.ids[t] == leaves.own[row]:
        return ZERO
    tri = tree.vertices[t]
    x, y, z = leaves.points[row, 0], leaves.points[row, 1], leaves.points[row, 2]
    fill_normal(tri, scratch.normal)
    side = receiver_side(tri, scratch.normal, x, y, z, counters)
    if side == 0:
        return ZERO
    sample_set = np.int64(leaves.sample_set[row])
    counters[ESCALATED_F64] += popcount64(candidates)
    blocked = ZERO
    while candidates != ZERO:
        bit = lowest_bit(candidates)
        candidates &= candidates - ONE
        point = light.points[sample_set, block * 256 + word * 64 + bit]
        if segment_is_blocked(side, x, y, z, point[0], point[1], point[2], tri, counters):
            blocked |= ONE << np.uint64(bit)
    return blocked


@helper
def decide_lanes(tree, leaves, light, block, cluster, lanes, leaf, pair, scratch, counters):
    """Decide whole blockers in world space, for all samples wanted that are open."""
    tree, leaves, light = borrow(tree), borrow(leaves), borrow(light)
    scratch, counters = borrow(scratch), borrow(counters)
    slot = np.int64(scratch.slots[pair])
    row = leaves.row[leaf * 16 + slot]
    while lanes != 0:
        lane = lowest_bit(np.uint64(lanes))
        lanes &= lanes - 1
        counters[PAIRS_ESCALATED] += 1
        for word in range(4):
            candidates = scratch.wanted[pair, word] & scratch.open[slot, word]
            if candidates != ZERO:
                scratch.open[slot, word] &= ~decide_lane(
                    tree, leaves, light, block, cluster, lane, row, word, candidates, scratch, counters
                )


@helper
def decide_samples(tree, leaves, light, block, cluster, lanes, row, slot, scratch, counters):
    """Decide the samples in scratch.unsure, which some of these lanes left open."""
    tree, leaves, light = borrow(tree), borrow(leaves), borrow(light)
    scratch, counters = borrow(scratch), borrow(counters)
    c = scratch.coefficients
    sample_set = np.int64(leaves.sample_set[row])
    for word in range(4):
        unsure = scratch.unsure[word] & scratch.open[slot, word]
        while unsure != ZERO:
            bit = lowest_bit(unsure)
            unsure &= unsure - ONE
            s = light.parameters[sample_set, block, 0, word * 64 + bit]
            t = light.parameters[sample_set, block, 1, word * 64 + bit]
            for lane in range(16):
                bound = np.float32(2.0) * c[9, lane]
                if (
                    (lanes >> lane) & 1 == 1
                    and c[0, lane] + c[1, lane] * s + c[2, lane] * t >= -bound
                    and c[3, lane] + c[4, lane] * s + c[5, lane] * t >= -bound
                    and c[6, lane] + c[7, lane] * s + c[8, lane] * t >= -bound
                ):
                    only = ONE << np.uint64(bit)
                    scratch.open[slot, word] &= ~decide_lane(
                        tree, leaves, light, block, cluster, lane, row, word, only, scratch, counters
                    )


@helper
def turn_lane(tree, leaves, light, cluster, lane, row, scratch, counters):
    """Turn a blocker of scratch.coefficients by the receiver's exact side; False: it is in the plane."""
    tree, leaves, light = borrow(tree), borrow(leaves), borrow(light)
    scratch, counters = borrow(scratch), borrow(counters)
    counters[PAIRS_ESCALATED] += 1
    tri = tree.vertices[cluster * 16 + lane]
    fill_normal(tri, scratch.normal)
    x, y, z = leaves.points[row, 0], leaves.points[row, 1], leaves.points[row, 2]
    side = receiver_side(tri, scratch.normal, x, y, z, counters)
    c = scratch.coefficients
    if float(c[14, lane]) * float(side) * light.handedness > 0.0:
        for k in range(13):
            if k != 9:
                c[k, lane] = -c[k, lane]
    return side != 0


@inlined
def _own_lane(tree, cluster, own):
    """Bit of the receiver's own triangle, if it is in the cluster."""
    same = bits_equal(load(tree.lane_ids, cluster * 16), splat(np.int32(own & _LOW_HALF)))
    if same != 0:
        for lane in range(16):
            t = cluster * 16 + lane
            if (same >> lane) & 1 == 1 and (t >= tree.ids.shape[0] or tree.ids[t] != own):
                same &= ~(np.int64(1) << lane)
    return same


@inlined
def prefetch_cluster(tree, cluster):
    """Ask for the lanes of a cluster while its receivers are looked up."""
    for k in range(N_LANES):
        prefetch(tree.lanes, (cluster * N_LANES + k) * 16)


@inlined
def prepare_cluster(tree, leaves, light, cluster, leaf, scratch):
    """Fill scratch.cluster: what is the same for all receivers of a leaf."""
    first = cluster * (N_LANES * 16)
    lanes, centre = tree.lanes, leaves.centres[leaf]
    wx = (load(lanes, first) - splat(centre[0])) + (load(lanes, first + 48) - splat(centre[3]))
    wy = (load(lanes, first + 16) - splat(centre[1])) + (load(lanes, first + 64) - splat(centre[4]))
    wz = (load(lanes, first + 32) - splat(centre[2])) + (load(lanes, first + 80) - splat(centre[5]))
    radius = splat(leaves.reaches[leaf, 0] + np.float32(light.doubt))
    size = (magnitude(wx) + magnitude(wy)) + (magnitude(wz) + radius)
    length = load(lanes, first + 240)
    tilt = load(lanes, first + 256) * splat(np.float32(8.0 * _ROUNDOFF))
    factor = np.float32(
        np.float32(32.0 * _ROUNDOFF) * leaves.reaches[leaf, 1] + np.float32(4.0 * light.residual)
    )
    store(scratch.cluster, 0, wx)
    store(scratch.cluster, 16, wy)
    store(scratch.cluster, 32, wz)
    store(scratch.cluster, 48, size * tilt + splat(_TINY))
    store(scratch.cluster, 64, (size + length) * length * splat(factor) + splat(_TINY))


@inlined
def _functions(w, n, turn, lanes, first, g):
    """A, B, C of the three edges; each blocker turned (1 or -1) so that it is seen from its back.

    w: first corners from the receiver; n: normals; g: centre of the light from the receiver.
    """
    wx, wy, wz = w[0] * turn, w[1] * turn, w[2] * turn
    nx, ny, nz = n[0] * turn, n[1] * turn, n[2] * turn
    ex, ey, ez = load(lanes, first + 96), load(lanes, first + 112), load(lanes, first + 128)
    b0, c0, d0 = wy * ez - wz * ey, wz * ex - wx * ez, wx * ey - wy * ex
    ex, ey, ez = load(lanes, first + 144), load(lanes, first + 160), load(lanes, first + 176)
    b2, c2, d2 = wy * ez - wz * ey, wz * ex - wx * ez, wx * ey - wy * ex
    b1, c1, d1 = (nx - b0) - b2, (ny - c0) - c2, (nz - d0) - d2
    a0 = muladd(b0, g[0], muladd(c0, g[1], d0 * g[2]))
    a1 = muladd(b1, g[0], muladd(c1, g[1], d1 * g[2]))
    a2 = muladd(b2, g[0], muladd(c2, g[1], d2 * g[2]))
    return a0, b0, c0, a1, b1, c1, a2, b2, c2


@inlined
def _reached(functions, bound, bins, slot, extent):
    """Lanes whose functions may all be >= 0 at once, and all <= 0, among the samples in a receiver's bins."""
    a0, b0, c0, a1, b1, c1, a2, b2, c2 = functions
    s0 = splat(extent[0] + (np.float32(bins[3, 0, slot]) - _MARGIN) / extent[4])
    s1 = splat(extent[0] + (np.float32(bins[3, 1, slot]) + _NEXT) / extent[4])
    t0 = splat(extent[1] + (np.float32(bins[3, 2, slot]) - _MARGIN) / extent[5])
    t1 = splat(extent[1] + (np.float32(bins[3, 3, slot]) + _NEXT) / extent[5])
    most = lesser(
        lesser(
            a0 + greater(b0 * s0, b0 * s1) + greater(c0 * t0, c0 * t1),
            a1 + greater(b1 * s0, b1 * s1) + greater(c1 * t0, c1 * t1),
        ),
        a2 + greater(b2 * s0, b2 * s1) + greater(c2 * t0, c2 * t1),
    )
    least = greater(
        greater(
            a0 + lesser(b0 * s0, b0 * s1) + lesser(c0 * t0, c0 * t1),
            a1 + lesser(b1 * s0, b1 * s1) + lesser(c1 * t0, c1 * t1),
        ),
        a2 + lesser(b2 * s0, b2 * s1) + lesser(c2 * t0, c2 * t1),
    )
    # Twice the bound: the sides of the rectangle are rounded as well.
    twice = bound + bound
    return bits_not_below(most, splat(np.float32(0.0)) - twice), bits_not_below(twice, least)


@inlined
def _test_cluster(functions, plain, bound, light, block, sample_set, pair, slot, scratch):
    """Test each sample wanted against 16 blockers; fills scratch.unsure, returns whether any sample is."""
    a0, b0, c0, a1, b1, c1, a2, b2, c2 = functions
    a0 = choose(plain, a0, splat(_NEVER))
    below = splat(np.float32(0.0)) - bound
    parameters = light.parameters
    any_unsure = ZERO
    # Only words that have samples: most pairs have one sample, and their branches are foreseen.
    words = np.int64(0)
    for word in range(4):
        scratch.unsure[word] = ZERO
        words |= np.int64(scratch.wanted[pair, word] != ZERO) << word
    while words != 0:
        word = lowest_bit(np.uint64(words))
        words &= words - 1
        wanted = scratch.wanted[pair, word]
        blocked = ZERO
        unsure = ZERO
        while wanted != ZERO:
            bit = lowest_bit(wanted)
            only = wanted & (~wanted + ONE)
            wanted ^= only
            s = splat(parameters[sample_set, block, 0, word * 64 + bit])
            t = splat(parameters[sample_set, block, 1, word * 64 + bit])
            f = lesser(
                lesser(muladd(b0, s, muladd(c0, t, a0)), muladd(b1, s, muladd(c1, t, a1))),
                muladd(b2, s, muladd(c2, t, a2)),
            )
            # Without a branch: whether a sample is blocked is a coin toss.
            blocked |= only if bits_above(f, bound) != 0 else ZERO
            unsure |= only if bits_not_below(f, below) != 0 else ZERO
        unsure &= ~blocked
        scratch.unsure[word] = unsure
        any_unsure |= unsure
        scratch.open[slot, word] &= ~blocked
    return any_unsure != ZERO


@inlined
def _store_functions(functions, bound, c):
    store(c, 0, functions[0])
    store(c, 16, functions[1])
    store(c, 32, functions[2])
    store(c, 48, functions[3])
    store(c, 64, functions[4])
    store(c, 80, functions[5])
    store(c, 96, functions[6])
    store(c, 112, functions[7])
    store(c, 128, functions[8])
    store(c, 144, bound)


@inlined
def cast_pair(tree, leaves, light, block, cluster, leaf, pair, extent, scratch, counters):
    """Clear the open samples of a receiver that a cluster blocks, of those in scratch.wanted[pair]."""
    slot = np.int64(scratch.slots[pair])
    row = leaves.row[leaf * 16 + slot]
    counters[CLUSTER_PAIRS] += 1
    first = cluster * (N_LANES * 16)
    w = (
        load(scratch.cluster, 0) - splat(leaves.offsets[leaf, 0, slot]),
        load(scratch.cluster, 16) - splat(leaves.offsets[leaf, 1, slot]),
        load(scratch.cluster, 32) - splat(leaves.offsets[leaf, 2, slot]),
    )
    places = leaves.places
    g = (splat(-places[leaf, 0, slot]), splat(-places[leaf, 1, slot]), splat(-places[leaf, 2, slot]))
    n = (load(tree.lanes, first + 192), load(tree.lanes, first + 208), load(tree.lanes, first + 224))
    height = muladd(w[0], n[0], muladd(w[1], n[1], w[2] * n[2]))
    fast = np.int64(tree.fast[cluster])
    sided = bits_above(magnitude(height), load(scratch.cluster, 48)) & fast
    turn = with_sign(splat(np.float32(1.0)), height)
    functions = _functions(w, n, turn, tree.lanes, first, g)
    bound = load(scratch.cluster, 64)
    n_wanted = popcount64(scratch.wanted[pair, 0]) + popcount64(scratch.wanted[pair, 1])
    n_wanted += popcount64(scratch.wanted[pair, 2]) + popcount64(scratch.wanted[pair, 3])
    crossing = np.int64(tree.straddling[cluster])
    not_own = ~_own_lane(tree, cluster, leaves.own[row])
    plain = sided & not_own
    askew = np.int64(0)
    if n_wanted > _FEW or sided != fast or crossing != 0:
        from_back, from_front = _reached(functions, bound, scratch.bins, slot, extent)
        plain &= from_back
        askew = (from_back | from_front) & fast & ~sided & not_own
    by_lane = (plain & crossing) | askew
    plain &= ~crossing
    if n_wanted > _SOME and popcount64(np.uint64(plain)) * 24 < n_wanted * 2:
        by_lane |= plain
        plain = np.int64(0)
        counters[TRIANGLE_MAJOR] += 1
    any_unsure = False
    if plain != 0:
        counters[LANES_TESTED] += n_wanted * 16
        sample_set = np.int64(leaves.sample_set[row])
        any_unsure = _test_cluster(functions, plain, bound, light, block, sample_set, pair, slot, scratch)
    if any_unsure or by_lane != 0:
        c = scratch.coefficients
        _store_functions(functions, bound, c)
        if any_unsure:
            decide_samples(tree, leaves, light, block, cluster, plain, row, slot, scratch, counters)
        if askew | crossing != 0:
            # The plane of the blocker: the light must lie beyond it. Its height is known to 8 units of |w|,
            # the rest to 16 of |w| and |l - r|; twice that.
            store(c, 160, (muladd(n[0], g[0], muladd(n[1], g[1], n[2] * g[2])) - height) * turn)
            store(c, 176, n[0] * turn)
            store(c, 192, n[1] * turn)
            reach = splat(
                leaves.reaches[leaf, 1] * np.float32(32.0 * _ROUNDOFF) + np.float32(4.0 * light.residual)
            )
            slack = load(scratch.cluster, 48) * splat(np.float32(4.0))
            store(c, 208, slack + load(tree.lanes, first + 256) * reach)
            store(c, 224, turn)
        _cast_lanes(
            tree, leaves, light, block, cluster, by_lane, askew, crossing, row, pair, scratch, counters
        )


@inlined
def _cast_lanes(tree, leaves, light, block, cluster, lanes, askew, crossing, row, pair, scratch, counters):
    """Test blockers of scratch.coefficients one by one."""
    while lanes != 0:
        lane = lowest_bit(np.uint64(lanes))
        lanes &= lanes - 1
        if (askew >> lane) & 1 == 1 and not turn_lane(
            tree, leaves, light, cluster, lane, row, scratch, counters
        ):
            continue
        crosses = (crossing >> lane) & 1 == 1
        _cast_lane(tree, leaves, light, block, cluster, lane, crosses, row, pair, scratch, counters)


@inlined
def _cast_lane(tree, leaves, light, block, cluster, lane, crosses, row, pair, scratch, counters):
    """Test one blocker against the samples wanted, 16 at a time."""
    slot = np.int64(scratch.slots[pair])
    c = scratch.coefficients
    sample_set = np.int64(leaves.sample_set[row])
    parameters = light.parameters
    at_s = (sample_set * light.tables.shape[1] + block) * 512
    a0, b0, c0 = splat(c[0, lane]), splat(c[1, lane]), splat(c[2, lane])
    a1, b1, c1 = splat(c[3, lane]), splat(c[4, lane]), splat(c[5, lane])
    a2, b2, c2 = splat(c[6, lane]), splat(c[7, lane]), splat(c[8, lane])
    bound, below = splat(c[9, lane]), splat(-c[9, lane])
    any_left = ZERO
    for word in range(4):
        wanted = scratch.wanted[pair, word] & scratch.open[slot, word]
        sure = ZERO
        possible = ZERO
        piece = np.int64(0)
        while wanted >> np.uint64(piece) != ZERO:
            if (wanted >> np.uint64(piece)) & _LANE != ZERO:
                counters[LANES_TESTED] += 16
                s = load(parameters, at_s + word * 64 + piece)
                t = load(parameters, at_s + 256 + word * 64 + piece)
                f = lesser(
                    lesser(muladd(b0, s, muladd(c0, t, a0)), muladd(b1, s, muladd(c1, t, a1))),
                    muladd(b2, s, muladd(c2, t, a2)),
                )
                here, maybe = bits_above(f, bound), bits_not_below(f, below)
                if crosses:
                    f = muladd(splat(c[11, lane]), s, muladd(splat(c[12, lane]), t, splat(c[10, lane])))
                    here &= bits_above(f, splat(c[13, lane]))
                    maybe &= bits_not_below(f, splat(-c[13, lane]))
                sure |= np.uint64(here) << np.uint64(piece)
                possible |= np.uint64(maybe) << np.uint64(piece)
            piece += 16
            if piece == 64:
                break
        scratch.unsure[word] = possible & ~sure & wanted
        any_left |= scratch.unsure[word]
        scratch.open[slot, word] &= ~(sure & wanted)
    if any_left != ZERO:
        for word in range(4):
            if scratch.unsure[word] != ZERO:
                scratch.open[slot, word] &= ~decide_lane(
                    tree, leaves, light, block, cluster, lane, row, word, scratch.unsure[word],
                    scratch, counters,
                )  # fmt: skip
