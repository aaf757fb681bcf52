"""`penumbra bench stability`: the judge is judged, the scenes are what they claim, wrong bits are found."""

import csv
import json
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from backends import BACKENDS, ONE_AT_A_TIME, assert_every_bit
from exact_geometry import (
    Floats,
    any_edge,
    between,
    cross,
    dot,
    exact,
    exact_normal,
    grazes,
    minus,
    orient3d,
    surrounds,
)
from scenes import SmallScene

import penumbra
from penumbra import PointLight
from penumbra.cli.main import run
from penumbra.errors import BackendError, OutputError, PenumbraError, SceneError
from penumbra.measure.stability import SCALES_AND_OFFSETS, StabilityOptions, measure_stability
from penumbra.measure.stability_cases import CASES, CORNER, EDGE_U, EDGE_V, ORDINARY
from penumbra.measure.stability_point_cases import POSITION
from penumbra.measure.stability_report import StabilityReport
from penumbra.measure.stability_scene import Case, HardScene, SceneSize, hard_scene

SIZE = SceneSize(n_receivers=14, n_blockers=10, n_samples=8)
BY_NAME = {case.name: case for case in CASES}


def test_names_are_unique() -> None:
    assert len(BY_NAME) == len(CASES)


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e-6, 1e6), (1e6, 1e4), (2.0**-20, 1e6)])
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_every_bit_is_what_the_independent_judge_decides(case: Case, scale: float, offset: float) -> None:
    scene = hard_scene(case, SIZE, seed=1, scale=scale, offset=offset)
    small = SmallScene(scene.points, scene.triangles, scene.light, scene.normals, scene.own)
    for backend in BACKENDS:
        assert_every_bit(small, backend)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_scenes_have_their_size_and_depend_on_the_seed_alone(case: Case) -> None:
    size = SceneSize(33, 24, 16)
    scene, same, other = (hard_scene(case, size, seed) for seed in (4, 4, 5))
    n_receivers, n_samples = (264, 1) if case.has_point_light else (33, 16)
    assert isinstance(scene.light, PointLight) == case.has_point_light
    assert scene.points.shape == (n_receivers, 3) and scene.own.shape == (n_receivers,)
    assert scene.triangles.shape == (24, 3, 3) and scene.light.sample_points.shape[1:] == (n_samples, 3)
    assert scene.n_bits == n_receivers * n_samples
    assert (scene.points == same.points).all() and (scene.triangles == same.triangles).all()
    assert (scene.light.sample_points == same.light.sample_points).all()
    assert (scene.points != other.points).any() or (scene.triangles != other.triangles).any()


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_scenes_are_in_penumbra_and_hold_sound_blockers(case: Case) -> None:
    scene = hard_scene(case, SceneSize(200, 64, 16))
    how = {"normals": scene.normals, "own": scene.own}
    result = penumbra.cast(scene.points, scene.triangles, scene.light, **how, backend="reference")
    assert 0.01 < result.visibility.mean() < 0.999
    assert np.mean([any(exact_normal(triangle)) for triangle in scene.triangles]) > 0.9


@pytest.mark.parametrize("exponent", [-20, 20])
@pytest.mark.parametrize(
    "name",
    [
        "in-the-light-plane",
        "receivers-on-planes",
        "receivers-on-vertices",
        "grazing",
        "point-on-blockers",
        "point-on-horizon",
        "point-grazing",
    ],
)
def test_powers_of_two_move_scenes_without_rounding(name: str, exponent: int) -> None:
    base = hard_scene(BY_NAME[name], SIZE)
    moved = hard_scene(BY_NAME[name], SIZE, scale=2.0**exponent, offset=1e6)
    for before, after in ((base.points, moved.points), (base.triangles, moved.triangles)):
        scaled = [Fraction(x) * Fraction(2) ** exponent for x in before.ravel()]
        differences = np.array([Fraction(x) for x in after.ravel()]) - np.array(scaled)
        assert set(differences) == {Fraction(10**6), Fraction(-(10**6)), Fraction(500_000)}


