"""Ingest: the same triangles come out as trimesh reads, whatever the memory, and no half store is left."""

import errno
import hashlib
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import trimesh
from paths import scene_file

import penumbra.io.runs as runs
from penumbra import ingest_plan
from penumbra.errors import BlockerStoreError, MemoryLimitError, MeshError, OutputError, SceneError
from penumbra.ingest import blockers_in_memory, ingest
from penumbra.io.blocker_store import BlockerStore
from penumbra.io.runs import SortPlan
from penumbra.options import IngestOptions
from penumbra.scene import MeshRef

ROOT = Path(__file__).resolve().parents[1]
SMALL = IngestOptions(chunk_triangles=256)


def _write_ply(path: Path, triangles: np.ndarray) -> Path:
    """Triangles with vertices of their own, in the type they have."""
    kind = {"float32": "float", "float64": "double"}[triangles.dtype.name]
    n = len(triangles)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {3 * n}\n"
    header += "".join(f"property {kind} {axis}\n" for axis in "xyz")
    header += f"element face {n}\nproperty list uchar int vertex_indices\nend_header\n"
    faces = np.empty(n, np.dtype([("n", "u1"), ("i", "<i4", 3)]))
    faces["n"] = 3
    faces["i"] = np.arange(3 * n).reshape(n, 3)
    path.write_bytes(header.encode() + triangles.tobytes() + faces.tobytes())
    return path


def _random_triangles(rng: np.random.Generator, n: int, dtype: type = np.float32) -> np.ndarray:
    """Sizes over nine decades, some flat, some the same as another."""
    sizes = 10.0 ** rng.uniform(-7, 2, size=(n, 1, 1))
    triangles = (rng.normal(size=(n, 1, 3)) * 10 + rng.normal(size=(n, 3, 3)) * sizes).astype(dtype)
    triangles[::97, 2] = triangles[::97, 1]
    triangles[5::89] = triangles[4::89][: len(triangles[5::89])]
    return triangles


def _content(store: BlockerStore) -> dict[int, bytes]:
    """Id to vertices of everything in a store."""
    found: dict[int, bytes] = {}
    for i in range(len(store.chunks)):
        chunk = store.read(i)
        for number, vertices in zip(chunk.ids.tolist(), chunk.vertices, strict=True):
            assert number not in found
            found[number] = (vertices + 0.0).tobytes()
    return found


def _expected(triangles: np.ndarray) -> dict[int, bytes]:
    """What should be in a store: all triangles but those of zero area, decided in long doubles."""
    wide = triangles.astype(np.longdouble)
    normals = np.cross(wide[:, 1] - wide[:, 0], wide[:, 2] - wide[:, 0])
    kept = np.flatnonzero((normals != 0).any(axis=1))
    return {int(i): (triangles[i].astype(np.float64) + 0.0).tobytes() for i in kept}


def _bucket_bytes(path: Path) -> dict[str, bytes]:
    """All that is below /buckets."""
    found: dict[str, bytes] = {}

    def add(name: str, item: h5py.HLObject) -> None:
        for key, value in item.attrs.items():
            found[f"{name}@{key}"] = np.asarray(value).tobytes()
        if isinstance(item, h5py.Dataset):
            found[name] = str(item.dtype).encode() + item[()].tobytes()

    with h5py.File(path) as file:
        file["buckets"].visititems(add)
    return found


@pytest.mark.parametrize("n", [1, 15, 16, 17, 255, 256, 257, 4095, 4096, 4097])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_every_triangle_comes_out(tmp_path: Path, rng: np.random.Generator, n: int, dtype: type) -> None:
    triangles = _random_triangles(rng, n, dtype)
    triangles[0] = np.eye(3)
    mesh = _write_ply(tmp_path / "mesh.ply", triangles)
    with ingest(mesh, tmp_path / "out.h5", options=IngestOptions(chunk_triangles=300)) as store:
        expected = _expected(triangles)
        assert _content(store) == expected
        assert (store.n_triangles, store.n_dropped) == (len(expected), n - len(expected))
        assert store.dtype == (np.float32 if n == 1 else dtype)
        corners = triangles[sorted(expected)].reshape(-1, 3)
        np.testing.assert_array_equal(store.bounds, [corners.min(axis=0), corners.max(axis=0)])
    assert [path.name for path in tmp_path.iterdir() if path.name not in ("mesh.ply", "out.h5")] == []


