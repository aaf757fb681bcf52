"""The PLY reader against plain Python: every layout of the same mesh, strips, and what is wrong in a file."""

import struct
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mesh_files import fan_by_hand, read_all, same_bits

from penumbra.errors import MeshError
from penumbra.io.meshes import open_mesh

BLOCKS = (1, 2, 13, 64, 1 << 20)
FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")

# struct code: the two names of the type.
TYPES = {
    "b": ("char", "int8"), "B": ("uchar", "uint8"), "h": ("short", "int16"), "H": ("ushort", "uint16"),
    "i": ("int", "int32"), "I": ("uint", "uint32"), "f": ("float", "float32"), "d": ("double", "float64"),
}  # fmt: skip


class Column(NamedTuple):
    """A property: name, value type, type of the list's length or "", and the value of each element."""

    name: str
    code: str
    count_code: str
    values: list


class Element(NamedTuple):
    name: str
    count: int
    columns: list[Column]


class Ply:
    """A PLY file in the making; `pack` writes one number in the file's format."""

    def __init__(
        self, kind: str, elements: list[Element], newline: str = "\n", new_names: bool = False
    ) -> None:
        self.kind = kind
        self.order = ">" if kind == "binary_big_endian" else "<"
        self.elements = elements
        self.newline = newline
        self.names = {code: names[new_names] for code, names in TYPES.items()}

    def header(self) -> bytes:
        lines = ["ply", f"format {self.kind} 1.0", "comment element face 99", "obj_info nothing"]
        for element in self.elements:
            lines.append(f"element {element.name}  {element.count} ")
            for column in element.columns:
                count = f"list {self.names[column.count_code]} " if column.count_code else ""
                lines.append(f"property {count}{self.names[column.code]} {column.name}")
        return self.newline.join([*lines, "end_header", ""]).encode()

    def pack(self, code: str, value: float) -> bytes:
        if self.kind == "ascii":
            return (repr(float(value)) if code in "fd" else str(int(value))).encode() + b" "
        return struct.pack(self.order + code, value if code in "fd" else int(value))

    def rows(self) -> Iterable[bytes]:
        for element in self.elements:
            for row in range(element.count):
                data = []
                for column in element.columns:
                    value = column.values[row]
                    if column.count_code:
                        data.append(self.pack(column.count_code, len(value)))
                    data += [self.pack(column.code, one) for one in (value if column.count_code else [value])]
                yield b"".join(data) + (self.newline.encode() if self.kind == "ascii" else b"")

    def write(self, path: Path) -> Path:
        path.write_bytes(self.header() + b"".join(self.rows()))
        return path


def vertex_element(vertices: list, codes: str = "fff", extra: tuple[Column, ...] = ()) -> Element:
    axes = [
        Column(a, c, "", [v[k] for v in vertices]) for k, (a, c) in enumerate(zip("xyz", codes, strict=True))
    ]
    return Element("vertex", len(vertices), [*extra[:1], *axes, *extra[1:]])


def face_element(
    faces: list, code: str = "i", count_code: str = "B", extra: tuple[Column, ...] = ()
) -> Element:
    return Element(
        "face", len(faces), [*extra[:1], Column("vertex_indices", code, count_code, faces), *extra[1:]]
    )


CORNERS = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


@st.composite
def extras(draw: st.DrawFn, n: int) -> tuple[Column, ...]:
    """Up to two properties that nobody asked for, one of them perhaps a list."""
    columns = []
    for name in draw(st.sampled_from([(), ("red",), ("quality", "texcoord")])):
        code = draw(st.sampled_from(list(TYPES)))
        if draw(st.booleans()):
            columns.append(Column(name, code, "", [draw(st.integers(0, 100)) for _ in range(n)]))
        else:
            lists = [draw(st.lists(st.integers(0, 100), max_size=4)) for _ in range(n)]
            columns.append(Column(name, code, draw(st.sampled_from(list(TYPES))), lists))
    return tuple(columns)


