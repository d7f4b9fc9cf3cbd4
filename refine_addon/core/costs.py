"""What the steps of a run are expected to take, by counts that are known beforehand.

A run puts these right as it goes by; see `pace`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from .views import View

SECONDS = {
    "activating": (0.0, 1.4e-6, 0.0, 1.0),
    "prior": (0.0006, 0.9e-6, 0.0, 1.0),
    "closed form": (0.0003, 0.5e-6, 5e-9, 0.3),
    "measuring": (0.0, 0.0, 0.36e-6, 0.0),
    "casting": (0.0025, 0.0, 0.08e-6, 0.0),
    "weighing": (0.0, 5e-6, 0.0, 1.0),
    "loading": (0.003, 0.0, 0.08e-6, 0.1),
    "sorting": (0.0, 0.37e-6, 0.0, 1.0),
    "ordering": (0.0012, 1.0e-6, 0.0, 0.5),
    "aligning": (0.08, 0.0, 0.0, 1.0),
    "estimating": (0.0065, 0.0, 0.13e-6, 0.0),
    "selecting": (0.25, 1.1e-6, 0.0, 0.8),
    "comparing": (0.004, 0.0, 0.15e-6, 0.5),
    "picturing": (0.02, 0.0, 0.5e-6, 0.1),
    "merging": (0.0, 11e-6, 0.0, 0.5),
    "refit casting": (0.0, 0.0, 0.72e-6, 0.0),
    "refit solving": (0.0, 12.7e-6, 0.0, 0.9),
    "refit checking": (0.0, 0.0, 0.14e-6, 0.0),
    "writing": (0.0, 0.7e-9, 0.0, 1.0),
    "rewriting": (0.0, 5e-9, 0.0, 1.0),
    "cleaning": (0.04, 0.0, 1.5e-6, 0.2),
    "drawing": (0.5, 0.0, 1e-6, 0.0),
}
"""Of each kind of work: seconds of one core for a view, for a splat (or byte), and for each splat
in each view; and which share of that one core does alone. By processor time of runs of 40,000 to
2 million splats, see `benchmarks.speed.recorded`."""


def by_views(kind: str) -> bool:
    """Return whether a kind of work looks at splats in views: how many each sees, it cannot know.

    In other scenes all such work takes longer or shorter than expected by about one factor.
    """
    return SECONDS[kind][2] > 0.0


BETWEEN = 12
"""So many views at most tell what lies between those that score."""


SAMPLE = 1 << 16
"""How many splats are enough to choose the floor's weights."""

PIXEL = 0.5
"""A pixel of a view takes as long to measure as so many splats."""


class Cost(NamedTuple):
    """What some work is expected to take.

    Attributes
    ----------
    kind : str
        Of `SECONDS`. Work of one kind takes longer or shorter than expected by about one factor.
    size : float
        Splats, or bytes.
    views : int
    """

    kind: str
    size: float
    views: int = 1

    def seconds(self, threads: int) -> float:
        """Return how long it takes on so many cores."""
        of_view, of_splat, of_both, alone = SECONDS[self.kind]
        total = of_view * self.views + (of_splat + of_both * self.views) * self.size
        return total * (alone + (1.0 - alone) / threads)


Plan = list[Cost]


class Images(NamedTuple):
    """The images of views: how many, and the pixels of each.

    Attributes
    ----------
    views : int
    pixels : float
        Mean of all.
    """

    views: int
    pixels: float

    @classmethod
    def of(cls, views: Iterable[View]) -> Images:
        """Return those of views."""
        sizes = [view.width * view.height for view in views]
        return cls(len(sizes), sum(sizes) / max(len(sizes), 1))

    def measuring(self, count: float, views: int | None = None) -> Cost:
        """Return the cost of measuring splats from some of the views, by default all."""
        return Cost(
            "measuring", count + PIXEL * self.pixels, self.views if views is None else views
        )


def weighing(count: int) -> Cost:
    """Return the cost of finding the floor's weights, by a sample of the splats."""
    return Cost("weighing", min(count, SAMPLE))


