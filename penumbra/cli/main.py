"""The command group, and how every way a command can end becomes a sentence and an exit code.

0 done, 1 bad input or a failed run, 2 usage, 3 refused by the memory limit, 75 stopped by SIGTERM,
130 stopped by Ctrl-C.
"""

import errno
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

import click

from penumbra import __version__
from penumbra.cli import options
from penumbra.cli.bench import bench
from penumbra.cli.console import Console, error, flush_results
from penumbra.cli.demo import demo
from penumbra.cli.info import info
from penumbra.cli.ingest import ingest
from penumbra.cli.render import render
from penumbra.cli.warmup import warmup
from penumbra.errors import Interrupted, PenumbraError

EXIT_FAILED = 1
EXIT_TERMINATED = 75
EXIT_CTRL_C = 130


class _Commands(click.Group):
    """Commands in the order in which they are used, instead of the alphabet's."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)

    def invoke(self, ctx: click.Context) -> Any:
        try:
            value = super().invoke(ctx)
            flush_results()
        except BrokenPipeError as problem:
            # click would end the process without a word.
            raise PenumbraError("cannot write the result: the program that read it is gone") from problem
        return value


@click.group(
    cls=_Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110}
)
@click.version_option(__version__, prog_name="penumbra")
@options.verbosity
def cli() -> None:
    """Exact soft shadows of triangle meshes larger than memory.

    Ingest meshes into a blocker store, or render a scene file straight away. Progress is on stderr,
    results are on stdout. `penumbra COMMAND --help` tells more about a command.
    """


for _command in (demo, ingest, render, info, bench, warmup):
    cli.add_command(_command)


def main() -> NoReturn:
    """Run the command line and exit."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: Sequence[str]) -> int:
    """Run one command; returns the exit code, having said on stderr what went wrong."""
    console = Console()
    try:
        with _sigterm_interrupts():
            code = cli.main(list(arguments), prog_name="penumbra", obj=console, standalone_mode=False)
        return code if isinstance(code, int) else 0
    except click.ClickException as problem:
        problem.show()
        return problem.exit_code
    except PenumbraError as problem:
        error(str(problem))
        return problem.exit_code
    except (click.Abort, KeyboardInterrupt):
        error("stopped by Ctrl-C")
        return EXIT_CTRL_C
    except OSError as problem:
        error(_os_sentence(problem))
    except MemoryError:
        error("out of memory: give a smaller --memory, or close other programs")
    except Exception as problem:
        if console.verbose:
            traceback.print_exc()
        what = f"{type(problem).__name__}: {problem}".splitlines()[0]
        hint = "" if console.verbose else "; --verbose shows the traceback to report it with"
        error(f"this is a bug in penumbra ({what}){hint}")
    return EXIT_FAILED


@contextmanager
def _sigterm_interrupts() -> Iterator[None]:
    """SIGTERM raises `Interrupted` in the main thread, once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(_signal: int, _frame: FrameType | None) -> NoReturn:
        # timeout(1) signals the process and then its group: a second one must not break the clearing up.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise Interrupted("stopped by SIGTERM", EXIT_TERMINATED)

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _os_sentence(problem: OSError) -> str:
    what = problem.strerror or str(problem)
    where = f" {problem.filename}" if problem.filename is not None else ""
    advice = {
        errno.ENOSPC: ": free some space, or choose another folder (--scratch for temporary files)",
        errno.EACCES: ": check the permissions, or choose another place",
        errno.EROFS: ": choose another place",
    }.get(problem.errno or 0, "")
    return f"{what}{where}{advice}"
