"""Floaters put into a scene, and how many of them cleaning finds, at what cost.

::

    python -m benchmarks.tables.floaters SCENE_DIR ... --recipe volume --seed 7 [--sure]

The recipes of `benchmarks.floaters` put in 1,000 floaters: 45 % single ones, 25 % in dense
clusters, 26 % needles and 4 % giant veils. Nothing of the cleaner was chosen by them, nor were they
written with it in view, as `mixed` was; `none` puts in nothing.

Of the 2,000 floaters of `mixed`, 1,100 stand in front of a camera, each by itself; 800 form blobs
of 5 to 59 in free space; 100 are huge veils. Size, opacity, colour and place vary. Free space is
what lies in front of the depth at which half of a ray's light is gone. The train views decide; the
test views only compare with renders of the unpolluted scene and real pictures.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from refine_addon.core.cleaning.clean import clean
from refine_addon.core.formats.ply import read_ply
from refine_addon.core.splats import SH_C0, Splats, joined
from refine_addon.core.views import View, ViewSet
from refine_addon.core.visibility import projection
from refine_addon.core.visibility.cast import validation_rays

from .evaluate import Evaluator, read_scene

COUNTS = {"front": 1100, "blob": 800, "veil": 100}
KINDS = ("single", "cluster", "needle", "veil")
RECIPES = ("volume", "photos", "motion")
COUNT = 1000


class Places:
    """Random places in free space, as views see it."""

    def __init__(self, splats: Splats, views: ViewSet) -> None:
        sample = validation_rays(splats, views)
        gaussians, scene, _ = projection.prepare(splats, views)
        self.size = scene.size
        self.found: list[tuple[View, NDArray[np.float64], NDArray[np.float64]]] = []
        for (view, _), rays in zip(sample.views, sample.rays, strict=True):
            if rays is None or not len(rays.ray):
                continue
            local, _ = projection.in_camera(gaussians.take(rays.hit), scene, view)
            depth = local[2][rays.owner] * scene.size
            dark = np.log1p(-rays.alpha).astype(np.float64)
            first = np.flatnonzero(np.diff(rays.ray, prepend=-1))
            total = np.cumsum(dark)
            before = np.repeat(total[first] - dark[first], np.diff(np.append(first, len(dark))))
            half = np.flatnonzero(total - before < np.log(0.5))
            line, place = np.unique(rays.ray[half], return_index=True)
            across = rays.columns[line % len(rays.columns)] + 0.5
            down = rays.rows[line // len(rays.columns)] + 0.5
            ray = [(across - view.cx) / view.fx, (down - view.cy) / view.fy, np.ones(len(line))]
            if len(line):
                self.found.append((view, np.stack(ray, axis=1), depth[half[place]]))

    def draw(
        self, random: np.random.Generator, count: int, low: float, high: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return places, (count, 3), at `low` to `high` of a surface's depth, and their depths."""
        places, depths = np.empty((count, 3)), np.empty(count)
        for k in range(count):
            view, rays, surface = self.found[random.integers(len(self.found))]
            line = random.integers(len(rays))
            depths[k] = surface[line] * random.uniform(low, high)
            places[k] = view.center + rays[line] * depths[k] @ view.rotation
        return places, depths


def floaters(splats: Splats, views: ViewSet, seed: int) -> tuple[Splats, NDArray[np.int64]]:
    """Return floaters for a scene, and which of `COUNTS` each is, (n,)."""
    random = np.random.default_rng(seed)
    free = Places(splats, views)
    rows: list[tuple[NDArray[np.float64], ...]] = [_front(random, free), *_blobs(random, free)]
    rows.append(_veils(random, free))
    return _as_splats(random, splats, rows), np.repeat(np.arange(3), list(COUNTS.values()))


def _as_splats(
    random: np.random.Generator, splats: Splats, rows: list[tuple[NDArray[np.float64], ...]]
) -> Splats:
    """Return means, scales, opacities and colours as splats like those of a scene."""
    means, scales, alphas, colors = (np.concatenate(part) for part in zip(*rows, strict=True))
    count = len(means)
    return Splats(
        means.astype(np.float32),
        np.log(scales).astype(np.float32),
        random.normal(size=(count, 4)).astype(np.float32),
        np.log(alphas / (1.0 - alphas)).astype(np.float32),
        ((colors - 0.5) / SH_C0).astype(np.float32),
        random.normal(0.0, 0.05, (count, *splats.sh_rest.shape[1:])).astype(np.float32),
    )


def _log_uniform(
    random: np.random.Generator, low: float, high: float, size: tuple[int, ...]
) -> NDArray[np.float64]:
    return np.asarray(np.exp(random.uniform(np.log(low), np.log(high), size)))


def _front(random: np.random.Generator, free: Places) -> tuple[NDArray[np.float64], ...]:
    count = COUNTS["front"]
    means, depths = free.draw(random, count, 0.05, 0.6)
    scales = (depths * _log_uniform(random, 0.004, 0.08, (count,)))[:, None]
    scales = scales * _log_uniform(random, 0.2, 1.0, (count, 3))
    return means, scales, random.uniform(0.05, 0.95, count), random.uniform(0.0, 1.0, (count, 3))


def _blobs(random: np.random.Generator, free: Places) -> list[tuple[NDArray[np.float64], ...]]:
    blobs, left = [], COUNTS["blob"]
    while left:
        count = min(int(random.integers(5, 60)), left)
        left -= count
        center, depth = free.draw(random, 1, 0.2, 0.8)
        radius = depth * _log_uniform(random, 0.01, 0.06, (1,))
        means = center + random.normal(size=(count, 3)) * radius / 2.0
        scales = radius * _log_uniform(random, 0.1, 0.6, (count, 1))
        scales = scales * _log_uniform(random, 0.3, 1.0, (count, 3))
        alphas = random.uniform(0.2, 0.95) * random.uniform(0.5, 1.0, count)
        colors = random.uniform(0.0, 1.0, 3) + random.normal(0.0, 0.1, (count, 3))
        blobs.append((means, scales, alphas, colors.clip(0.0, 1.0)))
    return blobs


