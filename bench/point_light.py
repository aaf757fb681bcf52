"""What a point light saves: cast from a point, and from a rectangle without size that has one sample there.

    python bench/point_light.py [--size WxH] [--threads N] [SCENE ...]

Masks are compared: a bit that differs is an error. Seconds are processor time of whole calls of
`penumbra.cast` in one process, the least of three, taken in turn; counters do not depend on the machine.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from scenes import SCENES, write_scene

import penumbra
from penumbra.api import CastResult
from penumbra.ingest import blockers_in_memory

COUNTERS = ("blockers_tested", "nodes_visited", "plane_point_tests", "pairs_tested", "masks_allocated",
            "escalated_f64", "escalated_exact")  # fmt: skip
RUNS = 3


def measure(scene: penumbra.Scene, threads: int) -> dict[str, tuple[float, CastResult]]:
    """Least processor seconds and result of both lights at the middle of the scene's first."""
    corner, edge_u, edge_v = (scene.lights[0].settings()[key] for key in ("corner", "edge_u", "edge_v"))
    middle = np.array(corner) + 0.5 * np.array(edge_u) + 0.5 * np.array(edge_v)
    nothing = np.zeros(3)
    lights = {
        "point": penumbra.PointLight(middle),
        "rect": penumbra.RectLight(middle, nothing, nothing, samples=1, sets=1, two_sided=True),
    }
    blockers = blockers_in_memory(scene.geometry)
    points, normals, own, _ = penumbra.camera_receivers(scene)
    best: dict[str, tuple[float, CastResult]] = {}
    for run in range(RUNS + 1):
        for name, light in lights.items():
            began = time.process_time()
            result = penumbra.cast(points, blockers, light, normals=normals, own=own, threads=threads)
            seconds = time.process_time() - began
            # The first run compiles, or loads what was compiled.
            if run == 1 or (run > 1 and seconds < best[name][0]):
                best[name] = seconds, result
    return best


def main() -> None:
    """Print two rows a scene as Markdown."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(SCENES))
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    width, height = map(int, arguments.size.split("x"))
    print("| scene | light | cpu s | ratio | " + " | ".join(COUNTERS) + " |")
    print("|---" * (4 + len(COUNTERS)) + "|")
    with tempfile.TemporaryDirectory() as scratch:
        for name in arguments.scenes or ("sponza", "dragon"):
            path = write_scene(name, Path(scratch))
            if path is None:
                print(f"{name}: its mesh is not on this machine")
                continue
            best = measure(
                penumbra.Scene.load(path).with_overrides(resolution=(width, height)), arguments.threads
            )
            if not np.array_equal(best["point"][1].masks, best["rect"][1].masks):
                raise SystemExit(f"{name}: masks differ")
            for light, (seconds, result) in best.items():
                counters = [f"{result.stats.counters[key]:,}" for key in COUNTERS]
                ratio = seconds / best["point"][0]
                print(f"| {name} | {light} | {seconds:.2f} | {ratio:.2f} | " + " | ".join(counters) + " |")


if __name__ == "__main__":
    main()
