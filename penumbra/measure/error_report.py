"""The result of `bench error`: rows, fitted slopes, and both as JSON, CSV and text."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from penumbra.measure.cost import Cost
from penumbra.measure.metrics import ErrorMetrics, PowerLaw, fit_power_law, without_floor
from penumbra.measure.report import aligned_table, prepare_outputs, write_outputs
from penumbra.memory import format_bytes

FILES = ("error.json", "error.csv", "error.png")

THEORY = {"jittered": "-3/4", "regular": "-1/2 to -3/4"}
"""Exponent of RMS error over samples where an edge crosses the light.

Jittered: Mitchell 1996, "Consequences of stratified sampling in graphics" (variance of N ** -3/2 where there
is an edge). Regular: as jittered over edges of all directions and places, N ** -1/2 for edges parallel to
the rows of samples.
"""

# Nearer to the error of the reference itself, what is left after taking it away is too uncertain to fit.
_LEAST_ABOVE_FLOOR = 2.0


class Pattern(NamedTuple):
    """How the samples of a light are placed."""

    pattern: str
    """"regular" or "jittered"."""
    sets: int
    """Sample sets that receivers choose from."""

    def __str__(self) -> str:
        return f"{self.pattern}, {self.sets} set{'s' if self.sets > 1 else ''}"


class ErrorRow(NamedTuple):
    """One cast: what was cast, how wrong it is and what it cost."""

    pattern: Pattern
    samples: int
    backend: str
    metrics: ErrorMetrics
    cost: Cost

    def as_dict(self) -> dict[str, Any]:
        """One flat row, as in the CSV file."""
        flat = {**self.pattern._asdict(), "samples": self.samples, "backend": self.backend}
        flat |= self.metrics._asdict()
        flat |= {key: value for key, value in self.cost._asdict().items() if key != "peak_is_own"}
        return flat


class Slope(NamedTuple):
    """The power law of RMS error over samples of one pattern."""

    pattern: Pattern
    law: PowerLaw

    def as_dict(self) -> dict[str, Any]:
        """JSON values, with what theory expects."""
        theory = {"theory": THEORY[self.pattern.pattern]}
        return {**self.pattern._asdict(), **self.law._asdict(), **theory}


def fit_slopes(rows: Sequence[ErrorRow], floor: float) -> tuple[Slope, ...]:
    """A law for each pattern, from errors without that of the reference, which is `floor` (RMS).

    All backends have the same errors, so the rows of the first serve.
    """
    first = [row for row in rows if row.backend == rows[0].backend]
    slopes = []
    for pattern in dict.fromkeys(row.pattern for row in first):
        used = [
            row for row in first if row.pattern == pattern and row.metrics.rms >= _LEAST_ABOVE_FLOOR * floor
        ]
        rms = [without_floor(row.metrics.rms, floor) for row in used]
        slopes.append(Slope(pattern, fit_power_law([row.samples for row in used], rms)))
    return tuple(slopes)


@dataclass(frozen=True)
class ErrorReport:
    """Everything that `bench error` measured; `str()` is what it prints."""

    scene: str
    scene_path: str | None
    date: str
    """When it was finished, ISO 8601, UTC."""
    camera: dict[str, Any]
    light: str
    light_settings: dict[str, Any]
    """By the keys of a scene file, without those that differ from row to row."""
    resolution: tuple[int, int]
    n_triangles: int
    n_receivers: int
    n_penumbra: int
    """Receivers that see a part of the light, by the reference."""
    seed: int
    threads: int
    limit_bytes: int
    reference_samples: int
    reference_rms: float
    """RMS error of the reference itself: no error far below it can be told."""
    reference_seconds: float
    backends: tuple[str, ...]
    """They gave identical visibility in every row, or there would be no report."""
    rows: tuple[ErrorRow, ...]
    slopes: tuple[Slope, ...]
    peak_bytes: int
    """Highest resident memory of the process."""
    is_complete: bool
    """False where the measuring was stopped, so that rows are missing."""
    machine: dict[str, Any]

    @property
    def penumbra_share(self) -> float:
        """Share of the receivers that are in penumbra: only they can be wrong for more than a sliver."""
        return self.n_penumbra / self.n_receivers if self.n_receivers else 0.0

    @property
    def peak_is_own(self) -> bool:
        """Whether each row has the peak of its own cast, and not that of the process since its start."""
        return all(row.cost.peak_is_own for row in self.rows)

    def as_dict(self) -> dict[str, Any]:
        """JSON values; the rows are those of the CSV file."""
        facts = {key: value for key, value in asdict(self).items() if key not in ("rows", "slopes")}
        facts |= {
            "penumbra_share": self.penumbra_share,
            "peak_is_own": self.peak_is_own,
            "backends_identical": len(self.backends) > 1 or None,
        }
        facts["slopes"] = [slope.as_dict() for slope in self.slopes]
        facts["rows"] = [row.as_dict() for row in self.rows]
        return facts

    def write(self, paths: Sequence[Path]) -> None:
        """Write JSON, CSV and the plot to the paths that `prepare_error_outputs` gave."""
        from penumbra.measure.plots import draw_error

        rows = [row.as_dict() for row in self.rows]
        write_outputs(paths, self.as_dict(), rows, lambda path: draw_error(self, path))

    def __str__(self) -> str:
        """Return what was measured as lines and tables of text."""
        blocks = [self._facts(), self._error_table(), self._cost_table(), self._slope_table()]
        if not self.is_complete:
            rows = "1 row is" if len(self.rows) == 1 else f"{len(self.rows)} rows are"
            blocks.insert(0, f"INCOMPLETE: the measuring was stopped when {rows} finished")
        return "\n\n".join(blocks)

    def _facts(self) -> str:
        width, height = self.resolution
        seen = f"{self.n_receivers:,} at {width} x {height}, {self.penumbra_share:.1%} in penumbra"
        if len(self.backends) > 1:
            equal = f"{' and '.join(self.backends)} gave identical visibility in every row"
        else:
            equal = f"{self.backends[0]} alone: nothing to compare it with"
        peaks = "of each cast" if self.peak_is_own else "of the process so far: this system cannot reset it"
        lines = (
            ("scene", f"{self.scene}, light {self.light}, {self.n_triangles:,} triangles"),
            ("receivers", seen),
            (
                "reference",
                f"{self.reference_samples:,} samples in {self.reference_seconds:.1f} s, "
                f"own RMS error {self.reference_rms:.2g}",
            ),
            ("backends", equal),
            ("memory", f"limit {format_bytes(self.limit_bytes)}, peak {format_bytes(self.peak_bytes)}"),
            ("", f"peaks below are {peaks}"),
            ("threads", f"{self.threads}"),
        )
        return "\n".join(f"{label:<11}{text}" for label, text in lines)

    def _error_table(self) -> str:
        header = ("pattern", "samples", "RMS", "RMS in penumbra", "mean abs", "bias", "99 %", "max")
        rows = []
        for row in self.rows:
            if row.backend == self.backends[0]:
                m = row.metrics
                errors = (m.rms, m.rms_penumbra, m.mean_absolute)
                cells = [*map(_small, errors), f"{m.bias:+.1e}", *map(_small, (m.p99, m.maximum))]
                rows.append([str(row.pattern), str(row.samples), *cells])
        return "error of visibility\n" + aligned_table(header, rows)

    def _cost_table(self) -> str:
        header = ["pattern", "samples"]
        for backend in self.backends:
            header += [f"{backend} s", "cpu s", "peak MiB", "added MiB"]
        rows: dict[tuple[Pattern, int], list[str]] = {}
        for row in self.rows:
            cells = rows.setdefault((row.pattern, row.samples), [str(row.pattern), str(row.samples)])
            cells += [f"{row.cost.seconds:.3f}", f"{row.cost.cpu_seconds:.3f}"]
            cells += [_mebibytes(row.cost.peak_bytes), _mebibytes(row.cost.added_bytes)]
        return "cost of a cast\n" + aligned_table(header, list(rows.values()))

    def _slope_table(self) -> str:
        header = ("pattern", "slope", "standard error", "theory", "points")
        rows = []
        for pattern, law in self.slopes:
            fitted = [_signed(law.slope), "" if law.standard_error is None else f"{law.standard_error:.3f}"]
            rows.append([str(pattern), *fitted, THEORY[pattern.pattern], str(law.n_points)])
        return "RMS falls with samples to the power of\n" + aligned_table(header, rows)


def prepare_error_outputs(folder: Path, overwrite: bool) -> list[Path]:
    """Paths of the files in a folder, checked before any work, and with them that a plot can be drawn.

    Raises OutputError, and PenumbraError where matplotlib is missing.
    """
    from penumbra.measure.plots import require_matplotlib

    require_matplotlib()
    return prepare_outputs(folder, FILES, overwrite)


def _small(value: float) -> str:
    return f"{value:.5f}"


def _signed(value: float | None) -> str:
    return "none" if value is None else f"{value:+.3f}"


def _mebibytes(n_bytes: int | None) -> str:
    return "" if n_bytes is None else f"{n_bytes / 2**20:.1f}"
