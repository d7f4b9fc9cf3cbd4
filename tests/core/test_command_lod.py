"""The command `lod`: what it writes and says, and what it refuses."""

from __future__ import annotations

import importlib
import json

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import read_splats

from .test_command_clean import call, files  # noqa: F401 - a fixture
from .test_levels import merges  # noqa: F401 - a fixture

pytestmark = pytest.mark.slow

LOD = importlib.import_module("refine_addon.core.lod")
QUICK = ["--method", "closed-form", "--views", "2"]


def test_lod_writes_levels_and_says_what_each_costs(files, capsys):
    """577 splats: .5 are 289 (288.5), .1 are 58 (57.7); a line for each, and the report."""
    out, told = files / "out", files / "report.json"

    options = ["--levels", ".5,.1", "-o", str(out / "room.splat"), "--report", str(told)]

    code = call(files, "lod", *options, *QUICK)

    assert code == 0
    said = capsys.readouterr().out
    assert "2 levels of 577 splats" in said
    assert "room.lod1.splat: 289 splats" in said
    assert len(read_splats(out / "room.lod2.splat")) == 58
    result = json.loads(told.read_text())["results"][0]
    assert [entry["splats"] for entry in result["levels"]] == [289, 58]


@pytest.mark.slow
def test_by_default_splats_are_merged_and_four_levels_are_made(merges, files):
    """Halves of halves, about: 289, 145, 70 and 35 of 577, rounded up."""
    assert call(files, "lod", "-o", str(files / "out"), "--views", "2", "--quiet") == 0
    made = [len(read_splats(files / f"out/scene.lod{number}.ply")) for number in range(1, 5)]
    assert made == [289, 145, 70, 35]
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
        (["--psnr", "40", "--levels", ".5"], "by the shares that stay or by PSNR, got both"),
        (["-o", "levels.ply.gz"], "is not written, expected one of .ply"),
    ],
)
def test_wrong_usage_ends_before_any_work(files, capsys, options, word):
    """Code 2, and no folder."""
    assert call(files, "lod", "-o", str(files / "out"), *options) == 2
    assert word in capsys.readouterr().err
    assert not (files / "out").exists()


def test_a_folder_for_the_files_is_required(files, capsys):
    """The option is named."""
    assert call(files, "lod") == 2
    assert "expected -o OUT" in capsys.readouterr().err


def test_files_that_exist_are_replaced_when_told_alone(files, capsys):
    """The second run fails on the first level, the third replaces both."""
    run = ["lod", "--levels", ".5,.1", "-o", str(files / "out"), *QUICK]
    assert call(files, *run) == 0

    assert call(files, *run) == 1
    assert "scene.lod1.ply: exists already" in capsys.readouterr().err
    assert call(files, *run, "--overwrite") == 0


def test_ctrl_c_leaves_nothing(files, monkeypatch, capsys):
    """Interrupted while the second level is made: 130, and the first level is gone again."""
    module = importlib.import_module("refine_addon.core.lod")
    made = module.lod

    def interrupted(*given, **named):
        for level in made(*given, **named):
            if level.number == 2:
                raise KeyboardInterrupt
            yield level

    monkeypatch.setattr(LOD, "lod", interrupted)

    assert call(files, "lod", "-o", str(files / "out"), *QUICK) == 130
    assert "nothing was left half-written" in capsys.readouterr().err
    assert not (files / "out").exists()


def test_without_cameras_there_are_no_levels(files, capsys):
    """They decide what goes."""
    assert main(["lod", str(files / "scene.ply"), "-o", str(files / "out")]) == 2
    assert "no cameras" in capsys.readouterr().err


def test_one_level_is_one(files, capsys):
    """It was "1 levels"."""
    assert call(files, "lod", "--levels", ".5", "-o", str(files / "out"), *QUICK) == 0
    assert ": 1 level of 577 splats, by 2 of 6 views, " in capsys.readouterr().out


