"""4: which receivers are cast at all, and the bits that are blocked because a sample is not faced."""

from typing import NamedTuple

import numpy as np

from penumbra.arrays import Int64Array, LightSamples, Receivers, UInt8Array, UInt64Array
from penumbra.kernels.facing import FACES_NONE, FACES_SOME, classify_facing, fill_not_facing
from penumbra.lights import Light, sample_sets_of


class CastStart(NamedTuple):
    """What every backend starts from: a light's samples, and R receivers before any blocker."""

    samples: LightSamples
    sample_sets: UInt8Array  # (R,)
    masks: UInt64Array  # (R, n_words) with the bits of the samples that are not faced
    live: Int64Array  # the rows that face some sample; the others are not cast


def full_mask(n_samples: int) -> UInt64Array:
    """(n_words,) the mask with every sample blocked; bits beyond the samples stay 0."""
    ones = [(1 << min(64, n_samples - start)) - 1 for start in range(0, n_samples, 64)]
    return np.array(ones, dtype=np.uint64)


def face_light(receivers: Receivers, light: Light, group_size: int) -> CastStart:
    """Choose the receivers' sample sets, and decide by exact signs what they do not face."""
    samples = light.light_samples(group_size)
    sample_sets = sample_sets_of(receivers.index, light.seed, light.sets)
    full = full_mask(light.samples)
    state = np.empty(len(receivers.points), np.uint8)
    classify_facing(receivers.points, receivers.normals, samples, not light.two_sided, state)
    some = np.flatnonzero(state == FACES_SOME).astype(np.int64)
    part = np.zeros((len(some), len(full)), np.uint64)
    fill_not_facing(some, receivers.points, receivers.normals, sample_sets, samples, light.samples, part)
    masks = np.zeros((len(state), len(full)), np.uint64)
    masks[some] = part
    state[some[(part == full).all(axis=1)]] = FACES_NONE
    masks[state == FACES_NONE] = full
    return CastStart(samples, sample_sets, masks, np.flatnonzero(state != FACES_NONE).astype(np.int64))
