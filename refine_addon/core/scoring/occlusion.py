"""Scores that take into account what hides what, computed without a renderer.

    score_i = error_i  contribution_i^(1/4)

`measuring` defines the error and the contribution. The error is exact for one splat that is removed
while all others stay. The contribution also counts what the splat hides, which matters once its
neighbours are removed too.

A floor is added to every score, for views that were not given: the closed form, with a weight that
rises with the share removed (`coverage`).

Splats hide each other, so they are removed in rounds: a part of the splats goes, the rest is scored
again, until a tenth is left. The views are measured once; what the rest is worth later is told by
scoring rays (`removal_rounds`). The result is one order of removal, so a larger budget also removes
all that a smaller one does. Scoring for one budget ends with the round that removes the last of its
splats.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import costs, execute
from ..errors import RefineError
from ..execute import Progress, part, report, silent
from ..pace import phases
from ..scores import Scores, shares_gone
from ..splats import Splats, refuse_undrawable
from ..views import ViewSet
from ..views_between import views_between
from ..visibility import projection
from ..visibility.measuring import SECONDS, Measured, Measuring, Sampling
from ..visibility.projection import Gaussians
from ..visibility.ray_sample import RaySample
from . import closed_form, coverage
from .removal_rounds import RemovalRounds

LEAST = 0.1
"""Share of the splats that is left when scores are computed for the last time."""

EXPONENT = 0.25
"""Exponent of the contribution."""

BETWEEN_RAYS = 0.375
"""How many rays they have together, as a part of `VALIDATION_RAYS`."""

PRIOR: dict[str, Any] = {"depth": "distance", "frustum": False, "local": False}
"""The closed form of the floor: without frustum test, as splats that no view shows need one too."""


@dataclass(frozen=True)
class Occlusion(Sampling):
    """Settings of the occlusion method; the default ranks the same whatever the scene's unit.

    Attributes
    ----------
    cell, density : float
        See `measuring.Sampling`.
    rounds : int
        How often scores are computed: once, or again after each part of the removal.
    """

    rounds: int = 8

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        if self.rounds < 1:
            raise RefineError(f"rounds is {self.rounds}, expected 1 or more")


def score(
    splats: Splats,
    views: ViewSet,
    settings: Occlusion = Occlusion(),
    *,
    settled: int | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Scores:
    """Score splats by how much the views would change without them, occlusion included.

    Parameters
    ----------
    splats : Splats
        In the frame and unit of the views.
    views : ViewSet
        All of them are used.
    settings : Occlusion
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
        If there are no splats, if none of them can be drawn, or if no view sees any.
    Cancelled
        If `progress` answers ``False``.

    Notes
    -----
    Memory: about 300 bytes a splat, plus a third of that for each thread beyond the first; and 100
    bytes for each point of a view, per thread. A view has at most about 4 million points
    (`points.MAX_POINTS`); only a view that shows more than 3 million splats has more.
    Each hit of the scoring rays takes 16 bytes, see `removal_rounds.RemovalRounds`.
    """
    stays = survivors_of_rounds(len(splats), settings.rounds, settled)
    preparing, measuring, ranking = phases(
        progress, *costs.occlusion(len(splats), costs.Images.of(views), stays), threads=threads
    )
    scoring = MemoryScoring(splats, views, settings, progress=preparing, threads=threads)
    scoring.measure(range(scoring.measuring.count), measuring)
    return scoring.rank(ranking, settled)


def score_once(
    splats: Splats,
    views: ViewSet,
    settings: Occlusion = Occlusion(),
    *,
    few_views: bool = False,
    progress: Progress = silent,
    threads: int | None = None,
) -> tuple[Scores, Measured]:
    """Score splats in one round; also return what was measured of all N.

    Parameters
    ----------
    splats, views, settings, progress, threads
        See `score`; `settings.rounds` is ignored.
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
    preparing, measuring, ranking = phases(
        progress, *costs.occlusion(len(splats), costs.Images.of(views)), threads=threads
    )
    scoring = MemoryScoring(
        splats, views, replace(settings, rounds=1), few_views=few_views,
        progress=preparing, threads=threads,
    )  # fmt: skip
    measured = scoring.measure(range(scoring.measuring.count), measuring)
    return scoring.rank(ranking), measured.for_all(scoring.gaussians.index, len(splats))


