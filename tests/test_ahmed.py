"""The Ahmed body: valid far outside its range, its sizes met on the mesh, closed forms, other people's meshes of it."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.stats import qmc

import lampopt
from lampopt.errors import InputError
from lampopt.intersections import self_intersections
from lampopt.protocols import Source
from lampopt.testing import check_source
from lampopt.topology import topology
from lampopt_families.ahmed import FAMILY, NAMES, AhmedSource, Sizes, ahmed_mesh, derived

DATA = Path(__file__).parents[2] / "shared" / "data" / "ahmed"
PUBLISHED = np.array([1044, 389, 288, 25, 222, 100, 50])
STILTS = (202, 672)  # [mm] from the nose, as documented


def rows(factor, count, seed=0):
    low, high = FAMILY.widened(factor)
    draws = qmc.scale(qmc.LatinHypercube(len(NAMES), rng=seed).random(count), low, high)
    ends = np.random.default_rng(seed).random((count, len(NAMES))) < 0.5
    return np.concatenate([draws, np.where(ends, low, high)])


def at(**values):
    return np.array([values.get(name, usual) for name, usual in zip(NAMES, PUBLISHED, strict=True)])


# the source


def test_source():
    source = AhmedSource()
    assert isinstance(source, Source)
    exemplars = source()
    assert len(exemplars) == 15 and exemplars.unit == "mm"
    assert [q.name for q in exemplars.space] == list(NAMES) == list(Sizes._fields)
    np.testing.assert_array_equal(exemplars.parameters[0], PUBLISHED)
    assert set(NAMES) - set(exemplars.measured) == {"height", "slant_length", "front_radius"}
    assert set(NAMES) - set(AhmedSource(stilts=False)().measured) == {
        "ground_clearance",
        "slant_length",
        "front_radius",
    }


@pytest.mark.parametrize("stilts", [True, False])
def test_what_is_declared_measurable_is_measured(stilts):
    exemplars = AhmedSource(count=2, design="lhs", stilts=stilts)()
    for name, address in exemplars.measured.items():
        measure, value = address.split(".")
        found = [lampopt.measure(measure, mesh)[value] for mesh in exemplars.meshes]
        assert found == pytest.approx(exemplars.parameters[:, NAMES.index(name)], rel=1e-4), name


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stilts": 1}, "stilts: expected true or false, got 1"),
        ({"edge": 0.0}, "edge: expected 3 to 100 mm, got 0"),
        ({"count": 20}, "'ends' has 15 exemplars, got count=20"),
    ],
)
def test_options_that_make_no_family(options, message):
    with pytest.raises(InputError, match=f"ahmed: .*{message}"):
        AhmedSource(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(({"edge": edge}, "edge: expected 3 to 100 mm, got") for edge in (True, "12", np.nan, 0, -12.0, 1e300)),
        *(({"stilts": stilts}, "stilts: expected true or false, got") for stilts in (1, "no", None)),
    ],
)
def test_options_that_make_no_mesh(options, message):
    for refused in (lambda: AhmedSource(**options), lambda: ahmed_mesh(PUBLISHED, **options)):
        with pytest.raises(InputError, match=f"ahmed: {message}"):
            refused()


def test_the_kit():
    check_source(AhmedSource(count=3, design="lhs", edge=40.0))


# the body


@pytest.mark.parametrize("stilts", [True, False])
@pytest.mark.parametrize("factor", [1, 2, 3])
def test_one_closed_body_without_handles(factor, stilts):
    for parameters in rows(factor, 2, seed=factor):
        mesh = ahmed_mesh(parameters, stilts=stilts)
        found = topology(mesh)
        assert mesh.is_watertight and mesh.volume > 0
        assert (found.bodies, found.genus) == (1, 0)
        assert (mesh.area_faces > 0).all()


@pytest.mark.parametrize("stilts", [True, False])
def test_nothing_crosses(stilts):
    mesh = ahmed_mesh(PUBLISHED, stilts=stilts)
    assert 20_000 < len(mesh.faces) < 40_000
    assert len(self_intersections(mesh)) == 0


def test_the_right_is_the_mirror_image_of_the_left():
    for stilts in (True, False):
        points = ahmed_mesh(PUBLISHED, stilts=stilts).vertices
        found, wanted = (p[np.lexsort(np.round(p, 6).T)] for p in (points, points * (1, -1, 1)))
        np.testing.assert_allclose(found, wanted, atol=1e-9)


@pytest.mark.parametrize("factor", [1, 3])
def test_every_size_is_met(factor):
    for parameters in rows(factor, 3, seed=5):
        s, mesh = Sizes(*parameters), ahmed_mesh(parameters)
        x, y, z = mesh.vertices.T
        body = z >= s.ground_clearance - 1e-9
        floor, roof = s.ground_clearance, s.ground_clearance + s.height
        assert mesh.bounds == pytest.approx(np.array([[0, -s.width / 2, 0], [s.length, s.width / 2, roof]]), abs=1e-9)
        assert z[body].min() == pytest.approx(floor)
        # the slant: its faces' normals, and where they begin and end
        normal, corners = mesh.face_normals, mesh.triangles.reshape(-1, 9)
        level = np.degrees(np.arctan2(normal[:, 0], normal[:, 2]))
        slant = (np.abs(level - s.slant_angle) < 1e-6) & (mesh.triangles_center[:, 0] > s.length / 2)
        ends = corners[slant].reshape(-1, 3)
        begin, end = ends[ends[:, 0].argmin()], ends[ends[:, 0].argmax()]
        assert np.hypot(end[0] - begin[0], end[2] - begin[2]) == pytest.approx(s.slant_length)
        assert (begin[2], end[0]) == pytest.approx((roof, s.length))
        assert mesh.area_faces[slant].sum() == pytest.approx(s.slant_length * s.width)
        # the nose: round about its axes in the side view and from above
        r = s.front_radius
        top = (x < r) & (z > roof - r) & (np.abs(y) < s.width / 2 - r)
        assert np.hypot(x - r, z - (roof - r))[top] == pytest.approx(r)
        flank = (x < r) & (y > s.width / 2 - r) & (np.abs(z - (floor + roof) / 2) < s.height / 2 - r)
        assert np.hypot(x - r, y - (s.width / 2 - r))[flank] == pytest.approx(r)
        # the stilts
        feet = mesh.vertices[z == 0]
        for ahead in STILTS:
            for side in (-1, 1):
                away = np.hypot(feet[:, 0] - ahead, feet[:, 1] - side * (s.width / 2 - 31))
                assert (np.abs(away - 15) < 1e-9).sum() == 24
        assert len(feet) == 4 * 24


@pytest.mark.parametrize("stilts", [True, False])
def test_closed_forms(stilts):
    """Chords fall short of circles, by a quarter as much where they are half as long."""
    for parameters in (*rows(3, 2), at(slant_angle=0)):
        truth = derived(parameters, stilts=stilts)
        short = {}
        for edge in (24.0, 12.0):
            mesh = ahmed_mesh(parameters, stilts=stilts, edge=edge)
            short[edge] = np.array([1 - mesh.volume / truth["volume"], 1 - mesh.area / truth["area"]])
        assert (short[12.0] > 0).all() and (short[12.0] < 2e-4).all()
        if not stilts:
            assert short[12.0] == pytest.approx(short[24.0] / 4, rel=0.2)


def test_frontal_area_in_closed_form():
    from shapely import union_all
    from shapely.geometry import Polygon

    mesh = ahmed_mesh(PUBLISHED, edge=40.0)
    shadow = union_all([Polygon(t) for t in mesh.triangles[mesh.face_normals[:, 0] < -1e-6][:, :, 1:]])
    assert shadow.area == pytest.approx(derived(PUBLISHED)["frontal_area"], rel=1e-3)


@pytest.mark.skipif(not DATA.exists(), reason=f"no folder {DATA.name} of Ahmed bodies beside the repository")
@pytest.mark.parametrize("slant", [0, 12.5, 25, 35])
def test_against_bodies_made_by_others(slant):
    other = trimesh.load(DATA / f"ahmed_{slant:g}.stl")
    ours = ahmed_mesh(at(slant_angle=slant), stilts=False)
    assert ours.volume == pytest.approx(other.volume, rel=5e-5)
    assert ours.area == pytest.approx(other.area, rel=5e-5)
    assert ours.bounds == pytest.approx(other.bounds, abs=1e-9)
    for one, two in ((ours, other), (other, ours)):
        points = two.vertices[:: max(1, len(two.vertices) // 600)]
        assert trimesh.proximity.closest_point(one, points)[1].max() < 0.1  # [mm] between chords


# what makes no such body


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"length": -1}, "length: expected more than 0 and up to 10,000 mm, got -1 mm"),
        ({"slant_angle": -2}, "slant_angle: expected 0 to less than 90 deg, got -2 deg"),
        ({"front_radius": 145}, "front_radius: expected less than half the height, got 145 mm and 144 mm"),
        ({"front_radius": 190, "width": 350, "height": 400}, "front_radius: expected less than half the width"),
        ({"front_radius": 190, "width": 500, "height": 500}, "front_radius: expected to end before the stilts"),
        ({"slant_length": 960, "slant_angle": 5}, "slant_length: expected to begin behind the nose"),
        ({"slant_length": 400, "slant_angle": 50}, "slant_length: expected to end above the underside"),
        ({"length": 680}, "length: expected to reach beyond the stilts, got 687 mm and 680 mm"),
        ({"width": 90, "front_radius": 40}, "width: expected to leave room between the stilts"),
        ({"height": np.inf}, "expected finite parameters, got height is inf"),
    ],
)
def test_parameters_that_make_no_body(values, message):
    with pytest.raises(InputError, match=f"ahmed: .*{message}"):
        ahmed_mesh(at(**values))
