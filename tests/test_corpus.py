"""Odd and broken files from the tests of other projects: read as expected, or refused in one sentence."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mesh_files import parse_obj_by_hand, read_all, same_bits
from paths import corpus_files

from penumbra.errors import MeshError
from penumbra.io.meshes import open_mesh

HERE = Path(__file__).resolve().parent

# name: {"triangles": n} or {"refused": part of the message}; "skip_bad": what is read all the same;
# "note": why that is not what counting the face lines would give.
EXPECTED = json.loads((HERE / "corpus_expected.json").read_text())

FILES = corpus_files()


def outcome(path: Path, **options: object) -> dict[str, object] | str:
    """What a file gives: counts, or the sentence of the refusal without the path."""
    try:
        with open_mesh(path, **options) as reader:
            triangles = [batch.vertices for batch in reader.batches(1000)]
            assert all(np.isfinite(t).all() for t in triangles)
            counts = {"triangles": sum(map(len, triangles))}
            if reader.n_bad_faces:
                counts |= {"dropped": reader.n_bad, "dropped_faces": reader.n_bad_faces}
            assert counts["triangles"] + reader.n_bad == reader.n_triangles
            return counts
    except MeshError as error:
        message = str(error)
        assert message.startswith(str(path)) and message.endswith(".") and "\n" not in message
        return message.removeprefix(str(path)).lstrip(":, ")


@pytest.mark.skipif(not FILES, reason="the corpus is not on this machine")
def test_the_table_is_complete() -> None:
    assert {path.name for path in FILES} == set(EXPECTED)


def test_the_documentation_has_the_same_table() -> None:
    page = (HERE.parent / "docs" / "mesh-files.md").read_text()
    rows = re.findall(r"^\| `(.*?)` \| (.*?) \|", page, re.MULTILINE)
    assert dict(rows) == {name: str(e.get("refused", e.get("triangles"))) for name, e in EXPECTED.items()}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_file_is_read_or_refused_as_expected(path: Path) -> None:
    expected = EXPECTED[path.name]
    strict = outcome(path)
    assert strict == outcome(path, block_bytes=61, memory_bytes=1000)
    lenient = outcome(path, skip_bad=True)
    if "refused" not in expected:
        assert strict == lenient == {"triangles": expected["triangles"]}
        return
    assert isinstance(strict, str) and expected["refused"] in strict
    if "skip_bad" in expected:
        assert lenient == expected["skip_bad"]
    else:
        assert isinstance(lenient, str)


SPECIAL = {"assimp__number_formats.obj"}  # numbers that Python does not read
READABLE = [path for path in FILES if "triangles" in EXPECTED[path.name] and path.name not in SPECIAL]


@pytest.mark.parametrize("path", [p for p in READABLE if p.suffix == ".obj"], ids=lambda path: path.name)
def test_obj_triangles_are_those_of_plain_python(path: Path) -> None:
    assert same_bits(read_all(path)[0], parse_obj_by_hand(path))


@pytest.mark.parametrize("path", [p for p in READABLE if p.suffix == ".ply"], ids=lambda path: path.name)
def test_ply_triangles_are_those_of_trimesh(path: Path) -> None:
    triangles, _ = read_all(path)
    other = trimesh.load_mesh(path, process=False).triangles
    # trimesh cuts polygons in its own way and puts quads behind triangles: what is left is the same area.
    assert len(triangles) == len(other)
    if not np.array_equal(triangles, other.astype(triangles.dtype)):
        assert np.isclose(areas(triangles).sum(), areas(other).sum(), rtol=1e-6)
        assert np.allclose(bounds(triangles), bounds(other))


def areas(triangles: np.ndarray) -> np.ndarray:
    """Area of each triangle."""
    triangles = triangles.astype(np.float64)
    edges = triangles[:, 1:] - triangles[:, :1]
    return np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2


def bounds(triangles: np.ndarray) -> np.ndarray:
    """Lower and upper corner."""
    corners = triangles.reshape(-1, 3)
    return np.stack([corners.min(axis=0), corners.max(axis=0)])
