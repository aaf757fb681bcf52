"""What Embree says of segments. A process of its own, because Embree sets flush-to-zero in its threads.

    python embree_child.py INPUT.npz OUTPUT.npy

INPUT holds triangles (T, 3, 3), origins (n, 3) and directions (n, 3); OUTPUT bool (n,), whether
something is in the way between origin and origin + direction.
"""

import sys

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene


def main(source: str, target: str) -> None:
    """Trace all segments of source as occlusion rays in Embree's robust mode."""
    with np.load(source) as arrays:
        scene = EmbreeScene(robust=True)
        TriangleMesh(scene, arrays["triangles"].astype(np.float32))
        origins = arrays["origins"].astype(np.float32)
        directions = arrays["directions"].astype(np.float32)
    lengths = np.ones(len(origins), np.float32)  # in units of the direction: up to the sample
    np.save(target, scene.run(origins, directions, dists=lengths, query="OCCLUDED") >= 0)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
