"""The preview: a film's grey radiance, exposed for the screen and written as PNG; the only file with PIL."""

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from penumbra.arrays import Float32Array, UInt8Array
from penumbra.errors import OutputError
from penumbra.io.atomic import atomic_path

# The 98th percentile of the lit pixels lands on the knee, so a few pixels close to a light cannot darken
# the rest; what is brighter bends into the shoulder instead of clipping.
_EXPOSURE_PERCENTILE = 98.0
_KNEE = 0.8
# Dark and neutral, and lighter than black, so that umbra in the picture's rim stands out from it.
_BACKGROUND_SRGB = 46


def write_png(path: str | os.PathLike[str], radiance: Float32Array, background: NDArray[np.bool_]) -> None:
    """Write a preview of `radiance` (height, width), linear; pixels of `background` get a dark neutral grey.

    Raises OutputError when the file cannot be written.
    """
    with atomic_path(Path(path)) as temporary:
        try:
            Image.fromarray(expose(radiance, background)).save(temporary, format="PNG", optimize=True)
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror}; check the disk") from error


def expose(radiance: Float32Array, background: NDArray[np.bool_]) -> UInt8Array:
    """Grey levels, uint8 (height, width): automatic exposure, a soft shoulder, the sRGB curve.

    Infinite radiance counts as the largest float32.
    """
    linear = np.maximum(np.nan_to_num(radiance), np.float32(0))
    lit = linear[~background & (linear > 0)]
    white = np.float32(np.percentile(lit, _EXPOSURE_PERCENTILE) if lit.size else 1.0)
    # Divided, for 1 / white may overflow in a very dark picture; so may what is brightest there.
    with np.errstate(over="ignore"):
        linear = linear / white * np.float32(_KNEE)
    above = np.maximum(linear - _KNEE, 0)
    linear = np.minimum(linear, _KNEE) + (1 - _KNEE) * -np.expm1(-above / (1 - _KNEE))
    grey = np.round(255 * _srgb(linear)).astype(np.uint8)
    grey[background] = _BACKGROUND_SRGB
    return grey


def _srgb(linear: Float32Array) -> Float32Array:
    """The sRGB transfer curve (IEC 61966-2-1)."""
    curve = 1.055 * np.power(linear, 1 / 2.4, where=linear > 0.0031308, out=np.zeros_like(linear)) - 0.055
    return np.where(linear > 0.0031308, curve, 12.92 * linear)
