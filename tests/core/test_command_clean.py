"""The command `clean`, and `prune --clean`, on a wall with a floater in front of it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import read_ply

from .test_cleaning import FLOATER, SIDE, cameras, joined, wall

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
NAMES += [f"scale_{k}" for k in range(3)] + [f"rot_{k}" for k in range(4)]


@pytest.fixture
def files(tmp_path):
    """Return the folder with scene.ply, whose last splat floats, and cameras.json."""
    s = joined(wall(), FLOATER)
    columns = (s.means, s.sh_dc, s.opacity_logits[:, None], s.log_scales, s.quaternions)
    body = np.hstack(columns).astype("<f4").tobytes()
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(s)}"]
    head = "\n".join([*lines, *(f"property float {name}" for name in NAMES), "end_header", ""])
    (tmp_path / "scene.ply").write_bytes(head.encode() + body)
    poses = [
        {
            "id": k, "img_name": view.name, "width": view.width, "height": view.height,
            "position": view.center.tolist(), "rotation": view.rotation.tolist(),
            "fx": view.fx, "fy": view.fy,
        }
        for k, view in enumerate(cameras())
    ]  # fmt: skip
    (tmp_path / "cameras.json").write_text(json.dumps(poses))
    return tmp_path


def call(files, command, *options):
    """Run a subcommand on the scene, and return its exit code."""
    return main([command, str(files / "scene.ply"), "--cameras", str(files), *options])


def test_clean_says_why_and_writes_the_rest(files, capsys):
    """One of 577 splats goes; the report has the count of each reason."""
    out, told = files / "out.ply", files / "report.json"

    assert call(files, "clean", "-o", str(out), "--report", str(told)) == 0
    assert len(read_ply(out)) == SIDE**2
    assert "1 in front of surfaces in 3+ views; 576 of 577 splats stay" in capsys.readouterr().out
    facts = json.loads(told.read_text())["results"][0]["cleaned"]
    assert facts["front"] == 1
    assert facts["giant"] == 0


def test_without_an_output_nothing_is_written(files):
    """Only what would go is said."""
    before = sorted(files.iterdir())

    assert call(files, "clean") == 0
    assert sorted(files.iterdir()) == before


def test_a_reason_that_is_off_takes_nothing(files):
    """The floater is no giant."""
    out = files / "out.ply"

    assert call(files, "clean", "-o", str(out), "--reasons", "giant") == 0
    assert out.read_bytes() == (files / "scene.ply").read_bytes()


def test_an_unknown_reason_is_wrong_usage(files, capsys):
    """Argparse names the choices."""
    assert call(files, "clean", "--reasons", "fog") == 2
    assert "transparent" in capsys.readouterr().err


@pytest.mark.parametrize("absorb", [[], ["--absorb"]])
def test_prune_cleans_before_the_budget_counts(files, capsys, absorb):
    """Of 577, one floats; half of the other 576 stay, and none of them is dark like the floater."""
    out = files / "out.ply"

    assert call(files, "prune", "--clean", "--ratio", ".5", "-o", str(out), *absorb) == 0
    assert "kept 288 of 577" in capsys.readouterr().out
    assert (read_ply(out).splats().means[:, 2] > 3.0).all()


def test_unseen_splats_are_counted_of_those_that_cleaning_left(files, capsys):
    """Of 577, one floats; of the other 576, those count that land outside of all six images.

    They lie at a depth of 4 and the focal length is 60, half of an image 40 by 30: a splat is seen
    from within 2.67 beside and 2 above of it.
    """
    places = wall().means[:, None, :2] - np.array([view.center[:2] for view in cameras()])
    unseen = int((np.abs(places) > [8 / 3, 2.0]).any(axis=2).all(axis=1).sum())

    assert call(files, "prune", "--clean", "--dry-run") == 0
    assert 0 < unseen < SIDE**2
    assert f"\n  {unseen} of 576 splats lie in no view\n" in capsys.readouterr().out


def test_clean_goes_with_files_alone(files, capsys):
    """Objects are not cleaned by the command."""
    assert main(["prune", "--clean", "--object", "Splats"]) == 2
    assert "--clean goes with INPUT files" in capsys.readouterr().err
    assert call(files, "clean", "--views", "-1") == 2


def test_clean_says_what_a_lossy_format_does_to_what_stays(files, capsys):
    """As `prune` and `convert` do: `.splat` has a note of its own."""
    assert call(files, "clean", "-o", str(files / "out.splat")) == 0
    assert "  note: .splat " in capsys.readouterr().out
