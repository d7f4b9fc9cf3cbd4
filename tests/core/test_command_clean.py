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


def call(files, command, *options, more=()):
    """Run a subcommand on the scene, and more inputs, and return its exit code."""
    return main([command, str(files / "scene.ply"), *more, "--cameras", str(files), *options])


def test_clean_says_why_and_writes_the_rest(files, capsys):
    """One of 577 splats goes; the report has the count of each reason."""
    out, told = files / "out.ply", files / "report.json"

    assert call(files, "clean", "-o", str(out), "--report", str(told)) == 0
    assert len(read_ply(out)) == SIDE**2
    assert "1 in front of surfaces (88 %); 576 of 577 splats stay" in capsys.readouterr().out
    facts = json.loads(told.read_text())["results"][0]["cleaned"]
    assert facts["front"] == 1
    assert facts["giant"] == 0
    assert facts["sure"] == {"front": 7 / 8, "isolated": None, "giant": None, "needle": None}


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


@pytest.mark.slow
@pytest.mark.parametrize("method", ["occlusion", "merge"])
def test_prune_cleans_before_the_budget_counts(files, capsys, method):
    """Of 577, one floats; half of the other 576 stay, and none of them is dark like the floater."""
    out = files / "out.ply"

    options = ["--clean", "--ratio", ".5", "--method", method]
    assert call(files, "prune", *options, "-o", str(out)) == 0
    assert "kept 288 of 577" in capsys.readouterr().out
    assert (read_ply(out).splats().means[:, 2] > 3.0).all()


@pytest.mark.slow
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


@pytest.mark.slow
def test_reasons_are_named_with_commas_before_or_behind_the_input(files):
    """With blanks between them the file behind them was taken for a reason."""
    scene, out = str(files / "scene.ply"), files / "out.ply"
    options = ["--cameras", str(files), "-o", str(out), "--overwrite"]

    assert main(["clean", "--reasons", "front,isolated", scene, *options]) == 0
    assert len(read_ply(out)) == SIDE**2
    assert main(["clean", scene, *options, "--reasons", "isolated, giant"]) == 0
    assert len(read_ply(out)) == SIDE**2 + 1


@pytest.mark.slow
def test_clean_takes_many_files_and_one_that_fails_does_not_stop_the_others(files, capsys):
    """As `prune` does: the second is no PLY."""
    (files / "broken.ply").write_bytes(b"no")
    (files / "again.ply").write_bytes((files / "scene.ply").read_bytes())
    names = [str(files / f"{name}.ply") for name in ("broken", "again")]

    code = call(files, "clean", "-o", str(files / "out"), more=names)

    assert code == 1
    assert "broken.ply" in capsys.readouterr().err
    assert sorted(path.name for path in (files / "out").iterdir()) == ["again.ply", "scene.ply"]
    assert len(read_ply(files / "out/again.ply")) == SIDE**2


def test_one_file_of_two_inputs_is_wrong_usage(files, capsys):
    """The same as of `prune`."""
    assert call(files, "clean", "-o", "x.ply", more=["a.ply"]) == 2
    assert "-o x.ply is one file, expected a folder" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["clean", "prune"])
def test_two_inputs_of_one_name_are_both_named(files, capsys, command):
    """They would be one file in the folder."""
    other = files / "other/scene.ply"

    assert call(files, command, "-o", str(files / "out"), more=[str(other)]) == 2
    said = capsys.readouterr().err
    assert f"{files / 'scene.ply'} and {other} would both be {files / 'out/scene.ply'}" in said


def test_a_file_of_splats_that_cannot_be_drawn_is_not_called_clean(files, capsys):
    """All positions are NaN: it said that there was nothing to clean away."""
    data = bytearray((files / "scene.ply").read_bytes())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    np.frombuffer(data, "<f4", offset=start).reshape(-1, len(NAMES))[:, 0] = np.nan
    (files / "scene.ply").write_bytes(data)

    assert call(files, "clean") == 1
    assert f"none of the {SIDE**2 + 1} splats can be drawn" in capsys.readouterr().err
