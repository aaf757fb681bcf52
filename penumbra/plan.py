"""What a render will do and the memory it needs, before any work: pure integers from options and headers."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from penumbra.errors import MemoryLimitError
from penumbra.film import Window, film_bytes
from penumbra.memory import format_bytes
from penumbra.options import CastOptions

BlockerSource = Literal["store", "memory", "temporary store"]

# Bytes by the thing that is held; each was measured as the growth of VmHWM and rounded up.
_GBUFFER_BYTES = 72  # a pixel of a pass: its pixel, point, normal, triangle and depth
_VISIBLE_BYTES = 112  # a pixel while visible points are found, its place in the G-buffer included
_CAST_BYTES = 112  # a receiver while it is cast and shaded: place in its tile, hierarchy, facing, results
_RECEIVER_BYTES = 64  # a receiver as it is passed to casting: point, normal, triangle, index
_RESULT_BYTES = 5  # a receiver in the result, without its mask
_MASK_WORD_BYTES = 16  # 64 light samples of a receiver: in the result, and at worst in its tile's pool too
_SAMPLE_BYTES = 168  # a light sample of one set: as point, as lane, and in the tables of light space
_PREVIEW_BYTES = 24  # a pixel while the picture is exposed
_CELL_BYTES = 512  # a cell of the grid: twice (both sides of a light), in up to eight parts of a chunk
_BOUND_BYTES = 64  # a blocker of a chunk while its cells are found, on either side of the light
_ENCODE_BYTES = 24 << 20  # buffers of the EXR encoder
_TREE_BYTES = 6 << 20  # a chunk of 64 Ki blockers in light space
# Two chunks of 64 Ki blockers with boxes and reading buffers, the store's index, a chunk in light space.
_STORE_BYTES = (48 << 20) + _TREE_BYTES
_READ_TRIANGLE_BYTES = 260  # a blocker while it is read and sorted in memory
_KEPT_TRIANGLE_BYTES = 112  # a blocker in memory after that
_KERNEL_BYTES = 96 << 20  # machine code and LLVM's own memory once every kernel is loaded
_INGEST_LEAST_BYTES = 96 << 20
_SCRATCH_TRIANGLE_BYTES = 2 * 84  # the store and, while it is made, its unsorted buckets

_ROUND_BYTES = 16 << 20
_LEAST_PASS = 1024  # receivers of one `cast`: fewer would read the blockers too often


class LightPlan(NamedTuple):
    """One light's samples."""

    name: str
    samples: int
    sets: int
    is_point: bool = False

    def __str__(self) -> str:
        """Return what of the light is cast."""
        return f"{self.name}: " + (
            "a point"
            if self.is_point
            else f"{self.samples} samples in {self.sets} set{'s' if self.sets > 1 else ''}"
        )


class GeometryPlan(NamedTuple):
    """What the headers of the geometry say."""

    n_triangles: int
    is_exact: bool
    is_store: bool