def _veils(random: np.random.Generator, free: Places) -> tuple[NDArray[np.float64], ...]:
    count = COUNTS["veil"]
    means, _ = free.draw(random, count, 0.1, 0.9)
    scales = free.size * _log_uniform(random, 0.3, 2.0, (count, 1))
    scales = scales * _log_uniform(random, 0.1, 1.0, (count, 3))
    return means, scales, random.uniform(0.01, 0.1, count), random.uniform(0.0, 1.0, (count, 3))


def dirtied(
    folder: Path, splats: Splats, views: ViewSet, recipe: str, seed: int
) -> tuple[Splats, NDArray[np.int64], tuple[str, ...]]:
    """Return a scene with floaters behind its own splats, the kind of each, (n,), and their names.

    - splats, views: What it holds, and the views that place the floaters of `mixed`.
    - recipe: "none", "mixed", or one of `RECIPES`.
    """
    if recipe == "none":
        return splats, np.empty(0, np.int64), ()
    if recipe in RECIPES:
        file = folder / "point_cloud.ply"
        module = importlib.import_module(f"benchmarks.floaters.{recipe}")
        rows, kinds = module.make(str(file), str(folder / "cameras.json"), COUNT, seed)
        plain = read_ply(file)
        added = replace(plain, rows=rows.astype(plain.rows.dtype)).splats()
        kinds = np.array([KINDS.index(kind) for kind in kinds])
        return joined([splats, added]), kinds, KINDS
    added, kinds = floaters(splats, views, seed)
    return joined([splats, added]), kinds, tuple(COUNTS)


def main() -> int:
    """Print a line for each scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE_DIR")
    parser.add_argument("--recipe", choices=(*RECIPES, "mixed", "none"), default="volume")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--sure", action="store_true", help="compare `sure`, and clean again")
    options = parser.parse_args()
    line = _sure if options.sure else _line
    if line is _line:
        print("scene: found (by kind), true splats taken, seconds, PSNR: before, dirty, cleaned")
    for folder in options.scenes:
        print(line(folder, options.recipe, options.seed), flush=True)
    return 0


def _sure(folder: Path, recipe: str, seed: int) -> str:
    """Say how sure cleaning was, beside what test views say, and what a second run takes.

    Giants and needles have no place here: of them `sure` counts light, not views.
    """
    scene = read_scene(folder)
    dirty, kinds, _ = dirtied(folder, scene.splats, scene.train, recipe, seed)
    found, held_out = clean(dirty, scene.train), clean(dirty, scene.test)
    small = found.by_reason["front"] | found.by_reason["isolated"]
    seen = np.rint((held_out.past + 1.0) / np.maximum(held_out.sure, 1e-9) - 2.0)
    other = held_out.by_reason["giant"] | held_out.by_reason["needle"]
    judged = small & (seen > 0.0) & ~other & (held_out.past <= seen)
    real = np.arange(len(dirty)) < len(scene.splats)
    cells = []
    for low, high in ((0.0, 0.7), (0.7, 0.8), (0.8, 0.9), (0.9, 0.95), (0.95, 1.0)):
        inside = small & (found.sure > low) & (found.sure <= high)
        both = inside & judged
        if not both.any():
            continue
        cells.append(
            f"said {found.sure[both].mean():.0%} of {inside.sum()}: "
            f"{held_out.past[both].sum() / seen[both].sum():.0%} of test views see past "
            f"{both.sum()} of them, {np.mean(~real[inside]):.0%} put in"
        )
    rest = dirty.take(found.keep)
    again, left = clean(rest, scene.train), real[found.keep]
    added = np.count_nonzero(~left)
    return (
        f"{folder.name}, {recipe}: {'; '.join(cells)}; again: "
        f"{np.count_nonzero(~again.keep & ~left)} of {added} floaters left of {len(kinds)}, "
        f"{np.count_nonzero(~again.keep & left)} of {np.count_nonzero(left)} true splats"
    )


def _line(folder: Path, recipe: str, seed: int) -> str:
    scene = read_scene(folder)
    dirty, kinds, names = dirtied(folder, scene.splats, scene.train, recipe, seed)
    count = len(scene.splats)
    start = time.process_time()
    found = clean(dirty, scene.train)
    seconds = time.process_time() - start
    gone = ~found.keep[count:]
    recalls = " ".join(f"{name} {gone[kinds == k].mean():.1%}" for k, name in enumerate(names))
    total = f"{gone.mean():.1%} ({recalls})" if len(gone) else "none put in"
    true = float(np.mean(~found.keep[:count]))
    evaluator = Evaluator(scene.splats, scene.test, scene.pictures, metrics=("psnr",))
    cells = []
    for splats in (scene.splats, dirty, dirty.take(found.keep)):
        quality = evaluator.evaluate(splats)
        pictures = quality.pictures.mean["psnr"] if quality.pictures else float("nan")
        worst = quality.renders.values["psnr"].min()
        cells.append(f"{quality.renders.mean['psnr']:.2f}, worst {worst:.1f} ({pictures:.2f})")
    return (
        f"{folder.name}, {recipe}: {total}, {true:.3%}, {seconds:.0f} s, "
        f"{'; '.join(cells)}; {found.in_words()}"
    )


if __name__ == "__main__":
    sys.exit(main())
