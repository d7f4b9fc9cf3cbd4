"""Pruning many files as one scene, by one ranking and one budget over all of them."""

from __future__ import annotations

import contextlib
import hashlib
import math
import tempfile
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...version import VERSION
from .. import radix
from ..absorb_splats import FIRST
from ..errors import RefineError
from ..estimate.psnr import psnr_kept
from ..estimate.quality import needed
from ..formats.ply_header import with_count
from ..report import MEASURES, Clock, Files, complete_report, conclude, make_report, remark
from ..scoring.closed_form_block import ROWS
from ..selection import Budget, least_seen, quality_of, refuse_none_left, select, single
from ..task import DEFAULTS, Settings
from ..urls import Url
from ..work import Progress, part, silent
from . import absorbing
from .folder import Folder
from .scoring import by_closed_form, by_occlusion, to_absorb
from .steps import SURVIVORS, Job, Rule
from .storage import discard, identity, located, make_folder, publish, refuse_existing
from .units import header_of, tile_at, units_of
from .workers import Call, Here, Interrupted

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from ..scores import Scores
    from ..views import ViewSet
    from .absorbing import Survivors
    from .scoring import Seen
    from .units import Tile
    from .workers import Workers

SCORED = 0.82
"""Part of the progress that scoring is; the rest is writing."""


def prune_tiles(  # noqa: PLR0913 - as `file_to_file.prune_file`
    sources: Sequence[Path | str],
    folder: Path | str | None,
    views: ViewSet,
    budget: Budget,
    settings: Settings = DEFAULTS,
    *,
    absorb: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
    threads: int | None = None,
    workers: Workers | None = None,
) -> dict[str, Any]:
    """Prune files of splats as one scene, by one budget over all of them; none is held in memory.

    The same splats stay as if all files were one, in the order in which they are given: of equal
    scores, those of the first file go first. All files are written, or none. What stands between
    the steps lies in a folder beside the outputs until the job is done: 50 bytes a splat for the
    closed form, 400 for occlusion. If the process is killed, the same call later goes on from
    there.

    Parameters
    ----------
    sources : sequence of path-like
        Plain binary PLY files in one frame and unit, or URLs of such, which fsspec opens.
    folder : path-like or None
        Where each goes under its own name; made if it is not there. None writes nothing. If it is a
        URL, the folder of the job is in the current directory, files are copied to the URL under
        other names, and renamed at the end.
    views, budget, settings, progress, threads
        See `pipeline.prune`.
    absorb : bool
        See `pipeline.prune`. A region of up to a million splats is absorbed at a time
        (`absorbing`), so survivors are not exactly those of one file.
    overwrite : bool
        Whether files may be replaced.
    workers : callable, optional
        Who does the steps; by default this process. See `cluster`.

    Returns
    -------
    dict
        The report, with ``tiles``: of each its name, counts and bytes.

    Raises
    ------
    RefineError, Cancelled
        See `pipeline.prune` and `units.tile_at`; also if the method or budget is none that works
        over tiles, or two files have one name. Then nothing is written.
    """
    clock = Clock()
    _refuse_what_needs_all(budget, settings, absorb=absorb)
    tiles = [tile_at(path) for path in sources]
    _refuse_twice(tiles)
    output = None if folder is None else located(folder)
    targets = [] if output is None else _targets(tiles, output, overwrite=overwrite)
    used = views.spread(settings.views)
    with contextlib.ExitStack() as held:
        if output is None:
            place = Path(held.enter_context(tempfile.TemporaryDirectory(prefix="refine-")))
        else:
            digest = _digest(tiles, used, budget, settings, absorb=absorb)
            near = Path.cwd() if isinstance(output, Url) else output.absolute()
            place = near / f".refine-{digest}"
        urls: list[Url] = []
        if isinstance(output, Url):
            urls = [output / f"{place.name}-{number:06d}" for number in range(len(tiles))]
        job = Job(Folder(place), used, settings.closed_form, used.middle())
        held.enter_context(job.folder.opened())
        try:
            run = _Run(job, tiles, workers or Here(threads), progress)
            facts = run.prune(budget, settings, views, clock, absorb=absorb)
            sizes = run.write(urls) if targets else run.sizes()
            made: Sequence[Path | Url] = urls or [
                job.folder.tiles / target.name for target in targets
            ]
            for waiting, target in zip(made, targets, strict=True):
                publish(waiting, target, overwrite=overwrite)
        except Interrupted as error:
            if output is None:
                raise
            msg = f"{error}; the same command goes on where this one was"
            raise Interrupted(msg) from error
        except Exception:
            job.folder.remove()
            for url in urls:
                discard(url)
            raise
        job.folder.remove()
    clock.lap("write_s")
    facts["splats"]["written"] = facts["splats"]["kept"] if targets else None
    before = sum(tile.size for tile in tiles)
    complete_report(facts, clock, Files(f"{len(tiles)} tiles", _shown(output), before, sum(sizes)))
    names: list[Path | Url | None] = [*targets] or [None] * len(tiles)
    facts["tiles"] = [
        {
            "input": tile.path,
            "output": _shown(name),
            "before": tile.splats,
            "kept": kept,
            "unseen": unseen,
            "input_bytes": tile.size,
            "output_bytes": size,
        }
        for tile, name, size, (kept, unseen) in zip(
            tiles, names, sizes, run.counts.tolist(), strict=True
        )
    ]
    return facts


