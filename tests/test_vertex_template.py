"""Decoder `vertex-template`: eggs that are linear in their sizes, exact at every mix; what does not correspond."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from trimesh import Trimesh

import lampopt
from lampopt import Spec, build_bank, compare
from lampopt.bank import decoder_of
from lampopt.decode import decode
from lampopt.errors import EmptyMesh, FitError, InputError, StudyError
from lampopt.mix import mixed_weights
from lampopt.plugins import Plugins
from lampopt.protocols import Corresponding, DesignChecks, Displace, Pullback
from lampopt.testing import decoder_checks, shapes
from lampopt.types import Exemplars, Parameter
from lampopt_template.vertex_template import VertexTemplate

DECODER = VertexTemplate()
SPACE = tuple(Parameter(name, "mm") for name in ("length", "width", "height"))
BOX = shapes.box((1.0, 0.7, 0.6), divisions=3)
SIZES = np.array([[1.0, 0.7, 0.6], [1.2, 0.7, 0.6], [1.0, 0.9, 0.6], [1.0, 0.7, 0.5]])


def stretched(size):
    """An egg of these diameters, its vertices those of a box's triangles."""
    ways = np.asarray(BOX.vertices) / BOX.extents
    return Trimesh(ways / np.linalg.norm(ways, axis=1, keepdims=True) * np.asarray(size) / 2, BOX.faces, process=False)


def eggs(meshes=None):
    return Exemplars(SIZES, SPACE, meshes or [stretched(size) for size in SIZES], ("a", "b", "c", "d"))


@pytest.fixture(scope="module")
def bank():
    return build_bank(eggs(), "vertex-template", probes=300)


@pytest.fixture(scope="module")
def shared():
    return DECODER.prepare([stretched(size) for size in SIZES[1:]], mean=stretched(SIZES[0]), seed=0)


@decoder_checks(DECODER)
def test_conforms(check):
    check()


def test_comes_in_by_the_front_door():
    assert Plugins.load().make("decoder", Spec("vertex-template")) == DECODER
    for ability in (Corresponding, Pullback, DesignChecks, Displace):
        assert isinstance(DECODER, ability)


@given(arrays(float, 3, elements=st.floats(-3, 3)))
@settings(max_examples=25, deadline=None)
def test_every_mix_of_eggs_is_the_egg(bank, steps):
    alpha = np.array([1 - steps.sum(), *steps])
    size = alpha @ SIZES
    made = decode(bank, decoder_of(bank, Plugins.load()), mixed_weights(bank, alpha))
    np.testing.assert_array_equal(made.faces, BOX.faces)
    np.testing.assert_allclose(made.vertices, stretched(size).vertices, atol=3e-6)


def test_a_study_is_met_exactly(bank):
    result = lampopt.run(lampopt.Study(bank, targets={"length": 1.3, "width": 0.8}))
    assert result.accepted, result.checks
    np.testing.assert_allclose(result.design.mesh.extents[:2], [1.3, 0.8], atol=1e-5)
    assert {"flipped", "crossing", "quality"} <= {check.name for check in result.checks}


def test_the_stated_error_is_that_of_rounding(shared):
    weights, error = DECODER.fit(shared, [stretched(size) for size in SIZES], seed=0)
    for row, size, stated in zip(weights, SIZES, error, strict=True):
        made = DECODER.decode(shared, row, resolution=1)
        off = np.linalg.norm(made.vertices - stretched(size).vertices, axis=1).mean()
        assert off == pytest.approx(stated, rel=1e-6)
        assert off < 1e-7


def test_exemplars_inside_out_are_turned():
    inward = [Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False) for mesh in eggs().meshes]
    there = DECODER.prepare(inward[1:], mean=inward[0], seed=0)
    mesh = DECODER.decode(there, DECODER.fit(there, [inward[1]], seed=0)[0][0], resolution=1)
    assert mesh.volume == pytest.approx(stretched(SIZES[1]).volume)


def others():
    fine, mixed = stretched(SIZES[1]).subdivide(), stretched(SIZES[1])
    swapped = mixed.faces.copy()
    swapped[0] = swapped[0] + 1
    yield fine, "expected 386 in the same 768 triangles, got stranger 1538 in 3072 of its own"
    yield Trimesh(mixed.vertices, swapped, process=False), "expected .*, got stranger 386 in 768 of .*'mesh-template'"


