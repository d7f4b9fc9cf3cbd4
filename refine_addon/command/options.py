"""The options of all subcommands, and what they say as budget and settings."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from ..core import (
    METHODS,
    REASONS,
    Budget,
    Cleaning,
    Levels,
    Merge,
    Method,
    Move,
    RefineError,
    Refit,
)
from ..core.errors import printable
from ..core.formats.registry import READ_SUFFIXES, SUFFIXES
from ..core.lod import SHARES as DEFAULT_LEVELS
from ..core.splats import MODELS
from ..core.whole_file import Url, expanded, is_url, refuse_url
from ..version import VERSION
from . import zones

DEFAULT_RATIO = 0.5

FORMATS = ", ".join(SUFFIXES)

_FILES = f"files: {', '.join(READ_SUFFIXES)}"

SOURCES = ("visible", "active", "selected", "frames", "collection:NAME")
"""What --source takes: the choices of the panel, in small letters."""

BLENDER = "blender -b scene.blend --command "
"""What stands before ``refine`` in an example that needs Blender."""

EXAMPLES = {
    "prune": (
        "refine prune in.ply --cameras cameras.json --ratio 0.7 -o out.ply",
        "refine prune *.ply --cameras cameras.json --psnr 40 --output-dir pruned",
        "refine prune in.ply --cameras sparse/0 --max-mb 5 --method refit -o out.ply",
        "refine prune in.ply --cameras sparse/0 --keep-inside box:-2,-2,-1,2,2,3 -o out.ply",
        f"{BLENDER}refine prune --object Splats --protect Statue --remove-inside Sky -o out.ply",
        "refine prune *.ply --together --cameras sparse/0 --ratio 0.6 --output-dir out",
        f"{BLENDER}refine prune --object Splats -o out.ply",
        f"{BLENDER}refine prune --object Splats --frames 1:250:10 --save",
        f"{BLENDER}refine prune --object Splats --source collection:Shot --dry-run",
        f"{BLENDER}refine prune --object Splats --dry-run --pictures before_and_after",
    ),
    "score": (
        "refine score in.ply --cameras cameras.json -o scored.ply",
        f"{BLENDER}refine score --object Splats -o scored.ply",
    ),
    "clean": (
        "refine clean in.ply --cameras cameras.json",
        "refine clean *.ply --cameras cameras.json --output-dir cleaned",
        "refine clean in.ply --cameras cameras.json --reasons front,isolated -o out.ply",
    ),
    "lod": (
        "refine lod in.ply --cameras cameras.json -o levels",
        "refine lod in.ply --cameras cameras.json -o web/lod-meta.json",
        "refine lod in.ply --cameras cameras.json --psnr 45,40,35 --format .spz -o levels",
    ),
    "convert": (
        "refine convert in.ply out.spz",
        "refine convert room.ply statue.spz both.ply --rotate 2:0,90,0 --translate 2:0,-1.5,0",
        "refine convert in.ply out.ply --degree 1 --morton",
    ),
    "info": ("refine info in.ply", "refine info *.ply --report report.json"),
    "render": (
        f"{BLENDER}refine render",
        f"{BLENDER}refine render --animation",
        f"{BLENDER}refine render --frames 1:250:10",
    ),
}
"""Under the help of each subcommand."""

LAST_FRAME = 1_048_574
"""The last frame that Blender knows, and with a minus the first."""


class _Parser(argparse.ArgumentParser):
    """A parser whose complaints can be shown, whatever the arguments hold."""

    def error(self, message: str) -> NoReturn:
        super().error(printable(message))


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of all subcommands."""
    parser = _Parser(
        prog="refine",
        description="Prune 3D Gaussian splats by how much the cameras would miss them.",
        epilog="Exit codes: 0 done, 1 failed on an input, 2 wrong usage, 130 cancelled, 143 "
        "terminated.",
    )
    parser.add_argument("--version", action="version", version=f"refine {VERSION}")
    commands = parser.add_subparsers(
        title="commands", dest="command", required=True, metavar="COMMAND"
    )
    _add_prune(commands)
    _add_score(commands)
    _add_clean(commands)
    _add_lod(commands)
    _add_convert(commands)
    info = _add(commands, "info", "say what is in files of splats")
    info.add_argument("inputs", nargs="+", type=_given, metavar="INPUT", help="files of splats")
    _add_common(info)
    _add_render(commands)
    return parser


