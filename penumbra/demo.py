"""The demo: writes a self-made scene into a folder and renders it there."""

from pathlib import Path

from penumbra.demo_scene import write_demo_scene
from penumbra.errors import OutputError
from penumbra.progress import Progress
from penumbra.render import render


def run_demo(folder: str | Path, progress: Progress | None = None) -> list[Path]:
    """Write demo.ply, demo.toml, demo.exr, demo.png and demo.json into `folder`; returns their paths.

    The folder is made if needed, and what an earlier demo left in it is replaced. Raises OutputError
    when it cannot be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the folder {folder}: {error.strerror}; choose another") from error
    scene = write_demo_scene(folder)
    image, preview, stats = (scene.with_suffix(suffix) for suffix in (".exr", ".png", ".json"))
    render(scene, image, preview=preview, stats=stats, overwrite=True, progress=progress)
    return [scene, image, preview, stats]
