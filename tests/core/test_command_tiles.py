"""The command ``prune --together``, on two tiles."""

from __future__ import annotations

import json

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import Budget, ClosedForm, prune, read_cameras, read_ply
from refine_addon.core.tiles import storage
from tests.strategies import plain_header, plain_ply, splat_names

CLOSED = ["--method", "closed-form"]
COUNTS = {"a.ply": 60, "b.ply": 40}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Stand in a folder with two tiles, the second far from the camera."""
    monkeypatch.chdir(tmp_path)
    for name, count in COUNTS.items():
        (tmp_path / name).write_bytes(plain_ply(count, seed=count))
    file = read_ply(tmp_path / "b.ply")
    rows = file.rows.copy()
    rows["z"] += 30.0
    (tmp_path / "b.ply").write_bytes(file.header + rows.tobytes())
    view = {
        "position": [0, 0, 0], "rotation": np.eye(3).tolist(), "img_name": "1",
        "fx": 50.0, "fy": 50.0, "width": 40, "height": 30,
    }  # fmt: skip
    (tmp_path / "cameras.json").write_text(json.dumps([view]))
    return tmp_path


def call(*options):
    """Prune the tiles together, and return the exit code."""
    return main(["prune", "a.ply", "b.ply", "--together", "--cameras", "cameras.json", *options])


def test_one_budget_counts_over_all_files(folder, capsys):
    """Half of 100 splats go, most of them from the tile that is far away: as of one file."""
    assert call(*CLOSED, "--ratio", "0.5", "-o", "out", "--report", "told.json") == 0

    rows = np.concatenate([read_ply(name).rows for name in COUNTS])
    (folder / "whole.ply").write_bytes(plain_header(100, splat_names(0)) + rows.tobytes())
    whole = read_ply("whole.ply").splats()
    views = read_cameras("cameras.json")
    keep = prune(whole, views, Budget(ratio=0.5), ClosedForm()).keep
    kept = [int(np.count_nonzero(part)) for part in np.split(keep, [60])]
    assert [len(read_ply(folder / "out" / name)) for name in COUNTS] == kept
    assert kept[1] < 20
    told = json.loads((folder / "told.json").read_text())["results"]
    assert [tile["kept"] for tile in told[0]["tiles"]] == kept
    said = capsys.readouterr().out
    assert "2 tiles: kept 50 of 100 splats (50.0% removed)" in said
    assert f"b.ply: {kept[1]} of 40 splats" in said


@pytest.mark.slow
def test_a_dry_run_says_the_same_and_writes_nothing(folder, capsys):
    """Only the verb differs."""
    before = sorted(folder.rglob("*"))

    assert call(*CLOSED, "--ratio", "0.5", "-o", "out", "--dry-run") == 0
    assert "2 tiles: would keep 50 of 100 splats" in capsys.readouterr().out
    assert sorted(folder.rglob("*")) == before


def test_a_tile_that_is_missing_stops_all(folder, capsys):
    """Exit code 1, the name of the tile, and no other tile is written."""
    (folder / "b.ply").unlink()

    assert call(*CLOSED, "-o", "out") == 1
    assert "b.ply: cannot be read" in capsys.readouterr().err
    assert not (folder / "out").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([*CLOSED, "-o", "out.ply"], "-o out.ply is one file, expected a folder"),
        ([*CLOSED, "-o", "out", "--clean"], "--clean does not go with --together"),
        (
            [*CLOSED, "-o", "out", "--protect", "sphere:0,0,0,1"],
            "--protect does not go with --together",
        ),
        (CLOSED, "expected -o OUT; instead of it prune takes --save or --dry-run"),
    ],
)
def test_what_does_not_go_with_tiles_is_wrong_usage(folder, capsys, options, words):
    """Exit code 2, before anything is read."""
    assert call(*options) == 2
    assert words in capsys.readouterr().err
    assert not (folder / "out").exists()


def test_two_tiles_of_one_name_are_wrong_usage(folder, capsys):
    """They would be one file in the folder."""
    (folder / "more").mkdir()
    (folder / "more/a.ply").write_bytes((folder / "a.ply").read_bytes())

    tiles = ["a.ply", "b.ply", "more/a.ply"]
    options = ["--together", "--cameras", "cameras.json", *CLOSED, "-o", "out"]
    assert main(["prune", *tiles, *options]) == 2
    said = capsys.readouterr().err
    assert "a.ply and more/a.ply would both be out/a.ply: rename one of them" in said


def test_after_ctrl_c_it_says_how_to_go_on(folder, capsys, monkeypatch):
    """Exit code 130; the same command then ends, and leaves nothing but the tiles."""
    with monkeypatch.context() as patched:

        def stop(*_paths, **_options):
            raise KeyboardInterrupt

        patched.setattr(storage, "publish", stop)
        assert call(*CLOSED, "-o", "out") == 130
    assert "the same command goes on where this one was" in capsys.readouterr().err

    assert call(*CLOSED, "-o", "out") == 0
    assert {path.name for path in (folder / "out").iterdir()} == set(COUNTS)
