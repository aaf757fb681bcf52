"""Point lights: every bit against the exact judge, the limit of a shrinking light, closed forms, Embree."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import oracle
import pytest
from backends import BACKENDS, assert_every_bit, cast_scene, masks_of, way
from hypothesis import given, settings
from hypothesis import strategies as st
from paths import scene_file as shared_scene
from random_scenes import small_scenes
from scenes import (
    FAMILIES,
    LIGHTS,
    Floats,
    SmallScene,
    large_scene,
    light_named,
    random_triangles,
    receivers_below,
    scene_of,
    transformed,
    write_ply,
)
from test_bits import (
    AMPLIFIED,
    EXTREME_EXPONENTS,
    FAR_CORNERS,
    OPTION_FAMILIES,
    OPTIONS,
    SCALES_AND_OFFSETS,
)
from test_embree import MESHES, embree_bits, receivers_above, receivers_behind_vertices

import penumbra
from penumbra import CastOptions, PointLight, RectLight
from penumbra.errors import SceneError
from penumbra.shading import shade

every_backend = pytest.mark.parametrize("backend", BACKENDS)


def as_point(scene: SmallScene) -> SmallScene:
    """The scene with a point light at the first sample of its light."""
    return replace(scene, light=PointLight(scene.light.sample_points[0, 0]))


def at_corner_of(name: str) -> RectLight:
    """The light without extent that stands at the corner of a named one."""
    return RectLight(light_named(name, 1).corner, (0, 0, 0), (0, 0, 0), samples=1, two_sided=True)


@every_backend
@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("family", FAMILIES)
def test_each_family(backend: str, family: str, light: str) -> None:
    assert_every_bit(as_point(scene_of(family, at_corner_of(light))), backend)
    assert_every_bit(as_point(scene_of(family, light_named(light, 1), seed=1)), backend)


@every_backend
@pytest.mark.parametrize("seed", range(6))
def test_whole_coordinates_where_most_predicates_are_zero(backend: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.integers(-3, 4, (80, 3)).astype(float)
    triangles = rng.integers(-2, 3, (4, 3, 3)).astype(float) + np.array([0.0, 0.0, 1.0])
    own = rng.integers(-1, 4, 80)
    light = PointLight(rng.integers(-1, 2, 3) + np.array([0, 0, 3]))
    normals = (rng.integers(1, 3, (80, 3)) - 2.5).astype(float)
    assert_every_bit(SmallScene(points, triangles, light, normals, own), backend)
    assert_every_bit(SmallScene(points, triangles, light), backend)


@every_backend
@pytest.mark.parametrize("weights", [(1, 0, 0), (0, 0.5, 0.5), (0.5, 0.25, 0.25), (2, -0.5, -0.5)])
def test_light_on_a_corner_edge_face_and_plane_of_a_blocker(backend: str, weights: tuple[float, ...]) -> None:
    rng = np.random.default_rng(3)
    triangles = rng.integers(-8, 9, (4, 3, 3)) / 4.0
    position = np.array(weights) @ triangles[0]
    # Some receivers at the light, in the blocker's plane, and on the far side of its corners.
    beyond = 2.0 * triangles.reshape(-1, 3) - position
    points = np.concatenate([position[None], triangles.reshape(-1, 3), beyond, receivers_below(rng, 30)])
    assert_every_bit(SmallScene(points, triangles, PointLight(position)), backend)


@every_backend
@pytest.mark.parametrize(("scale", "offset"), SCALES_AND_OFFSETS)
def test_scales_and_offsets(backend: str, scale: float, offset: float) -> None:
    for family in ("soup", "shared_edges", "on_blockers", "corners_on_segments"):
        scene = as_point(scene_of(family, at_corner_of("skewed")))
        assert_every_bit(transformed(scene, scale, offset), backend)


@every_backend
@pytest.mark.parametrize("exponent", EXTREME_EXPONENTS)
def test_extreme_scales(backend: str, exponent: int) -> None:
    for family in ("soup", "shared_edges", "on_blockers", "corners_on_segments"):
        scene = as_point(scene_of(family, at_corner_of("square above"), seed=1))
        assert_every_bit(transformed(scene, float(f"1e{exponent}"), 0.0), backend)


@every_backend
def test_the_largest_numbers(backend: str) -> None:
    largest = 1.7e308
    points = np.array([[0.0, 0.0, -largest], [0.5, 0.25, -1.0], [largest, largest, -largest]])
    triangles = np.array([[[-largest, -largest, 0.0], [largest, -largest, 0.0], [0.0, largest, 1.0]]])
    for position in ([0.0, 0.0, largest], [0.0, 0.0, 2.0], [largest, largest, largest]):
        assert_every_bit(SmallScene(points, triangles, PointLight(position)), backend)


@every_backend
@pytest.mark.parametrize("roll", [0, 1, 2])
@pytest.mark.parametrize("case", FAR_CORNERS)
def test_blockers_with_corners_far_away(backend: str, case: tuple[list[float], ...], roll: int) -> None:
    position, point, *blocker = np.roll(np.array(case), roll, axis=1)
    scene = SmallScene(point[None], np.array(blocker)[None], PointLight(position))
    assert assert_every_bit(scene, backend).tolist() == [[1]]


@every_backend
@pytest.mark.parametrize(("light", "samples", "seed"), AMPLIFIED)
def test_blockers_that_almost_touch_the_light(backend: str, light: str, samples: int, seed: int) -> None:
    scene = scene_of("close_to_the_light", light_named(light, samples, seed=seed), seed)
    for point in scene.light.sample_points[0]:
        assert_every_bit(replace(scene, light=PointLight(point)), backend)


@every_backend
@pytest.mark.parametrize("name", OPTIONS)
def test_no_option_changes_a_bit(backend: str, name: str) -> None:
    for family in OPTION_FAMILIES:
        scene = as_point(scene_of(family, at_corner_of("rotated")))
        assert_every_bit(scene, backend, options=OPTIONS[name])
        assert_every_bit(scene, backend, options=replace(OPTIONS[name], tile_receivers=2), threads=2)


@every_backend
def test_blockers_from_a_store(backend: str, tmp_path: Path) -> None:
    scene = as_point(scene_of("shared_edges", at_corner_of("rotated")))
    mesh = write_ply(tmp_path / "mesh.ply", scene.triangles)
    with penumbra.ingest([mesh], tmp_path / "mesh.h5") as store:
        assert_every_bit(scene, backend, store)


@settings(max_examples=40, derandomize=True)
@given(data=st.data())
@every_backend
def test_scenes_drawn_at_random(backend: str, data: Callable[..., object]) -> None:
    assert_every_bit(as_point(data.draw(small_scenes())), backend)  # type: ignore[attr-defined]


@every_backend
def test_shape_of_the_result(backend: str) -> None:
    scene = as_point(large_scene(500, 200, at_corner_of("rotated")))
    result = cast_scene(scene, backend)
    assert result.masks is not None
    assert result.masks.shape == (500, 1) and result.masks.dtype == np.uint64
    assert set(result.masks.ravel().tolist()) == {0, 1}
    assert result.sample_set.dtype == np.uint8 and not result.sample_set.any()
    assert np.array_equal(result.visibility, 1.0 - result.masks[:, 0])


@every_backend
@pytest.mark.parametrize("name", ["all on", *OPTIONS])
def test_many_receivers_as_a_light_without_extent(backend: str, name: str) -> None:
    """What is not small: several tiles and levels, rebuilds, and nodes that a blocker shadows as a whole."""
    scene = large_scene(3000, 400, at_corner_of("rotated"))
    roof = np.array([[[-4.0, -4.0, 1.0], [4.0, -4.0, 1.0], [0.0, 1.0, 1.0]]])
    scene = replace(scene, triangles=np.concatenate([scene.triangles, roof]), normals=None)
    assert scene.own is not None
    scene.own[1:400:2] = len(scene.triangles) - 1  # the roof does not block these
    options = replace(OPTIONS.get(name, CastOptions()), tile_receivers=1000)
    result = cast_scene(as_point(scene), backend, options=options)
    assert result.masks is not None and np.array_equal(result.masks, masks_of(scene, "reference"))
    counters = result.stats.as_dict()
    if backend == "hpc":
        for nothing in ("masks_allocated", "mask_bytes", "group_volumes_built", "umbra_groups_skipped"):
            assert counters[nothing] == 0, nothing
        assert counters["escalated_f64"] < 0.01 * counters["pairs_tested"]
        passed_over = counters["umbra_receivers_skipped"] + counters["umbra_nodes_skipped"]
        assert (passed_over + counters["rebuilds"] > 0) == options.umbra_bits


def distance_to_edges(points: Floats, light: Floats, triangles: Floats) -> Floats:
    """Distance (R,) of each segment from a point to the light to the nearest edge of a triangle.

    Ericson, "Real-Time Collision Detection", section 5.1.9.
    """
    first = triangles.reshape(-1, 3)
    along = np.roll(triangles, -1, axis=1).reshape(-1, 3) - first
    d1 = (light - points)[:, None]
    between = points[:, None] - first
    a, e, b = (d1 * d1).sum(-1), (along * along).sum(-1), (d1 * along).sum(-1)
    c, f = (d1 * between).sum(-1), (along * between).sum(-1)
    s = np.clip((b * f - c * e) / np.maximum(a * e - b * b, 1e-300), 0, 1)
    t = np.clip((b * s + f) / e, 0, 1)
    s = np.clip((b * t - c) / a, 0, 1)
    apart = between + s[..., None] * d1 - t[..., None] * along
    nearest: Floats = np.sqrt((apart * apart).sum(-1)).min(axis=1)
    return nearest


@every_backend
def test_a_shrinking_light_tends_to_the_point(backend: str, rng: np.random.Generator) -> None:
    position = np.array([0.1, -0.2, 4.0])
    triangles, points = random_triangles(rng, 12), receivers_below(rng, 300)
    shadow = masks_of(SmallScene(points, triangles, PointLight(position)), backend)
    distance = distance_to_edges(points, position, triangles)
    full = np.uint64((1 << 16) - 1)
    shares = []
    for size in (1.0, 1e-3, 1e-6, 1e-9, 0.0):
        edge_u, edge_v = size * np.array([0.8, 0.1, 0.3]), size * np.array([-0.2, 0.9, 0.1])
        corner = position - 0.5 * edge_u - 0.5 * edge_v
        light = RectLight(corner, edge_u, edge_v, samples=16, sets=1, two_sided=True)
        masks = masks_of(SmallScene(points, triangles, light), backend)
        # While no segment moves across an edge, none changes; rounding moves samples by some 1e-16.
        reach = np.abs(light.sample_points - position).max() * np.sqrt(3.0) + 1e-12
        clear = distance > reach
        assert np.array_equal(masks[clear], shadow[clear] * full), size
        shares.append((masks == shadow * full).mean())
    assert shares[0] < 0.9 and shares[1] > 0.9 and shares[2] == shares[3] == shares[4] == 1.0
    assert 0.1 < shadow.mean() < 0.9


@every_backend
def test_the_shadow_of_a_square_is_a_square(backend: str, rng: np.random.Generator) -> None:
    a, b, c, d = np.array([[-0.5, 1, -0.5], [0.5, 1, -0.5], [0.5, 1, 0.5], [-0.5, 1, 0.5]])
    position = np.array([0.3, 2.5, -0.2])
    points = np.zeros((4000, 3))
    points[:, [0, 2]] = rng.uniform(-3, 3, (4000, 2))
    result = cast_scene(SmallScene(points, np.array([[a, b, c], [a, c, d]]), PointLight(position)), backend)
    # Where the segment from a point of the floor passes the height of the square.
    passing = position + (points - position) * (2.5 - 1) / 2.5
    inside = np.abs(passing[:, [0, 2]]).max(axis=1)
    expected = inside < 0.5
    sure = np.abs(inside - 0.5) > 1e-12
    assert sure.mean() > 0.99
    assert np.array_equal(result.visibility[sure] == 0, expected[sure])
    assert expected.mean() == pytest.approx((2.5 / 1.5) ** 2 / 36, abs=0.02)


@pytest.mark.parametrize("scale", [1e-100, 1e-6, 1.0, 1e6])
def test_irradiance_is_intensity_times_cosine_over_distance_squared(
    scale: float, rng: np.random.Generator
) -> None:
    n = 20_000
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    distances = rng.uniform(0.5, 20, n)
    light = PointLight(np.array([1.0, 2.0, 3.0]) * scale, intensity=7.0 * scale**2)
    points = light.position - directions * distances[:, None] * scale
    masks = rng.integers(0, 2, (n, 1)).astype(np.uint64)
    shading = shade(points, normals, np.zeros(n, np.uint8), masks, light)
    expected = 7.0 * np.maximum((normals * directions).sum(axis=1), 0) / distances**2
    np.testing.assert_allclose(shading.irradiance_unshadowed, expected, rtol=1e-5, atol=1e-9)
    np.testing.assert_array_equal(shading.visibility, 1 - masks[:, 0])
    np.testing.assert_array_equal(shading.irradiance, shading.irradiance_unshadowed * shading.visibility)
    part = slice(9_000, 9_003)
    alone = shade(points[part], normals[part], np.zeros(3, np.uint8), masks[part], light)
    for whole, few in zip(shading, alone, strict=True):
        np.testing.assert_array_equal(whole[part], few)


def test_a_receiver_at_the_light_has_no_irradiance() -> None:
    light, upwards = PointLight((1, 2, 3), intensity=5.0), np.array([[0.0, 1.0, 0.0]])
    shading = shade(light.position[None], upwards, np.zeros(1, np.uint8), np.zeros((1, 1), np.uint64), light)
    assert [float(values[0]) for values in shading] == [1.0, 0.0, 0.0]


def test_a_small_rectangle_far_away_gives_the_same_irradiance(rng: np.random.Generator) -> None:
    # L A cos(light) is the intensity of a light too small to be seen as one with an area.
    points = rng.uniform(-1, 1, (50, 3))
    normals = np.tile([0.0, 1.0, 0.0], (50, 1))
    size = 1e-3
    rect = RectLight([0, 40, 0], [size, 0, 0], [0, 0, size], samples=1, sets=1, radiance=2e6)
    towards = rect.sample_points[0, 0] - points
    none, sets = np.zeros((50, 1), np.uint64), np.zeros(50, np.uint8)
    for row, w in enumerate(towards):
        point = PointLight(rect.sample_points[0, 0], intensity=2e6 * size**2 * w[1] / np.linalg.norm(w))
        one = slice(row, row + 1)
        arguments = (points[one], normals[one], sets[one], none[one])
        assert shade(*arguments, point).irradiance == pytest.approx(shade(*arguments, rect).irradiance)


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"position": (0, 1)}, "position"),
        ({"position": (0, 1, float("nan"))}, "position"),
        ({"position": "above"}, "position"),
        ({"intensity": -1.0}, "intensity"),
        ({"intensity": float("inf")}, "intensity"),
        ({"intensity": "bright"}, "intensity"),
    ],
)
def test_wrong_numbers_are_refused(wrong: dict[str, Any], word: str) -> None:
    with pytest.raises(SceneError, match=f"{word} of light 'lamp'"):
        PointLight(**{"position": (0, 1, 2), "name": "lamp", **wrong})


def test_a_point_light_is_what_it_was_given_and_stays_so() -> None:
    given = np.array([0.1, -0.0, 1e-310])
    light = PointLight(given)
    given[:] = 7.0
    assert light.sample_points.shape == (1, 1, 3) and light.sample_points.dtype == np.float64
    assert light.sample_points.tobytes() == np.array([0.1, -0.0, 1e-310]).tobytes()
    assert (light.samples, light.sets, light.seed, light.two_sided) == (1, 1, 0, True)
    with pytest.raises(ValueError, match="read-only"):
        light.sample_points[0, 0, 0] = 1.0
    with pytest.raises(SceneError, match=r"give a penumbra\.RectLight or a penumbra\.PointLight"):
        penumbra.cast(np.zeros((1, 3)), np.zeros((0, 3, 3)), given)  # type: ignore[arg-type]


# The brute force takes some tenths of a millisecond a receiver.
N_RECEIVERS = {"reference": 1000}
MANY_RECEIVERS = 12_000


@pytest.mark.skipif(find_spec("embreex") is None, reason="embreex is not installed")
@every_backend
@pytest.mark.parametrize("name", MESHES)
def test_agrees_with_embree_or_is_right(
    backend: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    corner, edge_u, edge_v = np.array(MESHES[name])
    light = PointLight(corner + 0.5 * edge_u + 0.5 * edge_v)
    with penumbra.ingest([shared_scene(name)], tmp_path / "mesh.h5") as store:
        chunks = [store.read(number) for number in range(len(store.chunks))]
        triangles = np.concatenate([chunk.vertices for chunk in chunks])
        half = N_RECEIVERS.get(backend, MANY_RECEIVERS) // 2
        hidden = receivers_behind_vertices(triangles, light, half)
        points = np.concatenate([receivers_above(triangles, half), hidden])
        blocked = penumbra.cast(points, store, light, **way(backend)).visibility == 0
    samples = np.broadcast_to(light.position, (len(points), 1, 3))
    occluded = embree_bits(tmp_path, triangles, points, samples)[:, 0]
    differ = np.flatnonzero(blocked != occluded)
    with capsys.disabled():
        print(f"\n{name}, point light, {backend}: {len(differ)} of {len(points)} bits differ from Embree's")
    assert 0.1 < blocked.mean() < 0.95
    for row in differ:
        judged = oracle.blocked_samples(points[row], triangles, light.sample_points[0])
        assert bool(judged) == blocked[row], points[row].tolist()


CHILD = """
import sys
import numpy as np
from test_point_light import cast_small
with np.errstate(all="ignore"):  # unused lanes may hold anything
    np.save(sys.argv[1], cast_small())
"""


def cast_small() -> np.ndarray:
    """Masks of a small scene by every backend, uint64 (n_backends, R, 1); small leaves and tiles."""
    scene = as_point(large_scene(60, 40, at_corner_of("rotated")))
    options = CastOptions(tile_receivers=30, leaf_receivers=4, rebuild_fraction=0.1)
    return np.array([masks_of(scene, backend, options=options) for backend in BACKENDS])


def test_kernels_give_the_same_bits_without_jit(tmp_path: Path) -> None:
    path = [str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(path)}
    output = tmp_path / "masks.npy"
    subprocess.run([sys.executable, "-c", CHILD, str(output)], env=environment, check=True, timeout=300)
    plain = np.load(output)
    assert (plain == plain[0]).all() and np.array_equal(plain, cast_small())
    assert 0.05 < plain.mean() < 0.95
