"""Files written whole or not at all: whatever fails, whoever else writes, whenever it is killed."""

import contextlib
import errno
import os
import signal
import stat
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from refine_addon.core import RefineError, read_ply
from refine_addon.core import whole_file as whole_files
from refine_addon.core.whole_file import refuse_existing, whole_file
from tests.strategies import plain_header, plain_ply, splat_names

posix = pytest.mark.skipif(os.name != "posix", reason="needs fork, links and signals")


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def written(path, data=b"all", *, overwrite=True):
    with whole_file(path, overwrite=overwrite) as stream:
        stream.write(data)


def refuse(*_, **__):
    raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))


FULL = "no space left on the disk; nothing was changed"
ERRORS = {
    **dict.fromkeys((KeyboardInterrupt(), ValueError())),
    **dict.fromkeys((OSError(errno.ENOSPC, ""), OSError(errno.EDQUOT, "")), FULL),
    OSError(errno.EIO, "Bad"): "cannot be written (Bad); nothing was changed",
}


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("error", ERRORS, ids=repr)
def test_a_block_that_fails_leaves_what_was_there(tmp_path, error, overwrite):
    """An error that is not the system's is handed on as it is."""
    path = tmp_path / "out"
    if overwrite:
        path.write_bytes(b"old")
    before = contents(tmp_path)
    raised = pytest.raises(RefineError if ERRORS[error] else type(error))
    with raised as caught, whole_file(path, overwrite=overwrite) as stream:
        stream.write(b"half of")
        raise error
    assert not ERRORS[error] or str(caught.value) == f"{path}: {ERRORS[error]}"
    assert before == contents(tmp_path)


@posix
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("folder", "is a folder, expected a file name to write to"),
        ("old", "exists already; choose another name, or set overwrite"),
        ("none/out", "cannot be written, there is no folder {folder}/none"),
        ("old/out", "cannot be written, there is no folder {folder}/old"),
        ("link", "cannot be written, there is no folder {folder}/no"),
        ("circle", "cannot be written ("),
        ("/dev/null", "is a device, expected the name of a file"),
        ("n" * 300, "cannot be written (File name too long); nothing was changed"),
        (f"{'n' * 300}/out", "cannot be written (File name too long)"),
        ("a\0b", "cannot be written ("),
    ],
    ids=ascii,
)
def test_an_output_that_cannot_be_is_refused_before_any_work(tmp_path, name, words):
    """The root user could replace a device by a file."""
    (tmp_path / "old").write_bytes(b"old")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "no/out")
    (tmp_path / "circle").symlink_to("circle")
    before, path = sorted(tmp_path.iterdir()), tmp_path / name
    for use in (refuse_existing, written):
        with pytest.raises(RefineError) as caught:
            use(path, overwrite=name != "old")
        assert str(caught.value).startswith(
            f"{RefineError(str(path))}: {words.format(folder=tmp_path)}"
        )
    assert sorted(tmp_path.iterdir()) == before
    assert (tmp_path / "old").read_bytes() == b"old"
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)


@posix
def test_a_link_is_followed_and_stays(tmp_path):
    """One that points nowhere makes its target; of 255 bytes: the temporary name is no longer."""
    long = tmp_path / ("部" * 85)
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "link").symlink_to("real")
    (tmp_path / "loose").symlink_to(long)
    for name, overwrite in (("link", True), ("loose", False)):
        written(tmp_path / name, overwrite=overwrite)
        assert (tmp_path / name).is_symlink()
    assert (tmp_path / "real").read_bytes() == long.read_bytes() == b"all"


@posix
@pytest.mark.parametrize("old_mode", [0o640, 0o000, 0o777, 0o6755])
@pytest.mark.parametrize("mask", [0o000, 0o022, 0o077])
def test_a_file_keeps_its_permissions_and_a_new_one_has_the_usual(tmp_path, mask, old_mode):
    """But it does not run in the name of whoever replaced it."""
    old, new = tmp_path / "old", tmp_path / "new"
    old.touch()
    old.chmod(old_mode)
    before = os.umask(mask)
    try:
        written(old)
        written(new)
    finally:
        assert os.umask(before) == mask
    assert stat.S_IMODE(old.stat().st_mode) == old_mode & 0o777
    assert stat.S_IMODE(new.stat().st_mode) == 0o666 & ~mask


@posix
@pytest.mark.parametrize("name", ["new", "old"])
def test_nobody_else_may_read_a_file_that_is_not_whole(tmp_path, monkeypatch, name):
    (tmp_path / "old").write_bytes(b"old")
    (tmp_path / "old").chmod(0o600)
    if name == "old":
        monkeypatch.setattr(Path, "chmod", refuse)
    with whole_file(tmp_path / name, overwrite=True):
        (temporary,) = tmp_path.glob(".refine-*")
        assert stat.S_IMODE(temporary.stat().st_mode) == 0o600


