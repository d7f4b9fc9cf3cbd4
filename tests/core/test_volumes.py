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


def test_splats_fall_in_by_groups_as_one_by_one():
    """60,000 points on a lattice through the vertices of a globe: groups change none of them."""
    solid = Solid(*globe(16, 8))
    steps = np.linspace(-1.0, 1.0, 39)
    points = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3)

    each = np.concatenate([solid.inside(points[start::997]) for start in range(997)])
    order = np.concatenate([np.arange(start, len(points), 997) for start in range(997)])
    assert np.array_equal(solid.inside(points)[order], each)


@given(st.integers(0, 2**32 - 1))
def test_cubes_side_by_side_share_no_point_and_leave_none_out(seed):
    """27 cubes tile a larger one, whose points each lie in one: on faces, edges, corners as well.

    Coordinates are halves; those of the largest ends belong to none.
    """
    points = np.random.default_rng(seed).integers(-1, 8, (200, 3)) / 2.0
    count = np.zeros(200, int)
    for place in itertools.product(range(3), repeat=3):
        count += Solid(CORNERS + place, CUBE).inside(points)

    assert count.tolist() == ((points >= 0.0) & (points < 3.0)).all(axis=1).astype(int).tolist()


def test_a_cube_as_mesh_and_as_box_holds_the_same_points():
    """A lattice of 9 steps an axis from -1 to 3; the box is [0, 2) in each."""
    steps = np.linspace(-1.0, 3.0, 9)
    points = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3)

    box = Box((0.0, 0.0, 0.0), (2.0, 2.0, 2.0)).inside(points)

    assert box.sum() == 4**3
    assert np.array_equal(Solid(2.0 * CORNERS, CUBE).inside(points), box)


def test_overlapping_parts_are_joined_and_a_part_turned_inside_out_hollows():
    """Two cubes overlap in half a unit; the second, inverted, takes the overlap out."""
    vertices = np.concatenate([CORNERS, CORNERS + np.array([0.5, 0.0, 0.0])])
    points = np.array([[0.25, 0.5, 0.5], [0.75, 0.5, 0.5], [1.25, 0.5, 0.5], [1.75, 0.5, 0.5]])
    joined = Solid(vertices, np.concatenate([CUBE, CUBE + 8]))
    hollow = Solid(vertices, np.concatenate([CUBE, CUBE[:, ::-1] + 8]))

    assert joined.inside(points).tolist() == [True, True, True, False]
    assert hollow.inside(points).tolist() == [True, False, True, False]


def test_faces_that_turn_anyhow_are_counted_odd_or_even():
    """Every second triangle of a cube is turned; its inside is what it was."""
    triangles = CUBE.copy()
    triangles[::2] = triangles[::2, ::-1]
    points = np.random.default_rng(1).uniform(-1.0, 2.0, (2000, 3))
    solid = Solid(CORNERS, triangles)

    assert not solid.turned
    assert np.array_equal(solid.inside(points), Solid(CORNERS, CUBE).inside(points))


def test_vertices_of_each_face_apart_are_joined():
    """As exporters write them: 36 vertices at 8 places, -0 among them."""
    apart = CORNERS[CUBE].reshape(-1, 3)
    apart = np.where((apart == 0.0) & (np.arange(36)[:, None] % 2 == 0), -0.0, apart)
    solid = Solid(apart, np.arange(36).reshape(12, 3))

    assert len(solid.vertices) == 8
    assert solid.turned
    assert solid.inside(np.array([[0.5, 0.5, 0.5]])).all()


def test_many_points_at_one_place_and_many_triangles_take_no_more_than_each_once():
    """50,000 points at two places of a globe of 9,800 triangles: one inside, one outside."""
    points = np.repeat([[0.1, 0.2, 0.3], [0.9, 0.9, 0.9]], 25_000, axis=0)

    found = Solid(*globe(70, 71)).inside(points)

    assert found[:25_000].all()
    assert not found[25_000:].any()


@pytest.mark.parametrize(
    ("triangles", "expected"),
    [
        (CUBE[1:], "is not closed: 3 of its edges belong to an odd number of faces; fill the"),
        (CUBE[:0], "has no faces"),
        (np.array([[0, 0, 1]]), "is not closed"),
    ],
)
def test_a_mesh_that_is_not_closed_is_refused(triangles, expected):
    """One triangle less has three open edges."""
    with pytest.raises(RefineError, match=expected):
        Solid(CORNERS, triangles)


def test_a_vertex_that_is_not_finite_is_refused():
    """It would make every line miss."""
    corners = CORNERS.copy()
    corners[3, 1] = np.nan

    with pytest.raises(RefineError, match="not finite"):
        Solid(corners, CUBE)


WILD = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [0, -np.inf, 0], [1e300, 0, 0], [0.5, 0.5, 0.5]])


