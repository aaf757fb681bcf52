"""2: what ingest reads: mesh files and stores as one stream of triangles in world space."""

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from penumbra.arrays import Float64Array, TriangleBatch
from penumbra.errors import BlockerStoreError, MeshError
from penumbra.io.blocker_store import Source, open_store
from penumbra.io.meshes import open_mesh
from penumbra.progress import Progress
from penumbra.scene import MeshRef

_HASH_BYTES = 1 << 20


class SourceStream:
    """All triangles of several inputs, ids running on from one input to the next.

    Once `batches` has ended, `sources` describes the inputs, and the counts are those of all of them.
    """

    def __init__(
        self,
        meshes: Sequence[MeshRef],
        *,
        skip_bad: bool,
        memory_bytes: int,
        batch_triangles: int,
        scratch: Path | None,
        progress: Progress,
    ) -> None:
        self._meshes = meshes
        self._skip_bad = skip_bad
        self._memory_bytes = memory_bytes
        self._batch_triangles = batch_triangles
        self._scratch = scratch
        self._progress = progress
        self.sources: list[Source] = []
        self.n_ids = 0
        self.n_bad = 0
        self.n_dropped = 0
        """Zero-area triangles that the stores among the inputs had dropped."""

    def batches(self) -> Iterator[TriangleBatch]:
        """Yield the triangles in world space, float32 or float64, with their ids. Raises MeshError."""
        self._progress.stage("ingest: reading", sum(mesh.path.stat().st_size for mesh in self._meshes), "B")
        for mesh in self._meshes:
            before = mesh.path.stat()
            first_id = self.n_ids
            n_bad = self.n_bad
            yield from self._store_batches(mesh) if mesh.is_store else self._mesh_batches(mesh)
            sha256 = _sha256(mesh.path)
            after = mesh.path.stat()
            if (after.st_size, after.st_mtime_ns) != (before.st_size, before.st_mtime_ns):
                raise MeshError(f"{mesh.path}: the file changed while it was read; run the ingest again")
            self.sources.append(
                Source(
                    path=str(mesh.path),
                    size_bytes=before.st_size,
                    mtime_ns=before.st_mtime_ns,
                    sha256=sha256,
                    up=mesh.up,
                    transform=mesh.transform,
                    first_id=first_id,
                    n_ids=self.n_ids - first_id,
                    n_bad=self.n_bad - n_bad,
                )
            )

    def _mesh_batches(self, mesh: MeshRef) -> Iterator[TriangleBatch]:
        matrix = mesh.matrix()
        with open_mesh(
            mesh.path, skip_bad=self._skip_bad, memory_bytes=self._memory_bytes, scratch=self._scratch
        ) as reader:
            bytes_done = 0
            for vertices, ids in reader.batches(self._batch_triangles):
                self._progress.advance(reader.bytes_done - bytes_done)
                bytes_done = reader.bytes_done
                if matrix is not None:
                    vertices = _moved(vertices, matrix)
                    _check_finite(vertices, ids, mesh.path)
                yield TriangleBatch(vertices, ids + self.n_ids)
            self._progress.advance(reader.bytes_done - bytes_done)
            assert reader.n_triangles is not None
            self.n_ids += reader.n_triangles
            self.n_bad += reader.n_bad

    def _store_batches(self, mesh: MeshRef) -> Iterator[TriangleBatch]:
        with open_store(mesh.path) as store:
            for i, info in enumerate(store.chunks):
                chunk = store.read(i)
                if chunk.ids.min() < 0 or chunk.ids.max() >= store.n_ids:
                    raise BlockerStoreError(
                        f"{mesh.path}: a triangle id is out of range; ingest the mesh again"
                    )
                for first in range(0, info.count, self._batch_triangles):
                    part = slice(first, first + self._batch_triangles)
                    yield TriangleBatch(chunk.vertices[part], chunk.ids[part] + self.n_ids)
                self._progress.advance(info.n_bytes)
            self.n_ids += store.n_ids
            self.n_bad += store.n_bad
            self.n_dropped += store.n_dropped


def _moved(vertices: NDArray[np.floating], matrix: Float64Array) -> Float64Array:
    """Triangles (n, 3, 3) under an affine map (4, 4), in float64.

    Written out instead of `@`, whose rounding depends on the number of rows.
    """
    x, y, z = np.moveaxis(vertices.astype(np.float64), -1, 0)
    moved = np.empty(vertices.shape)
    with np.errstate(over="ignore", invalid="ignore"):
        for axis in range(3):
            a, b, c, d = matrix[axis]
            moved[..., axis] = x * a + y * b + z * c + d
    return moved


def _check_finite(vertices: Float64Array, ids: NDArray[np.int64], path: Path) -> None:
    finite = np.isfinite(vertices)
    if not finite.all():
        bad = np.flatnonzero(~finite.all(axis=(1, 2)))
        raise MeshError(f"{path}: its transform moves triangle {ids[bad[0]]} beyond the range of float64")


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    buffer = memoryview(bytearray(_HASH_BYTES))
    with open(path, "rb", buffering=0) as file:
        while n_read := file.readinto(buffer):
            digest.update(buffer[:n_read])
    return digest.hexdigest()
