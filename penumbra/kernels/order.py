"""Areas, curve keys, boxes, and the order of blockers inside a chunk.

The order decides the speed of every later cast: runs of 16, 256 and 4096 blockers must have small
boxes. It is found with the surface-area heuristic (MacDonald and Booth 1990), splitting only at
multiples of 16**k, so that the runs of a chunk are nodes of a hierarchy without any pointer.
"""

import numpy as np

from penumbra.kernels._jit import helper, kernel
from penumbra.kernels.predicates import is_zero_area

KEY_BITS = 21  # per axis: three of them fit a uint64
RUN = 16

_DIGIT_BITS = 11
_DIGIT_MASK = (1 << _DIGIT_BITS) - 1

_ONE = np.uint64(1)
_ZERO = np.uint64(0)
_TOP_BIT = np.uint64(1) << np.uint64(KEY_BITS - 1)

# Far above the rounding of a cross product (about 1e-31 of its square), so that the exact test, which
# is a hundred times slower, runs for slivers only.
_CLEARLY_NOT_FLAT = 1e-20
_CLEARLY_NOT_TINY = 1e-280


@kernel
def fill_measures(vertices, out_areas, out_centres):
    """Areas (n,) and box centres (n, 3) of triangles (n, 3, 3), all float64.

    A triangle of exactly zero area gets -1. Areas overflow to inf and underflow to 0.
    """
    for t in range(len(vertices)):
        ax, ay, az = vertices[t, 0, 0], vertices[t, 0, 1], vertices[t, 0, 2]
        bx, by, bz = vertices[t, 1, 0], vertices[t, 1, 1], vertices[t, 1, 2]
        cx, cy, cz = vertices[t, 2, 0], vertices[t, 2, 1], vertices[t, 2, 2]
        ux, uy, uz = bx - ax, by - ay, bz - az
        vx, vy, vz = cx - ax, cy - ay, cz - az
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        cross_sq = nx * nx + ny * ny + nz * nz
        edges_sq = (ux * ux + uy * uy + uz * uz) * (vx * vx + vy * vy + vz * vz)
        is_clear = cross_sq > _CLEARLY_NOT_FLAT * edges_sq and cross_sq > _CLEARLY_NOT_TINY
        if not is_clear and is_zero_area(ax, ay, az, bx, by, bz, cx, cy, cz):
            out_areas[t] = -1.0
        else:
            # Edges that overflow make a NaN of inf - inf: such a triangle is large.
            out_areas[t] = 0.5 * np.sqrt(cross_sq) if cross_sq == cross_sq else np.inf
        out_centres[t, 0] = 0.5 * min(ax, bx, cx) + 0.5 * max(ax, bx, cx)
        out_centres[t, 1] = 0.5 * min(ay, by, cy) + 0.5 * max(ay, by, cy)
        out_centres[t, 2] = 0.5 * min(az, bz, cz) + 0.5 * max(az, bz, cz)


@helper
def _scale_to(size, bounds):
    """Factor that takes half distances inside bounds (2, 3) to 0 ... size; 0 where they are a point."""
    half_extent = 0.0
    for axis in range(3):
        half_extent = max(half_extent, 0.5 * bounds[1, axis] - 0.5 * bounds[0, axis])
    scale = size / half_extent if half_extent > 0.0 else 0.0
    return scale if scale < np.inf else 0.0


@helper
def _cell(value, origin, scale):
    """Grid coordinate of a value, 0 to 2**KEY_BITS - 1."""
    cells = float(1 << KEY_BITS)
    cell = (value * 0.5 - origin * 0.5) * scale
    return np.uint64(min(max(cell, 0.0), cells - 1.0))


@helper
def _hilbert_key(x, y, z):
    """Place of grid cell (x, y, z) along a Hilbert curve (Skilling 2004, axes to transpose)."""
    q = _TOP_BIT
    while q > _ONE:
        p = q - _ONE
        if x & q:
            x ^= p
        if y & q:
            x ^= p
        else:
            t = (x ^ y) & p
            x ^= t
            y ^= t
        if z & q:
            x ^= p
        else:
            t = (x ^ z) & p
            x ^= t
            z ^= t
        q >>= _ONE
    y ^= x
    z ^= y
    t = _ZERO
    q = _TOP_BIT
    while q > _ONE:
        if z & q:
            t ^= q - _ONE
        q >>= _ONE
    return _interleave(x ^ t, y ^ t, z ^ t)


