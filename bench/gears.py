"""Backend "gears" step by step, beside backend "hpc": the tables of the GEARS paper on scenes of today.

    python bench/gears.py [--size WxH] [--samples K] [--threads N] [SCENE ...]

SCENE is a name of bench/scenes.py, or the path of a scene as JSON (mesh, camera, light). Prints, per scene,
seconds by step for grids of 32 to 256 cells a side (the paper's tables 2 and 7), blockers and receivers of
a cell (8), necessary and total assignments (9) with and without the correction of the extrusion, and both
backends' processor seconds. Masks are compared with those of hpc: a bit that differs is an error.
"""

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scenes import SCENES, write_scene

import penumbra
from penumbra.api import CastResult
from penumbra.ingest import blockers_in_memory
from penumbra.options import CastOptions

STEPS = ("bound", "count", "prefix_sum", "fill", "rasterise", "bin")
GRIDS = (32, 64, 128, 256)


class Case:
    """One scene: its blockers, and what its camera sees."""

    def __init__(self, path: Path, size: tuple[int, int], threads: int) -> None:
        self.scene = penumbra.Scene.load(path).with_overrides(resolution=size)
        self.blockers = blockers_in_memory(self.scene.geometry)
        self.points, self.normals, self.own, self.pixel = penumbra.camera_receivers(self.scene)
        self.threads = threads
        self.base: CastResult | None = None

    def cast(self, backend: str, **changes: object) -> tuple[CastResult, float]:
        """Masks and processor seconds; masks must be those of the first call."""
        options = replace(CastOptions(), **changes)  # type: ignore[arg-type]
        began = time.process_time()
        result = penumbra.cast(
            self.points, self.blockers, self.scene.lights[0], normals=self.normals, own=self.own,
            index=self.pixel, backend=backend, options=options, threads=self.threads,
        )  # fmt: skip
        seconds = time.process_time() - began
        self.base = self.base or result
        if not np.array_equal(result.masks, self.base.masks):
            raise SystemExit(f"{backend} {changes}: masks differ")
        return result, seconds


def table(title: str, header: tuple[str, ...], rows: list[list[str]]) -> None:
    """Print a Markdown table."""
    print(f"\n{title}\n\n| " + " | ".join(header) + " |\n|" + "---|" * len(header))
    for row in rows:
        print("| " + " | ".join(row) + " |", flush=True)


def steps_row(label: str, result: CastResult, seconds: float) -> list[str]:
    """Seconds of both stages and of the steps of casting (0 for what was never done), and processor time."""
    stages, steps = result.stats.seconds, result.stats.step_seconds
    taken = (stages["hierarchy"], *(steps.get(f"cast_{step}", 0.0) for step in STEPS), stages["cast"])
    return [label, *(f"{part:.2f}" for part in taken), f"{seconds:.2f}"]


def cells_row(label: str, result: CastResult) -> list[str]:
    """Blockers and receivers of a cell that holds receivers: most and mean; necessary and total pairs."""
    n = result.stats.as_dict()
    n_receivers = len(result.sample_set) - n["receivers_not_cast"]
    total, needed = n["pairs_assigned"], n["pairs_blocking"]
    return [
        label,
        f"{n['most_blockers_in_cell']:,}",
        f"{n['cell_pairs'] / n['cells_used']:.0f}",
        f"{n['most_receivers_in_cell']:,}",
        f"{n_receivers / n['cells_used']:.0f}",
        f"{needed / 1e6:.2f}",
        f"{total / 1e6:.2f}",
        f"{100 * needed / max(total, 1):.0f} %",
    ]


def report(name: str, case: Case, samples: int) -> list[str]:
    """Print the tables of one scene; the row of the summary."""
    case.cast("hpc")
    hpc = min(case.cast("hpc")[1] for _ in range(2))
    one = case.cast("hpc", joint_triangles=2**62)[1]
    runs = {n: case.cast("gears", grid_resolution=n) for n in GRIDS}
    regular = case.cast("gears", grid_spacing="regular")
    size = "x".join(map(str, case.scene.camera.resolution))
    print(f"\n### {name}, {size}, K = {samples}, {len(case.points):,} receivers")
    rows = [steps_row(f"{n}", *run) for n, run in runs.items()] + [steps_row("128, regular", *regular)]
    table("Seconds by step", ("grid", "hierarchy", *STEPS, "cast", "processor"), rows)
    # Without leaving out what is blocked already, as the paper counts.
    whole = {"umbra_bits": False}
    rows = [
        cells_row(f"{n}", case.cast("gears", grid_resolution=n, **whole)[0]) for n in GRIDS if n >= 128
    ] + [
        cells_row("128, regular", case.cast("gears", grid_spacing="regular", **whole)[0]),
        cells_row("128, not corrected", case.cast("gears", correct_extrusion=False, **whole)[0]),
        cells_row(
            "128, regular, not corrected",
            case.cast("gears", grid_spacing="regular", correct_extrusion=False, **whole)[0],
        ),
    ]
    header = ("grid", "most blockers", "mean", "most receivers", "mean", "necessary M", "total M", "share")
    table("Blockers and receivers of a cell; pairs of receiver and blocker", header, rows)
    gears = runs[128][1]
    fastest = min((hpc, "hpc"), (one, "one at a time"), (gears, "gears"))[1]
    return [name, f"{hpc:.2f}", f"{one:.2f}", f"{gears:.2f}", fastest]


def main() -> None:
    """Print all tables as Markdown."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(SCENES))
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    width, height = map(int, arguments.size.split("x"))
    summary = []
    with tempfile.TemporaryDirectory() as scratch:
        for name in arguments.scenes or ("sponza", "bunny"):
            path = write_scene(name, Path(scratch), samples=arguments.samples)
            if path is None:
                print(f"{name}: its mesh is not on this machine")
                continue
            case = Case(path, (width, height), arguments.threads)
            summary.append(report(path.stem, case, arguments.samples))
    table("Processor seconds of casting", ("scene", "hpc", "one at a time", "gears", "fastest"), summary)


if __name__ == "__main__":
    main()
