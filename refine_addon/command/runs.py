"""What the subcommands do, input by input."""

from __future__ import annotations

import contextlib
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core import (
    PruneRequest,
    RefineError,
    as_written,
    clean,
    forced,
    picture_files,
    prune_file,
    prune_tiles,
    read_splats,
    score,
)
from ..core.errors import printable
from ..core.estimate.quality import UNSEEN, in_words
from ..core.formats.registry import without_suffix
from ..core.pace import Pace
from ..core.picture_files import PictureFiles
from ..core.report import held, kept_and_removed, scoring_notes, seen_by, what_was_seen
from ..core.tiles.storage import located
from ..core.urls import Url
from ..core.whole_file import new_folder, refuse_existing, refuse_mapped
from . import report, zones
from .cameras import deciding
from .checks import open_blend
from .info import describe
from .lod import make_levels
from .options import budget, cleaning, settings
from .terminal import Terminal, complain, described
from .words import by, left_unseen, sizes, written

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Sequence

    from ..core import ViewSet
    from ..core.formats.ply import SplatFile
    from ..core.scores import Scores
    from ..core.tiles.workers import Workers
    from ..core.volumes import Forced


def execute(options: argparse.Namespace) -> bool:
    """Do what the options say; return whether all of it went well.

    Raises
    ------
    RefineError
        If cameras cannot be read, or a folder or the report not be written; what is wrong with one
        input is said, and noted in the report.
    """
    if options.report is not None:
        report.check(options.report, overwrite=options.overwrite)
    run = _Run(options)
    works = {
        "prune": _prune,
        "score": _score,
        "clean": lambda run: _each(run, _clean_one),
        "lod": _lod,
        "convert": _convert,
        "info": _info,
    }
    works[options.command](run)
    run.finish()
    return not run.failed


class _Run:
    """What one call of the command did so far."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.terminal = Terminal(quiet=options.quiet)
        self.entries: list[dict[str, Any]] = []
        self.failed = False
        self._started = time.perf_counter()
        each = [_size(path) for path in options.inputs]
        together = getattr(options, "together", False)
        self._pace = Pace([sum(each)] if together else each or [0])
        self._cameras: dict[str, Any] = {}

    def views(self) -> ViewSet:
        """Return the views that decide, and note where they are from for the report."""
        views, facts = deciding(self.options)
        self._cameras = {"cameras": facts}
        return views

    def named(self, name: str) -> str:
        """Return what to call the file under way; see `Pace.named`."""
        return self._pace.named(name)

    def progress(self, name: str) -> Callable[[float, str], None]:
        """Return what draws how much of the file under way is done, and the time left."""
        return self.terminal.progress(self.named(name), self._pace.left)

    def say_cameras(self) -> None:
        """Say which cameras of the scene decided; those of a file were named by the user."""
        if words := self._cameras["cameras"].get("words"):
            self.terminal.say(f"  cameras: {words}")

    def say_unseen(self, unseen: int, scored: int) -> None:
        """Say how many of the splats that were scored no view holds, if any."""
        if unseen:
            self.terminal.say(f"  {left_unseen(unseen, scored)}")

    def attempt(self, label: str, work: Callable[[], dict[str, Any]]) -> None:
        """Do one input's work; note its error, so that the others go on."""
        self._pace.next()
        try:
            self.entries.append({"status": "done", **work(), **self._cameras})
        except (RefineError, OSError, MemoryError) as error:
            self.failed = True
            message = str(error) if isinstance(error, RefineError) else described(error)
            # What is wrong with the splats is said without the file.
            files = (Path(label), getattr(self.options, "output", None))
            if not any(file and printable(file.name) in message for file in files):
                message = f"{label}: {message}"
            self.entries.append({"status": "failed", "input": label, "error": message})
            complain(message)

    def finish(self) -> None:
        """Write the report, where one is wanted."""
        options = self.options
        if options.report is None:
            return
        writes = options.command != "info" and not getattr(options, "dry_run", False)
        if options.command == "clean":
            writes = bool(options.output or options.output_dir)
        report.write(
            options.report,
            self.entries,
            time.perf_counter() - self._started,
            overwrite=options.overwrite,
            splats=writes and any(entry["status"] == "done" for entry in self.entries),
        )


