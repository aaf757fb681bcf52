"""`penumbra bench error`: metrics, slopes and errors against closed forms; files, table and refusals."""

import csv
import io
import json
import math
import re
import sys
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import penumbra
from penumbra.cli.main import run
from penumbra.errors import BackendError, Interrupted, MemoryLimitError, SceneError
from penumbra.measure import error, error_report, plots
from penumbra.measure import scene as measured_scene
from penumbra.measure.cost import measured
from penumbra.measure.error import ErrorOptions, cast_reference, measure_error
from penumbra.measure.error_report import ErrorReport, fit_slopes
from penumbra.measure.metrics import error_metrics, fit_power_law, without_floor
from penumbra.measure.report import aligned_table, markdown_table, prepare_outputs
from penumbra.measure.scene import chosen_light, open_scene
from penumbra.memory import peak_bytes, reset_peak, resident_bytes
from penumbra.progress import LogProgress, NullProgress

# A floor at y = 0 and, at y = 1, a blocker that covers x < 0.
HALF_PLANE = """\
v -9 0 -9
v 9 0 -9
v 9 0 9
v -9 0 9
v -90 1 -90
v 0 1 -90
v 0 1 90
v -90 1 90
f 1 4 3
f 1 3 2
f 5 8 7
f 5 7 6
"""

QUICK = ["--samples", "4,16", "--reference", "64", "--resolution", "24x18"]
FILES = ["error.csv", "error.json", "error.png"]


def half_plane_scene(folder: Path) -> penumbra.Scene:
    """Floor, half-plane and a light of 1 x 1 at y = 2; the camera is below the blocker and sees the floor."""
    path = folder / "half.obj"
    path.write_text(HALF_PLANE)
    camera = penumbra.Camera((0, 0.9, 0), (0, 0, 0), up=(0, 0, -1), vfov=55, resolution=(96, 72))
    light = penumbra.RectLight([-0.5, 2, -0.5], [1, 0, 0], [0, 0, 1], name="key")
    return penumbra.Scene((penumbra.MeshRef(path),), camera, (light,))


