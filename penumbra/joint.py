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
from penumbra.kernels.order import fill_curve_keys

LEAF = 16


class JointReceivers:
    """Receivers on one side of a light, in leaves, and what casting a chunk on them needs."""

    def __init__(
        self,
        rows: Int64Array,
        receivers: Receivers,
        sample_sets: UInt8Array,
        light: LightSpace,
        masks: UInt64Array,
    ) -> None:
        """rows: which receivers; masks (R, n_words) are cast on in place."""
        self.light = light
        points = receivers.points[rows]
        keys = np.empty(len(rows), np.uint64)
        fill_curve_keys(points, np.stack([points.min(axis=0), points.max(axis=0)]), keys)
        order = np.argsort(keys)
        n_leaves = -(-len(rows) // LEAF)
        slots = order[np.minimum(np.arange(n_leaves * LEAF), len(rows) - 1)]
        placed = ((points[slots] - light.origin) @ light.matrix.T).reshape(n_leaves, LEAF, 3).transpose(0, 2, 1)
        high = np.ascontiguousarray(placed, dtype=np.float32)
        count = np.full(n_leaves, LEAF, np.int32)
        count[-1] = len(rows) - LEAF * (n_leaves - 1)
        self.leaves = ReceiverLeaves(
            high=high,
            low=np.ascontiguousarray(placed - high, dtype=np.float32),
            boxes=np.concatenate([high.min(axis=2), high.max(axis=2)], axis=1),
            count=count,
            is_done=np.zeros(n_leaves, np.uint8),
            row=rows[slots],
            points=receivers.points,
            own=receivers.own,
            sample_set=sample_sets,
            masks=masks,
        )
        self._deepest = float(high[:, 2].max())

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
