"""PlayCanvas splat-transform as an external process: decimation by merging pairs.

It is an npm package that needs Node 22, itself an npm package. `install` puts both, and Khronos'
validator for glTF files, under ``build/splat-transform``, where `find` looks before the search
path::

    python -m benchmarks.baselines.splat_transform

Nothing of it is part of this project; where it is missing, the benchmark says so and goes on.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from refine_addon.core.errors import RefineError

PACKAGES = ("@playcanvas/splat-transform@3.7.0", "node@22", "gltf-validator@2.0.0-dev.3.10")
ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "build/splat-transform"
MISSING = (
    "splat-transform is not installed: python -m benchmarks.baselines.splat_transform (needs npm)"
)
FLAGS = ("--decimate", "--decimate-adaptive")


@dataclass(frozen=True)
class Run:
    """One decimation, from file to file.

    - seconds, busy: Of the whole process, its start included, and of the processor, all cores
      together.
    - peak_bytes: Largest resident memory; None where the system does not tell.
    """

    seconds: float
    busy: float
    peak_bytes: int | None


def find() -> list[str] | None:
    """Return the start of its command line, or None where it is not installed."""
    script = FOLDER / "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
    node = FOLDER / "node_modules/node/bin" / ("node.exe" if os.name == "nt" else "node")
    if script.is_file() and node.is_file():
        return [str(node), str(script)]
    found = shutil.which("splat-transform")
    return None if found is None else [found]


def version() -> str:
    """Return its version, or "" where it is not installed."""
    start = find()
    if start is None:
        return ""
    done = subprocess.run([*start, "--version"], capture_output=True, text=True, check=False)
    words = (done.stdout + done.stderr).split()
    return next((word for word in words if word.lstrip("v")[:1].isdigit()), "?")


def command(source: Path, target: Path, flag: str, keep_count: int) -> list[str]:
    """Return the command line that writes `source`, decimated to `keep_count`, to `target`.

    - RefineError: if it is not installed.
    """
    start = find()
    if start is None:
        raise RefineError(MISSING)
    return [*start, "-g", "cpu", "-q", "-w", str(source), str(target), flag, str(keep_count)]


def decimate(source: Path, target: Path, flag: str, keep_count: int) -> Run:
    """Run `command`.

    - RefineError: if it is not installed, or fails; with what it said.
    """
    arguments = command(source, target, flag, keep_count)
    with tempfile.TemporaryFile() as said:
        before = processor_seconds(resource.RUSAGE_CHILDREN)
        start = time.perf_counter()
        process = subprocess.Popen(arguments, stdout=said, stderr=said)
        code, peak = _wait(process)
        seconds = time.perf_counter() - start
        busy = processor_seconds(resource.RUSAGE_CHILDREN) - before
        said.seek(0)
        text = said.read().decode(errors="replace").strip()
    if code != 0 or not target.is_file():
        raise RefineError(f"splat-transform ended with {code}: {text}")
    return Run(seconds, busy, peak)


def _wait(process: subprocess.Popen[bytes]) -> tuple[int, int | None]:
    """Wait for the process; return its exit code and peak memory.

    The peak is asked of the process while it runs: what the system reports afterwards counts the
    memory of the parent that it was forked from.
    """
    peak = None
    while process.poll() is None:
        peak = memory("VmHWM", process.pid) or peak
        time.sleep(0.01)
    return process.returncode, peak


def memory(what: str, process: int | str = "self") -> int | None:
    """Return a line of Linux's account of a process, and of those that it started, in bytes.

    None elsewhere, or once it ended.
    """
    place = Path("/proc") / str(process)
    try:
        lines = (place / "status").read_text(encoding="ascii").splitlines()
        started = [each.read_text(encoding="ascii") for each in place.glob("task/*/children")]
    except OSError:
        return None
    own = next((int(line.split()[1]) * 1024 for line in lines if line.startswith(what)), None)
    others = [memory(what, int(child)) for child in " ".join(started).split()]
    return None if own is None else own + sum(other or 0 for other in others)


def processor_seconds(whose: int) -> float:
    """Return the seconds of all cores so far, of `resource.RUSAGE_SELF` or ``RUSAGE_CHILDREN``."""
    usage = resource.getrusage(whose)
    return usage.ru_utime + usage.ru_stime


def measured(order: Sequence[str | Path]) -> tuple[float, float, float]:
    """Run a command in the checkout; return its seconds, the processor's, and peak megabytes.

    Those that belong to the process, and to those that it starts, alone (RssAnon): what is mapped
    of a file is the page cache's.

    - subprocess.CalledProcessError: if it fails.
    """
    peak = 0
    before = processor_seconds(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    with subprocess.Popen(order, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            peak = max(peak, memory("RssAnon", process.pid) or 0)
            time.sleep(0.002)
        seconds = time.perf_counter() - start
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, list(map(str, order)))
    return seconds, processor_seconds(resource.RUSAGE_CHILDREN) - before, peak / 1e6


def install() -> int:
    """Install it with npm; return the exit code."""
    npm = shutil.which("npm")
    if npm is None:
        print("npm is not installed; the benchmark goes on without splat-transform")
        return 0
    FOLDER.mkdir(parents=True, exist_ok=True)
    order = [npm, "install", "--no-audit", "--no-fund", "--prefix", str(FOLDER), *PACKAGES]
    code = subprocess.run(order, check=False).returncode
    print(f"splat-transform {version() or 'was not installed'}")
    return code


if __name__ == "__main__":
    sys.exit(install())
