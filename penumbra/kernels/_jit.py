"""Compiler policy in one place: how every kernel is jitted, and where its machine code is kept.

numba does not notice that a helper in another file has changed, so the cache folder carries a hash
of all kernel sources: a changed kernel starts from an empty folder instead of running stale code.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

_HERE = Path(__file__).parent


def _sources_hash() -> str:
    digest = hashlib.sha256()
    for path in [*sorted(_HERE.glob("*.py")), _HERE.parent / "arrays.py"]:
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """Folder of the compiled kernels, one per source hash: in NUMBA_CACHE_DIR, or in the user's cache.

    Where neither can be written (a container without a home), it is in the folder for temporary files:
    numba would otherwise refuse to compile, or keep stale code beside the sources.
    """
    version = f"numba{numba.__version__}-{_sources_hash()}"
    asked = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    home = Path(asked) if asked else Path(os.path.expanduser("~")) / ".cache"
    folder = home / "penumbra" / version
    if _can_be_written(folder):
        return folder
    user = os.getuid() if hasattr(os, "getuid") else 0
    return Path(tempfile.gettempdir()) / f"penumbra-{user}" / version


def _can_be_written(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


# numba reads this setting at every compilation, so assigning it before the first decorator suffices.
numba.config.CACHE_DIR = str(cache_folder())

# error_model="numpy": with Python's division check loops do not vectorise. No fastmath: `contract`
# breaks the antisymmetry of edge functions along a shared edge, `nnan` breaks tests against infinity.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": False}
# Without wrappers for callers other than kernels: a third of the cold compile of all kernels.
_HELPER_OPTIONS = _OPTIONS | {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


def helper(function: Callable[..., Any]) -> Callable[..., Any]:
    """Jit a function that only kernels call (Python cannot); compiled into its callers, not cached itself."""
    jitted: Callable[..., Any] = numba.njit(**_HELPER_OPTIONS)(function)
    return jitted


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Jit a helper that takes tuples of arrays and has one hot caller, into which LLVM must inline it.

    A call passes eight words for every array of every tuple, some 300 for a casting step: left to
    LLVM's own judgement those calls were most of the time of casting.
    """
    jitted: Callable[..., Any] = numba.njit(forceinline=True, **_HELPER_OPTIONS)(function)
    return jitted


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Jit a serial loop kernel called from Python: releases the GIL, kept in the cache folder."""
    jitted: Callable[..., Any] = numba.njit(cache=True, no_cfunc_wrapper=True, **_OPTIONS)(function)
    return jitted
