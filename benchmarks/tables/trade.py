"""The trade between quality, time and memory, measured: writes docs/trade.md and its plots.

    python -m benchmarks.tables.trade [SCENE_DIR ...]

SCENE_DIR is any folder that `evaluate` reads: ``point_cloud.ply``, ``cameras.json``, and optionally
``split.json`` and ``images``. Without one, the committed room is measured.

All methods get the same splats in memory and the same scoring views: those that are not held out,
at most ``--views``, spread evenly. Time is that of scoring and pruning, by the clock and of the
processor, the median of ``--runs`` runs (fewer where one takes long), after one on a single view
that does not count and compiles what is compiled. Memory is what the process had at its peak beyond
what it had before.

Of several scenes, training on the photos and the million splats are measured for the first only.
"""

from __future__ import annotations

import argparse
import gc
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from refine_addon.core import execute
from refine_addon.core.errors import RefineError
from refine_addon.core.scores import Scores
from refine_addon.core.selection import Budget, select
from refine_addon.core.splats import Splats
from refine_addon.core.views import ViewSet

from ..baselines import splat_transform
from ..renderer import rasterizer
from ..renderer.rasterizer import Statistics
from . import (
    estimate,
    evaluate,
    finetune,
    methods,
    million,
    refits,
    trade_report,
    variants,
)
from .cost import Cost
from .methods import Method, Task
from .results import Measured, Row

ROOT = Path(__file__).resolve().parents[2]
ROOM = ROOT / "tests/data/room_small"
PATIENCE = 40.0
"""Seconds after which nothing is run once more for the median."""
FAILURES = (
    RefineError,
    subprocess.SubprocessError,
    ArithmeticError,
    LookupError,
    TypeError,
    ValueError,
)
ONCE = ("finetune", "million")
"""Parts that take long and are measured for the first scene only."""
PARTS = ("methods", "estimate", "refits", *ONCE, "ablation")


class Comparison:
    """Compares reduced splats from held-out and from scoring views."""

    def __init__(
        self, scene: evaluate.Scene, scoring: ViewSet, options: argparse.Namespace
    ) -> None:
        compared = {"held-out": scene.test, "scoring": scoring.spread(options.compared)}
        # FLIP takes longer than all the rest, and the scoring views are not what counts.
        plain = [metric for metric in options.metrics if metric != "flip"]
        metrics = {"held-out": options.metrics, "scoring": plain or options.metrics}
        self.evaluators = {
            name: evaluate.Evaluator(scene.splats, views, scene.pictures, metrics=metrics[name])
            for name, views in compared.items()
        }

    def __call__(self, splats: Splats) -> dict[tuple[str, str], dict[str, float]]:
        """Return the mean of every metric."""
        found = {}
        for name, evaluator in self.evaluators.items():
            evaluation = evaluator.evaluate(splats)
            found[name, "renders"] = evaluation.renders.mean
            if evaluation.pictures is not None:
                found[name, "pictures"] = evaluation.pictures.mean
        return found


def measured(work: Callable[[], Any], runs: int) -> tuple[Any, Cost]:
    """Do `work` up to `runs` times; return its last result and what it took."""
    seconds, busy, peak, result = [], [], None, None
    while len(seconds) < runs and (not seconds or sum(seconds) < PATIENCE):
        result = None
        gc.collect()
        before, worked = _start_peak(), _busy()
        start = time.perf_counter()
        result = work()
        seconds.append(time.perf_counter() - start)
        after = splat_transform.memory("VmHWM")
        execute.end_idle()  # the next run starts them too
        busy.append(_busy() - worked)
        if before is not None and after is not None:
            peak = max(peak or 0, after - before)
    cost = Cost(statistics.median(seconds), statistics.median(busy), len(seconds), peak)
    return result, cost


def _busy() -> float:
    """Return the processor's seconds of this process and of those that have ended, so far."""
    whose = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(splat_transform.processor_seconds(each) for each in whose)


