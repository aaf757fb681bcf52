"""What every mesh reader offers: triangles in batches, in file order, in bounded memory."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from penumbra.arrays import TriangleBatch
from penumbra.errors import MeshError, PenumbraError
from penumbra.io.faces import (
    FacePage,
    count_triangles,
    describe_fault,
    drop_faces,
    fan,
    find_bad_faces,
    no_faces,
    triangle_ids,
)
from penumbra.io.vertex_table import VertexTable


class MeshReader(ABC):
    """A mesh file that yields its triangles as often as asked; use it as a context manager.

    `exact_float32` says that the header promises float32 coordinates. `n_triangles` is None until it is
    known. `n_bad` and `n_bad_faces` count the triangles, and the faces, that `skip_bad` dropped in the
    current or last run of `batches`; `bytes_done` says how far into the file that run is.
    """

    first_index = 0

    def __init__(self, path: Path, size_bytes: int, skip_bad: bool) -> None:
        self.path = path
        self.size_bytes = size_bytes
        self.skip_bad = skip_bad
        self.exact_float32 = False
        self.n_triangles: int | None = None
        self.n_bad = 0
        self.n_bad_faces = 0
        self.bytes_done = 0
        self._table: VertexTable | None = None

    @abstractmethod
    def _read_vertices(self) -> VertexTable:
        """Read all vertices."""

    @abstractmethod
    def _face_pages(self) -> Iterator[FacePage]:
        """Yield the faces in file order; pages are not empty."""

    @abstractmethod
    def _place(self, where: int) -> str:
        """Say where in the file a face is, as the start of a sentence."""

    def batches(self, max_triangles: int = 65536) -> Iterator[TriangleBatch]:
        """Yield all triangles in file order, at most `max_triangles` at a time.

        Vertices are float32 if `exact_float32`, else float64. Ids count every triangle of the file after
        fan triangulation, those dropped under `skip_bad` too. Degenerate triangles are yielded.
        Raises MeshError for what is wrong in the file.
        """
        try:
            yield from self._batches(max_triangles)
        except PenumbraError:
            raise
        except OSError as error:
            raise MeshError(f"{self.path}: cannot be read ({error.strerror}).") from error

    def _batches(self, max_triangles: int) -> Iterator[TriangleBatch]:
        self.n_bad = self.n_bad_faces = 0
        if self._table is None:
            self._table = self._read_vertices()
        next_id = 0
        n_faces = 0
        n_yielded = 0
        for page in self._face_pages():
            counts = count_triangles(page.sizes)
            batch = self._triangles(page, self._table, next_id)
            for first in range(0, len(batch.ids), max_triangles):
                part = slice(first, first + max_triangles)
                yield TriangleBatch(batch.vertices[part], batch.ids[part])
            next_id += int(counts.sum())
            n_faces += len(counts)
            n_yielded += len(batch.ids)
        self.n_triangles = next_id
        self.bytes_done = self.size_bytes
        if n_yielded == 0:
            raise MeshError(f"{self.path}: {self._nothing_to_read(n_faces)}.")

    def _triangles(self, page: FacePage, table: VertexTable, next_id: int) -> TriangleBatch:
        """Triangles of the good faces of one page."""
        counts = count_triangles(page.sizes)
        bad = find_bad_faces(page, table)
        ids = triangle_ids(counts, bad, next_id)
        if bad is not None:
            if not self.skip_bad:
                self._refuse(page, int(np.flatnonzero(bad)[0]), table)
            self.n_bad += int(counts[bad].sum())
            self.n_bad_faces += int(bad.sum())
            page = drop_faces(page, bad)
        return TriangleBatch(fan(page, table), ids)

    def _refuse(self, page: FacePage, face: int, table: VertexTable) -> None:
        end = int(page.sizes[: face + 1].sum())
        corners = page.corners[end - int(page.sizes[face]) : end]
        fault = describe_fault(corners, table, self.first_index)
        raise MeshError(f"{self.path}, {self._place(int(page.where[face]))}: {fault}.")

    def _nothing_to_read(self, n_faces: int) -> str:
        n_vertices = self._table.n_vertices if self._table else 0
        if n_faces:
            return f"not one of its {n_faces} faces can be used"
        return no_faces(n_vertices)

    def close(self) -> None:
        """Free the vertices and close the file; the reader cannot be used afterwards."""
        if self._table is not None:
            self._table.close()
            self._table = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
