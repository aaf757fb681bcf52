"""Arguments of `penumbra.cast` and of lights that are refused, each in one sentence that names the row."""

from typing import Any

import numpy as np
import pytest
from scenes import light_named

import penumbra
from penumbra import RectLight
from penumbra.errors import BackendError, SceneError

BAD_INPUT = {
    "a point that is not a number": ({"points": [[0, 0, 0], [0, np.nan, 0]]}, "points row 1 "),
    "an infinite point": ({"points": [[np.inf, 0, 0]]}, "points row 0 "),
    "points of two numbers": ({"points": [[0, 0], [1, 1]]}, r"points has shape \(2, 2\)"),
    "points of words": ({"points": [["a", "b", "c"]]}, "points cannot be read"),
    "a normal of zero": (
        {"points": np.zeros((3, 3)), "normals": [[0, 0, 1], [0, 1, 0], [0, 0, 0]]},
        "normals row 2 ",
    ),
    "a normal that is not a number": ({"normals": [[0, 0, np.nan]]}, "normals row 0 "),
    "too few normals": ({"points": np.zeros((2, 3)), "normals": [[0, 0, 1]]}, "normals has shape"),
    "too many own": ({"own": [1, 2]}, "own has shape"),
    "fractional own": ({"own": [0.5]}, "own has"),
    "a blocker that is not a number": (
        {"blockers": np.where(np.arange(18).reshape(2, 3, 3) == 12, np.nan, 1.0)},
        "blockers row 1 ",
    ),
    "blockers of two corners": ({"blockers": np.zeros((4, 2, 3))}, r"blockers has shape \(4, 2, 3\)"),
    "keep what there is not": ({"keep": "bits"}, "keep is 'bits'"),
    "complex points": ({"points": np.zeros((2, 3)) * 1j}, "points cannot be read"),
    "points with no coordinates": ({"points": np.zeros((5, 0))}, r"points has shape \(5, 0\)"),
    "own beyond an int64": ({"own": np.array([2**64 - 1], np.uint64)}, "own row 0 "),
    "memory that is not a size": ({"memory": "much"}, "is not a size"),
}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_is_refused_in_one_sentence(case: str) -> None:
    given, message = BAD_INPUT[case]
    arguments: dict[str, Any] = {"points": np.zeros((1, 3)), "blockers": np.zeros((1, 3, 3))} | given
    points, blockers = arguments.pop("points"), arguments.pop("blockers")
    with pytest.raises(SceneError, match=message) as error:
        penumbra.cast(points, blockers, light_named("skewed", 8), **arguments)
    assert "\n" not in str(error.value)


def test_a_backend_that_there_is_not() -> None:
    with pytest.raises(BackendError, match="no backend 'hcp'"):
        penumbra.cast(np.zeros((1, 3)), np.zeros((0, 3, 3)), light_named("skewed", 8), backend="hcp")


@pytest.mark.parametrize(
    "change",
    [
        {"corner": (0, np.nan, 0)},
        {"edge_u": (np.inf, 0, 0)},
        {"edge_v": (1, 2)},
        {"samples": 0},
        {"sets": 0},
        {"seed": 2**70},
    ],
    ids=str,
)
def test_lights_that_are_not_finite_are_refused(change: dict[str, Any]) -> None:
    good: dict[str, Any] = {"corner": (0, 0, 1), "edge_u": (1, 0, 0), "edge_v": (0, 1, 0), "name": "lamp"}
    with pytest.raises(SceneError, match=f"{next(iter(change))} of light 'lamp'"):
        RectLight(**good | change)


@pytest.mark.parametrize("exponent", [-320, -160, 140, 160, 300])
def test_lights_of_any_size_have_samples_or_are_refused(exponent: int) -> None:
    edge = float(f"1e{exponent}")
    try:
        samples = RectLight((0, 0, 0), (edge, 0, 0), (0, edge, 0), samples=16).sample_points
    except SceneError:
        return
    assert (samples[..., :2] >= 0.0).all()
    assert (samples[..., :2] <= edge).all()


def test_a_light_that_is_none_and_one_beyond_all_numbers() -> None:
    with pytest.raises(SceneError, match="light is None"):
        penumbra.cast(np.zeros((1, 3)), np.zeros((0, 3, 3)), None)  # type: ignore[arg-type]
    with pytest.raises(SceneError, match="light 'light' reaches beyond"):
        RectLight((1e308, 3, 0), (1e308, 0, 0), (0, 0, 1))
