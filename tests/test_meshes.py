"""What all mesh readers share: opening, other formats, memory that follows the batch and not the file."""

import os
import shutil
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mesh_files import parse_obj_by_hand, read_all, same_bits
from paths import scene_file

from penumbra.errors import MeshError, OutputError
from penumbra.io.meshes import open_mesh
from penumbra.io.vertex_table import VertexTable


def test_a_reader_can_be_run_again_and_stopped_early(square_obj: Path) -> None:
    with open_mesh(square_obj) as reader:
        assert (reader.path, reader.size_bytes) == (square_obj, square_obj.stat().st_size)
        assert (reader.n_triangles, reader.exact_float32, reader.n_bad) == (None, False, 0)
        assert next(reader.batches(1)).ids.tolist() == [0]
        for _ in range(2):
            batches = list(reader.batches(3))
            assert [b.ids.tolist() for b in batches] == [[0, 1, 2], [3]]
            assert reader.n_triangles == 4
            assert reader.bytes_done == reader.size_bytes
    assert batches[0].vertices[0].tolist() == [[-2, 0, -2], [-2, 0, 2], [2, 0, 2]]


@pytest.mark.parametrize("name", ["gone.obj", "gone.ply", "gone.stl"])
def test_a_missing_file(tmp_path: Path, name: str) -> None:
    with pytest.raises(MeshError, match=f"{name}: there is no such file\\."):
        open_mesh(tmp_path / name)


@pytest.mark.parametrize("name", ["empty.obj", "empty.ply", "empty.stl"])
def test_an_empty_file(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(MeshError, match=r"the file is empty \(0 bytes\)\."):
        open_mesh(tmp_path / name)


def test_what_is_not_a_file(tmp_path: Path) -> None:
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(MeshError, match="is a folder, not a mesh file"):
        open_mesh(tmp_path / "folder.obj")
    os.mkfifo(tmp_path / "pipe.ply")
    with pytest.raises(MeshError, match="is not a regular file"):
        open_mesh(tmp_path / "pipe.ply")
    with pytest.raises(MeshError, match="cannot be read"):
        open_mesh(tmp_path / ("x" * 300 + ".ply"))
    with pytest.raises(MeshError, match="cannot be read"):
        open_mesh(str(tmp_path / "nul\0.obj"))


@pytest.mark.parametrize("name", ["scene.blend", "noname", "drawing.dxf", "scene.gltf", "all.zip"])
def test_a_format_that_nobody_reads(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("something")
    with pytest.raises(MeshError, match="convert it to OBJ or PLY"):
        open_mesh(tmp_path / name)


@pytest.mark.parametrize("kind", ["stl", "off", "glb", "STL"])
def test_other_formats_through_trimesh(tmp_path: Path, kind: str) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    path = tmp_path / f"ball.{kind}"
    mesh.export(path, file_type=kind.lower())
    with open_mesh(path) as reader:
        assert reader.n_triangles == len(mesh.faces)
    triangles, ids = read_all(path, 100)
    assert ids.tolist() == list(range(len(mesh.faces)))
    assert np.allclose(triangles, mesh.triangles, atol=1e-6)


def test_other_formats_are_for_small_meshes(tmp_path: Path) -> None:
    path = tmp_path / "ball.stl"
    path.write_bytes(trimesh.creation.icosphere(subdivisions=3).export(file_type="stl"))
    with pytest.raises(MeshError, match="a STL file is read whole.*at most 5000 bytes, not 64084"):
        open_mesh(path, memory_bytes=100_000)
    (tmp_path / "broken.glb").write_bytes(b"glTF" + bytes(range(200)))
    with pytest.raises(MeshError, match=r"broken\.glb: trimesh cannot read this file \("):
        open_mesh(tmp_path / "broken.glb")


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_vertices_on_disk_are_those_in_memory(
    tmp_path: Path, rng: np.random.Generator, dtype: type[np.floating]
) -> None:
    vertices = rng.normal(size=(20_000, 3)).astype(dtype)
    vertices[77, 1] = np.inf
    queries = [rng.integers(0, 20_000, n) for n in (1, 10, 50_000)]
    queries += [np.arange(0), np.array([19_999, 0]), np.arange(20_000)[::-1].copy()]
    for memory_bytes in (1, 3000, 100_000, 200_000, 1 << 20):
        table = VertexTable(dtype, 20_000, memory_bytes, tmp_path)
        for first in range(0, 20_000, 1234):
            table.append(vertices[first : first + 1234])
        assert (table.n_vertices, table.n_unusable) == (20_000, 1)
        for query in [*queries, *queries]:
            assert same_bits(table.gather(query), vertices[query])
        table.close()
    assert list(tmp_path.iterdir()) == []


def test_a_scratch_folder_that_cannot_be_used(tmp_path: Path, square_obj: Path) -> None:
    with pytest.raises(OutputError, match="nowhere: cannot make a scratch file there"):
        read_all(square_obj, memory_bytes=24, scratch=tmp_path / "nowhere")


def write_grid_ply(path: Path, n: int) -> None:
    """A grid of n x n float32 vertices and its triangles, in row order."""
    y, x = np.mgrid[:n, :n]
    vertices = np.stack([x, y, np.sin(x) * np.cos(y)], axis=-1).reshape(-1, 3).astype("<f4")
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    faces = np.zeros(2 * len(corner), [("n", "u1"), ("v", "<i4", 3)])
    faces["n"] = 3
    faces["v"][0::2] = np.stack([corner, corner + 1, corner + n], axis=1)
    faces["v"][1::2] = np.stack([corner + 1, corner + n + 1, corner + n], axis=1)
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {n * n}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode() + vertices.tobytes() + faces.tobytes())


def write_grid_obj(path: Path, n: int) -> None:
    """The same grid as text."""
    index = np.arange(n * n).reshape(n, n) + 1
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1).reshape(-1, 4)
    with open(path, "w") as file:
        file.writelines(f"v {k % n} {k // n} 0.125\n" for k in range(n * n))
        file.writelines(f"f {a} {b} {c} {d}\n" for a, b, c, d in quads.tolist())


