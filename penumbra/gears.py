"""6: backend "gears", blockers assigned to the cells of a grid of receivers (Wang et al. 2014)."""

from collections.abc import Iterator
from contextlib import AbstractContextManager

import numpy as np

from penumbra.arrays import (
    BlockerChunk,
    Float32Array,
    Float64Array,
    Int32Array,
    Int64Array,
    LightSamples,
    Raster,
    RasterScratch,
    Receivers,
    UInt8Array,
    UInt64Array,
)
from penumbra.blockers import Blockers, stream_wanted
from penumbra.executors.threads import run_tasks
from penumbra.facing import CastStart, face_light, full_mask
from penumbra.kernels.counters import N_COUNTERS, NAMES
from penumbra.kernels.rasterise import BLOCK, N_LANES, N_ROWS, rasterise
from penumbra.kernels.shadow_grid import bound_volumes, count_cells, fill_cells
from penumbra.lights import Light
from penumbra.options import CastOptions
from penumbra.progress import Progress
from penumbra.receiver_grid import ShadowGrid, make_grids
from penumbra.stats import Stats

_PAIR_BYTES = 4
# What threads take from a queue: so many blockers to bound; runs of receivers to rasterise onto.
_BLOCKER_SLICE = 8192
_SLICES_PER_THREAD = 8


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

    Receivers are binned to the cells of an image plane behind the light; each chunk of blockers is bounded
    there, counted, and sorted by cell, and each receiver rasterises the blockers of its cell onto its mask.
    """
    stats = Stats("gears")
    with stats.timed("hierarchy"):
        start = face_light(receivers, light, options.group_size)
        grids = make_grids(
            receivers.points,
            start.live,
            start.samples,
            two_sided=light.two_sided,
            blocker_extent=float(np.abs(blockers.bounds).max()) if blockers.n_triangles else 0.0,
            resolution=options.grid_resolution,
            eye_distance=options.grid_eye,
            spacing=options.grid_spacing,
        )
    casts = [_GridCast(grid, receivers, start, options, threads, stats) for grid in grids]

    def is_wanted(number: int) -> bool:
        """Whether a chunk may still block something."""
        box = blockers.chunks[number].box
        return any(grid.touched_by(box, options.correct_extrusion) for grid in grids)

    progress.stage("cast", blockers.n_triangles, "triangles")
    with stats.timed("cast"):
        chunks = stream_wanted(blockers, is_wanted, large_first=options.sort, progress=progress, stats=stats)
        for _, chunk in chunks:
            for cast in casts:
                cast.cast(chunk)
            progress.advance(len(chunk.ids))
    for cast in casts:
        cast.report()
    stats.count("receivers_not_cast", len(receivers.points) - len(start.live))
    return start.masks, start.sample_sets, stats


class _GridCast:
    """Chunks cast on the receivers of one grid, step by step, each step timed (GEARS section 4.2)."""

    def __init__(
        self,
        grid: ShadowGrid,
        receivers: Receivers,
        start: CastStart,
        options: CastOptions,
        threads: int,
        stats: Stats,
    ) -> None:
        self._grid, self._samples = grid, start.samples
        self._options, self._threads, self._stats = options, threads, stats
        self._raster = Raster(
            points=receivers.points,
            own=receivers.own,
            sample_sets=start.sample_sets,
            masks=start.masks,
            full=full_mask(start.samples.n_samples),
            group_boxes=_group_boxes(start.samples, options.group_size),
            group_size=options.group_size,
            extent=grid.extent,
            skip_blocked=options.umbra_bits,
        )
        self._n_full = 0
        self._counters = np.zeros(N_COUNTERS, np.int64)
        self._blockers_in_cell = np.zeros(len(grid.grid.far) + 1, np.int64)
        self._receivers_in_cell = np.diff(grid.grid.first)

    def cast(self, chunk: BlockerChunk) -> None:
        """Assign a chunk's blockers to cells, in batches whose pairs fit the memory, and rasterise them."""
        with self._step("bound"):
            rects, nearest, counts = self._bound(chunk)
        for batch in _batches(counts, self._options.pair_bytes // _PAIR_BYTES):
            begin, pairs = self._sort_by_cell(batch, rects, nearest)
            with self._step("rasterise"):
                self._rasterise(chunk, begin, pairs)
            self._stats.count("batches", 1)
            self._stats.count("cell_pairs", len(pairs))
        self._stats.count("blockers_assigned", int(np.count_nonzero(counts)))
        if self._options.umbra_bits and self._n_full > self._options.rebuild_fraction * self._n_live:
            with self._step("bin"):
                self._leave_out_blocked()

    def _bound(self, chunk: BlockerChunk) -> tuple[Int32Array, Float64Array, Int64Array]:
        """Cells that each blocker's shadow volume touches, its nearest depth, and how many cells they are."""
        n_blockers = len(chunk.ids)
        rects, nearest = np.empty((n_blockers, 4), np.int32), np.empty(n_blockers)
        counts = np.empty(n_blockers, np.int64)
        camera, grid, correct = self._grid.camera, self._grid.grid, self._options.correct_extrusion

        def bound(first: int) -> None:
            last = min(first + _BLOCKER_SLICE, n_blockers)
            bound_volumes(chunk.vertices, first, last, camera, grid, correct, rects, nearest, counts)

        run_tasks(bound, range(0, n_blockers, _BLOCKER_SLICE), self._threads)
        return rects, nearest, counts

    def _sort_by_cell(
        self, batch: slice, rects: Int32Array, nearest: Float64Array
    ) -> tuple[Int64Array, Int32Array]:
        """Where each cell's run begins, (n_cells + 2,), and the runs: places in the chunk, ascending.

        A counting sort: pairs are counted by cell, and filled in at their sorted place at once, where the
        paper fills them in by blocker and sorts them then.
        """
        grid, error = self._grid.grid, self._grid.camera.error
        n_parts = min(self._threads, -(-(batch.stop - batch.start) // _BLOCKER_SLICE))
        edges = np.linspace(batch.start, batch.stop, n_parts + 1).astype(np.int64)
        parts = list(zip(edges, edges[1:], strict=False))
        place = np.zeros((len(parts), len(grid.far) + 1), np.int64)

        def count(k: int) -> None:
            count_cells(*parts[k], rects, nearest, grid, error, place[k])

        def fill(k: int) -> None:
            fill_cells(*parts[k], rects, nearest, grid, error, place[k], pairs)

        with self._step("count"):
            run_tasks(count, range(len(parts)), self._threads)
        with self._step("prefix_sum"):
            in_cell = place.sum(axis=0)
            begin = np.concatenate([[0], np.cumsum(in_cell)])
            # Of one cell, the parts' runs follow each other.
            place[:] = begin[:-1] + np.cumsum(place, axis=0) - place
            self._blockers_in_cell += in_cell
        with self._step("fill"):
            pairs = np.empty(begin[-1], np.int32)
            run_tasks(fill, range(len(parts)), self._threads)
        return begin, pairs

    def _rasterise(self, chunk: BlockerChunk, begin: Int64Array, pairs: Int32Array) -> None:
        """Rasterise onto all receivers, in slices of about the same number of pairs."""
        grid = self._grid.grid
        slices = _even_slices(grid.first, begin, self._threads * _SLICES_PER_THREAD)
        counters = np.zeros((len(slices), N_COUNTERS), np.int64)

        def task(k: int) -> int:
            return int(
                rasterise(
                    slices[k], grid, self._raster, chunk, begin, pairs, self._samples, _scratch(), counters[k]
                )
            )

        self._n_full += sum(run_tasks(task, range(len(slices)), self._threads))
        self._counters += counters.sum(axis=0)

    def _step(self, name: str) -> AbstractContextManager[None]:
        return self._stats.timed_step("cast", name)

    @property
    def _n_live(self) -> int:
        """Receivers in the grid."""
        return len(self._grid.grid.rows)

    def _leave_out_blocked(self) -> None:
        """Bin again, without the receivers that are in full umbra (as HPC section 3.3 A rebuilds)."""
        rows = self._grid.grid.rows
        self._grid.bin(rows[(self._raster.masks[rows] != self._raster.full).any(axis=1)])
        self._n_full = 0

    def report(self) -> None:
        """Add what was counted to the statistics; cells by what the image plane held in the beginning."""
        for name, amount in zip(NAMES, self._counters, strict=True):
            self._stats.count(name, int(amount))
        used = self._receivers_in_cell > 0
        self._stats.count_most("cells", len(used) - 1)
        self._stats.count_most("cells_used", int(used[:-1].sum()))
        self._stats.count_most("most_blockers_in_cell", int(self._blockers_in_cell.max()))
        self._stats.count_most("most_receivers_in_cell", int(self._receivers_in_cell.max()))
        self._stats.count("receivers_outside_grid", int(self._receivers_in_cell[-1]))


def _scratch() -> RasterScratch:
    return RasterScratch(
        lanes=np.empty((N_ROWS, BLOCK)),
        found=np.empty((3, 4, N_LANES)),
        edges=np.empty((4, 4), np.float32),
        normal=np.empty(6),
    )


def _group_boxes(samples: LightSamples, group_size: int) -> Float32Array:
    """Centres s, t and half widths of the light sample groups, float32 (4, n), n a multiple of 16."""
    n_groups = len(samples.full_groups)
    boxes = np.zeros((4, -(-n_groups // 16) * 16), np.float32)
    if samples.parameters.shape[2]:
        by_group = samples.parameters.reshape(-1, 2, n_groups, group_size)
        low, high = by_group.min(axis=(0, 3)), by_group.max(axis=(0, 3))
        boxes[:2, :n_groups] = 0.5 * (low + high)
        # Rounded outwards: the centre may be off by half a unit of float32.
        boxes[2:, :n_groups] = 0.5 * (high - low) + np.float32(2.0**-23)
    return boxes


def _batches(counts: Int64Array, most_pairs: int) -> Iterator[slice]:
    """Runs of blockers with at most so many pairs each; a blocker with more is a run of its own."""
    first, total = 0, np.concatenate([[0], np.cumsum(counts)])
    while first < len(counts):
        last = int(np.searchsorted(total, total[first] + most_pairs, side="right")) - 1
        last = max(last, first + 1)
        yield slice(first, last)
        first = last


def _even_slices(first: Int64Array, begin: Int64Array, n_slices: int) -> Int64Array:
    """Cut the receivers, in the order of cells, into runs (n, 2) with about the same number of pairs."""
    per_receiver = np.diff(begin)
    before = np.concatenate([[0], np.cumsum(np.diff(first) * per_receiver)])
    if not before[-1]:
        return np.zeros((0, 2), np.int64)
    wanted = before[-1] * np.arange(1, n_slices) // n_slices
    cell = np.searchsorted(before, wanted, side="right") - 1
    cut = first[cell] + (wanted - before[cell]) // np.maximum(per_receiver[cell], 1)
    edges = np.unique(np.concatenate([[0], cut, first[-1:]]))
    return np.stack([edges[:-1], edges[1:]], axis=1)
