"""What tests of primary visibility share: blockers in any order, an exact camera, rational pixels."""

from collections.abc import Sequence
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from penumbra.arrays import BlockerChunk, ChunkInfo, Float64Array, Int64Array
from penumbra.scene import CameraFrame
from penumbra.visible import GBuffer, find_visible

Vector = tuple[Fraction, Fraction, Fraction]


class ListBlockers:
    """Triangles in any order and any chunking, without an ingest."""

    def __init__(self, triangles: NDArray, ids: Sequence[int] | None = None, chunk: int = 1000) -> None:
        self.triangles = np.array(triangles, dtype=np.float64).reshape(-1, 3, 3)
        self.ids = np.arange(len(self.triangles)) if ids is None else np.array(ids, dtype=np.int64)
        self.n_triangles, self.n_dropped = len(self.triangles), 0
        self.n_bytes = self.triangles.nbytes
        corners = self.triangles.reshape(-1, 3)
        self.bounds = np.stack([corners.min(0), corners.max(0)]) if len(corners) else np.zeros((2, 3))
        self.chunks = []
        self.read_chunks: list[int] = []
        for first in range(0, len(self.triangles), chunk):
            part = self.triangles[first : first + chunk]
            box = np.stack([part.min((0, 1)), part.max((0, 1))])
            self.chunks.append(ChunkInfo(0, first, len(part), part.nbytes, box))

    def read(self, i: int) -> BlockerChunk:
        self.read_chunks.append(i)
        part = slice(self.chunks[i].first, self.chunks[i].first + self.chunks[i].count)
        none = np.zeros((0, 2, 3))
        return BlockerChunk(self.triangles[part], self.ids[part], none, none, none)

    def close(self) -> None:
        return


def exact(values: Sequence[float]) -> Vector:
    x, y, z = (Fraction(float(value)) for value in values)
    return x, y, z


def minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def dot(a: Vector, b: Vector) -> Fraction:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def hit_parameter(triangle: Sequence[Vector], eye: Vector, ray: Vector) -> Fraction | None:
    """Where the ray from the eye meets the closed triangle, by solving for plane and sides one by one."""
    a, b, c = triangle
    normal = cross(minus(b, a), minus(c, a))
    height, slope = dot(minus(a, eye), normal), dot(ray, normal)
    if height == 0 or slope == 0 or height / slope <= 0:
        return None
    t = height / slope
    hit = (eye[0] + t * ray[0], eye[1] + t * ray[1], eye[2] + t * ray[2])
    for start, end in ((a, b), (b, c), (c, a)):
        if dot(cross(minus(end, start), minus(hit, start)), normal) < 0:
            return None
    return t


def ray_of(frame: CameraFrame, x: int, y: int) -> Vector:
    q = frame.eye + ((frame.d0 + y * frame.dy) + x * frame.dx)
    return minus(exact(q), exact(frame.eye))


def seen_exactly(triangles: Float64Array, ids: Sequence[int], frame: CameraFrame, x: int, y: int) -> int:
    """The index of the triangle that pixel (x, y) sees, -1 for none."""
    eye, ray = exact(frame.eye), ray_of(frame, x, y)
    hits = [
        (t, int(index))
        for triangle, index in zip(triangles, ids, strict=True)
        if (t := hit_parameter([exact(v) for v in triangle], eye, ray)) is not None
    ]
    return min(hits)[1] if hits else -1


def exact_camera(
    eye: Sequence[float], width: int = 9, height: int = 7, step: float = 0.25
) -> SimpleNamespace:
    """Looks along -z; all of its rays, and eye + ray for small whole numbers, are exact in float64."""
    d0 = np.array([-(width - 1) / 2 * step, (height - 1) / 2 * step, -1.0])
    frame = CameraFrame(
        np.array(eye, dtype=np.float64),
        d0,
        np.array([step, 0.0, 0.0]),
        np.array([0.0, -step, 0.0]),
        np.array([0.0, 0.0, -1.0]),
    )
    return SimpleNamespace(resolution=(width, height), frame=lambda: frame)


def full(camera) -> tuple[int, int, int, int]:
    return (0, 0, *camera.resolution)


def own_picture(buffer: GBuffer, camera) -> Int64Array:
    """(height, width) triangle index, -1 for background."""
    width, height = camera.resolution
    picture = np.full(width * height, -1, dtype=np.int64)
    picture[buffer.pixel] = buffer.own
    return picture.reshape(height, width)


def assert_exact(triangles: Float64Array, camera, ids: Sequence[int] | None = None, **options) -> GBuffer:
    blockers = ListBlockers(triangles, ids, options.pop("chunk", 1000))
    buffer = find_visible(blockers, camera, full(camera), **options)
    width, height = camera.resolution
    expected = [
        [seen_exactly(blockers.triangles, blockers.ids, camera.frame(), x, y) for x in range(width)]
        for y in range(height)
    ]
    np.testing.assert_array_equal(own_picture(buffer, camera), expected)
    assert_receivers(buffer, blockers, camera)
    return buffer


def assert_receivers(buffer: GBuffer, blockers: ListBlockers, camera, stride: int = 1) -> None:
    """Receivers are just in front of their triangles, on the pixel's ray, with the normal to the eye."""
    frame = camera.frame()
    eye = exact(frame.eye)
    by_id = {int(index): triangle for index, triangle in zip(blockers.ids, blockers.triangles, strict=True)}
    assert (np.diff(buffer.pixel) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(buffer.normals, axis=1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(buffer.depth, (buffer.points - frame.eye) @ frame.forward, rtol=1e-12)
    for row in range(0, len(buffer.pixel), stride):
        a, b, c = corners = [exact(v) for v in by_id[int(buffer.own[row])]]
        normal = cross(minus(b, a), minus(c, a))
        side = 1 if dot(minus(eye, a), normal) > 0 else -1
        point = exact(buffer.points[row])
        above = side * dot(minus(point, a), normal)
        length = Fraction(float(np.sqrt(float(dot(normal, normal)))))
        size = max(abs(x) for v in (*corners, eye) for x in v)
        assert above > 0
        assert above <= Fraction(1, 10**13) * length * size
        assert side * dot(exact(buffer.normals[row]), normal) > 0
        y, x = divmod(int(buffer.pixel[row]), camera.resolution[0])
        ray = ray_of(frame, x, y)
        t = hit_parameter(corners, eye, ray)
        assert t is not None
        hit = np.array([float(e + t * r) for e, r in zip(eye, ray, strict=True)])
        # A hit is only as certain as the triangle is away from edge-on.
        edge_sq = max(dot(minus(v, u), minus(v, u)) for u, v in ((a, b), (b, c), (c, a)))
        slant = abs(dot(ray, normal)) / Fraction(float(np.linalg.norm([float(r) for r in ray])))
        tolerance = 1e-14 * float(size * (1 + edge_sq / slant))
        assert np.abs(buffer.points[row] - hit).max() <= tolerance
