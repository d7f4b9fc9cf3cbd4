"""The folder of a job: arrays between the steps, and what has been done.

Every file is written whole or not at all (`whole_file`), and holds the same bytes whoever writes
it. So a step may be done twice, or again after whoever did it was killed.
"""

from __future__ import annotations

import contextlib
import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import RefineError
from ..whole_file import whole_file

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray


@dataclass(frozen=True)
class Folder:
    """A folder on a disk that everybody who works on the job sees.

    Attributes
    ----------
    path : Path
        Absolute.
    """

    path: Path

    @property
    def tiles(self) -> Path:
        """Where finished tiles wait until all of them are finished."""
        return self.path / "tiles"

    def save(self, unit: int, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keep arrays of a unit by their names."""
        if arrays:
            self._array(unit, "").parent.mkdir(exist_ok=True)
        for name, array in arrays.items():
            with self._written(self._array(unit, name)) as stream:
                np.save(stream, array, allow_pickle=False)

    def load(self, unit: int, names: Iterable[str]) -> dict[str, NDArray[Any]]:
        """Return arrays of a unit by their names."""
        return {name: self._read(self._array(unit, name)) for name in names}

    def drop(self, unit: int, names: Iterable[str]) -> None:
        """Forget arrays of a unit."""
        for name in names:
            self._array(unit, name).unlink(missing_ok=True)

    def map(self, unit: int, name: str) -> NDArray[Any]:
        """Return an array of a unit without reading it yet."""
        return np.asarray(np.load(self._array(unit, name), mmap_mode="r", allow_pickle=False))

    def mapped(self, name: str) -> NDArray[Any]:
        """Return an array that was noted without reading it yet."""
        return np.asarray(np.load(self.path / "done" / name, mmap_mode="r", allow_pickle=False))

    def once(self, name: str, make: Callable[[], Any]) -> Any:  # noqa: ANN401 - as made, or `noted`
        """Return what came of something, as it was noted; if it is not done, make and note it."""
        done, found = self.noted(name)
        if done:
            return found
        try:
            found = make()
        except FileNotFoundError:
            # Another worker, taken for dead, ended this just now and cleared away what it needs.
            done, found = self.noted(name)
            if not done:
                raise
            return found
        self.note(name, found)
        return found

    def has(self, name: str) -> bool:
        """Return whether something is done."""
        return any((self.path / "done" / f"{name}{end}").exists() for end in ("", ".tuple"))

    def inner(self, name: str) -> Folder:
        """Return a folder in this one, and make it if it is not there."""
        folder = Folder(self.path / name)
        for path in (folder.path, folder.path / "done", folder.path / "arrays"):
            path.mkdir(parents=True, exist_ok=True)
        return folder

    def note(self, name: str, result: Any) -> None:  # noqa: ANN401 - an array, a tuple of some, None
        """Note what came of something: from then on it is done."""
        alone = isinstance(result, np.ndarray)
        arrays = [result] if alone else [np.asarray(each) for each in result or ()]
        with self._written(self.path / "done" / f"{name}{'' if alone else '.tuple'}") as stream:
            for array in arrays:
                np.save(stream, array, allow_pickle=False)

    def noted(self, name: str) -> tuple[bool, Any]:
        """Return whether something is done, and what came of it; numbers as arrays of no axis."""
        with contextlib.suppress(FileNotFoundError):
            return True, self._read(self.path / "done" / name)
        try:
            with (self.path / "done" / f"{name}.tuple").open("rb") as stream:
                arrays = []
                while stream.peek(1):
                    arrays.append(np.load(stream, allow_pickle=False))
        except FileNotFoundError:
            return False, None
        return True, tuple(arrays) or None

    @contextlib.contextmanager
    def opened(self) -> Iterator[None]:
        """Make the folder, if it is not there, and keep others from the same job in the block.

        Raises
        ------
        RefineError
            If it cannot be made, or somebody else works on the job.
        """
        try:
            self.tiles.mkdir(parents=True, exist_ok=True)
            self.inner("")
            stream = (self.path / "lock").open("wb")
        except OSError as error:
            msg = f"{self.path}: cannot be made ({error.strerror or error})"
            raise RefineError(msg) from error
        with stream:
            if fcntl is not None:
                try:
                    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError as error:
                    msg = f"{self.path}: another run is at work on the same job"
                    raise RefineError(msg) from error
                except OSError:
                    pass  # this file system has no locks
            yield

    def remove(self) -> None:
        """Remove the folder and all that is in it."""
        shutil.rmtree(self.path, ignore_errors=True)

    def _array(self, unit: int, name: str) -> Path:
        return self.path / "arrays" / f"{unit:06d}" / f"{name}.npy"

    def _written(self, path: Path) -> contextlib.AbstractContextManager[Any]:
        return whole_file(path, overwrite=True)

    def _read(self, path: Path) -> NDArray[Any]:
        with path.open("rb") as stream:
            return np.asarray(np.load(stream, allow_pickle=False))
