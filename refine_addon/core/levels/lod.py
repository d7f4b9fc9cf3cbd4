"""Levels of detail: the same scene with ever fewer splats, and what each costs.

Where survivors absorb, each level is made from the one before. What they then become does not
depend on which levels are asked for after them. Where splats are deleted, one ranking decides all
levels. Either way the rows of a level are among those of the level before.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import costs
from ..costs import Plan
from ..errors import RefineError
from ..execute import Progress, silent
from ..merging.merge import Merged
from ..pace import phases
from ..pipeline import decide, planned, score, scoring_plans
from ..quality.curve import PSNR_CAP
from ..scores import Scores
from ..selection import Budget
from ..splats import Splats, among_all
from ..survivor_choice import SURVIVORS, Became, refuse_unknown
from ..task import DEFAULTS, Origin, Result, Settings, Task
from ..views import ViewSet
from .distance import VIEWS, OriginalPictures, Reach

MAX_LEVELS = 16
"""No more levels than this: the last of so many halvings would hold .0015 % of the splats."""


@dataclass(frozen=True)
class Levels:
    """Which levels to make: by the share of the splats that stays, or by a PSNR.

    Attributes
    ----------
    shares : tuple of float
        Shares that stay, each in (0, 1) and less than the one before.
    psnr : tuple of float
        Instead, how close the pictures of the views stay to those of all splats, dB, each less than
        the one before; see `Budget`.
    survivors : {"unchanged", "absorb", "refit"}
        What survivors may become, see `survivor_choice.SURVIVORS`. If they stay unchanged, the rows
        of each level are what they were, to the bit.

    Examples
    --------
    >>> [budget.keep for budget in Levels((0.5, 0.25)).budgets(9)]
    [5, 3]
    """

    shares: tuple[float, ...] = ()
    psnr: tuple[float, ...] = ()
    survivors: Became = "absorb"

    def __post_init__(self) -> None:
        """Check the values."""
        refuse_unknown(self.survivors, SURVIVORS)
        for name in ("shares", "psnr"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
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
        """Return the number of levels."""
        return len(self.asked)

    @property
    def asked(self) -> tuple[float, ...]:
        """The shares, or the PSNR."""
        return self.shares or self.psnr

    def notes(self, remarks: Mapping[float, str]) -> list[str]:
        """Return, in sentences, which levels were not made, and what is remarked of the others.

        Parameters
        ----------
        remarks : mapping of float to str
            `Level.remark` of those that were made, by `Level.asked`.

        Examples
        --------
        >>> Levels(psnr=(99.0, 40.0)).notes({40.0: ""})
        ['no level for 99 dB: it would be a copy of the input']
        """
        notes, number, unit = [], 0, "" if self.shares else " dB"
        for asked in self.asked:
            if asked not in remarks:
                copied = f"level {number}" if number else "the input"
                notes.append(f"no level for {asked:g}{unit}: it would be a copy of {copied}")
                continue
            number += 1
            if remarks[asked]:
                notes.append(f"level {number}: {remarks[asked]}")
        return notes

    def budgets(self, count: int) -> list[Budget]:
        """Return the budgets of the levels for so many splats; at least one splat stays."""
        if self.psnr:
            return [Budget(psnr=psnr) for psnr in self.psnr]
        # The decimals as written, as `Budget.removals`; as many as with `ratio` of 1 - share.
        kept = (math.ceil(Fraction(repr(float(share))) * count) for share in self.shares)
        return [Budget(keep=max(number, 1)) for number in kept]


@dataclass(frozen=True, eq=False)
class Level:
    """One level.

    Attributes
    ----------
    number : int
        From 1; level 0 is the original.
    asked : float
        The share that stays or the PSNR that was asked for.
    keep : (N,) bool
        Which of all splats are in it.
    splats : Splats
        The K of the level, in the order of all.
    psnr : float or None
        The estimated PSNR of the views against all splats, dB; None where the views see too little.
    reach : Reach
        From how far away it will do.
    scores : Scores
        What the views saw of all splats, the same for all levels.
    absorbed : Merged or None
        What all splats became by absorbing and refitting.
    remark : str
        Why the PSNR that was asked for is out of reach; "" if it is not.
    made : dict
        What the report of `pipeline.decide` says of what survivors became: ``became``, and where
        they changed ``absorbed`` and ``refitted``, of those of the level before.
    """

    number: int
    asked: float
    keep: NDArray[np.bool_]
    splats: Splats
    psnr: float | None
    reach: Reach
    scores: Scores
    absorbed: Merged | None = None
    remark: str = ""
    made: dict[str, Any] = field(default_factory=dict)

    def for_all(self, rest: NDArray[np.bool_]) -> Level:
        """Return a level of what was left of N splats, (N,) bool, as one of them all."""
        keep = among_all(self.keep, rest)
        absorbed = None if self.absorbed is None else replace(self.absorbed, keep=keep)
        return replace(self, keep=keep, absorbed=absorbed)

    def facts(self, goal: float) -> dict[str, Any]:
        """Return what is to be known of it as plain JSON values.

        Parameters
        ----------
        goal : float
            The PSNR that ``distance_psnr`` is for, dB.
        """
        within = self.reach.within(goal)
        return {
            "level": self.number,
            "asked": self.asked,
            "splats": len(self.splats),
            "psnr": self.psnr,
            "distance_psnr": None if within is None else short(within),
            "psnr_from_distances": [round(psnr, 2) for _, psnr in self.reach.psnr],
            **self.made,
        }


def short(value: float) -> float:
    """Return a number to six digits."""
    return float(f"{value:.6g}")


def lod(
    splats: Splats,
    views: ViewSet,
    levels: Levels,
    settings: Settings = DEFAULTS,
    *,
    protected: NDArray[np.bool_] | None = None,
    forced_out: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
) -> list[Level]:
    """Make levels of detail.

    Parameters
    ----------
    splats : Splats
        In the frame of the views.
    views : ViewSet
    levels : Levels
    settings : Settings
        How to score; if survivors absorb, only its number of views and settings of
        occlusion count.
    protected : (N,) bool, optional
        Splats that are in all levels, unchanged.
    forced_out : (N,) bool, optional
        Splats that are in no level, unless they are protected. They count as removed, and levels
        are compared with the pictures of the others.
    progress : callable, optional
        See `refine_addon.core.execute.Progress`.

    Returns
    -------
    list of Level
        The finest first. One that would have as many splats as the one before, or as the original,
        is not among them; see `Levels.notes`.

    Raises
    ------
    RefineError, Cancelled
        See `pipeline.score`; also if no level would have fewer splats than the original.

    Examples
    --------
    To write the second level to a file::

        level = lod(file.splats(), views, Levels((0.5, 0.25)))[1]
        file.write("out.ply", level.keep, columns=survivor_columns(file.rows, level.absorbed))
    """
    scene = Task(
        Budget(ratio=0.0), settings, splats, views, protected=protected, forced_out=forced_out
    )
    return list(each_level(scene, levels, progress=progress))


def each_level(
    scene: Task, levels: Levels, *, progress: Progress = silent, threads: int | None = None
) -> Iterator[Level]:
    """Make the levels of `lod` one by one, when they are asked for.

    Parameters
    ----------
    scene : Task
        Splats, views, settings, what is protected and what goes; its budget does not matter.
    levels, progress
        See `lod`.
    threads : int, optional
    """
    total, forced = len(scene.scene()[0]), scene.forced()
    scene = replace(scene, forced_out=None) if forced is None else scene.without(forced)
    scene, budgets = replace(scene, survivors=levels.survivors), levels.budgets(total)
    first, *later = phases(progress, *_plans(scene, budgets), threads=threads)
    deciding, comparing = later[::2], later[1::2]
    original = OriginalPictures(*scene.scene(), progress=first, threads=threads)
    decide_levels = _absorbing if scene.absorb else _deleting
    decided = decide_levels(scene, budgets, deciding, threads)
    left_before, number = total, 0
    for place, (keep, splats, result, absorbed) in enumerate(decided):
        if len(splats) == left_before:
            continue
        number, left_before = number + 1, len(splats)
        if number == 1:
            scores = result.scores
        level = Level(
            number, levels.asked[place], keep, splats, result.report["estimated_psnr"],
            original.reach(splats, progress=comparing[place]), scores,
            absorbed, result.report["budget_remark"], _made_of(result.report),
        )  # fmt: skip
        yield level if forced is None else level.for_all(~forced)
    if not number:
        raise RefineError(f"no level has fewer splats than the input, which has {total}")


def _plans(scene: Task, budgets: Sequence[Budget]) -> list[Plan]:
    """Return the costs of pictures of the original, and of each level: deciding, comparing."""
    splats, views = scene.scene()
    plans, left = [costs.picturing(len(splats), VIEWS)], len(splats)
    for budget in budgets:
        deciding: Plan = []
        if scene.absorb:
            task = replace(scene, budget=budget, splats=splats.take(slice(left)), protected=None)
            deciding = planned(task)
        else:
            if len(plans) == 1:  # one ranking is for all
                scored = scoring_plans(splats, views, scene.settings, None, quality=True)
                deciding = costs.joined(scored)
            deciding = [*deciding, costs.Cost("selecting", len(splats))]
        gone = budget.removals(left)
        left -= left // 2 if gone is None else gone
        plans += [deciding, costs.picturing(left, VIEWS)]
    return plans


def _made_of(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a report says of what survivors became; see `Level.made`."""
    changed = {key: facts[key] for key in ("absorbed", "refitted") if key in facts}
    return {"became": facts["survivors"]["became"], **changed}