@pytest.mark.parametrize("name", ["sponza_dabrovic.ply", "stanford-bunny.obj"])
def test_real_meshes_as_trimesh_reads_them(tmp_path: Path, name: str) -> None:
    path = scene_file(name)
    mesh = trimesh.load(path, process=False, force="mesh")
    with ingest(path, tmp_path / "out.h5") as store:
        assert _content(store) == _expected(np.asarray(mesh.triangles))
        assert store.n_triangles + store.n_dropped == len(mesh.faces)


def test_any_memory_limit_gives_the_same_buckets(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh = _write_ply(tmp_path / "mesh.ply", _random_triangles(rng, 9000))
    plain = tmp_path / "plain.h5"
    ingest(mesh, plain, options=SMALL).close()
    for i, (run_records, merge_records, batch) in enumerate(
        [(100, 50, 7), (999, 4000, 100), (4097, 64, 65536)]
    ):
        plan = SortPlan(run_records, merge_records)
        monkeypatch.setattr(ingest_plan.MemoryPlan, "sort_plan", lambda self, dtype, plan=plan: plan)
        monkeypatch.setattr(ingest_plan, "_LARGEST_BATCH", batch)
        monkeypatch.setattr(ingest_plan, "_LEAST_BATCH", min(batch, 4096))
        monkeypatch.setattr(runs, "_SLICE_RECORDS", 37 * (i + 1))
        other = tmp_path / f"other{i}.h5"
        ingest(mesh, other, options=SMALL).close()
        assert _bucket_bytes(other) == _bucket_bytes(plain)


@pytest.mark.parametrize("sort", [True, False])
def test_memory_and_store_agree(tmp_path: Path, rng: np.random.Generator, sort: bool) -> None:
    triangles = _random_triangles(rng, 3000)
    options = IngestOptions(chunk_triangles=500, max_buckets=3, sort=sort)
    mesh = _write_ply(tmp_path / "mesh.ply", triangles)
    with ingest(mesh, tmp_path / "out.h5", options=options) as store:
        for blockers in (blockers_in_memory(triangles, options), blockers_in_memory(mesh, options)):
            assert (blockers.n_triangles, blockers.n_dropped) == (store.n_triangles, store.n_dropped)
            np.testing.assert_array_equal(blockers.bounds, store.bounds)
            for i, (ours, stored) in enumerate(zip(blockers.chunks, store.chunks, strict=True)):
                assert ours[:3] == stored[:3]
                np.testing.assert_array_equal(ours.box, stored.box)
                for a, b in zip(blockers.read(i), store.read(i), strict=True):
                    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("chunk_triangles", [1, 7, 16, 100, 1000, 100000])
def test_any_chunk_size_holds_the_same_triangles(
    tmp_path: Path, rng: np.random.Generator, chunk_triangles: int
) -> None:
    triangles = _random_triangles(rng, 600)
    mesh = _write_ply(tmp_path / "mesh.ply", triangles)
    options = IngestOptions(chunk_triangles=chunk_triangles)
    with ingest(mesh, tmp_path / "out.h5", options=options) as store:
        assert _content(store) == _expected(triangles)
        assert all(info.count <= chunk_triangles for info in store.chunks)
        for i, info in enumerate(store.chunks):
            chunk = store.read(i)
            parts = [chunk.vertices[k : k + 16].reshape(-1, 3) for k in range(0, info.count, 16)]
            np.testing.assert_array_equal(chunk.boxes_16, [[p.min(axis=0), p.max(axis=0)] for p in parts])


def test_input_order_without_sorting(tmp_path: Path, rng: np.random.Generator) -> None:
    # float64 between float32, so that scratch files of both kinds have to be joined again.
    parts = [_write_ply(tmp_path / f"{i}.ply", _random_triangles(rng, 300, t)) for i, t in enumerate("fdf")]
    with ingest(parts, tmp_path / "out.h5", options=IngestOptions(chunk_triangles=128, sort=False)) as store:
        ids = np.concatenate([store.read(i).ids for i in range(len(store.chunks))])
        assert (np.diff(ids) > 0).all() and len(ids) == store.n_triangles and len(store.buckets) == 1
        assert not store.is_sorted and store.dtype == np.float64


def test_ids_run_on_over_inputs_and_stores(tmp_path: Path, rng: np.random.Generator) -> None:
    first, second = _random_triangles(rng, 500), _random_triangles(rng, 400)
    a, b = _write_ply(tmp_path / "a.ply", first), _write_ply(tmp_path / "b.ply", second)
    with ingest([a, b], tmp_path / "both.h5", options=SMALL) as both:
        assert _content(both) == _expected(np.concatenate([first, second]))
        assert [(s.first_id, s.n_ids) for s in both.sources] == [(0, 500), (500, 400)]
        counts = both.n_triangles, both.n_dropped, both.n_ids
    ingest(a, tmp_path / "a.h5").close()
    with ingest([tmp_path / "a.h5", b], tmp_path / "joined.h5", options=SMALL) as joined:
        assert (joined.n_triangles, joined.n_dropped, joined.n_ids) == counts
    assert _bucket_bytes(tmp_path / "joined.h5") == _bucket_bytes(tmp_path / "both.h5")


def test_sources_are_described(tmp_path: Path, square_obj: Path) -> None:
    matrix = np.diag([2.0, 3.0, 4.0, 1.0])
    with ingest([square_obj, MeshRef(square_obj, matrix, "z")], tmp_path / "out.h5") as store:
        plain, moved = store.sources
        assert plain.path == str(square_obj) and plain.size_bytes == square_obj.stat().st_size
        assert plain.mtime_ns == square_obj.stat().st_mtime_ns
        assert plain.sha256 == hashlib.sha256(square_obj.read_bytes()).hexdigest() == moved.sha256
        assert (plain.up, plain.transform, plain.n_bad) == ("y", None, 0)
        np.testing.assert_array_equal(moved.transform, matrix)
        assert moved.up == "z"


def test_transform_and_up(tmp_path: Path, rng: np.random.Generator) -> None:
    triangles = _random_triangles(rng, 500)
    mesh = _write_ply(tmp_path / "mesh.ply", triangles)
    x, y, z = np.moveaxis(triangles.astype(np.float64), -1, 0)
    with ingest(MeshRef(mesh, up="z"), tmp_path / "up.h5") as store:
        assert store.dtype == np.float32
        assert _content(store) == _expected(np.stack([x, z, -y], axis=-1))
    matrix = np.array([[0, 2, 0, 1], [1, 0.5, 0, 0], [0, 0, 4, 0.1], [0, 0, 0, 1]])
    with ingest(MeshRef(mesh, matrix), tmp_path / "moved.h5") as store:
        assert store.dtype == np.float64
        moved = np.stack([2 * y + 1, x + 0.5 * y, 4 * z + 0.1], axis=-1)
        found = _content(store)
        kept = np.array([np.frombuffer(found[i]) for i in sorted(found)]).reshape(-1, 3, 3)
        np.testing.assert_allclose(kept, moved[sorted(found)], rtol=1e-15, atol=1e-14)
    with pytest.raises(MeshError, match="beyond the range"):
        ingest(MeshRef(mesh, np.diag([1e308, 1e308, 1e308, 1])), tmp_path / "far.h5")


def test_nothing_but_zero_areas(tmp_path: Path) -> None:
    mesh = tmp_path / "flat.obj"
    mesh.write_text("v 0 0 0\nv 1 1 1\nv 2 2 2\nf 1 2 3\nf 1 1 2\n")
    with ingest(mesh, tmp_path / "out.h5") as store:
        assert (store.n_triangles, store.n_dropped, store.n_ids) == (0, 2, 2)
        assert store.chunks == [] and store.buckets == [] and not store.bounds.any()


def test_bad_faces_are_counted(tmp_path: Path) -> None:
    mesh = tmp_path / "bad.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 9\nf 1 2 3\nf 1 2 3 9\nf 2 3 4\n")
    with pytest.raises(MeshError, match=r"bad\.obj"):
        ingest(mesh, tmp_path / "out.h5")
    assert not (tmp_path / "out.h5").exists()
    with ingest([mesh, mesh], tmp_path / "out.h5", skip_bad=True) as store:
        assert (store.n_triangles, store.n_bad, store.n_ids) == (4, 6, 10)
        assert sorted(store.read(0).ids.tolist()) == [1, 4, 6, 9]
    assert blockers_in_memory(mesh, skip_bad=True).n_bad == 3


