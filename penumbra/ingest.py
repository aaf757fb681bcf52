"""2: meshes to blockers in casting order, in a store on disk or in memory.

One pass over the meshes puts the triangles into bins by area; bins are joined to buckets from large
triangles to small (Laine and Aila 2005, section 3.3, "coarse blocker sorting"); each bucket is sorted
along a space-filling curve and cut into chunks, and each chunk is put in surface-area order. At no time
is more than the memory limit needed.
"""

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from penumbra.arrays import BlockerChunk, Float64Array, Int64Array, TriangleBatch, UInt64Array
from penumbra.blockers import MemoryBlockers
from penumbra.errors import OutputError, SceneError
from penumbra.ingest_plan import MemoryPlan, check_disk, estimate_triangles, plan_memory
from penumbra.ingest_sources import SourceStream, checked_inputs, names_meshes
from penumbra.io.atomic import atomic_path, check_output, remove_dead_temporaries
from penumbra.io.blocker_store import BlockerStore, BucketRange, StoreCounts, StoreWriter, open_store
from penumbra.io.buckets import AreaBin, Bucket, merge_bins, split_by_bin
from penumbra.io.runs import Records, Scratch, remove_dead_scratch, scratch_folder, sort_files
from penumbra.memory import call_limit_bytes, resident_bytes
from penumbra.options import IngestOptions, parse_size
from penumbra.ordering import curve_keys, measure, order_chunk, sort_by_key
from penumbra.progress import NullProgress, Progress
from penumbra.scene import MeshRef

PathLike = str | Path

# Reading into memory: vertices are a small part of it, and never go to a scratch file.
_NO_LIMIT_BYTES = 1 << 40
_BATCH_TRIANGLES = 65536


def ingest(
    meshes: Sequence[PathLike | MeshRef] | PathLike | MeshRef,
    output: PathLike,
    *,
    memory: int | str | None = None,
    overwrite: bool = False,
    skip_bad: bool = False,
    options: IngestOptions | None = None,
    scratch: PathLike | None = None,
    progress: Progress | None = None,
    process_limit: bool = False,
) -> BlockerStore:
    """Sort meshes of any size into a blocker store, and open it.

    Parameters
    ----------
    meshes
        Mesh files, or stores (.h5), in the order that triangle ids count them.
    output
        The store; it appears when it is whole.
    memory
        Bytes that this call may add to the resident memory, or a size such as "1GiB"; None is half of the
        free memory. With `process_limit` the limit is of the whole process. It changes no byte of `/buckets`.
    overwrite
        Replace `output` if it is there.
    skip_bad
        Drop and count faces that cannot be used.
    scratch
        Folder for temporary files; beside the output by default.

    Raises
    ------
    MeshError, BlockerStoreError
        An input is missing or cannot be read.
    OutputError
        The output is there already, or cannot be written, or the disk is too small.
    MemoryLimitError
        The limit is too low; the message has one that would do.
    """
    options = options or IngestOptions()
    progress = progress or NullProgress()
    # Written through a link, as atomic_path does: scratch and temporaries stand beside the file itself.
    output = Path(os.path.realpath(output))
    inputs = checked_inputs(meshes)
    parent = Path(scratch) if scratch is not None else output.parent
    _check_output(output, inputs, parent, overwrite)
    plan = _plan(memory, process_limit, options)
    _check_disk_before(inputs, plan, parent, output)
    with scratch_folder(output, parent) as folder, atomic_path(output) as temporary:
        stream = SourceStream(
            inputs,
            skip_bad=skip_bad,
            memory_bytes=plan.reader_bytes,
            batch_triangles=plan.batch_triangles,
            scratch=folder,
            progress=progress,
        )
        progress.stage("ingest: reading", sum(mesh.path.stat().st_size for mesh in inputs), "B")
        files = Scratch(folder)
        histogram, n_dropped = _distribute(stream, files, options.sort)
        n_kept = sum(area_bin.n_triangles for area_bin in histogram.values())
        counts = StoreCounts(n_kept, stream.n_ids, stream.n_dropped + n_dropped, stream.n_bad)
        run_records = plan.sort_plan(files.coordinates).run_records
        check_disk(n_kept, files.coordinates, run_records, folder, output, files.n_bytes)
        progress.stage("ingest: sorting", n_kept, "triangles")
        _write_store(temporary, stream, files, histogram, counts, plan, options, progress)
    return open_store(output)


