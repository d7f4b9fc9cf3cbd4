"""Scores with occlusion: ``error_i contribution_i^(1/4)`` (`measuring`), plus a floor (`coverage`).

A splat's worth rises as those around it go. So splats go in rounds, and each round scores the rest
again, down to a tenth. All budgets use one order. Views are measured once; later rounds correct the
measured errors by rays, cast once, of which n_i hit splat i (docs/method.md, section 6)::

    error_i = (n_i  error on the rays now  +  KNOWN  error measured, `_grown`) / (n_i + KNOWN)
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import partial

import numpy as np

from .. import execute
from ..errors import RefineError
from ..execute import Progress, part, report, run, run_all, seconds, silent, stages
from ..mapped import folder_of, note, noted
from ..scores import Scores, shares_gone
from ..splats import Splats, refuse_undrawable
from ..views import ViewSet
from ..visibility import projection
from ..visibility.between import views_beside, views_between, with_views_between
from ..visibility.cast import RaySample
from ..visibility.measuring import SECONDS, Measured, measure, view_groups
from . import closed_form, coverage

ROUNDS = 8
"""How often scores are computed."""

LEAST = 0.1
"""Share of the splats that is left when scores are computed for the last time."""

EXPONENT = 0.25
"""Exponent of the contribution."""

BETWEEN, TOLD = 24, 48
"""Most views that are estimated: halfway between, or beside few cameras."""

EACH, USUAL = 3, 3.5
"""Views beside each of few cameras that decide, too. Cameras of captures, 12 to 20, lose about the
other more, dB, when left out, those in houses thrice that: views decide farther away there, and
tell of places that are farther still."""

LEFT_OUT = 2.5
"""Views between and beside decide, too, if views left out lose this much more, dB: those of five
scenes with many cameras lose 0.7 to 2.3, of nine with few cameras 2.6 to 12."""

KNOWN = 10.0
"""Weight of a measured error, in rays."""

_LOADING = 0.3  # share of the progress of `_RemovalRounds.__init__` that colours take


@np.errstate(under="ignore")  # numbers that underflow to 0 are negligible in all sums
def score(
    splats: Splats,
    views: ViewSet,
    *,
    rounds: int = ROUNDS,
    settled: int | None = None,
    few_views: bool = False,
    most_between: int = 0,
    progress: Progress = silent,
) -> tuple[Scores, Measured]:
    """Score splats, in memory or files, by how much the views change without them, with occlusion.

    A splat's value is the share of splats removed up to it, in (0, 1]; 0 if undrawable. Memory: 100
    bytes a splat, and in each thread 160 for each splat that its view shows. A stage of the job if
    splats lie in files.

    Parameters
    ----------
    splats : Splats, in the frame of the views
    rounds : int, how often scores are computed
    settled : int, optional, how many splats, the first to go, need their final order; else all
    few_views : bool, whether the PSNR is to be estimated in few views, see `RaySample`
    most_between : int, most views halfway between these that decide, too, where there are few
    progress : see `prune`

    Returns
    -------
    Scores, and what was measured of all N splats before any removal

    Raises
    ------
    RefineError : no splats, or none that can be drawn or that a view sees
    Cancelled
    """
    job, stage = folder_of(splats), f"scores-{rounds}-{settled}-{few_views}-{most_between}"
    if job is not None and (done := noted(job, stage))[0]:
        return done[1]
    count = len(splats)
    if not count:
        raise RefineError("there are no splats to score")
    execute.start(SECONDS * count * len(views))
    kept = _kept_after_rounds(count, rounds, settled)
    others = expected_views(len(views), most_between) - len(views)
    preparing, closed, looking, weighing, beside, casting, ranking = stages(
        progress, seconds("read", count), seconds("closed form", count, len(views)),
        seconds("measure", count, len(views)), 5e-6 * min(count, coverage.SAMPLE),
        seconds("measure", count, others),
        seconds("cast", count, TOLD if others else min(BETWEEN, len(views))),
        sum(seconds("order", left, len(views)) for left in (count, *kept)),
    )  # fmt: skip
    gaussians, scene, good = projection.prepare(splats, views, progress=preparing)
    refuse_undrawable(int(np.count_nonzero(good)), count)
    prior = _prior(splats, views, closed)
    ordered = views.by_distance()
    samples = [RaySample(ordered, gaussians, splats, few_views=few_views)]
    if rounds > 1:
        samples.append(RaySample(ordered, gaussians, splats, "scoring"))
    sample, index = coverage.sample(gaussians), np.asarray(gaussians.index)
    measured, of_groups, errors = measure(
        gaussians, scene, ordered, view_groups(len(ordered)),
        sample=sample, ray_samples=samples, progress=looking,
    )  # fmt: skip
    if not measured[0].any():
        raise RefineError(
            f"no camera sees the splats: none of {count} reaches into the image of any of "
            f"{len(ordered)} views; check that cameras and splats share their frame and unit"
        )
    some, worth = measured.take(sample, axis=1), prior[index[sample]]
    folds = _folds(some, of_groups, errors, worth, weighing)
    weights, left_out = coverage.floor_weights(folds, _with_floors(some, worth))
    if most_between and left_out > LEFT_OUT:
        near, lost = partial(views_beside, views, gaussians, scene), left_out / USUAL
        more = with_views_between(views, most_between, gaussians, scene)
        more += near(lost**1.5, EACH * len(views), 0, progress=part(beside, 0.0, 0.07))
        told = near(lost**2, TOLD, 1, progress=part(beside, 0.07, 0.1))
    else:
        more, told = [], views_between(views, BETWEEN)
    if more:
        share, every = _with_between(views, more)
        for scoring in samples[1:]:
            scoring.extend(every)
        of_more, *_ = measure(
            gaussians, scene, every, [range(len(ordered), len(every))],
            ray_samples=samples[1:], progress=part(beside, 0.1, 1.0),
        )  # fmt: skip
        measured[:2] *= share
        measured[:2] += of_more[:2]
    between = None
    if told:
        between = RaySample(ViewSet(tuple(told)).by_distance(), gaussians, splats, "between")
        between.cast_all(gaussians, scene, casting)
    del gaussians, of_groups, errors  # not needed any more where memory is highest
    measured = execute.in_file(_for_all(measured, index, count))
    rays = samples.pop() if rounds > 1 else None
    values = _values(index, good, prior, measured, rays, weights, kept, ranking)
    scores = Scores(
        values, execute.in_file(measured[2].astype(np.int32)), len(ordered),
        int(np.count_nonzero(~good)),
        {"floor": weights}, method="occlusion", ray_sample=samples[0], between=between,
        settled=settled, deciding=replace(views, views=(*views, *more)), views_between=len(more),
    )  # fmt: skip
    result = scores, measured
    return result if job is None else note(job, stage, result)


def expected_views(count: int, most_between: int) -> int:
    """Views that decide, of `count` given; where they may be few, as if they are.

    >>> expected_views(12, 24), expected_views(64, 0)
    (72, 64)
    """
    return count * (1 + EACH) + most_between if most_between else count


@np.errstate(under="ignore")
def in_rounds(
    splats: Splats,
    scores: Scores,
    measured: Measured,
    *,
    settled: int | None = None,
    progress: Progress = silent,
) -> Scores:
    """`score` by what one round of it gave, not measuring again; each step reports 0 to 1."""
    deciding = scores.deciding
    assert deciding is not None
    own = len(deciding) - scores.views_between
    views, more = replace(deciding, views=deciding.views[:own]), deciding.views[own:]
    gaussians, scene, good = projection.prepare(splats, views, progress=progress)
    rays = RaySample((), gaussians, splats, "scoring")
    for some in (views.by_distance(), _with_between(views, more)[1]):  # own views get more rays
        rays.extend(some)
        rays.cast_all(gaussians, scene, progress)
    index, kept = np.asarray(gaussians.index), _kept_after_rounds(len(splats), ROUNDS, settled)
    del gaussians
    prior, weights = _prior(splats, views, progress), scores.facts["floor"]
    values = _values(index, good, prior, measured, rays, weights, kept, progress)
    return replace(scores, values=values, settled=settled)


def measure_part(
    splats: Splats,
    views: ViewSet,
    turn: int,
    parts: int,
    expected: Measured,
    *,
    progress: Progress = silent,
) -> Measured:
    """What views see of N splats, measured in one of at most `parts` parts, else as `expected`."""
    gaussians, scene, _ = projection.prepare(splats, views, progress=part(progress, 0.0, 0.05))
    ordered = views.by_distance()
    groups = view_groups(len(ordered))
    parts = min(parts, len(groups))
    groups = groups[turn % parts :: parts]
    later = part(progress, 0.05, 1.0)
    measured, *_ = measure(gaussians, scene, ordered, groups, progress=later)
    weight = math.fsum(ordered[number][1] for group in groups for number in group)
    share = weight / math.fsum(weight for _, weight in ordered)
    measured = _for_all(measured[: len(expected)], np.asarray(gaussians.index), len(splats))
    return measured + (1.0 - share) * expected


def _for_all(measured, index, count):
    """Sums of `count` splats: those measured at `index`, (M,), 0 for all others."""
    every = np.zeros((len(measured), count))
    every[:, index] = measured
    return every


def _prior(splats, views, progress):
    """The closed form's scores, which splats that no view shows have, too: no frustum test."""
    return closed_form.score(splats, views, prior=True, progress=progress).values


