"""Files that are written completely or not at all, and URLs of tiles, which fsspec opens."""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import re
import secrets
import stat
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from .errors import RefineError, reason_of
from .execute import REPLACES_MAPPED, Item, checkpoint

ABANDONED = 86_400.0  # seconds after which a temporary file is deleted: a killed run left it

_UNWRITTEN, _UNCHANGED = "cannot be written", "; nothing was changed"
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.:-]+://")
"""Scheme of a URL: two letters at least, since one would be a drive of Windows."""


class Url(str):
    """Address of a file or folder, such as ``s3://bucket/a.ply``, with attributes of `Path`."""

    __slots__ = ()

    @property
    def name(self) -> str:
        """Part after the last slash, for ``http`` and ``https`` without a query."""
        whole = self.partition("?")[0] if self.startswith("http") else self
        return whole.rpartition("/")[2]

    @property
    def suffix(self) -> str:
        """Ending of the name, with its dot; "" if it has none."""
        return PurePosixPath(self.name).suffix

    def __truediv__(self, name: str) -> Url:
        return Url(f"{self}{'' if self.endswith('/') else '/'}{name}")


def is_url(text: Path | str) -> bool:
    """Whether this is a URL and no path."""
    return isinstance(text, str) and _URL.match(text) is not None


def refuse_url(text: Path | str) -> None:
    """Raise `RefineError` if this is a URL, where only a path is accepted."""
    if is_url(text):
        raise RefineError(
            f"{text}: is a URL, expected a local path; only the tiles and the folder of "
            "'prune --together' can be URLs"
        )


def expanded(path: Path | str) -> Path:
    """Path with ``~`` replaced by the home folder; `RefineError` without one, or for a URL."""
    refuse_url(path)
    with explained(path, "cannot be found", errors=RuntimeError):
        return Path(path).expanduser()


def mode_of(path: Path) -> int:
    """``st_mode`` of `path`, 0 if it is missing; unlike in `pathlib`, other errors are raised."""
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):
        return path.stat().st_mode
    return 0


def refuse_existing(path: Path, *, overwrite: bool) -> None:
    """Raise `RefineError` early if writing `path` would replace a file, or could not work."""
    # A name too long, a folder that may not be entered.
    with explained(path, _UNWRITTEN, errors=(OSError, ValueError), end=_UNCHANGED):
        behind = Path(os.path.realpath(path)).parent  # of a link, where it leads
        mode, folder, above = mode_of(path), mode_of(behind), mode_of(path.parent)
    if stat.S_ISDIR(mode):
        raise RefineError(f"{path}: is a folder, expected a file name to write to")
    if mode and not stat.S_ISREG(mode):
        raise RefineError(f"{path}: is a device, expected the name of a file")
    if mode and not overwrite:
        raise RefineError(f"{path}: exists already; choose another name, or set overwrite")
    if not stat.S_ISDIR(folder):
        missing = behind if above else path.parent
        raise RefineError(f"{path}: cannot be written, there is no folder {missing}")


def alike(items: Iterable[Item], key: Callable[[Item], str]) -> Iterator[tuple[Item, Item]]:
    """Yield each item whose key an earlier one has, behind the first of these."""
    first: dict[str, Item] = {}
    for item in items:
        other = first.setdefault(key(item), item)
        if other is not item:
            yield other, item


def refuse_one_file(paths: Iterable[Path]) -> None:
    """Raise `RefineError` if two of the outputs are one file by links."""
    for other, path in alike(paths, os.path.realpath):
        raise RefineError(f"{path}: is the same file as {other}, by a link; remove the link")


def refuse_mapped(path: Path, source: Path) -> None:
    """Raise `RefineError` if `path` is the mapped file `source`, which cannot be replaced."""
    with contextlib.suppress(OSError, ValueError):
        if not REPLACES_MAPPED and path.samefile(source):
            problem = "is the file being read, which this system cannot replace"
            raise RefineError(f"{path}: {problem}; write to another name")


@contextlib.contextmanager
def explained(
    path: Path | str, problem: str, kind: Any = RefineError, *, errors: Any = OSError, end: str = ""
) -> Iterator[None]:
    """Raise an error of a `kind`, a `RefineError`, with the reason in place of the system's."""
    try:
        yield
    except errors as error:
        full = getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)
        why = "no space left on the disk" if full else f"{problem} ({reason_of(error)})"
        raise kind(f"{path}: {why}{end}") from error


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[None]:
    """Make a folder and its parents; after the block, new ones that are empty are deleted."""
    new: list[Path] = []
    try:
        with explained(path, "cannot be made", errors=(OSError, ValueError)):
            new += itertools.takewhile(lambda folder: not mode_of(folder), (path, *path.parents))
            path.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for folder in new:
            with contextlib.suppress(OSError):  # it holds something
                folder.rmdir()


@contextlib.contextmanager
def whole_file(path: Path, *, overwrite: bool) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path`, which is renamed to `path` when the block ends.

    If the block is interrupted (error, kill, full disk), `path` stays as it was. If it is a
    symbolic link, its target is replaced. Other users cannot read the file until it is whole; then
    it gets the permissions of the file that it replaces. `RefineError` if `path` exists and is not
    to be replaced, or the system refuses.
    """
    refuse_existing(path, overwrite=overwrite)
    target = Path(os.path.realpath(path))
    for left in target.parent.glob(".refine-*.tmp"):
        with contextlib.suppress(OSError):  # another process may remove it meanwhile
            if left.lstat().st_mtime < time.time() - ABANDONED:
                left.unlink()
    temporary = target.with_name(f".refine-{secrets.token_hex(8)}.tmp")
    with explained(path, _UNWRITTEN, end=_UNCHANGED):
        try:
            old = mode_of(target)
            # A new file gets the permissions that the user wants; it is made private while empty.
            first = 0o600 if old else 0o666
            with open(temporary, "xb", opener=lambda name, how: os.open(name, how, first)) as file:
                mode = (old or os.fstat(file.fileno()).st_mode) & 0o777
                with contextlib.suppress(OSError):  # a drive without permissions
                    temporary.chmod(0o600)
                yield file
                if os.fstat(file.fileno()).st_mode & 0o777 != mode:
                    # By descriptor: the folder's owner may have put a link of that name there.
                    os.chmod(file.fileno() if os.chmod in os.supports_fd else temporary, mode)
            checkpoint()  # cancelled while the file was written: leave none
            _rename(temporary, target, path, overwrite)
        finally:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)


def publish(finished: Path, path: Path, *, overwrite: bool) -> None:
    """Rename a finished file to `path` on the same disk, with the rules of `whole_file`."""
    refuse_existing(path, overwrite=overwrite)
    with explained(path, _UNWRITTEN, end=_UNCHANGED):
        target = Path(os.path.realpath(path))
        if mode := mode_of(target):
            finished.chmod(mode & 0o777)
        _rename(finished, target, path, overwrite)
        finished.unlink(missing_ok=True)  # after a hard link it is a second name of the file


def _rename(finished: Path, target: Path, path: Path, overwrite: bool) -> None:
    """Rename a file; without `overwrite`, `RefineError`, with `path`, if the target exists."""
    if overwrite:
        finished.replace(target)
        return
    try:
        os.link(finished, target)
    except OSError as error:
        if target.exists():
            problem = "another program created this file in the meantime; it was left as it is"
            raise RefineError(f"{path}: {problem}") from error
        finished.rename(target)  # this file system has no hard links
