"""Pruning many files as one scene, by one ranking and one budget over all of them."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...version import VERSION
from ..costs import Cost, Images, Plan, joined
from ..errors import RefineError
from ..execute import Cancelled, Progress, silent
from ..formats.format import Format
from ..formats.ply_header import with_count
from ..operation.requests import PruneRequest
from ..operation.run import Request, Runtime, Written, run
from ..quality.curve import needed
from ..quality.psnr import psnr_kept
from ..refit.refit import Gains, Refit
from ..report import (
    MEASURES,
    conclude,
    conclude_between,
    expected_psnr,
    files_facts,
    make_report,
    remark,
)
from ..scores import Scores
from ..scoring.closed_form import ROWS
from ..selection import Budget, refuse_none_left
from ..survivor_choice import Became
from ..urls import Url
from . import absorbing
from .absorbing import Survivors
from .closed_form import ClosedFormContext, by_closed_form
from .folder import Folder, Interrupted
from .plans import making as plan_making
from .plans import scoring as plan_scoring
from .refitting import refit_survivors
from .scoring import MeasuredTiles, by_occlusion, measured_once
from .selecting import ChooseByScore, removals, rule_of
from .storage import located, new_folder
from .units import Tile, Unit, header_of, pieces_of, tiles_at, units_of
from .workers import InProcess, Runner, Workers
from .writing import Outputs, WriteTile

UNCHANGED = (
    "survivors stay unchanged: over tiles they absorb or are refitted where that is asked for by "
    "name, which takes longer, and room on the disk"
)
"""A note of the report, where the files of one scene would have absorbed by default."""


def prune_tiles(
    sources: Sequence[Path | str],
    folder: Path | str | None,
    request: PruneRequest,
    *,
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
    request : PruneRequest
        What is asked. Up to `absorbing.REGION` splats, survivors that change are those of one file;
        more are absorbed and refitted region by region.
    progress, threads
        See `operation.run.run`.
    workers : Workers, optional
        Who does the steps; by default this process. See `cluster`.

    Returns
    -------
    dict
        The report, with ``tiles``: of each its name, counts and bytes.

    Raises
    ------
    RefineError, Cancelled
        See `pipeline.prune` and `units.tiles_at`; also if the request is none that works over
        tiles, or two files have one name. Then nothing is written, and nothing kept.
    Interrupted
        If a disk is full, a storage or all workers fail, or a file appears in the place of an
        output. What is done is kept for the same call.
    """
    absorbs_in_memory, by_default = request.absorb, request.survivors == "auto"
    if by_default:  # over tiles absorbing takes far longer, and room on the disk
        request = replace(request, survivors="unchanged")
    asked = TilesRequest(request)
    tiles = tiles_at(sources, request.model)
    output = None if folder is None or request.dry_run else located(folder)
    with contextlib.ExitStack() as held:
        if output is None:
            place = Path(held.enter_context(tempfile.TemporaryDirectory(prefix="refine-")))
        else:
            near = Path.cwd() if isinstance(output, Url) else output.absolute()
            place = near / f".refine-{_digest(tiles, asked)}"
        scene = TileScene(Folder(place), tiles, workers or InProcess(threads))
        sink = TileSink(scene, output, overwrite=request.overwrite)
        told = run(scene, asked, sink, progress=progress, threads=threads).report
    if by_default:
        told["survivors"]["asked"] = "auto"
        if absorbs_in_memory:
            told["notes"].append(UNCHANGED)
    return told


@dataclass(frozen=True, eq=False)
class TileScene:
    """Tiles as one scene: a source whose splats stay on the disk.

    Attributes
    ----------
    folder : Folder
        Of the job.
    tiles : list of Tile
    workers : Workers
        Who does the steps.
    """

    folder: Folder
    tiles: list[Tile]
    workers: Workers

    @functools.cached_property
    def units(self) -> list[Unit]:
        """The tiles, cut into units."""
        return units_of(self.tiles)

    @property
    def total(self) -> int:
        """How many splats there are."""
        return sum(map(len, self.units))

    @property
    def bytes(self) -> int:
        """Of all files."""
        return sum(tile.size for tile in self.tiles)

    def read(self, _form: Format | None) -> TileScene:
        """Raise `RefineError` if a worker does not see all files, `Interrupted` if much is done."""
        goes_on, _ = self.folder.noted("begun")
        self.folder.note("begun", None)
        try:
            self.workers.check(self.folder, self.tiles)
        except RefineError as error:
            if goes_on:
                raise Interrupted(str(error)) from error
            raise
        return self


