"""Hypothesis strategy of small scenes in which points, blockers and the light share coordinates."""

import numpy as np
from hypothesis import strategies as st
from scenes import Floats, SmallScene, transformed

from penumbra import RectLight

_SAMPLES = (1, 2, 3, 5, 16, 31, 33, 65)
_SCALES = (1.0, 1.0, 1.0, 2.0**-20, 2.0**20, 1e-6, 1e6, 0.1)
_OFFSETS = (0.0, 0.0, 0.0, 1e4, 1e6)

# Whole numbers and eighths meet each other in exact zeros; any float does not.
_coordinates = st.one_of(
    st.integers(-3, 3).map(float),
    st.integers(-24, 24).map(lambda eighths: eighths / 8.0),
    st.floats(-4, 4, allow_subnormal=False),
)
_vectors = st.tuples(_coordinates, _coordinates, _coordinates).map(np.array)
# Weights of three vertices: at one, between two, inside, outside; they sum to one.
_WEIGHTS = ((1, 0, 0), (0.5, 0.5, 0), (0.5, 0.25, 0.25), (2, -1, 0), (-0.5, 1, 0.5), (0.25, 0.75, 0))


@st.composite
def small_scenes(draw: st.DrawFn) -> SmallScene:
    """At most 5 receivers, 5 blockers and 65 samples, placed relative to one pool of vectors."""
    pool = np.array(draw(st.lists(_vectors, min_size=3, max_size=9)))

    def pick() -> Floats:
        mixed = np.array(draw(st.sampled_from(_WEIGHTS)))
        return mixed @ pool[[draw(st.integers(0, len(pool) - 1)) for _ in range(3)]]

    corner, edge_u, edge_v = pick(), draw(_vectors), draw(_vectors)
    light = RectLight(
        corner,
        edge_u * draw(st.sampled_from([0.0, 2.0**-60, 1.0, 1.0, 1.0])),
        edge_v,
        samples=draw(st.sampled_from(_SAMPLES)),
        sets=draw(st.sampled_from([1, 1, 8])),
        seed=draw(st.integers(0, 3)),
        two_sided=draw(st.booleans()),
    )
    samples = light.sample_points.reshape(-1, 3)

    def receiver() -> Floats:
        sample = samples[draw(st.integers(0, len(samples) - 1))]
        return draw(st.sampled_from([pick(), 2.0 * pick() - sample, sample]))

    points = np.array([receiver() for _ in range(draw(st.integers(1, 5)))])
    n_triangles = draw(st.integers(0, 5))
    corners = [pick() for _ in range(3 * n_triangles)]
    triangles = np.array(corners).reshape(n_triangles, 3, 3)
    if n_triangles and draw(st.booleans()):
        triangles[0, 0] = samples[draw(st.integers(0, len(samples) - 1))]
    normals = draw(st.none() | st.just(np.array([draw(_vectors) for _ in points])))
    if normals is not None:
        normals[~normals.any(axis=1)] = [0.0, 0.0, 1.0]
    own = draw(
        st.none() | st.just(np.array([draw(st.integers(-1, n_triangles)) for _ in points], dtype=np.int64))
    )
    scene = SmallScene(points, triangles, light, normals, own)
    return transformed(scene, draw(st.sampled_from(_SCALES)), draw(st.sampled_from(_OFFSETS)))
