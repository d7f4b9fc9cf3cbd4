"""The command without Blender: every option, exit codes, reports, what is left when it stops."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from refine_addon import command
from refine_addon.core import (
    Budget,
    ClosedForm,
    Occlusion,
    prune,
    prune_file,
    read_cameras,
    read_ply,
    read_splats,
    score,
)
from refine_addon.core.formats import ply
from refine_addon.core.images import png
from refine_addon.core.pictures import CAMERAS, PictureFiles, compare
from refine_addon.core.scoring import closed_form
from refine_addon.version import VERSION
from tests.strategies import plain_header, plain_ply, splat_names

ROOT = Path(__file__).parents[2]
ROOM = ROOT / "tests/data/room_small"
COUNT = 60


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Stand in a folder with a splat file and five cameras around it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in.ply").write_bytes(plain_ply(COUNT, 1))
    views = [
        {
            "position": [offset, 0.1 * offset * offset, 0.0],
            "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
            "fx": 180.0,
            "fy": 180.0,
            "width": 40,
            "height": 30,
            "img_name": str(offset),
        }
        for offset in (-0.4, -0.2, 0.0, 0.2, 0.4)
    ]
    (tmp_path / "cameras.json").write_text(json.dumps(views))
    return tmp_path


PRUNE = ["prune", "in.ply", "--cameras", "cameras.json"]
CLOSED = ["--method", "closed-form"]
SCORE = ["score", "in.ply", "--cameras", "cameras.json"]


def names(folder: Path) -> set[str]:
    """Return what is in the folder besides the input and its cameras."""
    return {path.name for path in folder.iterdir()} - {"in.ply", "cameras.json"}


def contents(folder: Path) -> dict[Path, bytes]:
    """Return every file below the folder."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# What is done.


@pytest.mark.parametrize(
    ("options", "budget", "settings"),
    [
        ([], Budget(ratio=0.5), Occlusion()),
        (["--ratio", "0.29"], Budget(ratio=0.29), Occlusion()),
        (["--keep", "7"], Budget(keep=7), Occlusion()),
        (["--max-mb", ".004"], Budget(max_mb=0.004), Occlusion()),
        (["--psnr", "30"], Budget(psnr=30), Occlusion()),
        (["--views", "2"], Budget(ratio=0.5), Occlusion(2)),
        (["--views", "0"], Budget(ratio=0.5), Occlusion(0)),
        (["--method", "closed-form"], Budget(ratio=0.5), ClosedForm()),
        (["--method", "occlusion"], Budget(ratio=0.5), Occlusion()),
    ],
)
def test_every_budget_and_setting_keeps_the_rows_that_the_interface_keeps(
    folder, options, budget, settings
):
    """The file is the input's bytes of exactly those rows."""
    file, views = read_ply("in.ply"), read_cameras("cameras.json")
    expected = prune(
        file,
        views,
        budget,
        settings,
    ).keep

    assert command.main([*PRUNE, "--method", "occlusion", "-o", "out.ply", *options]) == 0

    assert 0 < np.count_nonzero(expected) < COUNT
    assert file.rows[expected].tobytes() == read_ply("out.ply").rows.tobytes()
    assert {"out.ply"} == names(folder)


@pytest.mark.slow
def test_the_room_is_pruned_to_the_same_file_from_python_and_from_the_command(folder):
    """39,755 splats by the 64 most spread of 72 views, file to file."""
    source, cameras = ROOM / "point_cloud.ply", ROOM / "cameras.json"
    prune_file(source, "api.ply", read_cameras(cameras), Budget(ratio=0.3))

    done = command.main(
        ["prune", str(source), "--cameras", str(cameras), "-o", "out.ply", "--ratio", ".3"]
    )

    assert done == 0
    assert (folder / "api.ply").read_bytes() == (folder / "out.ply").read_bytes()


@pytest.mark.slow
@pytest.mark.usefixtures("folder")
def test_scores_are_written_bit_for_bit():
    """The file is the input with one more property, and nothing else."""
    file = read_ply("in.ply")
    expected = score(file.splats(), read_cameras("cameras.json"), Occlusion()).values

    assert command.main([*SCORE, "-o", "out.ply"]) == 0

    written = read_ply("out.ply")
    assert expected.tobytes() == written.rows["refine_score"].tobytes()
    assert np.dtype("<f4") == written.rows.dtype["refine_score"]
    for name in file.rows.dtype.names:
        assert file.rows[name].tobytes() == written.rows[name].tobytes()
    added = b"property float refine_score\nend_header\n"
    assert file.header.replace(b"end_header\n", added) == written.header