def _prune(run: _Run) -> None:
    options = run.options
    if options.object:
        run.attempt(options.object, lambda: _prune_object(run))
        return
    if options.together:
        views, label = run.views(), f"{len(options.inputs)} tiles"
        run.attempt(label, lambda: _prune_together(run, label, views))
        return
    _each(run, _prune_one)


def _each(run: _Run, work: Callable[[_Run, Path, Path | None, ViewSet], dict[str, Any]]) -> None:
    """Do the work of every input: with its output, if there is to be one, and the views."""
    options, views = run.options, run.views()
    writes = options.output_dir and not getattr(options, "dry_run", False)
    with new_folder(options.output_dir) if writes else contextlib.nullcontext():
        for source in options.inputs:
            output = options.output_dir / source.name if options.output_dir else options.output
            run.attempt(
                str(source), lambda source=source, output=output: work(run, source, output, views)
            )


def _request(options: argparse.Namespace, views: ViewSet, name: str) -> PruneRequest:
    """Return what is asked of a prune; `name` is the first part of the names of its pictures."""
    pictures = None
    if options.pictures is not None:
        pictures = PictureFiles(options.pictures, name, options.overwrite)
    return PruneRequest(
        views,
        budget(options),
        settings(options),
        zones=() if options.object else zones.of_files(options),
        absorb=options.absorb,
        cleaning=cleaning(options) if options.clean else None,
        pictures=pictures,
        overwrite=options.overwrite,
        dry_run=options.dry_run,
    )


def _prune_one(run: _Run, source: Path, output: Path | None, views: ViewSet) -> dict[str, Any]:
    request = _request(run.options, views, without_suffix(source.name))
    result = prune_file(source, output, request, progress=run.progress(source.name))
    run.terminal.clear()
    _say_result(run, str(source), result.report)
    return result.report


def _prune_together(run: _Run, label: str, views: ViewSet) -> dict[str, Any]:
    options = run.options
    try:
        with _workers(options) as workers:
            done = prune_tiles(
                options.inputs,
                None if options.dry_run else options.output_dir,
                views,
                budget(options),
                settings(options),
                absorb=options.absorb,
                overwrite=options.overwrite,
                progress=run.progress(label),
                workers=workers,
            )
    except KeyboardInterrupt:
        run.terminal.clear()
        if not options.dry_run:
            run.terminal.say("the same command goes on where this one was")
        raise
    run.terminal.clear()
    _say_result(run, label, done)
    for tile in done["tiles"]:
        share = (tile["before"] - tile["kept"]) / max(tile["before"], 1)
        run.terminal.say(
            f"  {located(tile['input']).name}: {tile['kept']:,} of {tile['before']:,} splats "
            f"({share:.1%} removed), {sizes(tile['input_bytes'], tile['output_bytes'])}"
        )
    return done


def _workers(options: argparse.Namespace) -> contextlib.AbstractContextManager[Workers | None]:
    """Return who works on tiles; None for this process alone."""
    if options.workers is None and not options.scheduler:
        return contextlib.nullcontext()
    from ..core.tiles.cluster import cluster  # noqa: PLC0415 - needs Dask

    return cluster(options.workers, options.scheduler)


def _prune_object(run: _Run) -> dict[str, Any]:
    from ..objects.prune_object import prune_object  # noqa: PLC0415 - needs Blender

    options, name = run.options, run.options.object
    request, demanded = _request(options, run.views(), name), zones.of_object(options)
    done = prune_object(
        name, request, demanded,
        output=options.output, save=options.save, progress=run.progress(name),
    )  # fmt: skip
    run.terminal.clear()
    _say_result(run, name, done)
    return done


