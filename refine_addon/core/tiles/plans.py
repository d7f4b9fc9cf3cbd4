"""What the steps of a prune over tiles are expected to cost; see `core/costs.py`."""

from __future__ import annotations

import math

from .. import costs
from ..costs import Cost, Images, Plan
from ..merging.merge import ALONE, stage_counts
from ..pipeline.absorb_splats import FIRST
from ..refit.refit import Refit
from ..refit.round_rays import limits
from ..scoring.occlusion import survivors_of_rounds
from ..task import Settings
from . import absorbing


def scoring(
    count: int, images: Images, settings: Settings, settled: int | None, *, once: bool
) -> list[Plan]:
    """Return the costs of getting tiles ready, of scoring, and of saving scores with a curve.

    Parameters
    ----------
    count : int
        How many splats there are.
    images : Images
        Of the views that score.
    settings : Settings
    settled : int or None
        See `occlusion.score`.
    once : bool
        Whether to score by occlusion in one round, as absorbing needs it.
    """
    views = images.views
    if settings.method == "closed-form" and not once:
        return [[], [Cost("closed form", count, views)], []]
    stays = [count] if once else survivors_of_rounds(count, settings.occlusion.rounds, settled)
    ready, *scored = costs.occlusion(count, images, stays)
    *_, curve = costs.scoring(count, images, settings.method, stays)
    curve = [Cost("estimating", count, views)] if once else curve
    return [ready, costs.joined(scored), curve]


def making(count: int, left: int, images: Images, refit: Refit | None) -> list[Plan]:
    """Return the costs of absorbing, of refitting if asked, and of estimating what is left.

    Parameters
    ----------
    count, left : int
        Splats before and after.
    images : Images
    refit : Refit or None
        How to refit; None where survivors are not refitted.
    """
    begin = max(count - math.floor(FIRST * count), left)
    alone = absorbing.ALONE if begin > absorbing.REGION else ALONE
    after = stage_counts(begin, left, alone)
    absorbed = costs.joined(costs.absorbing(begin, after, images))
    refitted: Plan = []
    if refit is not None:
        rays, rounds = limits(left)[0], refit.expected_rounds(left)
        refitted = costs.joined(costs.refitting(count, left, images.views, rays, rounds))
    return [absorbed, refitted, costs.comparing(left, images.views)]
