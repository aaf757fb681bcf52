"""The documentation keeps up with the program: commands, options, keys, links."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
import trimesh

from penumbra.cli.main import cli
from penumbra.io.scene_file import TABLE_KEYS

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
COMMAND_LINE = (ROOT / "docs" / "command-line.md").read_text()
SCENE_FILE = (ROOT / "docs" / "scene-file.md").read_text()

_LINK = re.compile(r"\[[^\]]*\]\(([^)#\s]+)[^)]*\)")
_MACHINE_PATH = re.compile(r"(?<![\w./~])/(?:work|tmp|home|root|Users|usr)/")


def _commands(group: click.Group, prefix: str = "") -> Iterator[tuple[str, click.Command]]:
    """All commands by their full name: `bench`, `bench error`."""
    for name, command in group.commands.items():
        yield prefix + name, command
        if isinstance(command, click.Group):
            yield from _commands(command, f"{prefix}{name} ")


COMMANDS = dict(_commands(cli))


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_is_explained(name: str) -> None:
    command = COMMANDS[name]
    assert command.help and f"Example: penumbra {name}" in command.help
    assert f"## penumbra {name}\n" in COMMAND_LINE
    section = COMMAND_LINE.split(f"## penumbra {name}\n", 1)[1].split("\n## ", 1)[0]
    for option in command.params:
        if isinstance(option, click.Option) and not {"-q", "-v"} & set(option.opts):
            assert option.help, option.name
            assert f"`{max(option.opts, key=len)}" in section, f"{name}: {option.opts} is not in its section"


@pytest.mark.parametrize("kind", TABLE_KEYS)
def test_every_key_of_a_scene_file_is_explained(kind: str) -> None:
    section = SCENE_FILE.split(f"[{kind}]", 1)[1]
    for key in TABLE_KEYS[kind]:
        assert f"`{key}`" in section


def test_scene_files_in_the_documentation_are_read(square_obj: Path, tmp_path: Path) -> None:
    from penumbra.scene import Scene

    blocks = re.findall(r"```toml\n(.*?)```", SCENE_FILE, re.DOTALL)
    assert blocks
    for block in blocks:
        for entry in tomllib.loads(block)["geometry"]:
            (tmp_path / entry["path"]).write_bytes(square_obj.read_bytes())
        (tmp_path / "scene.toml").write_text(block)
        assert Scene.load(tmp_path / "scene.toml").lights


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page: Path) -> None:
    targets = [
        link for link in _LINK.findall(page.read_text()) if "://" not in link and "mailto:" not in link
    ]
    missing = [target for target in targets if not (page.parent / target).exists()]
    assert not missing


def test_every_page_is_in_the_index() -> None:
    listed = set(_LINK.findall((ROOT / "docs" / "index.md").read_text()))
    assert {page.name for page in (ROOT / "docs").glob("*.md")} - {"index.md"} <= listed


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_no_page_speaks_of_one_machine(page: Path) -> None:
    assert not _MACHINE_PATH.search(page.read_text())


def test_the_example_of_the_readme_does_what_it_says() -> None:
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    names: dict[str, Any] = {}
    exec(block, names)
    # By similar triangles the second point sees the half of the light that is past its middle.
    np.testing.assert_allclose(names["result"].visibility, [0, 0.5, 1], atol=1 / 16)
    assert names["result"].masks.shape == (3, 1)


def test_the_examples_for_python_run(scene_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = scene_file.parent
    monkeypatch.chdir(folder)
    (folder / "scene.toml").write_bytes(scene_file.read_bytes())
    for name in ("terrain.ply", "trees.obj", "scene.ply"):
        kind = Path(name).suffix[1:]
        trimesh.load(folder / "square.obj", process=False).export(folder / name, file_type=kind)
    names: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(), re.DOTALL):
        exec(block.replace("(640, 480)", "(64, 48)"), names)
    assert names["visibility"].dtype == np.float32 and names["visibility"].shape == (48, 64)
    assert names["seen"].shape[1] == 3


def test_two_commands_are_enough() -> None:
    readme, makefile = (ROOT / "README.md").read_text(), (ROOT / "Makefile").read_text()
    for target in ("demo", "test"):
        assert f"make {target}" in readme
        assert re.search(rf"^{target}:", makefile, re.MULTILINE)
    assert "make test" in (ROOT / ".ci" / "run").read_text()
