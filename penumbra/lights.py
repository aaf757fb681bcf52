"""5: lights, their stratified samples, and the light sample hierarchy that casting works on."""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from penumbra.arrays import Float64Array, Int64Array, LightSamples, UInt8Array
from penumbra.errors import SceneError

MAX_SETS = 256
MAX_SAMPLES = 1 << 16
MAX_SEED = 2**63 - 1
PATTERNS = ("jittered", "regular")
# Sixteen roundings of subnormal numbers.
_SUBNORMAL_ROUNDING = 16 * 5e-324
_U64 = np.uint64


@dataclass(frozen=True, eq=False, init=False)
class RectLight:
    """A rectangular (or skewed: any parallelogram) area light that emits along cross(edge_u, edge_v)."""

    corner: Float64Array
    edge_u: Float64Array
    edge_v: Float64Array
    samples: int = 256
    sets: int = 8
    seed: int = 0
    two_sided: bool = False
    radiance: float = 1.0
    name: str = "light"
    pattern: str = "jittered"

    def __init__(
        self,
        corner: ArrayLike,
        edge_u: ArrayLike,
        edge_v: ArrayLike,
        samples: int = 256,
        sets: int = 8,
        seed: int = 0,
        two_sided: bool = False,
        radiance: float = 1.0,
        name: str = "light",
        pattern: str = "jittered",
    ) -> None:
        """Check and keep the numbers.

        corner, edge_u, edge_v: three numbers each, world space. `samples` (K) points per set, one in
        each of K strata of equal area; `sets` distinct sample sets against banding (HPC section 3.4);
        `radiance` in W m^-2 sr^-1. `pattern`: "jittered", a random point of every stratum, or "regular",
        its centre; all sets would then be equal, so `sets` is kept as 1. Raises SceneError for numbers that
        are not finite or out of range, and for other patterns.
        """
        keep = partial(object.__setattr__, self)
        keep("name", str(name))
        for field, vector in (("corner", corner), ("edge_u", edge_u), ("edge_v", edge_v)):
            keep(field, _vector(vector, f"{field} of light '{name}'"))
        with np.errstate(over="ignore"):
            reach = np.abs(self.corner) + np.abs(self.edge_u) + np.abs(self.edge_v)
        if not np.isfinite(reach).all():
            raise SceneError(f"light '{name}' reaches beyond the largest number: make it smaller")
        whole = (
            ("samples", samples, 1, MAX_SAMPLES),
            ("sets", sets, 1, MAX_SETS),
            ("seed", seed, 0, MAX_SEED),
        )
        for field, value, low, high in whole:
            keep(field, _whole_number(value, f"{field} of light '{name}'", low, high))
        keep("radiance", _amount(radiance, f"radiance of light '{name}'"))
        keep("two_sided", bool(two_sided))
        if pattern not in PATTERNS:
            raise SceneError(f"pattern of light '{name}' is {pattern!r}: give 'jittered' or 'regular'")
        keep("pattern", pattern)
        if pattern == "regular":
            keep("sets", 1)

    def settings(self) -> dict[str, Any]:
        """Everything that makes this light, by the keys of a scene file; JSON values."""
        return {
            "name": self.name,
            "type": "rect",
            "corner": self.corner.tolist(),
            "edge_u": self.edge_u.tolist(),
            "edge_v": self.edge_v.tolist(),
            "samples": self.samples,
            "sets": self.sets,
            "seed": self.seed,
            "pattern": self.pattern,
            "radiance": self.radiance,
            "two_sided": self.two_sided,
        }

    @cached_property
    def area(self) -> float:
        """Area of the parallelogram, in squared scene units."""
        with np.errstate(over="ignore", invalid="ignore"):
            return _length(np.cross(self.edge_u, self.edge_v))

    @cached_property
    def emission_normal(self) -> Float64Array:
        """Unit float64 (3,) along cross(edge_u, edge_v); zeros for a light of zero area."""
        with np.errstate(over="ignore", invalid="ignore"):
            normal = np.cross(self.edge_u, self.edge_v)
            return normal / self.area if self.area > 0 else np.zeros(3)

    @cached_property
    def sample_points(self) -> Float64Array:
        """Light samples, float64 (sets, K, 3), world space; consecutive samples are neighbours."""
        s, t = np.moveaxis(self._parameters, -1, 0)
        points: Float64Array = self.corner + s[..., None] * self.edge_u + t[..., None] * self.edge_v
        # Casting keeps a copy of its own: a light whose samples could be changed would not be that light.
        points.setflags(write=False)
        return points

    @cached_property
    def _parameters(self) -> Float64Array:
        """(sets, K, 2): positions of the samples along edge_u and edge_v, in [0, 1)."""
        low, size = _strata(self.samples, _length(self.edge_u), _length(self.edge_v))
        shape = (self.sets, self.samples, 2)
        if self.pattern == "regular":
            jitter = np.full(shape, 0.5)
        else:
            jitter = np.random.default_rng(self.seed).random(shape)
        parameters: Float64Array = low + jitter * size
        parameters.setflags(write=False)
        return parameters

    def light_samples(self, group_size: int) -> LightSamples:
        """Light, groups and samples as casting wants them (HPC section 3.1), `group_size` bits a group."""
        n_groups = -(-self.samples // group_size)
        padded = np.minimum(np.arange(n_groups * group_size), self.samples - 1)
        centred = self._parameters[:, padded] - 0.5
        by_group = centred.reshape(self.sets, n_groups, group_size, 2)
        low, high = by_group.min(axis=(0, 2)), by_group.max(axis=(0, 2))
        origin = self.corner + 0.5 * self.edge_u + 0.5 * self.edge_v
        reach = np.abs(self.corner).max() + np.abs(self.edge_u).max() + np.abs(self.edge_v).max()
        lanes = np.ascontiguousarray(np.moveaxis(centred, -1, 1), dtype=np.float32)
        return LightSamples(
            corner=np.array(self.corner),
            origin=origin,
            edge_u=np.array(self.edge_u),
            edge_v=np.array(self.edge_v),
            parameters=lanes,
            points=np.ascontiguousarray(self.sample_points[:, padded]),
            corners=np.concatenate(
                [self._corners(low.min(0)[None], high.max(0)[None]), self._corners(low, high)]
            ),
            n_samples=self.samples,
            full_groups=_full_groups(self.samples, group_size),
            # Six roundings at most make a sample point, and as many the origin it is compared with.
            residual=16.0 * 2.0**-53 * float(reach) + _SUBNORMAL_ROUNDING,
        )

    def _corners(self, low: Float64Array, high: Float64Array) -> Float64Array:
        """Corners (n, 4, 3), in order around the rectangle, of (n, 2) parameter bounds about the centre."""
        s = np.stack([low[:, 0], high[:, 0], high[:, 0], low[:, 0]], axis=1) + 0.5
        t = np.stack([low[:, 1], low[:, 1], high[:, 1], high[:, 1]], axis=1) + 0.5
        corners: Float64Array = self.corner + s[..., None] * self.edge_u + t[..., None] * self.edge_v
        return corners


@dataclass(frozen=True, eq=False, init=False)
class PointLight:
    """A light without size that shines all round: one sample, so that every shadow is hard."""

    samples: ClassVar[int] = 1
    sets: ClassVar[int] = 1
    seed: ClassVar[int] = 0
    two_sided: ClassVar[bool] = True

    position: Float64Array
    intensity: float = 1.0
    name: str = "light"

    def __init__(self, position: ArrayLike, intensity: float = 1.0, name: str = "light") -> None:
        """Check and keep the numbers.

        position: three numbers, world space. `intensity` in W sr^-1, the same in every direction. Raises
        SceneError for numbers that are not finite, and for an intensity below 0.
        """
        keep = partial(object.__setattr__, self)
        keep("name", str(name))
        keep("position", _vector(position, f"position of light '{name}'"))
        keep("intensity", _amount(intensity, f"intensity of light '{name}'"))

    def settings(self) -> dict[str, Any]:
        """Everything that makes this light, by the keys of a scene file; JSON values."""
        return {
            "name": self.name,
            "type": "point",
            "position": self.position.tolist(),
            "intensity": self.intensity,
        }

    @cached_property
    def sample_points(self) -> Float64Array:
        """The position as the light's only sample, float64 (1, 1, 3), world space."""
        points = self.position.reshape(1, 1, 3)
        points.setflags(write=False)
        return points

    def light_samples(self, group_size: int) -> LightSamples:
        """Light and sample as casting wants them; there is nothing to group, whatever `group_size` says."""
        return LightSamples(
            corner=np.array(self.position),
            origin=np.array(self.position),
            edge_u=np.zeros(3),
            edge_v=np.zeros(3),
            parameters=np.zeros((1, 2, 0), np.float32),
            points=np.array(self.sample_points),
            corners=np.tile(self.position, (1, 4, 1)),
            n_samples=1,
            full_groups=_full_groups(1, group_size),
            residual=0.0,
        )


Light: TypeAlias = RectLight | PointLight


def sample_sets_of(index: Int64Array, seed: int, sets: int) -> UInt8Array:
    """Sample set of each receiver, uint8 (R,): a fixed hash (SplitMix64) of its index and the seed."""
    with np.errstate(over="ignore"):
        key = np.asarray(index, np.int64).view(_U64) + _U64(0x9E3779B97F4A7C15) * (_U64(seed) + _U64(1))
        key = (key ^ (key >> _U64(30))) * _U64(0xBF58476D1CE4E5B9)
        key = (key ^ (key >> _U64(27))) * _U64(0x94D049BB133111EB)
        key ^= key >> _U64(31)
    return ((key >> _U64(32)) * _U64(sets) >> _U64(32)).astype(np.uint8)


def _vector(value: ArrayLike, what: str) -> Float64Array:
    try:
        vector = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise SceneError(f"{what} is {value!r}: give three numbers") from None
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise SceneError(f"{what} is {value!r}: give three finite numbers")
    vector.setflags(write=False)
    return vector


def _amount(value: float, what: str) -> float:
    if not (isinstance(value, int | float | np.number) and np.isfinite(value) and value >= 0):
        raise SceneError(f"{what} is {value!r}: give a number >= 0")
    return float(value)


def _whole_number(value: object, what: str, low: int, high: int) -> int:
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if isinstance(value, float | np.floating):
        whole = bool(np.isfinite(value)) and value == int(value)
    number = int(value) if whole else low - 1  # type: ignore[call-overload]
    if not low <= number <= high:
        raise SceneError(f"{what} is {value!r}: give a whole number from {low} to {high}")
    return number


def _length(edge: Float64Array) -> float:
    # Scaled first: squares of edges beyond 1e154 would overflow.
    largest = float(np.abs(edge).max())
    return largest * float(np.linalg.norm(edge / largest)) if largest > 0 else 0.0


def _strata(n_samples: int, length_u: float, length_v: float) -> tuple[Float64Array, Float64Array]:
    """Lower corners and sizes, (K, 2) each, of K strata of the unit square with equal areas.

    Rows of cells: as many rows as make the cells about square on the light, a power of two when K is
    one (the groups then are blocks of cells); a row's height is its share of the samples, so any K works.
    """
    ratio = length_v / length_u if length_u > 0 and length_v > 0 else 1.0
    rows = np.sqrt(n_samples * ratio)
    if n_samples & (n_samples - 1) == 0:
        rows = 2.0 ** np.round(np.log2(max(rows, 1.0)))
    n_rows = int(np.clip(np.round(rows), 1, n_samples))
    edges = (np.arange(n_rows + 1) * n_samples) // n_rows
    counts = np.diff(edges)
    row = np.repeat(np.arange(n_rows), counts)
    column = np.arange(n_samples) - edges[row]
    size = np.stack([1.0 / counts[row], counts[row] / n_samples], axis=1)
    low = np.stack([column * size[:, 0], edges[row] / n_samples], axis=1)
    order = np.argsort(_hilbert_index(low + 0.5 * size), kind="stable")
    return low[order], size[order]


def _hilbert_index(positions: Float64Array) -> Int64Array:
    """Index of points of the unit square, (n, 2), along a Hilbert curve of order 16."""
    x, y = np.minimum((positions * 65536).astype(np.int64), 65535).T
    index = np.zeros(len(positions), np.int64)
    bit = 1 << 15
    while bit:
        right, upper = (x & bit) > 0, (y & bit) > 0
        index += bit * bit * ((3 * right) ^ upper)
        flip = ~upper & right
        x, y = np.where(flip, 65535 - x, x), np.where(flip, 65535 - y, y)
        x, y = np.where(upper, x, y), np.where(upper, y, x)
        bit >>= 1
    return index


def _full_groups(n_samples: int, group_size: int) -> NDArray[np.uint64]:
    """The bits of each group that stand for a sample, lowest bit first."""
    ones = [(1 << min(group_size, n_samples - start)) - 1 for start in range(0, n_samples, group_size)]
    return np.array(ones, dtype=np.uint64)
