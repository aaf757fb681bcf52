"""What each optimization of the casting engine is worth: cast with all, without one, and without any.

    python bench/switches.py [--size WxH] [--samples K] [--threads N] [SCENE ...]

Masks are compared: a switch that changed a bit is an error. Seconds are processor time of casting and
of the receiver hierarchy, one thread, in one process; counters do not depend on the machine.
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
from penumbra.blockers import Blockers
from penumbra.ingest import blockers_in_memory
from penumbra.options import CastOptions, IngestOptions

SWITCHES = {
    "all on": {},
    "A off: umbra bits": {"umbra_bits": False},
    "B off: active plane sets": {"active_planes": False},
    "C off: lazy volumes": {"lazy_volumes": False},
    "D off: lazy masks": {"lazy_masks": False},
    "sorting off": {"sort": False},
    "all off": dict.fromkeys(("umbra_bits", "active_planes", "lazy_volumes", "lazy_masks", "sort"), False),
}
# The switches are about casting one blocker at a time.
ONE_AT_A_TIME = CastOptions(joint_triangles=1 << 40)
COUNTERS = ("nodes_visited", "plane_box_tests", "plane_point_tests", "group_volumes_built", "pairs_tested",
            "samples_tested", "masks_allocated")  # fmt: skip


def measure(
    scene: penumbra.Scene, stores: dict[bool, Blockers], seen: tuple, options: CastOptions, threads: int
):  # type: ignore[no-untyped-def]
    """Cast what the camera sees; the result and processor seconds."""
    points, normals, own, pixel = seen
    began = time.process_time()
    result = penumbra.cast(
        points, stores[options.sort], scene.lights[0], normals=normals, own=own, index=pixel,
        options=options, threads=threads,
    )  # fmt: skip
    return result, time.process_time() - began


def row(name: str, result: CastResult, seconds: float, base: CastResult, base_seconds: float) -> list[str]:
    """One table row; raises if a bit differs from the run with all switches on."""
    if result.masks is None or base.masks is None or not np.array_equal(result.masks, base.masks):
        raise SystemExit(f"{name}: masks differ")
    counters = result.stats.counters
    million = [f"{counters[key] / 1e6:.2f}" for key in COUNTERS]
    return [
        name,
        f"{seconds:.1f}",
        f"{seconds / base_seconds:.2f}",
        *million,
        f"{counters['mask_bytes'] / 2**20:.1f}",
    ]


def main() -> None:
    """Print one table per scene as Markdown."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(SCENES))
    parser.add_argument("--size", default="320x240")
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    width, height = map(int, arguments.size.split("x"))
    with tempfile.TemporaryDirectory() as scratch:
        for name in arguments.scenes or ("sponza", "dragon"):
            path = write_scene(name, Path(scratch), samples=arguments.samples)
            if path is None:
                print(f"{name}: its mesh is not on this machine")
                continue
            scene = penumbra.Scene.load(path).with_overrides(resolution=(width, height))
            stores = {
                sort: blockers_in_memory(scene.geometry, IngestOptions(sort=sort)) for sort in (True, False)
            }
            seen = penumbra.camera_receivers(scene)
            measure(scene, stores, tuple(a[:100] for a in seen), ONE_AT_A_TIME, 1)
            base, base_seconds = measure(scene, stores, seen, ONE_AT_A_TIME, arguments.threads)
            print(f"\n{name}, {arguments.size}, K = {arguments.samples}, {len(seen[0])} receivers\n")
            header = ("run", "cpu s", "ratio", *(f"{key} M" for key in COUNTERS), "mask MiB")
            print("| " + " | ".join(header) + " |\n|" + "---|" * len(header))
            for label, off in SWITCHES.items():
                options = replace(ONE_AT_A_TIME, **off)  # type: ignore[arg-type]
                result, seconds = (
                    (base, base_seconds)
                    if not off
                    else measure(scene, stores, seen, options, arguments.threads)
                )
                print("| " + " | ".join(row(label, result, seconds, base, base_seconds)) + " |", flush=True)


if __name__ == "__main__":
    main()
