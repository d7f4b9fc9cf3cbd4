"""What all subcommands share: a loop over the inputs that prints and records each result.
Control characters are printed escaped; the report is JSON, for programs."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TextIO

import numpy as np

from ..core import RefineError, ViewSet, read_cameras
from ..core.errors import described, printable, reason_of
from ..core.execute import Progress, TimeLeft, in_time
from ..core.formats.registry import names_file
from ..core.report import MANY_UNSEEN
from ..core.whole_file import new_folder, whole_file
from ..version import VERSION

_CLEAR = "\r\x1b[K"


def complain(text: str) -> None:
    """Print an error in place of the progress line."""
    start = _CLEAR if _is_terminal(sys.stderr) else ""
    write("stderr", f"{start}refine: error: {printable(text)}\n")


class Run:
    """One call of the command: its options, its output, and a report entry for each input."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self._failed = False  # some output could not be written
        self._draws = not options.quiet and _is_terminal(sys.stderr)
        self.entries: list[dict[str, Any]] = []
        self._started = time.perf_counter()
        files = options.inputs or [""]
        sizes = [os.path.getsize(file) if os.path.isfile(file) else 0 for file in files]
        self._sizes = [max(size, 1) for size in ([sum(sizes)] if options.together else sizes)]
        self._views: ViewSet | None = None
        self._cameras: dict[str, Any] = {}

    def views(self) -> ViewSet:
        """Views of the deciding cameras, read once; their source goes into the report."""
        path = self.options.cameras
        if self._views is None and path is not None:
            self._views, self._cameras = read_cameras(path), {"source": "file", "file": str(path)}
        elif self._views is None:
            from . import scene

            self._views, self._cameras = scene.views(self.options)
        return self._views

    def print(self, *lines: str) -> None:
        """Print lines, unless quiet."""
        if not self.options.quiet:
            self._failed |= write("stdout", "".join(f"{printable(line)}\n" for line in lines))

    def _draw(self, text: str) -> None:
        """Show a line that the next one replaces; on terminals only."""
        if self._draws:
            write("stderr", f"{_CLEAR}{printable(text)}")

    def progress(self, name: str) -> Progress:
        """Progress callback that draws the share done of an input, and the time left."""
        done, sizes = len(self.entries), self._sizes
        before, total, several = sum(sizes[:done]), sum(sizes), " in all" if sizes[1:] else ""

        def draw(fraction: float, what: str) -> None:
            seconds = self._left.seconds((before + fraction * sizes[done]) / total)
            left = "" if seconds is None else f", about {in_time(seconds)} left{several}"
            self._draw(f"{self._named(name)}: {what} {fraction:4.0%}{left}")

        return draw

    def say(self, label: str, line: str, report: dict[str, Any], *more: str) -> dict[str, Any]:
        """Print the summary `line` of an input, then cameras of the scene, protected and removed
        splats, splats in no view, `more`, and the report's notes; the report."""
        splats, output = report["splats"], report["files"]["output"]
        cameras = self._cameras.get("words")  # none of --cameras, which the user typed
        lines = [f"cameras: {cameras}" if cameras else "", _demands(report)]
        if unseen := splats.get("unseen"):
            cleaned = report["cleaned"].values() if {"budget", "cleaned"} <= report.keys() else ()
            scored = splats["before"] - splats["removed_by_user"]
            scored -= sum(count for count in cleaned if isinstance(count, int))
            lines.append(f"{unseen:,} of {scored:,} splats lie in no view")
            if (gone := splats.get("unseen_removed")) and unseen >= MANY_UNSEEN * scored:
                lines.append(f"{gone / unseen:.0%} of these go: add views if others can see them")
        self._draw("")
        first = f"{self._named(label)}: {line}{f' -> {output}' if output else ''}"
        rest = filter(None, [*lines, *more, *(f"note: {note}" for note in report["notes"])])
        self.print(first, *(f"  {text}" for text in rest))
        return report

    def each(self, work: Callable[..., dict[str, Any]]) -> None:
        """Do the work of the object or of each input, with its output path or None."""
        options, output = self.options, self.options.output
        inside = output is not None and options.command != "lod" and not names_file(output)
        if options.inputs and options.command != "info":
            self.views()  # without cameras no input can be done
        with new_folder(output) if inside and not options.dry_run else contextlib.nullcontext():
            for source in options.inputs or [options.object]:
                self.attempt(work, source, output / source.name if inside else output)

    def attempt(self, work: Callable[..., dict[str, Any]], source: Any, *output: Any) -> None:
        """Do one input's work and record its result or error; the others go on."""
        label = str(source)
        if not self.entries:
            self._left = TimeLeft()
        try:
            entry = {"status": "done", **work(self, source, *output)}
            self.entries.append(entry | ({"cameras": self._cameras} if self._cameras else {}))
        except (RefineError, OSError, MemoryError) as error:
            message = described(error)
            # Errors about the splats do not name the file.
            files = (Path(label), self.options.output)
            if not any(file and printable(file.name) in message for file in files):
                message = f"{label}: {message}"
            self.entries.append({"status": "failed", "input": label, "error": message})
            complain(message)

    def finish(self) -> bool:
        """Write the report if wanted; whether an input or the output failed."""
        done = [entry for entry in self.entries if entry["status"] == "done"]
        if self.options.report is not None:
            self._write_report(done)
        return len(done) < len(self.entries) or self._failed

    def _write_report(self, done: list[dict[str, Any]]) -> None:
        """Write the report of all results; the error, if any, says whether splats were written."""
        options, path = self.options, self.options.report
        content = {
            "refine": VERSION,  # first: `checks` recognizes a report by it
            "python": sys.version.split()[0],
            "numpy": np.__version__,
            "seconds": time.perf_counter() - self._started,
            "results": self.entries,
        }
        try:
            with whole_file(path, overwrite=options.overwrite) as stream:
                stream.write(json.dumps(content, indent=2, allow_nan=False).encode() + b"\n")
        except RefineError as error:
            # `whole_file` says that nothing was written, which is true of its own file alone.
            cause = error.__cause__
            why = reason_of(cause if isinstance(cause, OSError) else error)
            wrote = any(options.save or entry.get("files", {}).get("output") for entry in done)
            splats = "; the splats were" if wrote and not options.dry_run else ""
            problem = f"the report was not written ({why.removeprefix(f'{path}: ')})"
            raise RefineError(f"{path}: {problem}{splats}") from error

    def _named(self, name: str) -> str:
        count = len(self._sizes)
        return name if count == 1 else f"file {len(self.entries) + 1} of {count}, {name}"


