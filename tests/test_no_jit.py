"""The kernels as plain Python: the same bits, and every index checked by numpy."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from backends import BACKENDS, way

import penumbra

CHILD = """
import sys
import numpy as np
from test_no_jit import cast_both
with np.errstate(all="ignore"):  # words of masks wrap around, and unused lanes may hold anything
    np.save(sys.argv[1], cast_both())
"""


def cast_both() -> np.ndarray:
    """Masks of a small scene by every way to cast it, uint64 (3, R, n_words); all parts small."""
    rng = np.random.default_rng(7)
    blockers = rng.uniform(-1, 1, (60, 1, 3)) + rng.normal(size=(60, 3, 3)) * 0.4
    points, normals = rng.uniform(-2, 2, (40, 3)), rng.normal(size=(40, 3))
    light = penumbra.RectLight([-1, 3, -1], [2, 0.3, 0], [0, 0.2, 2], samples=70, sets=3)
    options = penumbra.CastOptions(tile_receivers=30, leaf_receivers=4, rebuild_fraction=0.1)
    masks = []
    for backend in BACKENDS:
        result = penumbra.cast(points, blockers, light, normals=normals, threads=1, **way(backend, options))
        masks.append(result.masks)
    return np.array(masks)


def test_kernels_give_the_same_bits_without_jit(tmp_path: Path) -> None:
    path = [str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(path)}
    output = tmp_path / "masks.npy"
    subprocess.run([sys.executable, "-c", CHILD, str(output)], env=environment, check=True, timeout=300)
    plain = np.load(output)
    assert np.array_equal(plain[0], plain[1]) and np.array_equal(plain[0], plain[2])
    assert np.array_equal(plain, cast_both())
    assert plain.any() and not (plain[0] == plain[0, 0]).all()