def measure_part(
    splats: Splats,
    views: ViewSet,
    settings: Occlusion,
    turn: int,
    parts: int,
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> tuple[Measured, float]:
    """Measure what one part of the views sees of each splat, hidden by all others.

    Parameters
    ----------
    splats, views, settings, progress, threads
        See `score`; `settings.rounds` is ignored.
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
    measuring = Measuring(scene, views, settings, threads)
    groups = measuring.groups_of_part(turn, parts)
    sums = measuring.measure(gaussians, groups, part(progress, 0.05, 1.0))
    measured = Measured.sum(sums.values()).for_all(gaussians.index, len(splats))
    return measured, measuring.weight_share(groups)


class OcclusionScoring:
    """One scoring: the views measure all splats, then they are removed and ordered in rounds.

    Parameters
    ----------
    gaussians : Gaussians
    measuring : Measuring
    rounds : int
        See `Occlusion`.
    prior : (N,) float32
    undrawable : (N,) bool
    validation_rays : RaySample, optional

    Attributes
    ----------
    gaussians : Gaussians
        The splats that can contribute to a picture, before any is removed.
    measuring : Measuring
    validation_rays : RaySample or None
        Those of the views that have measured all splats.
    scoring_rays : RaySample or None
        The rays that order splats after the first round; None if there is but one, and once `rank`
        has taken them.
    between : RaySample or None
        Rays of views between those that score; `rank` casts them.
    prior : (N,) float32
        Orders the splats that are not among the Gaussians, and is the floor of all others.
    undrawable : (N,) bool
        Which splats cannot be drawn.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        measuring: Measuring,
        rounds: int,
        prior: NDArray[np.float32],
        undrawable: NDArray[np.bool_],
        validation_rays: RaySample | None = None,
    ) -> None:
        self.gaussians, self.measuring, self.rounds = gaussians, measuring, rounds
        self.prior, self.undrawable = prior, undrawable
        self.validation_rays = validation_rays
        self.scoring_rays: RaySample | None = None
        self.between: RaySample | None = None
        self._sample = coverage.sample(gaussians)  # (m,)
        self._sums: dict[int, Mapping[int, Measured]] = {}  # group -> what holds its sums
        self._errors: dict[int, NDArray[np.float64]] = {}  # of the sample, by groups
        self._weights: dict[tuple[int, ...], list[float]] = {}  # of the floor, by groups

    def measure(self, groups: Sequence[int], progress: Progress = silent) -> Measured:
        """Measure all splats in some more groups of views; return the sums over all so far, (M,).

        Raises
        ------
        Cancelled
            If `progress` answers ``False``.
        """
        samples = [rays for rays in (self.validation_rays, self.scoring_rays) if rays is not None]
        sums, errors = self.measuring.measure_groups(
            self.gaussians, groups, self._sample, progress, samples
        )
        self._sums |= dict.fromkeys(sums, sums)
        self._errors |= errors
        return self.measured()

    def measured(self, groups: Sequence[int] | None = None) -> Measured:
        """Return the sums over some of the groups that were measured, by default all, (M,)."""
        chosen = sorted(self._sums if groups is None else groups)
        return Measured.sum(self._sums[k][k] for k in chosen)

    def rank(self, progress: Progress, settled: int | None = None) -> Scores:
        """Return the scores, by the groups measured; can be called once.

        Parameters
        ----------
        progress : callable
        settled : int, optional
            See `score`.

        Raises
        ------
        RefineError, Cancelled
            See `score`.
        """
        measured, removal = self.measured(), self._removal()
        if not measured.contribution.any():
            raise RefineError(
                f"no camera sees the splats: none of {len(self.prior)} reaches into the image of "
                f"any of {len(self.measuring.views)} views; check that cameras and splats share "
                "their frame and unit"
            )
        seen = np.zeros(len(self.prior), np.int32)
        seen[self.gaussians.index] = measured.seen
        threads = self.measuring.threads
        stays = survivors_of_rounds(len(self.prior), self.rounds, settled)
        views_used = sum(len(self.measuring.groups[k]) for k in self._sums)
        weighing, casting, loading, *each_round = phases(
            progress, *costs.ranking(len(self.gaussians), views_used, stays)
        )
        weights = self._floor_weights(measured, list(self._sums), weighing)
        if self.between is not None:
            self.between.cast_all(self.gaussians, self.measuring.scene, casting, threads)
        left, rounds = np.arange(len(self.gaussians)), None
        if self.scoring_rays is not None:
            rounds = RemovalRounds(self.scoring_rays, measured, loading, threads)
            self.scoring_rays = None  # its hits are let go as splats go
        for stay, round_progress in zip(stays, each_round, strict=True):
            now = measured if rounds is None else rounds.remove_and_measure(left, round_progress)
            report(round_progress, 1.0, "scoring")
            go = max(len(left) - stay, 0)
            order = self._order(left, now, weights, removal, go)
            removal.add(self.gaussians.index[left[order[:go]]])
            left = np.sort(left[order[go:]])
        removal.values[self.undrawable] = 0.0
        return Scores(
            values=removal.values,
            seen=seen,
            views_used=views_used,
            undrawable=int(np.count_nonzero(self.undrawable)),
            facts={"floor": weights},
            method="occlusion",
            ray_sample=self.validation_rays,
            between=self.between,
            settled=settled,
        )

    def _removal(self) -> _Removal:
        """Return an order of removal that begins with what is not among the Gaussians."""
        removal = _Removal(len(self.prior))
        undrawn = np.setdiff1d(np.arange(len(self.prior)), self.gaussians.index)
        removal.add(undrawn[np.argsort(self.prior[undrawn], kind="stable")])
        return removal

    def _order(
        self,
        left: NDArray[np.int64],
        measured: Measured,
        weights: Sequence[float],
        removal: _Removal,
        go: int,
    ) -> NDArray[np.int64]:
        """Return the places in `left`, (n,) rows of Gaussians, in the order of removal.

        `measured` is what these are worth now, `weights` are of the floor, up to each of
        `coverage.SHARES`, and `removal` is what was removed before. In this round `go` are removed;
        the order of the others is not exact.
        """
        prior = self.prior[self.gaussians.index[left]]  # (n,)
        count, gone = len(removal.values), removal.gone
        floors = coverage.floor(prior.astype(np.float64), measured.seen, 1.0 + EXPONENT)
        # How many of these splats have been removed when each of the shares is reached.
        stops = np.clip(np.rint(np.multiply(coverage.SHARES, count)) - gone, 0, go).astype(int)
        stops[-1] = go
        return coverage.order(combined(measured), floors, prior, weights, stops)

    def _floor_weights(
        self, measured: Measured, groups: Sequence[int], progress: Progress
    ) -> list[float]:
        """Choose the weights of the floor by leaving out each of some groups of views.

        `measured` has the sums over these groups, (M,).
        """
        chosen, sample = tuple(sorted(groups)), self._sample
        worth = self.prior[self.gaussians.index[sample]].astype(np.float64)  # (m,)

        def folds() -> Iterator[tuple[NDArray[np.float64], ...]]:
            for k in chosen if len(chosen) > 1 else ():
                report(progress, 0.0, "scoring")
                left_out, errors = self._sums[k][k], self._errors[k]
                others = Measured(
                    # Rounding can leave a negative difference.
                    np.maximum(measured.contribution[sample] - left_out.contribution[sample], 0.0),
                    np.maximum(measured.error[sample] - left_out.error[sample], 0.0),
                    measured.seen[sample] - left_out.seen[sample],
                )
                floors = coverage.floor(worth, others.seen, 1.0 + EXPONENT)
                yield combined(others), floors, errors

        if chosen not in self._weights:
            self._weights[chosen] = coverage.floor_weights(folds())
        return self._weights[chosen]


