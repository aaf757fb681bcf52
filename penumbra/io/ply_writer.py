"""Meshes that the program makes itself, as binary PLY."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from penumbra.io.atomic import atomic_path


def write_ply(path: Path, vertices: ArrayLike, triangles: ArrayLike, comment: str) -> None:
    """Write vertices (V, 3), rounded to float32, and triangles (T, 3) of vertex numbers.

    comment: one line for the header. Raises OutputError where the file cannot be written.
    """
    points = np.ascontiguousarray(vertices, "<f4")
    corners = np.asarray(triangles)
    faces = np.empty(len(corners), dtype=[("n", "u1"), ("vertex", "<i4", 3)])
    faces["n"], faces["vertex"] = 3, corners
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment {comment}\n"
        f"element vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(header.encode())
        points.tofile(file)
        faces.tofile(file)
