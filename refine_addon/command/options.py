"""The options of all subcommands, each once, and the settings made from them."""

from __future__ import annotations

import argparse
import contextlib
import functools
import re
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn

from ..core import METHODS, REASONS, Budget, Cleaning, Levels, Merge, RefineError, Refit
from ..core.affine import AXES
from ..core.errors import printable
from ..core.formats.registry import READ_SUFFIXES, SUFFIXES
from ..core.lod import SHARES
from ..core.splats import MODELS
from ..core.tiles.storage import located
from ..core.volumes import Role, parse
from ..core.whole_file import Url, is_url
from ..version import VERSION

_SOURCES = "visible, active, selected, collection:NAME, frames or frames:A:B:STEP"
_TABLE = f"""
inputs INPUT            files of splats: {", ".join(READ_SUFFIXES)}
output FILE             the file to write, in the format of its suffix: {", ".join(SUFFIXES)}
--object NAME           instead of INPUT: a splat object of the open .blend, with the cameras, marks
                        and volumes of the panel there
--source WHICH          which cameras of the open scene decide: {_SOURCES}, the active one
                        at every STEP-th frame from A to B; frames alone is the panel's range
render --source WHICH   frames (all of the scene) or frames:A:B:STEP (default: the current frame)
--cameras PATH          cameras.json, transforms.json or a COLMAP model (default: those of the open
                        scene)
--save                  with --object: delete its splats and save the .blend
-o OUT                  a file, in the format of its suffix; or a folder, by any other name, which
                        is made if missing
lod -o OUT              a folder, for INPUT.lod1.ply and so on; FOLDER/NAME.spz for NAME.lod1.spz;
                        or FOLDER/lod-meta.json, a streamed SOG, which viewers load by chunks
--ratio B               share of the splats to remove, 0 <= B < 1 (default 0.5)
--keep N                number of splats to keep
--max-mb M              size of the file to write, in 1e6 bytes
--psnr DB               remove as many as possible while the views' pictures stay this close to the
                        unpruned ones: 40 is hard to tell apart, 30 is visible
--levels S,S,...        share of the splats in each level, the finest first (default
                        {",".join(f"{share:g}" for share in SHARES)})
lod --psnr DB,DB,...    instead of --levels: how close each stays to the original in the views, in
                        dB
--method METHOD         from fastest to best: {", ".join(METHODS)}. The first two
                        delete splats, closed-form as if none was hidden; merge (the default) merges
                        removed splats into kept ones, unless deleting is as good; refit then fits
                        the kept ones to the pictures of all splats, which takes longer and gains
                        some dB
--rounds N              with --method refit: number of rounds at most (default: 2 to 4, by what they
                        gain)
--views N               use at most N views, spread out evenly; 0 uses all (default {Merge.views})
--exact                 no other views decide, too, where there are few cameras; so it is with
                        --source frames
--clean                 first remove floaters, as clean does; the budget applies to the rest
--reasons R,R,...       which to remove, of {", ".join(REASONS)}
                        (default {",".join(Cleaning.reasons)})
--remove-inside VOLUME  splats in it are removed first, as part of the budget:
                        box:x0,y0,z0,x1,y1,z1 or sphere:x,y,z,radius in the coordinates of the
                        cameras, or in Blender an object, a closed mesh or an empty shown as cube or
                        sphere; may be repeated
--keep-inside VOLUME    splats in no volume of this kind are removed; see --remove-inside
--protect VOLUME        splats in it stay unchanged, whatever else removes them; see
                        --remove-inside; also a vertex group or boolean attribute of --object
--pictures DIR          draw up to 3 of the views before and after, and their difference, as
                        NAME-CAMERA-before.png and so on; the folder is made if missing
--together              the inputs are tiles of one scene: one budget over all, never all in memory;
                        for plain PLY; INPUT and OUT may be URLs (needs the extra distributed)
--workers N|ADDRESS     with --together: run on N new processes of a Dask cluster, or on the workers
                        of the scheduler at an address (needs the extra distributed)
--degree D              leave out harmonics above this degree, 0 to 4
--model MODEL           how the splats are drawn, if the file does not say or is wrong: default,
                        antialiased (Mip-Splatting, gsplat, Brush's mip) or 2dgs (discs)
--spz-axes AXES         of .spz files that name none, read or written: rub (y up, z back, as SPZ has
                        it: splats are turned) or rdf (as they stand); by default cameras decide
                        where there are some, else as they stand
--dry-run               decide and report, but write no splats; --pictures are drawn
--report FILE.json      write a report as JSON
--overwrite             replace files that exist
--quiet                 print errors only
"""
"""Help of each option; after a subcommand where it differs there."""

