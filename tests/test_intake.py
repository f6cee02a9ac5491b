"""Intake of one mesh: what is counted, what is repaired and what is not, and what is still a usable field."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

import lampopt
from lampopt.errors import InputError
from lampopt.intake.repair import repaired
from lampopt.testing import shapes
from lampopt.topology import Topology, topology
from lampopt.types import Exemplars, Parameter

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402


def mesh(vertices, faces):
    return trimesh.Trimesh(vertices, faces, process=False)


def both(*meshes):
    return trimesh.util.concatenate(meshes)


def turned(solid):
    return mesh(solid.vertices, solid.faces[:, ::-1])


def ball(divisions=3):
    return trimesh.creation.icosphere(subdivisions=divisions)


def without(solid, *dropped):
    return mesh(solid.vertices, np.delete(solid.faces, dropped, axis=0))


def moebius():
    angle = np.linspace(0, 2 * np.pi, 30, endpoint=False)
    rows = []
    for side in (-0.3, 0.3):
        r = 1 + side * np.cos(angle / 2)
        rows.append(np.stack([r * np.cos(angle), r * np.sin(angle), side * np.sin(angle / 2)], 1))
    faces = []
    for i in range(30):
        j = (i + 1) % 30
        a, b, c, d = i, j, 30 + j, 30 + i
        if j == 0:
            b, c = c, b
        faces += [[a, b, c], [a, c, d]]
    return mesh(np.concatenate(rows), faces)


def family(*meshes, unit="m"):
    names = tuple(f"mesh_{i}" for i in range(len(meshes)))
    parameters = np.arange(float(len(meshes)))[:, None]
    return Exemplars(parameters, (Parameter("x"),), meshes, names, unit=unit)


def looked_at(solid, **options):
    """The health of one mesh and its findings by kind."""
    report = lampopt.intake(family(solid), **options)
    return report.health[0], {finding.kind: finding for finding in report.findings}


# what is counted


def test_a_sound_solid_has_nothing_to_be_said_of():
    health, findings = looked_at(shapes.plate_with_hole())
    assert not findings
    assert (health.closed, health.bodies, health.genus, health.crossings, health.unseen) == (True, 1, 1, 0, 0)
    assert health.open_edges == health.holes == health.crowded_edges == health.opposed_edges == health.inward == 0
    assert health.degenerate == health.duplicates == health.unreferenced == 0
    assert health.extents == pytest.approx((1.0, 0.6, 0.1))
    assert health.centre == pytest.approx((0, 0, 0))
    assert health.repairs == ()


def test_an_open_box_has_one_opening_as_wide_as_its_lid():
    solid = shapes.box((2, 1, 1), divisions=0)
    lid = np.flatnonzero((solid.triangles[:, :, 2] == 0.5).all(1))
    health, findings = looked_at(without(solid, *lid))
    assert (health.closed, health.genus, health.open_edges, health.holes) == (False, None, 4, 1)
    assert set(findings) == {"open"}
    assert findings["open"].severity == "note"
    assert f"an opening {np.sqrt(5):.3g} m wide (4 edges with one face)" in findings["open"].message


def test_crossings_are_counted_and_are_no_problem():
    crossing = both(shapes.box((1, 1, 1)), shapes.box((1, 1, 1), centre=(0.3, 0.2, 0.4)))
    health, findings = looked_at(crossing)
    assert health.crossings > 10
    assert findings["crossing"].severity == "note"
    assert looked_at(crossing, crossings=False)[0].crossings is None


def test_leftovers_are_counted():
    solid = shapes.box()
    spare = mesh(np.vstack([solid.vertices, [[0, 0, 0]]]), np.vstack([solid.faces, solid.faces[:2, [1, 2, 0]]]))
    health, findings = looked_at(spare, repair=False)
    assert (health.duplicates, health.unreferenced) == (2, 1)
    assert "2 faces given twice, 1 vertex without a face" in findings["leftovers"].message
    health, findings = looked_at(spare)
    assert (health.duplicates, health.closed) == (0, True)


def test_a_moebius_strip_is_told_and_left():
    health, findings = looked_at(moebius())
    assert health.opposed_edges > 0
    assert health.repairs == ()
    assert "one side only" in findings["open"].message


# repairs


@pytest.mark.parametrize(
    "make", [shapes.box, shapes.plate_with_hole, ball, lambda: both(ball(), turned(ball()).apply_scale(0.5))]
)
def test_what_needs_no_repair_is_left_untouched(make):
    solid = make()
    before = np.array(solid.vertices), np.array(solid.faces)
    mended, words = repaired(solid)
    assert mended is solid
    assert words == ()
    assert np.array_equal(before[0], mended.vertices)
    assert np.array_equal(before[1], mended.faces)


def test_faces_turned_against_their_neighbours_are_turned_back():
    solid = shapes.plate_with_hole()
    faces = np.array(solid.faces)
    chosen = np.random.default_rng(0).choice(len(faces), 40, replace=False)
    faces[chosen] = faces[chosen][:, ::-1]
    mended, words = repaired(mesh(solid.vertices, faces))
    assert words == ("turned 40 faces to agree with the neighbours",)
    assert topology(mended) == Topology(True, 1, 1)
    assert mended.volume == pytest.approx(solid.volume)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.booleans(), min_size=80, max_size=80))
def test_whatever_faces_are_turned_the_solid_comes_back(turn):
    solid = ball(1)
    faces = np.where(np.array(turn)[:, None], solid.faces[:, ::-1], solid.faces)
    mended, _ = repaired(mesh(solid.vertices, faces))
    assert mended.is_watertight
    assert mended.volume == pytest.approx(solid.volume)
    assert np.array_equal(mended.vertices, solid.vertices)


def test_a_solid_turned_inside_out_is_turned_outward():
    mended, words = repaired(turned(ball()))
    assert words == ("turned all faces outward",)
    assert mended.volume == pytest.approx(ball().volume)


def test_the_one_body_that_faces_inward_is_turned():
    mended, words = repaired(both(ball(2), turned(ball(2)).apply_translation([4, 0, 0])))
    assert words == ("turned 320 faces of 1 part outward",)
    assert mended.volume == pytest.approx(2 * ball(2).volume)


def test_a_cavity_stays_a_cavity():
    shell = both(ball(), turned(ball()).apply_scale(0.5))
    mended, words = repaired(turned(shell))
    assert words == ("turned all faces outward",)
    assert mended.volume == pytest.approx(shell.volume)
    assert mended.volume == pytest.approx(ball().volume * (1 - 0.5**3))


def test_an_open_box_that_faces_inward_is_turned():
    solid = shapes.box((2, 1, 1))
    lid = np.flatnonzero((solid.triangles[:, :, 2] == 0.5).all(1))
    open_box = without(solid, *lid)
    mended, words = repaired(turned(open_box))
    assert words == ("turned all faces outward",)
    assert np.array_equal(mended.face_normals, open_box.face_normals)


def test_faces_without_area_and_faces_given_twice_are_dropped():
    solid = shapes.box()
    faces = np.vstack([solid.faces, solid.faces[:3], [[0, 0, 1], [2, 2, 2]]])
    mended, words = repaired(mesh(solid.vertices, faces))
    assert words == ("dropped 2 faces without area", "dropped 3 faces given twice")
    assert np.array_equal(mended.faces, solid.faces)


def test_a_face_without_area_that_closes_the_surface_stays():
    solid = shapes.box((1, 1, 1), divisions=0)
    vertices = np.vstack([solid.vertices, solid.vertices[solid.faces[0][:2]].mean(0)])
    a, b, c = solid.faces[0]
    middle = len(vertices) - 1
    # one side of an edge is split at its middle, the other is not: a flat face holds them together
    faces = np.vstack([solid.faces[1:], [[a, middle, c], [middle, b, c], [a, b, middle]]])
    split = mesh(vertices, faces)
    assert topology(split).closed
    mended, words = repaired(split)
    assert mended is split
    assert words == ()
    assert looked_at(split)[0].degenerate == 1


def test_a_surface_drawn_from_both_sides_is_drawn_once():
    solid = ball()
    mended, words = repaired(mesh(solid.vertices, np.vstack([solid.faces, solid.faces[:, ::-1]])))
    assert words == (f"dropped {len(solid.faces)} faces drawn from behind as well",)
    assert mended.is_watertight
    assert mended.volume == pytest.approx(solid.volume)


def test_small_holes_are_closed_with_the_vertices_that_are_there():
    solid = ball(5)
    fan = np.flatnonzero((solid.faces == 20).any(1))
    assert len(fan) == 6
    mended, words = repaired(without(solid, 0, *fan))
    assert words == ("closed 2 small holes of up to 6 edges",)
    assert topology(mended) == Topology(True, 1, 0)
    assert np.array_equal(mended.vertices, solid.vertices)
    assert len(mended.faces) == len(solid.faces) - 2  # a hexagon has four triangles where the fan had six
    assert mended.volume == pytest.approx(solid.volume, rel=1e-4)


def test_large_openings_stay_open():
    solid = ball(3)
    cap = np.flatnonzero(solid.triangles_center[:, 2] > 0.8)
    one = without(solid, *cap)
    assert repaired(one)[0] is one
    coarse = without(shapes.box(divisions=0), 0)
    assert repaired(coarse)[0] is coarse


def test_the_rim_of_a_loose_patch_is_no_hole():
    patch = mesh(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * 0.01 + 2, [[0, 1, 2], [0, 2, 3]])
    solid = both(ball(2), patch)
    assert repaired(solid)[0] is solid


def test_repairs_are_listed_and_can_be_left():
    faces = np.array(ball(5).faces)
    faces[7] = faces[7][::-1]
    broken = without(mesh(ball(5).vertices, faces), 100)
    health, findings = looked_at(broken)
    listed = ("turned 1 face to agree with the neighbours", "closed a small hole of 3 edges")
    assert health.repairs == listed
    assert health.closed
    assert findings["repaired"].message == f"repaired: {'; '.join(listed)}"
    health, findings = looked_at(broken, repair=False)
    assert (health.closed, health.holes, health.opposed_edges, health.repairs) == (False, 1, 3, ())
    assert set(findings) == {"open"}


def test_repaired_meshes_come_on_access_and_the_others_as_they_are():
    given = family(ball(2), turned(ball(2)), ball(1))
    report = lampopt.intake(given)
    assert report.exemplars.meshes[0] is given.meshes[0]
    assert report.exemplars.meshes[-1] is given.meshes[2]
    assert report.exemplars.meshes[1].volume > 0
    assert [m.volume > 0 for m in report.exemplars.meshes[1:]] == [True, True]
    assert [m.volume > 0 for m in report.exemplars.meshes] == [True] * 3
    assert report.exemplars.names == given.names
    sound = family(ball(2), ball(1))
    assert lampopt.intake(sound).exemplars is sound


def test_a_bank_is_fitted_to_the_repaired_meshes():
    plain, given = small.boxes(), small.boxes()
    meshes = [*given.meshes]
    meshes[2] = turned(meshes[2])
    bank = small.bank(small.boxes(meshes=meshes))
    assert np.array_equal(bank.weights, small.bank(plain).weights)
    assert bank.mesh_facts == {"bodies": 1, "genus": 0}


# a usable field


def signs(solid, inside, count=20_000):
    """The share of points that the decoder's samples put on the right side."""
    from lampopt_sdf.samples import draw

    points, distances, _ = draw(solid, count, np.random.SeedSequence(0))
    return ((distances < 0) == inside(points)).mean()


