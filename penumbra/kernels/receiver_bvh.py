"""Receiver hierarchy: boxes over points, built top down (HPC section 3.2).

Above 1024 points a node's box is cut in equal halves; below, a binned search finds the cut of least
surface area, at a multiple of the leaf size, so that nearly all leaves are full (16 receivers, one
vector of lanes).
"""

import numpy as np

from penumbra.kernels._jit import helper, kernel

HALVING_COUNT = 1024
_BINS = 16


@helper
def _fill_bounds(points, order, first, count, box):
    for axis in range(3):
        low = np.inf
        high = -np.inf
        for i in range(first, first + count):
            value = points[order[i], axis]
            low = min(low, value)
            high = max(high, value)
        box[axis] = low
        box[3 + axis] = high


@helper
def _longest_axis(box):
    axis = 0
    for k in range(1, 3):
        if box[3 + k] - box[k] > box[3 + axis] - box[axis]:
            axis = k
    return axis


@helper
def _partition_at(points, order, first, count, axis, middle):
    """Move points below `middle` to the front; return how many there are."""
    i = first
    j = first + count - 1
    while i <= j:
        if points[order[i], axis] < middle:
            i += 1
        else:
            order[i], order[j] = order[j], order[i]
            j -= 1
    return i - first


@helper
def _select(points, order, first, count, axis, n_left):
    """Reorder so that the n_left smallest along an axis come first (Hoare's quickselect)."""
    low = first
    high = first + count - 1
    target = first + n_left
    while low < high:
        pivot = points[order[(low + high) >> 1], axis]
        i = low
        j = high
        while i <= j:
            while points[order[i], axis] < pivot:
                i += 1
            while points[order[j], axis] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if target <= j:
            high = j
        elif target >= i:
            low = i
        else:
            return


@helper
def _half_area(bounds, b):
    """Half the surface of box b, 0 for an empty one."""
    x = bounds[b, 3] - bounds[b, 0]
    y = bounds[b, 4] - bounds[b, 1]
    z = bounds[b, 5] - bounds[b, 2]
    if not x >= 0.0:
        return 0.0
    return x * y + y * z + z * x


@helper
def _grow(bounds, b, other, o):
    for k in range(3):
        bounds[b, k] = min(bounds[b, k], other[o, k])
        bounds[b, 3 + k] = max(bounds[b, 3 + k], other[o, 3 + k])


@helper
def _clear(bounds):
    bounds[:, :3] = np.inf
    bounds[:, 3:] = -np.inf


@helper
def _least_area_cut(points, order, first, count, box, leaf_size, bins, left, right, bin_counts):
    """Axis and number of points on the left of the binned cut of least area times leaves."""
    best_cost = np.inf
    best_axis = _longest_axis(box)
    best_left = ((count // leaf_size + 1) // 2) * leaf_size
    for axis in range(3):
        scale = _BINS / (box[3 + axis] - box[axis])
        # Not for a flat box, nor where the width or its inverse overflows: 0 * inf is no bin.
        if not (scale > 0.0 and scale < np.inf):
            continue
        _clear(bins)
        _clear(left)
        _clear(right)
        bin_counts[:] = 0
        for i in range(first, first + count):
            p = order[i]
            b = min(_BINS - 1, int((points[p, axis] - box[axis]) * scale))
            bin_counts[b] += 1
            for k in range(3):
                bins[b, k] = min(bins[b, k], points[p, k])
                bins[b, 3 + k] = max(bins[b, 3 + k], points[p, k])
        for b in range(1, _BINS):
            left[b] = left[b - 1]
            _grow(left, b, bins, b - 1)
            right[_BINS - b - 1] = right[_BINS - b]
            _grow(right, _BINS - b - 1, bins, _BINS - b)
        n_left = 0
        for b in range(1, _BINS):
            n_left += bin_counts[b - 1]
            snapped = min(max(1, (n_left + leaf_size // 2) // leaf_size) * leaf_size, count - 1)
            if n_left == 0 or n_left == count:
                continue
            leaves_left = (n_left + leaf_size - 1) // leaf_size
            leaves_right = (count - n_left + leaf_size - 1) // leaf_size
            cost = _half_area(left, b) * leaves_left + _half_area(right, b - 1) * leaves_right
            if cost < best_cost:
                best_cost = cost
                best_axis = axis
                best_left = snapped
    return best_axis, min(max(best_left, 1), count - 1)


@kernel
def build_bvh(points, order, leaf_size, boxes, first, count, child):
    """Build the hierarchy over the points that `order` lists, and permute `order` into leaf order.

    points float64 (n, 3); order int32 (m,). Fills boxes (n_nodes, 6: min, max), first and count (a
    node's run of `order`) and child (left child, the right one follows; -1: a leaf). The arrays must
    have room for 2 m nodes. Returns (n_nodes, depth).
    """
    bins = np.empty((_BINS, 6))
    left = np.empty((_BINS, 6))
    right = np.empty((_BINS, 6))
    bin_counts = np.empty(_BINS, np.int64)
    level = np.empty(boxes.shape[0], np.int32)
    first[0] = 0
    count[0] = order.shape[0]
    level[0] = 1
    n_nodes = 1
    depth = 1
    node = 0
    while node < n_nodes:
        start = np.int64(first[node])
        size = np.int64(count[node])
        _fill_bounds(points, order, start, size, boxes[node])
        child[node] = -1
        if size > leaf_size:
            n_left = np.int64(0)
            if size > HALVING_COUNT:
                axis = _longest_axis(boxes[node])
                middle = 0.5 * boxes[node, axis] + 0.5 * boxes[node, 3 + axis]
                n_left = np.int64(_partition_at(points, order, start, size, axis, middle))
                # A cut that leaves nearly all points on one side would make the hierarchy deep.
                if min(n_left, size - n_left) * 32 < size:
                    n_left = size // 2
                    _select(points, order, start, size, axis, n_left)
            else:
                axis, n_left = _least_area_cut(
                    points, order, start, size, boxes[node], leaf_size, bins, left, right, bin_counts
                )
                _select(points, order, start, size, axis, n_left)
            child[node] = n_nodes
            first[n_nodes] = start
            count[n_nodes] = n_left
            first[n_nodes + 1] = start + n_left
            count[n_nodes + 1] = size - n_left
            level[n_nodes] = level[node] + 1
            level[n_nodes + 1] = level[node] + 1
            depth = max(depth, np.int64(level[n_nodes]))
            n_nodes += 2
        node += 1
    return n_nodes, depth
