"""The result of `bench peers`: one row a scene, as JSON, CSV and text."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import geometric_mean, median
from typing import Any, NamedTuple

from penumbra.measure.equal_error import EqualError
from penumbra.measure.peer_process import Answer
from penumbra.measure.report import aligned_table, prepare_outputs, write_outputs
from penumbra.measure.side_by_side import Rounds, Spread

FILES = ("peers.json", "peers.csv", "peers.png")


class Agreement(NamedTuple):
    """How far the bits of both sides agree, and who is right where they do not."""

    n_bits: int
    n_differing: int
    n_blocked_by_us_alone: int
    n_judged: int
    """Receivers with differing bits that exact brute force has decided."""
    n_wrong_ours: int
    """Bits of those receivers in which we differ from brute force."""
    n_wrong_embree: int
    penumbra_share: float
    """Share of the receivers that see some of the samples."""
    umbra_share: float
    """Share of the receivers that see none."""


class PeerRow(NamedTuple):
    """One scene: what was cast, what each side took to get ready and to cast, and how the bits agree."""

    name: str
    case: Answer
    """`CastCase.facts()`."""
    ingest: Answer
    """What our ingest took; without times where the scene named a store."""
    build: Answer
    """What Embree's build took."""
    rounds: Rounds
    agreement: Agreement
    equal: EqualError | None = None
    """Mitsuba's way to our error; None where it was not asked for, or is not installed."""

    def as_dict(self) -> dict[str, Any]:
        """One flat row, as in the CSV file."""
        flat: dict[str, Any] = {"scene": self.name, "n_triangles": self.ingest["triangles"], **self.case}
        flat |= {key: getattr(self.agreement, key) for key in ("penumbra_share", "umbra_share")}
        for side, passes in (("ours", self.rounds.ours), ("embree", self.rounds.embree)):
            for what in ("cpu_seconds", "wall_seconds"):
                spread = Spread.of([getattr(one, what) for one in passes])
                flat |= {f"{side}_{what}_{part}": value for part, value in spread._asdict().items()}
            flat[f"{side}_added_bytes"] = max((one.added_bytes or 0) for one in passes) or None
        flat |= {"embree_flag": self._flag, "embree_rays": self.rounds.n_rays}
        for what in ("cpu", "wall"):
            spread = self.rounds.ratio(f"{what}_seconds")
            flat |= {f"{what}_ratio_{part}": value for part, value in spread._asdict().items()}
        flat |= {key: value for key, value in self.agreement._asdict().items() if key.startswith("n_")}
        for key in ("seconds", "cpu_seconds", "added_bytes", "store_bytes"):
            flat[f"ingest_{key}"] = self.ingest.get(key)
        for key in ("seconds", "cpu_seconds", "added_bytes", "own_bytes", "own_peak_bytes", "mesh_bytes"):
            flat[f"build_{key}"] = self.build[key]
        flat |= self.equal.as_dict() if self.equal is not None else {}
        return flat | self.rounds.stats

    @property
    def _flag(self) -> str:
        return "coherent" if self.rounds.is_coherent else "incoherent"

    def speed_cells(self) -> list[str]:
        """The row of the table of speed."""
        ours, theirs = (
            Spread.of([one.cpu_seconds for one in passes])
            for passes in (self.rounds.ours, self.rounds.embree)
        )
        rays = self.rounds.n_rays / 1e6 / theirs.median
        return [
            self.name,
            f"{self.ingest['triangles']:,}",
            f"{self.case['n_receivers']:,}",
            f"{self.agreement.penumbra_share:.0%}",
            f"{ours.median:.3f}",
            f"{theirs.median:.3f}",
            self._flag,
            f"{rays:.1f}",
            _spread(self.rounds.ratio("cpu_seconds")),
            _spread(self.rounds.ratio("wall_seconds")),
        ]

    def bit_cells(self) -> list[str]:
        """The row of the table of bits."""
        a = self.agreement
        return [
            self.name,
            f"{a.n_bits:,}",
            f"{a.n_differing:,}",
            f"{1e6 * a.n_differing / max(1, a.n_bits):.2f}",
            f"{a.n_blocked_by_us_alone:,}",
            f"{a.n_judged}",
            f"{a.n_wrong_ours}",
            f"{a.n_wrong_embree}",
        ]

    def build_cells(self) -> list[str]:
        """The row of the table of ingest and build."""
        n = max(1, self.ingest["triangles"])
        return [
            self.name,
            _number(self.ingest.get("seconds"), 1, ".2f"),
            _number(self.ingest.get("added_bytes"), 2**20, ".0f"),
            _number(self.ingest["store_bytes"], n, ".0f"),
            _number(max((one.added_bytes or 0) for one in self.rounds.ours), 2**20, ".0f"),
            _number(self.build["seconds"], 1, ".2f"),
            _number(self.build["added_bytes"], 2**20, ".0f"),
            _number(self.build["own_bytes"], n, ".0f"),
            _number(self.build["own_peak_bytes"], n, ".0f"),
        ]

    def equal_cells(self) -> list[str]:
        """The row of the table of equal error."""
        assert self.equal is not None
        ours = median(one.cpu_seconds for one in self.rounds.ours)
        cpu, wall = (self.equal.seconds(what) for what in ("cpu_seconds", "wall_seconds"))
        last = self.equal.estimates[-1]
        return [
            self.name,
            f"{self.equal.our_rms:.5f}",
            f"{ours:.3f}",
            f"{last.samples}",
            f"{last.rms:.5f}",
            _number(cpu, 1, ".3f"),
            _number(wall, 1, ".3f"),
            _number(cpu, ours, ".2f"),
        ]

    def stage_cells(self, stages: Sequence[str]) -> list[str]:
        """The row of the table of our stages, wall seconds."""
        return [self.name, *(_number(self.rounds.stats.get(stage), 1, ".3f") for stage in stages)]


