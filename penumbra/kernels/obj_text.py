r"""Scan OBJ text, one buffer at a time: vertex statements in one pass, face statements in another.

The scanner keeps its place in `state` between calls and may stop inside a statement: a face of any
length passes through a small buffer. What it leaves unread is less than one word.
"""

import numpy as np

from penumbra.kernels._jit import helper, kernel
from penumbra.kernels.index_codes import UNREADABLE_INDEX, ZERO_INDEX
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

# Fields of `state`, int64. The caller sets all to 0 but LINE (1), and empties the outputs after each call.
MODE = 0  # what the scanner is inside of
LINE = 1  # line number at the place reached, from 1
PREVIOUS = 2  # the byte before the place reached
N_VALUES = 3  # coordinates or corners read of the statement at hand
STATEMENT_LINE = 4  # line on which the statement at hand began
N_VERTICES = 5  # vertex statements begun so far; what negative indices count back from
SHORT_LINE = 6  # line of the first vertex with fewer than two numbers, 0 if none
FULL = 7  # 1 when an output had no room: empty them and call again from the place reached
N_ROWS = 8  # finished vertices, or finished faces, in the outputs
N_CORNERS = 9  # corners in the output, those of an unfinished face included
N_UNDECIDED = 10  # rows of `out_undecided`
STATE_SIZE = 11

# Values of MODE; VERTEX and FACE are also what `wanted` says.
_LINE_START = 0
VERTEX = 1
FACE = 2
_OTHER = 3  # a statement that is skipped; `\` at the end of its line continues it
_COMMENT = 4

_INDEX_LIMIT = 1 << 40


@helper
def _statement_at(text, pos, end):
    """Mode for the statement whose keyword starts at `pos`; _LINE_START if the buffer ends too early."""
    byte = text[pos]
    if byte == 35:
        return _COMMENT
    if byte != 118 and byte != 102:
        return _OTHER
    if pos + 1 == end:
        return _LINE_START
    following = text[pos + 1]
    if is_blank(following) or is_newline(following) or following == 92:
        return VERTEX if byte == 118 else FACE
    return _OTHER


@helper
def _begin_statement(mode, wanted, state, out_vertices):
    """Enter a statement: skipped when it is not the wanted kind."""
    state[N_VALUES] = 0
    state[STATEMENT_LINE] = state[LINE]
    if mode == VERTEX:
        state[N_VERTICES] += 1
        if wanted == VERTEX:
            out_vertices[state[N_ROWS], :] = 0.0
    if mode in (VERTEX, FACE) and mode != wanted:
        mode = _OTHER
    state[MODE] = mode


@helper
def _end_statement(state, out_vertices, out_sizes, out_lines):
    """Leave a statement at the end of its line and count its vertex or face as finished."""
    row = state[N_ROWS]
    if state[MODE] == VERTEX:
        if state[N_VALUES] < 2:
            out_vertices[row, :] = np.nan
            if state[SHORT_LINE] == 0:
                state[SHORT_LINE] = state[STATEMENT_LINE]
        state[N_ROWS] = row + 1
    elif state[MODE] == FACE:
        out_sizes[row] = state[N_VALUES]
        out_lines[row] = state[STATEMENT_LINE]
        state[N_ROWS] = row + 1
    state[MODE] = _LINE_START


@helper
def _read_coordinate(text, pos, end, state, out_vertices, out_undecided):
    """Read one coordinate; returns the position behind it, or `pos` when the buffer ends too early."""
    kind, value, tail = read_number(text, pos, end)
    if kind == NEED_MORE:
        return pos
    row = state[N_ROWS]
    axis = state[N_VALUES]
    if kind == UNDECIDED:
        n_undecided = state[N_UNDECIDED]
        out_undecided[n_undecided, 0] = row
        out_undecided[n_undecided, 1] = axis
        out_undecided[n_undecided, 2] = pos
        out_undecided[n_undecided, 3] = tail
        state[N_UNDECIDED] = n_undecided + 1
    out_vertices[row, axis] = value if kind == NUMBER else np.nan
    state[N_VALUES] = axis + 1
    return tail


