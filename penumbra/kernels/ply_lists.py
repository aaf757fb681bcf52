"""Find and read the lists of binary PLY elements, whose records differ in size."""

import numpy as np

from penumbra.kernels._jit import helper, kernel
from penumbra.kernels.index_codes import UNREADABLE_INDEX

# Kinds of a stored number; together with its size in bytes they say how to read it.
UNSIGNED = 0
SIGNED = 1
FLOATING = 2

# Columns of `properties`, one row for each property of the element.
COUNT_SIZE = 0  # bytes of the list's length, 0 for a single value
COUNT_KIND = 1
VALUE_SIZE = 2
OUT_COLUMN = 3  # column of `out_offsets` that takes the property's offset, -1 for none
N_COLUMNS = 4

# Fields of `state`.
N_ELEMENTS = 0
CONSUMED = 1  # bytes of the complete elements
NEEDED = 2  # bytes from CONSUMED that the next element is known to need, 0 if none was begun
BAD_COUNT = 3  # 1 when the length of a list of the next element is negative or not whole
STATE_SIZE = 4

_LARGEST_COUNT = 1 << 40


@helper
def _integer_of_float(bits, n_fraction, n_exponent):
    """Integer value of the bits of an IEEE number, UNREADABLE_INDEX when it is not one below 2**62."""
    negative = (bits >> (n_fraction + n_exponent)) & 1
    stored_exponent = (bits >> n_fraction) & ((1 << n_exponent) - 1)
    fraction = bits & ((np.int64(1) << n_fraction) - 1)
    if stored_exponent == 0:
        return np.int64(0) if fraction == 0 else np.int64(UNREADABLE_INDEX)
    exponent = stored_exponent - ((1 << (n_exponent - 1)) - 1)
    if exponent < 0 or exponent > 61:
        return np.int64(UNREADABLE_INDEX)
    mantissa = fraction | (np.int64(1) << n_fraction)
    shift = exponent - n_fraction
    if shift >= 0:
        value = mantissa << shift
    elif mantissa & ((np.int64(1) << -shift) - 1):
        return np.int64(UNREADABLE_INDEX)
    else:
        value = mantissa >> -shift
    return -value if negative else value


@helper
def _read_integer(data, pos, size, kind, big):
    """Integer stored at `pos`, of any type and byte order."""
    bits = np.int64(0)
    for k in range(size):
        byte = np.int64(data[pos + k]) if big else np.int64(data[pos + size - 1 - k])
        bits = (bits << 8) | byte
    if kind == FLOATING:
        return _integer_of_float(bits, 23, 8) if size == 4 else _integer_of_float(bits, 52, 11)
    if kind == SIGNED and size < 8 and bits >> (8 * size - 1):
        bits -= np.int64(1) << (8 * size)
    return bits


@kernel
def find_elements(data, end, properties, lists, big, state, out_offsets, out_sizes):
    """Walk over the elements in `data[:end]` as far as they are complete or the outputs have room.

    data         (n,) u1
    properties   (n_properties, 4) i8, columns as above
    lists        number of the property whose lengths go to `out_sizes`, -1 for none
    state        (STATE_SIZE,) i8, written
    out_offsets  (n_elements, n_columns) i8   offsets in `data` of the wanted properties
    out_sizes    (n_elements,) i8             lengths of the wanted list
    """
    begin = np.int64(0)
    element = 0
    state[:] = 0
    while element < out_sizes.shape[0]:
        pos = begin
        for p in range(properties.shape[0]):
            if properties[p, OUT_COLUMN] >= 0:
                out_offsets[element, properties[p, OUT_COLUMN]] = pos
            count = np.int64(1)
            if properties[p, COUNT_SIZE] > 0:
                if pos + properties[p, COUNT_SIZE] > end:
                    pos += properties[p, COUNT_SIZE]
                    break
                count = _read_integer(data, pos, properties[p, COUNT_SIZE], properties[p, COUNT_KIND], big)
                pos += properties[p, COUNT_SIZE]
                if count < 0 or count > _LARGEST_COUNT:
                    state[BAD_COUNT] = 1
                    break
                if p == lists:
                    out_sizes[element] = count
            pos += count * properties[p, VALUE_SIZE]
            if pos > end:
                break
        if pos > end or state[BAD_COUNT]:
            state[NEEDED] = pos - begin
            break
        element += 1
        begin = pos
    state[N_ELEMENTS] = element
    state[CONSUMED] = begin


@kernel
def read_indices(data, offsets, sizes, size, kind, big, out_corners):
    """Read the values of lists as integers, one list behind the other.

    data         (n,) u1
    offsets      (n_lists,) i8   where the values of each list begin
    sizes        (n_lists,) i8   how many there are
    size, kind   their type
    out_corners  (sum of sizes,) i8; UNREADABLE_INDEX for a value that is not whole
    """
    corner = 0
    for i in range(offsets.shape[0]):
        pos = offsets[i]
        for _ in range(sizes[i]):
            out_corners[corner] = _read_integer(data, pos, size, kind, big)
            pos += size
            corner += 1
