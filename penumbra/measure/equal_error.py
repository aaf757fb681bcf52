"""How long another renderer takes to an image as good as ours: Mitsuba, where it is installed."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from penumbra.api import cast
from penumbra.arrays import Float64Array
from penumbra.measure.metrics import root_mean_square
from penumbra.measure.mitsuba_peer import is_installed
from penumbra.measure.peer_case import CastCase
from penumbra.measure.peer_process import PeerProcess

# Receivers whose error is looked at; the time is that of all of them.
_N_JUDGED = 20_000
# Where errors fall with samples to the power of -3/4, 4096 err by an eighth of what 256 err by, which adds
# less than 1 % to an error that is measured against them.
_REFERENCE_SAMPLES = 4096
_REFERENCE_SETS = 16
_FIRST_ROWS = 8
_MOST_ROWS = 64


class Estimate(NamedTuple):
    """One estimate of all receivers."""

    samples: int
    rms: float
    """Error of visibility."""
    cpu_seconds: float
    wall_seconds: float


class EqualError(NamedTuple):
    """Mitsuba's way to our error."""

    version: str
    our_rms: float
    estimates: tuple[Estimate, ...]
    """By growing samples; the last is as good as ours, unless that took too many."""

    def seconds(self, what: str) -> float | None:
        """Seconds (a field of Estimate) to our error, by a power law between estimates; None: not reached."""
        for before, after in zip((None, *self.estimates), self.estimates, strict=False):
            if after.rms <= self.our_rms:
                if before is None or before.rms == after.rms:
                    return float(getattr(after, what))
                part = math.log(before.rms / self.our_rms) / math.log(before.rms / max(after.rms, 1e-300))
                low, high = math.log(getattr(before, what)), math.log(getattr(after, what))
                return math.exp(low + part * (high - low))
        return None

    def as_dict(self) -> dict[str, Any]:
        """Flat JSON values."""
        seconds = {f"mitsuba_{what}": self.seconds(what) for what in ("cpu_seconds", "wall_seconds")}
        return {"our_rms": self.our_rms, "mitsuba_samples": self.estimates[-1].samples, **seconds}


def measure_equal_error(
    case: CastCase, store: Path, folder: Path, visibility: Float64Array, threads: int
) -> EqualError | None:
    """Let Mitsuba take more and more samples until its error is ours; None where it is not installed.

    folder: has the mesh (`write_indexed_mesh`) and the case. visibility (R,): what we found.
    """
    if not is_installed():
        return None
    n_receivers = len(case.points)
    n_judged = min(_N_JUDGED, n_receivers)
    judged = np.sort(np.random.default_rng(1).choice(n_receivers, n_judged, replace=False))
    truth = _reference(case, store, judged)
    our_rms = root_mean_square(visibility[judged] - truth)
    estimates: list[Estimate] = []
    with PeerProcess("penumbra.measure.mitsuba_peer") as peer:
        version = peer.ask("build", mesh=str(folder), threads=threads)["version"]
        peer.ask("case", folder=str(folder))
        # The first pass compiles.
        peer.ask("cast", rows=1, seed=0)
        rows = _FIRST_ROWS
        while rows <= _MOST_ROWS and not (estimates and estimates[-1].rms <= our_rms):
            cost = peer.ask("cast", rows=rows, seed=rows)
            error = _visibility(peer, folder)[judged] - truth
            estimates.append(
                Estimate(rows * rows, root_mean_square(error), cost["cpu_seconds"], cost["seconds"])
            )
            rows *= 2
    return EqualError(version, our_rms, tuple(estimates))


def _reference(case: CastCase, store: Path, rows: np.ndarray[Any, Any]) -> Float64Array:
    """Visibility of some receivers with many samples, independent of the case's."""
    light = case.light
    many = case.with_light(samples=_REFERENCE_SAMPLES, sets=_REFERENCE_SETS, seed=light.seed + 1).light
    result = cast(
        case.points[rows],
        store,
        many,
        normals=case.normals[rows],
        own=case.own[rows],
        index=case.index[rows],
        keep="visibility",
    )
    return result.visibility.astype(np.float64)


def _visibility(peer: PeerProcess, folder: Path) -> Float64Array:
    path = folder / "visibility.npy"
    peer.ask("visibility", path=str(path))
    found: Float64Array = np.load(path)
    return found
