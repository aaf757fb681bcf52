"""From a scene file to an EXR, on a scene small enough to check every pixel by brute force."""

import json
import math
import os
import re
from pathlib import Path

import numpy as np
import pytest

import penumbra
from penumbra import plan as plan_module
from penumbra.errors import BackendError, MemoryLimitError, OutputError, SceneError
from penumbra.io.exr import read_header, read_layers
from penumbra.render import plan_render
from penumbra.scene import Scene

WIDTH, HEIGHT = 24, 16
LIGHTS = ("key", "fill")
SCENE = """\
[[geometry]]
path = "floor.obj"
[[geometry]]
path = "things.ply"
[camera]
eye = [0.3, 2.5, 6]
look_at = [0, 0.6, 0]
resolution = [24, 16]
[[light]]
name = "key"
type = "rect"
corner = [-2, 4, -1]
edge_u = [1.5, 0, 0]
edge_v = [0, 0.2, 1.5]
samples = 40
radiance = 10.0
[[light]]
name = "fill"
type = "rect"
corner = [2, 3, 3]
edge_u = [0, 0, -2]
edge_v = [0, 1, 0]
samples = 40
radiance = 3.0
two_sided = true
"""
FLOOR = """\
v -3 0 -3
v 3 0 -3
v 3 0 3
v -3 0 3
f 1 2 3 4
"""
THINGS = np.array(
    [
        [(-1, 0.5, -1), (1, 0.75, -1), (0, 1.5, 0.5)],
        [(1.5, 0, 0), (1.5, 0, 1), (1.5, 1.5, 0.5)],
        [(-2, 0.2, 1), (-1.2, 0.2, 1), (-1.6, 0.9, 1.3)],
        [(0.4, 2, 1), (0.9, 2, 1), (0.6, 2.1, 1.5)],
    ],
    dtype=np.float32,
)


