"""What to render: meshes by path, a camera, lights. Plain dataclasses of numbers and paths, checked here.

World space is right-handed with y up; lengths are in the scene's own unit.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from penumbra.arrays import Float64Array
from penumbra.errors import SceneError
from penumbra.lights import Light, RectLight

# OpenEXR cuts channel names at 255 bytes without a word; the longest layer adds 22.
_LONGEST_LIGHT_NAME = 200
RESERVED_LIGHT_NAMES = ("R", "G", "B", "A", "P", "N", "Z", "id")
"""Names that a light cannot have: they are layers or channels of the image."""

STORE_SUFFIX = ".h5"

# (x, y, z) -> (x, z, -y): exact, and right-handed stays right-handed.
_Z_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=np.float64)

Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class MeshRef:
    """One mesh file or blocker store, and how its vertices come into world space."""

    path: Path
    transform: Float64Array | None = None
    """(4, 4) float64, affine, applied to column vectors after the up-rotation; None: identity."""
    up: Literal["y", "z"] = "y"
    """The file's own up axis; "z" maps (x, y, z) to (x, z, -y)."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))
        if self.up not in ("y", "z"):
            raise SceneError(f'up of {self.path} is {self.up!r}: it must be "y" or "z"')
        if self.transform is not None:
            object.__setattr__(self, "transform", _affine(self.transform, self.path))
        if self.is_store and self.matrix() is not None:
            raise SceneError(
                f"{self.path} is a blocker store, which cannot be moved: "
                "leave out transform and up, or name the mesh that it was made from"
            )

    @property
    def is_store(self) -> bool:
        """Whether the path names a blocker store (by its suffix) and not a mesh."""
        return self.path.suffix.lower() == STORE_SUFFIX

    def matrix(self) -> Float64Array | None:
        """File coordinates to world space, float64 (4, 4); None where nothing changes."""
        if self.up == "y":
            return self.transform
        return _Z_UP if self.transform is None else self.transform @ _Z_UP


class CameraFrame(NamedTuple):
    """The camera as vectors: `d0 + x * dx + y * dy` is the direction through the centre of pixel (x, y).

    x runs right and y down from the upper left, in whole pixels; all are float64 (3,), world space,
    scaled so that `forward` (unit) times any direction is 1.
    """

    eye: Float64Array
    d0: Float64Array
    dx: Float64Array
    dy: Float64Array
    forward: Float64Array


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in world space with square pixels."""

    eye: Vector
    look_at: Vector
    up: Vector = (0.0, 1.0, 0.0)
    vfov: float = 45.0
    """Vertical field of view, degrees."""
    resolution: tuple[int, int] = (1280, 960)
    """Width and height in pixels."""

    def __post_init__(self) -> None:
        for name in ("eye", "look_at", "up"):
            object.__setattr__(self, name, _vector(getattr(self, name), f"camera.{name}"))
        object.__setattr__(self, "resolution", check_resolution(self.resolution))
        if not (isinstance(self.vfov, int | float) and 0 < self.vfov < 180):
            raise SceneError(f"camera.vfov is {self.vfov}: it must be between 0 and 180 degrees")
        object.__setattr__(self, "vfov", float(self.vfov))
        self.frame()

    def frame(self) -> CameraFrame:
        """The camera as vectors.

        Raises `SceneError` when `look_at` is the eye, or `up` is zero or parallel to the view.
        """
        eye = np.array(self.eye)
        forward = _unit(np.array(self.look_at) - eye)
        if forward is None:
            raise SceneError("camera.look_at is the same point as camera.eye: the view has no direction")
        up = _unit(np.array(self.up))
        right = None if up is None else _unit(np.cross(forward, up), least=1e-12)
        if right is None:
            raise SceneError("camera.up is zero or parallel to the view: choose another up")
        width, height = self.resolution
        pixel = 2.0 * math.tan(math.radians(self.vfov) / 2.0) / height
        dx = right * pixel
        dy = np.cross(forward, right) * pixel
        d0 = forward - dx * ((width - 1) / 2.0) - dy * ((height - 1) / 2.0)
        return CameraFrame(eye, d0, dx, dy, forward)


@dataclass(frozen=True)
class Scene:
    """Geometry, a camera and lights; at least one mesh and one light."""

    geometry: tuple[MeshRef, ...]
    camera: Camera
    lights: tuple[Light, ...]
    path: Path | None = None
    """The scene file, if it came from one."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "geometry", tuple(self.geometry))
        object.__setattr__(self, "lights", tuple(self.lights))
        if not self.geometry:
            raise SceneError("the scene has no geometry: it needs at least one mesh")
        if not self.lights:
            raise SceneError("the scene has no light: it needs at least one")
        check_light_names(light.name for light in self.lights)

    @staticmethod
    def load(path: str | Path) -> "Scene":
        """Read a scene file; `SceneError` names the file and key of what is wrong."""
        from penumbra.io.scene_file import read_scene

        return read_scene(path)

    def with_overrides(
        self, resolution: tuple[int, int] | None = None, samples: int | None = None, seed: int | None = None
    ) -> "Scene":
        """The same scene with another resolution, or with other samples or seed in every rect light."""
        camera = self.camera if resolution is None else replace(self.camera, resolution=resolution)
        changes: dict[str, Any] = {
            name: value for name, value in (("samples", samples), ("seed", seed)) if value is not None
        }
        lights = tuple(
            replace(light, **changes) if changes and isinstance(light, RectLight) else light
            for light in self.lights
        )
        return replace(self, camera=camera, lights=lights)


