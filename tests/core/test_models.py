"""What writers of files say of how splats are drawn, and that it survives."""

from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import (
    Budget,
    ClosedForm,
    Levels,
    RefineError,
    View,
    ViewSet,
    convert_files,
    lod_file,
    prune_tiles,
    read_splats,
    score_file,
)
from refine_addon.core.formats.ply_columns import values_by_name
from refine_addon.core.formats.registry import FORMATS
from refine_addon.core.merging.merge import merge
from refine_addon.core.splats import (
    LOG_ZERO,
    LOW_PASS,
    MODELS,
    joined,
    opacity,
    rotation_matrices,
    with_model,
)
from refine_addon.core.visibility import projection
from refine_addon.core.visibility.cast import hits
from tests.strategies import ply_of, splat_names

from .test_numerics import cloud as random_splats
from .test_occlusion import splats_of


def cloud(count):
    """Return splats of all shapes, of degree 0."""
    return replace(random_splats(count), sh_rest=np.zeros((count, 0, 3), np.float32))


def write(path, splats, comments=()):
    """Write splats as a plain PLY whose header has these comments."""
    path.write_bytes(ply_of(values_by_name(splats), comments))
    return path


SIZES, TURNS = "scale_0 scale_1 scale_2", "rot_0 rot_1 rot_2 rot_3"
COLOR, USUAL = "f_dc_0 f_dc_1 f_dc_2 REST", f"opacity {SIZES} {TURNS}"
BRUSH = "by Brush", "Vertical axis: 0 -0.97 0.2", "SH degree: 2", "SplatRenderMode: mip"
WRITERS = {
    "Brush": (2, "antialiased", f"x y z {SIZES} opacity {TURNS} {COLOR}", *BRUSH),
    "Postshot": (3, "antialiased", f"x y z {COLOR} {USUAL}", "antialiased 1"),
    "SuperSplat": (3, "default", f"x y z {TURNS} {SIZES} opacity {COLOR}"),
    "SuperSplat, discs": (1, "2dgs", f"x y z {TURNS} {SIZES[:15]} opacity {COLOR}"),
    "LichtFeld Studio": (3, "default", f"red green blue x y z nx ny nz {COLOR} {USUAL}"),
    "KIRI": (1, "default", f"x y z red green blue alpha {COLOR} {USUAL} Paint~Mask", "by Blender"),
    "gsplat": (0, "default", f"x y z {COLOR} {USUAL}"),
    "odd": (0, "antialiased", f"x y z {COLOR} {USUAL}", "splatrendermode:  MIP ", "antialiased 2"),
    "two": (0, "default", f"x y z {COLOR} {USUAL}", "SplatRenderMode: 2dgs", "antialiased 0"),
    "nerfstudio": (4, "default", f"x y z nx ny nz {COLOR} {USUAL}", "Vertical Axis: z"),
}
"""Writer, by its sources of August 2026: degree, model, properties (``~`` is a space), comments."""


@pytest.mark.parametrize("writer", WRITERS)
def test_a_file_is_read_as_its_writer_meant_and_written_as_it_was(tmp_path, writer):
    """Each value is that of its name, of several words by Blender. The last comment counts."""
    degree, model, names, *comments = WRITERS[writer]
    random, columns = np.random.default_rng(len(names)), {}
    for name in names.replace("REST", " ".join(splat_names(degree)[6:-8])).split():
        kind = np.uint8 if name in ("red", "green", "blue", "alpha") else np.float32
        columns[name.replace("~", " ")] = random.uniform(0.0, 9.0, 7).astype(kind)
    path, same = tmp_path / "in.ply", tmp_path / "same.ply"
    path.write_bytes(ply_of(columns, comments))
    convert_files([path], same)
    file = read_splats(path)
    assert (file.splats().sh_degree, file.model, file.splats().model) == (degree, model, model)
    for name, values in values_by_name(file.splats()).items():
        np.testing.assert_array_equal(values, columns[name])
    assert same.read_bytes() == path.read_bytes()


def test_splats_without_a_third_scale_are_discs_and_stay_so(tmp_path):
    """They are read as of size 0 along their third axis, and written without it.
    So are discs of several files, whether these have it or not."""
    splats = replace(cloud(5), model="2dgs")
    path = write(tmp_path / "in.ply", splats, ["antialiased 1"])
    other = write(tmp_path / "other.ply", cloud(3), ["SplatRenderMode: 2dgs"])
    convert_files([other, path], tmp_path / "both.ply")
    read, both = read_splats(path), read_splats(tmp_path / "both.ply")
    assert read.model == "2dgs"
    np.testing.assert_array_equal(read.splats().log_scales[:, 2], np.float32(LOG_ZERO))
    np.testing.assert_array_equal(read.splats().log_scales[:, :2], splats.log_scales[:, :2])
    assert b"scale_2" not in both.header
    expected = joined([read_splats(other).splats(), read.splats()])
    np.testing.assert_array_equal(both.splats().log_scales, expected.log_scales)
    np.testing.assert_array_equal(both.splats().quaternions, expected.quaternions)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("form", FORMATS, ids=lambda form: form.suffix)
