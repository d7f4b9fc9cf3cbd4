"""What the command does, with or without Blender: refuse, read, decide, write, compare."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from .affine import AXES, UNKNOWN_AXES, is_uniform, transformed
from .cleaning.clean import Cleaning
from .cleaning.clean import clean as clean_splats
from .errors import RefineError
from .execute import Cancelled, Progress, report, seconds, silent, stages, within
from .formats import registry
from .formats.format import Format
from .formats.ply import SplatFile, refuse_other_models
from .formats.ply_columns import Changes, other_properties
from .formats.registry import format_named, read_splats, turned_from, write_splats
from .formats.streamed_sog import INDEX
from .methods import DEFAULT, ClosedForm, Method
from .pictures import PictureFiles
from .prune import prune, score
from .quality.alignment import alignment
from .quality.psnr import psnr_against
from .report import Clock, kept_and_removed, prices, scoring_notes, seen_by
from .result import Result, file_of
from .selection import Budget
from .splats import Model, Splats, joined
from .views import ViewSet
from .visibility.scene import nearby_order
from .volumes import Forced, Zone, forced
from .whole_file import expanded, refuse_existing, refuse_mapped

TRIES = 4  # most times that a file is written to find how many splats fit a size
SAMPLE = 1 << 16  # about so many splats are written before, for the first of these
CLOSE, AIM = 0.98, 0.99  # least share of a size that is used, and that the next try aims at
PROPERTY = "refine_score"  # the property of a PLY that holds the scores


class Scene(NamedTuple):
    """Splats in memory, those that are protected or removed, and the rows that are written."""

    name: str  # in the report
    bytes: int  # of the source
    splats: Splats  # in the frame of the views
    demands: Forced
    file: Callable[[], SplatFile]  # what is written, in the source's frame
    sizes: tuple[float, int]  # bytes of a splat in a plain PLY, and of the rest
    matrix: NDArray[np.float64] | None = None  # (4, 4), source to views
    notes: tuple[str, ...] = ()
    form: Format | None = None  # of the output, None for plain PLY; `run` sets it


Decide = Callable[[Scene, Clock, Progress], Result]
"""Decides which splats of a scene stay."""


class Options(TypedDict, total=False):
    """What `prune_file`, `clean_file` and `score_file` all take; see the first of them."""

    zones: Sequence[Zone]
    model: Model | None
    axes: str | None
    overwrite: bool
    progress: Progress
    threads: int | None


def by_cameras(file: SplatFile, views: ViewSet) -> SplatFile:
    """The file; an SPZ that does not name its axes is turned if the views see it better then."""
    if file.axes != UNKNOWN_AXES:
        return file
    found = alignment(file.splats(), views, views)
    if found.turn == 2:
        return turned_from(AXES[0], file, "since the cameras fit that better")
    remark = f"{file.path.name}: not turned; these cameras cannot tell whether its y points up"
    return file if found.fineness else replace(file, remarks=(*file.remarks, remark))


def read_scene(
    path: Path | str,
    zones: Sequence[Zone] = (),
    model: Model | None = None,
    axes: str | None = None,
    views: ViewSet | None = None,
) -> Scene:
    """Read a file of splats, of any format, into memory; its frame is that of views and zones.

    `model` and `axes` count if the file does not say, see `read_splats`; without `axes` the views
    decide on those of an SPZ.
    """
    file = read_splats(path, model, axes=axes)
    file = file if views is None else by_cameras(file, views)
    splats = file.splats()
    return Scene(
        str(file.path), file.stored_bytes, splats, forced(zones, splats.means), lambda: file,
        (file.row_bytes, file.fixed_bytes),
    )  # fmt: skip


def run(
    read: Callable[[], Scene],
    decide: Decide,
    output: Path | None,
    *,
    source: Path | None = None,
    overwrite: bool = False,
    dry_run: bool = False,
    views: ViewSet | None = None,
    pictures: PictureFiles | None = None,
    save: Callable[[Result, Path | None], None] | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Result:
    """Read, decide, write and compare; the report of the result is complete afterwards.

    If this fails nothing is written, but for the last round of a refit that is cancelled, and for a
    file whose comparison fails. Without `output`, or in a dry run, no splats are written. `source`
    is the file that is read meanwhile. In `views` a lossy file and `pictures` are compared with all
    splats. `save` follows the writing.
    """
    clock, written = Clock(), None if dry_run else output
    folder = pictures.opened(views) if pictures and views else contextlib.nullcontext()
    with within(cores=threads), folder:
        if written is not None:
            refuse_existing(written, overwrite=overwrite)
            if source is not None:
                refuse_mapped(written, source)
        form = None if output is None else format_named(output)
        scene = read()._replace(form=form)
        clock.lap("read_s")
        count = len(scene.splats)
        drawing = 0.0 if pictures is None else seconds("draw", count, 6)
        deciding, writing, comparing = stages(
            progress, seconds("measure", count, 64), seconds("write", count), drawing
        )
        result = decide(scene, clock, deciding)
        stopped = result.stopped
        if stopped is not None and save is not None:  # nothing is saved over what is unfinished
            raise stopped
        report(silent if stopped else writing, 0.0, "writing")
        file = scene.file()
        result = replace(result, source=file, matrix=scene.matrix)
        keep, columns, told = result.keep, result.changed(), result.report
        if written is not None:
            write_splats(written, file, keep, columns=columns, overwrite=overwrite, threads=threads)
        dry = (file, form, keep, columns)
        size = registry.written_size(*dry) if written is None else written.stat().st_size
        if save is not None:
            save(result, written)
        clock.lap("write_s")
        if stopped is not None:
            if written is not None:
                stopped.add_note(f"{written} is written with what that had reached")
            raise stopped
        missing, said = registry.losses(file, form, keep)
        left = int(np.count_nonzero(keep)) - missing
        told["splats"] |= {"written": None if written is None else left, "left_out": missing}
        told["notes"] += [*said, *scene.notes]
        told["files"] = {
            "input": scene.name, "output": None if written is None else str(written),
            "input_bytes": scene.bytes, "output_bytes": size,
        }  # fmt: skip
        try:
            rays = None if result.scores is None else result.scores.ray_sample
            after = None  # splats of a lossy file, read again
            lossy = None if form is None or views is None else written
            if lossy is not None and (rays or pictures):
                after = _reread(lossy, file.axes.strip(UNKNOWN_AXES), scene.matrix)
            if lossy is not None and views is not None and result.scores:
                used = views.spread(told["settings"]["views"])
                psnr = None if rays is None or after is None else psnr_against(rays, after, used)
                told["written_psnr"] = None if psnr is None else round(psnr, 2)
            if pictures is not None and views is not None:
                if after is None:
                    after = replace(result, source=scene.splats).splats
                told["pictures"] = pictures.write(scene.splats, after, views, progress=comparing)
                clock.lap("pictures_s")
        except (Cancelled, KeyboardInterrupt) as stop:
            if written is not None:
                stop.add_note(f"{written} is written, its pictures and report are not")
            raise
    told["timings"] = clock.stop()
    return result


def _reread(path: Path, axes: str, matrix: NDArray[np.float64] | None) -> Splats | None:
    """Splats of a lossy file in the views' frame; None if unreadable or `matrix` is not uniform."""
    try:
        path.open("rb").close()
    except PermissionError:
        return None
    if matrix is not None and not is_uniform(matrix):
        return None
    splats = read_splats(path, axes=axes or None).splats()
    return splats if matrix is None else transformed(splats, matrix)


