"""The part common to all subcommands: go from input to input, print and record each result."""

from __future__ import annotations

import argparse
import contextlib
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..core import RefineError, ViewSet, read_cameras
from ..core.errors import printable
from ..core.execute import Progress, TimeLeft, in_time
from ..core.formats.registry import names_file
from ..core.report import MANY_UNSEEN
from ..core.whole_file import new_folder
from . import report, zones
from .terminal import Terminal, complain, described


class Run:
    """One call of the command: options, terminal, and the report's entries, one an input."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.terminal = Terminal(quiet=options.quiet)
        self.entries: list[dict[str, Any]] = []
        self._started = time.perf_counter()
        files = options.inputs or [""]
        sizes = [os.path.getsize(file) if os.path.isfile(file) else 0 for file in files]
        self._sizes = [max(size, 1) for size in ([sum(sizes)] if options.together else sizes)]
        self._left = TimeLeft()
        self._views: ViewSet | None = None
        self._cameras: dict[str, Any] = {}

    def views(self) -> ViewSet:
        """The deciding views; notes their source for the report."""
        path = self.options.cameras
        if self._views is None and path is not None:
            self._views, self._cameras = read_cameras(path), {"source": "file", "file": str(path)}
        elif self._views is None:
            from . import scene

            self._views, self._cameras = scene.views(self.options)
        return self._views

    def progress(self, name: str) -> Progress:
        """Progress callback that draws the share done of the current file, and the time left."""
        done, sizes = len(self.entries), self._sizes
        before, total, several = sum(sizes[:done]), sum(sizes), " in all" if sizes[1:] else ""

        def draw(fraction: float, what: str) -> None:
            seconds = self._left.seconds((before + fraction * sizes[done]) / total)
            left = "" if seconds is None else f", about {in_time(seconds)} left{several}"
            self.terminal.draw(f"{self._named(name)}: {what} {fraction:4.0%}{left}")

        return draw

    def say(self, label: str, line: str, done: dict[str, Any], *more: str) -> dict[str, Any]:
        """Print what was done, what decided, then more and the notes; the report.
        What decided: the scene's cameras (the user named a file's), protected and removed splats,
        and the number of scored splats that no view holds."""
        splats, words, output = done["splats"], self._cameras.get("words"), done["files"]["output"]
        lines = [f"cameras: {words}" if words else "", zones.words(done)]
        if unseen := splats.get("unseen"):
            cleaned = done["cleaned"].values() if "budget" in done and "cleaned" in done else ()
            scored = splats["before"] - splats["removed_by_user"]
            scored -= sum(count for count in cleaned if isinstance(count, int))
            lines.append(f"{unseen:,} of {scored:,} splats lie in no view")
            if (gone := splats.get("unseen_removed")) and unseen >= MANY_UNSEEN * scored:
                lines.append(f"{gone / unseen:.0%} of these go: add views if others can see them")
        self.terminal.clear()
        first = f"{self._named(label)}: {line}{f' -> {output}' if output else ''}"
        rest = filter(None, [*lines, *more, *(f"note: {note}" for note in done["notes"])])
        self.terminal.say(first, *(f"  {text}" for text in rest))
        return done

    def each(self, work: Callable[..., dict[str, Any]]) -> None:
        """Do the work of the object or of each input, with its output if one is wanted."""
        options, output = self.options, self.options.output
        inside = output is not None and options.command != "lod" and not names_file(output)
        if options.inputs and options.command != "info":
            self.views()  # without cameras no input can be done
        makes = inside and not options.dry_run
        with new_folder(output) if makes else contextlib.nullcontext():
            for source in options.inputs or [options.object]:
                self.attempt(work, source, output / source.name if inside else output)

    def attempt(self, work: Callable[..., dict[str, Any]], source: Any, *output: Any) -> None:
        """Do one input's work; record its error, so that the others go on."""
        label = str(source)
        if not self.entries:
            self._left = TimeLeft()
        try:
            entry = {"status": "done", **work(self, source, *output)}
            self.entries.append(entry | ({"cameras": self._cameras} if self._cameras else {}))
        except (RefineError, OSError, MemoryError) as error:
            message = described(error)
            # What is wrong with the splats is said without the file.
            files = (Path(label), self.options.output)
            if not any(file and printable(file.name) in message for file in files):
                message = f"{label}: {message}"
            self.entries.append({"status": "failed", "input": label, "error": message})
            complain(message)

    def finish(self) -> bool:
        """Write the report if wanted; whether an input failed."""
        options, seconds = self.options, time.perf_counter() - self._started
        done = [entry for entry in self.entries if entry["status"] == "done"]
        if options.report is not None:
            made = [entry for entry in done if options.save or entry.get("files", {}).get("output")]
            splats = bool(made) and not options.dry_run
            report.write(options.report, self.entries, seconds, options.overwrite, splats)
        return len(done) < len(self.entries)

    def _named(self, name: str) -> str:
        count = len(self._sizes)
        return name if count == 1 else f"file {len(self.entries) + 1} of {count}, {name}"
