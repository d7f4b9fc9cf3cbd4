"""Every format but plain PLY: what comes back lies within the bounds of docs/conventions.md."""

import os
import re
import struct
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import (
    METHODS,
    Budget,
    RefineError,
    Splats,
    prune_file,
    read_cameras,
    read_ply,
    read_splats,
    write_splats,
)
from refine_addon.core.formats import registry
from refine_addon.core.formats.registry import SUFFIXES
from refine_addon.core.pictures import PictureFiles
from refine_addon.core.splats import base_color, opacity, rotation_matrices
from tests.places import DATA
from tests.strategies import cameras_json, ply_of, splat_names
from tests.users import own_folder

FORMATS = [form for form in registry.FORMATS if form.suffix != ".sog" or find_spec("PIL")]
"""All but plain PLY; SOG where Pillow is installed."""

SUFFIX = [form.suffix for form in FORMATS]
KSPLAT = DATA / "other_tools/level_1.ksplat"
COUNT = 600
"""Splats of the test scene: two whole chunks of a compressed PLY and a part of one."""


def scene(degree: int = 0, count: int = COUNT) -> dict[str, np.ndarray]:
    """Return columns of splats in the order of x, each .01 from the next."""
    random = np.random.default_rng(5)
    columns = {n: random.normal(0.0, 0.5, count).astype(np.float32) for n in splat_names(degree)}
    columns["x"] = (np.arange(count) * 0.01 - 2.0).astype(np.float32)
    columns["opacity"] *= 4.0
    for name in columns:
        columns[name] -= 4.0 * name.startswith("scale_")
        columns[name] *= 0.3 if name.startswith("f_rest_") else 1.0
    return columns


def written(folder: Path, suffix: str, columns: dict[str, np.ndarray]) -> Path:
    """Write columns as a plain PLY and then in a format; return the path of that."""
    (folder / "in.ply").write_bytes(ply_of(columns))
    path = folder / f"made{suffix}"
    write_splats(path, read_splats(folder / "in.ply"), overwrite=True)
    return path


def in_order(splats: Splats) -> Splats:
    """Return splats in the order of x, since some formats sort them."""
    return splats.take(np.argsort(splats.means[:, 0], kind="stable"))


def differences(one: Splats, other: Splats) -> dict[str, float]:
    """Return the largest differences: absolute, of the activated values; log of the scale."""
    rest = min(one.sh_rest.shape[1], other.sh_rest.shape[1])
    turns = rotation_matrices(one.quaternions) - rotation_matrices(other.quaternions)
    step = np.abs(one.sh_rest[:, :rest] - other.sh_rest[:, :rest])
    return {
        "mean": np.abs(one.means - other.means).max(),
        "log scale": np.abs(one.log_scales - other.log_scales).max(),
        "opacity": np.abs(opacity(one.opacity_logits) - opacity(other.opacity_logits)).max(),
        "color": np.abs(base_color(one.sh_dc) - base_color(other.sh_dc)).max(),
        "rotation": np.abs(turns).max(),
        "harmonics": step.max(initial=0.0),
    }


