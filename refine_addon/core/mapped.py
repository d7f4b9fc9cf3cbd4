"""Arrays in files: indexing reads them, so scenes larger than memory are pruned by the same code.

Each access maps the file, copies what is asked for and lets the map go: pages that stay mapped
count as memory of the process. Pickled, an array is its file's name, type and shape, so processes
that see the file share it.

The files lie in the folder of a job. It also keeps what its finished stages returned (`once`), so
that the same job goes on from there after a kill.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import pickle
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
from numpy.typing import NDArray

from .errors import RefineError, reason_of

Result = TypeVar("Result")


class Interrupted(RefineError):
    """Workers, a disk or a storage failed: what is done stays for the next run."""


class Mapped:
    """An array in a file, read-only, in C order.

    Parameters
    ----------
    path : Path
    dtype : dtype
    shape : tuple of int

    Raises
    ------
    Interrupted
        If the file is not as long as the array; from indexing also if it cannot be read.
    """

    def __init__(self, path: Path, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
        self.path, self.dtype, self.shape = path, dtype, shape
        self.ndim, self.size = len(shape), math.prod(shape)
        self.nbytes = self.size * dtype.itemsize
        with reading(path):
            if path.stat().st_size != self.nbytes:
                raise Interrupted(f"{path}: is damaged")

    def __reduce__(self) -> tuple[type[Mapped], tuple[Any, ...]]:
        return Mapped, (self.path, self.dtype, self.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> Any:
        if not self.size:
            return np.empty(self.shape, self.dtype)[key]
        with reading(self.path):
            return np.array(np.memmap(self.path, self.dtype, "r", 0, self.shape)[key])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self[...], dtype)

    def take(self, rows: NDArray[np.int64], axis: int = 0) -> NDArray[Any]:
        """Some rows; the axis is the first."""
        return np.asarray(self[rows])


def write(folder: Path, pieces: Iterable[Mapping[str, NDArray[Any]]]) -> dict[str, Any]:
    """Write arrays into a new folder, a piece of each at a time along the first axis.

    Parameters
    ----------
    folder : Path
        It is there with all arrays or not at all; one that is there already is replaced.
    pieces : iterable of dict of str to array
        At least one, all with the names, types and further axes of the first.

    Returns
    -------
    dict of str to Mapped

    Raises
    ------
    Interrupted
        If the disk is full or fails.
    """
    unfinished = folder.with_name(f"{folder.name}-{secrets.token_hex(4)}.tmp")
    files: dict[str, BinaryIO] = {}
    kinds: dict[str, tuple[Any, int, tuple[int, ...]]] = {}  # type, rows, further axes
    try:
        with contextlib.ExitStack() as held:
            for piece in pieces:
                for name, values in piece.items():
                    with writing(folder):
                        if name not in files:
                            unfinished.mkdir(parents=True, exist_ok=True)
                            files[name] = held.enter_context((unfinished / name).open("wb"))
                        files[name].write(np.ascontiguousarray(values).data)
                    dtype, rows, further = kinds.get(name, (values.dtype, 0, values.shape[1:]))
                    kinds[name] = dtype, rows + len(values), further
        with writing(folder):
            if folder.exists():
                shutil.rmtree(folder)
            unfinished.rename(folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return {
        name: Mapped(folder / name, dtype, (rows, *further))
        for name, (dtype, rows, further) in kinds.items()
    }


def once(job: Path, stage: str, make: Callable[[], Result]) -> Result:
    """Result of a stage of a job: that of an earlier run, or what `make` returns, which is kept.

    Parameters
    ----------
    job : Path
    stage : str
    make : callable

    Raises
    ------
    Interrupted
        If the disk is full or fails.
    """
    done, result = noted(job, stage)
    return result if done else note(job, stage, make())


def note(job: Path, stage: str, result: Result) -> Result:
    """Keep the result of a stage, whole or not at all, and return it; see `once`."""
    path = job / f"{stage}.done"
    temporary = path.with_name(f"{secrets.token_hex(8)}.tmp")
    try:
        with writing(path):
            with temporary.open("xb") as stream:
                pickle.dump(result, stream, protocol=5)
            temporary.replace(path)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
    return result


def noted(job: Path, stage: str) -> tuple[bool, Any]:
    """Whether a stage is done, and its result; one whose files are damaged is not done."""
    path = job / f"{stage}.done"
    if not path.exists():
        return False, None
    with reading(path), path.open("rb") as stream:
        # Unpickling runs what it reads: nothing that another user has written.
        if not hasattr(os, "getuid") or os.fstat(stream.fileno()).st_uid == os.getuid():
            with contextlib.suppress(Interrupted, EOFError, ValueError, pickle.PickleError):
                return True, pickle.load(stream)
    return False, None


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Raise `Interrupted` where the system cannot read a file of a job."""
    try:
        yield
    except OSError as error:
        raise Interrupted(f"{path}: cannot be read ({reason_of(error)})") from error


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Raise `Interrupted` where the disk is full, or the system cannot write."""
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        reason = "no space left on the disk" if full else f"cannot be written ({reason_of(error)})"
        raise Interrupted(f"{path}: {reason}") from error
