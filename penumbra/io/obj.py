"""Wavefront OBJ, streaming: one pass over the text for the vertices, one for the faces.

Faces may stand before or after their vertices; only negative indices count back from where they stand.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from penumbra.arrays import Int64Array
from penumbra.errors import MeshError
from penumbra.io.faces import PAGE_FACES, FaceBuffer, FacePage
from penumbra.io.mesh_reader import MeshReader
from penumbra.io.text_blocks import TextBlocks, read_undecided
from penumbra.io.vertex_table import VertexTable
from penumbra.kernels import obj_text

_NO_FLOATS = np.empty((0, 3))
_NO_ROWS = np.empty((0, 4), np.int64)
_NO_INTS = np.empty(0, np.int64)
_UNDECIDED_ROWS = 4096


class ObjReader(MeshReader):
    """Triangles of an OBJ file; coordinates are float64, each the nearest to the text."""

    first_index = 1

    def __init__(
        self,
        path: Path,
        size_bytes: int,
        skip_bad: bool,
        memory_bytes: int,
        scratch: Path | None,
        block_bytes: int,
    ) -> None:
        super().__init__(path, size_bytes, skip_bad)
        self._memory_bytes = memory_bytes
        self._scratch = scratch
        self._block_bytes = block_bytes

    def _place(self, where: int) -> str:
        return f"line {where}"

    def _read_vertices(self) -> VertexTable:
        # The shortest vertex statement is "v" and a newline.
        table = VertexTable(np.float64, self.size_bytes // 2 + 1, self._memory_bytes, self._scratch)
        rows = np.empty((PAGE_FACES, 3))
        undecided = np.empty((_UNDECIDED_ROWS, 4), np.int64)
        state = _new_state()
        source = TextBlocks(self.path, block_bytes=self._block_bytes)
        try:
            pos = 0
            while source.refill(pos):
                pos = 0
                full = True
                while full:
                    pos = obj_text.scan_statements(
                        source.buffer, pos, source.end, obj_text.VERTEX, state,
                        rows, undecided, _NO_INTS, _NO_INTS, _NO_INTS,
                    )  # fmt: skip
                    read_undecided(source.buffer, undecided[: state[obj_text.N_UNDECIDED]], rows)
                    n_rows = int(state[obj_text.N_ROWS])
                    table.append(rows[:n_rows])
                    rows[0] = rows[min(n_rows, len(rows) - 1)]  # the vertex at hand, if one is unfinished
                    state[obj_text.N_ROWS] = state[obj_text.N_UNDECIDED] = 0
                    full = bool(state[obj_text.FULL])
                self._check_vertices(state)
        finally:
            source.close()
        return table

    def _check_vertices(self, state: Int64Array) -> None:
        line = int(state[obj_text.SHORT_LINE])
        if line and not self.skip_bad:
            raise MeshError(f"{self.path}, line {line}: a vertex has fewer than two numbers.")

    def _face_pages(self) -> Iterator[FacePage]:
        buffer = FaceBuffer(self.path)
        state = _new_state()
        source = TextBlocks(self.path, block_bytes=self._block_bytes)
        try:
            pos = 0
            while source.refill(pos):
                pos = 0
                full = True
                while full:
                    pos = obj_text.scan_statements(
                        source.buffer, pos, source.end, obj_text.FACE, state,
                        _NO_FLOATS, _NO_ROWS, buffer.corners, buffer.sizes, buffer.lines,
                    )  # fmt: skip
                    full = bool(state[obj_text.FULL])
                    self.bytes_done = source.bytes_done
                    n_rows, n_corners = int(state[obj_text.N_ROWS]), int(state[obj_text.N_CORNERS])
                    page, n_left = buffer.take(n_rows, n_corners, int(state[obj_text.STATEMENT_LINE]))
                    if page:
                        yield page
                    state[obj_text.N_ROWS] = 0
                    state[obj_text.N_CORNERS] = n_left
        finally:
            source.close()


def _new_state() -> Int64Array:
    state = np.zeros(obj_text.STATE_SIZE, np.int64)
    state[obj_text.LINE] = 1
    return state
