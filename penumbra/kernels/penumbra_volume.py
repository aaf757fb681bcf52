"""Penumbra volumes from separating planes (HPC sections 3.1 and 3.2), conservative under rounding.

A plane is (n, d) with n . p + d >= 0 inside. Eight planes, structure of arrays (4, 8), so that one
vector of lanes tests them all: three through an edge of the blocker and a corner of the light, four
through an edge of the light and a corner of the blocker, and the plane of the blocker as a cap.
Places without a plane hold (0, 0, 0, 1), which is inside everywhere.

Any direction n gives a bound, however it was rounded: if n . l <= n . q for all l of the light and q
of the blocker, then a receiver r = q + k (q - l), k >= 0, has n . r >= min n . q. Where the planes
touch both polygons, as separating planes do, n . l may exceed n . q by a rounding error e; then n . r
can fall short by k e, and k is at most the reach of a shadow over the gap between blocker and light.
Both go into the slack of d, some 1e-12 of the scene's size in ordinary scenes.
"""

import numpy as np

from penumbra.kernels._jit import helper, inlined
from penumbra.kernels.borrow import borrow
from penumbra.kernels.lanes import bits_above, bits_not_below, greater, lesser, load, splat
from penumbra.kernels.predicates import OVERFLOW, UNDERFLOW, UNIT_ROUNDOFF

N_PLANES = 8
VOLUME_SIZE = 4 * N_PLANES
ALL_PLANES = np.int64(255)
# Dot products of three terms, of both polygons, of receiver or box, and the rounding of d.
TOLERANCE = 24.0 * UNIT_ROUNDOFF
_NO_CHOICE = np.int64(-1)


@helper
def cross(ax, ay, az, bx, by, bz):
    """Cross product of two vectors."""
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@helper
def light_gap(tri, light):
    """Lower bound of the distance between a blocker and the light: largest gap along x, y, z, normal."""
    gap = 0.0
    for axis in range(3):
        low = min(min(tri[0, axis], tri[1, axis]), tri[2, axis])
        high = max(max(tri[0, axis], tri[1, axis]), tri[2, axis])
        light_low = np.inf
        light_high = -np.inf
        for j in range(4):
            light_low = min(light_low, light.corners[0, j, axis])
            light_high = max(light_high, light.corners[0, j, axis])
        gap = max(gap, max(low - light_high, light_low - high))
    u, v, o = light.edge_u, light.edge_v, light.origin
    nx, ny, nz = cross(u[0], u[1], u[2], v[0], v[1], v[2])
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    # Beyond these bounds the squares lose bits or overflow, and the gap along the normal is left out.
    if length > 1e-120 and length < 1e120:
        low = np.inf
        high = -np.inf
        for k in range(3):
            height = nx * (tri[k, 0] - o[0]) + ny * (tri[k, 1] - o[1]) + nz * (tri[k, 2] - o[2])
            low = min(low, height)
            high = max(high, height)
        # Edges parallel but for rounding give a normal that the light is far from perpendicular to.
        thickness = 0.0
        for j in range(4):
            c = light.corners[0, j]
            thickness = max(thickness, abs(nx * (c[0] - o[0]) + ny * (c[1] - o[1]) + nz * (c[2] - o[2])))
        gap = max(gap, (max(low, -high) - thickness) / length)
    # Rounding of the bound itself, and samples that lie off the polygon of the corners.
    reach = abs(o[0]) + abs(o[1]) + abs(o[2])
    for k in range(3):
        reach += abs(tri[k, 0]) + abs(tri[k, 1]) + abs(tri[k, 2])
    return gap * (1.0 - 1e-9) - 1e-13 * reach - 4.0 * light.residual - UNDERFLOW


@helper
def _place_plane(nx, ny, nz, tri, corners, polygon, extent, amplify, residual, planes, k):
    """Put the bound along direction n at place k; False where the direction does not separate."""
    norm = abs(nx) + abs(ny) + abs(nz)
    if not (norm > 0.0 and norm * extent < OVERFLOW):
        return False
    inside = np.inf
    for q in range(3):
        inside = min(inside, nx * tri[q, 0] + ny * tri[q, 1] + nz * tri[q, 2])
    light_side = -np.inf
    for j in range(4):
        light_side = max(
            light_side,
            nx * corners[polygon, j, 0] + ny * corners[polygon, j, 1] + nz * corners[polygon, j, 2],
        )
    tolerance = norm * (TOLERANCE * extent + 2.0 * residual) + UNDERFLOW
    overlap = light_side - inside
    if not overlap <= tolerance:
        return False
    slack = tolerance
    if overlap > -2.0 * tolerance:
        slack += 3.0 * amplify * tolerance
    planes[0, k] = nx
    planes[1, k] = ny
    planes[2, k] = nz
    planes[3, k] = slack - inside
    return True