def _demands(report):
    """Protected and removed splats in one line, "" if there are none."""
    counts = {"protected": "protected", "removed_by_user": "removed by you"}
    splats = report["splats"]
    parts = [f"{splats[key]:,} {what}" for key, what in counts.items() if splats.get(key)]
    volumes = "; ".join(
        f"{volume['role']} {volume['name'].removeprefix('object ')}: {volume['splats']:,}"
        for volume in report.get("volumes", ())
    )
    return " ".join([", ".join(parts), f"({volumes})" if volumes else ""]).strip()


def _is_terminal(stream: TextIO | None) -> bool:
    return stream is not None and stream.isatty()


def write(name: Literal["stdout", "stderr"], text: str) -> bool:
    """Write text; whether standard output failed. A reader that has left is no failure."""
    stream: TextIO | None = getattr(sys, name)
    if stream is None:  # closed before Python began
        return False
    try:
        stream.write(text)
        stream.flush()
    except UnicodeEncodeError:  # a name that this terminal's encoding cannot show
        return write(name, text.encode("ascii", "backslashreplace").decode())
    except OSError as error:
        # The work goes on. Python would flush again at exit and set an exit code of its own.
        setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        if name == "stdout" and not isinstance(error, BrokenPipeError):
            complain(f"standard output: {reason_of(error)}")
            return True
    return False
