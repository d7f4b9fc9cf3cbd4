"""The command `lod`: what it writes and says, and what it refuses."""

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
    By default four levels are made, halves of halves, about: 289, 145, 70 and 35."""
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
        (["-o", "out", "--levels", "half"], "numbers with commas"),
        (["-o", "out", "--psnr", "40", "--levels", ".5"], "by PSNR, got both"),
        (["-o", "levels.ply.gz"], "is not written, expected one of .ply"),
        ([], "expected -o OUT"),
        (["-o", "out"], "no cameras"),
        (["-o", "web/lod-meta.json", "--report", "web/lod-meta.json"], "is an input or output"),
    ],
)
def test_wrong_usage_ends_before_any_work(files, monkeypatch, capsys, options, word):
    monkeypatch.chdir(files)
    before = contents(files)

    cameras = ["--cameras", "cameras.json"] if word != "no cameras" else []
    assert main(["lod", "scene.ply", *cameras, *options]) == 2
    assert word in capsys.readouterr().err
    assert contents(files) == before


@pytest.mark.parametrize(("name", "moment"), [("out", 0), ("web/lod-meta.json", 2)])
def test_levels_are_replaced_when_told_alone_and_stay_where_that_stops(
    files, stops, capsys, name, moment
):
    """Before the second level: the first is gone again, too.
    An index says which folders a run before had more: none is left. No list says whose a third
    file is, so it stays and is named."""
    path = files / name
    folder = path.parent if path.suffix else path
    run = ["lod", "-o", path, *QUICK, "--levels"]
    if path.suffix:
        pytest.importorskip("PIL", reason="needs Pillow, which SOG does outside of Blender")
    stops.add(2)
    assert call(files, *run, ".5,.3,.1") == 130
    assert "nothing was left half-written" in capsys.readouterr().err
    assert not folder.exists()
    stops.clear()
    assert call(files, *run, ".5,.3,.1") == 0
    before = contents(files)
    assert call(files, *run, ".4,.2") == 1
    assert ": exists already" in capsys.readouterr().err
    stops.add(moment)
    assert call(files, *run, ".4,.2", "--overwrite") == 130
    assert contents(files) == before
    stops.clear()

    assert call(files, *run, ".4,.2", "--overwrite") == 0

    if path.suffix:  # beside the old ones until these go
        assert {entry.name for entry in folder.iterdir()} == {"0_1", "1_1", "2_1", path.name}
        assert [len(read_splats(path, level=level)) for level in (1, 2)] == [231, 116]
    else:
        assert "note: scene.lod3.ply is of another run" in capsys.readouterr().out
        assert list(made(folder).values()) == [231, 116, 58]


def test_two_levels_that_are_one_file_by_a_link_and_one_that_is_a_source(files, capsys):
    """A level may be the source of a new run: it stays."""
    out, cameras = files / "out", ["--cameras", str(files), *QUICK, "--levels", ".5,.1"]
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
    """Of 577, .999 are all (576.4); .002 and .0019 are both 2 (1.2 and 1.1).
    A PSNR that lets nothing go makes no level: alone it is an error. 1 dB is out of reach."""
    options = ["--levels", ".999,.5,.002,.0019", "-o", files / "out", *QUICK]
    by_psnr = ["lod", "-o", files / "psnr", "--method", "occlusion", "--views", "2", "--psnr"]

    assert call(files, "lod", *options) == 0
    said = capsys.readouterr().out
    assert "note: no level for 0.999: it would be a copy of the input" in said
    assert "note: no level for 0.0019: it would be a copy of level 2" in said
    assert made(files / "out") == {"scene.lod1.ply": 289, "scene.lod2.ply": 2}
    assert call(files, *by_psnr, "99.9") == 1
    assert "no level has fewer splats than the input, which has 577" in capsys.readouterr().err
    assert not (files / "psnr").exists()
    assert call(files, *by_psnr, "99.9,1") == 0
    said = capsys.readouterr().out
    assert ": 1 level of 577 splats" in said
    assert "note: no level for 99.9 dB: it would be a copy of the input" in said
    assert "note: level 1: the estimate ends at 95% removed" in said


def test_a_streamed_sog_has_all_levels_and_the_source(files, capsys):
    """577 splats as level 0, 289 and 58; positions to 16 bits, of the levels that files have.
    What must go is in none of them: a viewer shows level 0, too."""
    pytest.importorskip("PIL", reason="needs Pillow, which SOG does outside of Blender")
    path = files / "web/lod-meta.json"
    run = ["lod", "--levels", ".5,.1", "-o", path, *QUICK]
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
