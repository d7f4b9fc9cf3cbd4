"""Volumes: which points lie inside boxes, spheres and closed meshes."""

from __future__ import annotations

import itertools
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from refine_addon.core import Box, MovedVolume, RefineError, Solid, Sphere, Zone, forced
from refine_addon.core.volumes import parse

CORNERS = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
CUBE = np.array([t for a, b, c, d in FACES for t in ((a, b, c), (a, c, d))])
"""The unit cube; its faces turn outwards."""


def globe(columns, rows):
    """Return a closed mesh whose vertices lie on the unit sphere."""
    around = 2.0 * np.pi * np.arange(columns) / columns
    down = np.pi * np.arange(1, rows) / rows
    ring = np.stack([np.cos(around), np.sin(around), np.zeros(columns)], axis=1)
    rings = [ring * np.sin(angle) + [0.0, 0.0, np.cos(angle)] for angle in down]
    vertices = np.concatenate([[[0.0, 0.0, 1.0]], *rings, [[0.0, 0.0, -1.0]]])
    triangles = []
    for k in range(columns):
        n = (k + 1) % columns
        triangles.append((0, 1 + k, 1 + n))
        for row in range(rows - 2):
            a, b = 1 + row * columns + k, 1 + row * columns + n
            triangles += [(a, a + columns, b + columns), (a, b + columns, b)]
        last = len(vertices) - 1
        triangles.append((last, last - columns + n, last - columns + k))
    return vertices, np.array(triangles)


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

    Coordinates are halves; those of the largest ends belong to none. A box holds the same.
    """
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
    points = np.array([[0.25, 0.5, 0.5], [0.75, 0.5, 0.5], [1.25, 0.5, 0.5], [1.75, 0.5, 0.5]])
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


def test_many_points_fall_in_by_groups_as_one_by_one():
    """50,000 at two places of a globe of 9,800 triangles: one inside, one outside.

    On a lattice through the vertices of a globe, groups change none of them.
    """
    points = np.repeat([[0.1, 0.2, 0.3], [0.9, 0.9, 0.9]], 25_000, axis=0)
    steps, solid = np.linspace(-1.0, 1.0, 21), Solid(*globe(16, 8))
    lattice = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3)
    order = np.concatenate([np.arange(start, len(lattice), 463) for start in range(463)])

    found = Solid(*globe(70, 71)).inside(points)
    each = np.concatenate([solid.inside(lattice[start::463]) for start in range(463)])

    assert found[:25_000].all()
    assert not found[25_000:].any()
    assert np.array_equal(solid.inside(lattice)[order], each)


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
        (Sphere((0.5, 0.5, 0.5), 0.1), False),
        (Solid(CORNERS, CUBE), False),
        (MovedVolume(Box((-1, -1, -1), (1, 1, 1)), np.eye(4)), False),
    ],
    ids=["box", "half endless", "endless", "sphere", "solid", "placed"],
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


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("box:1,2,3", "expected box:x0,y0,z0,x1,y1,z1 in numbers, got 'box:1,2,3'"),
        ("box:0,0,0,1,1,one", "expected box:"),
        ("box:0,0,0,1,0,1", "'box:0,0,0,1,0,1': box goes from 0 to 0 in y"),
        ("box:0,0,nan,1,1,1", "box goes from nan to 1 in z"),
        ("sphere:0,0,0", "expected sphere:x,y,z,radius in numbers"),
        ("sphere:0,0,0,0", "sphere has radius 0, expected more than 0"),
        ("sphere:0,0,inf,1", "expected finite numbers"),
    ],
)
def test_numbers_that_are_no_volume_are_refused(text, expected):
    """With what was got and what was expected. Other texts are names of objects."""
    with pytest.raises(RefineError, match=re.escape(expected)):
        parse(text)
    assert [parse(name) for name in ("Cube", "box", "Box:1", "", "a:b")] == [None] * 5


LINE = np.stack([np.arange(10.0), np.zeros(10), np.zeros(10)], axis=1)
"""Ten points, at x from 0 to 9."""


def zone(role, low, high, **more):
    return Zone(role, f"{role} {low}", Box((low, -1.0, -1.0), (high, 1.0, 1.0)), **more)


def test_zones_of_a_kind_are_joined_and_protection_wins():
    """Keep 0-3 and 5-8, remove 2-6, protect 4 and 9: 2, 3, 5 and 8 go, 9 only for being outside.

    With 4 and 5 marked to go and 2 protected by a mask, 3, 5 and 8 go. Nothing costs nothing.
    """
    zones = [
        zone("keep", 0, 4), zone("keep", 5, 8), zone("remove", 2, 6),
        zone("protect", 4, 5), zone("protect", 9, 10),
    ]  # fmt: skip
    two, marked = np.arange(10) == 2, np.isin(np.arange(10), [4, 5])

    found, more = forced(zones, LINE), forced(zones, LINE, two, marked)

    assert np.flatnonzero(found.removed).tolist() == [2, 3, 5, 8]
    assert np.flatnonzero(found.protected).tolist() == [4, 9]
    assert [fact["splats"] for fact in found.facts] == [4, 3, 4, 1, 1]
    assert found.facts[2]["name"] == "remove 2"
    assert np.flatnonzero(more.removed).tolist() == [3, 5, 8]
    assert np.flatnonzero(more.protected).tolist() == [2, 4, 9]
    assert forced([], LINE, None, marked).counts() == {"protected": 0, "removed_by_user": 2}
    assert forced((), LINE).removed is None
    assert forced((), LINE).protected is None
    assert forced((), LINE, two).protected is two


def test_volumes_that_hold_or_leave_nothing_are_refused_unless_they_may_be_idle():
    """The sentence says where the splats are. An idle keep volume keeps nothing."""
    with pytest.raises(RefineError, match=r"remove 20 holds .*they lie from 0,0,0 to 9,0,0"):
        forced([zone("remove", 20, 21)], LINE)
    assert not forced([zone("remove", 20, 21, idle=True)], LINE).removed.any()
    with pytest.raises(RefineError, match="all 10 splats lie where they must go"):
        forced([zone("keep", 20, 21, idle=True)], LINE)
