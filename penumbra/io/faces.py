"""Faces as a reader finds them, and how they become triangles: checked, then fanned from the first vertex."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from penumbra.arrays import BoolArray, Int64Array
from penumbra.errors import MeshError
from penumbra.io.vertex_table import VertexTable
from penumbra.kernels.index_codes import UNREADABLE_INDEX, ZERO_INDEX

# No face of a real mesh comes near this; a damaged count does.
LARGEST_FACE = 1 << 20

# What a page holds at most, unless one face alone is larger.
PAGE_FACES = 1 << 16
PAGE_CORNERS = 1 << 18


class FacePage(NamedTuple):
    """A run of faces in file order."""

    sizes: Int64Array  # (n_faces,) corners of each face
    corners: Int64Array  # (sum of sizes,) vertex numbers from 0, or codes of `index_codes`
    where: Int64Array  # (n_faces,) line of the face in a text file, number of the face in a binary one


class FaceBuffer:
    """Where the text scanners put faces; it grows with the largest face, up to a limit."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.corners: Int64Array = np.empty(PAGE_CORNERS, np.int64)
        self.sizes: Int64Array = np.empty(PAGE_FACES, np.int64)
        self.lines: Int64Array = np.empty(PAGE_FACES, np.int64)

    def take(self, n_faces: int, n_corners: int, line: int) -> tuple[FacePage | None, int]:
        """Take the finished faces, and move the corners of an unfinished one to the front.

        Returns the page, None if it would be empty, and the number of corners left; `line` is where the
        unfinished face began. Raises MeshError for a face that is too large.
        """
        sizes, lines = self.sizes[:n_faces].copy(), self.lines[:n_faces].copy()
        n_taken = int(sizes.sum())
        n_left = n_corners - n_taken
        too_large = np.flatnonzero(sizes > LARGEST_FACE)
        if len(too_large) or n_left > LARGEST_FACE:
            line = int(lines[too_large[0]]) if len(too_large) else line
            raise MeshError(f"{self._path}, line {line}: a face has more than {LARGEST_FACE} corners.")
        page = FacePage(sizes, self.corners[:n_taken].copy(), lines) if n_faces else None
        self.corners[:n_left] = self.corners[n_taken:n_corners]
        if n_left == len(self.corners):
            self.corners = np.concatenate([self.corners, np.empty_like(self.corners)])
        return page, n_left


def count_triangles(sizes: Int64Array) -> Int64Array:
    """Triangles of the fan of each face; a face with fewer than three corners has none."""
    return np.maximum(sizes - 2, 0)


def find_bad_faces(page: FacePage, table: VertexTable) -> BoolArray | None:
    """Which faces have too few corners, an index out of range or a vertex without a place; None if none."""
    n_vertices = table.n_vertices
    corners = page.corners
    in_range = len(corners) == 0 or (corners.min() >= 0 and corners.max() < n_vertices)
    if in_range and table.n_unusable == 0 and page.sizes.min() >= 3:
        return None
    is_bad_corner = _bad_corners(corners, table)
    counts = np.concatenate([[0], np.cumsum(is_bad_corner)])
    ends = np.cumsum(page.sizes)
    bad: BoolArray = (counts[ends] > counts[ends - page.sizes]) | (page.sizes < 3)
    return bad if bad.any() else None


def _bad_corners(corners: Int64Array, table: VertexTable) -> BoolArray:
    is_bad: BoolArray = (corners < 0) | (corners >= table.n_vertices)
    if table.n_unusable:
        good = np.flatnonzero(~is_bad)
        is_bad[good] = ~np.isfinite(table.gather(corners[good])).all(axis=1)
    return is_bad


def describe_fault(corners: Int64Array, table: VertexTable, first_index: int) -> str:
    """Say what is wrong with a bad face, given its corners; the file counts vertices from `first_index`."""
    if len(corners) < 3:
        return (
            f"a face has {len(corners)} {'index' if len(corners) == 1 else 'indices'}, but three are needed"
        )
    corner = int(corners[np.flatnonzero(_bad_corners(corners, table))[0]])
    n_vertices = table.n_vertices
    if corner == UNREADABLE_INDEX:
        return "a vertex index is not a whole number"
    if corner == ZERO_INDEX:
        return "a face uses vertex 0, but vertices are counted from 1"
    if corner < 0 and first_index == 1:
        return "a face uses a relative index that reaches back before the first vertex"
    if corner < 0 or corner >= n_vertices:
        return f"a face uses vertex {corner + first_index}, but the file has only {n_vertices}"
    return f"a face uses vertex {corner + first_index}, which has a coordinate that is not a finite number"


def no_faces(n_vertices: int) -> str:
    """Say that a file has no faces."""
    return f"it has no faces, only points ({n_vertices}), so nothing in it can cast a shadow"


def drop_faces(page: FacePage, bad: BoolArray) -> FacePage:
    """The page without its bad faces."""
    return FacePage(page.sizes[~bad], page.corners[np.repeat(~bad, page.sizes)], page.where[~bad])


def fan(page: FacePage, table: VertexTable) -> NDArray[np.floating]:
    """Triangles of a page without bad faces, shape (n, 3, 3), in file order.

    A face (a, b, c, d) becomes (a, b, c) and (a, c, d).
    """
    positions = table.gather(page.corners)
    if (page.sizes == 3).all():
        return positions.reshape(-1, 3, 3)
    counts = count_triangles(page.sizes)
    first_corner = np.repeat(np.cumsum(page.sizes) - page.sizes, counts)
    first_triangle = np.repeat(np.cumsum(counts) - counts, counts)
    second = first_corner + (np.arange(len(first_corner)) - first_triangle) + 1
    triangles: NDArray[np.floating] = positions[np.stack([first_corner, second, second + 1], axis=1)]
    return triangles


def triangle_ids(counts: Int64Array, bad: BoolArray | None, next_id: int) -> Int64Array:
    """Ids of the triangles of the good faces of a page, when all triangles are counted from `next_id`."""
    ids = np.arange(next_id, next_id + counts.sum(), dtype=np.int64)
    return ids if bad is None else ids[np.repeat(~bad, counts)]
