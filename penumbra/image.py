"""A finished picture: its layers, its numbers, and the header that says what made it."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from penumbra import __version__
from penumbra.film import BACKGROUND_ID, Window
from penumbra.settings import Settings, canonical, settings_hash
from penumbra.stats import Stats

COMMENTS = (
    "visibility is the fraction of a light's samples that are not blocked: 1 = fully lit, 0 = full shadow. "
    "irradiance is in W m^-2, with and without (irradiance_unshadowed) blockers. "
    "R G B is the direct light on a 0.8 grey diffuse surface. Z is the distance along the view axis. "
    "P and N are in world space. Background pixels have id 4294967295, Z infinite and 0 everywhere else."
)


@dataclass(frozen=True, eq=False)
class Image:
    """A rendered picture.

    Attributes
    ----------
    layers
        Name to array (height, width) of the window, as in the EXR file: float32, `id` uint32.
    stats
        Counters, and seconds by stage.
    resolution, window
        Size of the full picture, and the part of it that the layers hold: (x0, y0, x1, y1), half-open.
    attributes
        The EXR header.
    """

    layers: Mapping[str, NDArray[Any]]
    stats: Stats
    resolution: tuple[int, int]
    window: Window
    attributes: Mapping[str, Any]

    def write(self, path: str | os.PathLike[str], threads: int = 1) -> None:
        """Write the layers to an OpenEXR file; raises OutputError when that fails."""
        from penumbra.io.exr import write_exr

        write_exr(path, self.layers, self.resolution, self.window, self.attributes, threads)

    def write_preview(self, path: str | os.PathLike[str]) -> None:
        """Write R (= G = B) as an exposed PNG; raises OutputError when that fails."""
        from penumbra.io.png import write_png

        write_png(path, self.layers["R"], self.layers["id"] == BACKGROUND_ID)


def header_attributes(settings: Settings, stats: Stats, plan: object) -> dict[str, Any]:
    """EXR header entries of a finished render: what made it, and what it took."""
    lights = settings["lights"]
    attributes: dict[str, Any] = {
        "comments": COMMENTS,
        "software": f"penumbra {__version__}",
        "penumbra:version": __version__,
        "penumbra:settings": canonical(settings),
        "penumbra:settings_hash": settings_hash(settings),
        "penumbra:plan": str(plan),
        "penumbra:seconds": sum(stats.seconds.values()),
    }
    # A light that has no such choice, a point, has one sample.
    for name, default in (("samples", 1), ("sets", 1), ("seed", 0)):
        values = {light["name"]: light.get(name, default) for light in lights}
        first, *others = set(values.values())
        attributes[f"penumbra:{name}"] = canonical(values) if others else first
    return attributes | {f"penumbra:{name}": value for name, value in stats.as_dict().items()}
