"""What `penumbra info` says: facts about a file as a dictionary, and those as text."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from penumbra.errors import SceneError

if TYPE_CHECKING:
    from penumbra.lights import Light

_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_EXR_MAGIC = b"\x76\x2f\x31\x01"
_HEADER_PREFIX = "penumbra:"
_MOST_ON_A_LINE = 3

Facts = dict[str, Any]


def describe(path: Path) -> Facts:
    """Facts about a blocker store, a scene file or an image, told apart by content; JSON values.

    Raises `SceneError` for any other file, and what reading the file raises.
    """
    try:
        with path.open("rb") as file:
            beginning = file.read(8)
    except OSError as problem:
        raise SceneError(f"cannot read {path}: {problem.strerror}") from None
    if beginning == _HDF5_MAGIC:
        return _store(path)
    if beginning.startswith(_EXR_MAGIC):
        return _image(path)
    if path.suffix.lower() == ".toml":
        return _scene(path)
    raise SceneError(f"{path} is no blocker store (.h5), scene file (.toml) or OpenEXR image (.exr)")


def as_text(facts: Facts, indent: str = "") -> str:
    """Facts as aligned lines: small ones of a list on a line each, larger ones as blocks."""
    width = max((len(key) for key in facts), default=0) + 2
    lines = []
    for key, value in facts.items():
        if isinstance(value, dict) or (_is_list_of_facts(value) and len(value[0]) > _MOST_ON_A_LINE):
            for entry in [value] if isinstance(value, dict) else value:
                lines += [f"{indent}{key}", as_text(entry, indent + "  ")]
        elif _is_list_of_facts(value):
            lines += [
                f"{indent}{key:<{width}}" + ", ".join(f"{k} {_plain(v)}" for k, v in entry.items())
                for entry in value
            ]
        else:
            text = _plain(value).replace("\n", "\n" + indent + " " * width)
            lines.append(f"{indent}{key:<{width}}{text}")
    return "\n".join(lines)


def _is_list_of_facts(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)


def _plain(value: Any) -> str:
    if isinstance(value, list | tuple):
        separator = ", " if value and isinstance(value[0], list) else " "
        return separator.join(map(_plain, value))
    if value is None or isinstance(value, bool):
        return {None: "none", True: "yes", False: "no"}[value]
    return f"{value:,}" if isinstance(value, int) else str(value)


def _scene(path: Path) -> Facts:
    from penumbra.scene import Scene

    scene = Scene.load(path)
    camera = scene.camera
    return {
        "kind": "scene",
        "path": str(path),
        "geometry": [
            {
                "path": str(mesh.path),
                "size_bytes": mesh.path.stat().st_size,
                "up": mesh.up,
                "transform": None if mesh.transform is None else mesh.transform.ravel().tolist(),
            }
            for mesh in scene.geometry
        ],
        "camera": {
            "eye": list(camera.eye),
            "look_at": list(camera.look_at),
            "up": list(camera.up),
            "vfov": camera.vfov,
            "resolution": list(camera.resolution),
        },
        "light": [_light(light) for light in scene.lights],
    }


def _light(light: "Light") -> Facts:
    from penumbra.lights import RectLight

    # A scene file has no seed.
    facts = {key: value for key, value in light.settings().items() if key != "seed"}
    return facts | {"area": light.area} if isinstance(light, RectLight) else facts


def _image(path: Path) -> Facts:
    from penumbra.io.exr import read_header

    header = read_header(path)
    ours = {
        # Matrices come as arrays.
        key.removeprefix(_HEADER_PREFIX): value.tolist() if hasattr(value, "tolist") else value
        for key, value in header.items()
        if key.startswith(_HEADER_PREFIX)
    }
    if not ours:
        raise SceneError(f"{path} is an OpenEXR image, but not one that penumbra wrote")
    return {
        "kind": "image",
        "path": str(path),
        "size_bytes": path.stat().st_size,
        "layers": header["channels"],
        "data_window": list(header["dataWindow"]),
        "display_window": list(header["displayWindow"]),
        "header": ours,
    }


def _store(path: Path) -> Facts:
    from penumbra.io.blocker_store import open_store

    with open_store(path) as store:
        return {
            "kind": "store",
            "path": str(path),
            "size_bytes": path.stat().st_size,
            "created_by": store.created_by,
            "n_triangles": store.n_triangles,
            "n_dropped": store.n_dropped,
            "n_bad": store.n_bad,
            "bounds": store.bounds.tolist(),
            "dtype": store.dtype.name,
            "is_sorted": store.is_sorted,
            "chunk_triangles": store.chunk_triangles,
            "n_chunks": len(store.chunks),
            "buckets": [bucket._asdict() for bucket in store.buckets],
            "sources": [
                {
                    key: value.ravel().tolist() if key == "transform" and value is not None else value
                    for key, value in source._asdict().items()
                }
                for source in store.sources
            ],
        }
