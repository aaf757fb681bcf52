"""What must change no bit, on scenes too large for the exact judge."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from backends import BACKENDS, Masks, cast_scene, masks_of, way
from scenes import (
    FAMILIES,
    SmallScene,
    large_scene,
    light_named,
    random_triangles,
    receivers_below,
    scene_of,
    write_ply,
)

import penumbra
from penumbra import CastOptions, IngestOptions, RectLight
from penumbra.errors import MemoryLimitError
from penumbra.ingest import blockers_in_memory
from penumbra.lights import sample_sets_of

SCENE = large_scene(320, 240, light_named("rotated", 96, sets=4))

pytestmark = pytest.mark.parametrize("backend", BACKENDS)

_cast_once: dict[str, Masks] = {}


def plain_masks(backend: str) -> Masks:
    """Masks of SCENE with everything as it is by default; cast once a backend."""
    if backend not in _cast_once:
        _cast_once[backend] = masks_of(SCENE, backend)
    return _cast_once[backend]


def test_every_backend_gives_the_same_bits(backend: str) -> None:
    assert np.array_equal(plain_masks(backend), plain_masks("reference"))
    blocked = np.bitwise_count(plain_masks(backend)).sum(axis=1)
    # The scene has receivers in full light, in the penumbra and in the umbra.
    assert (blocked == 96).sum() > 10
    assert ((blocked > 0) & (blocked < 96)).sum() > 100


def test_order_of_blockers(backend: str, rng: np.random.Generator) -> None:
    order = rng.permutation(len(SCENE.triangles))
    new_ids = np.append(np.argsort(order), -1)  # the last serves own = -1
    scene = replace(SCENE, triangles=SCENE.triangles[order], own=new_ids[SCENE.own])
    assert np.array_equal(masks_of(scene, backend), plain_masks(backend))


def test_order_of_corners(backend: str, rng: np.random.Generator) -> None:
    turned = np.stack([triangle[rng.permutation(3)] for triangle in SCENE.triangles])
    assert np.array_equal(masks_of(replace(SCENE, triangles=turned), backend), plain_masks(backend))


@pytest.mark.parametrize(
    "options",
    [
        IngestOptions(chunk_triangles=1000, max_buckets=1),
        IngestOptions(chunk_triangles=16),
        IngestOptions(chunk_triangles=37, max_buckets=5),
        IngestOptions(sort=False),
    ],
    ids=str,
)
def test_chunks_and_buckets(backend: str, options: IngestOptions, tmp_path: Path) -> None:
    in_memory = blockers_in_memory(SCENE.triangles, options)
    assert np.array_equal(masks_of(SCENE, backend, in_memory), plain_masks(backend))
    mesh = write_ply(tmp_path / "scene.ply", SCENE.triangles)
    store = penumbra.ingest([mesh], tmp_path / "scene.h5", options=options)
    assert np.array_equal(masks_of(SCENE, backend, store), plain_masks(backend))
    store.close()


@pytest.mark.parametrize(
    "options",
    [
        CastOptions(tile_receivers=64),
        CastOptions(tile_receivers=50, leaf_receivers=3),
        CastOptions(leaf_receivers=64),
        CastOptions(group_size=64),
        CastOptions(rebuild_fraction=1e-6),
        CastOptions(rebuild_fraction=2.0),
        CastOptions(umbra_bits=False),
        CastOptions(active_planes=False),
        CastOptions(lazy_volumes=False),
        CastOptions(lazy_masks=False),
        CastOptions(sort=False),
    ],
    ids=str,
)
@pytest.mark.parametrize("threads", [1, 2])
def test_casting_options_and_threads(backend: str, options: CastOptions, threads: int) -> None:
    found = masks_of(SCENE, backend, options=options, threads=threads)
    assert np.array_equal(found, plain_masks(backend))


def test_memory_splits_the_work_and_changes_no_bit(backend: str) -> None:
    with pytest.raises(MemoryLimitError, match="raise memory"):
        cast_scene(SCENE, backend, memory="4KiB")
    # Many copies, so that a small limit means several passes.
    copies = replace(
        SCENE,
        points=np.tile(SCENE.points, (25, 1)),
        normals=np.tile(SCENE.normals, (25, 1)),
        own=np.tile(SCENE.own, 25),
        triangles=SCENE.triangles[:40],
        light=replace(SCENE.light, sets=1),
    )
    copies = replace(copies, own=np.where(copies.own < 40, copies.own, -1))
    roomy = masks_of(copies, backend)
    assert np.array_equal(roomy[:320], roomy[-320:])
    assert np.array_equal(masks_of(copies, backend, memory="1MiB"), roomy)


@pytest.mark.parametrize("exponent", [-40, -20, -1, 1, 20, 40])
def test_scaling_by_a_power_of_two(backend: str, exponent: int) -> None:
    scale, light = 2.0**exponent, SCENE.light
    scene = replace(
        SCENE,
        points=SCENE.points * scale,
        triangles=SCENE.triangles * scale,
        light=replace(
            light, corner=light.corner * scale, edge_u=light.edge_u * scale, edge_v=light.edge_v * scale
        ),
    )
    assert np.array_equal(scene.light.sample_points, light.sample_points * scale)
    assert np.array_equal(masks_of(scene, backend), plain_masks(backend))


def moved(scene: SmallScene, move: Any) -> SmallScene:
    """The scene translated; the light's edges, and the normals, stay."""
    light = replace(scene.light, corner=scene.light.corner + move)
    return replace(scene, points=scene.points + move, triangles=scene.triangles + move, light=light)