def test_inputs_are_checked_before_anything_is_read(tmp_path: Path, square_obj: Path) -> None:
    with pytest.raises(MeshError, match=r"a\.obj, .*b\.obj"):
        ingest([square_obj, tmp_path / "a.obj", tmp_path / "b.obj"], tmp_path / "out.h5")
    with pytest.raises(MeshError, match="no mesh"):
        ingest([], tmp_path / "out.h5")
    with pytest.raises(OutputError, match="does not exist"):
        ingest(square_obj, tmp_path / "no" / "out.h5")
    with pytest.raises(OutputError, match="no such folder"):
        ingest(square_obj, tmp_path / "out.h5", scratch=tmp_path / "no")
    with pytest.raises(SceneError, match="is an input"):
        ingest(square_obj, square_obj, overwrite=True)
    (tmp_path / "text.h5").write_text("no store")
    with pytest.raises(BlockerStoreError, match="not an HDF5 file"):
        ingest(tmp_path / "text.h5", tmp_path / "out.h5")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["square.obj", "text.h5"]


def test_outputs_are_not_overwritten_unasked(tmp_path: Path, square_obj: Path) -> None:
    output = tmp_path / "out.h5"
    output.write_text("mine")
    with pytest.raises(OutputError, match="is there already"):
        ingest(square_obj, output)
    assert output.read_text() == "mine"
    with ingest(square_obj, output, overwrite=True) as store:
        assert store.n_triangles == 4


