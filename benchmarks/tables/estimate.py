"""The estimated PSNR beside that of rendered pictures, by the views that score.

::

    python -m benchmarks.tables.estimate SCENE_DIR ... --ratios .3 .5 .7 .9 --psnr 40 --views 64

For a scene's folder see `evaluate`. The splats are deleted by occlusion's order, and absorbed; the
estimates are those of the reports. Every view that scores is rendered. "Expected" is what a result
without absorbing says of absorbing. With `--psnr` the pictures are those of that budget.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from refine_addon.core.errors import RefineError
from refine_addon.core.pipeline import Settings, prune
from refine_addon.core.selection import Budget

from .evaluate import Evaluator, Scene, read_scene

if TYPE_CHECKING:
    from collections.abc import Sequence

    from refine_addon.core.task import Result

HEADING = (
    f"{'scene':12}{'':10}{'budget':>12}{'removed':>9}{'estimate':>10}{'truth':>8}{'off by':>8}"
    f"{'expected':>10}{'seconds':>9}"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line for each scene, way and budget; return the exit code."""
    options = _parse(arguments)
    print(HEADING)
    errors: list[float] = []
    for folder in options.scenes:
        try:
            scene = read_scene(folder)
        except RefineError as error:
            sys.stderr.write(f"{error}\n")
            return 1
        errors += _measure(folder.name, scene, options)
    absolute = [abs(error) for error in errors]
    print(f"mean error {sum(absolute) / len(absolute):.2f} dB, largest {max(absolute):.2f} dB")
    return 0


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    summary = (__doc__ or "").split("\n", maxsplit=1)[0]
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.tables.estimate", description=summary
    )
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE_DIR")
    parser.add_argument("--ratios", type=float, nargs="*", default=[0.3, 0.5, 0.7, 0.9])
    parser.add_argument("--psnr", type=float, nargs="*", default=[40.0])
    parser.add_argument("--views", type=int, default=64, help="that score, at most")
    parser.add_argument("--only", choices=["delete", "absorb"], help="one of the two ways")
    return parser.parse_args(arguments)


def _measure(name: str, scene: Scene, options: argparse.Namespace) -> list[float]:
    """Print the lines of a scene; return by how much the estimates are off, dB."""
    evaluator = Evaluator(scene.splats, scene.train.spread(options.views), metrics=("psnr",))
    budgets = [Budget(ratio=ratio) for ratio in options.ratios]
    budgets += [Budget(psnr=psnr) for psnr in options.psnr]
    settings = Settings("occlusion", options.views)
    errors = []
    for absorb in [False, True]:
        way = "absorb" if absorb else "delete"
        if options.only not in (None, way):
            continue
        for budget in budgets:
            start = time.perf_counter()
            result = prune(scene.splats, scene.train, budget, settings, absorb=absorb)
            seconds = time.perf_counter() - start
            errors.append(_line(f"{name:12}{way:10}", scene, evaluator, result, seconds))
    return errors


def _line(start: str, scene: Scene, evaluator: Evaluator, result: Result, seconds: float) -> float:
    """Print a line; return by how much its estimate is off, dB."""
    left = result.absorbed.splats if result.absorbed else scene.splats.take(result.keep)
    truth = float(evaluator.evaluate(left).renders.mean["psnr"])
    said = result.report
    ((kind, value),) = said["budget"].items()
    estimate = said["estimated_psnr"]
    expected = "" if result.absorbed else f"{said['estimated_psnr_absorbed']:.1f}"
    print(
        f"{start}{f'{kind} {value:g}':>12}{1.0 - result.keep.mean():9.1%}{estimate:10.2f}"
        f"{truth:8.2f}{estimate - truth:+8.2f}{expected:>10}{seconds:9.1f}",
        flush=True,
    )
    return float(estimate - truth)


if __name__ == "__main__":
    sys.exit(main())
