"""What refitting is worth: after each way to begin, round after round, and made cheaper."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from refine_addon import core
from refine_addon.core import Settings
from refine_addon.core.refitting.refit import SIMPLER, Refit, refit_on
from refine_addon.core.refitting.round_rays import RoundRays
from refine_addon.core.selection import Budget
from refine_addon.core.work import silent

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from refine_addon.core.splats import Splats
    from refine_addon.core.views import ViewSet

    from .evaluate import Evaluator
    from .methods import Task

STARTS = {
    "absorbed": ("occlusion", "absorb"),
    "deleted by auto": ("auto", "unchanged"),
    "deleted by the closed form": ("closed-form", "unchanged"),
}
"""What refitting begins with: method and what survivors become before."""


class Cheaper(NamedTuple):
    """Refitting made cheaper.

    Attributes
    ----------
    settings : Refit
    views, rays : float
        Shares of the views that it casts rays from, and of the rays that it casts.
    """

    settings: Refit = Refit()
    views: float = 1.0
    rays: float = 1.0


CHEAPER = {
    "as it is": Cheaper(),
    "colours and opacities alone": Cheaper(Refit(geometry=False), rays=SIMPLER),
    "1 round": Cheaper(Refit(rounds=1)),
    "2 rounds": Cheaper(Refit(rounds=2)),
    "half of the views": Cheaper(views=0.5),
    "a quarter of the views": Cheaper(views=0.25),
    "half of the rays": Cheaper(rays=0.5),
    "twice the rays": Cheaper(rays=2.0),
}
"""Ways to spend less, or more, on it."""


@dataclass(frozen=True)
class Curve:
    """Refitting at one ratio.

    Attributes
    ----------
    name : str
        One of `STARTS` or of `CHEAPER`, which begin with "absorbed".
    ratio : float
        Share removed.
    start : float
        Processor seconds until refitting begins, all threads together.
    rounds : list of (float, float)
        Processor seconds since then and PSNR on held-out views against renders of the unpruned
        splats, dB: before the first round, and after each that gained.
    """

    name: str
    ratio: float
    start: float
    rounds: list[tuple[float, float]]


def measure(task: Task, evaluator: Evaluator, ratios: Sequence[float]) -> list[Curve]:
    """Refit what each start leaves, and what absorbing leaves by each cheaper way."""
    curves = []
    for ratio in ratios:
        for name, (method, survivors) in STARTS.items():
            began = time.process_time()
            left = _left(task, ratio, method, survivors)
            start = time.process_time() - began
            ways = CHEAPER if survivors == "absorb" else {name: Cheaper()}
            for label, way in ways.items():
                label = name if way == Cheaper() else label  # noqa: PLW2901
                rounds = list(_timed(left, task, way, evaluator))
                curves.append(Curve(label, ratio, start, rounds))
                print(f"  {curves[-1]}", flush=True)
    return curves


def _left(task: Task, ratio: float, method: str, survivors: str) -> Splats:
    """Return what refitting begins with, made by one thread, whose time is all that it took."""
    settings, budget = Settings(method, views=0), Budget(ratio=ratio)
    result = core.prune(task.splats, task.views, budget, settings, survivors=survivors, threads=1)
    return result.survivors(task.splats)


def _timed(
    left: Splats, task: Task, way: Cheaper, evaluator: Evaluator
) -> Iterator[tuple[float, float]]:
    """Yield seconds and PSNR, round after round; what comparing takes is left out."""
    views: ViewSet = task.views.spread(max(round(way.views * len(task.views)), 1))
    began, compared = time.process_time(), 0.0
    rays = RoundRays.of(task.splats, views, round(way.rays * len(left)), silent, 1)
    for refitted in refit_on(rays, left, way.settings, threads=1):
        pause = time.process_time()
        seconds = pause - began - compared
        yield seconds, evaluator.evaluate(refitted.splats).renders.mean["psnr"]
        compared += time.process_time() - pause
