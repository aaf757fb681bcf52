"""Bits of many receivers of large meshes against Embree; where the two differ the exact judge decides."""

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import oracle
import pytest
from backends import BACKENDS, way
from paths import scene_file
from scenes import Floats

import penumbra
from penumbra import RectLight
from penumbra.arrays import BoolArray
from penumbra.lights import Light

pytestmark = pytest.mark.skipif(find_spec("embreex") is None, reason="embreex is not installed")

# Mesh, and corner, edge_u and edge_v of a light that shines down on it.
MESHES = {
    "stanford-bunny.obj": ((-0.06, 0.25, -0.04), (0.08, 0.0, 0.01), (0.0, 0.01, 0.09)),
    "sponza_dabrovic.ply": ((-4.0, 14.0, -2.0), (8.0, 0.0, 0.5), (0.0, 0.3, 4.0)),
}
SAMPLES = 32
# The brute force takes some milliseconds a receiver.
N_RECEIVERS = {"reference": 40}
MANY_RECEIVERS = 4000


def receivers_above(triangles: Floats, n_receivers: int) -> Floats:
    """Points a thousandth of the mesh's size off random triangles, along their normals."""
    rng = np.random.default_rng(11)
    rows = rng.integers(0, len(triangles), n_receivers)
    chosen = triangles[rows]
    normals = np.cross(chosen[:, 1] - chosen[:, 0], chosen[:, 2] - chosen[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    size = np.ptp(triangles.reshape(-1, 3), axis=0).max()
    on = np.einsum("rk,rkc->rc", rng.dirichlet([1, 1, 1], n_receivers), chosen)
    return on + 1e-3 * size * normals / np.maximum(lengths, 1e-300)


def receivers_behind_vertices(triangles: Floats, light: Light, n_receivers: int) -> Floats:
    """Points from which a vertex, or the middle of an edge, hides a sample, up to rounding."""
    rng = np.random.default_rng(12)
    chosen = triangles[rng.integers(0, len(triangles), n_receivers)]
    hiding = np.where(rng.random((n_receivers, 1)) < 0.5, chosen[:, 0], (chosen[:, 0] + chosen[:, 1]) / 2.0)
    samples = rng.choice(light.sample_points[0], n_receivers)
    size = np.ptp(triangles.reshape(-1, 3), axis=0).max()
    away = hiding - samples
    lengths = rng.choice([1e-4, 1e-2], (n_receivers, 1)) * size
    return hiding + lengths * away / np.linalg.norm(away, axis=1, keepdims=True)


def embree_bits(folder: Path, triangles: Floats, points: Floats, samples: Floats) -> BoolArray:
    """Whether Embree finds something between points (R, 3) and their samples (R, K, 3)."""
    directions = samples - points[:, None]
    source, target = folder / "segments.npz", folder / "occluded.npy"
    origins = np.broadcast_to(points[:, None], directions.shape)
    np.savez(
        source, triangles=triangles, origins=origins.reshape(-1, 3), directions=directions.reshape(-1, 3)
    )
    child = Path(__file__).with_name("embree_child.py")
    subprocess.run([sys.executable, child, source, target], check=True)
    occluded: BoolArray = np.load(target)
    return occluded.reshape(directions.shape[:2])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", MESHES)
def test_agrees_with_embree_or_is_right(
    backend: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    corner, edge_u, edge_v = MESHES[name]
    light = RectLight(corner, edge_u, edge_v, samples=SAMPLES, sets=1)
    with penumbra.ingest([scene_file(name)], tmp_path / "mesh.h5") as store:
        chunks = [store.read(number) for number in range(len(store.chunks))]
        triangles = np.concatenate([chunk.vertices for chunk in chunks])
        half = N_RECEIVERS.get(backend, MANY_RECEIVERS) // 2
        hidden = receivers_behind_vertices(triangles, light, half)
        points = np.concatenate([receivers_above(triangles, half), hidden])
        result = penumbra.cast(points, store, light, **way(backend))
    bits = np.unpackbits(result.masks.view(np.uint8), axis=1, bitorder="little")[:, :SAMPLES].astype(bool)
    samples = light.sample_points[result.sample_set]
    in_front = points[:, 1] < min(corner[1], corner[1] + edge_v[1])  # no more is blocked by facing away
    occluded = embree_bits(tmp_path, triangles, points, samples)
    differ = np.argwhere((bits != occluded) & in_front[:, None])
    with capsys.disabled():
        print(f"\n{name}, {backend}: {len(differ)} of {in_front.sum() * SAMPLES} bits differ from Embree's")
    assert 0.1 < bits[in_front].mean() < 0.95
    assert len(differ) < 0.002 * bits.size
    for row, sample in differ:
        judged = oracle.blocked_samples(points[row], triangles, samples[row, sample][None])
        assert bool(judged) == bits[row, sample], (points[row].tolist(), samples[row, sample].tolist())