def blockers_in_memory(
    triangles: Any,
    options: IngestOptions | None = None,
    ids: Int64Array | None = None,
    skip_bad: bool = False,
    progress: Progress | None = None,
) -> MemoryBlockers:
    """Blockers from an array of triangles (T, 3, 3), or from mesh files, held in memory.

    ids: (T,) of an array's triangles, the row by default. Chunks and order are those of a store.
    Raises SceneError for an array that is not usable, MeshError for a mesh.
    """
    options = options or IngestOptions()
    progress = progress or NullProgress()
    if names_meshes(triangles):
        stream = _memory_stream(checked_inputs(triangles), skip_bad, progress)
        batch = _read_whole(stream)
        n_dropped, n_bad = stream.n_dropped, stream.n_bad
    else:
        batch = _checked_triangles(triangles, ids)
        n_dropped = n_bad = 0
    progress.stage("ingest: sorting", len(batch.ids), "triangles")
    histogram: dict[int, AreaBin] = {}
    areas, centres = measure(batch.vertices)
    rows_of = dict(split_by_bin(areas, centres, options.sort, histogram))
    buckets = []
    for bucket in _buckets(histogram, options):
        rows = np.concatenate([rows_of.pop(number) for number in bucket.bins])
        ids_of = batch.ids[rows]
        keys = _keys(centres[rows], ids_of, bucket, options.sort)
        rows = rows[sort_by_key(keys, ids_of)]
        buckets.append(list(_memory_chunks(batch, rows, options, progress)))
    n_kept = sum(area_bin.n_triangles for area_bin in histogram.values())
    return MemoryBlockers(buckets, n_dropped + len(batch.ids) - n_kept, n_bad)


def _distribute(stream: SourceStream, files: Scratch, sort: bool) -> tuple[dict[int, AreaBin], int]:
    """Read everything into scratch files by area; returns the histogram and the number of zero areas."""
    histogram: dict[int, AreaBin] = {}
    n_dropped = 0
    for vertices, ids in stream.batches():
        narrow = _as_float32(vertices)
        areas, centres = measure(vertices.astype(np.float64, order="C", copy=False))
        n_dropped += int((areas < 0).sum())
        for number, rows in split_by_bin(areas, centres, sort, histogram):
            files.append(number, np.take(narrow, rows, axis=0), ids[rows])
    return histogram, n_dropped


def _as_float32(vertices: NDArray[np.floating]) -> NDArray[np.floating]:
    """The same numbers in float32 where nothing is lost, as they are otherwise."""
    with np.errstate(over="ignore"):
        narrow = vertices.astype(np.float32)
    return narrow if vertices.dtype == np.float32 or np.array_equal(narrow, vertices) else vertices


def _buckets(histogram: dict[int, AreaBin], options: IngestOptions) -> list[Bucket]:
    # A bucket smaller than this is better off in its neighbour: every chunk costs a read and a descent.
    least_triangles = options.chunk_triangles // 4
    return merge_bins(histogram, options.max_buckets, least_triangles)


def _keys(centres: Float64Array, ids: Int64Array, bucket: Bucket, sort: bool) -> UInt64Array:
    """Places along the curve; the ids when input order, which is theirs, is to be kept."""
    return curve_keys(centres, bucket.centre_bounds) if sort else ids.astype(np.uint64)


