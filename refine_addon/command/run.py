"""The part common to all subcommands: go from input to input, print and record each result.
Output cannot harm a terminal; the report says what was done, as JSON, for programs."""

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
from ..core.errors import printable, reason_of
from ..core.execute import Progress, TimeLeft, in_time
from ..core.formats.registry import names_file
from ..core.report import MANY_UNSEEN
from ..core.whole_file import new_folder, whole_file
from ..version import VERSION

_CLEAR = "\r\x1b[K"


def described(error: Exception) -> str:
    """An error's message; for those of the system with the file."""
    file = getattr(error, "filename", None)
    return f"{file}: {error.strerror}" if file else reason_of(error)


def complain(text: str) -> None:
    """Print an error in place of the progress."""
    start = _CLEAR if _is_terminal(sys.stderr) else ""
    _write("stderr", f"{start}refine: error: {printable(text)}\n")


def flush() -> bool:
    """Flush argparse's help; whether it could not be written."""
    return _write("stdout", "")


class Terminal:
    """Output of a run; `quiet`: errors only. `failed`: some of it could not be written."""

    def __init__(self, *, quiet: bool) -> None:
        self.failed = False
        self._quiet = quiet
        self._draws = not quiet and _is_terminal(sys.stderr)

    def say(self, *lines: str) -> None:
        """Print lines, unless quiet."""
        if not self._quiet:
            self.failed |= _write("stdout", "".join(f"{printable(line)}\n" for line in lines))

    def draw(self, text: str) -> None:
        """Show a line until the next replaces it; on terminals only."""
        if self._draws:
            _write("stderr", f"{_CLEAR}{printable(text)}")


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
        lines = [f"cameras: {words}" if words else "", _demands(done)]
        if unseen := splats.get("unseen"):
            cleaned = done["cleaned"].values() if "budget" in done and "cleaned" in done else ()
            scored = splats["before"] - splats["removed_by_user"]
            scored -= sum(count for count in cleaned if isinstance(count, int))
            lines.append(f"{unseen:,} of {scored:,} splats lie in no view")
            if (gone := splats.get("unseen_removed")) and unseen >= MANY_UNSEEN * scored:
                lines.append(f"{gone / unseen:.0%} of these go: add views if others can see them")
        self.terminal.draw("")
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
        """Write the report if wanted; whether an input or the output failed."""
        options, seconds = self.options, time.perf_counter() - self._started
        done = [entry for entry in self.entries if entry["status"] == "done"]
        if options.report is not None:
            made = [entry for entry in done if options.save or entry.get("files", {}).get("output")]
            splats = bool(made) and not options.dry_run
            _write_report(options.report, self.entries, seconds, options.overwrite, splats)
        return len(done) < len(self.entries) or self.terminal.failed

    def _named(self, name: str) -> str:
        count = len(self._sizes)
        return name if count == 1 else f"file {len(self.entries) + 1} of {count}, {name}"


def _demands(done):
    """The report's demands in one line, "" without."""
    counts = {"protected": "protected", "removed_by_user": "removed by you"}
    splats = done["splats"]
    parts = [f"{splats[key]:,} {what}" for key, what in counts.items() if splats.get(key)]
    volumes = "; ".join(
        f"{volume['role']} {volume['name'].removeprefix('object ')}: {volume['splats']:,}"
        for volume in done.get("volumes", ())
    )
    return " ".join([", ".join(parts), f"({volumes})" if volumes else ""]).strip()


def _write_report(path, results, seconds, overwrite, splats):
    """Write the report of all results; an error says whether `splats` were written."""
    content = {
        "refine": VERSION,  # first: by this a report is known, see `checks`
        "python": sys.version.split()[0],
        "numpy": np.__version__,
        "seconds": seconds,
        "results": results,
    }
    try:
        with whole_file(path, overwrite=overwrite) as stream:
            stream.write(json.dumps(content, indent=2, allow_nan=False).encode() + b"\n")
    except RefineError as error:
        # What `whole_file` says of "nothing" holds for its own file alone.
        cause = error.__cause__
        why = reason_of(cause if isinstance(cause, OSError) else error).removeprefix(f"{path}: ")
        done = "; the splats were" if splats else ""
        raise RefineError(f"{path}: the report was not written ({why}){done}") from error


def _is_terminal(stream: TextIO | None) -> bool:
    return stream is not None and stream.isatty()


def _write(name: Literal["stdout", "stderr"], text: str) -> bool:
    """Write text; whether standard output failed. A reader that has left is no failure."""
    stream: TextIO | None = getattr(sys, name)
    if stream is None:  # closed before Python began
        return False
    try:
        stream.write(text)
        stream.flush()
    except UnicodeEncodeError:  # a name that this terminal's encoding cannot show
        return _write(name, text.encode("ascii", "backslashreplace").decode())
    except OSError as error:
        # The work goes on. Python would flush again at exit and set an exit code of its own.
        setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        if name == "stdout" and not isinstance(error, BrokenPipeError):
            complain(f"standard output: {reason_of(error)}")
            return True
    return False
