"""Primary visibility against exact rationals, closed rooms, Embree, and itself under other orders."""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from paths import scene_file
from visible_oracle import (
    ListBlockers,
    assert_exact,
    assert_receivers,
    cross,
    exact,
    exact_camera,
    full,
    hit_parameter,
    minus,
    own_picture,
    ray_of,
    seen_exactly,
)

from penumbra.arrays import Float64Array
from penumbra.errors import SceneError
from penumbra.scene import Camera
from penumbra.visible import GBuffer, find_visible, make_view, may_be_seen, window_bytes

whole = st.integers(-4, 4)
corner = st.tuples(whole, whole, whole)


def has_area(triangle: Sequence[Sequence[int]]) -> bool:
    a, b, c = (exact(v) for v in triangle)
    return any(cross(minus(b, a), minus(c, a)))


grid_triangles = st.lists(st.tuples(corner, corner, corner).filter(has_area), min_size=1, max_size=12)


@settings(max_examples=40)
@given(grid_triangles, corner, st.integers(1, 5), st.randoms(use_true_random=False))
def test_grid_scenes_equal_the_rational_oracle(triangles, eye, chunk, random):
    # Whole numbers: rays through edges and corners, shared edges, edge-on and coplanar triangles,
    # duplicates, triangles through the plane of the eye and behind it.
    ids = list(range(len(triangles)))
    random.shuffle(ids)
    assert_exact(np.array(triangles, dtype=np.float64), exact_camera(eye), ids, chunk=chunk)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_scenes_at_any_scale_and_offset(rng, scale, offset):
    for _ in range(3):
        triangles = rng.normal(size=(25, 1, 3)) + rng.normal(size=(25, 3, 3)) * rng.choice([0.1, 1.0, 3.0])
        # Squares of two triangles: shared edges that no pixel may slip through, or see twice.
        triangles[1::2, 0], triangles[1::2, 1] = triangles[:-1:2, 2], triangles[:-1:2, 1]
        move = offset * np.array([1.0, -0.7, 0.3])
        camera = Camera(
            tuple(np.array([0.3, 0.2, 2.5]) * scale + move), tuple(move), vfov=60, resolution=(11, 8)
        )
        assert_exact(triangles * scale + move, camera, chunk=7)


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e6])
def test_edges_within_rounding_of_pixel_centres(rng, offset):
    # Every corner is a point of some pixel's ray, rounded: float64 alone cannot tell on which side.
    eye = np.array([0.3, 0.2, 2.5]) + offset * np.array([1.0, -0.7, 0.3])
    camera = Camera(tuple(eye), tuple(eye - np.array([0.1, 0.2, 3.0])), vfov=40, resolution=(40, 4))
    frame = camera.frame()
    for _ in range(3):
        x, y = rng.integers(0, 40, (12, 3, 1)), rng.integers(0, 4, (12, 3, 1))
        q = frame.eye + ((frame.d0 + y * frame.dy) + x * frame.dx)
        triangles = frame.eye + (q - frame.eye) * rng.uniform(0.1, 9.0, (12, 3, 1))
        triangles[6:, 2] += rng.normal(size=(6, 3))
        counters: dict[str, int] = {}
        assert_exact(triangles, camera, list(rng.permutation(12)), counters=counters)
        # Far from the origin, rounding of the corners is coarse and the float64 filter decides it.
        assert offset or counters["escalated_exact"] > 0


def test_depths_closer_than_float32(rng):
    # Small triangles one behind the other by 1e-7 to 1e-15 of their distance, or crossing there.
    for exponent in range(7, 17, 2):
        start = rng.normal(size=(6, 1, 3)) * 0.5 + rng.normal(size=(6, 3, 3)) * 0.3
        copies = [start + rng.normal(size=(6, 3, 3)) * 10.0**-exponent for _ in range(4)]
        # Facing the camera, the nearest corner is no nearer than what a pixel shows.
        start[:, :, 2] = rng.normal()
        copies += [start + [0, 0, step * 10.0**-exponent] for step in (0, 1, -1)]
        large = rng.normal(size=(2, 3, 3)) + np.array([0, 0, -1.0])
        wide = [large + rng.normal(size=(2, 3, 3)) * 10.0**-exponent for _ in range(3)]
        camera = Camera((0.1, 0.2, 4.0), (0.1, 0.2, 0), vfov=40, resolution=(18, 8))
        triangles = np.concatenate([*copies, *wide])
        counters: dict[str, int] = {}
        order = rng.permutation(len(triangles))
        assert_exact(triangles[order], camera, order, chunk=9, counters=counters)
        assert exponent == 7 or counters["depths_compared"] > 0


