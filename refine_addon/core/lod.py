"""Levels of detail: the same scene with ever fewer splats, in memory or as files.

If the method merges, each level is made from the one before; if it deletes, one ranking decides all
levels. Either way, a level's rows are among those of the level before, and no level depends on a
later one.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import whole_file
from .errors import RefineError
from .execute import Progress, report, seconds, silent, stages
from .formats import registry, sog
from .formats.registry import format_named, held_splats, losses, scene_name
from .formats.streamed_sog import INDEX, StreamedSog, folder_for
from .images import codec_for
from .methods import DEFAULT, Method
from .operations import read_scene
from .prune import prune, score
from .quality.alignment import in_picture
from .quality.curve import PSNR_CAP
from .report import Clock, scoring_notes, seen_by
from .result import Origin, Result
from .selection import Budget
from .splats import Model, Splats, among_all
from .views import ViewSet
from .volumes import Forced, Zone, must_go

MAX_LEVELS = 16  # the last of so many halvings would hold 0.0015 % of the splats
SHARES = (0.5, 0.25, 0.12, 0.06)  # shares kept, by default
_SAMPLE, _VIEWS = 4096, 8  # splats and views from which `viewing_distance` is estimated


@dataclass(frozen=True)
class Levels:
    """Which levels to make: by the share of the splats that is kept, or by a PSNR.

    Attributes
    ----------
    shares : tuple of float, each in (0, 1) and less than the one before
    psnr : tuple of float, instead; each less than the one before, dB, see `Budget`

    >>> [budget.keep for budget in Levels((0.5, 0.25)).budgets(9)]
    [5, 3]
    """

    shares: tuple[float, ...] = ()
    psnr: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if bool(self.shares) == bool(self.psnr):
            got = "both" if self.shares else "none"
            raise RefineError(
                f"levels are given by the shares that stay or by PSNR, got {got} of them"
            )
        values, most, unit = (self.shares, 1.0, "") if self.shares else (self.psnr, PSNR_CAP, " dB")
        bad = next((value for value in values if not 0.0 < value < most), None)
        if bad is not None:
            raise RefineError(f"level is {bad}, expected more than 0 and less than {most:g}{unit}")
        rising = next((pair for pair in pairwise(values) if pair[0] <= pair[1]), None)
        if rising:
            raise RefineError(
                f"level {rising[1]} comes after {rising[0]}, expected less: the finest first"
            )
        if len(values) > MAX_LEVELS:
            raise RefineError(f"got {len(values)} levels, expected at most {MAX_LEVELS}")

    def __len__(self) -> int:
        return len(self.goals)

    @property
    def goals(self) -> tuple[float, ...]:
        """The shares, or the PSNR in dB."""
        return self.shares or self.psnr

    def notes(self, remarks: Mapping[float, str]) -> list[str]:
        """Notes for the user: levels that were not made, and `remarks`, `Level.remark` by goal."""
        notes, number, unit = [], 0, "" if self.shares else " dB"
        for goal in self.goals:
            if goal not in remarks:
                copied = f"level {number}" if number else "the input"
                notes.append(f"no level for {goal:g}{unit}: it would be a copy of {copied}")
                continue
            number += 1
            if remarks[goal]:
                notes.append(f"level {number}: {remarks[goal]}")
        return notes

    def budgets(self, count: int) -> list[Budget]:
        """Budgets of the levels for so many splats; each keeps at least one."""
        if self.psnr:
            return [Budget(psnr=psnr) for psnr in self.psnr]
        # Decimals as written, like in `Budget.removals`: a share keeps what a ratio leaves.
        kept = (math.ceil(Fraction(repr(float(share))) * count) for share in self.shares)
        return [Budget(keep=max(number, 1)) for number in kept]


@dataclass(frozen=True, eq=False)
class Level:
    """One level, as a result for all splats, with the report of the step from the level before."""

    number: int  # from 1; level 0 is the original
    goal: float  # the share or the PSNR, dB
    result: Result  # the scores are those of all levels

    @property
    def psnr(self) -> float | None:
        """Estimated PSNR of the views against all splats, dB."""
        return self.result.report["estimated_psnr"]

    @property
    def remark(self) -> str:
        """Why the PSNR that is its goal is out of reach; "" if it is not."""
        return self.result.report["budget_remark"]

    def facts(self) -> dict[str, Any]:
        """Its report as plain JSON values."""
        report = self.result.report
        return {
            "level": self.number,
            "asked": self.goal,
            "splats": int(np.count_nonzero(self.result.keep)),
            "psnr": self.psnr,
            "done": report["method"]["done"],
            **{key: report[key] for key in ("merged", "refitted") if key in report},
        }


def lod(
    splats: Splats,
    views: ViewSet,
    levels: Levels,
    method: Method = DEFAULT,
    *,
    protected: NDArray[np.bool_] | None = None,
    removed: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Iterator[Level]:
    """Make levels of detail, each when the iterator is advanced, the finest first.

    A level with as many splats as the one before is left out; see `Levels.notes`.

    Parameters
    ----------
    splats, views, method, progress, threads : see `prune`
    levels : Levels
    protected : (N,) bool, optional; in all levels, unchanged
    removed : (N,) bool, optional
        In no level unless protected, and counted as removed. Levels are compared with pictures
        without them.

    Yields
    ------
    Level

    Raises
    ------
    RefineError, Cancelled : see `prune`; also if no level has fewer splats than the original

    Examples
    --------
    To write the second level to a file::

        second = list(lod(file.splats(), views, Levels((0.5, 0.25))))[1]
        replace(second.result, source=file).write("out.ply")
    """
    gone, budgets = must_go(removed, protected), levels.budgets(len(splats))
    scores, whole, origin = None, None, None
    # Shares of the time: a level takes half of that before it, or, once scored, hardly any.
    times = (0.5**place if method.changes else 0.02 for place in range(len(budgets)))
    scoring, *of_levels = stages(progress, 0.0 if method.changes else 1.0, *times)
    if not method.changes:  # one ranking for all, else each level is made from the one before
        scores = score(
            splats, views, method, removed=gone, quality=True, progress=scoring, threads=threads
        )
    left, demands = splats, Forced(protected, gone)
    number, fewest = 0, len(splats)
    for goal, budget, of_level in zip(levels.goals, budgets, of_levels, strict=True):
        result = prune(
            left, views, budget, method, **demands.masks, scores=scores, origin=origin,
            progress=of_level, threads=threads,
        )  # fmt: skip
        if method.changes:
            left, demands = result.splats, demands.of(result.keep)
            result = replace(result if whole is None else _both(whole, result), source=splats)
            if origin is None:
                assert result.scores is not None
                rest = splats if gone is None else splats.take(~gone)
                origin = Origin(rest, result.scores)
            origin, whole = origin._replace(psnr=result.report["estimated_psnr"]), result
        kept = int(np.count_nonzero(result.keep))
        if kept < fewest:
            number, fewest = number + 1, kept
            yield Level(number, goal, result)
    if not number:
        raise RefineError(f"no level has fewer splats than the input, which has {len(splats)}")


def _both(first, second):
    """Two results as one; the second is of the splats that the first kept."""
    keep, one, merged = among_all(second.keep, first.keep), first.merged, second.merged
    if one is not None and merged is None:
        splats, changed = one.splats.take(second.keep), one.changed[second.keep]
        merged = replace(one, splats=splats, changed=changed)
    elif one is not None:
        merged = replace(
            merged, changed=one.changed[second.keep] | merged.changed,
            merged=one.merged + merged.merged, deleted=one.deleted + merged.deleted,
        )  # fmt: skip
    merged = None if merged is None else replace(merged, keep=keep)
    return replace(second, keep=keep, merged=merged, scores=first.scores)


def level_paths(source: Path, target: Path, count: int) -> list[Path]:
    """Files of `count` levels, named by `target` if it is a file, else by `source`.

    >>> from pathlib import Path
    >>> [path.as_posix() for path in level_paths(Path("a/b.compressed.ply"), Path("out"), 2)]
    ['out/b.lod1.ply', 'out/b.lod2.ply']
    """
    folder, name, suffix = target, scene_name(source), ".ply"
    if registry.names_file(target):
        folder, name = target.parent, scene_name(target)
        suffix = target.name[len(name) :].lower()
    return [folder / f"{name}.lod{number}{suffix}" for number in range(1, count + 1)]


@contextlib.contextmanager
def _into_folder(source, target, count, overwrite):
    """Write a file for each level but 0. New files are deleted if the block fails.

    Yields ``add(scene, level)``, which writes one and returns its file's name and size, how many
    splats it lacks, and notes; and ``finish()``, which returns notes.
    """
    paths, written = level_paths(source, target, count), list[Path]()

    def add(scene, level):
        path, file = paths[level.number - 1], scene.file()
        replace(level.result, source=file).write(path, overwrite=overwrite)
        written.append(path)
        lost = losses(file, format_named(path), level.result.keep)
        return path.name, path.stat().st_size, *lost

    def finish():
        more = level_paths(source, target, MAX_LEVELS)[len(written) :]
        return [f"{path.name} is of another run" for path in more if whole_file.mode_of(path)]

    with whole_file.new_folder(paths[0].parent):
        whole_file.refuse_one_file(paths)
        for path in paths:
            whole_file.refuse_existing(path, overwrite=overwrite)
            whole_file.refuse_mapped(path, source)
        old = [path for path in paths if whole_file.mode_of(path)]
        try:
            yield add, finish
        except BaseException:
            for path in (path for path in written if path not in old):
                with contextlib.suppress(OSError):
                    path.unlink()
            raise


@contextlib.contextmanager
def _streamed(target, views, overwrite):
    """Write a streamed SOG of all levels, 0 without removed splats; see `_into_folder`."""
    codec_for(target)  # refuses where no library for images is
    streamed: list[StreamedSog] = []
    with folder_for(target, overwrite=overwrite) as folder:

        def add(scene, level):
            file, said, removed = scene.file(), list[str](), scene.demands.removed
            if not streamed:
                whole = np.ones(len(scene.splats), np.bool_) if removed is None else ~removed
                finest = held_splats(target, sog.FORMAT, file, whole, {})
                distance = viewing_distance(scene.splats, views)
                streamed.append(StreamedSog(finest.means, distance, folder))
                streamed[0].add(finest)
                _, said = losses(file, sog.FORMAT, whole)
            keep, columns = level.result.keep, level.result.changed()
            size = streamed[0].add(held_splats(target, sog.FORMAT, file, keep, columns))
            missing, _ = losses(file, sog.FORMAT, keep)
            return f"{level.number}_*/{sog.META}", size, missing, said

        def finish():
            streamed[0].publish(target, overwrite=overwrite)
            return list[str]()

        yield add, finish


def viewing_distance(splats: Splats, views: ViewSet) -> float:
    """Median distance from the views to the splats in them, world units; inf if there are none.

    A streamed SOG's chunks are at most this wide: far ends are at most twice as far as near ones.
    """
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        means = splats.means[:: max(len(splats) // _SAMPLE, 1)].astype(np.float64)
        points = np.hstack([in_picture(means, view) for view in views.spread(_VIEWS)])
        distances = np.linalg.norm(points, axis=0)
    return float(np.median(distances)) if len(distances) else math.inf


def lod_file(
    source: Path | str,
    target: Path | str,
    views: ViewSet,
    levels: Levels,
    method: Method = DEFAULT,
    *,
    zones: Sequence[Zone] = (),
    model: Model | None = None,
    axes: str | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
    threads: int | None = None,
) -> dict[str, Any]:
    """Make levels of detail of a file: a file for each, or one streamed SOG.

    Parameters
    ----------
    source : path-like, of any format; level 0, which only a streamed SOG holds again
    target : path-like
        A folder, made if missing; a file in it that gives the names (`level_paths`); or the index
        of a streamed SOG, ``lod-meta.json``.
    views, levels, method, progress, threads : see `lod`
    zones, model, axes, overwrite : see `prune_file`

    Returns
    -------
    dict : the report, plain JSON values; see docs/report.md

    Raises
    ------
    RefineError, Cancelled : then new files are deleted, and a streamed SOG is as it was
    """
    clock, path, file = Clock(), whole_file.expanded(target), whole_file.expanded(source)
    output = _into_folder(file, path, len(levels), overwrite)
    if path.name == INDEX:
        output = _streamed(path, views, overwrite)
    with output as (add, finish):
        scene = read_scene(source, zones, model, axes=axes, views=views)
        clock.lap("read_s")
        demands, entries, notes, remarks = scene.demands, list[dict[str, Any]](), list[str](), {}
        count = len(scene.splats)
        making, writing = stages(progress, seconds("merge", count), seconds("write", count))
        how = {**demands.masks, "progress": making, "threads": threads}
        for level in lod(scene.splats, views, levels, method, **how):
            name, size, missing, more = add(scene, level)
            notes += [note for note in more if note not in notes]
            entry = level.facts() | {"left_out": missing, "file": name, "bytes": size}
            entries.append(entry | {"splats": entry["splats"] - missing})
            remarks[level.goal] = level.remark
        report(writing, 0.5, "writing")
        notes += levels.notes(remarks) + finish()
        clock.lap("levels_s")
    scores = level.result.scores
    assert scores is not None
    return {
        "settings": method.facts(),
        "volumes": list(demands.facts),
        "source": {"file": file.name, "bytes": scene.bytes},
        **seen_by(scores, demands),
        "nested": not method.changes,
        "levels": entries,
        "files": {"input": scene.name, "output": str(path)},
        "timings": clock.stop(),
        "notes": scoring_notes(scores) + notes,
    }
