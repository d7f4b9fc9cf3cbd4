"""Converting several files into one: moved, merged, with fewer harmonics, sorted."""

from __future__ import annotations

import json

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import (
    Move,
    RefineError,
    convert_files,
    read_splats,
)
from refine_addon.core.affine import transformed
from refine_addon.core.splats import ARRAYS
from tests.strategies import plain_ply, ply_of

from .test_formats import differences, scene


@pytest.fixture
def files(tmp_path):
    """Return a folder with 20 splats of degree 1 and 5 of degree 2, different ones."""
    (tmp_path / "a.ply").write_bytes(ply_of(scene(1, 20)))
    columns = {name: values + np.float32(0.25) for name, values in scene(2, 5).items()}
    (tmp_path / "b.ply").write_bytes(ply_of(columns))
    return tmp_path


def call(files, *arguments):
    """Run `convert` in a folder; names with a dot are files there."""
    given = [str(files / word) if word[0].isalpha() and "." in word else word for word in arguments]
    return main(["convert", *given])


def test_files_are_merged_in_their_order(files, capsys):
    """20 and 5 splats, those of degree 1 with zeros above, every value to the bit."""
    assert call(files, "a.ply", "b.ply", "out.ply") == 0

    one, two, both = (read_splats(files / f"{n}.ply").splats() for n in ("a", "b", "out"))
    for name in ARRAYS:
        values = getattr(both, name)
        if name == "sh_rest":
            np.testing.assert_array_equal(values[:20, :3], one.sh_rest)
            assert not values[:20, 3:].any()
        else:
            np.testing.assert_array_equal(values[:20], getattr(one, name))
        np.testing.assert_array_equal(values[20:], getattr(two, name))
    assert "a.ply + " in capsys.readouterr().out


def test_each_input_is_moved_by_its_own(files):
    """The second by half a turn about z, twice as large."""
    moves = Move((1, 0, -2)), Move((1, 0, -2), (0, 0, 180), 2)

    convert_files([files / "a.ply", files / "b.ply"], files / "out.ply", moves=moves)

    one, two, both = (read_splats(files / f"{n}.ply").splats() for n in ("a", "b", "out"))
    np.testing.assert_allclose(both.means[:20], one.means + np.array([1, 0, -2]), atol=1e-6)
    np.testing.assert_allclose(both.means[20:], two.means * [-2, -2, 2] + [1, 0, -2], atol=1e-5)
    np.testing.assert_allclose(both.log_scales[20:], two.log_scales + np.log(2.0), atol=1e-6)
    # Of degree 1, the functions of y and x change their sign.
    expected = two.sh_rest[:, :3] * np.array([-1, 1, -1])[:, None]
    np.testing.assert_allclose(both.sh_rest[20:, :3], expected, atol=1e-6)


