"""The command without Blender: every option, exit codes, reports, what is left when it stops."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from refine_addon import command
from refine_addon.core import (
    Budget,
    ClosedForm,
    Merge,
    Occlusion,
    prune_file,
    read_cameras,
    read_ply,
    read_splats,
    score,
)
from refine_addon.core.images import png
from refine_addon.core.pictures import CAMERAS, PictureFiles, compare
from refine_addon.version import VERSION
from tests.places import ROOT
from tests.strategies import cameras_json, plain_header, plain_ply, splat_names

COUNT = 60
PRUNE = ["prune", "in.ply", "--cameras", "cameras.json"]
MADE = [*PRUNE, "-o", "out.ply"]
SCORE = ["score", "in.ply", "--cameras", "cameras.json"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Stand in a folder with a splat file and five cameras around it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in.ply").write_bytes(plain_ply(COUNT, 1))
    places = {str(x): [x, 0.1 * x * x, 0.0] for x in (-0.4, -0.2, 0.0, 0.2, 0.4)}
    (tmp_path / "cameras.json").write_text(cameras_json(places, 180.0, 40, 30))
    return tmp_path


def names(folder):
    """Return what is in the folder besides the input and its cameras."""
    return {path.name for path in folder.iterdir()} - {"in.ply", "cameras.json"}


def contents(folder):
    """Return every file below the folder, and None for each folder."""
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def told():
    """Return the only entry of the report."""
    (entry,) = json.loads(Path("report.json").read_text())["results"]
    return entry


def run(*arguments, encoding="utf-8", **options):
    """Run the command in a process where warnings are errors, but of files left open at the end."""
    named = {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "", "PYTHONIOENCODING": encoding}
    words = ["-B", "-W", "error", "-W", "ignore::ResourceWarning", "-m", "refine_addon", *arguments]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    return subprocess.run(
        [sys.executable, *words], env={**os.environ, **named}, timeout=600, check=False, **options
    )


@pytest.mark.parametrize(
    ("options", "budget", "settings"),
    [
        (["--ratio", "0.29"], Budget(ratio=0.29), Occlusion()),
        (["--keep", "7"], Budget(keep=7), Occlusion()),
        (["--max-mb", ".004"], Budget(max_mb=0.004), Occlusion()),
        (["--psnr", "30"], Budget(psnr=30), Occlusion()),
        (["--views", "2"], Budget(ratio=0.5), Occlusion(2)),
        (["--method", "closed-form"], Budget(ratio=0.5), ClosedForm()),
        (["--method", "merge", "--ratio", ".7"], Budget(ratio=0.7), Merge()),
    ],
)
def test_every_budget_and_setting_writes_the_file_that_python_writes(
    folder, options, budget, settings
):
    prune_file("in.ply", "api.ply", read_cameras("cameras.json"), budget, settings)

    assert command.main([*MADE, "--method", "occlusion", *options]) == 0

    assert 0 < len(read_ply("out.ply")) < COUNT
    assert (folder / "api.ply").read_bytes() == (folder / "out.ply").read_bytes()
    assert names(folder) == {"api.ply", "out.ply"}


@pytest.mark.slow
def test_scores_are_written_bit_for_bit_and_twice_alike(folder):
    """The file is the input with one more property, which a second run sets anew."""
    file = read_ply("in.ply")
    expected = score(file.splats(), read_cameras("cameras.json"), Occlusion()).values

    assert command.main([*SCORE, "-o", "out.ply"]) == 0
    assert command.main(["score", "out.ply", *SCORE[2:], "-o", "twice.ply"]) == 0

    written = read_ply("out.ply")
    assert expected.tobytes() == written.rows["refine_score"].tobytes()
    assert written.rows[list(file.rows.dtype.names)].tolist() == file.rows.tolist()
    added = b"property float refine_score\nend_header\n"
    assert file.header.replace(b"end_header\n", added) == written.header
    assert (folder / "out.ply").read_bytes() == (folder / "twice.ply").read_bytes()


def test_info_says_what_is_in_a_file(folder, capsys):
    """Two splats of degree 1, x from -1 to 2, one with a signalling NaN in a property of its own.
    14 + 9 properties and the extra one, of 4 bytes each: 96 bytes a splat. A row of text is as
    long as the average; nothing to measure is no error; nothing warns."""
    properties = [*splat_names(1), "extra"]
    values = np.zeros((2, len(properties)), "<f4")
    values[:, 0] = -1.0, 2.0
    values.view(np.uint32)[1, -1] = 0x7F800001
    header = plain_header(2, properties)
    (folder / "two.ply").write_bytes(header + values.tobytes())
    row = b"0 " * 13 + b"0\n"
    text_header = plain_header(2, splat_names(0), "ascii")
    (folder / "text.ply").write_bytes(text_header + row + b" " * 5 + row)
    (folder / "none.ply").write_bytes(plain_header(0, splat_names(0)))

    with np.errstate(all="raise"):
        words = ["info", "two.ply", "text.ply", "none.ply", "--report", "report.json"]
        assert command.main(words) == 0

    two, text, none = json.loads((folder / "report.json").read_text())["results"]
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
    assert two == {"status": "done", "input": "two.ply", **expected}
    said = capsys.readouterr().out
    for name, value in expected.items():
        line = rf"^  {name.replace('_', ' ')} +{re.escape(str(value))}$"
        assert re.search(line, said, re.MULTILINE)
    assert text["bytes_per_splat"] == (len(text_header) + 61) / 2
    assert (none["splats"], none["extent_low"], none["extent_high"]) == (0, None, None)


def test_one_bad_file_does_not_stop_the_others(folder, capsys):
    """Each good one is written, each bad one named; the exit code and the report say so."""
    (folder / "bad.ply").write_bytes(b"ply\nnonsense")
    (folder / "also.ply").write_bytes(plain_ply(10, seed=1))
    inputs = ["in.ply", "bad.ply", "none.ply", "also.ply"]
    words = ["prune", *inputs, *PRUNE[2:], "-o", "made/here", "--report", "report.json"]

    assert command.main(words) == 1

    assert {"in.ply", "also.ply"} == {path.name for path in (folder / "made/here").iterdir()}
    assert len(read_ply("made/here/also.ply")) == 5
    bad, none = capsys.readouterr().err.splitlines()
    assert none == "refine: error: none.ply: cannot be read (No such file or directory)"
    results = json.loads((folder / "report.json").read_text())["results"]
    assert [entry["status"] for entry in results] == ["done", "failed", "failed", "done"]
    assert bad == f"refine: error: {results[1]['error']}"


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts files as Linux shows them")
def test_a_batch_of_files_leaves_none_of_them_open_or_mapped(folder):
    def held():
        maps = Path("/proc/self/maps").read_text().splitlines()
        return len(list(Path("/proc/self/fd").iterdir())), len(maps)

    inputs = [f"{index}.ply" for index in range(40)]
    for name in inputs:
        (folder / name).write_bytes(plain_ply(20))
    command.main(["info", "--quiet", *inputs])
    before = held()

    words = ["prune", *inputs, *PRUNE[2:], "-o", "out", "--quiet", "--method", "closed-form"]
    assert command.main(words) == 0

    after = held()
    assert after[0] <= before[0]
    assert after[1] <= before[1] + 20


def test_summary_and_report_of_a_prune_are_complete(folder, capsys):
    """Counts, settings, weights, timings, versions, notes, sizes; valid JSON without NaN."""
    words = [*MADE, "--method", "closed-form", "--keep", "9", "--report", "report.json"]
    assert command.main(words) == 0

    report = json.loads((folder / "report.json").read_text(), parse_constant=pytest.fail)
    (entry,) = report["results"]
    assert (VERSION, np.__version__) == (report["refine"], report["numpy"])
    assert (entry["status"], entry["budget"]) == ("done", {"keep": 9})
    counts = [entry["splats"][name] for name in ("before", "kept", "removed")]
    assert counts == [COUNT, 9, COUNT - 9]
    sizes = [(folder / name).stat().st_size for name in ("in.ply", "out.ply")]
    assert [*entry["files"].values()] == ["in.ply", "out.ply", *sizes]
    assert sum(entry["weights"]["lambda"].values()) == pytest.approx(1.0)
    assert {"read_s", "score_s", "select_s", "write_s", "total_s"} == set(entry["timings"])
    assert 0 < entry["timings"]["total_s"] <= report["seconds"]
    said = capsys.readouterr()
    assert said.out.startswith("in.ply: kept 9 of 60 splats (85.0% removed), 6.1 -> 1.4 kB, by 5 o")
    assert f"\n  {entry['splats']['unseen']} of 60 splats lie in no view\n" in said.out
    assert said.err == ""


@pytest.mark.parametrize("arguments", [MADE, [*SCORE, "-o", "out.ply"], ["info", "in.ply"]])
def test_quiet_is_silent_but_for_errors(folder, capsys, arguments):
    assert command.main([*arguments, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")

    (folder / "in.ply").write_bytes(b"")
    assert command.main([*arguments, "--quiet", "--overwrite"]) == 1
    expected = "refine: error: in.ply: the file is empty, expected a PLY\n"
    assert ("", expected) == capsys.readouterr()


@pytest.mark.slow
def test_a_dry_run_says_the_same_and_writes_nothing(folder, capsys):
    """Not even the folder of the outputs; a report is written where asked for."""
    for options in (["-o", "out.ply"], ["-o", "made"], ["--report", "report.json"]):
        assert command.main([*PRUNE, "--dry-run", *options]) == 0

    assert names(folder) == {"report.json"}
    assert (told()["files"]["output"], told()["splats"]["kept"]) == (None, 30)
    assert capsys.readouterr().out.count("in.ply: would keep 30 of 60 splats (50.0% removed)") == 3


@pytest.mark.slow
@pytest.mark.parametrize("options", [["--dry-run"], ["-o", "out.splat", "--method", "merge"]])
def test_pictures_show_what_was_and_what_is_written(folder, capsys, options):
    """Of five cameras along a line three are drawn: both ends and the middle."""
    assert command.main([*PRUNE, *options, "--pictures", "shown", "--report", "report.json"]) == 0

    drawn = told()["pictures"]
    assert [view["camera"] for view in drawn["views"]] == ["-0.4", "0.0", "0.4"]
    kinds = ("before", "after", "difference")
    stems = ("in--0.4", "in-0.0", "in-0.4")
    assert names(folder / "shown") == {f"{stem}-{kind}.png" for stem in stems for kind in kinds}
    views = read_cameras("cameras.json")
    prune_file("in.ply", "api.ply", views, Budget(ratio=0.5))
    after = read_splats("out.splat" if "-o" in options else "api.ply").splats()
    found = compare(read_ply("in.ply").splats(), after, views.spread(CAMERAS))
    assert [view["psnr"] for view in drawn["views"]] == [round(one.psnr, 2) for one in found]
    for view, one in zip(drawn["views"], found, strict=True):
        assert (folder / view["after"]).read_bytes() == png(one.after)
    assert f"pictures: {drawn['psnr']:.1f} dB measured in 3 views" in capsys.readouterr().out


def test_pictures_that_exist_are_left_alone_and_nothing_is_pruned(folder, capsys):
    """Of a camera's name its last 80 bytes are in theirs, 26 characters of 3: systems take 255."""
    cameras = json.loads((folder / "cameras.json").read_text())
    for number, camera in enumerate(cameras):
        camera["img_name"] = f"{'像' * 120}{number}.jpg"
    (folder / "cameras.json").write_text(json.dumps(cameras))
    (folder / "shown").mkdir()
    first, *more = [folder / f"shown/in-{'像' * 26}{number}-after.png" for number in (0, 2, 4)]
    first.write_bytes(b"precious")
    before = contents(folder)

    assert command.main([*MADE, "--pictures", "shown"]) == 1

    assert f"{first.name}: exists already" in capsys.readouterr().err
    assert contents(folder) == before
    assert command.main([*MADE, "--pictures", "shown", "--overwrite"]) == 0
    assert {first, *more} == set((folder / "shown").glob("*after.png"))
    assert first.read_bytes().startswith(b"\x89PNG")