def prune_scene(
    views: ViewSet, budget: Budget, method: Method, cleaning: Cleaning | None = None,
    *, reusable: bool = False,
) -> Decide:  # fmt: skip
    """`decide` of `run` that cleans, if there is `cleaning`, and prunes the rest; see `prune`."""

    def decide(scene: Scene, clock: Clock, progress: Progress) -> Result:
        demands, splats, left = scene.demands, scene.splats, None
        if cleaning is not None:
            first, progress = stages(progress, 0.3, 0.7)
            cleaned = clean_splats(splats, views, cleaning, **demands.masks, progress=first)
            clock.lap("clean_s")
            # The budget counts what the user removed, so that is not cleaned away.
            left = cleaned.keep if demands.removed is None else cleaned.keep | demands.removed
            splats, demands = splats.take(left), demands.of(left)

        fits = budget.max_mb is not None and scene.form is not None

        def pruned(method: Method, sizes: tuple[float, int], **more: Any) -> Result:
            return prune(
                splats, views, budget, method, sizes=sizes, partial=True, reusable=reusable or fits,
                **demands.masks, **more,
            )  # fmt: skip

        def changed(result: Result) -> list[tuple[NDArray[np.bool_], Changes]]:
            result = replace(result if left is None else result.for_all(left), matrix=scene.matrix)
            return [(result.keep, result.changed())]

        if fits:
            files, methods = [scene.file()], {ClosedForm(method.views): silent, method: progress}
            ways = [(partial(pruned, each, clock=clock), how) for each, how in methods.items()]
            result = to_size(budget, scene.form, files, changed, ways)
        else:
            result = pruned(method, scene.sizes, progress=progress, clock=clock)
        if left is not None:
            result = result.for_all(left)
            result.report["cleaned"] = cleaned.facts()
        result.report["volumes"] = list(demands.facts)
        return result

    return decide


