"""`penumbra warmup`: compile ahead of the first render."""

import time

import click

from penumbra.cli import options
from penumbra.cli.console import Console, result


@click.command()
@options.verbosity
@click.pass_context
def warmup(context: click.Context) -> None:
    """Compile all kernels into the cache, so that no later run waits for it.

    Example: penumbra warmup
    """
    from penumbra.warmup import warm_up

    began = time.perf_counter()
    with context.ensure_object(Console).progress() as progress:
        folder = warm_up(progress)
    result(f"kernels are ready in {folder} ({time.perf_counter() - began:.1f} s)")