@pytest.mark.slow
def test_scoring_twice_writes_the_same_file(folder):
    """The property that is there is set, not added again; scores do not depend on it."""
    assert command.main([*SCORE, "-o", "once.ply"]) == 0
    assert command.main(["score", "once.ply", *SCORE[2:], "-o", "twice.ply"]) == 0

    assert (folder / "once.ply").read_bytes() == (folder / "twice.ply").read_bytes()


def test_info_says_what_is_in_a_file(folder, capsys):
    """Two splats of degree 1, x from -1 to 2, one with NaN in a property of its own.

    14 + 9 properties and the extra one, of 4 bytes each: 96 bytes a splat.
    """
    properties = [*splat_names(1), "extra"]
    values = np.zeros((2, len(properties)), "<f4")
    values[:, 0] = -1.0, 2.0
    values[1, -1] = np.nan
    header = plain_header(2, properties)
    (folder / "two.ply").write_bytes(header + values.tobytes())

    assert command.main(["info", "two.ply", "--report", "report.json"]) == 0

    expected = {
        "splats": 2,
        "sh_degree": 1,
        "bytes": len(header) + 192,
        "bytes_per_splat": 96,
        "format": "binary_little_endian 1.0",
        "model": "default",
        "extent_low": [-1.0, 0.0, 0.0],
        "extent_high": [2.0, 0.0, 0.0],
        "non_finite_rows": 1,
        "undrawable": 0,
        "extra_properties": ["extra"],
    }
    entry = json.loads((folder / "report.json").read_text())["results"][0]
    assert {"status": "done", "input": "two.ply", **expected} == entry
    text = capsys.readouterr().out
    assert text.startswith("two.ply\n")
    for name, value in expected.items():
        assert re.search(
            rf"^  {name.replace('_', ' ')} +{re.escape(str(value))}$", text, re.MULTILINE
        )


def test_info_of_a_text_file_says_how_long_a_row_is_on_average(folder):
    """Of the whole file, as of other formats; and that a PLY of it is binary."""
    row = b"0 " * 13 + b"0\n"
    header = plain_header(2, splat_names(0), "ascii")
    (folder / "two.ply").write_bytes(header + row + b" " * 5 + row)

    assert command.main(["info", "two.ply", "--report", "report.json"]) == 0

    entry = json.loads((folder / "report.json").read_text())["results"][0]
    assert entry["bytes_per_splat"] == (len(header) + 61) / 2
    assert "two.ply is text; a PLY that is written of it is binary" in entry["notes"]


def test_info_of_a_file_without_a_splat_has_no_extent(folder):
    """Nothing to measure is no error."""
    (folder / "none.ply").write_bytes(plain_header(0, splat_names(0)))

    assert command.main(["info", "none.ply", "--report", "report.json"]) == 0

    entry = json.loads((folder / "report.json").read_text())["results"][0]
    assert (entry["splats"], entry["extent_low"], entry["extent_high"]) == (0, None, None)


def test_pruning_a_file_without_a_splat_is_an_error_that_names_it(folder, capsys):
    """There is nothing that could stay."""
    (folder / "none.ply").write_bytes(plain_header(0, splat_names(0)))

    assert command.main(["prune", "none.ply", *PRUNE[2:], "-o", "out.ply"]) == 1

    assert capsys.readouterr().err == "refine: error: none.ply: there are no splats to score\n"
    assert {"none.ply"} == names(folder)


def test_the_input_can_be_its_own_output_if_asked_to(folder):
    """Refused as any file that exists; then replaced, whole."""
    before = (folder / "in.ply").read_bytes()

    assert command.main([*PRUNE, "-o", "in.ply"]) == 1
    assert before == (folder / "in.ply").read_bytes()
    assert command.main([*PRUNE, "-o", "in.ply", "--overwrite", "--keep", "5"]) == 0
    assert len(read_ply("in.ply")) == 5


# Many inputs.


def test_one_bad_file_does_not_stop_the_others(folder, capsys):
    """Each good one is written, each bad one named; the exit code and the report say so."""
    (folder / "bad.ply").write_bytes(b"ply\nnonsense")
    (folder / "also.ply").write_bytes(plain_ply(10, seed=1))

    inputs = ["in.ply", "bad.ply", "none.ply", "also.ply"]
    done = command.main(
        ["prune", *inputs, *PRUNE[2:], "-o", "made/here", "--report", "report.json"]
    )

    assert done == 1
    assert {"in.ply", "also.ply"} == {path.name for path in (folder / "made/here").iterdir()}
    assert len(read_ply("made/here/also.ply")) == 5
    said = capsys.readouterr()
    assert said.err.count("refine: error: ") == 2
    assert "refine: error: bad.ply: header without end" in said.err
    assert "refine: error: none.ply: cannot be read (No such file or directory)" in said.err
    results = json.loads((folder / "report.json").read_text())["results"]
    assert [entry["status"] for entry in results] == ["done", "failed", "failed", "done"]
    assert results[1]["input"] == "bad.ply"
    assert results[1]["error"].startswith("bad.ply: header without end")


