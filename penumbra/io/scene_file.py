"""1: a scene file (TOML) becomes a `Scene`; whatever is wrong is named with its file, line and key."""

import math
import re
import reprlib
import sys
import tomllib
from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TypeVar

import numpy as np

from penumbra.errors import SceneError
from penumbra.lights import PATTERNS, Light, PointLight, RectLight
from penumbra.scene import Camera, MeshRef, Scene, check_light_names

LIGHT_KEYS = {
    "rect": (
        "name",
        "type",
        "corner",
        "edge_u",
        "edge_v",
        "samples",
        "sets",
        "pattern",
        "radiance",
        "two_sided",
    ),
    "point": ("name", "type", "position", "intensity"),
}
"""Every type of light and every key it may have."""

TABLE_KEYS = {
    "geometry": ("path", "transform", "up"),
    "camera": ("eye", "look_at", "up", "vfov", "resolution"),
    "light": tuple(dict.fromkeys(key for keys in LIGHT_KEYS.values() for key in keys)),
}
"""Every table of a scene file and every key it may have, whatever its type."""

_HEADER = re.compile(r"\s*\[\[?\s*([\w.-]+)\s*\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"\s*[\"']?([\w-]+)[\"']?\s*(?:\.|=)")

T = TypeVar("T")


def read_scene(path: str | Path) -> Scene:
    """Read a scene file; mesh paths in it are relative to its folder.

    Raises `SceneError` with one sentence that names the file, and the line and key where there is one.
    """
    path = Path(path)
    text = _read_text(path)
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"{path}: not valid TOML: {error}") from None
    lines = _key_lines(text)
    root = _Table(path, "", content, lines.get(("", 0), {}))
    root.check_keys(tuple(TABLE_KEYS), "the scene file")
    tables = {
        kind: [
            _Table(path, kind, entry, lines.get((kind, number), {}), number, len(entries))
            for number, entry in enumerate(entries)
        ]
        for kind, entries in _entries(root).items()
    }
    for kind, of_kind in tables.items():
        for table in of_kind:
            if kind == "light":
                _check_light_keys(table)
            else:
                table.check_keys(TABLE_KEYS[kind], table.label)
    geometry = tuple(_geometry(table) for table in tables["geometry"])
    camera = _camera(tables["camera"][0])
    lights = tuple(_light(table) for table in tables["light"])
    for n_names, table in enumerate(tables["light"], start=1):
        table.build(partial(check_light_names, [light.name for light in lights[:n_names]]))
    return Scene(geometry, camera, lights, path)


class _Table:
    """One table of the file: typed look-ups whose errors say where."""

    def __init__(
        self,
        path: Path,
        kind: str,
        values: dict[str, Any],
        lines: dict[str, int],
        number: int = 0,
        of: int = 1,
    ) -> None:
        self.path, self.kind, self.values, self._lines = path, kind, values, lines
        self.label = f"[{kind}]" if kind == "camera" else f"[[{kind}]]" + (f" {number + 1}" if of > 1 else "")

    def refuse(self, message: str, key: str | None = None) -> NoReturn:
        """Raise `SceneError`, naming the file and the line of the key, or else of the table."""
        line = self._lines.get(key or "", self._lines.get(""))
        raise SceneError(f"{self.path}{f':{line}' if line else ''}: {message}")

    def check_keys(self, valid: Sequence[str], where: str) -> None:
        """Refuse the first key that is not valid, and name the valid one nearest to it."""
        for key in self.values:
            if key not in valid:
                nearest = get_close_matches(key, valid, n=1, cutoff=0.0)[0]
                self.refuse(
                    f"unknown key '{key}' in {where}; the nearest valid key is '{nearest}' "
                    f"(of {', '.join(valid)})",
                    key,
                )

    def needed(self, key: str, kind: "_Kind") -> Any:
        """The value of a key that must be there."""
        if key not in self.values:
            self.refuse(f"'{key}' is missing in {self.label}: it must be {kind.wanted}")
        return self._checked(key, kind)

    def given(self, kinds: "Mapping[str, _Kind]") -> dict[str, Any]:
        """The values of those keys that are there; for the others the scene has its own defaults."""
        return {key: self._checked(key, kind) for key, kind in kinds.items() if key in self.values}

    def _checked(self, key: str, kind: "_Kind") -> Any:
        value = self.values[key]
        if not kind.accepts(value):
            self.refuse(f"'{key}' in {self.label} is {reprlib.repr(value)}: it must be {kind.wanted}", key)
        return value

    def build(self, make: Callable[[], T]) -> T:
        """Make a part of the scene; what it refuses is told with the line of the key it speaks of."""
        try:
            return make()
        except SceneError as error:
            found = [(m.start(), key) for key in self.values if (m := re.search(rf"\b{key}\b", str(error)))]
            self.refuse(f"{error}", min(found)[1] if found else None)


def _geometry(table: _Table) -> MeshRef:
    path = table.path.parent / table.needed("path", _FILE_NAME)
    if not path.is_file():
        table.refuse(f"'path' in {table.label}: there is no file {path}", "path")
    given = table.given({"up": _UP_AXIS, "transform": _MATRIX})
    if "transform" in given:
        given["transform"] = np.array(given["transform"], dtype=np.float64).reshape(4, 4)
    return table.build(lambda: MeshRef(path, **given))


def _camera(table: _Table) -> Camera:
    eye, look_at = (table.needed(key, _VECTOR) for key in ("eye", "look_at"))
    given = table.given({"up": _VECTOR, "vfov": _DEGREES, "resolution": _PIXELS})
    return table.build(lambda: Camera(eye, look_at, **given))


def _light_type(table: _Table) -> str:
    found: str = table.given({"type": _LIGHT_TYPE}).get("type", "rect")
    return found


