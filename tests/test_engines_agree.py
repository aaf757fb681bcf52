"""Two engines that share how a bit is decided and nothing else, on whole pictures of real scenes."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from paths import SHARED

import penumbra
from penumbra.ingest import blockers_in_memory

_spec = importlib.util.spec_from_file_location(
    "bench_scenes", Path(__file__).resolve().parents[1] / "bench" / "scenes.py"
)
assert _spec and _spec.loader
bench_scenes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(bench_scenes)


def agree(name: str, folder: Path, size: tuple[int, int], samples: int) -> float:
    """Cast all receivers of a picture with both engines; returns the share of receivers in penumbra."""
    path = bench_scenes.write_scene(name, folder, meshes=SHARED / "scenes", samples=samples)
    if path is None:
        pytest.skip(f"the mesh of {name} is not on this machine")
    scene = penumbra.Scene.load(path).with_overrides(resolution=size)
    blockers = blockers_in_memory(scene.geometry)
    points, normals, own, pixel = penumbra.camera_receivers(scene)
    masks = []
    for backend in ("hpc", "gears"):
        result = penumbra.cast(
            points, blockers, scene.lights[0], normals=normals, own=own, index=pixel, backend=backend
        )
        masks.append(result.masks)
    assert np.array_equal(*masks)
    return float(((result.visibility > 0) & (result.visibility < 1)).mean())


@pytest.mark.parametrize("name", ["cornell", "bunny", "sponza", "house", "city"])
def test_on_a_small_picture(name: str, tmp_path: Path) -> None:
    assert agree(name, tmp_path, (96, 72), 40) > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("name", bench_scenes.SCENES)
def test_on_a_whole_picture(name: str, tmp_path: Path) -> None:
    assert agree(name, tmp_path, (640, 480), 256) > 0.01
