"""`penumbra bench stability`: scenes made to break shadow algorithms, judged bit by bit and timed.

Every scene is cast by the backend "reference", which decides each bit by exact signs alone, and by every
other backend; each bit in which a backend differs is wrong.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from penumbra.api import CastResult, backend_named, cast
from penumbra.arrays import UInt64Array
from penumbra.errors import SceneError
from penumbra.executors.threads import resolve_threads, run_tasks
from penumbra.measure.backends import DEFAULT_BACKENDS
from penumbra.measure.report import machine_facts
from penumbra.measure.stability_cases import cases_named, ordinary_of
from penumbra.measure.stability_report import PLAIN, StabilityReport, StabilityRow, WrongBit
from penumbra.measure.stability_scene import Case, HardScene, SceneSize, hard_scene
from penumbra.progress import NullProgress, Progress

JUDGE = "reference"

# Casting then takes most of the time of `cast`, and the judge 0.1 s (ordinary) to 0.6 s a scene.
SIZE = SceneSize(n_receivers=1024, n_blockers=128, n_samples=64)
QUICK_SIZE = SceneSize(n_receivers=64, n_blockers=24, n_samples=16)

# The powers of two move a scene without rounding, so that what is zero stays zero far from the origin.
SCALES_AND_OFFSETS = (
    *((scale, offset) for scale in (1e-6, 1.0, 1e6) for offset in (0.0, 1e4, 1e6)),
    (2.0**-20, 1e6),
    (2.0**20, 1e6),
)

_REPEATS = 5
_REPEAT_SECONDS = 0.25
# All times are divided by those of the two ordinary scenes, which are the shortest.
_ORDINARY_REPEATS = 25

Timed = tuple[list[CastResult], float]
"""What was cast, and the median of its processor seconds."""


@dataclass(frozen=True)
class StabilityOptions:
    """What to judge."""

    backends: Sequence[str] = DEFAULT_BACKENDS
    cases: Sequence[str] = ()
    """Names of cases; all when empty."""
    seed: int = 0
    quick: bool = False
    """Small scenes: for a first look, and for tests."""
    threads: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "backends", tuple(dict.fromkeys(self.backends)))
        for backend in self.backends:
            backend_named(backend)
        if JUDGE in self.backends or not self.backends:
            raise SceneError(f"backend {JUDGE} is the judge: name at least one other, and not it")

    @property
    def size(self) -> SceneSize:
        """Receivers, blockers and samples of every scene."""
        return QUICK_SIZE if self.quick else SIZE


def measure_stability(
    options: StabilityOptions | None = None, progress: Progress | None = None
) -> StabilityReport:
    """Cast every case at every scale and offset with every backend, and judge it.

    Wrong bits are reported and not raised. Raises SceneError for an unknown case, BackendError for an
    unknown backend.
    """
    options = options or StabilityOptions()
    progress = progress or NullProgress()
    cases = cases_named(options.cases)
    threads = resolve_threads(options.threads)
    ordinary = {
        case.name: _cast_ordinary(case, options, threads)
        for case in dict.fromkeys(ordinary_of(case) for case in cases)
    }
    progress.stage("stability", len(cases) * len(SCALES_AND_OFFSETS), "scenes")
    rows = [row for case in cases for row in _judge_case(case, options, threads, ordinary, progress)]
    return StabilityReport(
        receivers=options.size.n_receivers,
        blockers=options.size.n_blockers,
        samples=options.size.n_samples,
        point_receivers=options.size.n_point_receivers,
        scenes=len(cases) * len(SCALES_AND_OFFSETS),
        seed=options.seed,
        quick=options.quick,
        threads=threads,
        backends=tuple(options.backends),
        cases={case.name: case.what for case in cases},
        ordinary_cpu_seconds={
            case: {backend: seconds for backend, (_, seconds) in timed.items()}
            for case, timed in ordinary.items()
        },
        rows=tuple(rows),
        machine=machine_facts(),
    )


def _cast_ordinary(case: Case, options: StabilityOptions, threads: int) -> dict[str, Timed]:
    """What every backend takes for an ordinary case; no kernel is compiled while the time is taken."""
    small, scene = hard_scene(case, QUICK_SIZE), hard_scene(case, options.size, options.seed)
    for backend in (JUDGE, *options.backends):
        _cast(small, backend)
    return {backend: _timed_cast(scene, backend, threads, _ORDINARY_REPEATS) for backend in options.backends}


def _judge_case(
    case: Case,
    options: StabilityOptions,
    threads: int,
    ordinary: dict[str, dict[str, Timed]],
    progress: Progress,
) -> Iterator[StabilityRow]:
    """Rows of all scales, offsets and backends of a case, in this order."""
    scenes = [
        hard_scene(case, options.size, options.seed, scale, offset) for scale, offset in SCALES_AND_OFFSETS
    ]
    # The judge is slow where much is exactly zero, and not timed: it may take all threads.
    judged = run_tasks(lambda scene: _masks(_cast(scene, JUDGE)), scenes, threads)
    for (scale, offset), scene, expected in zip(SCALES_AND_OFFSETS, scenes, judged, strict=True):
        for backend in options.backends:
            # The ordinary scene itself has been cast and timed.
            timed = ordinary.get(case.name, {}) if (scale, offset) == PLAIN else {}
            results, seconds = timed.get(backend) or _timed_cast(scene, backend, threads)
            counters: dict[str, Any] = results[-1].stats.as_dict()
            compared = [_compare(_masks(result), expected) for result in results]
            first, n_wrong = max(compared, key=lambda found: found[1])
            yield StabilityRow(
                case=case.name,
                scale=scale,
                offset=offset,
                backend=backend,
                bits=scene.n_bits,
                wrong_bits=n_wrong,
                escalated_f64=counters["escalated_f64"],
                escalated_exact=counters["escalated_exact"],
                cpu_seconds=seconds,
                times_ordinary=seconds / ordinary[ordinary_of(case).name][backend][1],
                first_wrong=first,
            )
        progress.advance(1)


def _cast(scene: HardScene, backend: str, threads: int = 1) -> CastResult:
    return cast(
        scene.points,
        scene.triangles,
        scene.light,
        normals=scene.normals,
        own=scene.own,
        backend=backend,
        threads=threads,
    )


def _timed_cast(scene: HardScene, backend: str, threads: int, repeats: int = _REPEATS) -> Timed:
    """The results and the median processor time of a few casts (of fewer where they are slow).

    Results whose bits are those of an earlier one are left out: more than one is left only by a race.
    """
    seconds: list[float] = []
    results: list[CastResult] = []
    while len(seconds) < repeats and sum(seconds) < _REPEAT_SECONDS:
        began = time.process_time()
        result = _cast(scene, backend, threads)
        seconds.append(time.process_time() - began)
        if not any(np.array_equal(_masks(result), _masks(other)) for other in results):
            results.append(result)
    return results, median(seconds)


def _masks(result: CastResult) -> UInt64Array:
    assert result.masks is not None
    return result.masks


def _compare(masks: UInt64Array, expected: UInt64Array) -> tuple[WrongBit | None, int]:
    """The first wrong bit, and how many there are."""
    wrong = masks ^ expected
    n_wrong = int(np.bitwise_count(wrong).sum())
    if not n_wrong:
        return None, 0
    receiver, word = np.argwhere(wrong)[0]
    lowest = int(wrong[receiver, word]) & -int(wrong[receiver, word])
    bit = lowest.bit_length() - 1
    return WrongBit(
        int(receiver), 64 * int(word) + bit, bool(int(expected[receiver, word]) & lowest)
    ), n_wrong
