"""How much memory this process holds, has held and may still take; sizes in bytes."""

import contextlib
import ctypes
import os
import re
import sys
from pathlib import Path

_STATUS = Path("/proc/self/status")
_MEMINFO = Path("/proc/meminfo")
_CLEAR_REFS = Path("/proc/self/clear_refs")
_CGROUPS = Path("/sys/fs/cgroup")

# (limit file, usage file) of the two cgroup versions, relative to a group's folder.
_CGROUP_FILES = (
    ("memory.max", "memory.current"),
    ("memory.limit_in_bytes", "memory.usage_in_bytes"),
)


def resident_bytes() -> int:
    """Resident memory of this process now (VmRSS; the peak where /proc is not there)."""
    return _status_field("VmRSS") or peak_bytes()


def peak_bytes() -> int:
    """Highest resident memory of this process so far (VmHWM, else getrusage)."""
    high_water = _status_field("VmHWM")
    if high_water:
        return high_water
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # ru_maxrss counts KiB everywhere but on macOS, where it counts bytes.
    return peak if sys.platform == "darwin" else peak * 1024


def reset_peak() -> bool:
    """Start the peak anew from what is resident now; False where the system cannot (then nothing changes).

    Linux resets VmHWM when 5 is written to /proc/self/clear_refs (proc(5)).
    """
    try:
        _CLEAR_REFS.write_text("5")
    except OSError:
        return False
    return True


def available_bytes() -> int:
    """Memory that can still be taken: what the machine has free, or what the cgroup leaves if less."""
    machine = _meminfo_available()
    return max(0, min([machine, *_cgroup_headrooms()]))


def call_limit_bytes(memory: int | None, process_limit: bool) -> int:
    """Bytes a call may add to the resident memory.

    `memory` is the limit asked for: of the whole process when `process_limit`, else of what the call
    adds. None means half of the memory available now. Negative where the process is above it already.
    """
    if memory is None:
        return available_bytes() // 2
    if process_limit:
        return memory - resident_bytes()
    return memory


def give_back() -> None:
    """Return freed memory to the system, where the C library can (glibc's malloc_trim).

    Tiles are allocated by several threads in sizes that malloc keeps for later: without this the resident
    memory of a second light or pass stands on what the first one left (measured: 35 bytes a pixel).
    """
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def format_bytes(n_bytes: int) -> str:
    """Size for people: `512.0 MiB`."""
    size = float(n_bytes)
    for unit in ("B", "KiB", "MiB", "GiB"):
        if abs(size) < 1024:
            return f"{size:.0f} B" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1024
    return f"{size:.1f} TiB"


def _status_field(name: str) -> int:
    """Return a field of /proc/self/status in bytes, 0 where there is none."""
    match = re.search(rf"^{name}:\s+(\d+) kB", _read(_STATUS), re.MULTILINE)
    return int(match.group(1)) * 1024 if match else 0


def _meminfo_available() -> int:
    match = re.search(r"^MemAvailable:\s+(\d+) kB", _read(_MEMINFO), re.MULTILINE)
    if match:
        return int(match.group(1)) * 1024
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2


def _cgroup_headrooms() -> list[int]:
    """Limit minus usage of every control group this process is in, the enclosing ones included.

    A container or a SLURM job is killed at its group's limit, of which MemAvailable knows nothing.
    """
    headrooms = []
    for folder in _cgroup_folders():
        for limit_name, usage_name in _CGROUP_FILES:
            limit, usage = _read_integer(folder / limit_name), _read_integer(folder / usage_name)
            if limit is not None and usage is not None:
                headrooms.append(limit - usage + _reclaimable(folder))
    return headrooms


def _cgroup_folders() -> list[Path]:
    folders = []
    for line in _read(Path("/proc/self/cgroup")).splitlines():
        _, controllers, group = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        root = _CGROUPS / controllers
        leaf = root / group.lstrip("/")
        # Inside a container the path of /proc/self/cgroup may not exist: its root is then the group.
        folders += [leaf, *(parent for parent in leaf.parents if parent.is_relative_to(root))]
    return folders


def _reclaimable(folder: Path) -> int:
    """Page cache of a group that the kernel drops before it kills: counted as usage, free in truth."""
    match = re.search(r"^(?:total_)?inactive_file (\d+)", _read(folder / "memory.stat"), re.MULTILINE)
    return int(match.group(1)) if match else 0


def _read_integer(path: Path) -> int | None:
    try:
        return int(_read(path))
    except ValueError:
        return None


def _read(path: Path) -> str:
    """Content of a small system file, empty where the system has no such file."""
    try:
        return path.read_text()
    except OSError:
        return ""
