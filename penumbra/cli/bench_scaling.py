"""`penumbra bench scaling`: cost against size."""

from pathlib import Path
from typing import Any

import click

from penumbra.cli import options
from penumbra.cli.console import Console, deliver

_AXES = ("triangles", "resolution", "samples", "area")

_axis = click.option(
    "--axis",
    "axes",
    multiple=True,
    type=click.Choice(_AXES),
    help="What to vary; may be given more than once (default: all).",
)
_levels = click.option(
    "--levels",
    metavar="N",
    type=click.IntRange(min=1, max=6),
    default=2,
    show_default=True,
    help="How often the surface is subdivided, every triangle in four.",
)
_samples = click.option(
    "--samples",
    metavar="N",
    type=click.IntRange(min=1),
    default=256,
    show_default=True,
    help="Light samples of the base; the axis has a quarter and four times as many, too.",
)
_embree = click.option("--embree", is_flag=True, help="Measure Embree beside us (needs embreex).")


@click.command()
@options.scenes
@options.report_folder("scaling.json, scaling.csv and scaling.png (needs matplotlib)")
@_axis
@_levels
@options.pixels("640x480", "Pixels of the base; the axis has a quarter and four times as many, too.")
@_samples
@options.sets
@options.area_light("cast")
@options.rounds
@_embree
@options.backend
@options.threads
@options.scratch
@options.overwrite
@options.verbosity
@click.pass_context
def scaling(
    context: click.Context,
    /,
    scenes: tuple[str, ...],
    output: Path | None,
    scratch: Path | None,
    overwrite: bool,
    **settings: Any,
) -> None:
    """Measure how processor time, pairs, nodes and memory grow, and fit exponents.

    SCENE is a scene file, or the name of a made scene: grids, flowers, atrium, each also with four times
    the light (grids-4x and so on); all of these when none is given. Triangles grow by subdividing the same
    surface, so that no shadow changes.

    Example: penumbra bench scaling grids -o measured --axis triangles --embree
    """
    from penumbra.measure.scaling import ScalingOptions, measure_scaling
    from penumbra.measure.scaling_report import prepare_scaling_outputs
    from penumbra.measure.scaling_scenes import named_scenes

    chosen = ScalingOptions(**settings)
    paths = prepare_scaling_outputs(output, overwrite) if output is not None else []
    with named_scenes(scenes, scratch) as found, context.ensure_object(Console).progress() as progress:
        report = measure_scaling(found, chosen, scratch, progress)
    deliver(report, paths)
