"""Scenes with a point light that break shadow algorithms; the same for the same seed."""

import numpy as np

from penumbra.arrays import Float64Array
from penumbra.lights import PointLight
from penumbra.measure.stability_scene import (
    Case,
    HardScene,
    Rng,
    SceneSize,
    general_blockers,
    general_receivers,
    on_grid,
    scene_of,
    torn_sheet,
)

# No coordinate is zero, and none is that of another.
POSITION = np.array([0.25, -0.125, 4.0])


def point_ordinary(rng: Rng, size: SceneSize) -> HardScene:
    """Triangles, receivers and light in general position: what the other cases are timed against."""
    points, blockers = general_receivers(rng, size.n_point_receivers), general_blockers(rng, size.n_blockers)
    return scene_of(points, blockers, PointLight(POSITION))


def point_on_blockers(rng: Rng, size: SceneSize) -> HardScene:
    """A quarter of the blockers touch the light, an eighth has it in its plane beside it."""
    points = general_receivers(rng, size.n_point_receivers)
    return scene_of(points, _touching(rng, size.n_blockers), PointLight(POSITION))


def point_at_receivers(rng: Rng, size: SceneSize) -> HardScene:
    """A quarter of the receivers are exactly at the light, a quarter one ulp off it; blockers touch it."""
    points = general_receivers(rng, size.n_point_receivers)
    n_at = len(points) // 4
    towards = rng.choice([-np.inf, np.inf], (n_at, 3))
    points[:n_at] = POSITION
    points[n_at : 2 * n_at] = np.nextafter(POSITION, towards)
    return scene_of(points, _touching(rng, size.n_blockers), PointLight(POSITION))


def point_on_horizon(rng: Rng, size: SceneSize) -> HardScene:
    """Receivers with normals; of half of them the light is exactly in the plane through the receiver."""
    points, normals = (
        general_receivers(rng, size.n_point_receivers),
        rng.normal([0, 0, 1], 1, (size.n_point_receivers, 3)),
    )
    n_in_plane = len(points) // 2
    # Whole numbers, so that the normal and its product with the direction are not rounded.
    to_light = (POSITION - points[:n_in_plane]) * 1024
    normals[:n_in_plane] = np.cross(to_light, rng.choice([-3.0, -1.0, 2.0, 5.0], (n_in_plane, 3)))
    blockers = general_blockers(rng, size.n_blockers)
    return scene_of(points, blockers, PointLight(POSITION), normals=normals)


def point_grazing(rng: Rng, size: SceneSize) -> HardScene:
    """A sheet with holes; half of the receivers have the light exactly behind a vertex or an edge of it."""
    sheet, points = torn_sheet(rng, size.n_blockers), general_receivers(rng, size.n_point_receivers)
    n_grazing = len(points) // 2
    weights = rng.choice(np.array([[4, 0, 0], [2, 2, 0], [1, 3, 0]]) / 4.0, n_grazing)
    behind = np.einsum("rk,rkc->rc", weights, rng.choice(sheet, n_grazing))
    points[:n_grazing] = behind + rng.choice([1.0, 3.0], (n_grazing, 1)) * (behind - POSITION)
    return scene_of(points, sheet, PointLight(POSITION))


POINT_ORDINARY = Case(
    "point-ordinary", "a point light, general position", point_ordinary, has_point_light=True
)
POINT_CASES = (
    POINT_ORDINARY,
    Case(
        "point-on-blockers",
        "a point light at vertices, on edges and in planes of blockers",
        point_on_blockers,
        has_point_light=True,
    ),
    Case(
        "point-at-receivers",
        "a point light at receivers and an ulp from them",
        point_at_receivers,
        has_point_light=True,
    ),
    Case(
        "point-on-horizon",
        "a point light in the planes of receivers",
        point_on_horizon,
        has_point_light=True,
    ),
    Case(
        "point-grazing",
        "a point light exactly behind vertices and edges",
        point_grazing,
        has_point_light=True,
    ),
)


def _touching(rng: Rng, n_blockers: int) -> Float64Array:
    """A quarter with the light inside, on an edge or at a vertex; an eighth edge-on to it."""
    n_touching, n_edge_on = max(n_blockers // 4, 3), n_blockers // 8
    a, b = on_grid(rng.normal([0, 0, -1], [0.7, 0.7, 0.5], (2, n_touching + n_edge_on, 3)), 64)
    touching = np.stack([a, b, -(a + b)], axis=1)
    touching[1:n_touching:3, 2] = -a[1:n_touching:3]
    touching[2:n_touching:3, 2] = 0
    touching[n_touching:, 1:] = np.stack([2 * a, a + b], axis=1)[n_touching:]
    return np.concatenate([POSITION + touching, general_blockers(rng, n_blockers - n_touching - n_edge_on)])