def _say_result(run: _Run, label: str, done: dict[str, Any]) -> None:
    splats, views, files = done["splats"], done["views"], done["files"]
    verb = "would keep" if run.options.dry_run else "kept"
    share = splats["removed"] / splats["before"]
    parts = [
        f"{verb} {splats['kept']:,} of {splats['before']:,} splats ({share:.1%} removed)"
        + written(splats),
        sizes(files["input_bytes"], files["output_bytes"]),
        by(views),
        f"{done['timings']['total_s']:.2f} s",
    ]
    target = f" -> {files['output']}" if files["output"] else ""
    run.terminal.say(f"{run.named(label)}: {', '.join(parts)}{target}")
    run.say_cameras()
    if demanded := zones.words(done):
        run.terminal.say(f"  {demanded}")
    cleaned = sum(count for count in done.get("cleaned", {}).values() if isinstance(count, int))
    run.say_unseen(splats["unseen"], splats["before"] - cleaned - splats["forced"])
    if "cleaned" in done:
        run.terminal.say(f"  cleaned: {done['cleaned']['words']}")
    quality = _quality(done)
    if quality:
        run.terminal.say(f"  quality: {quality}")
    if "pictures" in done:
        measured = picture_files.in_words(done["pictures"])
        run.terminal.say(f"  pictures: {measured} -> {run.options.pictures}")
    run.terminal.notes(done["notes"])


def _quality(done: dict[str, Any]) -> str:
    """Return what is estimated of the pictures, in words; "" where nothing is."""
    psnr, absorbed = done["estimated_psnr"], done["estimated_psnr_absorbed"]
    if psnr is None:
        return ""
    words = f"{in_words(psnr)} in these views"
    if done.get("written_psnr") is not None:
        words += f", {in_words(done['written_psnr'])} as written"
    if "absorbed" in done or psnr > UNSEEN:
        return words
    if absorbed is None:
        return f"{words}; {done['estimated_psnr_absorbed_note']}"
    return f"{words}; with --absorb {in_words(absorbed)}"


def _score(run: _Run) -> None:
    options = run.options
    if options.object:
        run.attempt(options.object, lambda: _score_object(run))
        return
    views = run.views()
    source = options.inputs[0]
    run.attempt(str(source), lambda: _score_one(run, source, views))


def _score_one(run: _Run, source: Path, views: ViewSet) -> dict[str, Any]:
    options = run.options
    refuse_existing(options.output, overwrite=options.overwrite)
    file = read_splats(source)
    splats = file.splats()
    found = forced(zones.of_files(options), splats.means)
    scores = score(
        splats, views, settings(options),
        protected=found.protected, removed=found.removed, progress=run.progress(source.name),
    )  # fmt: skip
    return _write_scores(run, str(source), file, scores, found)


def _score_object(run: _Run) -> dict[str, Any]:
    from ..objects import splat_object  # noqa: PLC0415 - needs Blender

    options = run.options
    refuse_existing(options.output, overwrite=options.overwrite)
    views, demanded = run.views(), zones.of_object(options)
    file, scores, found, notes = splat_object.score_object(
        options.object, views, settings(options), demanded, progress=run.progress(options.object)
    )
    done = _write_scores(run, options.object, file, scores, found, notes)
    done["files"]["input"] = f"{open_blend()}#{options.object}"
    return done


def _write_scores(
    run: _Run,
    label: str,
    file: SplatFile,
    scores: Scores,
    found: Forced,
    more_notes: Sequence[str] = (),
) -> dict[str, Any]:
    """Write a file with its scores and say what came of it; return the report."""
    options = run.options
    output = options.output
    file.write(output, columns={"refine_score": scores.values}, overwrite=options.overwrite)
    run.terminal.clear()
    run.terminal.say(
        f"{label}: scored {len(file):,} splats by {scores.views_used} views -> {output}"
    )
    run.say_cameras()
    seen, gone = seen_by(scores), found.counts()["forced"]
    seen["splats"]["unseen"] -= gone
    done = {
        **seen,
        "splats": seen["splats"] | {"forced": gone},
        "volumes": list(found.facts),
    }
    if said := zones.words(done):
        run.terminal.say(f"  {said}")
    run.say_unseen(seen["splats"]["unseen"], len(file) - gone)
    notes = [*scoring_notes(scores), *more_notes]
    run.terminal.notes(notes)
    return {
        "files": {"input": label, "output": str(output)},
        **done,
        "settings": asdict(settings(options)),
        "weights": scores.facts,
        "notes": notes,
    }


