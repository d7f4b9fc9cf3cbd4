"""What each subcommand does and says."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..core import (
    SplatFile,
    ViewSet,
    clean_file,
    convert_files,
    lod_file,
    prune_file,
    prune_tiles,
    read_splats,
    score_file,
)
from ..core.execute import in_time
from ..core.formats.registry import without_suffix
from ..core.pictures import PictureFiles, measured_in_words
from ..core.quality.curve import UNSEEN, in_views, in_words
from ..core.report import size_in_words, sizes_in_words
from ..core.splats import drawable
from ..core.tiles.cluster import cluster
from ..core.tiles.storage import located
from . import zones
from .run import Run


def prune(run: Run) -> None:
    """Prune each input, all of them together, or an object."""
    options = run.options
    if options.object:
        run.attempt(options.object, _prune_object)
    elif options.together:
        views = run.views()
        run.attempt(f"{len(options.inputs)} tiles", _prune_together, views)
    else:
        run.each(_prune_file)


def _how(run: Run, name: str) -> dict[str, Any]:
    """What files and objects are pruned by; `name` begins the names of the pictures."""
    options = run.options
    pictures = options.pictures and PictureFiles(options.pictures, name, options.overwrite)
    return {
        "budget": options.budget, "method": options.how, "pictures": pictures,
        "dry_run": options.dry_run,
    }  # fmt: skip


def _prune_file(run: Run, source: Path, output: Path | None, views: ViewSet) -> dict[str, Any]:
    how = _how(run, without_suffix(source.name)) | run.reading(source.name)
    done = prune_file(source, output, views, cleaning=run.options.cleaning, **how)
    return _say_pruned(run, str(source), done.report)


def _prune_object(run: Run) -> dict[str, Any]:
    from ..objects.operation import prune_object

    options, name = run.options, run.options.object
    done = prune_object(
        name, run.views(), **_how(run, name), demands=zones.of_object(options),
        output=options.output, save=options.save, overwrite=options.overwrite,
        progress=run.progress(name),
    )  # fmt: skip
    return _say_pruned(run, name, done)


def _prune_together(run: Run, views: ViewSet) -> dict[str, Any]:
    options, label = run.options, f"{len(run.options.inputs)} tiles"
    workers = contextlib.nullcontext() if options.workers is None else cluster(options.workers)
    try:
        with workers as others:
            done = prune_tiles(
                options.inputs, options.output, views, options.budget, options.how,
                overwrite=options.overwrite, dry_run=options.dry_run, model=options.model,
                progress=run.progress(label), workers=others,
            )  # fmt: skip
    except KeyboardInterrupt:
        run.terminal.clear()
        if not options.dry_run:
            run.terminal.say("the same command goes on where this one was")
        raise
    tiles = [
        f"{located(tile['input']).name}: {tile['kept']:,} of {tile['before']:,} splats "
        f"({(tile['before'] - tile['kept']) / max(tile['before'], 1):.1%} removed), "
        f"{_sizes(tile['input_bytes'], tile['output_bytes'])}"
        for tile in done["tiles"]
    ]
    return _say_pruned(run, label, done, *tiles)


def _say_pruned(run: Run, label: str, done: dict[str, Any], *more: str) -> dict[str, Any]:
    splats, files, cleaned = done["splats"], done["files"], done.get("cleaned", {})
    verb = "would keep" if run.options.dry_run else "kept"
    line = (
        f"{run.named(label)}: {verb} {splats['kept']:,} of {splats['before']:,} splats "
        f"({splats['removed'] / splats['before']:.1%} removed){_written(splats)}, "
        f"{_sizes(files['input_bytes'], files['output_bytes'])}, {_by(done)}, "
        f"{done['timings']['total_s']:.2f} s{_to(files['output'])}"
    )
    lines = [f"cleaned: {cleaned['words']}"] if cleaned else []
    if quality := _quality(done):
        lines.append(f"quality: {quality}")
    if "pictures" in done:
        measured = measured_in_words(done["pictures"])
        lines.append(f"pictures: {measured} -> {run.options.pictures}")
    count = sum(count for count in cleaned.values() if isinstance(count, int))
    return run.say(done, line, *lines, *more, cleaned=count)


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
    others = _by_method(method, method["done"])
    return f"{words} (--method {others})" if others else words


def clean(run: Run) -> None:
    """Clean each input."""
    run.each(_clean)


def _clean(run: Run, source: Path, output: Path | None, views: ViewSet) -> dict[str, Any]:
    done = clean_file(
        source, output, views, run.options.cleaning, **run.reading(source.name)
    ).report
    splats = done["splats"]
    return run.say(
        done,
        f"{run.named(str(source))}: {done['cleaned']['words']}; {splats['kept']:,} of "
        f"{splats['before']:,} splats stay{_written(splats)}, {_by(done)}"
        f"{_to(output) or '; nothing is written without -o'}",
    )


def score(run: Run) -> None:
    """Score each input, or an object."""
    if run.options.object:
        run.attempt(run.options.object, _score_object)
    else:
        run.each(_score_file)


def _score_file(run: Run, source: Path, output: Path, views: ViewSet) -> dict[str, Any]:
    done = score_file(source, output, views, run.options.how, **run.reading(source.name))
    return _say_scored(run, str(source), output, done.report)


def _score_object(run: Run) -> dict[str, Any]:
    from ..objects.operation import score_object

    options, name = run.options, run.options.object
    done = score_object(
        name, run.views(), options.how, zones.of_object(options),
        output=options.output, overwrite=options.overwrite, progress=run.progress(name),
    )  # fmt: skip
    return _say_scored(run, name, options.output, done)


def _say_scored(run: Run, label: str, output: Path, done: dict[str, Any]) -> dict[str, Any]:
    prices = [f"{price['removed']:.0%} removed: {_by_method(price)}" for price in done["prices"]]
    line = f"scored {done['splats']['before']:,} splats by {done['views']['used']} views"
    return run.say(done, f"{run.named(label)}: {line}{_to(output)}", *prices)


def lod(run: Run) -> None:
    """Make levels of detail of the input."""
    views, source = run.views(), run.options.inputs[0]
    run.attempt(str(source), _make_levels, source, views)


def _make_levels(run: Run, source: Path, views: ViewSet) -> dict[str, Any]:
    options = run.options
    done = lod_file(
        source, options.output, views, options.shares, options.how, **run.reading(source.name)
    )
    count, number = done["splats"]["before"], len(done["levels"])
    levels = [
        f"{entry['file']}: {entry['splats']:,} splats, {size_in_words(entry['bytes'])}"
        + (f", {in_words(entry['psnr'])}" if entry["psnr"] is not None else "")
        for entry in done["levels"]
    ]
    line = f"{source}: {number} level{'s' if number > 1 else ''} of {count:,} splats, {_by(done)}"
    line += f", {done['timings']['total_s']:.2f} s{_to(options.output)}"
    return run.say(done, line, *levels)


def convert(run: Run) -> None:
    """Convert the inputs to one file."""
    run.attempt(str(run.options.inputs[0]), _convert)


def _convert(run: Run) -> dict[str, Any]:
    options = run.options
    done = convert_files(
        options.inputs, options.output, degree=options.degree, model=options.model,
        overwrite=options.overwrite,
    ).report  # fmt: skip
    splats, files = done["splats"], done["files"]
    size = _sizes(files["input_bytes"], files["output_bytes"])
    line = f"{' + '.join(map(str, options.inputs))}: {splats['before']:,} splats"
    return run.say(done, f"{line}{_written(splats)}, {size}{_to(options.output)}")


def info(run: Run) -> None:
    """Describe each input."""
    for source in run.options.inputs:
        run.attempt(str(source), _info, source)


def _info(run: Run, source: Path) -> dict[str, Any]:
    facts = describe(read_splats(source))
    run.terminal.say(f"{source}")
    for name, value in facts.items():
        run.terminal.say(f"  {name.replace('_', ' '):18} {value}")
    return {"input": str(source), **facts}


def describe(file: SplatFile) -> dict[str, Any]:
    """Return what ``info`` says of a file: counts, degree, extent, rows that are not finite."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    whole = file.splats()
    broken = undrawable = 0
    for start in range(0, len(file), 1 << 16):
        piece = file.rows[start : start + (1 << 16)]
        splats = whole.take(slice(start, start + (1 << 16)))
        finite = np.ones(len(piece), np.bool_)
        for name in piece.dtype.names or ():
            finite &= np.isfinite(piece[name])
        broken += int(np.count_nonzero(~finite))
        undrawable += int(np.count_nonzero(~drawable(splats)))
        means = splats.means[np.isfinite(splats.means).all(axis=1)].astype(np.float64)
        low = np.minimum(low, means.min(axis=0, initial=np.inf))
        high = np.maximum(high, means.max(axis=0, initial=-np.inf))
    names = file.rows.dtype.names or ()
    average: float = file.row_bytes
    if file.origin is not None:
        average = round(file.stored_bytes / max(len(file), 1), 1)
    known = ("x", "y", "z", "nx", "ny", "nz", "opacity")
    extra = [n for n in names if n not in known and not n.startswith(("f_", "scale_", "rot_"))]
    return {
        "splats": len(file),
        "sh_degree": whole.sh_degree,
        "bytes": file.stored_bytes,
        "bytes_per_splat": average,
        "format": file.format,
        "model": file.model,
        "extent_low": low.tolist() if np.isfinite(low).all() else None,
        "extent_high": high.tolist() if np.isfinite(high).all() else None,
        "non_finite_rows": broken,
        "undrawable": undrawable,
        "extra_properties": extra,
        **({"notes": list(file.remarks)} if file.remarks else {}),
    }


