"""What decides the bits of a picture, as JSON: a finished image carries it, and `--resume` compares it."""

import hashlib
import json
from dataclasses import asdict
from typing import Any

from penumbra import __version__
from penumbra.film import Window
from penumbra.scene import MeshRef, Scene

Settings = dict[str, Any]


def settings_of(scene: Scene, window: Window) -> Settings:
    """Everything that decides the picture's bits, as JSON values.

    Threads, memory and backend are not in it, for they change no bit; meshes are known by name, size and
    time of change.
    """
    camera = asdict(scene.camera)
    return {
        "version": __version__,
        "resolution": list(camera.pop("resolution")),
        "crop": list(window),
        "camera": {key: list(value) if isinstance(value, tuple) else value for key, value in camera.items()},
        "geometry": [_geometry_settings(mesh) for mesh in scene.geometry],
        "lights": [light.settings() for light in scene.lights],
    }


def settings_hash(settings: Settings) -> str:
    """Hexadecimal SHA-256 of the settings."""
    return hashlib.sha256(canonical(settings).encode()).hexdigest()


def canonical(value: Any) -> str:
    """JSON with one spelling for one value."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def differences(old: Any, new: Any, key: str = "") -> list[str]:
    """Name every value that differs between two settings: `camera.vfov 45 -> 60`."""
    if isinstance(old, dict) and isinstance(new, dict):
        names = sorted(old.keys() | new.keys())
        children = [(f"{key}.{name}", old.get(name), new.get(name)) for name in names]
    elif isinstance(old, list) and isinstance(new, list) and _holds_tables(old + new):
        if len(old) != len(new):
            return [f"{key.lstrip('.')}: {len(old)} -> {len(new)}"]
        children = [(f"{key}[{n}]", a, b) for n, (a, b) in enumerate(zip(old, new, strict=True))]
    else:
        return [] if old == new else [f"{key.lstrip('.')} {old} -> {new}"]
    return [text for name, a, b in children for text in differences(a, b, name)]


def _holds_tables(items: list[Any]) -> bool:
    return any(isinstance(item, dict) for item in items)


def _geometry_settings(mesh: MeshRef) -> Settings:
    status = mesh.path.stat()
    return {
        "file": mesh.path.name,
        "size": status.st_size,
        "mtime_ns": status.st_mtime_ns,
        "transform": None if mesh.transform is None else mesh.transform.tolist(),
        "up": mesh.up,
    }