def _check_light_keys(table: _Table) -> None:
    """Refuse the first key that belongs to another type of light, or to none."""
    of_type = _light_type(table)
    for key in table.values:
        if key in TABLE_KEYS["light"] and key not in LIGHT_KEYS[of_type]:
            hint = _hint_for_point(table, key) if of_type == "point" else _hint_for_rect(table, key)
            table.refuse(f"{hint} ({table.label})", key)
    table.check_keys(LIGHT_KEYS[of_type], f"{table.label} of type {of_type}")


def _hint_for_rect(table: _Table, key: str) -> str:
    """What to do about a key of point lights in a rect light: mostly, `type` was forgotten."""
    has_corner = "corner" in table.values
    if key == "intensity" and (has_corner or "position" not in table.values):
        return "'intensity' is for point lights, a rect light has 'radiance'"
    if has_corner:
        return f"'{key}' is for point lights, a rect light has 'corner': leave one of them out"
    change = "change type to" if "type" in table.values else "add type ="
    return f'\'{key}\' is a key of lights of type "point": {change} "point"'


def _hint_for_point(table: _Table, key: str) -> str:
    """What to do about a key of rect lights in a point light."""
    if key in ("samples", "sets", "pattern"):
        return f"a point light has one sample: leave '{key}' out"
    if key == "radiance":
        return "'radiance' is for rect lights, a point light has 'intensity'"
    if key == "two_sided":
        return "a point light shines all round: leave 'two_sided' out"
    if "position" in table.values:
        return f"'{key}' is for rect lights, a point light has 'position': leave one of them out"
    return f"'{key}' is a key of lights of type \"rect\": change type to \"rect\", or give 'position' instead"


def _light(table: _Table) -> Light:
    name = table.needed("name", _LIGHT_NAME)
    if _light_type(table) == "point":
        position = table.needed("position", _VECTOR)
        strength = table.given({"intensity": _NUMBER})
        return table.build(lambda: PointLight(position, name=name, **strength))
    corner, edge_u, edge_v = (table.needed(key, _VECTOR) for key in ("corner", "edge_u", "edge_v"))
    given = table.given(
        {"samples": _COUNT, "sets": _COUNT, "pattern": _PATTERN, "radiance": _NUMBER, "two_sided": _SWITCH}
    )
    return table.build(lambda: RectLight(corner, edge_u, edge_v, name=name, **given))


def _read_text(path: Path) -> str:
    try:
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: not a scene file: byte {error.start} is not UTF-8 text") from None
    except OSError as error:
        raise SceneError(f"cannot read the scene file {path}: {error.strerror}") from None


def _entries(root: _Table) -> dict[str, list[dict[str, Any]]]:
    """The tables of each kind: one camera, and at least one mesh and one light."""
    found: dict[str, list[dict[str, Any]]] = {}
    for kind in TABLE_KEYS:
        header = f"[{kind}]" if kind == "camera" else f"[[{kind}]]"
        value = root.values.get(kind)
        entries = [value] if kind == "camera" else value
        if value is None or value == []:
            root.refuse(
                f"there is no {header}: a scene needs a camera, at least one mesh and at least one light"
            )
        if not (isinstance(entries, list) and all(isinstance(entry, dict) for entry in entries)):
            root.refuse(
                f"'{kind}' must be a table: write {header} on a line of its own, its keys below", kind
            )
        found[kind] = entries
    return found


def _key_lines(text: str) -> dict[tuple[str, int], dict[str, int]]:
    """Line of each key, by (table, its number); the key "" is the table's own header.

    A look at the text and no parser: it is only asked about files that are valid TOML, and a key
    that is written in another way (an inline table) is reported without its line.
    """
    lines: dict[tuple[str, int], dict[str, int]] = {}
    current, seen = lines.setdefault(("", 0), {}), dict.fromkeys(TABLE_KEYS, 0)
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            kind = header[1]
            lines[("", 0)].setdefault(kind, number)
            current = lines.setdefault((kind, seen.get(kind, 0)), {"": number})
            seen[kind] = seen.get(kind, 0) + 1
        elif key := _KEY.match(line):
            current.setdefault(key[1], number)
    return lines


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip())


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: Any) -> bool:
    # A TOML integer may be too large for any float.
    return (_is_whole(value) and abs(value) <= sys.float_info.max) or (
        isinstance(value, float) and math.isfinite(value)
    )


def _list_of(count: int, accepts: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list) and len(value) == count and all(map(accepts, value))


class _Kind(NamedTuple):
    """What values a key takes, as a check and in words."""

    accepts: Callable[[Any], bool]
    wanted: str


_FILE_NAME = _Kind(_is_text, "the name of a mesh file or blocker store")
_UP_AXIS = _Kind(lambda value: value in ("y", "z"), '"y" or "z"')
_MATRIX = _Kind(_list_of(16, _is_number), "16 finite numbers, row by row")
_VECTOR = _Kind(_list_of(3, _is_number), "three finite numbers")
_DEGREES = _Kind(_is_number, "a number of degrees between 0 and 180")
_PIXELS = _Kind(_list_of(2, _is_whole), "two whole numbers, width and height in pixels")
_LIGHT_NAME = _Kind(_is_text, "a text, unique and without a dot")
_LIGHT_TYPE = _Kind(lambda value: value in tuple(LIGHT_KEYS), '"rect" or "point"')
_PATTERN = _Kind(lambda value: value in PATTERNS, '"jittered" or "regular"')
_COUNT = _Kind(_is_whole, "a whole number above 0")
_NUMBER = _Kind(_is_number, "a finite number")
_SWITCH = _Kind(lambda value: isinstance(value, bool), "true or false")
