"""Pictures of views: what is drawn, how close two of them are, and the files they become."""

from __future__ import annotations

import itertools
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from refine_addon.core import RefineError, Splats
from refine_addon.core.execute import Cancelled
from refine_addon.core.pictures import (
    AMPLIFIED,
    KINDS,
    PictureFiles,
    compare,
    fitted,
    measured_in_words,
)
from refine_addon.core.views import View, ViewSet
from refine_addon.core.visibility import projection
from refine_addon.core.visibility.cast import cast, colors_from

C0 = 0.28209479177387814


def splats_of(*rows):
    """Return round splats of (place, standard deviation, opacity, colour)."""
    places, sizes, opacities, colors = (
        np.array(column, float) for column in zip(*rows, strict=True)
    )
    return Splats(
        means=places,
        log_scales=np.log(sizes)[:, None] * np.ones(3),
        quaternions=np.tile([1.0, 0.0, 0.0, 0.0], (len(rows), 1)),
        opacity_logits=np.log(opacities / (1.0 - opacities)),
        sh_dc=(colors - 0.5) / C0,
        sh_rest=np.zeros((len(rows), 0, 3)),
    )


def view_of(width, height, focal=50.0, **more):
    """Return a view from the origin along z."""
    return View(np.eye(3), np.zeros(3), focal, focal, width / 2, height / 2, width, height, **more)


def crowd(count=300, seed=1):
    """Return many splats of all shapes before a view, with harmonics."""
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.uniform([-1.5, -1.0, 1.0], [1.5, 1.0, 6.0], (count, 3)),
        log_scales=rng.uniform(-4.0, -1.0, (count, 3)),
        quaternions=rng.normal(size=(count, 4)),
        opacity_logits=rng.normal(0.5, 2.0, count),
        sh_dc=rng.normal(size=(count, 3)),
        sh_rest=0.1 * rng.normal(size=(count, 3, 3)),
    )


def test_a_splat_is_a_gaussian_of_its_size_and_the_low_pass():
    """Deviation .1 at depth 2 through 50 px: (50 .1 / 2)^2 + .3 = 6.55 px^2, around the middle.

    The pixel (k, m) has its centre at k + .5, so that of an image of 41 px the middle one lies on
    the axis: alpha there is the opacity, .6; d px aside it is .6 exp(-d^2 / 2 / 6.55). The colour
    is (.9, .5, .1) times alpha, on black, in steps of 1 / 255.
    """
    splats = splats_of(((0.0, 0.0, 2.0), 0.1, 0.6, (0.9, 0.5, 0.1)))

    (found,) = compare(splats, splats, ViewSet((view_of(41, 31),)))

    for aside, down in itertools.product((0, 1, 4), (0, 2)):
        alpha = 0.6 * np.exp(-(aside**2 + down**2) / 2.0 / 6.55)
        expected = 255.0 * alpha * np.array([0.9, 0.5, 0.1])
        assert np.abs(found.before[15 + down, 20 + aside] - expected).max() <= 0.51
    assert found.before[0, 0].tolist() == [0, 0, 0]


@pytest.mark.slow
@pytest.mark.parametrize("size", [(64, 48), (700, 90)], ids=["one strip", "two strips"])
def test_a_picture_is_what_the_lines_of_sight_through_all_its_pixels_see(size):
    """`cast` finds the same by another way: all pairs first, then one sort for each pixel."""
    splats, view = crowd(), replace(view_of(*size, focal=0.8 * size[0]), near=0.5)
    views = ViewSet((view,))
    gaussians, scene, _ = projection.prepare(splats, views)
    footprints = projection.project(gaussians, scene, view)
    expected = np.empty((3, size[1], size[0]))
    for row in range(size[1]):
        rays = cast(footprints, np.arange(size[0]), np.array([row]))
        expected[:, row] = rays.colors(colors_from(splats, gaussians.index[rays.hit], view))

    (found,) = compare(splats, splats.take(slice(None, None, -1)), views)

    apart = np.abs(found.before.transpose(2, 0, 1) / 255.0 - expected)
    assert apart.max() <= 0.5 / 255.0 + 1e-5
    assert np.array_equal(found.after, found.before)


@pytest.mark.slow
def test_pictures_do_not_depend_on_threads_or_on_how_many_pairs_are_drawn_at_a_time(monkeypatch):
    """Blocks of footprints end anywhere; only sums of float64 may differ, by less than 1e-9 dB.

    MSE of the 8 bits tells the PSNR to a tenth of a dB; the same splats are 100 dB, the most.
    """
    splats, views = crowd(), ViewSet((view_of(120, 80, 90.0),))
    half = splats.take(np.arange(0, len(splats), 2))
    (one,), (same,) = compare(splats, half, views, threads=1), compare(splats, splats, views)
    monkeypatch.setattr("refine_addon.core.pictures._PAIRS", 1000)
    (other,) = compare(splats, half, views, threads=3)

    assert abs(one.psnr - other.psnr) < 1e-9
    assert np.abs(one.before.astype(int) - other.before).max() <= 1  # a half rounds either way
    error = np.mean((one.after / 255.0 - one.before / 255.0) ** 2)
    assert abs(one.psnr + 10.0 * np.log10(error)) < 0.1
    assert same.psnr == 100.0
    assert not same.difference.any()
    apart = np.abs(one.after.astype(int) - one.before)
    assert np.array_equal(one.difference, np.minimum(AMPLIFIED * apart, 255))


