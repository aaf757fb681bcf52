"""The blocker store: what is written is read, and what is damaged is refused in one sentence."""

import os
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import numpy as np
import pytest

from penumbra.errors import BlockerStoreError
from penumbra.ingest import ingest
from penumbra.io.blocker_store import BlockerStore, open_store
from penumbra.options import IngestOptions
from penumbra.ordering import order_chunk


def _write_obj(path: Path, triangles: np.ndarray) -> Path:
    corners = triangles.reshape(-1, 3)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in corners.tolist()]
    lines += [f"f {i} {i + 1} {i + 2}" for i in range(1, len(corners), 3)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def triangles(rng: np.random.Generator) -> np.ndarray:
    sizes = 10.0 ** rng.uniform(-4, 2, size=(900, 1, 1))
    return (rng.normal(size=(900, 1, 3)) + rng.normal(size=(900, 3, 3)) * sizes).astype(np.float32)


@pytest.fixture
def store_path(tmp_path: Path, triangles: np.ndarray) -> Path:
    mesh = _write_obj(tmp_path / "mesh.obj", triangles.astype(np.float64))
    ingest(mesh, tmp_path / "mesh.h5", options=IngestOptions(chunk_triangles=100)).close()
    return tmp_path / "mesh.h5"


def test_layout_as_documented(store_path: Path, triangles: np.ndarray) -> None:
    """Read with h5py alone, by what docs/store.md says."""
    with h5py.File(store_path) as file:
        assert file.attrs["format"] == "penumbra blocker store" and file.attrs["schema_version"] == 1
        assert file.attrs["n_triangles"] == 900 and file.attrs["n_ids"] == 900
        assert file.attrs["dtype"] == "float32" and file.attrs["chunk_triangles"] == 100
        corners = triangles.reshape(-1, 3)
        np.testing.assert_array_equal(file.attrs["bounds"], [corners.min(axis=0), corners.max(axis=0)])
        assert file.attrs["area_counts"].sum() == 900
        smallest_before = np.inf
        n_seen = 0
        for name in sorted(file["buckets"]):
            group = file["buckets"][name]
            stored, ids = group["triangles"][()], group["ids"][()]
            assert stored.dtype == np.float32 and group["triangles"].chunks is None
            np.testing.assert_array_equal(stored, triangles[ids])
            edges = (stored[:, 1:] - stored[:, :1]).astype(np.float64)
            areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
            assert group.attrs["least_area"] == pytest.approx(areas.min(), rel=1e-3)
            assert group.attrs["largest_area"] == pytest.approx(areas.max(), rel=1e-3)
            assert group.attrs["largest_area"] < smallest_before
            smallest_before = group.attrs["least_area"]
            _check_boxes(group, stored, 100)
            n_seen += len(ids)
        assert n_seen == 900 and len(file["buckets"]) > 1


def _check_boxes(group: h5py.Group, stored: np.ndarray, chunk_triangles: int) -> None:
    chunks = [stored[i : i + chunk_triangles] for i in range(0, len(stored), chunk_triangles)]
    for run in (16, 256, 4096):
        parts = [chunk[i : i + run].reshape(-1, 3) for chunk in chunks for i in range(0, len(chunk), run)]
        np.testing.assert_array_equal(
            group[f"boxes_{run}"][()], [[p.min(axis=0), p.max(axis=0)] for p in parts]
        )
    corners = [chunk.reshape(-1, 3) for chunk in chunks]
    np.testing.assert_array_equal(group["chunk_boxes"][()], [[p.min(axis=0), p.max(axis=0)] for p in corners])


def test_chunks_are_read_as_they_were_ordered(store_path: Path, triangles: np.ndarray) -> None:
    with open_store(store_path) as store:
        n_bytes = 0
        for i, info in enumerate(store.chunks):
            chunk = store.read(i)
            assert chunk.vertices.dtype == np.float64 and len(chunk.ids) == info.count <= 100
            np.testing.assert_array_equal(chunk.vertices, triangles[chunk.ids])
            expected = order_chunk(chunk.vertices, chunk.ids, sort=False)
            for array, wanted in zip(chunk, expected, strict=True):
                np.testing.assert_array_equal(array, wanted)
                assert array.flags.c_contiguous and array.flags.writeable
            n_bytes += info.n_bytes
            assert store.bytes_read == n_bytes
        assert store.n_bytes == n_bytes < store_path.stat().st_size


def test_threads_may_read_at_once(store_path: Path) -> None:
    with open_store(store_path) as store, ThreadPoolExecutor(8) as pool:
        numbers = list(range(len(store.chunks))) * 20
        for i, chunk in zip(numbers, pool.map(store.read, numbers), strict=True):
            np.testing.assert_array_equal(chunk.ids, store.read(i).ids)


def test_facts(store_path: Path) -> None:
    with open_store(store_path) as store:
        assert isinstance(store, BlockerStore) and store.path == store_path
        assert (store.n_triangles, store.n_ids, store.n_dropped, store.n_bad) == (900, 900, 0, 0)
        assert sum(store.histogram.values()) == 900 and store.is_sorted
        assert [bucket.n_triangles for bucket in store.buckets] == [
            sum(info.count for info in store.chunks if info.bucket == i) for i in range(len(store.buckets))
        ]


def test_a_closed_store_says_so(store_path: Path) -> None:
    store = open_store(store_path)
    store.close()
    store.close()
    with pytest.raises(BlockerStoreError, match="closed"):
        store.read(0)


def _sentence(path: Path) -> str:
    with pytest.raises(BlockerStoreError) as caught:
        open_store(path).close()
    message = str(caught.value)
    assert message.startswith(str(path)) and "\n" not in message
    return message


def test_files_that_are_no_store(tmp_path: Path) -> None:
    assert "no such file" in _sentence(tmp_path / "nowhere.h5")
    assert "folder" in _sentence(tmp_path)
    text = tmp_path / "text.h5"
    text.write_text("not at all")
    assert "not an HDF5 file" in _sentence(text)
    text.write_bytes(b"")
    assert "not an HDF5 file" in _sentence(text)
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["data"] = np.zeros(3)
    assert "not a blocker store" in _sentence(tmp_path / "foreign.h5")


def test_another_version(store_path: Path) -> None:
    with h5py.File(store_path, "a") as file:
        file.attrs["schema_version"] = 7
    message = _sentence(store_path)
    assert "version 7" in message and "version 1" in message


@pytest.mark.parametrize("share", [0.001, 0.1, 0.5, 0.9, 0.999])
def test_truncated(store_path: Path, share: float) -> None:
    os.truncate(store_path, int(store_path.stat().st_size * share))
    assert "ingest the mesh again" in _sentence(store_path)


def test_cut_off_while_open(store_path: Path) -> None:
    with open_store(store_path) as store:
        os.truncate(store_path, 5000)
        with pytest.raises(BlockerStoreError, match="shorter"):
            store.read(len(store.chunks) - 1)


@pytest.mark.parametrize("name", ["triangles", "ids", "boxes_16", "boxes_4096"])
def test_damaged_chunks_are_found_when_read(store_path: Path, name: str) -> None:
    with h5py.File(store_path, "a") as file:
        dataset = file["buckets/00"][name]
        dataset[-1] = dataset[-1] + 1
    with open_store(store_path) as store:
        last = max(i for i, info in enumerate(store.chunks) if info.bucket == 0)
        with pytest.raises(BlockerStoreError, match=f"chunk {last} .* damaged"):
            store.read(last)
        store.read(last + 1)


@pytest.mark.parametrize("name", ["chunk_boxes", "chunk_checksums"])
def test_a_damaged_index_is_found_on_opening(store_path: Path, name: str) -> None:
    with h5py.File(store_path, "a") as file:
        file["buckets/01"][name][0] = 1
    assert "damaged" in _sentence(store_path)


def test_changed_attributes_are_found_on_opening(store_path: Path) -> None:
    with h5py.File(store_path, "a") as file:
        file.attrs["n_dropped"] = 5
    assert "damaged" in _sentence(store_path)
    with h5py.File(store_path, "a") as file:
        del file.attrs["bounds"]
    assert "damaged" in _sentence(store_path)


def test_any_flipped_byte_is_found(store_path: Path, triangles: np.ndarray, rng: np.random.Generator) -> None:
    """Wherever a byte changes: an error, or all triangles as they were."""
    data = store_path.read_bytes()
    for place in [*range(0, 2000, 97), *rng.integers(0, len(data), 60).tolist()]:
        damaged = bytearray(data)
        damaged[place] ^= 0x55
        store_path.write_bytes(damaged)
        try:
            with open_store(store_path) as store:
                for i in range(len(store.chunks)):
                    chunk = store.read(i)
                    np.testing.assert_array_equal(chunk.vertices, triangles[chunk.ids])
        except BlockerStoreError as error:
            assert "\n" not in str(error)


def test_compressed_copies_are_refused(store_path: Path, tmp_path: Path) -> None:
    with h5py.File(store_path, "a") as file:
        group = file["buckets/00"]
        stored = group["ids"][()]
        del group["ids"]
        group.create_dataset("ids", data=stored, compression="gzip")
    assert "ids is not whole" in _sentence(store_path)


def test_checksums_are_crc32_of_what_is_stored(store_path: Path) -> None:
    with h5py.File(store_path) as file:
        group = max(file["buckets"].values(), key=lambda bucket: len(bucket["ids"]))
        rows = {"triangles": 100, "ids": 100, "boxes_16": 7, "boxes_256": 1, "boxes_4096": 1}
        checksum = 0
        for name, n_rows in rows.items():
            checksum = zlib.crc32(group[name][:n_rows].tobytes(), checksum)
        assert len(group["ids"]) >= 100 and group["chunk_checksums"][0] == checksum
