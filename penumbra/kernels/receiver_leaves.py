"""Receivers in leaves of 16: sorted along a Z curve by a radix sort, then mapped to light space."""

import numpy as np

from penumbra.kernels._jit import helper, kernel
from penumbra.kernels.borrow import borrow

LEAF = 16
_AXIS_BITS = 14
_DIGIT_BITS = np.uint64(11)
_N_DIGITS = 4
_N_BUCKETS = 1 << 11
# Rounding to float32 may go down.
_UP = 1.0 + 2.0**-20
_DIGIT = np.uint64(_N_BUCKETS - 1)
# Each line moves the upper half of every group of bits away from the lower one, to every third bit.
_SPREAD = np.array(
    [
        [16, 0x030000FF0000FF],
        [8, 0x300F00F00F00F00F],
        [4, 0x30C30C30C30C30C3],
        [2, 0x9249249249249249],
    ],
    np.uint64,
)


@helper
def _spread(cell):
    """Bits of a cell number, three apart."""
    for k in range(_SPREAD.shape[0]):
        cell = (cell | (cell << _SPREAD[k, 0])) & _SPREAD[k, 1]
    return cell


@kernel
def fill_z_keys(points, rows, first, last, low, per_unit, keys):
    """Set keys[first:last] to the places of points[rows[...]] (R, 3) along a Z curve.

    A cell number is (coordinate - low) * per_unit (3,), clipped to 0 ... 2**14 - 1.
    """
    most = float((1 << _AXIS_BITS) - 1)
    for k in range(first, last):
        row = rows[k]
        key = np.uint64(0)
        for axis in range(3):
            cell = (points[row, axis] - low[axis]) * per_unit[axis]
            # Written so that nan becomes 0.
            cell = min(cell, most) if cell > 0.0 else 0.0
            key |= _spread(np.uint64(np.int64(cell))) << np.uint64(axis)
        keys[k] = key


@kernel
def sort_keys(keys, order, spare_keys, spare_order):
    """Radix sort: order (n,) becomes the stable order of keys (n,) below 2**44; all arrays are used up."""
    n = keys.shape[0]
    counts = np.zeros((_N_DIGITS, _N_BUCKETS), np.int64)
    for k in range(n):
        key = keys[k]
        order[k] = k
        for digit in range(_N_DIGITS):
            counts[digit, np.int64((key >> (np.uint64(digit) * _DIGIT_BITS)) & _DIGIT)] += 1
    for digit in range(_N_DIGITS):
        total = 0
        for bucket in range(_N_BUCKETS):
            count = counts[digit, bucket]
            counts[digit, bucket] = total
            total += count
    for digit in range(_N_DIGITS):
        shift = np.uint64(digit) * _DIGIT_BITS
        for k in range(n):
            key = keys[k]
            bucket = np.int64((key >> shift) & _DIGIT)
            place = counts[digit, bucket]
            counts[digit, bucket] = place + 1
            spare_keys[place] = key
            spare_order[place] = order[k]
        keys, spare_keys = spare_keys, keys
        order, spare_order = spare_order, order


@helper
def _fill_leaf(leaves, leaf, placed):
    """Set all of a leaf that follows from its places in light space, (3, 16)."""
    radius = 0.0
    reach = 1.0
    for axis in range(3):
        low = high = placed[axis, 0]
        farthest = 0.0
        for slot in range(LEAF):
            place = placed[axis, slot]
            leaves.places[leaf, axis, slot] = np.float32(place)
            low, high = min(low, place), max(high, place)
            farthest = max(farthest, abs(place))
        leaves.boxes[leaf, axis] = np.float32(low)
        leaves.boxes[leaf, 3 + axis] = np.float32(high)
        centre = 0.5 * low + 0.5 * high
        nearest = np.float32(centre)
        leaves.centres[leaf, axis] = nearest
        leaves.centres[leaf, 3 + axis] = np.float32(centre - np.float64(nearest))
        largest = 0.0
        for slot in range(LEAF):
            offset = placed[axis, slot] - centre
            leaves.offsets[leaf, axis, slot] = np.float32(offset)
            largest = max(largest, abs(offset))
        radius += largest
        reach += farthest
    leaves.reaches[leaf, 0] = np.float32(radius * _UP)
    leaves.reaches[leaf, 1] = np.float32(reach * _UP)


@kernel
def fill_leaves(leaves, rows, order, light, first, last, box):
    """Fill leaves first to last (not included) with the receivers rows[order[...]], 16 each.

    Sets box (6,) to their bounds in world space.
    """
    leaves, light = borrow(leaves), borrow(light)
    box[:3] = np.inf
    box[3:] = -np.inf
    matrix, origin = light.matrix, light.origin
    n_rows = order.shape[0]
    placed = np.empty((3, LEAF))
    for leaf in range(first, last):
        leaves.count[leaf] = min(LEAF, n_rows - leaf * LEAF)
        for slot in range(LEAF):
            row = rows[order[min(leaf * LEAF + slot, n_rows - 1)]]
            leaves.row[leaf * LEAF + slot] = row
            x = leaves.points[row, 0] - origin[0]
            y = leaves.points[row, 1] - origin[1]
            z = leaves.points[row, 2] - origin[2]
            for axis in range(3):
                box[axis] = min(box[axis], leaves.points[row, axis])
                box[3 + axis] = max(box[3 + axis], leaves.points[row, axis])
                placed[axis, slot] = matrix[axis, 0] * x + matrix[axis, 1] * y + matrix[axis, 2] * z
        _fill_leaf(leaves, leaf, placed)
