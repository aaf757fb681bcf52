"""2: meshes to blockers in casting order, in a store on disk or in memory.

One pass over the meshes puts the triangles into bins by area; bins are joined to buckets from large
triangles to small (Laine and Aila 2005, section 3.3, "coarse blocker sorting"); each bucket is sorted
along a space-filling curve and cut into chunks, and each chunk is put in surface-area order. At no time
is more than the memory limit needed.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from penumbra.arrays import Int64Array
from penumbra.blockers import MemoryBlockers
from penumbra.errors import MeshError, OutputError, SceneError
from penumbra.io.atomic import atomic_path, check_output, remove_dead_temporaries
from penumbra.memory import call_limit_bytes, resident_bytes
from penumbra.options import IngestOptions, parse_size
from penumbra.progress import NullProgress, Progress
from penumbra.scene import MeshRef

# Compiled kernels and HDF5 take a good part of a small memory limit, so what needs them is imported in
# the calls below, where it is counted.
if TYPE_CHECKING:
    from penumbra.io.blocker_store import BlockerStore

PathLike = str | Path


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
) -> "BlockerStore":
    """Sort meshes of any size into a blocker store, and open it.

    Parameters
    ----------
    meshes
        Mesh files, or stores (.h5), in the order that triangle ids count them.
    output
        The store; it appears when it is whole.
    memory
        Bytes that this call may add to the resident memory, or a size such as "1GiB"; None is half of the
        free memory. With `process_limit` the limit is of the whole process. It changes nothing in the store.
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
    before_bytes = resident_bytes()
    limit_bytes = call_limit_bytes(parse_size(memory), process_limit)
    options = options or IngestOptions()
    progress = progress or NullProgress()

    from penumbra.ingest_plan import check_disk, estimate_triangles, plan_memory
    from penumbra.ingest_sources import SourceStream
    from penumbra.ingest_store import distribute, write_store
    from penumbra.io.blocker_store import open_store
    from penumbra.io.runs import Scratch, scratch_folder

    inputs = _checked_inputs(meshes)
    # Written through a link, as atomic_path does: scratch and temporaries stand beside the file itself.
    output = Path(os.path.realpath(output))
    parent = Path(scratch) if scratch is not None else output.parent
    _prepare_output(output, inputs, parent, overwrite)
    blockers_in_memory(np.tri(3)[None])  # loads the kernels, compiled if need be
    plan = plan_memory(before_bytes, limit_bytes, options.chunk_triangles, process_limit)
    check_disk(*estimate_triangles(inputs), plan, parent, output)
    with scratch_folder(output, parent) as folder, atomic_path(output) as temporary:
        stream = SourceStream(
            inputs,
            skip_bad=skip_bad,
            memory_bytes=plan.reader_bytes,
            batch_triangles=plan.batch_triangles,
            scratch=folder,
            progress=progress,
        )
        found = distribute(stream, Scratch(folder), options.sort)
        check_disk(
            found.counts.n_triangles, found.files.coordinates, plan, folder, output, found.files.n_bytes
        )
        progress.stage("ingest: sorting", found.counts.n_triangles, "triangles")
        write_store(temporary, found, plan, options, progress)
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
    from penumbra.ingest_memory import blockers_of_array, blockers_of_meshes

    options = options or IngestOptions()
    progress = progress or NullProgress()
    if _names_meshes(triangles):
        return blockers_of_meshes(_checked_inputs(triangles), options, skip_bad, progress)
    return blockers_of_array(triangles, ids, options, progress)


def _names_meshes(value: Any) -> bool:
    """Whether an argument is a mesh or several (and not an array of triangles)."""
    if isinstance(value, list | tuple) and value:
        value = value[0]
    return isinstance(value, str | Path | MeshRef)


def _checked_inputs(meshes: Sequence[PathLike | MeshRef] | PathLike | MeshRef) -> list[MeshRef]:
    """Meshes as MeshRefs, at least one, all of them existing files; MeshError names those that are not."""
    several = [meshes] if isinstance(meshes, str | Path | MeshRef) else list(meshes)
    refs = [mesh if isinstance(mesh, MeshRef) else MeshRef(Path(mesh)) for mesh in several]
    if not refs:
        raise MeshError("there is no mesh to ingest: name at least one file")
    missing = [str(ref.path) for ref in refs if not ref.path.exists()]
    if missing:
        raise MeshError(f"{', '.join(missing)}: no such file; check the path")
    return refs


def _prepare_output(output: Path, inputs: Sequence[MeshRef], scratch: Path, overwrite: bool) -> None:
    """Refuse what could not be written at the end, and remove what a killed run left behind."""
    from penumbra.io.runs import remove_dead_scratch

    check_output(output)
    if output.exists() and not overwrite:
        raise OutputError(
            f"{output} is there already: give --overwrite (overwrite=True) to replace it, or another output"
        )
    if any(output == Path(os.path.realpath(mesh.path)) for mesh in inputs):
        raise SceneError(f"{output} is an input of this ingest: choose another output")
    if not scratch.is_dir():
        raise OutputError(f"{scratch}: there is no such folder for scratch files; create it first")
    for folder in {output.parent, scratch}:
        remove_dead_scratch(output, folder)
    remove_dead_temporaries(output)
