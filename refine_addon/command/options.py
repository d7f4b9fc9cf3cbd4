"""The options of all subcommands, each once, and the settings they make."""

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
from ..core.errors import printable
from ..core.formats.registry import READ_SUFFIXES, SUFFIXES
from ..core.lod import SHARES
from ..core.splats import MODELS
from ..core.volumes import Role, Volume, parse
from ..core.whole_file import Url, expanded, is_url
from ..version import VERSION

_SOURCES = "visible, active, selected, collection:NAME, frames or frames:A:B:STEP"

_TABLE = f"""
inputs INPUT            files of splats: {", ".join(READ_SUFFIXES)}
output FILE             the file to make, by its suffix: {", ".join(SUFFIXES)}
--object NAME           in place of INPUT: this splat object of the open .blend, by the cameras that
                        are chosen in the panel there, with what it protects and crops
--source WHICH          which cameras of the open scene decide: {_SOURCES}, the active one
                        at frame A and every STEP-th after it to B; frames are the panel's range
render --source WHICH   frames, all of the scene, or frames:A:B:STEP; the current one by default
--cameras PATH          cameras.json, transforms.json or a COLMAP model; without, those of the scene
--save                  with --object: delete the splats there and save
-o OUT                  a file, in the format of its suffix, or for any number of inputs a folder,
                        which is any other name; made if it is not there
lod -o OUT              a folder, for INPUT.lod1.ply and so on; FOLDER/NAME.spz for NAME.lod1.spz;
                        or FOLDER/lod-meta.json, a streamed SOG, which viewers load by chunks
--ratio B               share of the splats to remove, 0 <= B < 1 (default 0.5)
--keep N                how many splats stay
--max-mb M              size of the file, in 1e6 bytes
--psnr DB               remove as much as leaves the views' pictures this close to the unpruned
                        ones: 40 is hard to tell apart, 30 is seen
--levels S,S,...        share of the splats that stays in each, the finest first (default
                        {",".join(f"{share:g}" for share in SHARES)})
lod --psnr DB,DB,...    or how close each stays to the original in these views, in dB
--method METHOD         from instant to best: {", ".join(METHODS)}. The first two
                        delete, closed-form as if nothing was hidden; merge (the default) merges
                        what goes into what stays, or deletes where that is as good; refit then fits
                        what stays to what all splats look like, some dB better, in more time
--rounds N              with --method refit: fit up to N times (default 2 to 4, by what they bring)
--views N               use at most N views, spread out evenly; 0 uses all (default {Merge.views})
--clean                 first remove what floats, as clean does; the budget counts the rest
--reasons R,R,...       which to remove, of {", ".join(REASONS)}
                        (default {",".join(Cleaning.reasons)})
--remove-inside VOLUME  splats in it go first, and count as removed: box:x0,y0,z0,x1,y1,z1 or
                        sphere:x,y,z,radius in the coordinates of the cameras, or in Blender an
                        object, a closed mesh or an empty shown as cube or sphere; may be repeated
--keep-inside VOLUME    all splats go that are in no volume of this kind; see --remove-inside
--protect VOLUME        splats in it stay unchanged, whatever else is said; see --remove-inside;
                        also a vertex group or boolean attribute of --object
--pictures DIR          draw up to 3 of the views before and after, and what differs, as
                        NAME-CAMERA-before.png and so on; made if it is not there
--together              the inputs are tiles of one scene: one budget over all, never all in memory;
                        for plain PLY; INPUT and OUT may be URLs (needs the extra distributed)
--workers N|ADDRESS     with --together: on N processes of a Dask cluster, started here, or on the
                        workers of the scheduler at an address (needs the extra distributed)
--degree D              leave out harmonics above this degree, 0 to 4
--model MODEL           how the splats are drawn, where a file does not say or is wrong: default,
                        antialiased (Mip-Splatting, gsplat, Brush's mip) or 2dgs (discs)
--dry-run               decide and report, write no splats; --pictures are drawn
--report FILE.json      write a report as JSON
--overwrite             replace files that exist
--quiet                 print errors only
"""
"""Each option, after the subcommand where its text differs there."""

_REST = "--report --overwrite --quiet"
_VIEWS = f"--cameras --source --views --remove-inside --keep-inside --model {_REST}"
_MORE = "--rounds --clean --protect --pictures --together --workers --dry-run"
BLENDER = "blender -b scene.blend --command refine"

