"""Exact claims about points, edges and triangles, in fractions: what test scenes are said to be made of."""

from collections.abc import Callable, Sequence
from fractions import Fraction

import numpy as np
import oracle
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Vector = list[Fraction]


def exact(vector: Sequence[float] | Floats) -> Vector:
    """The numbers as they are."""
    return [Fraction(float(x)) for x in vector]


def minus(a: Vector, b: Vector) -> Vector:
    """A - b."""
    return [x - y for x, y in zip(a, b, strict=True)]


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def dot(a: Vector, b: Vector) -> Fraction:
    """Scalar product."""
    return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))


def exact_normal(triangle: Floats) -> Vector:
    """Normal of a triangle, of twice its area."""
    a, b, c = map(exact, triangle)
    return cross(minus(b, a), minus(c, a))


def orient3d(a: Floats, b: Floats, c: Floats, d: Sequence[float] | Floats) -> Fraction:
    """Zero where d is in the plane of a, b, c; else the sign of its side."""
    return dot(exact_normal(np.array([a, b, c])), minus(exact(d), exact(a)))


def surrounds(triangle: Floats, point: Floats) -> bool:
    """Whether a point of a triangle's plane is inside of it, not on an edge."""
    normal = exact_normal(triangle)
    turns = [
        dot(cross(minus(exact(b), exact(a)), minus(exact(point), exact(a))), normal)
        for a, b in zip(triangle, np.roll(triangle, -1, axis=0), strict=True)
    ]
    return all(turn > 0 for turn in turns)


def any_edge(holds: Callable[[Floats, Floats], bool], triangle: Floats) -> bool:
    """Whether something holds for one of the three edges."""
    return any(holds(a, b) for a, b in zip(triangle, np.roll(triangle, -1, axis=0), strict=True))


def between(a: Floats, b: Floats, point: Floats) -> bool:
    """Whether a point lies on the open edge from a to b, exactly."""
    edge, away = minus(exact(b), exact(a)), minus(exact(point), exact(a))
    return not any(cross(edge, away)) and 0 < dot(edge, away) < dot(edge, edge)


def grazes(point: Floats, sample: Floats, triangles: Floats) -> bool:
    """Whether the segment meets a triangle and passes exactly over one of its edges or vertices."""
    return any(
        oracle.segment_meets_triangle(exact(point), exact(sample), [exact(v) for v in triangle])  # type: ignore[arg-type, misc]
        and any_edge(lambda a, b: orient3d(point, a, b, sample) == 0, triangle)
        for triangle in triangles
    )
