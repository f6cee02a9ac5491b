"""Meshes held against each other: what is odd is named, families as they are meant to be pass without a doubt."""

import csv
import importlib.util
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import manifold3d
import numpy as np
import pytest
import trimesh

import lampopt
from lampopt.errors import InputError
from lampopt.intake.facing import _poses
from lampopt.meshfile import load_mesh
from lampopt.testing import shapes
from lampopt.types import Exemplars, Parameter

HERE = Path(__file__).parent
SHARED = HERE.parent.parent / "shared"
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402

HALF, QUARTER = np.diag([-1.0, -1, 1, 1]), trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1])


def car(length=4.4, roof=1.4, hood=1.1, *, hole=False):
    """A small car: a side view with hood and boot of different heights, 1.8 m across, x along it, z up [m]."""
    side = [(0, 0.2), (1, 0.2), (1, 0.75), (0.93, 0.9), (0.75, roof), (0.4, roof), (hood / length, 0.85), (0, 0.6)]
    body = manifold3d.CrossSection([[(length * x, z) for x, z in side]]).extrude(1.8).rotate((90, 0, 0))
    if hole:
        body -= manifold3d.Manifold.cylinder(4, 0.2, circular_segments=16).translate((length / 2, -0.9, -1))
    made = body.to_mesh()
    solid = trimesh.Trimesh(made.vert_properties[:, :3], made.tri_verts, process=False)
    solid.apply_translation([-length / 2, 0.9, 0])
    assert solid.is_watertight
    return solid.subdivide().subdivide()


SIZES = [(4.4, 1.4, 1.1), (4.2, 1.35, 1.0), (4.6, 1.45, 1.2), (4.5, 1.5, 1.3), (4.0, 1.4, 0.9), (4.3, 1.3, 1.1)]
SIZES += [(4.7, 1.4, 1.0), (4.4, 1.5, 1.2)]


def cars():
    return [car(*size) for size in SIZES]


def family(meshes, unit="m"):
    names = tuple(f"mesh_{i}" for i in range(len(meshes)))
    return Exemplars(np.arange(float(len(meshes)))[:, None], (Parameter("x"),), meshes, names, unit=unit)


def odd(meshes, unit="m", **options):
    """(name's number, kind, severity) of what stands in the way."""
    report = lampopt.intake(family(meshes, unit), crossings=False, **options)
    return [(int(f.exemplar.rpartition("_")[2]), f.kind, f.severity) for f in report.problems]


def moved(meshes, index, transform):
    return [m.copy().apply_transform(transform) if i == index else m for i, m in enumerate(meshes)]


# the acceptance: a table with four faults