@dataclass(frozen=True, eq=False)
class TileDecision:
    """Which splats stay of each tile; which these are, the units say in the folder of the job.

    Attributes
    ----------
    counts : (tiles, 2) int64
        Of each tile, how many splats stay, and how many lie in no view.
    changed : bool
        Whether survivors may have changed.
    report : dict
    """

    counts: NDArray[np.int64]
    changed: bool
    report: dict[str, Any]


@dataclass(frozen=True, eq=False)
class _Made:
    """What survivors became: see `pipeline.refit_splats.Made`."""

    absorbed: Survivors  # by absorbing alone
    survivors: Survivors  # in the end
    refitted: Gains | None = None
    seconds: float = 0.0
    psnr: float | None = None


@dataclass(frozen=True, eq=False)
class TilesRequest(Request[TileScene, TileDecision]):
    """What is asked of a prune over tiles.

    Attributes
    ----------
    prune : PruneRequest
    """

    prune: PruneRequest

    def __post_init__(self) -> None:
        """Refuse what needs all splats at once."""
        budget, settings = self.prune.budget, self.prune.settings
        if self.prune.zones or self.prune.cleaning or self.prune.pictures:
            raise RefineError(
                "volumes, cleaning and pictures need all splats in memory: not over tiles"
            )
        if self.prune.absorb and (budget.threshold is not None or budget.psnr is not None):
            what = "a threshold" if budget.psnr is None else "a PSNR"
            raise RefineError(
                f"{what} needs all splats in memory to absorb: over tiles choose another budget"
            )
        if budget.psnr is not None and not settings.estimates:
            raise RefineError(f"over tiles {settings.method} estimates no PSNR: choose occlusion")

    def costs(self, scene: TileScene) -> list[Plan]:
        """Return what the steps are expected to cost; see `Request.costs`."""
        writing = Cost("rewriting" if self.prune.absorb else "writing", scene.bytes)
        return [joined(self._plans(scene)), [writing], []]

    def _plans(self, scene: TileScene) -> list[Plan]:
        """Return what getting ready, scoring, saving scores, and making survivors may cost."""
        asked, count = self.prune, scene.total
        images = Images.of(asked.views.spread(asked.settings.views))
        removed = removals(asked.budget, scene.tiles)
        known = removed is not None and not removed.by_bytes
        settled = needed(removed.amount, count) if removed is not None and known else None
        plans = plan_scoring(count, images, asked.settings, settled, once=asked.absorb)
        if not asked.absorb:
            return [*plans, []]
        left = count - removed.amount if removed is not None and known else count // 2
        made = plan_making(count, left, images, _refit(asked))
        return [*plans, joined(made)]

    def decide(self, scene: TileScene, runtime: Runtime) -> TileDecision:
        """Score the tiles and decide what stays.

        Raises
        ------
        RefineError, Cancelled, Interrupted
            See `prune_tiles`.
        """
        asked, runner = self.prune, Runner(scene.workers, runtime.progress)
        *scoring, making = runner.phases(*self._plans(scene))
        scores, measured = self._score(scene, scoring)
        notes = (*scores.notes, asked.views.note) if asked.views.note else scores.notes
        scores = replace(scores, notes=notes, views_given=len(asked.views))
        runtime.clock.lap("score_s")
        silently = Runner(scene.workers)
        counts = _select(scene, asked.budget, scores, silently)
        runtime.clock.lap("select_s")
        made = None
        if measured is not None:
            made = self._made(measured, int(counts[:, 0].sum()), making)
            settled = absorbing.settle(made.survivors, scene.units, scene.folder, silently)
            counts = _counted(scene, settled)
            runtime.clock.lap("absorb_s")
        changed = made is not None and bool(made.survivors.regions)
        psnr = made.psnr if made else None
        keep = np.empty(0, np.bool_)
        if scores.ray_sample is not None:
            load = scene.folder.load
            keep = np.concatenate([load(unit.index, ["keep"])["keep"] for unit in scene.units])
            psnr = psnr if changed else psnr_kept(scores.ray_sample, keep)
        facts = make_report(scores, keep, asked.budget, asked.settings, runtime.clock)
        kept, unseen = counts.sum(axis=0).tolist()
        size, removed = scene.bytes, scene.total - kept
        why = remark(asked.budget, removed, scene.total, psnr, size)
        conclude(facts, scores, keep, psnr, made.absorbed if made else None, why)
        conclude_between(facts, None)
        facts["survivors"]["asked"] = asked.survivors
        if made is not None:
            if made.refitted is not None:
                told: dict[Became, float | None] = {
                    "absorb": made.refitted.psnr_before,
                    "refit": psnr,
                }
                share = removed / scene.total
                facts["survivors"] |= expected_psnr(scores, share, told)
                facts["survivors"]["became"] = "refit"
                facts["refitted"] = {"began": "absorb", **made.refitted.facts(made.seconds)}
                facts["notes"].append(made.refitted.note(made.seconds))
            if asked.settings.method == "closed-form":
                facts["notes"].append(MEASURES)
        facts["splats"] |= {"before": scene.total, "kept": kept, "removed": removed}
        facts["splats"] |= {"unseen": unseen, "left_out": 0, "protected": 0, "forced": 0}
        return TileDecision(counts, changed, facts)

    def _score(
        self, scene: TileScene, runners: Sequence[Runner]
    ) -> tuple[Scores, MeasuredTiles | None]:
        """Score all splats; to absorb, also return what the views see of them.

        Of the runners one gets tiles ready, one scores and one saves the scores.
        """
        settings, absorb = self.prune.settings, self.prune.absorb
        used = self.prune.views.spread(settings.views)
        closed_form = ClosedFormContext(scene.folder, used, {}, used.middle())
        if absorb:
            measured = measured_once(closed_form, scene.units, settings, runners)
            return measured.scores, measured
        if settings.method == "closed-form":
            return by_closed_form(closed_form, scene.units, runners[1])[0], None
        removed = removals(self.prune.budget, scene.tiles)
        settled = None
        if removed is not None and not removed.by_bytes:
            settled = needed(removed.amount, scene.total)
        return by_occlusion(closed_form, scene.units, settings, settled, runners), None

    def _made(self, measured: MeasuredTiles, kept: int, runner: Runner) -> _Made:
        """Return what so many survivors become."""
        settings, refit = self.prune.settings, _refit(self.prune)
        count, images = len(measured.measured.seen), Images.of(measured.context.views)
        plans = plan_making(count, kept, images, refit)
        absorbing_runner, refitting, estimating = runner.phases(*plans)
        absorbed = absorbing.absorb(measured, kept, settings, absorbing_runner)
        made = _Made(absorbed, absorbed)
        if refit is not None and kept < count:
            start = time.perf_counter()
            done = refit_survivors(measured, absorbed, refit, refitting)
            if done is not None:
                made = _Made(absorbed, done.survivors, done, time.perf_counter() - start)
        if not made.survivors.regions:
            return made
        _, psnr = absorbing.estimated(measured, made.survivors.regions, estimating)
        return replace(made, psnr=psnr)


