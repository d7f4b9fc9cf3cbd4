"""Files that are either written whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import platform
import re
import secrets
import stat
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from .errors import RefineError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

REPLACES_MAPPED = os.name != "nt"
"""Whether the system lets go of a file's name while a program still maps it; Windows does not."""


def expanded(path: Path | str) -> Path:
    """Return `path` with ``~`` replaced by the home folder.

    Raises
    ------
    RefineError
        If there is no such user.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        msg = f"{path}: cannot be found ({error})"
        raise RefineError(msg) from error


def refuse_existing(path: Path, *, overwrite: bool) -> None:
    """Raise `RefineError` where writing `path` would lose a file, or could not work at all.

    Called before the long work starts, so that a mistyped output costs nothing.
    """
    try:
        mode, folder = mode_of(path), mode_of(path.parent)
    except (OSError, ValueError) as error:  # a name too long, a folder that may not be looked into
        raise RefineError(_explain(path, error)) from error
    if stat.S_ISDIR(mode):
        msg = f"{path}: is a folder, expected a file name to write to"
        raise RefineError(msg)
    if mode and not stat.S_ISREG(mode):
        msg = f"{path}: is a device, expected the name of a file"
        raise RefineError(msg)
    if mode and not overwrite:
        msg = f"{path}: exists already; choose another name or overwrite it (--overwrite)"
        raise RefineError(msg)
    if not stat.S_ISDIR(folder):
        msg = f"{path}: cannot be written, there is no folder {path.parent}"
        raise RefineError(msg)


def mode_of(path: Path) -> int:
    """Return what `path` is and who may use it, as `stat` says it; 0 where there is nothing.

    Raises
    ------
    OSError, ValueError
        If the system cannot tell: a name too long, a folder that may not be looked into. Unlike
        pathlib, which some versions of Python let take that for "nothing".
    """
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return 0


def refuse_mapped(path: Path, source: Path) -> None:
    """Raise `RefineError` where `path` is the mapped file `source` and cannot be replaced."""
    if REPLACES_MAPPED:
        return
    with contextlib.suppress(OSError, ValueError):
        if path.samefile(source):
            msg = (
                f"{path}: is the file being read, which this system cannot replace; "
                "write to another name"
            )
            raise RefineError(msg)


@contextlib.contextmanager
def whole_file(path: Path, *, overwrite: bool) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path` that takes its name once the block ends well.

    Whatever interrupts the block (an error, a kill, a full disk), `path` is what it was before. A
    symbolic link is followed: the file it points to is replaced, the link stays.

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
    """
    refuse_existing(path, overwrite=overwrite)
    try:
        target = path.resolve()
    except (OSError, RuntimeError) as error:  # links in a circle
        raise RefineError(_explain(path, error)) from error
    _remove_abandoned(target)
    try:
        with contextlib.ExitStack() as held:
            temporary, mode, stream = _new_temporary(target, held)
            with stream:
                yield stream
            replaced = mode_of(target)
            mode = stat.S_IMODE(replaced) if replaced else mode
            if stat.S_IMODE(mode_of(temporary)) != mode:
                temporary.chmod(mode)
            if overwrite:
                temporary.replace(target)
            else:
                _publish_new(temporary, target)
    except OSError as error:
        raise RefineError(_explain(path, error)) from error


def _prefix(target: Path) -> str:
    """Return what the names of a target's temporary files begin with on this machine.

    Not the target's own name, which may be as long as a name can be. With the machine's, because
    locks of other machines are not always seen.
    """
    owner = platform.node().encode() + b"\0" + os.fsencode(target.name)
    return f".refine-{hashlib.blake2b(owner, digest_size=8).hexdigest()}-"


def _new_temporary(target: Path, held: contextlib.ExitStack) -> tuple[Path, int, BinaryIO]:
    """Make a file beside `target` that nobody else may read, and which goes when `held` ends.

    It is locked until then, or until this process dies.

    Returns
    -------
    path : Path
    mode : int
        The permissions that a new file has, as the user wants them.
    stream : binary file, open for writing
    """
    while True:
        temporary = target.with_name(f"{_prefix(target)}{secrets.token_hex(8)}.tmp")
        # Ahead of the file itself, so that whatever interrupts from here on, none is left.
        held.callback(_discard, temporary)
        # What replaces a secret is one from the start. Otherwise the system applies the user's
        # mask, which nobody can ask for without setting it, and the file is empty until it is safe.
        opener = _opener(0o600 if mode_of(target) else 0o666)
        stream = held.enter_context(open(temporary, "xb", opener=opener))  # noqa: SIM115
        mode = stat.S_IMODE(os.fstat(stream.fileno()).st_mode)
        with contextlib.suppress(OSError):  # a drive without permissions
            temporary.chmod(0o600)
        if fcntl is None:
            return temporary, mode, stream
        # A second descriptor: the file is closed, which may fail, before it gets its name.
        lock = os.dup(stream.fileno())
        held.callback(os.close, lock)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            taken = not os.fstat(lock).st_nlink
        except BlockingIOError:
            taken = True  # by another run, which sees a file without an owner
        except OSError:
            taken = False  # no locks on this file system: nobody removes anything here
        if not taken:
            return temporary, mode, stream


def _opener(mode: int) -> Callable[[str, int], int]:
    """Return what `open` asks for a file that it makes, with these permissions at most."""
    return lambda name, flags: os.open(name, flags, mode)


def _discard(temporary: Path) -> None:
    """Remove a file if it is there."""
    with contextlib.suppress(OSError):
        temporary.unlink(missing_ok=True)


def _remove_abandoned(target: Path) -> None:
    """Remove what killed runs on this machine left of this target: files that nobody locks."""
    if fcntl is None:
        return
    ours = re.compile(re.escape(_prefix(target)) + r"[0-9a-f]{16}\.tmp")
    with contextlib.suppress(OSError), os.scandir(target.parent) as entries:
        for name in [entry.name for entry in entries if ours.fullmatch(entry.name)]:
            with contextlib.suppress(OSError):
                _remove_unlocked(target.with_name(name))


def _remove_unlocked(temporary: Path) -> None:
    descriptor = os.open(temporary, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            temporary.unlink()
    finally:
        os.close(descriptor)


def _publish_new(temporary: Path, target: Path) -> None:
    """Give `temporary` the name `target`, atomically refusing a name taken in the meantime."""
    try:
        os.link(temporary, target)
    except FileExistsError:
        raise
    except OSError:
        # No hard links here: two steps, the second of which refuses by itself on Windows.
        if target.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)) from None
        temporary.rename(target)


def _explain(path: Path, error: Exception) -> str:
    number = getattr(error, "errno", None)
    if number in (errno.ENOSPC, errno.EDQUOT):
        return f"{path}: no space left on the disk; nothing was changed"
    if isinstance(error, FileExistsError):
        return f"{path}: was made by somebody else in the meantime; it was left as it is"
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return f"{path}: cannot be written ({reason}); nothing was changed"
