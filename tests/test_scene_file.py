"""Scene files: what they say, and one sentence with file, line and key for what is wrong in them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from penumbra.errors import SceneError
from penumbra.lights import RectLight
from penumbra.scene import Camera, MeshRef, Scene

LIGHT = '[[light]]\nname = "fill"\ncorner = [0, 9, 0]\nedge_u = [1, 0, 0]\nedge_v = [0, 0, 1]\n'


def test_every_key_arrives(scene_file: Path) -> None:
    scene = Scene.load(scene_file)
    (mesh,), camera, (light,) = scene.geometry, scene.camera, scene.lights
    assert scene.path == scene_file
    assert mesh.path == scene_file.parent / "square.obj" and mesh.matrix() is None
    assert camera == Camera((0, 3, 5), (0, 0.3, 0), (0, 1, 0), 40, (32, 24))
    assert (light.name, light.samples, light.sets, light.radiance, light.two_sided) == (
        "key",
        16,
        8,
        10.0,
        False,
    )
    np.testing.assert_array_equal(
        [light.corner, light.edge_u, light.edge_v], [[-0.5, 3, -0.5], [1, 0, 0], [0, 0, 1]]
    )


def test_defaults_and_optional_keys(scene_file: Path) -> None:
    rows = [2, 0, 0, 1, 0, 2, 0, 0, 0, 0, 2, -1, 0, 0, 0, 1]
    text = scene_file.read_text().replace("vfov = 40\nresolution = [32, 24]\n", "")
    text = text.replace('path = "square.obj"', f'path = "square.obj"\ntransform = {rows}\nup = "z"')
    scene_file.write_text(text + "two_sided = true\nsets = 1\n\n" + LIGHT)
    scene = Scene.load(scene_file)
    assert (scene.camera.vfov, scene.camera.resolution, scene.camera.up) == (
        45.0,
        (1280, 960),
        (0.0, 1.0, 0.0),
    )
    assert [(light.name, light.samples, light.sets) for light in scene.lights] == [
        ("key", 16, 1),
        ("fill", 256, 8),
    ]
    matrix = scene.geometry[0].matrix()
    assert matrix is not None
    # (x, y, z) -> (x, z, -y), then doubled and moved by (1, 0, -1).
    np.testing.assert_array_equal(matrix @ [3.0, 5.0, 7.0, 1.0], [2 * 3 + 1, 2 * 7, 2 * -5 - 1, 1])


def test_paths_are_relative_to_the_scene_file(scene_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (scene_file.parent / "elsewhere").mkdir()
    monkeypatch.chdir(scene_file.parent / "elsewhere")
    assert Scene.load(Path("..") / scene_file.name).geometry[0].path.is_file()


def test_overrides(scene_file: Path) -> None:
    scene = Scene.load(scene_file)
    other = scene.with_overrides(resolution=(8, 4), samples=9, seed=3)
    assert other.camera.resolution == (8, 4)
    assert (other.lights[0].samples, other.lights[0].seed, other.lights[0].name) == (9, 3, "key")
    assert scene.camera.resolution == (32, 24) and scene.lights[0].seed == 0
    assert scene.with_overrides().lights == scene.lights


# What is replaced, by what, and the words that the sentence must have.
WRONG = {
    "unknown key": ("vfov = 40", "vfow = 40", [":7:", "'vfow'", "nearest valid key is 'vfov'"]),
    "unknown table": ("[camera]", "[camra]", [":4:", "'camra'", "'camera'"]),
    "unknown light key": ("radiance", "radience", [":17:", "'radience'", "'radiance'"]),
    "missing key": ("eye = [0, 3, 5]\n", "", [":4:", "'eye' is missing in [camera]"]),
    "missing light name": ('name = "key"\n', "", ["'name' is missing in [[light]]"]),
    "one table for light": ("[[light]]", "[light]", [":10:", "[[light]]"]),
    "nan": ("[0, 3, 5]", "[0, nan, 5]", [":5:", "'eye'", "finite"]),
    "infinite radiance": ("10.0", "inf", [":17:", "'radiance'"]),
    "integer beyond floats": ("10.0", "1" + "0" * 400, [":17:", "'radiance'"]),
    "two numbers": ("[0, 3, 5]", "[0, 3]", [":5:", "'eye'", "three"]),
    "text for a number": ("vfov = 40", 'vfov = "40"', [":7:", "'vfov'"]),
    "true for a number": ("samples = 16", "samples = true", [":16:", "'samples'"]),
    "fraction of a sample": ("samples = 16", "samples = 1.5", [":16:", "'samples'"]),
    "no sample": ("samples = 16", "samples = 0", [":16:", "samples"]),
    "zero view": ("[0, 0.3, 0]", "[0, 3, 5]", [":6:", "look_at"]),
    "parallel up": ("vfov = 40", "up = [0, 5.4, 10]", [":7:", "up", "parallel"]),
    "zero up": ("vfov = 40", "up = [0, 0, 0]", [":7:", "up"]),
    "flat vfov": ("vfov = 40", "vfov = 0", [":7:", "vfov", "between 0 and 180"]),
    "turned vfov": ("vfov = 40", "vfov = 180", [":7:", "vfov"]),
    "empty picture": ("[32, 24]", "[32, 0]", [":8:", "resolution"]),
    "half a pixel": ("[32, 24]", "[32, 2.5]", [":8:", "resolution"]),
    "dotted name": ('"key"', '"key.left"', [":11:", "'key.left'", "dot"]),
    "empty name": ('"key"', '" "', [":11:", "'name'"]),
    "unknown light type": ('"rect"', '"disk"', [":12:", "'type'", '"rect"']),
    "no such mesh": ("square.obj", "circle.obj", [":2:", "'path'", "circle.obj"]),
    "mesh is a folder": ("square.obj", ".", [":2:", "'path'"]),
    "up of a mesh": ('square.obj"', 'square.obj"\nup = "x"', [":3:", "'up'"]),
    "short transform": ('square.obj"', 'square.obj"\ntransform = [1, 0, 0]', [":3:", "'transform'", "16"]),
    "projective transform": (
        'square.obj"',
        f'square.obj"\ntransform = {[1] * 16}',
        [":3:", "transform", "last row"],
    ),
    "not TOML": ("[camera]", "[camera", ["not valid TOML", "line 4"]),
    "no light": ("[[light]]", "[camera.light]", ["there is no [[light]]", "at least one light"]),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_files_get_one_sentence(case: str, scene_file: Path) -> None:
    old, new, words = WRONG[case]
    text = scene_file.read_text()
    assert old in text
    scene_file.write_text(text.replace(old, new, 1))
    _refused(scene_file, words)


@pytest.mark.parametrize("name", ["R", "G", "B", "A", "P", "N", "Z", "id"])
def test_reserved_light_names(name: str, scene_file: Path) -> None:
    scene_file.write_text(scene_file.read_text().replace('"key"', f'"{name}"'))
    _refused(scene_file, [":11:", f"'{name}'", "reserved"])


@pytest.mark.parametrize("name", ["k" * 201, "a\\u0000b", "a\\nb"])
def test_light_names_that_cannot_name_a_layer(name: str, scene_file: Path) -> None:
    scene_file.write_text(scene_file.read_text().replace('"key"', f'"{name}"'))
    _refused(scene_file, [":11:", "too long or has characters that do not print"])


def test_names_must_differ(scene_file: Path) -> None:
    scene_file.write_text(scene_file.read_text() + LIGHT.replace("fill", "key"))
    _refused(scene_file, [":19:", "'key'", "two lights"])


@pytest.mark.parametrize("kind", ["geometry", "camera", "light"])
def test_every_kind_is_needed(kind: str, scene_file: Path) -> None:
    tables = scene_file.read_text().split("\n\n")
    scene_file.write_text("\n\n".join(table for table in tables if f"[{kind}]" not in table))
    _refused(scene_file, [kind, "a scene needs"])


def test_files_that_are_no_text(tmp_path: Path) -> None:
    (tmp_path / "latin.toml").write_bytes(b"# Stra\xdfe\n[camera]\n")
    _refused(tmp_path / "latin.toml", ["UTF-8", "byte 6"])
    _refused(tmp_path / "absent.toml", ["cannot read the scene file"])
    _refused(tmp_path, ["cannot read the scene file"])


def test_byte_order_mark_and_windows_line_ends(scene_file: Path) -> None:
    scene_file.write_bytes(b"\xef\xbb\xbf" + scene_file.read_bytes().replace(b"\n", b"\r\n"))
    assert Scene.load(scene_file).lights[0].name == "key"


def test_a_store_is_not_moved(scene_file: Path) -> None:
    (scene_file.parent / "s.h5").touch()
    scene_file.write_text(scene_file.read_text().replace('square.obj"', 's.h5"\nup = "z"'))
    _refused(scene_file, ["s.h5", "cannot be moved"])


def test_python_scenes_are_checked_too(square_obj: Path) -> None:
    light = RectLight((0, 3, 0), (1, 0, 0), (0, 0, 1))
    camera = Camera((0, 3, 5), (0, 0, 0))
    with pytest.raises(SceneError, match="no geometry"):
        Scene((), camera, (light,))
    with pytest.raises(SceneError, match="no light"):
        Scene((MeshRef(square_obj),), camera, ())
    with pytest.raises(SceneError, match="two lights"):
        Scene((MeshRef(square_obj),), camera, (light, light))


@pytest.mark.parametrize(
    "wrong",
    [
        {"eye": "abc"},
        {"eye": (0, 1)},
        {"look_at": 7},
        {"up": (0, float("inf"), 0)},
        {"vfov": float("nan")},
        {"resolution": 640},
        {"resolution": (640, 480, 3)},
        {"resolution": (640.0, 480)},
    ],
)
def test_python_cameras_are_checked_too(wrong: dict[str, Any]) -> None:
    with pytest.raises(SceneError, match=next(iter(wrong))):
        Camera(**{"eye": (0, 3, 5), "look_at": (0, 0, 0), **wrong})


finite = st.floats(-100, 100, allow_subnormal=False)
vectors = st.tuples(finite, finite, finite)


@given(vectors, vectors, vectors, st.floats(1, 170), st.integers(1, 50), st.integers(1, 50))
def test_camera_frame(eye: tuple, look_at: tuple, up: tuple, vfov: float, width: int, height: int) -> None:  # type: ignore[type-arg]
    view = np.subtract(look_at, eye)
    if np.linalg.norm(np.cross(view, up)) <= 1e-3 * np.linalg.norm(view) * np.linalg.norm(up):
        return
    frame = Camera(eye, look_at, up, vfov, (width, height)).frame()
    x, y = (width - 1) / 2, (height - 1) / 2
    # The middle of the picture looks at the target; right, down and forward are right-handed and square.
    np.testing.assert_allclose(frame.d0 + x * frame.dx + y * frame.dy, view / np.linalg.norm(view), atol=1e-9)
    across = np.cross(frame.dx, frame.dy)
    np.testing.assert_allclose(across / np.linalg.norm(across), frame.forward, atol=1e-9)
    assert np.linalg.norm(frame.dx) == pytest.approx(np.linalg.norm(frame.dy))
    assert frame.dy @ np.array(up) < 0
    # The upper and lower edge of the picture are vfov apart, and forward . direction is 1 everywhere.
    top, bottom = (frame.d0 + x * frame.dx + edge * frame.dy for edge in (-0.5, height - 0.5))
    cosine = top @ bottom / (np.linalg.norm(top) * np.linalg.norm(bottom))
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) == pytest.approx(vfov, abs=1e-4)
    assert frame.forward @ (frame.d0 + (width - 1) * frame.dx) == pytest.approx(1)


def _refused(path: Path, words: list[str]) -> None:
    with pytest.raises(SceneError) as caught:
        Scene.load(path)
    message = str(caught.value)
    assert "\n" not in message and path.name in message
    for word in words:
        assert word in message, message