@helper
def _read_corner(text, begin, end, state, out_corners):
    """Read the vertex index of `v`, `v/vt`, `v//vn` or `v/vt/vn`; returns as `_read_coordinate` does."""
    pos = begin
    negative = text[pos] == 45
    if negative or text[pos] == 43:
        pos += 1
    value = np.int64(0)
    n_digits = 0
    while pos < end and 48 <= text[pos] <= 57:
        value = min(value * 10 + np.int64(text[pos]) - 48, np.int64(_INDEX_LIMIT))
        n_digits += 1
        pos += 1
    tail = word_end(text, pos, end)
    if tail == end:
        return begin
    if n_digits == 0 or (tail != pos and text[pos] != 47):
        corner = np.int64(UNREADABLE_INDEX)
    elif value == 0:
        corner = np.int64(ZERO_INDEX)
    elif negative:
        corner = state[N_VERTICES] - value
    else:
        corner = value - 1
    out_corners[state[N_CORNERS]] = corner
    state[N_CORNERS] += 1
    state[N_VALUES] += 1
    return tail


@helper
def _has_room(wanted, state, out_vertices, out_undecided, out_corners, out_sizes):
    """Whether one more statement can begin, or one more corner be read."""
    if wanted == VERTEX:
        return state[N_ROWS] < out_vertices.shape[0] and state[N_UNDECIDED] + 3 <= out_undecided.shape[0]
    return state[N_ROWS] < out_sizes.shape[0] and state[N_CORNERS] < out_corners.shape[0]


@kernel
def scan_statements(
    text, begin, end, wanted, state, out_vertices, out_undecided, out_corners, out_sizes, out_lines
):
    r"""Scan `text[begin:end]` and return the position reached: all before it is dealt with.

    text           (n,) u1        the text must end with two newlines, which close every statement
    wanted         VERTEX or FACE; the outputs of the other kind are not touched
    state          (STATE_SIZE,) i8
    out_vertices   (n, 3) f8      coordinates, 0 where a vertex has only two, NaN where one is no number
    out_undecided  (n, 4) i8      (row, axis, begin, end): spans of `text` left to the caller; n >= 3
    out_corners    (n,) i8        vertex indices from 0, or the codes of `index_codes`
    out_sizes      (n,) i8        corners of each finished face
    out_lines      (n,) i8        line on which each finished face began
    """
    pos = begin
    state[FULL] = 0
    while pos < end:
        byte = text[pos]
        mode = state[MODE]
        if is_newline(byte):
            previous = text[pos - 1] if pos > 0 else np.uint8(state[PREVIOUS])
            if not (byte == 10 and previous == 13):  # the second half of CR LF says nothing new
                state[LINE] += 1
                if previous != 92 or mode == _COMMENT:
                    _end_statement(state, out_vertices, out_sizes, out_lines)
            pos += 1
        elif mode in (_OTHER, _COMMENT):
            pos = next_newline(text, pos, end)
        elif is_blank(byte):
            pos += 1
        elif byte == 92 and (pos + 1 == end or is_newline(text[pos + 1])):
            if pos + 1 == end:
                break
            pos += 1
        elif byte == 35 and mode != _LINE_START:
            _end_statement(state, out_vertices, out_sizes, out_lines)
            state[MODE] = _COMMENT
        elif mode == VERTEX and state[N_VALUES] == 3:
            # w, or the first colour: what follows is not needed, so it is neither read nor checked.
            _end_statement(state, out_vertices, out_sizes, out_lines)
            state[MODE] = _OTHER
        elif not _has_room(wanted, state, out_vertices, out_undecided, out_corners, out_sizes):
            state[FULL] = 1
            break
        elif mode == _LINE_START:
            found = _statement_at(text, pos, end)
            if found == _LINE_START:
                break
            _begin_statement(found, wanted, state, out_vertices)
            pos += 1
        else:
            if mode == VERTEX:
                tail = _read_coordinate(text, pos, end, state, out_vertices, out_undecided)
            else:
                tail = _read_corner(text, pos, end, state, out_corners)
            if tail == pos:
                break
            pos = tail
    if pos > 0:
        state[PREVIOUS] = text[pos - 1]
    return pos
