"""The command `clean`, and `prune --clean`, on a wall with a floater in front of it."""

import json

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import read_ply
from tests.strategies import cameras_json

from .test_cleaning import FLOATER, SIDE, cameras, joined, wall
from .test_levels import file_of

WHOLE = SIDE**2 + 1


@pytest.fixture
def files(tmp_path):
    """Return the folder with scene.ply, whose last splat floats, and cameras.json."""
    file_of(joined(wall(), FLOATER), tmp_path / "scene.ply")
    places = {view.name: view.center.tolist() for view in cameras()}
    (tmp_path / "cameras.json").write_text(cameras_json(places, 60.0, 80, 60))
    return tmp_path


def spoil(files, count):
    """Let the first so many splats have NaN for a place."""
    data = bytearray((files / "scene.ply").read_bytes())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    np.frombuffer(data, "<f4", offset=start).reshape(WHOLE, -1)[:count, 0] = np.nan
    (files / "scene.ply").write_bytes(data)


def call(files, command, *options, more=()):
    """Run a subcommand on the scene, and more inputs, and return its exit code."""
    words = [command, files / "scene.ply", *more, "--cameras", files, *options]
    return main([str(word) for word in words])


def told(files, command, *options):
    """Run a subcommand on the scene; return its entry of the report."""
    assert call(files, command, *options, "--report", files / "r.json", "--overwrite") == 0
    (entry,) = json.loads((files / "r.json").read_text())["results"]
    return entry


def test_clean_says_why_and_writes_the_rest(files, capsys):
    """One of 577 splats goes, dark and at half the depth of the white wall; counts of each reason.

    All six views see past it: a seventh is expected to by (6 + 1) / (6 + 2)."""
    before = set(files.iterdir())
    assert call(files, "clean") == 0
    assert set(files.iterdir()) == before

    facts = told(files, "clean", "-o", files / "out.ply")["cleaned"]

    kept = read_ply(files / "scene.ply").rows[:-1]
    assert read_ply(files / "out.ply").rows.tobytes() == kept.tobytes()
    assert "1 in front of surfaces (88 % sure); 576 of 577 splats stay" in capsys.readouterr().out
    assert [facts[name] for name in ("front", "isolated", "giant", "needle")] == [1, 0, 0, 0]
    assert facts["sure"] == {"front": 7 / 8, "isolated": None, "giant": None, "needle": None}


@pytest.mark.slow
def test_reasons_are_named_with_commas_before_or_behind_the_input(files):
    """With blanks between them the file behind them was taken for a reason.

    The floater is no giant: where that alone is asked for, the file stays to the byte.
    """
    scene, out = str(files / "scene.ply"), files / "out.ply"
    options = ["--cameras", str(files), "-o", str(out), "--overwrite"]

    assert main(["clean", "--reasons", "front,isolated", scene, *options]) == 0
    assert len(read_ply(out)) == SIDE**2
    assert main(["clean", scene, *options, "--reasons", "isolated, giant"]) == 0
    assert out.read_bytes() == (files / "scene.ply").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["occlusion", "merge"])
def test_prune_cleans_before_the_budget_counts(files, capsys, method):
    """Of 577, one floats; half of the other 576 stay, and none of them is dark like the floater.

    They lie at a depth of 4 and the focal length is 60, half of an image 40 by 30: a splat is seen
    from within 2.67 beside and 2 above of it. What lies in no view is counted of the 576.
    """
    out = files / "out.ply"
    places = wall().means[:, None, :2] - np.array([view.center[:2] for view in cameras()])
    unseen = int((np.abs(places) > [8 / 3, 2.0]).any(axis=2).all(axis=1).sum())

    assert call(files, "prune", "--clean", "--ratio", ".5", "--method", method, "-o", out) == 0

    said = capsys.readouterr().out
    assert "kept 288 of 577" in said
    assert 0 < unseen < SIDE**2
    assert f"\n  {unseen} of 576 splats lie in no view\n" in said
    assert (read_ply(out).splats().means[:, 2] > 3.0).all()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["clean", "scene.ply", "--reasons", "fog"], "reason is 'fog', expected some of front"),
        (["clean", "scene.ply", "--views", "-1"], "views is -1, expected 0"),
        (["prune", "scene.ply", "--views", "-1"], "views is -1, expected 0"),
        (["prune", "scene.ply", "--method", "refit", "--rounds", "0"], "rounds is 0, expected 1"),
        (["prune", "scene.ply", "--method", "refit", "--rounds", "101"], "rounds is 101, expected"),
        (["clean", "scene.ply", "a.ply", "-o", "x.ply"], "-o x.ply is one file, expected a folder"),
        (["prune", "--clean", "--object", "Splats"], "--clean goes with INPUT files"),
    ],
)
def test_wrong_usage_is_code_2(files, monkeypatch, capsys, words, expected):
    monkeypatch.chdir(files)

    assert main([*words, "--cameras", "cameras.json"]) == 2
    assert expected in capsys.readouterr().err


def test_a_file_of_splats_that_cannot_be_drawn_is_not_called_clean(files, capsys):
    """All positions are NaN: it said that there was nothing to clean away."""
    spoil(files, WHOLE)

    assert call(files, "clean") == 1
    assert f"none of the {WHOLE} splats can be drawn" in capsys.readouterr().err
