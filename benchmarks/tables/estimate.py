"""The estimated PSNR beside that of rendered pictures, by the views that score.

::

    python -m benchmarks.tables.estimate SCENE_DIR ... --ratios .3 .5 .7 .9 --views 64

For a scene's folder see `evaluate`. The splats are deleted by occlusion's order, and merged; the
estimates are those of the reports. Every view that scores is rendered. "Expected" is what a result
of deleting says of merging. The last columns are of single views: by how much their estimates are
off on average and at most.

With `--between` the estimate of the views between is set beside the held-out views instead, with
the standard error of their mean, and it is said whether the report warns that few views see much.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from refine_addon.core import Merge, Method, Occlusion, Refit, prune
from refine_addon.core.errors import RefineError
from refine_addon.core.quality.curve import Way
from refine_addon.core.quality.psnr import with_quality
from refine_addon.core.selection import Budget
from refine_addon.core.splats import Splats
from refine_addon.core.views import ViewSet

from .evaluate import Evaluator, read_scene

METHODS: dict[Way, type[Method]] = {"delete": Occlusion, "merge": Merge, "refit": Refit}
WAYS: tuple[Way, ...] = ("delete", "merge")
HEADING = (
    f"{'scene':12}{'':10}{'removed':>9}{'estimate':>10}{'truth':>8}{'off by':>8}"
    f"{'expected':>10}{'seconds':>9}"
    f"{'views off':>11}{'at most':>9}"
)

BETWEEN_HEADING = (
    f"{'scene':12}{'':10}{'removed':>9}{'between':>10}{'held out':>10}{'+-':>8}{'off by':>8}"
    f"{'median':>8}"
)


@dataclass(frozen=True)
class Estimated:
    """An estimate and the truth.

    - estimate, truth: PSNR, dB; the truth is the mean over all views that score.
    - expected: What a result of deleting says of merging, dB.
    - single, (V,) float64: By how much the estimates of single views exceed the truth, dB.
    """

    way: Way
    removed: float
    estimate: float
    truth: float
    expected: float | None
    seconds: float
    single: NDArray[np.float64]

    @property
    def off(self) -> float:
        """By how much the estimate exceeds the truth, dB."""
        return self.estimate - self.truth


def measure(
    splats: Splats,
    views: ViewSet,
    budgets: Sequence[Budget],
    ways: Sequence[Way] = WAYS,
) -> Iterator[Estimated]:
    """Yield estimate and truth of every way and budget, by `views`, all of which score.

    - RefineError: if there is no estimate, since the views see too little.
    """
    evaluator = Evaluator(splats, views, metrics=("psnr",))
    for way in ways:
        for budget in budgets:
            start = time.perf_counter()
            result = prune(splats, views, budget, METHODS[way](views=0))
            seconds = time.perf_counter() - start
            estimate = result.report["estimated_psnr"]
            if estimate is None:
                raise RefineError(result.report["estimated_psnr_note"])
            renders = evaluator.evaluate(result.splats).renders
            truth, gone = renders.values["psnr"], 1.0 - float(result.keep.mean())
            assert result.scores is not None
            curve = with_quality(result.scores).quality
            assert curve is not None
            of_views = curve.of_views(gone, way)
            # Merged results are compared in validation views only.
            told = [place for place, name in enumerate(renders.names) if name in of_views]
            guess = np.array([of_views[renders.names[place]] for place in told])  # (V,)
            truth = np.asarray(truth)[told]
            yield Estimated(
                way,
                gone,
                estimate,
                renders.mean["psnr"],
                result.report["method"]["psnr"]["merge"] if way == "delete" else None,
                seconds,
                guess - truth,
            )


@dataclass(frozen=True)
class Between:
    """The estimate of the views between, and what held-out views see.

    - estimate: Of the views between, dB.
    - held, (H,) float64: PSNR of each held-out view, dB.
    - between: Views in between that decided, too.
    """

    way: Way
    ratio: float
    estimate: float
    held: NDArray[np.float64]
    between: int

    def line(self, name: str) -> str:
        """Return it as a line of the table."""
        mean, error = self.held.mean(), self.held.std(ddof=1) / np.sqrt(len(self.held))
        return (
            f"{name:12}{self.way:10}{self.ratio:9.1%}{self.estimate:10.2f}{mean:10.2f}"
            f"{error:8.2f}{self.estimate - mean:+8.2f}{np.median(self.held):8.2f}"
            f"{self.between:4} between"
        )


def measure_between(
    splats: Splats,
    views: ViewSet,
    held: ViewSet,
    ratios: Sequence[float],
    ways: Sequence[Way] = WAYS,
) -> Iterator[Between]:
    """Yield, by `views`, the estimate of those between them beside the held-out views.

    - RefineError: if there is no estimate, since nothing lies between the views.
    """
    evaluator = Evaluator(splats, held, metrics=("psnr",))
    for way in ways:
        for ratio in ratios:
            result = prune(splats, views, Budget(ratio=ratio), METHODS[way]())
            estimate = result.report["estimated_psnr_between"]
            if estimate is None:
                raise RefineError(
                    f"of {len(views)} views nothing is told of what lies between them"
                )
            renders = evaluator.evaluate(result.splats).renders
            between = result.report["views"]["between"]
            yield Between(way, ratio, estimate, np.asarray(renders.values["psnr"]), between)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line for each scene, way and budget; return the exit code."""
    options = _parse(arguments)
    budgets = [Budget(ratio=ratio) for ratio in options.ratios]
    ways = [options.only] if options.only else WAYS
    print(BETWEEN_HEADING if options.between else HEADING)
    errors: list[float] = []
    for folder in options.scenes:
        try:
            scene = read_scene(folder)
            views = scene.train.spread(options.views)
            if options.between:
                for each in measure_between(scene.splats, views, scene.test, options.ratios, ways):
                    errors.append(abs(each.estimate - float(each.held.mean())))
                    print(each.line(folder.name), flush=True)
                continue
            for row in measure(scene.splats, views, budgets, ways):
                errors.append(abs(row.off))
                print(_line(folder.name, row), flush=True)
        except RefineError as error:
            sys.stderr.write(f"{error}\n")
            return 1
    print(f"mean error {sum(errors) / len(errors):.2f} dB, largest {max(errors):.2f} dB")
    return 0


def _line(name: str, row: Estimated) -> str:
    expected = "" if row.expected is None else f"{row.expected:.1f}"
    return (
        f"{name:12}{row.way:10}{row.removed:9.1%}{row.estimate:10.2f}{row.truth:8.2f}"
        f"{row.off:+8.2f}{expected:>10}{row.seconds:9.1f}"
        f"{np.abs(row.single).mean():11.2f}{np.abs(row.single).max():9.2f}"
    )


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    summary = (__doc__ or "").split("\n", maxsplit=1)[0]
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.tables.estimate", description=summary
    )
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE_DIR")
    parser.add_argument("--ratios", type=float, nargs="*", default=[0.3, 0.5, 0.7, 0.9])
    parser.add_argument("--views", type=int, default=64, help="that score, at most")
    parser.add_argument("--only", choices=METHODS, help="one of the ways")
    parser.add_argument(
        "--between", action="store_true", help="the views between, beside the held-out views"
    )
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
