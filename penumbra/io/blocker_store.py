"""2: the blocker store: one HDF5 file with blockers in casting order; docs/store.md has its layout.

HDF5 is written and its index is read through h5py. Triangles, ids and boxes are contiguous in the file
and are read at their offsets without it: no lock is shared between threads, and a chunk of triangles
is one read.
"""

import contextlib
import hashlib
import os
import threading
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from penumbra.arrays import BlockerChunk, ChunkInfo, Float64Array
from penumbra.errors import BlockerStoreError
from penumbra.io.buckets import bounds_of
from penumbra.io.runs import disk_error

FORMAT = "penumbra blocker store"
SCHEMA_VERSION = 1

# Datasets of one bucket that a chunk is read from, in the order of BlockerChunk; triangles in one row.
_CHUNK_DATASETS = ("triangles", "ids", "boxes_16", "boxes_256", "boxes_4096")
_RUNS = (1, 1, 16, 256, 4096)

_REMEDY = "ingest the mesh again"


class Source(NamedTuple):
    """A mesh that went into a store."""

    path: str
    size_bytes: int
    mtime_ns: int
    sha256: str
    up: str
    transform: Float64Array | None
    first_id: int
    n_ids: int
    n_bad: int


class StoreCounts(NamedTuple):
    """Triangles of a store: `n_ids` were read, of which `n_dropped` have zero area and `n_bad` were bad."""

    n_triangles: int
    n_ids: int
    n_dropped: int
    n_bad: int


class BucketRange(NamedTuple):
    """A bucket as it is announced to the writer."""

    n_triangles: int
    least_area: float
    largest_area: float


