"""The sedan: a valid solid far outside its range, every parameter met on the mesh, what it is made of held to truth."""

import numpy as np
import pytest
import shapely
from scipy.stats import qmc

import lampopt
from lampopt.errors import InputError
from lampopt.intersections import self_intersections
from lampopt.protocols import Source
from lampopt.testing import check_source
from lampopt.topology import topology
from lampopt_families.car import FAMILY, HIGH, LOW, NAMES, CarSource, car_mesh, checked, derived
from lampopt_families.car_solid import Sizes, Solid, side_view
from lampopt_families.outline import Outline
from lampopt_families.solids import common, joined, outside

MIDDLE = (np.array(LOW) + HIGH) / 2
TYRE, PATCH = 215.0, 6.0  # [mm] as documented: width of the tyres, how far they are pressed flat
COWL, DECK = (1250.0, 950.0), 1040.0  # [mm] as documented: where hood and windscreen, lid and rear window meet


def rows(factor, count, seed=0):
    low, high = FAMILY.widened(factor)
    return qmc.scale(qmc.LatinHypercube(len(NAMES), rng=seed).random(count), low, high)


def corners(factor, count, seed=0):
    low, high = FAMILY.widened(factor)
    return np.where(np.random.default_rng(seed).random((count, len(NAMES))) < 0.5, low, high)


def at(**values):
    return np.array([values.get(name, middle) for name, middle in zip(NAMES, MIDDLE, strict=True)])


@pytest.fixture(scope="module")
def middle():
    return car_mesh(MIDDLE)


# the source


def test_source():
    source = CarSource(count=7, seed=2)
    assert isinstance(source, Source)
    exemplars = source()
    assert [q.name for q in exemplars.space] == list(NAMES) == list(Sizes._fields)
    assert {q.unit for q in exemplars.space} == {"mm", "deg"}
    assert all((q.unit == "deg") == q.name.endswith("_angle") for q in exemplars.space)
    assert len(NAMES) >= 14
    assert set(NAMES) - set(exemplars.measured) == {"front_overhang", "trunk_lid_length"}
    assert exemplars.measured["windscreen_angle"] == "windscreen.angle"
    assert len(exemplars) == 7
    assert ((exemplars.parameters >= LOW) & (exemplars.parameters <= HIGH)).all()
    np.testing.assert_array_equal(exemplars.parameters, CarSource(count=7, seed=2)().parameters)
    assert not np.array_equal(exemplars.parameters, CarSource(count=7, seed=3)().parameters)


def test_what_is_declared_measurable_is_measured():
    exemplars = CarSource(count=1, seed=5)()
    mesh = exemplars.meshes[0]
    found_by = {m: lampopt.measure(m, mesh) for m in {a.split(".")[0] for a in exemplars.measured.values()}}
    for name, address in exemplars.measured.items():
        measure, value = address.split(".")
        found = found_by[measure][value]
        low, high = LOW[NAMES.index(name)], HIGH[NAMES.index(name)]
        assert found == pytest.approx(exemplars.parameters[0, NAMES.index(name)], abs=0.01 * (high - low)), name


def test_each_end_alone():
    assert len(CarSource()()) == 100
    exemplars = CarSource(design="ends")()
    assert len(exemplars) == 33
    assert exemplars.names[0] == "middle"
    changed = exemplars.parameters != exemplars.parameters[0]
    for name, row in zip(exemplars.names[1:], changed[1:], strict=True):
        assert [NAMES[k] for k in np.flatnonzero(row)] == [name.rsplit("_", 1)[0]]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"edge": 5.0}, "edge: expected 15 to 120 mm, got 5"),
        ({"edge": float("nan")}, "edge: .* got nan"),
        ({"design": "ends", "count": 100}, "'ends' has 33 exemplars, got count=100"),
        ({"design": "grid"}, "expected one of .*, got 'grid'"),
    ],
)
def test_options_that_make_no_family(options, message):
    with pytest.raises(InputError, match=f"car: .*{message}"):
        CarSource(**options)


