"""7: direct light from the samples that a receiver sees: visibility and irradiance.

The irradiance of a Lambertian light of radiance L and area A, estimated from its K samples, is

    E = L * A / K * sum over visible samples of cos(receiver) * cos(light) / distance**2     W m^-2

(Pharr, Jakob and Humphreys, "Physically Based Rendering", 3rd edition, section 5.5.3, integrals over
area); that of a point light of intensity I is I * cos(receiver) / distance**2. docs/units.md says what
the quantities mean.
"""

from typing import NamedTuple, Protocol

import numpy as np

from penumbra.arrays import Float32Array, Float64Array, UInt8Array, UInt64Array
from penumbra.executors.threads import run_tasks
from penumbra.kernels.shading import shade_receivers
from penumbra.lights import PointLight

SLICE_RECEIVERS = 8192
"""Receivers that one task shades."""


class AreaLight(Protocol):
    """What shading asks of a light with an area."""

    @property
    def sample_points(self) -> Float64Array:
        """(sets, K, 3) world space."""

    @property
    def emission_normal(self) -> Float64Array:
        """(3,) unit: the side a single-sided light shines to."""

    @property
    def area(self) -> float:
        """In squared scene units."""

    @property
    def radiance(self) -> float:
        """W m^-2 sr^-1."""

    @property
    def two_sided(self) -> bool:
        """Whether the light shines to both sides."""


class Shading(NamedTuple):
    """What a light does at each receiver."""

    visibility: Float32Array
    """(R,) fraction of the light's samples not blocked, 1 = fully lit."""
    irradiance: Float32Array
    """(R,) W m^-2, from the samples not blocked."""
    irradiance_unshadowed: Float32Array
    """(R,) W m^-2, as if nothing blocked."""


def shade(
    points: Float64Array,
    normals: Float64Array,
    sample_sets: UInt8Array,
    masks: UInt64Array,
    light: AreaLight | PointLight,
    threads: int = 1,
) -> Shading:
    """Shade receivers from their masks.

    points, normals: float64 (R, 3), world space, normals unit. sample_sets: uint8 (R,). masks: uint64
    (R, ceil(K / 64)), sample i is bit i % 64 of word i // 64, set = blocked; bits from K on are ignored.
    Samples behind the receiver, or behind a single-sided light, add nothing; a two-sided light counts
    |cos|. `threads`: 0 for all cores. The result depends neither on it nor on the other receivers.
    """
    if isinstance(light, PointLight):
        return _shade_from_point(points, normals, masks, light)
    samples = np.array(np.swapaxes(light.sample_points, 1, 2), dtype=np.float64, order="C")
    n, n_samples = len(points), samples.shape[2]
    shading = np.empty((3, n), dtype=np.float32)
    arrays = (
        np.require(points, np.float64, ["C", "W"]),
        np.require(normals, np.float64, ["C", "W"]),
        np.require(sample_sets, np.uint8, ["C", "W"]),
        np.require(masks, np.uint64, ["C", "W"]),
        samples,
        np.array(light.emission_normal, dtype=np.float64),
    )
    scale = float(light.radiance) * float(light.area) / n_samples

    def task(first: int) -> None:
        last = min(first + SLICE_RECEIVERS, n)
        shade_receivers(*arrays, bool(light.two_sided), scale, first, last, shading)

    run_tasks(task, range(0, n, SLICE_RECEIVERS), threads)
    return Shading(*shading)


def _shade_from_point(
    points: Float64Array, normals: Float64Array, masks: UInt64Array, light: PointLight
) -> Shading:
    """Shade receivers from the one bit that each has; plain float64, a slice of receivers at a time."""
    shading = np.empty((3, len(points)), dtype=np.float32)
    for first in range(0, len(points), SLICE_RECEIVERS):
        rows = slice(first, first + SLICE_RECEIVERS)
        lit = (masks[rows, 0] & np.uint64(1)) == 0
        nx, ny, nz = normals[rows].T
        # A receiver at the light divides by zero, and is then left out.
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            wx, wy, wz = (light.position - points[rows]).T
            distance_sq = wx * wx + wy * wy + wz * wz
            cosine = np.maximum(nx * wx + ny * wy + nz * wz, 0.0) / np.sqrt(distance_sq)
            unshadowed = np.where(distance_sq > 0.0, light.intensity * (cosine / distance_sq), 0.0)
            shading[:, rows] = lit, np.where(lit, unshadowed, 0.0), unshadowed
    return Shading(*shading)
