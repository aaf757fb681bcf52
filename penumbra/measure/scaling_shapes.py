"""Shapes that benchmark scenes are made of, and the same surface in four times as many triangles.

Vertices are snapped to a grid of 2**-14: within 16 units of the origin the middle of an edge is then
exact in float32, six times over, so that subdividing changes no point of the surface and no shadow.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from penumbra.arrays import Float64Array, Int64Array

GRID = 2.0**-14
REACH = 16.0
EXACT_LEVELS = 6
"""So often can a snapped mesh be subdivided in float32 without rounding."""

_OFFSET = round(REACH / GRID)
_BITS = 20


class Mesh(NamedTuple):
    """Triangles that share vertices."""

    vertices: Float64Array
    """(V, 3) world space."""
    triangles: Int64Array
    """(T, 3) rows of `vertices`."""

    def corners(self) -> Float64Array:
        """The triangles as coordinates, float64 (T, 3, 3)."""
        corners: Float64Array = self.vertices[self.triangles]
        return corners


def snapped_mesh(parts: Sequence[Float64Array]) -> Mesh:
    """One mesh of several (n, 3, 3), on the grid; triangles that it makes degenerate are left out.

    Raises ValueError for a coordinate at or beyond REACH.
    """
    steps = np.rint(np.concatenate([part.reshape(-1, 3) for part in parts]) / GRID).astype(np.int64)
    if np.abs(steps).max(initial=0) >= _OFFSET:
        raise ValueError(
            f"a benchmark scene reaches {np.abs(steps).max() * GRID:g}: keep it within {REACH:g}"
        )
    x, y, z = (steps + _OFFSET).T
    keys, inverse = np.unique((x << 2 * _BITS) | (y << _BITS) | z, return_inverse=True)
    mask = (1 << _BITS) - 1
    places = np.stack([keys >> 2 * _BITS, keys >> _BITS & mask, keys & mask], axis=1) - _OFFSET
    triangles = inverse.reshape(-1, 3)
    a, b, c = np.moveaxis(places[triangles], 1, 0)
    has_area = np.cross(b - a, c - a).any(axis=1)
    return Mesh(places * GRID, triangles[has_area].astype(np.int64))


def subdivided(mesh: Mesh, levels: int = 1) -> Mesh:
    """Split every triangle in four at the middles of its edges, so many times; neighbours share middles."""
    for _ in range(levels):
        vertices, triangles = mesh
        ends = np.sort(triangles[:, [(0, 1), (1, 2), (2, 0)]].reshape(-1, 2), axis=1)
        edges, edge_of = np.unique(ends[:, 0] << 32 | ends[:, 1], return_inverse=True)
        middles = 0.5 * (vertices[edges >> 32] + vertices[edges & 0xFFFFFFFF])
        a, b, c = triangles.T
        ab, bc, ca = (edge_of.reshape(-1, 3) + len(vertices)).T
        four = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        children = np.stack([np.stack(corners, axis=1) for corners in four], axis=1)
        mesh = Mesh(np.concatenate([vertices, middles]), children.reshape(-1, 3))
    return mesh


def sheet(points: Float64Array) -> Float64Array:
    """Triangles between the points (..., n, m, 3) of one grid or several: 2 (n - 1) (m - 1) of each."""
    a, b = points[..., :-1, :-1, :], points[..., 1:, :-1, :]
    c, d = points[..., 1:, 1:, :], points[..., :-1, 1:, :]
    halves = [np.stack(corners, axis=-2) for corners in ((a, b, c), (a, c, d))]
    triangles: Float64Array = np.stack(halves, axis=-3).reshape(-1, 3, 3)
    return triangles


def tube(axis: Float64Array, across: ArrayLike, up: ArrayLike, sides: int) -> Float64Array:
    """A tube without ends along axis (..., n, 3), its section spanned by two vectors of its radius."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)[:, None]
    across, up = np.asarray(across)[..., None, :], np.asarray(up)[..., None, :]
    return sheet(axis[..., None, :] + np.cos(angle) * across + np.sin(angle) * up)


def turned(profile: Sequence[tuple[float, float]], sides: int) -> Float64Array:
    """A profile of (radius, height) turned about the y axis, open at both ends."""
    radius, height = np.array(profile).T
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    rings = [
        np.outer(radius, np.cos(angle)),
        np.repeat(height[:, None], sides + 1, 1),
        np.outer(radius, np.sin(angle)),
    ]
    return sheet(np.stack(rings, axis=-1))


def box(low: ArrayLike, high: ArrayLike) -> Float64Array:
    """An axis-aligned box, (12, 3, 3), its normals outwards."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    faces = []
    for axis in range(3):
        u, v = np.eye(3)[[(axis + 1) % 3, (axis + 2) % 3]]
        square = np.array([[0 * u, u], [v, u + v]])
        faces += [sheet(low + square * (high - low)), sheet(high - square.swapaxes(0, 1) * (high - low))]
    return np.concatenate(faces)


def rotated(triangles: Float64Array, angle: float) -> Float64Array:
    """Triangles turned about the y axis."""
    x, y, z = np.moveaxis(triangles, -1, 0)
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.stack([cosine * x + sine * z, y, cosine * z - sine * x], axis=-1)
