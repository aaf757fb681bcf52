"""Every bit of `penumbra.cast` is what the exact judge decides, for each backend."""

from collections.abc import Callable
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
from backends import BACKENDS, assert_every_bit, masks_of
from hypothesis import given, settings
from hypothesis import strategies as st
from random_scenes import small_scenes
from scenes import (
    FAMILIES,
    LIGHTS,
    SmallScene,
    light_named,
    random_triangles,
    receivers_below,
    scene_of,
    transformed,
    write_ply,
)

import penumbra
from penumbra import CastOptions, IngestOptions, RectLight

SAMPLE_COUNTS = (1, 2, 31, 32, 33, 63, 64, 65, 100, 256)
# Each family meets each light, with a number of samples that changes from case to case.
CASES = list(
    zip(
        [(family, light) for family in FAMILIES for light in LIGHTS],
        cycle([16, 33, 1, 8, 20, 2, 65]),
        strict=False,
    )
)

SCALES_AND_OFFSETS = [
    (2.0**-20, 0.0),
    (2.0**20, 0.0),
    (1e-6, 0.0),
    (1e6, 0.0),
    (1.0, 1e4),
    (1.0, 1e6),
    (1e-6, 1e4),
    (2.0**-20, 1e6),
    (1e6, 1e6),
]
# Where products of coordinates underflow, are subnormal, or overflow, in one kernel or another.
EXTREME_EXPONENTS = (-320, -300, -200, -160, -150, -108, -106, -104, 100, 103, 104, 150)

# Point light, receiver and one corner after the other of a blocker whose far corners lie, but for
# rounding, in a plane through the segment: no bound may be sized by receivers and light alone.
FAR_CORNERS = [
    (
        [0.13252034159363424, -0.5955890583153038, 4.756192491285759],
        [1.5112753151793488, 0.7823717377791959, -0.41361996208610563],
        [117274.22872907741, 117205.94949616691, -919818.7011922685],
        [-769946.6658448743, -769503.896430487, 6039007.99190538],
        [97645467.2954774, -37557985.41178756, 136163241.1395675],
    ),
    (
        [-0.8222703570661389, 0.47904230870344056, 3.0303501671759494],
        [1.6653659859998755, -1.9320030881652008, -1.3387972108189201],
        [-3568.198095264482, 3458.0202080494437, 18198.54377646949],
        [19061.83526336871, -18475.265142279775, -97209.79782550117],
        [-92635.98537054495, -7682.58705702506, -14601.127976835016],
    ),
]

# Scenes of the family close_to_the_light in which a rounding error at the light, grown by the distance
# of the receiver over that of the blocker, puts a blocked receiver outside its penumbra volume unless
# the volume allows for that: one in sixty scenes does.
AMPLIFIED = [("sliver", 8, 40), ("rotated", 1, 160), ("point", 1, 290), ("line", 2, 894), ("skewed", 2, 908)]

OPTIONS = {
    "no umbra bits": CastOptions(umbra_bits=False),
    "all planes": CastOptions(active_planes=False),
    "eager volumes": CastOptions(lazy_volumes=False),
    "eager masks": CastOptions(lazy_masks=False),
    "unsorted": CastOptions(sort=False),
    "all off": CastOptions(
        umbra_bits=False, active_planes=False, lazy_volumes=False, lazy_masks=False, sort=False
    ),
    "groups of 64": CastOptions(group_size=64),
    "tiles of 1": CastOptions(tile_receivers=1),
    "tiles of 3, leaves of 1": CastOptions(tile_receivers=3, leaf_receivers=1),
    "leaves of 5": CastOptions(leaf_receivers=5),
    "rebuilt at once": CastOptions(rebuild_fraction=1e-9, leaf_receivers=1),
}
OPTION_FAMILIES = ("soup", "lattice", "shared_edges", "around_the_light", "on_blockers", "facing")

pytestmark = pytest.mark.parametrize("backend", BACKENDS)


@pytest.mark.parametrize(("case", "samples"), CASES, ids=lambda value: str(value))
def test_each_family_under_each_light(backend: str, case: tuple[str, str], samples: int) -> None:
    family, light = case
    assert_every_bit(scene_of(family, light_named(light, samples)), backend)


@pytest.mark.parametrize("seed", range(5))
def test_whole_coordinates_where_most_predicates_are_zero(backend: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    corner = rng.integers(-1, 2, 3) + np.array([0, 0, 3])
    # All samples of a light without extent are its corner, exactly.
    light = RectLight(corner, (0, 0, 0), (0, 0, 0), samples=1, two_sided=True)
    points = rng.integers(-3, 4, (60, 3)).astype(float)
    triangles = rng.integers(-2, 3, (4, 3, 3)).astype(float) + np.array([0.0, 0.0, 1.0])
    own = rng.integers(-1, 4, 60)
    assert_every_bit(SmallScene(points, triangles, light, rng.integers(1, 3, (60, 3)) - 2.5, own), backend)
    assert_every_bit(SmallScene(points, triangles, light), backend)


@pytest.mark.parametrize("samples", SAMPLE_COUNTS)
def test_any_number_of_samples(backend: str, samples: int, rng: np.random.Generator) -> None:
    light = light_named("rotated", samples, sets=3)
    triangles = random_triangles(rng, 3, 2.0)
    masks = assert_every_bit(SmallScene(receivers_below(rng, 6), triangles, light), backend)
    assert masks.shape == (6, -(-samples // 64))


@pytest.mark.parametrize("samples", SAMPLE_COUNTS)
def test_padding_bits_are_zero_in_full_shadow(backend: str, samples: int) -> None:
    light = light_named("square above", samples)
    roof = np.array([[[-99.0, -99.0, 2.0], [99.0, -99.0, 2.0], [0.0, 99.0, 2.0]]])
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 4.0], [0.5, 0.5, 9.0], [0.1, 0.2, -1.0]])
    words = [(1 << min(64, samples - first)) - 1 for first in range(0, samples, 64)]
    for normals in (None, np.tile([0.0, 0.0, -1.0], (4, 1))):
        assert masks_of(SmallScene(points, roof, light, normals), backend).tolist() == [words] * 4


