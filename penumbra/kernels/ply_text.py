"""Scan the data of ascii PLY files: a stream of words, element by element, one buffer at a time."""

import numpy as np

from penumbra.kernels._jit import helper, kernel
from penumbra.kernels.index_codes import UNREADABLE_INDEX
from penumbra.kernels.text_numbers import (
    NEED_MORE,
    NUMBER,
    UNDECIDED,
    is_blank,
    is_newline,
    next_newline,
    read_number,
    word_end,
)

# Fields of `state`, int64. All but LINE and N_LEFT start as 0; the caller empties the outputs.
LINE = 0  # line number at the place reached
PREVIOUS = 1  # the byte before the place reached
PROPERTY = 2  # number of the property that comes next
IN_LIST = 3  # 1 between the length of a list and its last value
LIST_LEFT = 4  # values of the list still to come
LIST_SIZE = 5  # length of the index list at hand
REST_OF_LINE = 6  # 1 behind an element's last value: what else stands on its line is ignored
ELEMENT_LINE = 7  # line on which the element at hand began
N_LEFT = 8  # elements still to come
FULL = 9  # 1 when an output had no room: empty them and call again from the place reached
BAD_COUNT = 10  # 1 when the length of a list is no whole number >= 0; the scan stops there
N_ROWS = 11  # finished elements in the outputs
N_CORNERS = 12
N_UNDECIDED = 13
STATE_SIZE = 14

# Second column of `roles`: 0, 1, 2 for a coordinate, or one of these.
INDICES = 3
SKIPPED = -1

_LARGEST_COUNT = 2.0**40


@helper
def _read_count(text, pos, end, role, state):
    """Read the length of a list; returns the position behind it, or `pos` when the buffer ends too early."""
    kind, value, tail = read_number(text, pos, end)
    if kind == NEED_MORE:
        return pos
    if kind != NUMBER or not 0.0 <= value <= _LARGEST_COUNT or value != np.floor(value):
        state[BAD_COUNT] = 1
        return pos
    state[IN_LIST] = 1
    state[LIST_LEFT] = np.int64(value)
    if role == INDICES:
        state[LIST_SIZE] = np.int64(value)
    return tail


@helper
def _read_value(text, pos, end, role, state, out_values, out_undecided, out_corners):
    """Read one value into its output; returns as `_read_count` does."""
    if role == SKIPPED:
        tail = word_end(text, pos, end)
        return pos if tail == end else tail
    kind, value, tail = read_number(text, pos, end)
    if kind == NEED_MORE:
        return pos
    if role == INDICES:
        whole = kind == NUMBER and value == np.floor(value) and abs(value) < _LARGEST_COUNT
        out_corners[state[N_CORNERS]] = np.int64(value) if whole else np.int64(UNREADABLE_INDEX)
        state[N_CORNERS] += 1
        return tail
    row = state[N_ROWS]
    if kind == UNDECIDED:
        n_undecided = state[N_UNDECIDED]
        out_undecided[n_undecided, 0] = row
        out_undecided[n_undecided, 1] = role
        out_undecided[n_undecided, 2] = pos
        out_undecided[n_undecided, 3] = tail
        state[N_UNDECIDED] = n_undecided + 1
    out_values[row, role] = value if kind == NUMBER else np.nan
    return tail


@helper
def _advance(roles, state, out_sizes, out_lines):
    """Step to the next property, or finish the element, unless the list at hand goes on."""
    if state[IN_LIST] == 1 and state[LIST_LEFT] > 0:
        return
    state[IN_LIST] = 0
    state[PROPERTY] += 1
    if state[PROPERTY] == roles.shape[0]:
        row = state[N_ROWS]
        out_sizes[row] = state[LIST_SIZE]
        out_lines[row] = state[ELEMENT_LINE]
        state[N_ROWS] = row + 1
        state[N_LEFT] -= 1
        state[PROPERTY] = 0
        state[REST_OF_LINE] = 1


@kernel
def scan_elements(
    text, begin, end, roles, state, out_values, out_undecided, out_corners, out_sizes, out_lines
):
    """Scan `text[begin:end]` for elements and return the position reached.

    text           (n,) u1            the text must end with a newline
    roles          (n_properties, 2)  i8: 1 for a list, and what the property is for
    state          (STATE_SIZE,) i8
    out_values     (n, 3) f8          coordinates
    out_undecided  (n, 4) i8          (row, column, begin, end): spans of `text` left to the caller
    out_corners    (n,) i8            vertex indices, those of an unfinished element included
    out_sizes      (n,) i8            how many of them each finished element has
    out_lines      (n,) i8            line on which each finished element began
    """
    pos = begin
    state[FULL] = 0
    while pos < end and state[N_LEFT] > 0:
        byte = text[pos]
        if is_newline(byte):
            previous = text[pos - 1] if pos > 0 else np.uint8(state[PREVIOUS])
            if not (byte == 10 and previous == 13):
                state[LINE] += 1
                state[REST_OF_LINE] = 0
            pos += 1
        elif state[REST_OF_LINE] == 1:
            pos = next_newline(text, pos, end)
        elif is_blank(byte) or byte == 92:  # a backslash means nothing here
            pos += 1
        elif (
            state[N_ROWS] == out_sizes.shape[0]
            or state[N_CORNERS] == out_corners.shape[0]
            or state[N_UNDECIDED] == out_undecided.shape[0]
        ):
            state[FULL] = 1
            break
        else:
            number = state[PROPERTY]
            if number == 0 and state[IN_LIST] == 0:
                state[ELEMENT_LINE] = state[LINE]
            role = roles[number, 1]
            if roles[number, 0] == 1 and state[IN_LIST] == 0:
                tail = _read_count(text, pos, end, role, state)
            else:
                tail = _read_value(text, pos, end, role, state, out_values, out_undecided, out_corners)
                state[LIST_LEFT] -= 1 if tail > pos and state[IN_LIST] == 1 else 0
            if tail == pos:
                break
            _advance(roles, state, out_sizes, out_lines)
            pos = tail
    if pos > 0:
        state[PREVIOUS] = text[pos - 1]
    return pos