def test_too_little_memory_is_refused_with_a_figure_that_does(tmp_path: Path, square_obj: Path) -> None:
    with pytest.raises(MemoryLimitError) as caught:
        ingest(square_obj, tmp_path / "out.h5", memory="1MiB")
    needed = str(caught.value).split("needs ")[1].split(" of")[0].replace(" ", "")
    with ingest(square_obj, tmp_path / "out.h5", memory=f"{float(needed[:-3]) + 1}{needed[-3:]}") as store:
        assert store.n_triangles == 4


PEAK = """
import sys
import penumbra
from penumbra.memory import peak_bytes, resident_bytes

before = resident_bytes()
penumbra.ingest(sys.argv[1], sys.argv[2], memory=sys.argv[3]).close()
print(peak_bytes() - before)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "limit_mib"), [(np.float32, 256), (np.float64, 320)])
def test_memory_stays_under_the_limit(
    tmp_path: Path, rng: np.random.Generator, dtype: type, limit_mib: int
) -> None:
    """4 M triangles of 150 to 290 MB, ids and keys not counted, of which few fit at once."""
    triangles = np.tile(_random_triangles(rng, 500_000, dtype), (8, 1, 1))
    triangles += rng.normal(size=(len(triangles), 1, 1)).astype(dtype)
    mesh = _write_ply(tmp_path / "mesh.ply", triangles)
    command = [sys.executable, "-c", PEAK, str(mesh), str(tmp_path / "out.h5")]
    # The first run compiles, which takes memory of its own.
    subprocess.run([*command, "2GiB"], cwd=ROOT, check=True, capture_output=True)
    plain = _bucket_bytes(tmp_path / "out.h5")
    (tmp_path / "out.h5").unlink()
    done = subprocess.run([*command, f"{limit_mib}MiB"], cwd=ROOT, check=True, capture_output=True, text=True)
    assert int(done.stdout) <= limit_mib << 20
    assert _bucket_bytes(tmp_path / "out.h5") == plain


def test_little_disk_is_refused_before_reading(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh = _write_ply(tmp_path / "mesh.ply", _random_triangles(rng, 1000))
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(total=10**6, used=0, free=40_000))
    with pytest.raises(OutputError, match=r"about 44\.\d KiB of disk space there and 39\.1 KiB is free"):
        ingest(mesh, tmp_path / "out.h5")
    assert [path.name for path in tmp_path.iterdir()] == ["mesh.ply"]


LIMITED = """
import resource, signal, sys
import penumbra

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]),) * 2)
try:
    penumbra.ingest(sys.argv[1], sys.argv[2])
