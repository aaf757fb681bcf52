"""`penumbra bench stability`: hard scenes at all scales and offsets, judged bit by bit."""

from pathlib import Path
from typing import Any

import click

from penumbra.cli import options
from penumbra.cli.console import Console, deliver


class _CaseOption(click.Option):
    """Lists the cases in its help; they are imported only then."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        from penumbra.measure.stability_cases import CASES

        names, text = super().get_help_record(ctx) or ("", "")
        return names, f"{text} Cases: {', '.join(case.name for case in CASES)}."


def _known_cases(
    _context: click.Context, _parameter: click.Parameter, value: tuple[str, ...]
) -> tuple[str, ...]:
    from penumbra.errors import SceneError
    from penumbra.measure.stability_cases import cases_named

    try:
        cases_named(value)
    except SceneError as problem:
        raise click.BadParameter(str(problem)) from None
    return value


_case = click.option(
    "--case",
    "cases",
    cls=_CaseOption,
    metavar="NAME",
    multiple=True,
    callback=_known_cases,
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
@options.report_folder("stability.json and stability.csv")
@options.backends("judge", "auto", "reference")
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
    blockers, grazing segments, slivers, lights of zero area, point lights on blockers and at receivers: at
    scales 1e-6, 1 and 1e6 and offsets 0, 1e4 and 1e6. Exit code 1 if one bit is wrong.

    Example: penumbra bench stability -o measured
    """
    from penumbra.measure.backends import DEFAULT_BACKENDS
    from penumbra.measure.stability import StabilityOptions, measure_stability
    from penumbra.measure.stability_report import prepare_stability_outputs

    settings["backends"] = settings["backends"] or DEFAULT_BACKENDS
    chosen = StabilityOptions(**settings)
    paths = prepare_stability_outputs(output, overwrite) if output is not None else []
    with context.ensure_object(Console).progress() as progress:
        report = measure_stability(chosen, progress)
    try:
        deliver(report, paths)
    finally:
        # A wrong bit is worse than a full disk.
        report.raise_if_wrong()
