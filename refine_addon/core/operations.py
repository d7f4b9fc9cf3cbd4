"""What the command does, with or without Blender: refuse, read, decide, write, compare."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .affine import is_uniform, transformed
from .cleaning.clean import Cleaned, Cleaning
from .cleaning.clean import clean as clean_splats
from .errors import RefineError
from .execute import Cancelled, Progress, report, seconds, silent, stages
from .formats import registry
from .formats.format import Format, near_ones_together
from .formats.ply import SplatFile
from .formats.ply_columns import other_properties
from .formats.registry import format_named, read_splats, refuse_unknown_size, write_splats
from .formats.streamed_sog import INDEX
from .methods import DEFAULT, Method
from .pictures import PictureFiles
from .prune import prune, score
from .quality.psnr import psnr_against
from .rendering import Model
from .report import Clock, kept_and_removed, prices, scored, scoring_notes, seen_by
from .result import Result, file_of
from .scores import Scores
from .selection import Budget
from .splats import Splats, joined
from .views import ViewSet
from .volumes import FREE, Forced, Zone, forced
from .whole_file import expanded, refuse_existing, refuse_mapped

PROPERTY = "refine_score"
"""The property of a PLY that holds the scores."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Splats in memory, what must stay and go, and the rows that are written.

    Attributes
    ----------
    name : str
        What the report calls the source.
    bytes : int
        Its size.
    splats : Splats
        In the frame of the views.
    demands : Forced
        Which of them must stay, and which must go.
    file : callable
        Returns the `SplatFile` that is written, in the frame of the source.
    sizes : (float, int)
        Bytes of a splat in the output and of everything else there.
    matrix : (4, 4) float64 or None
        From the frame of the source to that of the views, where they differ.
    notes : tuple of str
        What the user should know about the source, in sentences.
    """

    name: str
    bytes: int
    splats: Splats
    demands: Forced
    file: Callable[[], SplatFile]
    sizes: tuple[float, int]
    matrix: NDArray[np.float64] | None = None
    notes: tuple[str, ...] = ()


def read_scene(
    path: Path | str,
    zones: Sequence[Zone] = (),
    model: Model | None = None,
    form: Format | None = None,
) -> Scene:
    """Read a file of any format; its frame is that of the views.

    Parameters
    ----------
    path : path-like
    zones : sequence of Zone
        Volumes that say which splats must stay and which must go.
    model : {"default", "antialiased", "2dgs"}, optional
        How the splats are drawn, where the file does not say or is wrong.
    form : Format, optional
        Of the output; by default plain PLY.
    """
    file = read_splats(path, model)
    splats = file.splats()
    return Scene(
        str(file.path), file.stored_bytes, splats, forced(zones, splats.means), lambda: file,
        registry.row_sizes(file, form),
    )  # fmt: skip


def run(
    read: Callable[[Format | None], Scene],
    decide: Callable[[Scene, Clock, Progress], Result],
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

    Parameters
    ----------
    read : callable
        ``read(form)`` returns the scene; `form` is the format of the output, None for plain PLY.
    decide : callable
        ``decide(scene, clock, progress)``.
    output : Path or None
        Its suffix names the format. None writes nothing.
    source : Path, optional
        The file that is read meanwhile.
    overwrite, dry_run : bool
        Whether files may be replaced; whether to decide as for the output, and write no splats.
    views : ViewSet, optional
        Those that decide: what a lossy file costs, and pictures, are told by these.
    pictures : PictureFiles, optional
        Where pictures before and after go.
    save : callable, optional
        ``save(result, written)`` does what is left once the file is written.
    progress, threads
        See `prune`.

    Raises
    ------
    RefineError, Cancelled
        Nothing is written then; but what was written before comparing fails stays, and where
        refitting is cancelled, what it had reached is written.
    """
    clock, written = Clock(), None if dry_run else output
    with contextlib.ExitStack() as held:
        if pictures is not None:
            assert views is not None
            held.enter_context(pictures.opened(views))
        if written is not None:
            refuse_existing(written, overwrite=overwrite)
            if source is not None:
                refuse_mapped(written, source)
        form = None if output is None else format_named(output)
        scene = read(form)
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
        facts = result.report
        file = scene.file()
        result = replace(result, source=file, matrix=scene.matrix)
        keep, columns = result.keep, result.changed(file.rows)
        size = registry.written_size(file, form, keep, columns)
        if written is not None:
            write_splats(written, file, keep, columns=columns, overwrite=overwrite, threads=threads)
            size = written.stat().st_size
        if save is not None:
            save(result, written)
        clock.lap("write_s")
        if stopped is not None:
            if written is not None:
                stopped.add_note(f"{written} is written with what that had reached")
            raise stopped
        missing = registry.left_out(file, form, keep)
        left = int(np.count_nonzero(keep)) - missing
        facts["splats"] |= {"written": None if written is None else left, "left_out": missing}
        facts["notes"] += [*registry.notes(file, form, keep), *scene.notes]
        facts["files"] = {
            "input": scene.name, "output": None if written is None else str(written),
            "input_bytes": scene.bytes, "output_bytes": size,
        }  # fmt: skip
        try:
            if written is not None and views is not None and result.scores is not None:
                facts |= _written_psnr(written, result, views, threads)
            if pictures is not None and views is not None:
                after = None if written is None else _reread(written, scene.matrix)
                facts["pictures"] = pictures.write(
                    scene.splats, result_splats(scene, result) if after is None else after, views,
                    progress=comparing, threads=threads,
                )  # fmt: skip
                clock.lap("pictures_s")
        except (Cancelled, KeyboardInterrupt) as stop:
            if written is not None:
                stop.add_note(f"{written} is written, its pictures and report are not")
            raise
    clock.stop()
    facts["timings"] = clock.timings
    return result