def _add(commands: Any, name: str, purpose: str) -> argparse.ArgumentParser:
    """Return the parser of a new subcommand, with examples under its help."""
    examples = "\n".join(f"  {example}" for example in EXAMPLES[name])
    return commands.add_parser(
        name,
        help=purpose,
        description=f"{purpose[0].upper()}{purpose[1:]}.",
        epilog=f"examples:\n{examples}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _add_prune(commands: Any) -> None:
    prune = _add(commands, "prune", "remove the splats the cameras would miss least")
    prune.add_argument("inputs", nargs="*", type=_tile, metavar="INPUT", help=_FILES)
    _add_object(prune)
    prune.add_argument(
        "--save", action="store_true", help="with --object: delete the splats there and save"
    )
    _add_outputs(prune, folder=_folder)
    amount = prune.add_mutually_exclusive_group()
    amount.add_argument(
        "--ratio",
        type=float,
        metavar="B",
        help=f"share of the splats to remove, 0 <= B < 1 (default {DEFAULT_RATIO})",
    )
    amount.add_argument("--keep", type=int, metavar="N", help="how many splats stay")
    amount.add_argument("--max-mb", type=float, metavar="M", help="size of the file, in 1e6 bytes")
    amount.add_argument("--threshold", type=float, metavar="S", help="remove scores below S")
    amount.add_argument(
        "--min-seen", type=float, metavar="P", help="remove what fewer than P %% of the views see"
    )
    amount.add_argument(
        "--psnr",
        type=float,
        metavar="DB",
        help="remove as much as leaves the views' pictures this close to the unpruned ones: 40 "
        "is hard to tell apart, 30 is seen",
    )
    _add_scoring(prune)
    prune.add_argument(
        "--clean",
        action="store_true",
        help="first remove floaters and outliers, as clean does; the budget counts the rest",
    )
    zones.add(prune, names="a vertex group or boolean attribute of --object, ")
    prune.add_argument(
        "--pictures",
        type=_path,
        metavar="DIR",
        help="draw up to 3 of the views before and after, and what differs, as "
        "NAME-CAMERA-before.png and so on; made if it is not there; --dry-run draws them too",
    )
    prune.add_argument(
        "--together",
        action="store_true",
        help="the inputs are tiles of one scene: one budget over all of them, and never all of "
        "them in memory; for plain PLY; all are written or none; INPUT and DIR may be URLs such as "
        "s3://bucket/a.ply (needs the extra distributed)",
    )
    prune.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="with --together: on N processes of a Dask cluster, started here (needs the extra "
        "distributed)",
    )
    prune.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="with --together: on the workers of this Dask scheduler, which see the same files "
        "under the same paths",
    )
    _add_model(prune)
    prune.add_argument("--dry-run", action="store_true", help="decide and report, write no splats")
    _add_common(prune)


def _add_clean(commands: Any) -> None:
    cleaning = _add(commands, "clean", "remove what the cameras see to float in the air")
    cleaning.add_argument("inputs", nargs="+", type=_given, metavar="INPUT", help=_FILES)
    _add_outputs(cleaning, "; without it, only say what would go")
    _add_cameras(cleaning)
    cleaning.add_argument(
        "--reasons",
        type=_words,
        default=Cleaning.reasons,
        metavar="R,R,...",
        help=f"which to remove, of {', '.join(REASONS)} (default {','.join(Cleaning.reasons)})",
    )
    _add_views(cleaning)
    zones.add(cleaning)
    _add_model(cleaning)
    _add_common(cleaning)


