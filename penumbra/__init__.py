"""Exact soft shadows of meshes larger than memory, as bits, irradiance and images.

Names are resolved on first use, so that `import penumbra` and `penumbra --help` load neither numba
nor a file format library.
"""

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from penumbra import errors

if TYPE_CHECKING:
    from penumbra.api import camera_receivers, cast
    from penumbra.ingest import ingest
    from penumbra.io.blocker_store import open_store
    from penumbra.lights import PointLight, RectLight
    from penumbra.options import CastOptions, IngestOptions
    from penumbra.render import render
    from penumbra.scene import Camera, MeshRef, Scene

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "CastOptions",
    "IngestOptions",
    "MeshRef",
    "PointLight",
    "RectLight",
    "Scene",
    "__version__",
    "camera_receivers",
    "cast",
    "errors",
    "ingest",
    "open_store",
    "render",
]

_HOME = {
    "Camera": "penumbra.scene",
    "CastOptions": "penumbra.options",
    "IngestOptions": "penumbra.options",
    "MeshRef": "penumbra.scene",
    "PointLight": "penumbra.lights",
    "RectLight": "penumbra.lights",
    "Scene": "penumbra.scene",
    "camera_receivers": "penumbra.api",
    "cast": "penumbra.api",
    "ingest": "penumbra.ingest",
    "open_store": "penumbra.io.blocker_store",
    "render": "penumbra.render",
}


class _Package(ModuleType):
    """The package itself; `penumbra.ingest` and `penumbra.render` stay functions."""

    def __setattr__(self, name: str, value: object) -> None:
        # The import system binds a submodule to its package under its own name; the modules
        # `ingest` and `render` would then hide the functions that they hold.
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'penumbra' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


sys.modules[__name__].__class__ = _Package