def result_splats(scene: Scene, result: Result) -> Splats:
    """The kept splats as they became, in the frame of the views."""
    return scene.splats.take(result.keep) if result.merged is None else result.merged.splats


def _written_psnr(
    path: Path, result: Result, views: ViewSet, threads: int | None
) -> dict[str, Any]:
    """What a lossy file costs, with what it rounds and leaves out; nothing of a plain PLY."""
    if format_named(path) is None:
        return {}
    assert result.scores is not None
    rays = result.scores.ray_sample
    splats = None if rays is None else _reread(path, result.matrix)
    if rays is None or splats is None:
        return {"written_psnr": None}
    used = views.spread(result.report["settings"]["views"])
    psnr = psnr_against(rays, splats, used, threads=threads)
    return {"written_psnr": None if psnr is None else round(psnr, 2)}


def _reread(path: Path, matrix: NDArray[np.float64] | None) -> Splats | None:
    """What a lossy file holds, in the frame of the views; None where that cannot be told.

    It cannot of a plain PLY, which is exact; of a file that may not be read, since it has the
    permissions of the one it replaced; and where `matrix` scales directions differently.
    """
    matrix = np.eye(4) if matrix is None else matrix
    try:
        path.open("rb").close()
    except PermissionError:
        return None
    if format_named(path) is None or not is_uniform(matrix):
        return None
    splats = read_splats(path).splats()
    return splats if np.array_equal(matrix, np.eye(4)) else transformed(splats, matrix)


def prune_scene(
    views: ViewSet, budget: Budget, method: Method = DEFAULT, cleaning: Cleaning | None = None,
    *, reusable: bool = False, threads: int | None = None,
) -> Callable[[Scene, Clock, Progress], Result]:  # fmt: skip
    """For `run`: clean, if asked, and prune the rest; see `prune`."""

    def decide(scene: Scene, clock: Clock, progress: Progress) -> Result:
        demands, splats = scene.demands, scene.splats
        protected, removed = demands.protected, demands.out
        left, cleaned = None, None
        if cleaning is not None:
            share = 0.3
            cleaned = clean_splats(
                splats, views, cleaning, protected=protected, forced_out=removed,
                progress=lambda done, what: progress(share * done, what), threads=threads,
            )  # fmt: skip
            clock.lap("clean_s")
            # The budget counts what the user removed, so that is not cleaned away.
            left = cleaned.keep if removed is None else cleaned.keep | removed
            splats = splats.take(left)
            protected, removed = (
                None if mask is None else mask[left] for mask in (protected, removed)
            )
        result = prune(
            splats, views, budget, method,
            protected=protected, removed=removed, sizes=scene.sizes, reusable=reusable,
            partial=True, clock=clock, progress=progress, threads=threads,
        )  # fmt: skip
        if left is not None and cleaned is not None:
            result = result.for_all(left)
            result.report["cleaned"] = cleaned.facts()
        result.report["volumes"] = list(demands.facts)
        return result

    return decide