def in_box(size, centre=(0, 0, 0)):
    return lambda points: (np.abs(points - centre) < np.array(size) / 2).all(1)


def test_an_open_box_has_a_usable_field():
    solid = shapes.box((1.0, 0.8, 0.6))
    lid = np.flatnonzero((solid.triangles[:, :, 2] == 0.3).all(1))
    assert signs(without(solid, *lid), in_box((1.0, 0.8, 0.6))) > 0.94  # the lid bulges in by what a soap film would
    hole = without(solid, 0, 1)
    assert signs(hole, in_box((1.0, 0.8, 0.6))) > 0.98
    assert not [f for f in looked_at(without(solid, *lid))[1].values() if f.severity != "note"]


def test_boxes_that_cross_have_the_field_of_their_union():
    size, centre = (0.8, 0.8, 0.8), (0.3, 0.2, 0.25)
    one, other = in_box(size), in_box(size, centre)
    crossing = both(shapes.box(size), shapes.box(size, centre=centre))
    assert signs(crossing, lambda points: one(points) | other(points)) == 1.0


def test_a_box_turned_inward_has_its_field_after_repair():
    size = (1.0, 0.8, 0.6)
    assert signs(repaired(turned(shapes.box(size)))[0], in_box(size)) == 1.0


def soup(solid, seed=0):
    """The triangles of a solid, each for itself, turned anyhow."""
    vertices = np.asarray(solid.triangles).reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 3)
    turn = np.random.default_rng(seed).random(len(faces)) < 0.5
    return mesh(vertices, np.where(turn[:, None], faces[:, ::-1], faces))


