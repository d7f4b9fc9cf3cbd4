"""Where tiles lie: on disks that this machine sees, or behind URLs, which fsspec opens.

All functions raise `RefineError` where a file cannot be looked for, read or written; behind a URL
`Interrupted`, since that may pass.
"""

from __future__ import annotations

import contextlib
import secrets
from collections.abc import Hashable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import whole_file
from ..errors import RefineError
from ..urls import Url, is_url
from ..whole_file import expanded
from .folder import Interrupted

_FLEETING = ("url", "access")
"""Parts of the names of facts about a file that change though it does not: where a server sends
whoever asks for it, and when it was read."""

_LOCAL = "file://"
_NO_SUCH = "there is no such file"


def located(path: Path | str) -> Path | Url:
    """Return a URL, or a path with ``~`` replaced; raise `RefineError` if there is no such user."""
    return Url(path) if is_url(path) else expanded(path)


def identity(path: Path | Url) -> str:
    """Return a name of a file that is the same however the file is named."""
    if isinstance(path, Url):
        with _opened(path, "cannot be looked for") as (system, inner):
            name: str = system.unstrip_protocol(inner)
        if not name.startswith(_LOCAL):
            return name
        path = Path(name.removeprefix(_LOCAL))
    return f"{_LOCAL}{path.resolve()}"


def file_key(path: Path | Url) -> Hashable:
    """Return what is the same for all names of a file that exists, hard links included."""
    name = identity(path)
    if not name.startswith(_LOCAL):
        return name
    with _explained(path, "cannot be read"):
        status = Path(name.removeprefix(_LOCAL)).stat()
    return (status.st_dev, status.st_ino) if status.st_ino else name


def state(path: Path | Url) -> tuple[int, int | str]:
    """Return the bytes of a file and what changes with its content: a time in ns, or facts."""
    if not isinstance(path, Url):
        with _explained(path, "cannot be read"):
            status = path.stat()
            return status.st_size, status.st_mtime_ns
    with _opened(path, "cannot be read") as (system, inner):
        facts = system.info(inner)
        if facts.get("type") == "directory":
            raise RefineError(f"{path}: is a folder, expected a PLY file")
        if facts.get("size") is None:
            raise RefineError(f"{path}: the server does not say how long it is, which a tile needs")
        lasting = {
            name: str(fact)
            for name, fact in facts.items()
            if not any(word in name.lower() for word in _FLEETING)
        }
        return int(facts["size"]), repr(sorted(lasting.items()))


def beginning(url: Url, size: int, whole: int) -> bytes:
    """Return the first `size` bytes of a file of `whole` bytes, or all.

    A file that can only be read from its beginning is refused: `array` would be sent all of it.
    """
    with (
        _opened(url, "cannot be read") as (system, inner),
        system.open(inner, "rb", cache_type="none") as stream,
    ):
        start: bytes = stream.read(size)
        stream.seek(max(whole - 1, 0))
        stream.read(1)
        return start


def array(path: Path | Url, dtype: np.dtype[Any], count: int, begin: int) -> NDArray[Any]:
    """Read an array, and nothing else of the file; it is shorter where the file ends.

    Parameters
    ----------
    path : Path or Url
    dtype : dtype
    count : int
        How many elements.
    begin : int
        Bytes before the first.
    """
    if not isinstance(path, Url):
        with _explained(path, "cannot be read"):
            return np.fromfile(path, dtype, count, offset=begin)
    if not count:
        return np.empty(0, dtype)
    with _opened(path, "cannot be read") as (system, inner):
        # By name: storages have other arguments between these.
        sent = system.cat_file(inner, start=begin, end=begin + count * dtype.itemsize)
        return np.frombuffer(sent, dtype, len(sent) // dtype.itemsize)


@contextlib.contextmanager
def new_folder(folder: Path | Url) -> Iterator[None]:
    """Make a folder, if it is not there; remove it if it is empty at the end.

    Behind a URL an empty file is written there, moved and removed, so that a storage that does not
    let us is known before long work starts.
    """
    if not isinstance(folder, Url):
        with whole_file.new_folder(folder):
            yield
        return
    with _opened(folder, "cannot be written to") as (system, inner):
        system.makedirs(inner, exist_ok=True)
        name = f".refine-{secrets.token_hex(8)}"
        here, there = (_split(folder / f"{name}-{end}")[1] for end in "ab")
        system.pipe_file(here, b"")
        system.mv(here, there)
        system.rm_file(there)
    yield


def refuse_existing(path: Path | Url, *, overwrite: bool) -> None:
    """Do what `whole_file.refuse_existing` does, for URLs too."""
    if not isinstance(path, Url):
        whole_file.refuse_existing(path, overwrite=overwrite)
        return
    with _opened(path, "cannot be written") as (system, inner):
        if system.isdir(inner):
            raise RefineError(f"{path}: is a folder, expected a file name to write to")
        if not overwrite and system.exists(inner):
            raise RefineError(
                f"{path}: exists already; choose another name or overwrite it (--overwrite)"
            )


def upload(made: Path, url: Url) -> None:
    """Copy a file to a URL, unless one of that size is there."""
    with _opened(url, "cannot be written") as (system, inner):
        if not system.exists(inner) or system.size(inner) != made.stat().st_size:
            system.put_file(str(made), inner)


def publish(made: Path | Url, path: Path | Url, *, overwrite: bool) -> None:
    """Rename a finished file in the same storage, as `whole_file.publish` does.

    A file of that name that may not be replaced is refused.
    """
    if isinstance(made, Path) and isinstance(path, Path):
        whole_file.publish(made, path, overwrite=overwrite)
        return
    assert isinstance(path, Url)
    refuse_existing(path, overwrite=overwrite)
    with _opened(path, "cannot be written") as (system, inner):
        system.mv(_split(Url(made))[1], inner)


def size_of(path: Path | Url) -> int | None:
    """Return the bytes of a file; None if there is none."""
    if not isinstance(path, Url):
        return path.stat().st_size if path.is_file() else None
    with _opened(path, "cannot be looked for") as (system, inner):
        return int(system.size(inner)) if system.isfile(inner) else None


def discard(url: Url) -> None:
    """Remove a file if it is there."""
    with contextlib.suppress(RefineError), _opened(url, "") as (system, inner):
        system.rm_file(inner)


@contextlib.contextmanager
def _opened(url: Url, problem: str) -> Iterator[tuple[Any, str]]:
    """Yield the file system of a URL, as it is now, and the path there; see `_explained`."""
    with _explained(url, problem):
        system, inner = _split(url)
        system.invalidate_cache()
        yield system, inner


def _split(url: Url) -> tuple[Any, str]:
    """Return the file system of a URL, and the path there."""
    try:
        from fsspec.core import url_to_fs
    except ImportError as error:
        raise RefineError(
            f"{url}: URLs need fsspec: pip install 'refine-addon[distributed]'"
        ) from error
    system, inner = url_to_fs(url)
    return system, inner


@contextlib.contextmanager
def _explained(path: Path | Url, problem: str) -> Iterator[None]:
    """Raise `RefineError` for whatever the storage raises; for a URL `Interrupted`: it may pass."""
    try:
        yield
    except (RefineError, MemoryError):
        raise
    except Exception as error:  # each storage has errors of its own
        missing = isinstance(error, FileNotFoundError)
        said = getattr(error, "strerror", None) or (_NO_SUCH if missing else str(error))
        raise (
            Interrupted
            if isinstance(path, Url)
            else RefineError(f"{path}: {problem} ({said or type(error).__name__})")
        ) from error