def prune_file(
    source: Path | str,
    output: Path | str | None,
    views: ViewSet,
    budget: Budget,
    method: Method = DEFAULT,
    *,
    zones: Sequence[Zone] = (),
    cleaning: Cleaning | None = None,
    pictures: PictureFiles | None = None,
    model: Model | None = None,
    overwrite: bool = False,
    dry_run: bool = False,
    progress: Progress = silent,
    threads: int | None = None,
) -> Result:
    """Prune a file of splats, and write the result to another.

    Parameters
    ----------
    source, output : path-like
        Of any format; that of the output is named by its suffix. None writes nothing.
    views, budget, method, progress, threads
        See `prune`.
    zones, model
        See `read_scene`.
    cleaning : Cleaning, optional
        What to clean away first. The budget then counts what is left.
    pictures, overwrite, dry_run
        See `run`.

    Examples
    --------
    To leave half of the splats, with what was merged into them::

        prune_file("in.ply", "out.ply", views, Budget(ratio=0.5))
    """
    target = None if output is None else expanded(output)
    form = None if target is None else format_named(target)
    if budget.max_mb is not None and form is not None:
        refuse_unknown_size(form)
    return run(
        lambda form: read_scene(source, zones, model, form),
        prune_scene(views, budget, method, cleaning, threads=threads),
        target, source=expanded(source), overwrite=overwrite, dry_run=dry_run, views=views,
        pictures=pictures, progress=progress, threads=threads,
    )  # fmt: skip


def clean_file(
    source: Path | str,
    output: Path | str | None,
    views: ViewSet,
    cleaning: Cleaning,
    *,
    zones: Sequence[Zone] = (),
    model: Model | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
    threads: int | None = None,
) -> Result:
    """Clean a file of splats, and write what is left to another; see `prune_file` and `clean`."""

    def decide(scene: Scene, clock: Clock, told: Progress) -> Result:
        demands = scene.demands
        cleaned: Cleaned = clean_splats(
            scene.splats, views, cleaning, protected=demands.protected, forced_out=demands.out,
            progress=told, threads=threads,
        )  # fmt: skip
        clock.lap("clean_s")
        facts: dict[str, Any] = seen_by(
            cleaned.seen, cleaned.undrawable, cleaned.views_given, cleaned.views_used
        )
        facts["splats"] |= kept_and_removed(cleaned.keep) | demands.counts()
        facts["splats"]["unseen"] -= facts["splats"]["removed_by_user"]
        facts |= {
            "settings": asdict(cleaning),
            "volumes": list(demands.facts),
            "cleaned": cleaned.facts(),
            "notes": cleaned.notes(),
        }
        return Result(cleaned.keep, facts)

    return run(
        lambda form: read_scene(source, zones, model, form), decide,
        None if output is None else expanded(output), source=expanded(source),
        overwrite=overwrite, progress=progress, threads=threads,
    )  # fmt: skip


def score_scene(
    views: ViewSet, method: Method, threads: int | None = None
) -> Callable[[Scene, Clock, Progress], Result]:
    """For `run`: all splats stay, with their scores as a property."""

    def decide(scene: Scene, clock: Clock, progress: Progress) -> Result:
        demands = scene.demands
        scores: Scores = score(
            scene.splats, views, method, protected=demands.protected, removed=demands.out,
            progress=progress, threads=threads,
        )  # fmt: skip
        clock.lap("score_s")
        facts: dict[str, Any] = scored(scores)
        gone = demands.counts()["removed_by_user"]
        facts["splats"]["removed_by_user"] = gone
        facts["splats"]["unseen"] -= gone
        facts |= {
            "settings": method.facts(),
            "volumes": list(demands.facts),
            "weights": scores.facts,
            "prices": prices(scores, clock.timings["score_s"]),
            "notes": scoring_notes(scores),
        }
        keep = np.ones(len(scene.splats), np.bool_)
        return Result(keep, facts, columns={PROPERTY: scores.values})

    return decide


def score_file(
    source: Path | str,
    output: Path | str,
    views: ViewSet,
    method: Method = DEFAULT,
    *,
    zones: Sequence[Zone] = (),
    model: Model | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
    threads: int | None = None,
) -> Result:
    """Write a file with the float property ``refine_score``; see `prune_file` and `score`."""
    return run(
        lambda form: read_scene(source, zones, model, form), score_scene(views, method, threads),
        expanded(output), source=expanded(source), overwrite=overwrite, progress=progress,
        threads=threads,
    )  # fmt: skip


