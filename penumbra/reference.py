"""6: backend "reference", exact brute force by the definition of a bit; for small scenes and checks."""

import numpy as np

from penumbra.arrays import BlockerChunk, Receivers, UInt8Array, UInt64Array
from penumbra.blockers import Blockers, stream_wanted
from penumbra.executors.threads import run_tasks
from penumbra.facing import face_light
from penumbra.kernels.counters import N_COUNTERS, NAMES
from penumbra.kernels.reference import cast_reference
from penumbra.lights import Light
from penumbra.options import CastOptions
from penumbra.progress import Progress
from penumbra.stats import Stats

_SLICE_RECEIVERS = 4096


def cast_receivers(
    receivers: Receivers,
    blockers: Blockers,
    light: Light,
    *,
    options: CastOptions,
    threads: int,
    progress: Progress,
) -> tuple[UInt64Array, UInt8Array, Stats]:
    """Masks uint64 (R, n_words), sample sets uint8 (R,) and Stats, by testing every pair.

    Takes R * T * K steps: some 4 * 10^9 a minute on one core. Only `group_size` of the options matters,
    and changes nothing that is returned.
    """
    stats = Stats("reference")
    with stats.timed("hierarchy"):
        samples, sample_sets, masks, live = face_light(receivers, light, options.group_size)
    slices = [live[first : first + _SLICE_RECEIVERS] for first in range(0, len(live), _SLICE_RECEIVERS)]
    progress.stage("cast", blockers.n_triangles, "triangles")
    with stats.timed("cast"):
        chunks = stream_wanted(
            blockers, lambda _: bool(slices), large_first=True, progress=progress, stats=stats
        )
        for _, chunk in chunks:

            def cast_slice(rows: np.ndarray, chunk: BlockerChunk = chunk) -> np.ndarray:
                """Cast the chunk on some rows of the masks; the counters (N_COUNTERS,)."""
                counters = np.zeros(N_COUNTERS, np.int64)
                cast_reference(
                    receivers.points,
                    receivers.own,
                    sample_sets,
                    rows,
                    chunk.vertices,
                    chunk.ids,
                    samples,
                    light.samples,
                    masks,
                    counters,
                )
                return counters

            for counters in run_tasks(cast_slice, slices, threads):
                for name, amount in zip(NAMES, counters, strict=True):
                    stats.count(name, amount)
            progress.advance(len(chunk.ids))
    return masks, sample_sets, stats