@pytest.fixture
def faulty(tmp_path):
    meshes = cars()
    meshes[1].apply_scale(1000)
    meshes[3].apply_transform(HALF)
    meshes[6] = car(*SIZES[6], hole=True)
    rows = [["mesh", "length [m]", "roof [m]", "hood [m]"]]
    for i, (solid, size) in enumerate(zip(meshes, SIZES, strict=True)):
        name = tmp_path / f"car_{i}.stl"
        solid.export(name)
        if i == 4:
            name.write_text("solid car_4\nendsolid car_4\n")
        rows.append([name.name, *size])
    with open(tmp_path / "cars.csv", "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows(rows)
    return lampopt.exemplars("table", table=tmp_path / "cars.csv")


def test_four_faults_in_a_table_are_all_named_in_one_message(faulty):
    with pytest.raises(InputError) as caught:
        small.bank(faulty)
    lines = str(caught.value).splitlines()
    told = {name: [line for line in lines if line.startswith(f"  exemplar '{name}'")] for name in faulty.names}
    assert {name for name, said in told.items() if said} == {"car_1", "car_3", "car_4", "car_6"}
    (size,), (facing,), (empty,), (genus,) = (told[name] for name in ("car_1", "car_3", "car_4", "car_6"))
    assert "as a file in mm among files in m; scale it by 0.001" in size
    assert "turned by 180° about z" in facing
    assert "car_4.stl" in empty
    assert "expected genus 0, as 6 of 7 have, got 1" in genus
    assert lines[0] == "2 exemplars of 8 cannot be used:"
    assert "2 exemplars of 8 are in doubt:" in lines


def test_accepting_settles_doubts_and_only_those(faulty):
    with pytest.raises(InputError) as caught:
        small.bank(faulty, accept=("car_3", "car_6"))
    assert "in doubt" not in str(caught.value)
    assert [f.exemplar for f in lampopt.intake(faulty, accept="all").problems] == ["car_1", "car_4"]
    looked_at = lampopt.intake(faulty, accept=("car_1", "car_3", "car_6"))  # a size by name, too
    assert [f.exemplar for f in looked_at.problems] == ["car_4"]


def test_what_is_left_makes_a_bank(faulty):
    left = lampopt.intake(faulty).exemplars
    assert left.names == ("car_0", "car_2", "car_5", "car_7")
    assert left.parameters.tolist() == [list(SIZES[i]) for i in (0, 2, 5, 7)]
    assert small.bank(left).names == left.names


# size


@pytest.mark.parametrize(
    ("unit", "factor", "guess"),
    [
        ("m", 1000, "mm"),
        ("m", 100, "cm"),
        ("m", 39.37, "in"),
        ("mm", 0.001, "m"),
        ("mm", 0.1, "cm"),
        ("mm", 1 / 25.4, "in"),
    ],
)
def test_a_file_in_another_unit_is_named_with_its_unit(unit, factor, guess):
    scale = 1000 if unit == "mm" else 1
    meshes = [m.apply_scale(scale) for m in cars()]
    meshes[2].apply_scale(factor)
    assert odd(meshes, unit) == [(2, "size", "refused")]
    (found,) = lampopt.intake(family(meshes, unit), crossings=False).problems
    assert f"as a file in {guess} among files in {unit}; scale it by {1 / factor:.4g}" in found.message


def test_a_size_that_no_unit_explains_is_doubtful_or_refused():
    meshes = cars()
    meshes[5].apply_scale(8)
    assert odd(meshes) == [(5, "size", "doubtful")]
    meshes[5].apply_scale(25)
    assert odd(meshes) == [(5, "size", "refused")]


def test_of_two_files_in_different_units_both_are_named():
    assert odd([car(), car().apply_scale(1000)]) == [(0, "size", "refused"), (1, "size", "refused")]
    assert odd([car(), car(), car().apply_scale(1000)]) == [(2, "size", "refused")]


@pytest.mark.parametrize("factor", [10, 25.4, 39.37, 100, 304.8, 1000])
@pytest.mark.parametrize("which", [slice(0, None, 2), slice(4, None)])
def test_of_a_table_half_in_another_unit_all_are_named(factor, which):
    """No median tells which half is right: nobody can."""
    meshes = cars()
    for solid in meshes[which]:
        solid.apply_scale(factor)
    assert odd(meshes) == [(i, "size", "refused") for i in range(8)]
    found = lampopt.intake(family(meshes), crossings=False)
    assert "which are right cannot be known" in found.problems[0].message
    assert "diagonals are 4 near 4." in found.problems[0].message
    named = [f"mesh_{i}" for i in range(8)]
    assert not lampopt.intake(family(meshes), crossings=False, accept=named).problems
    meshes[which][0].apply_scale(1 / factor)  # five against three: those are told
    assert sorted(i for i, *_ in odd(meshes)) == list(range(8)[which])[1:]


def test_a_table_in_three_units_is_refused_as_a_whole():
    meshes = cars() + cars()[:1]
    for i, solid in enumerate(meshes):
        solid.apply_scale([1, 100, 1000][i % 3])
    assert odd(meshes) == [(i, "size", "refused") for i in range(9)]
    assert (
        "as files in different units have" in lampopt.intake(family(meshes, "ell"), crossings=False).problems[0].message
    )


@pytest.mark.parametrize("power", [1, 3])
def test_two_sizes_that_a_parameter_tells_apart_pass(power):
    """Small cars and large ones, ten times as large: the parameter is their scale, or their volume."""
    scales = np.repeat([1.0, 10.0], 4)
    meshes = [solid.apply_scale(scale) for solid, scale in zip(cars(), scales, strict=True)]
    assert odd(meshes) == [(i, "size", "refused") for i in range(8)]
    meant = replace(family(meshes), parameters=2.5 * scales[:, None] ** power)
    assert not [f for f in lampopt.intake(meant, crossings=False).problems if f.kind == "size"]


@pytest.mark.parametrize("seed", range(8))
def test_sizes_drawn_from_two_decades_pass(seed):
    radii = 10 ** np.random.default_rng(seed).uniform(-1, 1, 8)
    assert not odd([shapes.ellipsoid([r, r, r]) for r in radii])


# place, facing


def test_a_mesh_far_off_is_doubtful():
    assert odd(moved(cars(), 4, trimesh.transformations.translation_matrix([30, 0, 0]))) == [(4, "place", "doubtful")]


def test_a_family_may_have_places():
    solid = car()
    assert not odd([solid.copy().apply_translation([9 * x, 0, 0]) for x in np.linspace(0, 1, 9)])


@pytest.mark.parametrize(("name", "turn"), _poses(), ids=[name for name, _ in _poses()])
def test_a_car_turned_any_way_is_doubtful_and_how_to_turn_it_back_is_told(name, turn):
    back = np.eye(4)
    back[:3, :3] = turn.T
    meshes = moved(cars(), 3, back)
    (found,) = lampopt.intake(family(meshes), crossings=False).problems
    assert (found.exemplar, found.kind, found.severity) == ("mesh_3", "facing", "doubtful")
    assert f"when turned by {name}" in found.message


def test_several_turned_cars_are_each_named():
    meshes = moved(moved(cars(), 1, HALF), 6, QUARTER)
    assert odd(meshes) == [(1, "facing", "doubtful"), (6, "facing", "doubtful")]


def wings(sweeps, tapers):
    """Flat wings, 1 m at the root and 3 m long; swept forward where the sweep is negative [m]."""
    meshes = []
    for sweep, taper in zip(sweeps, tapers, strict=True):
        outline = manifold3d.CrossSection([[(0, 0), (1, 0), (sweep + taper, 3), (sweep, 3)]])
        made = outline.extrude(0.1).to_mesh()
        meshes.append(trimesh.Trimesh(made.vert_properties[:, :3], made.tri_verts, process=False))
    space = (Parameter("sweep", "m"), Parameter("taper"))
    names = tuple(f"wing_{i}" for i in range(len(meshes)))
    return Exemplars(np.column_stack([sweeps, tapers]), space, meshes, names)


def test_what_a_parameter_explains_is_only_noted():
    """Wings swept forward look like turned ones, and are not: they are those with the least sweep."""
    rng = np.random.default_rng(0)
    sweeps, tapers = np.append(rng.uniform(0.4, 1.4, 20), [-0.5, -0.48, -0.46]), rng.uniform(0.3, 0.7, 23)
    report = lampopt.intake(wings(sweeps, tapers), crossings=False)
    assert not report.problems
    assert {f.exemplar for f in report.findings} == {"wing_20", "wing_21", "wing_22"}
    assert all("parameter 'sweep' explains it" in f.message for f in report.findings)
    mixed = wings(np.append(sweeps[:20], [0.9, 0.6, 1.2]), tapers)  # the same, with sweeps that say otherwise
    meshes = [*mixed.meshes]
    for i in (20, 21, 22):
        meshes[i].apply_transform(np.diag([-1.0, 1, -1, 1]))
    report = lampopt.intake(replace(mixed, meshes=meshes), crossings=False)
    assert {f.exemplar for f in report.problems} == {"wing_20", "wing_21", "wing_22"}


@pytest.mark.parametrize("turn", [HALF, QUARTER])
def test_a_symmetric_shape_turned_onto_itself_is_the_same(turn):
    balls = [shapes.ellipsoid([r, r, 0.4]) for r in np.linspace(0.5, 0.6, 8)]
    assert not odd(moved(balls, 2, turn))
    assert not odd(moved([shapes.box((1, 1, h)) for h in np.linspace(0.5, 0.6, 8)], 2, turn))
    plates = [shapes.plate_with_hole(radius=r) for r in np.linspace(0.1, 0.2, 8)]
    assert not odd(moved(plates, 2, HALF))


# bodies, genus


def test_another_number_of_bodies_than_all_others_is_doubtful():
    meshes = cars()
    meshes[0] = trimesh.util.concatenate([meshes[0], shapes.box((0.1, 0.1, 0.1), centre=(0, 0, 2))])
    assert (0, "bodies", "doubtful") in odd(meshes)


def test_a_family_of_mixed_genus_is_only_noted():
    meshes = [car(*size, hole=i % 2 == 0) for i, size in enumerate(SIZES)]
    report = lampopt.intake(family(meshes), crossings=False)
    assert not report.problems
    (found,) = report.findings
    assert (found.exemplar, found.kind, found.severity) == ("", "genus", "note")
    assert str(found) == "the exemplars differ in genus: 0 (4), 1 (4); a mix of them may be torn"


def test_one_mesh_with_two_parameters_is_noted():
    report = lampopt.intake(family([car(), car(*SIZES[1]), car()]))
    (found,) = report.findings
    assert (found.exemplar, found.kind) == ("mesh_2", "same mesh")


# families as they are meant to be


@cache
def judge():
    path = SHARED / "judge" / "judge.py"
    if not path.exists():
        pytest.skip("no file judge.py in ../shared/judge, beside the repository")
    spec = importlib.util.spec_from_file_location("judge", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("count", [1, 2, 3, 4, 8])
def test_cars_of_any_number_pass(count):
    report = lampopt.intake(family(cars()[:count]))
    assert report.findings == ()
    assert report.exemplars is report.given


@pytest.mark.parametrize(
    "options", [{}, *({"count": 24, "design": d, "seed": s} for d in ("lhs", "random") for s in (0, 1))]
)
def test_plates_pass(options):
    assert lampopt.intake(lampopt.exemplars("plate", **options)).findings == ()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("make", [shapes.box, shapes.ellipsoid])
def test_boxes_and_balls_of_any_proportions_pass(make, seed):
    sizes = np.random.default_rng(seed).uniform(0.3, 1.2, (16, 3))
    assert not odd([make(size) for size in sizes])


def test_sizes_over_two_decades_pass():
    assert not odd([shapes.ellipsoid([r, r, r]) for r in np.logspace(-1, 1, 21)])


def test_one_at_a_time_designs_pass():
    """All but one value in the middle: medians say that nothing varies, and the ends are no faults."""
    middle = np.array([1.0, 0.6, 0.4])
    sizes = [middle] + [middle * np.where(np.arange(3) == k, f, 1) for k in range(3) for f in (0.5, 2.0)]
    assert not odd([shapes.box(size) for size in sizes])


@pytest.mark.parametrize("name", ["Hybrid", "hatchback", "pickup"])
def test_real_cars_pass_and_a_turned_one_does_not(name):
    truth = judge()
    body = truth.body(name)
    meshes = [truth.morph(body, p) for p in truth.exemplars(12, 0)]
    assert odd(meshes) == []
    assert odd(moved(meshes[:8], 5, HALF)) == [(5, "facing", "doubtful")]


def test_cars_of_three_bodies_pass():
    truth = judge()
    meshes = [truth.morph(truth.body(name), p) for name in truth.LENGTH for p in truth.exemplars(4, 1)]
    assert odd(meshes) == []


# real files


def expected():
    """The verdicts in docs/intake.md: (file, verdict, watertight, bodies, genus, openings, crossings)."""
    text = (HERE.parent / "docs" / "intake.md").read_text(encoding="utf-8")
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| `")]
    return [[cell.strip(" `") for cell in row[:7]] for row in rows if "/" in row[0]]


@pytest.mark.parametrize("row", expected(), ids=lambda row: row[0])
def test_real_files_have_the_documented_verdict(row):
    file, verdict, closed, bodies, genus, holes, crossings = row
    path = SHARED / "data" / file
    if not path.exists():
        pytest.skip(f"no file {file} in ../shared/data, beside the repository")
    report = lampopt.intake(family([load_mesh(path)]))
    (health,) = report.health
    assert ("used" if not report.problems else report.problems[0].severity) == verdict
    assert health.closed == (closed == "yes")
    assert [str(health.bodies), str(health.holes), str(health.crossings)] == [bodies, holes, crossings]
    assert ("–" if health.genus is None else str(health.genus)) == genus


def test_every_real_file_is_documented():
    folders = [SHARED / "data" / "cars" / "raw", SHARED / "data" / "parts"]
    if not all(folder.is_dir() for folder in folders):
        pytest.skip("no folders cars/raw and parts in ../shared/data, beside the repository")
    found = {path.relative_to(SHARED / "data").as_posix() for folder in folders for path in folder.iterdir()}
    assert found == {row[0] for row in expected()}
