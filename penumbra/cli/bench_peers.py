"""`penumbra bench peers`: us and Embree side by side."""

from pathlib import Path
from typing import Any

import click

from penumbra.cli import options
from penumbra.cli.console import Console, deliver

_judged = click.option(
    "--judged",
    metavar="N",
    type=click.IntRange(min=0),
    default=16,
    show_default=True,
    help="Receivers with differing bits that exact brute force decides.",
)

_mitsuba = click.option(
    "--mitsuba",
    is_flag=True,
    help="Also measure how long Mitsuba 3 takes to an error like ours (if installed).",
)


@click.command()
@options.scenes
@options.report_folder("peers.json, peers.csv and peers.png (needs matplotlib)")
@options.resolution
@options.samples
@options.sets
@options.area_light("cast")
@options.rounds
@_judged
@_mitsuba
@options.backend
@options.threads
@options.scratch
@options.overwrite
@options.verbosity
@click.pass_context
def peers(
    context: click.Context,
    /,
    scenes: tuple[str, ...],
    output: Path | None,
    scratch: Path | None,
    overwrite: bool,
    **settings: Any,
) -> None:
    """Measure us and Embree in turn, on the same receivers, samples and triangles.

    SCENE is a scene file, or the name of a scene that is made for the purpose: grids, flowers, atrium, each
    also with four times the light (grids-4x and so on); all of these when none is given. Embree comes with
    the package embreex; it traces every shadow ray, in packets of 16.

    Example: penumbra bench peers grids scene.toml -o measured --resolution 640x480
    """
    from penumbra.measure.peers import PeerOptions, measure_peers
    from penumbra.measure.peers_report import prepare_peer_outputs
    from penumbra.measure.scaling_scenes import named_scenes

    chosen = PeerOptions(**settings)
    paths = prepare_peer_outputs(output, overwrite) if output is not None else []
    with named_scenes(scenes, scratch) as found, context.ensure_object(Console).progress() as progress:
        report = measure_peers(found, chosen, scratch, progress)
    deliver(report, paths)
