"""3: primary visibility: the blockers streamed once through a z-buffer, and what each pixel sees.

Pixel (x, y) sees the triangle that the ray from the eye through q = eye + ((d0 + y * dy) + x * dx)
(`CameraFrame`; float64, in this order) meets first, edges and both faces included, edge-on triangles
excluded, ties to the lowest triangle index. All of it is decided exactly, so the picture depends on no
order of blockers, no chunk, window or thread.
"""

import math
import mmap
from collections.abc import Iterator
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from penumbra.arrays import BlockerChunk, Float64Array, Int64Array
from penumbra.blockers import Blockers, prefetch
from penumbra.errors import SceneError
from penumbra.executors.threads import resolve_threads, run_tasks
from penumbra.kernels.camera_receivers import fill_receivers
from penumbra.kernels.raster_setup import Vector, View, fill_boxes
from penumbra.kernels.visible import (
    DEPTHS_COMPARED,
    ESCALATED_EXACT,
    N_COUNTERS,
    PIXELS_TESTED,
    ZBand,
    rasterise,
)
from penumbra.progress import NullProgress, Progress
from penumbra.scene import Camera, CameraFrame

Window = tuple[int, int, int, int]
Number = TypeVar("Number", bound=np.generic)

BAND_ROWS = 64
"""Rows of a z-buffer band, the unit of a thread."""
SLICE_TRIANGLES = 8192
"""Triangles whose boxes one task computes."""

# near and far float32, index int64, nine float64 coordinates.
_Z_PIXEL_BYTES = 4 + 4 + 8 + 72
_RECEIVER_BYTES = 8 + 24 + 24 + 8 + 8
_U = 2.0**-53
# Far above the rounding of `to_pixel` and still a small part of a pixel.
_BOX_SLACK = 2.0**-32


class GBuffer(NamedTuple):
    """What the pixels of a window see, one row per pixel that sees anything, by ascending pixel."""

    pixel: Int64Array
    """(R,) y * width + x in the full picture."""
    points: Float64Array
    """(R, 3) receiver points, world space, strictly in front of their triangle."""
    normals: Float64Array
    """(R, 3) unit geometric normals, turned to the camera."""
    own: Int64Array
    """(R,) triangle index."""
    depth: Float64Array
    """(R,) distance of the point from the eye along the camera's forward axis."""


def window_bytes(width: int, height: int, threads: int = 1) -> int:
    """Most bytes that `find_visible` holds for a window of this size, its result included.

    Beside them stand the chunk in use, 112 bytes for each of its triangles, and the chunk read ahead.
    """
    # The z-buffer is given back band by band while the receivers are written, one band a thread.
    rows = min(height, BAND_ROWS * resolve_threads(threads))
    return width * (height * _Z_PIXEL_BYTES + rows * _RECEIVER_BYTES)


def find_visible(
    blockers: Blockers,
    camera: Camera,
    window: Window,
    *,
    threads: int = 1,
    progress: Progress | None = None,
    counters: dict[str, int] | None = None,
) -> GBuffer:
    """Return what the pixels x0 <= x < x1, y0 <= y < y1 of the camera's picture see.

    The values of a window are those of the full picture. `counters` is added to: bytes_read,
    bytes_skipped (chunks outside the view), triangles_rasterised (that may cover a pixel centre),
    pixels_tested, escalated_exact (edge signs decided in integers), depths_compared (pairs whose depths
    float32 intervals left open), offsets_doubled (moves of receivers off their triangles).

    Raises SceneError for a window outside the picture, and for an eye so far from the origin, or a
    field of view so extreme, that float64 cannot tell pixels apart.
    """
    width, height = camera.resolution
    x0, y0, x1, y1 = window
    if not (0 <= x0 <= x1 <= width and 0 <= y0 <= y1 <= height):
        raise SceneError(f"the window {list(window)} is not inside the picture of {width} x {height} pixels")
    counters = {} if counters is None else counters
    frame = camera.frame()
    view = make_view(frame, camera.resolution, window)
    bands = _empty_bands(window)
    for chunk in _visible_chunks(blockers, view, progress or NullProgress(), counters):
        _rasterise_chunk(chunk, view, bands, threads, counters)
    return _collect(bands, view, frame, width, threads, counters)


def make_view(frame: CameraFrame, resolution: tuple[int, int], window: Window) -> View:
    """The camera and window as kernels read them, with the error bounds of this camera.

    Raises SceneError where rounding moves a ray by more than 1/16 of a pixel.
    """
    width, height = resolution
    directions = np.stack([frame.d0, frame.dx, frame.dy])
    reach = np.abs(frame.d0) + width * np.abs(frame.dx) + height * np.abs(frame.dy)
    ray_error = 32 * _U * reach + 4 * _U * np.abs(frame.eye)
    to_pixel = np.linalg.inv(directions.T)
    # Largest at a corner of the picture, because it is linear in x and y.
    corners = np.array([[1.0, x, y] for x in (0, width) for y in (0, height)])
    residual = np.abs(corners @ directions @ to_pixel.T - corners).max(axis=0)
    moved = np.abs(to_pixel) @ ray_error + residual
    margin = float(max(moved[1:]) + 2 * max(width, height) * moved[0])
    if not margin < 1 / 16:
        raise SceneError(
            f"camera.eye {frame.eye.tolist()} is so far from the origin, or camera.vfov so extreme, that "
            "64-bit numbers cannot tell its pixels apart: move the scene nearer to the origin"
        )
    return View(
        eye=_vector(frame.eye),
        d0=_vector(frame.d0),
        dx=_vector(frame.dx),
        dy=_vector(frame.dy),
        window=window,
        to_depth=_vector(to_pixel[0]),
        to_column=_vector(to_pixel[1]),
        to_row=_vector(to_pixel[2]),
        ray_error=_vector(ray_error),
        underflow=1e-300 * (1.0 + float(reach.sum())),
        box_slack=_BOX_SLACK,
        box_margin=margin,
        depth_slack=2.0 * float(moved[0]) + _BOX_SLACK,
    )


