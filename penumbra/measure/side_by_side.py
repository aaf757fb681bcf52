"""Us and Embree on the same receivers, samples and triangles, in turn, each in a process of its own."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from types import TracebackType
from typing import NamedTuple

import numpy as np

from penumbra.arrays import UInt64Array
from penumbra.blockers import Blockers
from penumbra.errors import BackendError
from penumbra.io.blocker_store import open_store
from penumbra.measure.embree_library import library_path
from penumbra.measure.peer_case import CastCase, write_indexed_mesh
from penumbra.measure.peer_process import Answer, PeerProcess
from penumbra.measure.scene import chosen_light
from penumbra.scene import MeshRef, Scene
from penumbra.visible import find_visible

RAY_OFFSET = 1e-5
"""How far above its surface Embree starts a shadow ray, in diagonals of the scene."""

# Of the flags for coherent and incoherent rays, one that is so much slower is measured only once.
_CLEARLY_SLOWER = 1.15
_WARM_UP_SAMPLES = 16


class Pass(NamedTuple):
    """One pass over all receivers, or one build."""

    cpu_seconds: float
    """Processor time of all threads."""
    wall_seconds: float
    added_bytes: int | None
    """How far the process's memory rose meanwhile; None where the system does not tell."""


class Spread(NamedTuple):
    """A figure of several rounds."""

    median: float
    low: float
    high: float

    @staticmethod
    def of(values: Sequence[float]) -> "Spread":
        """Median and extremes."""
        return Spread(median(values), min(values), max(values))


@dataclass(frozen=True)
class Rounds:
    """Passes of both sides over one case, in the order in which they were made."""

    ours: tuple[Pass, ...]
    embree: tuple[Pass, ...]
    """Of the better flag, one for each of ours; empty when Embree was not measured."""
    is_coherent: bool
    """Whether the better flag is that for coherent rays."""
    n_rays: int
    """Shadow rays of one of Embree's passes."""
    stats: Answer
    """Counters and seconds of our last cast."""

    def ratio(self, what: str) -> Spread:
        """Embree's `what` (a field of Pass) over ours, round by round."""
        pairs = zip(self.embree, self.ours, strict=True)
        return Spread.of([getattr(theirs, what) / getattr(ours, what) for theirs, ours in pairs])


class SideBySide:
    """Both processes, over one scene at a time; leaving the `with` ends them."""

    def __init__(self, folder: Path, threads: int, backend: str = "auto", embree: bool = True) -> None:
        """Start the processes. folder: for the store, the mesh and the cases. embree: False for us alone."""
        if embree and library_path() is None:
            raise BackendError("Embree is not installed: pip install embreex, which brings the library")
        self._folder = folder
        self._threads = threads
        self._backend = backend
        self._stack = ExitStack()
        self._ours = self._stack.enter_context(PeerProcess("penumbra.measure.penumbra_peer"))
        self._embree = (
            self._stack.enter_context(PeerProcess("penumbra.measure.embree_peer")) if embree else None
        )

    def __enter__(self) -> "SideBySide":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, value, trace)

    def build(self, geometry: Sequence[MeshRef]) -> tuple[Answer, Answer]:
        """Ingest meshes on our side, build over the same triangles on Embree's; what each took."""
        store = self._folder / "blockers.h5"
        store.unlink(missing_ok=True)
        ours = self._ours.ask("build", meshes=[_fields(mesh) for mesh in geometry], store=str(store))
        self.store = Path(ours["store"])
        if self._embree is None:
            return ours, {}
        with self.blockers() as blockers:
            write_indexed_mesh(blockers, self._folder)
        return ours, self._embree.ask("build", mesh=str(self._folder), threads=self._threads)

    @contextmanager
    def blockers(self) -> Iterator[Blockers]:
        """The store of the scene that was built last."""
        with open_store(self.store) as blockers:
            yield blockers

    def load(self, case: CastCase) -> None:
        """Give a case to both sides, and have each cast a little of it, so that all is loaded and warm."""
        case.write(self._folder)
        self._ours.ask("case", folder=str(self._folder))
        self._ours.ask("cast", threads=self._threads, backend=self._backend, few=True)
        if self._embree is not None:
            self._embree.ask("case", folder=str(self._folder))
            self._cast_embree(True, samples=_WARM_UP_SAMPLES)

    def measure(self, rounds: int) -> Rounds:
        """Cast the case so many times on each side, in turn."""
        ours: list[Pass] = []
        embree: dict[bool, list[Pass]] = {True: [], False: []} if self._embree is not None else {}
        stats: Answer = {}
        n_rays = 0
        for _ in range(rounds):
            answer = self._ours.ask("cast", threads=self._threads, backend=self._backend)
            ours.append(_pass(answer))
            stats = answer["stats"]
            for is_coherent, passes in embree.items():
                answer = self._cast_embree(is_coherent)
                passes.append(_pass(answer))
                n_rays = answer["rays"]
            embree = _without_clearly_slower(embree)
        best = min(embree, key=lambda flag: median(p.cpu_seconds for p in embree[flag])) if embree else True
        return Rounds(tuple(ours), tuple(embree.get(best, ())), best, n_rays, stats)

    def our_masks(self) -> UInt64Array:
        """Bits of our last pass, uint64 (R, n_words)."""
        return self._masks(self._ours)

    def embree_masks(self) -> UInt64Array:
        """Bits of Embree's last pass, uint64 (R, n_words)."""
        assert self._embree is not None
        return self._masks(self._embree)

    def _masks(self, side: PeerProcess) -> UInt64Array:
        path = self._folder / "masks.npy"
        side.ask("masks", path=str(path))
        masks: UInt64Array = np.load(path)
        return masks

    def _cast_embree(self, is_coherent: bool, samples: int = 0) -> Answer:
        assert self._embree is not None
        return self._embree.ask("cast", threads=self._threads, coherent=is_coherent, samples=samples)


def case_of(
    scene: Scene,
    blockers: Blockers,
    *,
    light: str | None = None,
    samples: int | None = None,
    sets: int | None = None,
    resolution: tuple[int, int] | None = None,
    threads: int = 0,
) -> CastCase:
    """The receivers that `render` casts for a scene whose blockers these are, and one of its lights.

    light: its name, the first area light by default; samples, sets, resolution: in place of the scene's.
    """
    scene = scene.with_overrides(resolution=resolution, samples=samples)
    chosen = chosen_light(scene, light)
    if sets is not None:
        chosen = replace(chosen, sets=sets)
    width, height = scene.camera.resolution
    seen = find_visible(blockers, scene.camera, (0, 0, width, height), threads=threads)
    diagonal = float(np.linalg.norm(blockers.bounds[1] - blockers.bounds[0]))
    return CastCase(seen.points, seen.normals, seen.own, seen.pixel, width, RAY_OFFSET * diagonal, chosen)


def _without_clearly_slower(embree: dict[bool, list[Pass]]) -> dict[bool, list[Pass]]:
    """Leave out a flag whose first pass took clearly longer than the other's."""
    if len(embree) < 2:
        return embree
    first = {flag: passes[0].cpu_seconds for flag, passes in embree.items()}
    return {flag: p for flag, p in embree.items() if first[flag] <= _CLEARLY_SLOWER * min(first.values())}


def _fields(mesh: MeshRef) -> Answer:
    transform = None if mesh.transform is None else mesh.transform.tolist()
    return {"path": str(mesh.path.resolve()), "transform": transform, "up": mesh.up}


def _pass(answer: Answer) -> Pass:
    return Pass(answer["cpu_seconds"], answer["seconds"], answer["added_bytes"])
