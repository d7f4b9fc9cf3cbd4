"""Which splats a view shows, and which of them areas, places and colours take."""

import math

import numpy as np
import pytest

from refine_addon.core import picking
from refine_addon.core.views import View, pinhole

from .test_occlusion import look_along_z, splats_of

SIZE = 100
EVERYWHERE = np.ones((SIZE, SIZE), np.bool_)
VIEW = look_along_z(cx=50.0, cy=50.0, width=SIZE, height=SIZE)
"""It has a slope of 1/2 at the edges."""


def splats(means, colors=((0.5, 0.5, 0.5),), *, opacity=0.9997):
    """Return round splats of sigma .02, grey or of some colours."""
    return splats_of(means, opacity, 0.02, colors)


def wall(depth, edge=1.2, step=0.03):
    """Return centres on a grid across the axis, at a depth."""
    line = np.arange(-edge, edge, step)
    across, down = (axis.ravel() for axis in np.meshgrid(line, line))
    return np.stack([across, down, np.full_like(across, depth)], axis=1)


def seen(scene, camera=VIEW):
    """Return what a view shows of splats."""
    return picking.look(picking.prepare(scene, camera), camera)


@pytest.fixture(scope="module")
def walls():
    """Give two walls behind each other, at 2 and at 3, and what a view at 0 shows of them."""
    near, far = wall(2.0), wall(3.0)
    colors = np.concatenate([np.tile([0.9, 0.1, 0.1], (len(near), 1)), np.full((len(far), 3), 0.2)])
    return len(near), seen(splats(np.concatenate([near, far]), colors))


def test_what_a_wall_hides_is_not_taken(walls):
    """Splats 3 cm apart with sigmas of 2 cm leave no gap; told so, both walls are taken.

    The left 49 columns of the image hold the centres of the near wall with x < -.02.
    """
    count, shown = walls
    taken, through = (shown.in_area(EVERYWHERE, hidden=hidden) for hidden in (False, True))
    left = shown.in_area(EVERYWHERE & (np.arange(SIZE) < 49))[:count]
    means = shown.prepared.splats.means[:count]
    inner = (np.abs(means[:, :2]) < 0.99).all(axis=1)  # 50 px at depth 2 are 1

    assert taken[:count].any()
    assert not taken[count:].any()
    assert np.array_equal(through[:count], taken[:count])
    assert through[count:].any()
    assert np.array_equal(left[inner], means[inner, 0] < -0.02)


def test_a_veil_hides_nothing_and_what_is_not_in_the_view_is_never_taken():
    """Opacity .1 lets nine tenths of the light through, from one wall of it to the next.

    One before the view, one behind it, one beside the image, one that is not finite.
    """
    near, far = wall(2.0), wall(3.0)
    scene = splats(np.concatenate([near, far]))
    scene.opacity_logits[: len(near)] = -4.0
    four = seen(splats([[0, 0, 2], [0, 0, -2], [9, 0, 2], [np.nan, 0, 2]]))

    assert seen(scene).in_area(EVERYWHERE)[len(near) :].any()
    taken = four.in_area(EVERYWHERE, hidden=True)
    assert taken.tolist() == [True, False, False, False]


@pytest.mark.slow
def test_surfaces_lie_where_a_ray_has_lost_its_light():
    """Walls of opacity .5 every .1 from 2 on, without gaps: a tenth is left behind the fourth.

    Each takes 1 - a of the light, where a is nearly .5 only at centres; the reference sums along
    the rays, splat by splat.
    """
    scene = splats(np.concatenate([wall(2.0 + 0.1 * k, edge=0.5) for k in range(9)]), opacity=0.5)
    shown = seen(scene)
    footprints = shown.footprints
    depths = scene.means[shown.prepared.gaussians.index, 2].astype(np.float32)
    found = picking.surfaces(footprints, depths, VIEW, 10)
    axes = np.stack([footprints.major.T, footprints.minor.T], axis=2)
    inverse = np.linalg.inv(axes @ axes.transpose(0, 2, 1))
    for row, column in ((4, 5), (5, 5)):
        away = np.array([[column * 10 + 5.5], [row * 10 + 5.5]]) - footprints.centers
        alphas = 0.5 * np.exp(-np.einsum("in,nij,jn->n", away, inverse, away) / 2)
        left = np.cumprod(1 - np.where(alphas < 1 / 255, 0.0, alphas))
        assert found[row, column] == depths[footprints.index[np.argmax(left < 0.1)]]