@pytest.mark.parametrize(("scale", "offset"), SCALES_AND_OFFSETS)
@pytest.mark.parametrize("family", ["soup", "shared_edges", "on_blockers", "corners_on_segments"])
def test_scales_and_offsets(backend: str, family: str, scale: float, offset: float) -> None:
    for light in ("square above", "skewed"):
        scene = scene_of(family, light_named(light, 12))
        assert_every_bit(transformed(scene, scale, offset), backend)


@pytest.mark.parametrize("exponent", EXTREME_EXPONENTS)
def test_extreme_scales(backend: str, exponent: int) -> None:
    for family in ("soup", "shared_edges", "on_blockers", "corners_on_segments"):
        scene = scene_of(family, light_named("square above", 12), seed=1)
        assert_every_bit(transformed(scene, float(f"1e{exponent}"), 0.0), backend)


@pytest.mark.parametrize("exponent", [-323, -320, -315, -305, -200, 200, 300, 307, 308])
def test_normals_of_any_length(backend: str, exponent: int, rng: np.random.Generator) -> None:
    light = light_named("square above, two-sided", 20)
    points = receivers_below(rng, 30)
    towards = rng.choice(light.sample_points[0], 30) - points
    across = np.cross(towards, rng.normal(0, 1, (30, 3)))
    normals = np.concatenate([across[:15], rng.normal(0, 1, (15, 3))])
    normals = normals / np.abs(normals).max(axis=1, keepdims=True) * float(f"1e{exponent}")
    normals[~normals.any(axis=1)] = [5e-324, 0.0, 0.0]
    assert_every_bit(SmallScene(points, np.zeros((0, 3, 3)), light, normals), backend)


@pytest.mark.parametrize("roll", [0, 1, 2])
@pytest.mark.parametrize("case", FAR_CORNERS)
def test_blockers_with_corners_far_away(backend: str, case: tuple[list[float], ...], roll: int) -> None:
    corner, point, *blocker = np.roll(np.array(case), roll, axis=1)
    light = RectLight(corner, (0, 0, 0), (0, 0, 0), samples=1, two_sided=True)
    scene = SmallScene(point[None], np.array(blocker)[None], light)
    assert assert_every_bit(scene, backend).tolist() == [[1]]


@pytest.mark.parametrize(("light", "samples", "seed"), AMPLIFIED)
def test_blockers_that_almost_touch_the_light(backend: str, light: str, samples: int, seed: int) -> None:
    assert_every_bit(scene_of("close_to_the_light", light_named(light, samples, seed=seed), seed), backend)


@pytest.mark.parametrize("name", OPTIONS)
def test_no_option_changes_a_bit(backend: str, name: str) -> None:
    for family in OPTION_FAMILIES:
        assert_every_bit(scene_of(family, light_named("rotated", 70)), backend, options=OPTIONS[name])


@pytest.mark.parametrize("threads", [1, 2])
def test_threads_change_no_bit(backend: str, threads: int) -> None:
    for family in OPTION_FAMILIES:
        scene = scene_of(family, light_named("rotated", 70))
        assert_every_bit(scene, backend, threads=threads, options=CastOptions(tile_receivers=2))


@pytest.mark.parametrize("options", [IngestOptions(), IngestOptions(chunk_triangles=2, max_buckets=2)])
def test_blockers_from_a_store(backend: str, options: IngestOptions, tmp_path: Path) -> None:
    for number, family in enumerate(OPTION_FAMILIES):
        scene = scene_of(family, light_named("rotated", 70))
        mesh = write_ply(tmp_path / f"{number}.ply", scene.triangles)
        with_store = penumbra.ingest([mesh], tmp_path / f"{number}.h5", options=options)
        assert_every_bit(scene, backend, with_store)
        with_store.close()
        assert_every_bit(scene, backend, tmp_path / f"{number}.h5", threads=2)


def test_ids_go_on_from_one_mesh_to_the_next(backend: str, tmp_path: Path) -> None:
    scene = scene_of("on_blockers", light_named("skewed", 40))
    meshes = [
        write_ply(tmp_path / "a.ply", scene.triangles[:3]),
        write_ply(tmp_path / "b.ply", scene.triangles[3:]),
    ]
    with_store = penumbra.ingest(meshes, tmp_path / "both.h5", options=IngestOptions(chunk_triangles=1))
    assert_every_bit(scene, backend, with_store)
    with_store.close()


@settings(max_examples=60, derandomize=True)
@given(data=st.data())
def test_scenes_drawn_at_random(backend: str, data: Callable[..., object]) -> None:
    # The same examples for every backend and on every run: test_slow_bits.py draws new ones.
    assert_every_bit(data.draw(small_scenes()), backend)  # type: ignore[attr-defined]
