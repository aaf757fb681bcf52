"""The command line: every exit code, one sentence for every mistake, real signals to a running render."""

import errno
import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from penumbra import __version__
from penumbra.cli.main import cli, run
from penumbra.progress import LogProgress, TerminalProgress

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = list(cli.commands)


class Result:
    """Exit code and both streams of a command that ran in this process."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err

    def fails(self, code: int, *words: str) -> None:
        """Check that it failed with one sentence that has these words, and no result."""
        assert (self.code, self.out) == (code, ""), self.err
        sentence = [line for line in self.err.splitlines() if not line.startswith(("progress:", "done:"))]
        assert len(sentence) == 1 and sentence[0].startswith("penumbra: error: "), self.err
        for word in words:
            assert word in sentence[0], sentence[0]


class Penumbra:
    """Runs commands in a folder of their own."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *arguments: str | Path) -> Result:
        code = run([str(argument) for argument in arguments])
        return Result(code, *self._capsys.readouterr())


@pytest.fixture
def penumbra(
    capsys: pytest.CaptureFixture[str], scene_file: Path, monkeypatch: pytest.MonkeyPatch
) -> Penumbra:
    """Commands run in the folder that has square.toml and square.obj."""
    monkeypatch.chdir(scene_file.parent)
    return Penumbra(capsys)


