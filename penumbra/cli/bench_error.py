"""`penumbra bench error`: error of visibility against samples and seconds."""

from pathlib import Path
from typing import Any

import click

from penumbra.cli import options
from penumbra.cli.console import Console, deliver, result


def _samples(_context: click.Context, _parameter: click.Parameter, value: str) -> tuple[int, ...]:
    try:
        numbers = tuple(int(word) for word in value.split(","))
    except ValueError:
        numbers = ()
    if not numbers or min(numbers) < 1:
        raise click.BadParameter(f"{value!r} is not a list of whole numbers: write it as 16,64,256")
    return numbers


_sample_counts = click.option(
    "--samples",
    metavar="N,N,...",
    callback=_samples,
    default="16,32,64,128,256,512,1024",
    show_default=True,
    help="Numbers of light samples to measure, from 1 to 65536.",
)
_reference = click.option(
    "--reference",
    metavar="N",
    type=click.IntRange(min=2),
    help="Light samples of the reference: an even number, from twice the most of --samples to 131072"
    " (default: 16 times the most of --samples, at least 16384).",
)


@click.command()
@options.scene_path
@options.report_folder("error.json, error.csv and error.png (needs matplotlib)")
@options.area_light("measure")
@options.pixels("320x240", "Pixels whose visible points are the receivers, in place of the scene's.")
@_sample_counts
@_reference
@options.backends("measure", "auto")
@options.memory("4GiB")
@options.threads
@options.seed
@options.overwrite
@options.verbosity
@click.pass_context
def error(
    context: click.Context,
    /,
    scene: Path,
    output: Path | None,
    memory: int | None,
    overwrite: bool,
    **settings: Any,
) -> None:
    """Measure how wrong visibility is with so many light samples, and what they cost.

    Each backend casts the points that the camera sees with each number of samples, on a regular grid and
    jittered, and is compared with a reference of many samples: errors, seconds, peak memory, and how fast
    the error falls. Ctrl-C prints what is finished, and writes nothing.

    Example: penumbra bench error scene.toml -o measured --samples 16,64,256
    """
    from penumbra.errors import SceneError
    from penumbra.measure.backends import DEFAULT_BACKENDS
    from penumbra.measure.error import ErrorOptions, measure_error
    from penumbra.measure.error_report import ErrorReport, prepare_error_outputs

    settings["backends"] = settings["backends"] or DEFAULT_BACKENDS
    try:
        chosen = ErrorOptions(**settings)
    except SceneError as problem:
        raise click.UsageError(str(problem)) from None
    paths = prepare_error_outputs(output, overwrite) if output is not None else []
    stopped: list[ErrorReport] = []
    try:
        with context.ensure_object(Console).progress() as progress:
            report = measure_error(
                scene,
                chosen,
                memory=memory,
                process_limit=True,
                progress=progress,
                on_stop=stopped.append,
            )
    finally:
        # Not before: the progress bar has left its line by now.
        for unfinished in stopped:
            result(unfinished)
    deliver(report, paths)
