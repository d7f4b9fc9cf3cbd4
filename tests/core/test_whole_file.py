"""Files written whole or not at all: whatever fails, whoever else writes, whenever it is killed."""

from __future__ import annotations

import errno
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from refine_addon.core import RefineError, read_ply
from refine_addon.core import whole_file as whole_files
from refine_addon.core.execute import Cancelled, checked_by
from refine_addon.core.formats import ply
from refine_addon.core.whole_file import expanded, refuse_existing, whole_file
from tests.strategies import plain_header, plain_ply, splat_names
from tests.users import closed_folder

posix = pytest.mark.skipif(os.name != "posix", reason="needs fork, links and signals")


@pytest.fixture
def source(tmp_path):
    """Open a file of 3 splats, in a folder with nothing else."""
    path = tmp_path / "in.ply"
    path.write_bytes(plain_ply())
    return read_ply(path)


def contents(folder: Path) -> dict[str, bytes]:
    """Return everything in a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_a_block_that_ends_well_makes_the_file(tmp_path):
    """And nothing else stays in the folder."""
    with whole_file(tmp_path / "out", overwrite=False) as stream:
        stream.write(b"all of it")
        assert not (tmp_path / "out").exists()

    assert contents(tmp_path) == {"out": b"all of it"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, SystemExit, MemoryError])
@pytest.mark.parametrize("overwrite", [False, True])
def test_a_block_that_fails_leaves_what_was_there(tmp_path, error, overwrite):
    """An error that is not the system's is handed on as it is."""
    path = tmp_path / "out"
    if overwrite:
        path.write_bytes(b"old")
    before = contents(tmp_path)

    def fail():
        with whole_file(path, overwrite=overwrite) as stream:
            stream.write(b"half of")
            raise error

    with pytest.raises(error):
        fail()

    assert before == contents(tmp_path)


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (errno.ENOSPC, "no space left on the disk; nothing was changed"),
        (errno.EDQUOT, "no space left on the disk; nothing was changed"),
        (errno.EIO, "cannot be written (Input/output error); nothing was changed"),
        (errno.EFBIG, "cannot be written (File too large); nothing was changed"),
    ],
)
def test_a_disk_that_is_full_in_the_middle_of_the_rows_leaves_what_was_there(
    source, monkeypatch, number, expected
):
    """The header is written, the rows are not: simulated, for every error a disk has."""
    folder = source.path.parent
    (folder / "out.ply").write_bytes(b"old")
    before = contents(folder)

    def fail(stream, *_, **__):
        stream.write(b"a few rows")
        stream.flush()
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(ply, "write_rows", fail)

    with pytest.raises(RefineError, match=re.escape(f"{folder / 'out.ply'}: {expected}")):
        source.write(folder / "out.ply", overwrite=True)

    assert before == contents(folder)


LIMITED = """
import resource, sys
from pathlib import Path
from refine_addon.core import RefineError, read_ply

file = read_ply(sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (5_000, 5_000))
try:
    file.write(Path(sys.argv[2]), overwrite=True)
except RefineError as error:
    print(error)
"""


@pytest.mark.slow
@posix
def test_a_file_that_may_not_grow_leaves_what_was_there(tmp_path):
    """A real limit of 5,000 bytes, on a file of 56,000: the system's own error, in our words."""
    source, output = tmp_path / "in.ply", tmp_path / "out.ply"
    source.write_bytes(plain_ply(1000))
    output.write_bytes(b"old")
    before = contents(tmp_path)

    done = subprocess.run(
        [sys.executable, "-c", LIMITED, source, output], capture_output=True, text=True, check=True
    )

    assert f"{output}: cannot be written (File too large); nothing was changed\n" == done.stdout
    assert done.stderr == ""
    assert before == contents(tmp_path)


