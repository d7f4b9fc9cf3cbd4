"""Levels of detail as files in a folder, and the manifest that lists them."""

from __future__ import annotations

import contextlib
import json
import re
from dataclasses import asdict
from typing import TYPE_CHECKING

from ..errors import RefineError
from ..estimate.quality import PSNR_CAP
from ..formats.registry import SUFFIXES, as_written, read_splats, without_suffix
from ..report import Clock, held, scoring_notes, seen_by
from ..selection import Budget
from ..survivors import survivor_columns
from ..task import DEFAULTS, Task
from ..volumes import forced
from ..whole_file import expanded, make_folder, mode_of, refuse_existing, refuse_mapped, whole_file
from ..work import Progress, silent
from .lod import Levels, each_level, short

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path
    from typing import Any

    from ..formats.ply import SplatFile
    from ..task import Settings
    from ..views import ViewSet
    from ..volumes import Zone
    from .lod import Level

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


def lod_file(  # noqa: PLR0913 - as `file_to_file.prune_file`
    source: Path | str,
    folder: Path | str,
    views: ViewSet,
    levels: Levels,
    settings: Settings = DEFAULTS,
    *,
    zones: Sequence[Zone] = (),
    suffix: str = ".ply",
    goal: float = GOAL,
    overwrite: bool = False,
    progress: Progress = silent,
    threads: int | None = None,
) -> dict[str, Any]:
    """Make levels of detail of a file of splats: a file each, and `MANIFEST`, written last.

    Parameters
    ----------
    source : path-like
        The file to read, of any format (`read_splats`); level 0, which is not written again.
    folder : path-like
        Where the files go, named as by `level_paths`; made if it is not there.
    views, levels, settings, progress, threads
        See `lod`.
    zones : sequence of Zone
        Volumes that say which splats must stay and which must go.
    suffix : str
        Of the files, which names their format.
    goal : float
        The PSNR that the manifest's ``distance_psnr`` is for, dB.
    overwrite : bool
        Whether files may be replaced.

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
    clock = Clock()
    folder, source = expanded(folder), expanded(source)
    check_goal(goal)
    paths = level_paths(source, folder, len(levels), suffix)
    with _new_files(folder, [*paths, folder / MANIFEST], overwrite=overwrite) as written:
        file = read_splats(source)
        for path in paths:
            refuse_mapped(path, source)
        clock.lap("read_s")
        entries: list[dict[str, Any]] = []
        notes: list[str] = []
        remarks: dict[float, str] = {}
        splats = file.splats()
        given = forced(zones, splats.means)
        scene = Task(
            Budget(ratio=0.0), settings, splats, views,
            protected=given.protected, removed=given.removed,
        )  # fmt: skip
        for level in each_level(scene, levels, progress=progress, threads=threads):
            if level.number == 1:
                # From here on files of an earlier run are replaced, so its manifest goes first.
                before = _unlisted(folder) if overwrite else []
                distances = [short(far) for far, _ in level.reach.psnr]
                seen, notes = seen_by(level.scores), scoring_notes(level.scores)
                seen["splats"] |= {"before": len(file), **given.counts()}
            path = paths[level.number - 1]
            facts, found = _write(file, level, path, overwrite=overwrite)
            written.append(path)
            remarks[level.asked] = level.remark
            notes += [note for note in found if note not in notes]
            entries.append({**level.facts(goal), **facts})
        notes += levels.notes(remarks)
        notes += _remove(set(before) - set(written), source)
        clock.lap("levels_s")
        facts = {
            "lod": 1,
            "source": {"file": source.name, "bytes": file.stored_bytes},
            **seen,
            "distances": distances,
            "nested": not levels.absorb,
            "goal_psnr": goal,
            "levels": entries,
        }
        with whole_file(folder / MANIFEST, overwrite=overwrite) as stream:
            stream.write(json.dumps(facts, indent=2, allow_nan=False).encode() + b"\n")
    clock.stop()
    return {
        **facts,
        "files": {"input": str(source), "folder": str(folder), "manifest": MANIFEST},
        "settings": asdict(settings),
        "volumes": list(given.facts),
        "timings": clock.timings,
        "notes": notes,
    }


def _write(
    file: SplatFile, level: Level, path: Path, *, overwrite: bool
) -> tuple[dict[str, Any], list[str]]:
    """Write the file of a level; return what the manifest says of it, and sentences."""
    made = as_written(file, path)
    columns = survivor_columns(file.rows, level.absorbed) if level.absorbed else {}
    made.write(path, level.keep, columns=columns, overwrite=overwrite)
    counts = held(made, level.keep)
    facts = {
        "splats": counts["written"],
        "left_out": counts["left_out"],
        "file": path.name,
        "bytes": path.stat().st_size,
    }
    return facts, made.notes(level.keep)


def _unlisted(folder: Path) -> list[Path]:
    """Remove the manifest of an earlier run; return the files of levels that it lists.

    Names that no level has, or of other folders, do not count.
    """
    path = folder / MANIFEST
    try:
        told = json.loads(path.read_bytes())
        names = [str(entry["file"]) for entry in told["levels"]]
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


@contextlib.contextmanager
def _new_files(folder: Path, paths: list[Path], *, overwrite: bool) -> Iterator[list[Path]]:
    """Make a folder for files; if the block fails, remove those that it wrote anew.

    Yields
    ------
    list of Path
        To be filled with what was written.

    Raises
    ------
    RefineError
        If the folder cannot be made, or a file exists and may not be replaced.
    """
    written: list[Path] = []
    there = make_folder(folder)
    try:
        for path in paths:
            refuse_existing(path, overwrite=overwrite)
        old = [path for path in paths if mode_of(path)]
        yield written
    except BaseException:
        with contextlib.suppress(OSError):
            for path in written:
                if path not in old:
                    path.unlink()
            if not there:
                folder.rmdir()
        raise