@dataclass(frozen=True)
class PeerReport:
    """Everything that `bench peers` measured; `str()` is what it prints."""

    rows: tuple[PeerRow, ...]
    threads: int
    backend: str
    n_rounds: int
    machine: dict[str, Any]
    with_mitsuba: bool = False
    """Whether Mitsuba was asked for."""

    @property
    def mean_cpu_ratio(self) -> float:
        """Geometric mean over the scenes of Embree's processor time over ours."""
        return geometric_mean([row.rounds.ratio("cpu_seconds").median for row in self.rows])

    def as_dict(self) -> dict[str, Any]:
        """JSON values; the rows are those of the CSV file."""
        return {
            "threads": self.threads,
            "backend": self.backend,
            "n_rounds": self.n_rounds,
            "embree": self.rows[0].build["version"],
            "native_packets": self.rows[0].build["native_packets"],
            "mitsuba": self._mitsuba_version,
            "mean_cpu_ratio": self.mean_cpu_ratio,
            "machine": self.machine,
            "rows": [row.as_dict() for row in self.rows],
        }

    def write(self, paths: Sequence[Path]) -> None:
        """Write JSON, CSV and the plot to the paths that `prepare_peer_outputs` gave."""
        from penumbra.measure.plots_speed import draw_peers

        rows = [row.as_dict() for row in self.rows]
        keys = dict.fromkeys(key for row in rows for key in row)
        rows = [dict.fromkeys(keys) | row for row in rows]
        write_outputs(paths, self.as_dict(), rows, lambda path: draw_peers(self, path))

    def __str__(self) -> str:
        """Return what was measured as lines and tables of text."""
        tables = [self._speed(), self._stages(), self._bits(), self._builds()]
        tables += [self._equal_errors()] if self.with_mitsuba else []
        return "\n\n".join((self._facts(), *tables))

    def _facts(self) -> str:
        build, case = self.rows[0].build, self.rows[0].case
        packets = "native" if build["native_packets"] else "split by Embree: no AVX-512 here"
        return "\n".join(
            (
                f"Embree     {build['version']}, packets of 16 rays ({packets}), not robust, better ray flag",
                f"light      {case['samples']} samples, {case['sets']} set{'s' if case['sets'] > 1 else ''}",
                f"threads    {self.threads}, {self.n_rounds} rounds in turn, our backend {self.backend}",
                f"processor  {self.machine.get('processor', '')}",
            )
        )

    def _speed(self) -> str:
        header = ("scene", "triangles", "receivers", "penumbra", "our cpu s", "Embree cpu s", "ray flag",
                  "Mray/cpu s", "cpu ratio", "wall ratio")  # fmt: skip
        table = aligned_table(header, [row.speed_cells() for row in self.rows])
        mean = f"geometric mean of the cpu ratios: {self.mean_cpu_ratio:.2f}"
        title = "processor time of one pass, all threads; ratio: Embree over ours (lowest-highest round)"
        return f"{title}\n{table}\n{mean}"

    def _stages(self) -> str:
        stages = [key for key in self.rows[0].rounds.stats if key.startswith("seconds_")]
        header = ["scene", *(f"{stage.removeprefix('seconds_')} s" for stage in stages)]
        return "our last cast, wall seconds by stage\n" + aligned_table(
            header, [row.stage_cells(stages) for row in self.rows]
        )

    def _bits(self) -> str:
        header = ("scene", "bits", "differing", "per million", "blocked by us alone", "receivers judged",
                  "our wrong bits", "Embree's")  # fmt: skip
        return "bits that differ, and exact brute force on some of their receivers\n" + aligned_table(
            header, [row.bit_cells() for row in self.rows]
        )

    def _builds(self) -> str:
        header = ("scene", "ingest s", "added MiB", "store B/tri", "cast added MiB", "build s", "added MiB",
                  "Embree B/tri", "at its peak")  # fmt: skip
        return "getting ready: our ingest and memory of a cast, Embree's build\n" + aligned_table(
            header, [row.build_cells() for row in self.rows]
        )

    @property
    def _mitsuba_version(self) -> str | None:
        return next((row.equal.version for row in self.rows if row.equal is not None), None)

    def _equal_errors(self) -> str:
        if self._mitsuba_version is None:
            return "Mitsuba is not installed"
        header = ("scene", "our RMS error", "our cpu s", "its samples", "its RMS error", "cpu s to our error",
                  "wall s", "cpu ratio")  # fmt: skip
        title = f"Mitsuba {self._mitsuba_version} (llvm), shadow rays alone, until its error is ours"
        return f"{title}\n" + aligned_table(header, [row.equal_cells() for row in self.rows])


def prepare_peer_outputs(folder: Path, overwrite: bool) -> list[Path]:
    """Paths of the files in a folder, checked before any work, and with them that a plot can be drawn.

    Raises OutputError, and PenumbraError where matplotlib is missing.
    """
    from penumbra.measure.plots import require_matplotlib

    require_matplotlib()
    return prepare_outputs(folder, FILES, overwrite)


def _spread(spread: Spread) -> str:
    return f"{spread.median:.2f} ({spread.low:.2f}-{spread.high:.2f})"


def _number(value: float | None, unit: float, form: str) -> str:
    return "" if value is None else format(value / unit, form)
