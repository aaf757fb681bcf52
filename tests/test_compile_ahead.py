"""When a child process is started to compile the kernels, and when not."""

import subprocess
import sys
from types import SimpleNamespace

import pytest

from penumbra import compile_ahead as module
from penumbra.compile_ahead import compile_ahead
from penumbra.progress import NullProgress


@pytest.fixture
def started(monkeypatch, tmp_path):
    """Commands that were run; the cache is an empty folder and the child succeeds at once."""
    commands = []

    def run(command, **options):
        commands.append((command, options["env"]))
        return SimpleNamespace(returncode=run.returncode)

    run.returncode = 0
    monkeypatch.setattr(module.subprocess, "run", run)
    monkeypatch.setattr("penumbra.kernels._jit.cache_folder", lambda: tmp_path)
    monkeypatch.delenv("PENUMBRA_COMPILING", raising=False)
    monkeypatch.setattr(sys, "executable", "/usr/bin/python3.11")
    return SimpleNamespace(commands=commands, run=run)


def test_once_and_not_again(started, tmp_path):
    compile_ahead(NullProgress())
    compile_ahead(NullProgress())
    assert len(started.commands) == 1
    assert (tmp_path / "compiled").exists()
    assert started.commands[0][1]["PENUMBRA_COMPILING"] == "1"


def test_a_child_that_fails_is_tried_again(started, tmp_path):
    started.run.returncode = 1
    compile_ahead(NullProgress())
    assert not (tmp_path / "compiled").exists()
    compile_ahead(NullProgress())
    assert len(started.commands) == 2


@pytest.mark.parametrize("executable", ["", None, "/opt/viewer/bin/viewer"])
def test_an_application_that_embeds_python_is_not_started(started, monkeypatch, executable):
    monkeypatch.setattr(sys, "executable", executable)
    compile_ahead(NullProgress())
    assert started.commands == []


def test_the_child_starts_no_child(started, monkeypatch):
    monkeypatch.setenv("PENUMBRA_COMPILING", "1")
    compile_ahead(NullProgress())
    assert started.commands == []


def test_the_child_finds_this_package_from_anywhere(started, tmp_path):
    (tmp_path / "penumbra").mkdir()
    (tmp_path / "penumbra" / "__init__.py").write_text("raise ImportError('the wrong one')")
    compile_ahead(NullProgress())
    command, environment = started.commands[0]
    code = "import penumbra.warmup"
    command = [sys.prefix + "/bin/python", *command[1:-1], code]
    done = subprocess.Popen(command, cwd=tmp_path, env=environment)
    assert done.wait(timeout=60) == 0