@posix
def test_a_disk_that_is_really_full_leaves_what_was_there(tmp_path):
    """A file system of 64 kB, for the root user alone to make; the file needs 112 kB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)]
    if not shutil.which("mount") or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("may not mount a small file system")
    try:
        source = tmp_path / "in.ply"
        source.write_bytes(plain_ply(2000))
        file = read_ply(source)
        (disk / "out.ply").write_bytes(b"old")

        with pytest.raises(RefineError, match="no space left on the disk; nothing was changed"):
            file.write(disk / "out.ply", overwrite=True)

        assert contents(disk) == {"out.ply": b"old"}
        file.write(disk / "out.ply", np.arange(2000) < 100, overwrite=True)
        assert len(read_ply(disk / "out.ply")) == 100
    finally:
        subprocess.run(["umount", "--lazy", str(disk)], check=True)


def test_an_output_that_cannot_be_is_refused_before_any_work(tmp_path):
    """Each with the path and the reason; none of them is touched."""
    (tmp_path / "old").write_bytes(b"old")
    (tmp_path / "folder").mkdir()
    for name, overwrite, expected in [
        ("folder", True, "is a folder, expected a file name to write to"),
        ("old", False, "exists already; choose another name, or set overwrite"),
        ("none/out", False, f"cannot be written, there is no folder {tmp_path / 'none'}"),
        ("old/out", False, f"cannot be written, there is no folder {tmp_path / 'old'}"),
        ("n" * 300, False, "cannot be written (File name too long); nothing was changed"),
    ]:
        path = tmp_path / name
        with pytest.raises(RefineError, match=re.escape(f"{path}: {expected}")):
            refuse_existing(path, overwrite=overwrite)
        with (
            pytest.raises(RefineError, match=re.escape(f"{path}: {expected}")),
            whole_file(path, overwrite=overwrite),
        ):
            pytest.fail("the block must not run")

    assert contents(tmp_path) == {"old": b"old"}


@posix
def test_a_device_is_never_replaced(tmp_path):
    """The root user could: /dev/null would be a file from then on."""
    with (
        pytest.raises(RefineError, match="/dev/null: is a device, expected the name of a file"),
        whole_file(Path("/dev/null"), overwrite=True),
    ):
        pytest.fail("the block must not run")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(RefineError, match="pipe: is a device, expected the name of a file"):
        refuse_existing(tmp_path / "pipe", overwrite=True)

    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)


def test_a_folder_that_may_not_be_written_to_is_said_so(source, monkeypatch):
    """Simulated, since the root user may write anywhere."""

    def refuse(*_):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(os, "open", refuse)
    folder = source.path.parent

    with pytest.raises(RefineError, match=re.escape("out.ply: cannot be written (Permission den")):
        source.write(folder / "out.ply")

    assert list(contents(folder)) == ["in.ply"]


@posix
def test_a_folder_that_may_not_be_looked_into_is_said_so():
    """Where even asking whether the file is there is refused."""
    with closed_folder({"old": "old"}) as folder:
        for path in (folder / "old", folder / "new"):
            expected = re.escape(f"{path}: cannot be written (Permission denied)")
            with pytest.raises(RefineError, match=expected):
                refuse_existing(path, overwrite=True)
            with pytest.raises(RefineError, match=expected), whole_file(path, overwrite=True):
                pytest.fail("the block must not run")
            with pytest.raises(RefineError, match=re.escape(f"{path}: cannot be read (Permission")):
                read_ply(path)


@pytest.mark.parametrize("replaces", [False, True])
def test_what_cannot_be_compared_is_not_taken_for_the_file_being_read(
    tmp_path, monkeypatch, replaces
):
    """Names that no system takes are refused where they are opened, by those who open them."""
    monkeypatch.setattr(whole_files, "REPLACES_MAPPED", replaces)
    for name in ("n" * 300, "a\0b", "no/folder", "\ud800"):
        whole_files.refuse_mapped(tmp_path / name, tmp_path / name)


@pytest.mark.parametrize("name", ["n" * 300, "a\0b", "\ud800", f"{'n' * 300}/out"])
def test_an_odd_name_is_refused_before_any_work(tmp_path, name):
    """With the name and a reason; the work may take minutes."""
    with pytest.raises(RefineError, match="cannot be written"):
        refuse_existing(tmp_path / name, overwrite=True)
    with pytest.raises(RefineError, match="cannot be read"):
        read_ply(tmp_path / name)


def test_a_name_that_no_system_takes_is_refused(tmp_path):
    """A zero byte ends a name in every interface below us."""
    with (
        pytest.raises(RefineError, match="embedded null"),
        whole_file(tmp_path / "a\0b", overwrite=False),
    ):
        pytest.fail("the block must not run")
    with pytest.raises(RefineError, match=re.escape("~nobody-here/a: cannot be found (")):
        expanded("~nobody-here/a")


@posix
def test_the_longest_name_that_a_folder_takes_can_be_written(tmp_path):
    """255 bytes, here 85 characters of 3 each: the temporary name must not be longer."""
    path = tmp_path / ("部" * 85)
    with whole_file(path, overwrite=False) as stream:
        stream.write(b"all")

    assert path.read_bytes() == b"all"


@posix
def test_a_link_is_followed_and_stays(tmp_path):
    """The file it points to is replaced; one that points nowhere makes its target."""
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "link").symlink_to("real")
    (tmp_path / "loose").symlink_to("made")
    (tmp_path / "circle").symlink_to("circle")
    with whole_file(tmp_path / "link", overwrite=True) as stream:
        stream.write(b"new")
    with whole_file(tmp_path / "loose", overwrite=False) as stream:
        stream.write(b"made")

    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "loose").is_symlink()
    assert (tmp_path / "real").read_bytes() == b"new"
    assert (tmp_path / "made").read_bytes() == b"made"
    with (
        pytest.raises(RefineError, match=re.escape(f"{tmp_path / 'circle'}: cannot be written")),
        whole_file(tmp_path / "circle", overwrite=True),
    ):
        pytest.fail("the block must not run")


@posix
@pytest.mark.parametrize("old_mode", [0o640, 0o000, 0o777])
@pytest.mark.parametrize("mask", [0o000, 0o022, 0o077])
def test_a_file_keeps_its_permissions_and_a_new_one_has_the_usual(tmp_path, mask, old_mode):
    """Whatever the user's mask for new files; none of either mask or mode is left changed."""
    old, new = tmp_path / "old", tmp_path / "new"
    old.write_bytes(b"old")
    old.chmod(old_mode)
    before = os.umask(mask)
    try:
        for path in (old, new):
            with whole_file(path, overwrite=True) as stream:
                stream.write(b"new")
    finally:
        assert os.umask(before) == mask

    assert stat.S_IMODE(old.stat().st_mode) == old_mode
    assert stat.S_IMODE(new.stat().st_mode) == 0o666 & ~mask


