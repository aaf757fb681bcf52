"""Compile the kernels in a child process: what LLVM takes for it then never counts as ours.

Compiling everything leaves some 300 MB resident in the process that does it; loading the machine code
from the cache takes a tenth of that. A memory limit could not be kept otherwise in the first run.
"""

import os
import subprocess
import sys
from pathlib import Path

from penumbra.progress import Progress

_MARKER = "compiled"
_INSIDE = "PENUMBRA_COMPILING"
_CODE = "from penumbra.warmup import warm_up; warm_up()"


def compile_ahead(progress: Progress) -> None:
    """Fill the kernel cache by a child process, once for every version of the kernels.

    Does nothing where that is not possible (no Python of its own, a cache that cannot be written): the
    kernels are then compiled in this process, when they are first called.
    """
    from penumbra.kernels._jit import cache_folder

    marker = cache_folder() / _MARKER
    interpreter = Path(sys.executable or "")
    # An application that embeds Python may name itself as the executable: that must not be started.
    if marker.exists() or _INSIDE in os.environ or not interpreter.name.startswith("python"):
        return
    progress.stage("compile: once for every version", None, "")
    here = str(Path(__file__).resolve().parents[1])
    path = os.pathsep.join([here, *filter(None, [os.environ.get("PYTHONPATH")])])
    # -P: a folder named penumbra where the user stands must not be taken for this package.
    done = subprocess.run(
        [str(interpreter), "-P", "-c", _CODE],
        env={**os.environ, _INSIDE: "1", "PYTHONPATH": path},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=False,
    )
    if done.returncode == 0 and marker.parent.is_dir():
        try:
            marker.touch()
        except OSError:
            return
