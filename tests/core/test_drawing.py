"""Splats drawn among other things, and the images with depth that these come from."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import RefineError
from refine_addon.core.images import read_exr
from refine_addon.core.pictures import draw, in_order, seen_from

from .test_pictures import crowd, splats_of, view_of

RED, GREEN, BLUE = np.eye(3)


def layer_of(color, alpha, depth, size=9):
    """Return a layer that is the same in all pixels."""
    plane = np.ones((size, size))
    return in_order([(alpha * color[:, None, None] * plane, alpha * plane, depth * plane)])


def two_splats():
    """Return two wide splats before the view: red of opacity .8 at depth 2, green of .5 at 4."""
    return splats_of(
        ((0.0, 0.0, 2.0), 50.0, 0.8, tuple(RED)), ((0.0, 0.0, 4.0), 100.0, 0.5, tuple(GREEN))
    )


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
    """Front to back: each shows what those before it let through, (1 - .8) = .2, then .2 * .5."""
    picture = draw(two_splats(), view_of(9, 9), layer_of(BLUE, alpha, depth))

    assert np.abs(picture[:, 4, 4] - expected).max() < 2e-3  # a splat is not quite flat


@pytest.mark.parametrize("first", [0, 1])
def test_splats_between_two_layers_are_seen_through_the_nearer_one(first):
    """Front to back: blue glass of .4, a red splat of .8, a white wall that hides the green one.

    .4 blue; .6 of the red splat's .8; .6 * .2 of the wall. Which layer is given first is all one.
    """
    plane = np.ones((9, 9))
    glass = 0.4 * BLUE[:, None, None] * plane, 0.4 * plane, plane
    wall = np.ones((3, 9, 9)), plane, 3.0 * plane
    layers = in_order([(glass, wall)[first], (glass, wall)[1 - first]])

    picture = draw(two_splats(), view_of(9, 9), layers)

    assert np.abs(picture[:, 4, 4] - [0.6, 0.12, 0.52, 1.0]).max() < 2e-3
    over = np.asarray([0.6, 0.6, 1.0])
    assert np.abs(layers.over_nothing()[:, 4, 4] - over).max() < 1e-12


def test_splats_between_two_panes_are_mixed_with_the_nearer_one_alone():
    """Panes of .5 at depths 1 and 3, a splat of .8 at 2, one of .5 at 4: .5 * .8 red, and green.

    Green: .5 * .2 of what is behind the red splat, * .5 * .5 behind the second pane.
    """
    plane = np.ones((9, 9))
    panes = [(np.zeros((3, 9, 9)), 0.5 * plane, depth * plane) for depth in (1.0, 3.0)]

    picture = draw(two_splats(), view_of(9, 9), in_order(panes))

    left = 0.5 * 0.2 * 0.5 * 0.5
    assert np.abs(picture[:, 4, 4] - [0.4, 0.5 * 0.2 * 0.5 * 0.5, 0.0, 1.0 - left]).max() < 2e-3


def test_the_background_shows_through_splats_and_counts_for_no_alpha():
    """Of .6 that a layer of alpha .4 lets through, splats leave .1, wherever the layer stands."""
    for depth in (1.0, 3.0, 5.0):
        layer = layer_of(BLUE, 0.4, depth)
        lit = replace(layer, background=0.6 * np.ones((3, 9, 9)))
        apart = draw(two_splats(), view_of(9, 9), lit) - draw(two_splats(), view_of(9, 9), layer)

        assert np.abs(apart[:, 4, 4] - [0.06, 0.06, 0.06, 0.0]).max() < 1e-3


def test_a_layer_behind_all_splats_is_the_picture_over_it():
    """In each pixel: colours plus what their alpha lets through."""
    view = view_of(60, 40, near=0.5)
    plain = draw(crowd(), view)
    rng = np.random.default_rng(3)
    colors, opaque = rng.random((3, 40, 60)), np.ones((40, 60))
    behind = in_order([(colors, opaque, 1e4 * opaque)])

    picture = draw(crowd(), view, behind)

    expected = plain[:3] + (1.0 - plain[3]) * colors
    assert np.abs(picture[:3] - expected).max() < 1e-9
    assert (picture[3] == 1.0).all()


def test_a_picture_cut_in_depth_is_that_of_the_splats_on_each_side():
    """An opaque layer at depth 3 over black: as if only nearer splats were there."""
    splats, view = crowd(), view_of(60, 40, near=0.5)
    near = splats.take(splats.means[:, 2] < 3.0)
    opaque = np.ones((40, 60))
    layer = in_order([(np.zeros((3, 40, 60)), opaque, 3.0 * opaque)])

    assert np.abs(draw(splats, view, layer)[:3] - draw(near, view)[:3]).max() < 1e-5


def test_colours_seen_from_a_place_are_those_of_the_harmonics():
    """Drawn from there, all splats look the same with colours of their own."""
    splats, view = crowd(), view_of(60, 40, near=0.5)
    view = replace(view, center=np.array([0.4, -0.3, 0.2]))

    seen = seen_from(splats, view.center)

    assert seen.sh_degree == 0
    assert np.abs(draw(seen, view) - draw(splats, view)).max() < 1e-6


def test_no_splats_are_an_empty_picture():
    none = crowd().take(np.zeros(300, np.bool_))

    assert not draw(none, view_of(9, 9)).any()


def exr_of(channels, *, compression=0, version=2):
    """Return an image of float32 channels (H, W), by hand."""
    height, width = next(iter(channels.values())).shape
    listed = b"".join(
        name.encode() + b"\0" + struct.pack("<iiii", 2, 0, 1, 1) for name in sorted(channels)
    )
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = [
        (b"channels", b"chlist", listed + b"\0"),
        (b"compression", b"compression", bytes([compression])),
        (b"dataWindow", b"box2i", window),
    ]
    head = b"".join(
        name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value
        for name, kind, value in attributes
    )
    lines = [
        struct.pack("<ii", row, 4 * width * len(channels))
        + b"".join(channels[name][row].astype("<f4").tobytes() for name in sorted(channels))
        for row in range(height)
    ]
    table = bytes(8 * height)
    return struct.pack("<II", 20000630, version) + head + b"\0" + table + b"".join(lines)


def test_an_exr_image_is_read_channel_by_channel(tmp_path):
    rng = np.random.default_rng(0)
    channels = {f"View.{name}": rng.normal(size=(5, 7)).astype("f4") for name in "RGBZ"}
    path = tmp_path / "in.exr"
    path.write_bytes(exr_of(channels))

    found = read_exr(path)

    assert list(found) == sorted(channels)
    assert all(np.array_equal(found[name], values) for name, values in channels.items())


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"PNG and more",
        exr_of({"Z": np.zeros((2, 2))})[:-3],
        exr_of({"Z": np.zeros((2, 2))}, compression=3),
        exr_of({"Z": np.zeros((2, 2))}, version=0x1002),
    ],
    ids=["empty", "another format", "truncated", "packed", "several parts"],
)
def test_what_is_no_such_image_is_named(tmp_path, data):
    (tmp_path / "in.exr").write_bytes(data)

    with pytest.raises(RefineError, match=r"in\.exr: expected an OpenEXR image in one part"):
        read_exr(tmp_path / "in.exr")


def test_an_exr_image_that_is_not_there_is_named(tmp_path):
    with pytest.raises(RefineError, match=r"in\.exr: cannot be read"):
        read_exr(tmp_path / "in.exr")
