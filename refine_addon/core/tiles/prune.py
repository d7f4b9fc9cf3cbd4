"""Pruning many files as one scene, by one ranking and one budget over all of them."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import tempfile
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...version import VERSION
from ..errors import RefineError
from ..estimate.psnr import psnr_kept
from ..estimate.quality import needed
from ..formats.ply_header import with_count
from ..report import MEASURES, Clock, Files, complete_report, conclude, make_report, remark
from ..scoring.closed_form_block import ROWS
from ..selection import Budget, refuse_none_left
from ..task import DEFAULTS, Settings
from ..urls import Url
from ..work import Cancelled, Progress, silent
from . import absorbing
from .closed_form import ClosedFormContext, by_closed_form
from .folder import Folder, Interrupted
from .scoring import by_occlusion, measured_once
from .selecting import ChooseByScore, removals, rule_of
from .storage import located, make_folder
from .units import header_of, pieces_of, tiles_at, units_of
from .workers import InProcess, Runner
from .writing import Outputs, WriteTile

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from ..scores import Scores
    from ..views import ViewSet
    from .absorbing import Survivors
    from .scoring import MeasuredTiles
    from .units import Tile
    from .workers import Workers

SCORED = 0.82
"""Part of the progress that scoring is, or scoring and absorbing; the rest is writing."""


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
    closed form, 400 for occlusion. If the process is interrupted or killed, the same call later
    goes on from there.

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
        See `pipeline.prune`. Up to `absorbing.REGION` splats survivors are those of one file; more
        are absorbed region by region.
    overwrite : bool
        Whether files may be replaced.
    workers : Workers, optional
        Who does the steps; by default this process. See `cluster`.

    Returns
    -------
    dict
        The report, with ``tiles``: of each its name, counts and bytes.

    Raises
    ------
    RefineError, Cancelled
        See `pipeline.prune` and `units.tiles_at`; also if the method or budget is none that works
        over tiles, or two files have one name. Then nothing is written, and nothing kept.
    Interrupted
        If a disk is full, a storage or all workers fail, or a file appears in the place of an
        output. What is done is kept for the same call.
    """
    clock = Clock()
    _refuse_what_needs_all(budget, settings, absorb=absorb)
    tiles = tiles_at(sources)
    used = views.spread(settings.views)
    digest = _digest(tiles, used, budget, settings, absorb=absorb)
    with _opened(folder, digest, tiles, overwrite=overwrite) as (job, outputs):
        runner = Runner(workers or InProcess(threads), progress)
        pruning = _Pruning(job, tiles, used, runner)
        facts = pruning.decide(budget, settings, views, clock, absorb=absorb)
        sizes = pruning.write(outputs) if outputs else pruning.sizes()
        if outputs:
            outputs.publish()
    clock.lap("write_s")
    facts["splats"]["written"] = facts["splats"]["kept"] if outputs else None
    before, after = sum(tile.size for tile in tiles), sum(sizes)
    target = None if folder is None else str(located(folder))
    complete_report(facts, clock, Files(f"{len(tiles)} tiles", target, before, after))
    facts["tiles"] = pruning.facts(outputs, sizes)
    return facts


@contextlib.contextmanager
def _opened(
    folder: Path | str | None, digest: str, tiles: Sequence[Tile], *, overwrite: bool
) -> Iterator[tuple[Folder, Outputs | None]]:
    """Open the folder of a job for the block; remove it afterwards, unless the job can go on.

    Parameters
    ----------
    folder : path-like or None
        Where the tiles go; None writes nothing.
    digest : str
        Name of the job.
    tiles : sequence of Tile
    overwrite : bool

    Yields
    ------
    Folder, Outputs or None
        That of the job, and where each tile goes.
    """
    if folder is None:
        with tempfile.TemporaryDirectory(prefix="refine-") as temporary:
            job = Folder(Path(temporary))
            with job.opened():
                yield job, None
        return
    output = located(folder)
    made = make_folder(output)
    try:
        near = Path.cwd() if isinstance(output, Url) else output.absolute()
        job = Folder(near / f".refine-{digest}")
        outputs = Outputs.of(job, tiles, output, overwrite=overwrite)
        with job.opened():
            try:
                yield job, outputs
            except Interrupted as error:
                msg = f"{error}; the same command goes on where this one was"
                raise Interrupted(msg) from error
            except (RefineError, Cancelled):
                job.remove()
                outputs.discard()
                raise
            job.remove()
    finally:
        with contextlib.suppress(OSError):  # those that hold something stay
            for path in made:
                path.rmdir()