except penumbra.errors.OutputError as error:
    print(error)
"""


@pytest.mark.parametrize("limit_bytes", [1_000, 100_000, 137_000])
def test_writing_that_fails_leaves_nothing(
    tmp_path: Path, rng: np.random.Generator, limit_bytes: int
) -> None:
    """No file may grow beyond the limit: the first scratch file fails, or the store, or its last part."""
    mesh = _write_ply(tmp_path / "mesh.ply", _random_triangles(rng, 3000))
    command = [sys.executable, "-c", LIMITED, str(mesh), str(tmp_path / "out.h5"), str(limit_bytes)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert "cannot write there (File too large)" in done.stdout and done.stdout.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["mesh.ply"]


def test_a_full_disk_is_named(tmp_path: Path) -> None:
    error = runs.disk_error(tmp_path, OSError(errno.ENOSPC, "No space left on device"))
    assert str(error).startswith(f"{tmp_path}: the disk is full (")


def test_a_mesh_that_changes_while_it_is_read(
    tmp_path: Path, square_obj: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Meddler:
        def stage(self, name: str, total: float | None, unit: str) -> None:
            self.is_reading = "reading" in name

        def advance(self, amount: float) -> None:
            if self.is_reading:
                square_obj.write_text(square_obj.read_text() + "# more\n")

        def close(self) -> None:
            pass

    with pytest.raises(MeshError, match="changed while it was read"):
        ingest(square_obj, tmp_path / "out.h5", progress=Meddler())
    assert [path.name for path in tmp_path.iterdir()] == ["square.obj"]


KILLED = """
import os, signal, sys
from penumbra import ingest, IngestOptions

options = IngestOptions(chunk_triangles=256)

class Killer:
    def stage(self, name, total, unit):
        self.name, self.n = name, 0
    def advance(self, amount):
        self.n += 1
        if self.name == sys.argv[3] and self.n == int(sys.argv[4]):
            os.kill(os.getpid(), signal.SIGKILL)
    def close(self):
        pass

ingest(sys.argv[1], sys.argv[2], overwrite=True, progress=Killer(), options=options)
"""


@pytest.mark.parametrize(
    ("stage", "step"), [("ingest: reading", 1), ("ingest: sorting", 1), ("ingest: sorting", 9)]
)
def test_killed_ingest_leaves_no_store_and_the_next_run_cleans_up(
    tmp_path: Path, rng: np.random.Generator, stage: str, step: int
) -> None:
    mesh = _write_ply(tmp_path / "mesh.ply", _random_triangles(rng, 3000))
    output = tmp_path / "out.h5"
    command = [sys.executable, "-c", KILLED, str(mesh), str(output), stage, str(step)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert not output.exists()
    assert any(".ingest-" in path.name for path in tmp_path.iterdir())
    ingest(mesh, output, options=SMALL).close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mesh.ply", "out.h5"]


def test_only_scratch_of_dead_runs_is_removed(tmp_path: Path, square_obj: Path) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    for folder in (tmp_path, scratch):
        for name in (
            f".out.h5.ingest-{dead.pid}",
            f".out.h5.ingest-{os.getppid()}",
            f".b.h5.ingest-{dead.pid}",
        ):
            (folder / name).mkdir()
            (folder / name / "bin").write_text("x")
    ingest(square_obj, tmp_path / "out.h5", scratch=scratch).close()
    kept = {f".out.h5.ingest-{os.getppid()}", f".b.h5.ingest-{dead.pid}"}
    assert {path.name for path in scratch.iterdir()} == kept
    assert {path.name for path in tmp_path.iterdir()} == kept | {"square.obj", "scratch", "out.h5"}
