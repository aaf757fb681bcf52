"""`penumbra demo`: a self-made scene, rendered."""

from pathlib import Path

import click

from penumbra.cli import options
from penumbra.cli.console import Console, result


@click.command()
@options.demo_folder
@options.verbosity
@click.pass_context
def demo(context: click.Context, output: Path) -> None:
    """Make a small scene, render it to EXR and PNG, and print where they are.

    Example: penumbra demo -o demo
    """
    from penumbra.demo import run_demo

    with context.ensure_object(Console).progress() as progress:
        written = run_demo(output, progress)
    for path in written:
        result(path)