def row_in(form: Format | None, files: Sequence[SplatFile]) -> float:
    """About how many bytes a splat of files takes in a format: mean of some, spread evenly."""
    step = max(sum(map(len, files)) // SAMPLE, 1)
    some = [np.arange(len(file)) % step == 0 for file in files]
    size = sum(map(registry.written_size, files, [form] * len(some), some))
    return size / sum(map(np.count_nonzero, some))


def to_size(
    budget: Budget,
    form: Format | None,
    files: Sequence[SplatFile],
    changed: Callable[[Result], Sequence[tuple[NDArray[np.bool_], Changes]]],
    ways: Sequence[tuple[Callable[..., Result], Progress]],
) -> Result:
    """Result that fits `Budget.max_mb` in a format, and hardly less, by writing a few tries.

    `changed(result)` has the kept rows and new columns of each file. A way is
    ``pruned(sizes, scores=..., progress=...)`` and its progress, the cheapest first: what follows
    begins with as many splats. `RefineError` if nothing fits.
    """
    limit = math.floor(1e6 * (budget.max_mb or 0.0))
    goal = AIM * limit / row_in(form, files)
    for pruned, progress in ways:
        kept, size, best, scores = 0, 0, None, None
        for trying in stages(progress, *(0.5**number for number in range(TRIES))):
            result = pruned((limit / goal, 0), scores=scores, progress=trying)
            fewer, kept = kept, int(np.count_nonzero(result.keep))
            pairs = zip(files, changed(result), strict=True)
            less, size = size, sum(registry.written_size(file, form, *each) for file, each in pairs)
            best = result if size <= limit or result.stopped else best
            enough = best is result and (size >= CLOSE * limit or kept == len(result.keep))
            if enough or kept == fewer:
                break
            slope = (size - less) / (kept - fewer)
            goal = max(kept + (AIM * limit - size) / (slope if slope > 0.0 else size / kept), 1.0)
            scores = result.scores if result.merged is None else None
        if best is None:
            raise RefineError(f"max_mb is {budget.max_mb}, {kept:,} splats take {size / 1e6:g}")
        goal, result = int(np.count_nonzero(best.keep)), best
    return result


def prune_file(
    source: Path | str,
    output: Path | str | None,
    views: ViewSet,
    budget: Budget,
    method: Method = DEFAULT,
    *,
    cleaning: Cleaning | None = None,
    pictures: PictureFiles | None = None,
    dry_run: bool = False,
    **options: Unpack[Options],
) -> Result:
    """Prune a file of splats, and write the result to another.

    Parameters
    ----------
    source, output : path-like, of any format, by suffix; without output nothing is written
    views, budget, method, progress, threads : see `prune`
    cleaning : Cleaning, optional; what to clean away first, the budget then counts the rest
    pictures : PictureFiles, optional; where pictures before and after go
    dry_run : bool, whether to decide as for the output and write no splats
    zones : sequence of Zone, which splats to protect and remove
    model : Model, optional; where the file does not say how splats are drawn, or is wrong
    axes : {"rub", "rdf"}, optional; of an SPZ, see `read_splats`; without, the views decide
    overwrite : bool, whether files may be replaced

    Returns
    -------
    Result : its report is complete, see docs/report.md

    Raises
    ------
    RefineError, Cancelled : see `read_splats`, `prune` and `write_splats`
    """
    decide = prune_scene(views, budget, method, cleaning)
    return _run_file(source, output, decide, views, pictures=pictures, dry_run=dry_run, **options)


def _run_file(source, output, decide, views, *, zones=(), model=None, axes=None, **how: Any):
    return run(
        lambda: read_scene(source, zones, model, axes, views), decide,
        None if output is None else expanded(output), source=expanded(source), views=views, **how,
    )  # fmt: skip


def clean_file(
    source: Path | str,
    output: Path | str | None,
    views: ViewSet,
    cleaning: Cleaning,
    **options: Unpack[Options],
) -> Result:
    """Clean a file of splats, and write the rest to another; see `prune_file` and `clean`."""

    def decide(scene: Scene, clock: Clock, progress: Progress) -> Result:
        demands = scene.demands
        cleaned = clean_splats(scene.splats, views, cleaning, **demands.masks, progress=progress)
        clock.lap("clean_s")
        report: dict[str, Any] = {
            **seen_by(cleaned, demands),
            "settings": asdict(cleaning),
            "volumes": list(demands.facts),
            "cleaned": cleaned.facts(),
            "notes": cleaned.notes(),
        }
        report["splats"] |= kept_and_removed(cleaned.keep)
        return Result(cleaned.keep, report)

    return _run_file(source, output, decide, views, **options)


def score_scene(views: ViewSet, method: Method) -> Decide:
    """`decide` of `run` that keeps all splats, with their scores as a property."""

    def decide(scene: Scene, clock: Clock, progress: Progress) -> Result:
        demands = scene.demands
        scores = score(scene.splats, views, method, **demands.masks, progress=progress)
        clock.lap("score_s")
        report: dict[str, Any] = {
            **seen_by(scores, demands),
            "settings": method.facts(),
            "volumes": list(demands.facts),
            "weights": scores.facts,
            "prices": prices(scores, clock.timings["score_s"]),
            "notes": scoring_notes(scores),
        }
        keep = np.ones(len(scene.splats), np.bool_)
        return Result(keep, report, columns={PROPERTY: scores.values})

    return decide


def score_file(
    source: Path | str,
    output: Path | str,
    views: ViewSet,
    method: Method = DEFAULT,
    **options: Unpack[Options],
) -> Result:
    """Write a file with the float property ``refine_score``; see `prune_file` and `score`."""
    return _run_file(source, output, score_scene(views, method), views, **options)


def convert_files(
    sources: Sequence[Path | str],
    output: Path | str,
    *,
    matrices: Sequence[NDArray[Any]] = (),
    degree: int | None = None,
    morton: bool = False,
    level: int = 0,
    model: Model | None = None,
    axes: str | None = None,
    overwrite: bool = False,
) -> Result:
    """Write the splats of files to another, in the format that its suffix names.

    A single file with no other option given keeps every property of a PLY.

    Parameters
    ----------
    sources : sequence of path-like, at least one, in the order of their splats in the output
    matrices : sequence of (4, 4), one for each file, or none; they transform its splats
    degree : int from 0 to 4, optional; harmonics above it are left out
    morton : bool, whether splats are sorted along a Z-shaped (Morton) curve, near ones together
    level : int, of a streamed SOG; 0 is the finest
    model : Model, optional; see `prune_file`
    axes : {"rub", "rdf"}, optional; see `read_splats`

    Raises
    ------
    RefineError : see `read_splats` and `transformed`; also if models differ, files have no such
        level, or there are no files or another number of matrices

    Examples
    --------
    To put a statue into a room, half a unit above::

        up = np.eye(4)
        up[1, 3] = -0.5
        convert_files(["room.ply", "statue.spz"], "both.sog", matrices=[np.eye(4), up])
    """
    if not sources:
        raise RefineError("no files to convert, expected at least one")
    if matrices and len(matrices) != len(sources):
        count = len(sources)
        raise RefineError(f"got {len(matrices)} matrices, expected {count}: one for each file")
    if degree not in (None, *range(5)):
        raise RefineError(f"degree is {degree}, expected a whole number from 0 to 4")
    alone = len(sources) == 1 and not (matrices or morton or level) and degree is None

    def read() -> Scene:
        if alone:
            return read_scene(sources[0], model=model, axes=axes)
        paths = [expanded(path) for path in sources]
        of_level = [path for path in paths if path.name.lower().endswith(INDEX)] or paths
        files = [read_splats(path, model, level if path in of_level else 0, axes) for path in paths]
        refuse_other_models(files)
        parts = [file.splats() for file in files]
        splats = joined(list(map(transformed, parts, matrices)) if matrices else parts)
        if degree is not None:
            splats = splats.up_to_degree(degree)
        if morton:  # what is not finite comes last
            finite = np.isfinite(splats.means).all(axis=1)
            rows = np.flatnonzero(finite)
            order = nearby_order(splats.means[rows]) if len(rows) else rows
            splats = splats.take(np.concatenate([rows[order], np.flatnonzero(~finite)]))
        stored = sum(file.stored_bytes for file in files)
        file = replace(file_of(splats, files[0].path, stored), axes=files[0].axes)
        lost = {name for each in files for name in other_properties(each.rows.dtype.names or ())}
        names = ", ".join(sorted(lost))
        return Scene(
            " + ".join(str(each.path) for each in files), stored, file.splats(), Forced(),
            lambda: file, (0.0, 0),
            notes=(f"splats are written anew, without {names}",) if lost else (),
        )  # fmt: skip

    def decide(scene: Scene, *_: Any) -> Result:
        count = len(scene.splats)
        return Result(np.ones(count, np.bool_), {"splats": {"before": count}, "notes": []})

    source = expanded(sources[0]) if alone else None
    return run(read, decide, expanded(output), source=source, overwrite=overwrite)