@pytest.mark.parametrize("power", [-700, -400, 300, 340, 400])
def test_numbers_that_overflow_or_underflow(rng, power):
    triangles = np.ldexp(rng.integers(-6, 7, size=(15, 3, 3)).astype(np.float64), power)
    keep = [t for t in triangles if has_area(t)]
    camera = exact_camera([0, 0, 0])
    blockers = ListBlockers(keep)
    picture = own_picture(find_visible(blockers, camera, full(camera)), camera)
    frame = camera.frame()
    expected = [[seen_exactly(keep, blockers.ids, frame, x, y) for x in range(9)] for y in range(7)]
    np.testing.assert_array_equal(picture, expected)


def test_coplanar_surfaces_show_the_lowest_index(rng):
    # Two large triangles of one skew plane whose float64 depths differ in rounding, and a third in the
    # other winding; the lower index must win wherever they overlap.
    u, v = np.array([3.0, 1.0, -2.0]), np.array([-1.0, 3.0, 1.0])
    origin = np.array([0.0, 0.0, -7.0])
    weights = np.array(
        [[[-9, -5], [8, -7], [1, 9]], [[-7, 6], [9, 3], [-2, -9]], [[0, 8], [-8, -6], [9, -5]]]
    )
    triangles = origin + np.array(weights) @ np.stack([u, v])
    camera = exact_camera([0, 0, 0], 17, 13, 0.125)
    for ids in ([0, 1, 2], [2, 0, 1], [1, 2, 0]):
        for chunk in (1, 3):
            assert_exact(triangles, camera, ids, chunk=chunk)


def test_duplicates_in_any_winding_show_the_lowest_index(rng):
    mesh = trimesh.creation.icosphere(subdivisions=2).triangles
    flipped = mesh[:, [1, 0, 2]]
    camera = Camera((0.3, 0.4, 3.0), (0, 0, 0), resolution=(40, 30))
    n = len(mesh)
    blockers = ListBlockers(np.concatenate([mesh, flipped]), [*range(n, 2 * n), *range(n)], chunk=100)
    buffer = find_visible(blockers, camera, full(camera))
    assert len(buffer.own) > 100
    assert buffer.own.max() < n


def room(rng, scale: float, offset: float) -> Float64Array:
    """A rotated box, split into many uneven triangles, seen from inside."""
    box = trimesh.creation.box(extents=(4, 3, 5)).subdivide_loop(0).subdivide().subdivide()
    turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    return np.asarray(box.triangles @ turn.T * scale + offset, dtype=np.float64)


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e-6, 0.0), (1e6, 0.0), (1.0, 1e6), (1e-3, 1e5)])
def test_closed_room_has_no_holes(rng, scale, offset):
    triangles = room(rng, scale, offset)
    for target in rng.normal(size=(4, 3)):
        eye = tuple(np.full(3, offset) + scale * rng.uniform(-1, 1, 3))
        camera = Camera(eye, tuple(np.array(eye) + target), up=(0.1, 1, 0.3), vfov=100, resolution=(160, 120))
        buffer = find_visible(ListBlockers(triangles), camera, full(camera))
        assert len(buffer.pixel) == 160 * 120
        inside = (buffer.points - np.array(eye)) * buffer.normals
        assert (inside.sum(axis=1) < 0).all()


def test_picture_depends_on_no_order_chunk_thread_or_window(rng):
    triangles = rng.normal(size=(900, 1, 3)) * 2 + rng.normal(size=(900, 3, 3)) * 0.3
    triangles[::7, 1] *= 20
    camera = Camera((0.1, 0.2, 4), (0, 0, 0), vfov=70, resolution=(150, 140))
    whole_picture = find_visible(ListBlockers(triangles), camera, full(camera))
    order = rng.permutation(len(triangles))
    for chunk, threads in ((1000, 2), (64, 1), (17, 2)):
        other = find_visible(
            ListBlockers(triangles[order], order, chunk), camera, full(camera), threads=threads
        )
        for field, expected in zip(other, whole_picture, strict=True):
            np.testing.assert_array_equal(field, expected)
    rows = [find_visible(ListBlockers(triangles), camera, (0, y, 150, y + 35)) for y in range(0, 140, 35)]
    for name in GBuffer._fields:
        glued = np.concatenate([getattr(part, name) for part in rows])
        np.testing.assert_array_equal(glued, getattr(whole_picture, name))
    crop = find_visible(ListBlockers(triangles), camera, (31, 40, 77, 111))
    y, x = np.divmod(whole_picture.pixel, 150)
    inside = (x >= 31) & (x < 77) & (y >= 40) & (y < 111)
    for field, expected in zip(crop, whole_picture, strict=True):
        np.testing.assert_array_equal(field, expected[inside])