@pytest.mark.parametrize("edge", [True, "36", None, np.nan, 0, -36.0, 14.9, 1e300, 10**400])
def test_edges_that_make_no_mesh(edge):
    """In the source and in the mesh alike, which would be an endless one or none."""
    for refused in (lambda: CarSource(edge=edge), lambda: car_mesh(MIDDLE, edge=edge)):
        with pytest.raises(InputError, match="car: edge: expected 15 to 120 mm, got"):
            refused()


@pytest.mark.parametrize("option", ["count", "seed"])
@pytest.mark.parametrize("value", [True, 2.0, "3", None, -1, 10**19])
def test_draws_that_cannot_be_made(option, value):
    with pytest.raises(InputError, match=f"car: {option}: expected a whole number"):
        CarSource(**{option: value})


# the solid


def test_every_corner_of_the_range_widened_by_three_is_possible():
    """`checked` says which parameters make no car; here it has nothing to say, and nor in between."""
    for parameters in (*corners(3, 1000), *rows(3, 200)):
        checked(parameters)


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_one_closed_body_without_handles(factor):
    """Draws over the whole widened range at once, and its corners."""
    for parameters in (*rows(factor, 3, seed=factor), *corners(factor, 2, seed=factor)):
        mesh = car_mesh(parameters)
        found = topology(mesh)
        assert mesh.is_watertight and mesh.volume > 0
        assert (found.bodies, found.genus) == (1, 0), parameters.tolist()
        assert 20_000 < len(mesh.faces) < 45_000
        assert len(np.unique(mesh.faces)) == len(mesh.vertices)


def test_nothing_crosses_and_triangles_are_even():
    for parameters in (MIDDLE, *corners(3, 1)):
        mesh = car_mesh(parameters)
        assert len(self_intersections(mesh)) == 0
        assert np.degrees(mesh.face_angles.min()) > 5
        assert np.degrees(np.median(mesh.face_angles.min(axis=1))) > 35
        assert mesh.edges_unique_length.max() < 3 * 36


def test_faces_that_a_decoder_is_taught_by(middle):
    assert 30_000 < len(middle.faces) < 40_000
    assert len(car_mesh(MIDDLE, edge=50.0).faces) < 0.6 * len(middle.faces)


def test_the_right_is_the_mirror_image_of_the_left(middle):
    def ordered(points):
        return points[np.lexsort(points.T)]

    np.testing.assert_array_equal(ordered(middle.vertices), ordered(middle.vertices * (1, -1, 1)))


def test_vertices_lie_on_the_surface():
    for parameters in rows(2, 3):
        value, _ = Solid.of(Sizes(*parameters))(car_mesh(parameters).vertices)
        assert np.abs(value).max() < 1e-3  # [mm]


def test_centre_section_in_closed_form():
    """The section's area and outline against lines and arcs; a finer mesh comes nearer, as chords do."""
    errors = []
    for edge in (60.0, 30.0):
        mesh, truth = car_mesh(MIDDLE, edge=edge), derived(MIDDLE)
        section = mesh.section(plane_origin=(0, 0, 0), plane_normal=(0, 1, 0)).to_2D()[0]
        errors.append((1 - section.area / truth["centre_section"], 1 - section.length / truth["centre_outline"]))
    (coarse_area, coarse_length), (area, length) = errors
    assert 0 < area < 4e-4 and 0 < length < 1e-3
    assert area < coarse_area / 2 and length < coarse_length / 2


# the parameters, read off the mesh


def panel(mesh, chosen):
    """Slope to the horizontal [deg] and a point of the plane most of the chosen area lies in."""
    normals, areas = mesh.face_normals[chosen], mesh.area_faces[chosen]
    slopes = np.degrees(np.arctan2(np.hypot(normals[:, 0], normals[:, 1]), np.abs(normals[:, 2])))
    order = np.argsort(slopes)
    middle = order[np.searchsorted(np.cumsum(areas[order]), areas.sum() / 2)]  # by area: flat parts outweigh arcs
    return slopes[middle], mesh.triangles_center[chosen][middle]


def meeting(first, second):
    """Where two planes along y meet: x, z; each given by its slope dz/dx and a point."""
    (a, p), (b, q) = first, second
    x = (q[2] - p[2] + a * p[0] - b * q[0]) / (a - b)
    return x, p[2] + a * (x - p[0])


