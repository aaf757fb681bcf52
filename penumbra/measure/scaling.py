"""`penumbra bench scaling`: how cost grows with triangles, resolution, samples and the light's area."""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from penumbra.api import backend_named
from penumbra.arrays import UInt64Array
from penumbra.errors import SceneError
from penumbra.executors.threads import resolve_threads
from penumbra.io.atomic import temporary_folder
from penumbra.io.ply_writer import write_ply
from penumbra.lights import RectLight
from penumbra.measure.peer_case import CastCase, write_indexed_mesh
from penumbra.measure.peer_process import Answer
from penumbra.measure.report import machine_facts
from penumbra.measure.scaling_report import ScalingReport, ScalingRow
from penumbra.measure.scaling_scenes import NamedScene
from penumbra.measure.scaling_shapes import Mesh, subdivided
from penumbra.measure.side_by_side import SideBySide, case_of
from penumbra.progress import NullProgress, Progress
from penumbra.scene import MeshRef, Scene

AXES = ("triangles", "resolution", "samples", "area")
"""What is varied, one at a time; the others keep their base value."""

_EDGE_FACTORS = (0.5, 2.0)
_SAMPLE_FACTORS = (0.25, 4.0)


@dataclass(frozen=True)
class ScalingOptions:
    """What to vary, and the values that the others keep."""

    axes: Sequence[str] = AXES
    levels: int = 2
    """How often the surface is subdivided, 1 to 4 each time."""
    resolution: tuple[int, int] = (640, 480)
    samples: int = 256
    sets: int = 1
    light: str | None = None
    rounds: int = 3
    """Passes of which the median counts."""
    threads: int = 0
    backend: str = "auto"
    embree: bool = False
    """Measure Embree beside us."""

    def __post_init__(self) -> None:
        backend_named(self.backend)
        object.__setattr__(self, "axes", tuple(self.axes) or AXES)
        unknown = [axis for axis in self.axes if axis not in AXES]
        if unknown:
            raise SceneError(f"there is no axis {unknown[0]!r}: use {' '.join(AXES)}")
        object.__setattr__(self, "threads", resolve_threads(self.threads))


def measure_scaling(
    scenes: Sequence[NamedScene],
    options: ScalingOptions,
    scratch: Path | None = None,
    progress: Progress | None = None,
) -> ScalingReport:
    """Measure every scene along every axis; scratch: where stores and meshes are written meanwhile.

    Raises BackendError where Embree is asked for and not installed, and what reading a scene raises.
    """
    rows: list[ScalingRow] = []
    for scene in scenes:
        with temporary_folder(scratch or Path(tempfile.gettempdir())) as folder:
            rows += _SceneScaling(scene, options, folder, progress or NullProgress()).rows()
    return ScalingReport(tuple(rows), options.threads, options.backend, options.rounds, machine_facts())


class _SceneScaling:
    """One scene along every axis."""

    def __init__(self, named: NamedScene, options: ScalingOptions, folder: Path, progress: Progress) -> None:
        self._named = named
        self._options = options
        self._folder = folder
        self._progress = progress
        self._scene = Scene.load(named.path)

    def rows(self) -> list[ScalingRow]:
        """All rows; the base, which belongs to every axis, is measured once."""
        options = self._options
        with SideBySide(self._folder, options.threads, options.backend, options.embree) as self._sides:
            self._stage("build")
            builds = self._sides.build(self._scene.geometry)
            case = self._case(options.resolution)
            base = self._row("base", case, builds)
            masks = self._sides.our_masks()
            others = {
                axis: [self._row(axis, varied, builds) for varied in self._varied(axis, case)]
                for axis in options.axes
                if axis != "triangles"
            }
            # Last: it leaves another mesh behind.
            if "triangles" in options.axes:
                others["triangles"] = list(self._levels(case, masks))
        self._progress.close()
        along = ([base._replace(axis=axis), *others[axis]] for axis in options.axes)
        return [row for rows in along for row in sorted(rows, key=lambda row: row.x)]

    def _varied(self, axis: str, case: CastCase) -> Iterator[CastCase]:
        """The base case at the other places of an axis."""
        width, height = self._options.resolution
        for edge, samples in zip(_EDGE_FACTORS, _SAMPLE_FACTORS, strict=True):
            if axis == "resolution":
                yield self._case((max(1, round(width * edge)), max(1, round(height * edge))))
            elif axis == "samples":
                yield case.with_light(samples=max(1, round(case.light.samples * samples)))
            else:
                yield case.with_light(**scaled_edges(case.light, edge))

    def _levels(self, case: CastCase, masks: UInt64Array) -> Iterator[ScalingRow]:
        """The base case, whose bits are given, over the same surface, subdivided again and again."""
        mesh = self._mesh()
        # The triangles have other numbers then; receivers stand in front of theirs, which blocks nothing.
        case = replace(case, own=np.full_like(case.own, -1))
        for level in range(1, self._options.levels + 1):
            self._stage(f"subdivide {level}")
            mesh = subdivided(mesh)
            path = self._folder / "level.ply"
            write_ply(path, *mesh, comment=f"{self._named.name}, subdivided {level} times")
            row = self._row("triangles", case, self._sides.build([MeshRef(path)]))
            changed = np.bitwise_count(masks ^ self._sides.our_masks()).sum(dtype=np.int64)
            yield row._replace(n_changed=int(changed))

    def _row(self, axis: str, case: CastCase, builds: tuple[Answer, Answer]) -> ScalingRow:
        self._stage(f"{axis}, {case.light.samples} samples, {len(case.points)} receivers")
        self._sides.load(case)
        rounds = self._sides.measure(self._options.rounds)
        ingest, build = builds
        return ScalingRow(self._named.name, axis, case.facts(), ingest, build, rounds)

    def _case(self, resolution: tuple[int, int]) -> CastCase:
        options = self._options
        with self._sides.blockers() as blockers:
            return case_of(
                self._scene,
                blockers,
                light=options.light,
                samples=options.samples,
                sets=options.sets,
                resolution=resolution,
                threads=options.threads,
            )

    def _mesh(self) -> Mesh:
        """The triangles of the scene, vertices shared, as float32."""
        with self._sides.blockers() as blockers:
            write_indexed_mesh(blockers, self._folder)
        vertices, triangles = (np.load(self._folder / f"{name}.npy") for name in ("vertices", "triangles"))
        return Mesh(vertices.astype(np.float64), triangles.astype(np.int64))

    def _stage(self, what: str) -> None:
        self._progress.stage(f"{self._named.name}: {what}", None, "")


def scaled_edges(light: RectLight, factor: float) -> dict[str, Any]:
    """Corner and edges of the light with its edges scaled about its centre."""
    centre = light.corner + 0.5 * (light.edge_u + light.edge_v)
    edge_u, edge_v = factor * light.edge_u, factor * light.edge_v
    return {"corner": centre - 0.5 * (edge_u + edge_v), "edge_u": edge_u, "edge_v": edge_v}