class MemoryScoring(OcclusionScoring):
    """A scoring of splats in memory.

    Parameters
    ----------
    splats, views, settings, progress, threads
        See `score`.
    few_views : bool
        See `RaySample`.

    Raises
    ------
    RefineError, Cancelled
        See `score`.
    """

    validation_rays: RaySample

    def __init__(
        self,
        splats: Splats,
        views: ViewSet,
        settings: Occlusion,
        *,
        few_views: bool = False,
        progress: Progress = silent,
        threads: int | None = None,
    ) -> None:
        if not len(splats):
            raise RefineError("there are no splats to score")
        execute.start(SECONDS * len(splats) * len(views), threads)
        activating, scoring = phases(progress, *costs.preparing(len(splats), len(views)))
        gaussians, scene, good = projection.prepare(
            splats, views, progress=activating, threads=threads
        )
        refuse_undrawable(int(np.count_nonzero(good)), len(good))
        measuring = Measuring(scene, views, settings, threads)
        prior = closed_form.score(splats, views, **PRIOR, progress=scoring, threads=threads).values
        rays = RaySample(measuring.views, gaussians, splats, few_views=few_views)
        super().__init__(gaussians, measuring, settings.rounds, prior, ~good, rays)
        if settings.rounds > 1:
            self.scoring_rays = RaySample(measuring.views, gaussians, splats, scoring=True)
        self.between = rays_between(views, gaussians, splats)


