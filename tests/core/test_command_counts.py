"""What reports say of splats and views: the same everywhere, and what the file written holds."""

from __future__ import annotations

import json

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import read_splats

from .test_cleaning import FLOATER, SIDE, cameras, joined, wall
from .test_command_clean import call, files  # noqa: F401 - a fixture

WHOLE = SIDE**2 + 1
BROKEN = 3
QUICK = ["--method", "closed-form", "--views", "2"]


@pytest.fixture
def broken(files):
    """Return the folder with a scene of 577 splats, the first three of which are NaN."""
    data = bytearray((files / "scene.ply").read_bytes())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    rows = np.frombuffer(data, "<f4", offset=start).reshape(WHOLE, -1)
    rows[:BROKEN, 0] = np.nan
    (files / "scene.ply").write_bytes(data)
    return files


def told(folder, *arguments):
    """Run a command on the scene; return its entry of the report."""
    report = folder / "report.json"
    scene = str(folder / "scene.ply")
    assert main([arguments[0], scene, *arguments[1:], "--report", str(report), "--overwrite"]) == 0
    return json.loads(report.read_text())["results"][0]


@pytest.mark.parametrize("suffix", [".splat", ".ply"])
@pytest.mark.parametrize("command", ["prune", "clean", "convert"])
def test_a_report_counts_what_the_written_file_holds(broken, capsys, command, suffix):
    """`.splat` cannot hold the three that are NaN; a PLY holds every row."""
    out = broken / f"out{suffix}"
    options = {
        "prune": ["-o", str(out), "--cameras", str(broken), "--ratio", "0", *QUICK],
        "clean": ["-o", str(out), "--cameras", str(broken)],
        "convert": [str(out)],
    }[command]

    splats = told(broken, command, *options)["splats"]

    missing = BROKEN if suffix == ".splat" else 0
    stay = WHOLE - (command == "clean")
    assert len(read_splats(out)) == stay - missing
    assert splats["written"] == stay - missing
    assert splats["left_out"] == missing
    assert (f", {stay - missing} written" in capsys.readouterr().out) == bool(missing)


@pytest.mark.slow
def test_a_manifest_counts_what_the_files_of_levels_hold(broken):
    """Of 577, .997 are 576 (575.3): the first that cannot be drawn goes, two are left out."""
    options = ["--levels", ".997", "-o", str(broken / "out/levels.SPLAT")]

    entry = told(broken, "lod", "--cameras", str(broken), *options, *QUICK)["levels"][0]

    assert (entry["splats"], entry["left_out"]) == (574, 2)
    assert entry["file"] == "levels.lod1.splat"
    assert len(read_splats(broken / "out/levels.lod1.splat")) == 574


def test_nothing_is_said_to_be_written_where_nothing_is(broken):
    """Without an output, and with --dry-run, which tells what the format would leave out."""
    cameras = ["--cameras", str(broken)]
    dry = ["-o", str(broken / "out.splat"), "--dry-run", "--ratio", "0", *QUICK]

    assert told(broken, "clean", *cameras)["splats"]["written"] is None
    splats = told(broken, "prune", *cameras, *dry)["splats"]
    assert splats["written"] is None
    assert splats["left_out"] == BROKEN


@pytest.mark.slow
def test_every_report_says_what_was_seen_by_how_many_views(broken):
    """Of six views two are used. A splat at depth z lies in one up to 2/3 z beside, 1/2 z above.

    The images are 80 by 60 px at f = 60. What cannot be drawn lies in none.
    """
    means = joined(wall(), FLOATER).means
    beside = np.stack([means[:, :2] - view.center[:2] for view in cameras().spread(2)])
    outside = (np.abs(beside) > means[:, 2:] * [2 / 3, 1 / 2]).any(axis=2).all(axis=0)
    unseen = BROKEN + int(outside[BROKEN:].sum())
    options = ["--cameras", str(broken), "--views", "2"]
    entries = [
        told(broken, "prune", *options, "--dry-run"),
        told(broken, "score", *options, "--method", "occlusion", "-o", str(broken / "s.ply")),
        told(broken, "clean", *options),
        told(broken, "lod", *options, "--method", "occlusion", "-o", str(broken / "lod")),
    ]

    assert BROKEN < unseen < WHOLE / 2
    for entry in entries:
        assert entry["views"] == {"given": 6, "used": 2}
        facts = {name: entry["splats"][name] for name in ("before", "undrawable", "unseen")}
        assert facts == {"before": WHOLE, "undrawable": BROKEN, "unseen": unseen}


@pytest.mark.slow
def test_clean_and_lod_say_what_lies_in_no_view(files, capsys):
    """In the words of `prune`, and by how many views."""
    assert call(files, "clean", "--views", "2") == 0
    assert call(files, "lod", *QUICK, "-o", str(files / "out")) == 0
    said = capsys.readouterr().out
    assert said.count(f" of {WHOLE} splats lie in no view\n") == 2
    assert said.count("by 2 of 6 views") == 2


def test_sizes_below_a_tenth_of_a_megabyte_are_in_kilobytes(files, capsys):
    """577 splats of 32 bytes are 18,464: that was said to be 0.0 MB."""
    assert main(["convert", str(files / "scene.ply"), str(files / "out.splat")]) == 0
    assert "-> 18.5 kB -> " in capsys.readouterr().out


def test_a_limit_that_is_met_already_says_so(files, capsys):
    """The note has the size of the file, which becomes that of the output."""
    size = (files / "scene.ply").stat().st_size / 1e3
    out = ["-o", str(files / "out.ply"), *QUICK]

    assert call(files, "prune", "--max-mb", "1", *out) == 0
    assert f"note: already {size:.1f} kB: the budget removes nothing" in capsys.readouterr().out
    assert call(files, "prune", "--max-mb", ".02", *out, "--overwrite") == 0
    assert "already" not in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("psnr", "words"),
    [("99", "by the estimate nothing can go at 99 dB"), ("1", "the estimate ends at 95% removed")],
)
def test_a_psnr_out_of_reach_is_said(files, capsys, psnr, words):
    """Nothing can go at 99 dB, and at 95 % removed these still have more than 1."""
    assert call(files, "prune", "--psnr", psnr, "--dry-run", "--views", "2") == 0
    assert f"note: {words}" in capsys.readouterr().out