@dataclass
class _Pruning:
    """A job under way.

    Attributes
    ----------
    folder : Folder
    tiles : list of Tile
    views : ViewSet
        Those that are used.
    runner : Runner
    """

    folder: Folder
    tiles: list[Tile]
    views: ViewSet
    runner: Runner

    def __post_init__(self) -> None:
        """Cut the tiles into units."""
        self.units = units_of(self.tiles)
        self.pieces = pieces_of(self.tiles, self.units)
        self.total = sum(map(len, self.units))
        # Of each tile, how many splats stay, and how many lie in no view.
        self.counts = np.zeros((len(self.tiles), 2), np.int64)
        self.survivors: Survivors | None = None

    def decide(
        self, budget: Budget, settings: Settings, views: ViewSet, clock: Clock, *, absorb: bool
    ) -> dict[str, Any]:
        """Score the tiles and decide what stays; return the report as far as it is known."""
        self._check_workers()
        scores, measured = self._score(budget, settings, absorb=absorb)
        notes = (*scores.notes, views.note) if views.note else scores.notes
        scores = replace(scores, notes=notes, views_given=len(views))
        clock.lap("score_s")
        self._select(budget, scores)
        clock.lap("select_s")
        keep, psnr = np.empty(0, np.bool_), None
        if measured is not None:
            psnr = self._absorb(measured, settings)
            clock.lap("absorb_s")
        if scores.ray_sample is not None:
            keep = np.concatenate(
                [self.folder.load(unit.index, ["keep"])["keep"] for unit in self.units]
            )
            psnr = psnr if self._changed else psnr_kept(scores.ray_sample, keep)
        facts = make_report(scores, keep, budget, settings, clock)
        kept, unseen = self.counts.sum(axis=0).tolist()
        size, removed = sum(tile.size for tile in self.tiles), self.total - kept
        why = remark(budget, removed, self.total, psnr, size)
        conclude(facts, scores, keep, psnr, self.survivors, why)
        if self.survivors is not None and settings.method == "closed-form":
            facts["notes"].append(MEASURES)
        facts["splats"] |= {"before": self.total, "kept": kept, "removed": removed}
        facts["splats"] |= {"unseen": unseen, "left_out": 0, "protected": 0, "forced": 0}
        return facts

    def _check_workers(self) -> None:
        """Raise `RefineError` if a worker does not see all files, `Interrupted` if much is done."""
        goes_on, _ = self.folder.noted("begun")
        self.folder.note("begun", None)
        try:
            self.runner.workers.check(self.folder, self.tiles)
        except RefineError as error:
            if goes_on:
                raise Interrupted(str(error)) from error
            raise

    def _score(
        self, budget: Budget, settings: Settings, *, absorb: bool
    ) -> tuple[Scores, MeasuredTiles | None]:
        """Score all splats; to absorb, also return what the views see of them."""
        closed_form = ClosedFormContext(
            self.folder, self.views, settings.closed_form, self.views.middle()
        )
        runner = self.runner.part(0.0, SCORED * (0.3 if absorb else 1.0))
        if absorb:
            measured = measured_once(closed_form, self.units, settings, runner)
            return measured.scores, measured
        if settings.method == "closed-form":
            return by_closed_form(closed_form, self.units, runner)[0], None
        removed = removals(budget, self.tiles)
        settled = None
        if removed is not None and not removed.by_bytes:
            settled = needed(removed.amount, self.total)
        return by_occlusion(closed_form, self.units, settings, settled, runner), None

    def _select(self, budget: Budget, scores: Scores) -> None:
        """Decide by scores which splats stay, and count them."""
        runner = self.runner.part(SCORED, SCORED)
        rule = rule_of(budget, scores, self.tiles, self.units, self.folder, runner)
        steps = [ChooseByScore(unit, rule) for unit in self.units]
        self._count(runner.run(self.folder, steps, "selecting"))
        refuse_none_left(budget, self.total, int(self.counts[:, 0].sum()))

    def _absorb(self, measured: MeasuredTiles, settings: Settings) -> float | None:
        """Absorb to as many survivors as were selected; the units then say which stay, and as what.

        Returns
        -------
        float or None
            The estimated PSNR of the survivors, dB, if some of them changed.
        """
        kept, runner = int(self.counts[:, 0].sum()), self.runner.part(0.3 * SCORED, 0.95 * SCORED)
        survivors = self.survivors = absorbing.absorb(measured, kept, settings, runner)
        runner = self.runner.part(0.95 * SCORED, SCORED)
        self._count(absorbing.settle(survivors, self.units, self.folder, runner.part(0.0, 0.0)))
        return absorbing.estimated(measured, survivors, runner) if self._changed else None

    @property
    def _changed(self) -> bool:
        """Whether survivors may have absorbed others."""
        return self.survivors is not None and bool(self.survivors.regions)

    def _count(self, counts: Iterable[NDArray[np.int64]]) -> None:
        """Add up what each unit tells of its parts; see `selecting.save_kept`."""
        numbers = {tile: number for number, tile in enumerate(self.tiles)}
        parts = itertools.chain.from_iterable(unit.parts for unit in self.units)
        rows = [numbers[each.tile] for each in parts]
        self.counts[:] = 0
        np.add.at(self.counts, rows, np.concatenate([*counts]))

    def write(self, outputs: Outputs) -> list[int]:
        """Write each tile where it waits, unless it is in its place; return the bytes of all."""
        sizes = outputs.in_place()
        steps = [
            WriteTile(number, tile, self.pieces[number], kept, self._changed, url)
            for number, (tile, (kept, _), url) in enumerate(
                zip(self.tiles, self.counts.tolist(), outputs.urls, strict=True)
            )
            if number not in sizes
        ]
        work, runner = [step.tile.size for step in steps], self.runner.part(SCORED, 1.0)
        written = runner.run(self.folder, steps, "writing", work)
        sizes |= {step.number: size for step, size in zip(steps, written, strict=True)}
        return [sizes[number] for number in range(len(self.tiles))]

    def sizes(self) -> list[int]:
        """Return the bytes that `write` would write of each tile."""
        sizes = []
        for tile, (kept, _) in zip(self.tiles, self.counts.tolist(), strict=True):
            header = header_of(tile)
            shorter = len(header) - len(with_count(header, kept))
            sizes.append(tile.fixed_bytes - shorter + kept * tile.row_bytes)
        return sizes

    def facts(self, outputs: Outputs | None, sizes: Sequence[int]) -> list[dict[str, Any]]:
        """Return what the report says of each tile."""
        targets = [str(target) for target in outputs.targets] if outputs else [None] * len(sizes)
        return [
            {
                "input": tile.path,
                "output": target,
                "before": tile.splats,
                "kept": kept,
                "unseen": unseen,
                "input_bytes": tile.size,
                "output_bytes": size,
            }
            for tile, target, size, (kept, unseen) in zip(
                self.tiles, targets, sizes, self.counts.tolist(), strict=True
            )
        ]


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


def _digest(
    tiles: Sequence[Tile], views: ViewSet, budget: Budget, settings: Settings, *, absorb: bool
) -> str:
    """Return a name for a job: that of the same job again, and of no other."""
    digest = hashlib.blake2b(digest_size=8)
    for fact in (VERSION, ROWS, [*tiles], budget, settings, absorb):
        digest.update(repr(fact).encode("utf-8", "surrogateescape"))
    for view in views:
        for field in fields(view):
            value = getattr(view, field.name)
            is_array = isinstance(value, np.ndarray)
            digest.update(value.tobytes() if is_array else repr(value).encode())
    return digest.hexdigest()