def test_blockers_pass_through_the_light() -> None:
    triangles = hard_scene(BY_NAME["through-the-light"], SIZE).triangles
    assert sum(crosses_the_light(triangle) for triangle in triangles) >= SIZE.n_blockers // 2
    ordinary = hard_scene(ORDINARY, SIZE).triangles
    assert not any(crosses_the_light(triangle) for triangle in ordinary)


def test_blockers_touch_the_light() -> None:
    scene = hard_scene(BY_NAME["touching-the-light"], SIZE)
    samples = {tuple(point) for point in scene.light.sample_points[0]}
    for a, b, c in scene.triangles:
        touching = [tuple(point) for point in (a, b, c, 0.5 * (a + b))]
        assert samples & set(touching)


def test_blockers_lie_in_the_plane_of_the_light() -> None:
    triangles = hard_scene(BY_NAME["in-the-light-plane"], SceneSize(8, 64, 4)).triangles
    flat = [all(in_light_plane(vertex) for vertex in triangle) for triangle in triangles]
    assert sum(flat) == 8


def test_receivers_lie_in_planes_of_blockers() -> None:
    scene = hard_scene(BY_NAME["receivers-on-planes"], SIZE)
    for point in scene.points:
        assert any(orient3d(*triangle, point) == 0 for triangle in scene.triangles)


def test_receivers_lie_on_edges() -> None:
    scene = hard_scene(BY_NAME["receivers-on-edges"], SIZE)
    for point, own in zip(scene.points, scene.own, strict=True):
        on = [any_edge(lambda a, b, p=point: between(a, b, p), triangle) for triangle in scene.triangles]
        assert any(on) and (own < 0 or on[own])
        assert (point != scene.triangles.reshape(-1, 3)).any(axis=1).all()


def test_receivers_are_at_vertices() -> None:
    scene = hard_scene(BY_NAME["receivers-on-vertices"], SIZE)
    at = (scene.points[:, None, None] == scene.triangles).all(axis=-1).any(axis=-1)
    assert at.any(axis=1).all()
    knows = scene.own >= 0
    assert knows.any() and not knows.all()
    assert at[knows, scene.own[knows]].all()


def test_receivers_lie_in_the_plane_of_the_light() -> None:
    scene = hard_scene(BY_NAME["receivers-in-light-plane"], SIZE)
    assert all(in_light_plane(point) for point in scene.points)
    assert all(in_light_plane(point) for point in scene.light.sample_points[0])
    flat = [all(in_light_plane(vertex) for vertex in triangle) for triangle in scene.triangles]
    assert any(flat) and not all(flat)


def test_segments_graze() -> None:
    scene = hard_scene(BY_NAME["grazing"], SIZE)
    for point in scene.points:
        assert any(grazes(point, sample, scene.triangles) for sample in scene.light.sample_points[0])


def test_an_ulp_is_one_ulp() -> None:
    case = BY_NAME["grazing-within-an-ulp"]
    for scale, offset in SCALES_AND_OFFSETS:
        nudged = hard_scene(case, SIZE, 0, scale, offset)
        exact = hard_scene(Case(case.name, case.what, case.make), SIZE, 0, scale, offset)
        for values, before in ((nudged.points, exact.points), (nudged.triangles, exact.triangles)):
            near = (
                (values == before)
                | (values == np.nextafter(before, np.inf))
                | (values == np.nextafter(before, -np.inf))
            )
            assert near.all() and (values != before).any()


def test_slivers_are_slender() -> None:
    triangles = hard_scene(BY_NAME["slivers"], SceneSize(4, 200, 4)).triangles
    edges = np.roll(triangles, -1, axis=1) - triangles
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    double_area = np.array([float(sum(x * x for x in exact_normal(t))) ** 0.5 for t in triangles])
    aspect = longest**2 / np.maximum(double_area, 1e-30)
    assert np.median(aspect) > 1e7 and aspect.min() > 1 and aspect.max() > 1e14


