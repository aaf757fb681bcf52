"""5: a light in the space of its own where the joint descent works: the unit square at z = 0."""

import numpy as np

from penumbra.arrays import Float64Array, Int64Array, LightSpace, UInt64Array
from penumbra.kernels.joint_casting import N_BINS
from penumbra.lights import RectLight

BLOCK = 256
_U64 = 2.0**-53
_U32 = 2.0**-24
# Above this the light is so small for its coordinates that nearly every lane would be left open (10 times the
# time, scale 1e-6 at offset 1e4): such lights are cast one blocker at a time.
_LARGEST_RESIDUAL = 2.0**-18


def light_space(
    light: RectLight, side: float, points: Float64Array, bounds: Float64Array
) -> LightSpace | None:
    """Light space of a light for receivers on one side (1: the one it emits to, or -1).

    points (R, 3): the receivers; bounds (2, 3): of the blockers. None where the light has no such space
    (edges parallel or zero, or so small and far that float64 cannot place its samples).
    """
    matrix = _matrix(light, side)
    if matrix is None:
        return None
    origin = light.corner + 0.5 * light.edge_u + 0.5 * light.edge_v
    samples = light.sample_points
    with np.errstate(over="ignore", invalid="ignore"):
        corners = np.stack([points.min(axis=0), points.max(axis=0)])
        ends = [np.abs(ends).max(axis=0) for ends in (corners, bounds, samples.reshape(-1, 3))]
        far = np.abs(origin) + np.max(ends, axis=0)
        # Difference, three products, two sums; doubled and rounded up.
        world_error = 16 * _U64 * float((np.abs(matrix) @ far).max())
        placed = (samples - origin) @ matrix.T
        reach = max(1.0, float((np.abs(matrix) @ np.abs(corners - origin).max(axis=0)).max()))
    lanes = placed[..., :2].astype(np.float32)
    residual = (
        float(max(np.abs(placed[..., :2] - lanes).max() - _U32, np.abs(placed[..., 2]).max())) + world_error
    )
    slack = 4 * _U32 * reach + 2 * world_error + residual
    if not (residual < _LARGEST_RESIDUAL and reach < 2.0**30 and np.isfinite(slack)):
        return None
    blocks = _blocked(lanes)
    extents = _extents(blocks)
    return LightSpace(
        matrix=matrix,
        origin=origin,
        handedness=1.0 if np.linalg.det(matrix) > 0 else -1.0,
        parameters=np.ascontiguousarray(np.moveaxis(blocks, -1, 2)),
        tables=_tables(blocks, extents, light.samples),
        extents=extents,
        points=np.ascontiguousarray(_padded(samples)),
        full=_full(light.samples),
        n_words=-(-light.samples // 64),
        slack=slack,
        doubt=(2 * world_error + 2.0**-47 * reach) / _U32,
        residual=residual,
        border=16 * _U32 * (1 + reach),
    )


def heights_above(space: LightSpace, points: Float64Array, rows: Int64Array) -> Float64Array:
    """Heights of points[rows] above the plane of the light, in light space."""
    heights = np.zeros(len(rows))
    for axis in range(3):
        heights += (points[rows, axis] - space.origin[axis]) * space.matrix[2, axis]
    return heights


def _matrix(light: RectLight, side: float) -> Float64Array | None:
    """World vectors to light space, (3, 3); None where the light spans no plane."""
    with np.errstate(all="ignore"):
        normal = np.cross(light.edge_u, light.edge_v)
        lengths = [float(np.linalg.norm(v)) for v in (light.edge_u, light.edge_v, normal)]
        if (
            not all(1e-60 < length < 1e60 for length in lengths)
            or lengths[2] < 1e-6 * lengths[0] * lengths[1]
        ):
            return None
        axes = np.stack([light.edge_u, light.edge_v, side * normal / np.sqrt(lengths[2])], axis=1)
        matrix: Float64Array = np.ascontiguousarray(np.linalg.inv(axes))
        return matrix if np.isfinite(matrix).all() else None


def _padded(values: np.ndarray) -> np.ndarray:
    """(S, K, ...) to (S, 256 B, ...), filled up with copies of the last sample."""
    n_samples = values.shape[1]
    return values[:, np.minimum(np.arange(-(-n_samples // BLOCK) * BLOCK), n_samples - 1)]


def _blocked(lanes: np.ndarray) -> np.ndarray:
    """(S, K, 2) to (S, B, 256, 2)."""
    padded = _padded(lanes)
    return padded.reshape(len(padded), -1, BLOCK, 2)


def _extents(blocks: np.ndarray) -> np.ndarray:
    low, high = blocks.min(axis=(0, 2)), blocks.max(axis=(0, 2))
    # Never 0: `_reached` divides by it, and 0 * inf would drop blockers.
    per_unit = N_BINS / np.maximum(high - low, np.float32(1e-6))
    return np.concatenate([low, high, per_unit], axis=1).astype(np.float32)


def _full(n_samples: int) -> UInt64Array:
    bits = np.arange(-(-n_samples // BLOCK) * BLOCK) < n_samples
    return np.packbits(bits, bitorder="little").view(np.uint64).reshape(-1, 4)


def _tables(blocks: np.ndarray, extents: np.ndarray, n_samples: int) -> UInt64Array:
    """Samples from each bin on and up to each bin, (S + 1, B, 4, N_BINS, 4); see LightSpace."""
    low, per_unit = extents[:, None, :2], extents[:, None, 4:]
    bins = np.clip((blocks - low) * per_unit, 0, N_BINS - 1).astype(np.uint8)
    first = np.concatenate([bins, bins.max(axis=0, keepdims=True)])
    last = np.concatenate([bins, bins.min(axis=0, keepdims=True)])
    every = np.arange(N_BINS, dtype=np.uint8)[:, None]
    exists = (np.arange(blocks.shape[1] * BLOCK) < n_samples).reshape(-1, 1, BLOCK)
    packed = np.empty((len(first), blocks.shape[1], 4, N_BINS, BLOCK // 8), np.uint8)
    # Set by set: as booleans, eight times as large, all of them would be more than the light's samples.
    for number in range(len(first)):
        for axis in range(2):
            above = (first[number, :, None, :, axis] >= every) & exists
            below = (last[number, :, None, :, axis] <= every) & exists
            packed[number, :, 2 * axis] = np.packbits(above, axis=-1, bitorder="little")
            packed[number, :, 2 * axis + 1] = np.packbits(below, axis=-1, bitorder="little")
    return packed.view(np.uint64)
