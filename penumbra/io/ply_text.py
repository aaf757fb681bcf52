"""The data part of an ascii PLY file: vertices, faces and strips, scanned block by block."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from penumbra.arrays import Float64Array, Int64Array
from penumbra.errors import MeshError
from penumbra.io.faces import PAGE_FACES, FaceBuffer, FacePage
from penumbra.io.ply_header import Element, Header, Truncated, index_list
from penumbra.io.ply_strips import StripStream
from penumbra.io.text_blocks import N_CLOSING_LINES, TextBlocks, read_undecided
from penumbra.kernels import ply_text

_UNDECIDED_ROWS = 4096


class _Outputs:
    """What the scanner fills."""

    def __init__(self, path: Path) -> None:
        self.values: Float64Array = np.empty((PAGE_FACES, 3))
        self.undecided: Int64Array = np.empty((_UNDECIDED_ROWS, 4), np.int64)
        self.faces = FaceBuffer(path)


class _Start(NamedTuple):
    """Where an element begins: the byte, and the scanner's state there."""

    offset: int
    state: Int64Array


class TextPly:
    """The elements of an ascii PLY file; where an element begins is found when it is asked for.

    Words are read as a stream, so that an element may take several lines; what stands on a line
    behind the last value of an element is ignored.
    """

    def __init__(self, path: Path, header: Header, block_bytes: int) -> None:
        self.bytes_done = 0
        self._path = path
        self._header = header
        self._block_bytes = block_bytes
        state = np.zeros(ply_text.STATE_SIZE, np.int64)
        state[ply_text.LINE] = header.n_lines + 1
        self._starts = [_Start(header.data_offset, state)]

    def place(self, where: int) -> str:
        """Name a face by its line."""
        return f"line {where}"

    def close(self) -> None:
        """Nothing is held open."""

    def vertices(self) -> Iterator[NDArray[np.floating]]:
        """Coordinates of the vertices, shape (n, 3), in the order of the file."""
        position = self._header.vertex_position
        element = self._header.elements[position]
        wanted = {element.position_of(axis): column for column, axis in enumerate("xyz")}
        dtype = np.float32 if self._header.has_float32_vertices else np.float64
        out = _Outputs(self._path)
        for state in self._scan(position, wanted, out):
            n_rows = int(state[ply_text.N_ROWS])
            yield out.values[:n_rows].astype(dtype)
            # The vertex at hand, if one is unfinished.
            out.values[0] = out.values[min(n_rows, PAGE_FACES - 1)]

    def faces(self, position: int) -> Iterator[FacePage]:
        """Faces of the 'face' element with this number."""
        out = _Outputs(self._path)
        wanted = {index_list(self._header.elements[position]): ply_text.INDICES}
        for state in self._scan(position, wanted, out):
            n_rows, n_corners = int(state[ply_text.N_ROWS]), int(state[ply_text.N_CORNERS])
            page, n_left = out.faces.take(n_rows, n_corners, int(state[ply_text.ELEMENT_LINE]))
            if page:
                yield page
            state[ply_text.N_CORNERS] = n_left

    def strips(self, position: int) -> Iterator[FacePage]:
        """Triangles of the 'tristrips' element with this number; its lists may be as long as the file."""
        out = _Outputs(self._path)
        wanted = {index_list(self._header.elements[position]): ply_text.INDICES}
        stream = StripStream()
        n_taken = 0  # entries of the list at hand that earlier rounds took
        for state in self._scan(position, wanted, out):
            n_lists = int(state[ply_text.N_ROWS])
            begin = 0
            sizes, lines = out.faces.sizes[:n_lists].tolist(), out.faces.lines[:n_lists].tolist()
            for size, line in zip(sizes, lines, strict=True):
                end = begin + size - n_taken
                if page := stream.feed(out.faces.corners[begin:end], line):
                    yield page
                stream.end_list()
                begin, n_taken = end, 0
            end = int(state[ply_text.N_CORNERS])
            if page := stream.feed(out.faces.corners[begin:end], int(state[ply_text.ELEMENT_LINE])):
                yield page
            n_taken += end - begin
            state[ply_text.N_CORNERS] = 0

    def _start_of(self, position: int) -> _Start:
        """Where the element with this number begins; those before it are scanned over."""
        while len(self._starts) <= position:
            for _ in self._scan(len(self._starts) - 1, {}, _Outputs(self._path)):
                pass
        return self._starts[position]

    def _scan(self, position: int, wanted: dict[int, int], out: _Outputs) -> Iterator[Int64Array]:
        """Scan one element, and yield the state whenever there are outputs to take.

        `wanted`: number of a property -> what it is for. Whoever takes the outputs keeps those of an
        unfinished element, at the front, and sets N_CORNERS to how many these are.
        """
        element = self._header.elements[position]
        start = self._start_of(position)
        state = start.state.copy()
        state[ply_text.N_LEFT] = element.count if element.properties else 0
        roles = np.empty((len(element.properties), 2), np.int64)
        for number, stored in enumerate(element.properties):
            roles[number] = stored.count_type is not None, wanted.get(number, ply_text.SKIPPED)
        source = TextBlocks(self._path, start.offset, self._block_bytes)
        try:
            pos = 0
            while state[ply_text.N_LEFT]:
                if not state[ply_text.FULL]:
                    if not source.refill(pos):
                        raise self._truncated(element, state)
                    pos = 0
                pos = ply_text.scan_elements(
                    source.buffer, pos, source.end, roles, state,
                    out.values, out.undecided, out.faces.corners, out.faces.sizes, out.faces.lines,
                )  # fmt: skip
                if state[ply_text.BAD_COUNT]:
                    raise MeshError(
                        f"{self._path}, line {state[ply_text.LINE]}: the length of a list "
                        f"of a '{element.name}' element is not a whole number >= 0."
                    )
                read_undecided(source.buffer, out.undecided[: state[ply_text.N_UNDECIDED]], out.values)
                self.bytes_done = source.bytes_done
                yield state
                state[ply_text.N_ROWS] = state[ply_text.N_UNDECIDED] = 0
            if len(self._starts) == position + 1:
                self._starts.append(_Start(source.offset_of(pos), state))
        finally:
            source.close()

    def _truncated(self, element: Element, state: Int64Array) -> Truncated:
        n_left = int(state[ply_text.N_LEFT])
        is_inside = state[ply_text.PROPERTY] or state[ply_text.IN_LIST]
        line = state[ply_text.ELEMENT_LINE] if is_inside else state[ply_text.LINE] - N_CLOSING_LINES
        return Truncated(
            f"{self._path}, line {line}: the file ends after {element.count - n_left} of the "
            f"{element.count} '{element.name}' elements that its header promises.",
            n_left,
        )
