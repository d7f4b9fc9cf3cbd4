"""Method *auto*: occlusion with no more views than the pictures need.

Half of the views, spread evenly, measure the splats first, then an eighth more. Others judge: their
lines of sight tell how good the pictures are that each of the two rankings leaves. The error of a
mean over k views falls as 1 / k, so the PSNR is about ``limit - slope / k``, and what the eighth
has gained tells what the rest would gain. Where that is within the tolerance, the rest is not
measured. All that is measured to find out is used, so finding out costs no more than two rankings
and the lines of sight of the judges.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..estimate.quality import UNSEEN
from ..work import Progress, part, silent
from .occlusion import FIRST_END, Rounds, Run

if TYPE_CHECKING:
    from ..scores import Scores
    from ..splats import Splats
    from ..views import ViewSet
    from .occlusion import Occlusion

RATIOS = (0.3, 0.5, 0.7, 0.9)
"""Shares removed at which rankings are judged; the largest loss counts."""

LEAST_VIEWS = 16
"""Fewer views are all used: too few would be left to judge."""

FIRST, MORE, JUDGES = (0, 1, 2, 3), (4,), (5, 6)
"""Blocks of views, of eight: those that measure first, those that measure next, and those that
judge. The judges and the eighth block measure if the others are not enough."""

LOOKING = 0.05
"""Share of the time of the first round that looking from the views that judge takes, for the
display of progress."""


def score(  # noqa: PLR0913 - as `occlusion.score`, and the tolerance
    splats: Splats,
    views: ViewSet,
    tolerance: float,
    settings: Occlusion,
    *,
    settled: int | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Scores:
    """Score splats by occlusion, with no more views than are needed.

    Parameters
    ----------
    splats, settings, settled, progress, threads
        See `occlusion.score`.
    views : ViewSet
        Those that may be used.
    tolerance : float
        By how much the PSNR of the pictures may be lower than with all views, dB.

    Returns
    -------
    Scores
        ``facts["auto"]`` tells what the judges expect and what is estimated to be lost;
        ``views_used`` how many views measured.

    Raises
    ------
    RefineError, Cancelled
        See `occlusion.score`.
    """
    run = Run(
        splats, views, settings, members=blocks_of(views),
        progress=part(progress, 0.0, 0.1), threads=threads,
    )  # fmt: skip
    ahead = part(progress, 0.1, 1.0)
    return scored(run, tolerance, settled=settled, progress=ahead, threads=threads)


def scored(
    run: Rounds,
    tolerance: float,
    *,
    settled: int | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Scores:
    """Return the scores of a run that has measured nothing yet.

    Parameters
    ----------
    run : Rounds
        With the blocks of `blocks_of`, if these are not None.
    tolerance, settled, progress, threads
        See `score`.
    """
    end = FIRST_END if run.rounds > 1 else 1.0
    ahead = part(progress, 0.0, end)
    if len(run.measuring.views) < LEAST_VIEWS or not tolerance:
        run.measure(range(run.measuring.count), ahead)
        loss, judged = 0.0, dict[str, list[float]]()
    else:
        loss, judged = _measure(run, tolerance, ahead, threads)
    scores = run.rank(part(progress, end, 1.0), settled)
    own = {"views": scores.views_used, "loss": loss, "tolerance": tolerance, "judged": judged}
    facts = {**scores.facts, "auto": own}
    return replace(scores, facts=facts, method="auto")


def blocks_of(views: ViewSet) -> list[list[int]] | None:
    """Return the numbers of the views of each of eight blocks, as in `ViewSet.by_distance`.

    The first four blocks are half of the views, spread evenly over all.

    Parameters
    ----------
    views : ViewSet

    Returns
    -------
    list of list of int, or None
        None if there are fewer than `LEAST_VIEWS` views of positive weight.
    """
    order = [view for view, _ in views.by_distance()]
    if len(order) < LEAST_VIEWS:
        return None
    half = Counter(map(id, views.spread((len(order) + 1) // 2)))  # one view may be there twice
    first: list[int] = []
    rest: list[int] = []
    for number, view in enumerate(order):
        (first if half[id(view)] else rest).append(number)
        half[id(view)] -= half[id(view)] > 0
    return [numbers[k::4] for numbers in (first, rest) for k in range(4)]


def _measure(
    run: Rounds, tolerance: float, progress: Progress, threads: int | None
) -> tuple[float, dict[str, list[float]]]:
    """Measure the splats from as many views as are needed.

    Parameters
    ----------
    run : Rounds
        With the blocks of `blocks_of`.
    tolerance, progress, threads
        See `score`.

    Returns
    -------
    loss : float
        What the views that were left out are estimated to gain, dB.
    judged : dict of str to list of float
        What the judges expect of the two rankings at `RATIOS`, dB.

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.
    """
    members = run.measuring.members
    judges = [number for k in JUDGES for number in members[k]]
    ahead = part(progress, 0.0, LOOKING)
    assert run.sights is not None  # noqa: S101 - as the judges need
    run.sights.look_from(judges, run.gaussians, run.measuring.scene, ahead, threads)
    run.measure(FIRST, part(progress, LOOKING, 0.55))
    run.measure(MORE, part(progress, 0.55, 0.7))
    blocks = (FIRST, FIRST + MORE, range(len(members)))
    few, some, every = (sum(len(members[k]) for k in which) for which in blocks)
    found = {
        count: run.sights.judged(
            run.once(which, part(progress, 0.7, 0.7)), RATIOS, judges, threads=threads
        )
        for count, which in zip((few, some), blocks, strict=False)
    }
    known = {count: psnr for count, psnr in found.items() if psnr is not None}
    judged = {
        f"{count} views": [round(psnr, 2) for psnr in known[count].tolist()] for count in known
    }
    loss = math.inf
    if len(known) == len(found):
        # No eye tells apart what is above `UNSEEN`.
        gain = np.minimum(known[some], UNSEEN) - np.minimum(known[few], UNSEEN)
        loss = max(float(gain.max()), 0.0) * (1 / some - 1 / every) / (1 / few - 1 / some)
    if loss <= tolerance:
        return loss, judged
    run.measure(range(len(FIRST + MORE), len(members)), part(progress, 0.7, 1.0))
    return 0.0, judged