def test_levels_that_would_be_equal_are_made_once(files, capsys):
    """Of 577, .999 are all (576.4); .002 and .0019 are both 2 (1.2 and 1.1)."""
    options = ["--levels", ".999,.5,.002,.0019", "-o", str(files / "out"), *QUICK]

    assert call(files, "lod", *options) == 0
    said = capsys.readouterr().out
    assert "2 levels of 577" in said
    assert "note: no level for 0.999: it would be a copy of the input" in said
    assert "note: no level for 0.0019: it would be a copy of level 2" in said
    made = sorted((files / "out").iterdir())
    assert [(path.name, len(read_splats(path))) for path in made] == [
        ("scene.lod1.ply", 289),
        ("scene.lod2.ply", 2),
    ]


def test_a_psnr_that_lets_nothing_go_makes_no_level(files, capsys):
    """Alone it is an error; beside another the note says so. 1 dB is out of reach."""
    run = ["lod", "-o", str(files / "out"), "--method", "occlusion", "--views", "2"]

    assert call(files, *run, "--psnr", "99.9") == 1
    assert "no level has fewer splats than the input, which has 577" in capsys.readouterr().err
    assert not (files / "out").exists()
    assert call(files, *run, "--psnr", "99.9,1") == 0
    said = capsys.readouterr().out
    assert "note: no level for 99.9 dB: it would be a copy of the input" in said
    assert "note: level 1: the estimate ends at 95% removed" in said


def test_levels_with_names_that_are_too_long_leave_no_empty_folder(files, capsys):
    """The source's 251 bytes and .lod1 are 256; neither the folder nor the one above it is left."""
    long = files / f"{'x' * 247}.ply"
    (files / "scene.ply").rename(long)

    code = main(["lod", str(long), "--cameras", str(files), "-o", str(files / "a/new"), *QUICK])

    assert code == 1
    assert "cannot be written (File name too long)" in capsys.readouterr().err
    assert not (files / "a").exists()


def test_a_level_can_be_the_source_of_a_new_run(files):
    """It is in the folder: it stays."""
    out = files / "out"
    assert call(files, "lod", "-o", str(out), "--levels", ".5", *QUICK) == 0
    source, cameras = str(out / "scene.lod1.ply"), ["--cameras", str(files)]

    assert main(["lod", source, *cameras, "-o", str(out), "--overwrite", *QUICK]) == 0

    assert (out / "scene.lod1.ply").exists()
    assert (out / "scene.lod1.lod1.ply").exists()


def test_a_run_that_stops_before_its_first_level_leaves_the_run_before(files, monkeypatch):
    """Nothing is taken away until there is something to replace it."""
    out = files / "out"
    assert call(files, "lod", "-o", str(out), *QUICK) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}

    def interrupted(*_given, **_named):
        raise KeyboardInterrupt

    monkeypatch.setattr(LOD, "lod", interrupted)

    assert call(files, "lod", "-o", str(out), "--overwrite", *QUICK) == 130
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_levels_that_are_one_file_by_a_link_are_refused(files, capsys):
    out = files / "out"
    out.mkdir()
    (out / "scene.lod2.ply").symlink_to("scene.lod1.ply")

    assert call(files, "lod", "-o", str(out), "--overwrite", *QUICK) == 1
    assert "by a link" in capsys.readouterr().err


def test_more_levels_of_a_run_before_are_named(files, capsys):
    """No list says whose they are, so they stay."""
    run = ["lod", "-o", str(files / "out"), "--overwrite", *QUICK]
    assert call(files, *run, "--levels", ".5,.3,.1") == 0

    assert call(files, *run, "--levels", ".5,.3") == 0

    assert "note: scene.lod3.ply is of another run" in capsys.readouterr().out
    assert len(list((files / "out").iterdir())) == 3


@pytest.fixture
def streamed(files):
    """Return the index of a streamed SOG to be made, and the command that makes it."""
    pytest.importorskip("PIL", reason="needs Pillow, which SOG does outside of Blender")
    path = files / "web/lod-meta.json"
    return path, ["lod", "--levels", ".5,.1", "-o", str(path), *QUICK]


