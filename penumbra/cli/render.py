"""`penumbra render`: a scene file to an OpenEXR image."""

from pathlib import Path
from typing import Any

import click

from penumbra.cli import options
from penumbra.cli.console import Console, result


@click.command()
@options.scene_path
@options.image_output
@options.resolution
@options.samples
@options.backend
@options.memory("4GiB")
@options.threads
@options.crop
@options.seed
@options.resume
@options.preview
@options.stats
@options.scratch
@options.dry_run
@options.overwrite
@options.verbosity
@click.pass_context
def render(
    context: click.Context, /, scene: Path, output: Path | None, dry_run: bool, **settings: Any
) -> None:
    """Render a scene file to an OpenEXR image with exact soft shadows.

    Layers: R G B, NAME.visibility, NAME.irradiance and NAME.irradiance_unshadowed for each light, Z,
    P, N and id.

    Example: penumbra render scene.toml -o scene.exr --memory 2GiB --preview scene.png
    """
    if output is None and not dry_run:
        raise click.UsageError("Missing option '-o' / '--output'.", context)

    from penumbra.render import plan_render
    from penumbra.render import render as library_render

    if dry_run:
        result(plan_render(scene, output, process_limit=True, **settings))
        return
    with context.ensure_object(Console).progress() as progress:
        library_render(scene, output, process_limit=True, progress=progress, **settings)
    for path in (output, settings["preview"], settings["stats"]):
        # A finished image that was resumed comes without new numbers.
        if path is not None and Path(path).exists():
            result(path)
