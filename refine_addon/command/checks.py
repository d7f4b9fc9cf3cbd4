"""What is refused before anything is read or written, beyond what argparse refuses."""

from __future__ import annotations

import os
import stat
from typing import TYPE_CHECKING

from ..core import RefineError
from ..core.formats.registry import format_named, without_suffix
from ..core.levels.files import MANIFEST, check_goal, is_manifest, level_paths
from ..core.urls import Url, refuse_url
from . import options, zones
from .report import is_report
from .zones import ROLES

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Sequence
    from pathlib import Path


def check(parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    """Refuse what cannot go together, and outputs that would replace something else.

    Wrong usage leaves through ``parser.error``, code 2.

    Raises
    ------
    RefineError
        If a file that would be replaced cannot be looked into.
    """
    if given.command == "prune" and not given.together:
        _refuse_urls(parser, given)
    _check_report(parser, given)
    for path in _outputs(given):
        _check_output(parser, path)
    if given.command == "lod":
        _check_manifest(parser, given)
    if given.command in ("info", "convert"):
        return
    try:
        _check_settings(given)
    except RefineError as error:
        parser.error(str(error))
    zones.check(parser, given)
    if given.command == "prune":
        _check_prune(parser, given)
    elif given.command == "clean":
        _check_files(parser, given)
    elif given.command == "score":
        _check_score(parser, given)
    if given.cameras is None and not (given.scene and open_blend()):
        parser.error("no cameras: give --cameras, or open a .blend that has some")


def _refuse_urls(parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    """Refuse URLs where each input is pruned by itself."""
    try:
        for path in filter(None, [*given.inputs, given.output_dir]):
            refuse_url(path)
    except RefineError as error:
        parser.error(str(error))


def _check_settings(given: argparse.Namespace) -> None:
    """Refuse values that cannot be, and a budget that means nothing to the method.

    Raises
    ------
    RefineError
        For a value.
    """
    if given.command == "clean":
        options.cleaning(given)
        return
    if given.command == "lod":
        options.levels(given)
        check_goal(given.distance_psnr)
    settings = options.settings(given)
    if given.command == "prune":
        options.budget(given).refuse_meaningless(settings.method, frustum=settings.frustum)


def open_blend() -> str:
    """Return the path of the open .blend, "" if it was never saved."""
    import bpy  # noqa: PLC0415 - only there inside Blender

    return str(bpy.data.filepath)


def _outputs(given: argparse.Namespace) -> Sequence[Path | Url]:
    """Return the splat files to be made."""
    if given.command == "lod":
        count = len(given.psnr or given.levels or options.DEFAULT_LEVELS)
        return level_paths(given.inputs[0], given.output_dir, count, given.format)
    if getattr(given, "output_dir", None):
        return [given.output_dir / path.name for path in given.inputs]
    return [given.output] if getattr(given, "output", None) else []


def _check_report(parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    """Refuse a report that would replace what is read or written, even with --overwrite."""
    if given.report is None:
        return
    others = [*given.inputs, *_outputs(given), getattr(given, "cameras", None)]
    if given.command == "lod":
        others.append(given.output_dir / MANIFEST)
    if given.scene:
        others.append(open_blend())
    path = os.path.realpath(given.report)
    for other in filter(None, others):
        # Unlike pathlib's, these two never fail, whatever the name.
        if os.path.realpath(os.path.expanduser(other)) == path:  # noqa: PTH111
            parser.error(f"--report {given.report} is {other}, expected a file of its own")
    beginning = _beginning(given.report) if given.overwrite else None
    if beginning is not None and not is_report(beginning):
        parser.error(f"{given.report} exists and is no report: write to another name")


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


def _check_manifest(parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    """Refuse a folder in which another file has the name of the manifest."""
    path = given.output_dir / MANIFEST
    beginning = _beginning(path) if given.overwrite else None
    if beginning is not None and not is_manifest(beginning):
        parser.error(f"{path} exists and lists no levels: write to another folder")


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
        msg = f"{path}: cannot be looked into ({error.strerror or error}); nothing was changed"
        raise RefineError(msg) from error


def _check_source(parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    """Refuse an object beside files or out of Blender, and a choice of cameras beside another."""
    if bool(given.inputs) == bool(given.object):
        parser.error("expected INPUT files or --object NAME, and not both")
    if given.object and not given.scene:
        command = f"blender -b scene.blend --command refine {given.command} ..."
        parser.error(f"--object needs Blender: {command}")
    if not (given.source or given.frames):
        return
    option = "--source" if given.source else "--frames"
    if not given.object:
        parser.error(f"{option} goes with --object; for INPUT files give --cameras")
    if given.cameras is not None:
        parser.error(f"expected --cameras or {option}, and not both")
    if given.frames and given.source and given.source[0] != "FRAMES":
        parser.error("--frames goes with --source frames alone, or without --source")


def _check_prune(parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    if given.clean and given.object:
        parser.error("--clean goes with INPUT files, not with --object")
    if given.together:
        _check_together(parser, given)
    elif given.workers is not None or given.scheduler:
        parser.error("--workers and --scheduler go with --together")
    _check_source(parser, given)
    if given.object:
        if given.output_dir:
            parser.error("--object is written with -o, not with --output-dir")
        if not (given.output or given.save or given.dry_run):
            parser.error("--object needs -o OUT.ply, --save or --dry-run")
    else:
        if given.save:
            parser.error("--save goes with --object")
        if not (given.output or given.output_dir or given.dry_run):
            parser.error("expected -o OUT.ply, --output-dir DIR or --dry-run")
        _check_files(parser, given)


def _check_together(parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    """Refuse what needs all splats at once, or one output."""
    alone = ("object", "output", "clean", *ROLES)
    for name in alone:
        if getattr(given, name, None):
            option = "-o" if name == "output" else f"--{name.replace('_', '-')}"
            parser.error(f"{option} does not go with --together")
    if given.psnr is not None and (given.absorb or given.method == "closed-form"):
        parser.error("with --together, --psnr goes with --method auto or occlusion, not --absorb")
    if given.workers is not None and given.scheduler:
        parser.error("expected --workers or --scheduler, and not both")
    if given.workers is not None and given.workers < 1:
        parser.error(f"workers is {given.workers}, expected 1 or more")


def _check_score(parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    _check_source(parser, given)
    if len(given.inputs) > 1:
        parser.error(f"expected one INPUT, got {len(given.inputs)}")
    if format_named(given.output):
        parser.error(f"-o {given.output}: only a .ply holds scores")


def _check_files(parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    if given.output and given.output_dir:
        parser.error("expected -o or --output-dir, and not both")
    if given.output and len(given.inputs) > 1:
        parser.error(f"-o takes one input, got {len(given.inputs)}: use --output-dir")
    if given.output_dir:
        advice = "call the command for each, with its own --output-dir or -o"
        if getattr(given, "together", False):
            advice = "rename one of them"
        _refuse_doubles(parser, given.inputs, lambda path: given.output_dir / path.name, advice)
    if getattr(given, "pictures", None):
        if given.together:
            parser.error("--pictures draws each input by itself, not --together")
        _refuse_doubles(
            parser,
            given.inputs,
            lambda path: given.pictures / f"{without_suffix(path.name)}-CAMERA-after.png",
            "call the command for each, with its own --pictures",
        )


def _refuse_doubles(
    parser: argparse.ArgumentParser,
    inputs: Sequence[Path],
    made: Callable[[Path], Path],
    advice: str,
) -> None:
    """Refuse two inputs of which the same file would be made."""
    first: dict[Path, Path] = {}
    for path in inputs:
        other = first.setdefault(made(path), path)
        if other is not path:
            parser.error(f"{other} and {path} would both be {made(path)}: {advice}")
