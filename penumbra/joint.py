"""6: the joint descent: leaves of receivers through the hierarchy of each chunk, in light space."""

from collections.abc import Callable

import numpy as np

from penumbra.arrays import (
    BlockerChunk,
    BlockerTree,
    Float64Array,
    Int64Array,
    JointScratch,
    LightSpace,
    ReceiverLeaves,
    Receivers,
    UInt8Array,
    UInt64Array,
)
from penumbra.executors.threads import run_tasks
from penumbra.kernels.counters import N_COUNTERS
from penumbra.kernels.joint_casting import cast_leaves
from penumbra.kernels.light_space import FAR, N_LANES, fill_tree_part
from penumbra.kernels.receiver_leaves import LEAF, fill_leaves, fill_z_keys, sort_keys


class JointReceivers:
    """Receivers on one side of a light, in leaves, and what casting a chunk on them needs."""

    def __init__(
        self,
        rows: Int64Array,
        receivers: Receivers,
        sample_sets: UInt8Array,
        light: LightSpace,
        masks: UInt64Array,
        threads: int,
    ) -> None:
        """rows: which receivers; masks (R, n_words) are cast on in place."""
        self.light = light
        n_leaves = -(-len(rows) // LEAF)
        order = _z_order(receivers.points, rows, threads)
        self.leaves = ReceiverLeaves(
            high=np.empty((n_leaves, 3, LEAF), np.float32),
            low=np.empty((n_leaves, 3, LEAF), np.float32),
            boxes=np.empty((n_leaves, 6), np.float32),
            count=np.empty(n_leaves, np.int32),
            is_done=np.zeros(n_leaves, np.uint8),
            row=np.empty(n_leaves * LEAF, np.int64),
            points=receivers.points,
            own=receivers.own,
            sample_set=sample_sets,
            masks=masks,
        )
        run_tasks(
            lambda part: fill_leaves(self.leaves, rows, order, light, *part), _parts(n_leaves, 4096), threads
        )
        self._deepest = float(self.leaves.boxes[:, 5].max())

    def cast(self, chunk: BlockerChunk, threads: int, counters: np.ndarray) -> None:
        """Cast a chunk on all leaves; counters (threads, N_COUNTERS)."""
        tree = self._tree(chunk, threads)
        queue = np.zeros(1, np.int64)

        def cast_some(thread: int) -> None:
            cast_leaves(tree, self.leaves, self.light, queue, _scratch(), counters[thread])

        run_tasks(cast_some, range(threads), threads)

    def _tree(self, chunk: BlockerChunk, threads: int) -> BlockerTree:
        n_blockers = len(chunk.ids)
        lane_ids = np.full((-(-n_blockers // 16), 16), -1, np.int32)
        lane_ids.reshape(-1)[:n_blockers] = chunk.ids.astype(np.int32)
        n_clusters, n_low, n_middle, n_top = (-(-n_blockers // 16**k) for k in range(1, 5))
        first = np.array([0, n_low, n_low + n_middle, n_low + n_middle + n_top])
        nodes = np.empty((first[3], 6, 16), np.float32)
        nodes[first[2] :, :3], nodes[first[2] :, 3:] = FAR, -FAR
        tree = BlockerTree(
            lanes=np.empty((n_clusters, N_LANES, 16), np.float32),
            lane_ids=lane_ids,
            fast=np.empty(n_clusters, np.int32),
            straddling=np.empty(n_clusters, np.int32),
            careful=np.empty(n_clusters, np.int32),
            nodes=nodes,
            first_node=first,
            vertices=chunk.vertices,
            ids=chunk.ids,
        )
        run_tasks(lambda part: fill_tree_part(tree, self.light, self._deepest, part), range(n_middle), threads)
        return tree


def _z_order(points: Float64Array, rows: Int64Array, threads: int) -> Int64Array:
    """Order that sorts points[rows] along a Z curve."""
    n_rows = len(rows)
    keys, spare_keys = np.empty((2, n_rows), np.uint64)
    order, spare_order = np.empty((2, n_rows), np.int64)
    low, high = points.min(axis=0), points.max(axis=0)
    with np.errstate(all="ignore"):
        per_unit = np.nan_to_num(np.full(3, 2.0**14 / (high - low).max()), posinf=0.0)
    run_tasks(
        lambda part: fill_z_keys(points, rows, *part, low, per_unit, keys), _parts(n_rows, 65536), threads
    )
    sort_keys(keys, order, spare_keys, spare_order)
    return order


def _parts(n: int, size: int) -> list[tuple[int, int]]:
    """Ranges of at most `size` that make up range(n)."""
    return [(first, min(first + size, n)) for first in range(0, n, size)]


def _scratch() -> JointScratch:
    return JointScratch(
        open=np.zeros((17, 4), np.uint64),
        wanted=np.zeros(4, np.uint64),
        bins=np.zeros((4, 4, 16), np.int32),
        unsure=np.zeros(4, np.uint64),
        coefficients=np.zeros((14, 16), np.float32),
        normal=np.zeros(6),
    )


def new_counters(threads: int) -> np.ndarray:
    """Counters (threads, N_COUNTERS), all 0."""
    return np.zeros((threads, N_COUNTERS), np.int64)


_ = (Callable, Float64Array)