def _add_score(commands: Any) -> None:
    scoring = _add(commands, "score", "write the file with a float property refine_score")
    scoring.add_argument("inputs", nargs="*", type=_given, metavar="INPUT", help="a file of splats")
    _add_object(scoring)
    scoring.add_argument(
        "-o", "--output", type=_path, metavar="OUT.ply", required=True, help="the file to make"
    )
    _add_scoring(scoring)
    zones.add(scoring, protects=False)
    _add_model(scoring)
    _add_common(scoring)


def _add_lod(commands: Any) -> None:
    making = _add(commands, "lod", "write levels of detail, each with what it costs")
    making.add_argument("inputs", nargs=1, type=_given, metavar="INPUT", help="a file of splats")
    making.add_argument(
        "-o",
        "--output-dir",
        type=_path,
        metavar="DIR",
        required=True,
        help="for NAME.lod1.ply and so on; DIR/lod-meta.json makes a streamed SOG of all levels, "
        "which viewers on the web load by chunks; DIR is made if it is not there",
    )
    amount = making.add_mutually_exclusive_group()
    amount.add_argument(
        "--levels",
        type=_numbers,
        default=(),
        metavar="S,S,...",
        help="share of the splats that stays in each, the finest first (default "
        f"{','.join(f'{share:g}' for share in DEFAULT_LEVELS)})",
    )
    amount.add_argument(
        "--psnr",
        type=_numbers,
        default=(),
        metavar="DB,DB,...",
        help="or how close each stays to the original in these views, in dB",
    )
    making.add_argument(
        "--format",
        type=str.lower,
        choices=SUFFIXES,
        metavar="SUFFIX",
        help=f"of the files: {FORMATS} (default {SUFFIXES[0]})",
    )
    _add_scoring(making)
    zones.add(making)
    _add_model(making)
    _add_common(making)


def _add_convert(commands: Any) -> None:
    convert = _add(commands, "convert", "write files of splats as one, in another format")
    convert.add_argument(
        "inputs", nargs="+", type=_given, metavar="IN", help="known by its content; several merge"
    )
    convert.add_argument("output", type=_path, metavar="OUT", help=f"by its suffix: {FORMATS}")
    for name, metavar, what in (
        ("translate", "[N:]X,Y,Z", "by so many units, after the others"),
        ("rotate", "[N:]X,Y,Z", "by degrees about x, then y, then z"),
        ("scale", "[N:]S", "by a factor, before the others"),
    ):
        convert.add_argument(
            f"--{name}",
            type=partial(_numbered, count=metavar.count(",") + 1),
            action="append",
            default=[],
            metavar=metavar,
            help=f"move the N-th input {what}; without N all of them; --{name}=-1 for a minus",
        )
    convert.add_argument(
        "--degree",
        type=int,
        choices=range(5),
        metavar="D",
        help="leave out harmonics above this degree, 0 to 4",
    )
    convert.add_argument(
        "--morton",
        action="store_true",
        help="sort splats along a Z-shaped (Morton) curve, so that near ones follow each other",
    )
    convert.add_argument(
        "--level",
        type=int,
        default=0,
        metavar="L",
        help="of a streamed SOG (lod-meta.json): 0, the default, is the finest",
    )
    _add_model(convert)
    _add_common(convert)


def _add_render(commands: Any) -> None:
    render = _add(commands, "render", "render the open scene with splats, by its output settings")
    chosen = render.add_mutually_exclusive_group()
    chosen.add_argument(
        "--animation", action="store_true", help="all frames of the scene, not only the current one"
    )
    chosen.add_argument(
        "--frames",
        type=_frames,
        metavar="A:B:STEP",
        help="frame A and every STEP-th after it to B (every one without STEP)",
    )
    render.add_argument("--quiet", action="store_true", help="print errors only")
    render.set_defaults(inputs=[], report=None)


def _add_object(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--object",
        type=_name,
        metavar="NAME",
        help="in place of INPUT: this splat object of the open .blend, by the cameras that are "
        "chosen in the panel there, with what it protects and crops; of the panel's other settings "
        "none counts",
    )
    parser.add_argument(
        "--source",
        type=_source,
        metavar="WHICH",
        help=f"with --object: which cameras decide instead, one of {', '.join(SOURCES)}",
    )
    parser.add_argument(
        "--frames",
        type=_frames,
        metavar="A:B:STEP",
        help="with --object: the active camera decides, at frame A and every STEP-th after it to B "
        "(every one without STEP); --source frames alone takes the panel's range",
    )


