"""The plan: it fits its limit, its passes cover the picture once, and its refusals are honest."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from penumbra.errors import MemoryLimitError
from penumbra.memory import available_bytes, call_limit_bytes, format_bytes, peak_bytes, resident_bytes
from penumbra.options import CastOptions
from penumbra.plan import (
    GeometryPlan,
    LightPlan,
    backend_bytes,
    fitted_options,
    least_cast_bytes,
    make_plan,
    receivers_per_pass,
)

MIB = 1 << 20


def plan_of(limit, n_triangles=100_000, resolution=(1280, 960), window=None, samples=256, is_store=False):
    return make_plan(
        resolution,
        window or (0, 0, *resolution),
        [LightPlan("key", samples, 8)],
        GeometryPlan(n_triangles, True, is_store),
        limit_bytes=limit,
        resident_bytes=200 * MIB,
        threads=2,
    )


@given(
    limit=st.integers(300 * MIB, 8000 * MIB),
    n_triangles=st.integers(0, 10**9),
    corner=st.tuples(st.integers(0, 600), st.integers(0, 400)),
    size=st.tuples(st.integers(1, 600), st.integers(1, 500)),
    samples=st.integers(1, 2000),
    is_store=st.booleans(),
)
def test_a_plan_fits_and_covers_the_window_once(limit, n_triangles, corner, size, samples, is_store):
    window = (*corner, corner[0] + size[0], corner[1] + size[1])
    try:
        plan = plan_of(limit, n_triangles, (1280, 960), window, samples, is_store)
    except MemoryLimitError:
        return
    assert plan.needed_bytes <= limit
    assert plan.passes[0][1] == window[1]
    assert plan.passes[-1][3] == window[3]
    for before, after in zip(plan.passes, plan.passes[1:], strict=False):
        assert before[3] == after[1]
    assert all((x0, x1) == (window[0], window[2]) and y0 < y1 for x0, y0, x1, y1 in plan.passes)


@given(st.integers(1, 400 * MIB), st.integers(0, 10**9), st.sampled_from([(640, 480), (3840, 2160)]))
def test_a_refusal_names_a_limit_that_would_do(limit, n_triangles, resolution):
    try:
        plan_of(limit, n_triangles, resolution)
    except MemoryLimitError as refusal:
        enough = int(re.search(r"give (\d+)MiB", str(refusal)).group(1)) * MIB
        assert enough > limit
        assert plan_of(enough, n_triangles, resolution).needed_bytes <= enough


@pytest.mark.parametrize(
    ("window", "samples", "words"),
    [
        (None, 100, "a picture of 1280 x 960 pixels with 100 light samples does"),
        ((10, 10, 30, 20), 1, "a picture of 20 x 10 pixels (of 1280 x 960) with 1 light sample does"),
    ],
)
def test_a_refusal_says_what_was_asked_for(window, samples, words):
    with pytest.raises(MemoryLimitError) as refusal:
        plan_of(100 * MIB, window=window, samples=samples)
    assert words in str(refusal.value)
    assert f"give {refusal.value.enough_bytes // MIB}MiB" in str(refusal.value)


@given(
    st.integers(1, 10**6),
    st.integers(1, 65536),
    st.sampled_from([1, 8]),
    st.sampled_from(["hpc", "gears", "reference"]),
)
def test_the_least_limit_of_a_cast_is_enough_for_it(n_receivers, n_samples, sets, backend):
    chunk, read = 65536, 48 * MIB
    limit = least_cast_bytes(n_receivers, n_samples, sets, read, chunk, backend)
    held = read + backend_bytes(backend, fitted_options(CastOptions(), limit), chunk)
    assert receivers_per_pass(n_receivers, n_samples, sets, held, False, limit) >= min(n_receivers, 1024)


def test_half_a_gibibyte_does_for_an_ordinary_picture():
    plan = plan_of(512 * MIB, n_triangles=40_000_000, is_store=True)
    assert plan.source == "store"
    assert len(plan.passes) <= 20


def test_more_memory_needs_fewer_passes():
    counts = [len(plan_of(limit * MIB, is_store=True).passes) for limit in (480, 640, 1024, 4096)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > 1
    assert counts[-1] == 1


def test_where_the_blockers_live():
    assert plan_of(4096 * MIB).source == "memory"
    assert plan_of(4096 * MIB, n_triangles=50_000_000).source == "temporary store"
    assert plan_of(4096 * MIB, n_triangles=50_000_000).scratch_bytes > 50_000_000 * 36


def test_the_plan_as_text():
    text = str(plan_of(4096 * MIB))
    for words in (
        "1280 x 960",
        "1,228,800 pixels",
        "key: 256 samples",
        "100,000 triangles",
        "1 of up to 960 rows",
    ):
        assert words in text
    assert "no store is written" in text
    assert "needed" in text
    small = str(plan_of(600 * MIB, n_triangles=50_000_000))
    assert "of disk" in small
    assert "no second pass" not in small


def test_memory_of_this_process():
    assert 1 << 20 < resident_bytes() <= peak_bytes()
    block = bytearray(64 << 20)
    assert peak_bytes() > len(block)
    assert available_bytes() > 0


def test_call_limit():
    assert call_limit_bytes(1000, process_limit=False) == 1000
    # The process is above that limit already.
    assert call_limit_bytes(1, process_limit=True) < 0
    gib = 1 << 30
    assert gib - 2 * resident_bytes() < call_limit_bytes(gib, process_limit=True) < gib
    assert call_limit_bytes(None, process_limit=False) == pytest.approx(available_bytes() / 2, rel=0.2)


@pytest.mark.parametrize(
    ("size", "text"), [(0, "0 B"), (1536, "1.5 KiB"), (512 << 20, "512.0 MiB"), (1 << 40, "1.0 TiB")]
)
def test_format_bytes(size, text):
    assert format_bytes(size) == text
