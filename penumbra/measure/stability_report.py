"""The result of `bench stability`: rows as JSON, CSV and text, and what to say of wrong bits."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from penumbra.errors import BackendError
from penumbra.measure.report import aligned_table, prepare_outputs, write_outputs

FILES = ("stability.json", "stability.csv")

PLAIN = (1.0, 0.0)
"""The scale and offset of a scene as it was made."""


class WrongBit(NamedTuple):
    """A bit that a backend did not decide as the judge does."""

    receiver: int
    """Row of the points."""
    sample: int
    blocked: bool
    """What the judge says."""


class StabilityRow(NamedTuple):
    """One backend in one scene."""

    case: str
    scale: float
    offset: float
    backend: str
    bits: int
    wrong_bits: int
    escalated_f64: int
    """Samples left open by the first, fast test, of all blockers."""
    escalated_exact: int
    """Determinants that needed exact integers."""
    cpu_seconds: float
    times_ordinary: float
    """Processor time over that of the same backend in the ordinary scene with the same type of light, at
    scale 1, offset 0; of that scene itself, 1."""
    first_wrong: WrongBit | None

    @property
    def f64_per_million(self) -> float:
        """Samples decided again in float64, for a million bits."""
        return 1e6 * self.escalated_f64 / self.bits

    @property
    def exact_per_million(self) -> float:
        """Determinants decided in exact integers, for a million bits."""
        return 1e6 * self.escalated_exact / self.bits

    def as_dict(self) -> dict[str, Any]:
        """One flat row, as in the CSV file."""
        flat = self._asdict()
        wrong = flat.pop("first_wrong") or (None, None, None)
        return flat | {
            "escalated_f64_per_million": self.f64_per_million,
            "escalated_exact_per_million": self.exact_per_million,
            "wrong_receiver": wrong[0],
            "wrong_sample": wrong[1],
            "wrong_sample_is_blocked": wrong[2],
        }


@dataclass(frozen=True)
class StabilityReport:
    """Everything that `bench stability` found; `str()` is what it prints."""

    receivers: int
    blockers: int
    samples: int
    """Of every scene with a rect light."""
    point_receivers: int
    """Of every scene with a point light, which is one sample."""
    scenes: int
    seed: int
    quick: bool
    threads: int
    backends: tuple[str, ...]
    cases: dict[str, str]
    """What is hard about each case, by its name."""
    ordinary_cpu_seconds: dict[str, dict[str, float]]
    """What each backend takes for the ordinary scenes, by their names, at scale 1, offset 0."""
    rows: tuple[StabilityRow, ...]
    machine: dict[str, Any]

    @property
    def wrong_bits(self) -> int:
        """Bits of all rows that are wrong."""
        return sum(row.wrong_bits for row in self.rows)

    def as_dict(self) -> dict[str, Any]:
        """JSON values; the rows are those of the CSV file."""
        facts: dict[str, Any] = {key: value for key, value in vars(self).items() if key != "rows"}
        return facts | {"wrong_bits": self.wrong_bits, "rows": [row.as_dict() for row in self.rows]}

    def write(self, paths: Sequence[Path]) -> None:
        """Write JSON and CSV to the paths that `prepare_stability_outputs` gave."""
        write_outputs(paths, self.as_dict(), [row.as_dict() for row in self.rows])

    def raise_if_wrong(self) -> None:
        """Raise BackendError if a bit is wrong; it says how to see the first one again."""
        wrong = [row for row in self.rows if row.first_wrong is not None]
        if not wrong:
            return
        row = wrong[0]
        assert row.first_wrong is not None
        receiver, sample, blocked = row.first_wrong
        judged, found = ("blocked", "visible") if blocked else ("visible", "blocked")
        quick = " --quick" if self.quick else ""
        raise BackendError(
            f"{self.wrong_bits} bits are wrong in {len(wrong)} of {len(self.rows)} rows, the first one by "
            f"backend {row.backend} in case {row.case} at scale {_scale(row.scale)}, offset {row.offset:g} "
            f"(receiver {receiver}, sample {sample} is {judged} and was cast as {found}): this is a bug in "
            "penumbra, report it with the command that shows it again: penumbra bench stability "
            f"--case {row.case} --backend {row.backend} --seed {self.seed}{quick}"
        )

    def __str__(self) -> str:
        """Return what was found as lines and a table of text: one row for each case and backend."""
        return f"{self._facts()}\n\n{self.table()}"

    def _facts(self) -> str:
        each = f"{self.receivers:,} receivers, {self.blockers:,} blockers, {self.samples:,} samples"
        one = f"with a point light, {self.point_receivers:,} receivers and one sample"
        n_bits = sum(row.bits for row in self.rows)
        lines = [
            ("scenes", f"{self.scenes}, seed {self.seed}: {each} each,"),
            ("", one),
            ("judged", f"{n_bits:,} bits by exact brute force, {self.wrong_bits:,} wrong"),
        ]
        for case, taken in self.ordinary_cpu_seconds.items():
            each = ", ".join(f"{backend} {1e3 * seconds:.1f} ms" for backend, seconds in taken.items())
            lines.append((case, f"{each} of processor time at scale 1, offset 0"))
        lines += [
            ("columns", "f64, exact: escalations for a million bits; time: over that of the ordinary scene"),
            ("", "with the same type of light; each at scale 1, offset 0, and the worst of all scales and"),
            ("", "offsets; the last column has the scale and the offset of the worst time"),
        ]
        return "\n".join(f"{label:<16}{text}" for label, text in lines)

    def table(self) -> str:
        """The table alone."""
        return aligned_table(*self.summary())

    def summary(self) -> tuple[list[str], list[list[str]]]:
        """Header and cells of the table: wrong bits are summed over scales and offsets."""
        worst = ("f64", "f64 worst", "exact", "exact worst", "time", "time worst", "at scale, offset")
        header = ["case", "backend", "wrong bits", *worst]
        groups: dict[tuple[str, str], list[StabilityRow]] = {}
        for row in self.rows:
            groups.setdefault((row.case, row.backend), []).append(row)
        return header, [_cells(rows) for rows in groups.values()]


def prepare_stability_outputs(folder: Path, overwrite: bool) -> list[Path]:
    """Paths of the files in a folder, checked before any work. Raises OutputError."""
    return prepare_outputs(folder, FILES, overwrite)


def _cells(rows: list[StabilityRow]) -> list[str]:
    plain = next(row for row in rows if (row.scale, row.offset) == PLAIN)
    slowest = max(rows, key=lambda row: row.times_ordinary)
    return [
        plain.case,
        plain.backend,
        f"{sum(row.wrong_bits for row in rows):,}",
        f"{plain.f64_per_million:,.0f}",
        f"{max(row.f64_per_million for row in rows):,.0f}",
        f"{plain.exact_per_million:,.0f}",
        f"{max(row.exact_per_million for row in rows):,.0f}",
        f"{plain.times_ordinary:.2f}",
        f"{slowest.times_ordinary:.2f}",
        f"{_scale(slowest.scale)}, {slowest.offset:g}",
    ]


def _scale(scale: float) -> str:
    """A scale as people write it: powers of two as such."""
    mantissa, exponent = math.frexp(scale)
    return f"2^{exponent - 1}" if mantissa == 0.5 and scale != 1.0 else f"{scale:g}"