@dataclass(frozen=True)
class RenderPlan:
    """What a render will do; `str()` is what `--dry-run` prints."""

    resolution: tuple[int, int]
    window: Window
    lights: tuple[LightPlan, ...]
    geometry: GeometryPlan
    source: BlockerSource
    passes: tuple[Window, ...]
    threads: int
    backend: str
    limit_bytes: int
    resident_bytes: int
    kernel_bytes: int
    film_bytes: int
    ingest_bytes: int
    blocker_bytes: int
    pass_bytes: int
    write_bytes: int
    scratch_bytes: int

    @property
    def needed_bytes(self) -> int:
        """Most resident memory that the process is planned to take."""
        always = self.resident_bytes + self.kernel_bytes + self.film_bytes
        return always + max(self.ingest_bytes, self.blocker_bytes + self.pass_bytes, self.write_bytes)

    @property
    def left_out(self) -> tuple[str, ...]:
        """What this scene does not need and the render therefore does not do."""
        return tuple(
            text
            for applies, text in (
                (self.source == "memory", "no store is written: all geometry fits in memory"),
                (self.source == "store", "no ingest: the geometry is a blocker store"),
                (len(self.passes) == 1, "no second pass: the receivers of the whole picture fit in memory"),
                (len(self.lights) == 1, "no sum over lights: there is one"),
                (all(light.sets == 1 for light in self.lights), "no choice of sample set: there is one"),
                (
                    all(light.is_point for light in self.lights),
                    "no light sample groups: "
                    + ("the light is a point" if len(self.lights) == 1 else "all lights are points"),
                ),
            )
            if applies
        )

    def __str__(self) -> str:
        """Return the plan as lines of text."""
        return "\n".join(f"{label:<11}{text}" for label, text in self._lines())

    def _lines(self) -> list[tuple[str, str]]:
        width, height = self.resolution
        x0, y0, x1, y1 = self.window
        rows = max(y1 - y0 for _, y0, _, y1 in self.passes)
        tile = CastOptions().tile_receivers
        n_tiles = -(-rows * (x1 - x0) // tile)
        n_reads = len(self.passes) * (1 + len(self.lights))
        about = "" if self.geometry.is_exact else "at most about "
        always = (("process", self.resident_bytes), ("kernels", self.kernel_bytes), ("film", self.film_bytes))
        stages = (
            ("to ingest", self.ingest_bytes),
            ("to cast", self.blocker_bytes + self.pass_bytes),
            ("to write", self.write_bytes),
        )
        lines = [
            ("picture", f"{width} x {height}, window {x0} {y0} {x1} {y1}: {(x1 - x0) * (y1 - y0):,} pixels"),
            *(("light", str(light)) for light in self.lights),
            ("backend", self.backend),
            ("blockers", f"{about}{self.geometry.n_triangles:,} triangles from {self.source}"),
            ("", f"read {n_reads} times at most: to see, and for each light, in each pass"),
            ("passes", f"{len(self.passes)} of up to {rows} rows, on {self.threads} threads"),
            ("tiles", f"up to {n_tiles} a pass, of up to {tile:,} receivers each"),
            ("memory", " + ".join(f"{name} {format_bytes(size)}" for name, size in always)),
            ("", "and, in turn, " + ", ".join(f"{format_bytes(size)} {name}" for name, size in stages)),
            ("needed", f"{format_bytes(self.needed_bytes)} of {format_bytes(self.limit_bytes)}"),
            ("scratch", f"{format_bytes(self.scratch_bytes)} of disk" if self.scratch_bytes else "none"),
        ]
        return lines + [("left out", text) for text in self.left_out]


def make_plan(
    resolution: tuple[int, int],
    window: Window,
    lights: Sequence[LightPlan],
    geometry: GeometryPlan,
    limit_bytes: int,
    resident_bytes: int,
    threads: int,
    process_limit: bool = True,
    backend: str = "hpc",
    engine_bytes: int = 0,
) -> RenderPlan:
    """Choose where the blockers live and how many passes there are.

    `limit_bytes` is of the whole process, of which `resident_bytes` are taken before the render begins.
    Raises MemoryLimitError when not even one row of pixels fits; the message has a limit that would do:
    of the process when `process_limit`, else of what is added to `resident_bytes`. `engine_bytes` is what
    the backend takes beside receivers and light (`backend_bytes`).
    """
    film = film_bytes(window, len(lights))
    free = limit_bytes - resident_bytes - _KERNEL_BYTES - film
    n_words = max(-(-light.samples // 64) for light in lights)
    row_bytes = (window[2] - window[0]) * _pixel_bytes(n_words)
    write_bytes = _ENCODE_BYTES + (window[2] - window[0]) * (window[3] - window[1]) * _PREVIEW_BYTES
    light_bytes = max(light.samples * light.sets for light in lights) * _SAMPLE_BYTES + engine_bytes
    source, ingest_bytes, blocker_bytes = _place_blockers(geometry, free, light_bytes + row_bytes)
    least = max(ingest_bytes, blocker_bytes + light_bytes + row_bytes, write_bytes)
    if free < least:
        before = 0 if process_limit else resident_bytes
        enough = enough_limit(limit_bytes - free + least - before)
        samples = max(light.samples for light in lights)
        refusal = _refusal(resolution, window, samples, limit_bytes - before, enough)
        raise MemoryLimitError(refusal, enough)
    passes = _bands(window, (free - blocker_bytes - light_bytes) // row_bytes)
    return RenderPlan(
        resolution=resolution,
        window=window,
        lights=tuple(lights),
        geometry=geometry,
        source=source,
        passes=passes,
        threads=threads,
        backend=backend,
        limit_bytes=limit_bytes,
        resident_bytes=resident_bytes,
        kernel_bytes=_KERNEL_BYTES,
        film_bytes=film,
        ingest_bytes=ingest_bytes,
        blocker_bytes=blocker_bytes,
        pass_bytes=light_bytes + max(y1 - y0 for _, y0, _, y1 in passes) * row_bytes,
        write_bytes=write_bytes,
        scratch_bytes=geometry.n_triangles * _SCRATCH_TRIANGLE_BYTES if source == "temporary store" else 0,
    )


def backend_bytes(backend: str, options: CastOptions, chunk_triangles: int) -> int:
    """Memory that a backend takes beside receivers and light: lists of the cells, bounds of a chunk."""
    if backend != "gears":
        return 0
    n_cells = options.grid_resolution**2
    # One blocker may touch every cell.
    pair_bytes = max(options.pair_bytes, 4 * n_cells)
    return pair_bytes + n_cells * _CELL_BYTES + chunk_triangles * _BOUND_BYTES


def fitted_options(options: CastOptions, limit_bytes: int) -> CastOptions:
    """Options with a grid, and lists of its cells, that take an eighth of the limit each at most."""
    eighth = max(limit_bytes // 8, _CELL_BYTES)
    return replace(
        options,
        pair_bytes=min(options.pair_bytes, eighth),
        grid_resolution=min(options.grid_resolution, math.isqrt(eighth // _CELL_BYTES)),
    )


def receivers_per_pass(
    n_receivers: int, n_samples: int, sets: int, blocker_bytes: int, keep_masks: bool, limit_bytes: int
) -> int:
    """How many of the receivers of one `cast` are cast at a time, beside blockers, light and result.

    Raises MemoryLimitError when fewer than `_LEAST_PASS` of them, or than all, would fit.
    """
    held, receiver_bytes = _call_bytes(n_receivers, n_samples, sets, keep_masks)
    held += blocker_bytes
    least = held + min(n_receivers, _LEAST_PASS) * receiver_bytes
    if least > limit_bytes:
        raise MemoryLimitError(
            f"casting {n_receivers} points needs {format_bytes(least)} and the limit is"
            f" {format_bytes(limit_bytes)}: raise memory, cast fewer points at a time, or name a store"
        )
    return max(1, min(n_receivers, (limit_bytes - held) // receiver_bytes))


def least_cast_bytes(
    n_receivers: int, n_samples: int, sets: int, blocker_bytes: int, chunk_triangles: int, backend: str
) -> int:
    """A limit that is enough for one `cast` that keeps no masks, by a backend with its default options."""
    held, receiver_bytes = _call_bytes(n_receivers, n_samples, sets, keep_masks=False)
    # Without grid and lists of cells, which then take an eighth each of what is given (`fitted_options`).
    fixed = backend_bytes(backend, fitted_options(CastOptions(), 0), chunk_triangles)
    least = held + blocker_bytes + fixed + min(n_receivers, _LEAST_PASS) * receiver_bytes
    return least if backend != "gears" else -(-4 * least // 3)


def _call_bytes(n_receivers: int, n_samples: int, sets: int, keep_masks: bool) -> tuple[int, int]:
    """What one `cast` holds for light and result, and what it adds for a receiver of a pass."""
    n_words = -(-n_samples // 64)
    result_bytes = _RESULT_BYTES + (8 * n_words if keep_masks else 0)
    held = n_samples * sets * _SAMPLE_BYTES + n_receivers * result_bytes
    return held, _RECEIVER_BYTES + _CAST_BYTES + n_words * _MASK_WORD_BYTES


def array_bytes(n_triangles: int) -> int:
    """Memory of an array of triangles while it is sorted for casting."""
    return n_triangles * _READ_TRIANGLE_BYTES


def _pixel_bytes(n_words: int) -> int:
    """Memory of one pixel of a pass: finding visible points and casting them follow each other."""
    return max(_VISIBLE_BYTES, _GBUFFER_BYTES + _CAST_BYTES + n_words * _MASK_WORD_BYTES)


def _place_blockers(
    geometry: GeometryPlan, free: int, least_pass_bytes: int
) -> tuple[BlockerSource, int, int]:
    """Where the blockers are read from, the memory to get them there, and what they then take of `free`."""
    if geometry.is_store:
        return "store", 0, _STORE_BYTES
    read_bytes = geometry.n_triangles * _READ_TRIANGLE_BYTES
    kept_bytes = geometry.n_triangles * _KEPT_TRIANGLE_BYTES + min(
        _TREE_BYTES, geometry.n_triangles * _KEPT_TRIANGLE_BYTES
    )
    # Half of what is free at most: the other half makes the passes few.
    if read_bytes <= free and kept_bytes <= min(free // 2, free - least_pass_bytes):
        return "memory", read_bytes, kept_bytes
    return "temporary store", _INGEST_LEAST_BYTES, _STORE_BYTES


def _bands(window: Window, rows: int) -> tuple[Window, ...]:
    """Cut the window into bands of at most `rows` rows, as even as can be."""
    x0, y0, x1, y1 = window
    n_bands = math.ceil((y1 - y0) / rows)
    edges = [y0 + (y1 - y0) * band // n_bands for band in range(n_bands + 1)]
    return tuple((x0, first, x1, last) for first, last in zip(edges, edges[1:], strict=False))


def enough_limit(least_bytes: int) -> int:
    """A limit to advise, rounded up with some slack: what is resident before differs from run to run."""
    return (least_bytes + least_bytes // 50 + _ROUND_BYTES) // _ROUND_BYTES * _ROUND_BYTES


def _refusal(resolution: tuple[int, int], window: Window, samples: int, limit: int, enough: int) -> str:
    width, height = window[2] - window[0], window[3] - window[1]
    part = "" if (width, height) == tuple(resolution) else f" (of {resolution[0]} x {resolution[1]})"
    return (
        f"a picture of {width} x {height} pixels{part} with {samples} light "
        f"sample{'s' if samples > 1 else ''} does not fit the memory limit of {format_bytes(limit)}: "
        f"give {enough >> 20}MiB or more, or render fewer pixels (--resolution, --crop)"
    )
