"""A chunk of blockers in light space, where a rectangular light is the unit square at z = 0.

Affine maps keep incidence, so the matrix, rounded as it may be, is the exact map; what is rounded is
its value at a point, by `world_error` (penumbra/light_space.py). Lanes of a cluster, 16 blockers each:
0-2 first corner a, as the nearest float32, 3-5 what that leaves out, 6-8 edge b - a, 9-11 edge a - c,
12-14 normal (b - a) x (c - b), 15 length of the edges, 16 of the normal (sums of absolute values, from
above). Edges are mapped as edges, so that their error scales with them.
"""

import numpy as np

from penumbra.kernels._jit import helper, kernel
from penumbra.kernels.borrow import borrow

N_LANES = 17
FAR = np.float32(1e30)
# Products of three such numbers are far from the largest float32.
_LARGEST = 2.0**30
_UP = 1.0 + 2.0**-20
_BOX_ROUNDING = 2.0**-22


@helper
def _mapped(matrix, x, y, z, row):
    return matrix[row, 0] * x + matrix[row, 1] * y + matrix[row, 2] * z


@helper
def _fill_lane(tri, matrix, origin, lanes, cluster, lane, box):
    """Set one lane of a cluster and the box (6,) of its blocker; False if it does not fit float32."""
    size = 0.0
    largest = 0.0
    edge = (0.0, 0.0, 0.0)
    edges = (edge, edge, edge)
    for k in range(3):
        i = k + 1 if k < 2 else 0
        x, y, z = tri[k, 0] - origin[0], tri[k, 1] - origin[1], tri[k, 2] - origin[2]
        ux, uy, uz = tri[i, 0] - tri[k, 0], tri[i, 1] - tri[k, 1], tri[i, 2] - tri[k, 2]
        length = 0.0
        for row in range(3):
            place = _mapped(matrix, x, y, z, row)
            box[row] = place if k == 0 else min(box[row], place)
            box[3 + row] = place if k == 0 else max(box[3 + row], place)
            largest = max(largest, abs(place))
            if k == 0:
                high = np.float32(place)
                lanes[cluster, row, lane] = high
                lanes[cluster, 3 + row, lane] = np.float32(place - np.float64(high))
            length += abs(matrix[row, 0] * ux) + abs(matrix[row, 1] * uy) + abs(matrix[row, 2] * uz)
        edge = (
            _mapped(matrix, ux, uy, uz, 0),
            _mapped(matrix, ux, uy, uz, 1),
            _mapped(matrix, ux, uy, uz, 2),
        )
        if k == 0:
            edges = (edge, edge, edge)
        elif k == 1:
            edges = (edges[0], edge, edge)
        else:
            edges = (edges[0], edges[1], edge)
        size = max(size, length)
    u, v, w = edges
    normal = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])
    for row in range(3):
        lanes[cluster, 6 + row, lane] = np.float32(u[row])
        lanes[cluster, 9 + row, lane] = np.float32(w[row])
        lanes[cluster, 12 + row, lane] = np.float32(normal[row])
    length = abs(normal[0]) + abs(normal[1]) + abs(normal[2])
    lanes[cluster, 15, lane] = np.float32(size * _UP)
    lanes[cluster, 16, lane] = np.float32((length + 2.0**-20 * size * size) * _UP)
    if largest < _LARGEST and size < _LARGEST:
        return True
    box[:3] = -1e20
    box[3:] = 1e20
    return False


@helper
def _clear_lane(lanes, cluster, lane):
    for k in range(N_LANES):
        lanes[cluster, k, lane] = np.float32(0.0)


@helper
def _put_box(nodes, node, lane, x0, y0, z0, x1, y1, z1):
    nodes[node, 0, lane], nodes[node, 1, lane], nodes[node, 2, lane] = x0, y0, z0
    nodes[node, 3, lane], nodes[node, 4, lane], nodes[node, 5, lane] = x1, y1, z1


