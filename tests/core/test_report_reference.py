"""docs/report.md names every key that is written, and none that is not."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from refine_addon.command import main

from .test_command_clean import files  # noqa: F401 - a fixture

pytestmark = pytest.mark.slow

SECTIONS = (Path(__file__).parents[2] / "docs/report.md").read_text("utf-8").split("\n## ")
CAMERAS = ["--cameras", "."]
CHANGING = ["--method", "refit", "--clean", "--ratio", ".3"]
RUNS = {
    "prune": [
        ["-o", "a.splat", *CHANGING, *CAMERAS],
        ["--dry-run", "--method", "occlusion", "--max-mb", "9", "--pictures", "shots", *CAMERAS],
        ["--together", "--dry-run", "--method", "closed-form", *CAMERAS],
    ],
    "score": [["-o", "scored.ply", *CAMERAS]],
    "clean": [["--reasons", "front,isolated,giant,needle,transparent,haze,outside", *CAMERAS]],
    "convert": [["b.splat"]],
    "lod": [
        ["-o", "levels", "--method", "occlusion", *CAMERAS],
        ["-o", "refitted", "--method", "refit", "--levels", ".5", *CAMERAS],
    ],
    "info": [[]],
}


def documented(command):
    """Return the keys in the lists of all sections whose headings name a command, or "The file"."""
    sections = [text for text in SECTIONS if command in text.partition("\n")[0].split(", ")]
    rows = re.findall(r"^- (`.+?`)(?=: )", "\n".join(sections), re.MULTILINE)
    return [key for keys in rows for key in re.findall(r"`([^`]+)`", keys)]


def written(value, name=""):
    """Yield the dotted names of all values in a JSON value; those in lists once for each item."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from written(inner, f"{name}.{key}" if name else key)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for inner in value:
            yield from written(inner, f"{name}[]")
    else:
        yield name


def missing(names, patterns):
    """Return the names that no pattern has; one that ends in ``.*`` has all that begin so."""
    exact = {pattern for pattern in patterns if not pattern.endswith("*")}
    starts = tuple(pattern[:-1] for pattern in patterns if pattern.endswith("*"))
    return {name for name in names if name not in exact and not name.startswith(starts or "\0")}


def reports(command):
    """Yield the report of each run of a command, in the current folder."""
    for options in RUNS[command]:
        arguments = [command, "scene.ply", *options, "--quiet"]
        assert main([*arguments, "--report", "report.json", "--overwrite"]) == 0
        yield json.loads(Path("report.json").read_text())


@pytest.mark.parametrize("command", RUNS)
def test_every_key_of_a_report_is_in_the_reference(files, monkeypatch, command):
    """And every key that the reference has for the command is written by one of its runs.

    Without a curve `quality` itself is null.
    """
    monkeypatch.chdir(files)
    keys = documented(command)

    found = set()
    for report in reports(command):
        assert set(report) == set(documented("The file"))
        found |= set(written(report["results"][0]))
    found.discard("quality")
    keys = [key for key in keys if key not in ("levels", "quality")]

    assert missing(found, keys) == set()
    assert [key for key in keys if len(missing(found, [key])) == len(found)] == []


def test_an_input_that_fails_has_three_keys(files, monkeypatch):
    """As the reference says."""
    monkeypatch.chdir(files)
    assert main(["info", "nothing.ply", "--report", "report.json", "--quiet"]) == 1

    (entry,) = json.loads(Path("report.json").read_text())["results"]
    assert list(entry) == ["status", "input", "error"]
