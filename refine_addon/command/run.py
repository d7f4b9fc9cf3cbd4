"""What all subcommands do alike: go from input to input, say and note what came of each."""

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
    """What one call of the command did so far.

    Parameters
    ----------
    options : argparse.Namespace

    Attributes
    ----------
    options : argparse.Namespace
    terminal : Terminal
    entries : list of dict
        Of the report, one an input.
    failed : bool
        Whether an input failed.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.terminal = Terminal(quiet=options.quiet)
        self.entries: list[dict[str, Any]] = []
        self.failed = False
        self._started = time.perf_counter()
        sizes = [_size(path) for path in options.inputs] or [0]
        self._sizes = [max(size, 1) for size in ([sum(sizes)] if options.together else sizes)]
        self._begun = 0
        self._left = TimeLeft()
        self._cameras: dict[str, Any] = {}

    def views(self) -> ViewSet:
        """Return the views that decide, and note where they are from for the report."""
        path = self.options.cameras
        if path is not None:
            views, facts = read_cameras(path), {"source": "file", "file": str(path)}
        else:
            from . import scene

            views, facts = scene.views(self.options)
        self._cameras = {"cameras": facts}
        return views

    def reading(self, name: str) -> dict[str, Any]:
        """What all that is done with a file is told."""
        options = self.options
        return {
            "zones": zones.of_files(options), "model": options.model,
            "overwrite": options.overwrite, "progress": self.progress(name),
        }  # fmt: skip

    def named(self, name: str) -> str:
        """The name of the file under way, with its place among several."""
        count = len(self._sizes)
        return name if count == 1 else f"file {self._begun} of {count}, {name}"

    def progress(self, name: str) -> Progress:
        """Return what draws how much of the file under way is done, and the time left."""
        before, current = sum(self._sizes[: self._begun - 1]), self._sizes[self._begun - 1]
        total, several = sum(self._sizes), " in all" if len(self._sizes) > 1 else ""

        def left(fraction: float) -> str:
            seconds = self._left.seconds((before + fraction * current) / total)
            return "" if seconds is None else f", about {in_time(seconds)} left{several}"

        return self.terminal.progress(self.named(name), left)

    def say(self, done: dict[str, Any], line: str, *more: str, cleaned: int = 0) -> dict[str, Any]:
        """Say what was done, then what decided, then more and the notes; return the report.

        What decided is which cameras of the scene, since those of a file were named by the user;
        what had to stay and go; and how many of the splats that were scored no view holds.
        """
        splats, lines = done["splats"], [zones.words(done)]
        if words := self._cameras.get("cameras", {}).get("words"):
            lines.insert(0, f"cameras: {words}")
        if unseen := splats.get("unseen"):
            scored = splats["before"] - splats["removed_by_user"] - cleaned
            lines.append(f"{unseen:,} of {scored:,} splats lie in no view")
            if splats.get("unseen_removed", 0) and unseen >= MANY_UNSEEN * scored:
                share = splats["unseen_removed"] / unseen
                lines.append(f"{share:.0%} of these go: add views if others can see them")
        self.terminal.clear()
        self.terminal.say(line)
        for text in filter(None, [*lines, *more, *(f"note: {note}" for note in done["notes"])]):
            self.terminal.say(f"  {text}")
        return done

    def each(self, work: Callable[[Run, Path, Path | None, ViewSet], dict[str, Any]]) -> None:
        """Do the work of every input: with its output, if there is to be one, and the views."""
        views, output = self.views(), self.options.output
        folder = None if output is None or names_file(output) else output
        makes = folder and not self.options.dry_run
        with new_folder(folder) if makes else contextlib.nullcontext():
            for source in self.options.inputs:
                made = folder / source.name if folder else output
                self.attempt(str(source), work, source, made, views)

    def attempt(self, label: str, work: Callable[..., dict[str, Any]], *arguments: Any) -> None:
        """Do one input's work; note its error, so that the others go on."""
        if not self._begun:
            self._left = TimeLeft()
        self._begun += 1
        try:
            self.entries.append({"status": "done", **work(self, *arguments), **self._cameras})
        except (RefineError, OSError, MemoryError) as error:
            self.failed = True
            message = described(error)
            # What is wrong with the splats is said without the file.
            files = (Path(label), self.options.output)
            if not any(file and printable(file.name) in message for file in files):
                message = f"{label}: {message}"
            self.entries.append({"status": "failed", "input": label, "error": message})
            complain(message)

    def finish(self) -> None:
        """Write the report, where one is wanted."""
        options, seconds = self.options, time.perf_counter() - self._started
        if options.report is None:
            return
        done = [entry for entry in self.entries if entry["status"] == "done"]
        splats = any(entry.get("files", {}).get("output") for entry in done)
        splats |= bool(options.save and done and not options.dry_run)
        report.write(
            options.report, self.entries, seconds, overwrite=options.overwrite, splats=splats
        )


def _size(path: os.PathLike[str] | str) -> int:
    """Bytes of a file, 0 where reading it will fail anyway; a URL is not asked."""
    with contextlib.suppress(OSError, ValueError):
        return os.path.getsize(path)
    return 0
