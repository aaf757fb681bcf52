"""The film: named float32 layers (and one uint32 id layer) over the crop window of a picture. numpy only.

layer                              background   meaning
R G B                              0            preview: radiance of a 0.8 grey diffuse surface (W m^-2 sr^-1)
<light>.visibility                 0            fraction of the light's samples that are not blocked, 1 = lit
<light>.irradiance                 0            direct irradiance with shadows (W m^-2)
<light>.irradiance_unshadowed      0            the same as if nothing blocked
Z                                  infinity     distance along the camera's forward axis
P.X P.Y P.Z                        0            receiver point, world space
N.X N.Y N.Z                        0            unit geometric normal turned to the camera, world space
id                                 0xffffffff   triangle index

Background pixels hold no receiver: every quantity is 0 there, so that sums and premultiplied compositing
are right; only the depth is infinite, so that a depth merge puts everything else in front of it.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from penumbra.arrays import Float32Array, Int64Array

Window = tuple[int, int, int, int]

BACKGROUND_ID = np.uint32(0xFFFFFFFF)
ALBEDO = 0.8
LIGHT_LAYERS = ("visibility", "irradiance", "irradiance_unshadowed")
GEOMETRY_LAYERS = ("Z", "P.X", "P.Y", "P.Z", "N.X", "N.Y", "N.Z")


class Film:
    """Layers of one picture.

    Parameters
    ----------
    width, height
        Size of the full picture in pixels.
    window
        The part that is kept: (x0, y0, x1, y1), half-open, from the upper left.
    light_names
        One group of light layers is made for each.

    Attributes
    ----------
    layers
        Name to array (y1 - y0, x1 - x0): float32, uint32 for `id`. `R`, `G` and `B` are one array,
        because the preview is grey.
    """

    def __init__(self, width: int, height: int, window: Window, light_names: Sequence[str]) -> None:
        self.width, self.height, self.window = width, height, window
        self.light_names = tuple(light_names)
        x0, y0, x1, y1 = window
        shape = (y1 - y0, x1 - x0)
        grey = np.zeros(shape, np.float32)
        self.layers: dict[str, NDArray[np.float32] | NDArray[np.uint32]] = {"R": grey, "G": grey, "B": grey}
        for light in self.light_names:
            self.layers.update({f"{light}.{layer}": np.zeros(shape, np.float32) for layer in LIGHT_LAYERS})
        self.layers.update({layer: np.zeros(shape, np.float32) for layer in GEOMETRY_LAYERS})
        self.layers["Z"].fill(np.inf)
        self.layers["id"] = np.full(shape, BACKGROUND_ID, np.uint32)

    def put(self, layer: str, pixel: Int64Array, values: NDArray[np.generic]) -> None:
        """Write `values` (n,) at `pixel` (n,), flat indices y * width + x of the full picture."""
        self.layers[layer].reshape(-1)[self._offsets(pixel)] = values

    def put_xyz(self, layer: str, pixel: Int64Array, values: NDArray[np.floating]) -> None:
        """Write the columns of `values` (n, 3) to `<layer>.X`, `<layer>.Y` and `<layer>.Z`."""
        for axis, name in enumerate("XYZ"):
            self.put(f"{layer}.{name}", pixel, values[:, axis])

    def add_direct_light(self, pixel: Int64Array, irradiance: Float32Array) -> None:
        """Add one light's irradiance (n,) to the grey preview: radiance = albedo / pi * irradiance."""
        self.layers["R"].reshape(-1)[self._offsets(pixel)] += np.float32(ALBEDO / math.pi) * irradiance

    def _offsets(self, pixel: Int64Array) -> Int64Array:
        """Turn flat indices of the full picture into flat indices of the window."""
        x0, y0, x1, _ = self.window
        y, x = np.divmod(pixel, self.width)
        offsets: Int64Array = (y - y0) * (x1 - x0) + (x - x0)
        return offsets


def film_bytes(window: Window, n_lights: int) -> int:
    """Memory of a film: 4 bytes a pixel for each distinct layer."""
    x0, y0, x1, y1 = window
    n_arrays = 1 + len(LIGHT_LAYERS) * n_lights + len(GEOMETRY_LAYERS) + 1
    return 4 * n_arrays * (x1 - x0) * (y1 - y0)
