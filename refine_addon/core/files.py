"""Files that are either written whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
from typing import TYPE_CHECKING, BinaryIO

from .errors import RefineError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def refuse_existing(path: Path, *, overwrite: bool) -> None:
    """Raise `RefineError` where writing `path` would lose a file, or could not work at all.

    Called before the long work starts, so that a mistyped output costs nothing.
    """
    if path.is_dir():
        msg = f"{path}: is a folder, expected a file name to write to"
        raise RefineError(msg)
    if path.exists() and not overwrite:
        msg = f"{path}: exists already; choose another name or ask to overwrite it"
        raise RefineError(msg)
    if not path.parent.is_dir():
        msg = f"{path}: cannot be written, there is no folder {path.parent}"
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
    target = path.resolve()
    temporary = target.with_name(f".{target.name[:100]}.{secrets.token_hex(6)}.tmp")
    try:
        # Not tempfile: its files are readable by their owner alone, and the name would keep that.
        with temporary.open("xb") as stream:
            yield stream
        if overwrite:
            if target.exists():
                temporary.chmod(target.stat().st_mode & 0o7777)
            temporary.replace(target)
        else:
            _publish_new(temporary, target)
    except OSError as error:
        raise RefineError(_explain(path, error)) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _publish_new(temporary: Path, target: Path) -> None:
    """Give `temporary` the name `target`, atomically refusing a name taken in the meantime."""
    try:
        os.link(temporary, target)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links: the check and the rename are two steps
        if target.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)) from None
        temporary.replace(target)


def _explain(path: Path, error: OSError) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"{path}: no space left on the disk; nothing was written"
    if isinstance(error, FileExistsError):
        return f"{path}: was made by somebody else in the meantime; nothing was written"
    reason = error.strerror or type(error).__name__
    return f"{path}: cannot be written ({reason}); nothing was changed"