def exact_visibility(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """A point at x sees what of the light is beyond -x, as the blocker's edge is half way up."""
    return np.clip(0.5 + points[:, 0], 0, 1)


def test_metrics_are_those_computed_by_hand(rng: np.random.Generator) -> None:
    reference = np.array([0.0, 0.5, 0.25, 1.0])
    visibility = np.array([0.0, 0.75, 0.125, 1.0], np.float32)
    found = error_metrics(visibility, reference, np.array([False, True, True, False]))
    squares = 0.25**2 + 0.125**2
    assert found.rms == pytest.approx(math.sqrt(squares / 4))
    assert found.rms_penumbra == pytest.approx(math.sqrt(squares / 2))
    assert (found.mean_absolute, found.bias, found.maximum) == (0.375 / 4, 0.125 / 4, 0.25)
    many = rng.uniform(-1, 1, 1001)
    p99 = error_metrics(many, np.zeros(1001), np.ones(1001, bool)).p99
    assert np.count_nonzero(np.abs(many) <= p99) == 991
    assert error_metrics(many[:0], many[:0], many[:0] > 0) == (0,) * 6


def test_a_power_law_is_found_again() -> None:
    x = np.array([16, 32, 64, 128])
    law = fit_power_law(x, 3.0 * x**-0.75)
    assert law.slope == pytest.approx(-0.75) and law.scale == pytest.approx(3.0)
    assert law.standard_error == pytest.approx(0, abs=1e-9) and law.n_points == 4
    np.testing.assert_allclose(law.at(x), 3.0 * x**-0.75)


def test_the_standard_error_is_that_of_numpy(rng: np.random.Generator) -> None:
    x = np.array([16, 32, 64, 128, 256])
    y = x**-0.5 * np.exp(0.1 * rng.normal(size=5))
    law = fit_power_law(x, y)
    coefficients, covariance = np.polyfit(np.log(x), np.log(y), 1, cov=True)
    assert law.slope == pytest.approx(coefficients[0])
    assert law.standard_error == pytest.approx(math.sqrt(covariance[0, 0]))


def test_what_cannot_be_fitted_has_no_slope() -> None:
    for x, y in (([], []), ([16], [0.1]), ([16, 64], [0.1, 0.0]), ([16, 16], [0.1, 0.2])):
        law = fit_power_law(x, y)
        assert (law.slope, law.standard_error) == (None, None)
        with pytest.raises(ValueError, match="fewer than two points"):
            law.at(4)
    assert fit_power_law([16, 64], [0.1, 0.05]).standard_error is None


def test_the_error_of_the_reference_is_taken_away(rng: np.random.Generator) -> None:
    estimate, reference = 0.4 * rng.normal(size=200_000), 0.3 * rng.normal(size=200_000)
    seen = float(np.sqrt(np.mean((estimate - reference) ** 2)))
    assert without_floor(seen, 0.3) == pytest.approx(0.4, rel=0.01)
    assert without_floor(0.1, 0.2) == 0


def test_the_peak_starts_anew() -> None:
    if not Path("/proc/self/clear_refs").exists():
        pytest.skip("needs Linux")
    assert reset_peak()
    small = 16 << 20

    def hold(n_bytes: int) -> int:
        return len(np.ones(n_bytes, np.uint8))

    _, cost = measured(hold, 256 << 20)
    assert cost.added_bytes is not None and abs(cost.added_bytes - (256 << 20)) < small
    assert cost.peak_is_own and cost.cpu_seconds > 0
    _, cost = measured(hold, n_bytes=64 << 20)
    assert cost.added_bytes is not None and abs(cost.added_bytes - (64 << 20)) < small
    assert reset_peak() and peak_bytes() - resident_bytes() < small


def test_where_the_peak_cannot_start_anew_nothing_is_claimed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("penumbra.memory._CLEAR_REFS", Path("/proc/self/no-such-file/x"))
    value, cost = measured(lambda: 7)
    assert (value, cost.added_bytes, cost.peak_is_own) == (7, None, False)
    # The system keeps both counts by page batches, so that the peak may lag behind a little.
    assert cost.peak_bytes > 0.9 * resident_bytes()


def test_tables() -> None:
    header, rows = ["name", "n"], [["a", "10"], ["long", "5"]]
    assert aligned_table(header, rows).splitlines() == ["name   n", "a     10", "long   5"]
    assert markdown_table(header, rows).splitlines()[1:3] == ["| --- | ---: |", "| a | 10 |"]


@pytest.fixture(scope="module")
def half_plane(tmp_path_factory: pytest.TempPathFactory) -> ErrorReport:
    """What is measured of the half-plane, by two backends."""
    options = ErrorOptions(
        resolution=(96, 72), samples=(16, 64, 256), reference=8192, backends=("hpc", "reference"), threads=1
    )
    return measure_error(half_plane_scene(tmp_path_factory.mktemp("half")), options)


def test_the_reference_knows_its_own_error(tmp_path: Path) -> None:
    scene = half_plane_scene(tmp_path)
    light = replace(scene.lights[0], samples=2048, sets=1)
    with open_scene(scene, [light], ["hpc"], memory=None, process_limit=False, threads=1) as here:
        reference = cast_reference(here, light, "hpc", NullProgress())
        truth = exact_visibility(here.seen.points)
    true_rms = np.sqrt(np.mean((reference.visibility - truth) ** 2))
    assert reference.rms == pytest.approx(true_rms, rel=0.25)
    assert abs(reference.visibility - truth).max() < 0.01


@pytest.mark.parametrize("samples", [16, 64, 256])
def test_errors_are_those_of_the_closed_form(half_plane: ErrorReport, samples: int) -> None:
    """The blocker's edge is parallel to the light's, and places all receivers evenly over its cells.

    A regular grid of n x n samples rounds to a whole column, so the error is even in +-1/2n. Jittered, the
    edge cuts n cells at a fraction f, each with a variance of f (1 - f) / n^4, 1/6 in the mean over f.
    """
    rms = {str(row.pattern): row.metrics.rms_penumbra for row in half_plane.rows if row.samples == samples}
    assert rms["regular, 1 set"] == pytest.approx(samples**-0.5 / math.sqrt(12), rel=0.02)
    assert rms["jittered, 8 sets"] == pytest.approx(samples**-0.75 / math.sqrt(6), rel=0.2)
    assert rms["jittered, 1 set"] == pytest.approx(samples**-0.75 / math.sqrt(6), rel=0.4)


def test_slopes_are_those_of_theory(half_plane: ErrorReport) -> None:
    slopes = {str(slope.pattern): slope.law.slope for slope in half_plane.slopes}
    assert slopes["regular, 1 set"] == pytest.approx(-0.5, abs=0.02)
    assert slopes["jittered, 8 sets"] == pytest.approx(-0.75, abs=0.06)
    # Nearer to -3/4 than to -1/2.
    assert -1.0 < (slopes["jittered, 1 set"] or 0) < -0.625


def test_a_report_says_what_was_measured(half_plane: ErrorReport) -> None:
    assert half_plane.n_receivers == 96 * 72 and half_plane.n_triangles == 4
    # A strip as wide as the light, of a picture 4/3 as wide as it is high.
    width = 2 * 0.9 * math.tan(math.radians(27.5)) * 4 / 3
    assert half_plane.penumbra_share == pytest.approx(1 / width, abs=0.02)
    assert len(half_plane.rows) == 3 * 3 * 2
    for hpc, reference in zip(half_plane.rows[::2], half_plane.rows[1::2], strict=True):
        assert (hpc.backend, reference.backend) == ("hpc", "reference")
        assert hpc.metrics == reference.metrics
        assert hpc.cost.seconds > 0 and hpc.cost.peak_bytes <= half_plane.peak_bytes
    assert "hpc and reference gave identical visibility in every row" in str(half_plane)


def test_files_parse_and_agree(half_plane: ErrorReport, tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("error.json", "error.csv", "error.png")]
    half_plane.write(paths)
    facts = json.loads(paths[0].read_text())
    with paths[1].open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [{k: str(v) for k, v in row.items()} for row in facts["rows"]] == rows
    assert len(rows) == 18 and rows[0]["pattern"] == "regular" and float(rows[0]["rms"]) > 0
    assert facts["backends_identical"] is True and len(facts["slopes"]) == 3
    assert paths[2].read_bytes().startswith(b"\x89PNG")


def test_rows_without_error_are_written_and_drawn(half_plane: ErrorReport, tmp_path: Path) -> None:
    none = error_metrics(np.zeros(0), np.zeros(0), np.zeros(0, bool))
    rows = [row._replace(metrics=none) for row in half_plane.rows if row.backend == "hpc"]
    report = replace(half_plane, rows=tuple(rows), slopes=fit_slopes(rows, 0.0), backends=("hpc",))
    report.write([tmp_path / name for name in ("error.json", "error.csv", "error.png")])
    assert json.loads((tmp_path / "error.json").read_text())["slopes"][0]["slope"] is None
    assert (tmp_path / "error.png").exists()
    assert "hpc alone" in str(report) and "none" in str(report)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"camera": penumbra.Camera((0, 5, 0), (0, 9, 0), up=(0, 0, 1))}, "the camera sees no surface"),
        ({"corner": [5, 2, -0.5]}, r"in penumbra of light 'key' \(each sees all of it\)"),
        ({"corner": [-6, 2, -0.5]}, r"in penumbra of light 'key' \(each sees none of it\)"),
    ],
)
def test_where_nothing_can_be_wrong_nothing_is_measured(
    change: dict[str, Any], words: str, tmp_path: Path
) -> None:
    scene = half_plane_scene(tmp_path)
    if "corner" in change:
        change = {"lights": (replace(scene.lights[0], **change),)}
    options = ErrorOptions(resolution=(8, 6), samples=(4, 16), reference=32, backends=("hpc",), threads=1)
    with pytest.raises(SceneError, match=words):
        measure_error(replace(scene, **change), options)


