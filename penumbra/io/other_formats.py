"""Small meshes in other formats (STL, OFF, GLB, ...), read by trimesh; the whole mesh is in memory."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import trimesh

from penumbra.arrays import Float64Array, Int64Array
from penumbra.errors import MeshError
from penumbra.io.faces import PAGE_FACES, FacePage
from penumbra.io.mesh_reader import MeshReader
from penumbra.io.vertex_table import VertexTable

# Peak growth of the process over the size of the file, 1.3 M triangles: binary STL 9.1, ascii STL 6.7,
# OFF 18, GLB 8.0; the vertex table comes on top.
_MEMORY_FACTOR = 20

# trimesh also opens archives, drawings, and glTF with its data in other files: their size says nothing.
_UNBOUNDED = {"gltf", "obj", "ply"}


class OtherReader(MeshReader):
    """Triangles of a small mesh that trimesh has loaded; coordinates are float64."""

    def __init__(self, path: Path, size_bytes: int, skip_bad: bool, memory_bytes: int) -> None:
        super().__init__(path, size_bytes, skip_bad)
        kind = path.suffix.lower().lstrip(".")
        if kind not in trimesh.exchange.load.mesh_formats() - _UNBOUNDED:
            raise MeshError(
                f"{path}: no mesh format with a name that ends in '{path.suffix}' can be read; "
                "convert it to OBJ or PLY."
            )
        largest_bytes = memory_bytes // _MEMORY_FACTOR
        if size_bytes > largest_bytes:
            raise MeshError(
                f"{path}: a {kind.upper()} file is read whole, so with this memory limit it may have at most "
                f"{largest_bytes} bytes, not {size_bytes}; convert it to PLY, which is streamed."
            )
        self._vertices, self._faces = _load(path)
        self.n_triangles = len(self._faces)

    def _place(self, where: int) -> str:
        return f"face {where} (counted from 0)"

    def _read_vertices(self) -> VertexTable:
        table = VertexTable(np.float64, len(self._vertices), self._vertices.nbytes)
        table.append(self._vertices)
        return table

    def _face_pages(self) -> Iterator[FacePage]:
        for first in range(0, len(self._faces), PAGE_FACES):
            corners = self._faces[first : first + PAGE_FACES]
            yield FacePage(
                np.full(len(corners), 3), corners.reshape(-1), np.arange(first, first + len(corners))
            )


def _load(path: Path) -> tuple[Float64Array, Int64Array]:
    """Vertices and faces of a whole file, nothing merged or dropped."""
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # a loader meets bytes that mean nothing to it in any way it likes
        raise MeshError(
            f"{path}: trimesh cannot read this file ({type(error).__name__}: {error})."
        ) from error
    vertices = np.ascontiguousarray(mesh.vertices, np.float64).reshape(-1, 3)
    return vertices, np.ascontiguousarray(mesh.faces, np.int64).reshape(-1, 3)
