"""Measures against closed forms: boxes, spheres, tori, several bodies; what motion and scaling must leave or change."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from lampopt.errors import EmptyMesh, MeasureError
from lampopt.plugins import Plugins
from lampopt.protocols import Measure
from lampopt_measure.basic import Area, Extents, Genus, Volume
from lampopt_measure.plate import Plate

MEASURES = (Extents(), Volume(), Area(), Genus(), Plate())
BOX = (1.0, 2.0, 3.0)


def box(*sizes: float) -> trimesh.Trimesh:
    return trimesh.creation.box(sizes or BOX)


def torus() -> trimesh.Trimesh:
    return trimesh.creation.torus(1.0, 0.3, major_sections=96, minor_sections=48)


def apart(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.util.concatenate([m.copy().apply_translation((10 * i, 0, 0)) for i, m in enumerate(meshes)])


def loose(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same faces, each with corners of its own, as an STL file holds them."""
    return trimesh.Trimesh(mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3), process=False)


def open_box() -> trimesh.Trimesh:
    mesh = box()
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    return mesh


@pytest.mark.parametrize("measure", MEASURES, ids=lambda m: type(m).__name__)
def test_protocol(measure):
    assert isinstance(measure, Measure)
    assert len(measure.names) == len(measure.units) == len(set(measure.names))
    assert set(measure.units) <= {"L", "L^2", "L^3", ""}
    assert measure == type(measure)()
    assert repr(measure) == f"{type(measure).__name__}()"


def test_they_come_in_by_the_front_door():
    plugins = Plugins.load()
    assert [plugins.make("measure", name) for name in ("extents", "volume", "area", "genus", "plate")] == list(MEASURES)


def test_box():
    np.testing.assert_allclose(Extents()(box()), BOX)
    np.testing.assert_allclose(Volume()(box()), 6)
    np.testing.assert_allclose(Area()(box()), 22)
    np.testing.assert_array_equal(Genus()(box()), [1, 0])


def test_sphere():
    # 4/3 π and 4 π; an icosphere of 4 subdivisions falls short by O(h²), 0.2 %
    sphere = trimesh.creation.icosphere(4)
    np.testing.assert_allclose(Volume()(sphere), 4 / 3 * np.pi, rtol=5e-3)
    np.testing.assert_allclose(Area()(sphere), 4 * np.pi, rtol=5e-3)
    np.testing.assert_array_equal(Genus()(sphere), [1, 0])


def test_torus():
    # Pappus: volume 2 π² R r², area 4 π² R r
    np.testing.assert_allclose(Volume()(torus()), 2 * np.pi**2 * 0.09, rtol=5e-3)
    np.testing.assert_allclose(Area()(torus()), 4 * np.pi**2 * 0.3, rtol=5e-3)
    np.testing.assert_array_equal(Genus()(torus()), [1, 1])


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (apart(box(), box()), (2, 0)),
        (apart(torus(), box(), torus()), (3, 2)),
        (trimesh.util.concatenate([box(3, 3, 3), box().apply_scale(0.5)]), (2, 0)),  # a cavity is a body too
    ],
)
def test_genus_sums_over_bodies(mesh, expected):
    np.testing.assert_array_equal(Genus()(mesh), expected)
    np.testing.assert_array_equal(Genus()(loose(mesh)), expected)


def test_genus_of_two_handles():
    plate = trimesh.creation.box((4, 2, 0.5))
    for x in (-1, 1):
        drill = trimesh.creation.cylinder(0.4, 2, sections=16).apply_translation((x, 0, 0))
        plate = trimesh.boolean.difference([plate, drill], engine="manifold")
    np.testing.assert_array_equal(Genus()(plate), [1, 2])