@st.composite
def plys(draw: st.DrawFn) -> tuple[Ply, np.ndarray, bool]:
    """A PLY file, its triangles, and whether its coordinates are promised to be float32."""
    codes = draw(st.sampled_from(["fff", "ddd", "fdf", "bhB", "iii", "IHf"]))
    ranges = {"b": (-128, 127), "B": (0, 255), "h": (-(2**15), 2**15 - 1), "H": (0, 2**16 - 1)}
    ranges |= {"i": (-(2**31), 2**31 - 1), "I": (0, 2**32 - 1)}
    widths = {"f": 32, "d": 64}
    finite = {"allow_nan": False, "allow_infinity": False}
    axes = [
        st.floats(width=widths[c], **finite) if c in widths else st.integers(*ranges[c]).map(float)
        for c in codes
    ]
    vertices = draw(st.lists(st.tuples(*axes), min_size=1, max_size=8))
    n_corners = draw(st.sampled_from([(3, 3), (4, 4), (3, 6)]))
    index = st.integers(0, len(vertices) - 1)
    faces = draw(
        st.lists(st.lists(index, min_size=n_corners[0], max_size=n_corners[1]), min_size=1, max_size=6)
    )
    others = draw(st.lists(st.integers(0, 100), max_size=3))
    elements = [
        vertex_element(vertices, codes, draw(extras(len(vertices)))),
        face_element(faces, draw(st.sampled_from(list(TYPES))), draw(st.sampled_from(list(TYPES))),
                     draw(extras(len(faces)))),
        Element("edge", len(others), [Column("vertex1", "i", "", others)]),
        Element("material", 1, [Column("name", "B", "I", [[65, 66]]), Column("shine", "d", "", [0.5])]),
    ]  # fmt: skip
    if draw(st.booleans()):
        elements[1] = elements[1]._replace(columns=[c._replace(name=c.name.replace("indices", "index"))
                                                    for c in elements[1].columns])  # fmt: skip
    newline = draw(st.sampled_from(["\n", "\r\n", "\r"]))
    ply = Ply(draw(st.sampled_from(FORMATS)), draw(st.permutations(elements)), newline, draw(st.booleans()))
    return ply, fan_by_hand(vertices, faces), set(codes) <= set("fbBhH")


@settings(max_examples=200)
@given(plys(), st.sampled_from(BLOCKS), st.sampled_from([1, 2, 1000]), st.sampled_from([1, 1 << 20]))
def test_every_layout_gives_the_same_mesh(
    tmp_path_factory: pytest.TempPathFactory,
    mesh: tuple[Ply, np.ndarray, bool],
    block_bytes: int,
    max_triangles: int,
    memory_bytes: int,
) -> None:
    ply, expected, is_float32 = mesh
    path = ply.write(tmp_path_factory.mktemp("ply") / "mesh.PLY")
    with open_mesh(path) as reader:
        assert reader.exact_float32 == is_float32
        assert reader.n_triangles in (None, len(expected))
    triangles, ids = read_all(path, max_triangles, block_bytes=block_bytes, memory_bytes=memory_bytes)
    assert same_bits(triangles, expected.astype(np.float32 if is_float32 else np.float64))
    assert ids.tolist() == list(range(len(expected)))


def strip_by_hand(entries: list[int]) -> list[list[int]]:
    """Triangles of one list of entries, the definition written out."""
    faces = []
    strip: list[int] = []
    for entry in entries:
        strip = [] if entry == -1 else [*strip, entry]
        if len(strip) >= 3:
            a, b, c = strip[-3:]
            faces.append([a, b, c] if len(strip) % 2 else [b, a, c])
    return faces


@settings(max_examples=100)
@given(
    st.lists(st.lists(st.integers(-1, 3), max_size=40), min_size=1, max_size=4),
    st.sampled_from(FORMATS),
    st.sampled_from(["i", "h", "f"]),
    st.sampled_from(BLOCKS),
)
def test_strips(
    tmp_path_factory: pytest.TempPathFactory, lists: list[list[int]], kind: str, code: str, block_bytes: int
) -> None:
    extra = Column("length", "h", "", [len(one) for one in lists])
    strips = Element("tristrips", len(lists), [extra, Column("vertex_indices", code, "i", lists)])
    elements = [vertex_element(CORNERS), strips, face_element([[3, 2, 1]])]
    path = Ply(kind, elements).write(tmp_path_factory.mktemp("ply") / "strips.ply")
    triangles, _ = read_all(path, block_bytes=block_bytes)
    faces = [face for one in lists for face in strip_by_hand(one)]
    assert same_bits(triangles, fan_by_hand(CORNERS, [*faces, [3, 2, 1]]).astype(np.float32))


