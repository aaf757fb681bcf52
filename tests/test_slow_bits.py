"""More of test_bits.py: new random scenes on every run, for as long as some minutes allow."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from backends import BACKENDS, assert_every_bit, masks_of
from hypothesis import HealthCheck, given, settings
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
)

from penumbra import CastOptions, RectLight

pytestmark = [pytest.mark.slow, pytest.mark.parametrize("backend", BACKENDS)]

SAMPLE_COUNTS = (1, 2, 16, 31, 33, 64, 65, 130)


def random_options(rng: np.random.Generator) -> CastOptions:
    """Casting options that cut everything small, with random switches off."""
    return CastOptions(
        **{name: bool(rng.random() < 0.75) for name in ("umbra_bits", "active_planes", "lazy_volumes")},
        **{name: bool(rng.random() < 0.75) for name in ("lazy_masks", "sort")},
        group_size=int(rng.choice([32, 64])),
        tile_receivers=int(rng.choice([1, 3, 100])),
        leaf_receivers=int(rng.choice([1, 2, 16])),
        rebuild_fraction=float(rng.choice([1e-6, 0.25])),
        joint_triangles=int(rng.choice([0, 1 << 40])),
    )


@pytest.fixture
def fresh_rng() -> np.random.Generator:
    """Seeded by the clock; a failure prints the whole scene."""
    return np.random.default_rng()


@settings(max_examples=2000, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_scenes_drawn_at_random(backend: str, data: Callable[..., object]) -> None:
    assert_every_bit(data.draw(small_scenes()), backend)  # type: ignore[attr-defined]


@pytest.mark.parametrize("family", FAMILIES)
def test_families_with_random_options(backend: str, family: str, fresh_rng: np.random.Generator) -> None:
    for _ in range(60):
        light = light_named(
            str(fresh_rng.choice(LIGHTS)),
            int(fresh_rng.choice(SAMPLE_COUNTS)),
            sets=int(fresh_rng.choice([1, 4])),
            seed=int(fresh_rng.integers(1000)),
        )
        scene = scene_of(family, light, seed=int(fresh_rng.integers(2**31)))
        if fresh_rng.random() < 0.5:
            scale = float(fresh_rng.choice([2.0**-20, 2.0**20, 1e-6, 1e6, 1.0]))
            scene = transformed(scene, scale, float(fresh_rng.choice([0.0, 1e4, 1e6])))
        assert_every_bit(scene, backend, options=random_options(fresh_rng))


@pytest.mark.parametrize("family", FAMILIES)
def test_families_at_extreme_scales(backend: str, family: str, fresh_rng: np.random.Generator) -> None:
    for exponent in fresh_rng.integers(-320, 151, 40):
        light = light_named(str(fresh_rng.choice(LIGHTS)), 5, seed=int(fresh_rng.integers(1000)))
        scene = scene_of(family, light, seed=int(fresh_rng.integers(2**31)))
        assert_every_bit(transformed(scene, float(f"1e{exponent}"), 0.0), backend)


def test_blockers_with_corners_far_away(backend: str, fresh_rng: np.random.Generator) -> None:
    for _ in range(4000):
        point, sample = receivers_below(fresh_rng, 1)[0], fresh_rng.uniform([-1, -1, 3], [1, 1, 5])
        light = RectLight(sample, (0, 0, 0), (0, 0, 0), samples=1, two_sided=True)
        on = point + fresh_rng.uniform(0.2, 0.8) * (sample - point)
        axis = np.eye(3)[fresh_rng.integers(3)]
        along = fresh_rng.normal() * (sample - point) + fresh_rng.normal() * axis
        directions = np.array(
            [fresh_rng.random() * along, -fresh_rng.random() * along, fresh_rng.normal(0, 1, 3)]
        )
        triangles = on + 10.0 ** fresh_rng.integers(1, 13) * directions
        assert_every_bit(SmallScene(point[None], triangles[None], light), backend)


def test_whole_coordinates_agree_with_the_brute_force(backend: str, fresh_rng: np.random.Generator) -> None:
    for _ in range(60):
        light = light_named(str(fresh_rng.choice(LIGHTS)), 65, seed=int(fresh_rng.integers(1000)))
        n_triangles = int(fresh_rng.choice([5, 60]))
        scene = SmallScene(
            fresh_rng.integers(-3, 4, (300, 3)).astype(float),
            fresh_rng.integers(-2, 5, (n_triangles, 3, 3)).astype(float),
            light,
            own=fresh_rng.integers(-1, n_triangles, 300),
        )
        scene = transformed(scene, float(fresh_rng.choice([1.0, 1e-3])), float(fresh_rng.choice([0.0, 1e6])))
        found = masks_of(scene, backend, options=random_options(fresh_rng))
        assert np.array_equal(found, masks_of(scene, "reference"))


def test_fine_tessellation_agrees_with_the_brute_force(backend: str, fresh_rng: np.random.Generator) -> None:
    for sets in (1, 8):
        light = light_named("rotated", 256, sets=sets)
        triangles = random_triangles(fresh_rng, 4000, 0.1)
        scene = SmallScene(receivers_below(fresh_rng, 400), triangles, light)
        scene = replace(scene, normals=fresh_rng.normal(0, 1, (400, 3)) + np.array([0.0, 0.0, 1.5]))
        found = masks_of(scene, backend, options=random_options(fresh_rng))
        assert np.array_equal(found, masks_of(scene, "reference"))