def _with_between(views, more):
    """Share of `views` in all weights, and the views that decide, with weights: `more` are last."""
    share = len(views) / (len(views) + len(more))
    every = [(view, share * weight) for view, weight in views.by_distance()]
    others = ViewSet(tuple(more)).by_distance() if more else ()
    return share, every + [(view, (1.0 - share) * weight) for view, weight in others]


def _with_floors(measured, prior):
    """Scores ``error contribution^p`` and floors of splats, (n,) each.

    The error alone is that of removing one splat by itself.
    """
    contribution, error, seen = measured
    floors = coverage.floor(prior.astype(np.float64), seen, 1.0 + EXPONENT)
    return error * contribution**EXPONENT, floors


def _folds(whole, of_groups, errors, prior, progress):
    """Yield what `coverage.floor_weights` takes, with each group of views left out once."""
    for without, of_views in zip(of_groups, errors, strict=True) if len(errors) > 1 else ():
        report(progress, 0.0, "scoring")
        # Rounding can leave a negative difference.
        yield *_with_floors(np.maximum(whole - without, 0.0), prior), of_views


def _values(index, good, prior, measured, rays, weights, kept, progress):
    """Scores of N splats, `good` ones drawable; removal is in rounds if there are scoring rays."""
    loading, *of_rounds = stages(progress, len(good), *kept)
    rounds = None if rays is None else _RemovalRounds(rays, len(index), loading)
    count, left = len(good), np.arange(len(index))
    undrawn = np.setdiff1d(np.arange(count), index)
    removed = [undrawn[np.argsort(prior[undrawn], kind="stable")]]  # rows in the order of removal
    for stay, of_round in zip(kept, of_rounds, strict=True):  # `kept` are left after each round
        now = measured.take(index[left], axis=1)
        if rounds is not None:
            now = rounds.remove_and_measure(left, now, of_round)
        report(of_round, 1.0, "scoring")
        worth = prior[index[left]]  # (n,)
        # How many of those left are removed when each of the shares is reached.
        go, gone = max(len(left) - stay, 0), count - len(left)
        stops = np.clip(np.rint(np.multiply(coverage.SHARES, count)) - gone, 0, go).astype(int)
        stops[-1] = go
        scores, floors = _with_floors(now, worth)
        order = coverage.order(scores, floors, worth, weights, stops)
        removed.append(index[left[order[:go]]])
        left = np.sort(left[order[go:]])
    values = np.empty(count, np.float32)
    values[np.concatenate(removed)] = shares_gone(np.arange(1, count + 1), count)
    values[~good] = 0.0
    return values


