"""Scenes of the benchmarks: real meshes taken by path, with a camera and a light for each."""

import json
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "scenes"

# name: (mesh, up, floor: height and half width or None, eye, look_at, vfov, light corner, edge_u, edge_v)
SCENES = {
    "cornell": ("CornellBox-Original.obj", "y", None, [0, 1, 3.6], [0, 1, 0], 38,
                [-0.24, 1.97, -0.22], [0.47, 0, 0], [0, 0, 0.38]),
    "bunny": ("stanford-bunny.obj", "y", (0.033, 0.6), [-0.05, 0.2, 0.34], [-0.017, 0.1, 0], 38,
              [-0.2, 0.4, 0.0], [0.12, 0, 0], [0, 0, 0.12]),
    "sponza": ("sponza_dabrovic.ply", "y", None, [-6.5, 4.2, 1.6], [3, 2.2, -3.2], 62,
               [-2, 14.5, -1.25], [4, 0, 0], [0, 0, 2.5]),
    "dragon": ("mcguire_dragon.ply", "y", (0.0, 5), [1.2, 2.6, 3.9], [0.15, 0.65, -0.1], 40,
               [-1.9, 3.6, -0.2], [1, 0, 0], [0, 0, 1]),
    "house": ("small_house.ply", "z", None, [1, 13, 7], [0.3, 0, 0.6], 45,
              [-5, 12, -7], [2.5, 0, 0], [0, 0, 2.5]),
    "city": ("small_city.ply", "z", None, [95, 60, 105], [38, 3, 8], 42,
             [-80, 110, -60], [25, 0, 0], [0, 0, 25]),
    "office": ("office_env_large.ply", "z", None, [7, 1.8, 6.5], [0, 0.7, -0.5], 65,
               [1.5, 2.4, 1.5], [1.5, 0, 0], [0, 0, 1.5]),
}  # fmt: skip


def write_scene(
    name: str, folder: Path, meshes: Path = FOLDER, samples: int = 256, sets: int = 8
) -> Path | None:
    """Write the scene file of a name in SCENES, or of a path NAME.json; None if the mesh is not there."""
    if name.endswith(".json"):
        return _from_json(Path(name), folder, samples, sets)
    mesh, up, floor, eye, look_at, vfov, corner, edge_u, edge_v = SCENES[name]
    if not (meshes / mesh).exists():
        return None
    lines = ["[[geometry]]", f'path = "{meshes / mesh}"', f'up = "{up}"']
    if floor:
        height, half = floor
        corners = np.array(
            [[-half, height, half], [half, height, half], [half, height, -half], [-half, height, -half]]
        )
        text = "".join("v {:.9g} {:.9g} {:.9g}\n".format(*c) for c in corners)
        (folder / f"{name}-floor.obj").write_text(text + "f 1 2 3 4\n")
        lines += ["[[geometry]]", f'path = "{name}-floor.obj"']
    view = {"eye": eye, "look_at": look_at, "vfov": vfov}
    lamp = {"corner": corner, "edge_u": edge_u, "edge_v": edge_v, "samples": samples, "sets": sets}
    return _write(folder / f"{name}.toml", lines, view, lamp)


def _from_json(path: Path, folder: Path, samples: int, sets: int) -> Path:
    """Scene file of a scene that is described as JSON: mesh, camera and light, as a path NAME.json."""
    given = json.loads(path.read_text())
    view = {"eye": given["camera"]["eye"], "look_at": given["camera"]["look_at"]}
    view |= {"up": given["camera"]["up"], "vfov": given["camera"]["vfov_deg"]}
    lamp = given["light"] | {"samples": samples, "sets": sets}
    lines = ["[[geometry]]", f'path = "{path.parent.resolve() / given["mesh"]}"']
    return _write(folder / f"{path.stem}.toml", lines, view, lamp)


def _write(path: Path, lines: list[str], view: dict, lamp: dict) -> Path:  # type: ignore[type-arg]
    """Write geometry lines, camera and light as a scene file."""
    lines = lines + ["[camera]", *(f"{key} = {value}" for key, value in view.items())]
    lines += ["resolution = [1280, 960]", "[[light]]", 'name = "key"', 'type = "rect"', "radiance = 10.0"]
    lines += [f"{key} = {value}" for key, value in lamp.items()]
    path.write_text("\n".join(lines) + "\n")
    return path
