"""Blockers in memory, and reading ahead."""

import threading
from collections.abc import Iterator

import numpy as np
import pytest

from penumbra.arrays import BlockerChunk, ChunkInfo
from penumbra.blockers import prefetch
from penumbra.errors import BlockerStoreError, MeshError, SceneError
from penumbra.ingest import blockers_in_memory
from penumbra.options import IngestOptions

SIZES = [0, 1, 2, 3, 15, 16, 17, 255, 256, 257, 4095, 4096, 4097]


@pytest.mark.parametrize("sort", [True, False])
@pytest.mark.parametrize("n", SIZES)
def test_every_triangle_is_there_once(rng: np.random.Generator, n: int, sort: bool) -> None:
    triangles = rng.normal(size=(n, 3, 3))
    blockers = blockers_in_memory(triangles, IngestOptions(chunk_triangles=1000, sort=sort))
    assert blockers.n_triangles == n and blockers.n_dropped == 0
    chunks = [blockers.read(i) for i in range(len(blockers.chunks))]
    seen = {
        int(i): vertices for chunk in chunks for i, vertices in zip(chunk.ids, chunk.vertices, strict=True)
    }
    assert sorted(seen) == list(range(n)) and sum(len(chunk.ids) for chunk in chunks) == n
    for i, vertices in seen.items():
        np.testing.assert_array_equal(vertices, triangles[i])
    if n:
        corners = triangles.reshape(-1, 3)
        np.testing.assert_array_equal(blockers.bounds, [corners.min(axis=0), corners.max(axis=0)])
    else:
        assert not blockers.bounds.any() and blockers.chunks == []


def test_chunks_are_described(rng: np.random.Generator) -> None:
    blockers = blockers_in_memory(rng.normal(size=(2500, 3, 3)), IngestOptions(chunk_triangles=1000))
    first = 0
    for i, info in enumerate(blockers.chunks):
        chunk = blockers.read(i)
        corners = chunk.vertices.reshape(-1, 3)
        assert (info.bucket, info.first, info.count) == (0, first, len(chunk.ids))
        np.testing.assert_array_equal(info.box, [corners.min(axis=0), corners.max(axis=0)])
        assert info.n_bytes == sum(array.nbytes for array in chunk)
        assert all(array.flags.c_contiguous and array.flags.writeable for array in chunk)
        first += info.count
    assert first == 2500 and blockers.n_bytes == sum(info.n_bytes for info in blockers.chunks)


def test_without_sorting_the_order_is_kept(rng: np.random.Generator) -> None:
    blockers = blockers_in_memory(
        rng.normal(size=(700, 3, 3)), IngestOptions(chunk_triangles=300, sort=False)
    )
    ids = np.concatenate([blockers.read(i).ids for i in range(len(blockers.chunks))])
    np.testing.assert_array_equal(ids, np.arange(700))


def test_large_triangles_come_first(rng: np.random.Generator) -> None:
    sizes = np.repeat([1e-4, 1.0, 1e4], 400)
    triangles = rng.normal(size=(1200, 1, 3)) * 1e5 + rng.normal(size=(1200, 3, 3)) * sizes[:, None, None]
    blockers = blockers_in_memory(triangles, IngestOptions(chunk_triangles=400))
    assert [info.bucket for info in blockers.chunks] == [0, 1, 2]
    for i, first in enumerate((800, 400, 0)):
        assert sorted(blockers.read(i).ids.tolist()) == list(range(first, first + 400))


def test_zero_areas_are_dropped_and_keep_their_ids() -> None:
    good = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    line = np.array([[0.0, 0, 0], [1, 1, 1], [2, 2, 2]])
    blockers = blockers_in_memory([good, line, good + 1, np.zeros((3, 3)), good + 2])
    assert (blockers.n_triangles, blockers.n_dropped) == (3, 2)
    assert sorted(blockers.read(0).ids.tolist()) == [0, 2, 4]
    none = blockers_in_memory([line, line])
    assert (none.n_triangles, none.n_dropped, none.chunks) == (0, 2, [])


