"""Rays through a region of a scene that no memory holds at once: what refitting asks of them.

Splats of other regions are drawn as they are, in front and behind, and do not change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..refit.round_rays import (
    InMemory,
    RoundRays,
    Window,
    colors_of,
    limits,
    steps_of,
)
from ..splats import Splats
from ..views import View, ViewSet
from ..visibility import projection
from ..visibility.projection import Footprints, Gaussians
from ..visibility.scene import Scene
from .gaussians import SceneContext
from .regions import Region, taken

_SAMPLE = 1 << 12  # splats of a region that tell where it is in each view
_EDGE = 0.005  # share of them that may lie outside on each side


@dataclass(frozen=True, eq=False)
class StoredSplats:
    """Splats in a folder, for rays to hit: a `round_rays.Target`.

    Attributes
    ----------
    context : SceneContext
        Of their Gaussians.
    regions : sequence of Region
        All of them, for their colours.
    """

    context: SceneContext
    regions: Sequence[Region]

    def __len__(self) -> int:
        """Return the number of splats."""
        return sum(map(len, self.regions))

    def footprints(self, window: Window) -> Footprints:
        """Return the footprints in a view that may reach into a window of it."""
        return projection.front_to_back(
            [*self.context.footprints_and_depths(window.view, window.part)]
        )

    def index(self) -> NDArray[np.int64]:
        """Return the rows of the splats that the Gaussians are, (M,), without reading them yet."""
        return self.context.folder.mapped("index")

    def colors(self, hit: NDArray[np.int64], view: View) -> NDArray[np.float32]:
        """Return the colours in which a view sees some of the Gaussians, (3, u)."""
        chosen = self.take(self.index()[hit])
        return colors_of(chosen, np.arange(len(chosen)), view)

    def take(self, rows: NDArray[np.int64]) -> Splats:
        """Return some splats by their rows, (n,)."""
        return taken(self.regions, rows)


@dataclass(frozen=True, eq=False)
class _Amid:
    """The splats of a region amid all others, for rays to hit: a `round_rays.Target`."""

    region: InMemory
    stored: StoredSplats  # of all regions
    others: NDArray[np.bool_]  # (M,), which of the stored Gaussians are not of the region

    def footprints(self, window: Window) -> Footprints:
        """Return the footprints in a window; those of the region have the first numbers."""
        gaussians, seen = self.region.gaussians, (window.view, window.part)
        pieces = [projection.footprints_and_depths(gaussians, self.region.scene, *seen)]
        for footprints, depth in self.stored.context.footprints_and_depths(*seen):
            rows = np.flatnonzero(self.others[footprints.index])
            others = footprints.take(rows)
            pieces.append((replace(others, index=others.index + len(gaussians)), depth[rows]))
        return projection.front_to_back(pieces)

    def colors(self, hit: NDArray[np.int64], view: View) -> NDArray[np.float32]:
        """Return the colours in which a view sees some of the Gaussians, ascending, (3, u)."""
        count = len(self.region.gaussians)
        mine = int(np.searchsorted(hit, count))
        parts = [
            self.region.colors(hit[:mine], view),
            self.stored.colors(hit[mine:] - count, view),
        ]
        return np.concatenate(parts, axis=1)


class RegionRays(RoundRays):
    """The rays of all rounds through a region.

    Parameters
    ----------
    splats : Splats
        The survivors of the region.
    rows : (n,) int64
        Which of the survivors of all regions these are.
    before, after : StoredSplats
        The unpruned splats, and the survivors of all regions.
    threads : int, optional
    """

    def __init__(
        self,
        splats: Splats,
        rows: NDArray[np.int64],
        before: StoredSplats,
        after: StoredSplats,
        threads: int | None,
    ) -> None:
        views, scene = before.context.views.by_distance(), before.context.scene
        windows = _windows(splats, len(after), scene, views)
        super().__init__(windows, scene, before, len(before), threads)
        self._after, self.around = after, len(after)
        others = np.ones(len(after), np.bool_)
        others[rows] = False
        self._others = others[after.index()]

    def target(self, splats: Splats, gaussians: Gaussians) -> _Amid:
        """Return what rays are cast into: the region's survivors amid all others."""
        return _Amid(InMemory.of(splats, gaussians, self.scene), self._after, self._others)


def _windows(
    splats: Splats, total: int, scene: Scene, views: Sequence[tuple[View, float]]
) -> list[Window]:
    """Return the windows of the views that show a region.

    Rays are as dense in them as if all of the `total` survivors were refitted together. A view
    counts by how much of the region it shows. For the others see `RegionRays`.
    """
    sample = splats.take(slice(None, None, max(len(splats) // _SAMPLE, 1)))
    only = ViewSet(tuple(view for view, _ in views))
    gaussians, _, _ = projection.prepare(sample, only, scene, threads=1)
    boxes: dict[int, tuple[int, tuple[int, int, int, int]]] = {}
    for number, (view, _) in enumerate(views):
        with np.errstate(under="ignore"):
            footprints, _ = projection.footprints_and_depths(gaussians, scene, view)
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
    """Return left, top, width and height, at least 1 px, of where most points, (2, n), lie."""
    low, high = np.quantile(centers, (_EDGE, 1.0 - _EDGE), axis=1)
    size = np.array([view.width, view.height])
    first = np.floor(low).astype(np.int64).clip(0, size - 1)
    end = np.ceil(high).astype(np.int64).clip(first + 1, size)
    (left, top), (width, height) = first.tolist(), (end - first).tolist()
    return left, top, width, height
