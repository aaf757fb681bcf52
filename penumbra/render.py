"""The story of a render, from scene file to OpenEXR image; the calls stand in the order of the stages."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from penumbra.api import backend_named
from penumbra.arrays import Receivers, UInt8Array, UInt64Array
from penumbra.blockers import Blockers
from penumbra.compile_ahead import compile_ahead
from penumbra.errors import SceneError
from penumbra.executors.threads import resolve_threads
from penumbra.film import BACKGROUND_ID, LIGHT_LAYERS, Film, Window
from penumbra.image import Image, header_attributes
from penumbra.ingest import blockers_in_memory, ingest
from penumbra.io.atomic import temporary_folder
from penumbra.io.blocker_store import open_store
from penumbra.io.exr import camera_attributes
from penumbra.io.meshes import open_mesh
from penumbra.lights import PointLight
from penumbra.memory import call_limit_bytes, give_back, resident_bytes
from penumbra.options import CastOptions, IngestOptions, parse_size
from penumbra.outputs import Outputs, finished_image
from penumbra.plan import GeometryPlan, LightPlan, RenderPlan, backend_bytes, make_plan
from penumbra.progress import NullProgress, Progress
from penumbra.scene import Scene
from penumbra.settings import Settings, settings_of
from penumbra.shading import Shading, shade
from penumbra.stats import Stats
from penumbra.visible import GBuffer, find_visible

SceneLike = Scene | str | Path
PathLike = str | Path
CastReceivers = Callable[..., tuple[UInt64Array, UInt8Array, Stats]]

# A face of an OBJ file with its share of the vertices takes 20 bytes at least, binary formats less.
_LEAST_TRIANGLE_BYTES = 12


def render(
    scene: SceneLike,
    output: PathLike | None = None,
    *,
    memory: int | str | None = None,
    backend: str = "hpc",
    threads: int = 0,
    crop: Window | None = None,
    seed: int | None = None,
    samples: int | None = None,
    resolution: tuple[int, int] | None = None,
    preview: PathLike | None = None,
    stats: PathLike | None = None,
    scratch: PathLike | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
    process_limit: bool = False,
) -> Image:
    """Render a scene with exact soft shadows, and write it if `output` is given.

    scene: a Scene, or the path of a scene file. output, preview, stats: files to write, as OpenEXR,
    exposed PNG and JSON. memory: bytes that this call may add to the resident memory, or a size such as
    "2GiB"; None is half of the free memory; with `process_limit` the limit is of the whole process.
    backend: "hpc", "gears", "reference" or "auto"; all give the same bits. threads: 0 for all cores. crop:
    (x0, y0, x1, y1), half-open, from the upper left: exactly these pixels of the full picture. seed,
    samples, resolution: in place of the scene's. scratch: folder of the temporary store of geometry that
    does not fit in memory, beside `output` by default. resume: do nothing when `output` is there and was
    rendered with the same settings. overwrite: replace `output` if it is there.

    Raises SceneError, MeshError or BlockerStoreError for input that cannot be used, OutputError for an
    output that is there or cannot be written, BackendError for an unknown backend, and MemoryLimitError,
    before any work, when the limit cannot be met: the message has one that would do.
    """
    progress = progress or NullProgress()
    scene, window = _effective_scene(scene, crop, seed, samples, resolution)
    settings = settings_of(scene, window)
    outputs = _checked_outputs(scene, output, preview, stats)
    if resume and not overwrite and outputs.image is not None and outputs.image.exists():
        image = finished_image(outputs.image, settings)
        if outputs.preview is not None and not outputs.preview.exists():
            image.write_preview(outputs.preview)
        return image
    # A killed run may have left a preview; --resume begins again and replaces it.
    if not (overwrite or resume):
        outputs.refuse_existing()
    scratch_parent = outputs.scratch_parent(scratch)
    cast_receivers = backend_named(backend)
    plan = _make_plan(scene, window, memory, process_limit, threads, backend)
    run = Stats(backend)
    with run.timed("compile"):
        compile_ahead(progress)
    film = Film(*plan.resolution, window, [light.name for light in scene.lights])
    with open_blockers(scene, plan, scratch_parent, run, progress) as blockers:
        for band in plan.passes:
            _render_band(scene, blockers, band, cast_receivers, plan.threads, film, run, progress)
    image = _develop(film, scene, settings, plan, run)
    progress.stage("write", None, "")
    with run.timed("write"):
        outputs.write(image, plan.threads)
    outputs.write_numbers(_numbers(image, plan))
    return image


def _render_band(
    scene: Scene,
    blockers: Blockers,
    band: Window,
    cast_receivers: CastReceivers,
    threads: int,
    film: Film,
    run: Stats,
    progress: Progress,
) -> None:
    """Render some rows of the picture: one pass over the blockers to see, and one for each light."""
    with run.timed("visible"):
        seen = find_visible(
            blockers, scene.camera, band, threads=threads, progress=progress, counters=run.counters
        )
        run.count("n_receivers", len(seen.pixel))
        _put_geometry(film, seen)
    receivers = Receivers(seen.points, seen.normals, seen.own, seen.pixel)
    for light in scene.lights:
        masks, sample_sets, cast_stats = cast_receivers(
            receivers, blockers, light, options=CastOptions(), threads=threads, progress=progress
        )
        run.merge(cast_stats)
        run.backend = cast_stats.backend
        with run.timed("shade"):
            shading = shade(seen.points, seen.normals, sample_sets, masks, light, threads)
            # The masks of one light must not be there while the next is cast.
            del masks
            _put_shading(film, light.name, seen, shading)
            del shading
            give_back()


def plan_render(
    scene: SceneLike,
    output: PathLike | None = None,
    *,
    memory: int | str | None = None,
    backend: str = "hpc",
    threads: int = 0,
    crop: Window | None = None,
    seed: int | None = None,
    samples: int | None = None,
    resolution: tuple[int, int] | None = None,
    preview: PathLike | None = None,
    stats: PathLike | None = None,
    scratch: PathLike | None = None,
    resume: bool = False,
    overwrite: bool = False,
    process_limit: bool = False,
) -> RenderPlan:
    """Return what `render` with the same arguments would do, and do nothing; `str()` of it is for people.

    Raises what `render` would raise before its work begins, but for outputs that are there already.
    """
    scene, window = _effective_scene(scene, crop, seed, samples, resolution)
    _checked_outputs(scene, output, preview, stats).scratch_parent(scratch)
    backend_named(backend)
    return _make_plan(scene, window, memory, process_limit, threads, backend)


def visible_points(scene: SceneLike, threads: int = 0, progress: Progress | None = None) -> GBuffer:
    """Return the receivers of a scene's whole picture, exactly those that `render` casts."""
    progress = progress or NullProgress()
    scene, window = _effective_scene(scene, None, None, None, None)
    plan = _make_plan(scene, window, None, False, threads, "hpc")
    run = Stats("")
    scratch = Outputs(None, None, None).scratch_parent(None)
    with open_blockers(scene, plan, scratch, run, progress) as blockers:
        return find_visible(blockers, scene.camera, window, threads=plan.threads, progress=progress)