def test_turns_come_about_x_then_y_then_z():
    """By hand: z goes to -y about x, and that to x about z. About y, x goes to -z."""
    point = np.array([0.0, 0.0, 1.0, 1.0])

    np.testing.assert_allclose(Move(rotate=(90, 0, 0)).matrix @ point, [0, -1, 0, 1], atol=1e-12)
    np.testing.assert_allclose(Move(rotate=(90, 0, 90)).matrix @ point, [1, 0, 0, 1], atol=1e-12)
    x = np.array([1.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(Move(rotate=(0, 90, 0)).matrix @ x, [0, 0, -1, 1], atol=1e-12)
    matrix = Move((1, 2, 3), scale=2.0).matrix
    np.testing.assert_allclose(matrix @ point, [1, 2, 5, 1], atol=1e-12)


@pytest.mark.parametrize("suffix", [".ply", ".splat", ".glb"])
def test_what_is_moved_is_what_the_matrix_makes_of_it(files, suffix):
    """In any format, within its bounds."""
    move = Move((0.5, 0.0, 0.0), (10.0, 20.0, 30.0), 1.5)

    convert_files([files / "a.ply"], files / f"out{suffix}", moves=(move,))

    expected = transformed(read_splats(files / "a.ply").splats(), move.matrix)
    found = differences(read_splats(files / f"out{suffix}").splats(), expected)
    assert found["mean"] < 1e-5
    assert found["log scale"] < 1e-5
    assert found["rotation"] < (0.07 if suffix == ".splat" else 1e-5)


def test_bands_are_left_out(files):
    """All above the degree; what stays is what it was, to the bit."""
    assert call(files, "b.ply", "out.ply", "--degree", "1") == 0

    before, after = (read_splats(files / f"{name}.ply").splats() for name in ("b", "out"))
    assert after.sh_degree == 1
    np.testing.assert_array_equal(after.sh_rest, before.sh_rest[:, :3])
    np.testing.assert_array_equal(after.means, before.means)


def test_a_curve_puts_nearby_order(tmp_path):
    """Of 4 clumps of 30 in turn, 119 steps lead from clump to clump; sorted, few do.

    A row without a position comes last.
    """
    columns = scene(0, 121)
    clump = np.arange(121) % 4
    for axis, name in enumerate("xyz"):
        columns[name] = (columns[name] * 0.001 + 9 * (clump >> axis & 1)).astype(np.float32)
    columns["y"][0] = np.nan
    (tmp_path / "in.ply").write_bytes(ply_of(columns))

    convert_files([tmp_path / "in.ply"], tmp_path / "out.ply", morton=True)

    means = read_splats(tmp_path / "out.ply").splats().means
    assert np.isnan(means[-1, 1])
    steps = np.abs(np.diff(means[:-1], axis=0)).max(axis=1)
    assert np.count_nonzero(steps > 5) <= 12
    assert sorted(means[:-1, 2]) == sorted(columns["z"][1:])


def test_a_single_file_of_which_nothing_is_asked_stays_as_it_is(tmp_path):
    """To the byte, with properties that no splat needs; else they are named and left out."""
    data = ply_of({**scene(1, 9), "mine": np.arange(9, dtype=np.float32)})
    (tmp_path / "in.ply").write_bytes(data)

    kept = convert_files([tmp_path / "in.ply"], tmp_path / "same.ply")
    less = convert_files([tmp_path / "in.ply"], tmp_path / "out.ply", degree=0)

    assert (tmp_path / "same.ply").read_bytes() == data
    assert kept.report["notes"] == []
    assert less.report["notes"] == ["splats are written anew, without mine"]
    assert "mine" not in read_splats(tmp_path / "out.ply").rows.dtype.names


def test_models_are_not_mixed(files, capsys):
    """What is drawn one way is not merged with what is drawn another."""
    data = (files / "b.ply").read_bytes()
    mip = data.replace(b"\nelement", b"\ncomment SplatRenderMode: mip\nelement", 1)
    (files / "b.ply").write_bytes(mip)

    assert call(files, "a.ply", "b.ply", "out.ply") == 1
    assert "b.ply: its splats are antialiased, those of" in capsys.readouterr().err
    assert not (files / "out.ply").exists()
    assert call(files, "b.ply", "out.ply", "--degree", "0") == 0
    assert read_splats(files / "out.ply").model == "antialiased"


def test_a_merge_may_replace_one_of_its_inputs(files):
    """All are read before one is replaced."""
    assert call(files, "a.ply", "b.ply", "a.ply") == 1
    assert len(read_splats(files / "a.ply")) == 20

    assert call(files, "a.ply", "b.ply", "a.ply", "--overwrite") == 0
    assert len(read_splats(files / "a.ply")) == 25


def test_a_level_of_a_streamed_sog_is_converted(tmp_path):
    """76 of 151 splats and 15 of the environment; other files have no levels."""
    pytest.importorskip("PIL", reason="needs Pillow, which SOG does outside of Blender")
    source = f"{__file__.rpartition('/core/')[0]}/data/other_tools/streamed/lod-meta.json"
    plain, out = str(tmp_path / "in.ply"), str(tmp_path / "out.ply")
    (tmp_path / "in.ply").write_bytes(plain_ply(3, 1))

    convert_files([source, plain], out, level=1)
    assert len(read_splats(out)) == 76 + 15 + 3
    with pytest.raises(RefineError, match=r"only lod-meta\.json has levels"):
        convert_files([plain], out, level=1, overwrite=True)
    with pytest.raises(RefineError, match="no level 7, expected 0 to 1"):
        convert_files([source], out, level=7, overwrite=True)


def test_the_report_names_all_inputs(files):
    """And their bytes together."""
    told = files / "report.json"
    assert call(files, "a.ply", "b.ply", "out.spz", "--report", str(told), "--quiet") == 0

    (entry,) = json.loads(told.read_text())["results"]
    sizes = [(files / name).stat().st_size for name in ("a.ply", "b.ply")]
    assert entry["files"]["input"] == f"{files / 'a.ply'} + {files / 'b.ply'}"
    assert entry["files"]["input_bytes"] == sum(sizes)
    assert entry["splats"] == {"before": 25, "written": 25, "left_out": 0}


def test_wrong_usage_ends_before_any_work(files, capsys):
    """Code 2, and no file."""
    assert call(files, "a.ply", "b.ply", "out.ply", "--degree", "5") == 2
    assert "invalid choice" in capsys.readouterr().err
    assert call(files, "a.ply", "b.ply", "folder") == 2
    assert "folder: expected a name that ends in .ply" in capsys.readouterr().err
    assert not (files / "out.ply").exists()


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"scale": 0}, "scale is 0, expected more than 0"),
        ({"scale": float("nan")}, "expected finite numbers to move by"),
    ],
)
def test_a_move_that_is_none_is_refused(values, word):
    with pytest.raises(RefineError, match=word):
        Move(**values)


def test_a_move_that_splats_cannot_follow_is_refused(files):
    """Beyond what float32 holds; the matrix says so."""
    with pytest.raises(RefineError, match="scale"):
        convert_files([files / "a.ply"], files / "o.ply", moves=(Move(scale=1e31),))
