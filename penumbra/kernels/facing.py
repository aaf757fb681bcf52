"""Which receivers face the light, and which of its samples: exact signs of the inputs."""

import numpy as np

from penumbra.kernels._jit import helper, kernel
from penumbra.kernels.predicates import (
    OVERFLOW,
    UNDERFLOW,
    UNIT_ROUNDOFF,
    dot_difference_sign,
    edges_side_sign,
)

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


@kernel
def fill_not_facing(rows, points, normals, sample_sets, light, n_samples, masks):
    """Set in masks (n_rows, n_words) the bits of the samples with n . (l - r) <= 0, for given rows."""
    for k in range(rows.shape[0]):
        r = rows[k]
        for sample in range(n_samples):
            point = light.points[sample_sets[r], sample]
            side = dot_difference_sign(
                normals[r, 0], normals[r, 1], normals[r, 2],
                point[0], point[1], point[2], points[r, 0], points[r, 1], points[r, 2],
            )  # fmt: skip
            if side <= 0:
                masks[k, sample >> 6] |= np.uint64(1) << np.uint64(sample & 63)
