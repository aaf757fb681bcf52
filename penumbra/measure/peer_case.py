"""What both sides of a comparison are given: the same receivers, light samples and triangles, as files."""

import json
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from penumbra.arrays import Float64Array, Int64Array
from penumbra.blockers import Blockers
from penumbra.lights import RectLight

_ARRAYS = ("points", "normals", "own", "index")


@dataclass(frozen=True, eq=False)
class CastCase:
    """Receivers and a light; the arguments of `penumbra.cast` but for the blockers."""

    points: Float64Array
    """(R, 3) world space."""
    normals: Float64Array
    """(R, 3) geometric, turned to the camera."""
    own: Int64Array
    """(R,) index of each receiver's triangle."""
    index: Int64Array
    """(R,) pixel y * width + x; the sample set is hashed from it."""
    width: int
    """Of the picture, in pixels."""
    offset: float
    """How far above its surface a ray tracer starts a shadow ray, in scene units."""
    light: RectLight

    def write(self, folder: Path) -> None:
        """Write arrays and numbers into a folder that exists."""
        for name in _ARRAYS:
            np.save(folder / f"{name}.npy", getattr(self, name))
        light = {field.name: getattr(self.light, field.name) for field in fields(self.light)}
        light |= {name: value.tolist() for name, value in light.items() if isinstance(value, np.ndarray)}
        numbers = {"width": self.width, "offset": self.offset, "light": light}
        (folder / "case.json").write_text(json.dumps(numbers))

    @staticmethod
    def read(folder: Path) -> "CastCase":
        """Read what `write` has written; floats come back as they were."""
        arrays = {name: np.load(folder / f"{name}.npy") for name in _ARRAYS}
        numbers = json.loads((folder / "case.json").read_text())
        numbers["light"] = RectLight(**numbers["light"])
        return CastCase(**arrays, **numbers)

    def facts(self) -> dict[str, Any]:
        """Numbers that say what is cast; JSON values."""
        return {
            "width": self.width,
            "n_receivers": len(self.points),
            "samples": self.light.samples,
            "sets": self.light.sets,
            "light_area": self.light.area,
        }

    def with_light(self, **changes: Any) -> "CastCase":
        """The same receivers with other samples, sets or edges of the light."""
        return replace(self, light=replace(self.light, **changes))


def write_indexed_mesh(blockers: Blockers, folder: Path) -> int:
    """Write all blockers as `vertices.npy` float32 (V, 3) and `triangles.npy` uint32 (T, 3), shared vertices.

    In the order of their ids, as a mesh file has them. Returns the number of triangles.
    """
    chunks = [blockers.read(number) for number in range(len(blockers.chunks))]
    corners: NDArray[np.float32] = np.concatenate(
        [chunk.vertices.astype(np.float32) for chunk in chunks] or [np.zeros((0, 3, 3), np.float32)]
    )
    ids = np.concatenate([chunk.ids for chunk in chunks] or [np.zeros(0, np.int64)])
    del chunks
    corners = corners[np.argsort(ids, kind="stable")].reshape(-1, 3)
    # + 0.0 makes -0.0 equal to 0.0, which the bytes of a vertex would tell apart.
    keys = np.ascontiguousarray(corners + np.float32(0.0)).view("V12").ravel()
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    np.save(folder / "vertices.npy", corners[first])
    np.save(folder / "triangles.npy", inverse.reshape(-1, 3).astype(np.uint32))
    return len(ids)
