"""Outputs that are whole or absent: written beside their final name, synced to disk, then renamed."""

import contextlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from penumbra.errors import OutputError

_FOLDER_PREFIX = ".penumbra-tmp-"


@contextmanager
def atomic_path(final: Path) -> Iterator[Path]:
    """Yield a temporary path `.NAME.tmp-PID` in the folder of `final`; rename it to `final` at the end.

    The body must create the temporary file (a body that creates none leaves nothing). On success the
    file is synced, takes the place of `final` in one step, and the folder is synced; on any failure,
    Ctrl-C included, the temporary file is removed and `final` is as it was.

    Raises OutputError when the folder is missing or not writable, when `final` is there and is not a
    regular file (so `/dev/null` is never replaced), or when syncing or renaming fails.
    """
    # A link is written through, as with open(): the file it points to is the one replaced.
    target = Path(os.path.realpath(final))
    _check_target(target)
    temporary = target.with_name(f".{target.name}.tmp-{os.getpid()}")
    temporary.unlink(missing_ok=True)
    try:
        yield temporary
        if temporary.exists():
            _publish(temporary, target)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """Yield a new folder `.penumbra-tmp-PID-*` in `parent` and remove it with all it holds at the end.

    Folders that killed runs left in `parent` are removed first. Raises OutputError when `parent` is
    missing or not writable.
    """
    _check_folder(parent, parent / _FOLDER_PREFIX)
    for dead in _dead_entries(parent, _FOLDER_PREFIX):
        shutil.rmtree(dead, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=f"{_FOLDER_PREFIX}{os.getpid()}-", dir=parent))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def remove_dead_temporaries(final: Path) -> list[Path]:
    """Remove what killed runs of `atomic_path(final)` left behind; files of running processes stay.

    Returns the removed paths.
    """
    target = Path(os.path.realpath(final))
    removed: list[Path] = []
    for entry in _dead_entries(target.parent, f".{target.name}.tmp-"):
        with contextlib.suppress(OSError):
            entry.unlink()
            removed.append(entry)
    return removed


def check_output(final: Path) -> None:
    """Raise OutputError now if `final` could not be written later: long work asks this first."""
    _check_target(Path(os.path.realpath(final)))


def _check_target(target: Path) -> None:
    _check_folder(target.parent, target)
    if target.exists() and not target.is_file():
        raise OutputError(f"cannot write {target}: it is not a regular file; choose another name")


def _check_folder(folder: Path, target: Path) -> None:
    if not folder.is_dir():
        raise OutputError(f"cannot write {target}: the folder {folder} does not exist; create it first")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"cannot write {target}: the folder {folder} is not writable; choose another")


def _dead_entries(folder: Path, prefix: str) -> list[Path]:
    """Entries of `folder` named `prefix` and the number of a process that no longer runs."""
    pattern = re.compile(re.escape(prefix) + r"(\d+)(-.*)?")
    try:
        found = [(entry, pattern.fullmatch(entry.name)) for entry in folder.iterdir()]
    except OSError:
        return []
    return [entry for entry, match in found if match and not _is_running(int(match.group(1)))]


def _publish(temporary: Path, target: Path) -> None:
    try:
        _sync(temporary)
        os.replace(temporary, target)
        _sync(target.parent)
    except OSError as error:
        raise OutputError(f"cannot write {target}: {error.strerror}; check the disk and try again") from error


def _sync(path: Path) -> None:
    """Flush a file or a folder to disk: a rename survives a power cut only once its folder is synced."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