def test_a_streamed_sog_has_all_levels_and_the_source(files, streamed, capsys):
    """577 splats as level 0, 289 and 58; positions to 16 bits, of the levels that files have."""
    path, run = streamed
    assert call(files, "lod", "--levels", ".5,.1", "-o", str(files / "out"), *QUICK) == 0

    assert call(files, *run) == 0

    sources = [files / "scene.ply", *sorted((files / "out").iterdir())]
    for level, source in enumerate(sources):
        splats, wanted = read_splats(path, level=level).splats(), read_splats(source).splats()
        assert len(splats) == len(wanted) == (577, 289, 58)[level]
        near = np.linalg.norm(splats.means[:, None] - wanted.means, axis=2)
        assert max(near.min(axis=0).max(), near.min(axis=1).max()) < 1e-3
    said = capsys.readouterr().out
    assert "2 levels of 577 splats, by 2 of 6 views, " in said
    assert "  1_*/meta.json: 289 splats, " in said
    assert "note: .sog holds positions in 16 bits" in said


def test_a_streamed_sog_is_replaced_when_told_alone(files, streamed, capsys):
    """As a file is; nothing is left of what the run before had more."""
    path, run = streamed
    assert call(files, *run) == 0
    assert call(files, *run) == 1
    assert "lod-meta.json: exists already" in capsys.readouterr().err

    assert call(files, *run, "--overwrite", "--levels", ".3") == 0

    names = sorted(entry.name for entry in path.parent.iterdir())
    assert names == ["0_1", "1_1", "lod-meta.json"]  # beside the old ones until these go
    assert len(read_splats(path, level=1)) == 174


def test_what_must_go_is_in_no_level_of_a_streamed_sog(files, streamed):
    """Nor in level 0: a viewer shows that, too."""
    path, run = streamed
    box = "box:-1,-1,0,1,1,99"
    everything = read_splats(files / "scene.ply").splats().means
    inside = (np.abs(everything[:, :2]) < 1).all(axis=1)

    assert call(files, *run, "--remove-inside", box) == 0

    assert len(read_splats(path)) == 577 - inside.sum() < 577


def test_a_streamed_sog_that_is_stopped_leaves_nothing(files, streamed, monkeypatch):
    """Neither of a new one, nor of one to be replaced, which stays as it was."""
    path, run = streamed
    module = importlib.import_module("refine_addon.core.lod")
    made, stops = module.lod, [True]

    def interrupted(*given, **named):
        for level in made(*given, **named):
            if level.number == 2 and stops:
                raise KeyboardInterrupt
            yield level

    monkeypatch.setattr(LOD, "lod", interrupted)
    assert call(files, *run) == 130
    assert not path.parent.exists()
    stops.clear()
    assert call(files, *run) == 0
    before = {entry: entry.read_bytes() for entry in path.parent.rglob("*") if entry.is_file()}
    stops.append(True)

    assert call(files, *run, "--overwrite") == 130

    after = {entry: entry.read_bytes() for entry in path.parent.rglob("*") if entry.is_file()}
    assert after == before


def test_a_library_that_is_missing_is_told_before_the_work(streamed, monkeypatch, capsys):
    """Nothing is scored for a streamed SOG that could not be written."""
    path, run = streamed

    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    monkeypatch.setattr(LOD, "lod", None)

    assert call(path.parents[1], *run) == 1
    assert "WebP images need a library" in capsys.readouterr().err
    assert not path.parent.exists()


def test_a_report_over_a_streamed_sog_ends_before_any_work(streamed, capsys, monkeypatch):
    """Code 2, and no folder."""
    path, run = streamed
    monkeypatch.chdir(path.parents[1])

    assert call(path.parents[1], *run, "--report", "web/lod-meta.json") == 2

    assert "expected a file of its own" in capsys.readouterr().err
    assert not path.parent.exists()
