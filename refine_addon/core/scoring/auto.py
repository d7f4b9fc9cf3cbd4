"""Method *auto*: the cheapest model that keeps nearly the same splats as the full one.

Models, from cheap to full: the closed form without frustum test, the closed form with it, occlusion
measured once, and occlusion in rounds. All of them score the splats by a few probe views. Auto
takes the cheapest model whose kept set differs from the full model's by at most the tolerance. Then
it doubles the number of views until the kept set changes by no more than the rest of the tolerance.
If no cheaper choice agrees, auto runs the full model on all views.
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
"""Number of probe views, which are spread evenly."""

RATIOS = (0.3, 0.5, 0.7, 0.9)
"""Shares removed at which kept sets are compared; the largest difference counts."""

CAUTION = 4.0
"""Factor on the difference that probe views show between two models. On the committed scene the
kept sets of all views differed by up to 3.6 times as much as those of eight views."""

HASTE = 1.5
"""Factor on the estimated change by further views. On four scenes the kept sets changed by up to
1.3 times the estimate: later doublings change more than the first two suggest."""


@dataclass(frozen=True)
class Trial:
    """One comparison of a cheaper choice with a fuller one.

    Attributes
    ----------
    choice : str
        What was tried.
    disagreement : float
        Share of the kept set that differs, the largest over `RATIOS`; between two models multiplied
        by `CAUTION`.
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
        See `occlusion.score`.
    views : ViewSet
        The full model uses all of them.
    tolerance : float
        Share of the kept set that may differ from the full model's.
    settings : tuple of ClosedForm and Occlusion
        Settings of the models.

    Returns
    -------
    Scores
        ``facts["auto"]`` tells what was tried, chosen and estimated; ``notes`` tells it in words.

    Raises
    ------
    RefineError, Cancelled
        See `occlusion.score`.
    """
    models = _models(splats, settings, threads)
    last, probes = list(models)[-1], views.spread(PROBES)
    why = ""
    try:
        name, probed, trials = _cheapest(models, probes, tolerance, part(progress, 0.0, 0.3))
    except RefineError:
        # The probe views see nothing. The full model raises if all other views see nothing either.
        name, trials, total = last, [], 0.0
        scores = models[last](views, part(progress, 0.3, 1.0))
        why = f", as none of {len(probes)} probe views sees anything"
    else:
        # The model uses up a part of the tolerance; the number of views may use the rest.
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
    own = {
        "model": name,
        "views": scores.views_used,
        "estimate": total,
        "tolerance": tolerance,
        "tried": {trial.choice: trial.disagreement for trial in trials},
    }
    facts = {**scores.facts, "auto": own}
    return replace(scores, facts=facts, notes=(*scores.notes, note), method="auto")


def _models(
    splats: Splats, settings: tuple[ClosedForm, Occlusion], threads: int | None
) -> dict[str, Model]:
    """Return the models from cheap to full, by their names in the report."""
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
    """Return the cheapest model that agrees with the full one on the probe views.

    Returns
    -------
    name : str
        Of the model.
    scores : Scores
        By that model and the probe views.
    trials : list of Trial
        One for each cheaper model that was tried.
    """
    *cheaper, full = models
    reference = models[full](probes, part(progress, 0.0, 0.6))
    trials = []
    for index, name in enumerate(cheaper):
        span = part(progress, 0.6 + 0.4 * index / 3, 0.6 + 0.4 * (index + 1) / 3)
        try:
            scores = models[name](probes, span)
        except RefineError:  # this model sees nothing, unlike the full one
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
    """Return scores by as few views as the tolerance permits, and the estimated further change.

    Each doubling of the views changes some share of the kept set. The ratio of the last two changes
    extrapolates to all views as a geometric series. Where it predicts that all views are needed,
    they are used at once.

    Parameters
    ----------
    model : callable
    views : ViewSet
        All views.
    scores : Scores
        By the probe views.
    allowed : tuple of float and list of Trial
        The rest of the tolerance, and a list to which the comparisons are appended.
    progress : callable
    """
    tolerance, trials = allowed
    total = sum(view.weight > 0.0 for view in views)
    change, done = 0.0, 0.0
    while scores.views_used < total:
        count = min(2 * scores.views_used, total)
        # A model costs as much as it has views; all doublings together cost twice the last one.
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
        # Would half of all views be enough? After one doubling, assume that each halves the change.
        hope = shrink if before else 0.5
        saved = max(doublings - 1.0, 0.0)
        if _series(change * hope**saved, shrink, doublings - saved) > tolerance:
            return model(views.spread(0), part(progress, done, 1.0)), 0.0
    return scores, 0.0


def _series(change: float, shrink: float, doublings: float) -> float:
    """Return the estimated change by further doublings of the views, as a share of the kept set.

    Parameters
    ----------
    change : float
        By the last doubling.
    shrink : float
        Change of each doubling over that of the one before.
    doublings : float
        How many are left.
    """
    return float(HASTE * change * shrink * (1.0 - shrink**doublings) / (1.0 - shrink))
