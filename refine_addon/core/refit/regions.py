"""Refitting kept splats in files, too many for memory: region by region, amid all others.

Kept splats are divided into boxes of about equally many. Each box is refitted by itself; splats of
other regions are drawn as they are, in front and behind, and do not change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, run_all, seconds, silent, stages
from ..mapped import note, noted
from ..regions import divided, in_one, look, new_folder, pieces
from ..splats import Splats, folder_of, on_disk
from ..views import View, ViewSet
from ..visibility import projection
from ..visibility.projection import Footprints, Gaussians
from ..visibility.scene import Scene
from .round_rays import RoundRays, Target, Window, limits, steps_of

SHARE = 0.5
"""Kept splats of a region, in `regions.REGION`: one takes twice the memory of one that merges."""

_SAMPLE = 1 << 12  # splats of a region that tell where it is in each view
_EDGE = 0.005  # share of them that may lie outside on each side


def refit_by_regions(
    refit_on: Callable[..., Iterator[Any]],
    kept: Splats,
    original: Splats,
    views: ViewSet,
    progress: Progress,
    threads: int | None,
) -> Iterator[tuple[Splats, NDArray[np.bool_], int, float, float]]:
    """Yield what `Refitted` holds of kept splats, before and, if that is better, afterwards.

    Parameters and errors are those of `refit.refit_rounds`; `refit_on` is that of `refit`, which
    needs this module, with the number of rounds.
    """
    count, folder = len(kept), new_folder(original)
    cost = seconds("refit", count, len(views))
    preparing, before, refitting, after = stages(progress, 0.1 * cost, 0.1 * cost, cost, 0.1 * cost)
    if folder_of(kept) is None:
        kept = on_disk(new_folder(original), pieces(kept))
    rays = RoundRays.of(original, views, count, preparing, threads)
    psnr = rays.psnr(kept, before)
    yield kept, np.zeros(count, np.bool_), 0, psnr, psnr
    boxes = divided(kept.means[...], SHARE)
    for number, rows in enumerate(boxes):
        note(folder, f"rows-{number}", rows)
    targets = rays.original, rays.target(kept, silent)
    work = partial(_refit, refit_on, folder, views, *targets, threads)
    made = run_all(work, range(len(boxes)), progress=refitting, what="refitting", threads=1,
                   cost=cost)  # fmt: skip
    changed, rounds, regions = zip(*made, strict=True)
    rows = np.concatenate(boxes)
    splats = in_one(folder, regions, rows)
    better = rays.psnr(splats, after)
    if better > psnr:
        yield splats, np.concatenate(changed)[np.argsort(rows)], max(rounds), psnr, better


def _refit(refit_on, folder, views, original, kept, threads, number):
    """Refit the splats of a region amid all others: which changed, in how many rounds, and they."""
    rows = noted(folder, f"rows-{number}")[1]
    others = np.ones(len(kept.splats), np.bool_)
    others[rows] = False
    splats, changed, rounds = kept.splats.take(rows), np.zeros(len(rows), np.bool_), 0
    windows = _windows(splats, len(others), original.scene, views.by_distance())
    if windows:
        amid = partial(_Amid, every=kept, others=others[kept.gaussians.index[...]])
        rays = RoundRays(windows, original, threads, amid)
        *_, done = refit_on(rays, splats, progress=look, threads=threads)
        splats, changed, rounds = done.splats, done.changed, done.rounds
    return changed, rounds, on_disk(folder / f"region-{number}", [splats])


@dataclass(frozen=True, eq=False)
class _Amid(Target):
    """The splats of a region amid all others, for rays to hit."""

    every: Target  # of all regions
    others: NDArray[np.bool_]  # (M,), which of the Gaussians of all are not of the region

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "every": self.every, "others": self.others}

    def footprints(self, window: Window) -> Footprints:
        """Footprints in a window; those of the region have the first numbers."""
        both = _Both(**vars(self.gaussians), every=self.every.gaussians, others=self.others)
        return projection.project(both, self.scene, window.view, window.part)

    def colors(self, hit: NDArray[np.int64], view: View) -> NDArray[np.float32]:
        """Colours in which a view sees some of the Gaussians, ascending, (3, u)."""
        count = len(self.gaussians)
        mine = int(np.searchsorted(hit, count))
        parts = [super().colors(hit[:mine], view), self.every.colors(hit[mine:] - count, view)]
        return np.concatenate(parts, axis=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Both(Gaussians):
    """The Gaussians of a region and, behind them, all but these, as far as `project` asks."""

    every: Gaussians
    others: NDArray[np.bool_]

    def parts(self, *seen: Any) -> Iterator[tuple[int, Gaussians]]:
        """See `Gaussians.parts`."""
        yield 0, self
        for first, chunk in self.every.parts(*seen):
            there = self.others[first : first + len(chunk)]
            hidden = np.where(there, chunk.largest, np.float32(np.nan))  # which reaches nowhere
            yield first + len(self), replace(chunk, largest=hidden)


def _windows(
    splats: Splats, total: int, scene: Scene, views: Sequence[tuple[View, float]]
) -> list[Window]:
    """Windows of the views that show a region.

    Rays are as dense in them as if all of the `total` kept splats were refitted together. A view
    counts by how much of the region it shows.
    """
    sample = splats.take(slice(None, None, max(len(splats) // _SAMPLE, 1)))
    only = ViewSet(tuple(view for view, _ in views))
    gaussians, _, _ = projection.prepare(sample, only, scene, threads=1)
    boxes: dict[int, tuple[int, tuple[int, int, int, int]]] = {}
    for number, (view, _) in enumerate(views):
        with np.errstate(under="ignore"):
            footprints = projection.project(gaussians, scene, view)
        centers = footprints.centers[:, footprints.inside]
        if centers.shape[1]:
            boxes[number] = centers.shape[1], _box(centers, view)
    shown = sum(count for count, _ in boxes.values())
    rays, hits = limits(total)[0] / len(views), limits(len(splats))[1]
    steps, windows = steps_of([view for view, _ in views], scene), []
    for number, (count, box) in boxes.items():
        (view, weight), share = views[number], count / shown
        rays_here = rays * (box[2] * box[3] / (view.width * view.height))
        counts = weight * share, rays_here, hits * share
        windows.append(Window(view, number, *counts, *box, steps[number]))
    return windows


def _box(centers: NDArray[np.float32], view: View) -> tuple[int, int, int, int]:
    """Left, top, width and height, at least 1 px, of where most points, (2, n), lie."""
    low, high = np.quantile(centers, (_EDGE, 1.0 - _EDGE), axis=1)
    size = np.array([view.width, view.height])
    first = np.floor(low).astype(np.int64).clip(0, size - 1)
    end = np.ceil(high).astype(np.int64).clip(first + 1, size)
    (left, top), (width, height) = first.tolist(), (end - first).tolist()
    return left, top, width, height
