"""The files a render writes: refused before any work, known again by `--resume`, written at the end."""

import json
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from penumbra.errors import OutputError, PenumbraError, SceneError
from penumbra.image import Image
from penumbra.io.atomic import atomic_path, check_output, remove_dead_temporaries
from penumbra.settings import Settings, differences, settings_hash
from penumbra.stats import Stats


@dataclass(frozen=True)
class Outputs:
    """Where the image, its preview and the run's numbers go; None where they are not wanted."""

    image: Path | None
    preview: Path | None
    stats: Path | None

    def check(self, inputs: Iterable[Path]) -> None:
        """Raise OutputError if a file could not be written, SceneError if one is an input or named twice.

        Removes what killed runs left of the same outputs.
        """
        taken = {path.resolve() for path in inputs}
        for path in (self.image, self.preview, self.stats):
            if path is None:
                continue
            check_output(path)
            if path.resolve() in taken:
                raise SceneError(f"{path} is used twice, or is an input of this render; choose another")
            taken.add(path.resolve())
            remove_dead_temporaries(path)

    def refuse_existing(self) -> None:
        """Raise OutputError if one of the files is there and would be replaced."""
        for path in (self.image, self.preview, self.stats):
            if path is not None and path.exists():
                raise OutputError(
                    f"{path} is there already: give --overwrite to replace it, --resume to keep a finished "
                    "image, or another output"
                )

    def scratch_parent(self, scratch: str | Path | None) -> Path:
        """Folder for temporary files: the one asked for, else beside the image. Raises OutputError."""
        if scratch is not None:
            check_output(Path(scratch) / "blockers.h5")
            return Path(scratch)
        return self.image.resolve().parent if self.image is not None else Path(tempfile.gettempdir())

    def write(self, image: Image, threads: int) -> None:
        """Write the preview and the image, this last: it is the sign of a finished render."""
        if self.preview is not None:
            image.write_preview(self.preview)
        if self.image is not None:
            image.write(self.image, threads)

    def write_numbers(self, numbers: dict[str, Any]) -> None:
        """Write the numbers as JSON."""
        if self.stats is not None:
            with atomic_path(self.stats) as temporary:
                temporary.write_text(json.dumps(numbers, indent=2) + "\n")


def finished_image(path: Path, settings: Settings) -> Image:
    """Read a finished picture of exactly these settings.

    Raises OutputError, naming what differs, when the file is anything else.
    """
    from penumbra.io.exr import STRUCTURE, read_header, read_layers

    advice = "give --overwrite to replace it, or another output"
    try:
        header = read_header(path)
    except PenumbraError:
        header = {}
    try:
        made_with = json.loads(header["penumbra:settings"])
    except (KeyError, ValueError):
        raise OutputError(
            f"cannot resume {path}: it is there, but it is no finished picture of this program; {advice}"
        ) from None
    if header.get("penumbra:settings_hash") != settings_hash(settings):
        changes = ", ".join(differences(made_with, settings)) or "its settings cannot be read"
        raise OutputError(f"cannot resume {path}: it was rendered with other settings ({changes}); {advice}")
    x0, y0, x1, y1 = header["dataWindow"]
    resolution = header["displayWindow"][2] + 1, header["displayWindow"][3] + 1
    attributes = {name: value for name, value in header.items() if name not in STRUCTURE}
    stats = Stats(str(attributes.get("penumbra:backend", "")))
    try:
        layers = read_layers(path)
    except PenumbraError:
        raise OutputError(
            f"cannot resume {path}: its pixels cannot be read, it is not whole; {advice}"
        ) from None
    return Image(layers, stats, resolution, (x0, y0, x1 + 1, y1 + 1), attributes)
