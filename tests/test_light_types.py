"""Types of lights from scene file to picture: a point beside a rectangle, patterns, and what is refused."""

import json
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

import penumbra
from penumbra import PointLight, RectLight
from penumbra.cli.main import run
from penumbra.errors import OutputError, SceneError
from penumbra.io.exr import read_header, read_layers
from penumbra.render import plan_render
from penumbra.scene import Scene
from penumbra.settings import settings_hash, settings_of

LAMP = '\n[[light]]\nname = "lamp"\ntype = "point"\nposition = [0.9, 2, 0.4]\nintensity = 40\n'


@pytest.fixture
def both(scene_file: Path) -> Path:
    """The small scene with a point light beside its rectangle."""
    scene_file.write_text(scene_file.read_text() + LAMP)
    return scene_file


@pytest.fixture
def lamp_only(scene_file: Path) -> Path:
    """The small scene with a point light in place of its rectangle."""
    scene_file.write_text(scene_file.read_text().split("\n[[light]]")[0] + LAMP)
    return scene_file


def test_a_point_light_arrives(both: Path) -> None:
    rect, lamp = Scene.load(both).lights
    assert isinstance(rect, RectLight) and isinstance(lamp, PointLight)
    assert (lamp.name, lamp.position.tolist(), lamp.intensity) == ("lamp", [0.9, 2.0, 0.4], 40.0)
    both.write_text(both.read_text().replace("intensity = 40\n", ""))
    assert Scene.load(both).lights[1].settings()["intensity"] == 1.0


def test_overrides_leave_points_alone(both: Path) -> None:
    scene = Scene.load(both)
    rect, lamp = scene.with_overrides(samples=9, seed=3).lights
    assert (rect.samples, rect.seed) == (9, 3)
    assert lamp is scene.lights[1]


