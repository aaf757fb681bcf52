"""The Python calls that need no camera: `cast`, and `camera_receivers` to cast what a camera sees."""

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from penumbra.arrays import Float32Array, Float64Array, Int64Array, Receivers, UInt8Array, UInt64Array
from penumbra.blockers import Blockers, MemoryBlockers
from penumbra.errors import BackendError, SceneError
from penumbra.executors.threads import resolve_threads
from penumbra.lights import Light, PointLight, RectLight
from penumbra.memory import call_limit_bytes, give_back
from penumbra.options import CastOptions, IngestOptions, parse_size
from penumbra.plan import array_bytes, backend_bytes, fitted_options, receivers_per_pass
from penumbra.progress import NullProgress, Progress, RepeatedStage
from penumbra.scene import Scene
from penumbra.stats import Stats


@dataclass(frozen=True, eq=False)
class CastResult:
    """Which light samples each of R receivers sees; K samples, sample i is bit i % 64 of word i // 64."""

    masks: UInt64Array | None
    """(R, ceil(K / 64)); a set bit means blocked, bits beyond K are 0; None if keep="visibility"."""
    sample_set: UInt8Array
    """(R,) index into `light.sample_points` of the sample set that the receiver used."""
    visibility: Float32Array
    """(R,) fraction of the samples that are not blocked."""
    stats: Stats
    """Counters and seconds; `stats.as_dict()`."""


