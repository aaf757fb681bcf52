"""`bench scaling`: exponents of exact laws, and the command from scene file to files."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from penumbra import RectLight
from penumbra.cli.main import run
from penumbra.errors import SceneError
from penumbra.measure.scaling import ScalingOptions, scaled_edges
from penumbra.measure.scaling_report import QUANTITIES, ScalingReport, ScalingRow, fit_exponents
from penumbra.measure.side_by_side import Pass, Rounds, Spread


def row(axis: str, x: float, seconds: float, pairs: int = 1, embree: float | None = None) -> ScalingRow:
    """A row at one place of an axis, of three rounds whose median is `seconds`."""
    passes = tuple(Pass(seconds * factor, 1.0, 1 << 20) for factor in (0.9, 1.0, 1.5))
    theirs = () if embree is None else tuple(Pass(embree, 1.0, None) for _ in passes)
    case = {"n_receivers": x, "samples": x, "light_area": x}
    stats = {"pairs_tested": pairs, "nodes_visited": 0}
    rounds = Rounds(passes, theirs, True, 10, stats)
    return ScalingRow("made", axis, case, {"triangles": x, "store_bytes": 1}, {}, rounds)


@pytest.mark.parametrize("axis", ["triangles", "resolution", "samples", "area"])
@pytest.mark.parametrize("slope", [-0.5, 0.0, 0.25, 1.0])
def test_exponent_of_an_exact_law(axis: str, slope: float) -> None:
    rows = [row(axis, x, 3.0 * x**slope, embree=2.0 * x) for x in (16.0, 64.0, 256.0)]
    laws = {e.quantity: e.law for e in fit_exponents(rows)}
    assert set(laws) == set(QUANTITIES)
    assert laws["our_cpu_seconds"].slope == pytest.approx(slope, abs=1e-12)
    assert laws["our_cpu_seconds"].scale == pytest.approx(3.0)
    assert laws["our_cpu_seconds"].standard_error == pytest.approx(0.0, abs=1e-6)
    assert laws["embree_cpu_seconds"].slope == pytest.approx(1.0)
    assert laws["nodes_visited"].slope is None  # zero has no logarithm


def test_standard_error_of_a_noisy_law() -> None:
    x = np.array([1.0, 10.0, 100.0, 1000.0])
    noise = np.array([1.1, 0.8, 1.3, 0.9])
    rows = [row("samples", a, a**0.5 * n) for a, n in zip(x, noise, strict=True)]
    (law,) = (e.law for e in fit_exponents(rows) if e.quantity == "our_cpu_seconds")
    fitted, covariance = np.polyfit(np.log(x), np.log(x**0.5 * noise), 1, cov=True)
    assert law.slope == pytest.approx(fitted[0])
    assert law.standard_error == pytest.approx(np.sqrt(covariance[0, 0]))


def test_embree_has_no_exponent_where_it_was_not_measured() -> None:
    exponents = fit_exponents([row("area", x, x) for x in (1.0, 2.0)])
    assert "embree_cpu_seconds" not in {e.quantity for e in exponents}
    report = ScalingReport(tuple(row("area", x, x) for x in (1.0, 2.0)), 1, "hpc", 3, {})
    assert "Embree" not in str(report)
    json.dumps(report.as_dict(), allow_nan=False)


def test_ratios_are_taken_round_by_round() -> None:
    rounds = Rounds(
        (Pass(1.0, 1.0, 0), Pass(2.0, 1.0, 0), Pass(4.0, 1.0, 0)),
        (Pass(3.0, 2.0, 0), Pass(4.0, 2.0, 0), Pass(4.0, 2.0, 0)),
        True,
        0,
        {},
    )
    assert rounds.ratio("cpu_seconds") == Spread(2.0, 1.0, 3.0)
    assert rounds.ratio("wall_seconds") == Spread(2.0, 2.0, 2.0)


def test_a_scaled_light_keeps_its_centre() -> None:
    light = RectLight([1, 2, 3], [2, 0, 1], [0, 0.5, 3])
    larger = RectLight(**scaled_edges(light, 2.0))
    assert larger.area == pytest.approx(4 * light.area)
    assert larger.corner + 0.5 * (larger.edge_u + larger.edge_v) == pytest.approx(
        light.corner + 0.5 * (light.edge_u + light.edge_v)
    )


def test_unknown_axis() -> None:
    with pytest.raises(SceneError, match="no axis 'weather': use triangles resolution samples area"):
        ScalingOptions(axes=("weather",))


def test_command_measures_every_axis(
    scene_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    arguments = ["-q", "bench", "scaling", str(scene_file), "-o", str(tmp_path / "out")]
    arguments += [
        "--resolution",
        "16x12",
        "--samples",
        "16",
        "--levels",
        "1",
        "--rounds",
        "1",
        "--threads",
        "1",
    ]
    assert run(arguments) == 0
    out = capsys.readouterr().out
    for axis in ("triangles", "resolution", "samples", "area"):
        assert f"square by {axis}" in out
    facts = json.loads((tmp_path / "out" / "scaling.json").read_text())
    x = {
        axis: [r["x"] for r in facts["rows"] if r["axis"] == axis]
        for axis in ("triangles", "samples", "area")
    }
    assert x == {"triangles": [4, 16], "samples": [4, 16, 64], "area": [0.25, 1, 4]}
    assert [r["n_changed_bits"] for r in facts["rows"] if r["axis"] == "triangles"] == [None, 0]
    pixels = [r["n_receivers"] for r in facts["rows"] if r["axis"] == "resolution"]
    assert pixels == sorted(pixels) and pixels[0] > 0
    with (tmp_path / "out" / "scaling.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == len(facts["rows"]) == 11
    assert (tmp_path / "out" / "scaling.png").read_bytes().startswith(b"\x89PNG")
    assert run(arguments) == 1  # it is there already
    assert "--overwrite" in capsys.readouterr().err