def test_a_format_tells_the_model_or_its_notes_do(tmp_path, form, model):
    """Every tag that a format holds comes back from it; of the others is said how to read it."""
    if form.suffix == ".sog":
        pytest.importorskip("PIL", reason="needs Pillow, which SOG does outside of Blender")
    source = write(tmp_path / "in.ply", cloud(40))
    between, back = tmp_path / f"between{form.suffix}", tmp_path / "back.ply"
    report = convert_files([source], between, model=model).report
    convert_files([between], back)
    held = model in form.models
    assert read_splats(back).model == (model if held else "default")
    assert any(f"splats are {model}" in note for note in report["notes"]) != held
    assert (b"scale_2" in back.read_bytes()) == (read_splats(back).model != "2dgs")


def test_what_is_asked_for_replaces_what_the_file_says(tmp_path):
    path = write(tmp_path / "in.ply", cloud(5), ["SplatRenderMode: mip", "by hand"])
    discs, plain, same = (read_splats(path, model) for model in ("2dgs", "default", "antialiased"))
    assert (discs.model, plain.model) == ("2dgs", "default")
    assert b"comment SplatRenderMode: 2dgs\n" in discs.header
    assert b"mip" not in plain.header
    assert b"comment by hand\n" in plain.header
    assert same.header == read_splats(path).header


def test_a_model_that_cannot_be_is_refused(tmp_path):
    path = write(tmp_path / "in.ply", replace(cloud(5), model="2dgs"))
    with pytest.raises(RefineError, match="splats without scale_2 are drawn as 2dgs, got"):
        read_splats(path, "default")
    with pytest.raises(RefineError, match="model is 'mip', expected one of default, antialiased"):
        read_splats(path, "mip")
    with pytest.raises(RefineError, match="different models"):
        joined([cloud(2), with_model(cloud(2), "2dgs")])


VIEW = View(np.eye(3), np.zeros(3), 100.0, 110.0, 60.3, 41.7, 120, 80, near=0.2)


def test_tiles_of_discs_may_state_them_in_either_way(tmp_path):
    """One has no third scale, the other a comment; together they are pruned as one scene."""
    discs = before_the_camera(20, 0.1, "2dgs")
    tiles = [tmp_path / "flat.ply", tmp_path / "said.ply"]
    write(tiles[0], discs)
    write(tiles[1], replace(discs, model="default"), ["SplatRenderMode: 2dgs"])

    assert b"scale_2" not in tiles[0].read_bytes()
    stats = prune_tiles(tiles, None, ViewSet((VIEW,)), Budget(ratio=0.5), ClosedForm())
    assert stats["splats"]["kept"] == 20


def footprints_of(splats, view=VIEW):
    gaussians, scene, _ = projection.prepare(splats, ViewSet((VIEW,)))
    return projection.project(gaussians, scene, view), gaussians


def before_the_camera(count, size, model):
    """Return opaque splats of all shapes before `VIEW`."""
    random = np.random.default_rng(3)
    splats = replace(
        cloud(count),
        means=random.uniform([-1.5, -1.0, 2.0], [1.5, 1.0, 4.0], (count, 3)),
        log_scales=random.normal(size, 0.5, (count, 3)),
        opacity_logits=np.full(count, 3.0),
    )
    return with_model(splats, model)


@pytest.mark.parametrize("size", [-4.0, -2.0])
def test_an_antialiased_footprint_keeps_the_integral_of_its_alpha(size):
    """``o' 2 pi sqrt(det(C + .3 I))`` is ``o 2 pi sqrt(det C)``: by the sigmas of both."""
    plain, _ = footprints_of(before_the_camera(50, size, "default"))
    faint, gaussians = footprints_of(before_the_camera(50, size, "antialiased"))
    rows = np.searchsorted(np.sort(plain.index), faint.index)
    plain = plain.take(np.argsort(plain.index)[rows])
    np.testing.assert_array_equal(faint.sigmas, plain.sigmas)
    sharp = np.sqrt(np.prod(plain.sigmas.astype(np.float64) ** 2 - LOW_PASS, axis=0))
    kept = faint.alphas * np.prod(faint.sigmas, axis=0)
    np.testing.assert_allclose(kept, gaussians.alphas[faint.index] * sharp, rtol=2e-3, atol=1e-5)