@pytest.mark.parametrize("name", ["light-is-a-line", "light-is-folded", "edges-are-zero"])
def test_lights_without_area(name: str) -> None:
    scene = hard_scene(BY_NAME[name], SceneSize(4, 64, 16))
    assert scene.light.area == 0
    samples = {tuple(point) for point in scene.light.sample_points.reshape(-1, 3)}
    assert (len(samples) == 1) == (name == "edges-are-zero")
    edge_on = [all(orient3d(*triangle, sample) == 0 for sample in samples) for triangle in scene.triangles]
    assert sum(edge_on) >= 8


def test_a_light_as_thin_as_a_sliver() -> None:
    scene = hard_scene(BY_NAME["light-is-a-sliver"], SceneSize(40, 20, 16))
    length = float(np.linalg.norm(EDGE_V))
    assert 0 < scene.light.area < 1e-8 * length**2
    for dust in (scene.points[:20, 1:], scene.triangles[:10, :, 1:]):
        assert 0 < np.abs(dust - CORNER[1:]).max() < 1e-8


def test_a_point_light_touches_blockers() -> None:
    triangles = hard_scene(BY_NAME["point-on-blockers"], SceneSize(4, 64, 4)).triangles
    at_vertex = (triangles == POSITION).all(axis=-1).any(axis=1)
    on_edge = [any_edge(lambda a, b: between(a, b, POSITION), triangle) for triangle in triangles]
    in_plane = [orient3d(*triangle, POSITION) == 0 for triangle in triangles]
    inside = [flat and surrounds(t, POSITION) for flat, t in zip(in_plane, triangles, strict=True)]
    # A quarter in turn inside, on an edge and at a vertex; an eighth in its plane only.
    assert [np.sum(found) for found in (inside, on_edge, at_vertex, in_plane)] == [6, 5, 5, 24]


def test_a_point_light_is_at_receivers() -> None:
    points = hard_scene(BY_NAME["point-at-receivers"], SceneSize(20, 24, 4)).points
    at = (points == POSITION).all(axis=1)
    near = (np.abs(points - POSITION) < 1e-15).all(axis=1)
    assert (at.sum(), near.sum(), len(points)) == (40, 80, 160)


def test_a_point_light_is_in_planes_of_receivers() -> None:
    scene = hard_scene(BY_NAME["point-on-horizon"], SIZE, scale=2.0**-20, offset=1e6)
    assert scene.normals is not None and isinstance(scene.light, PointLight)
    away = [minus(exact(scene.light.position), exact(point)) for point in scene.points]
    heights = [dot(exact(normal), to) for normal, to in zip(scene.normals, away, strict=True)]
    assert sum(height == 0 for height in heights) == len(heights) // 2
    assert any(height > 0 for height in heights) and any(height < 0 for height in heights)