def preparing(count: int, views: int) -> list[Plan]:
    """Return the costs of getting splats ready to be measured, and of the floor of their scores."""
    return [[Cost("activating", count)], [Cost("prior", count, views)]]


def ranking(count: int, views: int, stays: Sequence[int] | None = None) -> list[Plan]:
    """Return the costs of ordering measured splats: the floor, rays between, rays, each round.

    Parameters
    ----------
    count, views : int
    stays : sequence of int, optional
        How many splats stay after each round; by default one round does.
    """
    between = [Cost("casting", count, min(views, BETWEEN))]
    if stays is None or len(stays) == 1:
        return [[weighing(count)], between, [], [Cost("sorting", count)]]
    return [
        [weighing(count)],
        between,
        [Cost("loading", count, views)],
        [Cost("sorting", count)],  # what the rays tell of all splats came with loading
        *([Cost("ordering", left, views)] for left in stays[:-1]),
    ]


def occlusion(count: int, images: Images, stays: Sequence[int] | None = None) -> list[Plan]:
    """Return the costs of scoring by occlusion: getting ready, measuring, ordering."""
    return [
        joined(preparing(count, images.views)),
        [images.measuring(count)],
        joined(ranking(count, images.views, stays)),
    ]


def scoring(count: int, images: Images, method: str, stays: Sequence[int]) -> list[Plan]:
    """Return the costs of scores by a method, of rays where it has none, of checks, of a curve."""
    views = images.views
    if method == "closed-form":
        rays = [Cost("activating", count), Cost("casting", count, views)]
        scored, by_rays = [Cost("closed form", count, views)], rays
    else:
        scored, by_rays = joined(occlusion(count, images, stays)), []
    # The curve ends where the rounds do.
    share = 1.0 - (stays[-2] if len(stays) > 1 else count) / max(count, 1)
    curve = Cost("estimating", count, max(round((0.3 + 0.7 * share) * views), 1))
    return [scored, by_rays, [Cost("aligning", count)], [curve]]


def scoring_once(count: int, images: Images) -> list[Plan]:
    """Return the costs of scores by occlusion in one round, and of checks."""
    return [joined(occlusion(count, images)), [Cost("aligning", count)]]


def absorbing(count: int, left_after: Sequence[int], images: Images) -> list[Plan]:
    """Return the costs of stages of absorbing, two of each: measuring half of the views, merging.

    Parameters
    ----------
    count : int
    images : Images
    left_after : sequence of int
        How many splats each stage leaves. The first has been measured.
    """
    plans: list[Plan] = []
    for entering in [count, *left_after[:-1]][: len(left_after)]:
        again = [Cost("activating", entering), images.measuring(entering, images.views // 2)]
        measured = again if plans else []
        plans += [measured, [Cost("merging", entering)]]
    return plans


def comparing(count: int, views: int) -> Plan:
    """Return the costs of estimating a PSNR by casting the rays of some views again."""
    return [Cost("activating", count), Cost("comparing", count, views)]


def picturing(count: int, views: int) -> Plan:
    """Return the costs of comparing pictures of some views in patches."""
    return [Cost("activating", count), Cost("picturing", count, views)]


def refit_round(original: int, survivors: int, views: int, rays: float) -> list[Plan]:
    """Return the costs of a round of refitting by so many rays: casting, solving, checking."""
    return [
        [Cost("refit casting", original + survivors, views)],
        [Cost("refit solving", rays)],
        [Cost("refit checking", survivors, views)],
    ]


def refitting(original: int, survivors: int, views: int, rays: float, rounds: int) -> list[Plan]:
    """Return the costs of refitting: getting ready, validation rays, rounds of so many rays."""
    return [
        [Cost("activating", original)],
        [Cost("refit checking", original + survivors, views)],
        rounds * joined(refit_round(original, survivors, views, rays)),
    ]


def seconds(plan: Plan) -> float:
    """Return how long work takes on one core, seconds."""
    return sum(cost.seconds(1) for cost in plan)


def joined(plans: Sequence[Plan]) -> Plan:
    """Return several plans as one."""
    return [cost for plan in plans for cost in plan]