def _add_outputs(
    parser: argparse.ArgumentParser, more: str = "", folder: Callable[[str], Any] | None = None
) -> None:
    parser.add_argument(
        "-o",
        "--output",
        type=_path,
        metavar="OUT.ply",
        help=f"for a single input; written in the format of its suffix{more}",
    )
    parser.add_argument(
        "--output-dir",
        type=folder or _path,
        metavar="DIR",
        help="for many inputs; made if it is not there",
    )


def _add_cameras(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--cameras",
        type=_given,
        metavar="FILE_OR_FOLDER",
        help="cameras.json, transforms.json or a COLMAP model; default: the visible cameras of the "
        "open scene",
    )


def _add_views(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--views",
        type=int,
        default=Merge.views,
        metavar="N",
        help=f"use at most N views, spread out evenly; 0 uses all (default {Merge.views})",
    )
    parser.add_argument(
        "--views-between",
        type=int,
        default=0,
        metavar="N",
        help="besides, use N more views, halfway between neighbouring ones: for pictures from "
        "where no camera stood (default 0)",
    )


def _add_scoring(parser: argparse.ArgumentParser) -> None:
    _add_cameras(parser)
    parser.add_argument(
        "--method",
        choices=METHODS,
        default=Merge.name,
        help="from instant to best: closed-form takes nothing as hidden, occlusion knows what "
        "hides what; both delete, and the other rows stay as they were. merge (the default) merges "
        "what goes into what stays, or deletes where that is as good; refit then fits what stays "
        "to what all splats look like, some dB better in several times the time",
    )
    parser.add_argument(
        "--rounds",
        type=int,
        metavar="N",
        help="with --method refit: fit up to N times, each time to other rays (default: 2 to 4 "
        "times, fewer of more splats; more rounds bring up to 1 dB, and take longer)",
    )
    _add_views(parser)


def _add_model(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--model",
        choices=MODELS,
        help="how the splats are drawn, where a file does not say or is wrong: default, "
        "antialiased (Mip-Splatting, gsplat, Brush's mip) or 2dgs (discs)",
    )


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--report", type=_path, metavar="FILE.json", help="write a report as JSON")
    parser.add_argument("--overwrite", action="store_true", help="replace files that exist")
    parser.add_argument("--quiet", action="store_true", help="print errors only")


def _numbers(text: str) -> tuple[float, ...]:
    """Return numbers between commas."""
    try:
        return tuple(float(word) for word in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"expected numbers with commas between them, got {text!r}"
        ) from error


def _numbered(text: str, count: int) -> tuple[int | None, tuple[float, ...]]:
    """Return the number of an input, None for all, and so many numbers."""
    first, colon, rest = text.rpartition(":")
    numbers = _numbers(rest)
    if len(numbers) != count or (colon and not (first.isdecimal() and int(first))):
        raise argparse.ArgumentTypeError(
            f"expected {count} numbers with commas between them, or N: and these, got {text!r}"
        )
    return int(first) if colon else None, numbers


def _words(text: str) -> tuple[str, ...]:
    """Return words between commas."""
    return tuple(word.strip() for word in text.split(","))


def _name(text: str) -> str:
    """Return what is there; a variable that a script did not set is a mistake, not a default."""
    if not text:
        raise argparse.ArgumentTypeError("expected a name, got none")
    return text


def _source(text: str) -> tuple[str, str]:
    """Return the kind of source as the panel names it, and the name of a collection or ""."""
    kind, colon, name = text.partition(":")
    if (f"{kind}:NAME" if colon else kind) not in SOURCES or (colon and not name):
        raise argparse.ArgumentTypeError(f"expected one of {', '.join(SOURCES)}, got {text!r}")
    return kind.upper(), name


