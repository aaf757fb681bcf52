"""Area bins, buckets, and the external sort of what is in them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import penumbra.io.runs as runs
from penumbra.io.buckets import AreaBin, area_bins, merge_bins
from penumbra.io.runs import SortPlan
from penumbra.ordering import sort_by_key


@given(arrays(np.float64, (50,), elements=st.floats(0, exclude_min=True)))
def test_area_bins_are_powers_of_four(areas: np.ndarray) -> None:
    for area, number in zip(areas.tolist(), area_bins(areas).tolist(), strict=True):
        if area < np.inf:
            mantissa, exponent = float.hex(area).split("p")
            power = int(exponent) + 1 if mantissa.startswith("0x1") else int(np.frexp(area)[1])
            assert 2 * number <= power < 2 * number + 2
    assert area_bins(np.array([0.0, 5e-324, 1.7e308, np.inf])).tolist() == [-537, -537, 512, 512]


@given(
    st.dictionaries(st.integers(-500, 500), st.integers(1, 10**6), min_size=1, max_size=60),
    st.integers(1, 20),
    st.integers(1, 10**5),
)
def test_buckets_are_runs_of_bins_from_large_to_small(
    counts: dict[int, int], max_buckets: int, least: int
) -> None:
    histogram = {
        number: AreaBin(count, 4.0**number / 2, 4.0**number, np.full((2, 3), float(number)))
        for number, count in counts.items()
    }
    buckets = merge_bins(histogram, max_buckets, least)
    assert [number for bucket in buckets for number in bucket.bins] == sorted(counts, reverse=True)
    assert 1 <= len(buckets) <= max_buckets
    assert len(buckets) == 1 or all(bucket.n_triangles >= least for bucket in buckets)
    for bucket in buckets:
        assert bucket.n_triangles == sum(counts[number] for number in bucket.bins)
        assert bucket.area_range == (4.0 ** min(bucket.bins) / 2, 4.0 ** max(bucket.bins))
        assert bucket.centre_bounds.tolist() == [[min(bucket.bins)] * 3, [max(bucket.bins)] * 3]
    assert merge_bins({}, max_buckets, least) == []


@given(
    st.lists(
        st.tuples(st.integers(0, 9), st.integers(0, 10**6)), unique_by=lambda pair: pair[1], max_size=80
    ),
    st.integers(1, 30),
    st.integers(1, 60),
)
def test_external_sort(
    tmp_path_factory: pytest.TempPathFactory,
    pairs: list[tuple[int, int]],
    run_records: int,
    merge_records: int,
) -> None:
    """Any run and block size gives what `sorted` gives."""
    folder = tmp_path_factory.mktemp("sort")
    scratch = runs.Scratch(folder)
    for i, (key, number) in enumerate(pairs):
        vertices = np.full((1, 3, 3), key, np.float32 if i % 3 else np.float64)
        scratch.append(i % 2, vertices, np.array([number]))
    blocks = runs.sort_files(
        scratch.files(0) + scratch.files(1),
        np.dtype(np.float64),
        folder,
        SortPlan(run_records, merge_records),
        lambda vertices, ids: vertices[:, 0, 0].astype(np.uint64),
        sort_by_key,
    )
    found = [
        (int(key), int(number))
        for block in blocks
        for key, number in zip(block["key"], block["id"], strict=True)
    ]
    assert found == sorted(pairs)
    assert list(folder.iterdir()) == []