def test_a_ball_and_a_colour_take_what_is_near_them(walls):
    """At (60, 50) the ray is (.105, .005, 1): it meets the wall at 2, where 1 m takes 50 px.

    A ball around (0, 0, 2), .3 wide: the far wall is 1 away. A colour .05 from the near wall's in
    each channel; the far wall is .7 away from it in red.
    """
    count, shown = walls
    surface, nothing = shown.surface(60, 50), seen(splats([[0, 0, 2]])).surface(3, 3)
    ball = shown.in_ball(np.array([0.0, 0.0, 2.0]), 0.3, hidden=True)
    away = np.linalg.norm(shown.prepared.splats.means - [0.0, 0.0, 2.0], axis=1)
    near, none = (
        shown.of_color(np.array([0.85, 0.1, 0.15]), d, hidden=True) for d in (0.051, 0.049)
    )

    np.testing.assert_allclose(surface.place, [0.21, 0.01, 2.0], atol=1e-6)
    np.testing.assert_allclose(surface.color, [0.9, 0.1, 0.1], atol=0.01)
    assert surface.scale == pytest.approx(50.0)
    assert nothing is None
    assert np.array_equal(ball[:count], away[:count] <= 0.3)
    assert near[:count].any()
    assert not (ball | near)[count:].any()
    assert not none.any()


def test_a_piece_is_what_hangs_together_with_a_place():
    """Of two patches of 400 with a gap the one that is nearer; what is not chosen is no bridge."""
    patch = wall(2.0, edge=0.3)
    means = np.concatenate([patch, patch + np.array([1.0, 0.0, 0.0]), wall(2.0, edge=2.0)])
    sight = seen(splats(means))
    both = np.arange(len(means)) < 2 * len(patch)
    first = np.arange(len(means)) < len(patch)

    assert np.array_equal(sight.piece(both, np.array([0.0, 0.0, 2.0])), first)
    assert np.array_equal(sight.piece(both, np.array([1.0, 0.0, 2.0])), both & ~first)
    assert sight.piece(first & (np.arange(len(means)) == 3), np.zeros(3)).sum() == 1
    assert not sight.piece(both & ~both, np.zeros(3)).any()


def test_a_polygon_holds_the_pixels_that_angles_say_it_holds():
    """The reference sums the angles to all corners: 2 pi times an odd number inside."""
    rng = np.random.default_rng(0)
    for corners in (rng.uniform(-5, 25, (7, 2)), rng.uniform(0, 20, (3, 2)), np.zeros((1, 2))):
        area = picking.polygon(corners.tolist(), 20, 15)
        x, y = np.meshgrid(np.arange(20) + 0.5, np.arange(15) + 0.5)
        to = corners[:, 0, None, None] - x + 1j * (corners[:, 1, None, None] - y)
        turns = np.angle(np.roll(to, -1, axis=0) / to).sum(axis=0) / (2 * np.pi)
        assert np.array_equal(area, np.rint(turns).astype(int) % 2 == 1)


def test_a_brush_paints_what_lies_near_its_way():
    """From (3, 4) to (12, 8) with a radius of 2.5; distances to 1,000 points on the way."""
    area = np.zeros((15, 20), np.bool_)
    picking.paint(area, (3.0, 4.0), (12.0, 8.0), 2.5)
    way = np.linspace([3.0, 4.0], [12.0, 8.0], 1000)
    x, y = np.meshgrid(np.arange(20) + 0.5, np.arange(15) + 0.5)
    away = np.sqrt((x[..., None] - way[:, 0]) ** 2 + (y[..., None] - way[:, 1]) ** 2).min(axis=2)

    assert np.array_equal(area, away <= 2.5)
    picking.paint(area, (-50.0, 4.0), (-40.0, 4.0), 2.5)  # outside: nothing more
    assert np.array_equal(area, away <= 2.5)


