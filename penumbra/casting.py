"""6: backend "hpc", hierarchical penumbra casting (Laine & Aila 2005, section 3)."""

from collections.abc import Callable

import numpy as np

from penumbra.arrays import (
    BlockerChunk,
    CastScratch,
    CastSwitches,
    LightSamples,
    PointScratch,
    Receivers,
    UInt8Array,
    UInt64Array,
)
from penumbra.blockers import Blockers, stream_wanted
from penumbra.executors.threads import run_tasks
from penumbra.facing import CastStart, face_light, full_mask
from penumbra.joint import JointCast, JointReceivers, joint_cast
from penumbra.kernels.casting import DONE, POOL_EMPTY, REBUILD, cast_blockers
from penumbra.kernels.counters import N_COUNTERS, NAMES
from penumbra.kernels.point_casting import cast_blockers_from_point
from penumbra.lights import Light, PointLight
from penumbra.options import CastOptions
from penumbra.progress import Progress
from penumbra.receivers import ReceiverTile, split_into_tiles
from penumbra.stats import Stats

_NEVER = 2**62

CastStep = Callable[[ReceiverTile, BlockerChunk, int, LightSamples, CastOptions, np.ndarray], tuple[int, int]]


def cast_receivers(
    receivers: Receivers,
    blockers: Blockers,
    light: Light,
    *,
    options: CastOptions,
    threads: int,
    progress: Progress,
) -> tuple[UInt64Array, UInt8Array, Stats]:
    """Masks uint64 (R, n_words), sample sets uint8 (R,) and Stats of one pass over the blockers.

    Receivers are split into tiles; each chunk of blockers, from large triangles to small, is cast on
    every tile whose shaft to the light it touches. Threads take tiles from a queue.
    """
    stats = Stats("hpc")
    with stats.timed("hierarchy"):
        start = face_light(receivers, light, options.group_size)
        joint = JointCast([], start.live)
        is_point = isinstance(light, PointLight)
        if not isinstance(light, PointLight) and blockers.n_triangles >= max(1, options.joint_triangles):
            joint = joint_cast(receivers, start, light, blockers, threads)
        extent = float(np.abs(blockers.bounds).max()) if blockers.n_triangles else 0.0
        rest = start._replace(live=joint.rest)
        tiles = _make_tiles(receivers, rest, extent, options, threads, has_masks=not is_point)
    with stats.timed("cast"):
        step = _cast_from_point if is_point else _cast_from_area
        counters = _cast_chunks(
            joint.sides, tiles, blockers, start.samples, step, options, threads, progress, stats
        )
    for tile in tiles:
        tile.copy_masks(start.masks)
    _count(stats, counters, joint.sides, tiles, len(receivers.points) - len(start.live))
    return start.masks, start.sample_sets, stats


def _make_tiles(
    receivers: Receivers,
    start: CastStart,
    blocker_extent: float,
    options: CastOptions,
    threads: int,
    *,
    has_masks: bool,
) -> list[ReceiverTile]:
    """Tiles of the receivers that face the light, with their hierarchies built."""
    partial = np.asarray(start.masks.any(axis=1))
    full = full_mask(start.samples.n_samples)

    def make(rows: np.ndarray) -> ReceiverTile:
        """One tile, started with the bits that its receivers do not face."""
        tile = ReceiverTile(
            rows,
            receivers,
            start.sample_sets,
            start.samples,
            full,
            blocker_extent=blocker_extent,
            group_size=options.group_size,
            leaf_receivers=options.leaf_receivers,
            lazy_masks=options.lazy_masks,
            has_masks=has_masks,
        )
        started = np.flatnonzero(partial[rows])
        tile.set_masks(started, start.masks[rows[started]])
        tile.build()
        return tile

    return run_tasks(make, split_into_tiles(receivers.points, start.live, options.tile_receivers), threads)


def _cast_chunks(
    sides: list[JointReceivers],
    tiles: list[ReceiverTile],
    blockers: Blockers,
    samples: LightSamples,
    step: CastStep,
    options: CastOptions,
    threads: int,
    progress: Progress,
    stats: Stats,
) -> np.ndarray:
    """Stream the chunks that matter through all tiles; returns counters (n_tiles, N_COUNTERS)."""
    counters = np.zeros((len(tiles), N_COUNTERS), np.int64)
    boxes = np.array([chunk.box for chunk in blockers.chunks]).reshape(-1, 2, 3)
    touches = np.array([tile.touches(boxes) for tile in tiles]).reshape(len(tiles), len(boxes))
    joint_touches = [side.touches(boxes) for side in sides]

    def is_wanted(number: int) -> bool:
        """Whether a chunk may still block something."""
        return any(touches[k, number] and tile.n_live for k, tile in enumerate(tiles)) or any(
            (touch[:, number] & side.open_slices()).any()
            for side, touch in zip(sides, joint_touches, strict=True)
        )

    progress.stage("cast", blockers.n_triangles, "triangles")
    chunks = stream_wanted(blockers, is_wanted, large_first=options.sort, progress=progress, stats=stats)
    for number, chunk in chunks:
        work = [k for k, tile in enumerate(tiles) if touches[k, number] and tile.n_live]

        def task(k: int, chunk: BlockerChunk = chunk) -> None:
            _cast_tile(step, tiles[k], chunk, samples, options, counters[k])

        run_tasks(task, work, threads)
        for side, touch in zip(sides, joint_touches, strict=True):
            side.cast(chunk, touch[:, number] & side.open_slices(), threads)
        progress.advance(len(chunk.ids))
    return np.concatenate([counters, *(side.counters for side in sides)])