class _Made(NamedTuple):
    """The splats of a level, and how they were decided; the attributes are those of `Level`."""

    keep: NDArray[np.bool_]
    splats: Splats
    result: Result
    absorbed: Merged | None


def _deleting(
    scene: Task, budgets: Sequence[Budget], progress: Sequence[Progress], threads: int | None
) -> Iterator[_Made]:
    """Make levels by one ranking, which the first progress callback is told of."""
    splats, views = scene.scene()
    scores = score(
        splats, views, scene.settings, quality=True, progress=progress[0], threads=threads
    )
    for budget in budgets:
        result = decide(replace(scene, budget=budget, scores=scores), threads=threads)
        yield _Made(result.keep, splats.take(result.keep), result, None)


def _absorbing(
    scene: Task, budgets: Sequence[Budget], progress: Sequence[Progress], threads: int | None
) -> Iterator[_Made]:
    """Make levels each from the one before; a progress callback is told of each."""
    original, scores, whole = scene.scene()[0], None, None
    task = scene
    for budget, of_level in zip(budgets, progress, strict=True):
        result = decide(replace(task, budget=budget), progress=of_level, threads=threads)
        if result.stopped is not None:
            raise result.stopped
        assert result.absorbed is not None
        whole = result.absorbed if whole is None else _both(whole, result.absorbed)
        yield _Made(whole.keep, whole.splats, result, whole)
        scores = result.scores if scores is None else scores
        left = result.report["estimated_psnr"]
        task = replace(
            task,
            splats=whole.splats,
            protected=None if scene.protected is None else scene.protected[whole.keep],
            origin=Origin(original, scores.ray_sample, scores.between, left),
        )


def _both(first: Merged, second: Merged) -> Merged:
    """Return what two steps make of the splats of the first, one after the other."""
    keep = first.keep.copy()
    keep[first.keep] = second.keep
    return replace(
        second,
        keep=keep,
        changed=first.changed[second.keep] | second.changed,
        merged=first.merged + second.merged,
        deleted=first.deleted + second.deleted,
    )