def rays_between(views: ViewSet, gaussians: Gaussians, splats: Splats) -> RaySample | None:
    """Return the rays of views between those that score, to be cast; None where nothing is between.

    Parameters
    ----------
    views : ViewSet
        Those that score.
    gaussians, splats
        See `RaySample`.
    """
    halfway = views_between(views, costs.BETWEEN)
    if not halfway:
        return None
    sample = RaySample(ViewSet(tuple(halfway)).by_distance(), gaussians, splats)
    sample.share = BETWEEN_RAYS
    return sample


class _Removal:
    """The order in which splats are removed.

    `values`, (N,) float32, are for each splat that was added the share of all N removed once it is;
    `gone` splats were added.
    """

    def __init__(self, count: int) -> None:
        self.values = np.zeros(count, np.float32)
        self.gone = 0

    def add(self, splats: NDArray[np.int64]) -> None:
        """Append splats, the first to be removed first."""
        end = self.gone + len(splats)
        self.values[splats] = shares_gone(np.arange(self.gone + 1, end + 1), len(self.values))
        self.gone = end


def survivors_of_rounds(count: int, rounds: int, settled: int | None = None) -> list[int]:
    """Return how many of `count` splats stay after each round: `LEAST` before the last, then 0.

    The last is the first round that removes `settled` splats or more together with those before.
    """
    rest = 0 if settled is None else max(count - settled, 0)
    stays = (round(count * LEAST ** (number / (rounds - 1))) for number in range(1, rounds))
    return [*itertools.takewhile(lambda stay: stay > rest, stays), 0]


def combined(measured: Measured) -> NDArray[np.float64]:
    """Return ``error contribution^p``, (M,).

    The error is exact for one splat. The more of its neighbours go too, the more it matters how
    much of the picture the splat covers, whatever lies behind it.
    """
    return np.asarray(measured.error * measured.contribution**EXPONENT)
