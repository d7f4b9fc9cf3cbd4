"""Refitting survivors that no memory holds at once: region by region.

Up to `absorbing.REGION` splats are refitted at once, as in memory. Of more, the survivors are
divided into boxes of about equally many, and each box is refitted by itself, amid all others as
they were before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..operation.run import Runtime
from ..refit.refit import Gains, Refit, refit, refit_on
from ..splats import ARRAYS, Splats, joined
from ..views import ViewSet
from . import absorbing
from .absorbing import Survivors
from .folder import Folder
from .region_rays import RegionRays, StoredSplats
from .regions import Region, StageContext
from .scoring import MeasuredTiles
from .units import Source, Unit, packed, unpacked
from .workers import Runner

_DENSER = 2  # a refitted survivor takes so many times the memory of one that is absorbed


@dataclass(frozen=True, eq=False)
class Refitting(Gains):
    """What refitting makes of survivors.

    Attributes
    ----------
    survivors : Survivors
        Its `changed` says which absorbed others or were refitted.
    changed : (K,) bool
        Which of them were refitted.
    rounds : int
        In how many rounds at most.
    psnr_before, psnr : float
        Before and after, dB, on rays that nothing was fitted to.
    """

    survivors: Survivors
    changed: NDArray[np.bool_]
    rounds: int
    psnr_before: float
    psnr: float


@dataclass(frozen=True)
class SaveSplats:
    """Saves some splats of a source as a region, in the types that they have."""

    source: Source
    rows: NDArray[np.int64] | None = None  # by default all

    def run(self, folder: Folder, _runtime: Runtime) -> Region:
        """Save them, unless that is done; return the region."""
        index = self.source.index
        count = folder.once(f"{index:06d}.splats", lambda: self._saved(folder))
        return Region(index, int(count), folder)

    def _saved(self, folder: Folder) -> NDArray[np.int64]:
        splats = self.source.splats()
        splats = splats if self.rows is None else splats.take(self.rows)
        kind = np.result_type(*(getattr(splats, name) for name in ARRAYS))
        folder.save(self.source.index, {"splats": packed(splats).astype(kind, copy=False)})
        return np.array(len(splats))


@dataclass(frozen=True)
class AtOnceContext:
    """What refitting all survivors at once needs."""

    folder: Folder
    views: ViewSet
    units: Sequence[Unit]  # the unpruned splats
    settings: Refit


@dataclass(frozen=True)
class RefitAtOnce:
    """Refits all survivors, as in memory."""

    regions: Sequence[Region]  # where they are, see `Survivors`
    origin: NDArray[np.int64]

    def run(self, context: AtOnceContext, runtime: Runtime) -> NDArray[np.float64]:
        """Save them, unless that is done; return rounds, and PSNR before and after."""
        told = context.folder.once("000000.refitted", lambda: self._refitted(context, runtime))
        return np.asarray(told)

    def _refitted(self, context: AtOnceContext, runtime: Runtime) -> NDArray[np.float64]:
        original = joined([unit.splats() for unit in context.units])
        done = refit(
            self._survivors(original), original, context.views, context.settings,
            progress=runtime.progress, threads=runtime.threads,
        )  # fmt: skip
        context.folder.save(0, {"splats": packed(done.splats), "changed": done.changed})
        return np.array([done.rounds, done.psnr_before, done.psnr])

    def _survivors(self, original: Splats) -> Splats:
        if self.regions:
            return joined([region.splats() for region in self.regions])
        return unpacked(packed(original.take(self.origin)))


@dataclass(frozen=True)
class RegionsContext:
    """What all regions need; the folder has of each the ``rows`` of its survivors."""

    folder: Folder
    before: StoredSplats  # the unpruned splats
    after: StoredSplats  # all survivors, as they are
    settings: Refit


@dataclass(frozen=True)
class RefitRegion:
    """Refits the survivors of a region amid all others."""

    index: int

    def run(self, context: RegionsContext, runtime: Runtime) -> int:
        """Save them, unless that is done; return in how many rounds they were refitted."""
        name = f"{self.index:06d}.refitted"
        return int(context.folder.once(name, lambda: self._refitted(context, runtime)))

    def _refitted(self, context: RegionsContext, runtime: Runtime) -> NDArray[np.int64]:
        rows, settings = context.folder.load(self.index, ["rows"])["rows"], context.settings
        splats, changed, rounds = context.after.take(rows), np.zeros(len(rows), np.bool_), 0
        rays = RegionRays(splats, rows, context.before, context.after, runtime.threads)
        if rays.windows:
            *_, done = refit_on(
                rays, splats, settings,
                progress=runtime.progress, threads=runtime.threads,
            )  # fmt: skip
            splats, changed, rounds = done.splats, done.changed, done.rounds
        context.folder.save(self.index, {"splats": packed(splats), "changed": changed})
        return np.array(rounds)


def refit_survivors(
    tiles: MeasuredTiles, survivors: Survivors, settings: Refit, runner: Runner
) -> Refitting | None:
    """Refit survivors to what the views see of the unpruned splats.

    Parameters
    ----------
    tiles : MeasuredTiles
        All splats, before any were removed.
    survivors : Survivors
    settings : Refit
    runner : Runner

    Returns
    -------
    Refitting or None
        None if the views see too little. Never below what it began with, by the validation rays.

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.

    Notes
    -----
    Memory of this process: about 40 bytes a splat; of a worker: see `refit.refit`, for half as many
    survivors as a region has. On the disk: about 250 bytes a splat and, of harmonics of degree 3,
    500 a survivor.
    """
    if len(tiles.measured.seen) <= absorbing.REGION:
        return _at_once(tiles, survivors, settings, runner)
    folder = tiles.context.folder.inner("refitting")
    if not survivors.regions:
        kept = _saved(tiles.units, folder.inner("kept"), runner, survivors.origin)
        survivors = replace(survivors, regions=kept)
    context, psnr_before = absorbing.estimated(tiles, survivors.regions, runner.part(0.0, 0.1))
    if psnr_before is None:
        return None
    before = StoredSplats(tiles.context, _saved(tiles.units, folder.inner("unpruned"), runner))
    after = StoredSplats(context, survivors.regions)
    regions = RegionsContext(folder.inner("regions"), before, after, settings)
    refitted = _by_regions(regions, survivors, psnr_before, runner.part(0.1, 0.9))
    _, psnr = absorbing.estimated(tiles, refitted.survivors.regions, runner.part(0.9, 1.0))
    if psnr is None or psnr <= psnr_before:
        unchanged = np.zeros(len(survivors.origin), np.bool_)
        return Refitting(survivors, unchanged, 0, psnr_before, psnr_before)
    return replace(refitted, psnr=psnr)


def _at_once(
    tiles: MeasuredTiles, survivors: Survivors, settings: Refit, runner: Runner
) -> Refitting:
    """Refit all survivors in one step."""
    folder = tiles.context.folder.inner("refitted")
    context = AtOnceContext(folder, tiles.context.views, tiles.units, settings)
    step = RefitAtOnce(survivors.regions, survivors.origin)
    ((rounds, psnr_before, psnr),) = runner.run(context, [step], "refitting")
    changed = folder.load(0, ["changed"])["changed"]
    made = replace(
        survivors,
        regions=[Region(0, len(changed), folder)],
        changed=survivors.changed | changed,
    )
    return Refitting(made, changed, int(rounds), float(psnr_before), float(psnr))


def _by_regions(
    context: RegionsContext, survivors: Survivors, psnr: float, runner: Runner
) -> Refitting:
    """Refit survivors region by region; the PSNR afterwards stays to be found."""
    scene, rows = context.before.context, np.arange(len(survivors.origin))
    stage = StageContext(context.folder, scene.views, scene.scene, survivors.regions)
    boxes = absorbing.boxes_of(stage, rows, absorbing.REGION // _DENSER, 0, runner)
    for index, box in enumerate(boxes):
        context.folder.save(index, {"rows": box})
    steps, sizes = [RefitRegion(index) for index in range(len(boxes))], [*map(len, boxes)]
    rounds = [*runner.run(context, steps, "refitting", sizes)]
    order = np.concatenate(boxes)
    changed = context.folder.joined(range(len(boxes)), "changed")
    made = replace(
        survivors,
        regions=[Region(index, size, context.folder) for index, size in enumerate(sizes)],
        origin=survivors.origin[order],
        changed=survivors.changed[order] | changed,
    )
    return Refitting(made, changed, max(rounds), psnr, psnr)


def _saved(
    units: Sequence[Unit], folder: Folder, runner: Runner, rows: NDArray[np.int64] | None = None
) -> list[Region]:
    """Save the splats of all units, or some of them by their rows, ascending, as regions."""
    begins = np.cumsum([0, *map(len, units)])
    places = None if rows is None else np.split(rows, np.searchsorted(rows, begins[1:-1]))
    steps = [
        SaveSplats(unit, None if places is None else places[number] - begins[number])
        for number, unit in enumerate(units)
    ]
    return [*runner.part(0.0, 0.0).run(folder, steps, "reading")]
