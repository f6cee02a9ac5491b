"""Topology against what is known of spheres, tori and their unions, and of meshes that are broken."""

import time

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.measure import marching_cubes

from lampopt.errors import MeasureError
from lampopt.testing import shapes
from lampopt.topology import Topology, topology
from lampopt_measure.basic import Genus


def sphere():
    return trimesh.creation.icosphere(subdivisions=2)


def torus():
    return trimesh.creation.torus(1.0, 0.3, major_sections=24, minor_sections=12)


def apart(*meshes):
    return trimesh.util.concatenate([m.copy().apply_translation((4 * i, 0, 0)) for i, m in enumerate(meshes)])


def mesh(vertices, faces):
    return trimesh.Trimesh(vertices, faces, process=False)


KNOWN = {
    "sphere": (sphere, 1, 0),
    "box": (shapes.box, 1, 0),
    "torus": (torus, 1, 1),
    "plate with a hole": (shapes.plate_with_hole, 1, 1),
    "two spheres": (lambda: apart(sphere(), sphere()), 2, 0),
    "sphere and torus": (lambda: apart(sphere(), torus()), 2, 1),
    "three tori": (lambda: apart(torus(), torus(), torus()), 3, 3),
    "a shell": (lambda: trimesh.util.concatenate([sphere(), sphere().apply_scale(0.5)]), 2, 0),
    "turned inside out": (lambda: mesh(sphere().vertices, sphere().faces[:, ::-1]), 1, 0),
}


@pytest.mark.parametrize("name", KNOWN)
def test_known_surfaces(name):
    make, bodies, genus = KNOWN[name]
    assert topology(make()) == Topology(True, bodies, genus)


@pytest.mark.parametrize("holes", [0, 1, 2, 3])
def test_genus_counts_through_holes(holes):
    length = 1 + 2 * max(holes, 1)
    inside = np.zeros((length + 2, 5, 3), bool)
    inside[1:-1, 1:-1, 1] = True
    for i in range(holes):
        inside[2 + 2 * i, 2, 1] = False
    vertices, faces, _, _ = marching_cubes(np.where(inside, -1.0, 1.0), 0.0)
    assert topology(mesh(vertices, faces)) == Topology(True, 1, holes)


def test_an_open_surface_has_no_genus():
    ball = sphere()
    ball.update_faces(np.arange(len(ball.faces)) > 0)
    assert topology(ball) == Topology(False, 1, None)


def test_one_flipped_face_is_not_closed():
    ball = sphere()
    faces = np.array(ball.faces)
    faces[7] = faces[7][::-1]
    assert topology(mesh(ball.vertices, faces)) == Topology(False, 1, None)


def test_a_body_turned_against_the_other_is_closed():
    both = apart(sphere(), sphere())
    faces = np.array(both.faces)
    faces[: len(faces) // 2] = faces[: len(faces) // 2, ::-1]
    assert topology(mesh(both.vertices, faces)) == Topology(True, 2, 0)


def test_a_face_given_twice_is_not_closed():
    ball = sphere()
    twice = mesh(ball.vertices, np.vstack([ball.faces, ball.faces[:1]]))
    assert not topology(twice).closed
    assert not topology(mesh(ball.vertices, np.vstack([ball.faces, ball.faces]))).closed


def test_bodies_that_share_an_edge_are_not_closed():
    low, high = shapes.box((1, 1, 1), divisions=0), shapes.box((1, 1, 1), centre=(1, 1, 0), divisions=0)
    both = trimesh.util.concatenate([low, high])
    both.merge_vertices()
    assert len(both.vertices) == 14
    assert not topology(both).closed


def test_loose_triangles_are_as_many_bodies():
    ball = sphere()
    loose = mesh(ball.triangles.reshape(-1, 3), np.arange(3 * len(ball.faces)).reshape(-1, 3))
    assert topology(loose) == Topology(False, len(ball.faces), None)


def touching():
    """Two boxes that share one vertex, stored once."""
    low, high = shapes.box((1, 1, 1), divisions=0), shapes.box((1, 1, 1), centre=(1, 1, 1), divisions=0)
    both = trimesh.util.concatenate([low, high])
    both.merge_vertices()
    assert len(both.vertices) == 15
    return both


def test_bodies_that_share_a_vertex_are_two():
    assert topology(touching()) == Topology(True, 2, 0)
    assert Genus()(touching()).tolist() == [2, 0]


def test_a_surface_that_touches_itself_in_a_vertex_has_no_handle():
    """A sphere with its poles pulled together is one surface of genus 0; counting vertices alone says one half."""
    ball = sphere()
    low, high = int(ball.vertices[:, 2].argmin()), int(ball.vertices[:, 2].argmax())
    faces = np.where(ball.faces == high, low, ball.faces)
    assert topology(mesh(ball.vertices, faces)) == Topology(True, 1, 0)


def test_three_boxes_in_a_row_at_vertices():
    boxes = [shapes.box((1, 1, 1), centre=(i, i, i), divisions=0) for i in range(3)]
    row = trimesh.util.concatenate(boxes)
    row.merge_vertices()
    assert len(row.vertices) == 22
    assert topology(row) == Topology(True, 3, 0)
    assert topology(trimesh.util.concatenate([row, torus().apply_translation((9, 0, 0))])) == Topology(True, 4, 1)


def test_open_faces_that_share_a_vertex_are_two():
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]
    assert topology(mesh(vertices, [[0, 1, 2], [0, 3, 4]])) == Topology(False, 2, None)