@helper
def _merge_children(nodes, node, parent, lane):
    """Make lane `lane` of node `parent` the box around the 16 boxes of a node."""
    x0 = y0 = z0 = FAR
    x1 = y1 = z1 = -FAR
    for k in range(16):
        x0, y0, z0 = min(x0, nodes[node, 0, k]), min(y0, nodes[node, 1, k]), min(z0, nodes[node, 2, k])
        x1, y1, z1 = max(x1, nodes[node, 3, k]), max(y1, nodes[node, 4, k]), max(z1, nodes[node, 5, k])
    _put_box(nodes, parent, lane, x0, y0, z0, x1, y1, z1)


@helper
def _fill_cluster(tree, light, deepest, cluster, box):
    """Set lanes, flags and box of one cluster."""
    matrix, origin, vertices = light.matrix, light.origin, tree.vertices
    low = (np.inf, np.inf, np.inf)
    high = (-np.inf, -np.inf, -np.inf)
    fast = np.int64(0)
    straddling = np.int64(0)
    careful = np.int64(0)
    for lane in range(16):
        t = cluster * 16 + lane
        if t >= vertices.shape[0]:
            _clear_lane(tree.lanes, cluster, lane)
            continue
        fits = _fill_lane(vertices[t], matrix, origin, tree.lanes, cluster, lane, box)
        reach = light.slack + _BOX_ROUNDING * (abs(box[2]) + abs(box[5]))
        if fits and (box[5] < -reach or box[2] > deepest + reach):
            # Behind the light, or farther from it than every receiver.
            _clear_lane(tree.lanes, cluster, lane)
            continue
        if fits:
            fast |= np.int64(1) << lane
            if not box[2] > reach:
                straddling |= np.int64(1) << lane
        else:
            careful |= np.int64(1) << lane
            _clear_lane(tree.lanes, cluster, lane)
        low = (min(low[0], box[0]), min(low[1], box[1]), min(low[2], box[2]))
        high = (max(high[0], box[3]), max(high[1], box[4]), max(high[2], box[5]))
    tree.fast[cluster] = fast
    tree.straddling[cluster] = straddling
    tree.careful[cluster] = careful
    return low, high


@kernel
def fill_tree_part(tree, light, deepest, part):
    """Set lanes and boxes of the clusters of run `part` of 4096 blockers, and the boxes above them.

    deepest: largest z of the receivers. Parts may be filled by several threads at once.
    """
    tree, light = borrow(tree), borrow(light)
    box = np.empty(6)
    slack = light.slack
    n_clusters = tree.fast.shape[0]
    nodes = tree.nodes
    for node in range(part * 16, part * 16 + 16):
        if node >= tree.first_node[1]:
            _put_box(nodes, tree.first_node[1] + part, node & 15, FAR, FAR, FAR, -FAR, -FAR, -FAR)
            continue
        for k in range(16):
            cluster = node * 16 + k
            _put_box(nodes, node, k, FAR, FAR, FAR, -FAR, -FAR, -FAR)
            if cluster >= n_clusters:
                continue
            low, high = _fill_cluster(tree, light, deepest, cluster, box)
            if tree.fast[cluster] | tree.careful[cluster] == 0:
                continue
            # Places are rounded to float32; what lies behind the light matters to nobody.
            out = (
                slack + _BOX_ROUNDING * (abs(low[0]) + abs(high[0])),
                slack + _BOX_ROUNDING * (abs(low[1]) + abs(high[1])),
                slack + _BOX_ROUNDING * (abs(low[2]) + abs(high[2])),
            )
            _put_box(
                nodes, node, k,
                np.float32(max(low[0] - out[0], -1e20)),
                np.float32(max(low[1] - out[1], -1e20)),
                np.float32(max(low[2] - out[2], 0.0)),
                np.float32(min(high[0] + out[0], 1e20)),
                np.float32(min(high[1] + out[1], 1e20)),
                np.float32(min(high[2] + out[2], 1e20)),
            )  # fmt: skip
        _merge_children(nodes, node, tree.first_node[1] + part, node & 15)
    top = tree.first_node[2]
    _merge_children(nodes, tree.first_node[1] + part, top + (part >> 4), part & 15)
