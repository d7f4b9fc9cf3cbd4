"""Refitting kept splats in files, too many for memory: region by region, amid all others.

Kept splats are divided into boxes of about equally many. Each box is refitted by itself; splats of
other regions are drawn as they are, in front and behind, and do not change.
"""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, checkpoint, chunks, run_all, seconds, silent, stages
from ..mapped import note, noted
from ..regions import divided
from ..rendering import Model
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
_ROWS = 1 << 16  # splats copied at a time


Refit = Callable[..., Iterator[Any]]
"""`refit.refit_on`, which needs this module."""

Outcome = tuple[Splats, "NDArray[np.bool_]", int, float, float]
"""What `refit.Refitted` holds."""


def refit_by_regions(
    refit_on: Refit,
    kept: Splats,
    original: Splats,
    views: ViewSet,
    rounds: int | None,
    *,
    progress: Progress,
    threads: int | None,
) -> Iterator[Outcome]:
    """Yield what kept splats are before, and what they are afterwards if that is better.

    Parameters and errors are those of `refit.refit_rounds`.
    """
    job, count = folder_of(original), len(kept)
    assert job is not None
    cost = seconds("refit", count, len(views))
    preparing, before, refitting, after = stages(progress, 0.1 * cost, 0.1 * cost, cost, 0.1 * cost)
    if folder_of(kept) is None:
        parts = chunks(count, _ROWS)
        kept = on_disk(job / f"kept-{secrets.token_hex(4)}", (kept.take(part) for part in parts))
    rays = RoundRays.of(original, views, count, preparing, threads)
    psnr = rays.psnr(kept, before)
    yield kept, np.zeros(count, np.bool_), 0, psnr, psnr
    folder = job / f"refit-{secrets.token_hex(4)}"
    folder.mkdir()
    boxes = divided(kept.means[...], SHARE)
    for number, rows in enumerate(boxes):
        note(folder, f"rows-{number}", rows)
    after_all = rays.target(kept, silent)
    work = _RefitRegion(refit_on, folder, views, rays.original, after_all, rounds, threads)
    made = run_all(work, range(len(boxes)), progress=refitting, what="refitting", threads=1,
                   cost=cost)  # fmt: skip
    order = np.argsort(np.concatenate(boxes))
    changed = np.concatenate([each[0] for each in made])[order]
    pieces = (each[2].take(part) for each in made for part in chunks(len(each[2]), _ROWS))
    every = on_disk(folder / "every", pieces)
    splats = on_disk(
        job / f"refitted-{secrets.token_hex(4)}",
        (every.take(order[part]) for part in chunks(count, _ROWS)),
    )
    shutil.rmtree(folder, ignore_errors=True)
    better = rays.psnr(splats, after)
    if better > psnr:
        yield splats, changed, max(each[1] for each in made), psnr, better


@dataclass(frozen=True, eq=False)
class _RefitRegion:
    """Refits the kept splats of a region amid all others; any process can."""

    refit_on: Refit
    folder: Path  # with the rows of each region
    views: ViewSet
    before: Target  # the unpruned splats
    after: Target  # all kept splats, as they are
    rounds: int | None
    threads: int | None

    def __call__(self, number: int) -> tuple[NDArray[np.bool_], int, Splats]:
        """Which changed, in how many rounds, and the splats of the region."""
        rows = noted(self.folder, f"rows-{number}")[1]
        splats, changed, rounds = self.after.splats.take(rows), np.zeros(len(rows), np.bool_), 0
        rays = _RegionRays(self, splats, rows)
        if rays.windows:
            *_, done = self.refit_on(
                rays, splats, self.rounds, progress=_look, threads=self.threads
            )
            splats, changed, rounds = done.splats, done.changed, done.rounds
        return changed, rounds, on_disk(self.folder / f"region-{number}", [splats])


def _look(_fraction: float, _what: str) -> None:
    checkpoint()


class _RegionRays(RoundRays):
    """The rays of all rounds through a region, of which some rows of the kept splats are."""

    def __init__(self, of_all: _RefitRegion, splats: Splats, rows: NDArray[np.int64]) -> None:
        before, self._after = of_all.before, of_all.after
        count = len(self._after.splats)
        windows = _windows(splats, count, before.scene, of_all.views.by_distance())
        super().__init__(windows, before, of_all.threads)
        others = np.ones(count, np.bool_)
        others[rows] = False
        self._others = others[self._after.gaussians.index[...]]

    def target(self, splats: Splats, progress: Progress) -> Target:
        """What rays are cast into: the region's splats amid all others."""
        region = super().target(splats, progress)
        return _Amid(**vars(region), every=self._after, others=self._others)


@dataclass(frozen=True, eq=False)
class _Amid(Target):
    """The splats of a region amid all others, for rays to hit."""

    every: Target  # of all regions
    others: NDArray[np.bool_]  # (M,), which of the Gaussians of all are not of the region

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "every": self.every, "others": self.others}

    def footprints(self, window: Window) -> Footprints:
        """Footprints in a window; those of the region have the first numbers."""
        both: Any = _Both(self.gaussians, self.every.gaussians, self.others)
        return projection.project(both, self.scene, window.view, window.part)

    def colors(self, hit: NDArray[np.int64], view: View) -> NDArray[np.float32]:
        """Colours in which a view sees some of the Gaussians, ascending, (3, u)."""
        count = len(self.gaussians)
        mine = int(np.searchsorted(hit, count))
        parts = [super().colors(hit[:mine], view), self.every.colors(hit[mine:] - count, view)]
        return np.concatenate(parts, axis=1)


class _Both(NamedTuple):
    """The Gaussians of a region and, behind them, all but these, as far as `project` asks."""

    region: Gaussians
    every: Gaussians
    others: NDArray[np.bool_]

    @property
    def model(self) -> Model:
        """How they are drawn."""
        return self.region.model

    @property
    def normals(self) -> NDArray[np.float32] | None:
        """Whether they are discs."""
        return self.region.normals

    def parts(self, *seen: Any) -> Iterator[tuple[int, Gaussians]]:
        """See `Gaussians.parts`."""
        yield 0, self.region
        for first, chunk in self.every.parts(*seen):
            there = self.others[first : first + len(chunk)]
            hidden = np.where(there, chunk.largest, np.float32(np.nan))  # which reaches nowhere
            yield first + len(self.region), replace(chunk, largest=hidden)


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
        part_of_image = box[2] * box[3] / (view.width * view.height)
        windows.append(
            Window(
                view, number, weight * share, rays * part_of_image, hits * share, *box,
                steps[number],
            )
        )  # fmt: skip
    return windows


def _box(centers: NDArray[np.float32], view: View) -> tuple[int, int, int, int]:
    """Left, top, width and height, at least 1 px, of where most points, (2, n), lie."""
    low, high = np.quantile(centers, (_EDGE, 1.0 - _EDGE), axis=1)
    size = np.array([view.width, view.height])
    first = np.floor(low).astype(np.int64).clip(0, size - 1)
    end = np.ceil(high).astype(np.int64).clip(first + 1, size)
    (left, top), (width, height) = first.tolist(), (end - first).tolist()
    return left, top, width, height
