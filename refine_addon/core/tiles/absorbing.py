"""Absorbing splats that no memory holds at once: region by region, stage by stage.

Up to `REGION` splats are absorbed at once, as in memory. More are divided, in each stage, into
boxes of about equally many (`divided`), and each box is absorbed by itself: what the views see of
its splats, hidden by all others, is measured before. How many of a region stay is decided by one
ranking of all. The next stage divides along other planes, so neighbours that a plane separates can
merge in the next stage. A splat is in one region in each stage.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..costs import Images
from ..costs import absorbing as plan_stages
from ..merging.merge import merge_penalty, stage_counts
from ..pipeline.absorb_splats import FIRST, PARTS
from ..selection import Budget, select
from ..task import Settings
from ..visibility.measuring import Measured
from .folder import Folder
from .gaussians import SceneContext, store_gaussians
from .regions import (
    MEANS,
    SURVIVORS,
    AbsorbAtOnce,
    AbsorbRegion,
    GatherRegion,
    PriceRegion,
    Region,
    SaveMeans,
    SettleUnit,
    StageContext,
)
from .scoring import MeasuredTiles
from .seeing import StoredRays, TileMeasuring
from .units import Source, Unit
from .workers import Runner

REGION = 1 << 20
"""Splats of a region at most; absorbing takes about 900 bytes of each."""

ALONE = 0.6
"""Least share that a stage of several regions leaves where one is enough; see `merge.ALONE`. Half
goes in two stages: four regions in one stage lost .5 dB."""

_SAMPLE = 1 << 14  # splats that decide along which axis a box is divided
_ASKEW = np.array([[2, -1, 2], [2, 2, -1], [-1, 2, 2]], np.float32) / np.float32(3.0)
"""Rotation of the planes in every other stage."""


@dataclass(frozen=True, eq=False)
class Survivors:
    """What is left of N splats: K of them; for the counts see `merge.Merged`.

    Attributes
    ----------
    regions : sequence of Region
        Where they are; none if nothing changed.
    origin : (K,) int64
        Rows of the survivors among the N, region by region, in no order.
    changed : (K,) bool
        Which of them absorbed others.
    """

    regions: Sequence[Region]
    origin: NDArray[np.int64]
    changed: NDArray[np.bool_]
    merged: int
    deleted: int


@dataclass(frozen=True, eq=False)
class _Left:
    """The n splats that are left before a stage, and what views see of them or are expected to."""

    sources: Sequence[Source]
    rows: NDArray[np.int64]  # (n,), of all sources together, ascending
    measured: Measured


def absorb(tiles: MeasuredTiles, goal: int, settings: Settings, runner: Runner) -> Survivors:
    """Reduce splats to `goal` by the merges and deletions that cost the pictures least.

    Parameters
    ----------
    tiles : MeasuredTiles
        All N splats, and what the views see of them.
    goal : int
        How many survive.
    settings : Settings
    runner : Runner

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.

    Notes
    -----
    Memory of this process: about 150 bytes a splat; of a worker: see `REGION`.
    """
    total = len(tiles.measured.seen)
    first = min(math.floor(FIRST * total), total - goal)
    rows = np.flatnonzero(select(tiles.scores, Budget(keep=total - first)))
    if goal >= len(rows):
        return Survivors([], rows, np.zeros(len(rows), np.bool_), 0, first)
    left = _Left(tiles.units, rows, tiles.measured.take(rows))
    if len(rows) <= REGION:
        return _at_once(tiles.context, left, AbsorbAtOnce(goal, total, settings), runner)
    factor = merge_penalty(1.0 - goal / len(rows))
    counts = stage_counts(len(rows), goal, ALONE)
    images = Images.of(tiles.context.views)
    runners = runner.phases(*plan_stages(len(rows), counts, images))
    for number, count in enumerate(counts):
        of_stage = runners[2 * number : 2 * number + 2]
        regions, left = _stage(tiles.context, number, left, count, factor, of_stage)
    folder, numbers = regions[0].folder, range(len(regions))
    origin, members = (folder.joined(numbers, name) for name in ("origin", "members"))
    merged = int(members.sum()) - goal
    return Survivors(regions, origin, members > 1, merged, total - goal - merged)


def _at_once(scene: SceneContext, left: _Left, step: AbsorbAtOnce, runner: Runner) -> Survivors:
    """Absorb all splats in one step, as `pipeline.absorb_removed` does in memory."""
    folder = scene.folder.inner("at-once")
    context = StageContext(folder, scene.views, scene.scene, left.sources)
    _save_region(folder, 0, left, np.arange(len(left.rows)))
    ((count, merged),) = runner.run(context, [step], "absorbing")
    arrays = folder.load(0, ("origin", "changed"))
    return Survivors(
        [Region(0, count, folder)],
        arrays["origin"],
        arrays["changed"],
        merged,
        step.total - count - merged,
    )


def _stage(
    scene: SceneContext,
    number: int,
    left: _Left,
    count: int,
    factor: float,
    runners: Sequence[Runner],
) -> tuple[list[Region], _Left]:
    """Reduce the splats that are left to `count`, region by region.

    Before all stages but the first, `number` 0, they are measured anew, by the first of two
    runners. For `factor` see `StageContext`.
    """
    measuring, runner = runners
    folder = scene.folder.inner(f"stage-{number}")
    if number:
        context = replace(scene, folder=folder.inner("seen"))
        left = _measured_again(context, left, number - 1, measuring)
    stage = StageContext(folder, scene.views, scene.scene, left.sources, factor)
    sizes = _save_regions(stage, left, number, runner)
    stay = _staying(stage, sizes, count, runner.part(0.0, 0.6))
    steps = [AbsorbRegion(index, survivors) for index, survivors in enumerate(stay)]
    survivors = runner.part(0.6, 1.0).run(stage, steps, "absorbing", sizes)
    regions = [Region(index, size, folder) for index, size in enumerate(survivors)]
    contribution, error = folder.joined(range(len(regions)), "expected", axis=1)
    rows = np.arange(len(error))
    measured = Measured(contribution, error, np.zeros(len(rows), np.int32))
    return regions, _Left(regions, rows, measured)


def _save_regions(stage: StageContext, left: _Left, number: int, runner: Runner) -> list[int]:
    """Divide the splats that are left; return how many each region has."""
    boxes = boxes_of(stage, left.rows, REGION, number, runner)
    for index, places in enumerate(boxes):
        _save_region(stage.folder, index, left, places)
    return [*map(len, boxes)]


def boxes_of(
    stage: StageContext, rows: NDArray[np.int64], most: int, number: int, runner: Runner
) -> list[NDArray[np.int64]]:
    """Divide some splats of the sources of a stage, given their rows; see `divided`."""
    steps = [SaveMeans(source) for source in stage.sources]
    Runner(runner.workers).run_all(stage, steps, "reading")
    means = stage.folder.joined((source.index for source in stage.sources), MEANS)
    return divided(means[rows], most, number)


def _save_region(folder: Folder, index: int, left: _Left, places: NDArray[np.int64]) -> None:
    """Save which of the splats that are left are in a region; see `StageContext`."""
    sums = np.array([left.measured.contribution[places], left.measured.error[places]])
    folder.save(index, {"rows": left.rows[places], "sums": sums})


def _measured_again(scene: SceneContext, left: _Left, turn: int, runner: Runner) -> _Left:
    """Measure all splats in a part of the views, and add what the others are expected to see.

    Left are all rows of the sources. The scene has a folder of its own. For `turn` see
    `occlusion.measure_part`.
    """
    gaussians, good = store_gaussians(scene, left.sources, runner.part(0.0, 0.2))
    measuring = TileMeasuring(scene, runner)
    groups = measuring.groups_of_part(turn, PARTS)
    progress = runner.part(0.2, 1.0).progress
    sums = measuring.measure(gaussians, groups, progress)  # type: ignore[arg-type]
    measured = Measured.sum(sums.values()).for_all(gaussians.index, len(good))
    others = 1.0 - measuring.weight_share(groups)
    measured.contribution[:] += others * left.measured.contribution
    measured.error[:] += others * left.measured.error
    return replace(left, measured=measured)


def _staying(stage: StageContext, sizes: Sequence[int], left: int, runner: Runner) -> list[int]:
    """Return how many of the `sizes` splats of each region stay, of `left` that do of all.

    As many go as a region has among the cheapest merges and deletions of all. A merge counts half,
    since of two splats that merge one goes; so all of them together may count half of the splats,
    and a stage has to leave half of them, or there would not be enough to go.
    """
    numbers = range(len(sizes))
    gather = [GatherRegion(index) for index in numbers]
    whole = np.sum([*runner.part(0.0, 0.4).run(stage, gather, "absorbing", sizes)], axis=0)
    price = [PriceRegion(index, whole) for index in numbers]
    runner.part(0.4, 1.0).run_all(stage, price, "absorbing", sizes)
    costs, weights = (stage.folder.joined(numbers, name) for name in ("costs", "weights"))
    return _shared_out(costs, weights, sizes, left)


def _shared_out(
    costs: NDArray[np.float64], weights: NDArray[np.float32], sizes: Sequence[int], left: int
) -> list[int]:
    """Return how many splats of each region stay; see `_staying`.

    Of each splat's cheapest operation, region by region: its cost, (n,), and how many splats go by
    it, 1 or .5.
    """
    order, goal = np.argsort(costs, kind="stable"), len(costs) - left
    last = int(np.searchsorted(np.cumsum(weights[order], dtype=np.float64), goal))
    goes, chosen = np.zeros_like(weights), order[: last + 1]
    goes[chosen] = weights[chosen]
    of_regions = np.split(goes, np.cumsum(sizes)[:-1])
    gone = np.cumsum([in_region.sum(dtype=np.float64) for in_region in of_regions])
    # Rounded so that the sum is exact: each gets what is added up to its end.
    gone = np.rint(gone * (goal / gone[-1])).astype(np.int64)
    return [size - int(go) for size, go in zip(sizes, np.diff(gone, prepend=0), strict=True)]


def settle(
    survivors: Survivors, units: Sequence[Unit], folder: Folder, runner: Runner
) -> Iterator[NDArray[np.int64]]:
    """Note of each unit which splats survive, and as what; yield what `save_kept` returns."""
    order = np.argsort(survivors.origin)
    arrays = survivors.origin[order], order, survivors.changed[order]
    for name, array in zip(SURVIVORS, arrays, strict=True):
        folder.note(name, array)
    begins = np.cumsum([0, *map(len, units)]).tolist()
    steps = [
        SettleUnit(unit, begin, survivors.regions)
        for unit, begin in zip(units, begins, strict=False)
    ]
    return runner.run(folder, steps, "selecting")


def estimated(
    tiles: MeasuredTiles, regions: Sequence[Region], runner: Runner
) -> tuple[SceneContext, float | None]:
    """Store the Gaussians of survivors that changed, and estimate their PSNR.

    Returns
    -------
    context : SceneContext
        Of their Gaussians.
    psnr : float or None
        In dB; None if too little is seen.
    """
    context = replace(tiles.context, folder=regions[0].folder.inner("after"))
    gaussians, _ = store_gaussians(context, regions, runner.part(0.0, 0.5))
    after = StoredRays(context, runner, regions, gaussians)
    return context, tiles.rays.psnr_against(after, runner.part(0.5, 1.0))


def divided(means: NDArray[np.float32], most: int, stage: int) -> list[NDArray[np.int64]]:
    """Divide splats into boxes of about equally many, by planes at right angles to where they vary.

    Parameters
    ----------
    means : (n, 3) float32
        Where they are; what is not finite counts as the origin.
    most : int
        How many there may be in a box.
    stage : int
        In every other stage the planes lie askew.

    Returns
    -------
    list of (m,) int64
        Rows of each box, ascending.
    """
    place = np.where(np.isfinite(means).all(axis=1, keepdims=True), means, np.float32(0.0))
    place = place @ (_ASKEW if stage % 2 else np.eye(3, dtype=np.float32))
    return _halved(place, np.arange(len(means)), -(-len(means) // most))


def _halved(
    place: NDArray[np.float32], rows: NDArray[np.int64], count: int
) -> list[NDArray[np.int64]]:
    """Divide some rows of places into `count` boxes."""
    if count <= 1:
        return [rows]
    sample = place[rows[:: max(len(rows) // _SAMPLE, 1)]]
    low, high = np.quantile(sample, (0.05, 0.95), axis=0)
    along = place[rows, int(np.argmax(high - low))]
    less = count // 2
    cut = len(rows) * less // count
    order = np.argpartition(along, cut)
    one, other = np.sort(rows[order[:cut]]), np.sort(rows[order[cut:]])
    return _halved(place, one, less) + _halved(place, other, count - less)
