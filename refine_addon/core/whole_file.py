"""Files that are written completely or not at all."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import itertools
import os
import platform
import re
import secrets
import stat
from pathlib import Path
from typing import BinaryIO

from .errors import RefineError, reason_of
from .execute import REPLACES_MAPPED, checkpoint
from .urls import refuse_url

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

from collections.abc import Callable, Iterable, Iterator


def expanded(path: Path | str) -> Path:
    """Return `path` with ``~`` replaced by the home folder.

    Raises
    ------
    RefineError
        If there is no such user, or it is a URL.
    """
    refuse_url(path)
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise RefineError(f"{path}: cannot be found ({error})") from error


def refuse_existing(path: Path, *, overwrite: bool) -> None:
    """Raise `RefineError` if writing `path` would replace a file, or could not work at all.

    Call it before long work starts, so that a mistyped output is noticed at once.
    """
    try:
        behind = Path(os.path.realpath(path)).parent  # of a link, where it leads
        mode, folder = mode_of(path), mode_of(behind)
    except (OSError, ValueError) as error:  # a name too long, a folder that may not be entered
        raise RefineError(_explain(path, error)) from error
    if stat.S_ISDIR(mode):
        raise RefineError(f"{path}: is a folder, expected a file name to write to")
    if mode and not stat.S_ISREG(mode):
        raise RefineError(f"{path}: is a device, expected the name of a file")
    if mode and not overwrite:
        raise RefineError(
            f"{path}: exists already; choose another name or overwrite it (--overwrite)"
        )
    if not stat.S_ISDIR(folder):
        missing = path.parent if mode_of(path.parent) == 0 else behind
        raise RefineError(f"{path}: cannot be written, there is no folder {missing}")


def refuse_one_file(paths: Iterable[Path]) -> None:
    """Raise `RefineError` if two of some outputs lead to one file, by links."""
    first: dict[str, Path] = {}
    for path in paths:
        other = first.setdefault(os.path.realpath(path), path)
        if other is not path:
            raise RefineError(f"{path}: is the same file as {other}, by a link; remove the link")


def mode_of(path: Path) -> int:
    """Return the type and permissions of `path`, as ``st_mode``; 0 if it does not exist.

    Raises
    ------
    OSError, ValueError
        If the system cannot tell: a name too long, a folder that may not be entered. (In some
        versions of Python, pathlib says then that the file does not exist.)
    """
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return 0


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[None]:
    """Make a folder and those above it; remove those that were not there and are empty at the end.

    Raises
    ------
    RefineError
        If it cannot be made; nothing is left then.
    """
    made: list[Path] = []
    try:
        try:
            made += itertools.takewhile(lambda folder: not mode_of(folder), (path, *path.parents))
            path.mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            raise RefineError(
                f"{path}: cannot be made ({getattr(error, 'strerror', None) or error})"
            ) from error
        yield
    finally:
        for folder in made:
            with contextlib.suppress(OSError):  # it holds something
                folder.rmdir()


def refuse_mapped(path: Path, source: Path) -> None:
    """Raise `RefineError` if `path` is the mapped file `source`, which cannot be replaced."""
    if REPLACES_MAPPED:
        return
    with contextlib.suppress(OSError, ValueError):
        if path.samefile(source):
            raise RefineError(
                f"{path}: is the file being read, which this system cannot replace; "
                "write to another name"
            )


@contextlib.contextmanager
def whole_file(path: Path, *, overwrite: bool) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path`, which is renamed to `path` when the block ends.

    If the block is interrupted (by an error, a kill, a full disk), `path` stays as it was. If it is
    a symbolic link, the file that it points to is replaced.

    Parameters
    ----------
    path : Path
        The file to make.
    overwrite : bool
        Whether a file of that name may be replaced.

    Yields
    ------
    binary file, open for writing

    Raises
    ------
    RefineError
        If the file exists and may not be replaced, or the system cannot write it.
    Cancelled
        See `execute.checkpoint`; the file stays as it was.
    """
    refuse_existing(path, overwrite=overwrite)
    try:
        target = path.resolve()
    except (OSError, RuntimeError) as error:  # such as a circle of links
        raise RefineError(_explain(path, error)) from error
    _remove_abandoned(target)
    try:
        with contextlib.ExitStack() as cleanup:
            temporary, mode, stream = _new_temporary(target, cleanup)
            with stream:
                yield stream
                stream.flush()  # before the permissions: a write would take setuid away
                mode = _inherited(target, stream.fileno(), mode)
                if stat.S_IMODE(os.fstat(stream.fileno()).st_mode) != mode:
                    # By descriptor: the owner of the folder may have put a link of that name there.
                    named = stream.fileno() if os.chmod in os.supports_fd else temporary
                    os.chmod(named, mode)
            checkpoint()  # cancelled while the file was written: leave none
            if overwrite:
                temporary.replace(target)
            else:
                _publish_new(temporary, target)
    except OSError as error:
        raise RefineError(_explain(path, error)) from error