def check_resolution(resolution: Sequence[int]) -> tuple[int, int]:
    """Width and height as positive ints, or `SceneError`."""
    try:
        width, height = resolution
        if not all(isinstance(size, int | np.integer) and size > 0 for size in (width, height)):
            raise ValueError
    except (TypeError, ValueError):
        raise SceneError(
            f"camera.resolution is {resolution!r}: it must be two whole numbers above 0"
        ) from None
    return int(width), int(height)


def check_light_names(names: Iterable[str]) -> None:
    """Raise `SceneError` for a light name that is empty, dotted, reserved or used twice."""
    seen: set[str] = set()
    for name in names:
        if not name or "." in name:
            raise SceneError(
                f"the light name {name!r} is empty or has a dot: it must do as the name of a layer"
            )
        if not name.isprintable() or len(name.encode()) > _LONGEST_LIGHT_NAME:
            raise SceneError(
                f"the light name {name[:40]!r} is too long or has characters that do not print: "
                f"layers are named after it, so take at most {_LONGEST_LIGHT_NAME} printable bytes"
            )
        if name in RESERVED_LIGHT_NAMES:
            raise SceneError(
                f"the light name {name!r} is reserved: take another than {' '.join(RESERVED_LIGHT_NAMES)}"
            )
        if name in seen:
            raise SceneError(f"two lights have the name {name!r}: names must differ")
        seen.add(name)


def _vector(value: Sequence[float], name: str) -> Vector:
    try:
        x, y, z = (float(number) for number in value)
        if not all(map(math.isfinite, (x, y, z))):
            raise ValueError
    except (TypeError, ValueError):
        raise SceneError(f"{name} is {value!r}: it must be three finite numbers") from None
    return x, y, z


def _affine(value: Float64Array, path: Path) -> Float64Array:
    matrix = np.array(value, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or matrix[3].tolist() != [0, 0, 0, 1]:
        raise SceneError(f"transform of {path} must be 4 x 4 finite numbers whose last row is 0 0 0 1")
    return matrix


def _unit(vector: Float64Array, least: float = 0.0) -> Float64Array | None:
    """The vector at length 1, or None where it is not longer than `least`."""
    largest = float(np.abs(vector).max())
    if not 0 < largest < math.inf:
        return None
    scaled = vector / largest
    length = float(np.linalg.norm(scaled))
    return scaled / length if length * largest > least else None
