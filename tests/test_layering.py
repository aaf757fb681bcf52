"""Who may import what: the way of the data is to be seen in the folders, and stays so."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "penumbra"

# Third-party module: the files, or folders, that may import it. Everybody may import numpy.
THIRD_PARTY_HOMES = {
    "numba": "kernels/",
    "llvmlite": "kernels/",
    "h5py": "io/blocker_store.py",
    "OpenEXR": "io/exr.py",
    "PIL": "io/png.py",
    "click": "cli/",
    "trimesh": "io/other_formats.py",
    "matplotlib": "measure/plots",
}
HEAVY = ("numba", "llvmlite", "h5py", "trimesh", "OpenEXR", "PIL", "matplotlib")

STAGES = ("ingest", "visible", "receivers", "receiver_grid", "casting", "gears", "reference", "shading")
# The receiver hierarchy, and the grid, are built again while casting goes on, so casting owns them.
STAGE_IN_STAGE = {("casting.py", "receivers"), ("gears.py", "receiver_grid")}

# Folder or file: what of penumbra it may import (a name stands for what is below it, too).
ALLOWED = {
    "errors.py": (),
    "memory.py": (),
    "arrays.py": (),
    "options.py": ("errors",),
    "progress.py": ("memory",),
    "lights.py": ("arrays", "errors"),
    "scene.py": ("arrays", "errors", "lights", "io.scene_file"),
    "kernels/": ("arrays", "kernels"),
    "io/": ("arrays", "errors", "scene", "lights", "io", "kernels"),
    "executors/": ("errors", "executors"),
}

# At the top of a cli file; all else is imported where it is used.
ALLOWED_ON_TOP_OF_CLI = ("__version__", "cli", "errors")


class Import(NamedTuple):
    """One imported module, from the root of its package."""

    file: str
    line: int
    module: str
    on_top: bool

    @property
    def root(self) -> str:
        return self.module.split(".")[0]

    @property
    def inside(self) -> str:
        """The module below `penumbra`."""
        return self.module.partition(".")[2]

    def __str__(self) -> str:
        return f"{self.file}:{self.line} imports {self.module}"


def _modules(node: ast.Import | ast.ImportFrom, file: str) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    base = node.module or ""
    if node.level:
        folder = ("penumbra/" + file).split("/")[: -node.level]
        base = ".".join([*folder, *([base] if base else [])])
    if base.split(".")[0] != "penumbra":
        return [base]
    # `from penumbra.kernels import bits` imports a module, `from penumbra.arrays import Receivers` a name.
    folder_of = ROOT / base.replace(".", "/")
    return [f"{base}.{alias.name}" if folder_of.is_dir() else base for alias in node.names]


def _imports_of(path: Path) -> Iterator[Import]:
    tree = ast.parse(path.read_text())
    file = path.relative_to(PACKAGE).as_posix()
    deferred = {
        id(inner)
        for outer in ast.walk(tree)
        if isinstance(outer, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) or _is_type_checking(outer)
        for inner in ast.walk(outer)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            for module in _modules(node, file):
                yield Import(file, node.lineno, module, id(node) not in deferred)


def _is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"


IMPORTS = [found for path in sorted(PACKAGE.rglob("*.py")) for found in _imports_of(path)]


def _is_below(module: str, names: tuple[str, ...]) -> bool:
    return any(module == name or module.startswith(name + ".") for name in names)


def test_third_party_modules_stay_at_home() -> None:
    known = {*sys.stdlib_module_names, "penumbra", "numpy", *THIRD_PARTY_HOMES}
    assert not [str(found) for found in IMPORTS if found.root not in known]
    homeless = [
        str(found)
        for found in IMPORTS
        if found.root in THIRD_PARTY_HOMES and not found.file.startswith(THIRD_PARTY_HOMES[found.root])
    ]
    assert not homeless


@pytest.mark.parametrize("part", ALLOWED)
def test_parts_import_only_what_is_below_them(part: str) -> None:
    wrong = [
        str(found)
        for found in IMPORTS
        if found.file.startswith(part)
        and found.root == "penumbra"
        and not _is_below(found.inside, ALLOWED[part])
    ]
    assert not wrong


def test_stages_do_not_import_each_other() -> None:
    wrong = [
        str(found)
        for found in IMPORTS
        if found.file.removesuffix(".py") in STAGES
        and (found.file, found.inside) not in STAGE_IN_STAGE
        and found.root == "penumbra"
        and _is_below(found.inside, STAGES)
    ]
    assert not wrong


def test_arrays_and_errors_are_the_ground() -> None:
    assert {found.root for found in IMPORTS if found.file == "arrays.py"} <= {"numpy", "typing"}
    assert not [str(found) for found in IMPORTS if found.file == "errors.py"]


def test_the_command_line_imports_the_library_where_it_uses_it() -> None:
    wrong = [
        str(found)
        for found in IMPORTS
        if found.file.startswith("cli/")
        and found.on_top
        and (
            found.root == "numpy"
            or found.root == "penumbra"
            and not _is_below(found.inside, ALLOWED_ON_TOP_OF_CLI)
        )
    ]
    assert not wrong
    assert not [
        str(found)
        for found in IMPORTS
        if found.module.startswith("penumbra.cli") and not found.file.startswith(("cli/", "__main__.py"))
    ]


def test_nothing_but_the_command_line_needs_the_measurements() -> None:
    wrong = [
        str(found)
        for found in IMPORTS
        if found.module.startswith("penumbra.measure") and not found.file.startswith(("measure/", "cli/"))
    ]
    assert not wrong
    # pyplot keeps figures in a global state and chooses a backend by the screen that it finds.
    assert "pyplot" not in {name for found in IMPORTS for name in found.module.split(".")}


def test_one_place_decides_how_kernels_are_compiled() -> None:
    wrong = [
        path.name
        for path in (PACKAGE / "kernels").glob("*.py")
        if path.name != "_jit.py" and any(word in path.read_text() for word in ("njit", "prange", "fastmath"))
    ]
    assert not wrong


COMMANDS = ("demo", "ingest", "render", "info", "bench", "bench error", "bench stability", "warmup")


@pytest.mark.parametrize(
    "statement",
    [
        "import penumbra, penumbra.errors",
        "import penumbra; dir(penumbra); penumbra.Scene, penumbra.Camera, penumbra.MeshRef",
        "import penumbra; penumbra.RectLight, penumbra.CastOptions, penumbra.IngestOptions",
        "from penumbra.cli.main import run; run(['--help'])",
        *(f"from penumbra.cli.main import run; run('{command} --help'.split())" for command in COMMANDS),
    ],
)
def test_nothing_heavy_is_loaded_before_it_is_needed(statement: str) -> None:
    code = f"import sys\n{statement}\nprint('loaded:', *sorted(set({HEAVY}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1].strip() == "loaded:"
