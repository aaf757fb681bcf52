"""Outputs are whole or absent, whatever happens while they are written."""

import os
import stat
import subprocess
import sys

import pytest

from penumbra.errors import OutputError
from penumbra.io.atomic import atomic_path, check_output, remove_dead_temporaries, temporary_folder


@pytest.fixture
def dead_pid():
    """The id of a process that has ended."""
    return int(
        subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True).stdout
    )


def test_the_file_appears_whole_and_alone(tmp_path):
    final = tmp_path / "out.bin"
    with atomic_path(final) as temporary:
        temporary.write_bytes(b"new")
        assert temporary.parent == tmp_path
        assert temporary.name == f".out.bin.tmp-{os.getpid()}"
        assert not final.exists()
    assert final.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["out.bin"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_failure_keeps_the_old_file(tmp_path, error):
    final = tmp_path / "out.bin"
    final.write_bytes(b"old")
    with pytest.raises(error), atomic_path(final) as temporary:
        temporary.write_bytes(b"half")
        raise error
    assert final.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["out.bin"]


def test_a_body_that_writes_nothing_leaves_nothing(tmp_path):
    with atomic_path(tmp_path / "out.bin"):
        pass
    assert os.listdir(tmp_path) == []


def test_a_link_is_written_through(tmp_path):
    real = tmp_path / "real"
    real.mkdir()
    (real / "file").write_bytes(b"old")
    link = tmp_path / "link"
    link.symlink_to(real / "file")
    with atomic_path(link) as temporary:
        temporary.write_bytes(b"new")
    assert link.is_symlink()
    assert (real / "file").read_bytes() == b"new"


def test_permissions_follow_the_umask(tmp_path):
    old = os.umask(0o027)
    try:
        with atomic_path(tmp_path / "out.bin") as temporary:
            temporary.write_bytes(b"")
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "out.bin").stat().st_mode) == 0o640


@pytest.mark.parametrize("name", ["missing/out.exr", "folder"])
def test_what_cannot_be_written_is_refused_first(tmp_path, name):
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match="cannot write"):
        check_output(tmp_path / name)
    with pytest.raises(OutputError, match="cannot write"), atomic_path(tmp_path / name):
        raise AssertionError("the body must not run")


def test_a_device_is_not_replaced():
    with pytest.raises(OutputError, match="not a regular file"), atomic_path(os.devnull):
        raise AssertionError("the body must not run")


def test_a_folder_that_is_not_writable(tmp_path):
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="not writable"):
        check_output(tmp_path / "out.exr")


def test_dead_temporaries_go_and_live_ones_stay(tmp_path, dead_pid):
    dead = tmp_path / f".out.exr.tmp-{dead_pid}"
    kept = [
        tmp_path / name for name in (f".out.exr.tmp-{os.getpid()}", f".other.exr.tmp-{dead_pid}", "out.exr")
    ]
    for path in [dead, *kept]:
        path.write_bytes(b"")
    assert remove_dead_temporaries(tmp_path / "out.exr") == [dead]
    assert sorted(tmp_path.iterdir()) == sorted(kept)


def test_temporary_folder_is_removed_with_its_content(tmp_path, dead_pid):
    dead = tmp_path / f".penumbra-tmp-{dead_pid}-x"
    dead.mkdir()
    (dead / "store.h5").write_bytes(b"")
    with pytest.raises(RuntimeError), temporary_folder(tmp_path) as folder:
        assert list(tmp_path.iterdir()) == [folder]
        (folder / "store.h5").write_bytes(b"")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_temporary_folder_needs_a_parent(tmp_path):
    with pytest.raises(OutputError, match="does not exist"), temporary_folder(tmp_path / "missing"):
        raise AssertionError("the body must not run")
