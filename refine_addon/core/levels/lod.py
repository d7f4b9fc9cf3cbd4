"""Levels of detail: the same scene with ever fewer splats, and what each costs.

Where survivors absorb, each level is made from the one before. What they then become does not
depend on which levels are asked for after them. Where splats are deleted, one ranking decides all
levels. Either way the rows of a level are among those of the level before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from typing import TYPE_CHECKING

from ..errors import RefineError
from ..pipeline import decide, score
from ..quality import PSNR_CAP
from ..selection import Budget
from ..task import DEFAULTS, Origin, Task
from ..volumes import among_all
from ..work import Progress, part, silent
from .distance import Lookout

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from typing import Any

    import numpy as np
    from numpy.typing import NDArray

    from ..absorbing.absorb import Absorbed
    from ..splats import Splats
    from ..task import Settings
    from ..views import ViewSet
    from .distance import Reach

    _Made = tuple[NDArray[np.bool_], Splats, float | None, Absorbed | None]

MANY = 16
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
    absorb : bool
        Whether survivors absorb what goes. Else splats are deleted, and the rows of each level stay
        what they were, to the bit.

    Examples
    --------
    >>> [budget.keep for budget in Levels((0.5, 0.25)).budgets(9)]
    [5, 3]
    """

    shares: tuple[float, ...] = ()
    psnr: tuple[float, ...] = ()
    absorb: bool = True

    def __post_init__(self) -> None:
        """Check the values.

        Raises
        ------
        RefineError
            With the value and what was expected.
        """
        for name in ("shares", "psnr"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if bool(self.shares) == bool(self.psnr):
            got = "both" if self.shares else "none"
            msg = f"levels are given by the shares that stay or by PSNR, got {got} of them"
            raise RefineError(msg)
        values, most, unit = (self.shares, 1.0, "") if self.shares else (self.psnr, PSNR_CAP, " dB")
        bad = next((value for value in values if not 0.0 < value < most), None)
        if bad is not None:
            msg = f"level is {bad}, expected more than 0 and less than {most:g}{unit}"
            raise RefineError(msg)
        rising = next((pair for pair in pairwise(values) if pair[0] <= pair[1]), None)
        if rising:
            msg = f"level {rising[1]} comes after {rising[0]}, expected less: the finest first"
            raise RefineError(msg)
        if len(values) > MANY:
            msg = f"got {len(values)} levels, expected at most {MANY}"
            raise RefineError(msg)

    def __len__(self) -> int:
        """Return the number of levels."""
        return len(self.shares or self.psnr)

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
    absorbed : Absorbed or None
        What absorbing made of all splats.
    """

    number: int
    asked: float
    keep: NDArray[np.bool_]
    splats: Splats
    psnr: float | None
    reach: Reach
    absorbed: Absorbed | None = None

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
            "geometricError": short(self.reach.error),
            "distance_pixel": short(self.reach.pixel),
            "distance_psnr": None if within is None else short(within),
            "psnr_from_distances": [round(psnr, 2) for _, psnr in self.reach.psnr],
        }


def short(value: float) -> float:
    """Return a number to six digits."""
    return float(f"{value:.6g}")


def lod(  # noqa: PLR0913 - as `pipeline.prune`
    splats: Splats,
    views: ViewSet,
    levels: Levels,
    settings: Settings = DEFAULTS,
    *,
    protected: NDArray[np.bool_] | None = None,
    removed: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> list[Level]:
    """Make levels of detail.

    Parameters
    ----------
    splats : Splats
        In the frame of the views.
    views : ViewSet
    levels : Levels
    settings : Settings
        How to score; with `Levels.absorb` only its number of views and settings of occlusion count.
    protected : (N,) bool, optional
        Splats that are in all levels, unchanged.
    removed : (N,) bool, optional
        Splats that are in no level, unless they are protected. They count as removed, and levels
        are compared with the pictures of the others.
    progress : callable, optional
        See `refine_addon.core.work.Progress`.
    threads : int, optional

    Returns
    -------
    list of Level
        The finest first.

    Raises
    ------
    RefineError, Cancelled
        See `pipeline.score`.

    Examples
    --------
    To write the second level to a file::

        level = lod(file.splats(), views, Levels((0.5, 0.25)))[1]
        file.write("out.ply", level.keep, columns=survivor_columns(file.rows, level.absorbed))
    """
    made = each_level(
        splats, views, levels, settings, protected=protected, removed=removed,
        progress=progress, threads=threads,
    )  # fmt: skip
    return list(made)


def each_level(  # noqa: PLR0913 - as `lod`
    splats: Splats,
    views: ViewSet,
    levels: Levels,
    settings: Settings = DEFAULTS,
    *,
    protected: NDArray[np.bool_] | None = None,
    removed: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Iterator[Level]:
    """Make the levels of `lod` one by one, when they are asked for."""
    scene = Task(Budget(ratio=0.0), settings, splats, views, protected=protected, removed=removed)
    budgets, ahead = levels.budgets(len(splats)), part(progress, 0.05, 1.0)
    forced = scene.forced()
    scene = scene if forced is None else scene.without(forced)
    splats = scene.scene()[0]
    lookout = Lookout(splats, views, progress=part(progress, 0.0, 0.05), threads=threads)
    coarsest = 0.0
    made = (_absorbing if levels.absorb else _deleting)(scene, budgets, ahead, threads)
    for number, (keep, left, psnr, absorbed) in enumerate(made):
        end = 0.05 + 0.95 * (number + 1) / len(levels) if levels.absorb else 1.0
        reach = lookout.reach(
            left, keep, absorbed.changed if absorbed else None, progress=part(progress, end, end)
        )
        # What a level has changed is changed in all after it, though they may measure as less.
        coarsest = max(coarsest, reach.error)
        reach = replace(reach, error=coarsest)
        asked = (levels.shares or levels.psnr)[number]
        level = Level(number + 1, asked, keep, left, psnr, reach, absorbed)
        yield level if forced is None else level.for_all(~forced)


def _deleting(
    scene: Task, budgets: Sequence[Budget], progress: Progress, threads: int | None
) -> Iterator[_Made]:
    """Make levels by one ranking."""
    splats, views = scene.scene()
    scores = score(splats, views, scene.settings, quality=True, progress=progress, threads=threads)
    for budget in budgets:
        task = replace(scene, budget=budget, scores=scores)
        result = decide(task, threads=threads)
        psnr = result.report["estimated_psnr"]
        yield result.keep, splats.take(result.keep), psnr, None


def _absorbing(
    scene: Task, budgets: Sequence[Budget], progress: Progress, threads: int | None
) -> Iterator[_Made]:
    """Make levels each from the one before."""
    count, sights, whole = len(scene.scene()[0]), None, None
    task = replace(scene, absorb=True)
    for number, budget in enumerate(budgets):
        ahead = part(progress, number / len(budgets), (number + 1) / len(budgets))
        result = decide(replace(task, budget=budget), progress=ahead, threads=threads)
        assert result.absorbed is not None  # noqa: S101 - the task says so
        psnr = result.report["estimated_psnr"]
        whole = result.absorbed if whole is None else _both(whole, result.absorbed)
        yield whole.keep, whole.splats, psnr, whole
        if number == 0:
            sights = result.scores.sights
        task = replace(
            task,
            splats=whole.splats,
            protected=None if scene.protected is None else scene.protected[whole.keep],
            origin=Origin(count, sights, psnr),
        )


def _both(first: Absorbed, second: Absorbed) -> Absorbed:
    """Return what two absorbings make of the splats of the first, one after the other."""
    keep = first.keep.copy()
    keep[first.keep] = second.keep
    return replace(
        second,
        keep=keep,
        changed=first.changed[second.keep] | second.changed,
        merged=first.merged + second.merged,
        deleted=first.deleted + second.deleted,
    )
