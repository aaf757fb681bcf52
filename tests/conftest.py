"""What every test file may use: seeded random numbers, a small mesh, a small scene file."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

# The first example of a property may compile kernels, which no per-example deadline allows for.
settings.register_profile("penumbra", deadline=None, print_blob=True)
settings.load_profile("penumbra")

# A floor of 4 x 4 at y = 0 and a square of 1 x 1 at y = 1 above its middle.
FLOOR_AND_SQUARE = """\
v -2 0 -2
v 2 0 -2
v 2 0 2
v -2 0 2
v -0.5 1 -0.5
v 0.5 1 -0.5
v 0.5 1 0.5
v -0.5 1 0.5
f 1 4 3
f 1 3 2
f 5 8 7
f 5 7 6
"""

SCENE = """\
[[geometry]]
path = "square.obj"

[camera]
eye = [0, 3, 5]
look_at = [0, 0.3, 0]
vfov = 40
resolution = [32, 24]

[[light]]
name = "key"
type = "rect"
corner = [-0.5, 3, -0.5]
edge_u = [1, 0, 0]
edge_v = [0, 0, 1]
samples = 16
radiance = 10.0
"""


@pytest.fixture
def rng() -> np.random.Generator:
    """Seeded anew for each test."""
    return np.random.default_rng(20051)


@pytest.fixture
def square_obj(tmp_path: Path) -> Path:
    """A floor and a square above it: four triangles, eight vertices."""
    path = tmp_path / "square.obj"
    path.write_text(FLOOR_AND_SQUARE)
    return path


@pytest.fixture
def scene_file(square_obj: Path) -> Path:
    """A 32 x 24 scene of the square above its floor, with one light of 16 samples above both."""
    path = square_obj.with_name("square.toml")
    path.write_text(SCENE)
    return path


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say how many decisions the exact judge has taken: the suite is to stay below 200,000."""
    if "oracle" in sys.modules:
        terminalreporter.write_line(f"exact judge: {sys.modules['oracle'].Count.predicates:,} predicates")
