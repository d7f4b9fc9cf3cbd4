"""Levels of detail as files in a folder, and the manifest that lists them."""

from __future__ import annotations

import contextlib
import json
import re
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING

from ..errors import RefineError
from ..estimate.quality import PSNR_CAP
from ..formats.registry import SUFFIXES, as_written, without_suffix
from ..operation.files import FileSource
from ..operation.run import Request, Written, run
from ..report import held, scoring_notes, seen_by
from ..selection import Budget
from ..task import DEFAULTS, Task
from ..whole_file import (
    expanded,
    mode_of,
    new_folder,
    refuse_existing,
    refuse_mapped,
    refuse_one_file,
    whole_file,
)
from ..work import Progress, silent
from .lod import each_level, short

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path
    from typing import Any

    from ..formats.format import Format
    from ..operation.loaded import Loaded
    from ..operation.run import Runtime
    from ..rendering import Model
    from ..task import Settings
    from ..views import ViewSet
    from ..volumes import Zone
    from .lod import Level, Levels

MANIFEST = "lod.json"

GOAL = 40.0
"""The PSNR from which on a level is hard to tell from the original, dB."""

_BEGINNING = b'{"lod":'

_LEVEL = re.compile(r"[^/\\]*\.lod\d+(?:" + "|".join(map(re.escape, SUFFIXES)) + ")")
"""Names of files of levels."""


def level_paths(source: Path, folder: Path, count: int, suffix: str = ".ply") -> list[Path]:
    """Return the names of the files of `count` levels.

    Examples
    --------
    >>> from pathlib import Path
    >>> [path.as_posix() for path in level_paths(Path("a/b.compressed.ply"), Path("out"), 2)]
    ['out/b.lod1.ply', 'out/b.lod2.ply']
    """
    name = without_suffix(source.name)
    name = source.stem if name == source.name else name or source.name
    return [folder / f"{name}.lod{number}{suffix}" for number in range(1, count + 1)]


def is_manifest(beginning: bytes) -> bool:
    """Return whether a file that begins like this is a manifest of levels, or empty."""
    words = b"".join(beginning.split())
    return not words or words.startswith(_BEGINNING)


def check_goal(goal: float) -> None:
    """Raise `RefineError` if no PSNR for a distance can be `goal`, dB."""
    if not 0.0 < goal < PSNR_CAP:
        msg = f"PSNR for a distance is {goal}, expected more than 0 and less than {PSNR_CAP:g} dB"
        raise RefineError(msg)


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
        Of the files, which names their format.
    goal : float
        The PSNR that the manifest's ``distance_psnr`` is for, dB.
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
class LevelSink:
    """A folder to be filled with a file of each level, and `MANIFEST`, written last.

    Attributes
    ----------
    source : Path
        Level 0, which is not written again.
    folder : Path
        Made if it is not there.
    request : LevelsRequest
    written : list of Path
        The files that are written so far.
    """

    source: Path
    folder: Path
    request: LevelsRequest
    written: list[Path] = field(default_factory=list)
    timing: str = "levels_s"

    @property
    def form(self) -> None:
        """No budget of levels counts bytes."""
        return

    @property
    def paths(self) -> list[Path]:
        """The files of the levels."""
        request = self.request
        return level_paths(self.source, self.folder, len(request.levels), request.suffix)

    @contextlib.contextmanager
    def opened(self) -> Iterator[None]:
        """Refuse what cannot be written; if the block fails, remove files that are new.

        Raises
        ------
        RefineError
            If the folder cannot be made, or a file exists and may not be replaced.
        """
        paths = [*self.paths, self.folder / MANIFEST]
        with new_folder(self.folder):
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

    def write(self, loaded: Loaded, series: LevelSeries, _runtime: Runtime) -> Written:
        """Write each level when it is made, then the manifest.

        Raises
        ------
        RefineError, Cancelled
            See `lod` and `SplatFile.write`.
        """
        request, entries = self.request, []
        notes: list[str] = []
        remarks: dict[float, str] = {}
        for level, path in zip(series.levels, self.paths, strict=False):
            if level.number == 1:
                # From here on files of an earlier run are replaced, so its manifest goes first.
                before = _unlisted(self.folder) if request.overwrite else []
                # Those that this run does not replace go while they are known: a killed run has
                # no list of them.
                notes += _remove(set(before) - {*self.paths}, self.source)
                facts = self._facts(loaded, level)
                notes += scoring_notes(level.scores)
            entry, more = _write(loaded, level, path, overwrite=request.overwrite)
            self.written.append(path)
            notes += [note for note in more if note not in notes]
            entries.append({**level.facts(request.goal), **entry})
            remarks[level.asked] = level.remark
        notes += request.levels.notes(remarks)
        notes += _remove({*before} & {*self.paths} - {*self.written}, self.source)
        facts["levels"] = entries
        with whole_file(self.folder / MANIFEST, overwrite=request.overwrite) as stream:
            stream.write(json.dumps(facts, indent=2, allow_nan=False).encode() + b"\n")
        files = {"input": loaded.name, "folder": str(self.folder), "manifest": MANIFEST}
        return Written(files, notes=notes, facts=facts)

    def _facts(self, loaded: Loaded, first: Level) -> dict[str, Any]:
        """Return what the manifest says beside the levels, given the first of them."""
        seen = seen_by(first.scores)
        seen["splats"] |= {"before": len(loaded.splats), **loaded.forced.counts()}
        return {
            "lod": 1,  # first: by this a manifest is known, see `is_manifest`
            "source": {"file": self.source.name, "bytes": loaded.bytes},
            **seen,
            "distances": [short(distance) for distance, _ in first.reach.psnr],
            "nested": self.request.levels.survivors == "unchanged",
            "goal_psnr": self.request.goal,
        }