class _RemovalRounds:
    """Errors and contributions of M Gaussians as ever more go, by rays cast before any removal.

    The rays leave their sample, so that the hits of what has gone are not kept there.
    """

    def __init__(self, scoring_rays, count, progress):
        def colored(number):
            rays, (view, weight) = scoring_rays.rays[number], scoring_rays.views[number]
            scoring_rays.rays[number] = None
            colors = scoring_rays.colors(number, rays)
            return rays, colors, weight * view.width * view.height / rays.count

        # Of each view: rays, (3, u) colours of what they hit, and the area of the image for each
        # ray, px^2, times the view's weight.
        numbers = [k for k, rays in enumerate(scoring_rays.rays) if rays is not None]
        earlier = part(progress, 0.0, _LOADING)
        self._views = run_all(colored, numbers, progress=earlier, what="scoring")
        self._rays_hitting = np.zeros(count, np.int64)  # (M,), n_i
        for rays, _, _ in self._views:
            self._rays_hitting[rays.hit] += np.bincount(rays.owner, minlength=len(rays.hit))
        self._first = self._sums(np.arange(count), part(progress, _LOADING, 1.0))

    def remove_and_measure(self, left, measured, progress):
        """Remove all but the ascending rows `left`, (n,); what was `measured` of these, now."""
        all_left = len(left) == len(self._rays_hitting)
        now = self._first if all_left else self._sums(left, progress)
        count = self._rays_hitting[left]  # (n,)
        contribution, error = (
            _grown(sums, before[left], after, KNOWN / np.maximum(count, 1))
            for sums, before, after in zip(measured[:2], self._first, now, strict=True)
        )
        error = (count * now[1] + KNOWN * error) / (count + KNOWN)
        return np.stack([contribution, error, measured[2]])

    def _sums(self, left, progress):
        """Contribution and error of Gaussians that are left, (2, n), by the rays."""
        keep = np.zeros(len(self._rays_hitting), np.bool_)
        keep[left] = True

        def removal_errors(number):
            rays, colors, area = self._views[number]
            rays = rays.keeping(keep.take(rays.hit))
            self._views[number] = rays, colors, area
            error, contribution = rays.removal_errors(colors)
            return rays.hit, area * np.stack([contribution, error])

        sums = np.zeros((2, len(keep)))
        every = range(len(self._views))
        for hit, of_view in run(removal_errors, every, progress=progress, what="scoring"):
            sums[:, hit] += of_view
        execute.return_freed()
        return sums.take(left, axis=1)


def _grown(measured, before, now, weight):
    """Measured sums, (n,), times their growth from `before` any removal to `now`, by the rays::

        growth = (now + scene growth  prior) / (before + prior),    prior = weight  measured

    The scene's growth counts most for splats that few rays hit.
    """
    total = float(before.sum())
    scene_growth = float(now.sum()) / total if total > 0.0 else 1.0
    prior = weight * measured
    both = before + prior
    grown = now + scene_growth * prior
    return measured * np.divide(grown, both, out=np.ones_like(both), where=both > 0.0)


def _kept_after_rounds(count, rounds, settled):
    """Splats left after each round, at last 0, up to the round that settles `settled`."""
    rest = 0 if settled is None else max(count - settled, 0)
    stays = (round(count * LEAST ** (number / (rounds - 1))) for number in range(1, rounds))
    return [*itertools.takewhile(lambda stay: stay > rest, stays), 0]