def circle(points):
    """Centre and radius of the circle through `points` (n, 2), by linear least squares."""
    a, b, c = np.linalg.lstsq(np.column_stack([2 * points, np.ones(len(points))]), (points**2).sum(axis=1))[0]
    return a, b, np.sqrt(c + a**2 + b**2)


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_panels_and_sizes(factor):
    for parameters in (*rows(factor, 2, seed=10 + factor), *corners(factor, 2, seed=10 + factor)):
        s, mesh = Sizes(*parameters), car_mesh(parameters)
        (nx, ny, nz), (x, y, z) = mesh.face_normals.T, mesh.triangles_center.T
        slope = np.degrees(np.arcsin(np.abs(nx)))
        strip = (np.abs(y) < 300) & (np.abs(ny) < 0.01)
        up, down, steep = strip & (nz > 0.1), strip & (nz < -0.1), (slope > 20) & (slope < 60)
        hood, _ = front = panel(mesh, up & (x > 200) & (x < 1150) & (slope < 20))
        screen, _ = front_up = panel(mesh, up & (x < 2400) & (nx < 0) & steep)
        window, _ = rear_up = panel(mesh, up & (x > 2400) & (nx > 0) & steep)
        lid, _ = rear = panel(mesh, up & (x > s.length - s.trunk_lid_length + 80) & (slope < 20))
        ramp, _ = panel(mesh, down & (x < 750) & (slope < 30))
        diffuser, _ = panel(mesh, down & (x > s.length - 850) & (slope < 30))
        glass, _ = panel(mesh, (ny > 0.5) & (z > 1000) & (np.abs(nx) < 0.01))
        under, (_, _, clearance) = panel(mesh, down & (x > 900) & (x < s.length - 1000))
        roof, (_, _, height) = panel(mesh, up & (slope < 0.01) & (z > 1200))
        flank, (_, half, _) = panel(mesh, (ny > 0.999) & (x > 1600) & (x < 2800) & (z > 250) & (z < 700))
        found = {
            "length": np.ptp(mesh.vertices[:, 0]), "width": 2 * half, "roof_height": height,
            "ground_clearance": clearance, "hood_angle": hood, "windscreen_angle": screen, "rear_window_angle": window,
            "trunk_lid_angle": lid, "ramp_angle": ramp, "diffuser_angle": diffuser, "greenhouse_angle": 90 - glass,
        }  # fmt: skip
        for name, value in found.items():
            assert value == pytest.approx(getattr(s, name), abs=1e-4), name
        assert (under, roof, flank) == pytest.approx((0, 0, 90), abs=1e-4)

        def rising(fitted, sense):
            return sense * np.tan(np.radians(fitted[0])), fitted[1]

        assert meeting(rising(front, 1), rising(front_up, 1)) == pytest.approx(COWL, abs=0.1)
        deck, height = meeting(rising(rear, -1), rising(rear_up, -1))
        assert (s.length - deck, height) == pytest.approx((s.trunk_lid_length, DECK), abs=0.1)
        low, high = mesh.bounds
        assert (low[0], low[2], high[2]) == pytest.approx((0, 0, s.roof_height), abs=1e-6)
        assert np.ptp(mesh.vertices[:, 1]) == pytest.approx(derived(parameters)["overall_width"], abs=1e-6)


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_wheels_are_round_and_stand_on_the_ground(factor):
    """Tread and faces of the tyres where they hang free below the body; and, in the arches, their discs."""
    for parameters in (*rows(factor, 2, seed=20 + factor), *corners(factor, 2, seed=20 + factor)):
        s, mesh = Sizes(*parameters), car_mesh(parameters)
        x, y, z = mesh.vertices.T
        inner, outer = (s.track - TYRE) / 2, (s.track + TYRE) / 2
        tread = (y > inner + 30) & (y < outer - 30) & (z > 0.1) & (z < s.ground_clearance - 10)
        front = tread & (x < s.length / 2)
        first, height, radius = circle(np.column_stack([x, z])[front])
        second, _, same = circle(np.column_stack([x, z])[tread & ~front])
        assert (first, second - first) == pytest.approx((s.front_overhang, s.wheelbase), abs=1e-3)
        assert (radius, same) == pytest.approx((s.wheel_radius,) * 2, abs=1e-3)
        assert height == pytest.approx(s.wheel_radius - PATCH, abs=1e-3)
        for centre in (first, second):
            low = (np.hypot(x - centre, z - height) < s.wheel_radius - 30) & (z < s.ground_clearance - 10) & (y > 0)
            faces = np.unique(np.round(y[low & (np.abs(y - s.track / 2) > 100)], 3))
            assert faces == pytest.approx([inner, outer], abs=1e-3)
            disc = (np.hypot(x - centre, z - height) < s.wheel_radius - 30) & (y > outer - 1)
            assert np.ptp(z[disc]) > s.wheel_radius  # the whole of it, in the open arch
        patch = z == z.min()
        assert patch.sum() >= 8
        reach = np.sqrt(s.wheel_radius**2 - (s.wheel_radius - PATCH) ** 2)
        ahead = np.minimum(np.abs(x - first), np.abs(x - second))
        assert ahead[np.abs(z) < 1e-6].max() == pytest.approx(reach, abs=30)