class StoreWriter:
    """Writes a store: all buckets are announced first, then filled chunk by chunk, then `finish`."""

    def __init__(
        self, path: Path, coordinates: np.dtype[Any], chunk_triangles: int, buckets: Sequence[BucketRange]
    ) -> None:
        """`coordinates`: float32 or float64, the type of vertices and boxes in the file."""
        self._coordinates = coordinates
        self._chunk_triangles = chunk_triangles
        self._boxes: list[Float64Array] = []
        self._n_chunks = [0] * len(buckets)
        self._folder = path.parent
        with self._write_errors():
            self._file = h5py.File(path, "w")
            self._groups = [self._add_bucket(number, bucket) for number, bucket in enumerate(buckets)]

    def _add_bucket(self, number: int, bucket: BucketRange) -> Any:
        group = self._file.create_group(f"buckets/{number:02d}")
        group.attrs["n_triangles"] = bucket.n_triangles
        group.attrs["least_area"] = bucket.least_area
        group.attrs["largest_area"] = bucket.largest_area
        n = bucket.n_triangles
        n_chunks = -(-n // self._chunk_triangles)
        for name, run in zip(_CHUNK_DATASETS, _RUNS, strict=True):
            shape, dtype = _row_format(name, self._coordinates)
            group.create_dataset(name, (_n_rows(n, run, self._chunk_triangles), *shape), dtype)
        group.create_dataset("chunk_boxes", (n_chunks, 2, 3), self._coordinates)
        group.create_dataset("chunk_checksums", (n_chunks,), np.uint32)
        return group

    def write(self, bucket: int, chunk: BlockerChunk) -> None:
        """Add the next chunk of a bucket; all but its last have `chunk_triangles` triangles."""
        group = self._groups[bucket]
        number = self._n_chunks[bucket]
        self._n_chunks[bucket] += 1
        checksum = 0
        box = bounds_of(list(chunk.boxes_4096))
        with self._write_errors():
            for name, run, array in zip(_CHUNK_DATASETS, _RUNS, chunk, strict=True):
                first = _n_rows(number * self._chunk_triangles, run, self._chunk_triangles)
                data = np.ascontiguousarray(array, group[name].dtype)
                group[name][first : first + len(data)] = data
                checksum = zlib.crc32(data.data, checksum)
            group["chunk_boxes"][number] = box
            group["chunk_checksums"][number] = checksum
        self._boxes.append(box)

    def finish(
        self,
        counts: StoreCounts,
        sources: Sequence[Source],
        histogram: dict[int, int],
        is_sorted: bool,
        created_by: str,
    ) -> None:
        """Write the facts about the whole store and close the file."""
        with self._write_errors():
            self._write_facts(counts, sources, histogram, is_sorted, created_by)
            self._file.attrs["index_sha256"] = _index_sha256(self._file)
            self._file.close()

    def _write_facts(
        self,
        counts: StoreCounts,
        sources: Sequence[Source],
        histogram: dict[int, int],
        is_sorted: bool,
        created_by: str,
    ) -> None:
        attributes = self._file.attrs
        attributes["format"] = FORMAT
        attributes["schema_version"] = SCHEMA_VERSION
        attributes["created_by"] = created_by
        attributes["dtype"] = self._coordinates.name
        attributes["chunk_triangles"] = self._chunk_triangles
        attributes["is_sorted"] = is_sorted
        attributes["bounds"] = bounds_of(self._boxes)
        for name, value in counts._asdict().items():
            attributes[name] = value
        attributes["area_bins"] = np.array(sorted(histogram), np.int64)
        attributes["area_counts"] = np.array([histogram[key] for key in sorted(histogram)], np.int64)
        self._file.require_group("buckets")
        for number, source in enumerate(sources):
            group = self._file.create_group(f"sources/{number:04d}")
            for name, value in source._asdict().items():
                if value is not None:
                    group.attrs[name] = value

    @contextlib.contextmanager
    def _write_errors(self) -> Iterator[None]:
        try:
            yield
        except (OSError, RuntimeError) as error:
            raise disk_error(self._folder, error) from error

    def close(self) -> None:
        """Close the file, finished or not."""
        with contextlib.suppress(RuntimeError, OSError):
            self._file.close()


class BlockerStore:
    """An open store; its index is in memory, chunks are read when asked for. A context manager."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.bytes_read = 0
        """Bytes of chunks read so far."""
        self._lock = threading.Lock()
        self._descriptor = -1
        with _index_errors(self.path), h5py.File(self.path, "r", locking=False) as file:
            _check_format(self.path, file.attrs)
            self._read_facts(file)
            self._read_index(file)
        self._descriptor = os.open(self.path, os.O_RDONLY | os.O_CLOEXEC)

    def _read_facts(self, file: Any) -> None:
        attributes = file.attrs
        self.n_triangles = int(attributes["n_triangles"])
        self.n_ids = int(attributes["n_ids"])
        self.n_dropped = int(attributes["n_dropped"])
        self.n_bad = int(attributes["n_bad"])
        self.bounds: Float64Array = np.array(attributes["bounds"], np.float64)
        self.dtype = np.dtype(str(attributes["dtype"]))
        """Type of the vertices in the file; they are handed out as float64."""
        self.chunk_triangles = int(attributes["chunk_triangles"])
        self.is_sorted = bool(attributes["is_sorted"])
        self.created_by = str(attributes["created_by"])
        self.histogram = {
            int(number): int(count)
            for number, count in zip(attributes["area_bins"], attributes["area_counts"], strict=True)
        }
        """Triangles by area: bin b holds areas from 4**b / 2 up to 2 * 4**b."""
        self.sources = [_source(group.attrs) for _, group in sorted(file.get("sources", {}).items())]

    def _read_index(self, file: Any) -> None:
        if _index_sha256(file) != str(file.attrs["index_sha256"]):
            raise BlockerStoreError(f"{self.path}: the index of this blocker store is damaged; {_REMEDY}")
        self.chunks: list[ChunkInfo] = []
        self.buckets: list[BucketRange] = []
        self._offsets: list[list[int]] = []
        self._checksums: list[int] = []
        size_bytes = self.path.stat().st_size
        for number, (_, group) in enumerate(sorted(file["buckets"].items())):
            n = int(group.attrs["n_triangles"])
            self.buckets.append(
                BucketRange(n, float(group.attrs["least_area"]), float(group.attrs["largest_area"]))
            )
            self._offsets.append([self._offset(group[name], size_bytes) for name in _CHUNK_DATASETS])
            self._checksums += map(int, group["chunk_checksums"][()])
            for i, box in enumerate(group["chunk_boxes"][()].astype(np.float64)):
                first = i * self.chunk_triangles
                count = min(self.chunk_triangles, n - first)
                n_bytes = sum(size for _, size in self._extents(number, first, count))
                self.chunks.append(ChunkInfo(number, first, count, n_bytes, box))
        self.n_bytes = sum(info.n_bytes for info in self.chunks)

    def _offset(self, dataset: Any, size_bytes: int) -> int:
        """Where a dataset begins in the file; one that is compressed or cut off has no such place."""
        offset = dataset.id.get_offset()
        if offset is None or offset + dataset.size * dataset.dtype.itemsize > size_bytes:
            raise BlockerStoreError(f"{self.path}: {dataset.name} is not whole in this file; {_REMEDY}")
        return int(offset)

    def _extents(self, bucket: int, first: int, count: int) -> Iterator[tuple[int, int]]:
        """Offset and size in bytes of each array of the chunk that begins at triangle `first`."""
        for name, run, offset in zip(_CHUNK_DATASETS, _RUNS, self._offsets[bucket], strict=True):
            shape, dtype = _row_format(name, self.dtype)
            row_bytes = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
            n_rows = _n_rows(count, run, self.chunk_triangles)
            yield offset + _n_rows(first, run, self.chunk_triangles) * row_bytes, n_rows * row_bytes

    def read(self, i: int) -> BlockerChunk:
        """Chunk i of `chunks`, checked against its checksum; safe to call from several threads."""
        info = self.chunks[i]
        checksum = 0
        arrays: list[Any] = []
        for name, (offset, n_bytes) in zip(
            _CHUNK_DATASETS, self._extents(info.bucket, info.first, info.count), strict=True
        ):
            shape, dtype = _row_format(name, self.dtype)
            data = self._read_bytes(offset, n_bytes)
            checksum = zlib.crc32(data.data, checksum)
            array = data.view(dtype).reshape(-1, *shape)
            arrays.append(array if name == "ids" else array.astype(np.float64))
        if checksum != self._checksums[i]:
            raise BlockerStoreError(f"{self.path}: chunk {i} of this blocker store is damaged; {_REMEDY}")
        with self._lock:
            self.bytes_read += info.n_bytes
        return BlockerChunk(*arrays)

    def _read_bytes(self, offset: int, n_bytes: int) -> NDArray[np.uint8]:
        data = np.empty(n_bytes, np.uint8)
        view = data.data
        done = 0
        try:
            while done < n_bytes:
                n_read = os.preadv(self._descriptor, [view[done:]], offset + done)
                if n_read == 0:
                    raise BlockerStoreError(f"{self.path}: the file has become shorter; {_REMEDY}")
                done += n_read
        except OSError as error:
            if isinstance(error, BlockerStoreError):
                raise
            reason = "the store is closed" if self._descriptor < 0 else error.strerror
            raise BlockerStoreError(f"{self.path}: cannot be read ({reason})") from error
        return data

    def close(self) -> None:
        """Close the file; chunks cannot be read afterwards."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_store(path: str | Path) -> BlockerStore:
    """Open a blocker store: reads its index only.

    Raises BlockerStoreError, in one sentence, for a file that is missing, foreign, of another version,
    cut off or damaged.
    """
    return BlockerStore(path)


@contextlib.contextmanager
def _index_errors(path: Path) -> Iterator[None]:
    """Turn whatever a foreign or damaged file makes HDF5 raise into one sentence."""
    try:
        # h5py's own errors do not tell a folder from a foreign file.
        with open(path, "rb"):
            is_hdf5 = h5py.is_hdf5(path)
        if not is_hdf5:
            raise BlockerStoreError(f"{path}: is not a blocker store (not an HDF5 file)")
        yield
    except BlockerStoreError:
        raise
    except FileNotFoundError as error:
        raise BlockerStoreError(f"{path}: there is no such file") from error
    except IsADirectoryError as error:
        raise BlockerStoreError(f"{path}: is a folder, not a blocker store") from error
    except PermissionError as error:
        raise BlockerStoreError(f"{path}: cannot be read ({error.strerror})") from error
    except Exception as error:
        raise BlockerStoreError(
            f"{path}: the file is cut off or damaged, its index cannot be read; {_REMEDY}"
        ) from error


def _check_format(path: Path, attributes: Any) -> None:
    if attributes.get("format") != FORMAT:
        raise BlockerStoreError(f"{path}: is an HDF5 file, but not a blocker store")
    version = attributes.get("schema_version")
    if version != SCHEMA_VERSION:
        raise BlockerStoreError(
            f"{path}: is a blocker store of version {version}, and this program reads version "
            f"{SCHEMA_VERSION}; {_REMEDY}"
        )


def _row_format(name: str, coordinates: np.dtype[Any]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of one row of a dataset that a chunk is read from."""
    if name == "ids":
        return (), np.dtype(np.int64)
    return ((3, 3) if name == "triangles" else (2, 3)), coordinates


def _n_rows(n_triangles: int, run: int, chunk_triangles: int) -> int:
    """Runs of `run` triangles in the first n_triangles of a bucket; runs begin anew with each chunk."""
    n_chunks, rest = divmod(n_triangles, chunk_triangles)
    return n_chunks * -(-chunk_triangles // run) + -(-rest // run)


def _source(attributes: Any) -> Source:
    transform = attributes.get("transform")
    return Source(
        path=str(attributes["path"]),
        size_bytes=int(attributes["size_bytes"]),
        mtime_ns=int(attributes["mtime_ns"]),
        sha256=str(attributes["sha256"]),
        up=str(attributes["up"]),
        transform=None if transform is None else np.array(transform, np.float64),
        first_id=int(attributes["first_id"]),
        n_ids=int(attributes["n_ids"]),
        n_bad=int(attributes["n_bad"]),
    )


def _index_sha256(file: Any) -> str:
    """Checksum of all attributes, chunk boxes and checksums of chunks."""
    digest = hashlib.sha256()

    def add_attributes(attributes: Any) -> None:
        for name in sorted(attributes):
            value = attributes[name]
            if name != "index_sha256":
                digest.update(name.encode() + b"\0")
                digest.update(value.encode() if isinstance(value, str) else np.asarray(value).tobytes())

    add_attributes(file.attrs)
    for _, group in sorted(file.get("sources", {}).items()):
        add_attributes(group.attrs)
    for _, group in sorted(file["buckets"].items()):
        add_attributes(group.attrs)
        digest.update(group["chunk_boxes"][()])
        digest.update(group["chunk_checksums"][()])
    return digest.hexdigest()
