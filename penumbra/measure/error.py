"""`penumbra bench error`: how wrong so many light samples of a pattern are, and what a backend takes for it.

The scene is ingested once and its camera's receivers are found once. Each backend casts them with every
number of samples and pattern, and visibility is compared with a reference of many samples.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from penumbra.api import backend_named
from penumbra.arrays import Float32Array, Float64Array
from penumbra.errors import BackendError, SceneError
from penumbra.lights import MAX_SAMPLES, RectLight
from penumbra.measure.cost import Cost, measured
from penumbra.measure.error_report import ErrorReport, ErrorRow, Pattern, fit_slopes
from penumbra.measure.metrics import error_metrics, root_mean_square
from penumbra.measure.progress import Prefixed
from penumbra.measure.report import machine_facts
from penumbra.measure.scene import OpenScene, chosen_light, open_scene
from penumbra.memory import peak_bytes
from penumbra.progress import NullProgress, Progress
from penumbra.scene import Scene

DEFAULT_BACKENDS = ("hpc", "gears")
DEFAULT_SAMPLES = (16, 32, 64, 128, 256, 512, 1024)
DEFAULT_REFERENCE = 16384
DEFAULT_RESOLUTION = (320, 240)

# A cast is repeated until it took so many seconds in all, or was done so many times.
_REPEAT_SECONDS = 1.0
_MOST_REPEATS = 5

PATTERNS = (Pattern("regular", 1), Pattern("jittered", 1), Pattern("jittered", 8))


@dataclass(frozen=True)
class ErrorOptions:
    """What to measure."""

    light: str | None = None
    """Name of the area light; the scene's first by default."""
    resolution: tuple[int, int] = DEFAULT_RESOLUTION
    """Width and height of the picture whose pixels are the receivers, in place of the scene's."""
    samples: Sequence[int] = DEFAULT_SAMPLES
    reference: int = DEFAULT_REFERENCE
    """Samples of the reference, in two independent halves whose difference tells its own error."""
    backends: Sequence[str] = DEFAULT_BACKENDS
    threads: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "samples", tuple(sorted(set(self.samples))))
        object.__setattr__(self, "backends", tuple(dict.fromkeys(self.backends)))
        if not self.samples or not self.backends:
            raise SceneError("there is nothing to measure: name at least one number of samples and a backend")
        for backend in self.backends:
            backend_named(backend)
        if not 1 <= self.samples[0] <= self.samples[-1] <= MAX_SAMPLES:
            raise SceneError(f"samples are {list(self.samples)}: give whole numbers from 1 to {MAX_SAMPLES}")
        least, most = 2 * self.samples[-1], 2 * MAX_SAMPLES
        if not (least <= self.reference <= most and self.reference % 2 == 0):
            raise SceneError(
                f"reference is {self.reference} samples: give an even number from {least}, twice the most "
                f"samples measured, to {most}"
            )


