"""The cheapest model that keeps nearly the same splats as the full one, found by probing.

Models, from cheap to full: the closed form without frustum test, with it, occlusion measured once,
and occlusion in rounds. A few probe views rank the splats by each; the cheapest whose kept set
differs from the full model's by no more than the tolerance is taken. Then views are added, twice as
many each time, until the ranking has settled likewise. The full model is the last of the models,
with all views: where nothing cheaper will do, that is what runs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from .. import selection
from ..errors import RefineError
from ..selection import Budget
from ..work import Progress, part, silent
from . import closed_form, occlusion

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..scores import Scores
    from ..splats import Splats
    from ..views import ViewSet
    from .closed_form import ClosedForm
    from .occlusion import Occlusion

    Model = Callable[[ViewSet, Progress], Scores]

PROBES = 8
"""How many views probe; they are the farthest apart."""

RATIOS = (0.3, 0.5, 0.7, 0.9)
"""Shares removed at which kept sets are compared; the worst counts."""


CAUTION = 4.0
"""Factor on what the probes say. On the committed scene the kept sets of all views differed by up
to 3.6 times what those of eight views did: with few views all models know little."""

HASTE = 1.5
"""Factor on what further views are estimated to change. On four scenes the kept sets differed by up
to 1.3 times the geometric series: later doublings change more than the first two promise."""


@dataclass(frozen=True)
class Trial:
    """One comparison of a cheaper choice with a fuller one.

    Attributes
    ----------
    choice : str
        What was tried.
    disagreement : float
        Share of the kept set that would change, at the worst of `RATIOS`; between models, times
        `CAUTION`.
    """

    choice: str
    disagreement: float


def disagreement(one: Scores, other: Scores) -> float:
    """Return the share of the kept set that differs between two rankings of the same splats.

    Parameters
    ----------
    one, other : Scores

    Returns
    -------
    float
        0 to 1: the largest over `RATIOS` of ``|kept by one and not by the other| / |kept|``.
    """
    worst = 0.0
    for ratio in RATIOS:
        budget = Budget(ratio=ratio)
        kept, also = (selection.select(scores, budget) for scores in (one, other))
        worst = max(worst, np.count_nonzero(kept & ~also) / np.count_nonzero(kept))
    return worst


def score(
    splats: Splats,
    views: ViewSet,
    tolerance: float,
    settings: tuple[ClosedForm, Occlusion],
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> Scores:
    """Score splats by the cheapest model and the fewest views that agree with the full ones.

    Parameters
    ----------
    splats, progress, threads
        See `refine_addon.core.occlusion.score`.
    views : ViewSet
        Those of the full model.
    tolerance : float
        Share of the kept set that may differ from the full model's.
    settings : tuple of ClosedForm and Occlusion
        What the models start from.

    Returns
    -------
    Scores
        ``weights["auto"]`` says what was tried, chosen and estimated, ``notes`` the same in words.

    Raises
    ------
    RefineError, Cancelled
        See `refine_addon.core.occlusion.score`.
    """
    models = _models(splats, settings, threads)
    last, probes = list(models)[-1], views.spread(PROBES)
    why = ""
    try:
        name, probed, trials = _cheapest(models, probes, tolerance, part(progress, 0.0, 0.3))
    except RefineError:  # whether the other views see anything, the full model says
        name, trials, total = last, [], 0.0
        scores = models[last](views, part(progress, 0.3, 1.0))
        why = f", as the {len(probes)} that probed see nothing"
    else:
        # What is left of the tolerance is for the views.
        spent = trials[-1].disagreement if name != last else 0.0
        scores, estimate = _settled(
            models[name], views, probed, (tolerance - spent, trials), part(progress, 0.3, 1.0)
        )
        total = min(spent + estimate, 1.0)
    other = "that is the full model"
    if total:
        other = f"estimated to keep {total:.1%} other splats than the full model"
        other += f" (tolerance {tolerance:.1%})"
    note = f"auto: {name}, {scores.views_used} of {len(views)} views{why}; {other}"
    facts = {
        "model": name,
        "views": scores.views_used,
        "estimate": total,
        "tolerance": tolerance,
        "tried": {trial.choice: trial.disagreement for trial in trials},
    }
    weights = {**scores.weights, "auto": facts}
    return replace(scores, weights=weights, notes=(*scores.notes, note), method="auto")


def _models(
    splats: Splats, settings: tuple[ClosedForm, Occlusion], threads: int | None
) -> dict[str, Model]:
    """Return the models from cheap to full, by the names that the report gives them."""
    form, froxels = settings

    def closed(changed: ClosedForm) -> Model:
        return lambda views, progress: closed_form.score(
            splats, views, changed, progress=progress, threads=threads
        )

    def hidden(changed: Occlusion) -> Model:
        return lambda views, progress: occlusion.score(
            splats, views, changed, progress=progress, threads=threads
        )

    return {
        "closed form without frustum test": closed(replace(form, frustum=False)),
        "closed form": closed(form),
        "occlusion measured once": hidden(replace(froxels, rounds=1)),
        "occlusion": hidden(froxels),
    }


def _cheapest(
    models: dict[str, Model], probes: ViewSet, tolerance: float, progress: Progress
) -> tuple[str, Scores, list[Trial]]:
    """Return the cheapest model that agrees with the last on the probe views, and its scores."""
    *cheaper, full = models
    reference = models[full](probes, part(progress, 0.0, 0.6))
    trials = []
    for index, name in enumerate(cheaper):
        span = part(progress, 0.6 + 0.4 * index / 3, 0.6 + 0.4 * (index + 1) / 3)
        try:
            scores = models[name](probes, span)
        except RefineError:  # it sees nothing where the full model does
            trials.append(Trial(name, 1.0))
            continue
        trials.append(Trial(name, min(CAUTION * disagreement(reference, scores), 1.0)))
        if trials[-1].disagreement <= tolerance:
            return name, scores, trials
    return full, reference, trials


def _settled(
    model: Model,
    views: ViewSet,
    scores: Scores,
    allowed: tuple[float, list[Trial]],
    progress: Progress,
) -> tuple[Scores, float]:
    """Return scores by the fewest views whose ranking has settled, and the estimated change.

    Each doubling of the views changes the kept set by some share, smaller each time by a factor
    that the last two doublings tell; what those up to all views would change is the sum of a
    geometric series. Where that says that all are needed, the doublings between are left out.
    """
    tolerance, trials = allowed
    total = sum(view.weight > 0.0 for view in views)
    change, done = 0.0, 0.0
    while scores.views_used < total:
        count = min(2 * scores.views_used, total)
        # The cost is in proportion to the views, and those of all doublings sum to twice the last.
        step = part(progress, done, done + (1.0 - done) * 0.5)
        done += (1.0 - done) * 0.5
        fuller = model(views.spread(count), step)
        before, change = change, disagreement(fuller, scores)
        trials.append(Trial(f"{scores.views_used} instead of {count} views", change))
        scores = fuller
        shrink = min(change / before, 0.9) if before else 0.9
        if count == total:
            break
        doublings = float(np.log2(total / count))
        rest = _series(change, shrink, doublings)
        if rest <= tolerance:
            return scores, rest
        # Whether one doubling less than all would do; whatever is known, each hardly halves it.
        hope = shrink if before else 0.5
        saved = max(doublings - 1.0, 0.0)
        if _series(change * hope**saved, shrink, doublings - saved) > tolerance:
            return model(views.spread(0), part(progress, done, 1.0)), 0.0
    return scores, 0.0


def _series(change: float, shrink: float, doublings: float) -> float:
    """Return what so many doublings will change, each `shrink` times the last; it was `change`."""
    return float(HASTE * change * shrink * (1.0 - shrink**doublings) / (1.0 - shrink))