def test_a_point_light_is_behind_vertices_and_edges() -> None:
    scene = hard_scene(BY_NAME["point-grazing"], SIZE)
    found = [grazes(point, POSITION, scene.triangles) for point in scene.points]
    assert all(found[: len(found) // 2]) and not all(found)


def test_no_backend_is_wrong() -> None:
    report = measure_stability(StabilityOptions(backends=others(), quick=True, seed=2))
    assert len(report.rows) == len(CASES) * len(SCALES_AND_OFFSETS) * len(others())
    assert report.wrong_bits == 0
    report.raise_if_wrong()
    plain = {row.case: row for row in report.rows if (row.scale, row.offset) == (1.0, 0.0)}
    assert plain["ordinary"].escalated_exact == 0 < plain["grazing"].escalated_exact
    assert all(row.cpu_seconds > 0 and row.times_ordinary > 0 for row in report.rows)
    # The scenes that all others are timed against were timed once.
    assert plain["ordinary"].times_ordinary == plain["point-ordinary"].times_ordinary == 1
    assert {row.bits for row in report.rows} == {64 * 16, 8 * 64}
    assert list(report.ordinary_cpu_seconds) == ["ordinary", "point-ordinary"]
    assert "point-ordinary  " in str(report)


def test_a_wrong_backend_is_found(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    break_a_bit(monkeypatch, receiver=3, sample=5)
    arguments = ["bench", "stability", "--backend", "hpc", "--case", "slivers", "--quick", "--seed", "7"]
    assert run([*arguments, "-o", str(tmp_path)]) == 1
    spoken = capsys.readouterr()
    assert "11 bits are wrong in 11 of 11 rows" in spoken.err
    assert "penumbra bench stability --case slivers --backend hpc --seed 7 --quick" in spoken.err
    assert "slivers" in spoken.out
    rows = json.loads((tmp_path / "stability.json").read_text())["rows"]
    judged, found = ("blocked", "visible") if rows[0]["wrong_sample_is_blocked"] else ("visible", "blocked")
    assert "case slivers at scale 1e-06, offset 0 " in spoken.err
    assert f"(receiver 3, sample 5 is {judged} and was cast as {found})" in spoken.err
    for row in rows:
        assert (row["wrong_bits"], row["wrong_receiver"], row["wrong_sample"]) == (1, 3, 5)
        scene = hard_scene(BY_NAME["slivers"], SceneSize(64, 24, 16), 7, row["scale"], row["offset"])
        masks = penumbra.cast(scene.points, scene.triangles, scene.light, backend="reference").masks
        assert masks is not None
        assert row["wrong_sample_is_blocked"] == bool(int(masks[3, 0]) >> 5 & 1)


def test_the_command_writes_json_and_csv_that_agree(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "measured"
    arguments = ["bench", "stability", "--quick", "--threads", "1", "-o", str(folder)]
    for name in ("grazing", "ordinary"):
        arguments += ["--case", name]
    for backend in others():
        arguments += ["--backend", backend]
    assert run(arguments) == 0
    spoken = capsys.readouterr()
    assert "0 wrong" in spoken.out and "stability" in spoken.err
    assert spoken.out.splitlines()[-2:] == [str(folder / "stability.json"), str(folder / "stability.csv")]
    facts = json.loads((folder / "stability.json").read_text())
    assert (facts["wrong_bits"], facts["seed"], facts["threads"], facts["quick"]) == (0, 0, 1, True)
    assert list(facts["cases"]) == ["ordinary", "grazing"]  # in the order of the table, not of the options
    with (folder / "stability.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [as_text(row) for row in facts["rows"]] == rows
    assert {(row["scale"], row["offset"]) for row in facts["rows"]} == set(SCALES_AND_OFFSETS)
    assert {row["backend"] for row in facts["rows"]} == set(others())
    assert all(row["bits"] == 64 * 16 for row in facts["rows"])

    assert run(arguments) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert run([*arguments, "--overwrite"]) == 0


def test_the_table_is_printed_even_when_the_files_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: Any) -> None:
        raise OutputError("the disk is full")

    monkeypatch.setattr(StabilityReport, "write", full)
    arguments = ["bench", "stability", "--quick", "--backend", "hpc", "--case", "ordinary"]
    assert run([*arguments, "-o", str(tmp_path)]) == 1
    spoken = capsys.readouterr()
    assert spoken.out.startswith("scenes") and "the disk is full" in spoken.err
    # What can be known before the work is said before it.
    (tmp_path / "file").touch()
    assert run([*arguments, "-o", str(tmp_path / "file" / "below")]) == 1
    assert capsys.readouterr().out == ""


def test_what_cannot_be_judged_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SceneError, match="no case 'grazign': use ordinary, "):
        measure_stability(StabilityOptions(backends=["hpc"], cases=["grazign"]))
    with pytest.raises(SceneError, match="is the judge"):
        StabilityOptions(backends=["reference"])
    with pytest.raises(SceneError, match="name at least one"):
        StabilityOptions(backends=[])
    with pytest.raises(BackendError):
        StabilityOptions(backends=["embree"])
    assert run(["bench", "stability", "--backend", "reference"]) == 2
    assert run(["bench", "stability", "--backend", "hpc", "--case", "nothing"]) == 2
    assert "no case 'nothing'" in capsys.readouterr().err


def test_the_table_tells_the_worst() -> None:
    report = measure_stability(StabilityOptions(backends=["hpc"], cases=["slivers"], quick=True))
    header, (cells,) = report.summary()
    assert len(header) == len(cells)
    slowest = max(report.rows, key=lambda row: row.times_ordinary)
    assert cells[0] == "slivers" and cells[2] == "0"
    assert cells[-2] == f"{slowest.times_ordinary:.2f}"
    scale, offset = cells[-1].split(", ")
    assert float(offset) == slowest.offset
    assert (2.0 ** float(scale[2:]) if "^" in scale else float(scale)) == slowest.scale
    assert int(cells[6].replace(",", "")) == round(max(row.exact_per_million for row in report.rows))
    assert str(report).count("\n") >= 7
    assert_reports_only_wrong_bits(report)


def assert_reports_only_wrong_bits(report: StabilityReport) -> None:
    report.raise_if_wrong()
    broken = report.rows[4]._replace(wrong_bits=2, first_wrong=(0, 63, True))  # type: ignore[arg-type]
    rows = (*report.rows[:4], broken, *report.rows[5:])
    wrong = StabilityReport(**{**vars(report), "rows": rows})
    with pytest.raises(PenumbraError, match="2 bits are wrong in 1 of 11 rows") as caught:
        wrong.raise_if_wrong()
    assert caught.value.exit_code == 1


def test_a_bit_that_is_wrong_in_one_repeat_only_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every repeat is judged: a race shows now and then."""
    calls: list[int] = []
    monkeypatch.setattr("penumbra.measure.stability._REPEAT_SECONDS", float("inf"))
    break_a_bit(monkeypatch, receiver=3, sample=5, when=lambda: calls.append(1) or len(calls) % 2 == 0)
    report = measure_stability(StabilityOptions(backends=("hpc",), cases=("grazing",), quick=True))
    assert [row.wrong_bits for row in report.rows] == [1] * len(report.rows)


def others() -> list[str]:
    """The backends that are judged."""
    return [backend for backend in BACKENDS if backend not in ("reference", ONE_AT_A_TIME)]


def as_text(row: dict[str, Any]) -> dict[str, str]:
    return {key: "" if value is None else str(value) for key, value in row.items()}


def break_a_bit(
    monkeypatch: pytest.MonkeyPatch, receiver: int, sample: int, when: Callable[[], Any] = lambda: True
) -> None:
    """Make backend hpc flip a bit, in the casts that `when` chooses."""
    from penumbra import casting

    right = casting.cast_receivers

    def wrong(*arguments: Any, **how: Any) -> Any:
        masks, *rest = right(*arguments, **how)
        if when():
            masks[receiver, 0] ^= np.uint64(1 << sample)
        return masks, *rest

    monkeypatch.setattr(casting, "cast_receivers", wrong)


def in_light_plane(point: Floats) -> bool:
    return light_height(point) == 0


def light_height(point: Floats) -> Fraction:
    return dot(cross(exact(EDGE_U), exact(EDGE_V)), minus(exact(point), exact(CORNER)))


def crosses_the_light(triangle: Floats) -> bool:
    """Whether a triangle with vertices on both sides of the light's plane meets the inside of the light."""
    ends = []
    for a, b in zip(triangle, np.roll(triangle, -1, axis=0), strict=True):
        height_a, height_b = light_height(a), light_height(b)
        if height_a * height_b < 0:
            share = height_a / (height_a - height_b)
            from_corner = minus(exact(a), exact(CORNER))
            at = [x + share * step for x, step in zip(from_corner, minus(exact(b), exact(a)), strict=True)]
            # The edges of the light are at right angles, so that these are its parameters.
            ends.append([dot(at, exact(edge)) / dot(exact(edge), exact(edge)) for edge in (EDGE_U, EDGE_V)])
    if len(ends) != 2:
        return False
    shares = [Fraction(k, 64) for k in range(65)]
    return any(all(0 < p + k * (q - p) < 1 for p, q in zip(*ends, strict=True)) for k in shares)


def test_the_claims_would_fail_elsewhere() -> None:
    scene: HardScene = hard_scene(ORDINARY, SIZE)
    assert not any(orient3d(*t, point) == 0 for t in scene.triangles for point in scene.points)
    assert not any(
        grazes(point, sample, scene.triangles)
        for point in scene.points[:4]
        for sample in scene.light.sample_points[0]
    )
