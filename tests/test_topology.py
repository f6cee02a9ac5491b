"""Topology against what is known of spheres, tori and their unions, and of meshes that are broken."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.measure import marching_cubes

from lampopt.testing import shapes
from lampopt.topology import Topology, topology


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
