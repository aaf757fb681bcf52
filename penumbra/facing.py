"""4: which receivers are cast at all, and the bits that are blocked because a sample is not faced."""

from typing import NamedTuple

import numpy as np

from penumbra.arrays import Int64Array, LightSamples, Receivers, UInt8Array, UInt64Array
from penumbra.kernels.facing import FACES_NONE, FACES_SOME, classify_facing, fill_not_facing


class Facing(NamedTuple):
    """State of R receivers before any blocker."""

    state: UInt8Array  # (R,) FACES_ALL, FACES_SOME or FACES_NONE
    rows: Int64Array  # (n,) the receivers that face some samples only
    masks: UInt64Array  # (n, n_words) their bits of the samples that they do not face


def words_of(n_samples: int) -> int:
    """Words of a mask of n_samples bits."""
    return -(-n_samples // 64)


def full_mask(n_samples: int) -> UInt64Array:
    """(n_words,) the mask with every sample blocked; bits beyond the samples stay 0."""
    ones = [(1 << min(64, n_samples - start)) - 1 for start in range(0, n_samples, 64)]
    return np.array(ones, dtype=np.uint64)


def face_light(
    receivers: Receivers, light: LightSamples, sample_sets: UInt8Array, n_samples: int, single_sided: bool
) -> Facing:
    """Class every receiver by exact signs, and fill the masks of those that face some samples only."""
    state = np.empty(len(receivers.points), np.uint8)
    classify_facing(receivers.points, receivers.normals, light, single_sided, state)
    rows = np.flatnonzero(state == FACES_SOME).astype(np.int64)
    masks = np.zeros((len(rows), words_of(n_samples)), np.uint64)
    fill_not_facing(rows, receivers.points, receivers.normals, sample_sets, light, n_samples, masks)
    full = (masks == full_mask(n_samples)).all(axis=1)
    state[rows[full]] = FACES_NONE
    clear = ~masks.any(axis=1)
    keep = ~(full | clear)
    return Facing(state, rows[keep], masks[keep])


def masks_before_casting(facing: Facing, n_samples: int) -> UInt64Array:
    """(R, n_words) masks with the bits of the samples that are not faced."""
    masks = np.zeros((len(facing.state), words_of(n_samples)), np.uint64)
    masks[facing.rows] = facing.masks
    masks[facing.state == FACES_NONE] = full_mask(n_samples)
    return masks