def test_ctrl_c_while_pictures_are_drawn_says_that_the_file_is_written(folder, monkeypatch, capsys):
    """The same command would refuse it, so it is named."""

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(PictureFiles, "write", stop)

    assert command.main([*MADE, "--pictures", "shown"]) == 130

    assert names(folder) == {"out.ply"}
    assert "out.ply is written, its pictures and report are not;" in capsys.readouterr().err


USAGE = {
    "nothing": [],
    "no input": ["prune", "--cameras", "cameras.json", "-o", "out.ply"],
    "no output": PRUNE,
    "one picture twice": ["prune", "in.ply", "in.spz", *PRUNE[2:], "--dry-run", "--pictures", "p"],
    "another input by a link": ["prune", "in.ply", "b.ply", *MADE[2:-1], "l", "--overwrite"],
    "one name twice": ["prune", "in.ply", "b/in.ply", *PRUNE[2:], "-o", "made"],
    "two budgets": [*MADE, "--ratio", ".5", "--keep", "3"],
    "keep a part": [*MADE, "--keep", "1.5"],
    "rounds of nothing": [*MADE, "--rounds", "2"],
    "too many rounds": [*MADE, "--method", "refit", "--rounds", "1000000"],
    "frames that end before they start": [*MADE, "--source", "frames:3:1"],
    "a source without Blender": ["prune", "in.ply", "-o", "out.ply", "--source", "frames:1:3"],
    "render without Blender": ["render"],
    "object without Blender": ["prune", "--object", "Splats", "-o", "out.ply", *PRUNE[2:]],
    "save without object": [*MADE, "--save"],
    "output of nobody": [*PRUNE, "-o", "~nobody-of-that-name/out.ply"],
    "output to standard output": [*PRUNE, "-o", "-"],
    "report over the input": [*MADE, "--report", "./in.ply", "--overwrite"],
    "report over the output": [*MADE, "--report", "out.ply"],
    "report over other splats": [*PRUNE, "--dry-run", "--report", "b.ply", "--overwrite"],
    "report over other cameras": [*PRUNE, "--dry-run", "--report", "t.json", "--overwrite"],
    "report that is the folder of the pictures": [*MADE, "--report", "p", "--pictures", "p"],
    "pictures in the place of the output": [*MADE, "--pictures", "./out.ply"],
    "report among the pictures": [*MADE, "--pictures", ".", "--report", "in-000-after.png"],
    "output that is not named as splats": ["prune", "in.dat", *PRUNE[2:], "-o", "m", "--overwrite"],
    "an option in part": [*MADE, "--rat", ".5"],
    "no name of an output": [*PRUNE, "-o", ""],
    "a name with a zero byte": [*PRUNE, "-o", "out\0.ply"],
    "score to another format": [*SCORE, "-o", "out.spz"],
    "info with a budget": ["info", "in.ply", "--ratio", ".5"],
}


