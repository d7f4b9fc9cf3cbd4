"""What refitting is worth: after each way to begin, round after round, and made cheaper.

::

    python -m benchmarks.tables.refits SCENE_DIR ... --ratio .5
    python -m benchmarks.tables.refits 160000 1000000 --ways "as it is"
    python -m benchmarks.tables.refits SCENE_DIR --views 8 --near --compared 16

Run as a command, it says how long refitting takes, over what merging took in the same run (all
views score, one thread, seconds of the processor), and what it gained, on rays that nothing was
learned from. For a scene's folder see `evaluate`; a number makes one of `speed.capture` of so many
splats. With ``--views`` so many views score, spread out, or by ``--near`` those nearest to the
first, so that most of the held-out views are far from them. With ``--compared`` so many held-out
views are rendered before and after each round.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from refine_addon import core
from refine_addon.core import ClosedForm, Merge, Method, Occlusion
from refine_addon.core.execute import silent, within
from refine_addon.core.refit.refit import Refitted, refit_on
from refine_addon.core.refit.round_rays import RoundRays
from refine_addon.core.selection import Budget
from refine_addon.core.splats import Splats
from refine_addon.core.views import ViewSet

from ..speed import capture
from .evaluate import Evaluator, read_scene
from .methods import Task

STARTS: dict[str, Method] = {
    "merged": Merge(views=0),
    "deleted by occlusion": Occlusion(views=0),
    "deleted by the closed form": ClosedForm(views=0),
}
"""What refitting begins with."""


class Cheaper(NamedTuple):
    """Refitting made cheaper.

    - views, rays: Shares of the views that it casts rays from, and of the rays that it casts.
    """

    rounds: int | None = None
    views: float = 1.0
    rays: float = 1.0


CHEAPER = {
    "as it is": Cheaper(),
    "1 round": Cheaper(rounds=1),
    "2 rounds": Cheaper(rounds=2),
    "half of the views": Cheaper(views=0.5),
    "a quarter of the views": Cheaper(views=0.25),
    "half of the rays": Cheaper(rays=0.5),
    "twice the rays": Cheaper(rays=2.0),
}
"""Ways to spend less, or more, on it."""


@dataclass(frozen=True)
class Curve:
    """Refitting at one ratio.

    - name: One of `STARTS` or of `CHEAPER`, which begin with "merged".
    - start: Processor seconds until refitting begins, all threads together.
    - rounds, list of (float, float): Processor seconds since then and PSNR on held-out views
      against renders of the unpruned splats, dB: before the first round, and after each that
      gained.
    """

    name: str
    ratio: float
    start: float
    rounds: list[tuple[float, float]]


def measure(task: Task, evaluator: Evaluator, ratios: Sequence[float]) -> list[Curve]:
    """Refit what each start leaves, and what merging leaves by each cheaper way."""
    curves = []
    for ratio in ratios:
        for name, method in STARTS.items():
            left, start = _left(task.splats, task.views, ratio, method)
            ways = CHEAPER if method.changes else {name: Cheaper()}
            for label, way in ways.items():
                label = name if way == Cheaper() else label
                rounds = [
                    (seconds, evaluator.evaluate(refitted.splats).renders.mean["psnr"])
                    for seconds, refitted in _timed(left, task.splats, task.views, way)
                ]
                curves.append(Curve(label, ratio, start, rounds))
                print(f"  {curves[-1]}", flush=True)
    return curves


def _left(splats: Splats, views: ViewSet, ratio: float, method: Method) -> tuple[Splats, float]:
    """Return what refitting begins with, made by one thread, and seconds, all that it took."""
    began = time.process_time()
    result = core.prune(splats, views, Budget(ratio=ratio), method, threads=1)
    return result.splats, time.process_time() - began


def _timed(
    left: Splats, splats: Splats, views: ViewSet, way: Cheaper
) -> Iterator[tuple[float, Refitted]]:
    """Yield seconds and result, round after round; what comparing takes is left out."""
    views = views.spread(max(round(way.views * len(views)), 1))
    began, compared = time.process_time(), 0.0
    with within(cores=1):
        rays = RoundRays.of(splats, views, round(way.rays * len(left)), silent)
        for refitted in refit_on(rays, left, way.rounds):
            pause = time.process_time()
            yield pause - began - compared, refitted
            compared += time.process_time() - pause


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line for each scene and way; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.tables.refits",
        description="How long refitting takes over merging, and what it gains.",
    )
    parser.add_argument("scenes", nargs="+", metavar="SCENE_DIR | SPLATS")
    parser.add_argument("--ratio", type=float, default=0.5)
    parser.add_argument("--ways", nargs="+", choices=CHEAPER, default=list(CHEAPER)[:2])
    parser.add_argument("--views", type=int, default=0, help="how many score; 0: all")
    parser.add_argument("--near", action="store_true", help="those nearest to the first view")
    parser.add_argument("--compared", type=int, default=0, help="held-out views that are rendered")
    options = parser.parse_args(arguments)
    for name in options.scenes:
        splats, views, evaluator = _scene(name, options.compared)
        views = _scoring(views, options.views, near=options.near)
        left, seconds = _left(splats, views, options.ratio, STARTS["merged"])
        told = f"{name}, {options.ratio:.0%}, {len(views)} views: merged in {seconds:.1f} s"
        print(told + _held_out(evaluator, left), flush=True)
        for way in options.ways:
            for taken, refitted in _timed(left, splats, views, CHEAPER[way]):
                gained = f"{refitted.psnr_before:.2f} -> {refitted.psnr:.2f} dB"
                told = f"{way}, {refitted.rounds} rounds: {taken:.1f} s, {taken / seconds:.2f} x"
                held_out = _held_out(evaluator, refitted.splats)
                print(f"  {told}, {gained}{held_out}", flush=True)
    return 0


def _scene(name: str, compared: int) -> tuple[Splats, ViewSet, Evaluator | None]:
    """Return splats and scoring views of a folder or of a number, and what compares."""
    if name.isdigit():
        return capture.make(int(name)), capture.cameras(), None
    scene = read_scene(name)
    if not compared:
        return scene.splats, scene.train, None
    held_out = scene.test.spread(compared)
    return scene.splats, scene.train, Evaluator(scene.splats, held_out, metrics=("psnr",))


def _scoring(views: ViewSet, count: int, *, near: bool) -> ViewSet:
    """Return so many views, spread out or those nearest to the first; all for 0."""
    if not 0 < count < len(views):
        return views
    if not near:
        return views.spread(count)
    distances = np.linalg.norm(views.centers - views.centers[0], axis=1)
    return ViewSet(tuple(views[row] for row in np.argsort(distances, kind="stable")[:count]))


def _held_out(evaluator: Evaluator | None, splats: Splats) -> str:
    """Return what the held-out views show, for a line."""
    if evaluator is None:
        return ""
    return f", held out {evaluator.evaluate(splats).renders.mean['psnr']:.2f} dB"


if __name__ == "__main__":
    sys.exit(main())
