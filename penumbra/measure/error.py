"""`penumbra bench error`: how wrong so many light samples of a pattern are, and what a backend takes for it.

The scene is ingested once and its camera's receivers are found once. Each backend casts them with every
number of samples and pattern, and visibility is compared with a reference of many samples.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from penumbra.api import backend_named
from penumbra.arrays import Float32Array, Float64Array
from penumbra.errors import BackendError, Interrupted, SceneError
from penumbra.lights import MAX_SAMPLES, RectLight
from penumbra.measure.backends import DEFAULT_BACKENDS
from penumbra.measure.cost import Cost, measured
from penumbra.measure.error_report import ErrorReport, ErrorRow, Pattern, fit_slopes
from penumbra.measure.metrics import error_metrics, root_mean_square
from penumbra.measure.progress import Prefixed
from penumbra.measure.report import machine_facts
from penumbra.measure.scene import OpenScene, chosen_light, open_scene
from penumbra.memory import peak_bytes
from penumbra.progress import NullProgress, Progress
from penumbra.scene import Scene

DEFAULT_SAMPLES = (16, 32, 64, 128, 256, 512, 1024)
LEAST_REFERENCE = 16384
MAX_REFERENCE = 2 * MAX_SAMPLES
DEFAULT_RESOLUTION = (320, 240)

# A cast is repeated until it took so many seconds in all, or was done so many times.
_REPEAT_SECONDS = 1.0
_MOST_REPEATS = 5

# What of a light's settings is measured, and not the scene's.
_OF_A_ROW = ("name", "samples", "sets", "seed", "pattern")

# Samples of the reference by default, over the most that are measured: its error is then an eighth of the
# least one where shadows have edges (16 ** -3/4).
_REFERENCE_FACTOR = 16

PATTERNS = (Pattern("regular", 1), Pattern("jittered", 1), Pattern("jittered", 8))


@dataclass(frozen=True)
class ErrorOptions:
    """What to measure."""

    light: str | None = None
    """Name of the area light; the scene's first by default."""
    resolution: tuple[int, int] = DEFAULT_RESOLUTION
    """Width and height of the picture whose pixels are the receivers, in place of the scene's."""
    samples: Sequence[int] = DEFAULT_SAMPLES
    reference: int | None = None
    """Samples of the reference, in two independent halves whose difference tells its own error; by default
    16 times the most of `samples`, but 16384 at least and 131072 at most."""
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
        least, reference = 2 * self.samples[-1], self.reference
        if reference is None:
            reference = min(max(LEAST_REFERENCE, _REFERENCE_FACTOR * self.samples[-1]), MAX_REFERENCE)
            object.__setattr__(self, "reference", reference)
        if not (least <= reference <= MAX_REFERENCE and reference % 2 == 0):
            raise SceneError(
                f"reference is {reference} samples: give an even number from {least}, twice the most "
                f"samples measured, to {MAX_REFERENCE}"
            )

    @property
    def reference_half(self) -> int:
        """Samples of each half of the reference."""
        assert self.reference is not None
        return self.reference // 2


