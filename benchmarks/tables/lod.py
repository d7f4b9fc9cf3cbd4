"""Levels of detail side by side: each merged from the one before, and from the original in one go.

::

    python -m benchmarks.tables.lod SCENE_DIR ... [--views 10]

Held-out PSNR at each level against renders of the original, and seconds of the processor: of each
level where it is made by itself, and of all of them where they come from one run. The train views
decide, PSNR is of some of the test views.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from refine_addon.core import Levels, Merge, lod, prune
from refine_addon.core.methods import DEFAULT
from refine_addon.core.splats import Splats

from .evaluate import Evaluator, Scene, read_scene

SHARES = (0.5, 0.25, 0.12, 0.06)


def from_one_another(scene: Scene) -> Iterator[tuple[Splats, str]]:
    """Yield the levels of `lod`, and the PSNR that it estimates."""
    for level in lod(scene.splats, scene.train, Levels(SHARES), DEFAULT):
        yield level.result.splats, f" [{level.psnr:.1f}]"


def in_one_go(scene: Scene) -> Iterator[tuple[Splats, str]]:
    """Yield what merging makes of the original for each level by itself."""
    for budget in Levels(SHARES).budgets(len(scene.splats)):
        start = time.process_time()
        left = prune(scene.splats, scene.train, budget, Merge()).splats
        yield left, f" ({time.process_time() - start:.0f} s)"


def main() -> int:
    """Print a table for each scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE_DIR")
    parser.add_argument("--views", type=int, default=10, help="how many are compared (default 10)")
    options = parser.parse_args()
    for folder in options.scenes:
        scene = read_scene(folder)
        evaluator = Evaluator(scene.splats, scene.test.spread(options.views), metrics=("psnr",))
        ways = {
            "each from the one before": from_one_another(scene),
            "each from the original": in_one_go(scene),
        }
        print(f"{folder.name}: {len(scene.splats)} splats, shares {SHARES}", flush=True)
        for name, levels in ways.items():
            start, cells = time.process_time(), []
            made = list(levels)
            seconds = time.process_time() - start
            for splats, note in made:
                psnr = evaluator.evaluate(splats).renders.mean["psnr"]
                cells.append(f"{psnr:.1f}{note}")
            print(f"  {name}: {', '.join(cells)}; {seconds:.0f} s in this process", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
