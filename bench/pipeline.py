"""Render real scenes from mesh to EXR and print one row each: receivers, seconds by stage, memory, counters.

    python bench/pipeline.py [--out FOLDER] [--size WxH] [--samples K] [--threads N] [SCENE ...]

Every scene runs in a process of its own, so that its peak memory is its own. `penumbra warmup` first.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from scenes import SCENES, write_scene

STAGES = ("ingest", "visible", "hierarchy", "cast", "shade", "write")
HEADER = ("scene", "triangles", "receivers", *(f"{s} s" for s in STAGES), "peak MiB", "pairs M", "nodes M",
          "samples M", "f64", "exact")  # fmt: skip


def run(scene: Path, out: Path, arguments: argparse.Namespace) -> dict[str, float]:
    """Render one scene in a child process; its numbers."""
    stats = out / f"{scene.stem}.json"
    command = [
        sys.executable,
        "-m",
        "penumbra",
        "-q",
        "render",
        str(scene),
        "-o",
        str(out / f"{scene.stem}.exr"),
    ]
    command += ["--resolution", arguments.size, "--samples", str(arguments.samples), "--overwrite"]
    command += [
        "--threads",
        str(arguments.threads),
        "--preview",
        str(out / f"{scene.stem}.png"),
        "--stats",
        str(stats),
    ]
    subprocess.run(command, check=True)
    numbers: dict[str, float] = json.loads(stats.read_text())
    return numbers


def row(name: str, n: dict[str, float]) -> list[str]:
    """One table row."""
    million = [f"{n[key] / 1e6:.1f}" for key in ("pairs_tested", "nodes_visited", "samples_tested")]
    seconds = [f"{n.get(f'seconds_{stage}', 0):.2f}" for stage in STAGES]
    tail = [f"{n['peak_bytes'] / 2**20:.0f}", *million, f"{n['escalated_f64']}", f"{n['escalated_exact']}"]
    return [name, f"{n['n_triangles']}", f"{n['n_receivers']}", *seconds, *tail]


def main() -> None:
    """Render the scenes and print the table as Markdown."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(SCENES))
    parser.add_argument("--out", type=Path, help="folder of pictures and numbers (default: a temporary one)")
    parser.add_argument("--size", default="1280x960")
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--threads", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        out = arguments.out or Path(scratch)
        out.mkdir(parents=True, exist_ok=True)
        print("| " + " | ".join(HEADER) + " |\n|" + "---|" * len(HEADER))
        for name in arguments.scenes or SCENES:
            scene = write_scene(name, Path(scratch), samples=arguments.samples)
            if scene is None:
                print(f"{name}: its mesh is not on this machine", file=sys.stderr)
                continue
            print("| " + " | ".join(row(name, run(scene, out, arguments))) + " |", flush=True)


if __name__ == "__main__":
    main()