def test_a_soup_without_a_usable_field_is_doubtful_and_the_command_is_told():
    health, findings = looked_at(soup(shapes.box((1, 0.8, 0.6))), repair=False)
    assert health.unseen > 0.25
    assert findings["soup"].severity == "doubtful"
    assert "wrap it: lampopt.wrap(mesh, gap=0.017)" in findings["soup"].message


def test_what_encloses_nothing_is_doubtful():
    health, findings = looked_at(mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]))
    assert health.unseen == 1
    assert findings["hollow"].severity == "doubtful"
    assert "encloses" in findings["hollow"].message
    health, findings = looked_at(turned(ball()), repair=False)
    assert findings["hollow"].severity == "doubtful"


def test_a_body_that_faces_inward_is_doubtful_where_it_may_not_be_repaired():
    pair = both(ball(2), turned(ball(2)).apply_scale(0.3).apply_translation([4, 0, 0]))
    health, findings = looked_at(pair, repair=False)
    assert health.inward == 1
    assert findings["inward"].severity == "doubtful"
    assert not looked_at(pair)[0].inward


# what cannot be used


class Broken:
    """Meshes of which some cannot be loaded."""

    def __len__(self):
        return 6

    def __getitem__(self, index):
        odd = {1: InputError("mesh b.stl: cannot be read: nonsense"), 2: "c.stl", 3: trimesh.Trimesh()}
        odd[5] = ZeroDivisionError("by width")
        if isinstance(odd.get(index), Exception):
            raise odd[index]
        return odd.get(index, shapes.box())


