"""From the arguments to the exit code; the work and messages of each subcommand."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import core
from ..core import RefineError, Zone
from ..core.errors import described
from ..core.execute import in_time
from ..core.formats.ply_columns import other_properties
from ..core.formats.registry import without_suffix
from ..core.pictures import PictureFiles, measured_in_words
from ..core.quality.curve import UNSEEN, in_views, in_words
from ..core.report import size_in_words, sizes_in_words
from ..core.splats import drawable
from ..core.tiles.cluster import cluster
from ..core.tiles.storage import located
from ..core.volumes import Role, Volume
from .checks import check, check_report
from .options import ROLES, complete, make_parser
from .run import Run, complain, write


def run(arguments: Sequence[str], *, scene: bool) -> int:
    """Parse, check and run; exit code as of `refine_addon.command.main`."""
    parser = make_parser()
    try:
        options = parser.parse_args(list(arguments))
        options.scene, options.blend = scene, ""
        if scene:
            from .scene import opened

            options.blend = opened(sys.argv)
        try:
            complete(options)
            check(options)
        except RefineError as error:
            parser.error(str(error))
        if options.report is not None:
            check_report(options.report, overwrite=options.overwrite)
        work = Run(options)
        _run(work)
        return int(work.finish())
    except SystemExit as end:  # of argparse; Blender needs a number
        return int(write("stdout", "") or end.code or 0)  # flushes argparse's help
    except (RefineError, OSError, MemoryError) as error:
        complain(described(error))
    return 1


def _run(run: Run) -> None:
    """Run the subcommand input by input; errors of inputs are recorded."""
    options = run.options
    work = {"prune": _prune, "score": _score, "clean": _clean, "lod": _lod, "info": _info}
    if options.command == "render":
        from .scene import render

        render(options, run.print)
    elif options.command == "convert":
        run.attempt(_convert, str(options.inputs[0]))
    elif options.together:
        run.views()
        run.attempt(_prune_together, f"{len(options.inputs)} tiles")
    else:
        run.each(work[options.command])


def _how(run: Run, name: str) -> dict[str, Any]:
    options = run.options
    how = {"overwrite": options.overwrite, "progress": run.progress(name)}
    if options.object:
        return how | {"demands": _of_object(options)}
    zones = tuple(_zone(*named) for named in _named(options))
    return how | {"zones": zones, "model": options.model, "axes": options.spz_axes}


def _prune(run: Run, source: Path | str, output: Path | None) -> dict[str, Any]:
    options, views = run.options, run.views()
    name = source if options.object else source.name
    how: dict[str, Any] = {
        "budget": options.budget, "method": options.how, "dry_run": options.dry_run,
        "output": output, **_how(run, name),
    }  # fmt: skip
    if options.pictures:
        how["pictures"] = PictureFiles(options.pictures, without_suffix(name), options.overwrite)
    if options.object:
        from ..objects.splat_group import prune_object

        return _say_pruned(run, name, prune_object(source, views, save=options.save, **how))
    report = core.prune_file(source, views=views, cleaning=options.cleaning, **how).report
    return _say_pruned(run, str(source), report)


def _prune_together(run: Run, label: str) -> dict[str, Any]:
    options, progress = run.options, run.progress(label)
    workers = contextlib.nullcontext() if options.workers is None else cluster(options.workers)
    try:
        with workers as others:
            report = core.prune_tiles(
                options.inputs, options.output, run.views(), options.budget, options.how,
                overwrite=options.overwrite, dry_run=options.dry_run, model=options.model,
                progress=progress, workers=others,
            )  # fmt: skip
    except KeyboardInterrupt as stop:
        if not options.dry_run:
            stop.add_note("the same command goes on where this one was")
        raise
    tiles = [
        f"{located(tile['input']).name}: {tile['kept']:,} of {tile['before']:,} splats "
        f"({(tile['before'] - tile['kept']) / max(tile['before'], 1):.1%} removed), "
        f"{sizes_in_words(tile['input_bytes'], '->', tile['output_bytes'])}"
        for tile in report["tiles"]
    ]
    return _say_pruned(run, label, report, *tiles)


def _say_pruned(run: Run, label: str, report: dict[str, Any], *more: str) -> dict[str, Any]:
    splats = report["splats"]
    line = (
        f"{'would keep' if run.options.dry_run else 'kept'} {splats['kept']:,} of "
        f"{splats['before']:,} splats ({splats['removed'] / splats['before']:.1%} removed)"
        f"{_files(report)}, {_by(report)}, {report['timings']['total_s']:.2f} s"
    )
    lines = [f"cleaned: {report['cleaned']['words']}"] if "cleaned" in report else []
    if quality := _quality(report):
        lines.append(f"quality: {quality}")
    if "pictures" in report:
        lines.append(f"pictures: {measured_in_words(report['pictures'])} -> {run.options.pictures}")
    return run.say(label, line, report, *lines, *more)


def _quality(report: dict[str, Any]) -> str:
    """The estimated quality in words, "" without an estimate."""
    psnr, method = report["estimated_psnr"], report["method"]
    if psnr is None:
        return ""
    words = in_views(psnr, report["estimated_psnr_between"])
    if report.get("written_psnr") is not None:
        words += f", {in_words(report['written_psnr'])} as written"
    if psnr <= UNSEEN and method["note"]:
        words += f"; {method['note']}"
    elif psnr <= UNSEEN and (others := _by_method(method, method["done"])):
        words += f" (--method {others})"
    return words


def _clean(run: Run, source: Path, output: Path | None) -> dict[str, Any]:
    how = _how(run, source.name)
    report = core.clean_file(source, output, run.views(), run.options.cleaning, **how).report
    splats = report["splats"]
    line = f"{report['cleaned']['words']}; {splats['kept']:,} of {splats['before']:,} splats stay"
    line += f"{_written(splats)}, {_by(report)}"
    if output is None:
        line += "; nothing is written without -o"
    return run.say(str(source), line, report)


def _score(run: Run, source: Path | str, output: Path) -> dict[str, Any]:
    method, views = run.options.how, run.views()
    if run.options.object:
        from ..objects.splat_group import score_object

        report = score_object(source, views, method, output=output, **_how(run, source))
    else:
        report = core.score_file(source, output, views, method, **_how(run, source.name)).report
    prices = [f"{price['removed']:.0%} removed: {_by_method(price)}" for price in report["prices"]]
    line = f"scored {report['splats']['before']:,} splats by {report['views']['used']} views"
    return run.say(str(source), line, report, *prices)


def _lod(run: Run, source: Path, output: Path) -> dict[str, Any]:
    options, how = run.options, _how(run, source.name)
    report = core.lod_file(source, output, run.views(), options.levels, options.how, **how)
    count, number = report["splats"]["before"], len(report["levels"])
    levels = [
        f"{entry['file']}: {entry['splats']:,} splats, {size_in_words(entry['bytes'])}"
        + (f", {in_words(entry['psnr'])}" if entry["psnr"] is not None else "")
        for entry in report["levels"]
    ]
    line = f"{number} level{'s' if number > 1 else ''} of {count:,} splats, {_by(report)}"
    line += f", {report['timings']['total_s']:.2f} s"
    return run.say(str(source), line, report, *levels)


def _convert(run: Run, _first: str) -> dict[str, Any]:
    options = run.options
    report = core.convert_files(
        options.inputs, options.output, degree=options.degree, model=options.model,
        axes=options.spz_axes, overwrite=options.overwrite,
    ).report  # fmt: skip
    line = f"{report['splats']['before']:,} splats{_files(report)}"
    return run.say(" + ".join(map(str, options.inputs)), line, report)


def _info(run: Run, source: Path, _output: None) -> dict[str, Any]:
    entry = describe(core.read_splats(source))
    lines = [f"  {name.replace('_', ' '):18} {value}" for name, value in entry.items()]
    run.print(str(source), *lines)
    return {"input": str(source), **entry}


def describe(file: core.SplatFile) -> dict[str, Any]:
    """Report entry of ``info``: counts, degree, format, extent, rows that are not finite."""
    splats, names = file.splats(), file.rows.dtype.names or ()
    pieces = (file.rows[start : start + (1 << 16)] for start in range(0, len(file), 1 << 16))
    finite = (np.logical_and.reduce([np.isfinite(piece[n]) for n in names]) for piece in pieces)
    means = splats.means[np.isfinite(splats.means).all(axis=1)]
    average = round(file.stored_bytes / max(len(file), 1), 1)
    return {
        "splats": len(file),
        "sh_degree": splats.sh_degree,
        "bytes": file.stored_bytes,
        "bytes_per_splat": file.row_bytes if file.format.startswith("binary") else average,
        "format": file.format,
        "model": file.model,
        "extent_low": means.min(axis=0).tolist() if len(means) else None,
        "extent_high": means.max(axis=0).tolist() if len(means) else None,
        "non_finite_rows": sum(int(np.count_nonzero(~rows)) for rows in finite),
        "undrawable": int(np.count_nonzero(~drawable(splats))),
        "extra_properties": other_properties(names),
        **({"notes": list(file.remarks)} if file.remarks else {}),
    }


def _by(report: dict[str, Any]) -> str:
    return f"by {report['views']['used']} of {report['views']['given']} views"


def _written(splats: Mapping[str, Any]) -> str:
    """Number of splats written, if the format left some out; else ""."""
    return f", {splats['written']:,} written" if splats["left_out"] and splats["written"] else ""


def _files(report: dict[str, Any]) -> str:
    """Number of splats written, if some were left out, and file sizes before and after."""
    files = report["files"]
    sizes = sizes_in_words(files["input_bytes"], "->", files["output_bytes"])
    return f"{_written(report['splats'])}, {sizes}"


def _by_method(predicted: Mapping[str, Any], without: str = "") -> str:
    """Predicted quality and time of all methods except `without`, from a report's numbers.

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


