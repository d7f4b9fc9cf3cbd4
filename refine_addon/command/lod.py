"""What ``lod`` does, and what it says of the levels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..core.estimate.quality import in_words
from ..core.levels.files import LevelsRequest, lod_file
from ..core.report import size_in_words
from .options import levels, settings
from .words import by, left_unseen
from .zones import of_files, words

if TYPE_CHECKING:
    import argparse
    from pathlib import Path

    from ..core import ViewSet
    from ..core.work import Progress
    from .terminal import Terminal


def make_levels(
    options: argparse.Namespace,
    terminal: Terminal,
    source: Path,
    views: ViewSet,
    progress: Progress,
) -> dict[str, Any]:
    """Make the levels of a file and say what each costs; return the report."""
    request = LevelsRequest(
        views,
        levels(options),
        settings(options),
        zones=of_files(options),
        suffix=options.format,
        goal=options.distance_psnr,
        overwrite=options.overwrite,
    )
    done = lod_file(source, options.output_dir, request, progress=progress)
    terminal.clear()
    count, made = done["splats"]["before"], len(done["levels"])
    terminal.say(
        f"{source}: {made} level{'s' if made > 1 else ''} of {count:,} splats, "
        f"{by(done['views'])}, {done['timings']['total_s']:.2f} s -> {options.output_dir}"
    )
    if said := words(done):
        terminal.say(f"  {said}")
    if done["splats"]["unseen"]:
        scored = count - done["splats"]["forced"]
        terminal.say(f"  {left_unseen(done['splats']['unseen'], scored)}")
    for entry in done["levels"]:
        terminal.say(f"  {_in_words(entry, done['goal_psnr'])}")
    terminal.notes(done["notes"])
    return done


def _in_words(entry: dict[str, Any], goal: float) -> str:
    """Return what there is to know of a level, on one line."""
    parts = [f"{entry['splats']:,} splats", size_in_words(entry["bytes"])]
    if entry["psnr"] is not None:
        parts.append(in_words(entry["psnr"]))
    far = entry["distance_psnr"]
    if far is not None:
        parts.append(f"{goal:g} dB at a distance of {far:.3g} or more")
    parts.append(f"no change wider than a pixel at {entry['distance_pixel']:.3g} or more")
    return f"{entry['file']}: {', '.join(parts)}"