def test_different_backends_are_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(*arguments: Any, **named: Any) -> Any:
        result = penumbra.cast(*arguments, **named)
        if named["backend"] == "reference" and len(result.visibility) > 64:
            result.visibility[5] = 0.5
        return result

    monkeypatch.setattr(measured_scene, "cast", wrong)
    options = ErrorOptions(resolution=(24, 18), samples=(4,), reference=8, backends=("hpc", "reference"))
    with pytest.raises(BackendError, match=r"reference and hpc differ at 1 of 432 .*receiver 5: 0\.5"):
        measure_error(half_plane_scene(tmp_path), options)


def test_point_lights_are_refused(tmp_path: Path) -> None:
    scene = half_plane_scene(tmp_path)
    lamp = penumbra.PointLight([0, 2, 0], name="lamp")
    with pytest.raises(SceneError, match="nothing converges"):
        chosen_light(replace(scene, lights=(lamp,)), None)
    both = replace(scene, lights=(lamp, *scene.lights))
    assert chosen_light(both, None).name == "key" and chosen_light(both, "key").name == "key"
    with pytest.raises(SceneError, match="light 'lamp' is a point .* choose key"):
        chosen_light(both, "lamp")
    with pytest.raises(SceneError, match="no light 'sun': choose key"):
        chosen_light(both, "sun")


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"samples": ()}, "nothing to measure"),
        ({"samples": (0, 16)}, "whole numbers from 1 to 65536"),
        ({"samples": (16, 1 << 17)}, "whole numbers from 1 to 65536"),
        ({"samples": (16,), "reference": 24}, "even number from 32"),
        ({"samples": (16,), "reference": 33}, "even number from 32"),
        ({"samples": (65536,), "reference": 16384}, "even number from 131072"),
        ({"reference": 1 << 18}, "even number"),
        ({"backends": ("fast",)}, "no backend 'fast'"),
    ],
)
def test_options_that_cannot_be_measured(wrong: dict[str, Any], word: str) -> None:
    with pytest.raises((SceneError, BackendError), match=word):
        ErrorOptions(**wrong)