def test_chunks_outside_the_view_are_not_read(rng):
    near = rng.normal(size=(50, 3, 3)) * 0.3
    away = [near + np.array(v) for v in ([0, 0, 40], [60, 0, 0], [-60, 0, 0], [0, 60, 0], [0, -60, 0])]
    blockers = ListBlockers(np.concatenate([near, *away]), chunk=50)
    camera = Camera((0, 0, 5), (0, 0, 0), resolution=(32, 24))
    counters: dict[str, int] = {}
    buffer = find_visible(blockers, camera, full(camera), counters=counters)
    assert blockers.read_chunks == [0]
    assert counters["bytes_read"] == near.nbytes
    assert counters["bytes_skipped"] == 5 * near.nbytes
    assert 0 < counters["triangles_rasterised"] <= 50
    assert counters["pixels_tested"] >= len(buffer.pixel)
    alone = find_visible(ListBlockers(near), camera, full(camera))
    for field, expected in zip(buffer, alone, strict=True):
        np.testing.assert_array_equal(field, expected)


def test_boxes_that_are_seen_are_never_skipped(rng):
    camera = Camera((0.2, -0.3, 1.0), (0, 0, 0), vfov=50, resolution=(64, 48))
    window = (10, 20, 40, 41)
    view = make_view(camera.frame(), camera.resolution, window)
    skipped = 0
    for _ in range(300):
        box = np.sort(rng.normal(size=(2, 3)) * 2, axis=0)
        if not may_be_seen(box, view):
            skipped += 1
            mesh = trimesh.creation.box(bounds=box).triangles
            assert len(find_visible(ListBlockers(mesh), camera, window).pixel) == 0
    assert skipped > 50


def test_needles_and_nearly_edge_on_triangles(rng):
    along = rng.normal(size=(40, 3))
    start = rng.normal(size=(40, 3)) * 0.2
    needles = np.stack([start, start + along * 1e-9 * rng.normal(size=(40, 1)), start + along * 3], axis=1)
    needles[:, 1] += rng.normal(size=(40, 3)) * 1e-9
    floor = np.array([[[-50, 1e-9, 40], [50, 1e-9, 40], [0, -1e-9, -50]]]) + np.array([0, 2.0, 0])
    camera = Camera((0, 2.0, 3), (0, 2.0, 0), resolution=(64, 1), vfov=1e-3)
    buffer = find_visible(ListBlockers(floor), camera, full(camera))
    assert np.isfinite(buffer.points).all() and np.isfinite(buffer.normals).all()
    assert_exact(needles, Camera((0, 0, 4), (0, 0, 0), resolution=(24, 16)))
    # A needle is seldom hit; looking straight at one gives its normal to full precision all the same.
    for needle in needles[:8]:
        middle = needle.mean(axis=0)
        camera = Camera(
            tuple(middle + np.array([0.1, 0.2, 3.0])), tuple(middle), vfov=1e-7, resolution=(3, 3)
        )
        buffer = find_visible(ListBlockers(needle[None]), camera, full(camera))
        for normal in buffer.normals:
            edges = needle[[1, 2, 0]] - needle
            lengths = np.linalg.norm(edges, axis=1)
            assert np.abs(edges @ normal / lengths).max() < 1e-6


def test_nothing_to_see():
    camera = Camera((0, 0, 5), (0, 0, 0), resolution=(8, 6))
    assert [
        len(field) for field in find_visible(ListBlockers(np.zeros((0, 3, 3))), camera, full(camera))
    ] == [0] * 5
    triangle = np.array([[[0, 0, 9.0], [1, 0, 9], [0, 1, 9]]])
    assert len(find_visible(ListBlockers(triangle), camera, full(camera)).pixel) == 0
    assert len(find_visible(ListBlockers(triangle - [0, 0, 9]), camera, (3, 2, 3, 4)).pixel) == 0


