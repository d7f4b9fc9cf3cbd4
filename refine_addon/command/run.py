"""What all subcommands do alike: go from input to input, say and note what came of each."""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..core import RefineError, ViewSet, read_cameras, with_views_between
from ..core.errors import printable
from ..core.execute import Progress, TimeLeft, in_time
from ..core.report import MANY_UNSEEN
from ..core.whole_file import Url, new_folder
from . import report
from .terminal import Terminal, complain, described
from .zones import words


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
        each = [_size(path) for path in options.inputs]
        together = getattr(options, "together", False)
        self._sizes = [max(size, 1) for size in ([sum(each)] if together else each or [0])]
        self._begun = 0
        self._left = TimeLeft()
        self._cameras: dict[str, Any] = {}

    def views(self) -> ViewSet:
        """Return the views that decide, and note where they are from for the report."""
        path = self.options.cameras
        if path is not None:
            views, facts = read_cameras(path), {"source": "file", "file": str(path)}
        else:
            from . import scene_cameras

            views, facts = scene_cameras.chosen(self.options)
        self._cameras = {"cameras": facts}
        more = self.options.views_between
        return with_views_between(views.spread(self.options.views), more) if more else views

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
            return "" if seconds is None else f"about {in_time(seconds)} left{several}"

        return self.terminal.progress(self.named(name), left)

    def say_what_decided(self, done: dict[str, Any], cleaned: int = 0) -> None:
        """Say what the report of an input tells of what decided.

        That is which cameras of the scene, since those of a file were named by the user; what had
        to stay and go; and how many of the splats that were scored no view holds.
        """
        if cameras := self._cameras["cameras"].get("words"):
            self.terminal.say(f"  cameras: {cameras}")
        if demanded := words(done):
            self.terminal.say(f"  {demanded}")
        splats = done["splats"]
        if splats["unseen"]:
            scored = splats["before"] - splats["removed_by_user"] - cleaned
            self.terminal.say(f"  {splats['unseen']:,} of {scored:,} splats lie in no view")
            if splats.get("unseen_removed", 0) and splats["unseen"] >= MANY_UNSEEN * scored:
                share = splats["unseen_removed"] / splats["unseen"]
                self.terminal.say(f"  {share:.0%} of these go: add views if others can see them")

    def each(self, work: Callable[[Run, Path, Path | None, ViewSet], dict[str, Any]]) -> None:
        """Do the work of every input: with its output, if there is to be one, and the views."""
        options, views = self.options, self.views()
        folder = None if getattr(options, "dry_run", False) else options.output_dir
        with new_folder(folder) if folder else contextlib.nullcontext():
            for source in options.inputs:
                output = options.output
                if options.output_dir:
                    output = options.output_dir / source.name
                self.attempt(
                    str(source),
                    lambda source=source, output=output: work(self, source, output, views),
                )

    def attempt(self, label: str, work: Callable[[], dict[str, Any]]) -> None:
        """Do one input's work; note its error, so that the others go on."""
        if not self._begun:
            self._left = TimeLeft()
        self._begun += 1
        try:
            self.entries.append({"status": "done", **work(), **self._cameras})
        except (RefineError, OSError, MemoryError) as error:
            self.failed = True
            message = str(error) if isinstance(error, RefineError) else described(error)
            # What is wrong with the splats is said without the file.
            files = (Path(label), getattr(self.options, "output", None))
            if not any(file and printable(file.name) in message for file in files):
                message = f"{label}: {message}"
            self.entries.append({"status": "failed", "input": label, "error": message})
            complain(message)

    def finish(self) -> None:
        """Write the report, where one is wanted."""
        options = self.options
        if options.report is None:
            return
        writes = options.command != "info" and not getattr(options, "dry_run", False)
        if options.command == "clean":
            writes = bool(options.output or options.output_dir)
        report.write(
            options.report,
            self.entries,
            time.perf_counter() - self._started,
            overwrite=options.overwrite,
            splats=writes and any(entry["status"] == "done" for entry in self.entries),
        )


def _size(path: Path | Url) -> int:
    """Return the bytes of a file, 0 where reading it will fail anyway, or a URL is not asked."""
    if isinstance(path, Url):
        return 0
    try:
        return path.stat().st_size
    except (OSError, ValueError):
        return 0
