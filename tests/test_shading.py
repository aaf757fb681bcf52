"""Shading against closed forms and a slow numpy version."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from penumbra.arrays import Float64Array
from penumbra.lights import RectLight
from penumbra.shading import Shading, shade


@dataclass(frozen=True)
class Samples:
    """A light of any samples, which no light class would make."""

    sample_points: Float64Array
    emission_normal: Float64Array
    area: float = 1.0
    radiance: float = 1.0
    two_sided: bool = False


def by_hand(points, normals, sample_sets, masks, light) -> tuple[list[float], list[float], list[float]]:
    """Shade one sample at a time, in the words of the definition."""
    visibility, irradiance, unshadowed = [], [], []
    n_samples = light.sample_points.shape[1]
    for point, normal, sample_set, words in zip(points, normals, sample_sets, masks, strict=True):
        seen, lit, all_of_it = 0, 0.0, 0.0
        for i, sample in enumerate(light.sample_points[sample_set]):
            blocked = int(words[i // 64]) >> (i % 64) & 1
            seen += not blocked
            distance = np.linalg.norm(sample - point)
            if distance == 0:
                continue
            direction = (sample - point) / distance
            cos_light = -np.dot(light.emission_normal, direction)
            cos_light = abs(cos_light) if light.two_sided else max(cos_light, 0.0)
            term = light.radiance * max(np.dot(normal, direction), 0.0) * cos_light / distance**2
            all_of_it += term * light.area / n_samples
            lit += 0.0 if blocked else term * light.area / n_samples
        visibility.append(seen / n_samples)
        irradiance.append(lit)
        unshadowed.append(all_of_it)
    return visibility, irradiance, unshadowed


def unit(vectors: Float64Array) -> Float64Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def one_receiver(light, point=(0.0, 0.0, 0.0), normal=(0.0, 1.0, 0.0)) -> Shading:
    """Shade one receiver that sees every sample."""
    words = np.zeros((1, -(-light.sample_points.shape[1] // 64)), dtype=np.uint64)
    return shade(np.array([point]), np.array([normal]), np.zeros(1, dtype=np.uint8), words, light)


@pytest.mark.parametrize("n_samples", [1, 3, 63, 64, 65, 100, 128, 256])
@pytest.mark.parametrize("two_sided", [False, True])
def test_equals_the_slow_version(rng, n_samples, two_sided):
    light = Samples(rng.normal(size=(3, n_samples, 3)), unit(rng.normal(size=3)), 2.5, 7.0, two_sided)
    n = 40
    n_words = -(-n_samples // 64)
    points, normals = rng.normal(size=(n, 3)) * 3, unit(rng.normal(size=(n, 3)))
    points[0] = light.sample_points[0, 0]
    sets = rng.integers(0, 3, n).astype(np.uint8)
    sets[0] = 0
    # Bits from K on are set or not: they must not matter.
    masks = rng.integers(0, 2**64, size=(n, n_words), dtype=np.uint64)
    masks[:4], masks[4:8] = 0, np.uint64(2**64 - 1)
    result = shade(points, normals, sets, masks, light)
    for got, expected in zip(result, by_hand(points, normals, sets, masks, light), strict=True):
        assert got.dtype == np.float32
        np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(result.visibility[:4], 1)
    np.testing.assert_array_equal(result.visibility[4:8], 0)
    np.testing.assert_array_equal(result.irradiance[4:8], 0)
    assert (result.irradiance <= result.irradiance_unshadowed).all()


def test_small_distant_light_is_a_point_light():
    # E = I cos(receiver) / d^2 with intensity I = L A cos(light).
    distance, tilt = 50.0, 0.6
    light = RectLight([-0.005, distance, -0.005], [0.01, 0, 0], [0, 0, 0.01], samples=4, sets=1, radiance=3.0)
    assert np.dot(light.emission_normal, [0, -1, 0]) == pytest.approx(1)
    upwards = replace(light, edge_u=light.edge_v, edge_v=light.edge_u)
    assert one_receiver(upwards).irradiance_unshadowed[0] == 0
    receiver = (0.0, np.cos(tilt), np.sin(tilt))
    expected = 3.0 * 1e-4 * np.cos(tilt) / distance**2
    assert one_receiver(light, normal=receiver).irradiance[0] == pytest.approx(expected, rel=1e-3)
    both = replace(upwards, two_sided=True)
    assert one_receiver(both).irradiance[0] == pytest.approx(3e-4 / 2500, rel=1e-3)


def corner_factor(a: float, b: float, c: float) -> float:
    """Configuration factor from a point to a parallel rectangle a x b at height c, over one corner.

    Howell, "A Catalog of Radiation Heat Transfer Configuration Factors", B-3.
    """
    x, y = a / c, b / c
    u, v = np.sqrt(1 + x * x), np.sqrt(1 + y * y)
    return (x / u * np.arctan(y / u) + y / v * np.arctan(x / v)) / (2 * np.pi)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(("side", "height"), [(2.0, 3.0), (2.0, 0.5), (8.0, 1.0)])
def test_parallel_square_is_its_configuration_factor(side, height, scale):
    s = side * scale
    light = RectLight(
        [-s / 2, height * scale, -s / 2], [s, 0, 0], [0, 0, s], samples=16384, sets=1, radiance=2.0
    )
    factor = 4 * corner_factor(side / 2, side / 2, height)
    # Irradiance has no length in it: the same at every scale. Stratified samples: far below 1 %.
    assert one_receiver(light).irradiance[0] == pytest.approx(2.0 * np.pi * factor, rel=2e-3)


def test_a_sample_at_the_receiver_adds_nothing_finite_or_not():
    points = np.zeros((1, 4, 3))
    points[0, 1:] = [[0, 1, 0], [0, 1e-200, 0], [0, -1, 0]]
    result = one_receiver(Samples(points[:, [0, 1, 3]], np.array([0, -1.0, 0])))
    assert result.irradiance_unshadowed[0] == pytest.approx(1 / 3)
    assert np.isfinite(one_receiver(Samples(points[:, :1], np.array([0, -1.0, 0]))).irradiance[0])
    assert one_receiver(Samples(points[:, [3]], np.array([0, -1.0, 0]))).irradiance_unshadowed[0] == 0


def test_depends_on_no_thread_or_neighbour(rng):
    light = RectLight([0, 2, 0], [1, 0, 0.3], [0, 0.2, 1], samples=100, sets=4, two_sided=True, radiance=5.0)
    n = 20_000
    points, normals = rng.normal(size=(n, 3)), unit(rng.normal(size=(n, 3)))
    sets = rng.integers(0, 4, n).astype(np.uint8)
    masks = rng.integers(0, 2**64, size=(n, 2), dtype=np.uint64)
    everything = shade(points, normals, sets, masks, light, threads=2)
    some = slice(9_001, 9_003)
    alone = shade(points[some], normals[some], sets[some], masks[some], light)
    for whole, serial, part in zip(
        everything, shade(points, normals, sets, masks, light), alone, strict=True
    ):
        np.testing.assert_array_equal(whole, serial)
        np.testing.assert_array_equal(whole[some], part)


def test_no_receivers():
    light = RectLight([0, 2, 0], [1, 0, 0], [0, 0, 1], samples=5)
    none = np.zeros((0, 3))
    result = shade(none, none, np.zeros(0, dtype=np.uint8), np.zeros((0, 1), dtype=np.uint64), light)
    assert [field.shape for field in result] == [(0,)] * 3
