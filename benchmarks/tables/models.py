"""What it gains that splats are scored, merged and refitted as they are drawn.

A scene of ordinary splats becomes antialiased by the word alone (its pictures change, and count as
the truth), and discs by leaving out the shortest axis of every splat. Each is pruned as what it is,
and as if it were ordinary, and both are judged in the held-out views by the reference renderer of
its model. The estimate is judged in the views that scored.

::

    python -m benchmarks.tables.models SCENE_DIR --ratios .5 .7
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from refine_addon.core import METHODS, prune
from refine_addon.core.affine import quaternion
from refine_addon.core.selection import Budget
from refine_addon.core.splats import MODELS, Model, Splats, rotation_matrices, with_model
from refine_addon.core.views import ViewSet

from .evaluate import Evaluator, read_scene

CHOSEN = ("occlusion", "merge", "refit")


def version(splats: Splats, model: Model) -> Splats:
    """Return a scene's splats as another model draws them."""
    return discs(splats) if model == "2dgs" else with_model(splats, model)


def discs(splats: Splats) -> Splats:
    """Return splats without their shortest axes."""
    logs = np.asarray(splats.log_scales, np.float64)
    order = np.argsort(-logs, axis=1, kind="stable")
    axes = np.take_along_axis(rotation_matrices(splats.quaternions), order[:, None, :], 2)
    axes[np.linalg.det(axes) < 0.0, :, 2] *= -1.0
    flat = replace(
        splats,
        log_scales=np.take_along_axis(logs, order, 1).astype(np.float32),
        quaternions=quaternion(axes).astype(np.float32),
    )
    return with_model(flat, "2dgs")


def measure(
    splats: Splats,
    decided: Splats,
    views: ViewSet,
    evaluators: Sequence[Evaluator],
    ratio: float,
    methods: Sequence[str],
) -> list[str]:
    """Return for each method: PSNR in the views of both evaluators, and the estimate, dB."""
    cells = []
    for name in methods:
        result = prune(decided, views, Budget(ratio=ratio), METHODS[name]())
        left = result.splats
        drawn = left if left.model == splats.model else version(left, splats.model)
        scoring, held = (each.evaluate(drawn).renders.mean["psnr"] for each in evaluators)
        cells.append(f"{held:.2f} ({result.report['estimated_psnr']:.2f} for {scoring:.2f})")
    return cells


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table of a scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder")
    parser.add_argument("--ratios", type=float, nargs="+", default=[0.5, 0.7])
    parser.add_argument("--models", nargs="+", choices=MODELS, default=MODELS)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=CHOSEN)
    parser.add_argument("--decided-as", nargs="+", choices=MODELS, help="default: both")
    options = parser.parse_args(arguments)
    scene = read_scene(options.folder)
    print("| model | decided as | removed |", " | ".join(options.methods), "|")
    print("|---|---|---|" + "---|" * len(options.methods))
    for model in options.models:
        splats = version(scene.splats, model)
        evaluators = [
            Evaluator(splats, views, metrics=("psnr",)) for views in (scene.train, scene.test)
        ]
        for asked in options.decided_as or dict.fromkeys((model, MODELS[0])):
            decided = replace(splats, model=asked)
            for ratio in options.ratios:
                cells = measure(splats, decided, scene.train, evaluators, ratio, options.methods)
                print(f"| {model} | {asked} | {100 * ratio:.0f} % |", " | ".join(cells), "|")
                sys.stdout.flush()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
