"""The backends under test, named once, and how a test compares one with the exact judge."""

from dataclasses import replace
from typing import Any

import numpy as np
import oracle
from numpy.typing import NDArray
from scenes import SmallScene

import penumbra
from penumbra import CastOptions
from penumbra.api import CastResult

# A new backend joins every test of bits by adding its name here.
ONE_AT_A_TIME = "hpc, one blocker at a time"
BACKENDS = ["reference", "hpc", ONE_AT_A_TIME, "gears"]

Masks = NDArray[np.uint64]

# What the judge said of a scene serves every backend: its decisions are counted and few.
_decided: dict[tuple[bytes, ...], Masks] = {}


def way(backend: str, options: CastOptions | None = None) -> dict[str, Any]:
    """Arguments of `penumbra.cast` for a backend of BACKENDS."""
    options = options or CastOptions()
    if backend == ONE_AT_A_TIME:
        return {"backend": "hpc", "options": replace(options, joint_triangles=1 << 40)}
    return {"backend": backend, "options": options}


def cast_scene(scene: SmallScene, backend: str, blockers: Any = None, **arguments: Any) -> CastResult:
    """`penumbra.cast` of a scene; blockers other than its triangles where given. One thread by default."""
    return penumbra.cast(
        scene.points,
        scene.triangles if blockers is None else blockers,
        scene.light,
        normals=scene.normals,
        own=scene.own,
        **{"threads": 1} | arguments | way(backend, arguments.get("options")),
    )


def masks_of(scene: SmallScene, backend: str, blockers: Any = None, **arguments: Any) -> Masks:
    """The masks alone."""
    masks = cast_scene(scene, backend, blockers, **arguments).masks
    assert masks is not None
    return masks


def decided_masks(scene: SmallScene, sample_set: NDArray[np.uint8]) -> Masks:
    """What the exact judge says of every bit of a scene."""
    light = scene.light
    arrays = (scene.points, scene.triangles, light.sample_points, sample_set, scene.normals, scene.own)
    flags = bytes([light.two_sided, scene.normals is None, scene.own is None])
    # A light that shines all round has no plane that a receiver could be behind.
    is_rect = isinstance(light, penumbra.RectLight)
    plane = (light.corner, light.edge_u, light.edge_v) if is_rect else (np.zeros(3),) * 3
    key = (flags, np.concatenate(plane).tobytes(), *(np.asarray(array).tobytes() for array in arrays))
    if key not in _decided:
        _decided[key] = oracle.masks(
            scene.points,
            scene.triangles,
            light.sample_points,
            sample_set,
            light=plane,
            two_sided=light.two_sided,
            normals=scene.normals,
            own=scene.own,
        )
    return _decided[key]


def assert_every_bit(scene: SmallScene, backend: str, blockers: Any = None, **arguments: Any) -> Masks:
    """Assert that every bit of a backend is what the judge decides; returns the masks."""
    result = cast_scene(scene, backend, blockers, **arguments)
    assert result.masks is not None
    expected = decided_masks(scene, result.sample_set)
    assert result.masks.shape == expected.shape
    assert result.masks.dtype == np.uint64
    wrong = np.flatnonzero((result.masks != expected).any(axis=1))
    assert not len(wrong), _difference(scene, result, expected, int(wrong[0]))
    return result.masks


def _difference(scene: SmallScene, result: CastResult, expected: Masks, row: int) -> str:
    """All that reproduces the first wrong bit of a receiver."""
    assert result.masks is not None
    word = int(np.flatnonzero(result.masks[row] != expected[row])[0])
    changed = int(result.masks[row, word] ^ expected[row, word])
    bit = (changed & -changed).bit_length() - 1
    sample = 64 * word + bit
    where = f"receiver {row}, sample {sample}"
    if sample >= scene.light.samples:
        return f"{where} is a padding bit and set"
    point = scene.light.sample_points[result.sample_set[row], sample]
    judged = "blocked" if int(expected[row, word]) >> bit & 1 else "visible"
    normal = None if scene.normals is None else scene.normals[row].tolist()
    own = None if scene.own is None else int(scene.own[row])
    return (
        f"{where} is {judged}: point {scene.points[row].tolist()}, sample point {point.tolist()},"
        f" normal {normal}, own {own}, triangles {scene.triangles.tolist()}, {scene.light}"
    )
