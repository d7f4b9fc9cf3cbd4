"""The folder of a job: arrays between the steps, and notes of what has been done.

Every file is written whole or not at all, and holds the same bytes whoever writes it. So a step
may be done twice, or again after whoever did it was killed.
"""

from __future__ import annotations

import contextlib
import errno
import secrets
import shutil
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from ..errors import RefineError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from numpy.typing import NDArray

_DAMAGE = (ValueError, EOFError)  # what NumPy raises for a file that is not a whole array


class Interrupted(RefineError):
    """Raised where workers, a disk or a storage failed: what is done stays for the next run."""


@dataclass(frozen=True)
class Folder:
    """A folder on a disk that every process that works on the job sees; its path is absolute.

    What writes raises `Interrupted` if the disk is full or fails; what reads raises it if a file is
    damaged, and forgets what keeps it from being made again (see `once`), and `FileNotFoundError`
    if there is none.
    """

    path: Path

    @property
    def tiles(self) -> Path:
        """Where finished tiles wait until all of them are finished."""
        return self.path / "tiles"

    def save(self, index: int, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Store arrays by name, of the unit, chunk or region of that number."""
        for name, array in arrays.items():
            with self.writing(self._array(index, name)) as stream:
                _write(stream, array)

    def load(self, index: int, names: Iterable[str]) -> dict[str, NDArray[Any]]:
        """Return arrays that were saved, by name."""
        return {name: self._loaded(index, name) for name in names}

    def joined(self, indices: Iterable[int], name: str, axis: int = 0) -> NDArray[Any]:
        """Return the arrays of several units, chunks or regions as one."""
        return np.concatenate([self.map(index, name) for index in indices], axis)

    def map(self, index: int, name: str) -> NDArray[Any]:
        """Return an array that was saved, without reading it yet."""
        return self._loaded(index, name, mode="r")

    def drop(self, index: int, names: Iterable[str]) -> None:
        """Remove arrays that were saved, where they are there."""
        for name in names:
            self._array(index, name).unlink(missing_ok=True)

    def once(self, name: str, make: Callable[[], Any]) -> Any:
        """Return the noted result of that name; if there is none, make and note it.

        Where `make` saves arrays, the name begins with their number in six digits and a dot: if one
        turns out to be damaged, these results are forgotten, and made again by the next run.

        Raises
        ------
        Interrupted
            If an array that it needs is gone; all results are forgotten then.
        """
        done, result = self.noted(name)
        if done:
            return result
        try:
            result = make()
        except FileNotFoundError as error:
            # Another worker, taken for dead, ended this just now and removed what it needs.
            done, result = self.noted(name)
            if done:
                return result
            self._forget("")
            raise Interrupted(f"{error.filename}: is gone") from error
        self.note(name, result)
        return result

    def inner(self, name: str) -> Folder:
        """Return a folder in this one, and make it if it is not there."""
        folder = Folder(self.path / name)
        try:
            for path in (folder.path / "done", folder.path / "arrays"):
                path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise Interrupted(_not_written(folder.path, error)) from error
        return folder

    def note(self, name: str, result: Any) -> None:
        """Note a result: from then on it is done."""
        alone = isinstance(result, np.ndarray)
        arrays = [result] if alone else [np.asarray(each) for each in result or ()]
        path = self.path / "done" / f"{name}{'' if alone else '.tuple'}"
        with self.writing(path) as stream:
            for array in arrays if alone else [np.array(len(arrays)), *arrays]:
                _write(stream, array)

    def noted(self, name: str) -> tuple[bool, Any]:
        """Return whether a result was noted, and which; numbers as arrays without axes.

        A note that a power cut has truncated counts as none.
        """
        with contextlib.suppress(FileNotFoundError, *_DAMAGE):
            return True, _read(self.path / "done" / name)
        with (
            contextlib.suppress(FileNotFoundError, *_DAMAGE),
            (self.path / "done" / f"{name}.tuple").open("rb") as stream,
        ):
            count = int(np.load(stream, allow_pickle=False))
            arrays = tuple(np.load(stream, allow_pickle=False) for _ in range(count))
            return True, arrays or None
        return False, None

    def mapped(self, name: str) -> NDArray[Any]:
        """Return an array that was noted, without reading it yet."""
        return self._read_or_forget(self.path / "done" / name, name, "r")

    @contextlib.contextmanager
    def writing(self, path: Path) -> Iterator[BinaryIO]:
        """Open a file of the job to write it whole; the folder that it lies in is made if need be.

        `whole_file` would look through that folder each time for what killed runs have left; here
        that goes with the folder. What else the block raises passes.
        """
        temporary = path.with_name(f"{secrets.token_hex(8)}.tmp")
        try:
            path.parent.mkdir(exist_ok=True)
            with temporary.open("xb") as stream:
                yield stream
            temporary.replace(path)
        except OSError as error:
            raise Interrupted(_not_written(path, error)) from error
        finally:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)

    @contextlib.contextmanager
    def opened(self) -> Iterator[None]:
        """Make the folder, if it is not there, and keep others from the same job in the block.

        Raises
        ------
        RefineError
            If it cannot be made, or another process works on the job.
        """
        fresh = not self.path.exists()
        try:
            self.tiles.mkdir(parents=True, exist_ok=True)
            self.inner("")
            stream = (self.path / "lock").open("wb")
        except OSError as error:
            if fresh:
                self.remove()
            raise RefineError(f"{self.path}: cannot be made ({error.strerror or error})") from error
        try:
            with stream:
                if fcntl is not None:
                    try:
                        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    except BlockingIOError as error:
                        raise RefineError(
                            f"{self.path}: another run is at work on the same job"
                        ) from error
                    except OSError:
                        pass  # this file system has no locks
                yield
        finally:
            if not (self.path / "done").exists():
                self.remove()  # Windows does not remove the lock while it is open

    def remove(self) -> None:
        """Remove the folder and all that is in it; Ctrl-C meanwhile comes too late."""
        try:
            shutil.rmtree(self.path, ignore_errors=True)
        except KeyboardInterrupt:
            shutil.rmtree(self.path, ignore_errors=True)

    def _loaded(self, index: int, name: str, mode: str | None = None) -> NDArray[Any]:
        return self._read_or_forget(self._array(index, name), f"{index:06d}.", mode)

    def _read_or_forget(self, path: Path, start: str, mode: str | None) -> NDArray[Any]:
        """Read an array; if it is damaged, forget what would keep it from being made again."""
        try:
            return _read(path, mode)
        except _DAMAGE as error:
            self._forget(start)
            raise Interrupted(f"{path}: is damaged") from error
        except FileNotFoundError:
            raise
        except OSError as error:
            raise Interrupted(f"{path}: cannot be read ({error.strerror})") from error

    def _forget(self, start: str) -> None:
        """Remove the notes whose names start so: what they stand for is then done again."""
        for path in (self.path / "done").glob(f"{start}*"):
            path.unlink(missing_ok=True)

    def _array(self, index: int, name: str) -> Path:
        return self.path / "arrays" / f"{index:06d}" / f"{name}.npy"


def _write(stream: BinaryIO, array: NDArray[Any]) -> None:
    """Write an array by calls of ``write``, whose errors name a full disk.

    To a file NumPy writes by C's ``fwrite``, and then says "90000 requested and 25072 written".
    """
    only_write: Any = SimpleNamespace(write=stream.write)
    np.save(only_write, array, allow_pickle=False)


def _read(path: Path, mode: Any = None) -> NDArray[Any]:
    """Return an array, mapped if `mode` is "r"."""
    return np.asarray(np.load(path, mmap_mode=mode, allow_pickle=False))


def _not_written(path: Path, error: OSError) -> str:
    """Return the message for what the system refuses to write."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    reason = f"cannot be written ({error.strerror})"
    return f"{path}: {'no space left on the disk' if full else reason}"