# What is replaced in the scene of both lights, by what, and the words that the sentence must have.
WRONG = {
    "type forgotten": ('type = "point"\n', "", [":21:", "'position' is a key", ': add type = "point"']),
    "type forgotten, intensity first": (
        'type = "point"\nposition = [0.9, 2, 0.4]\nintensity = 40',
        "intensity = 40\nposition = [0.9, 2, 0.4]",
        [":21:", "'intensity' is a key", ': add type = "point" ([[light]] 2)'],
    ),
    "type rect for point": ('"point"', '"rect"', [":22:", "'position'", 'change type to "point"']),
    "type point for rect": ('"rect"', '"point"', [":13:", "'corner'", 'change type to "rect"']),
    "samples of a point": ("intensity", "samples", [":23:", "has one sample: leave 'samples' out"]),
    "sets of a point": ("intensity", "sets", [":23:", "has one sample: leave 'sets' out"]),
    "pattern of a point": (
        "intensity = 40",
        'pattern = "regular"',
        [":23:", "has one sample: leave 'pattern' out"],
    ),
    "radiance of a point": ("intensity", "radiance", [":23:", "a point light has 'intensity'"]),
    "intensity of a rect": ("radiance", "intensity", [":17:", "a rect light has 'radiance'"]),
    "point shining to a side": (
        "intensity = 40",
        "two_sided = false",
        [":23:", "shines all round: leave 'two_sided' out"],
    ),
    "corner of a point": (
        "intensity = 40",
        "corner = [0, 0, 0]",
        [":23:", "'corner'", "a point light has 'position'"],
    ),
    "misspelt": ("intensity", "intensty", [":23:", "'intensty'", "nearest valid key is 'intensity'"]),
    "position of a rect": (
        "samples = 16",
        "position = [0, 0, 0]",
        [":16:", "'position'", "a rect light has 'corner'"],
    ),
    "no position": ("position = [0.9, 2, 0.4]\n", "", ["'position' is missing", "three finite numbers"]),
    "type of no light": ('"point"', '"pont"', [":21:", "'type'", '"rect" or "point"']),
    "type as a list": ('"point"', '["point"]', [":21:", "'type'", '"rect" or "point"']),
    "negative intensity": ("= 40", "= -40", [":23:", "intensity", "'lamp'", "number >= 0"]),
    "intensity as text": ("= 40", '= "40"', [":23:", "'intensity'", "finite number"]),
    "two numbers": ("[0.9, 2, 0.4]", "[0.9, 2]", [":22:", "'position'", "three"]),
    "one name twice": ('"lamp"', '"key"', [":20:", "two lights"]),
    "unknown pattern": (
        "samples = 16",
        'pattern = "sobol"',
        [":16:", "'pattern'", '"jittered" or "regular"'],
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_lights_get_one_sentence(case: str, both: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old, new, words = WRONG[case]
    text = both.read_text()
    assert old in text
    both.write_text(new.join(text.rsplit(old, 1)))
    assert run(["info", str(both)]) == 1
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and both.name in err
    for word in words:
        assert word in err, err


def test_info_tells_the_lights_apart(both: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", str(both), "--json"]) == 0
    rect, lamp = json.loads(capsys.readouterr().out)["light"]
    assert (rect["type"], rect["area"], rect["samples"], rect["pattern"]) == ("rect", 1.0, 16, "jittered")
    assert lamp == {"name": "lamp", "type": "point", "position": [0.9, 2.0, 0.4], "intensity": 40.0}


@pytest.mark.parametrize("backend", ["reference", "hpc"])
def test_a_point_and_a_rectangle_in_one_picture(both: Path, backend: str) -> None:
    output = both.with_suffix(".exr")
    penumbra.render(both, output, backend=backend, memory="500MB")
    layers, header = read_layers(output), read_header(output)
    scene = Scene.load(both)
    points, normals, own, pixel = penumbra.camera_receivers(scene)
    blockers = np.array([[0, 3, 2], [0, 2, 1], [4, 7, 6], [4, 6, 5]])
    corners = np.array(
        [
            [float(x) for x in line.split()[1:]]
            for line in both.with_suffix(".obj").read_text().splitlines()
            if line.startswith("v ")
        ]
    )
    direct = np.zeros(layers["R"].shape)
    for light in scene.lights:
        result = penumbra.cast(
            points, corners[blockers], light, normals=normals, own=own, index=pixel, backend="reference"
        )
        expected = np.zeros(layers["R"].size, np.float32)
        expected[pixel] = result.visibility
        assert np.array_equal(layers[f"{light.name}.visibility"].ravel(), expected)
        direct += layers[f"{light.name}.irradiance"]
    np.testing.assert_allclose(layers["R"], 0.8 / np.pi * direct, rtol=1e-5)
    shadow = layers["lamp.visibility"]
    assert set(np.unique(shadow)) == {0.0, 1.0}
    # The irradiance of the point in closed form, wherever it is not blocked.
    towards = scene.lights[1].sample_points[0, 0] - points
    distance = np.linalg.norm(towards, axis=1)
    cosine = np.maximum((towards * normals).sum(axis=1), 0) / distance
    lit = shadow.ravel()[pixel]
    np.testing.assert_allclose(
        layers["lamp.irradiance"].ravel()[pixel], lit * 40 * cosine / distance**2, rtol=1e-5, atol=1e-7
    )
    assert json.loads(header["penumbra:samples"]) == {"key": 16, "lamp": 1}


def test_a_picture_of_one_point(lamp_only: Path) -> None:
    image = penumbra.render(lamp_only, samples=99, seed=5)
    assert (image.attributes["penumbra:samples"], image.attributes["penumbra:sets"]) == (1, 1)
    assert 0 < image.layers["lamp.visibility"].mean() < 1


def test_the_plan_says_what_a_point_does_not_need(lamp_only: Path) -> None:
    alone = str(plan_render(lamp_only))
    assert "lamp: a point" in alone and "no light sample groups: the light is a point" in alone
    lamp_only.write_text(lamp_only.read_text() + LAMP.replace("lamp", "other"))
    assert "no light sample groups: all lights are points" in str(plan_render(lamp_only))


def test_the_plan_of_a_rectangle_and_a_point(both: Path) -> None:
    plan = str(plan_render(both))
    assert "lamp: a point" in plan and "key: 16 samples in 8 sets" in plan
    assert "no light sample groups" not in plan


def test_resume_sees_that_a_light_has_changed(lamp_only: Path) -> None:
    output = lamp_only.with_suffix(".exr")
    penumbra.render(lamp_only, output, resolution=(8, 6))
    before = output.stat().st_mtime_ns
    penumbra.render(lamp_only, output, resolution=(8, 6), samples=7, resume=True)
    assert output.stat().st_mtime_ns == before
    lamp_only.write_text(lamp_only.read_text().replace("intensity = 40", "intensity = 41"))
    with pytest.raises(OutputError, match=r"intensity 40\.0 -> 41\.0"):
        penumbra.render(lamp_only, output, resolution=(8, 6), resume=True)


@pytest.mark.parametrize("samples", [1, 16, 40, 256])
def test_regular_samples_are_the_centres_of_the_strata(samples: int) -> None:
    vectors = ((-1, 3, -1), (2, 0.3, 0), (0, 0.2, 2))
    regular = RectLight(*vectors, samples=samples, sets=3, pattern="regular")
    points = regular.sample_points
    assert points.shape == (1, samples, 3)
    # The mean of many jittered sets tends to the centres: strata have the same place and size.
    jittered = RectLight(*vectors, samples=samples, sets=256).sample_points
    # A mean of 256 is off by a sixteenth of one jitter, which is 0.29 of a stratum.
    stratum = 3.5 / np.sqrt(samples)
    np.testing.assert_allclose(jittered.mean(axis=0), points[0], atol=5 * 0.29 / 16 * stratum)
    np.testing.assert_allclose(points[0].mean(axis=0), [0, 3.25, 0], atol=1e-12)


def test_a_square_number_of_regular_samples_is_a_grid() -> None:
    light = RectLight((0, 0, 0), (1, 0, 0), (0, 1, 0), samples=64, pattern="regular")
    grid = (np.arange(8) + 0.5) / 8
    expected = {(x, y) for x in grid for y in grid}
    assert {tuple(point) for point in light.sample_points[0, :, :2].tolist()} == expected


def test_patterns_in_scene_files(scene_file: Path) -> None:
    assert Scene.load(scene_file).lights[0].settings()["pattern"] == "jittered"
    scene_file.write_text(scene_file.read_text() + 'pattern = "regular"\n')
    light = Scene.load(scene_file).with_overrides(samples=9).lights[0]
    assert light.settings()["pattern"] == "regular" and light.samples == 9
    with pytest.raises(SceneError, match="pattern of light 'key'"):
        RectLight((0, 0, 0), (1, 0, 0), (0, 1, 0), name="key", pattern="sobol")


def test_all_sets_of_regular_samples_are_one(scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = scene_file.read_text() + 'pattern = "regular"\n'
    hashes = []
    for text in (plain, plain + "sets = 5\n"):
        scene_file.write_text(text)
        plan = plan_render(scene_file)
        assert "key: 16 samples in 1 set\n" in str(plan) and "no choice of sample set" in str(plan)
        scene = Scene.load(scene_file)
        hashes.append(settings_hash(settings_of(scene, (0, 0, 32, 24))))
        points, normals, own, pixel = penumbra.camera_receivers(scene)
        result = penumbra.cast(points, np.zeros((0, 3, 3)), scene.lights[0], index=pixel)
        assert not result.sample_set.any()
        assert run(["info", str(scene_file), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["light"][0]["sets"] == 1
    assert hashes[0] == hashes[1]
    with pytest.raises(SceneError, match="sets of light 'light' is 0"):
        RectLight((0, 0, 0), (1, 0, 0), (0, 1, 0), sets=0, pattern="regular")


@pytest.mark.parametrize(("backend", "named"), [("hpc", "hpc"), ("gears", "gears"), ("auto", "hpc (auto)")])
def test_the_plan_names_the_backend(both: Path, backend: str, named: str) -> None:
    assert f"\nbackend    {named}\n" in str(plan_render(both, backend=backend))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("intensity", ["1e-45", "1e-40", "1e38", "1e60"])
def test_a_preview_of_any_brightness(intensity: str, lamp_only: Path) -> None:
    """Radiance beyond the largest float32 is infinite in the layers; the preview still shows the shadow."""
    lamp_only.write_text(lamp_only.read_text().replace("intensity = 40", f"intensity = {intensity}"))
    preview = lamp_only.with_suffix(".png")
    image = penumbra.render(lamp_only, preview=preview)
    grey, background = np.array(PIL.Image.open(preview)), image.layers["id"] == 0xFFFFFFFF
    lit = (image.layers["R"] > 0) & ~background
    assert (grey[~lit & ~background] == 0).all()
    if lit.any():
        assert np.median(grey[lit]) > 100


def test_the_jittered_pattern_has_not_changed() -> None:
    # Samples as they were before there was a choice: one of each stratum, by numpy's default generator.
    light = RectLight((0, 0, 0), (1, 0, 0), (0, 1, 0), samples=4, sets=2, seed=3)
    jitter = np.random.default_rng(3).random((2, 4, 2))
    low = np.array([[0, 0], [0.0, 0.5], [0.5, 0.5], [0.5, 0]])
    assert np.array_equal(light.sample_points[..., :2], low + jitter * 0.5)