def _effective_scene(
    scene: SceneLike,
    crop: Window | None,
    seed: int | None,
    samples: int | None,
    resolution: tuple[int, int] | None,
) -> tuple[Scene, Window]:
    """Load the scene if it is a path, apply what the caller overrides, and check the crop."""
    loaded = scene if isinstance(scene, Scene) else Scene.load(scene)
    loaded = loaded.with_overrides(resolution=resolution, samples=samples, seed=seed)
    for mesh in loaded.geometry:
        if not mesh.path.is_file():
            raise SceneError(f"{mesh.path}: no such file; check the path in {loaded.path or 'the scene'}")
    width, height = loaded.camera.resolution
    window = (0, 0, width, height) if crop is None else tuple(int(edge) for edge in crop)
    x0, y0, x1, y1 = window
    if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
        raise SceneError(
            f"crop {x0} {y0} {x1} {y1} is not a part of the picture: "
            f"it needs 0 <= X0 < X1 <= {width} and 0 <= Y0 < Y1 <= {height}"
        )
    return loaded, (x0, y0, x1, y1)


def _checked_outputs(
    scene: Scene, output: PathLike | None, preview: PathLike | None, stats: PathLike | None
) -> Outputs:
    outputs = Outputs(*(None if path is None else Path(path) for path in (output, preview, stats)))
    outputs.check([mesh.path for mesh in scene.geometry] + ([scene.path] if scene.path else []))
    return outputs