def _start_peak() -> int | None:
    """Forget the peak of this process's memory; return what it holds now."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return None
    return splat_transform.memory("VmRSS")


def measure_method(
    method: Method, task: Task, ratios: Sequence[float], compare: Comparison, runs: int,
    rendering: tuple[Statistics | None, Cost],
) -> list[Row]:  # fmt: skip
    """Measure one method at all ratios."""
    rows = []
    scores, scoring = None, Cost(0.0, 0.0, runs, None)
    if method.score is not None:
        score = method.score
        scores, scoring = measured(lambda: score(task, rendering[0]), runs)
        if method.rendered:
            scoring = scoring.plus(rendering[1])
    for ratio in ratios:
        asked = len(task.splats) - (Budget(ratio=ratio).removals(len(task.splats)) or 0)
        left, cost = _reduced(method, task, (ratio, asked), scores, runs)
        cost = cost.plus(scoring) if scores is not None else cost
        rows.append(Row(method, ratio, len(left), asked, cost, compare(left)))
        psnr = rows[-1].quality["held-out", "renders"]["psnr"]
        print(f"  {method.name:28} {ratio:4.0%} {psnr:7.2f} dB {cost.seconds:8.2f} s", flush=True)
    return rows


def _reduced(
    method: Method,
    task: Task,
    goal: tuple[float, int],
    scores: Scores | None,
    runs: int,
) -> tuple[Splats, Cost]:
    """Return what a method leaves at one ratio, and the cost of that besides its scores."""
    ratio, keep_count = goal
    if scores is not None:
        budget = Budget(ratio=ratio)
        return measured(lambda: task.splats.take(select(scores, budget)), runs)
    if method.reduce is not None:
        reduce = method.reduce
        return measured(lambda: reduce(task, keep_count, ratio), runs)
    found = [method.run(task, keep_count) for _ in range(runs)] if method.run else []
    seconds = statistics.median(run.seconds for _, run in found)
    busy = statistics.median(run.busy for _, run in found)
    return found[-1][0], Cost(seconds, busy, runs, found[-1][1].peak_bytes)


def leave(method: Method, task: Task, ratio: float) -> Splats:
    """Return what a method that needs no rendered statistics leaves at one ratio."""
    if method.score is not None:
        return task.splats.take(select(method.score(task, None), Budget(ratio=ratio)))
    count = len(task.splats) - (Budget(ratio=ratio).removals(len(task.splats)) or 0)
    return _reduced(method, task, (ratio, count), None, 1)[0]


def measure(folder: Path, options: argparse.Namespace, parts: Collection[str]) -> Measured:
    """Measure the `parts` of one scene."""
    scene = evaluate.read_scene(folder)
    splats = methods.in_memory(scene.splats)
    scoring = scene.train.spread(options.views)
    task = Task(splats, scoring, folder / "point_cloud.ply")
    about = trade_report.facts(scene, scoring, options.compared)
    found = Measured(folder.resolve().name, about, iterations=options.iterations)
    compare = Comparison(scene, scoring, options)
    if "methods" in parts:
        found.unpruned = compare(splats)
        _measure_methods(task, compare, found, options)
    # An hour's measurements are not lost because one of them fails; it is said, and is an error.
    for name, part in _parts(task, scene, compare.evaluators["held-out"], options).items():
        if name in parts:
            with _noted(name, found.failed):
                setattr(found, name, part())
    return found


def _parts(
    task: Task, scene: evaluate.Scene, held_out: evaluate.Evaluator, options: argparse.Namespace
) -> dict[str, Callable[[], Any]]:
    """Return how each part but the methods is measured, under its name in `Measured`."""
    splats, scoring, ratios = task.splats, task.views, options.ratios
    offered = {method.name: method for method in methods.everything()}
    budgets = [Budget(ratio=ratio) for ratio in ratios]

    def left(name: str, ratio: float) -> Splats:
        return leave(offered[name], task, ratio)

    def tuned() -> list[finetune.Tuned]:
        if not scene.pictures:
            return []
        training = (scoring, scene.pictures)
        return finetune.measure(left, finetune.METHODS, training, held_out, options.iterations)

    return {
        "estimate": lambda: list(estimate.measure(splats, scoring, budgets)),
        "refits": lambda: refits.measure(task, held_out, ratios),
        "finetune": tuned,
        "million": lambda: million.measure(splats, scoring, scene.test, options.million),
        "ablation": lambda: variants.measure(variants.ABLATION, task, held_out, ratios),
    }


@contextmanager
def _noted(what: str, failed: list[str]) -> Iterator[None]:
    """Note what fails and go on."""
    try:
        yield
    except FAILURES as error:
        failed.append(f"{what}: {type(error).__name__}: {error}")
        print(f"  {failed[-1]}", file=sys.stderr, flush=True)


def _measure_methods(
    task: Task, compare: Comparison, found: Measured, options: argparse.Namespace
) -> None:
    """Measure all methods, or those asked for."""
    offered = methods.everything()
    if options.rap is not None:
        offered.append(methods.rap_network(options.rap))
    chosen = [
        method for method in offered if options.methods is None or method.name in options.methods
    ]
    _warm_up(task, chosen)
    rendering: tuple[Statistics | None, Cost] = (None, Cost(0.0, 0.0, options.runs, None))
    if any(method.rendered for method in chosen):
        rendering = measured(
            lambda: rasterizer.accumulate_statistics(task.splats, task.views), options.runs
        )
    for method in chosen:
        with _noted(method.name, found.failed):
            found.rows += measure_method(
                method, task, options.ratios, compare, options.runs, rendering
            )


def _warm_up(task: Task, chosen: Sequence[Method]) -> None:
    """Compile what is compiled, on one view, so that no method pays for it."""
    one = Task(task.splats.take(slice(0, 2000)), task.views.spread(1), task.file)
    rasterizer.render_with_statistics(one.splats, one.views[0])
    for method in chosen:
        if method.name == "pup-3dgs" and method.score is not None:
            method.score(one, None)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the scenes and write the report; return the exit code."""
    options = _parse(arguments)
    if "flip" in options.metrics and not evaluate.flip_installed():
        print(evaluate.FLIP_MISSING, file=sys.stderr)
        options.metrics.remove("flip")
    if splat_transform.find() is None:
        print(splat_transform.MISSING, file=sys.stderr)
    scenes = []
    for folder in options.scenes:
        print(folder, flush=True)
        try:
            parts = set(options.parts) - set(ONCE if scenes else ())
            scenes.append(measure(folder, options, parts))
        except (RefineError, ValueError) as error:
            print(f"{folder}: {error}", file=sys.stderr)
            return 1
    trade_report.write(options.output, scenes, options)
    print(f"wrote {options.output}")
    return int(any(scene.failed for scene in scenes))


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    summary = (__doc__ or "").split("\n", maxsplit=1)[0]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.tables.trade", description=summary)
    parser.add_argument("scenes", type=Path, nargs="*", metavar="SCENE_DIR", default=[ROOM])
    parser.add_argument("--ratios", type=float, nargs="+", default=[0.3, 0.5, 0.7, 0.9])
    parser.add_argument("--methods", nargs="+", metavar="NAME", help="default: all")
    parser.add_argument("--rap", type=Path, metavar="FILE", help="trained weights: measure RAP too")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--metrics", nargs="+", choices=evaluate.METRICS,
                        default=list(evaluate.METRICS))  # fmt: skip
    parser.add_argument("--runs", type=int, default=3, help="of which the median counts")
    parser.add_argument("--views", type=int, default=64, help="that decide, at most; 0: all")
    parser.add_argument("--compared", type=int, default=8, help="how many of them are compared")
    parser.add_argument("--iterations", type=int, default=finetune.ITERATIONS, help="of training")
    parser.add_argument("--million", type=int, default=million.COUNT, metavar="N",
                        help="into how many splats the scene is split")  # fmt: skip
    parser.add_argument("--output", type=Path, default=ROOT / "docs/trade.md")
    options = parser.parse_args(arguments)
    options.scenes = options.scenes or [ROOM]
    return options


if __name__ == "__main__":
    sys.exit(main())
