"""Open any mesh file that penumbra reads; the ending of its name tells the format."""

import os
import stat
from pathlib import Path

from penumbra.errors import MeshError
from penumbra.io.mesh_reader import MeshReader

__all__ = ["MeshReader", "open_mesh"]

_BLOCK_BYTES = 1 << 20


def open_mesh(
    path: str | Path,
    *,
    skip_bad: bool = False,
    memory_bytes: int = 256 << 20,
    scratch: Path | None = None,
    block_bytes: int = _BLOCK_BYTES,
) -> MeshReader:
    """Open a mesh for streaming.

    Parameters
    ----------
    path
        An OBJ or PLY file of any size, or a small file of another format that trimesh reads.
    skip_bad
        Drop and count faces that cannot be used, instead of refusing the file.
    memory_bytes
        Memory for the vertices; more vertices than fit go to a scratch file.
    scratch
        Folder of the scratch file; None: the system's folder for temporary files.
    block_bytes
        How much of the file is read at a time.

    Raises
    ------
    MeshError
        The file is missing, empty, or its header is not usable; faults further on are raised by `batches`.
    """
    path = Path(path)
    size_bytes = _file_size(path)
    suffix = path.suffix.lower()
    try:
        if suffix == ".obj":
            from penumbra.io.obj import ObjReader

            return ObjReader(path, size_bytes, skip_bad, memory_bytes, scratch, block_bytes)
        if suffix == ".ply":
            from penumbra.io.ply import PlyReader

            return PlyReader(path, size_bytes, skip_bad, memory_bytes, scratch, block_bytes)
        from penumbra.io.other_formats import OtherReader

        return OtherReader(path, size_bytes, skip_bad, memory_bytes)
    except OSError as error:
        raise MeshError(f"{path}: cannot be read ({error.strerror}).") from error


def _file_size(path: Path) -> int:
    """Size of a regular, readable, non-empty file."""
    try:
        status = os.stat(path)
    except FileNotFoundError as error:
        raise MeshError(f"{path}: there is no such file.") from error
    except (OSError, ValueError) as error:
        raise MeshError(f"{path}: cannot be read ({getattr(error, 'strerror', error)}).") from error
    if stat.S_ISDIR(status.st_mode):
        raise MeshError(f"{path}: is a folder, not a mesh file.")
    if not stat.S_ISREG(status.st_mode):
        raise MeshError(
            f"{path}: is not a regular file; a mesh is read more than once, so save it to a file."
        )
    if status.st_size == 0:
        raise MeshError(f"{path}: the file is empty (0 bytes).")
    return status.st_size