@posix
@pytest.mark.parametrize("overwrite", [False, True])
def test_nobody_else_may_read_a_file_that_is_not_whole(tmp_path, monkeypatch, overwrite):
    """One that replaces a secret is its owner's alone from the moment it is made."""
    opening, made = os.open, []

    def watch(path, *how, **more):
        descriptor = opening(path, *how, **more)
        made.append(stat.S_IMODE(os.fstat(descriptor).st_mode))
        return descriptor

    path = tmp_path / "secret"
    if overwrite:
        path.write_bytes(b"old")
        path.chmod(0o600)
    monkeypatch.setattr(os, "open", watch)
    with whole_file(path, overwrite=overwrite) as stream:
        stream.write(b"half of")
        (temporary,) = tmp_path.glob(".refine-*")
        while_written = stat.S_IMODE(temporary.stat().st_mode)

    assert while_written == 0o600
    assert not overwrite or made == [0o600]


@posix
def test_a_file_that_is_replaced_loses_setuid():
    """The new file is its writer's, who did not ask for one that runs in the writer's name."""
    with tempfile.TemporaryDirectory() as made:
        path = Path(made) / "tool"
        path.write_bytes(b"old")
        path.chmod(0o6755)
        with whole_file(path, overwrite=True) as stream:
            stream.write(b"new")

        assert stat.S_IMODE(path.stat().st_mode) == 0o755


