"""The public names, and that they are what the documentation says whatever was imported before."""

import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import penumbra

PUBLIC = {
    "Camera",
    "CastOptions",
    "IngestOptions",
    "MeshRef",
    "PointLight",
    "RectLight",
    "Scene",
    "__version__",
    "camera_receivers",
    "cast",
    "errors",
    "ingest",
    "open_store",
    "render",
}


def test_public_names() -> None:
    assert set(penumbra.__all__) == PUBLIC
    assert set(dir(penumbra)) >= PUBLIC
    assert all(getattr(penumbra, name) is not None for name in PUBLIC)


def test_unknown_names_are_refused() -> None:
    with pytest.raises(AttributeError, match="shadows"):
        penumbra.shadows  # noqa: B018


@pytest.mark.parametrize(
    "first", ["import penumbra.ingest, penumbra.render", "from penumbra.render import render"]
)
def test_functions_are_not_hidden_by_the_modules_they_live_in(first: str) -> None:
    code = (
        f"{first}\nimport penumbra, types\nprint(*(callable(f) for f in (penumbra.ingest, penumbra.render)))"
    )
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "True"]


PARAMETERS = {
    "ingest": "meshes output *memory *overwrite *skip_bad *options *scratch *progress",
    "cast": "points blockers light *normals *own *index *backend *memory *threads *progress *keep *options",
    "render": "scene output *memory *backend *threads *crop *seed *samples *resolution *preview *stats "
    "*scratch *resume *overwrite *progress",
    "RectLight": "corner edge_u edge_v samples sets seed two_sided",
    "PointLight": "position intensity name",
}


@pytest.mark.parametrize("name", PARAMETERS)
def test_parameters_of_public_calls(name: str) -> None:
    parameters = inspect.signature(getattr(penumbra, name)).parameters
    for word in PARAMETERS[name].split():
        parameter = parameters[word.lstrip("*")]
        assert word[0] != "*" or parameter.kind is inspect.Parameter.KEYWORD_ONLY
