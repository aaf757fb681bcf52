"""2: what ingest may take: memory shared out before any work, disk space estimated and checked."""

import os
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from penumbra.errors import MemoryLimitError, OutputError
from penumbra.io.blocker_store import open_store
from penumbra.io.meshes import open_mesh
from penumbra.io.runs import SortPlan, record_dtype
from penumbra.memory import format_bytes, resident_bytes
from penumbra.scene import MeshRef

# Measured as growth of VmHWM and rounded up.
_CHUNK_TRIANGLE_BYTES = 400  # a triangle of the chunk that is being ordered and written
_BATCH_TRIANGLE_BYTES = 600  # a triangle of the batch that is being distributed
_READER_LEAST_BYTES = 8 << 20
_READER_BUFFERS_BYTES = 24 << 20  # what a reader takes beside its vertices
_LEAST_SORT_BYTES = 16 << 20
_SORT_COPIES_BYTES = 48  # beside a record: its key, its order, and copies of both while they are sorted
_MERGE_COPIES = 4  # records being merged, their concatenation, and the slice that is handed on

_LARGEST_BATCH = 65536
_LEAST_BATCH = 4096

# Bytes of file per triangle where the header does not say how many there are.
_TEXT_TRIANGLE_BYTES = 32
_BINARY_TRIANGLE_BYTES = 14


class MemoryPlan(NamedTuple):
    """How ingest shares out its memory."""

    ceiling_bytes: int  # resident memory of the process must not go above it
    reader_bytes: int
    batch_triangles: int
    chunk_bytes: int

    def sort_plan(self, coordinates: np.dtype[Any]) -> SortPlan:
        """Runs that fit into what is free now, of records with such coordinates."""
        # Looked at anew: what the readers' kernels took, compiled or loaded, does not come back.
        sort_bytes = max(_LEAST_SORT_BYTES, self.ceiling_bytes - resident_bytes() - self.chunk_bytes)
        record_bytes = record_dtype(coordinates, keyed=True).itemsize
        return SortPlan(
            run_records=sort_bytes // (record_bytes + _SORT_COPIES_BYTES),
            merge_records=sort_bytes // (record_bytes * _MERGE_COPIES),
        )


def plan_memory(before_bytes: int, limit_bytes: int, chunk_triangles: int, process_limit: bool) -> MemoryPlan:
    """Share out `limit_bytes` above `before_bytes`, the resident memory when ingest began.

    What libraries and kernels took since is in it. Raises MemoryLimitError, with the figure that would
    do, when it is too little.
    """
    chunk_bytes = chunk_triangles * _CHUNK_TRIANGLE_BYTES
    taken_bytes = max(0, resident_bytes() - before_bytes)
    working = limit_bytes - taken_bytes
    least = max(
        _READER_LEAST_BYTES + _READER_BUFFERS_BYTES + _LEAST_BATCH * _BATCH_TRIANGLE_BYTES,
        chunk_bytes + _LEAST_SORT_BYTES,
    )
    if working < least:
        # In the terms of whoever set the limit: of the whole process, or of what ingest adds to it.
        outside = before_bytes if process_limit else 0
        raise MemoryLimitError(
            f"ingest needs {format_bytes(outside + taken_bytes + least)} of memory and the limit is "
            f"{format_bytes(outside + limit_bytes)}: raise it"
        )
    batch = (working - _READER_LEAST_BYTES - _READER_BUFFERS_BYTES) // 2 // _BATCH_TRIANGLE_BYTES
    batch = max(_LEAST_BATCH, min(_LARGEST_BATCH, batch))
    return MemoryPlan(
        ceiling_bytes=before_bytes + limit_bytes,
        reader_bytes=working - _READER_BUFFERS_BYTES - batch * _BATCH_TRIANGLE_BYTES,
        batch_triangles=batch,
        chunk_bytes=chunk_bytes,
    )


def estimate_triangles(meshes: Iterable[MeshRef]) -> tuple[int, np.dtype[Any]]:
    """About how many triangles the inputs hold, and the type of their coordinates as headers promise it.

    The number is exact where headers have it. Raises MeshError or BlockerStoreError.
    """
    total = 0
    is_float32 = True
    for mesh in meshes:
        if mesh.is_store:
            with open_store(mesh.path) as store:
                total += store.n_triangles
                is_float32 &= store.dtype == np.float32
            continue
        with open_mesh(mesh.path) as reader:
            is_float32 &= reader.exact_float32 and mesh.transform is None
            if reader.n_triangles is not None:
                total += reader.n_triangles
            else:
                is_text = mesh.path.suffix.lower() == ".obj"
                total += reader.size_bytes // (_TEXT_TRIANGLE_BYTES if is_text else _BINARY_TRIANGLE_BYTES)
    return total, np.dtype(np.float32 if is_float32 else np.float64)


def store_bytes(n_triangles: int, coordinates: np.dtype[Any]) -> int:
    """Size of a store: vertices, ids, and a box for every 16 triangles and fewer above."""
    return n_triangles * (9 * coordinates.itemsize + 8) + n_triangles * 6 * coordinates.itemsize // 15


def check_disk(
    n_triangles: int,
    coordinates: np.dtype[Any],
    plan: MemoryPlan,
    scratch: Path,
    output: Path,
    written_bytes: int = 0,
) -> None:
    """Raise OutputError, with the figure, where the disk has too little room for an ingest.

    At the worst moment the scratch folder holds all bins and, where a bucket does not fit in memory, all
    sorted runs; or the runs, and the output the store. `written_bytes` of the bins are there already.
    """
    needs_runs = n_triangles > plan.sort_plan(coordinates).run_records
    unsorted = n_triangles * record_dtype(coordinates, keyed=False).itemsize
    runs = n_triangles * record_dtype(coordinates, keyed=True).itemsize if needs_runs else 0
    store = store_bytes(n_triangles, coordinates)
    if os.stat(scratch).st_dev == os.stat(output.parent).st_dev:
        needs = [(output.parent, runs + max(unsorted, store))]
    else:
        needs = [(scratch, runs + unsorted), (output.parent, store)]
    _check_free(needs, scratch, written_bytes)


def _check_free(needs: Sequence[tuple[Path, int]], scratch: Path, written_bytes: int) -> None:
    for folder, n_bytes in needs:
        already = written_bytes if os.stat(folder).st_dev == os.stat(scratch).st_dev else 0
        free = shutil.disk_usage(folder).free
        if n_bytes - already > free:
            raise OutputError(
                f"{folder}: ingest needs about {format_bytes(n_bytes - already)} of disk space there and "
                f"{format_bytes(free)} is free; make room, or name another folder for scratch files"
            )
