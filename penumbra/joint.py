"""6: the joint descent: leaves of 16 receivers through the hierarchy of each chunk, in light space."""

from typing import NamedTuple

import numpy as np

from penumbra.arrays import (
    BlockerChunk,
    BlockerTree,
    BoolArray,
    Float64Array,
    Int64Array,
    JointScratch,
    LightSpace,
    ReceiverLeaves,
    Receivers,
)
from penumbra.blockers import Blockers
from penumbra.executors.threads import run_tasks
from penumbra.facing import CastStart
from penumbra.kernels.counters import N_COUNTERS
from penumbra.kernels.joint_casting import cast_leaves
from penumbra.kernels.light_space import FAR, N_LANES, fill_tree_part
from penumbra.kernels.receiver_leaves import LEAF, fill_leaves, fill_z_keys, sort_keys
from penumbra.kernels.shaft import runs_touch_shaft
from penumbra.light_space import heights_above, light_space
from penumbra.lights import RectLight
from penumbra.receivers import shaft_to_light

# A task is a slice of leaves: small enough to balance, large enough that its call costs nothing.
_SLICE_LEAVES = 512


class JointCast(NamedTuple):
    """The receivers that descend with the blockers, by side of the light, and the rows that cannot."""

    sides: list["JointReceivers"]
    rest: Int64Array


def joint_cast(
    receivers: Receivers, start: CastStart, light: RectLight, blockers: Blockers, threads: int
) -> JointCast:
    """Receivers that face the light, in leaves, each side of the light by itself.

    Those in the plane of the light as far as float32 can tell, and all of a light that has no light space
    (edges parallel or zero, samples too close together for float64), are left to be cast otherwise.
    """
    sides = []
    rest = start.live
    for sign in (1.0, -1.0):
        if not len(rest):
            break
        space = light_space(light, sign, receivers.points[rest], blockers.bounds)
        if space is None:
            continue
        is_here = heights_above(space, receivers.points, rest) > 8 * space.slack
        if is_here.any():
            sides.append(
                JointReceivers(
                    rest[is_here], receivers, start, space, float(np.abs(blockers.bounds).max()), threads
                )
            )
        rest = rest[~is_here]
    return JointCast(sides, rest)


class JointReceivers:
    """Receivers on one side of a light, in leaves, and what casting a chunk on them needs."""

    def __init__(
        self,
        rows: Int64Array,
        receivers: Receivers,
        start: CastStart,
        light: LightSpace,
        blocker_extent: float,
        threads: int,
    ) -> None:
        """rows: which receivers; their masks in `start` are cast on in place."""
        n_leaves = -(-len(rows) // LEAF)
        order = _z_order(receivers.points, rows, threads)
        leaves = self.leaves = ReceiverLeaves(
            places=np.empty((n_leaves, 3, LEAF), np.float32),
            offsets=np.empty((n_leaves, 3, LEAF), np.float32),
            centres=np.empty((n_leaves, 6), np.float32),
            reaches=np.empty((n_leaves, 2), np.float32),
            boxes=np.empty((n_leaves, 6), np.float32),
            count=np.empty(n_leaves, np.int32),
            is_done=np.zeros(n_leaves, np.uint8),
            row=np.empty(n_leaves * LEAF, np.int64),
            points=receivers.points,
            own=receivers.own,
            sample_set=start.sample_sets,
            masks=start.masks,
        )
        self.light = light
        self.slices = _parts(n_leaves, _SLICE_LEAVES)
        self.counters = np.zeros((len(self.slices), N_COUNTERS), np.int64)
        boxes = np.empty((len(self.slices), 6))
        run_tasks(
            lambda k: fill_leaves(leaves, rows, order, light, *self.slices[k], boxes[k]),
            range(len(self.slices)),
            threads,
        )
        self._shafts = [shaft_to_light(box, start.samples, blocker_extent) for box in boxes]
        self._deepest = float(leaves.boxes[:, 5].max())

    def touches(self, boxes: Float64Array) -> BoolArray:
        """Which of boxes (n, 2, 3) may hold a blocker of each slice, (n_slices, n)."""
        out = np.empty((len(self.slices), len(boxes)), np.bool_)
        for shaft, row in zip(self._shafts, out, strict=True):
            runs_touch_shaft(shaft, boxes, row)
        return out

    def open_slices(self) -> BoolArray:
        """Which slices have a receiver that is not in full umbra, (n_slices,)."""
        firsts = np.array([first for first, _ in self.slices])
        is_done: BoolArray = np.minimum.reduceat(self.leaves.is_done, firsts) == 1
        return ~is_done

    def cast(self, chunk: BlockerChunk, wanted: BoolArray, threads: int) -> None:
        """Cast a chunk on the slices that are wanted (n_slices,)."""
        tree = self._tree(chunk, threads)

        def cast_slice(k: int) -> None:
            cast_leaves(tree, self.leaves, self.light, *self.slices[k], _scratch(), self.counters[k])

        run_tasks(cast_slice, np.flatnonzero(wanted).tolist(), threads)

    @property
    def hierarchy_bytes(self) -> int:
        """Bytes of the leaves, without what is the caller's."""
        shared = ("points", "own", "sample_set", "masks")
        return sum(a.nbytes for name, a in self.leaves._asdict().items() if name not in shared)

    def _tree(self, chunk: BlockerChunk, threads: int) -> BlockerTree:
        n_blockers = len(chunk.ids)
        n_clusters, n_low, n_middle, n_top = (-(-n_blockers // 16**k) for k in range(1, 5))
        first = np.array([0, n_low, n_low + n_middle, n_low + n_middle + n_top])
        nodes = np.empty((first[3], 6, 16), np.float32)
        nodes[first[2] :, :3], nodes[first[2] :, 3:] = FAR, -FAR
        lane_ids = np.full((n_clusters, 16), -1, np.int32)
        lane_ids.reshape(-1)[:n_blockers] = chunk.ids.astype(np.int32)
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
        run_tasks(
            lambda part: fill_tree_part(tree, self.light, self._deepest, part), range(n_middle), threads
        )
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
        wanted=np.zeros((17, 4), np.uint64),
        slots=np.zeros(17, np.int64),
        tables=np.zeros(16, np.int64),
        unsure=np.zeros(4, np.uint64),
        bins=np.zeros((4, 4, 16), np.int32),
        cluster=np.zeros((5, 16), np.float32),
        coefficients=np.zeros((15, 16), np.float32),
        normal=np.zeros(6),
    )