@pytest.mark.slow
def test_a_batch_of_files_leaves_none_of_them_open_or_mapped(folder):
    """60 files: as many are open and mapped at the end as at the start."""
    if not Path("/proc/self/fd").is_dir():
        pytest.skip("counts open files as Linux shows them")
    for index in range(60):
        (folder / f"{index}.ply").write_bytes(plain_ply(20, seed=index))
    inputs = [f"{index}.ply" for index in range(60)]
    command.main(["info", "--quiet", *inputs])
    before = open_files()

    assert command.main(["prune", *inputs, *PRUNE[2:], "-o", "out", "--quiet"]) == 0

    after = open_files()
    assert len(list((folder / "out").iterdir())) == 60
    assert after[0] <= before[0]
    assert after[1] <= before[1] + 20


def open_files() -> tuple[int, int]:
    """Return how many files this process has open, and how many parts of memory are mapped."""
    maps = Path("/proc/self/maps").read_text().splitlines()
    return len(list(Path("/proc/self/fd").iterdir())), len(maps)


# What is said.


def numbers(value: object) -> list[float]:
    """Return every number in a report."""
    if isinstance(value, dict):
        return [number for item in value.values() for number in numbers(item)]
    if isinstance(value, list):
        return [number for item in value for number in numbers(item)]
    return [value] if isinstance(value, float | int) else []


def test_the_report_of_a_prune_is_complete_and_plain(folder):
    """Counts, settings, weights, timings, versions, notes, sizes; valid JSON without NaN."""
    arguments = [*PRUNE, *CLOSED, "-o", "out.ply", "--keep", "9", "--report", "report.json"]
    assert command.main(arguments) == 0

    def refuse(name):
        pytest.fail(f"{name} is no JSON")

    report = json.loads((folder / "report.json").read_text(), parse_constant=refuse)
    (entry,) = report["results"]
    assert (VERSION, np.__version__) == (report["refine"], report["numpy"])
    assert (entry["status"], entry["budget"]) == ("done", {"keep": 9})
    assert entry["views"] == {"given": 5, "used": 5}
    assert tuple(entry["splats"][name] for name in ("before", "kept", "removed")) == (
        COUNT,
        9,
        COUNT - 9,
    )
    assert (entry["files"]["input"], entry["files"]["output"]) == ("in.ply", "out.ply")
    for name in ("input", "output"):
        size = (folder / entry["files"][name]).stat().st_size
        assert size == entry["files"][f"{name}_bytes"]
    assert entry["settings"]["method"] == "closed-form"
    assert math.isclose(1.0, sum(entry["weights"]["lambda"].values()))
    assert {"read_s", "score_s", "select_s", "write_s", "total_s"} == set(entry["timings"])
    assert 0 < entry["timings"]["total_s"] <= report["seconds"]
    assert entry["notes"] == []
    assert all(map(math.isfinite, numbers(report)))


@pytest.mark.slow
def test_the_report_of_scores_is_plain_too(folder):
    """Counts, weights and the files' names; unseen is what no view counts as seen."""
    seen = score(read_ply("in.ply").splats(), read_cameras("cameras.json"), Occlusion()).seen
    unseen = int(np.count_nonzero(seen == 0))
    assert command.main([*SCORE, "-o", "out.ply", "--report", "report.json"]) == 0

    (entry,) = json.loads((folder / "report.json").read_text())["results"]
    sizes = [(folder / name).stat().st_size for name in ("in.ply", "out.ply")]
    assert [*entry["files"].values()] == ["in.ply", "out.ply", *sizes]
    counts = {"before": COUNT, "undrawable": 0, "unseen": unseen, "removed_by_user": 0}
    assert entry["splats"] == counts | {"written": COUNT, "left_out": 0}
    assert all(map(math.isfinite, numbers(entry)))


@pytest.mark.usefixtures("folder")
def test_the_summary_says_what_went_and_where_it_is(capsys):
    """Counts, megabytes, views, seconds, the output; what no view sees; nothing on stderr."""
    assert command.main([*PRUNE, *CLOSED, "-o", "out.ply", "--keep", "9"]) == 0

    said = capsys.readouterr()
    pattern = (
        r"in\.ply: kept 9 of 60 splats \(85\.0% removed\), 6\.1 -> 1\.4 kB, by 5 of 5 views, "
        r"\d+\.\d\d s -> out\.ply\n  \d+ of 60 splats lie in no view\n"
        r"  \d+% of these go: add views if others can see them\n"
    )
    assert re.fullmatch(pattern, said.out)
    assert said.err == ""


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--method", "refit", "--rounds", "1000000"], "rounds is 1000000, expected 1 to 100"),
        (["--rounds", "3"], "rounds is 3, expected only with --method refit"),
    ],
)
def test_rounds_out_of_range_are_refused(capsys, options, words):
    """With what was got and what was expected; nothing is written."""
    assert command.main([*PRUNE, "-o", "out.ply", "--overwrite", *options]) != 0
    assert words in capsys.readouterr().err