_REST = "--report --overwrite --quiet"
_VIEWS = f"--cameras --source --views --remove-inside --keep-inside --model --spz-axes {_REST}"
_MORE = "--rounds --clean --protect --pictures --together --workers --dry-run"
BLENDER = "blender -b scene.blend --command refine"
_COMMANDS = f"""
prune: remove the splats the cameras would miss least
inputs* --object --save -o --ratio --keep --max-mb --psnr --method --exact {_MORE} {_VIEWS}
  refine prune in.ply --cameras cameras.json --ratio 0.7 -o out.ply
  refine prune *.ply --cameras cameras.json --psnr 40 -o pruned
  refine prune in.ply --cameras sparse/0 --max-mb 5 --method refit -o out.ply
  refine prune in.ply --cameras sparse/0 --keep-inside box:-2,-2,-1,2,2,3 -o out.ply
  refine prune *.ply --together --cameras sparse/0 --ratio 0.6 -o out
  {BLENDER} prune --object Splats --protect Statue --remove-inside Sky -o out.ply
  {BLENDER} prune --object Splats --source frames:1:250:10 --save

score: write files with a float property refine_score
inputs* --object -o --method --exact {_VIEWS}
  refine score in.ply --cameras cameras.json -o scored.ply
  {BLENDER} score --object Splats -o scored.ply

clean: remove floaters, which the cameras see in empty air; without -o only report them
inputs+ -o --reasons --protect {_VIEWS}
  refine clean *.ply --cameras cameras.json -o cleaned
  refine clean in.ply --cameras cameras.json --reasons front,isolated -o out.ply

lod: write levels of detail, and report the quality of each
inputs+ -o --levels --psnr --method --exact --rounds --protect {_VIEWS}
  refine lod in.ply --cameras cameras.json -o levels
  refine lod in.ply --cameras cameras.json -o web/lod-meta.json
  refine lod in.ply --cameras cameras.json --psnr 45,40,35 -o levels/in.spz

convert: write files of splats as one, in another format
inputs+ output --degree --model --spz-axes {_REST}
  refine convert in.ply out.spz
  refine convert room.ply statue.spz both.sog --degree 1

info: describe files of splats
inputs+ {_REST}
  refine info *.ply --report report.json

render: render the open scene with splats, by its output settings
--source --quiet
  {BLENDER} render --source frames:1:250:10
"""
"""Purpose, inputs, options and examples of each subcommand."""

ROLES: dict[str, Role] = {"protect": "protect", "remove_inside": "remove", "keep_inside": "keep"}
"""Option -> role of its volumes."""

LAST_FRAME = 1_048_574  # Largest frame number of Blender; the smallest is its negative


def settings(kind: type, options: argparse.Namespace, **default: Any) -> Any:
    """A `kind` with the options of its fields' names; with `default` if none is given."""
    values = {field.name: getattr(options, field.name, None) for field in fields(kind)}
    return kind(**({n: value for n, value in values.items() if value is not None} or default))


def complete(options: argparse.Namespace) -> None:
    """Add the settings ``budget``, ``how`` (the method), ``cleaning`` and ``levels``."""
    if options.command == "prune":
        options.budget = settings(Budget, options, ratio=0.5)
    if options.command == "lod":
        options.levels = settings(Levels, options, shares=SHARES)
    kind = METHODS[options.method or Merge.name]
    if options.rounds is not None and kind is not Refit:
        raise RefineError(f"rounds is {options.rounds}, expected only with --method refit")
    options.how = settings(kind, options)
    cleans = options.clean or options.command == "clean"
    options.cleaning = settings(Cleaning, options) if cleans else None


def _name(text: str) -> str:
    """The text; refused if empty, as from an unset variable of a script."""
    if not text:
        raise RefineError("expected a name, got none")
    return text


def _input(text: str) -> Path | Url:
    if "\0" in text:
        raise RefineError("expected a path without a zero byte")
    return Url(text) if is_url(text) else Path(_name(text))


def _output(text: str) -> Path | Url:
    """An output path, ``~`` expanded."""
    if text == "-":
        raise RefineError("nothing is written to standard output: name a file (one named - is ./-)")
    return located(_input(text))


def _workers(text: str) -> int | str:
    if not text.lstrip("-").isdecimal():
        return _name(text)
    if int(text) < 1:
        raise RefineError(f"workers is {text}, expected 1 or more")
    return int(text)