_COMMANDS = f"""
prune: remove the splats the cameras would miss least
inputs* --object --save -o --ratio --keep --max-mb --psnr --method {_MORE} {_VIEWS}
  refine prune in.ply --cameras cameras.json --ratio 0.7 -o out.ply
  refine prune *.ply --cameras cameras.json --psnr 40 -o pruned
  refine prune in.ply --cameras sparse/0 --max-mb 5 --method refit -o out.ply
  refine prune in.ply --cameras sparse/0 --keep-inside box:-2,-2,-1,2,2,3 -o out.ply
  refine prune *.ply --together --cameras sparse/0 --ratio 0.6 -o out
  {BLENDER} prune --object Splats --protect Statue --remove-inside Sky -o out.ply
  {BLENDER} prune --object Splats --source frames:1:250:10 --save

score: write files with a float property refine_score
inputs* --object -o --method {_VIEWS}
  refine score in.ply --cameras cameras.json -o scored.ply
  {BLENDER} score --object Splats -o scored.ply

clean: remove what the cameras see to float in the air; without -o, only say what would go
inputs+ -o --reasons --protect {_VIEWS}
  refine clean *.ply --cameras cameras.json -o cleaned
  refine clean in.ply --cameras cameras.json --reasons front,isolated -o out.ply

lod: write levels of detail, each with what it costs
inputs+ -o --levels --psnr --method --rounds --protect {_VIEWS}
  refine lod in.ply --cameras cameras.json -o levels
  refine lod in.ply --cameras cameras.json -o web/lod-meta.json
  refine lod in.ply --cameras cameras.json --psnr 45,40,35 -o levels/in.spz

convert: write files of splats as one, in another format
inputs+ output --degree --model {_REST}
  refine convert in.ply out.spz
  refine convert room.ply statue.spz both.sog --degree 1

info: say what is in files of splats
inputs+ {_REST}
  refine info *.ply --report report.json

render: render the open scene with splats, by its output settings
--source --quiet
  {BLENDER} render --source frames:1:250:10
"""
"""For each subcommand its purpose, inputs, options, and examples."""

ROLES: dict[str, Role] = {"protect": "protect", "remove_inside": "remove", "keep_inside": "keep"}
"""Options -> role of their volumes."""

LAST_FRAME = 1_048_574  # Blender's last frame; negative, its first


def settings(kind: type, options: argparse.Namespace, **default: Any) -> Any:
    """Settings of a kind: each field from the option of its name, else from `default`."""
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
    """A name, not empty: an unset variable of a script is a mistake, not a default."""
    if not text:
        raise RefineError("expected a name, got none")
    return text


def _given(text: str) -> Path | Url:
    if "\0" in text:
        raise RefineError("a path holds no zero byte")
    return Url(text) if is_url(text) else Path(_name(text))


def _made(text: str) -> Path | Url:
    """An output path, ``~`` expanded."""
    if text == "-":
        raise RefineError("nothing is written to standard output: name a file (./- is one, too)")
    place = _given(text)
    return place if isinstance(place, Url) else expanded(place)


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


def _volume(text: str) -> tuple[str, Volume | None]:
    """The text, and its volume if it holds numbers, not a name."""
    return _name(text), parse(text)


def _source(text: str) -> tuple[str, str | range]:
    """The kind of source as the panel names it, with its collection or frames."""
    kind, colon, rest = text.partition(":")
    if kind == "frames" and colon:
        return "FRAMES", _frames(rest)
    if text not in ("visible", "active", "selected", "frames", f"collection:{rest or '?'}"):
        raise RefineError(f"expected {_SOURCES}, got {text!r}")
    return kind.upper(), rest


def _frames(text: str) -> range:
    """The frames between colons, both ends included."""
    words = text.split(":")
    with contextlib.suppress(ValueError):
        first, last, step = map(int, words if words[2:] else [*words, "1"])
        if -LAST_FRAME <= first <= last <= LAST_FRAME and step >= 1:
            return range(first, last + 1, step)
    raise RefineError(
        f"expected A:B:STEP or A:B in whole numbers, A to B from {-LAST_FRAME} to {LAST_FRAME} and "
        f"STEP at least 1, got {text!r}"
    )


def _told(take: Callable[[str], Any]) -> Callable[[str], Any]:
    """The same for argparse, which shows messages of its own error type only."""

    @functools.wraps(take)
    def told(text: str) -> Any:
        try:
            return take(text)
        except RefineError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return told


_TYPES: dict[str, Callable[[str], Any]] = {
    **dict.fromkeys(("N", "D"), int),
    **dict.fromkeys(("B", "M", "DB"), float),
    **dict.fromkeys(("S,S,...", "DB,DB,..."), _numbers),
    "R,R,...": lambda text: tuple(word.strip() for word in text.split(",")),
    **dict.fromkeys(("INPUT", "PATH"), _given),
    **dict.fromkeys(("OUT", "FILE", "DIR", "FILE.json"), _made),
    **{"NAME": _name, "N|ADDRESS": _workers, "WHICH": _source, "VOLUME": _volume},
}
"""Type of an option by its placeholder in the help; else any text."""

_NAMES = {"-o": "output", "--levels": "shares"}  # Field names of options, where they differ

_CHOICES = {"METHOD": tuple(METHODS), "MODEL": MODELS, "D": tuple(range(5))}


class _Parser(argparse.ArgumentParser):
    """A parser whose complaints are safe to print, whatever the arguments hold."""

    def error(self, message: str) -> NoReturn:
        super().error(printable(message))


def make_parser() -> argparse.ArgumentParser:
    """Parser of all subcommands; options that one lacks are None."""
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
    none = {option.strip("-").replace("-", "_"): None for _, option in rows}
    parser.set_defaults(**none | {"inputs": ()})
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
                type=_told(_TYPES.get(metavar, str)),
                choices=_CHOICES.get(metavar),
                nargs=word[-1] if word != option else None,
                action="append" if metavar == "VOLUME" else "store",
                **({"dest": _NAMES[option]} if option in _NAMES else {}),
            )
    return parser