def measure_error(
    scene: Scene | str | Path,
    options: ErrorOptions | None = None,
    *,
    memory: int | str | None = None,
    process_limit: bool = False,
    progress: Progress | None = None,
    on_stop: Callable[[ErrorReport], None] | None = None,
) -> ErrorReport:
    """Measure error and cost of visibility in a scene.

    memory: bytes that the call may add to the resident memory, or a size; None is half of the free memory;
    with `process_limit` it is the limit of the whole process. on_stop: called with what is finished when
    Ctrl-C or SIGTERM stops the measuring, which is then raised as ever. Raises SceneError for a scene
    without an area light or with nothing in penumbra and for samples out of range, BackendError for an
    unknown backend or where two backends differ, MemoryLimitError where the limit is too low, and what
    reading the scene raises.
    """
    options = options or ErrorOptions()
    progress = progress or NullProgress()
    loaded = scene if isinstance(scene, Scene) else Scene.load(scene)
    light = replace(chosen_light(loaded, options.light), seed=options.seed, sets=1, pattern="jittered")
    half = replace(light, samples=options.reference_half)
    most_sets = max(pattern.sets for pattern in PATTERNS)
    opened = open_scene(
        loaded.with_overrides(resolution=options.resolution),
        [half, replace(light, samples=options.samples[-1], sets=most_sets)],
        options.backends,
        memory=memory,
        process_limit=process_limit,
        threads=options.threads,
        progress=progress,
    )
    with opened as here:
        if not len(here.seen.pixel):
            raise SceneError(f"{here.name}: the camera sees no surface, so there is nothing to measure")
        opening_peak = peak_bytes()
        for backend in options.backends:
            here.warm_up(light, backend)
        reference = cast_reference(here, half, options.backends[0], progress)
        _check_penumbra(here, reference)
        rows: list[ErrorRow] = []
        try:
            for row in _measure(here, light, options, reference, progress):
                rows.append(row)
        except (KeyboardInterrupt, Interrupted):
            # Where one backend was cast and the next was not, there is nothing to compare.
            finished = rows[: len(rows) - len(rows) % len(options.backends)]
            if finished and on_stop is not None:
                on_stop(_report(here, options, reference, finished, opening_peak))
            raise
        return _report(here, options, reference, rows, opening_peak)


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
    progress.stage("measure", _n_rows(options), "casts")
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


def _check_penumbra(here: OpenScene, reference: Reference) -> None:
    """Refuse a scene in which any number of samples is right everywhere."""
    if not penumbra_of(reference.visibility).any():
        seen = " or ".join(("none", "all")[int(value)] for value in np.unique(reference.visibility))
        raise SceneError(
            f"{here.name}: no point that the camera sees is in penumbra of light "
            f"'{here.scene.lights[0].name}' (each sees {seen} of it), so there is no error to measure: "
            "choose another light (--light) or another view"
        )


def _n_rows(options: ErrorOptions) -> int:
    return len(PATTERNS) * len(options.samples) * len(options.backends)


def _check_equal(name: str, expected: Float32Array, backend: str, found: Float32Array, case: str) -> None:
    different = np.flatnonzero(expected != found)
    if len(different):
        row = different[0]
        raise BackendError(
            f"{backend} and {name} differ at {len(different)} of {len(found)} receivers ({case}; first at "
            f"receiver {row}: {found[row]} and {expected[row]}): this is a bug in penumbra, please report it"
        )


def _report(
    here: OpenScene, options: ErrorOptions, reference: Reference, rows: list[ErrorRow], opening_peak: int
) -> ErrorReport:
    costs = [*reference.costs, *(row.cost for row in rows)]
    light = here.scene.lights[0].settings()
    n_receivers = len(reference.visibility)
    in_penumbra = penumbra_of(reference.visibility)
    return ErrorReport(
        scene=here.scene.path.name if here.scene.path else "scene",
        scene_path=str(here.scene.path.resolve()) if here.scene.path else None,
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        camera=asdict(here.scene.camera),
        light=here.scene.lights[0].name,
        # Without what differs from row to row.
        light_settings={key: value for key, value in light.items() if key not in _OF_A_ROW},
        resolution=options.resolution,
        n_triangles=here.blockers.n_triangles,
        n_receivers=n_receivers,
        n_penumbra=int(in_penumbra.sum()),
        seed=options.seed,
        threads=here.plan.threads,
        limit_bytes=here.plan.limit_bytes,
        reference_samples=2 * options.reference_half,
        reference_rms=reference.rms,
        reference_seconds=sum(cost.seconds for cost in reference.costs),
        backends=tuple(options.backends),
        rows=tuple(rows),
        slopes=fit_slopes(rows, reference.rms),
        peak_bytes=max(opening_peak, *(cost.peak_bytes for cost in costs)),
        is_complete=len(rows) == _n_rows(options),
        machine=machine_facts(),
    )
