"""`penumbra bench stability`: hard scenes at all scales and offsets, judged bit by bit."""

from pathlib import Path
from typing import Any

import click

from penumbra.cli import options
from penumbra.cli.console import Console, result

_output = click.option(
    "-o",
    "--output",
    metavar="FOLDER",
    type=click.Path(path_type=Path, file_okay=False),
    help="Also write stability.json and stability.csv into this folder.",
)
_backend = click.option(
    "--backend",
    "backends",
    metavar="NAME",
    multiple=True,
    type=click.Choice([name for name in options.BACKENDS if name not in ("auto", "reference")]),
    help="A backend to judge; may be given more than once (default: hpc and gears).",
)
_case = click.option(
    "--case",
    "cases",
    metavar="NAME",
    multiple=True,
    help="Only this case of the table; may be given more than once.",
)
_seed = click.option(
    "--seed",
    metavar="N",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Seed of the scenes.",
)
_quick = click.option("--quick", is_flag=True, help="Small scenes: bits are judged, but times mean little.")


@click.command()
@_output
@_backend
@_case
@_seed
@_quick
@options.threads
@options.overwrite
@options.verbosity
@click.pass_context
def stability(context: click.Context, /, output: Path | None, overwrite: bool, **settings: Any) -> None:
    """Cast scenes that break shadow algorithms, and judge every bit by exact brute force.

    Blockers through the light, touching it and in its plane, receivers on planes, edges and vertices of
    blockers, grazing segments, slivers, lights of zero area: at scales 1e-6, 1 and 1e6 and offsets 0, 1e4
    and 1e6. Exit code 1 if one bit is wrong.

    Example: penumbra bench stability -o measured
    """
    from penumbra.measure.error import DEFAULT_BACKENDS
    from penumbra.measure.stability import StabilityOptions, measure_stability
    from penumbra.measure.stability_report import prepare_stability_outputs

    settings["backends"] = settings["backends"] or DEFAULT_BACKENDS
    chosen = StabilityOptions(**settings)
    paths = prepare_stability_outputs(output, overwrite) if output is not None else []
    with context.ensure_object(Console).progress() as progress:
        report = measure_stability(chosen, progress)
    if paths:
        report.write(paths)
    result(report)
    for path in paths:
        result(path)
    report.raise_if_wrong()