def test_given_ids_are_kept() -> None:
    triangles = np.eye(3) + np.arange(3.0)[:, None, None]
    blockers = blockers_in_memory(triangles, ids=np.array([70, 5, 6]))
    chunk = blockers.read(0)
    assert {int(i): v[0, 0] for i, v in zip(chunk.ids, chunk.vertices, strict=True)} == {70: 1, 5: 2, 6: 3}


def test_float32_and_lists_do() -> None:
    triangle = [[0.1, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert blockers_in_memory([triangle]).read(0).vertices[0, 0, 0] == 0.1
    narrow = blockers_in_memory(np.array([triangle], np.float32)).read(0).vertices
    assert narrow.dtype == np.float64 and narrow[0, 0, 0] == np.float64(np.float32(0.1))


def test_unusable_arrays_are_refused() -> None:
    bad = np.ones((3, 3, 3))
    bad[1, 2, 0] = np.nan
    with pytest.raises(SceneError, match="row 1 is not finite"):
        blockers_in_memory(bad)
    with pytest.raises(SceneError, match=r"shape \(4, 3\)"):
        blockers_in_memory(np.ones((4, 3)))
    with pytest.raises(SceneError, match="ids have shape"):
        blockers_in_memory(np.ones((2, 3, 3)), ids=np.arange(3))
    with pytest.raises(MeshError, match=r"nowhere\.obj"):
        blockers_in_memory(["nowhere.obj"])


class _SlowBlockers:
    """Chunks that are only numbers, and a record of who read them when."""

    def __init__(self, n: int, broken: int = -1) -> None:
        self.n_triangles = n
        self.n_dropped = 0
        self.n_bytes = 0
        self.bounds = np.zeros((2, 3))
        self.chunks = [ChunkInfo(0, i, 1, 0, self.bounds) for i in range(n)]
        self.broken = broken
        self.reads: list[int] = []
        self.threads: set[int] = set()

    def read(self, i: int) -> BlockerChunk:
        self.threads.add(threading.get_ident())
        self.reads.append(i)
        if i == self.broken:
            raise BlockerStoreError(f"chunk {i} is damaged")
        return BlockerChunk(np.zeros((1, 3, 3)), np.array([i]), *[np.zeros((1, 2, 3))] * 3)

    def close(self) -> None:
        pass


def test_prefetch_reads_in_order_on_one_other_thread() -> None:
    blockers = _SlowBlockers(6)
    asked = [4, 0, 5, 5, 1]
    assert [(i, int(chunk.ids[0])) for i, chunk in prefetch(blockers, asked)] == [(i, i) for i in asked]
    assert blockers.reads == asked
    assert len(blockers.threads) == 1 and threading.get_ident() not in blockers.threads
    assert list(prefetch(blockers, [])) == []


def test_prefetch_draws_one_index_ahead() -> None:
    drawn: list[int] = []

    def indices() -> Iterator[int]:
        for i in range(5):
            drawn.append(i)
            yield i

    for i, _ in prefetch(_SlowBlockers(5), indices()):
        assert drawn == list(range(min(i + 2, 5)))


def test_prefetch_raises_where_the_chunk_would_have_come() -> None:
    blockers = _SlowBlockers(5, broken=2)
    seen = []
    with pytest.raises(BlockerStoreError, match="chunk 2 is damaged"):
        for i, _ in prefetch(blockers, range(5)):
            seen.append(i)
    assert seen == [0, 1]


def test_prefetch_can_be_left() -> None:
    blockers = _SlowBlockers(100)
    before = threading.active_count()
    for i, _ in prefetch(blockers, range(100)):
        if i == 3:
            break
    reader = prefetch(blockers, range(100))
    next(reader)
    reader.close()
    assert len(blockers.reads) <= 5 + 3
    assert threading.active_count() == before
