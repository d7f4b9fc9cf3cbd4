"""Volumes: which points lie inside boxes, spheres and closed meshes."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from refine_addon.core import Box, MovedVolume, RefineError, Solid, Sphere
from refine_addon.core.volumes import parse

CORNERS = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
CUBE = np.array([t for a, b, c, d in FACES for t in ((a, b, c), (a, c, d))])
"""The unit cube; its faces turn outwards."""


def globe(columns, rows):
    """Return a closed mesh whose vertices lie on the unit sphere, those of a pole in one place."""
    around, down = np.meshgrid(
        2.0 * np.pi * np.arange(columns) / columns, np.pi * np.arange(rows + 1) / rows
    )
    places = np.cos(around) * np.sin(down), np.sin(around) * np.sin(down), np.cos(down)
    grid = np.arange(columns * (rows + 1)).reshape(rows + 1, columns)
    grid[0], grid[-1] = grid[0, 0], grid[-1, 0]
    a, b = grid[:-1], np.roll(grid[:-1], -1, axis=1)
    c, d = grid[1:], np.roll(grid[1:], -1, axis=1)
    lower, upper = np.stack([a, c, d], -1)[:-1], np.stack([a, d, b], -1)[1:]
    return np.stack(places, -1).reshape(-1, 3), np.concatenate([lower, upper]).reshape(-1, 3)


def angles(vertices, triangles, point):
    """Return the winding number about a point: solid angles by Van Oosterom and Strackee, 1983."""
    a, b, c = (vertices[triangles[:, k]] - point for k in range(3))
    lengths = [np.linalg.norm(v, axis=1) for v in (a, b, c)]
    top = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = [np.einsum("ij,ij->i", p, q) for p, q in ((a, b), (b, c), (c, a))]
    below = np.prod(lengths, axis=0)
    below += dots[0] * lengths[2] + dots[1] * lengths[0] + dots[2] * lengths[1]
    return np.arctan2(top, below).sum() / (2.0 * np.pi)


@pytest.mark.slow
def test_the_inside_is_where_the_winding_number_is_not_0():
    """Of a bent, turned globe, by the sum of solid angles; with the grid and without it."""
    vertices, triangles = globe(14, 9)
    rng = np.random.default_rng(0)
    vertices = vertices * (1.0 + 0.3 * np.sin(5.0 * vertices[:, :1])) @ rng.normal(size=(3, 3))
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    points = rng.uniform(low, high, (3000, 3))
    solid = Solid(vertices, triangles)
    expected = [abs(angles(solid.vertices, solid.triangles, point)) > 0.5 for point in points]

    assert 200 < sum(expected) < 2800
    assert solid.inside(points).tolist() == expected
    assert np.concatenate([solid.inside(some) for some in points.reshape(10, 300, 3)]).tolist() == (
        expected
    )


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1))
def test_cubes_side_by_side_share_no_point_and_leave_none_out(seed):
    """27 cubes tile a larger one, whose points each lie in one: on faces, edges, corners as well.

    Coordinates are halves; those of the largest ends belong to none. A box holds the same."""
    points = np.random.default_rng(seed).integers(-1, 8, (200, 3)) / 2.0
    count = np.zeros(200, int)
    for place in itertools.product(range(3), repeat=3):
        inside = Solid(CORNERS + place, CUBE).inside(points)
        assert np.array_equal(inside, Box(place, np.add(place, 1)).inside(points))
        count += inside

    assert count.tolist() == ((points >= 0.0) & (points < 3.0)).all(axis=1).astype(int).tolist()


def test_overlapping_parts_are_joined_and_a_part_turned_inside_out_hollows():
    """Two cubes overlap in half a unit; the second, inverted, takes the overlap out."""
    vertices = np.concatenate([CORNERS, CORNERS + np.array([0.5, 0.0, 0.0])])
    points = np.array([0.25, 0.75, 1.25, 1.75])[:, None] * [1.0, 0.0, 0.0] + [0.0, 0.5, 0.5]
    joined = Solid(vertices, np.concatenate([CUBE, CUBE + 8]))
    hollow = Solid(vertices, np.concatenate([CUBE, CUBE[:, ::-1] + 8]))

    assert joined.inside(points).tolist() == [True, True, True, False]
    assert hollow.inside(points).tolist() == [True, False, True, False]


def test_faces_that_turn_anyhow_or_have_vertices_of_their_own_are_a_cube_all_the_same():
    """Every second triangle is turned: odd or even counts.

    Exporters write 36 vertices at 8 places, -0 among them, which are joined.
    """
    turned = CUBE.copy()
    turned[::2] = turned[::2, ::-1]
    apart = CORNERS[CUBE].reshape(-1, 3)
    apart = np.where((apart == 0.0) & (np.arange(36)[:, None] % 2 == 0), -0.0, apart)
    points = np.random.default_rng(1).uniform(-1.0, 2.0, (2000, 3))
    anyhow, joined = Solid(CORNERS, turned), Solid(apart, np.arange(36).reshape(12, 3))

    assert [anyhow.turned, joined.turned, len(joined.vertices)] == [False, True, 8]
    expected = Solid(CORNERS, CUBE).inside(points)
    assert np.array_equal(anyhow.inside(points), expected)
    assert np.array_equal(joined.inside(points), expected)


BROKEN = CORNERS * np.where(np.arange(24).reshape(8, 3) == 10, np.nan, 1.0)


@pytest.mark.parametrize(
    ("volume", "expected"),
    [
        (lambda: Solid(CORNERS, CUBE[1:]), "is not closed: 3 of its edges belong to an odd number"),
        (lambda: Solid(CORNERS, CUBE[:0]), "has no faces"),
        (lambda: Solid(CORNERS, np.array([[0, 0, 1]])), "is not closed"),
        (lambda: Solid(BROKEN, CUBE), "not finite"),
        (lambda: MovedVolume(Sphere((0, 0, 0), 1.0), np.diag([1.0, 0.0, 1.0, 1.0])), "is flat"),
    ],
)
def test_what_has_no_inside_is_refused(volume, expected):
    """One triangle less has three open edges."""
    with pytest.raises(RefineError, match=expected):
        volume()


WILD = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [0, -np.inf, 0], [1e300, 0, 0], [0.5, 0.5, 0.5]])


@pytest.mark.parametrize(
    ("volume", "far"),
    [
        (Box((0, 0, 0), (1, 1, 1)), False),
        (Box((0, 0, 0), (1e9, 1, np.inf)), False),
        (parse("box:-inf,-inf,-inf,inf,inf,inf"), True),
        (Sphere((0, 0, 0), 1e200), False),
        (Sphere((0.5, 0.5, 0.5), 0.1), False),
        (Solid(CORNERS, CUBE), False),
        (MovedVolume(Box((-1, -1, -1), (1, 1, 1)), np.eye(4)), False),
    ],
    ids=["box", "half endless", "endless", "vast", "sphere", "solid", "placed"],
)
def test_what_is_not_finite_lies_in_no_volume(volume, far):
    """Nor does what is far away, unless it is as large; no warning of NumPy's is raised."""
    assert volume.inside(WILD).tolist() == [False] * 3 + [far, True]


def test_a_sphere_holds_its_surface_and_placed_it_is_an_ellipsoid():
    """Stretched to 2, 1 and 1/2 and moved by 1 in x: its ends lie at those lengths."""
    matrix = np.diag([2.0, 1.0, 0.5, 1.0])
    matrix[0, 3] = 1.0
    surface = np.array([[3.0, 4.0, 0.0], [3.0, 4.0, 1e-6]])
    ends = [[2.9, 0, 0], [3.1, 0, 0], [1, 0.9, 0], [1, 1.1, 0], [1, 0, 0.4], [1, 0, 0.6]]

    assert Sphere((0, 0, 0), 5.0).inside(surface).tolist() == [True, False]
    assert Sphere((0, 0, 0), 1e200).inside(surface * 1e30).all()  # its square is no float64
    placed = MovedVolume(Sphere((0, 0, 0), 1.0), matrix)
    assert placed.inside(np.array(ends)).tolist() == [True, False] * 3
