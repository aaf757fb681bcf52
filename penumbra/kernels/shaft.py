"""The shaft between a tile of receivers and the light (Haines & Wallace 1991).

Whole boxes outside it can block nothing there. Its planes bound both boxes in twelve directions, so
any rounding of a direction is harmless.
"""

import numpy as np

from penumbra.kernels._jit import helper, kernel
from penumbra.kernels.predicates import OVERFLOW, UNDERFLOW, UNIT_ROUNDOFF

N_SHAFT_PLANES = 12


@kernel
def fill_shaft(tile_box, light_box, extent, box, planes):
    """Set box (6,) to the union of two boxes, and planes (12, 4) to lines joining their corners.

    For each pair of axes and each of four corners of the two rectangles seen along the third axis,
    the line from one corner to the other bounds the hull if it is tangent; if it is not, its bound is
    only loose. extent: largest coordinate of the two boxes and of every box that will be tested.
    """
    for k in range(3):
        box[k] = min(tile_box[k], light_box[k])
        box[3 + k] = max(tile_box[3 + k], light_box[3 + k])
    n = 0
    for axis in range(3):
        i = (axis + 1) % 3
        j = (axis + 2) % 3
        for corner in range(4):
            ci = i + 3 * (corner & 1)
            cj = j + 3 * (corner >> 1)
            di = light_box[ci] - tile_box[ci]
            dj = light_box[cj] - tile_box[cj]
            ni, nj = -dj, di
            # Outward: away from the rectangles' other corners.
            if (ni < 0.0) == ((corner & 1) == 1) and ni != 0.0:
                ni, nj = -ni, -nj
            elif ni == 0.0 and (nj < 0.0) == ((corner >> 1) == 1):
                nj = -nj
            high = -np.inf
            for other in (tile_box, light_box):
                high = max(
                    high,
                    max(ni * other[i], ni * other[3 + i]) + max(nj * other[j], nj * other[3 + j]),
                )
            norm = abs(ni) + abs(nj)
            planes[n, :] = 0.0
            if norm * extent < OVERFLOW:
                planes[n, i] = ni
                planes[n, j] = nj
                planes[n, 3] = high + 16.0 * UNIT_ROUNDOFF * norm * extent + UNDERFLOW
            n += 1


@helper
def outside_shaft(shaft, lx, ly, lz, hx, hy, hz):
    """Whether a box lies wholly outside the shaft."""
    box = shaft.box
    if lx > box[3] or ly > box[4] or lz > box[5] or hx < box[0] or hy < box[1] or hz < box[2]:
        return True
    for k in range(N_SHAFT_PLANES):
        n = shaft.planes[k]
        nearest = min(n[0] * lx, n[0] * hx) + min(n[1] * ly, n[1] * hy) + min(n[2] * lz, n[2] * hz)
        if nearest > n[3]:
            return True
    return False


@helper
def box_outside_shaft(shaft, boxes, k):
    """Whether box k of (n, 2, 3) lies wholly outside the shaft."""
    return outside_shaft(
        shaft,
        boxes[k, 0, 0], boxes[k, 0, 1], boxes[k, 0, 2],
        boxes[k, 1, 0], boxes[k, 1, 1], boxes[k, 1, 2],
    )  # fmt: skip


@helper
def triangle_outside_shaft(shaft, tri):
    """Whether a triangle (3, 3) lies wholly outside the shaft's box or one of its planes."""
    if outside_shaft(
        shaft,
        min(min(tri[0, 0], tri[1, 0]), tri[2, 0]),
        min(min(tri[0, 1], tri[1, 1]), tri[2, 1]),
        min(min(tri[0, 2], tri[1, 2]), tri[2, 2]),
        max(max(tri[0, 0], tri[1, 0]), tri[2, 0]),
        max(max(tri[0, 1], tri[1, 1]), tri[2, 1]),
        max(max(tri[0, 2], tri[1, 2]), tri[2, 2]),
    ):
        return True
    for k in range(N_SHAFT_PLANES):
        n = shaft.planes[k]
        nearest = np.inf
        for v in range(3):
            nearest = min(nearest, n[0] * tri[v, 0] + n[1] * tri[v, 1] + n[2] * tri[v, 2])
        if nearest > n[3]:
            return True
    return False


@helper
def blockers_to_skip(shaft, chunk, t):
    """How many blockers of a chunk, from t on, lie outside the shaft together: a run, one, or none."""
    n_left = chunk.ids.shape[0] - t
    if t & 4095 == 0 and box_outside_shaft(shaft, chunk.boxes_4096, t >> 12):
        return min(np.int64(4096), n_left)
    if t & 255 == 0 and box_outside_shaft(shaft, chunk.boxes_256, t >> 8):
        return min(np.int64(256), n_left)
    if t & 15 == 0 and box_outside_shaft(shaft, chunk.boxes_16, t >> 4):
        return min(np.int64(16), n_left)
    return np.int64(triangle_outside_shaft(shaft, chunk.vertices[t]))


@kernel
def runs_touch_shaft(shaft, boxes, out):
    """Set out (n,) to whether each of boxes (n, 2, 3) may touch the shaft."""
    for k in range(boxes.shape[0]):
        out[k] = not box_outside_shaft(shaft, boxes, k)
