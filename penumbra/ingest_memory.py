"""2: triangles of an array or of meshes as blockers in memory, ordered as a store would have them."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from penumbra.arrays import BlockerChunk, Int64Array, TriangleBatch
from penumbra.blockers import MemoryBlockers
from penumbra.errors import SceneError
from penumbra.io.buckets import AreaBin, split_by_bin
from penumbra.options import IngestOptions
from penumbra.ordering import bucket_keys, choose_buckets, measure, order_chunk, sort_by_key
from penumbra.progress import Progress
from penumbra.scene import MeshRef

if TYPE_CHECKING:
    from penumbra.ingest_sources import SourceStream

# The vertices of a reader are a small part of what is held here: they never go to a scratch file.
_NO_LIMIT_BYTES = 1 << 40
_BATCH_TRIANGLES = 65536


def blockers_of_meshes(
    inputs: Sequence[MeshRef], options: IngestOptions, skip_bad: bool, progress: Progress
) -> MemoryBlockers:
    """Read meshes, and order their triangles."""
    # Imported here: an array needs no readers and no HDF5.
    from penumbra.ingest_sources import SourceStream

    stream = SourceStream(
        inputs,
        skip_bad=skip_bad,
        memory_bytes=_NO_LIMIT_BYTES,
        batch_triangles=_BATCH_TRIANGLES,
        scratch=None,
        progress=progress,
    )
    buckets, n_dropped = _ordered(_read_whole(stream), options, progress)
    return MemoryBlockers(buckets, stream.n_dropped + n_dropped, stream.n_bad)


def blockers_of_array(
    triangles: Any, ids: Int64Array | None, options: IngestOptions, progress: Progress
) -> MemoryBlockers:
    """Check an array of triangles (T, 3, 3), and order it. Raises SceneError."""
    return MemoryBlockers(*_ordered(_checked_triangles(triangles, ids), options, progress))


def _ordered(
    batch: TriangleBatch, options: IngestOptions, progress: Progress
) -> tuple[list[list[BlockerChunk]], int]:
    """Chunks of each bucket, and the number of zero areas, which are in none."""
    progress.stage("ingest: sorting", len(batch.ids), "triangles")
    histogram: dict[int, AreaBin] = {}
    areas, centres = measure(np.asarray(batch.vertices, np.float64))
    rows_of = dict(split_by_bin(areas, centres, options.sort, histogram))
    buckets = []
    for bucket in choose_buckets(histogram, options):
        rows = np.concatenate([rows_of.pop(number) for number in bucket.bins])
        ids = batch.ids[rows]
        keys = bucket_keys(centres[rows], ids, bucket.centre_bounds, options.sort)
        rows = rows[sort_by_key(keys, ids)]
        buckets.append(list(_chunks(batch, rows, options, progress)))
    return buckets, int((areas < 0).sum())


def _read_whole(stream: "SourceStream") -> TriangleBatch:
    """All triangles of a stream, vertices in float64."""
    batches = list(stream.batches())
    ids = np.concatenate([batch.ids for batch in batches])
    vertices = np.empty((len(ids), 3, 3))
    first = 0
    # Batches are freed as they are copied, so that float32 and float64 are never there both in full.
    batches.reverse()
    while batches:
        part = batches.pop().vertices
        vertices[first : first + len(part)] = part
        first += len(part)
    return TriangleBatch(vertices, ids)


def _checked_triangles(triangles: Any, ids: Int64Array | None) -> TriangleBatch:
    """An array of triangles as float64, with its ids; SceneError names the first bad row."""
    vertices = np.require(triangles, np.float64, ["C", "W"])
    if vertices.size == 0:
        vertices = vertices.reshape(0, 3, 3)
    if vertices.shape[1:] != (3, 3):
        raise SceneError(f"blockers have shape {vertices.shape}: give an array of shape (n, 3, 3)")
    finite = np.isfinite(vertices)
    if not finite.all():
        bad = np.flatnonzero(~finite.all(axis=(1, 2)))
        raise SceneError(f"blockers row {bad[0]} is not finite: {vertices[bad[0]].tolist()}")
    numbers = np.arange(len(vertices)) if ids is None else np.require(ids, np.int64, ["C", "W"])
    if numbers.shape != (len(vertices),):
        raise SceneError(f"ids have shape {numbers.shape}: give one for each of {len(vertices)} blockers")
    return TriangleBatch(vertices, numbers)


def _chunks(
    batch: TriangleBatch, rows: Int64Array, options: IngestOptions, progress: Progress
) -> Iterator[BlockerChunk]:
    """Chunks of one bucket, whose triangles are `rows` of the batch in curve order."""
    for first in range(0, len(rows), options.chunk_triangles):
        part = rows[first : first + options.chunk_triangles]
        vertices = np.take(batch.vertices, part, axis=0)
        yield order_chunk(vertices, np.take(batch.ids, part), options.sort)
        progress.advance(len(part))
