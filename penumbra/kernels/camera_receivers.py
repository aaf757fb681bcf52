"""3: what a pixel sees becomes a receiver: a point just in front of its triangle, normal, depth.

Point and error bound as in Pharr, Jakob and Humphreys, "Physically Based Rendering", 3rd edition,
sections 3.9.4 (a point from barycentrics is off by at most gamma(7) per unit of sum |b v|) and 3.9.5
("Robust spawned ray origins"). That the point is in front of its triangle is then proven by orient3d.
"""

import numpy as np

from penumbra.kernels._jit import helper, kernel
from penumbra.kernels.predicates import UNIT_ROUNDOFF
from penumbra.kernels.raster_setup import through
from penumbra.kernels.vec3 import (
    absolute,
    cross,
    dot,
    load_triangle,
    minus,
    scaled,
    side_of,
    side_of_if_sure,
    unit,
)

GAMMA_7 = 7.0 * UNIT_ROUNDOFF / (1.0 - 7.0 * UNIT_ROUNDOFF)
# Integers cost more than a move of 1e-15 matters: they are asked only after so many doublings.
_SURE_DOUBLINGS = 4
# After so many doublings along the normal the normal itself is not to be trusted (a sliver).
_NORMAL_DOUBLINGS = 24
# u times the distance, doubled 53 times, is the distance: the point is then the eye, which is in front.
_MOST_DOUBLINGS = _NORMAL_DOUBLINGS + 60


@helper
def _unit_normal(a, b, c, sign, to_eye):
    """Unit normal of a triangle times `sign`.

    From the two shorter edges: of a needle they give the normal to full precision, the longer ones do
    not. Where even these are parallel in float64, it is the direction to the eye made perpendicular to
    the longest edge.
    """
    ab, bc, ca = minus(b, a), minus(c, b), minus(a, c)
    ab_sq, bc_sq, ca_sq = dot(ab, ab), dot(bc, bc), dot(ca, ca)
    u, w, longest = ca, ab, bc
    if ca_sq > bc_sq and ca_sq >= ab_sq:
        u, w, longest = ab, bc, ca
    elif ab_sq > bc_sq:
        u, w, longest = bc, ca, ab
    # Unit vectors, so that no product underflows that need not.
    normal = unit(scaled(cross(unit(u), unit(w)), sign))
    if normal[0] == 0.0 and normal[1] == 0.0 and normal[2] == 0.0:
        along = unit(longest)
        normal = unit(minus(to_eye, scaled(along, dot(to_eye, along))))
    return normal


@helper
def _barycentrics(a, b, c, sign, eye, ray):
    """Barycentric coordinates of the hit, each in [0, 1]."""
    b0 = max(sign * dot(ray, cross(minus(b, eye), minus(c, b))), 0.0)
    b1 = max(sign * dot(ray, cross(minus(c, eye), minus(a, c))), 0.0)
    b2 = max(sign * dot(ray, cross(minus(a, eye), minus(b, a))), 0.0)
    total = b0 + b1 + b2
    # A triangle that is edge-on but for a rounding error: any of its points is as good.
    if not 0.0 < total < np.inf:
        return 1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0
    return b0 / total, b1 / total, b2 / total


@helper
def _sum(a, b, c):
    return a[0] + b[0] + c[0], a[1] + b[1] + c[1], a[2] + b[2] + c[2]


@helper
def _move_in_front(a, b, c, side, point, normal, offset, eye):
    """Move the point along the normal by `offset`, doubled until it is proven to be in front.

    Returns the point and the number of doublings.
    """
    to_eye = minus(eye, point)
    distance = np.sqrt(dot(to_eye, to_eye))
    for doublings in range(_MOST_DOUBLINGS):
        if doublings == _NORMAL_DOUBLINGS:
            normal = unit(to_eye)
            offset = UNIT_ROUNDOFF * distance
        if offset >= distance:
            break
        moved = (
            point[0] + offset * normal[0],
            point[1] + offset * normal[1],
            point[2] + offset * normal[2],
        )
        found = side_of_if_sure(a, b, c, moved)
        if doublings >= _SURE_DOUBLINGS:
            found = side_of(a, b, c, moved)
        if found == side:
            return moved, doublings
        offset = max(2.0 * offset, UNIT_ROUNDOFF * distance)
    return eye, np.int64(_MOST_DOUBLINGS)


@helper
def _receiver(view, a, b, c, x, y):
    """Point and unit normal, in front of a triangle, of the pixel (x, y) that sees it; doublings."""
    side = side_of(a, b, c, view.eye)
    ray = minus(through(view, x, y), view.eye)
    weights = _barycentrics(a, b, c, -float(side), view.eye, ray)
    point = _sum(scaled(a, weights[0]), scaled(b, weights[1]), scaled(c, weights[2]))
    normal = _unit_normal(a, b, c, float(side), minus(view.eye, point))
    size = _sum(
        scaled(absolute(a), weights[0]), scaled(absolute(b), weights[1]), scaled(absolute(c), weights[2])
    )
    offset = GAMMA_7 * dot(absolute(normal), size)
    point, doublings = _move_in_front(a, b, c, side, point, normal, offset, view.eye)
    return point, normal, doublings


@kernel
def fill_receivers(view, band, forward, width, first, out_pixel, out_points, out_normals, out_own, out_depth):
    """Turn the hits of a band into rows `first` and on of the outputs, in ascending pixel order.

    forward: unit vector, three floats; width of the full picture. Outputs are the fields of `GBuffer`.
    Returns the number of doublings of offsets.
    """
    receiver = first
    doublings = 0
    rows, columns = band.own.shape
    for row in range(rows):
        for column in range(columns):
            own = band.own[row, column]
            if own < 0:
                continue
            x, y = band.left + column, band.top + row
            a, b, c = load_triangle(band.vertices[row, column])
            point, normal, doubled = _receiver(view, a, b, c, float(x), float(y))
            out_points[receiver, 0], out_points[receiver, 1], out_points[receiver, 2] = point
            out_normals[receiver, 0], out_normals[receiver, 1], out_normals[receiver, 2] = normal
            out_pixel[receiver] = y * width + x
            out_own[receiver] = own
            out_depth[receiver] = dot(forward, minus(point, view.eye))
            doublings += doubled
            receiver += 1
    return doublings
