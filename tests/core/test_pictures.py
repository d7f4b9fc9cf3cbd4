"""Pictures of views: what is drawn, alone or among other things, and the files they become."""

import itertools
import struct
from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import RefineError
from refine_addon.core.execute import Cancelled, within
from refine_addon.core.images import read_exr
from refine_addon.core.pictures import (
    AMPLIFIED,
    KINDS,
    PictureFiles,
    compare,
    draw,
    fitted,
    in_order,
    measured_in_words,
    seen_from,
)
from refine_addon.core.views import View, ViewSet
from tests.core.test_occlusion import cloud, splats_of

RED, GREEN, BLUE = np.eye(3)


def view_of(width, height, focal=50.0, **more):
    """A view from the origin along z."""
    return View(np.eye(3), np.zeros(3), focal, focal, width / 2, height / 2, width, height, **more)


def crowd(count=300):
    """Many splats of all shapes before a view, with harmonics."""
    return replace(cloud(count, 1), means=cloud(count, 1).means * 0.8 + [0.0, 0.0, 3.5])


def test_a_splat_is_a_gaussian_of_its_size_and_the_low_pass():
    """Deviation .1 at depth 2 through 50 px: (50 .1 / 2)^2 + .3 = 6.55 px^2, around the middle.

    The pixel (k, m) has its centre at k + .5; d px aside alpha is .6 exp(-d^2 / 2 / 6.55).
    """
    splats = splats_of([[0, 0, 2]], 0.6, 0.1, [[0.9, 0.5, 0.1]])
    (found,) = compare(splats, splats, ViewSet((view_of(41, 31),)))
    for aside, down in itertools.product((0, 1, 4), (0, 2)):
        alpha = 0.6 * np.exp(-(aside**2 + down**2) / 2.0 / 6.55)
        expected = 255.0 * alpha * np.array([0.9, 0.5, 0.1])
        assert np.abs(found.before[15 + down, 20 + aside] - expected).max() <= 0.51
    assert found.before[0, 0].tolist() == [0, 0, 0]


@pytest.mark.slow
def test_pictures_do_not_depend_on_threads_or_on_how_many_pairs_are_drawn_at_a_time(monkeypatch):
    """Nor on the order of splats; only sums of float64 differ. MSE of 8 bits is near."""
    splats, views = crowd(), ViewSet((view_of(120, 80, 90.0),))
    half = splats.take(np.arange(0, len(splats), 2))
    (one,), (same,) = (within(cores=1)(compare)(splats, each, views) for each in (half, splats))
    monkeypatch.setattr("refine_addon.core.pictures._PAIRS", 1000)
    (other,) = within(cores=3)(compare)(splats.take(slice(None, None, -1)), half, views)
    assert abs(one.psnr - other.psnr) < 1e-9
    assert np.abs(one.before.astype(int) - other.before).max() <= 1  # a half rounds either way
    error = np.mean((one.after / 255.0 - one.before / 255.0) ** 2)
    assert abs(one.psnr + 10.0 * np.log10(error)) < 0.1
    assert same.psnr == 100.0
    apart = np.abs(one.after.astype(int) - one.before)
    assert np.array_equal(one.difference, np.minimum(AMPLIFIED * apart, 255))


def test_a_view_of_many_pixels_is_drawn_smaller_and_sees_the_same():
    """4000 x 3000 px becomes 960 x 720; a point stays at the same share of the image."""
    small = fitted(replace(view_of(4000, 3000, 2000.0), cx=1500.0), 10.0)
    assert (small.width, small.height, small.near) == (960, 720, 0.1)
    assert [small.fx / 960, small.cx / 960] == pytest.approx([2000.0 / 4000, 1500.0 / 4000])
    assert repr(fitted(small, 10.0)) == repr(small)


