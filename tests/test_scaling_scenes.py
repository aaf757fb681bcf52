"""Scenes made for benchmarks: what they are made of, and that subdividing changes no point and no bit."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

import penumbra
from penumbra import RectLight
from penumbra.arrays import Float64Array
from penumbra.errors import SceneError
from penumbra.measure.scaling_scenes import (
    NAMES,
    SCENES,
    atrium,
    flowers,
    grids,
    named_scenes,
    write_scene,
)
from penumbra.measure.scaling_shapes import (
    EXACT_LEVELS,
    REACH,
    Mesh,
    box,
    rotated,
    sheet,
    snapped_mesh,
    subdivided,
    tube,
    turned,
)

SMALL = {
    "grids": lambda: grids(n_layers=2, n_wires=3, n_segments=4),
    "flowers": lambda: flowers(n_side=2),
    "atrium": lambda: atrium(n_bays=2, n_blades=30),
}


def areas(mesh: Mesh) -> Float64Array:
    """Area of every triangle."""
    a, b, c = np.moveaxis(mesh.corners(), 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


@pytest.mark.parametrize("layers, wires, segments", [(1, 2, 1), (3, 4, 5)])
def test_grids_have_the_triangles_that_they_say(layers: int, wires: int, segments: int) -> None:
    assert len(grids(layers, wires, segments).triangles) == 12 * layers * wires * segments + 2


def test_flowers_are_a_floor_and_plants_of_244_or_260_triangles() -> None:
    n_plants, n_triangles = 9, len(flowers(n_side=3).triangles) - 2
    assert 244 * n_plants <= n_triangles <= 260 * n_plants
    assert (n_triangles - 244 * n_plants) % 16 == 0


def test_atrium_grows_by_four_triangles_a_blade() -> None:
    few, more = (len(atrium(n_bays=2, n_blades=n).triangles) for n in (10, 110))
    assert more - few == 400


@pytest.mark.parametrize("name", SCENES)
def test_scenes_are_the_same_at_every_call_and_within_reach(name: str) -> None:
    first, second = SMALL[name](), SMALL[name]()
    assert np.array_equal(first.vertices, second.vertices)
    assert np.array_equal(first.triangles, second.triangles)
    assert np.abs(first.vertices).max() < REACH
    assert areas(first).min() > 0
    assert first.vertices[:, 1].min() == 0  # everything stands on its floor


def test_area_of_shapes() -> None:
    angle = np.pi / 7
    parts = {
        "box": (box((0, 0, 0), (1, 2, 3)), 22.0),
        "rotated": (rotated(box((0, 0, 0), (1, 2, 3)), angle), 22.0),
        "tube": (tube(np.array([[0.0, 0, 0], [4, 0, 0]]), (0, 1, 0), (0, 0, 1), 6), 24.0),
        "turned": (turned([(1.0, 0.0), (1.0, 2.0)], 4), 4 * 2.0 * np.sqrt(2)),
        "sheet": (sheet(np.stack(np.meshgrid(*[np.arange(4.0)] * 2, [0.0]), -1)[:, :, 0]), 9.0),
    }
    for name, (triangles, area) in parts.items():
        found = areas(Mesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))).sum()
        assert found == pytest.approx(area, rel=1e-12), name


def test_a_box_is_closed_and_stays_so() -> None:
    mesh = snapped_mesh([box((-1, -1, -1), (1, 2, 3))])
    for levels in (0, 2):
        as_trimesh = trimesh.Trimesh(*subdivided(mesh, levels), process=False)
        assert as_trimesh.is_watertight and as_trimesh.euler_number == 2
        assert as_trimesh.volume == pytest.approx(24.0)


def test_snapping_leaves_out_what_it_makes_degenerate_and_refuses_what_is_too_far() -> None:
    sliver = np.array([[[0, 0, 0], [1, 0, 0], [2, 1e-6, 0]]], np.float64)
    assert len(snapped_mesh([sliver]).triangles) == 0
    with pytest.raises(ValueError, match="keep it within 16"):
        snapped_mesh([sliver * REACH])


@pytest.mark.parametrize("name", SCENES)
def test_subdividing_keeps_the_surface_to_the_last_bit(name: str) -> None:
    mesh = SMALL[name]()
    fine = subdivided(mesh, 2)
    assert len(fine.triangles) == 16 * len(mesh.triangles)
    assert areas(fine).sum() == pytest.approx(areas(mesh).sum(), rel=1e-9)
    # In whole steps of 2**-16 all is exact: every child lies in its parent's plane, and within its box.
    parents = np.rint(mesh.corners() * 2**16).astype(np.int64)
    children = np.rint(fine.corners() * 2**16).astype(np.int64).reshape(-1, 48, 3)
    assert np.array_equal(children / 2**16, fine.corners().reshape(-1, 48, 3))
    a, b, c = np.moveaxis(parents, 1, 0)
    normals = np.cross(b - a, c - a)
    # Coordinates below 2**20 make products below 2**63.
    assert not np.einsum("tk,tnk->tn", normals, children - a[:, None]).any()
    assert (children >= parents.min(axis=1)[:, None]).all()
    assert (children <= parents.max(axis=1)[:, None]).all()


def test_subdivided_vertices_are_exact_in_float32() -> None:
    triangle = np.array([[[-15.99, 0, 15.99], [15.99, 0.001, 0], [0, 15.99, -15.99]]])
    fine = subdivided(snapped_mesh([triangle]), EXACT_LEVELS)
    assert len(fine.triangles) == 4**EXACT_LEVELS
    assert np.array_equal(fine.vertices, fine.vertices.astype(np.float32))


def test_subdividing_changes_no_bit() -> None:
    mesh = SMALL["grids"]()
    light = RectLight([-1.5, 9, -1.5], [3, 0, 0], [0, 0, 3], samples=64, sets=2)
    rng = np.random.default_rng(5)
    points = rng.uniform([-3, 0.001, -3], [3, 1.6, 3], (300, 3))
    masks = [penumbra.cast(points, subdivided(mesh, n).corners(), light).masks for n in (0, 1, 2)]
    assert masks[0] is not None and masks[0].any() and not masks[0].all()
    for other in masks[1:]:
        assert np.array_equal(masks[0], other)


def test_scene_files_of_every_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, make in SMALL.items():
        monkeypatch.setitem(SCENES, name, (make, SCENES[name][1]))
    with named_scenes([], tmp_path) as found:
        assert tuple(scene.name for scene in found) == NAMES
        scenes = {scene.name: penumbra.Scene.load(scene.path) for scene in found}
        for name, make in SMALL.items():
            (mesh,) = scenes[name].geometry
            read = trimesh.load(mesh.path, process=False)
            assert np.array_equal(read.vertices, make().vertices.astype(np.float32))
            assert np.array_equal(read.faces, make().triangles)
            light, larger = scenes[name].lights[0], scenes[f"{name}-4x"].lights[0]
            assert isinstance(light, RectLight) and isinstance(larger, RectLight)
            assert larger.area == pytest.approx(4 * light.area)
            for side in (light, larger):
                assert side.emission_normal == pytest.approx([0, -1, 0])
            middles = [side.corner + 0.5 * (side.edge_u + side.edge_v) for side in (light, larger)]
            assert middles[0] == pytest.approx(middles[1])
    assert not list(tmp_path.iterdir())


def test_a_subdivided_scene_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SCENES, "grids", (SMALL["grids"], SCENES["grids"][1]))
    scene = penumbra.Scene.load(write_scene("grids", tmp_path, levels=1).path)
    read = trimesh.load(scene.geometry[0].path, process=False)
    assert len(read.faces) == 4 * len(SMALL["grids"]().triangles)


def test_what_is_neither_a_file_nor_a_name(tmp_path: Path) -> None:
    with (
        pytest.raises(SceneError, match="'meadow': use a scene file, or one of grids"),
        named_scenes(["meadow"]),
    ):
        pass