def test_a_ray_hits_a_disc_where_it_meets_its_plane():
    """Alpha is ``o exp(-q / 2)``, q where line and plane meet, or twice px^2 if less."""
    splats = before_the_camera(60, -2.0, "2dgs")
    footprints, gaussians = footprints_of(splats)
    columns, rows = np.arange(VIEW.width), np.arange(VIEW.height)
    turns, sizes = rotation_matrices(splats.quaternions), np.exp(splats.log_scales)
    found = 0

    for owner, pixel, alpha in hits(footprints, columns, rows, 1 << 16):
        for place, at, got in zip(owner[::97], pixel[::97], alpha[::97], strict=True):
            index = gaussians.index[footprints.index[place]]
            mean, turn = splats.means[index], turns[index]
            x, y = at % VIEW.width + 0.5, at // VIEW.width + 0.5
            ray = np.array([(x - VIEW.cx) / VIEW.fx, (y - VIEW.cy) / VIEW.fy, 1.0])
            hit = ray * (turn[:, 2] @ mean) / (turn[:, 2] @ ray)
            on_plane = np.sum((turn[:, :2].T @ (hit - mean) / sizes[index, :2]) ** 2)
            center = mean[:2] / mean[2] * [VIEW.fx, VIEW.fy] + [VIEW.cx, VIEW.cy]
            square = min(on_plane, 2.0 * np.sum((center - [x, y]) ** 2))
            expected = min(opacity(splats.opacity_logits[index]) * np.exp(-0.5 * square), 0.99)
            assert got == pytest.approx(expected, rel=2e-3)
            found += 1
    assert found > 50


def test_a_disc_seen_from_far_away_is_its_low_pass():
    """``o exp(-d^2)`` is 1 / 255 at d = 2.34 px: 19 pixels. Its axes differ by rounding alone."""
    far = replace(VIEW, center=np.array([0.0, 0.0, -1e17]), near=0.0)
    footprints, _ = footprints_of(before_the_camera(60, -2.0, "2dgs"), far)
    ((_, pixel, _),) = hits(footprints, np.arange(VIEW.width), np.arange(VIEW.height), 1 << 16)
    assert np.unique(pixel, return_counts=True)[1].tolist() == [60] * 19


def two(means, sizes, model):
    """Return two splats of one shape, along the axes."""
    return with_model(splats_of(means, 0.27, sizes, 0.78), model)


def merged_to_one(splats):
    """Merge splats in a view to which all contribute alike."""

    def seen_whole(left, _expected, _progress):
        return np.repeat([[10.0], [1.0]], len(left), axis=1)

    views, seen = ViewSet((VIEW,)), seen_whole(range(2), None, None)
    return merge(splats, views, seen, seen_whole, 1).splats


@pytest.mark.parametrize("model", MODELS)
def test_two_small_splats_merge_into_one_of_their_mass(model):
    """Seen by the camera that measured them, what they cover together stays, but for overlap."""
    splats = two([[-0.02, 0.0, 2.0], [0.02, 0.0, 2.0]], [0.01, 0.01, 0.01], model)
    merged = merged_to_one(splats)
    assert merged.model == model
    before, after = (
        np.prod(f.sigmas, axis=0) @ f.alphas for f, _ in map(footprints_of, (splats, merged))
    )
    assert after == pytest.approx(before, rel=0.12)


def test_of_discs_one_behind_the_other_comes_one_that_faces_the_camera():
    """The shortest axis of both lies across: without it the disc would be seen from its edge."""
    merged = merged_to_one(two([[0.0, 0.0, 1.95], [0.0, 0.0, 2.05]], [0.02, 0.01, 1.0], "2dgs"))
    assert abs(rotation_matrices(merged.quaternions)[0, 2, 2]) > 0.99
    np.testing.assert_allclose(np.sort(np.exp(merged.log_scales[0, :2])), [0.01, 0.02], rtol=0.02)


@pytest.mark.parametrize("model", MODELS)
def test_levels_and_scores_are_files_of_the_same_model(tmp_path, model):
    """Of splats that the file calls ordinary and `model=` does not; discs stay discs."""
    source = write(tmp_path / "in.ply", before_the_camera(60, -2.0, "default"))
    lod_file(source, tmp_path / "levels", ViewSet((VIEW,)), Levels((0.5,)), model=model)
    score_file(source, tmp_path / "scored.ply", ViewSet((VIEW,)), model=model)
    assert read_splats(tmp_path / "levels/in.lod1.ply").model == model
    assert read_splats(tmp_path / "scored.ply").model == model