def _make_plan(
    scene: Scene, window: Window, memory: int | str | None, process_limit: bool, threads: int, backend: str
) -> RenderPlan:
    asked, resident = parse_size(memory), resident_bytes()
    # None asks for a part of what is free now, which is never a limit of the whole process.
    process_limit = process_limit and asked is not None
    added = call_limit_bytes(asked, process_limit)
    return make_plan(
        scene.camera.resolution,
        window,
        [
            LightPlan(light.name, light.samples, light.sets, isinstance(light, PointLight))
            for light in scene.lights
        ],
        _measure_geometry(scene),
        limit_bytes=asked if asked is not None and process_limit else resident + added,
        resident_bytes=resident,
        threads=resolve_threads(threads),
        process_limit=process_limit,
        backend="hpc (auto)" if backend == "auto" else backend,
        engine_bytes=backend_bytes(backend, CastOptions(), IngestOptions().chunk_triangles),
    )


def _measure_geometry(scene: Scene) -> GeometryPlan:
    """Count triangles from the headers; where a format has none, take the most that the file can hold."""
    n_triangles, is_exact = 0, True
    for mesh in scene.geometry:
        with open_store(mesh.path) if mesh.is_store else open_mesh(mesh.path) as source:
            if source.n_triangles is None:
                is_exact = False
                n_triangles += source.size_bytes // _LEAST_TRIANGLE_BYTES
            else:
                n_triangles += source.n_triangles
    if is_exact and n_triangles > BACKGROUND_ID:
        raise SceneError(
            f"the geometry has {n_triangles:,} triangles: the id layer has 32 bits; leave some out"
        )
    return GeometryPlan(n_triangles, is_exact, len(scene.geometry) == 1 and scene.geometry[0].is_store)


@contextmanager
def open_blockers(
    scene: Scene, plan: RenderPlan, scratch: Path, run: Stats, progress: Progress
) -> Iterator[Blockers]:
    """Open the store, or make the blockers: in memory, or in a store that is removed afterwards."""
    with ExitStack() as stack:
        with run.timed("ingest"):
            blockers: Blockers
            if plan.source == "store":
                blockers = open_store(scene.geometry[0].path)
            elif plan.source == "memory":
                blockers = blockers_in_memory(scene.geometry, progress=progress)
            else:
                folder = stack.enter_context(temporary_folder(scratch))
                blockers = ingest(
                    scene.geometry,
                    folder / "blockers.h5",
                    memory=plan.limit_bytes - resident_bytes(),
                    scratch=folder,
                    progress=progress,
                )
            stack.callback(blockers.close)
            give_back()
        run.count("n_triangles", blockers.n_triangles)
        run.count("n_dropped", blockers.n_dropped)
        yield blockers


def _put_geometry(film: Film, seen: GBuffer) -> None:
    film.put("Z", seen.pixel, seen.depth)
    film.put("id", seen.pixel, seen.own)
    film.put_xyz("P", seen.pixel, seen.points)
    film.put_xyz("N", seen.pixel, seen.normals)


def _put_shading(film: Film, light: str, seen: GBuffer, shading: Shading) -> None:
    for layer in LIGHT_LAYERS:
        film.put(f"{light}.{layer}", seen.pixel, getattr(shading, layer))
    film.add_direct_light(seen.pixel, shading.irradiance)


def _develop(film: Film, scene: Scene, settings: Settings, plan: RenderPlan, run: Stats) -> Image:
    attributes = header_attributes(settings, run, plan)
    attributes |= camera_attributes(scene.camera.frame(), scene.camera.resolution)
    return Image(film.layers, run, plan.resolution, plan.window, attributes)


def _numbers(image: Image, plan: RenderPlan) -> dict[str, Any]:
    """Return the content of the stats file: everything counted, and what the picture was."""
    return image.stats.as_dict() | {
        "resolution": list(plan.resolution),
        "window": list(plan.window),
        "passes": len(plan.passes),
        "threads": plan.threads,
        "blockers": plan.source,
        "planned_bytes": plan.needed_bytes,
        "settings_hash": image.attributes["penumbra:settings_hash"],
    }