def test_what_cannot_be_drawn_or_is_too_near_is_not_and_drawing_can_be_cancelled():
    """The near plane is a share of the scene, which pruning changes: one for both pictures."""
    bad = replace(crowd(3), opacity_logits=np.full(3, np.nan))
    far = [[x, 0.0, 400.0] for x in (-90.0, 0.0, 90.0)]
    alphas, scales = [0.9, 0.01, 0.01, 0.01], [[0.05], [1.0], [1.0], [1.0]]
    splats = splats_of([[0.0, 0.0, 0.5], *far], alphas, scales, [1.0, 0.5, 0.5, 0.5])
    views = ViewSet((view_of(20, 10),))
    (black,) = compare(bad, bad, views)
    (found,) = compare(splats, splats.take(np.array([0])), views)
    assert black.before.shape == (10, 20, 3)
    assert not black.before.any()
    assert found.before[5, 10].max() <= 4  # nearer than a hundredth of the scene's size
    assert not found.after.any()
    with pytest.raises(Cancelled):
        compare(crowd(), crowd(), views, progress=lambda *_: False)


def test_files_are_named_after_splats_and_camera_and_hold_the_pictures(tmp_path):
    """Two of three views have one name; what no file can be called stands as _."""
    image = pytest.importorskip("PIL.Image", reason="needs Pillow, which reads pictures")
    names = ("left/0.JPG", "left/0.JPG", "Camera: A.001")
    views = ViewSet(tuple(replace(view_of(40, 30), name=name) for name in names))
    splats, half = crowd(50), crowd(50).take(np.arange(25))
    facts = PictureFiles(tmp_path, "my/room").write(splats, half, views)
    stems = ["my_room-left_0", "my_room-left_0_2", "my_room-Camera_ A.001"]
    expected = {f"{stem}-{kind}.png" for stem in stems for kind in KINDS}
    assert {path.name for path in tmp_path.iterdir()} == expected
    assert [view["camera"] for view in facts["views"]] == list(names)
    found = compare(splats, half, views)
    for one, told in zip(found, facts["views"], strict=True):
        assert (told["size"], told["psnr"]) == ([40, 30], round(one.psnr, 2))
        for kind in KINDS:
            assert np.array_equal(np.asarray(image.open(told[kind])), getattr(one, kind))
    assert facts["psnr"] == round(sum(one.psnr for one in found) / 3, 2)
    assert measured_in_words(facts).startswith(f"{facts['psnr']:.1f} dB measured in 3 views (")


def layer_of(color, alpha, depth, size=9):
    """Colours, alphas and depths of a layer that is the same in all pixels."""
    plane = np.ones((size, size))
    return alpha * np.asarray(color)[:, None, None] * plane, alpha * plane, depth * plane


def two_splats():
    """Two wide splats before the view: red of opacity .8 at depth 2, green of .5 at 4."""
    return splats_of([[0, 0, 2], [0, 0, 4]], [0.8, 0.5], [[50.0], [100.0]], [RED, GREEN])