@pytest.mark.usefixtures("folder")
def test_the_summary_says_how_close_the_pictures_stay(capsys):
    """As the report does, in whole decibels; and why not what merging would reach."""
    for options, pattern in (
        (
            ["--method", "occlusion"],
            r"  quality: about \d+ dB in these views, about \d+ between them; what merging and ",
        ),
        (
            ["--method", "merge"],
            r"quality: about \d+ dB in these views, about \d+ between them \(--method occlus",
        ),
        (
            ["--method", "occlusion", "--ratio", "0"],
            r"  quality: more than 60 dB in these views and between them$",
        ),
    ):
        assert command.main([*PRUNE, "-o", "out.ply", "--overwrite", *options]) == 0

        assert re.search(pattern, capsys.readouterr().out, re.MULTILINE)


@pytest.mark.slow
def test_a_psnr_is_kept_by_every_method(folder):
    """By the estimate in the report, to the next of 60 splats; the closed form makes one too."""
    for options in ([], CLOSED, ["--method", "occlusion"]):
        arguments = [*PRUNE, "-o", "out.ply", "--overwrite", "--report", "r.json", *options]
        assert command.main([*arguments, "--psnr", "30"]) == 0

        (entry,) = json.loads((folder / "r.json").read_text())["results"]
        assert entry["budget"] == {"psnr": 30.0}
        assert entry["estimated_psnr"] == pytest.approx(30.0, abs=2.0)


