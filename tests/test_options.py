"""Sizes and option checks."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from penumbra.errors import SceneError
from penumbra.options import CastOptions, IngestOptions, parse_size


@pytest.mark.parametrize(
    ("text", "size_bytes"),
    [
        ("512MiB", 512 * 2**20),
        ("4GB", 4_000_000_000),
        ("1.5GiB", 3 * 2**29),
        (".5 kib", 512),
        ("1TiB", 2**40),
        ("7tb", 7 * 10**12),
        ("123", 123),
        ("9B", 9),
        (" 2 GiB ", 2**31),
        (4096, 4096),
        (None, None),
    ],
)
def test_sizes(text: str | int | None, size_bytes: int | None) -> None:
    assert parse_size(text) == size_bytes


@pytest.mark.parametrize(
    "text", ["", "banana", "-1GiB", "0", "0.1B", "4 G B", "1e9", "4PB", "nan", True, 2.5, "GiB"]
)
def test_what_is_not_a_size_is_told(text: object) -> None:
    with pytest.raises(SceneError, match="is not a size"):
        parse_size(text)  # type: ignore[arg-type]


@given(st.integers(1, 2**60), st.sampled_from(["", "B", "KiB", "kb", "MiB", "MB", "GiB", "gb"]))
def test_whole_sizes_are_exact(count: int, unit: str) -> None:
    power = " KMGT".index(unit[0].upper()) if unit.upper() not in ("", "B") else 0
    assert parse_size(f"{count}{unit}") == count * (1024 if "i" in unit else 1000) ** power


@pytest.mark.parametrize(
    ("options", "name"),
    [
        (lambda: IngestOptions(chunk_triangles=0), "chunk_triangles"),
        (lambda: IngestOptions(max_buckets=0), "max_buckets"),
        (lambda: CastOptions(group_size=48), "group_size"),
        (lambda: CastOptions(tile_receivers=0), "tile_receivers"),
        (lambda: CastOptions(leaf_receivers=-1), "leaf_receivers"),
        (lambda: CastOptions(rebuild_fraction=float("nan")), "rebuild_fraction"),
        (lambda: CastOptions(rebuild_fraction="much"), "rebuild_fraction"),  # type: ignore[arg-type]
        (lambda: CastOptions(grid_eye="near"), "grid_eye"),  # type: ignore[arg-type]
        (lambda: CastOptions(grid_resolution=3.5), "grid_resolution is 3.5"),  # type: ignore[arg-type]
        (lambda: CastOptions(grid_resolution=True), "grid_resolution is True"),
        (lambda: CastOptions(pair_bytes="16MiB"), "pair_bytes is '16MiB'"),  # type: ignore[arg-type]
        (lambda: CastOptions(group_size=32.0), "group_size is 32.0"),  # type: ignore[arg-type]
    ],
)
def test_options_out_of_range_are_named(options: object, name: str) -> None:
    with pytest.raises(SceneError, match=name):
        options()  # type: ignore[operator]