@pytest.mark.parametrize(("samples", "reference"), [(4, 16384), (1024, 16384), (20000, 131072)])
def test_the_reference_grows_with_the_samples(samples: int, reference: int) -> None:
    assert ErrorOptions(samples=(samples,)).reference == reference


@pytest.mark.parametrize("memory", ["32MiB", "224MiB"])
def test_a_limit_that_is_too_low_is_refused_early(memory: str, tmp_path: Path) -> None:
    """The second is enough for a render in passes, not for all receivers at once."""
    camera = replace(half_plane_scene(tmp_path).camera, resolution=(1280, 960))
    scene = replace(half_plane_scene(tmp_path), camera=camera)
    how: dict[str, Any] = {"backends": ["hpc", "gears"], "process_limit": False, "threads": 1}
    lights = [replace(scene.lights[0], samples=8192, sets=1)]
    with pytest.raises(MemoryLimitError, match="or a smaller --resolution") as refusal:
        open_scene(scene, lights, memory=memory, **how).__enter__()
    assert "1280 x 960 receivers with 8192 light samples" in str(refusal.value)
    assert "--crop" not in str(refusal.value)
    enough = re.search(r"give (\d+)MiB", str(refusal.value))
    assert enough is not None
    # What it names is enough to open the scene and for the largest cast, which is done in passes.
    with open_scene(scene, lights, memory=f"{enough[1]}MiB", **how) as here:
        assert here.cast_bytes < here.plan.limit_bytes


def test_casts_have_their_memory_however_much_the_process_has_grown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = half_plane_scene(tmp_path)
    light = replace(scene.lights[0], samples=512, sets=8)
    how: dict[str, Any] = {"memory": None, "process_limit": False, "threads": 1}
    with open_scene(scene, [light], ["hpc", "gears"], **how) as here:
        expected = here.cast(light, "hpc").visibility
        monkeypatch.setattr(measured_scene, "resident_bytes", lambda: here.plan.limit_bytes + 1)
        for backend in ("hpc", "gears"):
            np.testing.assert_array_equal(here.cast(light, backend).visibility, expected)


