"""Where the optional real meshes live: beside the repository, absent on most machines."""

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


def scene_file(name: str) -> Path:
    """Path of a real mesh; skips the test where it is absent."""
    path = SHARED / "scenes" / name
    if not path.exists():
        pytest.skip(f"{name} is not on this machine")
    return path


def corpus_files() -> list[Path]:
    """All odd and broken OBJ and PLY files, empty where the corpus is absent."""
    folder = SHARED / "corpus"
    return sorted(p for p in folder.glob("*") if p.suffix in {".obj", ".ply"}) if folder.exists() else []