@helper
def _spread(v):
    """The 21 low bits of v, two zero bits between each and the next."""
    v = (v | (v << np.uint64(32))) & np.uint64(0x1F00000000FFFF)
    v = (v | (v << np.uint64(16))) & np.uint64(0x1F0000FF0000FF)
    v = (v | (v << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    v = (v | (v << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    return (v | (v << np.uint64(2))) & np.uint64(0x1249249249249249)


@helper
def _interleave(x, y, z):
    return (_spread(x) << np.uint64(2)) | (_spread(y) << _ONE) | _spread(z)


@kernel
def fill_curve_keys(centres, bounds, out_keys):
    """Hilbert keys uint64 (n,) of centres (n, 3) on a cubic grid over bounds (2, 3).

    One scale serves all axes: stretching a flat scene to a cube makes its chunks worse.
    """
    scale = _scale_to(float(1 << KEY_BITS), bounds)
    for t in range(len(centres)):
        out_keys[t] = _hilbert_key(
            _cell(centres[t, 0], bounds[0, 0], scale),
            _cell(centres[t, 1], bounds[0, 1], scale),
            _cell(centres[t, 2], bounds[0, 2], scale),
        )


@kernel
def fill_triangle_boxes(vertices, out_boxes):
    """Boxes (ceil(n / 16), 2, 3) of runs of 16 triangles (n, 3, 3)."""
    n_triangles = len(vertices)
    for run in range(len(out_boxes)):
        for axis in range(3):
            low = np.inf
            high = -np.inf
            for t in range(run * RUN, min((run + 1) * RUN, n_triangles)):
                for corner in range(3):
                    value = vertices[t, corner, axis]
                    low = min(low, value)
                    high = max(high, value)
            out_boxes[run, 0, axis] = low
            out_boxes[run, 1, axis] = high


@kernel
def fill_box_boxes(boxes, out_boxes):
    """Boxes (ceil(n / 16), 2, 3) of runs of 16 boxes (n, 2, 3)."""
    for run in range(len(out_boxes)):
        for axis in range(3):
            low = np.inf
            high = -np.inf
            for b in range(run * RUN, min((run + 1) * RUN, len(boxes))):
                low = min(low, boxes[b, 0, axis])
                high = max(high, boxes[b, 1, axis])
            out_boxes[run, 0, axis] = low
            out_boxes[run, 1, axis] = high


@kernel
def fill_unit_boxes(vertices, bounds, out_boxes):
    """Boxes float32 (n, 6), least then largest coordinates, of triangles scaled into the unit cube."""
    scale = _scale_to(1.0, bounds)
    for t in range(len(vertices)):
        for axis in range(3):
            a, b, c = vertices[t, 0, axis], vertices[t, 1, axis], vertices[t, 2, axis]
            out_boxes[t, axis] = (0.5 * min(a, b, c) - 0.5 * bounds[0, axis]) * scale
            out_boxes[t, 3 + axis] = (0.5 * max(a, b, c) - 0.5 * bounds[0, axis]) * scale


@helper
def _sort_digit(digits, order, shift, counts, out_order):
    """One pass of a radix sort: stable, by _DIGIT_BITS bits of digits[t] from `shift` on."""
    for digit in range(len(counts)):
        counts[digit] = 0
    for t in order:
        counts[(digits[t] >> shift) & _DIGIT_MASK] += 1
    total = 0
    for digit in range(len(counts)):
        count = counts[digit]
        counts[digit] = total
        total += count
    for t in order:
        digit = (digits[t] >> shift) & _DIGIT_MASK
        out_order[counts[digit]] = t
        counts[digit] += 1


@kernel
def fill_axis_orders(boxes, out_orders):
    """Sort boxes (n, 6) in the unit cube by their centre on each axis, in 2**22 steps; int32 (3, n).

    Equal centres keep their sequence.
    """
    n_boxes = len(boxes)
    digits = np.empty(n_boxes, np.int32)
    counts = np.empty(1 << _DIGIT_BITS, np.int32)
    first_order = np.empty(n_boxes, np.int32)
    for t in range(n_boxes):
        first_order[t] = t
    spare = np.empty(n_boxes, np.int32)
    largest = np.float32((1 << 2 * _DIGIT_BITS) - 1)
    for axis in range(3):
        for t in range(n_boxes):
            centre = (boxes[t, axis] + boxes[t, 3 + axis]) * np.float32(0.5)
            digits[t] = np.int32(centre * largest)
        _sort_digit(digits, first_order, 0, counts, spare)
        _sort_digit(digits, spare, _DIGIT_BITS, counts, out_orders[axis])


@helper
def _half_area(x0, y0, z0, x1, y1, z1):
    x, y, z = x1 - x0, y1 - y0, z1 - z0
    return x * y + y * z + z * x


@helper
def _fill_part_boxes(boxes, order, first, last, unit, part_boxes):
    """Boxes of the runs of `unit` triangles along one order; returns how many there are."""
    n_parts = (last - first + unit - 1) // unit
    for part in range(n_parts):
        begin = first + part * unit
        x0 = y0 = z0 = np.float32(np.inf)
        x1 = y1 = z1 = np.float32(-np.inf)
        for i in range(begin, min(begin + unit, last)):
            t = order[i]
            x0 = min(x0, boxes[t, 0])
            y0 = min(y0, boxes[t, 1])
            z0 = min(z0, boxes[t, 2])
            x1 = max(x1, boxes[t, 3])
            y1 = max(y1, boxes[t, 4])
            z1 = max(z1, boxes[t, 5])
        part_boxes[part, 0], part_boxes[part, 1], part_boxes[part, 2] = x0, y0, z0
        part_boxes[part, 3], part_boxes[part, 4], part_boxes[part, 5] = x1, y1, z1
    return n_parts


@helper
def _fill_swept_areas(part_boxes, n_parts, areas):
    """areas[0, j], areas[1, j]: half the surface of the box of the first j parts, and of the others."""
    for side in range(2):
        x0 = y0 = z0 = np.float32(np.inf)
        x1 = y1 = z1 = np.float32(-np.inf)
        for step in range(n_parts - 1):
            part = step if side == 0 else n_parts - 1 - step
            x0 = min(x0, part_boxes[part, 0])
            y0 = min(y0, part_boxes[part, 1])
            z0 = min(z0, part_boxes[part, 2])
            x1 = max(x1, part_boxes[part, 3])
            y1 = max(y1, part_boxes[part, 4])
            z1 = max(z1, part_boxes[part, 5])
            areas[side, part + 1 if side == 0 else part] = _half_area(x0, y0, z0, x1, y1, z1)


@helper
def _best_split(boxes, orders, first, last, unit, part_boxes, areas):
    """Axis and number of parts on the left of the cheapest split at a multiple of `unit`."""
    best_cost = np.inf
    best_axis = 0
    best_parts = 1
    for axis in range(3):
        n_parts = _fill_part_boxes(boxes, orders[axis], first, last, unit, part_boxes)
        _fill_swept_areas(part_boxes, n_parts, areas)
        for parts in range(1, n_parts):
            cost = areas[0, parts] * parts + areas[1, parts] * (n_parts - parts)
            if cost < best_cost:
                best_cost = cost
                best_axis = axis
                best_parts = parts
    return best_axis, best_parts


@helper
def _split(orders, axis, first, middle, last, is_right, spare):
    """Bring the left triangles to the front of the other two orders, each side keeping its sequence."""
    for i in range(first, middle):
        is_right[orders[axis, i]] = 0
    for i in range(middle, last):
        is_right[orders[axis, i]] = 1
    for other in range(3):
        if other == axis:
            continue
        order = orders[other]
        left = first
        right = 0
        for i in range(first, last):
            # Both writes always, one of them to be overwritten: a branch here is a coin toss.
            t = order[i]
            order[left] = t
            spare[right] = t
            right += is_right[t]
            left += 1 - is_right[t]
        for i in range(right):
            order[middle + i] = spare[i]


@kernel
def sort_by_surface_area(boxes, orders):
    """Reorder triangles so that runs of 16, 256, 4096, ... have small boxes.

    boxes float32 (n, 6), least then largest coordinates. orders int32 (3, n): in, the triangles sorted
    along each axis; out, row 0 is the new order. A node of more than 16**k triangles, the largest such
    power, is split where the two boxes' areas times their numbers of runs of 16**k add up to least.
    """
    n_triangles = len(boxes)
    is_right = np.zeros(n_triangles, np.uint8)
    spare = np.empty(n_triangles, np.int32)
    part_boxes = np.empty((RUN, 6), np.float32)
    areas = np.empty((2, RUN + 1), np.float32)
    # Depth first: at most 15 nodes wait on each level of 16**k.
    stack = np.empty((256, 2), np.int64)
    stack[0, 0], stack[0, 1] = 0, n_triangles
    n_stack = 1
    while n_stack > 0:
        n_stack -= 1
        first, last = stack[n_stack, 0], stack[n_stack, 1]
        if last - first <= RUN:
            continue
        unit = RUN
        while unit * RUN < last - first:
            unit *= RUN
        axis, parts = _best_split(boxes, orders, first, last, unit, part_boxes, areas)
        middle = first + parts * unit
        _split(orders, axis, first, middle, last, is_right, spare)
        stack[n_stack, 0], stack[n_stack, 1] = first, middle
        stack[n_stack + 1, 0], stack[n_stack + 1, 1] = middle, last
        n_stack += 2
