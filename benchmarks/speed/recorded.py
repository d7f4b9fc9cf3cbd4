"""Records how a prune goes by: its phases, what they count, and when each was how far.

    python -m benchmarks.speed.recorded SCENE_DIR --survivors absorb --ratio 0.9 [--record FILE]

Tells what each kind of work took beside what `core/costs.py` expects of it, and the time left that
was told beside what was left. ``--record`` adds the run to a file that `tests/core/test_pace.py`
replays. Seconds are those of the processor, and one thread does everything, so that other work on
the machine does not matter; with ``--threads`` seconds are those of the clock.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from refine_addon.core import Budget, pace, prune_file, prune_tiles, read_cameras, read_ply
from refine_addon.core.costs import Cost, Plan
from refine_addon.core.formats.ply import with_count
from refine_addon.core.levels.files import LevelsRequest, lod_file
from refine_addon.core.levels.lod import Levels
from refine_addon.core.operation.requests import PruneRequest
from refine_addon.core.survivor_choice import SURVIVORS
from refine_addon.core.task import METHODS, Settings

EVENTS = 150
"""So many reports of a run are kept, evenly spread; all are told to the run."""


class Recorder:
    """Notes what a run tells `pace`.

    Parameters
    ----------
    clock : callable
        Returns seconds.

    Attributes
    ----------
    events : list
        ``[seconds, phase, plans]`` where a phase is divided, ``[seconds, phase, fraction]`` where
        it says how much of it is done. Phases are numbered as they are made; 0 is the whole run.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self.events: list[list[Any]] = []
        self._clock = clock
        self.begin()
        self._numbers: dict[int, int] = {}
        self._kept: list[pace.Phase] = []  # so that no number is given twice

    def begin(self) -> None:
        """Begin to count the seconds of the run."""
        self._start = self._clock()

    def seconds(self) -> float:
        """Return how long the run has been going on."""
        return round(self._clock() - self._start, 3)

    def watch(self) -> None:
        """Note what all phases are told from now on."""
        divide, tell = pace.Phase.divided, pace.Phase.__call__

        def divided(phase: pace.Phase, plans: Iterable[Plan]) -> list[pace.Phase]:
            plans = list(plans)
            counts = [[[kind, int(size), views] for kind, size, views in plan] for plan in plans]
            self.events.append([self.seconds(), self._number(phase), counts])
            made = divide(phase, plans)
            for each in made:
                self._number(each)
            return made

        def told(phase: pace.Phase, fraction: float, what: str) -> bool | None:
            self.events.append([self.seconds(), self._number(phase), round(fraction, 4)])
            return tell(phase, fraction, what)

        pace.Phase.divided, pace.Phase.__call__ = divided, told  # type: ignore[method-assign]

    def thinned(self) -> list[list[Any]]:
        """Return the events, with fewer reports."""
        reports = [event for event in self.events if not isinstance(event[2], list)]
        last = self.events[-1][0]
        kept, due = [], 0.0
        for event in self.events:
            of_phase = event is not self.events[0] and kept and event[1] != kept[-1][1]
            if isinstance(event[2], list) or of_phase or event[0] >= due:
                kept.append(event)
                due = event[0] + last / min(EVENTS, len(reports))
        return kept

    def _number(self, phase: pace.Phase) -> int:
        self._kept.append(phase)
        return self._numbers.setdefault(id(phase), len(self._numbers))


def cut(source: Path, folder: Path, count: int) -> list[Path]:
    """Write the splats of a file as so many tiles; return their paths."""
    file, tiles = read_ply(source), []
    for number, rows in enumerate(np.array_split(np.arange(len(file)), count)):
        tiles.append(folder / f"tile{number}.ply")
        with tiles[-1].open("wb") as stream:
            stream.write(with_count(file.header, len(rows)))
            stream.write(file.rows[rows[0] : rows[-1] + 1].tobytes())
    return tiles


