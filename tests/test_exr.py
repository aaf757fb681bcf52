"""EXR files: read back with OpenEXR itself, every channel, window and header entry."""

import numpy as np
import OpenEXR
import pytest

from penumbra.errors import OutputError, SceneError
from penumbra.io.exr import camera_attributes, read_header, read_layers, write_exr
from penumbra.scene import Camera

RESOLUTION = (20, 12)
WINDOW = (3, 2, 10, 9)
MATRIX = np.arange(16, dtype=np.float64).reshape(4, 4) / 3


@pytest.fixture
def layers():
    rng = np.random.default_rng(3)
    shape = (WINDOW[3] - WINDOW[1], WINDOW[2] - WINDOW[0])
    names = ("R", "G", "B", "key.visibility", "Z", "P.X")
    arrays = {name: rng.random(shape, dtype=np.float32) for name in names}
    arrays["Z"][0, 0] = np.inf
    return arrays | {"id": rng.integers(0, 2**32, shape, dtype=np.uint32)}


@pytest.fixture
def path(tmp_path, layers):
    attributes = {
        "comments": "1 = lit, \u00e4",
        "penumbra:samples": np.int64(256),
        "penumbra:large": 2**40,
        "penumbra:negative": -(2**40),
        "penumbra:seconds": 1.5,
        "penumbra:matrix": MATRIX,
        "worldToCamera": MATRIX.astype(np.float32),
    }
    write_exr(tmp_path / "out.exr", layers, RESOLUTION, WINDOW, attributes, threads=2)
    return tmp_path / "out.exr"


def test_pixels_windows_and_types(path, layers):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        header, channels = file.header(), file.channels()
        assert [corner.tolist() for corner in header["dataWindow"]] == [[3, 2], [9, 8]]
        assert [corner.tolist() for corner in header["displayWindow"]] == [[0, 0], [19, 11]]
        assert header["compression"] == OpenEXR.ZIP_COMPRESSION
        assert sorted(channels) == sorted(layers)
        for name, layer in layers.items():
            assert channels[name].pixels.dtype == layer.dtype
            assert np.array_equal(channels[name].pixels, layer)


def test_read_layers_and_header(path, layers):
    back = read_layers(path)
    assert all(np.array_equal(back[name], layers[name]) for name in layers)
    header = read_header(path)
    assert header["dataWindow"] == (3, 2, 9, 8)
    assert header["displayWindow"] == (0, 0, 19, 11)
    assert sorted(header["channels"]) == sorted(layers)
    assert header["comments"] == "1 = lit, \u00e4"
    assert header["penumbra:samples"] == 256
    assert header["penumbra:large"] == 2**40
    assert header["penumbra:negative"] == -(2**40)
    assert header["penumbra:seconds"] == 1.5
    assert header["penumbra:matrix"].dtype == np.float64
    assert np.array_equal(header["penumbra:matrix"], MATRIX)
    assert header["worldToCamera"].dtype == np.float32


def test_the_layers_given_stay_arrays(tmp_path, layers):
    write_exr(tmp_path / "a.exr", layers, RESOLUTION, WINDOW, {})
    assert all(isinstance(layer, np.ndarray) for layer in layers.values())


def test_no_folder(tmp_path, layers):
    with pytest.raises(OutputError, match="does not exist"):
        write_exr(tmp_path / "no" / "a.exr", layers, RESOLUTION, WINDOW, {})


def test_what_is_not_an_exr_file(tmp_path, path):
    with pytest.raises(SceneError, match="no such file"):
        read_header(tmp_path / "nothing.exr")
    (tmp_path / "text.exr").write_text("hello")
    with pytest.raises(SceneError, match="not an OpenEXR file"):
        read_header(tmp_path / "text.exr")
    content = path.read_bytes()
    for size in (40, len(content) // 2, len(content) - 5):
        (tmp_path / "cut.exr").write_bytes(content[:size])
        with pytest.raises(SceneError, match="damaged"):
            read_layers(tmp_path / "cut.exr")


def test_camera_matrices_agree_with_the_frame():
    camera = Camera((3.0, 4.0, 9.0), (1.0, 0.5, -2.0), vfov=38.0, resolution=RESOLUTION)
    frame = camera.frame()
    attributes = camera_attributes(frame, RESOLUTION)
    to_camera, to_ndc = attributes["penumbra:worldToCamera"], attributes["penumbra:worldToNDC"]
    rng = np.random.default_rng(4)
    for _ in range(20):
        x, y, depth = rng.uniform(-5, 25), rng.uniform(-5, 15), rng.uniform(0.1, 50)
        point = frame.eye + depth * (frame.d0 + x * frame.dx + y * frame.dy)
        u, v, _, w = np.append(point, 1.0) @ to_ndc
        # The centre of pixel (x, y) is half a pixel from its upper left corner.
        assert (u / w * RESOLUTION[0] - 0.5, v / w * RESOLUTION[1] - 0.5) == pytest.approx((x, y), abs=1e-9)
        in_camera = np.append(point, 1.0) @ to_camera
        assert in_camera[2] == pytest.approx(depth)
        half_height = np.tan(np.radians(38.0 / 2))
        assert in_camera[1] / in_camera[2] == pytest.approx(half_height * (1 - (2 * y + 1) / RESOLUTION[1]))
    # Left-handed: x right, y up, z forward, for a scene that is right-handed.
    assert np.linalg.det(to_camera[:3, :3]) == pytest.approx(-1)
    assert attributes["worldToCamera"].dtype == attributes["worldToNDC"].dtype == np.float32