def test_a_slice_through_the_wheels_shows_circles_in_open_arches():
    s = Sizes(*MIDDLE)
    section = car_mesh(MIDDLE).section(plane_origin=(0, (s.track + TYRE) / 2 - 45, 0), plane_normal=(0, 1, 0))
    discs = [shapely.Polygon(points[:, [0, 2]]) for points in section.discrete]
    assert len(discs) == 3  # the body and, free of it, two wheels
    for disc in sorted(discs, key=lambda polygon: polygon.area)[:2]:
        flat = s.wheel_radius**2 * np.arccos(1 - PATCH / s.wheel_radius) - (s.wheel_radius - PATCH) * np.sqrt(
            s.wheel_radius**2 - (s.wheel_radius - PATCH) ** 2
        )
        assert disc.area == pytest.approx(np.pi * s.wheel_radius**2 - flat, rel=5e-3)


# what makes no car


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"length": 3450}, r"length, windscreen_angle, rear_window_angle, .*: no room for the roof"),
        ({"hood_angle": 25}, "hood_angle: no room for the slope of the nose"),
        ({"ramp_angle": 25}, "ramp_angle and ground_clearance: no room for the upright nose"),
        ({"diffuser_angle": 30}, "diffuser_angle and ground_clearance: no room for the upright tail"),
        ({"ramp_angle": -15}, "ramp_angle and ground_clearance: the ramp reaches into the ground"),
        ({"diffuser_angle": -15}, "diffuser_angle and ground_clearance: the diffuser reaches into the ground"),
        ({"trunk_lid_length": 150}, "trunk_lid_length and trunk_lid_angle: no room for the trunk lid"),
        ({"windscreen_angle": 5}, "windscreen_angle: expected 15 to 85 deg, got 5 deg"),
        ({"greenhouse_angle": 50, "width": 1500}, "greenhouse_angle, width, roof_height: no room for the roof across"),
        ({"track": 2200}, "track and width: the tyres stand beside the body"),
        ({"wheelbase": 3700}, "wheelbase, length, wheel_radius: the rear tyres stand out beyond the tail"),
        ({"wheelbase": 1000, "wheel_radius": 420}, "wheelbase and wheel_radius: front and rear arches meet"),
        ({"wheel_radius": 200, "ground_clearance": 250}, "ground_clearance: the tyres hang below the body"),
        ({"front_overhang": 250}, "front_overhang and wheel_radius: the front tyres stand out beyond the nose"),
        ({"track": np.nan}, "expected finite parameters, got track is nan"),
    ],
)
def test_parameters_that_make_no_car(values, message):
    with pytest.raises(InputError, match=f"car: .*{message}"):
        car_mesh(at(**values))


def test_the_wrong_number_of_parameters():
    with pytest.raises(InputError, match=r"car: expected 16 parameters.*length, .* got shape \(15,\)"):
        car_mesh(MIDDLE[:15])


# what it is made of

POLYGON = ((0.0, 0.0), (5.0, -1.0), (9.0, 0.0), (9.0, 4.0), (6.0, 4.0), (5.0, 2.0), (1.0, 3.0))  # hollow at (5, 2)
TANGENTS = (0.8, 1.2, 0.6, 1.0, 0.5, 0.9, 0.4)