@dataclass(frozen=True)
class Move:
    """A scale, then turns about x, y and z in this order, then a translation.

    Attributes
    ----------
    translate : tuple of three float
        In the unit of the file.
    rotate : tuple of three float
        Degrees about the axes of the file.
    scale : float

    Raises
    ------
    RefineError
        If a number is not finite, or the scale is not above 0.
    """

    translate: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotate: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (*self.translate, *self.rotate, self.scale))):
            raise RefineError(f"expected finite numbers to move by, got {self}")
        if self.scale <= 0.0:
            raise RefineError(f"scale is {self.scale:g}, expected more than 0")

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The move as (4, 4).

        Examples
        --------
        >>> quarter = Move((1.0, 0.0, 0.0), (0.0, 0.0, 90.0), 2.0)
        >>> (quarter.matrix @ [1.0, 0.0, 0.0, 1.0]).round(6).tolist()
        [1.0, 2.0, 0.0, 1.0]
        """
        turned = np.eye(3)
        for axis, degrees in enumerate(self.rotate):
            one, other = (axis + 1) % 3, (axis + 2) % 3
            cosine, sine = (f(math.radians(degrees)) for f in (math.cos, math.sin))
            turn = np.eye(3)
            turn[[one, other], [one, other]] = cosine
            turn[one, other], turn[other, one] = -sine, sine
            turned = turn @ turned
        matrix = np.eye(4)
        matrix[:3, :3] = turned * self.scale
        matrix[:3, 3] = self.translate
        return matrix


def convert_files(
    sources: Sequence[Path | str],
    output: Path | str,
    *,
    moves: Sequence[Move] = (),
    degree: int | None = None,
    morton: bool = False,
    level: int = 0,
    model: Model | None = None,
    overwrite: bool = False,
) -> Result:
    """Write the splats of files to another, in the format that its suffix names.

    A single file of which nothing else is asked stays what it is, every property of a PLY included.

    Parameters
    ----------
    sources : sequence of path-like
        Of any format, one at least; the first comes first.
    output : path-like
    moves : sequence of Move
        One for each file, or none.
    degree : int, optional
        Harmonics above this degree are left out.
    morton : bool
        Whether splats are sorted along a Z-shaped (Morton) curve, so that near ones follow.
    level : int
        Of a streamed SOG, 0 being the finest.
    model : {"default", "antialiased", "2dgs"}, optional
        See `read_scene`.
    overwrite : bool

    Raises
    ------
    RefineError
        See `read_splats` and `affine.transformed`; if the files are of different models, or a level
        is asked of files that have none.

    Examples
    --------
    To put a statue into a room, half a unit above::

        moves = (Move(), Move(translate=(0.0, -0.5, 0.0)))
        convert_files(["room.ply", "statue.spz"], "both.sog", moves=moves)
    """
    alone = len(sources) == 1 and not (moves or morton or level) and degree is None

    def read(form: Format | None) -> Scene:
        if alone:
            return read_scene(sources[0], model=model, form=form)
        files = _files(sources, model, level)
        parts = [
            file.splats() if move == Move() else transformed(file.splats(), move.matrix)
            for file, move in zip(files, moves or (Move(),) * len(files), strict=True)
        ]
        splats = joined(parts)
        if degree is not None:
            splats = splats.up_to_degree(degree)
        if morton:
            splats = splats.take(_along_curve(splats.means))
        stored = sum(file.stored_bytes for file in files)
        file = file_of(splats, files[0].path, stored)
        lost = {name for each in files for name in other_properties(each.rows.dtype.names or ())}
        names = ", ".join(sorted(lost))
        return Scene(
            " + ".join(str(each.path) for each in files), stored, file.splats(), FREE,
            lambda: file, (0.0, 0),
            notes=(f"splats are written anew, without {names}",) if lost else (),
        )  # fmt: skip

    def decide(scene: Scene, _clock: Clock, _progress: Progress) -> Result:
        count = len(scene.splats)
        return Result(np.ones(count, np.bool_), {"splats": {"before": count}, "notes": []})

    source = expanded(sources[0]) if alone else None
    return run(read, decide, expanded(output), source=source, overwrite=overwrite)


def _files(sources: Sequence[Path | str], model: Model | None, level: int) -> list[SplatFile]:
    """The files, all of one model."""
    paths = [expanded(path) for path in sources]
    streamed = [path.name.lower().endswith(INDEX) for path in paths]
    files = [
        read_splats(path, model, level if has_levels or not any(streamed) else 0)
        for path, has_levels in zip(paths, streamed, strict=True)
    ]
    for file in files:
        if file.model != files[0].model:
            raise RefineError(
                f"{file.path}: its splats are {file.model}, those of {files[0].path} "
                f"{files[0].model}; expected one model, or say which (--model)"
            )
    return files


def _along_curve(means: NDArray[Any]) -> NDArray[np.int64]:
    """Order of positions (N, 3) along the curve; those that are not finite come last."""
    finite = np.isfinite(means).all(axis=1)
    rows, rest = np.flatnonzero(finite), np.flatnonzero(~finite)
    return np.concatenate([rows[near_ones_together(means[rows])], rest]) if len(rows) else rest
