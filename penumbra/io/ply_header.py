"""The header of a PLY file: which elements come in which order, and how their values are stored."""

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from penumbra.errors import MeshError
from penumbra.io.faces import no_faces

_LONGEST_HEADER_BYTES = 1 << 20

# Names of the original format and the newer ones that say the number of bits.
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8",
    "float": "f4", "double": "f8", "float32": "f4", "float64": "f8",
}  # fmt: skip

_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}

_INDEX_LISTS = ("vertex_indices", "vertex_index")
_FACE_ELEMENTS = ("face", "tristrips")


class Truncated(MeshError):
    """The file ends too early: `n_missing` elements of the one being read are not there."""

    def __init__(self, message: str, n_missing: int) -> None:
        super().__init__(message)
        self.n_missing = n_missing


@dataclass(frozen=True)
class Property:
    """One property; `count_type` is None for a single value, else the type of the list's length."""

    name: str
    value_type: np.dtype
    count_type: np.dtype | None = None


@dataclass(frozen=True)
class Element:
    """One element: `count` records with the same properties."""

    name: str
    count: int
    properties: list[Property] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        """Whether the records differ in size."""
        return any(p.count_type is not None for p in self.properties)

    def position_of(self, *names: str) -> int:
        """Number of the first property with one of these names, -1 if there is none."""
        return next((i for i, p in enumerate(self.properties) if p.name in names), -1)


@dataclass(frozen=True)
class Header:
    """A checked header: it has usable vertices and faces with vertex indices, maybe none of them."""

    byte_order: str  # "<", ">", or "" for ascii
    elements: list[Element]
    data_offset: int
    n_lines: int

    @property
    def vertex_position(self) -> int:
        """Number of the vertex element."""
        return next(i for i, e in enumerate(self.elements) if e.name == "vertex")

    @property
    def face_positions(self) -> list[int]:
        """Numbers of the elements that hold faces."""
        return [i for i, e in enumerate(self.elements) if e.name in _FACE_ELEMENTS and e.count]

    @property
    def has_float32_vertices(self) -> bool:
        """Whether every value that the coordinates' types can hold is a float32."""
        vertex = self.elements[self.vertex_position]
        types = [p.value_type for p in vertex.properties if p.name in ("x", "y", "z")]
        return all(np.can_cast(t, np.float32, "safe") for t in types)


def index_list(element: Element) -> int:
    """Number of the property of a face or strip element that lists its vertices."""
    return element.position_of(*_INDEX_LISTS)


def read_header(path: Path) -> Header:
    """Read and check the header; raises MeshError with the line of the fault, OSError."""
    lines, data_offset = _header_lines(path)
    byte_order = None
    elements: list[Element] = []
    for number, line in enumerate(lines[1:], start=2):
        words = line.split()
        keyword = words[0] if words else "comment"
        if keyword == "format" and len(words) >= 2 and words[1] in _FORMATS:
            byte_order = _FORMATS[words[1]]
        elif keyword == "element" and len(words) == 3 and words[2].isdecimal():
            elements.append(Element(words[1], int(words[2])))
        elif keyword == "property" and elements and (found := _parse_property(words)):
            elements[-1].properties.append(found)
        elif keyword not in ("comment", "obj_info"):
            raise MeshError(f"{path}, line {number}: {line.strip()[:60]!r} is not a line of a PLY header.")
    if byte_order is None:
        raise MeshError(f"{path}: the PLY header has no format line.")
    header = Header(byte_order, elements, data_offset, len(lines) + 1)
    _check_elements(path, header)
    return header


def _parse_property(words: list[str]) -> Property | None:
    if len(words) == 3 and words[1] in _TYPES:
        return Property(words[2], np.dtype(_TYPES[words[1]]))
    if len(words) == 5 and words[1] == "list" and words[2] in _TYPES and words[3] in _TYPES:
        return Property(words[4], np.dtype(_TYPES[words[3]]), np.dtype(_TYPES[words[2]]))
    return None


def _header_lines(path: Path) -> tuple[list[str], int]:
    """Lines before end_header, and the offset of the first byte of data."""
    with open(path, "rb") as file:
        head = file.read(_LONGEST_HEADER_BYTES)
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", head)
    if first is None:
        raise MeshError(f"{path}: this is not a PLY file, its first line is not 'ply'.")
    # In a header with CR LF the data begins behind the LF, so such lines are split at LF and stripped.
    newline = b"\r" if first[1] == b"\r" else b"\n"
    lines: list[str] = []
    begin = 0
    while begin < len(head):
        end = head.find(newline, begin)
        end = len(head) if end < 0 else end
        line = head[begin:end].decode("latin-1").strip()
        begin = end + 1
        if line == "end_header":
            return lines, min(begin, len(head))
        lines.append(line)
    raise MeshError(
        f"{path}: the PLY header has no end_header line, so the file is cut off or not a PLY file."
    )


def _check_elements(path: Path, header: Header) -> None:
    vertices = [e for e in header.elements if e.name == "vertex"]
    if not vertices:
        raise MeshError(f"{path}: the PLY header has no element 'vertex'.")
    for axis in "xyz":
        position = vertices[0].position_of(axis)
        if position < 0 or vertices[0].properties[position].count_type is not None:
            raise MeshError(f"{path}: the PLY header has no number '{axis}' for its vertices.")
    for position in header.face_positions:
        element = header.elements[position]
        found = index_list(element)
        if found < 0 or element.properties[found].count_type is None:
            raise MeshError(
                f"{path}: the PLY element '{element.name}' has no list 'vertex_indices' or 'vertex_index'."
            )
    if not header.face_positions:
        raise MeshError(f"{path}: {no_faces(vertices[0].count)}.")


def least_bytes(element: Element, is_text: bool) -> int:
    """Size that the element has at least: every list empty, every ascii value one digit and a blank."""
    if is_text:
        return 2 * element.count * len(element.properties)
    return element.count * sum((p.count_type or p.value_type).itemsize for p in element.properties)


def triangles_by_size(header: Header, size_bytes: int) -> int | None:
    """Number of triangles of a binary file, if its size tells that every face is one.

    With n faces of at least three corners, the lists hold 3 n indices only if each face is a triangle.
    """
    rest_bytes = size_bytes - header.data_offset
    n_triangles = 0
    for element in header.elements:
        n_lists = sum(p.count_type is not None for p in element.properties)
        if n_lists > 1 or (n_lists and element.name != "face"):
            return None
        n_triangles += element.count * n_lists
        for stored in element.properties:
            list_bytes = (
                stored.count_type.itemsize + 2 * stored.value_type.itemsize if stored.count_type else 0
            )
            rest_bytes -= element.count * (stored.value_type.itemsize + list_bytes)
    return n_triangles if header.byte_order and rest_bytes == 0 else None
