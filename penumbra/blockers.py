"""The blockers as casting sees them: chunks in casting order, wherever they are kept."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol

from penumbra.arrays import BlockerChunk, ChunkInfo, Float64Array
from penumbra.io.buckets import bounds_of
from penumbra.progress import Progress
from penumbra.stats import Stats


class Blockers(Protocol):
    """Triangles that may cast shadow, read chunk by chunk.

    `chunks` stand in casting order, the bucket of the largest triangles first; `n_bytes` is the size of
    all of them. `n_dropped` counts the zero-area triangles that were left out; their ids stay used.
    """

    n_triangles: int
    n_dropped: int
    bounds: Float64Array
    """(2, 3) least and largest coordinates; zeros where there is no blocker."""
    chunks: list[ChunkInfo]
    n_bytes: int

    def read(self, i: int) -> BlockerChunk:
        """Chunk i of `chunks`; safe to call from several threads."""

    def close(self) -> None:
        """Let go of what is open; nothing can be read afterwards."""


class MemoryBlockers:
    """Blockers held in memory, in the chunks and the order that a store would have."""

    def __init__(self, buckets: Sequence[Sequence[BlockerChunk]], n_dropped: int = 0, n_bad: int = 0) -> None:
        """`buckets`: the chunks of each area bucket, from large triangles to small."""
        self._chunks = [chunk for bucket in buckets for chunk in bucket]
        self.chunks = [info for number, bucket in enumerate(buckets) for info in _chunk_infos(number, bucket)]
        self.n_triangles = sum(info.count for info in self.chunks)
        self.n_dropped = n_dropped
        self.n_bad = n_bad
        self.n_bytes = sum(info.n_bytes for info in self.chunks)
        self.bounds = bounds_of([info.box for info in self.chunks])

    def read(self, i: int) -> BlockerChunk:
        """Chunk i of `chunks`."""
        return self._chunks[i]

    def close(self) -> None:
        """Free the triangles."""
        self._chunks = []


def prefetch(blockers: Blockers, chunk_indices: Iterable[int]) -> Iterator[tuple[int, BlockerChunk]]:
    """Yield (i, chunk i) for each index, the next chunk being read by another thread meanwhile.

    Indices are drawn one ahead, on the caller's thread. An error of a read is raised where its chunk
    would have come. Leaving the iterator early waits for at most the one read under way.
    """
    if isinstance(blockers, MemoryBlockers):
        yield from ((i, blockers.read(i)) for i in chunk_indices)
        return
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="penumbra-read") as reader:
        pending = None
        for i in chunk_indices:
            ahead = (i, reader.submit(blockers.read, i))
            if pending is not None:
                yield pending[0], pending[1].result()
            pending = ahead
        if pending is not None:
            yield pending[0], pending[1].result()


def stream_wanted(
    blockers: Blockers,
    is_wanted: Callable[[int], bool],
    *,
    large_first: bool,
    progress: Progress,
    stats: Stats,
) -> Iterator[tuple[int, BlockerChunk]]:
    """Yield (i, chunk i) of the chunks that are wanted, in casting order or its reverse; count bytes.

    is_wanted is asked on the caller's thread, one chunk ahead of the one that is worked on. A chunk that
    is not wanted is never read; progress advances over it.
    """
    order = range(len(blockers.chunks))

    def wanted() -> Iterator[int]:
        """Chunks to read."""
        for number in order if large_first else reversed(order):
            info = blockers.chunks[number]
            if is_wanted(number):
                stats.count("bytes_read", info.n_bytes)
                yield number
            else:
                stats.count("bytes_skipped", info.n_bytes)
                progress.advance(info.count)

    return prefetch(blockers, wanted())


def _chunk_infos(bucket: int, chunks: Sequence[BlockerChunk]) -> Iterator[ChunkInfo]:
    first = 0
    for chunk in chunks:
        count = len(chunk.ids)
        n_bytes = sum(array.nbytes for array in chunk)
        yield ChunkInfo(bucket, first, count, n_bytes, bounds_of(chunk.boxes_4096))
        first += count
