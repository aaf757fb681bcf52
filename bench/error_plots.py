"""Error of visibility against samples and seconds, on real scenes: the plots of docs/error.md, and tables.

    python bench/error_plots.py [--out FOLDER] [--plots FOLDER] [SCENE ...]

Every scene is measured by `penumbra bench error` in a process of its own, into a folder of its own below
--out; --plots also copies the plots, as error-SCENE.png. Options after `--` go to `penumbra bench error`.
`penumbra warmup` first.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from scenes import SCENES, write_scene

PLOTTED = ("cornell", "sponza", "dragon")


def main() -> None:
    """Measure the scenes and print what `penumbra bench error` prints."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(SCENES), default=PLOTTED)
    parser.add_argument("--out", type=Path, help="folder of all files (default: a temporary one)")
    parser.add_argument("--plots", type=Path, help="folder to copy the plots to, such as docs/images")
    mine, passed_on = _split(sys.argv[1:])
    arguments = parser.parse_args(mine)
    if arguments.plots is not None:
        arguments.plots.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        out = arguments.out or Path(scratch)
        for name in arguments.scenes:
            scene = write_scene(name, Path(scratch))
            if scene is None:
                print(f"{name}: its mesh is not on this machine", file=sys.stderr)
                continue
            command = [sys.executable, "-m", "penumbra", "-q", "bench", "error", str(scene)]
            command += ["-o", str(out / name), "--overwrite", *passed_on]
            print(f"\n== {name}", flush=True)
            subprocess.run(command, check=True)
            if arguments.plots:
                shutil.copyfile(out / name / "error.png", arguments.plots / f"error-{name}.png")


def _split(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Arguments before and after `--`."""
    if "--" not in arguments:
        return arguments, []
    at = arguments.index("--")
    return arguments[:at], arguments[at + 1 :]


if __name__ == "__main__":
    main()
