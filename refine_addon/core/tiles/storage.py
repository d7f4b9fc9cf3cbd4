"""Files of tiles: on disks of this machine, or behind URLs, which fsspec opens.

All functions raise `RefineError` if a file cannot be looked for, read or written. For a URL it is
`Interrupted`, since the storage may answer later.
"""

from __future__ import annotations

import contextlib
import re
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import whole_file
from ..errors import RefineError, reason_of
from ..mapped import Interrupted, status_of
from ..whole_file import Url, expanded, explained, is_url

_FLEETING = re.compile("url|access", re.IGNORECASE)
"""Parts of names of entries that change though the file does not, such as times of access."""

_LOCAL = "file://"


def located(path: Path | str) -> Path | Url:
    """The URL, or the path with ``~`` replaced by the home folder."""
    return Url(path) if is_url(path) else expanded(path)


def identity(path: Path | Url) -> str:
    """Absolute URL of a file or folder, the same for all its names but hard links."""
    if isinstance(path, Url):
        with _opened(path, "cannot be looked for") as (system, inner):
            name: str = system.unstrip_protocol(inner)
        if not name.startswith(_LOCAL):
            return name
        path = Path(name.removeprefix(_LOCAL))
    return f"{_LOCAL}{path.resolve()}"


def state(path: Path | Url) -> tuple[int, int | str]:
    """Bytes of a file, and what changes with its content: a time in ns, or a storage's entries."""
    if not isinstance(path, Url):
        status = status_of(path)
        return status.st_size, status.st_mtime_ns
    with _opened(path, "cannot be read") as (system, inner):
        info = system.info(inner)
        if info.get("type") == "directory":
            raise RefineError(f"{path}: is a folder, expected a PLY file")
        if info.get("size") is None:
            raise RefineError(f"{path}: the server does not say how long it is, which a tile needs")
        lasting = {name: str(value) for name, value in info.items() if not _FLEETING.search(name)}
        return int(info["size"]), repr(sorted(lasting.items()))


def beginning(path: Path | Url, size: int, whole: int) -> bytes:
    """First `size` bytes of a file of `whole` bytes.

    The last byte behind a URL is read, too, which fails where `array` would download the file.
    """
    if not isinstance(path, Url):
        return array(path, np.dtype(np.uint8), size, 0).tobytes()
    with (
        _opened(path, "cannot be read") as (system, inner),
        system.open(inner, "rb", cache_type="none") as stream,
    ):
        start: bytes = stream.read(size)
        stream.seek(max(whole - 1, 0))
        stream.read(1)
        return start


def array(path: Path | Url, dtype: np.dtype[Any], count: int, begin: int) -> NDArray[Any]:
    """`count` elements from byte `begin` on, fewer if the file ends; nothing else is read."""
    if not isinstance(path, Url):
        with explained(path, "cannot be read"):
            return np.fromfile(path, dtype, count, offset=begin)
    if not count:
        return np.empty(0, dtype)
    with _opened(path, "cannot be read") as (system, inner):
        # By name: storages have other arguments between these.
        sent = system.cat_file(inner, start=begin, end=begin + count * dtype.itemsize)
        return np.frombuffer(sent, dtype, len(sent) // dtype.itemsize)


@contextlib.contextmanager
def new_folder(folder: Path | Url) -> Iterator[None]:
    """Make a folder if it is missing; remove it after the block if it is empty.

    Behind a URL an empty file is written, moved and removed, to fail before long work.
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
    """`whole_file.refuse_existing`, for URLs too."""
    if not isinstance(path, Url):
        whole_file.refuse_existing(path, overwrite=overwrite)
        return
    with _opened(path, "cannot be written") as (system, inner):
        if system.isdir(inner):
            raise RefineError(f"{path}: is a folder, expected a file name to write to")
        if not overwrite and system.exists(inner):
            raise RefineError(f"{path}: exists already; choose another name, or set overwrite")


def upload(file: Path, url: Url) -> None:
    """Copy a file to a URL, unless one of the same size is there."""
    with _opened(url, "cannot be written") as (system, inner):
        if not system.exists(inner) or system.size(inner) != file.stat().st_size:
            system.put_file(str(file), inner)


def publish(finished: Path | Url, path: Path | Url, *, overwrite: bool) -> None:
    """`whole_file.publish` within one storage; refuses to replace unless `overwrite`."""
    if isinstance(finished, Path) and isinstance(path, Path):
        whole_file.publish(finished, path, overwrite=overwrite)
        return
    refuse_existing(path, overwrite=overwrite)
    with _opened(Url(path), "cannot be written") as (system, inner):
        system.mv(_split(Url(finished))[1], inner)


def size_of(url: Url) -> int | None:
    """Bytes of a file; None if there is none."""
    with _opened(url, "cannot be looked for") as (system, inner):
        return int(system.size(inner)) if system.isfile(inner) else None


def discard(url: Url) -> None:
    """Remove a file if it is there."""
    with contextlib.suppress(RefineError), _opened(url, "") as (system, inner):
        system.rm_file(inner)


@contextlib.contextmanager
def _opened(url: Url, problem: str) -> Iterator[tuple[Any, str]]:
    """Yield the file system of a URL, without cached listings, and the path there.

    `Interrupted` takes the place of any error of the storage.
    """
    try:
        system, inner = _split(url)
        system.invalidate_cache()
        yield system, inner
    except (RefineError, MemoryError):
        raise
    except Exception as error:  # each storage has errors of its own
        missing = isinstance(error, FileNotFoundError) and not error.strerror
        why = "there is no such file" if missing else reason_of(error)
        raise Interrupted(f"{url}: {problem} ({why})") from error


def _split(url: Url) -> tuple[Any, str]:
    needed = "URLs need fsspec: pip install 'refine-addon[distributed]'"
    with explained(url, needed, errors=ImportError):
        from fsspec.core import url_to_fs
    return url_to_fs(url)
