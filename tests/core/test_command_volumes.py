"""The command's volumes in numbers: `--protect`, `--remove-inside`, `--keep-inside`."""

import numpy as np
import pytest

from refine_addon.core import read_ply

from .test_cleaning import SIDE
from .test_command_clean import call, files, told  # noqa: F401 - a wall, a floater before it

HALF = "box:-inf,-inf,-inf,0,inf,inf"
"""All with x below 0; the wall is as wide to both sides."""


@pytest.fixture
def scene(files):
    """Return the folder, where the splats lie along x and z, and the file to be written."""
    means = read_ply(files / "scene.ply").splats().means
    return files, means[:, 0], means[:, 2], files / "out.ply"


def test_prune_removes_protects_and_says_how_many(scene, capsys):
    """With nothing left to the budget, what goes is half of the wall but its farthest column."""
    folder, x, z, out = scene
    stays = (x < -2.9) & (z > 3.0)
    goes = (x < 0.0) & ~stays
    options = ["--remove-inside", HALF, "--protect", "box:-9,-9,3,-2.9,9,9", "--ratio", "0"]

    entry = told(folder, "prune", *options, "-o", out)

    assert len(read_ply(out)) == len(x) - goes.sum()
    assert (read_ply(out).splats().means[:, 0] >= 0.0).sum() == (x >= 0.0).sum()
    assert entry["splats"]["protected"] == stays.sum() == SIDE
    assert entry["splats"]["removed_by_user"] == goes.sum()
    inside = int((x < 0.0).sum())
    assert entry["volumes"][1] == {"role": "remove", "name": f"'{HALF}'", "splats": inside}
    line = f"\n  {SIDE} protected, {goes.sum()} removed by you (protect 'box:-9,-9,3,-2.9,9,9': "
    assert f"{line}{SIDE}" in capsys.readouterr().out


def test_volumes_of_a_kind_are_joined(scene):
    """Two spheres about splats of the wall keep these two."""
    folder, _, _, out = scene
    means = read_ply(folder / "scene.ply").splats().means
    options = []
    for row in (0, 300):
        options += ["--keep-inside", f"sphere:{','.join(map(str, means[row].tolist()))},1e-3"]

    assert call(folder, "prune", *options, "--ratio", "0", "-o", out) == 0
    assert len(read_ply(out)) == 2


def test_clean_and_score_leave_out_what_must_go(scene, capsys):
    """The floater, which `clean` would take, is spared; half of the wall goes, and scores 0.

    What is spared counts for no reason."""
    folder, x, z, out = scene
    options = ["--protect", "box:-9,-9,-9,9,9,3", "--remove-inside", HALF]

    entry = told(folder, "clean", *options, "-o", out)

    assert len(read_ply(out)) == ((x >= 0.0) | (z < 3.0)).sum()
    assert entry["splats"]["removed_by_user"] == ((x < 0.0) & (z > 3.0)).sum()
    assert entry["cleaned"]["front"] == 0
    assert call(folder, "score", "--remove-inside", HALF, "-o", out, "--overwrite") == 0
    assert np.array_equal(read_ply(out).rows["refine_score"] == 0.0, x < 0.0)
    assert call(folder, "score", "--protect", HALF, "-o", out, "--overwrite") == 2


@pytest.mark.parametrize(
    ("options", "code", "expected"),
    [
        (["--remove-inside", "Cube"], 2, "--remove-inside Cube: objects can be named in Blender"),
        (["--protect", ""], 2, "expected a name, got none"),
        (["--protect", "box:1,2"], 2, "expected box:x0,y0,z0,x1,y1,z1 in numbers, got 'box:1,2'"),
        (["--protect", "box:0,0,0,1,1,one"], 2, "expected box:x0,y0,z0,x1,y1,z1 in numbers, got"),
        (["--protect", "box:0,0,0,1,0,1"], 2, "'box:0,0,0,1,0,1': box goes from 0 to 0 in y"),
        (["--protect", "box:0,0,nan,1,1,1"], 2, "box goes from nan to 1 in z"),
        (["--keep-inside", "sphere:0,0,0,-1"], 2, "sphere has radius -1, expected more than 0"),
        (["--keep-inside", "sphere:0,0,0,0"], 2, "sphere has radius 0, expected more than 0"),
        (["--keep-inside", "sphere:0,0,inf,1"], 2, "expected finite numbers"),
        (["--remove-inside", "sphere:99,0,0,1"], 1, "'sphere:99,0,0,1' holds the centre of no"),
        (["--remove-inside", "sphere:0,0,0,99"], 1, "all 577 splats lie where they must go"),
    ],
)
def test_what_cannot_be_is_refused_and_nothing_is_written(scene, capsys, options, code, expected):
    folder, _, _, out = scene

    assert call(folder, "prune", *options, "-o", out) == code
    assert expected in capsys.readouterr().err
    assert not out.exists()