def drawn(outline, per_arc=400):
    """The outline as a fine polygon."""
    points = []
    following = np.roll(outline.start, -1, axis=0)
    for a, way, length, c, r, d in zip(
        outline.start, outline.way, outline.length, outline.centre, outline.radius, following, strict=True
    ):
        b = a + length * way
        turned = np.linspace(np.arctan2(*(b - c)[::-1]), np.arctan2(*(d - c)[::-1]) + 0.0, 2)
        turned[1] = turned[0] + (turned[1] - turned[0] + np.pi) % (2 * np.pi) - np.pi
        sweep = np.linspace(*turned, per_arc)
        points += [a[None], c + np.abs(r) * np.column_stack([np.cos(sweep), np.sin(sweep)])]
    return shapely.Polygon(np.concatenate(points))


def test_outline_against_a_fine_polygon():
    outline = Outline.of(POLYGON, TANGENTS)
    polygon = drawn(outline)
    assert polygon.is_valid
    assert outline.area == pytest.approx(polygon.area, rel=1e-5)
    assert outline.perimeter == pytest.approx(polygon.length, rel=1e-5)
    u, v = np.random.default_rng(0).uniform((-2, -3), (11, 6), (600, 2)).T
    value, _ = outline.distance(u, v)
    points = shapely.points(u, v)
    truth = shapely.distance(polygon.exterior, points) * np.where(shapely.contains(polygon, points), -1, 1)
    np.testing.assert_allclose(value, truth, atol=1e-5)


def test_outline_without_rounding_is_the_polygon():
    square = Outline.of(((0.0, 0.0), (2.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0)), (0, 1, 0, 0, 0))
    assert square.area == pytest.approx(12) and square.perimeter == pytest.approx(14)
    assert square.distance(np.array([2.0, -1.0]), np.array([1.0, 1.5]))[0] == pytest.approx([-1, 1])


def test_room_between_corners():
    assert (Outline.of(((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)), (0.6, 0.6, 0.1, 0.1)).length < 0).sum() == 1


def test_edges_between_planes_are_quarter_circles():
    x, y = np.random.default_rng(1).uniform(-3, 1, (2, 200))
    value, (gx, gy, _) = common(1.0, (x, (1.0, 0.0, 0.0)), (y, (0.0, 1.0, 0.0)))
    corner = (x > -1) & (y > -1)
    np.testing.assert_allclose(value[corner], np.hypot(x + 1, y + 1)[corner] - 1)
    np.testing.assert_allclose(value[~corner], np.maximum(x, y)[~corner])
    np.testing.assert_allclose(np.hypot(gx, gy), 1)


def test_joined_and_outside():
    x = np.array([-2.0, 0.5, 3.0])
    first, second = (x, (1.0, 0.0, 0.0)), (1 - x, (-1.0, 0.0, 0.0))
    value, (gx, *_) = joined(first, second)
    np.testing.assert_array_equal(value, np.minimum(x, 1 - x))
    np.testing.assert_array_equal(gx, [1, -1, -1])
    np.testing.assert_array_equal(outside(first)[0], -x)


def test_gradient_of_the_solid_against_differences(middle):
    solid = Solid.of(Sizes(*MIDDLE))
    noise = np.random.default_rng(2)
    points = middle.vertices[::40] + noise.uniform(-20, 20, (len(middle.vertices[::40]), 3))
    value, gradient = solid(points)
    step = 1e-3
    sloped = np.stack([(solid(points + e)[0] - solid(points - e)[0]) / (2 * step) for e in step * np.eye(3)], axis=1)
    apart = np.abs(sloped - gradient).max(axis=1)
    assert np.median(apart) < 1e-6
    assert (apart < 1e-4).mean() > 0.99  # the others sit on a crease
    assert (np.abs(value) < 50).all()


def test_the_side_view_has_no_kink():
    """Arcs end where the next straight edge begins, for panels of any slope."""
    for parameters in rows(3, 20):
        side = side_view(Sizes(*parameters))
        end = side.start + side.length[:, None] * side.way
        assert (side.length > 0).all()
        for points in (end, np.roll(side.start, -1, axis=0)):
            assert np.linalg.norm(points - side.centre, axis=1) == pytest.approx(np.abs(side.radius), rel=1e-9)


def test_the_kit():
    check_source(CarSource(count=2, edge=100.0))
