"""Write and read multi-layer OpenEXR files; the only file that imports OpenEXR."""

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from penumbra.arrays import Float64Array
from penumbra.errors import OutputError, SceneError
from penumbra.io.atomic import atomic_path
from penumbra.scene import CameraFrame

Layers = Mapping[str, NDArray[Any]]

STRUCTURE = ("channels", "compression", "dataWindow", "displayWindow", "lineOrder", "type")
"""Header entries that `write_exr` makes itself."""

_INT32_MAX = 2**31 - 1


def write_exr(
    path: str | os.PathLike[str],
    layers: Layers,
    resolution: tuple[int, int],
    window: tuple[int, int, int, int],
    attributes: Mapping[str, Any],
    threads: int = 1,
) -> None:
    """Write `layers` losslessly (ZIP) as one part, through a temporary name.

    Parameters
    ----------
    layers
        Channel name to array (y1 - y0, x1 - x0): float32 or uint32.
    resolution
        Width and height of the full picture: the displayWindow.
    window
        (x0, y0, x1, y1), half-open: the dataWindow (which OpenEXR stores inclusive).
    attributes
        Header entries: str, int, float (kept as float32), or (4, 4) float32 or float64 arrays. Integers
        beyond 32 bits are written as decimal strings, for OpenEXR has no 64-bit integers.

    Raises OutputError when the file cannot be written.
    """
    x0, y0, x1, y1 = window
    header = {
        "type": OpenEXR.scanlineimage,
        "compression": OpenEXR.ZIP_COMPRESSION,
        "dataWindow": (np.array([x0, y0], np.int32), np.array([x1 - 1, y1 - 1], np.int32)),
        "displayWindow": (np.zeros(2, np.int32), np.array(resolution, np.int32) - np.int32(1)),
        **{name: _to_attribute(value) for name, value in attributes.items()},
    }
    # Both are needed: without the global count the file's own number of threads has no effect.
    OpenEXR.set_global_thread_count(threads)
    with atomic_path(Path(path)) as temporary:
        try:
            # A copy of the mapping: the module replaces its values by Channel objects.
            OpenEXR.File(header, dict(layers), num_threads=threads).write(str(temporary))
        except RuntimeError as error:
            raise OutputError(f"cannot write {path}: {error}; check the disk and try again") from error


def read_header(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Header of an EXR file as plain Python values.

    Windows come as (x_min, y_min, x_max, y_max), inclusive as in the file; `channels` as a list of names;
    matrices as arrays; integers that were written as strings because of their size as integers.
    Raises SceneError when `path` is not an EXR file.
    """
    with _open(path, header_only=True) as file:
        # Inside the `with`: leaving it empties the header.
        header = file.header()
        names = [channel.name for channel in header["channels"]]
        return {name: _from_attribute(value) for name, value in header.items()} | {"channels": names}


def read_layers(path: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    """Every channel of an EXR file: name to array (height, width) of its dataWindow.

    Raises SceneError when `path` is not an EXR file.
    """
    with _open(path, header_only=False) as file:
        return {name: channel.pixels for name, channel in file.channels().items()}


def camera_attributes(frame: CameraFrame, resolution: tuple[int, int]) -> dict[str, Any]:
    """Header entries of a camera, by OpenEXR's conventions for row vectors (point times matrix).

    `worldToCamera`: left-handed, x right, y up, z forward. `worldToNDC`: after division by w, (0, 0) is the
    upper left corner of the display window and (1, 1) the lower right one (z holds 1 / depth). Both are
    float32 by the standard, so the same matrices follow in float64 as `penumbra:worldToCamera` and
    `penumbra:worldToNDC`. `screenWindowWidth` is the width of what is seen at distance 1.
    """
    to_camera = np.eye(4)
    right, up = frame.dx / np.linalg.norm(frame.dx), -frame.dy / np.linalg.norm(frame.dy)
    to_camera[:3, :3] = np.stack([right, up, frame.forward], axis=1)
    to_camera[3, :3] = -frame.eye @ to_camera[:3, :3]
    to_ndc = _world_to_ndc(frame, resolution)
    return {
        "screenWindowWidth": float(np.linalg.norm(frame.dx)) * resolution[0],
        "worldToCamera": to_camera.astype(np.float32),
        "worldToNDC": to_ndc.astype(np.float32),
        "penumbra:worldToCamera": to_camera,
        "penumbra:worldToNDC": to_ndc,
    }


def _world_to_ndc(frame: CameraFrame, resolution: tuple[int, int]) -> Float64Array:
    # A point eye + depth * (d0 + x dx + y dy) is at pixel (x, y); the centre of pixel 0 is half a pixel
    # inside the display window. dx, dy and forward are orthogonal, so x = (p - eye).dx / dx.dx / depth - ...
    matrix = np.zeros((4, 4))
    for column, (step, size) in enumerate(zip((frame.dx, frame.dy), resolution, strict=True)):
        along = step / (step @ step)
        matrix[:3, column] = (along + (0.5 - frame.d0 @ along) * frame.forward) / size
    matrix[3, 2] = 1.0
    matrix[:3, 3] = frame.forward
    translation = np.eye(4)
    translation[3, :3] = -frame.eye
    return translation @ matrix


@contextmanager
def _open(path: str | os.PathLike[str], header_only: bool) -> Iterator[Any]:
    name = os.fspath(path)
    # Asked first, because the module prints to stderr what it cannot open.
    if not Path(name).is_file():
        raise SceneError(f"{name}: no such file; give the path of an OpenEXR file")
    if not OpenEXR.isOpenExrFile(name):
        raise SceneError(f"{name}: this is not an OpenEXR file; give the path of an OpenEXR file")
    try:
        # separate_channels: the default would merge R, G and B into one array.
        with OpenEXR.File(name, separate_channels=True, header_only=header_only) as file:
            yield file
    # A damaged file shows as RuntimeError when opened, as ValueError (no parts) when read.
    except (RuntimeError, ValueError) as error:
        raise SceneError(f"{name}: the OpenEXR file is damaged ({error}); write it again") from error


def _to_attribute(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, int) and not -_INT32_MAX <= value <= _INT32_MAX:
        return str(value)
    return value


def _from_attribute(value: Any) -> Any:
    if isinstance(value, str) and re.fullmatch(r"-?\d{10,}", value):
        return int(value)
    if isinstance(value, tuple):
        return tuple(int(number) for corner in value for number in corner)
    if isinstance(value, str | int | float | np.ndarray):
        return value
    return getattr(value, "name", str(value))