def start(arguments: Sequence[str], folder: Path, **streams: int) -> subprocess.Popen[str]:
    """Start a command as a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [sys.executable, "-m", "penumbra", *arguments], cwd=folder, env=environment, text=True, **streams
    )


def test_help_and_version(penumbra: Penumbra) -> None:
    helped = penumbra("--help")
    assert helped.code == 0 and all(f"  {name} " in helped.out for name in COMMANDS)
    for name in COMMANDS:
        assert penumbra(name, "--help").code == 0
    assert penumbra("--version").out.strip().endswith(__version__)


USAGE = {
    "no command": [],
    "unknown command": ["cast"],
    "unknown option": ["render", "square.toml", "-o", "x.exr", "--fast"],
    "no scene": ["render"],
    "no output": ["render", "square.toml"],
    "no mesh": ["ingest", "-o", "x.h5"],
    "no store": ["ingest", "square.obj"],
    "size": ["ingest", "square.obj", "-o", "x.h5", "--memory", "banana"],
    "negative size": ["render", "square.toml", "-o", "x.exr", "--memory", "-1GiB"],
    "resolution": ["render", "square.toml", "-o", "x.exr", "--resolution", "640"],
    "empty resolution": ["render", "square.toml", "-o", "x.exr", "--resolution", "640x0"],
    "samples": ["render", "square.toml", "-o", "x.exr", "--samples", "0"],
    "threads": ["render", "square.toml", "-o", "x.exr", "--threads", "-1"],
    "backend": ["render", "square.toml", "-o", "x.exr", "--backend", "embree"],
    "crop": ["render", "square.toml", "-o", "x.exr", "--crop", "0", "0", "8"],
    "seed": ["render", "square.toml", "-o", "x.exr", "--seed", "-3"],
}


@pytest.mark.parametrize("case", USAGE)
def test_usage_errors(case: str, penumbra: Penumbra) -> None:
    result = penumbra(*USAGE[case])
    assert result.code == 2 and result.out == "" and "Traceback" not in result.err
    assert "Error: " in result.err or not USAGE[case]


def test_wrong_paths(penumbra: Penumbra, tmp_path: Path) -> None:
    penumbra("render", "absent.toml", "-o", "x.exr").fails(1, "absent.toml", "No such file")
    penumbra("render", ".", "-o", "x.exr").fails(1, "cannot read")
    penumbra("ingest", "absent.ply", "-o", "x.h5").fails(1, "absent.ply")
    penumbra("ingest", "square.obj", "-o", "no/folder/x.h5").fails(1, "no/folder")
    penumbra("render", "square.toml", "-o", "no/folder/x.exr").fails(1, "no/folder")
    penumbra("render", "square.toml", "-o", tmp_path).fails(1, str(tmp_path))
    penumbra("info", "absent.h5").fails(1, "absent.h5", "No such file")
    penumbra("info", "square.obj").fails(1, "square.obj", "no blocker store")


def test_wrong_contents(penumbra: Penumbra, scene_file: Path) -> None:
    scene_file.write_text(scene_file.read_text().replace("vfov", "fov"))
    penumbra("render", scene_file.name, "-o", "x.exr").fails(1, "square.toml:7", "'fov'", "'vfov'")
    Path("short.ply").write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        b"property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n\0\0\0\0"
    )
    penumbra("ingest", "short.ply", "-o", "x.h5").fails(1, "short.ply")
    Path("bad.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\nf 1 2 3\n")
    penumbra("ingest", "bad.obj", "-o", "x.h5").fails(1, "bad.obj", "4")
    assert not Path("x.h5").exists()
    skipped = penumbra("ingest", "bad.obj", "-o", "x.h5", "--skip-bad")
    assert (skipped.code, skipped.out) == (0, "x.h5: 1 triangles, 1 bad ones skipped\n")


def test_crop_outside_the_picture(penumbra: Penumbra) -> None:
    penumbra("render", "square.toml", "-o", "x.exr", "--crop", "0", "0", "999", "999").fails(1, "crop")


def test_memory_that_cannot_do_is_refused(penumbra: Penumbra) -> None:
    penumbra("render", "square.toml", "-o", "x.exr", "--memory", "1MiB").fails(3, "MiB")
    penumbra("ingest", "square.obj", "-o", "x.h5", "--memory", "1MiB").fails(3, "MiB")
    assert not list(Path().glob("*.exr")) and not list(Path().glob("*.h5"))


def test_existing_outputs_are_kept(penumbra: Penumbra) -> None:
    for name, arguments in {"x.exr": ("render", "square.toml"), "x.h5": ("ingest", "square.obj")}.items():
        Path(name).write_text("precious")
        penumbra(*arguments, "-o", name).fails(1, name, "overwrite")
        assert Path(name).read_text() == "precious"
        assert penumbra(*arguments, "-o", name, "--overwrite").code == 0
        assert Path(name).read_bytes() != b"precious"


def test_render_and_info(penumbra: Penumbra) -> None:
    done = penumbra("render", "square.toml", "-o", "x.exr", "--preview", "x.png", "--stats", "x.json")
    assert (done.code, done.out.split()) == (0, ["x.exr", "x.png", "x.json"])
    assert "cast" in done.err
    assert Path("x.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads(Path("x.json").read_text())["backend"] == "hpc"
    text, facts = penumbra("info", "x.exr").out, json.loads(penumbra("info", "x.exr", "--json").out)
    assert "key.visibility" in text
    assert (facts["kind"], facts["data_window"], facts["header"]["samples"]) == ("image", [0, 0, 31, 23], 16)
    assert {"R", "G", "B", "Z", "id", "key.visibility", "key.irradiance", "P.X", "N.Z"} <= set(
        facts["layers"]
    )
    assert not [path for path in Path().iterdir() if "tmp" in path.name]


def test_ingest_and_info(penumbra: Penumbra) -> None:
    done = penumbra("ingest", "square.obj", "square.obj", "-o", "x.h5")
    assert (done.code, done.out) == (0, "x.h5: 8 triangles\n")
    facts = json.loads(penumbra("info", "x.h5", "--json").out)
    assert (facts["kind"], facts["n_triangles"], facts["n_dropped"]) == ("store", 8, 0)
    assert facts["bounds"] == [[-2.0, 0.0, -2.0], [2.0, 1.0, 2.0]]
    assert sum(bucket["n_triangles"] for bucket in facts["buckets"]) == 8
    assert "n_triangles" in penumbra("info", "x.h5").out


def test_info_of_a_scene(penumbra: Penumbra) -> None:
    facts = json.loads(penumbra("info", "square.toml", "--json").out)
    assert facts["kind"] == "scene" and facts["camera"]["resolution"] == [32, 24]
    assert facts["light"][0]["name"] == "key" and facts["light"][0]["area"] == 1.0
    assert facts["geometry"][0]["path"] == "square.obj"


def test_dry_run_only_prints(penumbra: Penumbra, tmp_path: Path) -> None:
    before = set(tmp_path.iterdir())
    plan = penumbra("render", "square.toml", "--dry-run", "--resolution", "640x480")
    assert plan.code == 0 and "640 x 480" in plan.out and "key: 16 samples" in plan.out
    assert set(tmp_path.iterdir()) == before


def test_overrides_arrive(penumbra: Penumbra) -> None:
    done = penumbra(
        *("render", "square.toml", "-o", "x.exr", "-q", "--resolution", "16x8", "--samples", "5"),
        *("--crop", "2", "1", "10", "6", "--seed", "7", "--backend", "reference", "--threads", "1"),
    )
    assert (done.code, done.out, done.err) == (0, "x.exr\n", "")
    facts = json.loads(penumbra("info", "x.exr", "--json").out)
    assert (facts["data_window"], facts["display_window"]) == ([2, 1, 9, 5], [0, 0, 15, 7])
    assert (facts["header"]["samples"], facts["header"]["seed"]) == (5, 7)
    assert facts["header"]["backend"] == "reference"


def test_resume_of_a_finished_image_does_nothing(penumbra: Penumbra) -> None:
    assert penumbra("render", "square.toml", "-o", "x.exr", "--resume").code == 0
    before = Path("x.exr").stat().st_mtime_ns
    assert penumbra("render", "square.toml", "-o", "x.exr", "--resume").code == 0
    assert Path("x.exr").stat().st_mtime_ns == before
    penumbra("render", "square.toml", "-o", "x.exr", "--resume", "--samples", "17").fails(
        1, "x.exr", "samples"
    )


@pytest.mark.parametrize(("kind", "mark"), [(TerminalProgress, "\x1b[K"), (LogProgress, "done: ")])
def test_progress_on_a_terminal_and_in_a_log(kind: type[TerminalProgress | LogProgress], mark: str) -> None:
    stream = io.StringIO()
    report = kind(stream)
    report.stage("ingest: reading", 4 * 2**20, "B")
    report.advance(2**20)
    report.advance(3 * 2**20)
    report.stage("cast", None, "triangles")
    report.advance(1234)
    report.close()
    assert mark + "ingest: reading: 4.0 MiB, " in stream.getvalue()
    assert mark + "cast: 1,234 triangles, " in stream.getvalue()
    report.stage("shade", 2, "receivers")
    report.abandon()
    report.close()
    assert "shade: " not in stream.getvalue() and stream.getvalue().endswith("\n")


@pytest.mark.parametrize("flags", [("-q",), ("-v",), ()])
def test_quiet_and_verbose_before_or_after(flags: tuple[str, ...], penumbra: Penumbra) -> None:
    before = penumbra(*flags, "ingest", "square.obj", "-o", "a.h5")
    after = penumbra("ingest", "square.obj", "-o", "b.h5", *flags)
    assert before.code == after.code == 0
    assert (before.err == "", after.err == "") == ((True, True) if "-q" in flags else (False, False))


def _raise(problem: BaseException) -> object:
    def describe(_path: Path) -> None:
        raise problem

    return describe


def test_unexpected_errors_are_owned_up_to(penumbra: Penumbra, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("penumbra.cli.describe.describe", _raise(ZeroDivisionError("by\nzero")))
    penumbra("info", "square.toml").fails(1, "bug", "ZeroDivisionError: by", "--verbose")
    told = penumbra("info", "square.toml", "-v")
    assert told.code == 1 and "Traceback" in told.err and told.err.count("bug in penumbra") == 1


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.ENOSPC, ("No space left", "big.h5", "--scratch")),
        (errno.EACCES, ("Permission denied", "big.h5")),
    ],
)
def test_system_errors_get_a_sentence(
    number: int, words: tuple[str, ...], penumbra: Penumbra, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "penumbra.cli.describe.describe", _raise(OSError(number, os.strerror(number), "big.h5"))
    )
    penumbra("info", "square.toml").fails(1, *words)


def test_out_of_memory_gets_a_sentence(penumbra: Penumbra, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("penumbra.cli.describe.describe", _raise(MemoryError()))
    penumbra("info", "square.toml").fails(1, "out of memory")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="has no /dev/full")
def test_results_that_cannot_be_written(penumbra: Penumbra, tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        process = start(["info", "square.toml"], tmp_path, stdout=full.fileno(), stderr=subprocess.PIPE)
        _, said = process.communicate()
    assert (process.returncode, said.count("\n")) == (1, 1) and "No space left" in said

    reader, writer = os.pipe()
    os.close(reader)
    process = start(["info", "square.toml"], tmp_path, stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    _, said = process.communicate()
    assert (process.returncode, said.count("\n")) == (1, 1) and "cannot write the result" in said


@pytest.mark.parametrize(
    ("number", "code", "word"), [(signal.SIGTERM, 75, "SIGTERM"), (signal.SIGINT, 130, "Ctrl-C")]
)
def test_signals_stop_a_render(number: int, code: int, word: str, penumbra: Penumbra, tmp_path: Path) -> None:
    before = {path.name for path in tmp_path.iterdir()}
    long = ["--resolution", "4000x3000", "--samples", "1024"]
    process = start(
        ["render", "square.toml", "-o", "x.exr", *long],
        tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert process.stderr is not None
    began = process.stderr.readline()
    process.send_signal(number)
    printed, said = process.communicate()
    assert began.startswith("progress:")
    assert (process.returncode, printed) == (code, ""), said
    assert word in said.splitlines()[-1] and "Traceback" not in said
    assert {path.name for path in tmp_path.iterdir()} == before


def test_demo_prints_what_was_written(penumbra: Penumbra, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "penumbra.demo.run_demo", lambda folder, progress: [folder / "a.exr", folder / "a.png"]
    )
    assert penumbra("demo").out.split() == ["demo/a.exr", "demo/a.png"]
    assert penumbra("demo", "-o", "made").out.split() == ["made/a.exr", "made/a.png"]
    assert penumbra("demo", "-o", "square.obj").code == 2


@pytest.mark.slow
def test_demo(penumbra: Penumbra) -> None:
    for _ in range(2):
        done = penumbra("demo", "-o", "made")
        assert done.code == 0
        written = [Path(line) for line in done.out.splitlines()]
        assert {".exr", ".png"} <= {path.suffix for path in written}
        assert all(path.is_file() for path in written)


def test_warmup(penumbra: Penumbra) -> None:
    done = penumbra("warmup")
    assert done.code == 0 and "kernels are ready" in done.out
