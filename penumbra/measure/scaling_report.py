"""The result of `bench scaling`: rows and fitted exponents, as JSON, CSV and text."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from penumbra.measure.metrics import PowerLaw, fit_power_law
from penumbra.measure.peer_process import Answer
from penumbra.measure.report import aligned_table, prepare_outputs, write_outputs
from penumbra.measure.side_by_side import Rounds

FILES = ("scaling.json", "scaling.csv", "scaling.png")

QUANTITIES = {
    "our_cpu_seconds": "our cpu s",
    "embree_cpu_seconds": "Embree cpu s",
    "pairs_tested": "pairs",
    "nodes_visited": "nodes",
    "added_bytes": "bytes",
}
"""What an exponent is fitted for, and its heading."""


class ScalingRow(NamedTuple):
    """One place on one axis of one scene."""

    scene: str
    axis: str
    case: Answer
    """`CastCase.facts()`."""
    ingest: Answer
    build: Answer
    """Of Embree; empty when it was not measured."""
    rounds: Rounds
    n_changed: int | None = None
    """Bits that differ from those of the surface before it was subdivided; None where that is no question."""

    @property
    def x(self) -> float:
        """Where the row stands on its axis."""
        if self.axis == "triangles":
            return float(self.ingest["triangles"])
        key = {"resolution": "n_receivers", "samples": "samples", "area": "light_area"}[self.axis]
        return float(self.case[key])

    @property
    def our_cpu_seconds(self) -> float:
        """Median processor time of a cast."""
        return median(one.cpu_seconds for one in self.rounds.ours)

    @property
    def embree_cpu_seconds(self) -> float | None:
        """Median processor time of a pass of Embree, better ray flag."""
        return median(one.cpu_seconds for one in self.rounds.embree) if self.rounds.embree else None

    @property
    def added_bytes(self) -> int | None:
        """How far a cast raised the memory of the process, at most."""
        added = [one.added_bytes for one in self.rounds.ours if one.added_bytes is not None]
        return max(added, default=None)

    def quantity(self, name: str) -> float | None:
        """One of QUANTITIES."""
        return getattr(self, name) if hasattr(self, name) else self.rounds.stats.get(name)

    def as_dict(self) -> dict[str, Any]:
        """One flat row, as in the CSV file."""
        flat: dict[str, Any] = {"scene": self.scene, "axis": self.axis, "x": self.x}
        flat |= {"n_triangles": self.ingest["triangles"], **self.case}
        flat |= {name: self.quantity(name) for name in QUANTITIES}
        flat |= {"our_wall_seconds": median(one.wall_seconds for one in self.rounds.ours)}
        flat |= {"ingest_seconds": self.ingest.get("seconds"), "store_bytes": self.ingest["store_bytes"]}
        flat |= {"build_seconds": self.build.get("seconds"), "build_bytes": self.build.get("own_bytes")}
        return flat | {"n_changed_bits": self.n_changed} | self.rounds.stats


class Exponent(NamedTuple):
    """The power law of one quantity along one axis of one scene."""

    scene: str
    axis: str
    quantity: str
    law: PowerLaw

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {"scene": self.scene, "axis": self.axis, "quantity": self.quantity, **self.law._asdict()}

    def __str__(self) -> str:
        if self.law.slope is None:
            return ""
        error = "" if self.law.standard_error is None else f" ± {self.law.standard_error:.2f}"
        return f"{self.law.slope:.2f}{error}"


def fit_exponents(rows: Sequence[ScalingRow]) -> tuple[Exponent, ...]:
    """A law for each quantity that was measured, along each axis of each scene."""
    exponents = []
    for scene, axis in dict.fromkeys((row.scene, row.axis) for row in rows):
        along = [row for row in rows if (row.scene, row.axis) == (scene, axis)]
        for quantity in QUANTITIES:
            values = [row.quantity(quantity) for row in along]
            if None not in values:
                law = fit_power_law([row.x for row in along], [float(value or 0) for value in values])
                exponents.append(Exponent(scene, axis, quantity, law))
    return tuple(exponents)


@dataclass(frozen=True)
class ScalingReport:
    """Everything that `bench scaling` measured; `str()` is what it prints."""

    rows: tuple[ScalingRow, ...]
    threads: int
    backend: str
    n_rounds: int
    machine: dict[str, Any]

    @property
    def exponents(self) -> tuple[Exponent, ...]:
        """Fitted to the rows."""
        return fit_exponents(self.rows)

    def as_dict(self) -> dict[str, Any]:
        """JSON values; the rows are those of the CSV file."""
        return {
            "threads": self.threads,
            "backend": self.backend,
            "n_rounds": self.n_rounds,
            "machine": self.machine,
            "exponents": [exponent.as_dict() for exponent in self.exponents],
            "rows": [row.as_dict() for row in self.rows],
        }

    def write(self, paths: Sequence[Path]) -> None:
        """Write JSON, CSV and the plot to the paths that `prepare_scaling_outputs` gave."""
        from penumbra.measure.plots_speed import draw_scaling

        rows = [row.as_dict() for row in self.rows]
        keys = dict.fromkeys(key for row in rows for key in row)
        rows = [dict.fromkeys(keys) | row for row in rows]
        write_outputs(paths, self.as_dict(), rows, lambda path: draw_scaling(self, path))

    def __str__(self) -> str:
        """Return what was measured as tables of text."""
        facts = f"{self.threads} threads, {self.n_rounds} rounds, backend {self.backend}; medians"
        axes = dict.fromkeys((row.scene, row.axis) for row in self.rows)
        return "\n\n".join([facts, *(self._axis_table(*key) for key in axes), self._exponent_table()])

    def _axis_table(self, scene: str, axis: str) -> str:
        along = [row for row in self.rows if (row.scene, row.axis) == (scene, axis)]
        header = [axis, "our cpu s", "pairs M", "nodes M", "added MiB"]
        header += ["Embree cpu s", "ratio"] if along[0].embree_cpu_seconds else []
        header += ["changed bits"] if axis == "triangles" else []
        return f"{scene} by {axis}\n" + aligned_table(header, [_axis_cells(row) for row in along])

    def _exponent_table(self) -> str:
        names = [name for name in QUANTITIES if any(e.quantity == name for e in self.exponents)]
        cells: dict[tuple[str, str], dict[str, str]] = {}
        for exponent in self.exponents:
            cells.setdefault((exponent.scene, exponent.axis), {})[exponent.quantity] = str(exponent)
        rows = [
            [f"{scene} by {axis}", *(c.get(name, "") for name in names)] for (scene, axis), c in cells.items()
        ]
        return "exponent ± standard error\n" + aligned_table(
            ["", *(QUANTITIES[name] for name in names)], rows
        )


def prepare_scaling_outputs(folder: Path, overwrite: bool) -> list[Path]:
    """Paths of the files in a folder, checked before any work, and with them that a plot can be drawn.

    Raises OutputError, and PenumbraError where matplotlib is missing.
    """
    from penumbra.measure.plots import require_matplotlib

    require_matplotlib()
    return prepare_outputs(folder, FILES, overwrite)


def _axis_cells(row: ScalingRow) -> list[str]:
    pairs, nodes = (row.rounds.stats.get(name, 0) / 1e6 for name in ("pairs_tested", "nodes_visited"))
    added = "" if row.added_bytes is None else f"{row.added_bytes / 2**20:.0f}"
    x = f"{row.x:,.0f}" if row.x == int(row.x) else f"{row.x:.6g}"
    cells = [x, f"{row.our_cpu_seconds:.3f}", f"{pairs:.2f}", f"{nodes:.2f}", added]
    embree = row.embree_cpu_seconds
    cells += [f"{embree:.3f}", f"{embree / row.our_cpu_seconds:.2f}"] if embree else []
    changed = "" if row.n_changed is None else f"{row.n_changed:,}"
    return cells + ([changed] if row.axis == "triangles" else [])
