"""What every measurement does with its numbers: a folder checked first, then JSON, CSV and tables."""

import csv
import json
import os
import platform
import tempfile
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from penumbra import __version__
from penumbra.errors import OutputError
from penumbra.io.atomic import atomic_path, check_output, remove_dead_temporaries

Row = Mapping[str, Any]

_PACKAGES = ("numpy", "numba", "llvmlite")


def prepare_outputs(folder: Path, names: Sequence[str], overwrite: bool) -> list[Path]:
    """Return the paths of the files to write in a folder, which is made if it is not there.

    Called before any work: raises OutputError when a file is there already and `overwrite` is False, or
    when it could not be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise OutputError(
            f"cannot make the folder {folder}: {problem.strerror}; choose another place"
        ) from None
    _check_writable(folder)
    paths = [folder / name for name in names]
    for path in paths:
        check_output(path)
        if path.exists() and not overwrite:
            raise OutputError(f"{path} is there already: give --overwrite to replace it, or another folder")
        remove_dead_temporaries(path)
    return paths


def _check_writable(folder: Path) -> None:
    """Write a little and remove it: permissions alone do not tell of a full or broken disk."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))
    except OSError as problem:
        raise OutputError(f"cannot write in {folder}: {problem.strerror}; choose another folder") from None


def write_outputs(
    paths: Sequence[Path], facts: Row, rows: Sequence[Row], draw: Callable[[Path], None] | None = None
) -> None:
    """Write facts as JSON, rows as CSV and then, if `draw` is given, the plot, to paths in this order.

    The plot is last: whatever fails in drawing costs no number. Raises OutputError.
    """
    write_json(paths[0], facts)
    write_csv(paths[1], rows)
    if draw is None:
        return
    try:
        draw(paths[2])
    except (OutputError, OSError):
        raise
    except Exception as problem:
        # matplotlib, its fonts and its compiled parts fail in ways that nobody can list.
        what = f"{type(problem).__name__}: {problem}".splitlines()[0]
        raise OutputError(
            f"cannot draw {paths[2]} ({what}); {paths[0].name} and {paths[1].name} are written"
        ) from problem


def write_json(path: Path, facts: Mapping[str, Any]) -> None:
    """Write facts as JSON; numbers that are not finite are an error, as JSON has none."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(facts, indent=2, allow_nan=False) + "\n")


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write rows with the keys of the first as the header; None becomes an empty field."""
    with atomic_path(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def aligned_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table for people: the first column to the left, the others, which are numbers, to the right."""
    lines = [list(header), *map(list, rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(header))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """The same table as Markdown, for documents."""
    rule = ["---", *["---:"] * (len(header) - 1)]
    return "\n".join("| " + " | ".join(line) + " |" for line in (header, rule, *rows))


def machine_facts() -> dict[str, Any]:
    """What the numbers were measured on: processor, system and versions; JSON values, no host name."""
    return {
        "penumbra": __version__,
        "python": platform.python_version(),
        **{name: _version(name) for name in _PACKAGES},
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "processors": os.cpu_count(),
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _processor() -> str:
    """Name of the processor, from /proc/cpuinfo where there is one."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