def test_a_pinched_vertex_is_no_handle():
    """Two tetrahedra that share one vertex: two closed surfaces of genus 0, however the vertex is stored."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3], [0, 4, 5], [0, 6, 4], [0, 5, 6], [4, 6, 5]])
    mesh = trimesh.Trimesh(corners, faces, process=False)
    assert mesh.is_watertight
    np.testing.assert_array_equal(Genus()(mesh), [2, 0])


@pytest.mark.parametrize("measure", [Volume(), Area(), Genus(), Extents()], ids=lambda m: type(m).__name__)
@pytest.mark.parametrize("mesh", [box(), torus()], ids=["box", "torus"])
def test_loose_triangles_measure_the_same(measure, mesh):
    np.testing.assert_allclose(measure(loose(mesh)), measure(mesh), rtol=1e-9)


angle = st.floats(-np.pi, np.pi)
shift = st.tuples(*[st.floats(-100, 100)] * 3)


@settings(max_examples=30, deadline=None)
@given(angles=st.tuples(angle, angle, angle), move=shift)
@pytest.mark.parametrize("measure", [Volume(), Area(), Genus()], ids=lambda m: type(m).__name__)
def test_rigid_motion_changes_nothing(measure, angles, move):
    mesh = torus()
    before = measure(mesh)
    mesh.apply_transform(trimesh.transformations.compose_matrix(angles=angles, translate=move))
    np.testing.assert_allclose(measure(mesh), before, rtol=1e-8)


@settings(max_examples=30, deadline=None)
@given(move=shift)
def test_extents_do_not_depend_on_place(move):
    np.testing.assert_allclose(Extents()(box().apply_translation(move)), BOX, rtol=1e-9)


@settings(max_examples=30, deadline=None)
@given(scale=st.floats(1e-2, 1e3))
@pytest.mark.parametrize("measure", [Extents(), Volume(), Area(), Genus()], ids=lambda m: type(m).__name__)
def test_values_scale_as_their_units_say(measure, scale):
    exponent = np.array([{"": 0, "L": 1, "L^2": 2, "L^3": 3}[u] for u in measure.units])
    before = measure(torus())
    np.testing.assert_allclose(measure(torus().apply_scale(scale)), before * scale**exponent, rtol=1e-8)


def test_the_mesh_is_left_as_it_was():
    mesh = loose(box())
    vertices, faces = mesh.vertices.copy(), mesh.faces.copy()
    for measure in (Extents(), Volume(), Area(), Genus()):
        measure(mesh)
    np.testing.assert_array_equal(mesh.vertices, vertices)
    np.testing.assert_array_equal(mesh.faces, faces)


def test_unreferenced_vertices_do_not_count():
    mesh = trimesh.Trimesh(np.vstack([box().vertices, [[99, 99, 99]]]), box().faces, process=False)
    np.testing.assert_allclose(Extents()(mesh), BOX)
    np.testing.assert_array_equal(Genus()(mesh), [1, 0])


@pytest.mark.parametrize("measure", MEASURES, ids=lambda m: type(m).__name__)
def test_empty_mesh(measure):
    with pytest.raises(EmptyMesh, match="expected a mesh with faces"):
        measure(trimesh.Trimesh())


@pytest.mark.parametrize("measure", MEASURES, ids=lambda m: type(m).__name__)
def test_vertices_that_are_not_finite(measure):
    mesh = trimesh.Trimesh(np.where(np.arange(8)[:, None] == 3, np.nan, box().vertices), box().faces, process=False)
    with pytest.raises(MeasureError, match="got 1 that are not"):
        measure(mesh)


@pytest.mark.parametrize("measure", [Volume(), Genus()], ids=lambda m: type(m).__name__)
def test_open_mesh_is_refused(measure):
    with pytest.raises(MeasureError, match="got 3 of 18 edges"):
        measure(open_box())


def test_area_of_an_open_mesh():
    assert Area()(open_box()) == pytest.approx(22 - box().area_faces[0])


def test_inward_faces_have_no_volume():
    mesh = box()
    mesh.invert()
    with pytest.raises(MeasureError, match=r"enclosed volume of -6; turn the faces round"):
        Volume()(mesh)


def test_faces_wound_at_odds_have_no_volume():
    mesh = box()
    faces = mesh.faces.copy()
    faces[0] = faces[0, ::-1]
    with pytest.raises(MeasureError, match="wound alike"):
        Volume()(trimesh.Trimesh(mesh.vertices, faces, process=False))


@pytest.mark.parametrize("measure", MEASURES, ids=lambda m: type(m).__name__)
@pytest.mark.parametrize("wrong", [8, -1])
def test_a_face_between_vertices_that_are_not_there(measure, wrong):
    mesh = trimesh.Trimesh(box().vertices, np.vstack([box().faces, [[0, 1, wrong]]]), process=False)
    for asked in (measure, getattr(measure, "gradient", measure)):
        with pytest.raises(MeasureError, match=f"expected faces between the 8 vertices, got one with vertex {wrong}"):
            asked(mesh)


@pytest.mark.parametrize("measure", MEASURES, ids=lambda m: type(m).__name__)
@pytest.mark.parametrize("scale", [1e200, 1e-200])
def test_sizes_beyond_reckoning(measure, scale):
    mesh = trimesh.Trimesh(box().vertices * scale, box().faces, process=False)
    with pytest.raises(MeasureError, match="expected a largest coordinate from 1e-50 to 1e\\+50"):
        measure(mesh)


def test_a_flat_box_has_a_volume():
    flat = trimesh.Trimesh(box().vertices * [1, 1, 1e-200], box().faces, process=False)
    np.testing.assert_allclose(Volume()(flat), 6e-200)
    with pytest.raises(MeasureError, match="plate: expected a side"):
        Plate().gradient(flat)


@pytest.mark.parametrize("copy", ["faces", "vertices too"])
def test_a_plate_listed_twice_is_refused(copy):
    """Its section would enclose twice the hole, a radius √2 too large."""
    plate = trimesh.creation.annulus(0.3, 1.0, 0.2, sections=64)
    start = len(plate.vertices) if copy == "vertices too" else 0
    vertices = np.vstack([plate.vertices, plate.vertices]) if start else plate.vertices
    twice = trimesh.Trimesh(vertices, np.vstack([plate.faces, plate.faces + start]), process=False)
    with pytest.raises(MeasureError, match="expected each face once, got some twice"):
        Plate()(twice)


def test_a_torus_listed_twice_is_refused():
    ring = torus()
    for asked in (Plate(), Plate().gradient):
        with pytest.raises(MeasureError, match="expected each face once, got some twice"):
            asked(trimesh.Trimesh(ring.vertices, np.vstack([ring.faces, ring.faces]), process=False))


def test_a_plate_beside_a_vertex_far_away():
    plate = trimesh.creation.annulus(0.3, 1.0, 0.2, sections=64)
    parted = loose(plate)
    stray = trimesh.Trimesh(np.vstack([parted.vertices, [[1e12] * 3]]), parted.faces, process=False)
    np.testing.assert_allclose(Plate()(stray), Plate()(parted), rtol=1e-9, atol=1e-12)