def test_what_killed_runs_left_is_removed_a_day_later_and_nothing_else(tmp_path):
    """Not what may still be written, nor files of other names."""
    old, new, other = (tmp_path / name for name in (".refine-1.tmp", ".refine-2.tmp", "a.tmp"))
    for path in (old, new, other):
        path.write_bytes(b"half of")
    for path in (old, other):
        os.utime(path, (0.0, time.time() - whole_files.ABANDONED - 60.0))
    (tmp_path / ".refine-folder.tmp").mkdir()
    os.utime(tmp_path / ".refine-folder.tmp", (0.0, 0.0))
    with whole_file(tmp_path / "out", overwrite=False) as stream:
        stream.write(b"all")

    assert contents(tmp_path) == {"out": b"all", new.name: b"half of", "a.tmp": b"half of"}
    assert (tmp_path / ".refine-folder.tmp").is_dir()


@posix
def test_a_drive_without_permissions_is_written_to_the_same(tmp_path, monkeypatch):
    """FAT: every file has those of the drive, and changing them is refused."""

    def refuse(*_, **__):
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    (tmp_path / "old").write_bytes(b"old")
    (tmp_path / "old").chmod(0o600)
    monkeypatch.setattr(Path, "chmod", refuse)
    for name in ("old", "new"):
        with whole_file(tmp_path / name, overwrite=True) as stream:
            stream.write(b"all")

    assert contents(tmp_path) == {"old": b"all", "new": b"all"}


def test_interrupted_at_any_line_before_the_block_nothing_is_left(tmp_path):
    """Ctrl-C and kills become exceptions anywhere: there is no line between file and clean-up."""
    file, lines = whole_files.__file__, 0

    def interrupt_at(number):
        left = [number]

        def trace(frame, event, _):
            if frame.f_code.co_filename != file:
                return None
            left[0] -= event == "line"
            if event == "line" and left[0] == 0:
                raise KeyboardInterrupt
            return trace

        return trace

    reached = False
    while not reached:
        lines += 1
        before = sys.gettrace()
        try:
            sys.settrace(interrupt_at(lines))
            with whole_file(tmp_path / "out", overwrite=False):
                sys.settrace(before)
                reached = True
        except KeyboardInterrupt:
            pass
        finally:
            sys.settrace(before)
        if not reached:
            assert list(tmp_path.iterdir()) == [], lines

    assert lines > 20


def test_the_file_being_read_can_be_the_one_written(source):
    """Only if asked to; what was opened stays readable, since the old file lives on unnamed."""
    keep = np.array([True, False, True])
    before = source.path.read_bytes()
    with pytest.raises(RefineError, match="exists already"):
        source.write(source.path, keep)
    assert before == source.path.read_bytes()

    rows = source.rows.tobytes()
    source.write(source.path, keep, overwrite=True)

    assert len(read_ply(source.path)) == 2
    assert rows == source.rows.tobytes()


def test_a_mapped_file_is_not_replaced_where_the_system_cannot(source, monkeypatch):
    """Windows: refused with a sentence; other names, and text, which is not mapped, are not."""
    monkeypatch.setattr(whole_files, "REPLACES_MAPPED", False)
    before = contents(source.path.parent)

    with pytest.raises(RefineError, match="is the file being read, which this system"):
        source.write(source.path, overwrite=True)

    assert before == contents(source.path.parent)
    source.write(source.path.with_name("out.ply"))
    text = source.path.with_name("text.ply")
    text.write_bytes(plain_header(0, splat_names(0), "ascii"))
    read_ply(text).write(text, overwrite=True)


