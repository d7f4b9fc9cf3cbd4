"""The command's volumes in numbers: `--protect`, `--remove-inside`, `--keep-inside`."""

from __future__ import annotations

import json

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import read_ply

from .test_cleaning import SIDE
from .test_command_clean import files  # noqa: F401 - a fixture: a wall with a floater before it

WALL = SIDE**2
HALF = "box:-inf,-inf,-inf,0,inf,inf"
"""All with x below 0; the wall is as wide to both sides."""


@pytest.fixture
def scene(files):
    """Return the folder, and where the splats lie along x and z."""
    means = read_ply(files / "scene.ply").splats().means
    return files, means[:, 0], means[:, 2]


def call(folder, command, *options):
    """Run a subcommand on the scene, and return its exit code."""
    words = [command, str(folder / "scene.ply"), "--cameras", str(folder), *options]
    return main([*words, "--overwrite", "--report", str(folder / "report.json")])


def told(folder):
    """Return what the report says of the file."""
    return json.loads((folder / "report.json").read_text())["results"][0]


def test_prune_removes_protects_and_says_how_many(scene, capsys):
    """With nothing left to the budget, what goes is half of the wall but its farthest column."""
    folder, x, z = scene
    stays = (x < -2.9) & (z > 3.0)
    goes = (x < 0.0) & ~stays
    out = folder / "out.ply"
    options = ["--remove-inside", HALF, "--protect", "box:-9,-9,3,-2.9,9,9", "--ratio", "0"]

    assert call(folder, "prune", *options, "-o", str(out)) == 0

    assert len(read_ply(out)) == len(x) - goes.sum()
    assert (read_ply(out).splats().means[:, 0] >= 0.0).sum() == (x >= 0.0).sum()
    entry = told(folder)
    assert entry["splats"]["protected"] == stays.sum() == SIDE
    assert entry["splats"]["removed_by_user"] == goes.sum()
    assert entry["volumes"][1] == {
        "role": "remove", "name": f"'{HALF}'", "splats": int((x < 0.0).sum())
    }  # fmt: skip
    line = f"\n  {SIDE} protected, {goes.sum()} removed by you (protect 'box:-9,-9,3,-2.9,9,9': "
    assert f"{line}{SIDE}" in capsys.readouterr().out


def test_volumes_of_a_kind_are_joined(scene):
    """Two spheres about splats of the wall keep these two."""
    folder, *_ = scene
    means = read_ply(folder / "scene.ply").splats().means
    spheres = [f"sphere:{','.join(map(str, means[row].tolist()))},1e-3" for row in (0, 300)]
    options = [word for sphere in spheres for word in ("--keep-inside", sphere)]
    out = folder / "out.ply"

    assert call(folder, "prune", *options, "--ratio", "0", "-o", str(out)) == 0
    assert len(read_ply(out)) == 2


def test_clean_leaves_out_what_must_go_and_spares_what_is_protected(scene):
    """The floater, which `clean` would take, stays; half of the wall goes."""
    folder, x, z = scene
    out = folder / "out.ply"
    near = "box:-9,-9,-9,9,9,3"

    assert call(folder, "clean", "--protect", near, "--remove-inside", HALF, "-o", str(out)) == 0

    left = read_ply(out).splats().means
    assert len(left) == ((x >= 0.0) | (z < 3.0)).sum()
    assert told(folder)["splats"]["removed_by_user"] == ((x < 0.0) & (z > 3.0)).sum()


def test_score_leaves_out_what_must_go(scene):
    """It scores 0 in the file, and nothing else does."""
    folder, x, _ = scene
    out = folder / "out.ply"

    assert call(folder, "score", "--remove-inside", HALF, "-o", str(out)) == 0
    assert np.array_equal(read_ply(out).rows["refine_score"] == 0.0, x < 0.0)
    assert call(folder, "score", "--protect", HALF, "-o", str(out)) == 2


@pytest.mark.slow
def test_levels_leave_out_what_must_go(scene):
    """Both levels lie in the right half; the report counts what went."""
    folder, x, _ = scene
    options = [
        "--remove-inside",
        HALF,
        "--levels",
        ".4,.2",
        "-o",
        str(folder / "lod"),
        "--method",
        "occlusion",
    ]

    assert call(folder, "lod", *options) == 0
    for entry in told(folder)["levels"]:
        level = read_ply(folder / "lod" / entry["file"])
        assert (level.splats().means[:, 0] >= 0.0).all()
    assert told(folder)["splats"]["removed_by_user"] == (x < 0.0).sum()
    assert told(folder)["splats"]["before"] == WALL + 1


@pytest.mark.parametrize(
    ("options", "code", "expected"),
    [
        (["--remove-inside", "Cube"], 2, "--remove-inside Cube: objects have names in Blender"),
        (["--protect", ""], 2, "expected a name, got none"),
        (["--protect", "box:1,2"], 2, "expected box:x0,y0,z0,x1,y1,z1 in numbers, got 'box:1,2'"),
        (["--keep-inside", "sphere:0,0,0,-1"], 2, "sphere has radius -1, expected more than 0"),
        (["--remove-inside", "sphere:99,0,0,1"], 1, "'sphere:99,0,0,1' holds the centre of no"),
        (["--remove-inside", "sphere:0,0,0,99"], 1, "all 577 splats lie where they must go"),
    ],
)
def test_what_cannot_be_is_refused(scene, capsys, options, code, expected):
    """With what was got; nothing is written."""
    folder, *_ = scene
    out = folder / "out.ply"

    assert call(folder, "prune", *options, "-o", str(out)) == code
    assert expected in capsys.readouterr().err
    assert not out.exists()