class _Run:
    """A job under way.

    Parameters
    ----------
    job : Job
    tiles : list of Tile
    workers : callable
    progress : callable

    Attributes
    ----------
    counts : (tiles, 2) int64
        Of each tile, how many splats stay, and how many lie in no view.
    """

    def __init__(self, job: Job, tiles: list[Tile], workers: Workers, progress: Progress) -> None:
        self.job, self.tiles, self.units = job, tiles, units_of(tiles)
        self.total = sum(tile.splats for tile in tiles)
        self.counts = np.zeros((len(tiles), 2), np.int64)
        self._workers, self._progress = workers, progress
        self._absorbed = False
        job.folder.note("begun", None)
        workers.check(job, tiles)

    def prune(
        self, budget: Budget, settings: Settings, views: ViewSet, clock: Clock, *, absorb: bool
    ) -> dict[str, Any]:
        """Score the tiles and decide what stays; return the report as far as it is known."""
        ahead = part(self._progress, 0.0, SCORED * (0.3 if absorb else 1.0))
        seen: Seen | None = None
        if absorb:
            seen = to_absorb(self.job, self.units, settings, self._workers, ahead)
            scores = seen.scores
        elif settings.method == "closed-form":
            scores = by_closed_form(self.job, self.units, self._workers, ahead)[0]
        else:
            amount, by_bytes = _amount(budget, self.tiles)
            settled = None if amount is None or by_bytes else needed(amount, self.total)
            scores = by_occlusion(self.job, self.units, settings, settled, self._workers, ahead)
        notes = (*scores.notes, views.note) if views.note else scores.notes
        scores = replace(scores, notes=notes, views_given=len(views))
        clock.lap("score_s")
        self._count(self._map("choose", self._rule(budget, scores)))
        kept, unseen = self.counts.sum(axis=0).tolist()
        refuse_none_left(budget, self.total, kept)
        clock.lap("select_s")
        keep, psnr, survivors = np.empty(0, np.bool_), None, None
        if seen is not None:
            survivors, psnr = self._absorb(seen, kept)
            kept = int(self.counts[:, 0].sum())
            clock.lap("absorb_s")
        if scores.ray_sample is not None:
            keep = np.concatenate(
                [self.job.folder.load(unit.index, ["keep"])["keep"] for unit in self.units]
            )
            psnr = psnr_kept(scores.ray_sample, keep) if not self._absorbed else psnr
        facts = make_report(scores, keep, budget, settings, clock)
        size = sum(tile.size for tile in self.tiles)
        why = remark(budget, self.total - kept, self.total, psnr, size)
        conclude(facts, scores, keep, psnr, survivors, why)
        if survivors is not None and settings.method == "closed-form":
            facts["notes"].append(MEASURES)
        facts["splats"] |= {
            "before": self.total,
            "kept": kept,
            "removed": self.total - kept,
            "unseen": unseen,
            "left_out": 0,
            "protected": 0,
            "forced": 0,
        }
        return facts

    def _absorb(self, seen: Seen, goal: int) -> tuple[Survivors, float | None]:
        """Absorb to `goal` survivors; the units then say which stay, and as what.

        Returns
        -------
        survivors : Survivors
        psnr : float or None
            The estimate for them, dB, if some of them changed.
        """
        first = min(math.floor(FIRST * self.total), self.total - goal)
        rest = select(seen.scores, Budget(keep=self.total - first))
        ahead = part(self._progress, 0.3 * SCORED, 0.95 * SCORED)
        found = absorbing.absorb(seen, rest, goal, workers=self._workers, progress=ahead)
        order = np.argsort(found.origin)
        arrays = found.origin[order], order, found.changed[order]
        for name, array in zip(SURVIVORS, arrays, strict=True):
            self.job.folder.note(name, array)
        begins = np.cumsum([0, *map(len, self.units)])
        self._count(self._map("settle", begins, found.regions))
        self._absorbed = bool(found.regions)
        if not self._absorbed:
            return found, None
        ahead = part(self._progress, 0.95 * SCORED, SCORED)
        return found, absorbing.estimated(seen, found, self._workers, ahead)

    def _count(self, kept: Iterator[NDArray[np.int64]]) -> None:
        """Note what each unit says of its parts, see `Job.choose`."""
        places = {tile: place for place, tile in enumerate(self.tiles)}
        self.counts[:] = 0
        for unit, each in zip(self.units, kept, strict=True):
            for (tile, _, _), pair in zip(unit.parts, each, strict=True):
                self.counts[places[tile]] += pair

    def write(self, urls: Sequence[Url]) -> list[int]:
        """Write each tile into the folder of the job, and to its URL if there are some.

        Returns
        -------
        list of int
            Their bytes.
        """
        places: Sequence[Url | None] = urls or [None] * len(self.tiles)
        calls = [
            Call(
                "write",
                (
                    tile,
                    [u for u in self.units if any(tile == part.tile for part in u.parts)],
                    kept,
                ),
                tile.splats / self.total,
                options={"absorbed": self._absorbed, "url": url},
            )
            for tile, (kept, _), url in zip(self.tiles, self.counts.tolist(), places, strict=True)
        ]
        return [*self._workers(self.job, calls, part(self._progress, SCORED, 1.0), "writing")]

    def sizes(self) -> list[int]:
        """Return the bytes that `write` would write of each tile."""
        found = []
        for tile, (kept, _) in zip(self.tiles, self.counts.tolist(), strict=True):
            header = header_of(tile)
            shorter = len(header) - len(with_count(header, kept))
            found.append(tile.fixed_bytes - shorter + kept * tile.row_bytes)
        return found

    def _map(self, step: str, *arguments: Any, **options: Any) -> Iterator[Any]:  # noqa: ANN401 - of each its own
        """Do a step of `Job` with each unit."""
        calls = [
            Call(step, (unit, *arguments), len(unit) / self.total, options=options)
            for unit in self.units
        ]
        ahead = part(self._progress, SCORED, SCORED)
        return self._workers(self.job, calls, ahead, "selecting")

    def _rule(self, budget: Budget, scores: Scores) -> Rule:
        """Return which splats a budget removes by scores."""
        if budget.threshold is not None:
            return Rule(threshold=float(single(budget.threshold)))
        if budget.min_seen is not None:
            return Rule(least_seen=least_seen(budget.min_seen, scores.views_used))
        if budget.psnr is not None:
            share = quality_of(scores).share(budget.psnr)
            amount, by_bytes = math.floor(share * self.total), False
        else:
            found, by_bytes = _amount(budget, self.tiles)
            amount = found or 0
        if not amount:
            return Rule(left=(0,) * len(self.units))

        def count(prefixes: list[int], shift: int) -> NDArray[np.int64]:
            return radix.added(self._map("rank", prefixes, shift, by_bytes=by_bytes))

        edge, below = radix.find(count, 32, [amount - 1])[0]
        tied = [*self._map("tied", edge, by_bytes=by_bytes)]
        before = np.cumsum([0, *tied[:-1]])
        return Rule(edge=edge, left=tuple((amount - below - before).tolist()), by_bytes=by_bytes)


