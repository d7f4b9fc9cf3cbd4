"""The command `lod`: what it writes and says, and what it refuses."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import read_splats

from .test_command import contents
from .test_command_clean import call, files, told  # noqa: F401 - a fixture

pytestmark = pytest.mark.slow

LOD = importlib.import_module("refine_addon.core.lod")
QUICK = ["--method", "closed-form", "--views", "2"]


@pytest.fixture
def stops(monkeypatch):
    """Return the levels before which Ctrl-C comes, none at first; 0: before any."""
    made, levels = LOD.lod, set()

    def lod(*given, **named):
        if 0 in levels:
            raise KeyboardInterrupt
        for level in made(*given, **named):
            if level.number in levels:
                raise KeyboardInterrupt
            yield level

    monkeypatch.setattr(LOD, "lod", lod)
    return levels


def made(folder):
    """Return the names of files of levels, and how many splats each holds."""
    return {path.name: len(read_splats(path)) for path in sorted(folder.iterdir())}


def test_lod_writes_levels_and_says_what_each_costs(files, capsys):
    """577 splats: .5 are 289 (288.5), .1 are 58 (57.7); a line for each, and the report.

    By default four levels are made, halves of halves, about: 289, 145, 70 and 35.
    """
    options = ["--levels", ".5,.1", "-o", files / "out/room.splat"]

    entry = told(files, "lod", *options, *QUICK)

    said = capsys.readouterr().out
    assert ": 2 levels of 577 splats, by 2 of 6 views, " in said
    assert "room.lod1.splat: 289 splats" in said
    assert made(files / "out") == {"room.lod1.splat": 289, "room.lod2.splat": 58}
    assert [level["splats"] for level in entry["levels"]] == [289, 58]
    assert call(files, "lod", "-o", files / "four", "--views", "2", "--quiet") == 0
    assert list(made(files / "four").values()) == [289, 145, 70, 35]


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["-o", "out", "--levels", ".5,.6"], "comes after"),
        (["-o", "out", "--levels", "half"], "numbers with commas"),
        (["-o", "out", "--levels", "2"], "less than 1"),
        (["-o", "out", "--psnr", "30,40"], "comes after"),
        (["-o", "out", "--psnr", "40", "--levels", ".5"], "by PSNR, got both"),
        (["-o", "levels.ply.gz"], "is not written, expected one of .ply"),
        ([], "expected -o OUT"),
        (["-o", "out"], "no cameras"),
        (["-o", "web/lod-meta.json", "--report", "web/lod-meta.json"], "a file of its own"),
    ],
)
def test_wrong_usage_ends_before_any_work(files, monkeypatch, capsys, options, word):
    monkeypatch.chdir(files)
    before = contents(files)

    cameras = ["--cameras", "cameras.json"] if word != "no cameras" else []
    assert main(["lod", "scene.ply", *cameras, *options]) == 2
    assert word in capsys.readouterr().err
    assert contents(files) == before


def test_files_that_exist_are_replaced_when_told_alone_and_none_is_taken_away(files, capsys):
    """No list says whose a third level of a run before is, so it stays and is named."""
    run = ["lod", "-o", files / "out", *QUICK, "--levels"]
    assert call(files, *run, ".5,.3,.1") == 0
    before = made(files / "out")

    assert call(files, *run, ".4,.2") == 1
    assert "scene.lod1.ply: exists already" in capsys.readouterr().err
    assert made(files / "out") == before
    assert call(files, *run, ".4,.2", "--overwrite") == 0
    assert "note: scene.lod3.ply is of another run" in capsys.readouterr().out
    assert list(made(files / "out").values()) == [231, 116, 58]


def test_ctrl_c_leaves_what_was_there(files, stops, capsys):
    """Before the second level: the first is gone again, too; before any, a run before stays."""
    run = ["lod", "-o", files / "out", *QUICK]
    stops.add(2)
    assert call(files, *run) == 130
    assert "nothing was left half-written" in capsys.readouterr().err
    assert not (files / "out").exists()
    stops.clear()
    assert call(files, *run) == 0
    before = contents(files)

    stops.add(0)
    assert call(files, *run, "--overwrite") == 130
    assert contents(files) == before


def test_places_of_levels_that_cannot_be_and_one_that_is_a_source(files, capsys):
    """Two levels that are one file by a link; names of 256 bytes, the source's 251 and .lod1.

    No empty folder is left, nor the one above it. A level may be the source of a new run: it stays.
    """
    out, cameras = files / "out", ["--cameras", str(files), *QUICK, "--levels", ".5,.1"]
    long = files / f"{'x' * 247}.ply"
    long.write_bytes((files / "scene.ply").read_bytes())
    assert main(["lod", str(long), "-o", str(files / "a/new"), *cameras]) == 1
    assert "cannot be written (File name too long)" in capsys.readouterr().err
    assert not (files / "a").exists()

    out.mkdir()
    (out / "scene.lod2.ply").symlink_to("scene.lod1.ply")
    assert call(files, "lod", "-o", out, "--overwrite", *QUICK) == 1
    assert "by a link" in capsys.readouterr().err
    (out / "scene.lod2.ply").unlink()

    assert call(files, "lod", "-o", out, *QUICK, "--levels", ".5") == 0
    assert main(["lod", str(out / "scene.lod1.ply"), "-o", str(out), "--overwrite", *cameras]) == 0
    made_of_it = {"scene.lod1.lod1.ply": 145, "scene.lod1.lod2.ply": 29}
    assert made(out) == {**made_of_it, "scene.lod1.ply": 289}


def test_levels_that_would_be_equal_are_made_once(files, capsys):
    """Of 577, .999 are all (576.4); .002 and .0019 are both 2 (1.2 and 1.1)."""
    options = ["--levels", ".999,.5,.002,.0019", "-o", files / "out", *QUICK]

    assert call(files, "lod", *options) == 0
    said = capsys.readouterr().out
    assert "note: no level for 0.999: it would be a copy of the input" in said
    assert "note: no level for 0.0019: it would be a copy of level 2" in said
    assert made(files / "out") == {"scene.lod1.ply": 289, "scene.lod2.ply": 2}


def test_a_psnr_that_lets_nothing_go_makes_no_level(files, capsys):
    """Alone it is an error; beside another the note says so. 1 dB is out of reach."""
    run = ["lod", "-o", files / "out", "--method", "occlusion", "--views", "2"]

    assert call(files, *run, "--psnr", "99.9") == 1
    assert "no level has fewer splats than the input, which has 577" in capsys.readouterr().err
    assert not (files / "out").exists()
    assert call(files, *run, "--psnr", "99.9,1") == 0
    said = capsys.readouterr().out
    assert ": 1 level of 577 splats" in said
    assert "note: no level for 99.9 dB: it would be a copy of the input" in said
    assert "note: level 1: the estimate ends at 95% removed" in said


@pytest.fixture
def streamed(files):
    """Return the index of a streamed SOG to be made, and the command that makes it."""
    pytest.importorskip("PIL", reason="needs Pillow, which SOG does outside of Blender")
    path = files / "web/lod-meta.json"
    return path, ["lod", "--levels", ".5,.1", "-o", path, *QUICK]


def test_a_streamed_sog_has_all_levels_and_the_source(files, streamed, capsys):
    """577 splats as level 0, 289 and 58; positions to 16 bits, of the levels that files have.

    What must go is in none of them: a viewer shows level 0, too.
    """
    path, run = streamed
    assert call(files, "lod", "--levels", ".5,.1", "-o", files / "out", *QUICK) == 0
    capsys.readouterr()

    assert call(files, *run) == 0

    said = capsys.readouterr().out
    sources = [files / "scene.ply", *sorted((files / "out").iterdir())]
    for level, source in enumerate(sources):
        splats, wanted = read_splats(path, level=level).splats(), read_splats(source).splats()
        assert len(splats) == len(wanted) == (577, 289, 58)[level]
        near = np.linalg.norm(splats.means[:, None] - wanted.means, axis=2)
        assert max(near.min(axis=0).max(), near.min(axis=1).max()) < 1e-3
    assert "2 levels of 577 splats, by 2 of 6 views, " in said
    assert "  1_*/meta.json: 289 splats, " in said
    assert "note: .sog holds positions in 16 bits" in said

    inside = (np.abs(read_splats(sources[0]).splats().means[:, :2]) < 1).all(axis=1)
    assert call(files, *run, "--overwrite", "--remove-inside", "box:-1,-1,0,1,1,99") == 0
    assert len(read_splats(path)) == 577 - inside.sum() < 577


def test_a_streamed_sog_is_replaced_when_told_alone_and_stays_where_that_stops(
    files, streamed, stops, capsys
):
    """As a file is; nothing is left of what the run before had more."""
    path, run = streamed
    stops.add(2)
    assert call(files, *run) == 130
    assert not path.parent.exists()
    stops.clear()
    assert call(files, *run) == 0
    before = contents(files)
    assert call(files, *run) == 1
    assert "lod-meta.json: exists already" in capsys.readouterr().err
    stops.add(2)
    assert call(files, *run, "--overwrite") == 130
    assert contents(files) == before
    stops.clear()

    assert call(files, *run, "--overwrite", "--levels", ".3") == 0

    names = sorted(entry.name for entry in path.parent.iterdir())
    assert names == ["0_1", "1_1", "lod-meta.json"]  # beside the old ones until these go
    assert len(read_splats(path, level=1)) == 174


def test_a_library_that_is_missing_is_told_before_the_work(files, streamed, monkeypatch, capsys):
    """Nothing is scored for a streamed SOG that could not be written."""

    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    monkeypatch.setattr(LOD, "lod", None)

    assert call(files, *streamed[1]) == 1
    assert "WebP images need a library" in capsys.readouterr().err
    assert not streamed[0].parent.exists()