def test_translation_where_all_stays_representable(backend: str) -> None:
    # Everything is between 1024 and 2048, where the spacing of float64 is one and the same: then the
    # samples, too, move exactly.
    here = moved(replace(SCENE, light=replace(SCENE.light, corner=(-0.5, -1.125, 4.25))), 1040.0)
    reference = masks_of(here, backend)
    for move in ([300.0, 17.0, 2.0**-10], [900.5, 800.0 + 2.0**-10, 3.0 * 2.0**-10]):
        there = moved(here, np.array(move))
        assert np.array_equal(there.light.sample_points, here.light.sample_points + move)
        assert np.array_equal(there.triangles - move, here.triangles)
        assert np.array_equal(masks_of(there, backend), reference)


@pytest.mark.parametrize("move", [(0.5, -3.0, 2.0**-10), (1e4, -1e4, 1e4), (1e6, 2e6, -1e6)])
def test_translation_under_lights_without_extent(backend: str, move: tuple[float, ...]) -> None:
    for corner in ((0, 0, 4), (1, -1, 4.5)):
        light = RectLight(corner, (0, 0, 0), (0, 0, 0), samples=1, two_sided=True)
        scene = replace(SCENE, light=light)
        there = moved(scene, np.array(move))
        assert np.array_equal(there.triangles - move, scene.triangles)
        assert np.array_equal(masks_of(there, backend), masks_of(scene, backend))


def test_masks_of_parts_combine_by_or(backend: str, rng: np.random.Generator) -> None:
    part = rng.random(len(SCENE.triangles)) < 0.5
    # A part keeps the place of each triangle: those of the other part are squeezed to a point.
    halves = [
        np.where(keep[:, None, None], SCENE.triangles, SCENE.triangles[:, :1]) for keep in (part, ~part)
    ]
    first, second = (masks_of(replace(SCENE, triangles=half), backend) for half in halves)
    assert np.array_equal(first | second, plain_masks(backend))
    assert not np.array_equal(first, second)


def test_degenerate_blockers_change_nothing(backend: str, rng: np.random.Generator) -> None:
    a, b = rng.integers(-3, 4, (2, 60, 3)).astype(float)
    degenerate = np.concatenate([np.stack([a, b, a], axis=1), np.stack([a, a, a], axis=1)])
    degenerate = np.concatenate([degenerate, np.stack([a, (a + b) / 2.0, b], axis=1)])
    scene = replace(SCENE, triangles=np.concatenate([SCENE.triangles, degenerate]))
    assert np.array_equal(masks_of(scene, backend), plain_masks(backend))
    alone = replace(SCENE, triangles=degenerate, own=None)
    nothing = replace(SCENE, triangles=np.zeros((0, 3, 3)), own=None)
    assert np.array_equal(masks_of(alone, backend), masks_of(nothing, backend))


def test_blockers_given_twice_change_nothing(backend: str) -> None:
    own = replace(SCENE, own=None)
    twice = replace(own, triangles=np.concatenate([SCENE.triangles, SCENE.triangles[::-1]]))
    assert np.array_equal(masks_of(twice, backend), masks_of(own, backend))


