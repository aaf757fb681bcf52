"""Bits of random receivers around real meshes, from arrays and through a store, by the exact judge."""

from pathlib import Path

import numpy as np
import oracle
import pytest
from backends import BACKENDS, way
from paths import scene_file
from scenes import Floats

import penumbra
from penumbra import RectLight

# Mesh, then corner, edge_u and edge_v of a light above it that shines down.
MESHES = {
    "stanford-bunny.obj": ((-0.06, 0.25, -0.04), (0.08, 0.0, 0.01), (0.0, 0.01, 0.09)),
    "CornellBox-Original.obj": ((-0.24, 1.9, -0.22), (0.47, 0.0, 0.0), (0.0, 0.0, 0.38)),
}
N_RECEIVERS = 40
SAMPLES_JUDGED = 2


def obj_triangles(path: Path) -> Floats:
    """Triangles (T, 3, 3) of a plain OBJ file, faces as fans, every number as Python reads it."""
    vertices: list[list[float]] = []
    triangles = []
    for line in path.read_text().splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            vertices.append([float(word) for word in words[:3]])
        elif kind == "f":
            numbers = [int(word.split("/")[0]) for word in words]
            corners = [vertices[number - 1 if number > 0 else number] for number in numbers]
            triangles += [[corners[0], *corners[k : k + 2]] for k in range(1, len(corners) - 1)]
    return np.array(triangles)


def receivers_near(triangles: Floats, rng: np.random.Generator) -> tuple[Floats, np.ndarray]:
    """Points on, or a rounding error off, random triangles, at vertices and anywhere; own triangles."""
    rows = rng.integers(0, len(triangles), N_RECEIVERS)
    on = np.einsum("rk,rkc->rc", rng.dirichlet([1, 1, 1], N_RECEIVERS), triangles[rows])
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    anywhere = rng.uniform(low, high, (N_RECEIVERS, 3))
    points = np.where((np.arange(N_RECEIVERS) % 4 == 0)[:, None], anywhere, on)
    own = np.where(np.arange(N_RECEIVERS) % 4 == 1, rows, -1)
    vertex = np.arange(N_RECEIVERS) % 4 == 2
    points[vertex] = triangles[rows[vertex], 0]
    return points, own


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", MESHES)
def test_random_receivers_of_a_mesh(
    backend: str, name: str, rng: np.random.Generator, tmp_path: Path
) -> None:
    path = scene_file(name)
    triangles = obj_triangles(path)
    corner, edge_u, edge_v = MESHES[name]
    light = RectLight(corner, edge_u, edge_v, samples=40, sets=2)
    points, own = receivers_near(triangles, rng)
    from_array = penumbra.cast(points, triangles, light, own=own, **way(backend))
    penumbra.ingest([path], tmp_path / "mesh.h5").close()
    from_store = penumbra.cast(points, tmp_path / "mesh.h5", light, own=own, **way(backend))
    assert np.array_equal(from_array.masks, from_store.masks)
    bits = np.unpackbits(from_array.masks.view(np.uint8), axis=1, bitorder="little")[:, :40]
    assert 0.05 < bits.mean() < 0.99
    for row in range(N_RECEIVERS):
        judged = rng.choice(40, SAMPLES_JUDGED, replace=False)
        samples = light.sample_points[from_array.sample_set[row], judged]
        blocked = oracle.blocked_samples(
            points[row], triangles, samples, light=(corner, edge_u, edge_v), left_out=int(own[row])
        )
        expected = np.isin(np.arange(SAMPLES_JUDGED), blocked)
        assert np.array_equal(bits[row, judged].astype(bool), expected), (points[row].tolist(), judged)
