"""What reports say of splats and views: the same everywhere, and what the file written holds."""

import json

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import read_splats

from .test_cleaning import FLOATER, cameras, joined, wall
from .test_command_clean import WHOLE, call, files, spoil, told  # noqa: F401 - a fixture

BROKEN = 3
QUICK = ["--method", "closed-form", "--views", "2"]


@pytest.fixture
def broken(files):
    """Return the folder with a scene of 577 splats, the first three of which are NaN."""
    spoil(files, BROKEN)
    return files


@pytest.mark.parametrize("suffix", [".splat", ".ply"])
@pytest.mark.parametrize("command", ["prune", "clean", "convert"])
def test_a_report_counts_what_the_written_file_holds(broken, capsys, command, suffix):
    """`.splat` cannot hold the three that are NaN, and says what it rounds; a PLY holds all."""
    out = broken / f"out{suffix}"
    if command == "convert":
        words = ["convert", broken / "scene.ply", out, "--report", broken / "r.json"]
        assert main([str(word) for word in words]) == 0
        splats = json.loads((broken / "r.json").read_text())["results"][0]["splats"]
    else:
        options = ["--ratio", "0", *QUICK] if command == "prune" else []
        splats = told(broken, command, "-o", out, *options)["splats"]

    missing = BROKEN if suffix == ".splat" else 0
    stay = WHOLE - (command == "clean") - missing
    assert len(read_splats(out)) == splats["written"] == stay
    assert splats["left_out"] == missing
    said = capsys.readouterr().out
    assert (f", {stay} written" in said) == ("  note: .splat " in said) == bool(missing)


def test_nothing_is_said_to_be_written_where_nothing_is(broken):
    """Without an output, and with --dry-run, which tells what the format would leave out."""
    dry = ["-o", broken / "out.splat", "--dry-run", "--ratio", "0", *QUICK]

    assert told(broken, "clean")["splats"]["written"] is None
    splats = told(broken, "prune", *dry)["splats"]
    assert (splats["written"], splats["left_out"]) == (None, BROKEN)


@pytest.mark.slow
def test_every_report_says_what_was_seen_by_how_many_views(broken, capsys):
    """Of six views two are used. A splat at depth z lies in one up to 2/3 z beside, 1/2 z above.

    The images are 80 by 60 px at f = 60. What cannot be drawn lies in none. Of 577, .997 are 576
    (575.3): the first that cannot be drawn goes, and two are left out of a `.splat`.
    """
    means = joined(wall(), FLOATER).means
    beside = np.stack([means[:, :2] - view.center[:2] for view in cameras().spread(2)])
    outside = (np.abs(beside) > means[:, 2:] * [2 / 3, 1 / 2]).any(axis=2).all(axis=0)
    unseen = BROKEN + int(outside[BROKEN:].sum())
    levels = [*QUICK, "--levels", ".997", "-o", broken / "out/levels.SPLAT"]
    runs = {
        "prune": ["--dry-run", "--views", "2"],
        "score": ["--views", "2", "--method", "occlusion", "-o", broken / "s.ply"],
        "clean": ["--views", "2"],
        "lod": levels,
    }

    assert BROKEN < unseen < WHOLE / 2
    for command, options in runs.items():
        entry = told(broken, command, *options)
        assert entry["views"] == {"given": 6, "used": 2, "between": 0}
        facts = {name: entry["splats"][name] for name in ("before", "undrawable", "unseen")}
        assert facts == {"before": WHOLE, "undrawable": BROKEN, "unseen": unseen}
        said = capsys.readouterr().out
        assert f" {unseen} of {WHOLE} splats lie in no view\n" in said
        assert ("by 2 of 6 views" in said) == (command != "score")
    (level,) = entry["levels"]
    assert [level[key] for key in ("splats", "left_out", "file")] == [574, 2, "levels.lod1.splat"]
    assert len(read_splats(broken / "out/levels.lod1.splat")) == 574


def test_sizes_and_limits_are_in_units_that_show_them(files, capsys):
    """577 splats of 32 bytes are 18,464: that was said to be 0.0 MB; a limit that is met is told.

    The note has the size of the file, which becomes that of the output.
    """
    size = (files / "scene.ply").stat().st_size / 1e3
    out = ["-o", files / "out.ply", *QUICK]

    assert main(["convert", str(files / "scene.ply"), str(files / "out.splat")]) == 0
    assert "-> 18.5 kB -> " in capsys.readouterr().out
    assert call(files, "prune", "--max-mb", "1", *out) == 0
    assert f"note: already {size:.1f} kB: the budget removes nothing" in capsys.readouterr().out
    assert call(files, "prune", "--max-mb", ".02", *out, "--overwrite") == 0
    assert "already" not in capsys.readouterr().out
