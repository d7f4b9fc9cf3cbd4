"""The command `lod`: what it writes and says, and what it refuses."""

from __future__ import annotations

import json
import multiprocessing
import os
from pathlib import Path

import pytest

from refine_addon.command import main
from refine_addon.core import read_splats
from refine_addon.core.levels import files as levels_files

from .test_command_clean import call, files  # noqa: F401 - a fixture

pytestmark = pytest.mark.slow

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


def test_one_level_is_one(files, capsys):  # noqa: F811
    """It was "1 levels"."""
    assert call(files, "lod", "--levels", ".5", "-o", str(files / "out"), *QUICK) == 0
    assert ": 1 level of 577 splats, by 2 of 6 views, " in capsys.readouterr().out


def test_levels_that_would_be_equal_are_made_once(files, capsys):  # noqa: F811
    """Of 577, .999 are all (576.4); .002 and .0019 are both 2 (1.2 and 1.1)."""
    options = ["--levels", ".999,.5,.002,.0019", "-o", str(files / "out"), *QUICK]

    assert call(files, "lod", *options) == 0
    said = capsys.readouterr().out
    assert "2 levels of 577" in said
    assert "note: no level for 0.999: it would be a copy of the input" in said
    assert "note: no level for 0.0019: it would be a copy of level 2" in said
    told = json.loads((files / "out/lod.json").read_text())["levels"]
    assert [(entry["level"], entry["asked"], entry["splats"]) for entry in told] == [
        (1, 0.5, 289),
        (2, 0.002, 2),
    ]
    assert len(list((files / "out").iterdir())) == 3


def test_a_psnr_that_lets_nothing_go_makes_no_level(files, capsys):  # noqa: F811
    """Alone it is an error; beside another the note says so. 1 dB is out of reach."""
    run = ["lod", "-o", str(files / "out"), "--nested", "--views", "2"]

    assert call(files, *run, "--psnr", "99.9") == 1
    assert "no level has fewer splats than the input, which has 577" in capsys.readouterr().err
    assert not (files / "out").exists()
    assert call(files, *run, "--psnr", "99.9,1") == 0
    said = capsys.readouterr().out
    assert "note: no level for 99.9 dB: it would be a copy of the input" in said
    assert "note: level 1: the estimate ends at 95% removed" in said


def test_files_that_the_new_manifest_does_not_name_go(files, capsys):  # noqa: F811
    """Those of the run before alone; neither the source nor what is no level."""
    out = files / "out"
    run = ["lod", "-o", str(out), "--overwrite", *QUICK]
    assert call(files, *run, "--levels", ".5,.3,.1") == 0
    (out / "scene.lod9.ply").write_text("mine")
    (files / "outside.lod3.ply").write_text("mine")
    (out / "notes.txt").write_text("mine")
    told = json.loads((out / "lod.json").read_text())
    names = ["scene.lod3.ply", "../outside.lod3.ply", "notes.txt", "gone.lod1.ply"]
    told["levels"] = [{"file": name} for name in names]
    (out / "lod.json").write_text(json.dumps(told))
    capsys.readouterr()

    assert call(files, *run, "--levels", ".5,.3") == 0

    assert "note: scene.lod3.ply of the run before is removed" in capsys.readouterr().out
    left = ["lod.json", "notes.txt", "scene.lod1.ply", "scene.lod2.ply", "scene.lod9.ply"]
    assert sorted(path.name for path in out.iterdir()) == left
    assert (files / "outside.lod3.ply").exists()


def test_levels_with_names_that_are_too_long_leave_no_empty_folder(files, capsys):  # noqa: F811
    """The source's 251 bytes and .lod1 are 256; neither the folder nor the one above it is left."""
    long = files / f"{'x' * 247}.ply"
    (files / "scene.ply").rename(long)

    code = main(["lod", str(long), "--cameras", str(files), "-o", str(files / "a/new"), *QUICK])

    assert code == 1
    assert "cannot be written (File name too long)" in capsys.readouterr().err
    assert not (files / "a").exists()


@pytest.mark.parametrize("told", ["[" * 100_000, "}", '{"file": 1}', "[{}]"])
def test_a_manifest_that_cannot_be_read_names_no_files(files, told):  # noqa: F811
    """It is replaced; brackets within brackets are more than the parser of JSON follows."""
    out = files / "out"
    out.mkdir()
    (out / "lod.json").write_text('{"lod": 1, "levels": ' + told)

    assert call(files, "lod", "-o", str(out), "--overwrite", *QUICK) == 0

    assert json.loads((out / "lod.json").read_text())["lod"] == 1


def test_a_level_can_be_the_source_of_a_new_run(files):  # noqa: F811
    """It is in the folder, and the manifest before names it: it stays."""
    out = files / "out"
    assert call(files, "lod", "-o", str(out), "--levels", ".5", *QUICK) == 0
    source, cameras = str(out / "scene.lod1.ply"), ["--cameras", str(files)]

    assert main(["lod", source, *cameras, "-o", str(out), "--overwrite", *QUICK]) == 0

    assert (out / "scene.lod1.ply").exists()
    assert (out / "scene.lod1.lod1.ply").exists()


def test_a_run_that_stops_before_its_first_level_leaves_the_run_before(files, monkeypatch):  # noqa: F811
    """Nothing is taken away until there is something to replace it."""
    out = files / "out"
    assert call(files, "lod", "-o", str(out), *QUICK) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}

    def interrupted(*_given, **_named):
        raise KeyboardInterrupt

    monkeypatch.setattr(levels_files, "each_level", interrupted)

    assert call(files, "lod", "-o", str(out), "--overwrite", *QUICK) == 130
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


@pytest.mark.parametrize("stop", ["scene.lod1.ply", "scene.lod2.ply", "lod.json"])
def test_no_manifest_names_a_file_that_is_not_there(files, monkeypatch, stop):  # noqa: F811
    """Killed at any file: what the manifest names, if there is one, is there."""
    out = files / "out"
    assert call(files, "lod", "-o", str(out), "--levels", ".5,.3,.1", *QUICK) == 0
    replace = Path.replace

    def killed(self, target):
        if Path(target).name == stop:
            os._exit(9)  # without any clean-up
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", killed)
    process = multiprocessing.get_context("fork").Process(
        target=call, args=(files, "lod", "-o", str(out), "--overwrite", "--levels", ".5,.3", *QUICK)
    )
    process.start()
    process.join()

    assert process.exitcode == 9
    assert not (out / "lod.json").exists()


def test_levels_that_are_one_file_by_a_link_are_refused(files, capsys):  # noqa: F811
    out = files / "out"
    out.mkdir()
    (out / "scene.lod2.ply").symlink_to("scene.lod1.ply")

    assert call(files, "lod", "-o", str(out), "--overwrite", *QUICK) == 1
    assert "by a link" in capsys.readouterr().err


def test_a_killed_run_leaves_no_level_that_no_list_names(files, monkeypatch):  # noqa: F811
    """Five levels before, two now: the other three go with the list, before a level is written."""
    out = files / "out"
    assert call(files, "lod", "-o", str(out), "--levels", ".5,.4,.3,.2,.1", *QUICK) == 0

    def killed(*_, **__):
        raise ZeroDivisionError

    monkeypatch.setattr(levels_files, "_write", killed)

    with pytest.raises(ZeroDivisionError):
        call(files, "lod", "-o", str(out), "--levels", ".5,.1", "--overwrite", *QUICK)

    assert sorted(path.name for path in out.iterdir()) == ["scene.lod1.ply", "scene.lod2.ply"]
