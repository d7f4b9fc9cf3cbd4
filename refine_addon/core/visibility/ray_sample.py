"""A sample of the pixels of all views: the rays through them, and the splats that they hit.

Of a few hundred pixels of each view, spread evenly, it is noted which splats their rays hit. What
these pixels show follows from that, with all splats or with any choice of them, without projecting
splats again. Two samples are taken, of different pixels: what is chosen by the *scoring rays* would
look better on them than it is, so the *validation rays* tell how good the pictures are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .. import spherical_harmonics
from ..execute import Progress, part, run_all, silent
from ..splats import Splats
from ..views import View, ViewSet
from . import projection
from .cast import cast, depth_complexity, pixels
from .projection import Footprints, Gaussians
from .rays import Rays
from .scene import Scene

VALIDATION_RAYS = 1 << 14
"""How many validation rays all views together have."""

MAX_VALIDATION_HITS = 1 << 24
"""About how many hits these may have together; dense scenes get fewer rays."""

SCORING_RAYS = 1 << 16
"""How many scoring rays all views together have."""

MAX_SCORING_HITS = 3 << 24
"""About how many hits these may have together. Each takes 16 bytes."""

MAX_HITS_OF_VIEW = 1 << 21
"""About how many hits the rays of one view may have: casting takes 60 bytes for each, and views are
cast side by side. Only few views of dense scenes reach it."""

MAX_RAYS_OF_VIEW = 60_000
"""A view has at most so many rays: their numbers fit into 16 bits, see `cast`."""

VALIDATION_VIEWS = 24
"""What takes longer to compare than deleted splats (absorbed ones, written files) is compared in at
most about so many views."""


class RaySample:
    """Rays of all views into one scene.

    Parameters
    ----------
    views : sequence of (View, float)
        Views and their weights, in an order given by the scene; see `ViewSet.by_distance`.
    gaussians : Gaussians
        What the rays may hit.
    splats : Splats
        What the Gaussians were made of, for their colours.
    few_views : bool
        Whether rays of only about `VALIDATION_VIEWS` of the views are wanted: enough to validate
        other splats by, not for a curve.
    scoring : bool
        Whether these are scoring rays; else they are validation rays.

    Attributes
    ----------
    splat_rows : (M,) int64
        Which of all splats each Gaussian is.
    share : float
        How many rays all views have together, as a part of what they usually have.
    rays : list of Rays or None
        Of each view; None where they have not been cast.
    """

    def __init__(
        self,
        views: Sequence[tuple[View, float]],
        gaussians: Gaussians,
        splats: Splats,
        *,
        few_views: bool = False,
        scoring: bool = False,
    ) -> None:
        self.views, self.splats, self.scoring, self.share = views, splats, scoring, 1.0
        self._step = max(math.ceil(len(views) / VALIDATION_VIEWS), 1) if few_views else 1
        self.splat_rows = np.asarray(gaussians.index)
        self.rays: list[Rays | None] = [None] * len(views)

    def colors(self, number: int, rays: Rays) -> NDArray[np.float64]:
        """Colours in which view `number` sees what its rays hit, (3, u)."""
        return colors_from(self.splats, self.splat_rows[rays.hit], self.views[number][0])

    def wants(self, number: int) -> bool:
        """Whether the rays of a view are wanted and have not been cast yet."""
        return self.rays[number] is None and number % self._step == 0

    def cast_all(
        self, gaussians: Gaussians, scene: Scene, progress: Progress, threads: int | None
    ) -> None:
        """Project all Gaussians into the views, and cast the rays that are wanted."""

        def cast_one(number):
            with np.errstate(under="ignore"):
                footprints = projection.project(gaussians, scene, self.views[number][0])
                self.rays[number] = cast_view(
                    self.views, number, footprints, scoring=self.scoring, share=self.share
                )

        run_all(
            cast_one, filter(self.wants, range(len(self.views))),
            progress=progress, what="casting rays", threads=threads,
        )  # fmt: skip

    def seeing(self) -> list[int]:
        """Numbers of the views whose rays hit a splat."""
        return [k for k, rays in enumerate(self.rays) if rays is not None and len(rays.ray)]

    def validating(self) -> list[int]:
        """Numbers of the views that validate where comparing in all would take long."""
        seeing = self.seeing()
        return seeing[:: max(math.ceil(len(seeing) / VALIDATION_VIEWS), 1)]

    def hits_of_ray(self) -> float:
        """How many splats a ray hits on average, hidden ones included."""
        every = [rays for rays in self.rays if rays is not None]
        return sum(len(rays.ray) for rays in every) / max(sum(rays.count for rays in every), 1)


def validation_rays(
    splats: Splats, views: ViewSet, *, progress: Progress = silent, threads: int | None = None
) -> RaySample:
    """Validation rays of all views, for scores that did not project splats.

    Parameters
    ----------
    splats : Splats
        In the frame and unit of the views.
    views : ViewSet
    progress : callable, optional
    threads : int, optional

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.
    """
    gaussians, scene, _ = projection.prepare(
        splats, views, progress=part(progress, 0.0, 0.2), threads=threads
    )
    sample = RaySample(views.by_distance(), gaussians, splats)
    sample.cast_all(gaussians, scene, part(progress, 0.2, 1.0), threads)
    return sample


def cast_view(
    views: Sequence[tuple[View, float]],
    number: int,
    footprints: Footprints,
    *,
    scoring: bool = False,
    share: float = 1.0,
) -> Rays:
    """Rays of one of some views.

    Parameters
    ----------
    views : sequence of (View, float)
        All views of the sample, which share its rays evenly.
    number : int
        Which of them.
    footprints : Footprints
        In that view.
    scoring : bool
        Whether these are scoring rays, which go through other pixels than the validation rays.
    share : float
        See `RaySample`.
    """
    view = views[number][0]
    rays_of_all, hits_of_all = VALIDATION_RAYS, MAX_VALIDATION_HITS
    if scoring:
        rays_of_all, hits_of_all = SCORING_RAYS, MAX_SCORING_HITS
    most_rays = min(share * rays_of_all / len(views), MAX_RAYS_OF_VIEW)
    most_hits = min(share * hits_of_all / len(views), MAX_HITS_OF_VIEW)
    count = min(most_rays, most_hits / max(depth_complexity(footprints, view), 1.0))
    # Half a step of the sequence keeps the two samples apart in every view, however many there are.
    return cast(footprints, *pixels(view, number + 0.5 * scoring, count))


def colors_from(splats: Splats, rows: NDArray[np.int64], view: View) -> NDArray[np.float64]:
    """Colours in which a view sees some splats, (3, n), at least 0.

    All harmonics count. By the constant alone, which the rest of scoring uses, the estimated PSNR
    was 1.2 dB too high on an outdoor scene.

    Parameters
    ----------
    splats : Splats
        In the frame of the view.
    rows : (n,) int64
        Which of them.
    view : View
    """
    direction = splats.means[rows].astype(np.float64) - view.center
    length = np.linalg.norm(direction, axis=1)
    direction /= np.maximum(length, np.finfo(np.float64).tiny)[:, None]
    colors = spherical_harmonics.colors(direction, splats.sh_dc[rows], splats.sh_rest[rows])
    return np.ascontiguousarray(colors.T.clip(0.0, projection.BRIGHTEST))