@pytest.mark.parametrize(
    "arguments", [[*PRUNE, "-o", "out.ply"], [*SCORE, "-o", "out.ply"], ["info", "in.ply"]]
)
def test_quiet_is_silent(folder, capsys, arguments):
    """Not a byte on either stream; errors are still said."""
    assert command.main([*arguments, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")

    (folder / "in.ply").write_bytes(b"")
    assert command.main([*arguments, "--quiet", "--overwrite"]) == 1
    expected = "refine: error: in.ply: the file is empty, expected a PLY\n"
    assert ("", expected) == capsys.readouterr()


@pytest.mark.slow
def test_a_dry_run_says_the_same_and_writes_nothing(folder, capsys):
    """Not even the folder of the outputs; a report is written where asked for."""
    assert command.main([*PRUNE, "--dry-run"]) == 0
    assert command.main([*PRUNE, "--dry-run", "-o", "out.ply"]) == 0
    assert command.main([*PRUNE, "--dry-run", "-o", "made"]) == 0
    assert set() == names(folder)

    assert command.main([*PRUNE, "--dry-run", "--report", "report.json"]) == 0

    assert {"report.json"} == names(folder)
    (entry,) = json.loads((folder / "report.json").read_text())["results"]
    assert (entry["files"]["output"], entry["splats"]["kept"]) == (None, 30)
    assert capsys.readouterr().out.count("in.ply: would keep 30 of 60 splats (50.0% removed)") == 4


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [["--dry-run"], ["-o", "out.ply"], ["-o", "out.splat", "--method", "merge"]],
    ids=["dry run", "written", "merged, rounded"],
)
def test_pictures_show_what_was_and_what_is_written(folder, capsys, options):
    """Of five cameras along a line three are drawn: both ends and the middle; 100 x 75 px each."""
    shown = [*PRUNE, *options, "--pictures", "shown", "--report", "report.json"]

    assert command.main(shown) == 0

    (entry,) = json.loads((folder / "report.json").read_text())["results"]
    drawn = entry["pictures"]
    assert [view["camera"] for view in drawn["views"]] == ["-0.4", "0.0", "0.4"]
    assert names(folder / "shown") == {
        f"in-{camera}-{kind}.png"
        for camera in ("-0.4", "0.0", "0.4")
        for kind in ("before", "after", "difference")
    }
    before = read_ply(folder / "in.ply").splats()
    made = folder / options[1] if "-o" in options else None
    decided = prune(before, read_cameras(folder / "cameras.json"), Budget(ratio=0.5))
    after = read_splats(made).splats() if made else decided.splats
    found = compare(before, after, read_cameras(folder / "cameras.json").spread(CAMERAS))
    assert [view["psnr"] for view in drawn["views"]] == [round(one.psnr, 2) for one in found]
    for view, one in zip(drawn["views"], found, strict=True):
        assert (folder / view["after"]).read_bytes() == png(one.after)
    assert f"pictures: {drawn['psnr']:.1f} dB measured in 3 views" in capsys.readouterr().out


def test_pictures_that_exist_are_left_alone_and_nothing_is_pruned(folder, capsys):
    (folder / "shown").mkdir()
    (folder / "shown/in-0.0-after.png").write_bytes(b"precious")

    assert command.main([*PRUNE, "-o", "out.ply", "--pictures", "shown"]) == 1

    assert "in-0.0-after.png: exists already" in capsys.readouterr().err
    assert names(folder / "shown") == {"in-0.0-after.png"}
    assert not (folder / "out.ply").exists()
    assert command.main([*PRUNE, "-o", "out.ply", "--pictures", "shown", "--overwrite"]) == 0
    assert (folder / "shown/in-0.0-after.png").read_bytes().startswith(b"\x89PNG")


def test_ctrl_c_while_pictures_are_drawn_says_that_the_file_is_written(folder, monkeypatch, capsys):
    """The same command would refuse it, so it is named."""

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(PictureFiles, "write", stop)

    assert command.main([*PRUNE, "-o", "out.ply", "--pictures", "shown"]) == 130

    assert names(folder) == {"out.ply"}
    assert "out.ply is written, its pictures and report are not;" in capsys.readouterr().err


def test_pictures_have_names_that_the_system_takes(folder):
    """Of a camera's name its last 80 bytes: 26 characters of 3; systems take names of 255 bytes."""
    told = json.loads((folder / "cameras.json").read_text())
    for number, camera in enumerate(told):
        camera["img_name"] = f"{'像' * 120}{number}.jpg"
    (folder / "cameras.json").write_text(json.dumps(told))

    assert command.main([*PRUNE, "--dry-run", "--pictures", "shown"]) == 0

    label = "像" * 26
    assert {name for name in names(folder / "shown") if "after" in name} == {
        f"in-{label}{number}-after.png" for number in (0, 2, 4)
    }


@pytest.mark.parametrize("more", [["--pictures", "a/new"], ["-o", "a/new"]])
def test_what_is_refused_leaves_no_empty_folder(folder, more):
    """A file whose pictures have longer names than there are, and one that is not there."""
    long = "x" * 245 + ".ply"
    (folder / "in.ply").rename(folder / long)
    source = long if "--pictures" in more else "in.ply"
    output = [] if "-o" in more else ["-o", "out.ply"]
    before = sorted(folder.iterdir())

    assert command.main(["prune", source, *PRUNE[2:], *output, *more]) == 1

    assert sorted(folder.iterdir()) == before


@pytest.mark.slow
def test_a_name_that_the_terminal_cannot_show_is_no_error(folder):
    """As bytes that are no UTF-8, and on a terminal that knows ASCII alone."""
    try:
        (folder / "b\udcff ü.ply").write_bytes(plain_ply())
    except (OSError, UnicodeError):
        pytest.skip("this file system takes no such name")
    for encoding in ("utf-8", "ascii"):
        done = run("info", "b\udcff ü.ply", environment={"PYTHONIOENCODING": encoding})
        assert (done.returncode, done.stderr) == (0, b"")
        assert b"\\udcff" in done.stdout


# What is refused.

USAGE = {
    "nothing": [],
    "unknown command": ["shrink", "in.ply"],
    "no input": ["prune", "--cameras", "cameras.json", "-o", "out.ply"],
    "no output": PRUNE,
    "no cameras": ["prune", "in.ply", "-o", "out.ply"],
    "one output of two": ["prune", "in.ply", "b.ply", *PRUNE[2:], "-o", "out.ply"],
    "one picture twice": ["prune", "in.ply", "in.spz", *PRUNE[2:], "--dry-run", "--pictures", "p"],
    "no name of pictures": [*PRUNE, "--dry-run", "--pictures", ""],
    "one name twice": ["prune", "in.ply", "b/in.ply", *PRUNE[2:], "-o", "made"],
    "two budgets": [*PRUNE, "-o", "out.ply", "--ratio", ".5", "--keep", "3"],
    "ratio of 1": [*PRUNE, "-o", "out.ply", "--ratio", "1"],
    "ratio below 0": [*PRUNE, "-o", "out.ply", "--ratio", "-.1"],
    "ratio that is none": [*PRUNE, "-o", "out.ply", "--ratio", "nan"],
    "ratio in words": [*PRUNE, "-o", "out.ply", "--ratio", "half"],
    "keep none": [*PRUNE, "-o", "out.ply", "--keep", "0"],
    "keep a part": [*PRUNE, "-o", "out.ply", "--keep", "1.5"],
    "no megabytes": [*PRUNE, "-o", "out.ply", "--max-mb", "0"],
    "endless megabytes": [*PRUNE, "-o", "out.ply", "--max-mb", "inf"],
    "equal pictures": [*PRUNE, "-o", "out.ply", "--psnr", "100"],
    "no pictures": [*PRUNE, "-o", "out.ply", "--psnr", "0"],
    "views below 0": [*PRUNE, "-o", "out.ply", "--views", "-1"],
    "rounds of nothing": [*PRUNE, "-o", "out.ply", "--rounds", "2"],
    "no rounds": [*PRUNE, "-o", "out.ply", "--method", "refit", "--rounds", "0"],
    "unknown method": [*PRUNE, "-o", "out.ply", "--method", "guess"],
    "a source that is none": [*PRUNE, "-o", "out.ply", "--source", "visble"],
    "a collection without a name": [*PRUNE, "-o", "out.ply", "--source", "collection:"],
    "frames that end before they start": [*PRUNE, "-o", "out.ply", "--source", "frames:3:1"],
    "a source without Blender": ["prune", "in.ply", "-o", "out.ply", "--source", "frames:1:3"],
    "render without Blender": ["render"],
    "object without Blender": ["prune", "--object", "Splats", "-o", "out.ply", *PRUNE[2:]],
    "save without object": [*PRUNE, "-o", "out.ply", "--save"],
    "object and input": [*PRUNE, "--object", "Splats", "-o", "out.ply"],
    "output of nobody": [*PRUNE, "-o", "~nobody-of-that-name/out.ply"],
    "report over the input": [*PRUNE, "-o", "out.ply", "--report", "./in.ply", "--overwrite"],
    "report over the output": [*PRUNE, "-o", "out.ply", "--report", "out.ply"],
    "report over an output": [*PRUNE, "-o", "made", "--report", "made/in.ply"],
    "report over other splats": [*PRUNE, "--dry-run", "--report", "b.ply", "--overwrite"],
    "report over other cameras": [*PRUNE, "--dry-run", "--report", "t.json", "--overwrite"],
    "output that is not named as splats": [
        *("prune", "in.dat", *PRUNE[2:], "-o", "made", "--overwrite"),
    ],
    "an option in part": [*PRUNE, "-o", "out.ply", "--rat", ".5"],
    "no name of cameras": ["prune", "in.ply", "--cameras", "", "-o", "out.ply"],
    "no name of an input": ["prune", "", *PRUNE[2:], "-o", "out.ply"],
    "no name of an input to describe": ["info", "in.ply", ""],
    "no name of an output": [*PRUNE, "-o", ""],
    "no name of a folder": [*PRUNE, "-o", ""],
    "no name of a report": [*PRUNE, "-o", "out.ply", "--report", ""],
    "no name of an object": [*PRUNE, "-o", "out.ply", "--object", ""],
    "no name of an output of scores": [*SCORE, "-o", ""],
    "a name with a zero byte": [*PRUNE, "-o", "out\0.ply"],
    "cameras with a zero byte": ["prune", "in.ply", "--cameras", "c\0", "-o", "out.ply"],
    "report over the cameras": [*PRUNE, "--dry-run", "--report", "cameras.json", "--overwrite"],
    "score of two": ["score", "in.ply", "b.ply", *SCORE[2:], "-o", "out.ply"],
    "score to another format": [*SCORE, "-o", "out.spz"],
    "score to nowhere": SCORE,
    "score of nothing": ["score", *SCORE[2:], "-o", "out.ply"],
    "score of object and input": [*SCORE, "--object", "Splats", "-o", "out.ply"],
    "score of object without Blender": ["score", "--object", "x", *SCORE[2:], "-o", "out.ply"],
    "score without cameras": ["score", "in.ply", "-o", "out.ply"],
    "info of nothing": ["info"],
    "info with a budget": ["info", "in.ply", "--ratio", ".5"],
}


@pytest.mark.parametrize("name", USAGE)
def test_wrong_usage_is_code_2_and_one_sentence(folder, capsys, name):
    """Before anything is read or written: the usage, then the error."""
    (folder / "made").mkdir()
    for path, content in (("b.ply", b"ply\n"), ("t.json", b'{"frames": []}'), ("in.dat", b"ply\n")):
        (folder / path).write_bytes(content)
    (folder / "made/in.dat").write_bytes(b"notes")
    before = contents(folder)

    assert command.main(USAGE[name]) == 2

    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("usage: refine")
    assert re.search(r"\nrefine[a-z ]*: error: .+\n\Z", said.err)
    assert contents(folder) == before


LONG = "n" * 300  # file systems take 255 bytes

FAILS = {
    "no input": (["prune", "none.ply", *PRUNE[2:], "-o", "out.ply"], "none.ply: cannot be read"),
    "a folder": (["prune", "folder", *PRUNE[2:], "-o", "out.ply"], "folder: is a folder, expected"),
    "a mesh": (["prune", "mesh.ply", *PRUNE[2:], "-o", "out.ply"], "mesh.ply: a point cloud, not"),
    "cut off": (
        ["prune", "cut.ply", *PRUNE[2:], "-o", "out.ply"],
        "cut.ply: truncated: the header",
    ),
    "no cameras": (
        ["prune", "in.ply", "--cameras", "none.json", "-o", "out.ply"],
        "none.json: no such file or folder, expected cameras",
    ),
    "cameras that are none": (
        ["prune", "in.ply", "--cameras", "in.ply", "-o", "out.ply"],
        "in.ply: not a camera file",
    ),
    "cameras that see nothing": (
        ["prune", "in.ply", "--cameras", "away.json", "-o", "out.ply"],
        "in.ply: no camera sees the splats: none of 60 reaches into the image of any of 1 views",
    ),
    "an output that exists": ([*PRUNE, "-o", "mesh.ply"], "mesh.ply: exists already; choose"),
    "an output that is a folder": ([*PRUNE, "-o", "f.ply", "--overwrite"], "f.ply: is a folder"),
    "an output nowhere": ([*PRUNE, "-o", "none/out.ply"], "none/out.ply: cannot be written, there"),
    "a folder that is a file": ([*PRUNE, "-o", "notes"], "notes: cannot be made ("),
    "a folder in a file": (
        [*PRUNE, "-o", "mesh.ply/in"],
        "mesh.ply/in: cannot be made",
    ),
    "a report that exists": (
        [*PRUNE, "-o", "out.ply", "--report", "mesh.ply"],
        "mesh.ply: exists already; choose another name, or set overwrite",
    ),
    "a report nowhere": (
        [*PRUNE, "-o", "out.ply", "--report", "none/report.json"],
        "none/report.json: cannot be written, there is no folder none",
    ),
    "a report that is a folder": (
        [*PRUNE, "-o", "out.ply", "--report", "folder", "--overwrite"],
        "folder: is a folder, expected",
    ),
    "a report through a link to nowhere": (
        [*PRUNE, "-o", "out.ply", "--report", "link.json"],
        "link.json: cannot be written, there is no folder",
    ),
    "an input of too long a name": (
        ["prune", LONG, *PRUNE[2:], "-o", "out.ply"],
        f"{LONG}: cannot be read (File name too long)",
    ),
    "cameras of too long a name": (
        ["prune", "in.ply", "--cameras", LONG, "-o", "out.ply"],
        f"{LONG}: cannot be read (File name too long)",
    ),
    "an output of too long a name": ([*PRUNE, "-o", f"{LONG}.ply"], f"{LONG}.ply: cannot be "),
    "a folder of too long a name": ([*PRUNE, "-o", LONG], f"{LONG}: cannot be made (File name"),
    "a report of too long a name": (
        [*PRUNE, "-o", "out.ply", "--report", LONG],
        f"{LONG}: cannot be written (File name too long); nothing was changed",
    ),
    "info of too long a name": (
        ["info", LONG],
        f"{LONG}: cannot be read (File name too long)",
    ),
    "too small a size": (
        [*PRUNE, "-o", "out.ply", "--max-mb", "1e-6"],
        "in.ply: max_mb is 1e-06",
    ),
    "scores over a file": ([*SCORE, "-o", "mesh.ply"], "mesh.ply: exists already; choose another"),
    "info of nothing": (
        ["info", "none.ply"],
        "none.ply: cannot be read (No such file or directory)",
    ),
}


@pytest.mark.parametrize("name", FAILS)
def test_what_fails_is_code_1_and_one_sentence_that_names_the_file(folder, capsys, name):
    """No traceback, nothing written, and every file as it was."""
    arguments, expected = FAILS[name]
    (folder / "folder").mkdir()
    (folder / "f.ply").mkdir()
    (folder / "notes").write_bytes(b"mine")
    (folder / "link.json").symlink_to(folder / "none/report.json")
    (folder / "mesh.ply").write_bytes(plain_header(0, ["x", "y", "z"]))
    (folder / "cut.ply").write_bytes(plain_ply(COUNT)[:-1])
    away = json.loads((folder / "cameras.json").read_text())[:1]
    away[0]["position"] = [0, 0, 100]
    (folder / "away.json").write_text(json.dumps(away))
    before = contents(folder)

    assert command.main(arguments) == 1

    said = capsys.readouterr()
    assert said.err.startswith(f"refine: error: {expected}")
    assert said.err.count("\n") == 1
    assert before == contents(folder)


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_help_and_version_are_code_0(capsys, option):
    """On stdout, for a pager."""
    assert command.main([option]) == 0
    assert f"refine {VERSION}\n" == capsys.readouterr().out or option == "--help"


@pytest.mark.parametrize("name", ["prune", "score", "info"])
def test_every_command_has_help(capsys, name):
    """Every option is in it."""
    assert command.main([name, "--help"]) == 0
    text = capsys.readouterr().out
    assert "--report FILE.json" in text
    assert ("--ratio B" in text) == (name == "prune")


# The process.


def run(*arguments: str, environment: dict[str, str] | None = None, **options):
    """Run ``python -m refine_addon`` in the current folder."""
    paths = {"PYTHONPATH": str(ROOT), **(environment or {})}
    return subprocess.run(
        [sys.executable, "-W", "error", "-m", "refine_addon", *arguments],
        env={**os.environ, **paths},
        capture_output=options.pop("capture_output", True),
        timeout=600,
        check=False,
        **options,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "code"),
    [([*PRUNE, "-o", "out.ply"], 0), ([*PRUNE, "-o", "none/out.ply"], 1), (["prune"], 2)],
)
@pytest.mark.usefixtures("folder")
def test_the_exit_code_is_that_of_the_process(arguments, code):
    """And nothing but the summary is printed, warnings included."""
    done = run(*arguments)

    assert code == done.returncode
    assert (code == 0) == (done.stderr == b"")
    assert b"Traceback" not in done.stderr