NAMES = ("mean", "log scale", "opacity", "color", "rotation", "harmonics")
BYTE, DEEP = 0.5 / 255, 8 * 0.5 * 2**0.5 / 1023
BOUNDS = {
    # Of a quaternion's component: half a step of 1/128, or a whole one at +1, which is code 255.
    # A matrix's entries are sums of two products of two components, times 2: at most 4 times that
    # for each of two components.
    ".splat": (0.0, 1e-6, BYTE + 1e-6, BYTE + 1e-6, 8 / 128, np.inf),
    # Half a step of the range of a chunk, which is at most that of the scene: y and z and the log
    # scales of 600 normal deviates times .5 lie within 4 (8 deviations). A component of a rotation
    # is off by half a step of sqrt(2) / 1023, the largest by up to three times that.
    ".compressed.ply": (
        *(0.5 * 6.0 / 1023 + 1e-6, 0.5 * 4.0 / 1023 + 1e-6, BYTE + 1e-6, 1.2 * BYTE + 1e-6),
        *(DEEP, 1 / 64 + 1e-6),
    ),
    # Half of 1/65535 of 2 log(1 + 4), times 1 + 4; half of 1/127 of the range of all log scales or
    # colours; of 2/255/sqrt(2). Each splat of 512 palettes' groups is near its mean.
    ".sog": (
        *(0.5 * 3.3 / 65535 * 5.0, 0.5 * 4.0 / 127, BYTE + 1e-6, 0.5 * 1.2 / 127),
        *(8 * 0.5 * 2**0.5 / 255, 1.0),
    ),
    # float32 of what is activated: 6e-8 of the value. An opacity p has the logit log(p / (1 - p)).
    ".glb": (0.0, 1e-6, 1e-7, 1e-7, 1e-6, 0.0),
    # Half of 1/4096; of 1/16; of f_dc's 1/38.25, which is .282 / 38.25 of colour; of sqrt(.5) / 511
    # for a rotation's component; of 16/128 and then of 1/128.
    ".spz": (
        *(0.5 / 4096 + 1e-6, 0.5 / 16 + 1e-6, BYTE + 1e-6, 0.5 * 0.2821 / 38.25 + 1e-6),
        *(DEEP, 0.5 / 8 + 0.5 / 128 + 1e-6),
    ),
}
BOUNDS = {key: dict(zip(NAMES, bounds, strict=True)) for key, bounds in BOUNDS.items()}
"""Suffix -> largest differences that docs/conventions.md allows in the test scene."""


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("suffix", SUFFIX)
def test_what_comes_back_lies_within_the_bounds(tmp_path, suffix, degree):
    """Written, read as what it is, compared splat by splat with activated values.
    Any format but .splat is read under any name. A plain PLY of it has the same numbers."""
    path = written(tmp_path, suffix, scene(degree))
    other = path.rename(tmp_path / ("in.bin" if suffix != ".splat" else "IN.SPLAT"))
    file = read_splats(other)
    file.write(tmp_path / "plain.ply")
    source, form = read_splats(tmp_path / "in.ply"), FORMATS[SUFFIX.index(suffix)]
    found = differences(in_order(file.splats()), source.splats())
    moved = np.linalg.norm(in_order(file.splats()).means - source.splats().means, axis=1).max()
    note = f"{suffix} moves splats by up to {moved:.3g}, those beside an outlier farthest"
    _, told = registry.losses(source, form, np.ones(COUNT, np.bool_))
    assert (note in told) == (form is FORMATS[0])
    assert (len(file), file.splats().sh_degree) == (COUNT, min(degree, form.degree))
    assert file.format.startswith(form.name)
    assert file.stored_bytes == other.stat().st_size
    for name, bound in BOUNDS[suffix].items():
        assert found[name] <= bound, name
    plain = read_ply(tmp_path / "plain.ply").rows
    assert (plain.tobytes(), plain.dtype) == (file.rows.tobytes(), file.rows.dtype)


