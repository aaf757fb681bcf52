"""Ways to write and read meshes for the reader tests, in plain Python and apart from the readers."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from penumbra.io.meshes import open_mesh

Face = Sequence[int]


def fan_by_hand(vertices: Sequence[Sequence[float]], faces: Sequence[Face]) -> np.ndarray:
    """Triangles (n, 3, 3) of faces with indices from 0."""
    triangles = [(face[0], face[k], face[k + 1]) for face in faces for k in range(1, len(face) - 1)]
    return np.array([[vertices[i] for i in triangle] for triangle in triangles], float).reshape(-1, 3, 3)


def read_all(path: Path, max_triangles: int = 65536, **options: object) -> tuple[np.ndarray, np.ndarray]:
    """Triangles and ids of a whole file."""
    with open_mesh(path, **options) as reader:
        batches = list(reader.batches(max_triangles))
        assert all(0 < len(b.ids) <= max_triangles and len(b.ids) == len(b.vertices) for b in batches)
        wanted = np.float32 if reader.exact_float32 else np.float64
        assert all(b.vertices.dtype == wanted and b.ids.dtype == np.int64 for b in batches)
    return np.concatenate([b.vertices for b in batches]), np.concatenate([b.ids for b in batches])


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two arrays hold the same numbers in the same type, the sign of zero included."""
    return a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes()


def parse_obj_by_hand(path: Path) -> np.ndarray:
    """Triangles of an OBJ file whose lines hold nothing unusual."""
    vertices: list[list[float]] = []
    faces: list[Face] = []
    encoding = "utf-16" if path.read_bytes()[:2] == b"\xfe\xff" else "latin-1"
    for line in path.read_text(encoding).splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([*map(float, words[1:4]), 0.0][:3])
        elif words[:1] == ["f"]:
            indices = [int(w.split("/")[0]) for w in words[1:]]
            faces.append([i - 1 if i > 0 else len(vertices) + i for i in indices])
    return fan_by_hand(vertices, faces)
