"""The command `lod`: what it writes and says, and what it refuses."""

from __future__ import annotations

import json

import pytest

from refine_addon.command import main
from refine_addon.core import read_splats
from refine_addon.core.levels import files as levels_files

from .test_command_clean import call, files  # noqa: F401 - a fixture

QUICK = ["--nested", "--method", "closed-form", "--views", "2"]


def test_lod_writes_levels_and_says_what_each_costs(files, capsys):  # noqa: F811
    """577 splats: .5 are 289 (288.5), .1 are 58 (57.7); a line for each, and the report."""
    out, told = files / "out", files / "report.json"

    code = call(
        files, "lod", "--levels", ".5,.1", "-o", str(out), "--report", str(told),
        "--format", ".splat", *QUICK,
    )  # fmt: skip

    assert code == 0
    said = capsys.readouterr().out
    assert "2 levels of 577 splats" in said
    assert "scene.lod1.splat: 289 splats" in said
    assert "under a pixel from" in said
    assert len(read_splats(out / "scene.lod2.splat")) == 58
    result = json.loads(told.read_text())["results"][0]
    assert result["levels"] == json.loads((out / "lod.json").read_text())["levels"]


@pytest.mark.slow
def test_by_default_survivors_absorb_and_four_levels_are_made(files):  # noqa: F811
    """Halves of halves, about: 289, 145, 70 and 35 of 577, rounded up."""
    assert call(files, "lod", "-o", str(files / "out"), "--views", "2", "--quiet") == 0
    told = json.loads((files / "out/lod.json").read_text())
    assert [entry["splats"] for entry in told["levels"]] == [289, 145, 70, 35]
    source = {row.tobytes() for row in read_splats(files / "scene.ply").rows}
    rows = read_splats(files / "out/scene.lod4.ply").rows
    assert any(row.tobytes() not in source for row in rows)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--levels", ".5,.6"], "comes after"),
        (["--levels", "half"], "numbers with commas"),
        (["--levels", "2"], "less than 1"),
        (["--psnr", "30,40"], "comes after"),
        (["--psnr", "40", "--levels", ".5"], "not allowed with"),
        (["--distance-psnr", "200"], "less than 100"),
        (["--format", ".obj"], "invalid choice"),
    ],
)
def test_wrong_usage_ends_before_any_work(files, capsys, options, word):  # noqa: F811
    """Code 2, and no folder."""
    assert call(files, "lod", "-o", str(files / "out"), *options) == 2
    assert word in capsys.readouterr().err
    assert not (files / "out").exists()


def test_a_folder_for_the_files_is_required(files, capsys):  # noqa: F811
    """Argparse names the option."""
    assert call(files, "lod") == 2
    assert "--output-dir" in capsys.readouterr().err


def test_what_is_no_manifest_is_not_replaced(files, capsys):  # noqa: F811
    """Not even with --overwrite."""
    (files / "lod.json").write_text('{"my": "notes"}')

    assert call(files, "lod", "-o", str(files), "--overwrite", *QUICK) == 2
    assert "lod.json exists and lists no levels" in capsys.readouterr().err
    assert (files / "lod.json").read_text() == '{"my": "notes"}'


def test_files_that_exist_are_replaced_when_told_alone(files, capsys):  # noqa: F811
    """The second run fails on the first level, the third replaces both and the manifest."""
    run = ["lod", "--levels", ".5,.1", "-o", str(files / "out"), *QUICK]
    assert call(files, *run) == 0

    assert call(files, *run) == 1
    assert "scene.lod1.ply: exists already" in capsys.readouterr().err
    assert call(files, *run, "--overwrite") == 0


def test_a_report_cannot_take_the_place_of_the_manifest(files, capsys):  # noqa: F811
    """It would replace what the run writes."""
    told = str(files / "out/lod.json")

    assert call(files, "lod", "-o", str(files / "out"), "--report", told, *QUICK) == 2
    assert "a file of its own" in capsys.readouterr().err


def test_ctrl_c_leaves_nothing(files, monkeypatch, capsys):  # noqa: F811
    """Interrupted while the second level is made: 130, and the first level is gone again."""
    made = levels_files.each_level

    def interrupted(*given, **named):
        for level in made(*given, **named):
            if level.number == 2:
                raise KeyboardInterrupt
            yield level

    monkeypatch.setattr(levels_files, "each_level", interrupted)

    assert call(files, "lod", "-o", str(files / "out"), *QUICK) == 130
    assert "nothing was left half-written" in capsys.readouterr().err
    assert not (files / "out").exists()


def test_without_cameras_there_are_no_levels(files, capsys):  # noqa: F811
    """They decide what goes."""
    assert main(["lod", str(files / "scene.ply"), "-o", str(files / "out")]) == 2
    assert "no cameras" in capsys.readouterr().err
