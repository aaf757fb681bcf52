"""A scene opened once to be cast many times: its blockers, its camera's receivers, and the memory left."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from penumbra.api import CastResult, cast
from penumbra.blockers import Blockers
from penumbra.compile_ahead import compile_ahead
from penumbra.errors import MemoryLimitError, SceneError
from penumbra.lights import PointLight, RectLight
from penumbra.memory import call_limit_bytes, format_bytes, give_back, resident_bytes
from penumbra.options import IngestOptions, parse_size
from penumbra.plan import RenderPlan, enough_limit, least_cast_bytes
from penumbra.progress import NullProgress, Progress
from penumbra.render import open_blockers, plan_render
from penumbra.scene import Scene
from penumbra.stats import Stats
from penumbra.visible import GBuffer, find_visible, window_bytes

# Receivers whose cast loads the compiled kernels, so that no measured cast does.
_WARM_UP_RECEIVERS = 64
# A receiver in a measurement, beside its place while it is cast: point, normal, triangle, pixel and depth,
# the visibility of references and estimate, and the errors while they are summed up.
_HELD_BYTES = 72 + 40
# Steps in which a limit that would do is looked for, at most, or an eighth of what lacks.
_STEP_BYTES = 16 << 20


@dataclass(frozen=True)
class OpenScene:
    """Blockers and receivers of a scene under a memory limit; use `open_scene`."""

    scene: Scene
    blockers: Blockers
    seen: GBuffer
    plan: RenderPlan
    cast_bytes: int
    """What casts may take at least, however much the process has grown since it was planned."""

    @property
    def name(self) -> str:
        """What error messages call the scene."""
        return _name(self.scene)

    def cast(self, light: RectLight, backend: str, progress: Progress | None = None) -> CastResult:
        """Visibility of a light at every receiver, with the memory that is left of the limit."""
        return self._cast_first(len(self.seen.pixel), light, backend, progress)

    def warm_up(self, light: RectLight, backend: str) -> None:
        """Cast a few receivers, so that a backend is loaded before it is measured."""
        self._cast_first(_WARM_UP_RECEIVERS, replace(light, samples=16), backend, None)

    def _cast_first(self, n: int, light: RectLight, backend: str, progress: Progress | None) -> CastResult:
        seen = self.seen
        # Half of what is left: of the masks of a pass, malloc kept most resident in its threads' arenas.
        return cast(
            seen.points[:n],
            self.blockers,
            light,
            normals=seen.normals[:n],
            own=seen.own[:n],
            index=seen.pixel[:n],
            backend=backend,
            memory=max(self.cast_bytes, (self.plan.limit_bytes - resident_bytes()) // 2),
            threads=self.plan.threads,
            progress=progress,
            keep="visibility",
        )


def chosen_light(scene: Scene, name: str | None) -> RectLight:
    """The area light of that name, or the first one of the scene; SceneError where there is none."""
    areas = [light for light in scene.lights if isinstance(light, RectLight)]
    names = " ".join(light.name for light in areas)
    if not areas:
        raise SceneError(
            f"{_name(scene)} has point lights alone, of one sample each, so that nothing converges: "
            "add an area light"
        )
    if name is None:
        return areas[0]
    for light in scene.lights:
        if light.name == name and isinstance(light, PointLight):
            advice = f"choose {names}"
            raise SceneError(f"light '{name}' is a point of one sample, so that nothing converges: {advice}")
    for light in areas:
        if light.name == name:
            return light
    raise SceneError(f"{_name(scene)} has no light '{name}': choose {names}")


@contextmanager
def open_scene(
    scene: Scene,
    lights: Sequence[RectLight],
    backends: Sequence[str],
    *,
    memory: int | str | None,
    process_limit: bool,
    threads: int,
    progress: Progress | None = None,
) -> Iterator[OpenScene]:
    """Ingest a scene once and find what its camera sees, to cast it by `backends`.

    lights: the largest that will be cast. memory, process_limit, threads: as for `penumbra.render`. Raises
    what it raises, and MemoryLimitError, before any work, when the receivers of the picture and the largest
    cast do not fit.
    """
    progress = progress or NullProgress()
    lit = replace(scene, lights=(max(lights, key=lambda light: light.samples),))
    plan = _plan(lit, lights, backends, memory, process_limit, threads)
    cast_bytes = _cast_bytes(plan, lights, backends)
    compile_ahead(progress)
    with open_blockers(lit, plan, Path(tempfile.gettempdir()), Stats(""), progress) as blockers:
        seen = find_visible(blockers, lit.camera, plan.window, threads=plan.threads, progress=progress)
        give_back()
        yield OpenScene(lit, blockers, seen, plan, cast_bytes)


def _plan(
    lit: Scene,
    lights: Sequence[RectLight],
    backends: Sequence[str],
    memory: int | str | None,
    process_limit: bool,
    threads: int,
) -> RenderPlan:
    """Plan, or refuse early: a render may go on in passes, a measurement holds all receivers."""
    asked = parse_size(memory)
    process_limit = process_limit and asked is not None
    limit = call_limit_bytes(asked, process_limit=False)

    def lacking(limit: int) -> int:
        """How much more than a limit would be needed; at most 0 where it does."""
        try:
            plan = plan_render(lit, memory=limit, process_limit=process_limit, threads=threads)
        except MemoryLimitError as refusal:
            return (refusal.enough_bytes or 2 * limit) - limit
        return _needed_bytes(plan, lights, backends) - plan.limit_bytes

    enough = limit
    # In steps: more memory is planned with differently, as geometry that fits is not stored.
    while (lacks := lacking(enough)) > 0:
        enough += max(min(lacks, _STEP_BYTES), lacks // 8)
    if enough > limit:
        width, height = lit.camera.resolution
        raise MemoryLimitError(
            f"measuring {width} x {height} receivers with {lit.lights[0].samples} light samples does not fit "
            f"the memory limit of {format_bytes(limit)}: give {enough_limit(enough) >> 20}MiB or more, or a "
            "smaller --resolution",
            enough_limit(enough),
        )
    return plan_render(lit, memory=limit, process_limit=process_limit, threads=threads)


def _needed_bytes(plan: RenderPlan, lights: Sequence[RectLight], backends: Sequence[str]) -> int:
    """Most resident memory of a measurement: it finds what is seen, then holds it and casts."""
    width, height = plan.resolution
    blockers = plan.blocker_bytes if plan.source == "memory" else 0
    casting = width * height * _HELD_BYTES + _cast_bytes(plan, lights, backends)
    seeing = window_bytes(width, height, plan.threads) + plan.blocker_bytes - blockers
    always = plan.resident_bytes + plan.kernel_bytes
    return always + max(plan.ingest_bytes, blockers + max(casting, seeing))


def _cast_bytes(plan: RenderPlan, lights: Sequence[RectLight], backends: Sequence[str]) -> int:
    """What the largest cast takes beside receivers, and beside blockers where they are in memory."""
    width, height = plan.resolution
    read_bytes = 0 if plan.source == "memory" else plan.blocker_bytes
    chunk = IngestOptions().chunk_triangles
    return max(
        least_cast_bytes(width * height, light.samples, light.sets, read_bytes, chunk, backend)
        for light in lights
        for backend in backends
    )


def _name(scene: Scene) -> str:
    return str(scene.path) if scene.path is not None else "the scene"
