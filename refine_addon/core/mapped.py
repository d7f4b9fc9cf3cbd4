"""Arrays and splats in files, and the finished stages of a job.

Indexing an array maps its file, copies the elements and unmaps the file, since mapped pages count
as memory. Pickled, an array is the name, type and shape of its file. The folder of a job holds such
files, and the results of its stages (`once`), so that a killed job can go on. Splats that are too
many to be worked on at once are divided into regions, which any process can work on.
"""

from __future__ import annotations

import contextlib
import math
import os
import pickle
import secrets
import shutil
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
from numpy.typing import NDArray

from .errors import RefineError
from .execute import chunks, mapped
from .splats import ARRAYS, Splats
from .whole_file import explained

Result = TypeVar("Result")
REGION = 1 << 20  # most splats of a region; merging takes about 400 bytes of each
_ROWS = 1 << 16  # splats copied at a time
_SAMPLE = 1 << 14  # splats that decide along which axis a box is divided
_ASKEW = np.array([[2, -1, 2], [2, 2, -1], [-1, 2, 2]], np.float32) / np.float32(3.0)


class Interrupted(RefineError):
    """Workers, a disk or a storage failed; finished stages are kept for the next run."""


class Mapped:
    """An array in a file, read-only, in C order; `Interrupted` if damaged or unreadable."""

    def __init__(self, path: Path, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
        self.path, self.dtype, self.shape = path, dtype, shape
        self.ndim, self.size = len(shape), math.prod(shape)
        self.nbytes = self.size * dtype.itemsize
        with explained(path, "cannot be read", Interrupted):
            if path.stat().st_size != self.nbytes:
                raise Interrupted(f"{path}: is damaged")

    def __reduce__(self) -> tuple[type[Mapped], tuple[Any, ...]]:
        return Mapped, (self.path, self.dtype, self.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> Any:
        if not self.size:
            return np.empty(self.shape, self.dtype)[key]
        with explained(self.path, "cannot be read", Interrupted):
            return np.array(np.memmap(self.path, self.dtype, "r", 0, self.shape)[key])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self[...], dtype)

    def take(self, rows: NDArray[np.int64], axis: int = 0) -> NDArray[Any]:
        """Elements at `rows` along the first axis; `axis`, which NumPy passes, is ignored."""
        return np.asarray(self[rows])


def write(folder: Path, pieces: Iterable[Mapping[str, NDArray[Any]]]) -> dict[str, Any]:
    """Write arrays by name to a folder, replaced whole or not at all; `Interrupted` on errors."""
    unfinished = folder.with_name(f"{folder.name}-{secrets.token_hex(4)}.tmp")
    files: dict[str, BinaryIO] = {}
    kinds: dict[str, tuple[Any, tuple[int, ...]]] = {}  # type and shape
    try:
        # Closing writes what is buffered.
        with explained(folder, "cannot be written", Interrupted), contextlib.ExitStack() as held:
            for piece in pieces:
                for name, values in piece.items():
                    if name not in files:
                        unfinished.mkdir(parents=True, exist_ok=True)
                        files[name] = held.enter_context((unfinished / name).open("wb"))
                    files[name].write(np.ascontiguousarray(values).data)
                    dtype, (rows, *more) = kinds.get(name, (values.dtype, (0, *values.shape[1:])))
                    kinds[name] = dtype, (rows + len(values), *more)
        with explained(folder, "cannot be written", Interrupted):
            if folder.exists():
                shutil.rmtree(folder)
            unfinished.rename(folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return {name: Mapped(folder / name, *kind) for name, kind in kinds.items()}


@contextlib.contextmanager
def whole(path: Path) -> Iterator[BinaryIO]:
    """Open a file that becomes `path` when the block ends, if it does; `Interrupted` on errors."""
    unfinished = path.with_name(f"{secrets.token_hex(8)}.tmp")
    try:
        with explained(path, "cannot be written", Interrupted):
            with unfinished.open("xb") as stream:
                yield stream
            unfinished.replace(path)
    finally:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)


def once(job: Path, stage: str, make: Callable[[], Result]) -> Result:
    """Result of a stage of a job: of an earlier run, or of ``make()``, which is then stored."""
    done, result = noted(job, stage)
    return result if done else note(job, stage, make())


def note(job: Path, stage: str, result: Result) -> Result:
    """Store the result of a stage, whole or not at all, and return it; see `once`."""
    with whole(job / f"{stage}.done") as stream:
        pickle.dump(result, stream, protocol=5)
    return result


def noted(job: Path, stage: str) -> tuple[bool, Any]:
    """Whether a stage is done, and its result; not done if its files are damaged."""
    path, missing = job / f"{stage}.done", contextlib.suppress(FileNotFoundError)
    with explained(path, "cannot be read", Interrupted), missing, path.open("rb") as stream:
        # Unpickling can run code in the file, so files of other users are not read.
        if not hasattr(os, "getuid") or os.fstat(stream.fileno()).st_uid == os.getuid():
            with contextlib.suppress(Interrupted, EOFError, ValueError, pickle.PickleError):
                return True, pickle.load(stream)
    return False, None


# Splats in files.


def on_disk(folder: Path, parts: Iterable[Splats]) -> Splats:
    """Join splats of the same types, degree and model as `Mapped` arrays in a new folder."""
    model: Any = None

    def columns() -> Iterator[dict[str, NDArray[Any]]]:
        nonlocal model
        for each in parts:
            model = each.model
            for piece in chunks(max(len(each), 1), _ROWS):
                yield {name: getattr(each, name)[piece] for name in ARRAYS}

    return Splats(**write(folder, columns()), model=model)


def pieces(splats: Splats, rows: NDArray[np.int64]) -> Iterator[Splats]:
    """Splats at `rows`, (n,), in that order, a piece at a time, for `on_disk`."""
    return (splats.take(rows[piece]) for piece in chunks(len(rows), _ROWS))


def folder_of(splats: Splats) -> Path | None:
    """Folder of the job whose files hold the splats; None for splats in memory."""
    return splats.means.path.parents[1] if isinstance(splats.means, Mapped) else None


def new_folder(splats: Splats) -> Path:
    """Make a folder in that of the splats' job, for files derived from them."""
    job = folder_of(splats)
    assert job is not None
    folder = job / f"regions-{secrets.token_hex(4)}"
    folder.mkdir()
    return folder


# Regions of splats in files.


def in_regions(splats: Splats, count: int) -> bool:
    """Whether `count` of the splats must be divided: more than a `REGION`, of splats in files."""
    return folder_of(splats) is not None and count > REGION


def divided(
    means: NDArray[np.floating[Any]], share: float = 1.0, *, askew: bool = False
) -> list[NDArray[np.int64]]:
    """Rows, ascending, of boxes of about equally many splats, at most `share` of a `REGION` each.

    Boxes are halved across the axis along which `means`, (n, 3), vary most; with `askew`, the axes
    are turned, so that other splats lie at the borders. Non-finite means count as the origin.
    """
    with np.errstate(over="ignore"):  # doubles beyond float32
        place = np.asarray(means, np.float32)
    place = np.where(np.isfinite(place).all(axis=1, keepdims=True), place, np.float32(0.0))
    place = place @ (_ASKEW if askew else np.eye(3, dtype=np.float32))

    def halved(rows: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
        if count <= 1:
            return [rows]
        sample = place[rows[:: max(len(rows) // _SAMPLE, 1)]]
        low, high = np.quantile(sample, (0.05, 0.95), axis=0)
        along = place[rows, int(np.argmax(high - low))]
        less = count // 2
        cut = len(rows) * less // count
        order = np.argpartition(along, cut)
        one, other = np.sort(rows[order[:cut]]), np.sort(rows[order[cut:]])
        return halved(one, less) + halved(other, count - less)

    return halved(np.arange(len(place)), -(-len(place) // max(int(share * REGION), 1)))


def in_one(
    folder: Path, regions: Sequence[Splats], boxes: Sequence[NDArray[np.int64]]
) -> tuple[Splats, NDArray[np.int64]]:
    """Join regions, whose folder is then deleted; `boxes` are the rows of each.

    Returns the splats by ascending row, and the place of each among the concatenated regions, (N,).
    """
    every, order = on_disk(folder / "every", regions), np.argsort(np.concatenate(boxes))
    result = on_disk(folder.with_name(f"{folder.name}-done"), pieces(every, order))
    shutil.rmtree(folder, ignore_errors=True)
    return result, order


def file_bytes(path: Path) -> NDArray[np.uint8]:
    """Bytes of a file, memory-mapped, (n,); `RefineError` if it is no file or cannot be read."""
    if not status_of(path).st_size:
        return np.empty(0, np.uint8)
    reading = explained(path, "cannot be read", errors=(OSError, ValueError))
    with reading, path.open("rb") as stream:
        return np.frombuffer(mapped(stream), np.uint8)


def status_of(path: Path) -> os.stat_result:
    """Status of a file that may be read; `RefineError` if it is no file or cannot be found."""
    with explained(path, "cannot be read", errors=(OSError, ValueError)):
        status = path.stat()
    if not stat.S_ISREG(status.st_mode):  # opening a pipe would wait for a writer
        kind = "folder" if stat.S_ISDIR(status.st_mode) else "device"
        raise RefineError(f"{path}: is a {kind}, expected a PLY file")
    return status
