"""Levels of detail as files in a folder, or as one streamed SOG."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import RefineError
from ..execute import Progress, silent
from ..formats import sog
from ..formats.format import Format
from ..formats.images import codec_for
from ..formats.registry import format_named, held_splats, notes, scene_name, write_splats
from ..formats.streamed_sog import INDEX, StreamedSog, folder_for
from ..operation.files import FileSource
from ..operation.loaded import Loaded
from ..operation.run import Request, Runtime, Written, run
from ..quality.curve import PSNR_CAP
from ..rendering import Model
from ..report import held, scoring_notes, seen_by
from ..selection import Budget
from ..task import DEFAULTS, Settings, Task
from ..views import ViewSet
from ..volumes import Zone
from ..whole_file import (
    expanded,
    mode_of,
    new_folder,
    refuse_existing,
    refuse_mapped,
    refuse_one_file,
)
from .lod import MAX_LEVELS, Level, Levels, each_level, short

GOAL = 40.0
"""The PSNR from which on a level is hard to tell from the original, dB."""


def level_paths(source: Path, folder: Path, count: int, suffix: str = ".ply") -> list[Path]:
    """Return the names of the files of `count` levels.

    Examples
    --------
    >>> from pathlib import Path
    >>> [path.as_posix() for path in level_paths(Path("a/b.compressed.ply"), Path("out"), 2)]
    ['out/b.lod1.ply', 'out/b.lod2.ply']
    """
    name = scene_name(source)
    return [folder / f"{name}.lod{number}{suffix}" for number in range(1, count + 1)]


def is_streamed(target: Path) -> bool:
    """Return whether levels that go to `target` become a streamed SOG, by its name."""
    return target.name == INDEX


def check_goal(goal: float) -> None:
    """Raise `RefineError` if no PSNR for a distance can be `goal`, dB."""
    if not 0.0 < goal < PSNR_CAP:
        raise RefineError(
            f"PSNR for a distance is {goal}, expected more than 0 and less than {PSNR_CAP:g} dB"
        )


@dataclass(frozen=True, eq=False)
class LevelsRequest(Request["Loaded", "LevelSeries"]):
    """What is asked of levels of detail as files.

    Attributes
    ----------
    views, levels, settings
        See `lod`.
    zones : sequence of Zone
        Volumes that say which splats must stay and which must go, in the frame of the views.
    suffix : str
        Of the files, which names their format; a streamed SOG has none.
    goal : float
        The PSNR that ``distance_psnr`` of the report is for, dB.
    overwrite, model
        See `Request`.
    """

    views: ViewSet
    levels: Levels
    settings: Settings = DEFAULTS
    zones: Sequence[Zone] = ()
    suffix: str = ".ply"
    goal: float = GOAL
    overwrite: bool = False
    model: Model | None = None

    @contextlib.contextmanager
    def opened(self, _form: Format | None) -> Iterator[None]:
        """Refuse a PSNR that none can be."""
        check_goal(self.goal)
        yield

    def decide(self, loaded: Loaded, runtime: Runtime) -> LevelSeries:
        """Return the levels, each of which is made when it is asked for."""
        scene = Task(
            Budget(ratio=0.0), self.settings, loaded.splats, self.views,
            protected=loaded.forced.protected, forced_out=loaded.forced.out,
        )  # fmt: skip
        levels = each_level(scene, self.levels, progress=runtime.progress, threads=runtime.threads)
        facts = {"settings": asdict(self.settings), "volumes": loaded.volumes, "notes": []}
        return LevelSeries(levels, facts)


@dataclass(frozen=True, eq=False)
class LevelSeries:
    """Levels of detail that are made one by one, so that no two are in memory.

    Attributes
    ----------
    levels : iterator of Level
    report : dict
    """

    levels: Iterator[Level]
    report: dict[str, Any]


@dataclass(frozen=True, eq=False)
class LevelSink(ABC):
    """Where levels go.

    Attributes
    ----------
    source : Path
        Level 0.
    target : Path
        The folder, or the index of a streamed SOG.
    request : LevelsRequest
    """

    source: Path
    target: Path
    request: LevelsRequest
    timing: str = "levels_s"

    @property
    def form(self) -> None:
        """No budget of levels counts bytes."""
        return

    @abstractmethod
    def opened(self) -> AbstractContextManager[None]:
        """Refuse what cannot be written; if the block fails, remove what is new."""

    @abstractmethod
    def _add(self, loaded: Loaded, level: Level) -> tuple[dict[str, Any], list[str]]:
        """Write a level; return what the report says of its file, and sentences."""

    def _finish(self) -> list[str]:
        """Do what is left when all levels are written; return sentences."""
        return []

    def write(self, loaded: Loaded, series: LevelSeries, _runtime: Runtime) -> Written:
        """Write each level when it is made.

        Raises
        ------
        RefineError, Cancelled
            See `lod` and `SplatFile.write`.
        """
        request, entries = self.request, []
        notes: list[str] = []
        remarks: dict[float, str] = {}
        for level in series.levels:
            if level.number == 1:
                facts = self._facts(loaded, level)
                notes += scoring_notes(level.scores)
            entry, more = self._add(loaded, level)
            notes += [note for note in more if note not in notes]
            entries.append({**level.facts(request.goal), **entry})
            remarks[level.asked] = level.remark
        notes += request.levels.notes(remarks) + self._finish()
        facts["levels"] = entries
        files = {"input": loaded.name, "output": str(self.target)}
        return Written(files, notes=notes, facts=facts)

    def _facts(self, loaded: Loaded, first: Level) -> dict[str, Any]:
        """Return what the report says beside the levels, given the first of them."""
        seen = seen_by(first.scores)
        seen["splats"] |= {"before": len(loaded.splats), **loaded.forced.counts()}
        return {
            "source": {"file": self.source.name, "bytes": loaded.bytes},
            **seen,
            "distances": [short(distance) for distance, _ in first.reach.psnr],
            "nested": self.request.levels.survivors == "unchanged",
            "goal_psnr": self.request.goal,
        }


@dataclass(frozen=True, eq=False)
class FolderSink(LevelSink):
    """A folder to be filled with a file of each level; level 0 is not written again.

    Attributes
    ----------
    written : list of Path
        The files that are written so far.
    """

    written: list[Path] = field(default_factory=list)

    @contextlib.contextmanager
    def opened(self) -> Iterator[None]:
        """Refuse what cannot be written; if the block fails, remove files that are new.

        Raises
        ------
        RefineError
            If the folder cannot be made, or a file exists and may not be replaced.
        """
        paths = self._paths(len(self.request.levels))
        with new_folder(self.target):
            refuse_one_file(paths)
            for path in paths:
                refuse_existing(path, overwrite=self.request.overwrite)
                refuse_mapped(path, self.source)
            old = [path for path in paths if mode_of(path)]
            try:
                yield
            except BaseException:
                for path in self.written:
                    if path not in old:
                        with contextlib.suppress(OSError):
                            path.unlink()
                raise

    def _paths(self, count: int) -> list[Path]:
        return level_paths(self.source, self.target, count, self.request.suffix)

    def _add(self, loaded: Loaded, level: Level) -> tuple[dict[str, Any], list[str]]:
        path = self._paths(level.number)[-1]
        file, form = loaded.file(), format_named(path)
        columns = loaded.columns(level.absorbed)
        write_splats(path, file, level.keep, columns=columns, overwrite=self.request.overwrite)
        self.written.append(path)
        counts = held(file, form, level.keep)
        facts = {
            "splats": counts["written"],
            "left_out": counts["left_out"],
            "file": path.name,
            "bytes": path.stat().st_size,
        }
        return facts, notes(file, form, level.keep)

    def _finish(self) -> list[str]:
        """Name levels of a run before, which had more."""
        more = self._paths(MAX_LEVELS)[len(self.written) :]
        return [f"{path.name} is of another run" for path in more if mode_of(path)]


@dataclass(frozen=True, eq=False)
class StreamedSink(LevelSink):
    """A streamed SOG to be made of all levels, with level 0: what is not forced out of the source.

    Attributes
    ----------
    made : list of Path
        The folder in which it is made.
    scene : list of StreamedSog
        What is made there, once there is a level.
    """

    made: list[Path] = field(default_factory=list)
    scene: list[StreamedSog] = field(default_factory=list)

    @contextlib.contextmanager
    def opened(self) -> Iterator[None]:
        """Refuse what cannot be written, also for want of a library for images.

        See `streamed_sog.folder_for`.
        """
        codec_for(self.target)
        with folder_for(self.target, overwrite=self.request.overwrite) as made:
            self.made.append(made)
            yield

    def _add(self, loaded: Loaded, level: Level) -> tuple[dict[str, Any], list[str]]:
        file, said = loaded.file(), []
        if level.number == 1:
            out = loaded.forced.out
            whole = np.ones(len(loaded.splats), np.bool_) if out is None else ~out
            finest = held_splats(self.target, sog.FORMAT, file, whole, {})
            self.scene.append(StreamedSog(finest.means, _width(level), self.made[0]))
            self.scene[0].add(finest)
            said = notes(file, sog.FORMAT, whole)
        columns = loaded.columns(level.absorbed)
        splats = held_splats(self.target, sog.FORMAT, file, level.keep, columns)
        size = self.scene[0].add(splats)
        counts = held(file, sog.FORMAT, level.keep)
        facts = {
            "splats": counts["written"],
            "left_out": counts["left_out"],
            "file": f"{level.number}_*/{sog.META}",
            "bytes": size,
        }
        return facts, said

    def _finish(self) -> list[str]:
        """Put all in its place."""
        self.scene[0].publish(self.target, overwrite=self.request.overwrite)
        return []


def _width(level: Level) -> float:
    """Return how wide a chunk may be: as far as the views are from what they see.

    So the near and the far end of a chunk are no more than twice as far away, seen from there.
    """
    return level.reach.psnr[0][0] if level.reach.psnr else np.inf


def lod_file(
    source: Path | str,
    target: Path | str,
    request: LevelsRequest,
    *,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Make levels of detail of a file of splats: a file each, or a streamed SOG of all.

    Parameters
    ----------
    source : path-like
        The file to read, of any format (`read_splats`); level 0, which is not written again but in
        a streamed SOG.
    target : path-like
        The folder where the files go, named as by `level_paths`; or the index of a streamed SOG,
        ``lod-meta.json`` in such a folder. The folder is made if it is not there.
    request : LevelsRequest
        What is asked.
    progress : callable, optional
        See `operation.run.run`.

    Returns
    -------
    dict
        The report.

    Raises
    ------
    RefineError, Cancelled
        See `lod`, `volumes.forced`, `read_splats` and `SplatFile.write`. Files that were new are
        removed again then; a streamed SOG that was to be replaced is as it was.
    """
    path = expanded(target)
    sink = (StreamedSink if is_streamed(path) else FolderSink)(expanded(source), path, request)
    read = FileSource(source, request.zones, request.model)
    return run(read, request, sink, progress=progress).report
