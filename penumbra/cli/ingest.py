"""`penumbra ingest`: meshes to a blocker store."""

from pathlib import Path

import click

from penumbra.cli import options
from penumbra.cli.console import Console, result


@click.command()
@options.mesh_paths
@options.store_output
@options.memory("1GiB")
@options.overwrite
@options.skip_bad
@options.scratch
@options.verbosity
@click.pass_context
def ingest(
    context: click.Context,
    meshes: tuple[Path, ...],
    output: Path,
    memory: int,
    overwrite: bool,
    skip_bad: bool,
    scratch: Path | None,
) -> None:
    """Sort meshes into a blocker store that renders and casts stream from.

    Any number of OBJ and PLY files, of any size: memory stays under the limit.

    Example: penumbra ingest terrain.ply trees.obj -o scene.h5 --memory 2GiB
    """
    from penumbra.ingest import ingest as library_ingest

    with context.ensure_object(Console).progress() as progress:
        store = library_ingest(
            meshes,
            output,
            memory=memory,
            overwrite=overwrite,
            skip_bad=skip_bad,
            scratch=scratch,
            progress=progress,
            process_limit=True,
        )
    left_out = {"of zero area dropped": store.n_dropped, "bad ones skipped": store.n_bad}
    counts = [f"{store.n_triangles:,} triangles", *(f"{n:,} {what}" for what, n in left_out.items() if n)]
    result(f"{output}: {', '.join(counts)}")
    store.close()