def test_the_command(scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = scene_file.parent / "new" / "measured"
    command = ["bench", "error", str(scene_file), *QUICK, "--backend", "hpc", "-o", str(folder)]
    assert run(command) == 0
    out, err = capsys.readouterr()
    assert sorted(path.name for path in folder.iterdir()) == FILES
    assert out.splitlines()[-3:] == [str(folder / name) for name in ("error.json", "error.csv", "error.png")]
    assert "square.toml, light key, 4 triangles" in out and "jittered, 8 sets" in out
    assert "done: measure: 6 casts" in err
    facts = json.loads((folder / "error.json").read_text())
    assert facts["scene_path"] == str(scene_file.resolve()) and facts["is_complete"]
    assert datetime.now(UTC) - datetime.fromisoformat(facts["date"]) < timedelta(minutes=10)
    assert facts["camera"]["resolution"] == [24, 18] and len(facts["camera"]["eye"]) == 3
    assert set(facts["light_settings"]) == {"type", "corner", "edge_u", "edge_v", "radiance", "two_sided"}
    assert facts["resolution"] == [24, 18] and facts["peak_bytes"] <= facts["limit_bytes"]
    assert run(command) == 1
    assert "is there already: give --overwrite" in capsys.readouterr().err
    assert run(["-q", *command, "--overwrite", "--seed", "3"]) == 0
    assert capsys.readouterr().err == ""
    again = json.loads((folder / "error.json").read_text())
    rms = [[row["rms"] for row in found["rows"] if row["pattern"] == "jittered"] for found in (facts, again)]
    assert rms[0] != rms[1]


def test_without_a_folder_nothing_is_written(scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted(scene_file.parent.iterdir())
    assert run(["bench", "-q", "error", str(scene_file), *QUICK, "--backend", "hpc"]) == 0
    assert capsys.readouterr().out.startswith("scene      square.toml")
    assert sorted(scene_file.parent.iterdir()) == before


def test_the_example_for_python_runs(scene_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).resolve().parents[1] / "docs" / "error.md").read_text()
    (block,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(scene_file.parent)
    names: dict[str, Any] = {}
    exec(block.replace("scene.toml", scene_file.name), names)
    assert len(names["report"].rows) == 2 * 3 * 2


def test_a_missing_matplotlib_is_said_before_any_work(
    scene_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    folder = scene_file.parent / "measured"
    assert run(["bench", "error", str(scene_file), *QUICK, "-o", str(folder)]) == 1
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1 and not folder.exists()
    assert "pip install 'penumbra-render[bench]'" in err


def test_a_broken_matplotlib_is_said_before_any_work(
    scene_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(name: str) -> None:
        if name == "matplotlib.backends.backend_agg":
            raise RuntimeError("built for another numpy\nand a page of advice")

    monkeypatch.setattr(plots, "import_module", broken)
    assert run(["bench", "error", str(scene_file), *QUICK, "-o", str(scene_file.parent / "measured")]) == 1
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1
    assert "installed but broken (RuntimeError: built for another numpy)" in err


def test_a_plot_that_fails_costs_no_number(
    scene_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise ValueError("no font")

    monkeypatch.setattr(plots, "draw_error", fails)
    folder = scene_file.parent / "measured"
    assert run(["bench", "-q", "error", str(scene_file), *QUICK, "--backend", "hpc", "-o", str(folder)]) == 1
    out, err = capsys.readouterr()
    assert "error of visibility" in out and "no font" in err and len(err.splitlines()) == 1
    assert sorted(path.name for path in folder.iterdir()) == ["error.csv", "error.json"]


def test_files_that_cannot_be_written_cost_no_table(
    scene_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(error_report, "write_outputs", fails)
    folder = scene_file.parent / "measured"
    assert run(["bench", "-q", "error", str(scene_file), *QUICK, "--backend", "hpc", "-o", str(folder)]) == 1
    out, err = capsys.readouterr()
    assert "error of visibility" in out and str(folder) not in out and "No space left" in err


@pytest.mark.parametrize(
    ("stop", "code"), [(KeyboardInterrupt(), 130), (Interrupted("stopped by SIGTERM", 75), 75)]
)
def test_what_was_finished_is_printed_when_it_is_stopped(
    stop: BaseException,
    code: int,
    scene_file: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of the fourth row one backend is cast and the other is not, so that three are told."""
    n_casts = 0

    def stopping(*arguments: Any, **named: Any) -> Any:
        nonlocal n_casts
        n_casts += 1
        if n_casts == 7:
            raise stop
        return fastest(*arguments, **named)

    fastest = error._fastest_cast
    monkeypatch.setattr(error, "_fastest_cast", stopping)
    folder = scene_file.parent / "measured"
    assert run(["bench", "error", str(scene_file), *QUICK, "-o", str(folder)]) == code
    out, err = capsys.readouterr()
    assert out.startswith("INCOMPLETE: the measuring was stopped when 6 rows are finished")
    assert out.count("regular, 1 set") == 2 * 2 + 1 and out.count("jittered, 8 sets") == 0
    assert "stopped by" in err and not list(folder.iterdir())


def test_a_reference_in_passes_is_one_line(tmp_path: Path) -> None:
    scene = half_plane_scene(tmp_path)
    stream = io.StringIO()
    triangles = np.array([[[-90, 1, -90], [0, 1, -90], [0, 1, 90]]], np.float64)
    points = np.zeros((5000, 3))
    for memory, n_passes in (("1GiB", 1), ("1MiB", 2)):
        progress = LogProgress(stream)
        penumbra.cast(points, triangles, scene.lights[0], memory=memory, keep="visibility", progress=progress)
        progress.close()
        lines = [line for line in stream.getvalue().splitlines() if line.startswith("done: cast")]
        assert len(lines) == 1 and f" {n_passes} triangles" in lines[0]
        stream.seek(0)
        stream.truncate()


def test_labels_of_the_plot_do_not_overlap(
    half_plane: ErrorReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures: list[Any] = []
    monkeypatch.setattr(plots, "save_figure", lambda figure, path: figures.append(figure))
    # Many points, close to each other.
    rows = [
        row._replace(samples=row.samples + extra, cost=row.cost._replace(cpu_seconds=1 + row.samples / 1e4))
        for extra in range(5)
        for row in half_plane.rows
    ]
    plots.draw_error(replace(half_plane, rows=tuple(rows)), tmp_path / "error.png")
    (figure,) = figures
    figure.draw_without_rendering()
    by_samples, by_seconds = figure.axes
    assert by_seconds.get_xlabel().startswith("processor seconds") and len(by_seconds.lines) == 3 * 2
    for texts in (by_seconds.texts, by_samples.get_xticklabels(), by_seconds.get_xticklabels()):
        boxes = [text.get_window_extent() for text in texts if text.get_text()]
        assert boxes
        assert not any(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[:k])


@pytest.mark.parametrize(
    ("arguments", "code", "word"),
    [
        (["--samples", "16,x"], 2, "write it as 16,64,256"),
        (["--samples", "0"], 2, "write it as 16,64,256"),
        (["--backend", "auto"], 2, "auto"),
        (["--resolution", "20"], 2, "write it as 1280x960"),
        (["--samples", "64", "--reference", "64"], 2, "even number from 128"),
        (["--samples", "64", "--reference", "129"], 2, "even number from 128"),
        (["--samples", "70000"], 2, "whole numbers from 1 to 65536"),
        (["--backend", "gear"], 2, "hpc"),
        (["--light", "sun"], 1, "no light 'sun'"),
        (["--memory", "16MiB"], 3, "memory limit"),
    ],
)
def test_mistakes_of_a_user(
    arguments: list[str], code: int, word: str, scene_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["bench", "error", str(scene_file), *arguments]) == code
    out, err = capsys.readouterr()
    assert out == "" and word in err and "Traceback" not in err


def test_outputs_are_checked_first(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("{}")
    with pytest.raises(penumbra.errors.OutputError, match="is there already"):
        prepare_outputs(tmp_path, ["a.json"], overwrite=False)
    assert prepare_outputs(tmp_path, ["a.json"], overwrite=True) == [tmp_path / "a.json"]
    with pytest.raises(penumbra.errors.OutputError, match="cannot make the folder"):
        prepare_outputs(tmp_path / "a.json" / "b", ["c"], overwrite=False)


def test_a_folder_that_cannot_be_written_is_refused_first() -> None:
    if not Path("/proc/self").is_dir():
        pytest.skip("needs a folder that nobody can write in")
    with pytest.raises(penumbra.errors.OutputError, match="choose another"):
        prepare_outputs(Path("/proc/self"), ["a.json"], overwrite=False)
