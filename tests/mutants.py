"""Deliberate faults in what ships, to be caught by the tests of core: ``make mutants``.

    python tests/mutants.py [--stale] [test or module ...]

The faults are listed in ``mutants.toml``. Each is put into a copy of the project; prints which test
catches it. The test that caught it last is asked first, all others only if it does not any more.
Fails if a fault survives, or if a text to change or a test is no longer there: that alone is what
``--stale`` looks for, at once.
"""

from __future__ import annotations

import argparse
import functools
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

PROJECT = Path(__file__).resolve().parent.parent
ROOT_FILES = ("pyproject.toml", "blender_manifest.toml", "Makefile", "README.md", "CONTRIBUTING.md")
"""What tests read in the project's folder; without one of them they would fail by themselves."""

SECONDS, SECONDS_ALONE = 900, 120
"""A fault that makes a stage, or a single test, take longer is caught: something hangs."""


class Fault(NamedTuple):
    """One fault.

    Attributes
    ----------
    test : str
        The file whose tests guard it: ``tests/core/test_TEST.py``.
    old, new : str
        The text to change and what it becomes.
    label : str
        What is wrong then.
    caught : str
        The test that catches it, as far as known: its name in that file, or
        ``test_OTHER.py::name``.
    """

    test: str
    old: str
    new: str
    label: str
    caught: str = ""

    @property
    def first(self) -> str:
        """The test to ask first, as pytest is told."""
        file, _, name = self.caught.rpartition("::")
        return f"tests/core/{file or f'test_{self.test}.py'}{name and f'::{name}'}"


def faults() -> list[Fault]:
    """Return all faults of the table."""
    table = tomllib.loads((PROJECT / "tests/mutants.toml").read_text("utf-8"))
    return [Fault(test, old, *rest) for test, entry in table.items() for old, rest in entry.items()]


def sources() -> dict[str, str]:
    """Return what ships: the text of every module, by its path in the project."""
    paths = sorted(PROJECT.glob("refine_addon/**/*.py"))
    return {path.relative_to(PROJECT).as_posix(): path.read_text("utf-8") for path in paths}


def module_of(fault: Fault, texts: dict[str, str]) -> str:
    """Return the module with the text that a fault changes.

    Raises
    ------
    ValueError
        If the text does not stand in what ships exactly once, or there is no such test.
    """
    places = [path for path, text in texts.items() for _ in range(text.count(fault.old))]
    if len(places) != 1:
        msg = f"expected {fault.old!r} in one place, it is in {', '.join(places) or 'none'}"
        raise ValueError(msg)
    file, _, name = fault.first.partition("::")
    path = PROJECT / file
    if not path.exists() or (name and f"def {name}(" not in path.read_text("utf-8")):
        msg = f"there is no {fault.first}"
        raise ValueError(msg)
    return places[0]


_ONE = threading.Lock()
"""Held while it is asked whether all tests pass, which takes minutes, so that it is asked once."""


def outcome(fault: Fault, module: str, text: str) -> str:
    """Return the first test that fails with a fault in a module, or "" if none does."""
    caught = _outcome([[fault.first]], fault, module, text)
    with _ONE:
        broken = not caught and not unbroken()
    if broken:
        msg = "not known: other tests fail without any fault"
        raise ValueError(msg)
    return caught or _outcome(_stages(fault.test), fault, module, text)


@functools.cache
def unbroken() -> bool:
    """Return whether all tests of core pass without a fault."""
    return not _outcome(_stages())


def _outcome(
    stages: list[list[str]], fault: Fault | None = None, module: str = "", text: str = ""
) -> str:
    """Return the first test of some stages that fails, or "" if none does."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in ("refine_addon", "tests", "benchmarks", ".ci", "docs"):
            shutil.copytree(PROJECT / name, copy / name, ignore=shutil.ignore_patterns("e2e"))
        for name in ROOT_FILES:
            shutil.copy(PROJECT / name, copy / name)
        if fault:
            (copy / module).write_text(text.replace(fault.old, fault.new), "utf-8")
        return next(filter(None, (_caught(copy, stage) for stage in stages)), "")


def _stages(test: str = "") -> list[list[str]]:
    """Return what pytest is to run, stage by stage: one file, all quick tests, all slow ones."""
    # What documents and words name does not depend on any line of core.
    apart = {f"test_{test}.py", "test_documents.py", "test_words.py"}
    paths = [path.relative_to(PROJECT) for path in sorted(PROJECT.glob("tests/core/test_*.py"))]
    others = [str(path) for path in paths if path.name not in apart]
    first = [[f"tests/core/test_{test}.py"]] if test else []
    return [*first, [*others, "-m", "not slow"], [*others, "-m", "slow"]]


def _caught(copy: Path, stage: list[str]) -> str:
    """Return the first of some tests that fails in a copy of the project, or ""."""
    tests = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *stage]
    limit = SECONDS_ALONE if len(stage) == 1 and "::" in stage[0] else SECONDS
    # pytest rewrites Hypothesis each time, for 2 s, unless it may keep the bytecode.
    kept = {**os.environ, "PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": _bytecode().name}
    try:
        done = subprocess.run(
            tests, cwd=copy, capture_output=True, text=True, check=False, timeout=limit, env=kept
        )
    except subprocess.TimeoutExpired:
        return f"{stage[0]}: more than {limit} s"
    if done.returncode == 0:
        return ""
    if "error" in done.stdout.splitlines()[-1]:
        raise ValueError(done.stdout[-2000:])  # a test that cannot be collected catches nothing
    failed = re.search(r"^FAILED \S*?/?([^/\s]+?)(?:\[| |$)", done.stdout, re.MULTILINE)
    return failed[1] if failed else done.stdout[-200:]


@functools.cache
def _bytecode() -> tempfile.TemporaryDirectory[str]:
    """Make a folder for bytecode, which goes with this process."""
    return tempfile.TemporaryDirectory(prefix="mutants-")


def main() -> int:
    """Try every fault, or those of some tests or modules; return 1 if one survives."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stale", action="store_true", help="only say what cannot be tried")
    parser.add_argument("only", nargs="*", help="name of a test file or module, such as absorb")
    options = parser.parse_args()
    texts, known, stale = sources(), [], 0
    for fault in faults():
        try:
            module = module_of(fault, texts)
        except ValueError as error:
            stale += 1
            print(f"NOT TRIED: {fault.label} ({fault.test}): {error}")
            continue
        if not options.only or {fault.test, Path(module).stem} & set(options.only):
            known.append((fault, module))
    if options.stale:
        return 1 if stale else 0
    if failed := _outcome([sorted({fault.first for fault, _ in known})]):
        print(f"{failed} fails without any fault: mend that first")
        return 1

    def tried(place: tuple[Fault, str]) -> bool:
        fault, module = place
        try:
            caught = outcome(fault, module, texts[module])
            said = caught or "SURVIVED"
        except ValueError as error:
            caught, said = "", f"SURVIVED: {error}"
        print(f"{fault.label:34} {module.removeprefix('refine_addon/'):34} {said}", flush=True)
        return bool(caught)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        survived = [*pool.map(tried, known)].count(False)
    print(f"{len(known)} faults, {survived} survived, {stale} not tried")
    return 1 if survived or stale else 0


if __name__ == "__main__":
    sys.exit(main())