def _frames(text: str) -> range:
    """Return the frames between colons, both ends included."""
    numbers = text.split(":")
    try:
        first, last, step = map(int, numbers if numbers[2:] else [*numbers, "1"])
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"expected A:B:STEP or A:B in whole numbers, got {text!r}"
        ) from error
    if step < 1 or max(abs(first), abs(last)) > LAST_FRAME:
        raise argparse.ArgumentTypeError(
            f"expected A:B:STEP with frames from {-LAST_FRAME} to {LAST_FRAME} and a step of at "
            f"least 1, got {text!r}"
        )
    if last < first:
        raise argparse.ArgumentTypeError(
            f"expected at least one frame, got {text!r}, which starts after it ends"
        )
    return range(first, last + 1, step)


def _given(text: str) -> Path:
    """Return the path of what is read, as it was given."""
    if "\0" in text:
        raise argparse.ArgumentTypeError("a path holds no zero byte")
    try:
        refuse_url(text)
    except RefineError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return Path(_name(text))


def _tile(text: str) -> Path | Url:
    """Return a URL, or what `_given` does."""
    return Url(text) if is_url(text) else _given(text)


def _folder(text: str) -> Path | Url:
    """Return a URL, or what `_path` does."""
    return Url(text) if is_url(text) else _path(text)


def _path(text: str) -> Path:
    """Return the path of what is written, the home folder spelt out."""
    if text == "-":
        raise argparse.ArgumentTypeError(
            "nothing is written to standard output: give the name of a file (./- is one, too)"
        )
    try:
        return expanded(_given(text))
    except RefineError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def method(options: argparse.Namespace) -> Method:
    """The method with its settings; raises `RefineError` where a value cannot be."""
    kind, rounds = METHODS[options.method], options.rounds
    if kind is Refit:
        return Refit(most_views(options), rounds)
    if rounds is not None:
        raise RefineError(f"rounds is {rounds}, expected only with --method refit")
    return kind(most_views(options))


def most_views(options: argparse.Namespace) -> int:
    """Return how many views may be used, with those in between; 0 for all.

    Raise `RefineError` where their number cannot be.
    """
    if options.views_between < 0:
        raise RefineError(f"--views-between is {options.views_between}, expected 0 or more")
    return options.views + options.views_between if options.views > 0 else options.views


def cleaning(options: argparse.Namespace) -> Cleaning:
    """Return what to clean away, or raise `RefineError` where a value cannot be."""
    return Cleaning(getattr(options, "reasons", Cleaning.reasons), most_views(options))


def levels(options: argparse.Namespace) -> Levels:
    """Return which levels to make, or raise `RefineError` where a value cannot be."""
    shares = () if options.psnr else options.levels or DEFAULT_LEVELS
    return Levels(shares, options.psnr)


def arrangement(options: argparse.Namespace) -> dict[str, Any]:
    """What becomes of splats besides their format; raises `RefineError` where none can."""
    asked: list[dict[str, Any]] = [{} for _ in options.inputs]
    for name in ("translate", "rotate", "scale"):
        # Those of all inputs first, so that an input's own takes their place.
        for number, values in sorted(getattr(options, name), key=lambda item: item[0] or 0):
            if number is not None and number > len(asked):
                raise RefineError(f"--{name} {number}: there are {len(asked)} inputs")
            for move in asked if number is None else [asked[number - 1]]:
                move[name] = values if len(values) > 1 else values[0]
    moves = tuple(Move(**move) for move in asked)
    moved = moves if any(move != Move() for move in moves) else ()
    return {
        "moves": moved, "degree": options.degree, "morton": options.morton, "level": options.level
    }  # fmt: skip


def budget(options: argparse.Namespace) -> Budget:
    """Return how much goes, or raise `RefineError` where a value cannot be."""
    names = ("ratio", "keep", "max_mb", "threshold", "min_seen", "psnr")
    amounts = {name: getattr(options, name) for name in names}
    amounts = {name: amount for name, amount in amounts.items() if amount is not None}
    return Budget(**(amounts or {"ratio": DEFAULT_RATIO}))
