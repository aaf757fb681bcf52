"""Exact brute force by the definition of the visibility bit: every receiver, blocker and sample."""

import numpy as np

from penumbra.kernels._jit import kernel
from penumbra.kernels.counters import PAIRS_TESTED, SAMPLES_TESTED
from penumbra.kernels.segment import plane_side, segment_is_blocked


@kernel
def cast_reference(points, own, sample_sets, rows, vertices, ids, light, n_samples, masks, counters):
    """OR into masks (R, n_words) all bits that blockers (n, 3, 3) block for the given rows.

    Bits already set are left alone; a receiver's own triangle is passed over.
    """
    one = np.uint64(1)
    for k in range(rows.shape[0]):
        r = rows[k]
        rx, ry, rz = points[r, 0], points[r, 1], points[r, 2]
        samples = light.points[sample_sets[r]]
        for t in range(vertices.shape[0]):
            if ids[t] == own[r]:
                continue
            tri = vertices[t]
            side = plane_side(
                tri[0, 0], tri[0, 1], tri[0, 2], tri[1, 0], tri[1, 1], tri[1, 2],
                tri[2, 0], tri[2, 1], tri[2, 2], rx, ry, rz, counters,
            )  # fmt: skip
            counters[PAIRS_TESTED] += 1
            if side == 0:
                continue
            for sample in range(n_samples):
                bit = one << np.uint64(sample & 63)
                if masks[r, sample >> 6] & bit:
                    continue
                counters[SAMPLES_TESTED] += 1
                point = samples[sample]
                if segment_is_blocked(side, rx, ry, rz, point[0], point[1], point[2], tri, counters):
                    masks[r, sample >> 6] |= bit