@pytest.mark.parametrize(
    "volume",
    [
        Box((0, 0, 0), (1, 1, 1)),
        Box((0, 0, 0), (1e9, 1, np.inf)),
        Sphere((0.5, 0.5, 0.5), 0.1),
        Solid(CORNERS, CUBE),
        MovedVolume(Box((-1, -1, -1), (1, 1, 1)), np.eye(4)),
    ],
    ids=["box", "endless", "sphere", "solid", "placed"],
)
def test_what_is_not_finite_lies_in_no_volume(volume):
    """Nor does what is far away; no warning of NumPy's is raised."""
    assert volume.inside(WILD).tolist() == [False] * 4 + [True]


def test_an_endless_box_holds_all_that_is_finite():
    """1e300 is, infinity is not."""
    box = parse("box:-inf,-inf,-inf,inf,inf,inf")

    assert box.inside(WILD).tolist() == [False, False, False, True, True]


def test_a_placed_sphere_is_an_ellipsoid():
    """Stretched to 2, 1 and 1/2 and moved by 1 in x: its ends lie at those lengths."""
    matrix = np.diag([2.0, 1.0, 0.5, 1.0])
    matrix[0, 3] = 1.0
    volume = MovedVolume(Sphere((0, 0, 0), 1.0), matrix)
    points = np.array(
        [[2.9, 0, 0], [3.1, 0, 0], [1, 0.9, 0], [1, 1.1, 0], [1, 0, 0.4], [1, 0, 0.6]]
    )

    assert volume.inside(points).tolist() == [True, False] * 3


def test_a_vast_sphere_holds_all():
    """The square of its radius is no float64."""
    assert Sphere((0, 0, 0), 1e200).inside(np.array([[1e30, 0.0, 0.0]])).tolist() == [True]


def test_a_sphere_holds_its_surface():
    """A point at the distance of the radius, exactly."""
    points = np.array([[3.0, 4.0, 0.0], [3.0, 4.0, 1e-6]])

    assert Sphere((0, 0, 0), 5.0).inside(points).tolist() == [True, False]


def test_a_flat_matrix_is_refused():
    """A scale of 0 leaves no volume."""
    with pytest.raises(RefineError, match="is flat"):
        MovedVolume(Sphere((0, 0, 0), 1.0), np.diag([1.0, 0.0, 1.0, 1.0]))


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
    """With what was got and what was expected."""
    with pytest.raises(RefineError, match=re.escape(expected)):
        parse(text)


@pytest.mark.parametrize("text", ["Cube", "box", "Box:1", "", "a:b"])
def test_other_texts_are_names(text):
    """Objects may be called as they like."""
    assert parse(text) is None


LINE = np.stack([np.arange(10.0), np.zeros(10), np.zeros(10)], axis=1)
"""Ten points, at x from 0 to 9."""


def zone(role, low, high, **more):
    return Zone(role, f"{role} {low}", Box((low, -1.0, -1.0), (high, 1.0, 1.0)), **more)


def test_zones_of_a_kind_are_joined_and_protection_wins():
    """Keep 0-3 and 5-8, remove 2-6, protect 4 and 9: 2, 3, 5 and 8 go, 9 only for being outside."""
    zones = [
        zone("keep", 0, 4), zone("keep", 5, 8), zone("remove", 2, 6),
        zone("protect", 4, 5), zone("protect", 9, 10),
    ]  # fmt: skip
    found = forced(zones, LINE)

    assert np.flatnonzero(found.removed).tolist() == [2, 3, 5, 8]
    assert np.flatnonzero(found.protected).tolist() == [4, 9]
    assert [fact["splats"] for fact in found.facts] == [4, 3, 4, 1, 1]
    assert found.facts[2]["name"] == "remove 2"


def test_without_volumes_nothing_is_forced_and_a_mask_stays_what_it_was():
    """None costs nothing."""
    mask = LINE[:, 0] > 5.0

    assert forced((), LINE).removed is None
    assert forced((), LINE).protected is None
    assert forced((), LINE, mask).protected is mask


def test_a_volume_without_splats_is_refused_unless_it_may_be_idle():
    """The sentence says where the splats are."""
    with pytest.raises(RefineError, match=r"remove 20 holds .*they lie from 0,0,0 to 9,0,0"):
        forced([zone("remove", 20, 21)], LINE)

    assert not forced([zone("remove", 20, 21, idle=True)], LINE).removed.any()


def test_volumes_that_leave_nothing_are_refused():
    """An idle keep volume keeps nothing."""
    with pytest.raises(RefineError, match="all 10 splats lie where they must go"):
        forced([zone("keep", 20, 21, idle=True)], LINE)


def test_splats_marked_to_go_go_with_those_of_volumes_but_not_the_protected():
    """Of x = 0..5: 0 is marked, 4 and 5 lie in a box, 5 and 1 are protected: 0 and 4 go."""
    means = np.stack([np.arange(6.0), np.zeros(6), np.zeros(6)], axis=1)
    marked, protected = np.arange(6) == 0, np.isin(np.arange(6), [1, 5])
    zone = Zone("remove", "box", Box((3.5, -1, -1), (9, 1, 1)))
    found = forced([zone], means, protected, marked | (np.arange(6) == 1))

    assert np.flatnonzero(found.removed).tolist() == [0, 4]
    assert forced([], means, None, marked).counts() == {"protected": 0, "removed_by_user": 1}
