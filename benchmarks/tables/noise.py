"""By how much cells of the quality tables vary when nothing that matters changes.

::

    python -m benchmarks.tables.noise SCENE_DIR ... --ratios .5 .7 .9 --turns 4

For a scene's folder see `evaluate`. Splats are merged by the views that score; each turn takes
other pixels for the rays, and cells of the image that are up to 3 % larger, neither of which makes
results better. PSNR is by 65,536 rays of the held-out views, always the same ones: what is left is
how much the result itself varies.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from refine_addon.core.execute import silent, within
from refine_addon.core.methods import DEFAULT
from refine_addon.core.prune import merge_down
from refine_addon.core.quality.psnr import psnr_against
from refine_addon.core.scoring import occlusion
from refine_addon.core.splats import Splats
from refine_addon.core.views import View, ViewSet
from refine_addon.core.visibility import cast, points, projection
from refine_addon.core.visibility.cast import RaySample

from .evaluate import read_scene

RAYS = 1 << 16
"""Rays of the held-out views."""

WIDER = 0.01
"""By which share of their side cells are larger in each turn than in the one before."""


def other_pixels(turn: int) -> AbstractContextManager[Any]:
    """Let rays go through other pixels, those of turn 0 as always."""
    usual = cast.pixels

    def pixels(
        view: View, number: float, count: float
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        return usual(view, number + 1000.25 * turn, count)

    return mock.patch.object(cast, "pixels", pixels)


def other_cells(turn: int) -> AbstractContextManager[Any]:
    """Let cells be larger, those of turn 0 as always."""
    sides = points.cell_size
    factor = 1.0 + WIDER * turn
    return mock.patch(
        "refine_addon.core.visibility.measuring.cell_size",
        lambda *arguments: factor * sides(*arguments),
    )


def held_out(splats: Splats, views: ViewSet) -> RaySample:
    """Return rays of the held-out views."""
    gaussians, scene, _ = projection.prepare(splats, views)
    sample = RaySample(views.by_distance(), gaussians, splats)
    with mock.patch.dict(cast.RAYS, validation=(RAYS, cast.RAYS["validation"][1])):
        sample.cast_all(gaussians, scene, silent)
    return sample


def measure(folder: Path, ratios: Sequence[float], turns: int) -> None:
    """Print the PSNR of each ratio and turn of a scene, mean and standard deviation."""
    scene = read_scene(folder)
    used = scene.train.spread(DEFAULT.views)
    sample = held_out(scene.splats, scene.test)
    found = np.zeros((turns, len(ratios)))
    for turn in range(turns):
        with other_pixels(turn), other_cells(turn), within(cores=1):
            known = occlusion.score(scene.splats, used, rounds=1)
            for place, ratio in enumerate(ratios):
                left = len(scene.splats) - int(ratio * len(scene.splats))
                began = len(scene.splats)
                made = merge_down(scene.splats, left, scored=known, began=began).splats
                found[turn, place] = psnr_against(sample, made, scene.test)
        print(f"{folder.name} turn {turn}:", *(f"{x:.2f}" for x in found[turn]), flush=True)
    print(f"{folder.name} {'removed':>10} {'mean':>6} {'sd':>6} {'range':>6}")
    for ratio, column in zip(ratios, found.T, strict=True):
        print(
            f"{folder.name} {ratio:10.0%} {column.mean():6.2f} {column.std(ddof=1):6.2f} "
            f"{np.ptp(column):6.2f}",
            flush=True,
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="How much cells of the quality tables vary.")
    parser.add_argument("scenes", nargs="+", type=Path, help="folders, see evaluate.py")
    parser.add_argument("--ratios", nargs="+", type=float, default=[0.5, 0.7, 0.9])
    parser.add_argument("--turns", type=int, default=4)
    options = parser.parse_args(arguments)
    for folder in options.scenes:
        measure(folder, options.ratios, options.turns)


if __name__ == "__main__":
    main()