def cast(
    points: Float64Array,
    blockers: Any,
    light: Light,
    *,
    normals: Float64Array | None = None,
    own: Int64Array | None = None,
    index: Int64Array | None = None,
    backend: str = "hpc",
    memory: int | str | None = None,
    threads: int = 0,
    progress: Progress | None = None,
    keep: Literal["masks", "visibility"] = "masks",
    options: CastOptions | None = None,
) -> CastResult:
    """Find which samples of a light each point sees, exactly.

    points: (R, 3) world space. blockers: a store or its path, a trimesh.Trimesh, or triangles
    (T, 3, 3), whose float64 values are used as given. normals: (R, 3); samples with n . (l - r) <= 0
    count as blocked. own: (R,) index of the triangle each point lies on (it never blocks that point),
    -1 for none. index: (R,) what the sample set is hashed from, the row by default. memory: bytes this
    call may add, e.g. "2GiB"; None is half of the free memory (compiled kernels take some 100 MB of a
    process once, on top). threads: 0 for all.

    Raises SceneError for input that is not usable (it names the row), MemoryLimitError when the
    result cannot fit, BackendError for an unknown backend.
    """
    options = options or CastOptions()
    if not isinstance(light, RectLight | PointLight):
        raise SceneError(f"light is {light!r}: give a penumbra.RectLight or a penumbra.PointLight")
    receivers = _checked_receivers(points, normals, own, index)
    if keep not in ("masks", "visibility"):
        raise SceneError(f"keep is {keep!r}: give 'masks' or 'visibility'")
    limit = call_limit_bytes(parse_size(memory), process_limit=False)
    given = _checked_blockers(blockers)
    with ExitStack() as stack:
        if not isinstance(given, np.ndarray) and given is not blockers:
            stack.callback(given.close)
        options = fitted_options(options, limit)
        held = _blocker_bytes(given) + backend_bytes(backend, options, _chunk_triangles(given))
        per_pass = receivers_per_pass(
            len(receivers.points), light.samples, light.sets, held, keep == "masks", limit
        )
        if isinstance(given, np.ndarray):
            from penumbra.ingest import blockers_in_memory

            given = blockers_in_memory(given, IngestOptions(sort=options.sort))
        return _cast_in_passes(
            receivers,
            given,
            light,
            per_pass,
            keep,
            backend,
            options=options,
            threads=resolve_threads(threads),
            progress=RepeatedStage(progress or NullProgress(), -(-len(receivers.points) // per_pass)),
        )


def camera_receivers(scene: Scene | str | Path) -> tuple[Float64Array, Float64Array, Int64Array, Int64Array]:
    """Receivers that `render` casts for a scene: points, normals, own, pixel.

    points and normals float64 (R, 3) in world space, the normal geometric and turned to the camera;
    own int64 (R,) triangle index; pixel int64 (R,) is y * W + x from the upper left. Pixels that see
    no surface have no receiver. For the sample sets of `render`, pass `index=pixel` to `cast`.
    """
    from penumbra.render import visible_points

    buffer = visible_points(scene)
    return buffer.points, buffer.normals, buffer.own, buffer.pixel


def backend_named(name: str) -> Any:
    """`cast_receivers` of a backend; "auto" is the fastest one for most scenes. Raises BackendError."""
    if name in ("hpc", "auto"):
        from penumbra import casting

        return casting.cast_receivers
    if name == "reference":
        from penumbra import reference

        return reference.cast_receivers
    if name == "gears":
        from penumbra import gears

        return gears.cast_receivers
    raise BackendError(f"there is no backend {name!r}: use hpc, gears, reference or auto")


def visible_fraction(masks: UInt64Array, n_samples: int) -> Float32Array:
    """Fraction (R,) float32 of n_samples that are not blocked in masks (R, n_words)."""
    blocked = np.bitwise_count(masks).sum(axis=1, dtype=np.int64)
    visibility: Float32Array = ((n_samples - blocked) / n_samples).astype(np.float32)
    return visibility


def _cast_in_passes(
    receivers: Receivers,
    blockers: Blockers,
    light: Light,
    per_pass: int,
    keep: str,
    backend: str,
    **how: Any,
) -> CastResult:
    """Cast runs of receivers that fit the memory, one reading of the blockers each."""
    cast_receivers = backend_named(backend)
    n_receivers = len(receivers.points)
    n_words = -(-light.samples // 64)
    masks = np.zeros((n_receivers, n_words), np.uint64) if keep == "masks" else None
    sample_set = np.zeros(n_receivers, np.uint8)
    visibility = np.ones(n_receivers, np.float32)
    stats = Stats("hpc" if backend == "auto" else backend)
    for first in range(0, n_receivers, per_pass):
        # What the pass before has freed would stand beside what this one takes.
        give_back()
        rows = slice(first, first + per_pass)
        normals = receivers.normals[rows] if len(receivers.normals) else receivers.normals
        part = Receivers(receivers.points[rows], normals, receivers.own[rows], receivers.index[rows])
        found, sample_set[rows], part_stats = cast_receivers(part, blockers, light, **how)
        visibility[rows] = visible_fraction(found, light.samples)
        if masks is not None:
            masks[rows] = found
        # The masks of one pass must not be there while the next is cast.
        del found
        stats.merge(part_stats)
    return CastResult(masks, sample_set, visibility, stats)


def _checked_blockers(blockers: Any) -> Blockers | Float64Array:
    """Blockers as they are, a store opened, or triangles (T, 3, 3) of an array or a Trimesh."""
    if isinstance(blockers, str | Path):
        from penumbra.io.blocker_store import open_store

        return open_store(blockers)
    if hasattr(blockers, "chunks") and hasattr(blockers, "read"):
        opened: Blockers = blockers
        return opened
    # trimesh.Trimesh is recognised by what it has, so that trimesh need not be imported.
    values = blockers.triangles if hasattr(blockers, "triangles") else blockers
    return _checked(values, "blockers", (None, 3, 3))


def _blocker_bytes(blockers: Blockers | Float64Array) -> int:
    """Memory that the blockers add in this call: an array is sorted, of a store two chunks are held."""
    if isinstance(blockers, np.ndarray):
        return array_bytes(len(blockers))
    largest = max((chunk.n_bytes for chunk in blockers.chunks), default=0)
    # In light space one chunk at a time; of a store, two are held, each as it is read and as float64.
    return largest if isinstance(blockers, MemoryBlockers) else 5 * largest


def _chunk_triangles(blockers: Blockers | Float64Array) -> int:
    """Triangles of the largest chunk there is or will be."""
    if isinstance(blockers, np.ndarray):
        return min(len(blockers), IngestOptions().chunk_triangles)
    return max((chunk.count for chunk in blockers.chunks), default=0)


def _checked_receivers(points: Any, normals: Any, own: Any, index: Any) -> Receivers:
    """Arrays as the kernels want them; SceneError names the first bad row."""
    points = _checked(points, "points", (None, 3))
    n_receivers = len(points)
    if normals is None:
        normals = np.zeros((0, 3))
    else:
        normals = _checked(normals, "normals", (n_receivers, 3))
        zero = np.flatnonzero(~normals.any(axis=1))
        if len(zero):
            raise SceneError(f"normals row {zero[0]} is zero: give a direction, or leave normals out")
    own = np.full(n_receivers, -1) if own is None else own
    index = np.arange(n_receivers) if index is None else index
    return Receivers(
        points,
        normals,
        _checked_integers(own, "own", n_receivers),
        _checked_integers(index, "index", n_receivers),
    )


def _checked(values: Any, what: str, shape: tuple[int | None, ...]) -> Float64Array:
    """C-contiguous, writable float64 array of a shape (None: any length) with finite values."""
    wanted = "(" + ", ".join("n" if size is None else str(size) for size in shape) + ")"
    try:
        given = np.asarray(values)
        if given.dtype.kind == "c":
            raise TypeError
        array = np.require(given, np.float64, ["C", "W"])
    except (TypeError, ValueError):
        raise SceneError(f"{what} cannot be read as numbers: give an array of shape {wanted}") from None
    if array.shape == (0,) and shape[0] in (None, 0):
        return np.zeros((0, *(size or 0 for size in shape[1:])))
    if array.ndim != len(shape) or any(s not in (None, n) for s, n in zip(shape, array.shape, strict=True)):
        raise SceneError(f"{what} has shape {array.shape}: give an array of shape {wanted}")
    bad = np.flatnonzero(~np.isfinite(array).all(axis=tuple(range(1, array.ndim))))
    if len(bad):
        raise SceneError(f"{what} row {bad[0]} is not finite: {array[bad[0]].tolist()}")
    return array


def _checked_integers(values: Any, what: str, n_receivers: int) -> Int64Array:
    array = np.asarray(values)
    if array.shape != (n_receivers,) or array.dtype.kind not in "iu" and array.size:
        raise SceneError(
            f"{what} has shape {array.shape} and type {array.dtype}: give {n_receivers} whole numbers"
        )
    if array.size and array.max() > np.iinfo(np.int64).max:
        raise SceneError(f"{what} row {array.argmax()} is {array.max()}: numbers must be below 2**63")
    return np.require(array, np.int64, ["C", "W"])