@pytest.mark.parametrize("kind", FORMATS)
def test_a_strip_longer_than_any_block(tmp_path: Path, kind: str, rng: np.random.Generator) -> None:
    entries = rng.integers(-1, 4, 100_000).tolist()
    elements = [
        Element("tristrips", 1, [Column("vertex_indices", "i", "i", [entries])]),
        vertex_element(CORNERS),
    ]
    triangles, _ = read_all(Ply(kind, elements).write(tmp_path / "strip.ply"), block_bytes=1 << 14)
    assert same_bits(triangles, fan_by_hand(CORNERS, strip_by_hand(entries)).astype(np.float32))


@pytest.mark.parametrize("kind", FORMATS)
def test_a_polygon_longer_than_any_block(tmp_path: Path, kind: str, rng: np.random.Generator) -> None:
    face = rng.integers(0, 4, 100_000).tolist()
    path = Ply(kind, [vertex_element(CORNERS), face_element([face], count_code="I")]).write(
        tmp_path / "a.ply"
    )
    triangles, _ = read_all(path, block_bytes=1 << 14)
    assert same_bits(triangles, fan_by_hand(CORNERS, [face]).astype(np.float32))


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("first", ["vertex", "face"])
def test_a_file_cut_off_anywhere_is_refused(tmp_path: Path, kind: str, first: str) -> None:
    elements = [vertex_element(CORNERS), face_element([[0, 1, 2], [2, 1, 3], [0, 1, 2, 3]])]
    ply = Ply(kind, elements if first == "vertex" else elements[::-1])
    whole = ply.header() + b"".join(ply.rows())
    path = tmp_path / "cut.ply"
    # An ascii file may lose its last blank and newline, and a last vertex the zero behind its point too.
    n_harmless = 0 if kind != "ascii" else 2 if first == "vertex" else 4
    for n_bytes in range(1, len(whole) - n_harmless):
        path.write_bytes(whole[:n_bytes])
        with pytest.raises(MeshError, match="cut.ply"):
            read_all(path)
        try:
            triangles, _ = read_all(path, skip_bad=True)
        except MeshError as error:
            assert str(error).startswith(str(path))
        else:
            assert 1 <= len(triangles) <= 3
    path.write_bytes(whole[: n_bytes + 1])
    assert len(read_all(path)[0]) == 4


def test_skip_bad_counts_what_a_cut_off_file_has_lost(tmp_path: Path) -> None:
    ply = Ply("binary_little_endian", [vertex_element(CORNERS), face_element([[0, 1, 2]] * 10)])
    path = tmp_path / "cut.ply"
    path.write_bytes((ply.header() + b"".join(ply.rows()))[:-20])
    with open_mesh(path, skip_bad=True) as reader:
        assert sum(len(b.ids) for b in reader.batches()) == 8
        assert (reader.n_bad, reader.n_bad_faces) == (2, 2)


@pytest.mark.parametrize("kind", FORMATS)
def test_damaged_files_never_end_in_a_traceback(tmp_path: Path, kind: str, rng: np.random.Generator) -> None:
    strips = Element("tristrips", 1, [Column("vertex_indices", "i", "i", [[0, 1, 2, -1, 1, 2, 3, 0]])])
    scattered = vertex_element(CORNERS, extra=(Column("more", "f", "B", [[1], [], [2, 3], [4]]),))
    for elements in (
        [vertex_element(CORNERS), face_element([[0, 1, 2], [2, 1, 3]])],
        [vertex_element(CORNERS), face_element([[0, 1, 2], [2, 1, 3, 0]], "f", "f")],
        [face_element([[0, 1, 2, 3]]), strips, scattered],
    ):
        ply = Ply(kind, elements)
        whole = np.frombuffer(ply.header() + b"".join(ply.rows()), np.uint8)
        start = len(ply.header()) if kind != "ascii" else 0
        for _ in range(150):
            damaged = whole.copy()
            where = rng.integers(rng.choice([0, start]), len(whole), rng.integers(1, 5))
            damaged[where] = rng.integers(0, 256, len(where))
            path = tmp_path / "damaged.ply"
            path.write_bytes(damaged.tobytes())
            for skip_bad in (False, True):
                try:
                    read_all(path, skip_bad=skip_bad)
                except MeshError as error:
                    assert str(error).startswith(str(path)) and "\n" not in str(error)