def test_a_selection_grows_by_neighbours_and_shrinks_back():
    """On a line each point's 8 nearest are 4 to each side; at an end those that there are.

    Modes combine 1100 before with 1010 taken, all pairs of bits that there are. Where all are NaN
    nothing grows; where some are, each has an index within range.
    """
    line = np.stack([np.arange(60.0), np.zeros(60), np.zeros(60)], axis=1)
    neighbours = picking.neighbours_of(line)
    chosen = (np.arange(60) >= 28) & (np.arange(60) < 32)
    grown = picking.grown(neighbours, chosen)
    before, taken = np.array([True, True, False, False]), np.array([True, False, True, False])
    nothing = picking.neighbours_of(np.full((5, 3), np.nan))
    some = picking.neighbours_of(np.array([[0, 0, 0], [1, 0, 0], [np.nan, 0, 0]]))

    assert np.flatnonzero(grown).tolist() == list(range(24, 36))
    assert np.array_equal(picking.shrunk(neighbours, grown), chosen)
    for mode, expected in (("SET", "1010"), ("ADD", "1110"), ("SUBTRACT", "0100"),
                           ("INTERSECT", "1000")):  # fmt: skip
        found = picking.combined(before, taken, mode)
        assert "".join(str(int(bit)) for bit in found) == expected
    assert picking.grown(nothing, np.zeros(5, np.bool_)).sum() == 0
    assert ((some >= 0) & (some < 3)).all()


def test_the_view_of_opengls_matrices_is_the_one_they_were_made_of():
    """Off the middle, turned by 30 degrees, moved; near is told by the matrix."""
    c, s = math.cos(math.pi / 6), 0.5
    turned = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    camera = View(turned, np.array([1.0, 2, 3]), 80.0, 90.0, 60.0, 45.0, 120, 100, 0.01)
    pose, lens, far = np.eye(4), np.zeros((4, 4)), 100.0
    pose[:3, :3] = np.diag([1, -1, -1]) @ turned
    pose[:3, 3] = -pose[:3, :3] @ camera.center
    lens[0, [0, 2]] = 2 * 80 / 120, 1 - 2 * 60 / 120
    lens[1, [1, 2]] = 2 * 90 / 100, 2 * 45 / 100 - 1
    lens[2, [2, 3]] = -(far + 0.01) / (far - 0.01), -2 * far * 0.01 / (far - 0.01)
    lens[3, 2] = -1
    found = pinhole(pose, lens, (120, 100), np.zeros((1, 3)))

    np.testing.assert_allclose(found.rotation, camera.rotation, atol=1e-12)
    np.testing.assert_allclose(found.center, camera.center, atol=1e-12)
    for name in ("fx", "fy", "cx", "cy", "near"):
        assert getattr(found, name) == pytest.approx(getattr(camera, name))


def test_without_perspective_centres_lie_where_parallel_rays_meet_them():
    """4 m fill 200 px: 50 px a metre, whatever the depth; the view's own middle is at (1, 0).

    The rays of the far pinhole are off by a thousandth of the extent: .15 px here.
    """
    matrix = np.eye(4)
    matrix[0, 3] = -1.0
    projected = np.diag([0.5, 0.5, -0.01, 1.0])  # clips from -100 to 100
    points = np.array([[1.0, 0, 0], [2, 1, -3], [0, -0.5, 2], [1.5, 0.5, 1]])
    found = pinhole(matrix, projected, (200, 200), points)
    shown = seen(splats(points), found)
    expected = [[100, 100], [150, 50], [50, 125], [125, 75]]
    local = (points - found.center) @ found.rotation.T
    across = found.fx * local[:, 0] / local[:, 2] + found.cx
    down = found.fy * local[:, 1] / local[:, 2] + found.cy
    np.testing.assert_allclose(np.stack([across, down], axis=1), expected, atol=0.2)
    assert sorted(shown.centered.index.tolist()) == [0, 1, 2, 3]