@helper
def _blocker_edge_normal(tri, corners, polygon, edge, corner):
    """Normal of the plane through an edge of the blocker and a corner of the light, blocker inside."""
    i = (edge + 1) % 3
    j = (edge + 2) % 3
    ax, ay, az = tri[edge, 0], tri[edge, 1], tri[edge, 2]
    nx, ny, nz = cross(
        tri[i, 0] - ax, tri[i, 1] - ay, tri[i, 2] - az,
        corners[polygon, corner, 0] - ax, corners[polygon, corner, 1] - ay, corners[polygon, corner, 2] - az,
    )  # fmt: skip
    if nx * (tri[j, 0] - ax) + ny * (tri[j, 1] - ay) + nz * (tri[j, 2] - az) < 0.0:
        return -nx, -ny, -nz
    return nx, ny, nz


@helper
def _light_edge_normal(tri, corners, polygon, edge, vertex):
    """Normal of the plane through an edge of the light and a corner of the blocker, light outside."""
    i = (edge + 1) & 3
    j = (edge + 2) & 3
    ax, ay, az = corners[polygon, edge, 0], corners[polygon, edge, 1], corners[polygon, edge, 2]
    nx, ny, nz = cross(
        corners[polygon, i, 0] - ax, corners[polygon, i, 1] - ay, corners[polygon, i, 2] - az,
        tri[vertex, 0] - ax, tri[vertex, 1] - ay, tri[vertex, 2] - az,
    )  # fmt: skip
    opposite = (
        nx * (corners[polygon, j, 0] - ax)
        + ny * (corners[polygon, j, 1] - ay)
        + nz * (corners[polygon, j, 2] - az)
    )
    if opposite > 0.0:
        return -nx, -ny, -nz
    return nx, ny, nz


@helper
def fill_volume(blocker, normal, light, polygon, choices, planes):
    """Set planes (4, 8) to the penumbra volume of a blocker and a polygon of the light; return its set.

    polygon 0 is the whole light, 1 + g a group. normal: that of the blocker; its `amplify` bounds k
    (module docstring). choices (7,) holds, and is given,
    the corner that each of the first seven planes went through: that of the whole light is nearly
    always right for its groups (390 ns a volume without it, 240 with it).
    """
    blocker, normal, light = borrow(blocker), borrow(normal), borrow(light)
    choices, planes = borrow(choices), borrow(planes)
    found = np.int64(0)
    tri, extent, amplify = blocker.corners, blocker.extent, blocker.amplify
    residual = light.residual
    corners = light.corners
    for k in range(7):
        n_candidates = 4 if k < 3 else 3
        first = choices[k] if choices[k] != _NO_CHOICE else 0
        choices[k] = _NO_CHOICE
        for step in range(n_candidates):
            candidate = (first + step) % n_candidates
            if k < 3:
                nx, ny, nz = _blocker_edge_normal(tri, corners, polygon, k, candidate)
            else:
                nx, ny, nz = _light_edge_normal(tri, corners, polygon, k - 3, candidate)
            if _place_plane(nx, ny, nz, tri, corners, polygon, extent, amplify, residual, planes, k):
                choices[k] = candidate
                found |= np.int64(1) << k
                break
        if choices[k] == _NO_CHOICE:
            planes[0, k] = planes[1, k] = planes[2, k] = 0.0
            planes[3, k] = 1.0
    nx, ny, nz = normal[0], normal[1], normal[2]
    if _place_plane(nx, ny, nz, tri, corners, polygon, extent, amplify, residual, planes, 7) or _place_plane(
        -nx, -ny, -nz, tri, corners, polygon, extent, amplify, residual, planes, 7
    ):
        return found | np.int64(128)
    planes[0, 7] = planes[1, 7] = planes[2, 7] = 0.0
    planes[3, 7] = 1.0
    return found


@inlined
def clip_box(planes, first, active, boxes, node):
    """Active planes that a node's box straddles, or -1 if the box is wholly outside an active one.

    planes: array that holds the volume (4, 8) from flat offset `first` on. HPC section 3.3 B: a plane
    that has the whole box inside needs no test below that node.
    """
    nx, ny, nz, d = (
        load(planes, first),
        load(planes, first + 8),
        load(planes, first + 16),
        load(planes, first + 24),
    )
    x0, x1 = nx * splat(boxes[node, 0]), nx * splat(boxes[node, 3])
    y0, y1 = ny * splat(boxes[node, 1]), ny * splat(boxes[node, 4])
    z0, z1 = nz * splat(boxes[node, 2]), nz * splat(boxes[node, 5])
    zero = splat(0.0)
    farthest = (greater(x0, x1) + greater(y0, y1)) + (greater(z0, z1) + d)
    if bits_above(zero, farthest) & active:
        return np.int64(-1)
    nearest = (lesser(x0, x1) + lesser(y0, y1)) + (lesser(z0, z1) + d)
    return active & ~bits_not_below(nearest, zero)


@inlined
def contains_point(planes, first, active, x, y, z):
    """Whether a point is inside all active planes of the volume at flat offset `first`."""
    nx, ny, nz, d = (
        load(planes, first),
        load(planes, first + 8),
        load(planes, first + 16),
        load(planes, first + 24),
    )
    height = (nx * splat(x) + ny * splat(y)) + (nz * splat(z) + d)
    return bits_above(splat(0.0), height) & active == 0
