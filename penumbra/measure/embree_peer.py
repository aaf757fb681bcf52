"""The peer Embree: a child process that builds its structure and traces every shadow ray of a case.

Run as `python -m penumbra.measure.embree_peer`; `peer_process` talks to it. Rays are traced in packets of
16 samples of one receiver, receivers in tiles of 32 x 32 pixels that threads take from a queue; samples
below a receiver's plane are not traced.
"""

import threading
from pathlib import Path
from typing import Any

import numpy as np

from penumbra.arrays import Float64Array
from penumbra.executors.threads import run_tasks
from penumbra.facing import full_mask
from penumbra.kernels.embree_loop import LANES, PACKET_WORDS, RAY_MASK, T_NEAR, TIME, trace_shadow_rays
from penumbra.lights import RectLight, sample_sets_of
from penumbra.measure.embree_library import EmbreeScene
from penumbra.measure.peer_case import CastCase
from penumbra.measure.peer_process import Answer, costed, serve

# Pixels on a side of a work item: enough to make handing it out cheap.
_TILE = 32
_CACHE_LINE = 64
_FIELD = LANES


class EmbreePeer:
    """Embree's side of a comparison."""

    _scene: EmbreeScene | None = None

    def __init__(self) -> None:
        self._scratch = threading.local()

    def build(self, mesh: str, threads: int, robust: bool = False, compact: bool = False) -> Answer:
        """Build over the mesh of a folder (`write_indexed_mesh`)."""
        if self._scene is not None:
            self._scene.close()
        vertices, triangles = (np.load(Path(mesh) / f"{name}.npy") for name in ("vertices", "triangles"))

        def work() -> Answer:
            """Build, and what Embree says of it."""
            self._scene = scene = EmbreeScene(vertices, triangles, threads, robust, compact)
            return {
                "version": scene.version,
                "native_packets": scene.has_native_packets,
                "own_bytes": scene.bytes,
                "own_peak_bytes": scene.peak_bytes,
                "mesh_bytes": vertices.nbytes + triangles.nbytes,
            }

        return costed(work)

    def case(self, folder: str) -> Answer:
        """Load receivers and light, and order the receivers by tile."""
        case = CastCase.read(Path(folder))
        self._light = case.light
        self._rows = np.flatnonzero(_before_light(case.points, case.light))
        y, x = np.divmod(case.index[self._rows], case.width)
        tile = y // _TILE * (case.width // _TILE + 1) + x // _TILE
        order = np.lexsort((x, y, tile))
        self._rows = self._rows[order]
        self._starts = np.flatnonzero(np.diff(tile[order], prepend=-1, append=-1))
        self._points = (case.points + case.offset * case.normals)[self._rows].astype(np.float32)
        self._normals = case.normals[self._rows].astype(np.float32)
        self._sets = sample_sets_of(case.index, case.light.seed, case.light.sets)[self._rows].astype(np.int64)
        self._samples = _padded_samples(case.light)
        full = full_mask(case.light.samples)
        self._masks = np.repeat(full[None], len(case.points), axis=0)
        self._found = np.empty((len(self._rows), len(full)), np.uint64)
        return {"receivers": len(self._rows)}

    def cast(self, threads: int, coherent: bool, samples: int = 0) -> Answer:
        """Trace the first `samples` (0: all) samples of every receiver, once."""
        n_samples = samples or self._light.samples
        rays: list[int] = []

        def trace(tile: int) -> int:
            rows = slice(self._starts[tile], self._starts[tile + 1])
            return self._trace(rows, coherent, n_samples)

        def work() -> Answer:
            rays.extend(run_tasks(trace, range(len(self._starts) - 1), threads))
            return {}

        return costed(work) | {"rays": sum(rays)}

    def masks(self, path: str) -> Answer:
        """Save the bits of the last pass, uint64 (R, n_words), in the order of the receivers."""
        self._masks[self._rows] = self._found
        np.save(path, self._masks)
        return {}

    def _trace(self, rows: slice, coherent: bool, n_samples: int) -> int:
        scene = self._scene
        assert scene is not None
        return int(
            trace_shadow_rays(
                scene.occluded16,
                scene.address,
                scene.arguments(coherent),
                *self._thread_scratch(),
                self._points[rows],
                self._normals[rows],
                self._sets[rows],
                self._samples,
                n_samples,
                self._found[rows],
            )
        )

    def _thread_scratch(self) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        """Valid lanes and a packet, made once for each thread."""
        if not hasattr(self._scratch, "arrays"):
            packet = _aligned(PACKET_WORDS, np.float32)
            packet[:] = 0
            packet[T_NEAR : T_NEAR + _FIELD] = packet[TIME : TIME + _FIELD] = 0.0
            packet[RAY_MASK : RAY_MASK + _FIELD].view(np.uint32)[:] = 0xFFFFFFFF
            self._scratch.arrays = _aligned(LANES, np.int32), packet
        arrays: tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]] = self._scratch.arrays
        return arrays


def _before_light(points: Float64Array, light: RectLight) -> np.ndarray[Any, Any]:
    """Whether each point can see the light's emitting side; the others are not traced, by neither side."""
    if light.two_sided:
        return np.ones(len(points), bool)
    before: np.ndarray[Any, Any] = (points - light.corner) @ np.cross(light.edge_u, light.edge_v) > 0
    return before


def _padded_samples(light: RectLight) -> np.ndarray[Any, Any]:
    """Samples as float32 (sets, 3, K padded to whole packets with nan), coordinate by coordinate."""
    padded = np.full((light.sets, 3, -(-light.samples // LANES) * LANES), np.nan, np.float32)
    padded[:, :, : light.samples] = np.moveaxis(light.sample_points, 2, 1)
    return padded


def _aligned(length: int, dtype: Any) -> np.ndarray[Any, Any]:
    """An uninitialised array that begins at a cache line, as Embree wants it."""
    raw = np.empty(length + _CACHE_LINE // 4, dtype)
    skip = -raw.ctypes.data % _CACHE_LINE // 4
    return raw[skip : skip + length]


def main() -> None:
    """Answer commands until stdin ends."""
    peer = EmbreePeer()
    serve({"build": peer.build, "case": peer.case, "cast": peer.cast, "masks": peer.masks})


if __name__ == "__main__":
    main()