def _refit(request: PruneRequest) -> Refit | None:
    """Return how survivors are refitted; None if they are not."""
    return request.settings.refit if request.survivors == "refit" else None


def _select(scene: TileScene, budget: Budget, scores: Scores, runner: Runner) -> NDArray[np.int64]:
    """Decide by scores which splats stay; return how many, see `TileDecision.counts`."""
    rule = rule_of(budget, scores, scene.tiles, scene.units, scene.folder, runner)
    steps = [ChooseByScore(unit, rule) for unit in scene.units]
    counts = _counted(scene, runner.run(scene.folder, steps, "selecting"))
    refuse_none_left(budget, scene.total, int(counts[:, 0].sum()))
    return counts


def _counted(scene: TileScene, each: Iterable[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Add up what each unit tells of its parts; see `selecting.save_kept`."""
    numbers = {tile: number for number, tile in enumerate(scene.tiles)}
    rows = [numbers[part.tile] for unit in scene.units for part in unit.parts]
    counts = np.zeros((len(scene.tiles), 2), np.int64)
    np.add.at(counts, rows, np.concatenate([*each]))
    return counts


class TileSink:
    """A folder in which each tile gets a file of what stays of it: all of them or none.

    Parameters
    ----------
    scene : TileScene
    folder : Path or Url or None
        Made if it is not there. None writes nothing.
    overwrite : bool
        Whether files may be replaced.
    """

    timing = "write_s"
    form = None
    """Tiles are plain PLY."""

    def __init__(self, scene: TileScene, folder: Path | Url | None, *, overwrite: bool) -> None:
        self._scene, self._folder, self._overwrite = scene, folder, overwrite
        self._outputs: Outputs | None = None

    @contextlib.contextmanager
    def opened(self) -> Iterator[None]:
        """Refuse what cannot be written, and open the folder of the job.

        It is removed when the block ends, unless the job can go on.

        Raises
        ------
        RefineError
            See `Outputs.of` and `Folder.opened`.
        """
        scene, folder = self._scene, self._folder
        with contextlib.ExitStack() as held:
            if folder is not None:
                held.enter_context(new_folder(folder))
                self._outputs = Outputs.of(
                    scene.folder, scene.tiles, folder, overwrite=self._overwrite
                )
            held.enter_context(scene.folder.opened())
            try:
                yield
            except Interrupted as error:
                if self._outputs is None:
                    raise
                raise Interrupted(
                    f"{error}; the same command goes on where this one was"
                ) from error
            except (RefineError, Cancelled):
                scene.folder.remove()
                if self._outputs:
                    self._outputs.discard()
                raise
            scene.folder.remove()

    def write(self, scene: TileScene, decision: TileDecision, runtime: Runtime) -> Written:
        """Write each tile where it waits, unless it is in its place; then rename all of them."""
        outputs, kept = self._outputs, decision.counts[:, 0].tolist()
        if outputs is None:
            sizes = [_size(tile, count) for tile, count in zip(scene.tiles, kept, strict=True)]
        else:
            runner = Runner(scene.workers, runtime.progress)
            sizes = _write(scene, decision, outputs, runner)
            outputs.publish()
        target = None if outputs is None else str(self._folder)
        before = scene.bytes
        return Written(
            files=files_facts(f"{len(scene.tiles)} tiles", target, before, sum(sizes)),
            splats={"written": None if outputs is None else sum(kept)},
            facts={"tiles": _facts(scene.tiles, outputs, sizes, decision.counts)},
        )


def _write(scene: TileScene, decision: TileDecision, outputs: Outputs, runner: Runner) -> list[int]:
    """Write each tile that is not in its place; return the bytes of all."""
    sizes, pieces = outputs.in_place(), pieces_of(scene.tiles, scene.units)
    steps = [
        WriteTile(number, tile, pieces[number], kept, decision.changed, url)
        for number, (tile, (kept, _), url) in enumerate(
            zip(scene.tiles, decision.counts.tolist(), outputs.urls, strict=True)
        )
        if number not in sizes
    ]
    written = runner.run(scene.folder, steps, "writing", [step.tile.size for step in steps])
    sizes |= {step.number: size for step, size in zip(steps, written, strict=True)}
    return [sizes[number] for number in range(len(scene.tiles))]


def _size(tile: Tile, kept: int) -> int:
    """Return the bytes of a tile of which so many splats stay."""
    header = header_of(tile)
    shorter = len(header) - len(with_count(header, kept))
    return tile.fixed_bytes - shorter + kept * tile.row_bytes


def _facts(
    tiles: Sequence[Tile], outputs: Outputs | None, sizes: Sequence[int], counts: NDArray[np.int64]
) -> list[dict[str, Any]]:
    """Return what the report says of each tile."""
    targets = [str(target) for target in outputs.targets] if outputs else [None] * len(tiles)
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
            tiles, targets, sizes, counts.tolist(), strict=True
        )
    ]


def _digest(tiles: Sequence[Tile], request: TilesRequest) -> str:
    """Return a name for a job: that of the same job again, and of no other."""
    digest, asked = hashlib.blake2b(digest_size=8), request.prune
    for fact in (VERSION, ROWS, [*tiles], asked.budget, asked.settings, asked.survivors):
        digest.update(repr(fact).encode("utf-8", "surrogateescape"))
    for view in asked.views.spread(asked.settings.views):
        for field in fields(view):
            value = getattr(view, field.name)
            is_array = isinstance(value, np.ndarray)
            digest.update(value.tobytes() if is_array else repr(value).encode())
    return digest.hexdigest()
