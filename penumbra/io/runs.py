"""2: scratch files of ingest: triangles by area bin, and the external sort of what is in them.

A record is an id and three vertices, with a sort key in front once it is sorted. Files are opened for
each access, so no number of bins or runs meets a limit on open files.
"""

import errno
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from penumbra.arrays import Float64Array, Int64Array, UInt64Array
from penumbra.errors import OutputError

Records = NDArray[np.void]
KeyFunction = Callable[[Float64Array, Int64Array], UInt64Array]
SortFunction = Callable[[UInt64Array, Int64Array], Int64Array]

# Records converted or written at a time: some megabytes, so that copies stay small beside the runs.
_SLICE_RECORDS = 65536


def record_dtype(coordinates: np.dtype[Any], keyed: bool) -> np.dtype[np.void]:
    """Layout of one record, without padding."""
    key = [("key", np.uint64)] if keyed else []
    return np.dtype([*key, ("id", np.int64), ("vertices", coordinates, (3, 3))])


class BinFile(NamedTuple):
    """Records of one area bin, all with coordinates of one type."""

    path: Path
    dtype: np.dtype[np.void]
    n_records: int


class Scratch:
    """The scratch folder of one ingest: append-only bin files, then sorted runs."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._counts: dict[tuple[int, np.dtype[Any]], int] = {}

    def append(self, number: int, vertices: NDArray[np.floating], ids: Int64Array) -> None:
        """Add triangles (n, 3, 3), float32 or float64, to area bin `number`."""
        key = (number, vertices.dtype)
        records = np.empty(len(ids), record_dtype(vertices.dtype, keyed=False))
        records["id"] = ids
        records["vertices"] = vertices
        append_records(self._path(*key), records)
        self._counts[key] = self._counts.get(key, 0) + len(ids)

    def files(self, number: int) -> list[BinFile]:
        """Files of one bin."""
        return [
            BinFile(self._path(number, coordinates), record_dtype(coordinates, keyed=False), count)
            for (other, coordinates), count in self._counts.items()
            if other == number
        ]

    @property
    def n_bytes(self) -> int:
        """Size of all bin files so far."""
        return sum(
            count * record_dtype(coordinates, keyed=False).itemsize
            for (_, coordinates), count in self._counts.items()
        )

    @property
    def coordinates(self) -> np.dtype[Any]:
        """Float32 when all that was added is float32, else float64."""
        return np.dtype(max((dtype for _, dtype in self._counts), default=np.dtype(np.float32)))

    def _path(self, number: int, coordinates: np.dtype[Any]) -> Path:
        return self.folder / f"bin{number:+05d}.{coordinates.name}"


@contextmanager
def scratch_folder(output: Path, parent: Path) -> Iterator[Path]:
    """Make `.NAME.ingest-PID` in `parent`, and remove it at the end however that comes."""
    folder = parent / f".{output.name}.ingest-{os.getpid()}"
    try:
        folder.mkdir()
    except OSError as error:
        raise OutputError(
            f"{parent}: cannot make a scratch folder there ({error.strerror}); name another"
        ) from error
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def remove_dead_scratch(output: Path, parent: Path) -> None:
    """Remove scratch folders that killed runs with the same output left in `parent`."""
    pattern = re.compile(re.escape(f".{output.name}.ingest-") + r"(\d+)")
    for entry in parent.glob(".*.ingest-*"):
        match = pattern.fullmatch(entry.name)
        if match and not _is_running(int(match[1])):
            shutil.rmtree(entry, ignore_errors=True)


def _is_running(pid: int) -> bool:
    # In a container the killed run may well have had the number that this process has now.
    if pid == os.getpid():
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def append_records(path: Path, records: Records) -> None:
    """Append to a scratch file; OutputError says how much room the disk has left when it is full."""
    try:
        with open(path, "ab", buffering=0) as file:
            data = records.view(np.uint8).data
            while data:
                data = data[file.write(data) :]
    except OSError as error:
        raise disk_error(path.parent, error) from error


def disk_error(folder: Path, error: OSError | RuntimeError) -> OutputError:
    """Say why a file in `folder` could not be written."""
    number = getattr(error, "errno", None)
    if number in (errno.ENOSPC, errno.EDQUOT):
        free_bytes = shutil.disk_usage(folder).free
        return OutputError(
            f"{folder}: the disk is full ({free_bytes} bytes left); "
            "make room, or name another folder for scratch files"
        )
    reason = os.strerror(number) if number else str(error)
    return OutputError(f"{folder}: cannot write there ({reason}); check the disk")


class SortPlan(NamedTuple):
    """How an external sort may use memory."""

    run_records: int  # records sorted in memory at a time
    merge_records: int  # records held while runs are merged, of all runs together


def sort_files(
    files: Iterable[BinFile],
    coordinates: np.dtype[Any],
    folder: Path,
    plan: SortPlan,
    key_of: KeyFunction,
    sort: SortFunction,
) -> Iterator[Records]:
    """Yield the records of all files sorted by key, then id, in blocks; the files are removed.

    Coordinates become `coordinates`; `key_of` gets vertices float64 (n, 3, 3) and ids, `sort` keys and ids.
    """
    runs: list[BinFile] = []
    for run in _sorted_runs(list(files), record_dtype(coordinates, keyed=True), plan, key_of, sort):
        if run.is_only:
            yield from run.slices()
            return
        path = folder / f"run{len(runs):05d}"
        for part in run.slices():
            append_records(path, part)
        runs.append(BinFile(path, run.records.dtype, len(run.order)))
        del run
    yield from _merge_runs(runs, max(1, plan.merge_records // max(1, len(runs))), sort)


class _SortedRun(NamedTuple):
    records: Records
    order: Int64Array
    is_only: bool

    def slices(self) -> Iterator[Records]:
        for first in range(0, len(self.order), _SLICE_RECORDS):
            yield np.take(self.records, self.order[first : first + _SLICE_RECORDS])


def _sorted_runs(
    files: list[BinFile], dtype: np.dtype[np.void], plan: SortPlan, key_of: KeyFunction, sort: SortFunction
) -> Iterator[_SortedRun]:
    """Fill one buffer after the other from the files, with keys, and sort it."""
    n_left = sum(file.n_records for file in files)
    is_only = n_left <= plan.run_records
    records = np.empty(min(n_left, plan.run_records), dtype)
    n_filled = 0
    for part in _read_files(files):
        done = 0
        while done < len(part):
            taken = part[done : done + len(records) - n_filled]
            into = records[n_filled : n_filled + len(taken)]
            into["id"] = taken["id"]
            into["vertices"] = taken["vertices"]
            into["key"] = key_of(np.ascontiguousarray(taken["vertices"], np.float64), taken["id"])
            n_filled += len(taken)
            done += len(taken)
            n_left -= len(taken)
            if n_filled == len(records) or n_left == 0:
                filled = records[:n_filled]
                keys = np.ascontiguousarray(filled["key"])
                yield _SortedRun(filled, sort(keys, filled["id"]), is_only)
                n_filled = 0


def _read_files(files: list[BinFile]) -> Iterator[Records]:
    """Records of scratch files in slices; each file is removed when it has been read."""
    for file in files:
        for first in range(0, file.n_records, _SLICE_RECORDS):
            records = _read_records(file, first, min(_SLICE_RECORDS, file.n_records - first))
            if first + len(records) == file.n_records:
                file.path.unlink()
            yield records


def _read_records(file: BinFile, first: int, count: int) -> Records:
    records = np.fromfile(file.path, file.dtype, count, offset=first * file.dtype.itemsize)
    if len(records) != count:
        raise OutputError(f"{file.path}: a scratch file is shorter than it was written; check the disk")
    return records


class _RunHead:
    """The part of a sorted run that is in memory."""

    def __init__(self, file: BinFile, block_records: int) -> None:
        self._file = file
        self._block_records = block_records
        self._n_read = 0
        self._head: Records = np.empty(0, file.dtype)
        self.top_up()

    @property
    def is_on_disk(self) -> bool:
        """Whether more of the run is still to be read."""
        return self._n_read < self._file.n_records

    @property
    def last(self) -> tuple[np.uint64, np.int64]:
        """Key and id of the last record in memory."""
        return self._head["key"][-1], self._head["id"][-1]

    def top_up(self) -> bool:
        """Read until a block is in memory again; False when the run is at its end, and then removed."""
        count = min(self._block_records - len(self._head), self._file.n_records - self._n_read)
        if count > 0:
            more = _read_records(self._file, self._n_read, count)
            self._head = np.concatenate([self._head, more]) if len(self._head) else more
            self._n_read += count
        if len(self._head) == 0:
            self._file.path.unlink()
        return len(self._head) > 0

    def take(self, limit: tuple[np.uint64, np.int64] | None) -> Records:
        """Remove and return the records in memory up to and including (key, id) `limit`; None: all."""
        count = len(self._head)
        if limit is not None:
            keys = self._head["key"]
            low = int(np.searchsorted(keys, limit[0], "left"))
            high = int(np.searchsorted(keys, limit[0], "right"))
            count = low + int(np.searchsorted(self._head["id"][low:high], limit[1], "right"))
        taken, self._head = self._head[:count], self._head[count:]
        return taken


def _merge_runs(files: list[BinFile], block_records: int, sort: SortFunction) -> Iterator[Records]:
    """Merge sorted runs, all in step: whatever no unread record can precede is sorted and yielded.

    Every run is topped up in every round. Waiting until a block is empty would make rounds as many as
    blocks, each a loop over all runs.
    """
    runs = [_RunHead(file, block_records) for file in files]
    while runs:
        limit = min((run.last for run in runs if run.is_on_disk), default=None)
        block = np.concatenate([run.take(limit) for run in runs])
        order = sort(np.ascontiguousarray(block["key"]), block["id"])
        for first in range(0, len(block), _SLICE_RECORDS):
            yield np.take(block, order[first : first + _SLICE_RECORDS])
        runs = [run for run in runs if run.top_up()]
