"""Which receivers face the light, and which of its samples: exact signs of the inputs."""

import numpy as np

from penumbra.kernels._jit import helper, kernel
from penumbra.kernels.bits import lowest_bit
from penumbra.kernels.borrow import borrow
from penumbra.kernels.hard_shadow import LANE_BOUND
from penumbra.kernels.lanes import bits_above, load, splat
from penumbra.kernels.predicates import (
    OVERFLOW,
    UNDERFLOW,
    UNIT_ROUNDOFF,
    dot_difference_sign,
    edges_side_sign,
)

_SMALLEST = 1e-250
_LARGEST = 1e250
FACES_ALL = np.uint8(0)
FACES_SOME = np.uint8(1)
FACES_NONE = np.uint8(2)


@helper
def _normal_faces(px, py, pz, nx, ny, nz, light):
    """Class of a receiver by its normal alone; FACES_SOME where the float64 bound leaves it open."""
    lowest = np.inf
    highest = -np.inf
    reach = 0.0
    for k in range(4):
        dx, dy, dz = light.corners[0, k, 0] - px, light.corners[0, k, 1] - py, light.corners[0, k, 2] - pz
        side = nx * dx + ny * dy + nz * dz
        lowest = min(lowest, side)
        highest = max(highest, side)
        reach = max(reach, abs(dx) + abs(dy) + abs(dz))
    # The samples lie within `residual` of the polygon of the corners; both are rounded points.
    norm = abs(nx) + abs(ny) + abs(nz)
    if not norm * reach < OVERFLOW:
        return FACES_SOME
    bound = norm * (16.0 * UNIT_ROUNDOFF * reach + 2.0 * light.residual) + UNDERFLOW * (1.0 + norm + reach)
    if lowest > bound:
        return FACES_ALL
    return FACES_NONE if highest < -bound else FACES_SOME


@kernel
def classify_facing(points, normals, light, single_sided, out):
    """Fill out (R,) with FACES_ALL, FACES_SOME or FACES_NONE of the light's samples.

    points (R, 3); normals (R, 3), or (0, 3) for receivers that see all round. A receiver behind or in
    the plane of a single-sided light faces none.
    """
    c, u, v = light.corner, light.edge_u, light.edge_v
    for r in range(points.shape[0]):
        px, py, pz = points[r, 0], points[r, 1], points[r, 2]
        if (
            single_sided
            and edges_side_sign(u[0], u[1], u[2], v[0], v[1], v[2], px, py, pz, c[0], c[1], c[2]) <= 0
        ):
            out[r] = FACES_NONE
        elif normals.shape[0] == 0:
            out[r] = FACES_ALL
        else:
            out[r] = _normal_faces(px, py, pz, normals[r, 0], normals[r, 1], normals[r, 2], light)


@helper
def _facing_function(px, py, pz, nx, ny, nz, light):
    """Return n . (l - r) over the light as float32 A + B s + C t, at most 1, and the bound of its lanes."""
    o, u, v = light.origin, light.edge_u, light.edge_v
    gx, gy, gz = o[0] - px, o[1] - py, o[2] - pz
    a = nx * gx + ny * gy + nz * gz
    b = nx * u[0] + ny * u[1] + nz * u[2]
    c = nx * v[0] + ny * v[1] + nz * v[2]
    reach = abs(gx) + abs(gy) + abs(gz)
    for axis in range(3):
        reach += abs(u[axis]) + abs(v[axis])
    norm = abs(nx) + abs(ny) + abs(nz)
    error = norm * (16.0 * UNIT_ROUNDOFF * reach + light.residual) + UNDERFLOW * (1.0 + norm + reach)
    total = abs(a) + abs(b) + abs(c)
    if not (total > _SMALLEST and total < _LARGEST and error < _LARGEST):
        # Nothing is known: every lane is left open.
        zero = np.float32(0.0)
        return zero, zero, zero, np.float32(np.inf)
    scale = 1.0 / max(max(abs(a), abs(b)), abs(c))
    bound = LANE_BOUND + np.float32(1.001 * error * scale)
    return np.float32(a * scale), np.float32(b * scale), np.float32(c * scale), bound


@kernel
def fill_not_facing(rows, points, normals, sample_sets, light, n_samples, masks):
    """Set in masks (n_rows, n_words) the bits of the samples with n . (l - r) <= 0, for given rows."""
    light = borrow(light)
    n_padded = light.parameters.shape[2]
    for k in range(rows.shape[0]):
        r = rows[k]
        x, y, z = points[r, 0], points[r, 1], points[r, 2]
        nx, ny, nz = normals[r, 0], normals[r, 1], normals[r, 2]
        a, b, c, bound = _facing_function(x, y, z, nx, ny, nz, light)
        sample_set = np.int64(sample_sets[r])
        first = sample_set * 2 * n_padded
        for start in range(0, n_samples, 16):
            s, t = load(light.parameters, first + start), load(light.parameters, first + n_padded + start)
            f = splat(a) + splat(b) * s + splat(c) * t
            exists = (np.int64(1) << min(np.int64(16), n_samples - start)) - 1
            not_faced = bits_above(splat(-bound), f) & exists
            left_open = exists & ~not_faced & ~bits_above(f, splat(bound))
            while left_open != 0:
                lane = lowest_bit(np.uint64(left_open))
                left_open &= left_open - 1
                p = light.points[sample_set, start + lane]
                if dot_difference_sign(nx, ny, nz, p[0], p[1], p[2], x, y, z) <= 0:
                    not_faced |= np.int64(1) << lane
            masks[k, start >> 6] |= np.uint64(not_faced) << np.uint64(start & 63)