def _amount(budget: Budget, tiles: Sequence[Tile]) -> tuple[int | None, bool]:
    """Return how many splats a budget removes, if it tells; or how many bytes, and True.

    Raises
    ------
    RefineError
        See `Budget.removals`.
    """
    lengths = {tile.row_bytes for tile in tiles if tile.splats}
    total, fixed = sum(tile.splats for tile in tiles), sum(tile.fixed_bytes for tile in tiles)
    removals = budget.removals(total, min(lengths), fixed)
    if budget.max_mb is None or len(lengths) == 1:
        return removals, False
    excess = sum(tile.splats * tile.row_bytes for tile in tiles) - budget.room(fixed)
    return max(excess, 0), True


def _refuse_what_needs_all(budget: Budget, settings: Settings, *, absorb: bool) -> None:
    """Raise `RefineError` for budgets that need all splats at once."""
    if absorb and (budget.threshold is not None or budget.psnr is not None):
        what = "a threshold" if budget.psnr is None else "a PSNR"
        msg = f"{what} needs all splats in memory to absorb: over tiles choose another budget"
        raise RefineError(msg)
    if budget.psnr is not None and not settings.estimates:
        msg = f"over tiles {settings.method} estimates no PSNR: choose auto or occlusion"
        raise RefineError(msg)
    budget.refuse_meaningless(settings.method, frustum=settings.frustum)