@pytest.fixture
def scene_path(tmp_path) -> Path:
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "floor.obj").write_text(FLOOR)
    vertices = "".join(" ".join(map(str, vertex)) + "\n" for vertex in THINGS.reshape(-1, 3).tolist())
    faces = "".join(f"3 {3 * n} {3 * n + 1} {3 * n + 2}\n" for n in range(len(THINGS)))
    header = (
        "ply\nformat ascii 1.0\n"
        f"element vertex {3 * len(THINGS)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(THINGS)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    (folder / "things.ply").write_text(header + vertices + faces)
    (folder / "scene.toml").write_text(SCENE)
    return folder / "scene.toml"


def assert_same_layers(a, b):
    assert sorted(a) == sorted(b)
    for name in a:
        assert np.array_equal(a[name], b[name]), name


def blocked(points, samples, triangles):
    """(R, K) whether the open segment point-sample meets any of its row's triangles, plain float64."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    direction = (samples - points[:, None])[:, :, None]
    p = np.cross(direction, c - a)
    det = ((b - a) * p).sum(-1)
    with np.errstate(all="ignore"):
        from_a = (points[:, None] - a)[:, None]
        u = (from_a * p).sum(-1) / det
        q = np.cross(from_a, b - a)
        v = (direction * q).sum(-1) / det
        t = ((c - a) * q).sum(-1) / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1)
    return hit


def test_layers_agree_with_brute_force(scene_path, tmp_path):
    output = tmp_path / "out.exr"
    penumbra.render(scene_path, output)
    layers = read_layers(output)
    scene = Scene.load(scene_path)
    points, normals, own, pixel = penumbra.camera_receivers(scene)
    floor = np.array([[(-3, 0, -3), (3, 0, -3), (3, 0, 3)], [(-3, 0, -3), (3, 0, 3), (-3, 0, 3)]])
    triangles = np.concatenate([floor, THINGS]).astype(np.float64)

    assert (layers["id"] == 0xFFFFFFFF).sum() == WIDTH * HEIGHT - len(pixel)
    assert np.array_equal(layers["id"].ravel()[pixel], own)
    for axis, letter in enumerate("XYZ"):
        assert np.array_equal(layers[f"P.{letter}"].ravel()[pixel], points[:, axis].astype(np.float32))
        assert np.array_equal(layers[f"N.{letter}"].ravel()[pixel], normals[:, axis].astype(np.float32))
    eye, forward = np.array(scene.camera.eye), scene.camera.frame().forward
    assert layers["Z"].ravel()[pixel] == pytest.approx((points - eye) @ forward)

    radiance = 0
    for light in scene.lights:
        result = penumbra.cast(points, triangles, light, normals=normals, own=own, index=pixel)
        samples = light.sample_points[result.sample_set]
        away = samples - points[:, None]
        square = (away**2).sum(-1)
        cos_receiver = (away * normals[:, None]).sum(-1) / np.sqrt(square)
        cos_light = -(away @ light.emission_normal) / np.sqrt(square)
        cos_light = abs(cos_light) if light.two_sided else np.maximum(cos_light, 0)
        hit = blocked(points, samples, triangles)
        hit[np.arange(len(own)), :, own] = False
        lit = ~hit.any(-1) & (cos_receiver > 0) & (cos_light > 0)
        visibility = layers[f"{light.name}.visibility"].ravel()
        assert np.array_equal(visibility[pixel], result.visibility)
        # Plain float64 may take a grazing sample for the other side.
        assert np.count_nonzero(abs(visibility[pixel] - lit.mean(-1)) > 1e-6) <= 2
        each = light.radiance * np.maximum(cos_receiver, 0) * cos_light / square * light.area / light.samples
        irradiance = layers[f"{light.name}.irradiance"].ravel()
        assert irradiance[pixel] == pytest.approx((each * lit).sum(-1), rel=1e-4, abs=1e-5)
        unshadowed = layers[f"{light.name}.irradiance_unshadowed"].ravel()
        assert unshadowed[pixel] == pytest.approx(each.sum(-1), rel=1e-4, abs=1e-5)
        assert 0 < visibility[pixel].mean() < 1
        radiance = radiance + 0.8 / math.pi * irradiance
    for name in "RGB":
        assert layers[name].ravel() == pytest.approx(radiance, rel=1e-5)


def test_background_and_types(scene_path):
    image = penumbra.render(scene_path)
    background = image.layers["id"] == 0xFFFFFFFF
    assert background.any()
    assert not background.all()
    for name, layer in image.layers.items():
        assert layer.shape == (HEIGHT, WIDTH)
        assert layer.dtype == (np.uint32 if name == "id" else np.float32)
        if name != "id":
            assert np.isinf(layer[background]).all() if name == "Z" else not layer[background].any()
    expected = {f"{light}.{layer}" for light in LIGHTS for layer in ("visibility", "irradiance")}
    assert expected < set(image.layers)


def test_header(scene_path, tmp_path):
    image = penumbra.render(scene_path, tmp_path / "out.exr", crop=(3, 2, 20, 14), seed=5)
    header = read_header(tmp_path / "out.exr")
    assert header["dataWindow"] == (3, 2, 19, 13)
    assert header["displayWindow"] == (0, 0, WIDTH - 1, HEIGHT - 1)
    assert header["compression"] == "ZIP_COMPRESSION"
    assert header["penumbra:samples"] == 40
    assert header["penumbra:seed"] == 5
    assert header["penumbra:version"] == penumbra.__version__
    assert header["penumbra:peak_bytes"] > 1 << 20
    assert header["penumbra:seconds"] > 0
    assert header["penumbra:pairs_tested"] == image.stats.counters["pairs_tested"] > 0
    assert "1 = fully lit" in header["comments"]
    settings = json.loads(header["penumbra:settings"])
    assert [light["name"] for light in settings["lights"]] == list(LIGHTS)
    assert [mesh["file"] for mesh in settings["geometry"]] == ["floor.obj", "things.ply"]


def test_crop_is_exactly_a_part_of_the_picture(scene_path):
    full = penumbra.render(scene_path).layers
    x0, y0, x1, y1 = window = (5, 4, 19, 15)
    crop = penumbra.render(scene_path, crop=window).layers
    assert_same_layers(crop, {name: layer[y0:y1, x0:x1] for name, layer in full.items()})


def test_threads_backends_and_passes_change_nothing(scene_path, monkeypatch):
    first = penumbra.render(scene_path, threads=1)
    assert_same_layers(penumbra.render(scene_path, threads=2).layers, first.layers)
    assert_same_layers(penumbra.render(scene_path, backend="reference").layers, first.layers)
    # As if every receiver took a mebibyte: the same limit then needs several passes.
    monkeypatch.setattr(plan_module, "_CAST_BYTES", 1 << 20)
    plan = plan_render(scene_path, memory="350MiB")
    assert 1 < len(plan.passes) <= HEIGHT
    assert_same_layers(penumbra.render(scene_path, memory="350MiB").layers, first.layers)


def test_where_the_blockers_come_from_changes_nothing(scene_path, tmp_path, monkeypatch):
    folder = scene_path.parent
    in_memory = penumbra.render(scene_path)
    store_scene = folder / "store.toml"
    penumbra.ingest([folder / "floor.obj", folder / "things.ply"], folder / "scene.h5").close()
    geometry = SCENE[: SCENE.index("[camera]")]
    store_scene.write_text(SCENE.replace(geometry, '[[geometry]]\npath = "scene.h5"\n'))
    assert plan_render(store_scene).source == "store"
    assert_same_layers(penumbra.render(store_scene).layers, in_memory.layers)

    monkeypatch.setattr(plan_module, "_READ_TRIANGLE_BYTES", 1 << 40)
    assert plan_render(scene_path).source == "temporary store"
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    image = penumbra.render(scene_path, tmp_path / "out.exr", scratch=scratch)
    assert_same_layers(image.layers, in_memory.layers)
    penumbra.render(scene_path, tmp_path / "out.exr", overwrite=True)
    assert os.listdir(scratch) == []
    assert sorted(os.listdir(tmp_path)) == ["out.exr", "scene", "scratch"]


def test_image_write(scene_path, tmp_path):
    image = penumbra.render(scene_path, tmp_path / "a.exr")
    image.write(tmp_path / "b.exr")
    assert_same_layers(read_layers(tmp_path / "a.exr"), read_layers(tmp_path / "b.exr"))
    assert read_header(tmp_path / "a.exr").keys() == read_header(tmp_path / "b.exr").keys()


def test_preview_and_stats(scene_path, tmp_path):
    penumbra.render(
        scene_path, tmp_path / "out.exr", preview=tmp_path / "out.png", stats=str(tmp_path / "out.json")
    )
    assert sorted(os.listdir(tmp_path)) == ["out.exr", "out.json", "out.png", "scene"]
    assert (tmp_path / "out.png").read_bytes().startswith(b"\x89PNG")
    numbers = json.loads((tmp_path / "out.json").read_text())
    stages = ("ingest", "visible", "hierarchy", "cast", "shade", "write")
    assert all(numbers[f"seconds_{stage}"] >= 0 for stage in stages)
    assert numbers["backend"] == "hpc"
    assert numbers["n_triangles"] == 6
    assert numbers["n_dropped"] == 0
    assert numbers["passes"] == 1
    for name in ("pairs_tested", "nodes_visited", "bytes_read", "bytes_skipped", "peak_bytes", "n_receivers"):
        assert isinstance(numbers[name], int)


def test_resume(scene_path, tmp_path):
    output = tmp_path / "out.exr"
    first = penumbra.render(scene_path, output, resume=True)
    before = output.stat().st_mtime_ns
    again = penumbra.render(scene_path, output, resume=True, threads=1, memory="1GiB", backend="reference")
    assert output.stat().st_mtime_ns == before
    assert_same_layers(again.layers, first.layers)
    assert (again.resolution, again.window) == (first.resolution, first.window)
    again.write(tmp_path / "copy.exr")
    copied, header = read_header(tmp_path / "copy.exr"), read_header(output)
    assert copied.keys() == header.keys()
    assert all(np.array_equal(copied[name], header[name]) for name in header)
    with pytest.raises(OutputError, match=r"lights\[0\]\.samples 40 -> 41"):
        penumbra.render(scene_path, output, resume=True, samples=41)
    with pytest.raises(OutputError, match="crop"):
        penumbra.render(scene_path, output, resume=True, crop=(0, 0, 5, 5))
    os.utime(scene_path.parent / "floor.obj", ns=(0, 1))
    with pytest.raises(OutputError, match=r"geometry\[0\]\.mtime_ns"):
        penumbra.render(scene_path, output, resume=True)
    assert output.stat().st_mtime_ns == before
    penumbra.render(scene_path, output, resume=True, samples=41, overwrite=True)
    assert read_header(output)["penumbra:samples"] == 41


def test_resume_of_something_else(scene_path, tmp_path):
    output = tmp_path / "out.exr"
    output.write_text("not an image")
    with pytest.raises(OutputError, match="no finished picture"):
        penumbra.render(scene_path, output, resume=True)
    assert output.read_text() == "not an image"


def test_an_output_that_is_there_is_kept(scene_path, tmp_path):
    output = tmp_path / "out.exr"
    output.write_text("precious")
    with pytest.raises(OutputError, match="is there already"):
        penumbra.render(scene_path, output)
    assert output.read_text() == "precious"
    penumbra.render(scene_path, output, overwrite=True)
    assert "id" in read_layers(output)


@pytest.mark.parametrize("what", ["preview", "stats"])
def test_a_preview_or_numbers_that_are_there_are_kept(scene_path, tmp_path, what):
    kept = tmp_path / "kept"
    kept.write_text("precious")
    with pytest.raises(OutputError, match="kept is there already"):
        penumbra.render(scene_path, tmp_path / "out.exr", **{what: kept})
    assert kept.read_text() == "precious" and not (tmp_path / "out.exr").exists()


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"crop": (0, 0, 25, 16)}, SceneError, "crop 0 0 25 16"),
        ({"crop": (4, 4, 4, 8)}, SceneError, "crop 4 4 4 8"),
        ({"crop": (-1, 0, 4, 8)}, SceneError, "crop -1 0 4 8"),
        ({"backend": "magic"}, BackendError, "magic"),
        ({"memory": "8MiB"}, MemoryLimitError, r"give \d+MiB or more"),
        ({"memory": "lots"}, SceneError, "not a size"),
        ({"scratch": "nowhere"}, OutputError, "does not exist"),
        ({"threads": -2}, SceneError, "threads is -2"),
        ({"samples": 0}, SceneError, "samples"),
        ({"resolution": (0, 5)}, SceneError, "resolution"),
    ],
)
def test_what_cannot_be_done_is_refused_before_any_work(scene_path, tmp_path, change, error, words):
    for function in (penumbra.render, plan_render):
        with pytest.raises(error, match=words):
            function(scene_path, tmp_path / "out.exr", **change)
    assert os.listdir(tmp_path) == ["scene"]


def test_the_limit_named_by_a_refusal_does(scene_path):
    with pytest.raises(MemoryLimitError) as refusal:
        penumbra.render(scene_path, memory="8MiB")
    assert "limit of 8.0 MiB" in str(refusal.value)
    enough = re.search(r"give (\d+MiB) or more", str(refusal.value)).group(1)
    assert plan_render(scene_path, memory=enough).passes


def test_an_input_is_never_an_output(scene_path, tmp_path):
    mesh = scene_path.parent / "things.ply"
    for output in (scene_path, mesh):
        content = output.read_bytes()
        with pytest.raises(SceneError, match="is an input"):
            penumbra.render(scene_path, output, overwrite=True)
        with pytest.raises(SceneError, match="is an input"):
            penumbra.render(scene_path, tmp_path / "out.exr", preview=output)
        assert output.read_bytes() == content


def test_missing_geometry(scene_path):
    (scene_path.parent / "things.ply").unlink()
    with pytest.raises(SceneError, match="things.ply"):
        penumbra.render(scene_path)


def test_stores_and_meshes_together(scene_path):
    meshes = penumbra.render(scene_path).layers
    folder = scene_path.parent
    penumbra.ingest([folder / "things.ply"], folder / "things.h5").close()
    scene_path.write_text(SCENE.replace("things.ply", "things.h5"))
    assert_same_layers(penumbra.render(scene_path).layers, meshes)


def test_failing_leaves_nothing_behind(scene_path, tmp_path, monkeypatch):
    def stop(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(plan_module, "_READ_TRIANGLE_BYTES", 1 << 40)
    monkeypatch.setattr("penumbra.film.Film.add_direct_light", stop)
    with pytest.raises(KeyboardInterrupt):
        penumbra.render(scene_path, tmp_path / "out.exr", preview=tmp_path / "out.png")
    assert os.listdir(tmp_path) == ["scene"]


def test_a_picture_of_nothing(scene_path):
    away = Scene.load(scene_path)
    camera = type(away.camera)((0, 2, 6), (0, 5, 30), resolution=(8, 6))
    image = penumbra.render(Scene(away.geometry, camera, away.lights))
    assert (image.layers["id"] == 0xFFFFFFFF).all()
    assert not image.layers["key.visibility"].any()