@pytest.mark.parametrize("stage", ["score", "write_rows"])
def test_cancelled_anywhere_it_is_code_130(folder, monkeypatch, capsys, stage):
    """From Python, as if Ctrl-C came while scoring or while writing."""

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    module = {"score": closed_form, "write_rows": ply}[stage]
    monkeypatch.setattr(module, stage, interrupt)

    assert command.main([*PRUNE, "-o", "out.ply", "--report", "report.json"]) == 130

    assert capsys.readouterr().err == "refine: error: cancelled; nothing was left half-written\n"
    assert set() == names(folder)


@pytest.mark.slow
@pytest.mark.usefixtures("folder")
def test_progress_is_drawn_on_a_terminal_and_wiped_away():
    """On a pseudo-terminal: lines that overwrite each other, the last of them empty."""
    pty = pytest.importorskip("pty")
    for quiet in (False, True):
        ours, theirs = pty.openpty()
        more = ["--quiet"] if quiet else []
        done = run(
            *PRUNE, "-o", "out.ply", "--overwrite", *more,
            stdout=subprocess.PIPE, stderr=theirs, capture_output=False,
        )  # fmt: skip
        os.close(theirs)
        drawn = read_all(ours)

        assert done.returncode == 0
        if quiet:
            assert b"" == drawn == done.stdout
        else:
            steps = drawn.split(b"\r\x1b[K")
            assert b"" == steps[0] == steps[-1]
            assert any(re.fullmatch(rb"in\.ply: scoring +\d+%", step) for step in steps)
            assert any(re.fullmatch(rb"in\.ply: writing +\d+%", step) for step in steps)
            assert b"\x1b" not in done.stdout