def lod_file(
    source: Path | str,
    folder: Path | str,
    request: LevelsRequest,
    *,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Make levels of detail of a file of splats: a file each, and `MANIFEST`, written last.

    Parameters
    ----------
    source : path-like
        The file to read, of any format (`read_splats`); level 0, which is not written again.
    folder : path-like
        Where the files go, named as by `level_paths`; made if it is not there.
    request : LevelsRequest
        What is asked.
    progress : callable, optional
        See `operation.run.run`.

    Returns
    -------
    dict
        The report: what the manifest says, settings, timings, notes.

    Raises
    ------
    RefineError, Cancelled
        See `lod`, `volumes.forced`, `read_splats` and `SplatFile.write`. Files that were new are
        removed again then, and where one was to be replaced, no manifest is left.
    """
    sink = LevelSink(expanded(source), expanded(folder), request)
    read = FileSource(source, request.zones, request.model)
    return run(read, request, sink, progress=progress).report


def _write(
    loaded: Loaded, level: Level, path: Path, *, overwrite: bool
) -> tuple[dict[str, Any], list[str]]:
    """Write the file of a level; return what the manifest says of it, and sentences."""
    writer = as_written(loaded.file(), path)
    writer.write(path, level.keep, columns=loaded.columns(level.absorbed), overwrite=overwrite)
    counts = held(writer, level.keep)
    facts = {
        "splats": counts["written"],
        "left_out": counts["left_out"],
        "file": path.name,
        "bytes": path.stat().st_size,
    }
    return facts, writer.notes(level.keep)


def _unlisted(folder: Path) -> list[Path]:
    """Remove the manifest of an earlier run; return the files of levels that it lists.

    Names that no level has, or of other folders, do not count.
    """
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_bytes())
        names = [str(entry["file"]) for entry in manifest["levels"]]
    except (OSError, ValueError, LookupError, TypeError, RecursionError):  # none that we wrote
        names = []
    path.unlink(missing_ok=True)
    return [folder / name for name in names if _LEVEL.fullmatch(name)]


def _remove(paths: Iterable[Path], source: Path) -> list[str]:
    """Remove files that are there, but not the source; return what there is to say."""
    notes = []
    for path in sorted(paths):
        try:
            if path.samefile(source):
                continue
            path.unlink()
            notes.append(f"{path.name} of the run before is removed")
        except FileNotFoundError:
            continue
        except OSError as error:
            notes.append(f"{path.name} of the run before is not removed ({error.strerror})")
    return notes
