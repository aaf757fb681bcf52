"""The peer Mitsuba 3: a child process that estimates visibility at the receivers of a case.

Run as `python -m penumbra.measure.mitsuba_peer`; `peer_process` talks to it. Variant llvm: Dr.Jit compiles
the loop for the vectors of this processor, and Embree inside Mitsuba tests the rays. Every receiver has
samples of its own, jittered in as many strata, as a renderer takes them; nothing but shadow rays is timed.
"""

import importlib
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from penumbra.measure.peer_case import CastCase
from penumbra.measure.peer_process import Answer, costed, serve

_VARIANT = "llvm_ad_mono"


def is_installed() -> bool:
    """Whether Mitsuba can be imported."""
    return find_spec("mitsuba") is not None


class MitsubaPeer:
    """Mitsuba's side of a comparison."""

    def __init__(self) -> None:
        # By name: an optional package without types.
        self._mi: Any = importlib.import_module("mitsuba")
        self._mi.set_variant(_VARIANT)
        self._dr: Any = importlib.import_module("drjit")

    def build(self, mesh: str, threads: int) -> Answer:
        """Build over the mesh of a folder (`write_indexed_mesh`)."""
        mi = self._mi
        self._dr.set_thread_count(threads)
        vertices, triangles = (np.load(Path(mesh) / f"{name}.npy") for name in ("vertices", "triangles"))
        shape = mi.Mesh("blockers", len(vertices), len(triangles))
        values = mi.traverse(shape)
        values["vertex_positions"] = mi.Float(vertices.ravel())
        values["faces"] = mi.UInt32(triangles.ravel())
        values.update()

        def work() -> Answer:
            self._scene = mi.load_dict({"type": "scene", "blockers": shape})
            return {"version": mi.__version__}

        return costed(work)

    def case(self, folder: str) -> Answer:
        """Load receivers and light."""
        mi, case = self._mi, CastCase.read(Path(folder))
        points = (case.points + case.offset * case.normals).astype(np.float32)
        self._points, self._normals = mi.Point3f(points.T), mi.Vector3f(case.normals.T.astype(np.float32))
        light = case.light
        self._corner, self._edge_u, self._edge_v = (
            mi.Vector3f(*(float(x) for x in vector)) for vector in (light.corner, light.edge_u, light.edge_v)
        )
        side = (case.points - light.corner) @ np.cross(light.edge_u, light.edge_v)
        self._in_front = mi.Bool(np.asarray(side > 0) | light.two_sided)
        self._n_receivers = len(points)
        return {"receivers": len(points)}

    def cast(self, rows: int, seed: int) -> Answer:
        """Estimate visibility with rows x rows samples; timed until it is there."""

        def work() -> Answer:
            """Trace every sample of every receiver, and wait for the result."""
            mi, dr = self._mi, self._dr
            random = mi.PCG32(size=self._n_receivers, initstate=seed)
            seen = dr.zeros(mi.Float, self._n_receivers)
            for sample in range(rows * rows):
                column, row = mi.Float(sample % rows), mi.Float(sample // rows)
                # Opaque: one kernel is compiled, and serves every sample.
                dr.make_opaque(column, row)
                u = (column + random.next_float32()) / rows
                v = (row + random.next_float32()) / rows
                to_light = self._corner + u * self._edge_u + v * self._edge_v - mi.Vector3f(self._points)
                above = self._in_front & (dr.dot(self._normals, to_light) > 0)
                ray = mi.Ray3f(self._points, to_light, 1.0, 0.0, mi.Color0f())
                seen += dr.select(above & ~self._scene.ray_test(ray, above), 1.0, 0.0)
                dr.eval(seen, random)
            self._visibility = np.array(seen) / (rows * rows)
            return {}

        return costed(work)

    def visibility(self, path: str) -> Answer:
        """Save what the last cast found, float64 (R,)."""
        np.save(path, self._visibility)
        return {}


def main() -> None:
    """Answer commands until stdin ends."""
    peer = MitsubaPeer()
    serve({"build": peer.build, "case": peer.case, "cast": peer.cast, "visibility": peer.visibility})


if __name__ == "__main__":
    main()
