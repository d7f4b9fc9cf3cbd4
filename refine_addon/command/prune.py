"""What ``prune`` does and says."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path
from typing import Any

from ..core import ViewSet, prune_file, prune_tiles
from ..core.formats.registry import without_suffix
from ..core.pictures import PictureFiles, measured_in_words
from ..core.quality.curve import UNSEEN, in_views, in_words
from ..core.tiles.cluster import Cluster, cluster
from ..core.tiles.storage import located
from . import zones
from .options import budget, cleaning, method
from .run import Run
from .words import by, by_method, sizes, written


def prune(run: Run) -> None:
    """Prune each input, all of them together, or an object."""
    options = run.options
    if options.object:
        run.attempt(options.object, lambda: _prune_object(run))
    elif options.together:
        views, label = run.views(), f"{len(options.inputs)} tiles"
        run.attempt(label, lambda: _prune_together(run, label, views))
    else:
        run.each(_prune_one)


def _how(options: argparse.Namespace, name: str) -> dict[str, Any]:
    """What files and objects are pruned by; `name` begins the names of the pictures."""
    pictures = None
    if options.pictures is not None:
        pictures = PictureFiles(options.pictures, name, options.overwrite)
    return {
        "budget": budget(options),
        "method": method(options),
        "pictures": pictures,
        "overwrite": options.overwrite,
        "dry_run": options.dry_run,
    }


def _prune_one(run: Run, source: Path, output: Path | None, views: ViewSet) -> dict[str, Any]:
    options = run.options
    done = prune_file(
        source, output, views, **_how(options, without_suffix(source.name)),
        zones=zones.of_files(options), cleaning=cleaning(options) if options.clean else None,
        model=options.model, progress=run.progress(source.name),
    ).report  # fmt: skip
    run.terminal.clear()
    _say_result(run, str(source), done)
    return done


def _prune_together(run: Run, label: str, views: ViewSet) -> dict[str, Any]:
    options, progress = run.options, run.progress(label)
    try:
        with _workers(options) as workers:
            done = prune_tiles(
                options.inputs, options.output_dir, views, budget(options), method(options),
                overwrite=options.overwrite, dry_run=options.dry_run, model=options.model,
                progress=progress, workers=workers,
            )  # fmt: skip
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


def _workers(options: argparse.Namespace) -> contextlib.AbstractContextManager[Cluster | None]:
    """Who works on tiles; None for this process alone."""
    if options.workers is None and not options.scheduler:
        return contextlib.nullcontext()
    return cluster(options.workers, options.scheduler)


def _prune_object(run: Run) -> dict[str, Any]:
    from ..objects.operation import prune_object

    options, name = run.options, run.options.object
    done = prune_object(
        name, run.views(), **_how(options, name), demands=zones.of_object(options),
        output=options.output, save=options.save, progress=run.progress(name),
    )  # fmt: skip
    run.terminal.clear()
    _say_result(run, name, done)
    return done


def _say_result(run: Run, label: str, done: dict[str, Any]) -> None:
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
    cleaned = sum(count for count in done.get("cleaned", {}).values() if isinstance(count, int))
    run.say_what_decided(done, cleaned)
    if "cleaned" in done:
        run.terminal.say(f"  cleaned: {done['cleaned']['words']}")
    quality = _quality(done)
    if quality:
        run.terminal.say(f"  quality: {quality}")
    if "pictures" in done:
        measured = measured_in_words(done["pictures"])
        run.terminal.say(f"  pictures: {measured} -> {run.options.pictures}")
    run.terminal.notes(done["notes"])


def _quality(done: dict[str, Any]) -> str:
    """What is estimated of the pictures, in words; "" where nothing is."""
    psnr, method = done["estimated_psnr"], done["method"]
    if psnr is None:
        return ""
    words = in_views(psnr, done["estimated_psnr_between"])
    if done.get("written_psnr") is not None:
        words += f", {in_words(done['written_psnr'])} as written"
    if psnr > UNSEEN:
        return words
    if method["note"]:
        return f"{words}; {method['note']}"
    others = by_method(method, method["done"])
    return f"{words} (--method {others})" if others else words