HEAD = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
FACES = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
POINTS = "0 0 0\n1 0 0\n0 1 0\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("OFF\n", ": this is not a PLY file, its first line is not 'ply'."),
        ("ply", ": this is not a PLY file"),
        (HEAD, ": the PLY header has no end_header line, so the file is cut off or not a PLY file."),
        (HEAD.replace("float z", "half z") + FACES, ", line 6: 'property half z' is not a line of a"),
        (HEAD.replace("vertex 3", "vertex -3") + FACES, ", line 3: 'element vertex -3' is not a line of"),
        (HEAD.replace("vertex 3", "vertex 3x") + FACES, ", line 3: 'element vertex 3x' is not a line of"),
        (HEAD.replace("ascii", "binary") + FACES, ", line 2: 'format binary 1.0' is not a line of"),
        (HEAD.replace("format ascii 1.0\n", "") + FACES, ": the PLY header has no format line."),
        (HEAD.replace("float z", "float w") + FACES, ": the PLY header has no number 'z' for its vertices."),
        (HEAD.replace("float z", "list int float z") + FACES, ": the PLY header has no number 'z'"),
        (HEAD.replace("vertex", "vertices") + FACES, ": the PLY header has no element 'vertex'."),
        (HEAD + FACES.replace("vertex_indices", "corners"), "'face' has no list 'vertex_indices' or"),
        (HEAD + "end_header\n" + POINTS, ": it has no faces, only points (3), so nothing in it"),
        (HEAD + FACES.replace("face 1", "face 0") + POINTS, ": it has no faces"),
        (HEAD + FACES.replace("face 1", "face 0"), ": it has no faces"),
        (HEAD + FACES + POINTS, "promises 3 vertex, 1 face, at least 20 bytes, but only 18 bytes follow it;"),
        (HEAD.replace("3", "99999999999999") + FACES + POINTS, "the file is cut off or its header is wrong."),
        (HEAD + FACES + POINTS + "3 0 1\n", ", line 13: the file ends after 0 of the 1 'face' elements"),
        (HEAD + FACES + POINTS + "3 0 1 3\n", ", line 13: a face uses vertex 3, but the file has only 3."),
        (HEAD + FACES + POINTS + "3 0 1 -1\n", ", line 13: a face uses vertex -1, but the file has only 3."),
        (HEAD + FACES + POINTS + "3 0 1 1.5\n", ", line 13: a vertex index is not a whole number."),
        (HEAD + FACES + POINTS + "2 0 1 2\n", ", line 13: a face has 2 indices, but three are needed."),
        (HEAD + FACES + POINTS + "-3 0 1 2\n", ", line 13: the length of a list of a 'face' element is not"),
        (HEAD + FACES + POINTS + "x 0 1 2\n", ", line 13: the length of a list of a 'face' element is not"),
        (HEAD + FACES + POINTS.replace("1 0 0", "nan 0 0") + "3 0 1 2\n", ", line 13: a face uses"),
        (HEAD + FACES + POINTS.replace("1 0 0", "1e39 0 0") + "3 0 1 2\n", "that is not a finite number."),
        (HEAD + FACES + POINTS + "2000000 " + "0 " * 2000000, ", line 13: a face has more than 1048576"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "wrong.ply"
    path.write_text(text)
    with pytest.raises(MeshError) as caught:
        read_all(path)
    assert str(caught.value).startswith(str(path)) and message in str(caught.value)


@pytest.mark.parametrize(
    ("element", "message"),
    [
        (face_element([[0, 1, 2], [0, 1, 4]]), ", face 1 (counted from 0): a face uses vertex 4, but"),
        (face_element([[0, 1, 2], [0, 1, -1]]), ", face 1 (counted from 0): a face uses vertex -1, but"),
        (face_element([[0, 1, 2], [0, 1, 2, 9]]), ", face 1 (counted from 0): a face uses vertex 9, but"),
        (face_element([[0, 1, 2], [0, 1]]), ", face 1 (counted from 0): a face has 2 indices, but"),
        (face_element([[0, 1, 2], [0, 1, 1.5]], "f"), ", face 1 (counted from 0): a vertex index is"),
        (face_element([[0, 1, 2], [0, 1, 2, np.nan]], "d"), ", face 1 (counted from 0): a vertex index"),
        (Element("tristrips", 1, [Column("vertex_indices", "i", "i", [[0, 1, 2, 5]])]), ", strip 0 (counted"),
        (Element("face", 1, [Column("vertex_indices", "i", "", [0])]), "'face' has no list 'vertex_indices'"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("kind", FORMATS[1:])
def test_what_is_wrong_in_a_binary_file(tmp_path: Path, kind: str, element: Element, message: str) -> None:
    path = Ply(kind, [vertex_element(CORNERS), element]).write(tmp_path / "wrong.ply")
    with pytest.raises(MeshError) as caught:
        read_all(path)
    assert message in str(caught.value)


@pytest.mark.parametrize("kind", FORMATS[1:])
def test_vertices_that_are_not_numbers(tmp_path: Path, kind: str) -> None:
    ply = Ply(kind, [vertex_element(CORNERS, "fdf"), face_element([[0, 1, 2], [1, 2, 3]])])
    whole = ply.header() + b"".join(ply.rows())
    z_of_first = len(ply.header()) + 4 + 8
    path = tmp_path / "nan.ply"
    for bits in (0x7F800001, 0x7FC00000, 0xFF800000):  # a signalling NaN, a quiet one, minus infinity
        path.write_bytes(whole[:z_of_first] + struct.pack(ply.order + "I", bits) + whole[z_of_first + 4 :])
        with pytest.raises(MeshError, match=r"face 0 \(counted from 0\): a face uses vertex 0, which"):
            read_all(path)
        triangles, ids = read_all(path, skip_bad=True)
        assert ids.tolist() == [1] and np.isfinite(triangles).all()


@pytest.mark.parametrize("kind", FORMATS[1:])
def test_lists_of_impossible_length(tmp_path: Path, kind: str) -> None:
    ply = Ply(kind, [vertex_element(CORNERS), face_element([[0, 1, 2], [0, 1, 2]], count_code="i")])
    whole = ply.header() + b"".join(ply.rows())
    for length, message in (
        (-1, "is negative, too large or not whole"),
        (2**31 - 1, "the file ends after 1 of"),
    ):
        path = tmp_path / "long.ply"
        path.write_bytes(whole[:-16] + struct.pack(ply.order + "i", length) + whole[-12:])
        with pytest.raises(MeshError, match=message):
            read_all(path)


def test_the_size_of_a_file_of_triangles_tells_their_number(tmp_path: Path) -> None:
    triangles, edges = face_element([[0, 1, 2], [2, 1, 3]]), Element("edge", 1, [Column("a", "i", "", [0])])
    with_quads = face_element([[0, 1, 2], [2, 1, 3, 0]])
    quality = face_element([[0, 1, 2], [2, 1, 3]], "H", "I", (Column("quality", "d", "", [1, 2]),))
    two_lists = face_element([[0, 1, 2], [2, 1, 3]], extra=(Column("uv", "f", "B", [[], []]),))
    for kind, faces, n_triangles in [
        *[(kind, faces, 2) for kind in FORMATS[1:] for faces in (triangles, quality)],
        *[(FORMATS[1], faces, None) for faces in (with_quads, two_lists)],
        ("ascii", triangles, None),
    ]:
        path = Ply(kind, [vertex_element(CORNERS), faces, edges]).write(tmp_path / "a.ply")
        with open_mesh(path) as reader:
            assert reader.n_triangles == n_triangles
        with open_mesh(path, skip_bad=True) as reader:
            assert reader.n_triangles is None


def test_what_follows_the_values_of_an_ascii_line_is_ignored(tmp_path: Path) -> None:
    path = tmp_path / "lines.ply"
    path.write_text(HEAD + FACES + "0 0\n\n0 255 255\n1 0 0 \\\n0 1 0\n\n3 0 1\n2 9 9 9")
    triangles, _ = read_all(path)
    assert triangles.tolist() == [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]