def test_bad_windows_and_cameras_are_refused():
    blockers = ListBlockers(np.ones((1, 3, 3)))
    camera = Camera((0, 0, 5), (0, 0, 0), resolution=(8, 6))
    for window in ((0, 0, 9, 6), (-1, 0, 8, 6), (5, 0, 4, 6)):
        with pytest.raises(SceneError, match="is not inside the picture of 8 x 6"):
            find_visible(blockers, camera, window)
    far = Camera((1e14, 0, 5), (0, 0, 0), vfov=1.0, resolution=(8, 6))
    with pytest.raises(SceneError, match="cannot tell its pixels apart"):
        find_visible(blockers, far, full(far))


_PEAK = """
from pathlib import Path
import trimesh
from visible_oracle import ListBlockers, full
from penumbra.scene import Camera
from penumbra.visible import find_visible

def status(name):
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(name))

room = ListBlockers(trimesh.creation.box(extents=(4, 3, 5)).triangles)
for resolution in ((8, 6), (1920, 1440)):
    Path("/proc/self/clear_refs").write_text("5")
    before = status("VmRSS")
    camera = Camera((0, 0, 0), (0, 0, -1), resolution=resolution)
    n = len(find_visible(room, camera, full(camera), threads=2).pixel)
print(n, status("VmHWM") - before)
"""


def test_window_bytes_are_the_memory_of_a_window():
    if not Path("/proc/self/clear_refs").exists():
        pytest.skip("this system does not tell the peak memory of a stretch of code")
    tests = Path(__file__).parent
    run = subprocess.run(
        [sys.executable, "-c", _PEAK],
        cwd=tests,
        env={**os.environ, "PYTHONPATH": str(tests.parent)},
        capture_output=True,
        text=True,
        check=True,
    )
    n_pixels, peak_bytes = map(int, run.stdout.split())
    assert n_pixels == 1920 * 1440
    promised = window_bytes(1920, 1440, threads=2)
    # Code pages and allocator slack come on top; a z-buffer kept beside its result would add 80 %.
    assert 0.8 * promised < peak_bytes < 1.1 * promised


# Embree sets flush-to-zero in the threads of its process, so it gets a process of its own.
_EMBREE = """
import json, sys
import numpy as np, trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector
mesh = trimesh.load(sys.argv[1], process=False)
rays = np.load(sys.argv[2])
origins = rays[:1].repeat(len(rays) - 1, 0)
first = RayMeshIntersector(mesh, scale_to_box=False).intersects_first(origins, rays[1:])
print(json.dumps(first.tolist()))
"""


def test_first_hits_of_sponza_agree_with_embree(tmp_path):
    pytest.importorskip("embreex")
    path = scene_file("sponza_dabrovic.ply")
    triangles = np.asarray(trimesh.load(path, process=False).triangles, dtype=np.float64)
    camera = Camera((-6.5, 4.2, 1.6), (3, 2.2, -3.2), vfov=62, resolution=(320, 240))
    counters: dict[str, int] = {}
    buffer = find_visible(ListBlockers(triangles, chunk=9000), camera, full(camera), counters=counters)
    frame = camera.frame()
    y, x = np.divmod(np.arange(320 * 240), 320)
    rays = frame.d0 + y[:, None] * frame.dy + x[:, None] * frame.dx
    np.save(tmp_path / "rays.npy", np.concatenate([frame.eye[None], rays]))
    run = subprocess.run(
        [sys.executable, "-c", _EMBREE, str(path), str(tmp_path / "rays.npy")],
        capture_output=True,
        text=True,
        check=True,
    )
    ours, theirs = own_picture(buffer, camera).ravel(), np.array(json.loads(run.stdout))
    different = np.flatnonzero(ours != theirs)
    assert len(different) < 0.002 * len(ours)
    # Where they differ, the rationals say that what we see is hit, and no later than what Embree saw.
    eye = exact(frame.eye)
    for pixel in different:
        ray = ray_of(frame, int(x[pixel]), int(y[pixel]))
        candidates = [int(i) for i in (ours[pixel], theirs[pixel]) if i >= 0]
        hits = [(hit_parameter([exact(v) for v in triangles[i]], eye, ray), i) for i in candidates]
        assert min(((t, i) for t, i in hits if t is not None), default=(None, -1))[1] == ours[pixel]
    assert_receivers(buffer, ListBlockers(triangles), camera, stride=97)