@pytest.mark.parametrize("name", USAGE)
def test_wrong_usage_is_code_2_and_one_sentence(folder, capsys, name):
    """Before anything is read or written: the usage, then the error."""
    for place in ("made", "m"):
        (folder / place).mkdir()
        (folder / place / "in.dat").write_bytes(b"notes")
    for path, content in (("b.ply", b"ply\n"), ("t.json", b'{"frames": []}'), ("in.dat", b"ply\n")):
        (folder / path).write_bytes(content)
    (folder / "l").mkdir()
    (folder / "l/in.ply").symlink_to(folder / "b.ply")
    before = contents(folder)

    assert command.main(USAGE[name]) == 2

    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("usage: refine")
    assert re.search(r"\nrefine[a-z ]*: error: .+\n\Z", said.err)
    assert contents(folder) == before


LONG = "n" * 300  # file systems take 255 bytes
LONGEST = "x" * 245 + ".ply"  # whose pictures have longer names than that


def pruned(source="in.ply", cameras="cameras.json", output="out.ply"):
    """Return the command that prunes so."""
    return ["prune", source, "--cameras", cameras, "-o", output]


FAILS = [
    (pruned("empty.ply"), "empty.ply: there are no splats to score"),
    (pruned(cameras="in.ply"), "in.ply: not a camera file"),
    (pruned(cameras="away.json"), "in.ply: no camera sees the splats: none of 60 reaches into"),
    (pruned(output="mesh.ply"), "mesh.ply: exists already; choose"),
    (pruned(output="none/out.ply"), "none/out.ply: cannot be written, there is no folder none"),
    (pruned(output=LONG), f"{LONG}: cannot be made (File name"),
    ([*pruned(output="cameras.json"), "--overwrite"], "cameras.json: cannot be made (File exists)"),
    ([*MADE, "--report", "mesh.ply"], "mesh.ply: exists already; choose another name, or set"),
    ([*MADE, "--report", LONG], f"{LONG}: cannot be written (File name too long); nothing was"),
    ([*MADE, "--max-mb", "1e-6"], "in.ply: max_mb is 1e-06"),
    (["prune", "none.ply", *PRUNE[2:], "-o", "a/new"], "none.ply: cannot be read"),
    ([*pruned(LONGEST), "--pictures", "a/new"], "x" * 200),
]


@pytest.mark.parametrize(("arguments", "expected"), FAILS, ids=range(len(FAILS)))
def test_what_fails_is_code_1_and_one_sentence_that_names_the_file(
    folder, capsys, arguments, expected
):
    """No traceback, nothing written, no empty folder left, and every file as it was."""
    (folder / "mesh.ply").write_bytes(plain_header(0, ["x", "y", "z"]))
    (folder / "empty.ply").write_bytes(plain_header(0, splat_names(0)))
    (folder / LONGEST).write_bytes(plain_ply(COUNT))
    away = json.loads((folder / "cameras.json").read_text())[:1]
    away[0]["position"] = [0, 0, 100]
    (folder / "away.json").write_text(json.dumps(away))
    before = contents(folder)

    assert command.main(arguments) == 1

    said = capsys.readouterr()
    assert said.err.startswith(f"refine: error: {expected}")
    assert said.err.count("\n") == 1
    assert before == contents(folder)
