"""Vertices by number: in memory when they fit, else in a scratch file behind a bounded cache.

Mapped pages of a file count as resident memory, so the scratch file is read with `pread` instead.
"""

import os
import shutil
import tempfile
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from penumbra.arrays import Int64Array
from penumbra.errors import OutputError

# 1024 vertices are 12 to 24 KB: one request for a mesh whose neighbours lie close in the file,
# and not too much thrown away for one that has them scattered.
_PAGE_ROWS = 1024


class VertexTable:
    """Grow with `append`, then look up with `gather`; `memory_bytes` bounds the vertices kept in memory."""

    def __init__(
        self, dtype: type[np.floating], at_most: int, memory_bytes: int, scratch: Path | None = None
    ) -> None:
        """`dtype`: float32 or float64; `at_most`: no more vertices than this can come, if memory allows.

        The array is allocated for `at_most` vertices at once: memory that is never touched is never resident.
        """
        self.dtype = np.dtype(dtype)
        self.n_vertices = 0
        self.n_unusable = 0
        self._row_bytes = 3 * self.dtype.itemsize
        self._memory_bytes = memory_bytes
        self._scratch = scratch
        self._file: BinaryIO | None = None
        n_rows = max(1, min(at_most, memory_bytes // self._row_bytes))
        self._rows: NDArray[np.floating] = np.empty((n_rows, 3), self.dtype)

    def append(self, vertices: NDArray[np.floating]) -> None:
        """Add vertices, shape (n, 3), behind those already here. Raises OutputError when the disk is full."""
        n_after = self.n_vertices + len(vertices)
        self.n_unusable += int(len(vertices) - np.isfinite(vertices).all(axis=1).sum())
        if self._file is None and n_after > len(self._rows):
            self._move_to_disk()
        if self._file is None:
            self._rows[self.n_vertices : n_after] = vertices
        else:
            self._write(vertices.astype(self.dtype))
        self.n_vertices = n_after

    def _move_to_disk(self) -> None:
        try:
            # Without a name: it is gone when the process is, however that ends.
            self._file = tempfile.TemporaryFile(dir=self._scratch, buffering=0)  # noqa: SIM115
        except OSError as error:
            raise OutputError(
                f"{self._folder()}: cannot make a scratch file there ({error.strerror})."
            ) from error
        self._write(self._rows[: self.n_vertices])
        self._rows = np.empty((0, 3), self.dtype)

    def _write(self, vertices: NDArray[np.floating]) -> None:
        assert self._file is not None
        data = np.ascontiguousarray(vertices).reshape(-1).view(np.uint8).data
        try:
            while data:
                data = data[self._file.write(data) or 0 :]
        except OSError as error:
            free_bytes = shutil.disk_usage(self._folder()).free
            raise OutputError(
                f"{self._folder()}: cannot write {vertices.nbytes} bytes of vertices to a file there "
                f"({error.strerror}, {free_bytes} bytes free); "
                "name another scratch folder or allow more memory."
            ) from error

    def _folder(self) -> str:
        return str(self._scratch) if self._scratch else tempfile.gettempdir()

    def gather(self, indices: Int64Array) -> NDArray[np.floating]:
        """Vertices of `indices` (n,), all in range, as a new array (n, 3)."""
        if self._file is None:
            return np.take(self._rows, indices, axis=0, mode="clip")
        if len(self._rows) == 0:
            self._start_cache()
        page = indices // _PAGE_ROWS
        is_needed = np.zeros(len(self._slot_of_page), bool)
        is_needed[page] = True
        needed = np.flatnonzero(is_needed)
        out = np.empty((len(indices), 3), self.dtype)
        for first in range(0, len(needed), self._n_slots):
            pages = needed[first : first + self._n_slots]
            self._load(pages)
            rows = np.flatnonzero((page >= pages[0]) & (page <= pages[-1]))
            out[rows] = self._rows[self._slot_of_page[page[rows]] * _PAGE_ROWS + indices[rows] % _PAGE_ROWS]
        return out

    def _start_cache(self) -> None:
        """Spend the memory that the vertices had on pages of the scratch file."""
        n_pages = -(-self.n_vertices // _PAGE_ROWS)
        self._n_slots = max(1, min(n_pages, self._memory_bytes // (_PAGE_ROWS * self._row_bytes)))
        self._rows = np.empty((self._n_slots * _PAGE_ROWS, 3), self.dtype)
        self._slot_of_page = np.full(n_pages, -1, np.int64)
        self._page_of_slot = np.full(self._n_slots, -1, np.int64)
        self._last_use = np.zeros(self._n_slots, np.int64)
        self._clock = 0

    def _load(self, pages: Int64Array) -> None:
        """Bring `pages`, no more than there are slots, into the cache; the longest unused pages leave."""
        assert self._file is not None
        self._clock += 1
        slots = self._slot_of_page[pages]
        self._last_use[slots[slots >= 0]] = self._clock
        missing = pages[slots < 0]
        if len(missing) == 0:
            return
        victims = np.argsort(self._last_use, kind="stable")[: len(missing)]
        leaving = self._page_of_slot[victims]
        self._slot_of_page[leaving[leaving >= 0]] = -1
        self._slot_of_page[missing] = victims
        self._page_of_slot[victims] = missing
        self._last_use[victims] = self._clock
        cache = self._rows.data.cast("B")
        page_bytes = _PAGE_ROWS * self._row_bytes
        file_bytes = self.n_vertices * self._row_bytes
        for page, slot in zip(missing.tolist(), victims.tolist(), strict=True):
            n_bytes = min(page_bytes, file_bytes - page * page_bytes)
            _read_into(self._file.fileno(), cache[slot * page_bytes :][:n_bytes], page * page_bytes)

    def close(self) -> None:
        """Free the memory and the scratch file."""
        self._rows = np.empty((0, 3), self.dtype)
        if self._file is not None:
            self._file.close()


def _read_into(descriptor: int, target: memoryview, offset: int) -> None:
    """Fill `target` from a file at `offset`."""
    while target:
        n_bytes = os.preadv(descriptor, [target], offset)
        if n_bytes == 0:
            raise OutputError("The scratch file of the vertices became shorter while it was in use.")
        target = target[n_bytes:]
        offset += n_bytes
