"""Compile every kernel into the cache, by doing once, very small, what each command does."""

import tempfile
from pathlib import Path

import numpy as np

from penumbra.lights import PointLight, RectLight
from penumbra.progress import NullProgress, Progress
from penumbra.scene import Camera, MeshRef, Scene

_OBJ = "v -1 0 1\nv 1 0 1\nv 1 0 -1\nv -1 0 -1\nv -.3 .5 .3\nv .3 .5 .3\nv .3 .5 -.3\nf 1 2 3 4\nf 5 6 7\n"
_PLY_HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
    "property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
)


def warm_up(progress: Progress | None = None) -> Path:
    """Compile all kernels into the cache folder, which is returned; nothing else is written.

    Later commands load the machine code in a fraction of a second. A changed kernel or another numba
    uses another folder and compiles again.
    """
    from penumbra.api import cast
    from penumbra.ingest import ingest
    from penumbra.kernels._jit import cache_folder
    from penumbra.render import render

    progress = progress or NullProgress()
    progress.stage("compile", None, "")
    with tempfile.TemporaryDirectory(prefix="penumbra-warmup-") as name:
        folder = Path(name)
        (folder / "a.obj").write_text(_OBJ)
        (folder / "b.ply").write_bytes(_PLY_HEADER.encode() + _ply_body())
        ingest([folder / "a.obj", folder / "b.ply"], folder / "scene.h5").close()
        for backend in ("hpc", "gears", "reference"):
            render(_scene(folder / "scene.h5"), folder / f"{backend}.exr", backend=backend)
        # Lights without a light space, such as those of zero area, are cast one blocker at a time; receivers
        # would not face such a light if it had one side.
        point = RectLight([0, 2, 0], [0, 0, 0], [0, 0, 0], samples=1, two_sided=True)
        cast(np.zeros((1, 3)), folder / "scene.h5", point)
    progress.close()
    return cache_folder()


def _ply_body() -> bytes:
    """Four vertices, and a triangle and a quad as faces."""
    vertices = np.array([[-0.2, 0.3, 0.2], [0.2, 0.3, 0.2], [0.2, 0.3, -0.2], [-0.2, 0.3, -0.2]], "<f4")
    faces = b"\x03" + np.array([0, 1, 2], "<i4").tobytes() + b"\x04" + np.array([0, 1, 2, 3], "<i4").tobytes()
    return vertices.tobytes() + faces


def _scene(store: Path) -> Scene:
    light = RectLight([-0.4, 2.0, -0.4], [0.8, 0, 0], [0, 0, 0.8], samples=40, name="key")
    camera = Camera((0, 2, 3), (0, 0, 0), resolution=(16, 12))
    return Scene((MeshRef(store),), camera, (light, PointLight([0.3, 1.5, 0.2], name="lamp")))
