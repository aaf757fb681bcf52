"""2: triangles of meshes into a store: distributed by area, then sorted and written bucket by bucket."""

from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from penumbra.arrays import Float64Array, Int64Array, UInt64Array
from penumbra.ingest_plan import MemoryPlan
from penumbra.ingest_sources import SourceStream
from penumbra.io.blocker_store import BucketRange, Source, StoreCounts, StoreWriter
from penumbra.io.buckets import AreaBin, split_by_bin
from penumbra.io.runs import Records, Scratch, sort_files
from penumbra.options import IngestOptions
from penumbra.ordering import bucket_keys, choose_buckets, measure, order_chunk, sort_by_key
from penumbra.progress import Progress


class Distribution(NamedTuple):
    """All triangles in scratch files by area, and what is known of them."""

    files: Scratch
    histogram: dict[int, AreaBin]
    counts: StoreCounts
    sources: list[Source]


def distribute(stream: SourceStream, files: Scratch, sort: bool) -> Distribution:
    """Read everything once, into a scratch file for each area bin; zero areas are dropped."""
    histogram: dict[int, AreaBin] = {}
    n_dropped = 0
    for vertices, ids in stream.batches():
        narrow = _as_float32(vertices)
        areas, centres = measure(np.asarray(vertices, np.float64, order="C"))
        n_dropped += int((areas < 0).sum())
        for number, rows in split_by_bin(areas, centres, sort, histogram):
            files.append(number, np.take(narrow, rows, axis=0), ids[rows])
    n_kept = sum(area_bin.n_triangles for area_bin in histogram.values())
    counts = StoreCounts(n_kept, stream.n_ids, stream.n_dropped + n_dropped, stream.n_bad)
    return Distribution(files, histogram, counts, stream.sources)


def write_store(
    path: Path, found: Distribution, plan: MemoryPlan, options: IngestOptions, progress: Progress
) -> None:
    """Sort the buckets one after the other into a store."""
    from penumbra import __version__

    buckets = choose_buckets(found.histogram, options)
    coordinates = found.files.coordinates
    ranges = [BucketRange(bucket.n_triangles, *bucket.area_range) for bucket in buckets]
    writer = StoreWriter(path, coordinates, options.chunk_triangles, ranges)
    try:
        for number, bucket in enumerate(buckets):
            records = sort_files(
                [file for bin_number in bucket.bins for file in found.files.files(bin_number)],
                coordinates,
                found.files.folder,
                plan.sort_plan(coordinates),
                partial(_key_of, bounds=bucket.centre_bounds, sort=options.sort),
                sort_by_key,
            )
            for part in _cut(records, options.chunk_triangles):
                vertices = np.ascontiguousarray(part["vertices"], np.float64)
                writer.write(number, order_chunk(vertices, np.ascontiguousarray(part["id"]), options.sort))
                progress.advance(len(part))
        areas = {number: area_bin.n_triangles for number, area_bin in found.histogram.items()}
        writer.finish(found.counts, found.sources, areas, options.sort, f"penumbra {__version__}")
    finally:
        writer.close()


def _key_of(vertices: Float64Array, ids: Int64Array, *, bounds: Float64Array, sort: bool) -> UInt64Array:
    return bucket_keys(measure(vertices).centres, ids, bounds, sort)


def _as_float32(vertices: NDArray[np.floating]) -> NDArray[np.floating]:
    """The same numbers in float32 where nothing is lost, as they are otherwise."""
    if vertices.dtype == np.float32:
        return vertices
    with np.errstate(over="ignore"):
        narrow = vertices.astype(np.float32)
    return narrow if np.array_equal(narrow, vertices) else vertices


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