def _render(run: Run) -> None:
    from .render import render

    render(run)


SUBCOMMANDS = {
    "prune": prune, "score": score, "clean": clean, "lod": lod, "convert": convert, "info": info,
    "render": _render,
}  # fmt: skip


def _by(done: dict[str, Any]) -> str:
    """How many views decided."""
    return f"by {done['views']['used']} of {done['views']['given']} views"


def _to(output: object) -> str:
    """Where the result is; "" where nothing is written."""
    return f" -> {output}" if output else ""


def _written(splats: Mapping[str, Any]) -> str:
    """How many splats a file holds, if its format left some out; else ""."""
    return f", {splats['written']:,} written" if splats["left_out"] and splats["written"] else ""


def _sizes(before: int, after: int | None) -> str:
    """What became of the size of a file; None where only writing tells it."""
    return f"of {size_in_words(before)}" if after is None else sizes_in_words(before, "->", after)


def _by_method(predicted: Mapping[str, Any], without: str = "") -> str:
    """Which quality and time the methods are expected to come to.

    Parameters
    ----------
    predicted : mapping
        ``psnr`` and ``seconds`` of a report's ``method`` or ``prices``.
    without : str
        The method that is left out.

    Examples
    --------
    >>> psnr = {"delete": 38.0, "merge": 46.0, "refit": None}
    >>> _by_method({"psnr": psnr, "seconds": {"delete": 1.2, "merge": 2.1, "refit": 8.0}})
    'occlusion about 38 dB in 2 s, merge about 46 dB in 3 s'
    >>> _by_method({"psnr": psnr}, "merge")  # one round of scoring tells less than all
    'occlusion about 38 dB or more'
    """
    seconds = predicted.get("seconds") or {}
    return ", ".join(
        f"{name} {in_words(psnr)}"
        + (" or more" if way == "delete" and without else "")
        + (f" in {in_time(seconds[way])}" if seconds else "")
        for way, psnr in predicted["psnr"].items()
        if psnr is not None
        and without != (name := "occlusion" if way == "delete" else way)
        and not (way == "delete" and without == "closed-form")
    )
