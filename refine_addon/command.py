"""The command: ``blender -b [scene.blend] --command refine ...``, ``python -m refine_addon ...``.

Both parse the same arguments and run the same pipeline. Only ``--object``, and the cameras of an
open scene, need Blender; they are imported where they are used.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .core import (
    METHODS,
    Budget,
    Cancelled,
    ClosedForm,
    RefineError,
    Settings,
    prune_file,
    read_cameras,
    read_ply,
    score,
)
from .core.report import scoring_notes
from .core.splats import drawable
from .core.whole_file import expanded, refuse_existing, whole_file
from .version import VERSION

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from .core import SplatFile, ViewSet

DONE, FAILED, USAGE, CANCELLED = 0, 1, 2, 130
"""Exit codes: done, failed on an input, wrong usage, cancelled."""

DEFAULT_RATIO = 0.5


def main(arguments: Sequence[str], *, scene: bool = False) -> int:
    """Run the command.

    Parameters
    ----------
    arguments : sequence of str
        What stands behind ``refine`` on the command line.
    scene : bool
        Whether this runs in Blender, whose open scene has objects and cameras.

    Returns
    -------
    int
        Exit code: 0 done, 1 failed on an input, 2 wrong usage, 130 cancelled.
    """
    parser = make_parser()
    try:
        options = parser.parse_args(list(arguments), argparse.Namespace(scene=scene))
        _check_usage(parser, options)
    except SystemExit as leaving:  # argparse leaves the process; Blender wants a number
        return int(leaving.code or 0)
    run: Callable[[argparse.Namespace], int] = options.run
    try:
        return run(options)
    except RefineError as error:
        _complain(str(error))
        return FAILED
    except (Cancelled, KeyboardInterrupt):
        _complain("cancelled; nothing was left half-written")
        return CANCELLED


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of all three subcommands."""
    parser = argparse.ArgumentParser(
        prog="refine",
        description="Prune 3D Gaussian splats by how much the cameras would miss them.",
        epilog="Exit codes: 0 done, 1 failed on an input, 2 wrong usage, 130 cancelled.",
    )
    parser.add_argument("--version", action="version", version=f"refine {VERSION}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_prune(commands)
    _add_score(commands)
    info = commands.add_parser("info", help="say what is in 3DGS PLY files")
    info.add_argument("inputs", nargs="+", type=Path, metavar="INPUT", help="3DGS PLY files")
    _add_common(info)
    info.set_defaults(run=_run_info)
    return parser


def _add_prune(commands: Any) -> None:  # noqa: ANN401 - argparse does not name the type
    prune = commands.add_parser("prune", help="remove the splats the cameras would miss least")
    prune.add_argument("inputs", nargs="*", type=Path, metavar="INPUT", help="3DGS PLY files")
    prune.add_argument(
        "--object", metavar="NAME", help="prune this splat object of the open .blend"
    )
    prune.add_argument(
        "--save", action="store_true", help="with --object: delete the splats there and save"
    )
    prune.add_argument("-o", "--output", type=_path, metavar="OUT.ply", help="for a single input")
    prune.add_argument(
        "--output-dir", type=_path, metavar="DIR", help="for many inputs; made if it is not there"
    )
    budget = prune.add_mutually_exclusive_group()
    budget.add_argument(
        "--ratio",
        type=float,
        metavar="B",
        help=f"share of the splats to remove, 0 <= B < 1 (default {DEFAULT_RATIO})",
    )
    budget.add_argument("--keep", type=int, metavar="N", help="how many splats stay")
    budget.add_argument("--max-mb", type=float, metavar="M", help="size of the file, in 1e6 bytes")
    budget.add_argument("--threshold", type=float, metavar="S", help="remove scores below S")
    budget.add_argument(
        "--min-seen", type=float, metavar="P", help="remove what fewer than P %% of the views see"
    )
    _add_scoring(prune)
    prune.add_argument(
        "--absorb",
        action="store_true",
        help="survivors take over what is removed, by what the cameras see of it: far better when "
        "much is removed, and slower; they change; --method then only matters with --threshold and "
        "--min-seen",
    )
    prune.add_argument("--dry-run", action="store_true", help="decide and report, write nothing")
    _add_common(prune)
    prune.set_defaults(run=_run_prune)


def _add_score(commands: Any) -> None:  # noqa: ANN401 - argparse does not name the type
    scoring = commands.add_parser("score", help="write the file with a float property refine_score")
    scoring.add_argument("inputs", nargs=1, type=Path, metavar="INPUT", help="a 3DGS PLY file")
    scoring.add_argument(
        "-o", "--output", type=_path, metavar="OUT.ply", required=True, help="the file to make"
    )
    _add_scoring(scoring)
    _add_common(scoring)
    scoring.set_defaults(run=_run_score)


def _add_scoring(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--cameras",
        type=Path,
        metavar="FILE_OR_FOLDER",
        help="cameras.json, transforms.json or a COLMAP model; default: the open scene's cameras",
    )
    parser.add_argument(
        "--method",
        choices=METHODS,
        default=METHODS[0],
        help="default: closed-form; occlusion knows what hides what, and takes longer; auto takes "
        "the cheapest that agrees with it",
    )
    parser.add_argument(
        "--tolerance",
        type=float,
        default=Settings.tolerance,
        metavar="T",
        help="with --method auto: share of the kept splats that may differ from the full model's "
        f"(default {Settings.tolerance})",
    )
    parser.add_argument(
        "--depth",
        choices=["z", "distance"],
        default="z",
        help="what the closed form takes as distance: along the view's axis (z), or to the view "
        "itself (default z)",
    )
    parser.add_argument(
        "--published",
        action="store_true",
        help="the formula as published, without frustum test and with constants in scene units: "
        "the paper's with --depth z, its authors' code with --depth distance",
    )
    parser.add_argument(
        "--views",
        type=int,
        default=64,
        metavar="N",
        help="use at most N views, spread out evenly; 0 uses all (default 64)",
    )


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--report", type=_path, metavar="FILE.json", help="write a report as JSON")
    parser.add_argument("--overwrite", action="store_true", help="replace files that exist")
    parser.add_argument("--quiet", action="store_true", help="print errors only")


def _path(text: str) -> Path:
    try:
        return expanded(text)
    except RefineError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _check_usage(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Refuse combinations that argparse cannot; leaves through ``parser.error``, code 2."""
    _check_report(parser, options)
    _check_output(parser, options)
    if options.run is _run_info:
        return
    try:
        _settings(options)
        if options.run is _run_prune:
            _budget(options)
    except RefineError as error:
        parser.error(str(error))
    if options.method == "occlusion" and (options.published or options.depth != "z"):
        parser.error("--published and --depth are settings of the closed form")
    if options.cameras is None and not (options.scene and _blend()):
        parser.error("no cameras: give --cameras, or open a .blend that has some")
    if options.run is _run_prune:
        _check_prune(parser, options)


def _check_report(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Refuse a report that would replace what is read or written, even with --overwrite."""
    if options.report is None:
        return
    others = [*options.inputs, getattr(options, "output", None), getattr(options, "cameras", None)]
    if getattr(options, "output_dir", None):
        others += [options.output_dir / path.name for path in options.inputs]
    cameras = getattr(options, "cameras", None)
    if cameras and cameras.is_dir() and options.report.exists():
        others += [path for path in cameras.rglob("*") if path.is_file()]
    if options.scene:
        others.append(_blend())
    report = os.path.realpath(options.report)
    for other in filter(None, others):
        # Unlike pathlib's, these two never fail, whatever the name.
        if os.path.realpath(os.path.expanduser(other)) == report:  # noqa: PTH111
            parser.error(f"--report {options.report} is {other}, expected a file of its own")


def _check_output(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Refuse an output that would replace something other than splats, cameras above all."""
    output = getattr(options, "output", None)
    if output is None or not output.is_file() or output.suffix.lower() == ".ply":
        return
    with output.open("rb") as stream:
        if stream.read(3) != b"ply":
            parser.error(f"{output} exists and is no PLY: write to another name")


def _check_prune(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    if bool(options.inputs) == bool(options.object):
        parser.error("expected INPUT files or --object NAME, and not both")
    if options.object:
        if not options.scene:
            parser.error(
                "--object needs Blender: blender -b scene.blend --command refine prune ..."
            )
        if options.output_dir:
            parser.error("--object is written with -o, not with --output-dir")
        if not (options.output or options.save or options.dry_run):
            parser.error("--object needs -o OUT.ply, --save or --dry-run")
    else:
        _check_files(parser, options)


def _check_files(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    if options.save:
        parser.error("--save goes with --object")
    if options.output and options.output_dir:
        parser.error("expected -o or --output-dir, and not both")
    if not (options.output or options.output_dir or options.dry_run):
        parser.error("expected -o OUT.ply, --output-dir DIR or --dry-run")
    if options.output and len(options.inputs) > 1:
        parser.error(f"-o takes one input, got {len(options.inputs)}: use --output-dir")
    names = [path.name for path in options.inputs]
    double = next((name for name in names if names.count(name) > 1), None)
    if options.output_dir and double:
        parser.error(f"two inputs are called {double}: they would be one file in --output-dir")


def _settings(options: argparse.Namespace) -> Settings:
    make = ClosedForm.published if options.published else ClosedForm
    return Settings(options.method, options.views, make(options.depth), tolerance=options.tolerance)


def _budget(options: argparse.Namespace) -> Budget:
    names = ("ratio", "keep", "max_mb", "threshold", "min_seen")
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    return Budget(**(given or {"ratio": DEFAULT_RATIO}))


def _blend() -> str:
    """Return the path of the open .blend, "" if it was never saved."""
    import bpy  # noqa: PLC0415 - only there inside Blender

    return str(bpy.data.filepath)


def _views(options: argparse.Namespace) -> ViewSet:
    if options.cameras is not None:
        return read_cameras(options.cameras)
    import bpy  # noqa: PLC0415

    from .cameras import sets as camera_sets  # noqa: PLC0415

    return camera_sets.visible_views(bpy.context.scene)


@dataclass
class _Run:
    """What one call of the command did so far."""

    options: argparse.Namespace
    entries: list[dict[str, Any]] = field(default_factory=list)
    failed: bool = False
    started: float = field(default_factory=time.perf_counter)

    def say(self, text: str) -> None:
        if self.options.quiet:
            return
        try:
            print(text, flush=True)
        except UnicodeEncodeError:  # a name that this terminal's encoding cannot show
            print(text.encode("ascii", "backslashreplace").decode(), flush=True)
        except OSError:  # whoever read this has gone, or its disk is full: the work goes on
            self.options.quiet = True
            sys.stdout = open(os.devnull, "w")  # noqa: PTH123, SIM115 - closed with the process

    def progress(self, label: str) -> Callable[[float, str], None]:
        """Return a callback that draws on a terminal and is silent elsewhere."""
        if self.options.quiet or not sys.stderr.isatty():
            return lambda _fraction, _what: None

        def draw(fraction: float, what: str) -> None:
            print(f"\r\x1b[K{label}: {what} {fraction:4.0%}", end="", file=sys.stderr, flush=True)

        return draw

    def attempt(self, label: str, work: Callable[[], dict[str, Any]]) -> None:
        """Do one input's work; note its error, so that the others go on."""
        try:
            self.entries.append({"status": "done", **work()})
        except (RefineError, OSError, MemoryError) as error:
            self.failed = True
            message = str(error) or type(error).__name__
            # What is wrong with the splats is said without the file.
            files = (Path(label), getattr(self.options, "output", None))
            if not any(file and file.name in message for file in files):
                message = f"{label}: {message}"
            self.entries.append({"status": "failed", "input": label, "error": message})
            self.clear_line()
            _complain(message)

    def clear_line(self) -> None:
        if not self.options.quiet and sys.stderr.isatty():
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)

    def finish(self) -> int:
        """Write the report and return the exit code."""
        if self.options.report is not None:
            content = {
                "refine": VERSION,
                "python": sys.version.split()[0],
                "numpy": np.__version__,
                "seconds": time.perf_counter() - self.started,
                "results": self.entries,
            }
            path = self.options.report
            with whole_file(path, overwrite=self.options.overwrite) as stream:
                stream.write(json.dumps(content, indent=2, allow_nan=False).encode() + b"\n")
        return FAILED if self.failed else DONE


def _start(options: argparse.Namespace) -> _Run:
    if options.report is not None:
        refuse_existing(options.report, overwrite=options.overwrite)
    return _Run(options)


def _complain(text: str) -> None:
    print(f"refine: error: {text}", file=sys.stderr, flush=True)


def _run_prune(options: argparse.Namespace) -> int:
    run = _start(options)
    views = _views(options)
    if options.object:
        run.attempt(options.object, lambda: _prune_object(run, views))
    elif options.output_dir and not options.dry_run:
        _make_folder(options.output_dir)
    for source in options.inputs:
        run.attempt(str(source), lambda source=source: _prune_one(run, source, views))
    return run.finish()


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        msg = f"{folder}: cannot be made ({error.strerror or error})"
        raise RefineError(msg) from error


def _prune_one(run: _Run, source: Path, views: ViewSet) -> dict[str, Any]:
    options = run.options
    output = options.output
    if options.output_dir:
        output = options.output_dir / source.name
    result = prune_file(
        source,
        None if options.dry_run else output,
        views,
        _budget(options),
        _settings(options),
        absorb=options.absorb,
        overwrite=options.overwrite,
        progress=run.progress(source.name),
    )
    run.clear_line()
    _say_result(run, str(source), result.report)
    return result.report


def _prune_object(run: _Run, views: ViewSet) -> dict[str, Any]:
    from . import splat_object  # noqa: PLC0415 - needs Blender

    options = run.options
    report = splat_object.prune_object(
        options.object,
        views,
        _budget(options),
        _settings(options),
        absorb=options.absorb,
        output=options.output,
        save=options.save,
        dry_run=options.dry_run,
        overwrite=options.overwrite,
        progress=run.progress(options.object),
    )
    run.clear_line()
    _say_result(run, options.object, report)
    return report


def _say_result(run: _Run, label: str, report: dict[str, Any]) -> None:
    splats, views, files = report["splats"], report["views"], report["files"]
    verb = "would keep" if run.options.dry_run else "kept"
    before, after = (files[name] / 1e6 for name in ("input_bytes", "output_bytes"))
    share = splats["removed"] / splats["before"]
    parts = [
        f"{verb} {splats['kept']:,} of {splats['before']:,} splats ({share:.1%} removed)",
        f"{before:,.1f} -> {after:,.1f} MB",
        f"by {views['used']} of {views['given']} views",
        f"{report['timings']['total_s']:.2f} s",
    ]
    target = f" -> {files['output']}" if files["output"] else ""
    run.say(f"{label}: {', '.join(parts)}{target}")
    for note in report["notes"]:
        run.say(f"  note: {note}")


def _run_score(options: argparse.Namespace) -> int:
    run = _start(options)
    views = _views(options)
    source = options.inputs[0]
    run.attempt(str(source), lambda: _score_one(run, source, views))
    return run.finish()


def _score_one(run: _Run, source: Path, views: ViewSet) -> dict[str, Any]:
    options = run.options
    output = options.output
    refuse_existing(output, overwrite=options.overwrite)
    file = read_ply(source)
    scores = score(file.splats(), views, _settings(options), progress=run.progress(source.name))
    file.write(output, columns={"refine_score": scores.values}, overwrite=options.overwrite)
    run.clear_line()
    run.say(f"{source}: scored {len(file):,} splats by {scores.views_used} views -> {output}")
    notes = scoring_notes(scores)
    for note in notes:
        run.say(f"  note: {note}")
    return {
        "files": {"input": str(source), "output": str(output)},
        "splats": {"before": len(file), "undrawable": scores.undrawable},
        "views": {"given": len(views), "used": scores.views_used},
        "settings": asdict(_settings(options)),
        "weights": scores.weights,
        "notes": notes,
    }


def _run_info(options: argparse.Namespace) -> int:
    run = _start(options)
    for source in options.inputs:
        run.attempt(str(source), lambda source=source: _info_one(run, source))
    return run.finish()


def _info_one(run: _Run, source: Path) -> dict[str, Any]:
    file = read_ply(source)
    facts = describe(file)
    run.say(f"{source}")
    for name, value in facts.items():
        run.say(f"  {name.replace('_', ' '):18} {value}")
    return {"input": str(source), **facts}


def describe(file: SplatFile) -> dict[str, Any]:
    """Return what ``info`` says of a file: counts, degree, extent, rows that are not finite."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    whole = file.splats()
    broken = undrawable = 0
    for start in range(0, len(file), 1 << 16):
        rows = file.rows[start : start + (1 << 16)]
        splats = whole.take(slice(start, start + (1 << 16)))
        finite = np.ones(len(rows), np.bool_)
        for name in rows.dtype.names or ():
            finite &= np.isfinite(rows[name])
        broken += int(np.count_nonzero(~finite))
        undrawable += int(np.count_nonzero(~drawable(splats)))
        means = splats.means[np.isfinite(splats.means).all(axis=1)].astype(np.float64)
        low = np.minimum(low, means.min(axis=0, initial=np.inf))
        high = np.maximum(high, means.max(axis=0, initial=-np.inf))
    names = file.rows.dtype.names or ()
    known = ("x", "y", "z", "nx", "ny", "nz", "opacity")
    extra = [n for n in names if n not in known and not n.startswith(("f_", "scale_", "rot_"))]
    return {
        "splats": len(file),
        "sh_degree": whole.sh_degree,
        "bytes": file.size(),
        "bytes_per_splat": round(file.row_bytes, 1),
        "format": file.format,
        "extent_low": low.tolist() if np.isfinite(low).all() else None,
        "extent_high": high.tolist() if np.isfinite(high).all() else None,
        "non_finite_rows": broken,
        "undrawable": undrawable,
        "extra_properties": extra,
    }