def test_a_view_of_many_pixels_is_drawn_smaller_and_sees_the_same():
    """4000 x 3000 px becomes 960 x 720; a point stays at the same share of the image."""
    view = replace(view_of(4000, 3000, 2000.0), cx=1500.0)

    small = fitted(view)

    assert (small.width, small.height) == (960, 720)
    assert small.fx / 960 == pytest.approx(2000.0 / 4000)
    assert small.cx / 960 == pytest.approx(1500.0 / 4000)
    assert fitted(small) is small


def test_both_pictures_begin_at_the_same_near_plane():
    """It is a share of the scene's size, which pruning changes; what stays is drawn the same.

    Two close splats and many far ones: without the latter the scene is far smaller, and so would
    be its near plane.
    """
    close = [((0.0, 0.0, 0.5), 0.05, 0.9, (1.0, 1.0, 1.0))]
    far = [((x, 0.0, 400.0), 1.0, 0.01, (0.5, 0.5, 0.5)) for x in (-90.0, 0.0, 90.0)]
    splats = splats_of(*close, *far)

    (found,) = compare(splats, splats.take(np.array([0])), ViewSet((view_of(21, 21),)))

    assert found.before[10, 10].max() <= 4  # nearer than a hundredth of the scene's size
    assert not found.after.any()


def test_drawing_can_be_cancelled_and_draws_nothing_of_what_cannot_be_drawn():
    bad = replace(crowd(3), opacity_logits=np.full(3, np.nan))

    (found,) = compare(bad, bad, ViewSet((view_of(20, 10),)))

    assert found.before.shape == (10, 20, 3)
    assert not found.before.any()
    with pytest.raises(Cancelled):
        compare(
            crowd(), crowd(), ViewSet((view_of(300, 300),)),
            progress=lambda fraction, _what: fraction < 0.7,
        )  # fmt: skip


def pixels_of(data):
    """Return the pixels of a PNG, (H, W, 3), by hand: chunks, one zlib stream, filter 2."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, chunks = 8, {}
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        body = data[at + 4 : at + 8 + length]
        assert struct.unpack(">I", data[at + 8 + length : at + 12 + length])[0] == zlib.crc32(body)
        chunks[body[:4]] = body[4:]
        at += 12 + length
    assert list(chunks) == [b"IHDR", b"IDAT", b"IEND"]
    width, height, *form = struct.unpack(">IIBBBBB", chunks[b"IHDR"])
    assert form == [8, 2, 0, 0, 0]  # 8 bits, red green blue
    rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(height, -1)
    assert (rows[:, 0] == 2).all()
    return np.cumsum(rows[:, 1:], axis=0, dtype=np.uint8).reshape(height, width, 3)


def test_files_are_named_after_splats_and_camera_and_hold_the_pictures(tmp_path):
    """Two of three views have one name; what no file can be called stands as _.

    A picture that exists is refused before the work.
    """
    names = ("left/0.JPG", "left/0.JPG", "Camera: A.001")
    views = ViewSet(tuple(
        replace(view_of(40, 30), name=name, center=np.array([0.1 * number, 0.0, 0.0]))
        for number, name in enumerate(names)
    ))  # fmt: skip
    splats = crowd(50)
    half = splats.take(np.arange(25))

    facts = PictureFiles(tmp_path, "my/room").write(splats, half, views)

    stems = ["my_room-left_0", "my_room-left_0_2", "my_room-Camera_ A.001"]
    expected = {f"{stem}-{kind}.png" for stem in stems for kind in KINDS}
    assert {path.name for path in tmp_path.iterdir()} == expected
    assert [view["camera"] for view in facts["views"]] == list(names)
    found = compare(splats, half, views)
    for one, told in zip(found, facts["views"], strict=True):
        assert (told["size"], told["psnr"]) == ([40, 30], round(one.psnr, 2))
        for kind in KINDS:
            assert np.array_equal(pixels_of(Path(told[kind]).read_bytes()), getattr(one, kind))
    assert facts["psnr"] == round(sum(one.psnr for one in found) / 3, 2)
    assert measured_in_words(facts).startswith(f"{facts['psnr']:.1f} dB measured in 3 views (")
    refused = pytest.raises(RefineError, match=r"my_room-left_0-.*\.png: exists already")
    with refused, PictureFiles(tmp_path, "my/room").opened(views):
        pass
    with PictureFiles(tmp_path, "my/room", overwrite=True).opened(views):
        pass
