"""The signs that decide bits, against rationals: where float64 suffices, where it does not, and beyond it."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
import oracle
import pytest
from scenes import Floats

from penumbra.kernels import predicates as helpers


def from_python(name: str) -> Callable[..., Any]:
    """A predicate that Python can call: helpers are compiled for kernels only."""
    helper = getattr(helpers, name)
    call: Callable[..., Any] = numba.njit(lambda *values: helper(*values))
    return call


NAMES = ("orient3d_sign", "edges_side_sign", "dot_difference_sign", "is_zero_area")
predicates = SimpleNamespace(**{name: from_python(name) for name in NAMES})

# Powers of ten for which products of three differences are ordinary, underflow, are subnormal, overflow.
EXPONENTS = [0, -6, 6, -105, -160, -307, -320, 90, 150, 307]


def sign(value: int) -> int:
    """-1, 0 or 1."""
    return (value > 0) - (value < 0)


def scaled(values: Floats, exponent: int) -> Floats:
    """Values times a power of ten, kept finite."""
    with np.errstate(over="ignore"):
        return np.clip(values * float(f"1e{min(exponent, 308)}"), -1.7e308, 1.7e308)


def rational_orient3d(a: Floats, b: Floats, c: Floats, p: Floats) -> int:
    """Sign of (p - a) . ((b - a) x (c - a)), in integers."""
    oracle.Count.predicates += 1
    first, *others = oracle.integers(a, b, c, p)
    u, v, w = ([q - o for q, o in zip(other, first, strict=True)] for other in others)
    return sign(oracle.dot(w, oracle.cross(u, v)))


def four_points(kind: str, rng: np.random.Generator) -> Floats:
    """Corners a, b, c and a point p, (4, 3)."""
    points = rng.uniform(-1, 1, (4, 3))
    if kind == "on the plane, rounded":
        weights = rng.dirichlet([1, 1, 1])
        points[3] = weights @ points[:3]
    elif kind == "on an edge, rounded":
        points[3] = points[0] + rng.random() * (points[1] - points[0])
    elif kind == "one bit off":
        points = rng.integers(-8, 9, (4, 3)) / 8.0
        points[3] = (points[0] + points[1]) / 2.0
        points[3, rng.integers(3)] = np.nextafter(points[3, 0], rng.choice([-9.0, 9.0]))
    elif kind == "whole numbers":
        points = rng.integers(-2, 3, (4, 3)).astype(float)
    elif kind == "in a coordinate plane":
        points[:, 1] = points[0, 1]
    elif kind == "far from the origin":
        points = points * 1e-3 + rng.uniform(1e5, 1e6, 3)
        points[3] = points[:3].mean(axis=0)
    elif kind == "of very different sizes":
        points *= 10.0 ** rng.integers(-200, 100, (4, 1))
    return points


KINDS = (
    "anywhere",
    "on the plane, rounded",
    "on an edge, rounded",
    "one bit off",
    "whole numbers",
    "in a coordinate plane",
    "far from the origin",
    "of very different sizes",
)


@pytest.mark.parametrize("kind", KINDS)
def test_orient3d(kind: str, rng: np.random.Generator) -> None:
    for exponent in EXPONENTS:
        for _ in range(30):
            a, b, c, p = points = scaled(four_points(kind, rng), exponent)
            expected = rational_orient3d(a, b, c, p)
            assert predicates.orient3d_sign(*a, *b, *c, *p) == expected, points.tolist()
            # Cyclic order keeps the sign, a swap turns it, to the last bit.
            assert predicates.orient3d_sign(*b, *c, *a, *p) == expected
            assert predicates.orient3d_sign(*b, *a, *c, *p) == -expected
            with np.errstate(over="ignore"):
                u, v = b - a, c - a
            if np.isfinite([u, v]).all():
                plain = oracle.integers(u, v, p, a)
                side = oracle.dot([x - y for x, y in zip(*plain[2:], strict=True)], oracle.cross(*plain[:2]))
                assert predicates.edges_side_sign(*u, *v, *p, *a) == sign(side), points.tolist()


@pytest.mark.parametrize("kind", KINDS)
def test_dot_difference(kind: str, rng: np.random.Generator) -> None:
    for exponent in EXPONENTS:
        for normal_exponent in (0, exponent, -exponent):
            for _ in range(10):
                points = four_points(kind, rng)
                p, q = scaled(points[:2], exponent)
                # At right angles to p - q, as far as float64 goes, so that the last bits decide.
                normal = scaled(np.cross(points[0] - points[1], points[2]), normal_exponent)
                (n,), (x, y) = oracle.integers(normal), oracle.integers(p, q)
                expected = sign(oracle.dot(n, [s - t for s, t in zip(x, y, strict=True)]))
                oracle.Count.predicates += 1
                found = predicates.dot_difference_sign(*normal, *p, *q)
                assert found == expected, (normal.tolist(), p.tolist(), q.tolist())
                assert predicates.dot_difference_sign(*normal, *q, *p) == -expected


@pytest.mark.parametrize("kind", KINDS)
def test_zero_area(kind: str, rng: np.random.Generator) -> None:
    for exponent in EXPONENTS:
        for _ in range(8):
            a, b, c, p = scaled(four_points(kind, rng), exponent)
            for corners in ((a, b, c), (a, b, p), (a, a, b), (a, b, b), (a, b, a), (a, a, a)):
                oracle.Count.predicates += 1
                first, second, third = oracle.integers(*corners)
                u, v = ([q - o for q, o in zip(other, first, strict=True)] for other in (second, third))
                expected = not any(oracle.cross(u, v))
                assert predicates.is_zero_area(*np.concatenate(corners)) == expected, corners


def test_a_needle_one_bit_wide_has_an_area() -> None:
    tiny = 5e-324
    assert not predicates.is_zero_area(0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.5, 0.5, tiny)
    assert not predicates.is_zero_area(1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 1.5, 1.5, np.nextafter(1.5, 2.0))
    assert predicates.is_zero_area(0.1, 0.1, 0.1, 0.2, 0.2, 0.2, 0.4, 0.4, 0.4)
