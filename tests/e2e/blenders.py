"""The Blenders that the tests run: real binaries in a Debian root, and `bpy` modules.

Both run a step, one file of `inside/`, in a process of their own and give back what its `main`
returned. Nothing of the person's own Blender is seen or touched: home, preferences and extensions
are folders of the test.
"""

from __future__ import annotations

import functools
import json
import os
import signal
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import blender_root
import bpy_venv
from made_once import UnavailableError

PROJECT = Path(__file__).resolve().parents[2]
DRIVER = Path(__file__).parent / "inside" / "run_step.py"
MANIFEST = tomllib.loads((PROJECT / "blender_manifest.toml").read_text(encoding="utf-8"))

MODULES = ("bpy-4.2.23", "bpy-4.5.15", "bpy-5.0.1")
BINARIES = ("trixie", "sid")

# Seconds. The slowest step is the window's: about 80 on two idle cores, far more on busy ones.
# A step in Blender gives up by itself a minute before, and says where it was.
PATIENCE, _TO_SAY_WHERE = 600, 60


class StepError(AssertionError):
    """A step inside Blender failed; the message is the end of what it printed."""


@functools.cache
def provide(name: str) -> tuple[Path | None, str]:
    """Return the interpreter or root of one of `MODULES` or `BINARIES`, or None and why not."""
    try:
        if name in BINARIES:
            return blender_root.provide(name), ""
        return bpy_venv.provide(name.removeprefix("bpy-")), ""
    except UnavailableError as error:
        return None, f"{name} cannot be had here: {error}"


@dataclass(frozen=True)
class Blender:
    """What `provide` gave for a name, and folders for its files, and for its preferences."""

    name: str
    path: Path
    work: Path
    resources: Path
    patience: float = PATIENCE

    def environment(self) -> dict[str, str]:
        """Return the variables that keep Blender to the test's folders."""
        return {
            "HOME": os.fspath(self.work),
            "BLENDER_USER_RESOURCES": os.fspath(self.resources),
            "LC_ALL": "C.UTF-8",
            "REFINE_PATIENCE": f"{self.patience - _TO_SAY_WHERE}",
        }

    def python(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run Blender with this script and its arguments, in the background."""
        raise NotImplementedError

    def step(self, name: str, /, **arguments: Any) -> Any:
        """Return what ``main(**arguments)`` of `inside/NAME.py` does in Blender, all as JSON.

        `StepError` if it raises, Blender ends before, or the extension raises meanwhile.
        """
        return self._result(name, arguments, self.python)

    def _result(self, name: str, arguments: dict[str, Any], run: Any) -> Any:
        __tracebackhide__ = True  # a report that ends with Blender's output, not with this
        answer = self.work / f"{name}.json"
        answer.unlink(missing_ok=True)
        done = run(os.fspath(DRIVER), "--", name, json.dumps(arguments, default=str), str(answer))
        printed = done.stdout + done.stderr
        # Blender goes on after an exception in a panel, a poll or a handler; a test must not.
        if done.returncode != 0 or not answer.exists() or "Traceback" in printed:
            message = f"{self.name}, step {name}, exit code {done.returncode}:\n"
            raise StepError(message + "\n".join(printed.splitlines()[-80:]))
        return json.loads(answer.read_text(encoding="utf-8"))


class Module(Blender):
    """`bpy` in a virtual environment."""

    def python(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run a script with the environment's interpreter."""
        environment = {"PATH": "/usr/bin:/bin", **self.environment()}
        return _run([self.path, *words], patience=self.patience, env=environment, cwd=self.work)


class Binary(Blender):
    """A real Blender in a Debian root, with a command line and, under Xvfb, a window."""

    def run(self, *words: str | Path) -> subprocess.CompletedProcess[str]:
        """Run a command in the root, offline; it can write to the test's folders alone."""
        return _run(self.entered(*words), patience=self.patience)

    def entered(self, *words: str | Path) -> list[str | Path]:
        """Return the command that runs a command as `run` does."""
        enter = blender_root.enter(
            self.path,
            read_only=[PROJECT],
            writable=[self.work, self.resources],
            environment=self.environment(),
        )
        return [*enter, "--chdir", self.work, *words]

    def blender(self, *words: str | Path) -> subprocess.CompletedProcess[str]:
        """Run Blender in the background, with the preferences that the test has saved."""
        return self.run("blender", "--background", *words)

    def refine(
        self, *words: str | Path, blend: Path | None = None
    ) -> subprocess.CompletedProcess[str]:
        """Run the extension's command in Blender, with an open file."""
        return self.blender(*([blend] if blend else []), "--command", "refine", *words)

    def python(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run a script in Blender as it is fresh from the factory."""
        return self.blender("--factory-startup", "--python-exit-code", "1", "--python", *words)

    def window_step(
        self,
        name: str,
        blend: Path | None = None,
        /,
        *,
        size: tuple[int, int] = (1600, 1000),
        simulate: bool = True,
        factory: bool = True,
        **arguments: Any,
    ) -> Any:
        """Run a step in a window of some pixels, on an open file or the default scene; see `step`.

        The step's `main` is a generator; each value it yields is how many seconds to leave
        Blender to itself. Where it simulates events, Blender listens to no real ones; where it is
        not fresh from the factory, it reads and keeps preferences.
        """

        def window(*words: str) -> subprocess.CompletedProcess[str]:
            width, height = map(str, size)
            screen = f"--server-args=-screen 0 {width}x{height}x24"
            blender = ["xvfb-run", "--auto-servernum", screen, "blender"]
            blender += ["--factory-startup"] * factory
            place = ["--enable-event-simulate"] * simulate
            place += ["--window-geometry", "0", "0", width, height]
            file = [] if blend is None else [blend]
            return self.run(*blender, *place, *file, "--python", *words)

        return self._result(name, arguments, window)


def without_blender(*words: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the extension's command of this checkout, in this Python and without Blender."""
    return _run([sys.executable, "-m", "refine_addon", *words], cwd=PROJECT)


def _run(
    words: list[Any], *, patience: float = PATIENCE, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Run a command; after so many seconds end it with all that it has started."""
    pipe = subprocess.PIPE
    with subprocess.Popen(
        words,
        stdout=pipe,
        stderr=pipe,
        text=True,
        stdin=subprocess.DEVNULL,
        start_new_session=True,  # a group of its own: what it starts holds the pipes open, too
        **options,
    ) as process:
        try:
            printed = process.communicate(timeout=patience)
        except BaseException as error:
            os.killpg(process.pid, signal.SIGKILL)
            if not isinstance(error, subprocess.TimeoutExpired):
                raise
            printed = process.communicate()
            last = "\n".join("".join(printed).splitlines()[-80:])
            raise StepError(
                f"{Path(words[0]).name} was ended after {patience:.0f} s:\n{last}"
            ) from None
    return subprocess.CompletedProcess(words, process.returncode, *printed)
