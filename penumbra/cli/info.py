"""`penumbra info`: what is in a file."""

import json
from pathlib import Path

import click

from penumbra.cli import options
from penumbra.cli.console import result


@click.command()
@options.any_path
@options.as_json
@options.verbosity
def info(file: Path, as_json: bool) -> None:
    """Say what is in a blocker store, a scene file or an image that penumbra wrote.

    Example: penumbra info scene.h5
    """
    from penumbra.cli.describe import as_text, describe

    facts = describe(file)
    result(json.dumps(facts, indent=2) if as_json else as_text(facts))
