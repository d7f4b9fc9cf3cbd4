"""Deliberate faults in core, each of which the core tests must catch: ``make mutants``.

Every mutant is a copy of the project with one line changed. Prints which tests caught it, and fails
if one survives, or if the line to change is no longer there.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

PROJECT = Path(__file__).resolve().parent.parent

MUTANTS = [
    ("frustum.py", "-view.rotation @ center", "view.rotation @ center", "sign of translation"),
    ("frustum.py", "out=x), depth)", "out=x), np.abs(depth))", "behind counts as inside"),
    ("frustum.py", "inside &= depth <= far", "inside &= depth < far", "far plane excluded"),
    (
        "frustum.py",
        "(view.cx - view.width / 2)",
        "(view.width / 2 - view.cx)",
        "shift mirrored",
    ),
    ("frustum.py", "half_height = view.height", "half_height = view.width", "axes swapped"),
    (
        "closed_form.py",
        "total *= self.alpha[piece]",
        "total *= self.alpha[piece] ** 2",
        "opacity twice",
    ),
    ("closed_form.py", "LUMA = (0.299, 0.587, 0.114)", "LUMA = (0.114, 0.587, 0.299)", "BGR"),
    ("closed_form.py", "largest + middle", "largest + smallest", "wrong two scales"),
    ("adaptive.py", "math.log(geometry)", "math.log(1 + geometry)", "wrong logarithm"),
    ("selection.py", "ties[: count", "ties[-count :][: count", "ties from the end"),
    ("selection.py", "count - 1)[count - 1]", "count)[count]", "off by one"),
    ("selection.py", "free & (values < edge)", "(values < edge)", "protection forgotten"),
    ("selection.py", "Fraction(repr(float(self.ratio)))", "self.ratio", "binary ratio"),
    ("splats.py", "w, x, y, z = np", "x, y, z, w = np", "quaternion order"),
    ("splats.py", "good &= (largest <= _LOG_LARGEST)", "good &= (largest <= 1e9)", "huge drawn"),
    (
        "spherical_harmonics.py",
        "points @ rotation, degree",
        "points @ rotation.T, degree",
        "inverse",
    ),
    ("transform.py", "> 0 else -rotation", "> 0 else rotation", "mirror not undone"),
    ("views.py", "place = place[order]", "", "spread in order of views"),
    (
        "ply_columns.py",
        "sh_rest = planes.transpose(0, 2, 1)",
        "sh_rest = planes.reshape(size, -1, 3)",
        "SH channel order",
    ),
]


def outcome(module: str, old: str, new: str) -> str:
    """Return the first test that fails with the fault in, or "" if none does.

    Raises
    ------
    ValueError
        If the line to change does not stand in the module exactly once.
    """
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in ("refine_addon", "tests", "benchmarks", ".ci"):
            shutil.copytree(PROJECT / name, copy / name, ignore=shutil.ignore_patterns("e2e"))
        for name in ("pyproject.toml", "blender_manifest.toml"):
            shutil.copy(PROJECT / name, copy / name)
        path = copy / "refine_addon/core" / module
        text = path.read_text("utf-8")
        if text.count(old) != 1:
            msg = f"{module}: expected {old!r} once, found it {text.count(old)} times"
            raise ValueError(msg)
        path.write_text(text.replace(old, new), "utf-8")
        tests = [sys.executable, "-m", "pytest", "tests/core", "-x", "-q", "-p", "no:cacheprovider"]
        # Those that race against a clock could catch a fault by chance.
        tests += ["-k", "not interrupted and not killed"]
        done = subprocess.run(tests, cwd=copy, capture_output=True, text=True, check=False)
    if "error" in done.stdout.splitlines()[-1]:
        raise ValueError(done.stdout[-2000:])  # a test that cannot be collected catches nothing
    found = re.search(r"^FAILED \S*?/?([^/\s]+?)(?:\[| |$)", done.stdout, re.MULTILINE)
    if done.returncode == 0:
        return ""
    return found[1] if found else done.stdout[-200:]


def main() -> int:
    """Try every mutant; return 1 if one survives."""
    if outcome("splats.py", "SH_C0 = ", "SH_C0 = "):
        print("the tests fail without any fault: mend that first")
        return 1
    survivors = 0
    for module, old, new, label in MUTANTS:
        caught = outcome(module, old, new)
        survivors += not caught
        print(f"{label:28} {module:24} {caught or 'SURVIVED'}", flush=True)
    print(f"{len(MUTANTS)} faults, {survivors} survived")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