def _of_object(options: argparse.Namespace) -> Any:
    """The demands on the splats of --object: those of the options and of the scene."""
    import bpy

    from ..objects import demands, splat_group

    obj = splat_group.find(options.object)
    marks = {*obj.vertex_groups.keys(), *getattr(obj.data, "attributes", {}).keys()}
    names, zones = [], []
    for role, text, volume in _named(options):
        if role == "protect" and volume is None and text in marks:
            names.append(text)
        else:
            also = f", nor a group or attribute of '{obj.name}'" if role == "protect" else ""
            zones.append(_zone(role, text, volume, also))
    scene = demands.Demands.of_scene(bpy.context.scene)
    return demands.Demands((*scene.names, *names), (*scene.zones, *zones))


def _named(options: argparse.Namespace) -> Iterator[tuple[Role, str, Volume | None]]:
    for option, role in ROLES.items():
        for text, volume in getattr(options, option) or ():
            yield role, text, volume


def _zone(role: Role, text: str, volume: Volume | None, also: str = "") -> Zone:
    if volume is not None:
        return Zone(role, f"'{text}'", volume)
    import bpy

    from ..objects import demands

    obj = bpy.context.scene.objects.get(text)
    if obj is None:
        fit = [o.name for o in bpy.context.scene.objects if demands.can_be_volume(o)]
        there = f"objects that can be volumes: {', '.join(fit[:8]) or 'none'}"
        raise RefineError(f"no object '{text}' in the open .blend{also} ({there})")
    return demands.zone(role, obj)