def read_all(descriptor: int) -> bytes:
    """Return what a terminal was sent, until its other end is closed."""
    drawn = b""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        try:
            more = os.read(descriptor, 4096)
        except OSError:  # Linux says so that there is no other end
            break
        if not more:
            break
        drawn += more
    os.close(descriptor)
    return drawn


def test_an_output_never_replaces_what_is_no_splat_file(folder, capsys):
    """Cameras, a scene, notes: only what is named as splats is a file that is made."""
    before = (folder / "cameras.json").read_bytes()

    code = command.main([*PRUNE, "-o", "cameras.json", "--overwrite"])

    assert code == 1
    assert "cameras.json: cannot be made (File exists)" in capsys.readouterr().err
    assert (folder / "cameras.json").read_bytes() == before


@pytest.mark.parametrize("option", ["-o", "--report", "--pictures"])
def test_nothing_is_written_to_standard_output(folder, capsys, option):
    """A lone - stands for it elsewhere: a file of that name would be found by nobody."""
    before = sorted(folder.iterdir())

    assert command.main([*PRUNE, option, "-"]) == 2

    assert "nothing is written to standard output" in capsys.readouterr().err
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize("name", ["out.ply.gz", "out.PLY.BZ2", "out.splat.zip"])
def test_an_output_that_is_named_as_compressed_is_refused(folder, capsys, name):
    """It would hold a plain PLY; in one sentence, before anything is read."""
    assert command.main([*PRUNE, "-o", name]) == 2

    assert "is not written, expected one of .ply" in capsys.readouterr().err
    assert not (folder / name).exists()


def test_info_of_a_signalling_not_a_number_does_not_warn(folder, capsys):
    """Only finite means are widened to float64."""
    file = read_ply("in.ply")
    rows = file.rows.copy()
    rows["x"].view(np.uint32)[0] = 0x7F800001
    replace(file, rows=rows).write("snan.ply")

    with np.errstate(all="raise"):
        assert command.main(["info", "snan.ply"]) == 0
    assert "non finite rows    1" in capsys.readouterr().out
