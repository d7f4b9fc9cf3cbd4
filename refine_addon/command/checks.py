"""What is refused before anything is read or written, beyond what single values show."""

from __future__ import annotations

import argparse
import contextlib
import os
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path

from ..core import RefineError
from ..core.formats.registry import SUFFIXES, format_named, names_file, without_suffix
from ..core.lod import is_streamed, level_paths
from ..core.whole_file import Url, refuse_url
from .options import BLENDER
from .report import is_report
from .zones import ROLES


def check(options: argparse.Namespace) -> None:
    """Refuse what does not go together, and outputs that would replace something else.

    Raises
    ------
    RefineError
        It is wrong usage.
    OSError
        If a report that would be replaced cannot be looked into.
    """
    together = options.together and ("inputs", "output")
    for option in ("inputs", "output", "cameras", "report", "pictures"):
        values = getattr(options, option)
        for value in values if option == "inputs" else [values]:
            if value and option not in (together or ()):
                refuse_url(value)
    for wrong, why in _rules(options):
        if wrong:
            raise RefineError(why)
    made = _outputs(options)
    for path in made:
        if not format_named(path) and path.suffix.lower() != ".ply":
            raise RefineError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")
    if options.command in ("prune", "score", "clean"):
        advice = "rename one of them" if together else "call the command for each, with its own -o"
        _refuse_doubles(options.inputs, made, advice)
        if options.pictures:
            names = [without_suffix(path.name) for path in options.inputs]
            pictures = [options.pictures / f"{name}-CAMERA-after.png" for name in names]
            _refuse_doubles(options.inputs, pictures, "call the command for each")
        if not together and len(made) > 1:
            _refuse_replaced(options.inputs, made)
    if options.report:
        _check_report(options, made)


def _rules(options: argparse.Namespace) -> Iterator[tuple[object, str]]:
    """What does not go together, with what is said of it."""
    name, one = options.command, options.object
    needs = f"needs Blender: {BLENDER} {name}"
    decides = name in ("prune", "score", "clean", "lod")
    yield name == "render" and not options.scene, f"render {needs}"
    if name in ("prune", "score"):
        yield bool(options.inputs) == bool(one), "expected INPUT files or --object NAME, not both"
        yield (
            one and options.model,
            ("--model goes with INPUT files; an object has it in the panel, under Splats"),
        )
        yield one and options.clean, "--clean goes with INPUT files, not with --object"
        yield one and not options.scene, f"--object {needs} ..."
        yield options.save and not one, "--save goes with --object"
        yield options.workers and not options.together, "--workers goes with --together"
    for option in ("object", "clean", "pictures", *ROLES) if options.together else ():
        flag = f"--{option.replace('_', '-')}"
        yield getattr(options, option), f"{flag} does not go with --together"
    yield name == "lod" and len(options.inputs) > 1, "lod takes one INPUT"
    output = options.output
    yield (
        name in ("prune", "score", "lod") and not (output or options.save or options.dry_run),
        "expected -o OUT" + ", --save or --dry-run" * (name == "prune"),
    )
    if decides and output:
        file, many = names_file(output), len(options.inputs) > 1 or options.together
        yield one and not file, f"-o {output}: expected the name of a file for --object"
        yield file and many, f"-o {output} is one file, expected a folder for the inputs"
        yield (
            name == "score" and file and format_named(output),
            (f"-o {output}: only a .ply holds scores"),
        )
    yield options.source and not options.scene, f"--source {needs} ..."
    yield options.source and options.cameras, "expected --cameras or --source, and not both"
    yield (
        decides and not options.cameras and not (options.scene and open_blend()),
        "no cameras: give --cameras, or open a .blend that has some",
    )
    for role in ROLES if not options.scene else ():
        for text, volume in getattr(options, role) or ():
            yield (
                volume is None,
                (
                    f"--{role.replace('_', '-')} {text}: objects have names in Blender alone; "
                    "here give box:x0,y0,z0,x1,y1,z1 or sphere:x,y,z,radius"
                ),
            )


def open_blend() -> str:
    """Return the path of the open .blend, "" if it was never saved."""
    import bpy

    return str(bpy.data.filepath)


def _outputs(options: argparse.Namespace) -> Sequence[Path | Url]:
    """The files of splats to be made."""
    output = options.output
    if output is None or (options.command == "lod" and is_streamed(output)):
        return []
    if options.command == "lod":
        format_named(output)  # refuses endings that are not written
        return level_paths(options.inputs[0], output, len(options.shares))
    if names_file(output) or options.command == "convert":
        return [output]
    return [output / path.name for path in options.inputs]


def _check_report(options: argparse.Namespace, made: Sequence[Path | Url]) -> None:
    """Refuse a report that would replace what is read or written, even with --overwrite."""
    report, pictures = options.report, options.pictures
    others = [*options.inputs, *made, options.output, options.cameras]
    if options.scene:
        others.append(open_blend())
    path = os.path.realpath(report)
    for other in filter(None, others):
        # Unlike pathlib's, these two never fail, whatever the name.
        if os.path.realpath(os.path.expanduser(other)) == path:
            raise RefineError(f"--report {report} is {other}, expected a file of its own")
    if pictures and path.endswith(".png") and os.path.dirname(path) == os.path.realpath(pictures):
        raise RefineError(f"--report {report} may be one of the pictures; choose another name")
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):
        # What is no file `refuse_existing` says.
        if options.overwrite and stat.S_ISREG(report.stat().st_mode):
            with report.open("rb") as stream:
                if not is_report(stream.read(64)):
                    raise RefineError(f"{report} exists and is no report: write to another name")


def _refuse_doubles(inputs: Sequence[Path], made: Sequence[Path], advice: str) -> None:
    """Refuse two inputs of which the same file would be made."""
    first: dict[str, Path] = {}
    for path, output in zip(inputs, made, strict=False):
        other = first.setdefault(os.path.realpath(output), path)
        if other is not path:
            raise RefineError(f"{other} and {path} would both be {output}: {advice}")


def _refuse_replaced(inputs: Sequence[Path], made: Sequence[Path]) -> None:
    """Refuse an output that is another input by a link: it would be replaced before it is read."""
    read = {os.path.realpath(path): path for path in inputs}
    for path, output in zip(inputs, made, strict=True):
        other = read.get(os.path.realpath(output), path)
        if other is not path:
            raise RefineError(f"{output} is {other} by a link, which is read too")
