"""4: receivers in tiles, each with its own hierarchy: the unit of work of a thread."""

import math

import numpy as np

from penumbra.arrays import (
    Float64Array,
    Int32Array,
    Int64Array,
    LightSamples,
    MaskPool,
    ReceiverBvh,
    Receivers,
    Shaft,
    UInt8Array,
    UInt64Array,
)
from penumbra.kernels.masks import MASK_NONE, MASK_UMBRA, fill_umbra
from penumbra.kernels.receiver_bvh import HALVING_COUNT, build_bvh
from penumbra.kernels.shaft import N_SHAFT_PLANES, fill_shaft, runs_touch_shaft

_FIRST_MASKS = 64


def split_into_tiles(points: Float64Array, live: Int64Array, tile_receivers: int) -> list[Int64Array]:
    """Group the live rows of points (R, 3) into compact tiles of at most tile_receivers rows each."""
    if not len(live):
        return []
    order = np.arange(len(live), dtype=np.int32)
    _, first, count, child, _ = _build(points[live], order, tile_receivers)
    leaves = np.flatnonzero(child < 0)
    return [live[order[first[n] : first[n] + count[n]]] for n in leaves]


class ReceiverTile:
    """Receivers of one tile: their masks, hierarchy, and the shaft between them and the light."""

    def __init__(
        self,
        rows: Int64Array,
        receivers: Receivers,
        sample_sets: UInt8Array,
        light: LightSamples,
        full: UInt64Array,
        *,
        blocker_extent: float,
        group_size: int,
        leaf_receivers: int,
        lazy_masks: bool,
        has_masks: bool = True,
    ) -> None:
        self.rows = rows
        self.n_rebuilds = 0
        self._points = receivers.points[rows]
        self._own = receivers.own[rows]
        self._sample_set = sample_sets[rows]
        self._light = light
        self._group_size = group_size
        self._leaf_receivers = leaf_receivers
        first_masks = _FIRST_MASKS if lazy_masks else len(rows)
        self.pool = _new_pool(len(rows), full, first_masks if has_masks else 0)
        if has_masks and not lazy_masks:
            self._give_masks(np.arange(len(rows)))
        self._blocker_extent = blocker_extent

    def set_masks(self, tile_rows: Int64Array, masks: UInt64Array) -> None:
        """Start some receivers of the tile with bits set: the samples they do not face."""
        without = tile_rows[self.pool.place[tile_rows] == MASK_NONE]
        while self.pool.state[0] < len(without):
            self.grow_pool()
        self._give_masks(without)
        self.pool.masks[self.pool.place[tile_rows]] = masks

    def build(self) -> None:
        """Build hierarchy and shaft over the receivers that are not in full umbra."""
        order = np.flatnonzero(self.pool.place != MASK_UMBRA).astype(np.int32)
        n_groups = len(self._light.full_groups)
        if len(order):
            boxes, first, count, child, self.depth = _build(self._points, order, self._leaf_receivers)
            self.shaft = shaft_to_light(boxes[0], self._light, self._blocker_extent)
        else:
            boxes, first, count, child, self.depth = np.zeros((0, 6)), *np.zeros((3, 0), np.int32), 0
        self.bvh = ReceiverBvh(
            boxes=boxes,
            first=first,
            n_slots=count,
            child=child,
            umbra=np.zeros((len(boxes), -(-n_groups // 64)), np.uint64),
            points=self._points[order],
            own=self._own[order],
            sample_set=self._sample_set[order],
            row=order,
        )
        self.pool.state[1] = 0
        self.refresh_umbra()

    def refresh_umbra(self) -> None:
        """Recompute the umbra bits of all nodes from the masks."""
        fill_umbra(self.bvh, len(self.bvh.boxes), self.pool, self._light, self._group_size)

    def rebuild(self) -> None:
        """Build again, without the receivers that reached umbra (HPC figure 3, line 29)."""
        self.n_rebuilds += 1
        self.build()

    def grow_pool(self) -> None:
        """Double the masks; pools start small, since most receivers never need one (HPC 3.3 D)."""
        pool, n_rows = self.pool, len(self.rows)
        n_old = len(pool.masks)
        n_new = min(n_rows, 2 * n_old)
        masks = np.zeros((n_new, pool.masks.shape[1]), np.uint64)
        masks[:n_old] = pool.masks
        free = np.empty(n_new, np.int32)
        n_free = int(pool.state[0])
        added = np.arange(n_new - 1, n_old - 1, -1, dtype=np.int32)
        free[: len(added)] = added
        free[len(added) : len(added) + n_free] = pool.free[:n_free]
        pool.state[0] = n_free + len(added)
        self.pool = pool._replace(masks=masks, free=free)

    def copy_masks(self, out: UInt64Array) -> None:
        """Copy the masks of the tile into out (R, n_words), at the tile's rows."""
        place = self.pool.place
        allocated = place >= 0
        out[self.rows[allocated]] = self.pool.masks[place[allocated]]
        out[self.rows[place == MASK_UMBRA]] = self.pool.full

    def touches(self, boxes: Float64Array) -> np.ndarray:
        """Which of boxes (n, 2, 3) may hold a blocker of this tile, bool (n,)."""
        out = np.empty(len(boxes), np.bool_)
        runs_touch_shaft(self.shaft, boxes, out)
        return out

    @property
    def n_live(self) -> int:
        """Receivers in the hierarchy."""
        return len(self.bvh.row)

    @property
    def hierarchy_bytes(self) -> int:
        """Bytes of the hierarchy."""
        return sum(a.nbytes for a in self.bvh)

    def _give_masks(self, tile_rows: Int64Array) -> None:
        n = len(tile_rows)
        left = int(self.pool.state[0]) - n
        self.pool.place[tile_rows] = self.pool.free[left : left + n]
        self.pool.state[0] = left


def _new_pool(n_receivers: int, full: UInt64Array, capacity: int) -> MaskPool:
    capacity = min(capacity, n_receivers)
    return MaskPool(
        place=np.full(n_receivers, MASK_NONE, np.int32),
        masks=np.zeros((capacity, len(full)), np.uint64),
        free=np.arange(capacity - 1, -1, -1, dtype=np.int32),
        state=np.array([capacity, 0], np.int64),
        full=full,
    )


def _build(
    points: Float64Array, order: Int32Array, leaf_size: int
) -> tuple[Float64Array, Int32Array, Int32Array, Int32Array, int]:
    """Hierarchy over the points listed in order, which it permutes; arrays cut to the nodes there are."""
    # A cut leaves at least a 32nd on either side above the halving limit, one point below it.
    leaves = len(order) if leaf_size <= HALVING_COUNT else 32 * len(order) // leaf_size + 1
    room = 2 * leaves + 1
    boxes = np.empty((room, 6))
    first, count, child = (np.empty(room, np.int32) for _ in range(3))
    n_nodes, depth = build_bvh(points, order, leaf_size, boxes, first, count, child)
    return (
        boxes[:n_nodes].copy(),
        first[:n_nodes].copy(),
        count[:n_nodes].copy(),
        child[:n_nodes].copy(),
        int(depth),
    )


def shaft_to_light(tile_box: Float64Array, light: LightSamples, blocker_extent: float) -> Shaft:
    """Shaft from a box of receivers (6,) to the light; blocker_extent: largest coordinate of a blocker."""
    corners = light.corners[0]
    margin = 4.0 * light.residual
    light_box = np.concatenate([corners.min(axis=0) - margin, corners.max(axis=0) + margin])
    extent = float(max(np.abs(tile_box).max(), np.abs(light_box).max()))
    box, planes = np.empty(6), np.empty((N_SHAFT_PLANES, 4))
    # The slack of the planes must cover the rounding of what is tested against them.
    fill_shaft(tile_box, light_box, max(extent, blocker_extent), box, planes)
    # Infinite for the largest numbers: then no volume is trusted.
    with np.errstate(over="ignore"):
        reach = math.hypot(*(box[3:] - box[:3])) * (1 + 1e-9)
    return Shaft(box, planes, extent, reach)
