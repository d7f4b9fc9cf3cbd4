"""Scores that take into account what hides what, computed without a renderer.

    score_i = error_i  contribution_i^(1/4)

`measuring` defines the error and the contribution. The error is exact for one splat that is removed
while all others stay. The contribution also counts what the splat hides, which matters once its
neighbours are removed too.

A floor is added to every score, for views that were not given: the closed form, with a weight that
rises with the share removed (`coverage`).

Splats hide each other, so what one is worth rises as those around it go, and they are removed in
rounds: a part of the splats goes, the rest is scored again, until a tenth is left. The result is
one order of removal, so a larger budget also removes all that a smaller one does. Scoring for one
budget ends with the round that removes the last of its splats.

The views are measured once. Later, rays that were cast once (`RaySample`) tell what the rest is
worth: the hits of a ray are known, front to back, and so is what it would show without any one of
them. Few rays hit a small splat, so what they tell is weighed against what the views measured of
all splats::

    error_i = (n_i  error on the rays now  +  KNOWN  error measured, grown) / (n_i + KNOWN)

n_i is how many rays hit the splat while all were there. A measured sum grows as the rays tell, see
`_grown`.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from .. import execute
from ..errors import RefineError
from ..execute import Progress, part, report, run_all, seconds, silent, stages
from ..mapped import folder_of, note, noted
from ..scores import Scores, shares_gone
from ..splats import Splats, refuse_undrawable
from ..views import ViewSet, views_between
from ..visibility import projection
from ..visibility.cast import RaySample
from ..visibility.measuring import SECONDS, Measured, Sampling, measure, view_groups
from . import closed_form, coverage

LEAST = 0.1
"""Share of the splats that is left when scores are computed for the last time."""

EXPONENT = 0.25
"""Exponent of the contribution."""

BETWEEN = 12
"""So many views at most tell what lies between those that score."""

BETWEEN_RAYS = 0.375
"""How many rays they have together, as a part of `VALIDATION_RAYS`."""

KNOWN = 10.0
"""What was measured counts as much as so many rays."""

_LOADING = 0.3  # share of the time of getting ready that getting colours takes, to show progress
_SAMPLING = Sampling()


def score(
    splats: Splats,
    views: ViewSet,
    *,
    rounds: int = 8,
    sampling: Sampling = _SAMPLING,
    settled: int | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Scores:
    """Score splats by how much the views would change without them, occlusion included.

    Parameters
    ----------
    splats : Splats
        N splats in the frame and unit of the views; they may lie in files.
    views : ViewSet
        All of them are used.
    rounds : int
        How often scores are computed: once, or again after each part of the removal.
    sampling : Sampling
    settled : int, optional
        How many splats to put in their final order, the first to be removed first; the others get
        scores of the last round that this takes. By default all.
    progress : callable, optional
        See `refine_addon.core.execute.Progress`.
    threads : int, optional

    Returns
    -------
    Scores
        ``values`` is the share of the splats that have been removed once this one is, in (0, 1].

    Raises
    ------
    RefineError
        If there are no splats, if none of them can be drawn, if no view sees any, or if `rounds` is
        less than 1.
    Cancelled
        If `progress` answers ``False``.

    Notes
    -----
    Memory: about 300 bytes a splat, plus a third of that for each thread beyond the first; and 100
    bytes for each point of a view, per thread. A view has at most about 4 million points
    (`points.MAX_POINTS`); only a view that shows more than 3 million splats has more.
    Each hit of the scoring rays takes 16 bytes, of which there are at most about
    `cast.MAX_SCORING_HITS`.
    """
    if rounds < 1:
        raise RefineError(f"rounds is {rounds}, expected 1 or more")
    return _score(splats, views, rounds, settled, sampling, False, progress, threads)[0]


def score_once(
    splats: Splats,
    views: ViewSet,
    *,
    sampling: Sampling = _SAMPLING,
    few_views: bool = False,
    progress: Progress = silent,
    threads: int | None = None,
) -> tuple[Scores, Measured]:
    """Score splats in one round; also return what was measured of all N.

    Parameters
    ----------
    splats, views, sampling, progress, threads
        See `score`.
    few_views : bool
        Whether rays of few views are enough, see `RaySample`.

    Returns
    -------
    Scores, Measured

    Raises
    ------
    RefineError, Cancelled
        See `score`.
    """
    with np.errstate(under="ignore"):  # numbers that underflow to 0 are negligible in all sums
        return _score(splats, views, 1, None, sampling, few_views, progress, threads)


def measure_part(
    splats: Splats,
    views: ViewSet,
    turn: int,
    parts: int,
    *,
    sampling: Sampling = _SAMPLING,
    progress: Progress = silent,
    threads: int | None = None,
) -> tuple[Measured, float]:
    """Measure what one part of the views sees of each splat, hidden by all others.

    Parameters
    ----------
    splats, views, sampling, progress, threads
        See `score`.
    turn, parts : int
        The views are divided into so many parts, or into fewer if there are fewer views; each part
        is spread over all of them. Turn 0 measures the first, and so on, and then the first again.

    Returns
    -------
    Measured
        Of all N splats; 0 for splats that no view shows or that cannot be drawn.
    share : float
        Of the weights of all views, those of this part.

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.
    """
    gaussians, scene, _ = projection.prepare(
        splats, views, progress=part(progress, 0.0, 0.05), threads=threads
    )
    ordered = views.by_distance()
    groups = view_groups(len(ordered))
    parts = min(parts, len(groups))
    groups = groups[turn % parts :: parts]
    measured, *_ = measure(
        gaussians, scene, ordered, groups, sampling,
        progress=part(progress, 0.05, 1.0), threads=threads,
    )  # fmt: skip
    measured = measured.for_all(np.asarray(gaussians.index), len(splats))
    weight = math.fsum(ordered[number][1] for group in groups for number in group)
    return measured, weight / math.fsum(weight for _, weight in ordered)


def _score(splats, views, rounds, settled, sampling, few_views, progress, threads):
    """Scores, and what was measured of all N; see `score` and `score_once`.

    Of splats in files they are a stage of the job.
    """
    job, stage = folder_of(splats), f"scores-{rounds}-{settled}-{few_views}"
    done, found = (False, None) if job is None else noted(job, stage)
    if done:
        return found
    count = len(splats)
    if not count:
        raise RefineError("there are no splats to score")
    execute.start(SECONDS * count * len(views), threads)
    kept = _kept_after_rounds(count, rounds, settled)
    preparing, closed, looking, weighing, casting, loading, *ranking = stages(
        progress, seconds("read", count), seconds("closed form", count, len(views)),
        seconds("measure", count, len(views)), 5e-6 * min(count, coverage.SAMPLE),
        seconds("cast", count, min(BETWEEN, len(views))),
        *(seconds("order", left, len(views)) for left in (count, *kept)),
    )  # fmt: skip
    gaussians, scene, good = projection.prepare(splats, views, progress=preparing, threads=threads)
    refuse_undrawable(int(np.count_nonzero(good)), count)
    # Splats that no view shows need a floor too: without frustum test.
    prior = closed_form.score(
        splats, views, depth="distance", frustum=False, local=False,
        progress=closed, threads=threads,
    ).values  # fmt: skip
    ordered = views.by_distance()
    samples = [RaySample(ordered, gaussians, splats, few_views=few_views)]
    if rounds > 1:
        samples.append(RaySample(ordered, gaussians, splats, scoring=True))
    sample = coverage.sample(gaussians)
    measured, of_groups, errors = measure(
        gaussians, scene, ordered, view_groups(len(ordered)), sampling,
        sample=sample, ray_samples=samples, progress=looking, threads=threads,
    )  # fmt: skip
    if not measured.contribution.any():
        raise RefineError(
            f"no camera sees the splats: none of {count} reaches into the image of any of "
            f"{len(ordered)} views; check that cameras and splats share their frame and unit"
        )
    index = np.asarray(gaussians.index)
    weights = coverage.floor_weights(
        _folds(measured.take(sample), of_groups, errors, prior[index[sample]], weighing)
    )
    between = None
    if halfway := views_between(views, BETWEEN):
        between = RaySample(ViewSet(tuple(halfway)).by_distance(), gaussians, splats)
        between.share = BETWEEN_RAYS
        between.cast_all(gaussians, scene, casting, threads)
    del gaussians, of_groups, errors  # not needed any more where memory is highest
    rays = _RemovalRounds(samples.pop(), measured, loading, threads) if rounds > 1 else None
    undrawn = np.setdiff1d(np.arange(count), index)
    first = undrawn[np.argsort(prior[undrawn], kind="stable")]
    order = _order(index, prior, measured, rays, weights, kept, ranking)
    values = np.empty(count, np.float32)
    values[np.concatenate([first, order])] = shares_gone(np.arange(1, count + 1), count)
    values[~good] = 0.0
    everything = measured.for_all(index, count)
    scores = Scores(
        values, everything.seen, len(ordered), int(np.count_nonzero(~good)),
        {"floor": weights}, method="occlusion", ray_sample=samples[0], between=between,
        settled=settled,
    )  # fmt: skip
    found = scores, everything
    return found if job is None else note(job, stage, found)


def _folds(whole, of_groups, errors, prior, progress):
    """What `coverage.floor_weights` takes, with each group of views left out once.

    Of a sample: `whole` has the sums over all views, `of_groups` those over each group, `errors`
    are by views.
    """
    for without, of_views in zip(of_groups, errors, strict=True) if len(errors) > 1 else ():
        report(progress, 0.0, "scoring")
        others = Measured(
            # Rounding can leave a negative difference.
            np.maximum(whole.contribution - without.contribution, 0.0),
            np.maximum(whole.error - without.error, 0.0),
            whole.seen - without.seen,
        )
        floors = coverage.floor(prior.astype(np.float64), others.seen, 1.0 + EXPONENT)
        yield _combined(others), floors, of_views


def _order(index, prior, measured, rays, weights, kept, progress):
    """Rows of the Gaussians in the order of removal, (M,); they are the last of all N.

    Arguments: rows and prior of all N, what was measured, scoring rays if there are rounds, weights
    of the floor, and how many are left after each round.
    """
    count, left, removed = len(prior), np.arange(len(index)), []
    for stay, of_round in zip(kept, progress, strict=True):
        now = measured if rays is None else rays.remove_and_measure(left, of_round)
        report(of_round, 1.0, "scoring")
        worth = prior[index[left]]  # (n,)
        floors = coverage.floor(worth.astype(np.float64), now.seen, 1.0 + EXPONENT)
        # How many of what is left have been removed when each of the shares is reached.
        go, gone = max(len(left) - stay, 0), count - len(left)
        stops = np.clip(np.rint(np.multiply(coverage.SHARES, count)) - gone, 0, go).astype(int)
        stops[-1] = go
        order = coverage.order(_combined(now), floors, worth, weights, stops)
        removed.append(index[left[order[:go]]])
        left = np.sort(left[order[go:]])
    return np.concatenate(removed)


class _RemovalRounds:
    """M Gaussians, of which ever more are removed, and scoring rays cast while all were there."""

    def __init__(self, scoring_rays, measured, progress, threads):
        self._measured, self._threads = measured, threads

        def colored(number):
            rays, (view, weight) = scoring_rays.rays[number], scoring_rays.views[number]
            with np.errstate(under="ignore"):
                colors = scoring_rays.colors(number, rays).astype(np.float32)
            return rays, colors, weight * view.width * view.height / rays.count

        # Of each view: rays, (3, u) colours of what they hit, and the area of the image for each
        # ray, px^2, times the view's weight.
        self._views = run_all(
            colored, [k for k, rays in enumerate(scoring_rays.rays) if rays is not None],
            progress=part(progress, 0.0, _LOADING), what="scoring", threads=threads,
        )  # fmt: skip
        self._rays_hitting = np.zeros(len(measured.seen), np.int64)  # (M,), n_i
        for rays, _, _ in self._views:
            self._rays_hitting[rays.hit] += np.bincount(rays.owner, minlength=len(rays.hit))
        every = np.arange(len(self._rays_hitting))
        self._first = self._sums(every, part(progress, _LOADING, 1.0))

    def remove_and_measure(self, left, progress):
        """Remove all Gaussians but some, (n,) rows, ascending; what each of these is worth now."""
        all_left = len(left) == len(self._rays_hitting)
        now = self._first if all_left else self._sums(left, progress)
        measured = self._measured.error[left], self._measured.contribution[left]
        count = self._rays_hitting[left]  # (n,)
        error, contribution = (
            _grown(sums, before[left], after, KNOWN / np.maximum(count, 1))
            for sums, before, after in zip(measured, self._first, now, strict=True)
        )
        error = (count * now[0] + KNOWN * error) / (count + KNOWN)
        return Measured(contribution, error, self._measured.seen[left])

    def _sums(self, left, progress):
        """Error and contribution of Gaussians that are left, (n,) each, by the rays."""
        keep = np.zeros(len(self._rays_hitting), np.bool_)
        keep[left] = True

        def removal_errors(number):
            rays, colors, area = self._views[number]
            rays = rays.keeping(keep.take(rays.hit))
            self._views[number] = rays, colors, area
            with np.errstate(under="ignore"):
                error, contribution = rays.removal_errors(colors)
                return area * error, area * contribution

        of_views = run_all(
            removal_errors, range(len(self._views)),
            progress=progress, what="scoring", threads=self._threads,
        )  # fmt: skip
        error, contribution = np.zeros(len(keep)), np.zeros(len(keep))
        for (rays, _, _), (errors, contributions) in zip(self._views, of_views, strict=True):
            error[rays.hit] += errors
            contribution[rays.hit] += contributions
        return error[left], contribution[left]


def _grown(measured, before, now, known):
    """Measured sums times what they have grown by since, (n,).

    The growth of a splat is what the rays tell of it, and the mean growth of the scene as if that
    were so many rays more::

        growth = (now + scene growth  prior) / (before + prior),    prior = known  measured

    `measured` is from before any splat had gone, `before` and `now` are what the rays told then and
    what they tell now. `known` is the weight of the scene's growth, over the measured sum: large
    for a splat that few rays hit. All are (n,).
    """
    total = float(before.sum())
    scene_growth = float(now.sum()) / total if total > 0.0 else 1.0
    prior = known * measured
    both = before + prior
    grown = now + scene_growth * prior
    return measured * np.divide(grown, both, out=np.ones_like(both), where=both > 0.0)


def _kept_after_rounds(count, rounds, settled):
    """How many of `count` splats are left after each round: `LEAST` before the last, then 0.

    The last is the first round that removes `settled` splats or more together with those before.
    """
    rest = 0 if settled is None else max(count - settled, 0)
    stays = (round(count * LEAST ** (number / (rounds - 1))) for number in range(1, rounds))
    return [*itertools.takewhile(lambda stay: stay > rest, stays), 0]


def _combined(measured):
    """``error contribution^p``, (M,).

    The error is exact for one splat. The more of its neighbours go too, the more it matters how
    much of the picture the splat covers, whatever lies behind it.
    """
    return measured.error * measured.contribution**EXPONENT
