"""What each splat is worth while others go, told by scoring rays.

Splats hide each other, so what one is worth rises as those around it go. Rays that were cast once
(`ray_sample`) tell it at any time without measuring the views again: the hits of a ray are known,
front to back, and so is what it would show without any one of them. Few rays hit a small splat, so
what they tell is weighed against what the views measured of all splats (`measuring`)::

    error_i = (n_i  error on the rays now  +  KNOWN  error measured, grown) / (n_i + KNOWN)

n_i is how many rays hit the splat while all were there. A measured sum grows as the rays tell, see
`_grown`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, part, run_all
from ..visibility.measuring import Measured
from ..visibility.ray_sample import RaySample

KNOWN = 10.0
"""What was measured counts as much as so many rays."""

_LOADING = 0.3  # share of the time that getting colours takes, to show progress


class RemovalRounds:
    """M Gaussians, of which ever more are removed.

    Parameters
    ----------
    scoring_rays : RaySample
        Cast while all were there.
    measured : Measured
        What the views saw of them then.
    progress : callable
    threads : int, optional

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.

    Notes
    -----
    Memory: 16 bytes for every hit, of which there are at most about
    `ray_sample.MAX_SCORING_HITS`.
    """

    def __init__(
        self,
        scoring_rays: RaySample,
        measured: Measured,
        progress: Progress,
        threads: int | None,
    ) -> None:
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

    def remove_and_measure(self, left: NDArray[np.int64], progress: Progress) -> Measured:
        """Remove all Gaussians but some; return what each of these is worth now, (n,).

        Parameters
        ----------
        left : (n,) int64
            Rows of those that stay, ascending; none that was removed before.
        progress : callable

        Raises
        ------
        Cancelled
            If `progress` answers ``False``.
        """
        nothing_gone = len(left) == len(self._rays_hitting)
        now = self._first if nothing_gone else self._sums(left, progress)
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
        nothing_gone = len(left) == len(keep)

        def removal_errors(number):
            rays, colors, area = self._views[number]
            if not nothing_gone:
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
    growth = np.divide(
        now + scene_growth * prior, both, out=np.ones_like(measured), where=both > 0.0
    )
    return np.asarray(measured * growth)