def measure_error(
    scene: Scene | str | Path,
    options: ErrorOptions | None = None,
    *,
    memory: int | str | None = None,
    process_limit: bool = False,
    progress: Progress | None = None,
) -> ErrorReport:
    """Measure error and cost of visibility in a scene.

    memory: bytes that the call may add to the resident memory, or a size; None is half of the free memory;
    with `process_limit` it is the limit of the whole process. Raises SceneError for a scene without an area
    light and for samples out of range, BackendError for an unknown backend or where two backends differ,
    MemoryLimitError where the limit is too low, and what reading the scene raises.
    """
    options = options or ErrorOptions()
    progress = progress or NullProgress()
    loaded = scene if isinstance(scene, Scene) else Scene.load(scene)
    light = replace(chosen_light(loaded, options.light), seed=options.seed, sets=1, pattern="jittered")
    half = replace(light, samples=options.reference // 2)
    opened = open_scene(
        loaded.with_overrides(resolution=options.resolution),
        half,
        memory=memory,
        process_limit=process_limit,
        threads=options.threads,
        progress=progress,
    )
    with opened as here:
        opening_peak = peak_bytes()
        for backend in options.backends:
            here.warm_up(light, backend)
        reference = cast_reference(here, half, options.backends[0], progress)
        rows = list(_measure(here, light, options, reference, progress))
        costs = [*reference.costs, *(row.cost for row in rows)]
        peak = max(opening_peak, *(cost.peak_bytes for cost in costs))
        return _report(here, options, reference, rows, peak)


class Reference(NamedTuple):
    """What every estimate is compared with."""

    visibility: Float64Array
    """(R,) mean of two independent casts."""
    rms: float
    """RMS error of `visibility` itself, as the two casts tell it."""
    costs: tuple[Cost, Cost]


def cast_reference(here: OpenScene, half: RectLight, backend: str, progress: Progress) -> Reference:
    """Two jittered casts with seeds that no estimate has.

    The error of each is independent of the other's, so that their difference has the sum of both mean
    squares, and their mean a quarter of it: half the RMS difference is the RMS error of the mean.
    """
    halves: list[Float32Array] = []
    costs: list[Cost] = []
    for number in (1, 2):
        light = replace(half, seed=half.seed + number)
        within = Prefixed(progress, f"reference {number} of 2")
        result, cost = measured(here.cast, light, backend, within)
        halves.append(result.visibility)
        costs.append(cost)
    first, second = (half_visibility.astype(np.float64) for half_visibility in halves)
    return Reference(0.5 * (first + second), 0.5 * root_mean_square(first - second), (costs[0], costs[1]))


def _measure(
    here: OpenScene, light: RectLight, options: ErrorOptions, reference: Reference, progress: Progress
) -> Iterator[ErrorRow]:
    """Rows of all patterns, numbers of samples and backends, in this order."""
    in_penumbra = penumbra_of(reference.visibility)
    n_casts = len(PATTERNS) * len(options.samples) * len(options.backends)
    progress.stage("measure", n_casts, "casts")
    for pattern, samples in product(PATTERNS, options.samples):
        cast_light = replace(light, pattern=pattern.pattern, sets=pattern.sets, samples=samples)
        expected: Float32Array | None = None
        for backend in options.backends:
            visibility, cost = _fastest_cast(here, cast_light, backend)
            expected = visibility if expected is None else expected
            _check_equal(options.backends[0], expected, backend, visibility, f"{pattern}, {samples} samples")
            metrics = error_metrics(visibility, reference.visibility, in_penumbra)
            yield ErrorRow(pattern, samples, backend, metrics, cost)
            progress.advance(1)


def _fastest_cast(here: OpenScene, light: RectLight, backend: str) -> tuple[Float32Array, Cost]:
    """Visibility and cost of a cast, the fastest of a few where it is short: that is easily disturbed."""
    spent = 0.0
    costs: list[Cost] = []
    while not costs or (spent < _REPEAT_SECONDS and len(costs) < _MOST_REPEATS):
        result, cost = measured(here.cast, light, backend)
        costs.append(cost)
        spent += cost.seconds
    return result.visibility, min(costs, key=lambda cost: cost.seconds)


def penumbra_of(visibility: Float64Array) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Which receivers (R,) see a part of the light: neither none of its samples nor all."""
    inside: np.ndarray[Any, np.dtype[np.bool_]] = (visibility > 0) & (visibility < 1)
    return inside


def _check_equal(name: str, expected: Float32Array, backend: str, found: Float32Array, case: str) -> None:
    different = np.flatnonzero(expected != found)
    if len(different):
        row = different[0]
        raise BackendError(
            f"{backend} and {name} differ at {len(different)} of {len(found)} receivers ({case}; first at "
            f"receiver {row}: {found[row]} and {expected[row]}): this is a bug in penumbra, please report it"
        )


def _report(
    here: OpenScene, options: ErrorOptions, reference: Reference, rows: list[ErrorRow], peak: int
) -> ErrorReport:
    n_receivers = len(reference.visibility)
    in_penumbra = penumbra_of(reference.visibility)
    return ErrorReport(
        scene=here.scene.path.name if here.scene.path else "scene",
        light=here.scene.lights[0].name,
        resolution=options.resolution,
        n_triangles=here.blockers.n_triangles,
        n_receivers=n_receivers,
        n_penumbra=int(in_penumbra.sum()),
        seed=options.seed,
        threads=here.plan.threads,
        limit_bytes=here.plan.limit_bytes,
        reference_samples=options.reference,
        reference_rms=reference.rms,
        reference_seconds=sum(cost.seconds for cost in reference.costs),
        backends=tuple(options.backends),
        rows=tuple(rows),
        slopes=fit_slopes(rows, reference.rms),
        peak_bytes=peak,
        machine=machine_facts(),
    )