def test_all_that_cannot_be_used_is_refused_in_one_message():
    given = Exemplars(np.zeros((6, 1)), (Parameter("x"),), Broken(), tuple("abcdef"))
    report = lampopt.intake(given)
    assert [(f.exemplar, f.severity) for f in report.problems] == [(name, "refused") for name in "bcdf"]
    assert [h.name for h in report.health] == ["a", "e"]
    assert report.exemplars.names == ("a", "e")
    with pytest.raises(InputError) as caught:
        small.bank(given)
    message = str(caught.value)
    assert message.startswith("4 exemplars of 6 cannot be used:\n")
    for part in (
        "'b': mesh b.stl: cannot be read: nonsense",
        "'c': expected a trimesh.Trimesh",
        "'d': expected a mesh",
        "'f': cannot be loaded: ZeroDivisionError('by width')",
    ):
        assert part in message
    assert "'a'" not in message
    with pytest.raises(InputError, match="cannot be used"):
        lampopt.intake(given, accept="all").refuse()


def test_nothing_usable_is_said_when_it_is_asked_for():
    report = lampopt.intake(family(trimesh.Trimesh()))
    assert report.health == ()
    with pytest.raises(InputError, match="1 exemplar of 1 cannot be used"):
        _ = report.exemplars


def test_accept_takes_names_that_there_are():
    with pytest.raises(
        InputError, match="accept: expected names of exemplars or 'all', got 'box_9'; names are 'box_0'"
    ):
        small.bank(accept=("box_9",))


