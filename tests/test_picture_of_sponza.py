"""The visibility layer of a rendered picture, pixel by pixel, by the exact judge."""

from pathlib import Path

import numpy as np
import oracle
import pytest
from paths import scene_file

import penumbra
from penumbra import Camera, MeshRef, RectLight, Scene
from penumbra.io.exr import read_layers
from penumbra.lights import sample_sets_of

N_PIXELS = 500
SAMPLES = 16
CORNER, EDGE_U, EDGE_V = (-2.0, 14.5, -1.25), (4.0, 0.0, 0.0), (0.0, 0.0, 2.5)


def binary_ply_triangles(path: Path) -> np.ndarray:
    """Triangles of a binary PLY of float32 x y z and lists of three int32, read without penumbra."""
    header, _, data = path.read_bytes().partition(b"end_header\n")
    n_vertices, n_faces = (
        int(header.split(word)[1].split()[0]) for word in (b"element vertex", b"element face")
    )
    vertices = np.frombuffer(data, "<f4", 3 * n_vertices).reshape(-1, 3)
    record = np.dtype([("n", "u1"), ("corners", "<i4", 3)])
    faces = np.frombuffer(data, record, n_faces, offset=vertices.nbytes)
    assert (faces["n"] == 3).all()
    return vertices[faces["corners"]].astype(np.float64)


@pytest.mark.slow
def test_visibility_of_random_pixels_is_that_of_the_exact_judge(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    path = scene_file("sponza_dabrovic.ply")
    light = RectLight(CORNER, EDGE_U, EDGE_V, samples=SAMPLES, name="key")
    camera = Camera((-6.5, 4.2, 1.6), (3, 2.2, -3.2), vfov=62, resolution=(320, 240))
    scene = Scene((MeshRef(path),), camera, (light,))
    penumbra.render(scene, tmp_path / "sponza.exr")
    visibility = read_layers(tmp_path / "sponza.exr")["key.visibility"].reshape(-1)
    points, normals, own, pixel = penumbra.camera_receivers(scene)
    triangles = binary_ply_triangles(path)
    sets = sample_sets_of(pixel, light.seed, light.sets)
    # Half of the pixels from the penumbra, where there is most to get wrong.
    partly = np.flatnonzero((visibility[pixel] > 0) & (visibility[pixel] < 1))
    rows = np.concatenate([rng.choice(partly, N_PIXELS // 2), rng.choice(len(pixel), N_PIXELS // 2)])
    for row in rows:
        blocked = oracle.blocked_samples(
            points[row],
            triangles,
            light.sample_points[sets[row]],
            light=(CORNER, EDGE_U, EDGE_V),
            normal=normals[row],
            left_out=int(own[row]),
        )
        expected = np.float32((SAMPLES - len(blocked)) / SAMPLES)
        assert visibility[pixel[row]] == expected, (points[row].tolist(), int(pixel[row]))
