"""What is refused before anything is read or written: combinations of options, and outputs."""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

from ..core import RefineError
from ..core.formats.registry import SUFFIXES, format_named, names_file, without_suffix
from ..core.formats.streamed_sog import INDEX
from ..core.lod import level_paths
from ..core.whole_file import Url, explained, refuse_existing, refuse_url
from .options import BLENDER, ROLES


def check(options: argparse.Namespace) -> None:
    """Refuse options that exclude each other, and outputs that would replace inputs or others."""
    together, inputs = options.together, options.inputs
    places = [options.cameras, options.report, options.pictures]
    for place in filter(None, places if together else [*places, *inputs, options.output]):
        refuse_url(place)
    outputs = _outputs(options)
    for message, broken in _rules(options).items():
        if broken:
            raise RefineError(message)
    for path in outputs:
        if not format_named(path) and path.suffix.lower() != ".ply":
            raise RefineError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")
    if options.command not in ("lod", "convert"):
        _refuse_doubles(inputs, outputs, read=() if together else inputs)
    if options.pictures:
        _refuse_one_of("--pictures", options.pictures, [*inputs, *outputs])
        names = [without_suffix(path.name) for path in inputs]
        _refuse_doubles(inputs, [options.pictures / f"{n}-CAMERA-after.png" for n in names])
    if options.report:
        _refuse_report(options, outputs)


def check_report(path: Path, *, overwrite: bool) -> None:
    """Refuse a report that could not be written, before the work."""
    refuse_existing(path, overwrite=overwrite)
    with explained(path, "cannot be written", end="; nothing was changed"):
        # A link stays one: what it points to is written.
        tempfile.TemporaryFile(dir=os.path.dirname(os.path.realpath(path))).close()


def _rules(options: argparse.Namespace) -> dict[str, object]:
    """Message of each rule -> whether the options break it."""
    name, scene, obj, output = options.command, options.scene, options.object, options.output
    together, many = options.together, len(options.inputs) > 1
    needs = f"needs Blender: {BLENDER} {name}"
    decides = name in ("prune", "score", "clean", "lod")
    file = output is not None and decides and names_file(output)
    alone = ("object", "clean", "pictures", "spz_axes", *ROLES)
    flags = {o: f"--{o.replace('_', '-')}" for o in alone}
    nameless = "objects can be named in Blender only; here give box:... or sphere:x,y,z,radius"
    return {
        f"render {needs}": name == "render" and not scene,
        "render takes --source frames or frames:A:B:STEP": (
            name == "render" and options.source and options.source[0] != "FRAMES"
        ),
        "expected either INPUT files or --object NAME": (
            name in ("prune", "score") and bool(options.inputs) == bool(obj)
        ),
        "--model and --spz-axes go with INPUT files; the panel sets them for objects": (
            obj and (options.model or options.spz_axes)
        ),
        "--clean goes with INPUT files, not with --object": obj and options.clean,
        f"--object {needs} ...": obj and not scene,
        "--save goes with --object": options.save and not obj,
        "--workers goes with --together": options.workers and not together,
        **{f"{flags[o]} does not go with --together": together and vars(options)[o] for o in flags},
        "lod takes one INPUT": name == "lod" and many,
        "expected -o OUT (or, for prune, --save or --dry-run)": (
            decides and name != "clean" and not (output or options.save or options.dry_run)
        ),
        f"-o {output}: expected the name of a file for --object": obj and output and not file,
        f"-o {output} is one file, expected a folder for the inputs": file and (many or together),
        f"-o {output}: only a .ply holds scores": (
            name == "score" and file and format_named(output)
        ),
        f"--source {needs} ...": options.source and not scene,
        "expected --cameras or --source, not both": options.source and options.cameras,
        "no cameras: give --cameras, or open a .blend that has some": (
            decides and not options.cameras and not options.blend
        ),
        **{
            f"{flags[role]} {text}: {nameless}": volume is None and not scene
            for role in ROLES
            for text, volume in vars(options)[role] or ()
        },
    }


def _outputs(options: argparse.Namespace) -> Sequence[Path | Url]:
    output = options.output
    if output is None or (options.command == "lod" and output.name == INDEX):
        return []
    if options.command == "lod":
        format_named(output)  # refuses endings that are not written
        return level_paths(options.inputs[0], output, len(options.levels))
    if names_file(output) or options.command == "convert":
        return [output]
    return [output / path.name for path in options.inputs]


def _refuse_report(options: argparse.Namespace, outputs: Sequence[Path | Url]) -> None:
    """Refuse a report that would replace an input or output, even with --overwrite."""
    report, pictures = options.report, options.pictures
    others = [*options.inputs, *outputs, options.output, options.cameras, options.blend, pictures]
    _refuse_one_of("--report", report, others)
    path = os.path.realpath(report)
    if pictures and path.endswith(".png") and os.path.dirname(path) == os.path.realpath(pictures):
        raise RefineError(f"--report {report}: may be one of the pictures; choose another name")
    if options.overwrite and os.path.isfile(report):
        with report.open("rb") as stream:
            words = stream.read(64).split()
            if words and not b"".join(words).startswith(b'{"refine":'):
                raise RefineError(f"{report}: exists and is no report; choose another name")


def _refuse_one_of(option, path, others):
    """Refuse the path of an option that is one of the others, which may be None."""
    for other in filter(None, others):
        # These two never raise, as pathlib's do for some names.
        if os.path.realpath(os.path.expanduser(other)) == os.path.realpath(path):
            raise RefineError(f"{option} {path}: {other} is an input or output already")


def _refuse_doubles(inputs, outputs, read=()):
    """Refuse inputs with the same output, and outputs that are links to another file of `read`."""
    first: dict[str, Path] = {}
    linked = {os.path.realpath(path): path for path in read}
    for path, output in zip(inputs, outputs, strict=False):
        real = os.path.realpath(output)
        if (other := first.setdefault(real, path)) is not path:
            raise RefineError(f"{other} and {path} would both be {output}: rename one of them")
        if (other := linked.get(real, path)) is not path:
            raise RefineError(f"{output} is a link to {other}, which is an input too")
