"""Layers of a film: names, background, and where pixels of the full picture land in a crop."""

import math

import numpy as np
import pytest

from penumbra.film import BACKGROUND_ID, Film, film_bytes
from penumbra.io.png import expose

LIGHT_NAMES = ["key.visibility", "key.irradiance", "key.irradiance_unshadowed"]
NAMES = [*"RGB", *LIGHT_NAMES, "Z", "P.X", "P.Y", "P.Z", "N.X", "N.Y", "N.Z", "id"]


def test_layers_and_background():
    film = Film(6, 4, (1, 1, 6, 4), ["key"])
    assert sorted(film.layers) == sorted(NAMES)
    for name, layer in film.layers.items():
        assert layer.shape == (3, 5)
        assert layer.dtype == (np.uint32 if name == "id" else np.float32)
    assert np.isinf(film.layers["Z"]).all()
    assert (film.layers["id"] == 0xFFFFFFFF).all()
    assert all(not film.layers[name].any() for name in NAMES if name not in ("Z", "id"))


def test_every_light_has_its_layers():
    film = Film(2, 2, (0, 0, 2, 2), ["a", "b"])
    assert {name for name in film.layers if "." in name and name[0] in "ab"} == {
        f"{light}.{layer}"
        for light in "ab"
        for layer in ("visibility", "irradiance", "irradiance_unshadowed")
    }


def test_a_crop_holds_the_pixels_of_the_full_picture():
    rng = np.random.default_rng(1)
    width, height, window = 7, 5, (2, 1, 6, 4)
    values = rng.random((height, width)).astype(np.float32)
    full, crop = Film(width, height, (0, 0, width, height), []), Film(width, height, window, [])
    everything = np.arange(width * height)
    full.put("Z", everything, values.ravel())
    x0, y0, x1, y1 = window
    inside = everything.reshape(height, width)[y0:y1, x0:x1].ravel()
    # In any order: what is put does not depend on it.
    shuffled = rng.permutation(inside)
    crop.put("Z", shuffled, values.ravel()[shuffled])
    assert np.array_equal(full.layers["Z"], values)
    assert np.array_equal(crop.layers["Z"], values[y0:y1, x0:x1])


def test_xyz_and_preview():
    film = Film(3, 1, (0, 0, 3, 1), ["key"])
    pixel = np.array([2, 0])
    film.put_xyz("P", pixel, np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    assert film.layers["P.Y"].tolist() == [[5.0, 0.0, 2.0]]
    for _ in range(2):
        film.add_direct_light(pixel, np.array([math.pi, 0.0], np.float32))
    assert film.layers["G"].tolist() == [[0.0, 0.0, pytest.approx(1.6)]]


def test_film_bytes_counts_every_array_once():
    window = (0, 0, 9, 5)
    film = Film(9, 5, window, ["a", "b"])
    distinct = {id(layer): layer.nbytes for layer in film.layers.values()}
    assert film_bytes(window, 2) == sum(distinct.values())


def test_exposure_keeps_order_and_marks_the_background():
    radiance = np.linspace(0, 40, 1000, dtype=np.float32).reshape(10, 100)
    background = np.zeros((10, 100), bool)
    background[0, :5] = True
    grey = expose(radiance, background)
    assert (np.diff(grey[~background].astype(int)) >= 0).all()
    assert grey[9, 99] > 230
    assert len({int(level) for level in grey[0, :5]}) == 1
    assert 20 < grey[0, 0] < 80


def test_exposure_does_not_depend_on_the_light_power():
    rng = np.random.default_rng(2)
    radiance = rng.random((20, 30)).astype(np.float32)
    background = np.zeros((20, 30), bool)
    assert np.array_equal(expose(radiance, background), expose(radiance * np.float32(1024), background))


def test_exposure_of_nothing():
    dark = np.zeros((2, 2), np.float32)
    assert not expose(dark, np.zeros((2, 2), bool)).any()
    assert (expose(dark, np.ones((2, 2), bool)) == expose(dark, np.ones((2, 2), bool))[0, 0]).all()
    assert BACKGROUND_ID == 0xFFFFFFFF