def test_a_face_with_one_corner_twice_is_not_closed():
    ball = sphere()
    spare = len(ball.vertices)
    bad = mesh(np.vstack([ball.vertices, np.eye(3)]), np.vstack([ball.faces, [[spare, spare, spare + 1]]]))
    assert not topology(bad).closed
    paired = np.vstack([ball.faces, [[spare, spare, spare + 1], [spare, spare, spare + 2]]])
    assert not topology(mesh(bad.vertices, paired)).closed


@pytest.mark.parametrize("name", ["one flipped", "moebius", "klein"])
def test_the_measure_refuses_what_has_no_genus(name):
    if name == "one flipped":
        faces = np.array(sphere().faces)
        faces[7] = faces[7][::-1]
        bad = mesh(sphere().vertices, faces)
        with pytest.raises(MeasureError, match="wound alike"):
            Genus()(bad)
    else:
        bad = grid_surface(flip=True, wrap=name == "klein")
        with pytest.raises(MeasureError, match="wound alike" if name == "klein" else "expected a closed mesh"):
            Genus()(bad)
    assert topology(bad) == Topology(False, 1, None)


def test_a_torus_without_places():
    assert topology(grid_surface(flip=False, wrap=True)) == Topology(True, 1, 1)


def grid_surface(*, flip, wrap, n=6):
    """An n × n grid of squares, its left end joined to its right (turned round if `flip`), its top to its bottom."""
    rows = n if wrap else n + 1

    def at(i, j):
        j = -j if flip and i >= n and wrap else (n - j if flip and i >= n else j)
        return (i % n) * rows + j % rows

    squares = [(at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)) for i in range(n) for j in range(n)]
    faces = [face for a, b, c, d in squares for face in ((a, b, c), (a, c, d))]
    return mesh(np.random.default_rng(0).normal(size=(n * rows, 3)), faces)


def test_it_is_fast():
    ball = trimesh.creation.icosphere(subdivisions=6)
    began = time.process_time()
    assert topology(ball) == Topology(True, 1, 0)
    assert time.process_time() - began < 1.0  # 82 thousand faces; about 0.06 s


def test_vertices_that_no_face_uses_do_not_count():
    ball = sphere()
    spare = mesh(np.vstack([np.ones((3, 3)), ball.vertices, np.zeros((5, 3))]), ball.faces + 3)
    assert topology(spare) == Topology(True, 1, 0)


def test_nothing_is_no_body():
    assert topology(trimesh.Trimesh()) == Topology(False, 0, None)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(sorted(KNOWN)))
def test_order_and_place_do_not_matter(seed, name):
    make, bodies, genus = KNOWN[name]
    solid, draw = make(), np.random.default_rng(seed)
    order = draw.permutation(len(solid.vertices))
    faces = np.argsort(order)[np.asarray(solid.faces)]
    faces = draw.permutation(np.stack([np.roll(f, draw.integers(3)) for f in faces]))
    moved = mesh(
        np.asarray(solid.vertices)[order] @ np.linalg.qr(draw.normal(size=(3, 3)))[0] + draw.normal(size=3), faces
    )
    assert topology(moved) == Topology(True, bodies, genus)