@pytest.mark.parametrize(("mesh", "said"), [*others()], ids=["finer", "other"])
def test_what_does_not_correspond_is_named(shared, mesh, said):
    mesh.metadata["name"] = "stranger"
    mean = stretched(SIZES[0])
    mean.metadata["name"] = "middle"
    with pytest.raises(FitError, match=f"not correspond to those of middle, the mean exemplar: {said}"):
        DECODER.prepare([mean, mesh], mean=mean, seed=0)
    with pytest.raises(FitError, match=f"not correspond to those of the template: {said}"):
        DECODER.fit(shared, [mean, mesh], seed=0)
    assert not DECODER.corresponds(shared, mesh)


def test_in_what_order_triangles_are_listed_does_not_matter(shared):
    egg = stretched(SIZES[1])
    order = np.random.default_rng(0).permutation(len(egg.faces))
    for faces in (egg.faces[order], np.roll(egg.faces, 1, axis=1), egg.faces[:, [0, 2, 1]]):
        weights, _ = DECODER.fit(shared, [Trimesh(egg.vertices, faces, process=False)], seed=0)
        made = DECODER.decode(shared, weights[0], resolution=1)
        np.testing.assert_allclose(made.vertices, egg.vertices, atol=1e-7)
        assert made.volume > 0


def test_an_open_mean_is_named():
    mesh = Trimesh(BOX.vertices, BOX.faces[1:], process=False)
    with pytest.raises(FitError, match="a mesh: expected a closed mesh as the template's, got one that is open"):
        DECODER.prepare([mesh], mean=mesh, seed=0)


def test_comparing_says_why_it_does_not_serve(tmp_path):
    balls = [shapes.ellipsoid(size, divisions=2 + k % 2) for k, size in enumerate([*SIZES, *(1.1 * SIZES)])]
    given = Exemplars(np.concatenate([SIZES, 1.1 * SIZES]), SPACE, balls, tuple("abcdefgh"))
    found = compare(given, ["vertex-template"], folder=tmp_path)
    assert found.best is None
    assert "vertices do not correspond" in found.rows[0].refusal


def test_points_go_along_and_far_ones_stay(shared):
    weights = DECODER.fit(shared, [stretched(SIZES[1])], seed=0)[0][0]
    still, moved = (DECODER.decode(shared, w, resolution=1) for w in (0 * weights, weights))
    np.testing.assert_allclose(DECODER.displace(shared, weights, still.vertices), moved.vertices, atol=1e-9)
    np.testing.assert_allclose(DECODER.evaluate(shared, weights, still.vertices), moved.vertices, atol=1e-9)
    for go in (DECODER.evaluate, DECODER.displace):
        np.testing.assert_allclose(go(shared, weights, still.triangles_center), moved.triangles_center, atol=1e-9)
    far = np.array([[0.0, 0.0, 5.0]])
    np.testing.assert_array_equal(DECODER.displace(shared, weights, far), far)
    beside = np.array([[0.505, 0, 0.0], [0.6, 0, 0]])
    along = DECODER.displace(shared, weights, beside)[:, 0] - beside[:, 0]
    assert 0.1 > along[0] > along[1] > 0.02
    assert DECODER.displace(shared, weights, np.empty((0, 3))).shape == (0, 3)


def test_blocks_of_points_go_where_they_go_together(shared, monkeypatch):
    weights = DECODER.fit(shared, [stretched(SIZES[2])], seed=0)[0][0]
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 3))
    together = DECODER.displace(shared, weights, points)
    monkeypatch.setattr("lampopt_template.vertex_template.PAIRS", 2000)
    np.testing.assert_allclose(DECODER.displace(shared, weights, points), together, rtol=0, atol=1e-15)


def test_a_design_turned_inside_out_is_told(shared):
    weights = DECODER.fit(shared, [stretched(SIZES[0])], seed=0)[0][0]
    mirrored = weights.reshape(-1, 3) - 2 * shared["vertices"] * [1, 0, 0]
    mesh = DECODER.decode(shared, mirrored.ravel(), resolution=1)
    checks = {check.name: check for check in DECODER.design_checks(shared, mirrored.ravel(), mesh)}
    assert not checks["flipped"].passed
    assert checks["flipped"].value > 0.1
    one = weights.reshape(-1, 3).copy()
    one[0] += [2.0, 0.5, 0.5]  # a corner drawn through the other side
    checks = DECODER.design_checks(shared, one.ravel(), DECODER.decode(shared, one.ravel(), resolution=1))
    assert {check.name for check in checks if not check.passed} >= {"crossing"}


def collapsed(size):
    """An egg whose vertices about one pole are one place."""
    mesh = stretched(size)
    top = mesh.vertices[:, 2] > 0.8 * mesh.vertices[:, 2].max()
    mesh.vertices[top] = mesh.vertices[top].mean(0)
    return mesh