def _cast_tile(
    step: CastStep,
    tile: ReceiverTile,
    chunk: BlockerChunk,
    samples: LightSamples,
    options: CastOptions,
    counters: np.ndarray,
) -> None:
    """Cast a chunk on a tile; between blockers, grow its mask pool and rebuild its hierarchy as needed."""
    start, reason = 0, int(REBUILD)
    while reason != DONE and tile.n_live:
        start, reason = step(tile, chunk, start, samples, options, counters)
        if reason == POOL_EMPTY:
            tile.grow_pool()
            tile.refresh_umbra()
        elif reason == REBUILD:
            tile.rebuild()


def _cast_from_area(
    tile: ReceiverTile,
    chunk: BlockerChunk,
    start: int,
    samples: LightSamples,
    options: CastOptions,
    counters: np.ndarray,
) -> tuple[int, int]:
    """Cast the blockers from `start` on; returns where it stopped, and why (DONE, POOL_EMPTY, REBUILD)."""
    stop, reason = cast_blockers(
        chunk,
        start,
        _rebuild_at(tile, options),
        tile.shaft,
        tile.bvh,
        tile.pool,
        samples,
        options.group_size,
        _switches(options),
        _scratch(tile.depth, len(samples.full_groups)),
        counters,
    )
    return int(stop), int(reason)


def _cast_from_point(
    tile: ReceiverTile,
    chunk: BlockerChunk,
    start: int,
    samples: LightSamples,
    options: CastOptions,
    counters: np.ndarray,
) -> tuple[int, int]:
    """`_cast_from_area` for a point light, which takes no masks (DONE or REBUILD)."""
    stop, reason = cast_blockers_from_point(
        chunk,
        start,
        _rebuild_at(tile, options),
        tile.shaft,
        tile.bvh,
        tile.pool,
        samples,
        _switches(options),
        PointScratch(np.empty((2 * tile.depth + 6, 2), np.int32), np.zeros((5, 8))),
        counters,
    )
    return int(stop), int(reason)


def _switches(options: CastOptions) -> CastSwitches:
    return CastSwitches(options.umbra_bits, options.active_planes, options.lazy_volumes, options.lazy_masks)


def _rebuild_at(tile: ReceiverTile, options: CastOptions) -> int:
    """How many receivers must reach full umbra for the tile's hierarchy to be built again."""
    if not options.umbra_bits or options.rebuild_fraction >= 1:
        return _NEVER
    return max(1, int(options.rebuild_fraction * tile.n_live))


def _scratch(depth: int, n_groups: int) -> CastScratch:
    levels = depth + 2
    return CastScratch(
        stack=np.empty((2 * levels + 2, 2), np.int32),
        light_planes=np.zeros(levels, np.int64),
        n_active=np.zeros(levels, np.int64),
        active_group=np.zeros((levels, n_groups), np.int32),
        active_planes=np.zeros((levels, n_groups), np.int64),
        light_volume=np.zeros((4, 8)),
        group_volumes=np.zeros((n_groups, 4, 8)),
        group_found=np.zeros(n_groups, np.int64),
        choices=np.zeros((2, 7), np.int64),
        normal=np.zeros(6),
        edges=np.zeros((4, 4), np.float32),
    )


def _count(
    stats: Stats,
    counters: np.ndarray,
    sides: list[JointReceivers],
    tiles: list[ReceiverTile],
    n_not_cast: int,
) -> None:
    for name, amount in zip(NAMES, counters.sum(axis=0), strict=True):
        stats.count(name, amount)
    # The joint descent under the names that every backend has: it sets up 16 blockers at a time.
    found = stats.counters
    stats.count("pairs_tested", 16 * found["cluster_pairs"] + found["pairs_escalated"])
    stats.count("nodes_visited", found["tree_nodes_visited"])
    stats.count("samples_tested", found["lanes_tested"])
    stats.count("receivers_not_cast", n_not_cast)
    stats.count("tiles", len(tiles) + sum(len(side.slices) for side in sides))
    stats.count("rebuilds", sum(tile.n_rebuilds for tile in tiles))
    stats.count("mask_bytes", sum(tile.pool.masks.nbytes for tile in tiles))
    stats.count("hierarchy_bytes", sum(tile.hierarchy_bytes for tile in tiles))
    stats.count("hierarchy_bytes", sum(side.hierarchy_bytes for side in sides))