@pytest.mark.parametrize("suffix", SUFFIX)
def test_what_a_format_cannot_hold_is_left_out_with_a_note(tmp_path, suffix):
    """Of 40 splats, one has no number as mean and one opacity 0: 38 are written.
    Only PLY and SPZ hold degree 4, only PLY a property that is no splat's; others refuse it."""
    columns = {**scene(4, 40), "mine": np.zeros(40, np.float32)}
    columns["y"][3], columns["opacity"][5] = np.nan, -np.inf
    columns["scale_1"][7] = -np.inf  # flat, which can be drawn
    columns["opacity"][9] = np.inf
    splats = read_splats(written(tmp_path, suffix, columns)).splats()
    source, form = read_splats(tmp_path / "in.ply"), FORMATS[SUFFIX.index(suffix)]
    missing, notes = registry.losses(source, form, np.ones(40, np.bool_))
    assert (len(splats), missing, splats.sh_degree) == (38, 2, form.degree)
    assert any(note.startswith("2 of the kept splats cannot be drawn") for note in notes)
    degrees = f"degree {form.degree}, the file has degree 4"
    assert any(degrees in note for note in notes) == (form.degree < 4)
    assert f"{suffix} does not hold mine: left out" in notes
    with pytest.raises(RefineError, match=r"holds no property 'score'; write to a \.ply"):
        write_splats(tmp_path / f"a{suffix}", source, columns={"score": np.zeros(40, np.float32)})
    assert not (tmp_path / f"a{suffix}").exists()


