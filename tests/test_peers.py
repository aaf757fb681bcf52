"""`bench peers`: Embree's bits against the exact judge, and the command from scene file to files."""

import csv
import json
import os
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import oracle
import pytest

import penumbra
from penumbra import RectLight
from penumbra.arrays import UInt64Array
from penumbra.cli.main import run
from penumbra.errors import BackendError
from penumbra.ingest import blockers_in_memory
from penumbra.lights import sample_sets_of
from penumbra.measure import side_by_side
from penumbra.measure.equal_error import EqualError, Estimate
from penumbra.measure.mitsuba_peer import is_installed
from penumbra.measure.peer_case import CastCase, write_indexed_mesh
from penumbra.measure.peer_process import PeerProcess

needs_embree = pytest.mark.skipif(
    find_spec("embreex") is None or os.environ.get("NUMBA_DISABLE_JIT", "0") != "0",
    reason="needs embreex and compiled kernels",
)

N_RECEIVERS, N_TRIANGLES, OFFSET = 40, 20, 1e-5


@pytest.fixture
def embree() -> Iterator[PeerProcess]:
    """Embree's process."""
    with PeerProcess("penumbra.measure.embree_peer") as peer:
        yield peer


def case_of_noise(rng: np.random.Generator, samples: int, sets: int) -> tuple[CastCase, np.ndarray]:
    """Receivers around and above the light, most of them below it, among triangles at random; all float32."""
    triangles = (rng.uniform(-1, 1.5, (N_TRIANGLES, 1, 3)) + rng.normal(0, 0.5, (N_TRIANGLES, 3, 3))).astype(
        np.float32
    )
    points = rng.uniform([-2, -2, -2], [2, 0, 2], (N_RECEIVERS, 3))
    points[:4, 1] += 7.0
    normals = rng.normal(size=(N_RECEIVERS, 3)) + (0, 1.5, 0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = RectLight([-1, 3, -1], [2, 0.3, 0], [0, 0.2, 2], samples=samples, sets=sets, seed=3)
    own = np.full(N_RECEIVERS, -1)
    index = rng.permutation(64 * 48)[:N_RECEIVERS]
    return CastCase(points, normals, own, index, 64, OFFSET, light), triangles.astype(np.float64)


def embree_bits(peer: PeerProcess, case: CastCase, folder: Path, coherent: bool = True) -> UInt64Array:
    """Bits of one pass over the mesh in a folder."""
    case.write(folder)
    peer.ask("case", folder=str(folder))
    peer.ask("cast", threads=2, coherent=coherent)
    peer.ask("masks", path=str(folder / "masks.npy"))
    masks: UInt64Array = np.load(folder / "masks.npy")
    return masks


@needs_embree
@pytest.mark.parametrize("samples, sets", [(16, 1), (70, 3)])
def test_embree_has_the_bits_of_the_judge_where_no_sample_grazes(
    embree: PeerProcess, rng: np.random.Generator, tmp_path: Path, samples: int, sets: int
) -> None:
    case, triangles = case_of_noise(rng, samples, sets)
    write_indexed_mesh(blockers_in_memory(triangles), tmp_path)
    built = embree.ask("build", mesh=str(tmp_path), threads=1)
    assert built["own_bytes"] > 0 and built["version"].startswith("4.")
    light = case.light
    chosen = sample_sets_of(case.index, light.seed, sets)
    faces = (light.corner, light.edge_u, light.edge_v)
    moved = case.points + OFFSET * case.normals
    judged = oracle.masks(
        moved, triangles, light.sample_points, chosen, light=faces, two_sided=False, normals=case.normals
    )
    found = embree_bits(embree, case, tmp_path)
    assert judged.any() and (judged != judged[:, :1]).any() | (judged != 0).any()
    assert np.array_equal(found, embree_bits(embree, case, tmp_path, coherent=False))
    assert (
        found[:4] == found[0]
    ).all()  # behind the light: all bits are set, those beyond the samples are not
    assert int(np.bitwise_count(found[0]).sum()) == samples
    differing = found ^ judged
    assert int(np.bitwise_count(differing).sum()) < 0.005 * samples * N_RECEIVERS
    for row in np.flatnonzero(differing.any(axis=1)):
        near = moved[row] + 20 * OFFSET * np.vstack([np.eye(3), -np.eye(3)])
        around = oracle.masks(
            near, triangles, light.sample_points, np.repeat(chosen[row], 6), light=faces, two_sided=False
        )
        steady = ~(around ^ around[:1]).any(axis=0)
        assert not (differing[row] & np.where(steady, ~np.uint64(0), np.uint64(0))).any()


@needs_embree
def test_samples_below_the_receiver_are_not_traced(embree: PeerProcess, tmp_path: Path) -> None:
    mesh = blockers_in_memory(np.array([[[50.0, 0, 0], [51, 0, 0], [50, 1, 0]]]))
    write_indexed_mesh(mesh, tmp_path)
    embree.ask("build", mesh=str(tmp_path), threads=1)
    light = RectLight([-1, 3, -1], [2, 0, 0], [0, 0, 2], samples=64, sets=1)
    normals = np.array([[0.0, 1, 0], [0, -1, 0], [1, 0, 0]])
    case = CastCase(np.zeros((3, 3)), normals, np.full(3, -1), np.arange(3), 3, 0.0, light)
    case.write(tmp_path)
    embree.ask("case", folder=str(tmp_path))
    rays = embree.ask("cast", threads=1, coherent=True)["rays"]
    masks = embree_bits(embree, case, tmp_path)
    above = light.sample_points[0] @ normals.T > 0
    assert rays == above.sum()
    bits = np.unpackbits(masks.view(np.uint8), axis=1, bitorder="little")
    assert np.array_equal(bits.astype(bool), ~above.T)


def test_the_mesh_has_shared_vertices_and_the_order_of_ids(rng: np.random.Generator, tmp_path: Path) -> None:
    corners = rng.integers(-3, 3, (50, 3, 3)).astype(np.float64)
    corners[rng.random(corners.shape) < 0.1] *= -0.0
    blockers = blockers_in_memory(corners)
    n_triangles = write_indexed_mesh(blockers, tmp_path)
    vertices, triangles = (np.load(tmp_path / f"{name}.npy") for name in ("vertices", "triangles"))
    a, b, c = np.moveaxis(corners, 1, 0)
    kept = corners[np.cross(b - a, c - a).any(axis=1)]
    assert n_triangles == len(kept)
    assert np.array_equal(vertices[triangles], kept)
    assert len(np.unique(vertices, axis=0)) == len(vertices)


def test_a_case_comes_back_from_its_folder(rng: np.random.Generator, tmp_path: Path) -> None:
    case, _ = case_of_noise(rng, 33, 4)
    case.write(tmp_path)
    back = CastCase.read(tmp_path)
    for name in ("points", "normals", "own", "index"):
        assert np.array_equal(getattr(case, name), getattr(back, name))
    assert np.array_equal(case.light.sample_points, back.light.sample_points)
    assert (back.width, back.offset, back.facts()) == (case.width, case.offset, case.facts())


def test_a_childs_error_is_ours(tmp_path: Path) -> None:
    with PeerProcess("penumbra.measure.penumbra_peer") as peer:
        with pytest.raises(BackendError, match=r"missing\.ply: no such file"):
            mesh = {"path": str(tmp_path / "missing.ply"), "transform": None, "up": "y"}
            peer.ask("build", meshes=[mesh], store=str(tmp_path / "store.h5"))
        with pytest.raises(BackendError, match="ended with code 1 while asked to dance"):
            peer.ask("dance")


@needs_embree
def test_command_compares_both_sides(
    scene_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    arguments = ["-q", "bench", "peers", str(scene_file), "-o", str(tmp_path / "out")]
    arguments += ["--samples", "64", "--sets", "2", "--rounds", "2", "--threads", "1"]
    assert run(arguments) == 0
    out = capsys.readouterr().out
    assert "geometric mean of the cpu ratios" in out and "square" in out
    facts = json.loads((tmp_path / "out" / "peers.json").read_text())
    (row,) = facts["rows"]
    scene = penumbra.Scene.load(scene_file)
    points, normals, own, pixel = penumbra.camera_receivers(scene)
    light = penumbra.RectLight(
        *(getattr(scene.lights[0], k) for k in ("corner", "edge_u", "edge_v")), samples=64, sets=2
    )
    result = penumbra.cast(points, str(_store(scene, tmp_path)), light, normals=normals, own=own, index=pixel)
    assert row["n_receivers"] == len(points) and row["n_bits"] == 64 * len(points)
    share = ((result.visibility > 0) & (result.visibility < 1)).mean()
    assert row["penumbra_share"] == pytest.approx(share)
    assert row["n_differing"] <= 0.001 * row["n_bits"]
    assert row["n_wrong_ours"] == 0
    assert row["cpu_ratio_low"] <= row["cpu_ratio_median"] <= row["cpu_ratio_high"]
    assert 0 < row["embree_rays"] <= row["n_bits"]
    with (tmp_path / "out" / "peers.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 1
    assert (tmp_path / "out" / "peers.png").read_bytes().startswith(b"\x89PNG")


def _store(scene: penumbra.Scene, folder: Path) -> Path:
    penumbra.ingest(scene.geometry, folder / "store.h5").close()
    return folder / "store.h5"


def test_without_embree_there_is_one_sentence(
    scene_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(side_by_side, "library_path", lambda: None)
    assert run(["-q", "bench", "peers", str(scene_file)]) == 1
    error = capsys.readouterr().err
    assert error.startswith("penumbra: error: Embree is not installed") and error.count("\n") == 1


def test_unknown_scene(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["-q", "bench", "peers", "meadow"]) == 1
    assert "'meadow'" in capsys.readouterr().err


@pytest.mark.parametrize("slope", [-0.5, -0.75])
def test_seconds_to_equal_error_follow_the_power_law(slope: float) -> None:
    estimates = tuple(Estimate(n, 2.0 * n**slope, 0.1 * n, 0.06 * n) for n in (64, 256, 1024))
    found = EqualError("3", 2.0 * 400**slope, estimates)
    assert found.seconds("cpu_seconds") == pytest.approx(40.0)
    assert found.seconds("wall_seconds") == pytest.approx(24.0)
    assert EqualError("3", 1e-9, estimates).seconds("cpu_seconds") is None
    assert EqualError("3", 1.0, estimates).seconds("cpu_seconds") == pytest.approx(6.4)


@needs_embree
def test_mitsuba_sees_what_we_see(scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["-q", "bench", "peers", str(scene_file), "--rounds", "1", "--samples", "64", "--mitsuba"]
    assert run(arguments) == 0
    out = capsys.readouterr().out
    if not is_installed():
        assert "Mitsuba is not installed" in out
        return
    table = out.split("until its error is ours\n")[1].splitlines()
    our_rms, its_rms = (float(table[1].split()[column]) for column in (1, 4))
    # As many samples of the same kind err by as much; a systematic difference would not go away.
    assert 0 < its_rms < 1.5 * our_rms < 0.1