def test_a_name_taken_while_the_block_ran_is_not_lost(tmp_path):
    """Both began when there was no such file; the second to finish gives way."""
    path = tmp_path / "out"

    def race():
        with whole_file(path, overwrite=False) as late:
            late.write(b"late")
            with whole_file(path, overwrite=False) as early:
                early.write(b"early")

    with pytest.raises(RefineError, match="out: another program created this file in the meantime"):
        race()

    assert contents(tmp_path) == {"out": b"early"}


@pytest.mark.parametrize("taken", [False, True])
def test_a_file_system_without_hard_links_is_written_to_the_same(tmp_path, monkeypatch, taken):
    """FAT and some network drives: the check and the renaming are two steps."""

    def refuse(*_):
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "link", refuse)
    path = tmp_path / "out"

    def write():
        with whole_file(path, overwrite=False) as stream:
            stream.write(b"late" if taken else b"early")
            if taken:
                path.write_bytes(b"early")

    if taken:
        with pytest.raises(RefineError, match="another program created this file"):
            write()
    else:
        write()

    assert contents(tmp_path) == {"out": b"early"}


@pytest.mark.parametrize("overwrite", [False, True])
def test_many_writers_of_one_name_leave_one_whole_file(tmp_path, overwrite):
    """Eight at once, 100 kB each: the content is that of one; without leave to, of the first."""
    path = tmp_path / "out"
    refused = []

    def write(letter: bytes) -> None:
        try:
            with whole_file(path, overwrite=overwrite) as stream:
                for _ in range(100):
                    stream.write(letter * 1000)
        except RefineError as error:
            refused.append(str(error))

    writers = [threading.Thread(target=write, args=(bytes([65 + i]),)) for i in range(8)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()

    content = path.read_bytes()
    assert content[:1] * 100_000 == content
    assert list(contents(tmp_path)) == ["out"]
    assert (0 if overwrite else 7) == len(refused)


@pytest.mark.slow
@posix
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # of fork, with threads
@pytest.mark.parametrize("exists", [False, True])
def test_killed_at_any_moment_the_old_file_or_the_new_one_is_there_whole(tmp_path, exists):
    """Forty writers of 56 kB, killed after 0 to 4 ms; a writer needs about 2."""
    path, source = tmp_path / "out.ply", tmp_path / "in.ply"
    new = plain_ply(1000)
    source.write_bytes(new)
    file = read_ply(source)
    random = np.random.default_rng(0)
    seen = set()
    for delay in random.uniform(0.0, 0.004, 40):
        if exists:
            path.write_bytes(b"old")
        else:
            path.unlink(missing_ok=True)
        child = forked(lambda: file.write(path, overwrite=exists))
        threading.Event().wait(delay)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)

        content = path.read_bytes() if path.exists() else None
        assert content in (new, b"old" if exists else None)
        seen.add(content)

    assert new == source.read_bytes()
    names = {name for name in contents(tmp_path) if not name.startswith(".refine-")}
    assert names <= {"in.ply", "out.ply"}
    assert seen  # which of the two came about is the clock's business


def forked(work) -> int:
    """Run `work` in a forked process that ends with it; return its id."""
    child = os.fork()
    if child:
        return child
    try:
        work()
    finally:
        os._exit(0)


def test_a_file_whose_writing_was_cancelled_is_not_put_in_place(tmp_path):
    """It is asked once more when all is written; the old file stays, and no temporary one."""
    path = tmp_path / "out.bin"
    path.write_bytes(b"old")

    def check():
        raise Cancelled

    with pytest.raises(Cancelled), checked_by(check), whole_file(path, overwrite=True) as stream:
        stream.write(b"new")

    assert contents(tmp_path) == {"out.bin": b"old"}


def test_a_link_into_a_folder_that_is_not_there_is_refused_before_the_work(tmp_path):
    link = tmp_path / "out.ply"
    link.symlink_to(tmp_path / "no/out.ply")

    with pytest.raises(RefineError, match=r"out\.ply: cannot be written, there is no folder .*no"):
        whole_files.refuse_existing(link, overwrite=True)