def _numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(map(float, text.split(",")))
    except ValueError:
        raise RefineError(f"expected numbers with commas between them, got {text!r}") from None


def _source(text: str) -> tuple[str, str | range]:
    """The source by its name in the panel, and its collection or frames."""
    kind, colon, rest = text.partition(":")
    if kind == "frames" and colon:
        return "FRAMES", _frames(rest)
    if text not in ("visible", "active", "selected", "frames", f"collection:{rest or '?'}"):
        raise RefineError(f"expected {_SOURCES}, got {text!r}")
    return kind.upper(), rest


def _frames(text: str) -> range:
    """Frames of ``A:B:STEP``, with A and B."""
    words = text.split(":")
    with contextlib.suppress(ValueError):
        first, last, step = map(int, words if words[2:] else [*words, "1"])
        if -LAST_FRAME <= first <= last <= LAST_FRAME and step >= 1:
            return range(first, last + 1, step)
    limits = f"A to B from {-LAST_FRAME} to {LAST_FRAME} and STEP at least 1"
    raise RefineError(f"expected A:B:STEP or A:B in whole numbers, {limits}, got {text!r}")


def _for_argparse(parse: Callable[[str], Any]) -> Callable[[str], Any]:
    """The same, but raising the only error whose message argparse shows."""

    @functools.wraps(parse)
    def wrapped(text: str) -> Any:
        try:
            return parse(text)
        except RefineError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return wrapped


_TYPES: dict[str, Callable[[str], Any]] = {
    **dict.fromkeys(("N", "D"), int),
    **dict.fromkeys(("B", "M", "DB"), float),
    **dict.fromkeys(("S,S,...", "DB,DB,..."), _numbers),
    "R,R,...": lambda text: tuple(word.strip() for word in text.split(",")),
    **dict.fromkeys(("INPUT", "PATH"), _input),
    **dict.fromkeys(("OUT", "FILE", "DIR", "FILE.json"), _output),
    **{"NAME": _name, "N|ADDRESS": _workers, "WHICH": _source},
    "VOLUME": lambda text: (_name(text), parse(text)),
}
"""Placeholder in the help -> parser of the value; others take any text."""

_NAMES = {"-o": "output", "--levels": "shares"}  # Options whose attribute has another name
_CHOICES = {"METHOD": tuple(METHODS), "MODEL": MODELS, "AXES": AXES, "D": tuple(range(5))}


class _Parser(argparse.ArgumentParser):
    """A parser whose errors show control characters of the arguments escaped."""

    def error(self, message: str) -> NoReturn:
        super().error(printable(message))


def make_parser() -> argparse.ArgumentParser:
    """Parser of all subcommands; options that a subcommand lacks are None."""
    parser = _Parser(
        prog="refine",
        description="Prune 3D Gaussian splats by how much the cameras would miss them.",
        epilog="Exit codes: 0 done, 1 failed on an input, 2 wrong usage, 130 cancelled (Ctrl-C).",
    )
    parser.add_argument("--version", action="version", version=f"refine {VERSION}")
    commands = parser.add_subparsers(
        title="commands", dest="command", required=True, metavar="COMMAND"
    )
    row = r"^(?:(\w+) )?(-\S+|inputs|output)(?: (\S+))? {2,}(.*(?:\n .*)*)"
    rows = {
        (own, option): (metavar, " ".join(text.split()))
        for own, option, metavar, text in re.findall(row, _TABLE, re.MULTILINE)
    }
    absent = {option.strip("-").replace("-", "_"): None for _, option in rows}
    parser.set_defaults(**absent | {"inputs": ()})
    for block in _COMMANDS.strip().split("\n\n"):
        head, takes, *examples = block.split("\n")
        name, purpose = head.split(": ")
        command = commands.add_parser(
            name,
            help=purpose,
            description=f"{purpose[0].upper()}{purpose[1:]}.",
            epilog="\n".join(["examples:", *examples]),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        for word in takes.split():
            option = word.rstrip("*+")
            metavar, text = rows.get((name, option)) or rows["", option]
            if not metavar:
                command.add_argument(option, help=text, action="store_true")
                continue
            command.add_argument(
                option,
                help=text,
                metavar=metavar,
                type=_for_argparse(_TYPES.get(metavar, str)),
                choices=_CHOICES.get(metavar),
                nargs=word[-1] if word != option else None,
                action="append" if metavar == "VOLUME" else "store",
                **({"dest": _NAMES[option]} if option in _NAMES else {}),
            )
    return parser
