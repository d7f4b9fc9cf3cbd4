"""Whole commands on scenes that look like captures, beside splat-transform, and what changed.

    python -m benchmarks.speed.whole [--quick] [--write]

160,000, 1 million and 2.2 million splats of degree 3, 160,000 and 2.2 million of degree 0
(`capture`); with ``--quick`` 160,000 alone, minutes of the processor. Each command is a process of
its own and runs once, from file to file, one after the other: every method, merging to half and a
tenth, and splat-transform to the same numbers; refitting where it takes minutes, not tens of them.
Told are seconds of the processor and the most memory (RssAnon) of the whole tree of processes, both
over splat-transform's, and by how much they differ from the committed figures, `figures.json`,
which ``--write`` replaces. Seconds of another machine are compared by what copying and decimating
take there, so look at ratios first.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from ..baselines import splat_transform
from ..tables.million import write_cameras, write_ply
from . import capture

QUICK = 160_000
SCENES = ((QUICK, 3), (QUICK, 0), (1_000_000, 3), (2_200_000, 3), (2_200_000, 0))
"""Numbers of splats, and degrees of their harmonics: splat-transform takes longer with more."""

FIGURES = Path(__file__).parent / "figures.json"
REFITTED = 200_000
"""Scenes of at most so many splats are refitted, too."""

CHANGED, LEAST = 0.1, 0.1
"""A figure that differs by more than this share, and this many seconds or MB, is marked."""


class Figure(NamedTuple):
    """What a command took: seconds of the processor, and most memory, megabytes."""

    busy: float
    megabytes: float


def commands(folder: Path, count: int) -> Mapping[str, Sequence[str | Path]]:
    """Return all commands by name, from ``in.ply`` in a folder to ``out.ply`` there."""
    source, output = folder / "in.ply", folder / "out.ply"
    ours: list[str | Path] = [sys.executable, "-m", "refine_addon", "prune", source, "-o", output]
    ours += ["--cameras", folder / "cameras.json", "--quiet", "--overwrite"]
    half = [*ours, "--ratio", "0.5", "--method"]
    found: dict[str, Sequence[str | Path]] = {"copy": ["cp", source, output]}
    found |= {name: [*half, name] for name in ("closed-form", "occlusion")}
    for ratio in (0.5, 0.9):
        name = f"merge {ratio:.0%}"
        found[name] = [*ours, "--ratio", str(ratio), "--method", "merge"]
        if splat_transform.find() is not None:
            left = count - round(ratio * count)
            flag = splat_transform.FLAGS[0]
            name = f"splat-transform {ratio:.0%}"
            found[name] = splat_transform.command(source, output, flag, left)
    if count <= REFITTED:
        # At 50 % deletion leaves these scenes as good, and nothing is refitted.
        found["refit 90%"] = [*ours, "--ratio", "0.9", "--method", "refit"]
    return found


def measured(count: int, degree: int) -> dict[str, Figure]:
    """Return the figures of all commands on a scene of so many splats, by name."""
    figures = {}
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        write_ply(folder / "in.ply", capture.make(count, degree))
        write_cameras(folder / "cameras.json", capture.cameras())
        for name, command in commands(folder, count).items():
            _, busy, megabytes = splat_transform.measured(command)
            figures[name] = Figure(round(busy, 2), round(megabytes))
            print(
                f"{count:,} of degree {degree}, {name}: {busy:.1f} s, {megabytes:.0f} MB",
                flush=True,
            )
            (folder / "out.ply").unlink()
    return figures


def table(figures: Mapping[str, Figure], before: Mapping[str, Sequence[float]]) -> list[str]:
    """Return the lines of a table: figures, over splat-transform's, and against those before."""
    lines = ["| | processor | memory | over splat-transform | since the committed figures |"]
    lines.append("|---|---:|---:|---:|---|")
    for name, figure in figures.items():
        other = figures.get(f"splat-transform {name[-3:] if '%' in name else '50%'}")
        over = ""
        if other is not None and "splat" not in name and name != "copy":
            over = " / ".join(f"{a / max(b, 1e-9):.2f}" for a, b in zip(figure, other, strict=True))
        changes = []
        for now, then, what in zip(figure, before.get(name, figure), Figure._fields, strict=True):
            if abs(now - then) > max(CHANGED * then, LEAST):
                changes.append(f"{what} {now / max(then, LEAST) - 1.0:+.0%}")
        known = ", ".join(changes) or ("as before" if name in before else "new")
        lines.append(
            f"| {name} | {figure.busy:.1f} s | {figure.megabytes:.0f} MB | {over} | {known} |"
        )
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print tables, and write the figures if asked."""
    parser = argparse.ArgumentParser(description="Time every method beside splat-transform.")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK:,} splats alone")
    parser.add_argument("--write", action="store_true", help="keep the figures as those to compare")
    options = parser.parse_args(arguments)
    known = json.loads(FIGURES.read_text()) if FIGURES.exists() else {}
    if splat_transform.find() is None:
        print(splat_transform.MISSING)
    for count, degree in SCENES[:2] if options.quick else SCENES:
        figures, scene = measured(count, degree), f"{count} of degree {degree}"
        lines = table(figures, known.get(scene, {}))
        print(f"\n{scene}\n", *lines, sep="\n", flush=True)
        known[scene] = figures
    if options.write:
        rows = (f'"{scene}": {json.dumps(figures)}' for scene, figures in known.items())
        FIGURES.write_text("{\n" + ",\n".join(rows) + "\n}\n")


if __name__ == "__main__":
    main()
