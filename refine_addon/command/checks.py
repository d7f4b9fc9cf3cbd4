"""What is refused before anything is read or written, beyond what argparse refuses."""

from __future__ import annotations

import argparse
import os
import stat
from collections.abc import Callable, Sequence
from pathlib import Path

from ..core import RefineError
from ..core.formats.registry import SUFFIXES, format_named, without_suffix
from ..core.lod import is_streamed, level_paths
from ..core.whole_file import Url, refuse_url
from . import zones
from .options import DEFAULT_LEVELS, arrangement, budget, cleaning, levels, method
from .report import is_report
from .zones import ROLES


def check(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Refuse what cannot go together, and outputs that would replace something else.

    Wrong usage leaves through ``parser.error``, code 2.

    Raises
    ------
    RefineError
        If a file that would be replaced cannot be looked into.
    """
    if options.command == "render":
        _check_render(parser, options)
    else:
        _check_splats(parser, options)
    if options.command == "convert":
        _check_convert(parser, options)


def _check_convert(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Refuse to move what cannot be moved so."""
    try:
        arrangement(options)
    except RefineError as error:
        parser.error(str(error))


def _check_render(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    if not options.scene:
        parser.error("render needs Blender: blender -b scene.blend --command refine render")


def _check_splats(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Do what `check` does for subcommands that go from splats to splats."""
    if options.command == "prune" and not options.together:
        _refuse_urls(parser, options)
    _check_report(parser, options)
    for path in _outputs(options):
        _check_output(parser, path)
    if options.command == "lod" and options.format and is_streamed(options.output_dir):
        parser.error(f"--format goes with a folder, not with {options.output_dir.name}")
    if options.command in ("info", "convert"):
        return
    try:
        _check_settings(options)
    except RefineError as error:
        parser.error(str(error))
    zones.check(parser, options)
    if options.command == "prune":
        _check_prune(parser, options)
    elif options.command == "clean":
        _check_files(parser, options)
    elif options.command == "score":
        _check_score(parser, options)
    if options.cameras is None and not (options.scene and open_blend()):
        parser.error("no cameras: give --cameras, or open a .blend that has some")


def _refuse_urls(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Refuse URLs where each input is pruned by itself."""
    try:
        for path in filter(None, [*options.inputs, options.output_dir]):
            refuse_url(path)
    except RefineError as error:
        parser.error(str(error))


def _check_settings(options: argparse.Namespace) -> None:
    """Refuse values that cannot be, and a budget that means nothing to the method."""
    if options.command == "clean":
        cleaning(options)
        return
    if options.command == "lod":
        levels(options)
    method(options)
    if options.command == "prune":
        budget(options)


def open_blend() -> str:
    """Return the path of the open .blend, "" if it was never saved."""
    import bpy

    return str(bpy.data.filepath)


def _outputs(options: argparse.Namespace) -> Sequence[Path | Url]:
    """Return the splat files to be made."""
    if options.command == "lod":
        count = len(options.psnr or options.levels or DEFAULT_LEVELS)
        if is_streamed(options.output_dir):
            return []
        return level_paths(
            options.inputs[0], options.output_dir, count, options.format or SUFFIXES[0]
        )
    if getattr(options, "output_dir", None):
        return [options.output_dir / path.name for path in options.inputs]
    return [options.output] if getattr(options, "output", None) else []


def _check_report(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Refuse a report that would replace what is read or written, even with --overwrite."""
    if options.report is None:
        return
    others = [*options.inputs, *_outputs(options), getattr(options, "cameras", None)]
    if options.command == "lod":
        others.append(options.output_dir)
    if options.scene:
        others.append(open_blend())
    path = os.path.realpath(options.report)
    for other in filter(None, others):
        # Unlike pathlib's, these two never fail, whatever the name.
        if os.path.realpath(os.path.expanduser(other)) == path:
            parser.error(f"--report {options.report} is {other}, expected a file of its own")
    pictures = getattr(options, "pictures", None)
    if pictures and path.endswith(".png") and os.path.dirname(path) == os.path.realpath(pictures):
        parser.error(f"--report {options.report} may be one of the pictures; choose another name")
    beginning = _beginning(options.report) if options.overwrite else None
    if beginning is not None and not is_report(beginning):
        parser.error(f"{options.report} exists and is no report: write to another name")


def _check_output(parser: argparse.ArgumentParser, path: Path | Url) -> None:
    """Refuse an output that would replace something other than splats, cameras above all."""
    try:
        if format_named(path) or path.suffix.lower() == ".ply":
            return
    except RefineError as error:
        parser.error(str(error))
    if isinstance(path, Url):
        parser.error(f"{path}: expected a name that ends in .ply")
    beginning = _beginning(path)
    if beginning is not None and not beginning.startswith(b"ply"):
        parser.error(f"{path} exists and is no PLY: write to another name")


def _beginning(path: Path) -> bytes | None:
    """Return the first bytes of a file; None where there is none."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            return None  # which `refuse_existing` says
        with path.open("rb") as stream:
            return stream.read(64)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise RefineError(
            f"{path}: cannot be looked into ({error.strerror or error}); nothing was changed"
        ) from error


def _check_source(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Refuse an object beside files or out of Blender, and a choice of cameras beside another."""
    if bool(options.inputs) == bool(options.object):
        parser.error("expected INPUT files or --object NAME, and not both")
    if options.object and options.model:
        parser.error("--model goes with INPUT files; an object has it in the panel, under Splats")
    if options.object and not options.scene:
        command = f"blender -b scene.blend --command refine {options.command} ..."
        parser.error(f"--object needs Blender: {command}")
    if not (options.source or options.frames):
        return
    option = "--source" if options.source else "--frames"
    if not options.object:
        parser.error(f"{option} goes with --object; for INPUT files give --cameras")
    if options.cameras is not None:
        parser.error(f"expected --cameras or {option}, and not both")
    if options.frames and options.source and options.source[0] != "FRAMES":
        parser.error("--frames goes with --source frames alone, or without --source")


def _check_prune(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    if options.clean and options.object:
        parser.error("--clean goes with INPUT files, not with --object")
    if options.together:
        _check_together(parser, options)
    elif options.workers is not None or options.scheduler:
        parser.error("--workers and --scheduler go with --together")
    _check_source(parser, options)
    if options.object:
        if options.output_dir:
            parser.error("--object is written with -o, not with --output-dir")
        if not (options.output or options.save or options.dry_run):
            parser.error("--object needs -o OUT.ply, --save or --dry-run")
    else:
        if options.save:
            parser.error("--save goes with --object")
        if not (options.output or options.output_dir or options.dry_run):
            parser.error("expected -o OUT.ply, --output-dir DIR or --dry-run")
        _check_files(parser, options)


def _check_together(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Refuse what needs all splats at once, or one output."""
    alone = ("object", "output", "clean", *ROLES)
    for name in alone:
        if getattr(options, name, None):
            option = "-o" if name == "output" else f"--{name.replace('_', '-')}"
            parser.error(f"{option} does not go with --together")
    if options.workers is not None and options.scheduler:
        parser.error("expected --workers or --scheduler, and not both")
    if options.workers is not None and options.workers < 1:
        parser.error(f"workers is {options.workers}, expected 1 or more")


def _check_score(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    _check_source(parser, options)
    if len(options.inputs) > 1:
        parser.error(f"expected one INPUT, got {len(options.inputs)}")
    if format_named(options.output):
        parser.error(f"-o {options.output}: only a .ply holds scores")


def _check_files(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    if options.output and options.output_dir:
        parser.error("expected -o or --output-dir, and not both")
    if options.output and len(options.inputs) > 1:
        parser.error(f"-o takes one input, got {len(options.inputs)}: use --output-dir")
    if options.output_dir:
        advice = "call the command for each, with its own --output-dir or -o"
        if getattr(options, "together", False):
            advice = "rename one of them"
        _refuse_doubles(parser, options.inputs, lambda path: options.output_dir / path.name, advice)
        if not getattr(options, "together", False):
            _refuse_replaced(parser, options.inputs, options.output_dir)
    if getattr(options, "pictures", None):
        if options.together:
            parser.error("--pictures draws each input by itself, not --together")
        _refuse_doubles(
            parser,
            options.inputs,
            lambda path: options.pictures / f"{without_suffix(path.name)}-CAMERA-after.png",
            "call the command for each, with its own --pictures",
        )


def _refuse_doubles(
    parser: argparse.ArgumentParser,
    inputs: Sequence[Path],
    output_of: Callable[[Path], Path],
    advice: str,
) -> None:
    """Refuse two inputs of which the same file would be made."""
    first: dict[str, Path] = {}
    for path in inputs:
        output = output_of(path)
        other = first.setdefault(os.path.realpath(str(output)), path)
        if other is not path:
            parser.error(f"{other} and {path} would both be {output}: {advice}")


def _refuse_replaced(parser: argparse.ArgumentParser, inputs: Sequence[Path], folder: Path) -> None:
    """Refuse an output that is another input by a link: it would be replaced before it is read."""
    read = {os.path.realpath(path): path for path in inputs}
    for path in inputs:
        other = read.get(os.path.realpath(str(folder / path.name)), path)
        if other is not path:
            parser.error(f"{folder / path.name} is {other} by a link, which is read too")
