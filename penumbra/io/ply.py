"""PLY, streaming: ascii and binary of both byte orders, faces and strips, in any order of the elements."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from penumbra.errors import MeshError
from penumbra.io.faces import FacePage
from penumbra.io.mesh_reader import MeshReader
from penumbra.io.ply_binary import BinaryPly
from penumbra.io.ply_header import Header, Truncated, least_bytes, read_header, triangles_by_size
from penumbra.io.vertex_table import VertexTable

if TYPE_CHECKING:
    from penumbra.io.ply_text import TextPly


class PlyReader(MeshReader):
    """Triangles of a PLY file; coordinates are float32 when its header says so, else float64."""

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
        self._header = read_header(path)
        self._memory_bytes = memory_bytes
        self._scratch = scratch
        self.exact_float32 = self._header.has_float32_vertices
        if not skip_bad:
            _check_size(path, self._header, size_bytes)
            self.n_triangles = triangles_by_size(self._header, size_bytes)
        if self._header.byte_order:
            self._body: BinaryPly | TextPly = BinaryPly(path, self._header, size_bytes, block_bytes)
        else:
            from penumbra.io import ply_text

            self._body = ply_text.TextPly(path, self._header, block_bytes)

    def _place(self, where: int) -> str:
        return self._body.place(where)

    def _read_vertices(self) -> VertexTable:
        element = self._header.elements[self._header.vertex_position]
        dtype = np.float32 if self.exact_float32 else np.float64
        # A header may promise anything; no file holds more vertices than it has bytes.
        at_most = min(element.count, self.size_bytes)
        table = VertexTable(dtype, at_most, self._memory_bytes, self._scratch)
        # Signalling NaNs, and ascii numbers that no float32 holds, only matter where a face uses them.
        with np.errstate(invalid="ignore", over="ignore"):
            for vertices in self._body.vertices():
                table.append(vertices)
        return table

    def _face_pages(self) -> Iterator[FacePage]:
        for position in self._header.face_positions:
            is_strip = self._header.elements[position].name == "tristrips"
            pages = self._body.strips(position) if is_strip else self._body.faces(position)
            try:
                for page in pages:
                    self.bytes_done = self._body.bytes_done
                    yield page
            except Truncated as error:
                if not self.skip_bad:
                    raise
                self.n_bad += error.n_missing
                self.n_bad_faces += error.n_missing
                return

    def close(self) -> None:
        """Free the vertices and close the file."""
        super().close()
        self._body.close()


def _check_size(path: Path, header: Header, size_bytes: int) -> None:
    """Refuse a header that promises more than the file can hold, before anything is allocated for it."""
    promised = sum(least_bytes(e, is_text=not header.byte_order) for e in header.elements)
    there = size_bytes - header.data_offset
    # The last ascii value needs no blank behind it.
    if promised > there + (0 if header.byte_order else 1):
        counts = ", ".join(f"{e.count} {e.name}" for e in header.elements)
        raise MeshError(
            f"{path}: its header promises {counts}, at least {promised} bytes, but only {there} bytes "
            "follow it; the file is cut off or its header is wrong."
        )