def _write_store(
    path: Path,
    stream: SourceStream,
    files: Scratch,
    histogram: dict[int, AreaBin],
    counts: StoreCounts,
    plan: MemoryPlan,
    options: IngestOptions,
    progress: Progress,
) -> None:
    """Sort the buckets one after the other into a store."""
    from penumbra import __version__

    buckets = _buckets(histogram, options)
    coordinates = files.coordinates
    ranges = [BucketRange(bucket.n_triangles, *bucket.area_range) for bucket in buckets]
    writer = StoreWriter(path, coordinates, options.chunk_triangles, ranges)
    try:
        for number, bucket in enumerate(buckets):

            def key_of(vertices: Float64Array, ids: Int64Array, bucket: Bucket = bucket) -> UInt64Array:
                return _keys(measure(vertices).centres, ids, bucket, options.sort)

            records = sort_files(
                [file for bin_number in bucket.bins for file in files.files(bin_number)],
                coordinates,
                files.folder,
                plan.sort_plan(coordinates),
                key_of,
                sort_by_key,
            )
            for part in _cut(records, options.chunk_triangles):
                vertices = np.ascontiguousarray(part["vertices"], np.float64)
                writer.write(number, order_chunk(vertices, np.ascontiguousarray(part["id"]), options.sort))
                progress.advance(len(part))
        areas = {number: area_bin.n_triangles for number, area_bin in histogram.items()}
        writer.finish(counts, stream.sources, areas, options.sort, f"penumbra {__version__}")
    finally:
        writer.close()


def _cut(blocks: Iterable[Records], size: int) -> Iterator[Records]:
    """Cut a stream of records anew, into pieces of `size` and a last one of what is left."""
    waiting: list[Records] = []
    n_waiting = 0
    for block in blocks:
        waiting.append(block)
        n_waiting += len(block)
        while n_waiting >= size:
            joined = np.concatenate(waiting) if len(waiting) > 1 else waiting[0]
            yield joined[:size]
            waiting, n_waiting = [joined[size:]], n_waiting - size
    if n_waiting:
        yield np.concatenate(waiting)


def _plan(memory: int | str | None, process_limit: bool, options: IngestOptions) -> MemoryPlan:
    """Share out the memory, after the kernels, which take a good part of it, are loaded."""
    before = resident_bytes()
    limit_bytes = call_limit_bytes(parse_size(memory), process_limit)
    blockers_in_memory(np.tri(3)[None])
    return plan_memory(before, limit_bytes, options.chunk_triangles)


def _check_output(output: Path, inputs: Sequence[MeshRef], scratch: Path, overwrite: bool) -> None:
    """Refuse what could not be written at the end, and remove what a killed run left behind."""
    check_output(output)
    if output.exists() and not overwrite:
        raise OutputError(f"{output} is there already: choose another output, or allow to overwrite it")
    if any(output == Path(os.path.realpath(mesh.path)) for mesh in inputs):
        raise SceneError(f"{output} is an input of this ingest: choose another output")
    if not scratch.is_dir():
        raise OutputError(f"{scratch}: there is no such folder for scratch files; create it first")
    for folder in {output.parent, scratch}:
        remove_dead_scratch(output, folder)
    remove_dead_temporaries(output)


def _check_disk_before(inputs: Sequence[MeshRef], plan: MemoryPlan, scratch: Path, output: Path) -> None:
    n_triangles, is_float32 = estimate_triangles(inputs)
    coordinates = np.dtype(np.float32 if is_float32 else np.float64)
    check_disk(n_triangles, coordinates, plan.sort_plan(coordinates).run_records, scratch, output)


def _memory_stream(inputs: Sequence[MeshRef], skip_bad: bool, progress: Progress) -> SourceStream:
    progress.stage("ingest: reading", sum(mesh.path.stat().st_size for mesh in inputs), "B")
    return SourceStream(
        inputs,
        skip_bad=skip_bad,
        memory_bytes=_NO_LIMIT_BYTES,
        batch_triangles=_BATCH_TRIANGLES,
        scratch=None,
        progress=progress,
    )


def _read_whole(stream: SourceStream) -> TriangleBatch:
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


def _memory_chunks(
    batch: TriangleBatch, rows: Int64Array, options: IngestOptions, progress: Progress
) -> Iterator[BlockerChunk]:
    """Chunks of one bucket, whose triangles are `rows` of the batch in curve order."""
    for first in range(0, len(rows), options.chunk_triangles):
        part = rows[first : first + options.chunk_triangles]
        vertices = np.take(batch.vertices, part, axis=0)
        yield order_chunk(vertices, np.take(batch.ids, part), options.sort)
        progress.advance(len(part))