@pytest.mark.parametrize(("write", "suffix"), [(write_grid_ply, "ply"), (write_grid_obj, "obj")])
def test_memory_follows_the_batch_and_not_the_file(tmp_path: Path, write: object, suffix: str) -> None:
    peaks = []
    for n in (20, 300, 600):  # the first run also pays for imports and compilation
        path = tmp_path / f"grid.{suffix}"
        write(path, n)
        tracemalloc.start()
        with open_mesh(path, memory_bytes=500_000, scratch=tmp_path) as reader:
            n_triangles = sum(len(batch.ids) for batch in reader.batches(4096))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert n_triangles == 2 * (n - 1) ** 2
    assert peaks[2] < 1.1 * peaks[1]


def test_vertices_that_do_not_fit_in_memory_change_nothing(tmp_path: Path) -> None:
    write_grid_ply(tmp_path / "grid.ply", 200)
    in_memory, _ = read_all(tmp_path / "grid.ply")
    on_disk, _ = read_all(tmp_path / "grid.ply", memory_bytes=50_000, scratch=tmp_path)
    assert same_bits(in_memory, on_disk)
    assert in_memory.dtype == np.float32


def test_the_reader_survives_its_file(square_obj: Path, tmp_path: Path) -> None:
    copy = shutil.copy(square_obj, tmp_path / "copy.obj")
    with open_mesh(copy) as reader:
        assert sum(len(b.ids) for b in reader.batches()) == 4
        Path(copy).unlink()
        with pytest.raises(MeshError, match=r"copy\.obj: cannot be read \(No such file or directory\)"):
            list(reader.batches())


@pytest.mark.parametrize(
    ("name", "n_triangles"),
    [
        ("CornellBox-Original.obj", 36), ("stanford-bunny.obj", 69_451), ("sponza_dabrovic.ply", 66_445),
        ("mcguire_dragon.ply", 348_503), ("small_city.ply", 221_986), ("small_house.ply", 148_404),
        ("office_env_large.ply", 2_771_255),
    ],
)  # fmt: skip
def test_real_scenes(name: str, n_triangles: int) -> None:
    path = scene_file(name)
    n_read = 0
    mesh = trimesh.load_mesh(path, process=False) if path.suffix == ".ply" else None
    with open_mesh(path) as reader:
        for batch in reader.batches():
            assert batch.ids[0] == n_read and batch.ids[-1] == n_read + len(batch.ids) - 1
            if mesh is not None:
                faces = mesh.faces[n_read : n_read + len(batch.ids)]
                assert np.array_equal(batch.vertices, mesh.vertices[faces])
            n_read += len(batch.ids)
    assert n_read == n_triangles


@pytest.mark.parametrize("name", ["CornellBox-Original.obj", "stanford-bunny.obj"])
def test_real_obj_files_against_plain_python(name: str) -> None:
    path = scene_file(name)
    assert same_bits(read_all(path)[0], parse_obj_by_hand(path))