def test_triangles_without_area_do_not_count_where_exemplars_have_them():
    shared = DECODER.prepare([collapsed(size) for size in SIZES[1:]], mean=collapsed(SIZES[0]), seed=0)
    assert 0.9 < shared["sound"].mean() < 0.95  # more than the worst hundredth
    weights, _ = DECODER.fit(shared, [collapsed(size) for size in SIZES], seed=0)
    for row in (weights[0], 2 * weights[1] - weights[0]):
        checks = DECODER.design_checks(shared, row, DECODER.decode(shared, row, resolution=1))
        assert {check.name: check.passed for check in checks}["quality"]
    one = [stretched(SIZES[0]), collapsed(SIZES[1]), stretched(SIZES[2])]
    mixed = DECODER.prepare(one, mean=one[0], seed=0)
    assert mixed["quality"][0] > 0.02


def test_exemplars_that_pass_through_themselves_are_the_measure_for_designs():
    def pair(apart):
        one, other = stretched(SIZES[0]), stretched(SIZES[0])
        other.vertices[:, 0] += apart
        faces = np.vstack([one.faces, other.faces + len(one.vertices)])
        return Trimesh(np.vstack([one.vertices, other.vertices]), faces, process=False)

    shared = DECODER.prepare([pair(0.8)], mean=pair(0.9), seed=0)
    weights, _ = DECODER.fit(shared, [pair(0.8), pair(0.9), pair(1.2), pair(0.2)], seed=0)
    passed = []
    for row in weights:
        checks = DECODER.design_checks(shared, row, DECODER.decode(shared, row, resolution=1))
        passed.append({check.name: check.passed for check in checks}["crossing"])
    assert passed[:3] == [True, True, True]
    assert shared["crossing"][0] > 0


def test_a_design_of_a_run_joins_its_bank(bank, tmp_path):
    lampopt.run(lampopt.Study(bank, targets={"length": 1.3}), tmp_path / "run")
    grown = lampopt.enrich(bank, tmp_path / "run")
    assert len(grown) == len(bank) + 1
    assert grown.fit_error[-1] < 1e-6


def test_space_goes_along_and_cannot_be_kept_from_folding(bank):
    wide = lampopt.run(lampopt.Study(bank, targets={"width": 0.9})).design
    inner = 0.5 * np.asarray(stretched(SIZES[0]).vertices)
    moved = lampopt.warp(bank, wide, inner)
    assert 1.1 < np.ptp(moved[:, 1]) / np.ptp(inner[:, 1]) < 1.4
    with pytest.raises(StudyError, match="'vertex-template' does not"):
        lampopt.run(lampopt.Study(bank, targets={"width": 0.9}, safe=("jacobian",), solver="casadi"))


def test_where_numbers_end_there_is_no_mesh(shared):
    with pytest.raises(EmptyMesh, match="where there are no numbers"):
        DECODER.decode(shared, np.full(shared["vertices"].size, np.inf), resolution=1)


def test_what_is_not_a_templates_is_refused(shared):
    count = shared["vertices"].size
    with pytest.raises(InputError, match="expected vertices, faces, sound, quality, crossing, got none of quality"):
        DECODER.decode({k: v for k, v in shared.items() if k != "quality"}, np.zeros(count), resolution=1)
    with pytest.raises(InputError, match=r"points: expected shape \(M, 3\), got \(3,\)"):
        DECODER.evaluate(shared, np.zeros(count), np.zeros(3))
    for points in ([0.0, 0.0], [[np.nan, 0, 0]]):
        for go in (DECODER.evaluate, DECODER.displace):
            with pytest.raises(InputError, match="points: expected"):
                go(shared, np.zeros(count), points)
    with pytest.raises(InputError, match=r"weights: expected 1158 for this template, got shape \(2, 1158\)"):
        DECODER.decode(shared, np.zeros((2, count)), resolution=1)
    with pytest.raises(InputError, match=r"gradient: expected shape \(386, 3\), got \(385, 3\)"):
        DECODER.pullback(shared, np.zeros(count), BOX, np.zeros((385, 3)))


def test_measures_are_followed_by_their_derivatives(bank):
    study = lampopt.Study(bank, targets={"extents.length": 1.25, "volume.volume": 0.3}, solver="nlopt")
    result = lampopt.run(study)
    assert result.design.mesh.extents[0] == pytest.approx(1.25, abs=1e-4)
    assert result.design.mesh.volume == pytest.approx(0.3, abs=1e-4)
