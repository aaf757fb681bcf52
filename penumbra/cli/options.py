"""Every option that commands share, defined once; what `bench` alone has stands with its commands.

option          commands               meaning
-o, --output    ingest, render, demo   where results go
--memory        ingest, render, bench  most resident memory of the process
--overwrite     ingest, render, bench  replace an output that is there
--skip-bad      ingest                 drop and count bad triangles
--scratch       ingest, render         folder of temporary files
--resolution    render, bench          WxH in place of the scene's
--samples       render                 light samples in place of the scene's
--backend       render, bench          how visibility is decided
--threads       render, bench          0: all
--light         bench                  the area light to measure
--sets          bench                  sample sets in place of the scene's
--rounds        bench                  passes to take the median of
--crop          render                 the part of the picture to render
--seed          render, bench          of the light samples
--resume        render                 keep a finished image of the same settings
--preview       render                 also a PNG
--stats         render                 also counters and seconds as JSON
--dry-run       render                 print the plan only
--json          info                   for programs
-v, -q          all                    say more, say nothing
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from penumbra.cli.console import Console

BACKENDS = ("hpc", "gears", "reference", "auto")


def _size(_context: click.Context, _parameter: click.Parameter, value: str) -> int | None:
    from penumbra.errors import SceneError
    from penumbra.options import parse_size

    try:
        return parse_size(value)
    except SceneError as problem:
        raise click.BadParameter(str(problem)) from None


def resolution_of(
    _context: click.Context, _parameter: click.Parameter, value: str | None
) -> tuple[int, int] | None:
    """Width and height of `WxH`, as a click callback."""
    if value is None:
        return None
    match = re.fullmatch(r"([1-9][0-9]{0,8})x([1-9][0-9]{0,8})", value, re.IGNORECASE)
    if match is None:
        raise click.BadParameter(f"{value!r} is not a resolution: write it as 1280x960, in pixels")
    return int(match[1]), int(match[2])


_FILE = click.Path(path_type=Path)


def _set_quiet(context: click.Context, _parameter: click.Parameter, value: bool) -> None:
    if value:
        context.ensure_object(Console).quiet = True


def _set_verbose(context: click.Context, _parameter: click.Parameter, value: bool) -> None:
    if value:
        context.ensure_object(Console).verbose = True


def verbosity(command: Callable[..., Any]) -> Callable[..., Any]:
    """-v and -q; they are kept in the `Console` and not passed to the command."""
    quiet = click.option(
        "-q", "--quiet", is_flag=True, expose_value=False, callback=_set_quiet, help="Report no progress."
    )
    verbose = click.option(
        "-v",
        "--verbose",
        is_flag=True,
        expose_value=False,
        callback=_set_verbose,
        help="Show the traceback of an unexpected error.",
    )
    return quiet(verbose(command))


mesh_paths = click.argument("meshes", metavar="MESH...", nargs=-1, required=True, type=_FILE)
scene_path = click.argument("scene", metavar="SCENE.toml", type=_FILE)
any_path = click.argument("file", metavar="FILE", type=_FILE)

store_output = click.option(
    "-o", "--output", metavar="STORE.h5", required=True, type=_FILE, help="The blocker store to write."
)
image_output = click.option(
    "-o",
    "--output",
    metavar="OUT.exr",
    type=_FILE,
    help="The OpenEXR image to write (needed, but for --dry-run).",
)
demo_folder = click.option(
    "-o",
    "--output",
    metavar="FOLDER",
    type=click.Path(path_type=Path, file_okay=False),
    default="demo",
    show_default=True,
    help="Folder to put the scene and its images in.",
)


def memory(default: str) -> Callable[..., Any]:
    """--memory, with the command's default."""
    return click.option(
        "--memory",
        metavar="SIZE",
        callback=_size,
        default=default,
        show_default=True,
        help="Most resident memory that the process may take, such as 512MiB or 4GB.",
    )


def report_folder(files: str) -> Callable[..., Any]:
    """-o of a benchmark: the folder of the files that it names."""
    return click.option(
        "-o",
        "--output",
        metavar="FOLDER",
        type=click.Path(path_type=Path, file_okay=False),
        help=f"Also write {files} into this folder.",
    )


def area_light(purpose: str) -> Callable[..., Any]:
    """--light of a benchmark."""
    return click.option(
        "--light", metavar="NAME", help=f"The area light to {purpose} (default: the first of the scene)."
    )


def backends(purpose: str, *left_out: str) -> Callable[..., Any]:
    """--backend of a benchmark that compares several."""
    return click.option(
        "--backend",
        "backends",
        multiple=True,
        type=click.Choice([name for name in BACKENDS if name not in left_out]),
        help=f"A backend to {purpose}; may be given more than once (default: hpc and gears).",
    )


def pixels(default: str, what: str) -> Callable[..., Any]:
    """--resolution of a benchmark, with its default."""
    return click.option(
        "--resolution",
        metavar="WxH",
        callback=resolution_of,
        default=default,
        show_default=True,
        help=what,
    )


scenes = click.argument("scenes", metavar="[SCENE]...", nargs=-1)
sets = click.option(
    "--sets",
    metavar="N",
    type=click.IntRange(min=1, max=256),
    default=1,
    show_default=True,
    help="Sample sets of the light, in place of the scene's.",
)
rounds = click.option(
    "--rounds",
    metavar="N",
    type=click.IntRange(min=1),
    default=3,
    show_default=True,
    help="Passes of each side, in turn.",
)
overwrite = click.option("--overwrite", is_flag=True, help="Replace the output if it is there.")
skip_bad = click.option(
    "--skip-bad", is_flag=True, help="Drop and count what is wrong in a mesh, do not fail."
)
scratch = click.option(
    "--scratch",
    metavar="FOLDER",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for temporary files (default: beside the output).",
)
resolution = click.option(
    "--resolution",
    metavar="WxH",
    callback=resolution_of,
    help="Width and height in pixels, in place of the scene's.",
)
samples = click.option(
    "--samples",
    metavar="N",
    type=click.IntRange(min=1),
    help="Samples of every rect light, in place of the scene's.",
)
backend = click.option(
    "--backend",
    type=click.Choice(BACKENDS),
    default="hpc",
    show_default=True,
    help="How visibility is decided; all give the same bits. `reference` is slow and for checks.",
)
threads = click.option(
    "--threads",
    metavar="N",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Threads to work with; 0: one for each core.",
)
crop = click.option(
    "--crop",
    metavar="X0 Y0 X1 Y1",
    nargs=4,
    type=int,
    help="Render this part only: pixels, half-open, from the upper left.",
)
seed = click.option(
    "--seed",
    metavar="N",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Seed of the light samples.",
)
resume = click.option(
    "--resume", is_flag=True, help="Do nothing where a finished image of the same settings is there."
)
preview = click.option(
    "--preview", metavar="OUT.png", type=_FILE, help="Also write a PNG of the direct light on 0.8 grey."
)
stats = click.option(
    "--stats", metavar="OUT.json", type=_FILE, help="Also write counters, seconds by stage and peak memory."
)
dry_run = click.option("--dry-run", is_flag=True, help="Print the plan and do nothing.")
as_json = click.option("--json", "as_json", is_flag=True, help="Print JSON, for programs.")