def _refuse_twice(tiles: Sequence[Tile]) -> None:
    """Raise `RefineError` if a file is given twice: its splats would count twice."""
    given: set[str] = set()
    for tile in tiles:
        if tile.path in given:
            msg = f"{tile.path}: is given twice"
            raise RefineError(msg)
        given.add(tile.path)


def _targets(tiles: Sequence[Tile], folder: Path | Url, *, overwrite: bool) -> Sequence[Path | Url]:
    """Return where each tile goes, and make the folder.

    Raises
    ------
    RefineError
        If two tiles have one name, or a file could not be made, or may not be replaced.
    """
    make_folder(folder)
    targets = [folder / tile.name for tile in tiles]
    read = {identity(tile.place) for tile in tiles}
    for place, target in enumerate(targets):
        if target in targets[:place]:
            msg = f"{tiles[place].path}: another tile is called {target.name} too"
            raise RefineError(msg)
        if identity(target) in read:
            msg = f"{target}: is read until all tiles are written; write to another folder"
            raise RefineError(msg)
        refuse_existing(target, overwrite=overwrite)
    return targets


def _digest(
    tiles: Sequence[Tile], views: ViewSet, budget: Budget, settings: Settings, *, absorb: bool
) -> str:
    """Return a name for a job: that of the same job again, and of no other."""
    told = hashlib.blake2b(digest_size=8)
    for fact in (VERSION, ROWS, [*tiles], budget, settings, absorb):
        told.update(repr(fact).encode("utf-8", "surrogateescape"))
    for view in views:
        for field in fields(view):
            value = getattr(view, field.name)
            told.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return told.hexdigest()


def _shown(path: Path | Url | None) -> str | None:
    return None if path is None else str(path)