def _convert(run: _Run) -> None:
    source = run.options.inputs[0]
    run.attempt(str(source), lambda: _convert_one(run, source))


def _convert_one(run: _Run, source: Path) -> dict[str, Any]:
    output, overwrite = run.options.output, run.options.overwrite
    refuse_existing(output, overwrite=overwrite)
    refuse_mapped(output, source)
    file = read_splats(source)
    made = as_written(file, output)
    made.write(output, overwrite=overwrite)
    everything = np.ones(len(file), np.bool_)
    size, notes = output.stat().st_size, made.notes(everything)
    splats = {"before": len(file), **held(made, everything)}
    run.terminal.say(
        f"{source}: {len(file):,} splats{written(splats)}, {sizes(file.stored_bytes, size)} "
        f"-> {output}"
    )
    run.terminal.notes(notes)
    return {
        "files": {
            "input": str(source),
            "output": str(output),
            "input_bytes": file.stored_bytes,
            "output_bytes": size,
        },
        "splats": splats,
        "notes": notes,
    }


def _clean_one(run: _Run, source: Path, output: Path | None, views: ViewSet) -> dict[str, Any]:
    options = run.options
    if output:
        refuse_existing(output, overwrite=options.overwrite)
        refuse_mapped(output, source)
    file = read_splats(source)
    progress = run.progress(source.name)
    splats = file.splats()
    demanded = forced(zones.of_files(options), splats.means)
    found = clean(
        splats, views, cleaning(options), protected=demanded.protected, removed=demanded.removed,
        progress=progress,
    )  # fmt: skip
    made = as_written(file, output)
    if output:
        made.write(output, found.keep, overwrite=options.overwrite)
    run.terminal.clear()
    facts = what_was_seen(found.seen, found.undrawable, found.views_given, found.views_used)
    counts: dict[str, Any] = {
        **facts["splats"],
        **kept_and_removed(found.keep),
        **demanded.counts(),
        **held(made, found.keep, written=output is not None),
    }
    counts["unseen"] -= counts["forced"]
    done = {"splats": counts, "volumes": list(demanded.facts)}
    to = f" -> {output}" if output else ""
    run.terminal.say(
        f"{run.named(str(source))}: {found.in_words()}; {counts['kept']:,} of {len(file):,} splats "
        f"stay{written(counts)}, {by(facts['views'])}{to}"
    )
    run.say_cameras()
    if said := zones.words(done):
        run.terminal.say(f"  {said}")
    run.say_unseen(counts["unseen"], len(file) - counts["forced"])
    notes = [*found.notes(), *made.notes(found.keep)]
    run.terminal.notes(notes)
    return {
        "files": {"input": str(source), "output": str(output) if output else None},
        **done,
        "views": facts["views"],
        "settings": asdict(found.settings),
        "cleaned": found.facts(),
        "notes": notes,
    }


def _lod(run: _Run) -> None:
    options = run.options
    views, source = run.views(), options.inputs[0]
    run.attempt(
        str(source),
        lambda: make_levels(options, run.terminal, source, views, run.progress(source.name)),
    )


def _info(run: _Run) -> None:
    for source in run.options.inputs:
        run.attempt(str(source), lambda source=source: _info_one(run, source))


def _info_one(run: _Run, source: Path) -> dict[str, Any]:
    file = read_splats(source)
    facts = describe(file)
    run.terminal.say(f"{source}")
    for name, value in facts.items():
        run.terminal.say(f"  {name.replace('_', ' '):18} {value}")
    return {"input": str(source), **facts}


def _size(path: Path | Url) -> int:
    """Return the bytes of a file, 0 where reading it will fail anyway, or a URL is not asked."""
    if isinstance(path, Url):
        return 0
    try:
        return path.stat().st_size
    except (OSError, ValueError):
        return 0