@pytest.mark.parametrize(
    ("alpha", "depth", "expected"),
    [
        (1.0, 1.0, [0.0, 0.0, 1.0, 1.0]),
        (1.0, 3.0, [0.8, 0.0, 0.2, 1.0]),
        (1.0, 5.0, [0.8, 0.1, 0.1, 1.0]),
        (0.4, 1.0, [0.6 * 0.8, 0.6 * 0.1, 0.4, 1.0 - 0.6 * 0.1]),
        (0.4, 3.0, [0.8, 0.6 * 0.1, 0.2 * 0.4, 1.0 - 0.6 * 0.1]),
        (0.4, 5.0, [0.8, 0.1, 0.1 * 0.4, 1.0 - 0.1 * 0.6]),
        (0.0, 1.0, [0.8, 0.1, 0.0, 0.9]),
    ],
)
def test_a_layer_hides_what_is_behind_it_by_its_alpha(alpha, depth, expected):
    """Each shows what those before it let through, (1 - .8) = .2, then .2 * .5.

    The rest of 1 is seen of a white background, which counts for no alpha. A correction by it is
    seen where an opaque layer is, which hides the splats behind.
    """
    layer = in_order([layer_of(BLUE, alpha, depth)])
    lit = replace(layer, background=(1.0 - alpha) * np.ones((3, 9, 9)))
    picture, light = (draw(two_splats(), view_of(9, 9), each)[:, 4, 4] for each in (layer, lit))
    assert np.abs(picture - expected).max() < 2e-3  # a splat is not quite flat
    left = 1.0 - expected[3]
    assert np.abs(light - picture - [left, left, left, 0.0]).max() < 1e-3
    dark = replace(layer, background=np.full((3, 9, 9), -0.1 * (alpha == 1.0)))
    blue = draw(two_splats(), view_of(9, 9), dark)[2, 4, 4]
    assert blue == pytest.approx(expected[2] * (1.0 - 0.1 * (alpha == 1.0)), abs=2e-3)


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize(
    ("near", "far", "expected", "over"),
    [
        # Blue glass of .4, a red splat of .8, a white wall that hides the green one.
        ((BLUE, 0.4), (np.ones(3), 1.0), [0.6 * 0.8, 0.0, 0.4, 1.0], [0.6, 0.6, 1.0]),
        # Grey panes of .5: half of the red, .2 * .5 of which is left, of that half of the green.
        ((np.zeros(3), 0.5), (np.zeros(3), 0.5), [0.4, 0.025, 0.0, 0.975], [0.0] * 3),
    ],
)
def test_splats_between_two_layers_are_seen_through_the_nearer_one(
    near, far, expected, over, order
):
    """White, the wall adds the .6 * .2 that is left; the order of layers is all one."""
    layers = in_order([layer_of(*near, 1.0), layer_of(*far, 3.0)][::order])
    picture = draw(two_splats(), view_of(9, 9), layers)[:, 4, 4]
    wall = 0.12 * far[0][0]
    assert np.abs(picture - np.add(expected, [wall, wall, wall, 0.0])).max() < 2e-3
    assert np.abs(layers.over_nothing()[:, 4, 4] - over).max() < 1e-12


def test_colours_seen_from_a_place_are_those_of_the_harmonics():
    splats, view = crowd(), view_of(60, 40, near=0.5)
    view = replace(view, center=np.array([0.4, -0.3, 0.2]))
    seen = seen_from(splats, view.center)
    assert seen.sh_degree == 0
    assert np.abs(draw(seen, view) - draw(splats, view)).max() < 1e-6


def exr_of(channels, *, compression=0, version=2):
    """An image of float32 channels (H, W), by hand."""
    height, width = next(iter(channels.values())).shape
    names = sorted(channels)
    listed = b"".join(name.encode() + b"\0" + struct.pack("<4i", 2, 0, 1, 1) for name in names)
    data = struct.pack("<II", 20000630, version)
    for name, kind, value in (
        (b"channels", b"chlist", listed + b"\0"),
        (b"compression", b"compression", bytes([compression])),
        (b"dataWindow", b"box2i", struct.pack("<4i", 0, 0, width - 1, height - 1)),
    ):
        data += name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value
    data += b"\0" + bytes(8 * height)  # the table of lines
    for row in range(height):
        data += struct.pack("<ii", row, 4 * width * len(channels))
        data += b"".join(channels[name][row].astype("<f4").tobytes() for name in names)
    return data


def test_an_exr_image_is_read_channel_by_channel(tmp_path):
    rng = np.random.default_rng(0)
    channels = {f"View.{name}": rng.normal(size=(5, 7)).astype("f4") for name in "RGBZ"}
    (tmp_path / "in.exr").write_bytes(exr_of(channels))
    found = read_exr(tmp_path / "in.exr")
    assert list(found) == sorted(channels)
    assert all(np.array_equal(found[name], values) for name, values in channels.items())


def test_what_is_no_such_image_is_named(tmp_path):
    flat = {"Z": np.zeros((2, 2))}
    packed, parts = exr_of(flat, compression=3), exr_of(flat, version=0x1002)
    for data in (b"", b"PNG and more", exr_of(flat)[:-3], packed, parts):
        (tmp_path / "in.exr").write_bytes(data)
        with pytest.raises(RefineError, match=r"in\.exr: expected an OpenEXR image in one part"):
            read_exr(tmp_path / "in.exr")
    with pytest.raises(RefineError, match=r"no\.exr: cannot be read"):
        read_exr(tmp_path / "no.exr")