def may_be_seen(box: Float64Array, view: View) -> bool:
    """Whether anything in a box (2, 3), min and max, may be in the view's window; errs to True."""
    corners = np.array([[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    relative = corners - view.eye
    to_pixel = np.array([view.to_depth, view.to_column, view.to_row])
    h, x, y = to_pixel @ relative.T
    x0, y0, x1, y1 = view.window
    reach = np.abs(to_pixel).sum() * (1 + max(x1, y1))
    slack = view.box_slack * reach * np.abs(relative).sum(axis=1).max()
    # One pixel further out than the outermost centres, which covers `box_margin`.
    sides = np.stack([h, x - (x0 - 1) * h, x1 * h - x, y - (y0 - 1) * h, y1 * h - y])
    return not bool((sides < -slack).all(axis=1).any())


def _visible_chunks(
    blockers: Blockers, view: View, progress: Progress, counters: dict[str, int]
) -> Iterator[BlockerChunk]:
    """The chunks that may be seen, read one ahead; counts what is read and what is not."""
    seen = [i for i, chunk in enumerate(blockers.chunks) if may_be_seen(chunk.box, view)]
    read_bytes = sum(blockers.chunks[i].n_bytes for i in seen)
    _count(counters, bytes_read=read_bytes)
    _count(counters, bytes_skipped=sum(chunk.n_bytes for chunk in blockers.chunks) - read_bytes)
    progress.stage("primary visibility", read_bytes, "B")
    for i, chunk in prefetch(blockers, seen):
        yield chunk
        progress.advance(blockers.chunks[i].n_bytes)


def _empty_bands(window: Window) -> list[ZBand]:
    x0, y0, x1, y1 = window
    bands = []
    for top in range(y0, y1, BAND_ROWS):
        shape = min(BAND_ROWS, y1 - top), x1 - x0
        band = ZBand(
            near=_own_pages(shape, np.float32),
            far=_own_pages(shape, np.float32),
            own=_own_pages(shape, np.int64),
            vertices=_own_pages((*shape, 9), np.float64),
            left=x0,
            top=top,
        )
        band.near[:], band.far[:], band.own[:] = np.inf, np.inf, -1
        bands.append(band)
    return bands


def _own_pages(shape: tuple[int, ...], dtype: type[Number]) -> NDArray[Number]:
    """A zeroed array whose memory goes back to the system with it; malloc keeps blocks below 32 MiB."""
    n_bytes = math.prod(shape) * np.dtype(dtype).itemsize
    return np.frombuffer(mmap.mmap(-1, max(n_bytes, 1)), dtype, math.prod(shape)).reshape(shape)


def _rasterise_chunk(
    chunk: BlockerChunk, view: View, bands: list[ZBand], threads: int, counters: dict[str, int]
) -> None:
    """Put one chunk into all bands: first the boxes, slice by slice, then the pixels, band by band."""
    n = len(chunk.ids)
    vertices = chunk.vertices.reshape(n, 9)
    survivors = np.empty(n, dtype=np.int64)
    boxes = np.empty((n, 4), dtype=np.int64)
    depths = np.empty((n, 2))

    def fill(first: int) -> int:
        last = min(first + SLICE_TRIANGLES, n)
        return int(fill_boxes(vertices, view, first, last, survivors, boxes, depths))

    starts = range(0, n, SLICE_TRIANGLES)
    found = run_tasks(fill, starts, threads)
    rows = np.concatenate([np.arange(s, s + c) for s, c in zip(starts, found, strict=True)])
    packed = survivors[rows], boxes[rows], depths[rows]

    def draw(band: ZBand) -> Int64Array:
        tally = np.zeros(N_COUNTERS, dtype=np.int64)
        rasterise(vertices, chunk.ids, *packed, view, band, tally)
        return tally

    if not len(rows):
        return
    total = np.sum(run_tasks(draw, bands, threads), axis=0)
    _count(
        counters,
        triangles_rasterised=len(rows),
        pixels_tested=int(total[PIXELS_TESTED]),
        escalated_exact=int(total[ESCALATED_EXACT]),
        depths_compared=int(total[DEPTHS_COMPARED]),
    )


def _collect(
    bands: list[ZBand], view: View, frame: CameraFrame, width: int, threads: int, counters: dict[str, int]
) -> GBuffer:
    """The receivers of all bands in order; a band is dropped as soon as its receivers are written."""
    counts = [int(np.count_nonzero(band.own >= 0)) for band in bands]
    firsts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    n = int(firsts[-1])
    buffer = GBuffer(
        pixel=np.empty(n, dtype=np.int64),
        points=np.empty((n, 3)),
        normals=np.empty((n, 3)),
        own=np.empty(n, dtype=np.int64),
        depth=np.empty(n),
    )
    forward = _vector(frame.forward)
    waiting = dict(enumerate(bands))
    bands.clear()

    def collect(i: int) -> int:
        return int(fill_receivers(view, waiting.pop(i), forward, width, firsts[i], *buffer))

    _count(counters, offsets_doubled=sum(run_tasks(collect, range(len(counts)), threads)))
    return buffer


def _vector(values: Float64Array) -> Vector:
    x, y, z = values.tolist()
    return x, y, z


def _count(counters: dict[str, int], **amounts: int) -> None:
    for name, amount in amounts.items():
        counters[name] = counters.get(name, 0) + amount