@pytest.mark.parametrize("suffix", SUFFIX)
def test_one_colour_beyond_all_others_is_no_file_that_is_refused(tmp_path, suffix, cameras):
    """1e20 is more than a number in JSON may be here, and so is 1e30 of a harmonic.
    A .sog was written, could not be read again, and stayed where it was with exit code 1."""
    columns = scene(1)
    columns["f_dc_1"][7], columns["f_rest_4"][9] = 1e20, -1e30
    (tmp_path / "in.ply").write_bytes(ply_of(columns))
    output = tmp_path / f"p{suffix}"
    prune_file(tmp_path / "in.ply", output, cameras, Budget(ratio=0.0))
    splats = in_order(read_splats(output).splats())
    others = np.arange(COUNT) != 7
    assert len(splats) == COUNT
    assert np.isfinite(splats.sh_dc).all()
    if suffix not in (".compressed.ply", ".sog"):  # which share their range with others
        plain = read_splats(tmp_path / "in.ply").splats()
        colors = base_color(splats.sh_dc[others]) - base_color(plain.sh_dc[others])
        assert np.abs(colors).max() <= BOUNDS[suffix]["color"]


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [*SUFFIX, ".ksplat"])
def test_a_file_cut_anywhere_is_refused(tmp_path, suffix):
    """With a sentence that names it, or, of .splat between two splats, read as fewer splats."""
    path = tmp_path / "a.ksplat"
    if suffix != path.suffix:
        path = written(tmp_path, suffix, scene(1, 3))
    whole = path.read_bytes() if path.exists() else KSPLAT.read_bytes()
    every = range(1, len(whole))
    for cut in sorted({*every[:80], *every[:: max(len(whole) // 80, 1)], *every[-80:]}):
        path.write_bytes(whole[:cut])
        if suffix == ".splat" and cut % 32 == 0:
            assert len(read_splats(path)) == cut // 32
            continue
        with pytest.raises(RefineError, match=re.escape(f"{path}: ")):
            read_splats(path)


@pytest.mark.parametrize("method", ["closed-form", "merge"])
@pytest.mark.parametrize("suffix", SUFFIX)
def test_a_size_is_kept_to(tmp_path, suffix, cameras, method):
    """Never above, at most 2 % below; a dry run tells the same. In 100 bytes nothing fits."""
    source, path = tmp_path / "in.ply", tmp_path / f"out{suffix}"
    source.write_bytes(ply_of(scene(1, 5 * COUNT)))
    whole = written(tmp_path, suffix, scene(1, 5 * COUNT)).stat().st_size / 1e6
    for share in (0.3, 0.7):
        asked = source, path, cameras, Budget(max_mb=share * whole), METHODS[method]()
        planned = prune_file(*asked, dry_run=True).report["files"]["output_bytes"]
        prune_file(*asked, overwrite=True)
        assert 0.98 * share * whole <= path.stat().st_size / 1e6 <= share * whole
        assert planned == path.stat().st_size
    all_of_it = prune_file(*asked[:3], Budget(max_mb=2 * whole), overwrite=True).report
    assert all_of_it["splats"]["removed"] == 0
    with pytest.raises(RefineError, match=r"max_mb is 0\.0001|max_mb is 1e-05"):
        prune_file(*asked[:3], Budget(max_mb=1e-5), overwrite=True)


@pytest.mark.skipif(os.name != "posix", reason="needs permissions")
def test_a_file_that_may_not_be_read_is_replaced(cameras):
    """The new one may not be read either: what it rounds is not told, where the run had failed.
    Pictures are those of what was written before it was rounded."""
    with own_folder() as folder:
        (folder / "in.ply").write_bytes(ply_of(scene()))
        output, pictures = folder / "out.splat", PictureFiles(folder, "a")
        output.write_bytes(b"old")
        output.chmod(0o200)
        asked = {"overwrite": True, "pictures": pictures, "threads": 1}
        report = prune_file(folder / "in.ply", output, cameras, Budget(keep=300), **asked).report
        assert report["written_psnr"] is None
        assert len(report["pictures"]["views"]) == 2
        assert output.stat().st_mode & 0o777 == 0o200
        output.chmod(0o600)
        assert len(read_splats(output)) == 300


@pytest.fixture(scope="module")
def cameras(tmp_path_factory):
    """Return two views of the test scene."""
    path = tmp_path_factory.mktemp("views") / "cameras.json"
    path.write_text(cameras_json({"a": [0, 0, -6], "b": [1, 0, -6]}, 30, 64, 48))
    return read_cameras(path)


def test_the_command_converts_by_the_suffix(tmp_path, capsys):
    """PLY to .splat and back. A .ksplat would hold a PLY; scores have no place but in a PLY."""
    (tmp_path / "in.ply").write_bytes(ply_of(scene()))
    source, there, back = (str(tmp_path / name) for name in ("in.ply", "a.splat", "b.ply"))
    assert main(["convert", source, there]) == 0
    assert main(["convert", there, back]) == 0
    assert main(["convert", there, back]) == 1
    said = capsys.readouterr()
    assert f"in.ply: 600 splats, 34.0 -> 19.2 kB -> {there}\n  note: .splat holds c" in said.out
    assert "exists already" in said.err
    assert read_ply(back).rows.tobytes() == read_splats(there).rows.tobytes()
    for name in ("a.ksplat", "a.gltf", "meta.json", "lod-meta.json"):
        assert main(["convert", source, str(tmp_path / name)]) == 2
    assert main(["score", source, "-o", there]) == 2
    said = capsys.readouterr().err
    assert all(f"{end} is not written" in said for end in (".ksplat", ".gltf", ".json"))
    assert "only a .ply holds scores" in said
    assert f"holds levels, which lod makes; expected one of {', '.join(SUFFIXES)}" in said


def test_a_splat_file_written_by_hand(tmp_path):
    """Mean and scale as floats; red 255 is 1, which is f_dc = .5 / .282095; 128 is no turn.
    The rotation (128, 192, 128, 128) is (0, .5, 0, 0): half a turn about x once it has length 1."""
    row = struct.pack("<6f", 1.0, -2.0, 3.0, 0.5, 1.0, 2.0)
    (tmp_path / "a.splat").write_bytes(row + bytes([255, 0, 51, 204, 128, 192, 128, 128]))
    splats = read_splats(tmp_path / "a.splat").splats()
    assert splats.means.tolist() == [[1.0, -2.0, 3.0]]
    np.testing.assert_allclose(splats.log_scales, np.log([[0.5, 1.0, 2.0]]), rtol=1e-6)
    np.testing.assert_allclose(splats.sh_dc * 0.28209479, [[0.5, -0.5, -0.3]], atol=1e-6)
    np.testing.assert_allclose(splats.opacity_logits, [np.log(4.0)], rtol=1e-6)
    assert splats.quaternions.tolist() == [[0.0, 1.0, 0.0, 0.0]]
