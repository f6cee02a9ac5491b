"""Crossing faces: closed forms, and exact rational arithmetic as a reference."""

from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from lampopt.intersections import self_intersections
from lampopt.testing import shapes


def mesh(vertices, faces):
    return trimesh.Trimesh(vertices, faces, process=False)


def both(*meshes):
    return trimesh.util.concatenate(meshes)


def boxes(centre, divisions, size=(1, 1, 1)):
    return both(shapes.box((1, 1, 1), divisions=divisions), shapes.box(size, centre=centre, divisions=divisions))


def dented(depth):
    """A unit ball whose cap above 0.5 is folded inward, down to 0.5 − `depth`."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    vertices = np.array(ball.vertices)
    cap = vertices[:, 2] > 0.5
    vertices[cap, 2] = 0.5 - 2 * depth * (vertices[cap, 2] - 0.5)
    return mesh(vertices, ball.faces)


BIG = [[0, 0, 0], [4, 0, 0], [0, 4, 0]]


@pytest.mark.parametrize(
    ("other", "crosses"),
    [
        ([[1, 1, -1], [1, 1, 1], [2, 1, 1]], True),  # a needle through the middle
        ([[1, 1, 1], [2, 1, 1], [1, 2, 3]], False),  # above
        ([[1, 1, 0], [2, 1, 1], [1, 2, 1]], False),  # stands on it with a corner
        ([[1, 1, 0], [2, 1, 0], [1, 2, 1]], False),  # stands on it with an edge
        ([[1, 1, 0], [2, 1, 0], [1, 2, 0]], False),  # lies on it
        ([[5, 5, -1], [5, 5, 1], [6, 5, 1]], False),  # through its plane, beside it
        ([[0, 4, -1], [0, 4, 1], [-1, 5, 0]], False),  # touches a corner
        ([[2, 0, -1], [2, 0, 1], [2, -1, 0]], False),  # touches an edge
        ([[2, -1, -1], [2, -1, 1], [2, 1, 0]], True),  # cuts an edge
    ],
)
def test_two_triangles(other, crosses):
    found = self_intersections(mesh([*BIG, *other], [[0, 1, 2], [3, 4, 5]]))
    assert found.tolist() == ([[0, 1]] if crosses else [])


@pytest.mark.parametrize(("third", "crosses"), [([2, 2, 1], False), ([3, 1, 1], True)])
def test_two_triangles_that_share_a_vertex(third, crosses):
    below = [1, 1, -1] if crosses else [1, 3, 1]
    found = self_intersections(mesh([*BIG, third, below], [[0, 1, 2], [0, 3, 4]]))
    assert found.tolist() == ([[0, 1]] if crosses else [])


@pytest.mark.parametrize("divisions", [0, 1, 2])
@pytest.mark.parametrize("centre", [(0.3, 0.21, 0.4), (0.5, 0.5, 0.5), (0.5, 0, 0.5), (0.25, 0.25, 0.25)])
def test_boxes_that_cross_are_found_also_along_their_edges(divisions, centre):
    solid = boxes(centre, divisions)
    found = self_intersections(solid)
    half = len(solid.faces) // 2
    assert len(found)
    assert (found[:, 0] < half).all()
    assert (found[:, 1] >= half).all()  # always one box through the other, neither through itself


@pytest.mark.parametrize("divisions", [0, 2])
@pytest.mark.parametrize(
    ("centre", "size"),
    [
        ((0, 0, 0), (0.5, 0.5, 0.5)),  # nested
        ((1, 0, 0), (1, 1, 1)),  # face to face
        ((1, 0.1, 0.2), (1, 1, 1)),  # face on face, shifted
        ((1, 1, 0.2), (1, 1, 1)),  # edge to edge
        ((1, 1, 1), (1, 1, 1)),  # corner to corner
        ((3, 0, 0), (1, 1, 1)),  # apart
    ],
)
def test_boxes_that_only_touch_do_not_cross(divisions, centre, size):
    assert len(self_intersections(boxes(centre, divisions, size))) == 0


def test_where_edges_coincide_sides_decide():
    """Two folded sheets along one line, apart from each other: they cross only if they come through alternately."""

    def sheets(*angles):
        parts = []
        for one, other in (angles[:2], angles[2:]):
            tips = [[np.cos(a), np.sin(a), 0.5] for a in np.radians([one, other])]
            parts.append(mesh([[0, 0, 0], [0, 0, 1], *tips], [[0, 1, 2], [1, 0, 3]]))
        return both(*parts)

    assert len(self_intersections(sheets(0, 180, 90, 270)))
    assert len(self_intersections(sheets(10, 200, 100, 290)))
    assert len(self_intersections(sheets(70, 230, 10, 60))) == 0
    assert len(self_intersections(sheets(0, 90, 180, 270))) == 0


def test_a_dent_crosses_where_it_comes_out_below():
    assert len(self_intersections(dented(1.0))) == 0
    ball = dented(3.0)
    found = self_intersections(ball)
    assert len(found)
    cap = trimesh.creation.icosphere(subdivisions=3).triangles_center[:, 2] > 0
    bottom = ball.triangles[:, :, 2].max(1) < -0.5
    assert (cap[found].sum(1) == 1).all()  # always a face of the dent with one of the bottom
    assert bottom[found[~cap[found]]].all()


@pytest.mark.parametrize("name", ["sphere", "plate", "box"])
def test_sound_solids_do_not_cross(name):
    solid = {"sphere": shapes.ellipsoid(divisions=4), "plate": shapes.plate_with_hole(), "box": shapes.box()}[name]
    assert self_intersections(solid).shape == (0, 2)


def test_place_size_and_order_do_not_matter():
    solid = boxes((0.3, 0.21, 0.4), 1)
    found = {tuple(pair) for pair in self_intersections(solid).tolist()}
    turn = trimesh.transformations.random_rotation_matrix(rand=np.array([0.1, 0.7, 0.4]))
    moved = solid.copy().apply_transform(turn).apply_scale(1e-4).apply_translation([3, -2, 1])
    assert {tuple(pair) for pair in self_intersections(moved).tolist()} == found
    order = np.random.default_rng(0).permutation(len(solid.faces))
    mixed = self_intersections(mesh(solid.vertices, solid.faces[order]))
    assert {tuple(sorted(order[pair].tolist())) for pair in mixed} == found


def test_it_can_stop_early():
    solid = boxes((0.3, 0.21, 0.4), 2)
    assert len(self_intersections(solid, most=5)) == 5


@pytest.mark.parametrize("faces", [[], [[0, 1, 2]], [[0, 1, 1], [0, 0, 0], [0, 1, 2]]])
def test_nothing_to_cross(faces):
    assert self_intersections(mesh(BIG, np.array(faces, int).reshape(-1, 3))).shape == (0, 2)


def test_all_in_one_point():
    assert len(self_intersections(mesh(np.zeros((6, 3)), [[0, 1, 2], [3, 4, 5]]))) == 0


# the reference: exact arithmetic, every pair


def minus(p, q):
    return [a - b for a, b in zip(p, q, strict=True)]


def cross(p, q):
    return [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]]


def dot(p, q):
    return sum(a * b for a, b in zip(p, q, strict=True))


def pass_through(one, other):
    """Whether each of two triangles of whole numbers goes through the other along a piece of line."""
    normals = [cross(minus(t[1], t[0]), minus(t[2], t[0])) for t in (one, other)]
    line = cross(*normals)
    if not any(line):
        return False
    spans = []
    for triangle, plane, normal in ((one, other, normals[1]), (other, one, normals[0])):
        height = [dot(minus(p, plane[0]), normal) for p in triangle]
        if not (min(height) < 0 < max(height)):
            return False
        at = [dot(p, line) for p in triangle]
        places = [Fraction(a) for a, h in zip(at, height, strict=True) if h == 0]
        for i, j in ((0, 1), (1, 2), (2, 0)):
            if height[i] * height[j] < 0:
                places.append(at[i] + Fraction(height[i], height[i] - height[j]) * (at[j] - at[i]))
        spans.append((min(places), max(places)))
    return min(spans[0][1], spans[1][1]) > max(spans[0][0], spans[1][0])


def expected(vertices, faces):
    triangles = [[vertices[i] for i in face] for face in faces]
    return [[i, j] for i, j in combinations(range(len(faces)), 2) if pass_through(triangles[i], triangles[j])]


whole = st.integers(-6, 6)
point = st.lists(whole, min_size=3, max_size=3)


@settings(max_examples=150, deadline=None)
@given(st.integers(2, 10).flatmap(lambda n: st.lists(point, min_size=3 * n, max_size=3 * n)))
def test_loose_triangles_agree_with_exact_arithmetic(vertices):
    faces = np.arange(len(vertices)).reshape(-1, 3)
    assert self_intersections(mesh(vertices, faces)).tolist() == expected(vertices, faces.tolist())


@settings(max_examples=150, deadline=None)
@given(st.integers(2, 6).flatmap(lambda n: st.lists(point, min_size=2 * n + 1, max_size=2 * n + 1)))
def test_a_fan_about_one_vertex_agrees_with_exact_arithmetic(vertices):
    faces = [[0, k, k + 1] for k in range(1, len(vertices), 2)]
    assert self_intersections(mesh(vertices, faces)).tolist() == expected(vertices, faces)


def test_neighbours_in_nearly_one_plane_do_not_cross():
    """A top that is flat but for a bend of about the rounding: triangles lie beside each other about each vertex."""
    rng = np.random.default_rng(0)
    points = rng.random((3000, 2))
    faces = Delaunay(points).simplices
    for bend in (1e-8, 1e-7, 1e-6, 1e-5):
        top = np.column_stack([points, bend * np.sin(4 * points[:, 0]) * np.cos(5 * points[:, 1])])
        assert len(self_intersections(trimesh.Trimesh(top, faces, process=False))) == 0, bend


@pytest.mark.parametrize(("angle", "crosses"), [(1e-7, False), (5e-7, False), (1e-5, True), (-1e-4, True)])
def test_planes_nearly_one_are_one(angle, crosses):
    """Two triangles that overlap and are turned against each other about a line in both: rounding bends flat faces."""
    one = np.array([[-0.5, -0.4, 0.0], [0.5, -0.3, 0.0], [0.1, 0.5, 0.0]])
    other = one @ np.diag([-1, 1, 1]) * [0.7, 0.8, 1]
    other[:, 2] = np.tan(angle) * other[:, 0]
    mesh = trimesh.Trimesh(np.concatenate([one, other]), [[0, 1, 2], [3, 4, 5]], process=False)
    assert len(self_intersections(mesh)) == crosses