def test_what_killed_runs_left_is_removed_a_day_later_and_nothing_else(tmp_path):
    old, new, other = (tmp_path / name for name in (".refine-1.tmp", ".refine-2.tmp", "a.tmp"))
    for path in (old, new, other):
        path.write_bytes(b"half of")
    folder = tmp_path / ".refine-folder.tmp"
    folder.mkdir()
    for path in (old, other, folder):
        os.utime(path, (0.0, time.time() - whole_files.ABANDONED - 60.0))
    written(tmp_path / "out")
    assert contents(tmp_path) == {"out": b"all", new.name: b"half of", "a.tmp": b"half of"}
    assert folder.is_dir()


def test_interrupted_at_any_line_before_the_block_nothing_is_left(tmp_path):
    """Ctrl-C and kills become exceptions anywhere: there is no line between file and clean-up."""
    lines, left, before, reached = 0, 0, sys.gettrace(), False

    def trace(frame, event, _):
        nonlocal left
        if frame.f_code.co_filename != whole_files.__file__:
            return None
        left -= event == "line"
        if event == "line" and left == 0:
            raise KeyboardInterrupt
        return trace

    while not reached:
        lines = left = lines + 1
        with contextlib.suppress(KeyboardInterrupt):
            try:
                sys.settrace(trace)
                with whole_file(tmp_path / "out", overwrite=False):
                    sys.settrace(before)
                    reached = True
            finally:
                sys.settrace(before)
        assert reached or list(tmp_path.iterdir()) == [], lines

    assert lines > 20


@pytest.mark.parametrize("replaces", [True, False])
def test_the_file_being_read_can_be_the_one_written(tmp_path, monkeypatch, replaces):
    """Only if asked to; the old file lives on unnamed. Windows: refused, but not text."""
    monkeypatch.setattr(whole_files, "REPLACES_MAPPED", replaces)
    path, text, keep = tmp_path / "in.ply", tmp_path / "text.ply", np.array([True, False, True])
    path.write_bytes(plain_ply())
    file, before = read_ply(path), path.read_bytes()
    rows = file.rows.tobytes()
    refused = "exists already" if replaces else "is the file being read, which this system"
    with pytest.raises(RefineError, match=refused):
        file.write(path, keep, overwrite=not replaces)
    assert before == path.read_bytes()
    if replaces:
        file.write(path, keep, overwrite=True)
        assert len(read_ply(path)) == 2
    assert rows == file.rows.tobytes()
    file.write(tmp_path / "out.ply")
    text.write_bytes(plain_header(0, splat_names(0), "ascii"))
    read_ply(text).write(text, overwrite=True)


@pytest.mark.parametrize("fat", [False, True])
def test_a_name_taken_while_the_block_ran_is_not_lost(tmp_path, monkeypatch, fat):
    """The second to finish gives way; also on FAT, without hard links or permissions."""
    if fat:
        monkeypatch.setattr(os, "link", refuse)
        monkeypatch.setattr(Path, "chmod", refuse)
    lost = pytest.raises(RefineError, match="another program created this file in the meantime")
    with lost, whole_file(tmp_path / "out", overwrite=False) as late:
        late.write(b"late")
        written(tmp_path / "out", b"early", overwrite=False)
    assert contents(tmp_path) == {"out": b"early"}
    written(tmp_path / "out", b"replaced")
    assert contents(tmp_path) == {"out": b"replaced"}


@pytest.mark.slow
@posix
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # of fork, with threads
@pytest.mark.parametrize("exists", [False, True])
def test_killed_at_any_moment_the_old_file_or_the_new_one_is_there_whole(tmp_path, exists):
    """Forty writers of 56 kB, killed after 0 to 4 ms; a writer needs about 2."""
    path, source, new = tmp_path / "out.ply", tmp_path / "in.ply", plain_ply(1000)
    source.write_bytes(new)
    file = read_ply(source)
    for delay in np.random.default_rng(0).uniform(0.0, 0.004, 40):
        path.unlink(missing_ok=True)
        if exists:
            path.write_bytes(b"old")
        child = os.fork()
        if not child:
            try:
                file.write(path, overwrite=exists)
            finally:
                os._exit(0)
        time.sleep(delay)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        content = path.read_bytes() if path.exists() else None
        assert content in (new, b"old" if exists else None)
    assert new == source.read_bytes()
    names = {name for name in contents(tmp_path) if not name.startswith(".refine-")}
    assert names <= {"in.ply", "out.ply"}


def test_what_can_be_read_stays_as_it_is():
    """Other scripts, backslashes and typographers' spaces; half a surrogate pair has no bytes."""
    for text in ("Müller – 部屋 🎈", "C:\\new\\table", "50\xa0% ", ""):
        assert str(RefineError(text)) == text
    assert str(RefineError("a\udcffb")) == r"a\udcffb"
