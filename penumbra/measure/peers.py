"""`penumbra bench peers`: us and Embree side by side in one run, scene by scene."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from penumbra.api import backend_named, cast, visible_fraction
from penumbra.arrays import UInt64Array
from penumbra.executors.threads import resolve_threads
from penumbra.io.atomic import temporary_folder
from penumbra.measure.equal_error import measure_equal_error
from penumbra.measure.peer_case import CastCase
from penumbra.measure.peers_report import Agreement, PeerReport, PeerRow
from penumbra.measure.report import machine_facts
from penumbra.measure.scaling_scenes import NamedScene
from penumbra.measure.side_by_side import SideBySide, case_of
from penumbra.progress import NullProgress, Progress
from penumbra.scene import Scene

_JUDGE = "reference"


@dataclass(frozen=True)
class PeerOptions:
    """What to measure; None keeps what the scene says."""

    resolution: tuple[int, int] | None = None
    samples: int | None = None
    sets: int = 1
    """Sample sets; one, as ray tracers do it in benchmarks, or as many as a picture without bands needs."""
    light: str | None = None
    rounds: int = 3
    """Passes of each side, in turn."""
    threads: int = 0
    backend: str = "auto"
    judged: int = 16
    """Receivers with disagreeing bits that exact brute force decides."""
    mitsuba: bool = False
    """Also measure how long Mitsuba takes to an error like ours, where it is installed."""

    def __post_init__(self) -> None:
        backend_named(self.backend)
        object.__setattr__(self, "threads", resolve_threads(self.threads))


def measure_peers(
    scenes: Sequence[NamedScene],
    options: PeerOptions,
    scratch: Path | None = None,
    progress: Progress | None = None,
) -> PeerReport:
    """Measure every scene; scratch: where stores and meshes are written meanwhile.

    Raises BackendError where Embree is not installed, and what reading a scene raises.
    """
    progress = progress or NullProgress()
    rows = []
    for scene in scenes:
        # A process for each scene: what one leaves in memory would count as the next one's.
        with temporary_folder(scratch or Path(tempfile.gettempdir())) as folder:
            rows.append(_measure_scene(scene, options, folder, progress))
    return PeerReport(
        tuple(rows), options.threads, options.backend, options.rounds, machine_facts(), options.mitsuba
    )


def _measure_scene(named: NamedScene, options: PeerOptions, folder: Path, progress: Progress) -> PeerRow:
    scene = Scene.load(named.path)
    with SideBySide(folder, options.threads, options.backend) as sides:
        progress.stage(f"{named.name}: build", None, "")
        ingest, build = sides.build(scene.geometry)
        progress.stage(f"{named.name}: receivers", None, "")
        with sides.blockers() as blockers:
            case = case_of(
                scene,
                blockers,
                light=options.light,
                samples=options.samples,
                sets=options.sets,
                resolution=options.resolution,
                threads=options.threads,
            )
        sides.load(case)
        progress.stage(f"{named.name}: cast and trace in turn", None, "")
        rounds = sides.measure(options.rounds)
        ours, embree = sides.our_masks(), sides.embree_masks()
        progress.stage(f"{named.name}: judge", None, "")
        agreement = _agreement(case, sides.store, ours, embree, options.judged)
    equal = None
    if options.mitsuba:
        progress.stage(f"{named.name}: Mitsuba to equal error", None, "")
        visibility = visible_fraction(ours, case.light.samples).astype(np.float64)
        equal = measure_equal_error(case, sides.store, folder, visibility, options.threads)
    progress.close()
    return PeerRow(named.name, case.facts(), ingest, build, rounds, agreement, equal)


def _agreement(case: CastCase, store: Path, ours: UInt64Array, embree: UInt64Array, judged: int) -> Agreement:
    """Compare bits, and have exact brute force decide some of the receivers where they differ."""
    differing = ours ^ embree
    rows = np.flatnonzero(differing.any(axis=1))
    chosen = np.sort(np.random.default_rng(0).choice(rows, min(judged, len(rows)), replace=False))
    wrong_ours = wrong_embree = 0
    if len(chosen):
        exact = cast(
            case.points[chosen],
            store,
            case.light,
            normals=case.normals[chosen],
            own=case.own[chosen],
            index=case.index[chosen],
            backend=_JUDGE,
        ).masks
        assert exact is not None
        wrong_ours, wrong_embree = _count(exact ^ ours[chosen]), _count(exact ^ embree[chosen])
    visibility = visible_fraction(ours, case.light.samples)
    return Agreement(
        n_bits=len(ours) * case.light.samples,
        n_differing=_count(differing),
        n_blocked_by_us_alone=_count(ours & ~embree),
        n_judged=len(chosen),
        n_wrong_ours=wrong_ours,
        n_wrong_embree=wrong_embree,
        penumbra_share=_share((visibility > 0) & (visibility < 1)),
        umbra_share=_share(visibility == 0),
    )


def _count(masks: UInt64Array) -> int:
    return int(np.bitwise_count(masks).sum(dtype=np.int64))


def _share(flags: np.ndarray) -> float:
    return float(flags.mean()) if len(flags) else 0.0