def publish(finished: Path, path: Path, *, overwrite: bool) -> None:
    """Rename a finished file on the same disk to `path`, as `whole_file` does with its own.

    Raises
    ------
    RefineError
        See `whole_file`.
    """
    refuse_existing(path, overwrite=overwrite)
    try:
        target = path.resolve()
        if not overwrite:
            _publish_new(finished, target)
            finished.unlink(missing_ok=True)  # which may be a second name now
            return
        with finished.open("rb+") as stream:
            mode = _inherited(
                target, stream.fileno(), stat.S_IMODE(os.fstat(stream.fileno()).st_mode)
            )
            finished.chmod(mode)
        finished.replace(target)
    except (OSError, RuntimeError) as error:
        raise RefineError(_explain(path, error)) from error


def _prefix(target: Path) -> str:
    """Return the start of the names of a target's temporary files on this machine.

    It is a hash, since the target's own name may be as long as names can be. The machine's name is
    in it because locks of other machines are not always visible.
    """
    owner = platform.node().encode() + b"\0" + os.fsencode(target.name)
    return f".refine-{hashlib.blake2b(owner, digest_size=8).hexdigest()}-"


def _new_temporary(target: Path, cleanup: contextlib.ExitStack) -> tuple[Path, int, BinaryIO]:
    """Create a file beside `target` that only its owner may read.

    When `cleanup` is closed, the file is removed. It is locked until then, or until this process
    dies. Return its path, the permissions that the user wants new files to have, and a binary
    stream that writes it.
    """
    while True:
        temporary = target.with_name(f"{_prefix(target)}{secrets.token_hex(8)}.tmp")
        # Before the file exists, so that no interruption from here on can leave it behind.
        cleanup.callback(_discard, temporary)
        # A file that replaces another is private from the start. A new one is created with the
        # user's permissions, which cannot be read otherwise, and made private while it is empty.
        opener = _opener(0o600 if mode_of(target) else 0o666)
        stream = cleanup.enter_context(open(temporary, "xb", opener=opener))  # noqa: SIM115
        mode = stat.S_IMODE(os.fstat(stream.fileno()).st_mode)
        with contextlib.suppress(OSError):  # a drive without permissions
            temporary.chmod(0o600)
        if fcntl is None:
            return temporary, mode, stream
        # A second descriptor keeps the lock when the file is closed, before it is renamed.
        lock = os.dup(stream.fileno())
        cleanup.callback(os.close, lock)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            taken = not os.fstat(lock).st_nlink
        except BlockingIOError:
            taken = True  # another run locked it between these two lines, to remove it
        except OSError:
            taken = False  # this file system has no locks, so no run removes files here
        if not taken:
            return temporary, mode, stream


def _inherited(target: Path, descriptor: int, mode: int) -> int:
    """Give an open file the owner and group of `target`, as far as this process may.

    Return the permissions that the file is to have: those of `target`, without setuid and setgid
    where it could not be given; `mode` if there is no such file.
    """
    try:
        old = target.stat()
    except (FileNotFoundError, NotADirectoryError):
        return mode
    owner, permissions = (old.st_uid, old.st_gid), stat.S_IMODE(old.st_mode)
    if fcntl is None or owner == _owner(descriptor):
        return permissions
    for user in (old.st_uid, -1):  # -1: the group alone
        with contextlib.suppress(OSError):
            os.fchown(descriptor, user, old.st_gid)
            break
    if owner == _owner(descriptor):
        return permissions
    return permissions & ~(stat.S_ISUID | stat.S_ISGID)


def _owner(descriptor: int) -> tuple[int, int]:
    """Return the user and the group that own an open file."""
    status = os.fstat(descriptor)
    return status.st_uid, status.st_gid


def _opener(mode: int) -> Callable[[str, int], int]:
    """Return an opener for `open` that creates files with at most these permissions."""
    return lambda name, flags: os.open(name, flags, mode)


def _discard(temporary: Path) -> None:
    """Remove a file if it is there."""
    with contextlib.suppress(OSError):
        temporary.unlink(missing_ok=True)


def _remove_abandoned(target: Path) -> None:
    """Remove unlocked temporary files of this target: killed runs on this machine left them."""
    if fcntl is None:
        return
    ours = re.compile(re.escape(_prefix(target)) + r"[0-9a-f]{16}\.tmp")
    with contextlib.suppress(OSError), os.scandir(target.parent) as entries:
        for name in [entry.name for entry in entries if ours.fullmatch(entry.name)]:
            with contextlib.suppress(OSError):
                _remove_unlocked(target.with_name(name))


def _remove_unlocked(temporary: Path) -> None:
    """Remove a regular file; raise `OSError` if another process has locked it."""
    descriptor = os.open(temporary, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            temporary.unlink()
    finally:
        os.close(descriptor)


def _publish_new(temporary: Path, target: Path) -> None:
    """Rename `temporary` to `target`; raise `FileExistsError` if that exists by now."""
    try:
        os.link(temporary, target)
    except FileExistsError:
        raise
    except OSError:
        # This file system has no hard links. On Windows, rename itself refuses an existing file.
        if target.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)) from None
        temporary.rename(target)


def _explain(path: Path, error: Exception) -> str:
    """Return the message for an error of the system."""
    number = getattr(error, "errno", None)
    if number in (errno.ENOSPC, errno.EDQUOT):
        return f"{path}: no space left on the disk; nothing was changed"
    if isinstance(error, FileExistsError):
        return f"{path}: another program created this file in the meantime; it was left as it is"
    return f"{path}: cannot be written ({reason_of(error)}); nothing was changed"
