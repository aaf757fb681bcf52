"""7: masks to visibility and irradiance, a receiver at a time; plain float64, summed pairwise."""

import numpy as np

from penumbra.kernels._jit import helper, kernel

_ONE = np.uint64(1)
_ZERO = np.uint64(0)


@helper
def _fill_terms(point, normal, samples, emission, two_sided, n_samples, terms):
    """Set terms[:n_samples] to cos(receiver) * cos(light) / distance**2 of each sample, at least 0.

    samples: float64 (3, K). With w = sample - point and unit normals n, m the term is
    (n . w)(m . -w) / (w . w)**2; a sample at the receiver itself adds 0.
    """
    for sample in range(n_samples):
        wx = samples[0, sample] - point[0]
        wy = samples[1, sample] - point[1]
        wz = samples[2, sample] - point[2]
        distance_sq = wx * wx + wy * wy + wz * wz
        receiver = normal[0] * wx + normal[1] * wy + normal[2] * wz
        light = -(emission[0] * wx + emission[1] * wy + emission[2] * wz)
        light = abs(light) if two_sided else light
        # Never distance**4, which would underflow for scenes of 1e-80.
        inverse = 1.0 / distance_sq
        term = (max(receiver, 0.0) * inverse) * (max(light, 0.0) * inverse)
        terms[sample] = term if distance_sq > 0.0 else 0.0


@helper
def _sum(terms, n):
    """Sum of terms[:n], n a power of two, pairwise: it vectorises, and rounds less than a running sum."""
    while n > 1:
        n //= 2
        for k in range(n):
            terms[k] += terms[k + n]
    return terms[0]


@kernel
def shade_receivers(
    points, normals, sample_sets, masks, samples, emission, two_sided, scale, first, last, out_shading
):
    """Shade receivers [first, last): out_shading float32 (3, R) rows visibility, irradiance, unshadowed.

    points, normals float64 (R, 3); sample_sets uint8 (R,); masks uint64 (R, n_words), a set bit is
    blocked; samples float64 (sets, 3, K); emission float64 (3,) unit; scale = radiance * area / K.
    """
    n_samples = samples.shape[2]
    padded = 1
    while padded < n_samples:
        padded *= 2
    lit = np.empty(padded)
    terms = np.empty(padded)
    for receiver in range(first, last):
        _fill_terms(
            points[receiver],
            normals[receiver],
            samples[sample_sets[receiver]],
            emission,
            two_sided,
            n_samples,
            terms,
        )
        n_lit = 0
        for start in range(0, n_samples, 64):
            word = ~masks[receiver, start // 64]
            for bit in range(min(64, n_samples - start)):
                seen = (word >> np.uint64(bit)) & _ONE
                lit[start + bit] = terms[start + bit] if seen != _ZERO else 0.0
                n_lit += np.int64(seen)
        for sample in range(n_samples, padded):
            terms[sample] = lit[sample] = 0.0
        out_shading[0, receiver] = n_lit / n_samples
        out_shading[1, receiver] = scale * _sum(lit, padded)
        out_shading[2, receiver] = scale * _sum(terms, padded)
