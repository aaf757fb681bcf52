"""What the user asked to hear, and the streams: progress and errors to stderr, results to stdout."""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from penumbra.progress import Progress


@dataclass
class Console:
    """Set by -v and -q, which may stand before or after the command."""

    quiet: bool = False
    verbose: bool = False

    @contextmanager
    def progress(self) -> "Iterator[Progress]":
        """A bar on a terminal, lines elsewhere, nothing with -q."""
        from penumbra.progress import LogProgress, NullProgress, TerminalProgress

        if self.quiet:
            yield NullProgress()
            return
        report = TerminalProgress() if sys.stderr.isatty() else LogProgress()
        try:
            yield report
        except BaseException:
            report.abandon()
            raise
        report.close()


def result(text: object) -> None:
    """Print a result on stdout."""
    click.echo(str(text))


def deliver(report: Any, paths: Sequence[Path]) -> None:
    """Print a report, write its files if there are paths, and print those: none failing costs the others."""
    try:
        result(report)
        flush_results()
    finally:
        if paths:
            report.write(paths)
    for path in paths:
        result(path)


def error(message: str) -> None:
    """Print one sentence on stderr."""
    click.echo(f"penumbra: error: {message}", err=True)


def flush_results() -> None:
    """Write stdout out now, so that a full disk or a closed pipe is noticed while it can be told."""
    try:
        sys.stdout.flush()
    except OSError:
        # Python flushes again at exit; without a place to flush to it would complain once more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise
