"""The OBJ reader against plain Python: every way to write the same mesh, and what is wrong in a file."""

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mesh_files import Face, fan_by_hand, read_all, same_bits

from penumbra.errors import MeshError
from penumbra.io.meshes import open_mesh

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
BLOCKS = (1, 2, 3, 7, 64, 1 << 20)


def write(folder: Path, text: str | bytes) -> Path:
    path = folder / "mesh.obj"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def refusal(path: Path, **options: object) -> str:
    with pytest.raises(MeshError) as caught:
        read_all(path, **options)
    message = str(caught.value)
    assert message.startswith(str(path)) and message.endswith(".") and "\n" not in message
    return message.removeprefix(str(path))


class Writer:
    """Writes OBJ text in a style that hypothesis draws, statement by statement."""

    def __init__(self, draw: st.DrawFn) -> None:
        self.draw = draw
        self.newline = draw(st.sampled_from(["\n", "\r\n", "\r"]))
        self.text = ""
        self.n_vertices = 0

    def pick(self, *choices: str) -> str:
        return self.draw(st.sampled_from(choices))

    def blank(self) -> str:
        return self.pick(" ", "  ", "\t", " \t ", f" \\{self.newline}", f"\\{self.newline} ")

    def statement(self, words: list[str]) -> None:
        # Glued together by blanks, `\` continuation among them; a comment may follow the last word.
        line = self.pick("", "", " ", "\t") + words[0]
        for word in words[1:]:
            line += self.blank() + word
        self.text += line + self.pick("", "", " ", " # f 1 1 1", "\t") + self.newline

    def noise(self) -> None:
        self.text += self.pick(
            "", "", "# comment f 1 2 3", " # v 9 9 9", "vn 0 1 0", "vt 0.5 0.5", "g a f 1 2",
            "usemtl C:\\v\\f",
            "s off", "l 1 2", "p 1", "o v", "mtllib f.mtl", "", "vp 1 2", "fx 1 2 3", "#\u00e9t\u00e9",
        ) + self.newline  # fmt: skip

    def number(self, value: float) -> str:
        exact = self.pick("repr", "17g", "17e", "upper", "plus", "zeros", "hex")
        if exact == "repr":
            return repr(value)
        if exact == "hex":
            return value.hex()
        if exact == "zeros":
            return repr(value).replace("e", "000e") if "." in repr(value) else repr(value)
        text = f"{value:.17g}" if exact == "17g" else f"{value:.16e}"
        text = text.upper() if exact == "upper" else text
        return f"+{text}" if exact == "plus" and not text.startswith("-") else text

    def vertex(self, position: list[float]) -> None:
        n_words = (
            2 if position[2] == 0 and math.copysign(1, position[2]) > 0 and self.draw(st.booleans()) else 3
        )
        extra = self.pick("", "1", "0.1 0.2 0.3", "nan nan nan", "1 1 1 1", "x y z") if n_words == 3 else ""
        self.statement(["v", *[self.number(c) for c in position[:n_words]], *extra.split()])
        self.n_vertices += 1

    def face(self, face: Face) -> None:
        form = self.pick("{}", "{}/7", "{}//7", "{}/7/7", "{}/", "{}//", "{}/-1/-1")
        negative = max(face) < self.n_vertices and self.draw(st.booleans())
        indices = [i - self.n_vertices if negative else i + 1 for i in face]
        self.statement(
            ["f", *[form.format(f"+{i}" if i > 0 and self.draw(st.booleans()) else i) for i in indices]]
        )

    def finish(self) -> bytes:
        if self.draw(st.booleans()):
            self.text = self.text.rstrip("\r\n")
        encoding = self.pick("utf-8", "utf-8-sig", "latin-1", "utf-16-le", "utf-16-be")
        mark = "\ufeff" if encoding.startswith("utf-16") else ""
        return (mark + self.text).encode(encoding)


@st.composite
def meshes(draw: st.DrawFn) -> tuple[bytes, np.ndarray]:
    """An OBJ file and its triangles."""
    coordinate = st.one_of(
        st.floats(allow_nan=False, allow_infinity=False), st.integers(-9, 9).map(float), st.just(0.1)
    )
    vertices = draw(st.lists(st.lists(coordinate, min_size=3, max_size=3), min_size=1, max_size=8))
    index = st.integers(0, len(vertices) - 1)
    faces = draw(st.lists(st.lists(index, min_size=3, max_size=6), min_size=1, max_size=6))
    writer = Writer(draw)
    # Vertices keep their order, and so do faces, but the two are shuffled into each other.
    kinds = draw(st.permutations(["v"] * len(vertices) + ["f"] * len(faces)))
    left = {"v": iter(vertices), "f": iter(faces)}
    for kind in kinds:
        writer.noise()
        if kind == "v":
            writer.vertex(next(left["v"]))
        else:
            writer.face(next(left["f"]))
    return writer.finish(), fan_by_hand(vertices, faces)


@settings(max_examples=150)
@given(meshes(), st.sampled_from(BLOCKS), st.sampled_from([1, 2, 5, 1000]), st.sampled_from([1, 1 << 20]))
def test_every_style_of_writing_gives_the_same_mesh(
    tmp_path_factory: pytest.TempPathFactory,
    mesh: tuple[bytes, np.ndarray],
    block_bytes: int,
    max_triangles: int,
    memory_bytes: int,
) -> None:
    path = write(tmp_path_factory.mktemp("obj"), mesh[0])
    triangles, ids = read_all(path, max_triangles, block_bytes=block_bytes, memory_bytes=memory_bytes)
    assert same_bits(triangles, mesh[1])
    assert ids.tolist() == list(range(len(mesh[1])))


def decimal_of(value: Fraction, n_digits: int) -> str:
    """`value` cut off after `n_digits` significant digits, in exponent form."""
    exponent = math.floor(math.log10(value)) + 1 - n_digits
    return f"{int(value / Fraction(10) ** exponent)}e{exponent}"


def hard_numbers(rng: np.random.Generator) -> list[str]:
    """Decimals of every length, many of them just beside, or exactly on, the middle of two float64."""
    words = []
    for _ in range(1500):
        value = float(rng.uniform(0.5, 1.0) * 2.0 ** rng.integers(-60, 60))
        middle = (Fraction(value) + Fraction(math.nextafter(value, math.inf))) / 2
        n_digits = int(rng.integers(15, 40))
        words += [decimal_of(middle, n_digits), decimal_of(middle + Fraction(value) / 10**30, n_digits)]
        words += [f"{value:.{n_digits}g}", f"{value:.17g}", f"{value:.6f}"]
        digits = "".join(map(str, rng.integers(0, 10, int(rng.integers(1, 30)))))
        point = int(rng.integers(0, len(digits) + 1))
        words.append(f"{digits[:point]}.{digits[point:]}e{rng.integers(-340, 320)}")
        words.append(f"{digits[:point]}.{digits[point:]}")
    # Integers whose float64 neighbours lie 2 apart: odd ones are ties.
    words += [str(2**53 + int(k)) for k in rng.integers(0, 2**53, 2000)]
    return [
        *words,
        "0.1",
        "5e-324",
        "2.47e-324",
        "1.7976931348623157e308",
        "9007199254740993",
        "0" * 400 + "1",
    ]


def test_numbers_are_rounded_to_the_nearest_float64(tmp_path: Path, rng: np.random.Generator) -> None:
    words = [w for w in hard_numbers(rng) if math.isfinite(float(w))]
    words += ["0"] * (-len(words) % 9)
    lines = [f"v {words[i]} -{words[i + 1]} +{words[i + 2]}" for i in range(0, len(words), 3)]
    lines += [f"f {i} {i + 1} {i + 2}" for i in range(1, len(words) // 3, 3)]
    triangles, _ = read_all(write(tmp_path, "\n".join(lines)))
    expected = np.array([float(w) for w in words]).reshape(-1, 3, 3) * [1.0, -1.0, 1.0]
    assert same_bits(triangles, expected)


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("+1e+2", 100.0), ("2.e+1", 20.0), (".5", 0.5), ("-.5", -0.5), ("1E-03", 1e-3), ("1e010", 1e10),
        ("0x1p3", 8.0), ("-0X1.8p1", -3.0), ("0x1F", 31.0), ("1e-400", 0.0), ("-0", -0.0), ("00012", 12.0),
    ],
)  # fmt: skip
def test_numbers_as_c_reads_them(tmp_path: Path, word: str, value: float) -> None:
    triangles, _ = read_all(write(tmp_path, f"v {word} 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3"))
    assert same_bits(triangles[0, 0, :1], np.array([value]))


@pytest.mark.parametrize(
    "word",
    [
        "nan",
        "-NaN",
        "inf",
        "-Infinity",
        "1e999",
        "1.#IND",
        "1.#INF",
        "3.1+e2",
        "1,5",
        "1_0",
        "e5",
        "+",
        ".",
        "x",
    ]
    + ["0x", "0xg", "--1", "1e", "1e+", "1.2.3", "\u0661"],
)
def test_a_coordinate_that_is_no_finite_number_matters_once_a_face_uses_it(tmp_path: Path, word: str) -> None:
    text = f"{TRIANGLE}v 0 {word} 0\nf 1 2 3\n"
    triangles, _ = read_all(write(tmp_path, text))
    assert len(triangles) == 1
    path = write(tmp_path, text + "f 1 2 4\nf 3 2 1\n")
    assert (
        refusal(path) == ", line 6: a face uses vertex 4, which has a coordinate that is not a finite number."
    )
    triangles, ids = read_all(path, skip_bad=True)
    assert ids.tolist() == [0, 2]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (TRIANGLE + "f 1 2\n", ", line 4: a face has 2 indices, but three are needed."),
        (TRIANGLE + "f\n", ", line 4: a face has 0 indices, but three are needed."),
        (TRIANGLE + "f 1 2 4\n", ", line 4: a face uses vertex 4, but the file has only 3."),
        (TRIANGLE + "f 99999999999999999999 2 3\n", "but the file has only 3."),
        (TRIANGLE + "\r\r\nf 0 2 3\n", ", line 6: a face uses vertex 0, but vertices are counted from 1."),
        (TRIANGLE + "f 1 2 -4\n", "a face uses a relative index that reaches back before the first vertex."),
        ("f -1 -2 -3\n" + TRIANGLE, ", line 1: a face uses a relative index that reaches back"),
        (TRIANGLE + "f 1 2 x\n", ", line 4: a vertex index is not a whole number."),
        (TRIANGLE + "f 1 2 3.0\n", ", line 4: a vertex index is not a whole number."),
        (TRIANGLE + "f 1 2 /1/1\n", ", line 4: a vertex index is not a whole number."),
        (TRIANGLE + "f 1 \\\n 2 \\\r\n 9\n", ", line 4: a face uses vertex 9"),
        ("# \\\n" + TRIANGLE + "f 1 2 4", ", line 5: a face uses vertex 4, but the file has only 3."),
        (("\ufeff" + TRIANGLE + "f 1 2 3\u03a9").encode("utf-16-le"), ", line 4: a vertex index is not"),
        (TRIANGLE + "v 1\nf 1 2 3\n", ", line 4: a vertex has fewer than two numbers."),
        (TRIANGLE + "f 1 2 3\nv", ", line 5: a vertex has fewer than two numbers."),
        (TRIANGLE, ": it has no faces, only points (3), so nothing in it can cast a shadow."),
        (TRIANGLE + "g f 1 2 3\nl 1 2 3\n", ": it has no faces"),
        (b"\x00\x01\xff\xfe" * 99, ": it has no faces"),
        ("v 1 2 " + "3" * (3 << 20), "a word is longer than 1048576 bytes, so this is not a mesh"),
        (TRIANGLE + "f" + " 1" * ((1 << 20) + 1), ", line 4: a face has more than 1048576 corners."),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_with_its_line(tmp_path: Path, text: str | bytes, message: str) -> None:
    assert message in refusal(write(tmp_path, text))


def test_skip_bad_drops_whole_faces_and_keeps_the_ids(tmp_path: Path) -> None:
    text = TRIANGLE + "v 1 1 nan\nv 7\nf 1 2 3 4\nf 1 2\nf 1 2 3\nf 3 2 1 9 1\nf 1 5 2\nf 2 3 1\n"
    path = write(tmp_path, text)
    for block_bytes in BLOCKS:
        with open_mesh(path, skip_bad=True, block_bytes=block_bytes) as reader:
            for _ in range(2):
                ids = np.concatenate([b.ids for b in reader.batches()])
                # Two of the quad, none of the pair, three of the pentagon and one of the short vertex.
                assert ids.tolist() == [2, 7]
                assert (reader.n_bad, reader.n_bad_faces, reader.n_triangles) == (6, 4, 8)
                assert reader.bytes_done == reader.size_bytes
    assert "not one of its 1 faces can be used" in refusal(
        write(tmp_path, TRIANGLE + "f 1 2 9"), skip_bad=True
    )


def test_a_polygon_longer_than_any_buffer(tmp_path: Path, rng: np.random.Generator) -> None:
    vertices = rng.normal(size=(100, 3)).tolist()
    face = rng.integers(0, 100, 300_000).tolist()
    text = (
        "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in vertices) + "f " + " ".join(str(i + 1) for i in face)
    )
    triangles, _ = read_all(write(tmp_path, text), block_bytes=1 << 16)
    assert same_bits(triangles, fan_by_hand(vertices, [face]))


def test_a_file_cut_off_anywhere_is_read_or_refused(tmp_path: Path) -> None:
    whole = (TRIANGLE + "v 0.25 -1e-3 0x1p2 # c\r\nf 1//1 2//1 \\\n -1\nf 1 2 3 4\n").encode()
    for n_bytes in range(1, len(whole)):
        path = write(tmp_path, whole[:n_bytes])
        for skip_bad in (False, True):
            try:
                triangles, _ = read_all(path, skip_bad=skip_bad, block_bytes=16)
            except MeshError as error:
                assert str(error).startswith(str(path))
            else:
                assert 1 <= len(triangles) <= 3


def test_damaged_files_never_end_in_a_traceback(tmp_path: Path, rng: np.random.Generator) -> None:
    whole = np.frombuffer((TRIANGLE * 3 + "f 1 2 3\nf -1/1 -2/2 -3/3\nf 1 2 3 4\n").encode(), np.uint8)
    alphabet = np.frombuffer(b" \t\r\n\\#/-+.0123456789vfxep\x00\xff", np.uint8)
    for _ in range(400):
        damaged = whole.copy()
        where = rng.integers(0, len(whole), rng.integers(1, 6))
        damaged[where] = rng.choice(alphabet, len(where))
        path = write(tmp_path, damaged.tobytes())
        results = []
        for block_bytes in (5, 1 << 20):
            try:
                triangles, ids = read_all(path, skip_bad=True, block_bytes=block_bytes)
                results.append((triangles.tobytes(), ids.tobytes()))
            except MeshError as error:
                results.append(str(error))
        assert results[0] == results[1]
