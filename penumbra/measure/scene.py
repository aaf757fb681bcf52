"""A scene opened once to be cast many times: its blockers, its camera's receivers, and the memory left."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from penumbra.api import CastResult, cast
from penumbra.blockers import Blockers
from penumbra.compile_ahead import compile_ahead
from penumbra.errors import MemoryLimitError, SceneError
from penumbra.lights import PointLight, RectLight
from penumbra.memory import format_bytes, give_back, resident_bytes
from penumbra.plan import RenderPlan
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


@dataclass(frozen=True)
class OpenScene:
    """Blockers and receivers of a scene under a memory limit; use `open_scene`."""

    scene: Scene
    blockers: Blockers
    seen: GBuffer
    plan: RenderPlan

    def cast(self, light: RectLight, backend: str, progress: Progress | None = None) -> CastResult:
        """Visibility of a light at every receiver, with the memory that is left of the limit."""
        return self._cast_first(len(self.seen.pixel), light, backend, progress)

    def warm_up(self, light: RectLight, backend: str) -> None:
        """Cast a few receivers, so that a backend is loaded before it is measured."""
        self._cast_first(_WARM_UP_RECEIVERS, replace(light, samples=16), backend, None)

    def _cast_first(self, n: int, light: RectLight, backend: str, progress: Progress | None) -> CastResult:
        seen = self.seen
        return cast(
            seen.points[:n],
            self.blockers,
            light,
            normals=seen.normals[:n],
            own=seen.own[:n],
            index=seen.pixel[:n],
            backend=backend,
            memory=max(1, self.plan.limit_bytes - resident_bytes()),
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
    light: RectLight,
    *,
    memory: int | str | None,
    process_limit: bool,
    threads: int,
    progress: Progress | None = None,
) -> Iterator[OpenScene]:
    """Ingest a scene once and find what its camera sees, to cast `light` or lights of fewer samples.

    memory, process_limit, threads: as for `penumbra.render`. Raises what it raises, and MemoryLimitError
    when the receivers of the picture do not fit at once.
    """
    progress = progress or NullProgress()
    lit = replace(scene, lights=(light,))
    plan = plan_render(lit, memory=memory, process_limit=process_limit, threads=threads)
    _check_memory(plan)
    compile_ahead(progress)
    with open_blockers(lit, plan, Path(tempfile.gettempdir()), Stats(""), progress) as blockers:
        seen = find_visible(blockers, lit.camera, plan.window, threads=plan.threads, progress=progress)
        give_back()
        yield OpenScene(lit, blockers, seen, plan)


def _check_memory(plan: RenderPlan) -> None:
    """Refuse early: a render may go on in passes, a measurement holds all receivers of the picture."""
    width, height = plan.resolution
    receivers = max(window_bytes(width, height, plan.threads), width * height * _HELD_BYTES)
    least = plan.resident_bytes + plan.kernel_bytes + plan.blocker_bytes + receivers
    if least > plan.limit_bytes:
        raise MemoryLimitError(
            f"measuring {width} x {height} receivers needs {format_bytes(least)} and the limit is "
            f"{format_bytes(plan.limit_bytes)}: raise --memory, or give a smaller --resolution"
        )


def _name(scene: Scene) -> str:
    return str(scene.path) if scene.path is not None else "the scene"
