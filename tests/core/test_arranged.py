"""Converting several files into one: moved, merged, with fewer harmonics, sorted."""

import json

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import RefineError, convert_files, read_splats
from refine_addon.core.splats import ARRAYS
from tests.places import DATA
from tests.strategies import plain_ply, ply_of

from .test_formats import scene


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
    """20 and 5 splats, those of degree 1 with zeros above, every value to the bit.
    The report names both inputs and their bytes together. One of them is replaced when told alone.
    """
    told = files / "report.json"
    one, two = (read_splats(files / f"{name}.ply").splats() for name in ("a", "b"))
    bytes_before = sum((files / name).stat().st_size for name in ("a.ply", "b.ply"))
    assert call(files, "a.ply", "b.ply", "a.ply") == 1
    assert len(read_splats(files / "a.ply")) == 20
    capsys.readouterr()
    assert call(files, "a.ply", "b.ply", "a.ply", "--overwrite", "--report", str(told)) == 0
    both = read_splats(files / "a.ply").splats()
    padded = np.pad(one.sh_rest, ((0, 0), (0, 5), (0, 0)))
    for name in ARRAYS:
        first = padded if name == "sh_rest" else getattr(one, name)
        np.testing.assert_array_equal(getattr(both, name)[:20], first)
        np.testing.assert_array_equal(getattr(both, name)[20:], getattr(two, name))
    assert "a.ply + " in capsys.readouterr().out
    (entry,) = json.loads(told.read_text())["results"]
    assert entry["files"]["input"] == f"{files / 'a.ply'} + {files / 'b.ply'}"
    assert entry["files"]["input_bytes"] == bytes_before
    assert entry["splats"] == {"before": 25, "written": 25, "left_out": 0}


def test_each_input_is_moved_by_its_own(files):
    """The second by half a turn about z, twice as large."""
    moves = np.eye(4), np.diag([-2.0, -2.0, 2.0, 1.0])
    for matrix in moves:
        matrix[:3, 3] = 1, 0, -2
    inputs = [files / "a.ply", files / "b.ply"]
    one, two = (read_splats(path).splats() for path in inputs)
    convert_files(inputs, files / "out.ply", matrices=moves)
    both = read_splats(files / "out.ply").splats()
    np.testing.assert_allclose(both.means[:20], one.means + np.array([1, 0, -2]), atol=1e-6)
    np.testing.assert_allclose(both.means[20:], two.means * [-2, -2, 2] + [1, 0, -2], atol=1e-5)
    np.testing.assert_allclose(both.log_scales[20:], two.log_scales + np.log(2.0), atol=1e-6)
    # Of degree 1, the functions of y and x change their sign.
    expected = two.sh_rest[:, :3] * np.array([-1, 1, -1])[:, None]
    np.testing.assert_allclose(both.sh_rest[20:, :3], expected, atol=1e-6)


def test_a_curve_puts_nearby_order(tmp_path):
    """Of 4 clumps of 30 in turn, 119 steps lead from clump to clump; sorted, few do.
    A row without a position comes last."""
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


def test_models_are_not_mixed_and_bands_are_left_out(files, capsys):
    """What is drawn one way is not merged with what is drawn another.
    All bands above the degree go; what stays is what it was, to the bit."""
    before = read_splats(files / "b.ply").splats()
    data = (files / "b.ply").read_bytes()
    mip = data.replace(b"\nelement", b"\ncomment SplatRenderMode: mip\nelement", 1)
    (files / "mip.ply").write_bytes(mip)

    assert call(files, "a.ply", "mip.ply", "out.ply") == 1
    assert "mip.ply: its splats are antialiased, those of" in capsys.readouterr().err
    assert not (files / "out.ply").exists()
    assert call(files, "mip.ply", "out.ply", "--degree", "1") == 0
    after = read_splats(files / "out.ply")
    assert after.model == "antialiased"
    np.testing.assert_array_equal(after.splats().sh_rest, before.sh_rest[:, :3])
    np.testing.assert_array_equal(after.splats().means, before.means)


def test_a_level_of_a_streamed_sog_is_converted(tmp_path):
    """76 of 151 splats and 15 of the environment; other files have no levels."""
    pytest.importorskip("PIL", reason="needs Pillow, which SOG does outside of Blender")
    source = DATA / "other_tools/streamed/lod-meta.json"
    plain, out = tmp_path / "in.ply", tmp_path / "out.ply"
    plain.write_bytes(plain_ply(3, 1))
    convert_files([source, plain], out, level=1)
    assert len(read_splats(out)) == 76 + 15 + 3
    with pytest.raises(RefineError, match=r"only lod-meta\.json has levels"):
        convert_files([plain], out, level=1, overwrite=True)


def test_a_degree_or_a_name_that_cannot_be_is_refused(files, capsys):
    assert call(files, "a.ply", "o.ply", "--degree", "5") == 2
    assert call(files, "a.ply", "b.ply", "folder") == 2
    assert "folder: expected a name that ends in .ply" in capsys.readouterr().err
    assert not (files / "o.ply").exists()


@pytest.mark.parametrize(
    ("sources", "how", "words"),
    [
        ([], {}, "no files to convert, expected at least one"),
        (["a.ply"], {"matrices": [1, 1]}, "got 2 matrices, expected 1: one for each file"),
        (["a.ply"], {"matrices": [np.eye(3)]}, r"expected a finite \(4, 4\) matrix"),
        (["a.ply"], {"matrices": [np.zeros((4, 4))]}, "flat or not affine"),
        (["a.ply"], {"degree": -1}, "degree is -1, expected a whole number from 0 to 4"),
    ],
    ids=["no files", "number", "shape", "flat", "degree"],
)
def test_a_call_that_does_not_fit_is_refused(files, sources, how, words):
    with pytest.raises(RefineError, match=words):
        convert_files([files / name for name in sources], files / "o.ply", **how)
