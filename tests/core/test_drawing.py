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
    """Return the colours, alphas and depths of a layer that is the same in all pixels."""
    plane = np.ones((size, size))
    return alpha * np.asarray(color)[:, None, None] * plane, alpha * plane, depth * plane


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
    """Front to back: each shows what those before it let through, (1 - .8) = .2, then .2 * .5.

    What is left of 1 is seen of a white background, which counts for no alpha.
    """
    layer = in_order([layer_of(BLUE, alpha, depth)])
    lit = replace(layer, background=(1.0 - alpha) * np.ones((3, 9, 9)))

    picture, light = (draw(two_splats(), view_of(9, 9), each)[:, 4, 4] for each in (layer, lit))

    assert np.abs(picture - expected).max() < 2e-3  # a splat is not quite flat
    left = 1.0 - expected[3]
    assert np.abs(light - picture - [left, left, left, 0.0]).max() < 1e-3


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
    """White, the wall adds the .6 * .2 that is left. Which layer is given first is all one."""
    layers = in_order([layer_of(*near, 1.0), layer_of(*far, 3.0)][::order])

    picture = draw(two_splats(), view_of(9, 9), layers)[:, 4, 4]

    wall = 0.12 * far[0][0]
    assert np.abs(picture - np.add(expected, [wall, wall, wall, 0.0])).max() < 2e-3
    assert np.abs(layers.over_nothing()[:, 4, 4] - over).max() < 1e-12


def test_a_layer_is_the_picture_over_it_and_cuts_it_in_depth():
    """Behind all splats: in each pixel colours plus what their alpha lets through.

    Opaque and black at depth 3: as if only nearer splats were there. No splats draw nothing.
    """
    splats, view = crowd(), view_of(60, 40, near=0.5)
    plain, near = draw(splats, view), splats.take(splats.means[:, 2] < 3.0)
    colors, opaque = np.random.default_rng(3).random((3, 40, 60)), np.ones((40, 60))

    picture = draw(splats, view, in_order([(colors, opaque, 1e4 * opaque)]))
    cut = draw(splats, view, in_order([(0.0 * colors, opaque, 3.0 * opaque)]))

    assert np.abs(picture[:3] - plain[:3] - (1.0 - plain[3]) * colors).max() < 1e-9
    assert (picture[3] == 1.0).all()
    assert np.abs(cut[:3] - draw(near, view)[:3]).max() < 1e-5
    assert not draw(splats.take(np.zeros(300, np.bool_)), view).any()


def test_colours_seen_from_a_place_are_those_of_the_harmonics():
    """Drawn from there, all splats look the same with colours of their own."""
    splats, view = crowd(), view_of(60, 40, near=0.5)
    view = replace(view, center=np.array([0.4, -0.3, 0.2]))

    seen = seen_from(splats, view.center)

    assert seen.sh_degree == 0
    assert np.abs(draw(seen, view) - draw(splats, view)).max() < 1e-6


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
    with pytest.raises(RefineError, match=r"no\.exr: cannot be read"):
        read_exr(tmp_path / "no.exr")