def test_doubts_are_settled_by_name_or_for_all():
    sheet = mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    given = family(shapes.box(), sheet)
    assert [f.exemplar for f in lampopt.intake(given).problems] == ["mesh_1"]
    for accept in (("mesh_1",), "mesh_1", "all", ["mesh_0", "mesh_1"]):
        assert not lampopt.intake(given, accept=accept).problems
    assert lampopt.intake(given, accept=("mesh_0",)).problems
    with pytest.raises(InputError, match=r"accept=\('mesh_1',\) or --accept mesh_1"):
        lampopt.intake(given).refuse()


def test_progress_rises_from_0_to_1():
    told = []
    lampopt.intake(family(shapes.box(), shapes.box()), progress=lambda done, message="": told.append((done, message)))
    assert told == [(0.0, "looking at mesh_0"), (0.5, "looking at mesh_1"), (1.0, "looked at all")]


@pytest.mark.parametrize("scale", [1e-100, 1e-30, 1e30, 1e99])
def test_a_mesh_of_any_size_is_looked_at(scale):
    solids = [
        both(ball(2), shapes.box(centre=(0.8, 0, 0)), turned(shapes.box()).apply_translation([3, 0, 0]))
        for _ in range(4)
    ]
    solids[1].vertices[:, 0] *= -1  # inside out, and the other way round
    report = lampopt.intake(family(*(s.apply_scale(scale) for s in solids)))
    assert [h.genus for h in report.health] == [0] * 4
    assert report.health[0].repairs == ("turned 192 faces of 1 part outward",)
    assert report.health[1].repairs == ("turned 512 faces of 2 parts outward",)
    assert report.health[0].crossings > 0
    assert [f.kind for f in report.problems] == ["facing"]
    assert lampopt.wrap(solids[0], gap=0.2 * scale).is_watertight


@pytest.mark.parametrize(
    "vertices",
    [np.zeros((3, 3)), [[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[5, 5, 5], [5, 5, 5], [5, 5, 6]]],
    ids=["point", "line", "needle"],
)
def test_a_mesh_without_area_encloses_nothing(vertices):
    health, findings = looked_at(mesh(vertices, [[0, 1, 2]]))
    assert (health.degenerate, health.unseen) == (1, 1)
    assert findings["hollow"].severity == "doubtful"
    assert not lampopt.intake(family(*[mesh(vertices, [[0, 1, 2]])] * 5), accept="all").problems


@pytest.mark.parametrize("options", [{"exemplars": 3}, {"accept": 3}, {"accept": [3]}])
def test_arguments_are_checked(options):
    with pytest.raises(InputError, match="expected"):
        lampopt.intake(**{"exemplars": family(shapes.box()), **options})


def test_every_kind_of_finding_is_documented():
    source = "".join(path.read_text(encoding="utf-8") for path in (HERE.parent / "lampopt" / "intake").glob("*.py"))
    kinds = set(re.findall(r'(?:found\(|Finding\([^"]*?)\s*"([a-z ]+)"', source)) - {
        "doubtful"
    }  # where the kind is no literal: bodies, genus
    assert {"unreadable", "size", "place", "facing", "soup", "hollow", "open", "same mesh"} <= kinds
    page = (HERE.parent / "docs" / "intake.md").read_text(encoding="utf-8")
    documented = {
        kind.strip()
        for row in re.findall(r"^\| ([a-z, ]+) \| (?:refused|doubtful|note)", page, re.M)
        for kind in row.split(",")
    }
    assert kinds | {"bodies", "genus"} == documented


def test_what_is_mended_of_the_exemplars_is_mended_of_the_mean():
    """A source whose every shape lacks a face: its mean, the template's, does too."""

    def at(row):
        return without(ball(4).apply_scale(row[0]), 7)

    sizes = np.array([[1.0], [1.2], [1.4]])
    given = Exemplars(sizes, (Parameter("size", "m"),), [at(row) for row in sizes], ("a", "b", "c"), mesh_at=at)
    report = lampopt.intake(given)
    assert not report.problems and not at([1.1]).is_watertight
    assert report.exemplars.mesh_at([1.1]).is_watertight