def prune_options(description: str) -> argparse.ArgumentParser:
    """Return a parser of which scene is pruned, and how."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("scene", type=Path, help="folder of point_cloud.ply and cameras.json")
    parser.add_argument("--method", choices=METHODS, default=METHODS[0])
    parser.add_argument("--survivors", choices=SURVIVORS, default="unchanged")
    parser.add_argument("--ratio", type=float, default=0.5)
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Record a run, and print what it took."""
    parser = prune_options("Record how a prune goes by.")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--tiles", type=int, help="cut it into so many tiles of one scene")
    parser.add_argument(
        "--levels",
        type=float,
        nargs="+",
        help="make levels of these shares (taskset -c 0 has that done by one thread)",
    )
    parser.add_argument("--record", type=Path, help="file of runs to add this one to")
    options = parser.parse_args(arguments)
    clock = time.process_time if options.threads == 1 else time.perf_counter
    pace.phases.__kwdefaults__["clock"] = clock
    told = []
    recorder = Recorder(clock)
    recorder.watch()
    views, source = read_cameras(options.scene / "cameras.json"), options.scene / "point_cloud.ply"
    settings = Settings(method=options.method)
    with tempfile.TemporaryDirectory() as made:
        request = PruneRequest(
            views, Budget(ratio=options.ratio), settings, survivors=options.survivors
        )
        files = [source] if options.tiles is None else cut(source, Path(made), options.tiles)
        recorder.begin()

        def progress(fraction: float, what: str) -> None:
            told.append((recorder.seconds(), fraction, what))

        if options.levels:
            levels = Levels(tuple(options.levels), survivors=options.survivors)
            asked = LevelsRequest(views, levels, settings)
            report = lod_file(source, Path(made) / "levels", asked, progress=progress)
            splats = report["splats"]["before"]
        elif options.tiles is None:
            result = prune_file(
                source, Path(made) / "out.ply", request,
                progress=progress, threads=options.threads,
            )  # fmt: skip
            splats = result.report["splats"]["before"]
        else:
            report = prune_tiles(
                files, Path(made) / "out", request, progress=progress, threads=options.threads
            )
            splats = report["splats"]["before"]
    total = recorder.seconds()
    name = f"{options.scene.name}, {splats:,} splats, {options.method}, {options.survivors}"
    name += " over tiles" if options.tiles else " in levels" if options.levels else ""
    print(f"{name}, {options.ratio:.0%}: {total:.1f} s")
    _tell_kinds(recorder.events, total, options.threads)
    for part in range(1, 20):
        seconds, fraction, what = min(told, key=lambda each: abs(each[0] - total * part / 20))
        left = seconds * (1.0 - fraction) / max(fraction, 1e-9)
        print(
            f"  {seconds:7.1f} s {fraction:4.0%}: {left:7.1f} s told, "
            f"{total - seconds:7.1f} true, {what}"
        )
    if options.record is not None:
        runs = json.loads(options.record.read_text()) if options.record.exists() else {}
        runs[f"{name}, {options.ratio:g}, {options.threads}"] = {
            "threads": options.threads, "seconds": total, "events": recorder.thinned()
        }  # fmt: skip
        lines = ",\n".join(
            f"{json.dumps(key)}: {json.dumps(run, separators=(',', ':'))}"
            for key, run in sorted(runs.items())
        )
        options.record.write_text(f"{{\n{lines}\n}}\n")


def _tell_kinds(events: Sequence[Sequence[Any]], total: float, threads: int) -> None:
    """Print what each kind of work took, and what was expected."""
    plans: dict[int, Plan] = {}
    spent: dict[str, float] = defaultdict(float)
    expected: dict[str, float] = defaultdict(float)
    reached, now, before, made = set(), 0, 0.0, 1
    for seconds, phase, what in [*events, [total, -1, 1.0]]:
        kinds = plans.get(now, [])
        names = "+".join(sorted({kind for kind, _, _ in kinds})) or "-"
        spent[names] += seconds - before
        if now not in reached:
            reached.add(now)
            expected[names] += sum(Cost(*each).seconds(threads) for each in kinds)
        before = seconds
        if isinstance(what, list):
            for plan in what:
                plans[made], made = plan, made + 1
        else:
            now = phase
    for kind, seconds in spent.items():
        print(f"  {kind:40} {seconds:7.2f} s, expected {expected[kind]:7.2f}")


if __name__ == "__main__":
    main()
