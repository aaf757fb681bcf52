"""`penumbra bench`: the commands that measure what accuracy, stability and speed cost."""

import click

from penumbra.cli import options
from penumbra.cli.bench_error import error
from penumbra.cli.bench_peers import peers
from penumbra.cli.bench_scaling import scaling
from penumbra.cli.bench_stability import stability


@click.group()
@options.verbosity
def bench() -> None:
    """Measure on a scene of your own what accuracy costs, and that no bit is wrong where it is hard.

    Tables are printed on stdout; with -o, files are written as well.

    Example: penumbra bench error scene.toml -o measured
    """


for _command in (error, stability, peers, scaling):
    bench.add_command(_command)
