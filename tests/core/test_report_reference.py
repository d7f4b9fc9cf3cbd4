"""docs/report.md names every key that is written, and none that is not."""

import json
import re
from pathlib import Path

import pytest

from refine_addon.command import main

from .test_command_clean import files  # noqa: F401 - a fixture

pytestmark = pytest.mark.slow

SECTIONS = (Path(__file__).parents[2] / "docs/report.md").read_text("utf-8").split("\n## ")
CAMERAS = ["--cameras", "."]
RUNS = {
    "prune": [
        ["-o", "a.splat", "--method", "refit", "--rounds", "1", "--clean", "--ratio", ".3"],
        ["--dry-run", "--method", "occlusion", "--max-mb", "9", "--pictures", "shots"],
        ["--together", "--dry-run", "--method", "closed-form"],
    ],
    "score": [["-o", "scored.ply"]],
    "clean": [["--reasons", "front,isolated,giant,needle,transparent,haze,outside"]],
    "convert": [["b.splat"]],
    "lod": [
        ["-o", "levels", "--method", "occlusion", "--levels", ".5"],
        ["-o", "refitted", "--method", "refit", "--rounds", "1", "--levels", ".5"],
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


@pytest.mark.parametrize("command", RUNS)
def test_every_key_of_a_report_is_in_the_reference(files, monkeypatch, command):
    """And every key that the reference has for the command is written by one of its runs.

    Without a curve `quality` itself is null. An input that fails has three keys.
    """
    monkeypatch.chdir(files)
    found = set()
    for options in RUNS[command]:
        inputs = ["scene.ply", *(["nothing.ply"] if command == "info" else [])]
        more = [] if command in ("convert", "info") else CAMERAS
        words = [command, *inputs, *options, *more, "--quiet", "--report", "report.json"]
        assert main([*words, "--overwrite"]) == (command == "info")
        report = json.loads(Path("report.json").read_text())
        assert set(report) == set(documented("The file"))
        found |= set(written(report["results"][0]))
        assert [list(entry) for entry in report["results"][1:]] == [
            ["status", "input", "error"]
        ] * (command == "info")
    found.discard("quality")
    keys = [key for key in documented(command) if key not in ("levels", "quality")]

    assert missing(found, keys) == set()
    assert [key for key in keys if len(missing(found, [key])) == len(found)] == []