def test_rows_are_cast_alone_as_together(backend: str, rng: np.random.Generator) -> None:
    result = cast_scene(SCENE, backend)
    rows = rng.permutation(len(SCENE.points))[:150]
    part = replace(SCENE, points=SCENE.points[rows], normals=SCENE.normals[rows], own=SCENE.own[rows])
    alone = cast_scene(part, backend, index=rows)
    assert np.array_equal(alone.masks, result.masks[rows])
    assert np.array_equal(alone.sample_set, result.sample_set[rows])
    assert np.array_equal(alone.visibility, result.visibility[rows])


def test_sample_sets_are_a_hash_of_index_and_seed(backend: str) -> None:
    points = np.zeros((4000, 3))
    found = [
        cast_scene(
            SmallScene(points, np.zeros((0, 3, 3)), light_named("skewed", 4, sets=8, seed=seed)), backend
        ).sample_set
        for seed in (0, 1)
    ]
    assert not np.array_equal(*found)
    for seed, sample_set in enumerate(found):
        assert sample_set.dtype == np.uint8
        assert np.array_equal(sample_set, sample_sets_of(np.arange(4000), seed, 8))
        counts = np.bincount(sample_set, minlength=8)
        assert len(counts) == 8
        assert abs(counts - 500).max() < 6.0 * np.sqrt(500)


def test_visibility_is_the_fraction_not_blocked(backend: str) -> None:
    result = cast_scene(SCENE, backend)
    blocked = np.bitwise_count(plain_masks(backend)).sum(axis=1)
    assert result.visibility.dtype == np.float32
    assert np.array_equal(result.visibility, ((96 - blocked.astype(np.int64)) / 96).astype(np.float32))
    only = cast_scene(SCENE, backend, keep="visibility")
    assert only.masks is None
    assert np.array_equal(only.visibility, result.visibility)


def test_result_says_what_was_done(backend: str) -> None:
    numbers = cast_scene(SCENE, backend).stats.as_dict()
    assert numbers["backend"] == way(backend)["backend"]
    for name in ("pairs_tested", "nodes_visited", "bytes_read", "bytes_skipped", "peak_bytes"):
        assert numbers[name] >= 0
    assert numbers["escalated_f64"] >= 0
    assert numbers["escalated_exact"] >= 0
    assert any(name.startswith("seconds_") for name in numbers)


def test_no_receivers_and_no_blockers(backend: str) -> None:
    light, triangles = light_named("skewed", 70), random_triangles(np.random.default_rng(1), 5)
    none = penumbra.cast(np.zeros((0, 3)), triangles, light, **way(backend))
    assert none.masks.shape == (0, 2)
    assert none.visibility.shape == none.sample_set.shape == (0,)
    for blockers in (np.zeros((0, 3, 3)), np.zeros((4, 3, 3))):
        lit = penumbra.cast(np.zeros((3, 3)), blockers, light, **way(backend))
        assert lit.masks.tolist() == [[0, 0]] * 3
        assert lit.visibility.tolist() == [1.0, 1.0, 1.0]


def test_input_is_not_changed_and_may_be_of_any_kind(backend: str) -> None:
    scene = scene_of("on_blockers", light_named("rotated", 33))
    before = masks_of(scene, backend)
    frozen = replace(scene, points=np.asfortranarray(scene.points), triangles=scene.triangles[::1])
    for array in (frozen.points, frozen.triangles, frozen.own):
        array.setflags(write=False)
    assert np.array_equal(masks_of(frozen, backend), before)
    lists = replace(scene, points=scene.points.tolist(), triangles=scene.triangles.tolist())
    assert np.array_equal(masks_of(lists, backend), before)
    single = scene.triangles.astype(np.float32)
    from_single = masks_of(replace(scene, triangles=single), backend)
    assert np.array_equal(from_single, masks_of(replace(scene, triangles=single.astype(float)), backend))


def test_a_trimesh_is_its_triangles(backend: str) -> None:
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.7)
    mesh.apply_translation([0.1, 0.2, 2.0])
    points, light = receivers_below(np.random.default_rng(2), 60), light_named("square above", 50)
    from_mesh = penumbra.cast(points, mesh, light, **way(backend)).masks
    assert np.array_equal(from_mesh, penumbra.cast(points, mesh.triangles, light, **way(backend)).masks)
    assert from_mesh.any()


@pytest.mark.parametrize("family", FAMILIES)
def test_more_samples_than_the_judge_takes(backend: str, family: str) -> None:
    scene = scene_of(family, light_named("skewed", 130), seed=5)
    assert np.array_equal(masks_of(scene, backend, threads=2), masks_of(scene, "reference"))
