"""Decoder `mesh-template`: solids known in closed form, exact linearity, what registration bears, what it refuses."""

import gc
import logging
import weakref
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from threadpoolctl import threadpool_limits

from lampopt import Spec, build_bank
from lampopt.bank import decoder_of
from lampopt.check import mismatches
from lampopt.decode import decode
from lampopt.errors import FitError, InputError
from lampopt.metrics import surface_distance
from lampopt.mix import mixed_weights
from lampopt.plugins import Plugins
from lampopt.protocols import DesignChecks, Displace, Pullback
from lampopt.testing import decoder_checks, shapes
from lampopt.topology import topology
from lampopt.types import Exemplars, Parameter
from lampopt_families.plate import plate_mesh
from lampopt_template.mesh_template import MeshTemplate
from lampopt_template.specks import without_specks
from lampopt_template.template import Template

TINY = MeshTemplate(faces=1000, cell=0.2, tolerance=0.0)
AS_IS = replace(TINY, remesh=False)  # the mean's own triangles
FLAT, TALL = np.array([0.6, 0.35, 0.2]), np.array([0.5, 0.3, 0.32])
EGG, POT = shapes.ellipsoid(FLAT, divisions=3), shapes.ellipsoid(TALL, divisions=3)
BALL = shapes.ellipsoid((FLAT + TALL) / 2, divisions=3)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    with threadpool_limits(1):
        yield


def with_stray(mesh):
    """The same with vertices that no face has, far away."""
    stray = np.concatenate([[[9.0, 9, 9], [-9, -9, -9]], mesh.vertices])
    return trimesh.Trimesh(stray, mesh.faces + 2, process=False)


def test_vertices_without_a_face_make_no_difference():
    plain, strewn = (TINY.prepare([f(EGG), f(POT)], mean=f(BALL), seed=0) for f in (lambda mesh: mesh, with_stray))
    for name in plain:
        np.testing.assert_array_equal(strewn[name], plain[name])
    for one, other in zip(TINY.fit(plain, [EGG], seed=0), TINY.fit(plain, [with_stray(EGG)], seed=0), strict=True):
        np.testing.assert_array_equal(one, other)


def test_preparing_holds_few_meshes_at_once():
    """A thousand cars do not fit in memory; the six that the template is tried on do."""
    alive = weakref.WeakSet()

    class Loaded(Sequence):
        def __len__(self):
            return 20

        def __getitem__(self, index):
            if index >= len(self):
                raise IndexError
            gc.collect()
            mesh = shapes.ellipsoid(FLAT + index / 20 * (TALL - FLAT), divisions=3)
            alive.add(mesh)
            most.append(len(alive))
            return mesh

    most = []
    gc.freeze()  # what hundreds of tests have left need not be looked through each time
    try:
        TINY.prepare(Loaded(), mean=BALL, seed=0)
    finally:
        gc.unfreeze()
    assert max(most) <= 4


@decoder_checks(MeshTemplate(faces=500, cell=0.25))
def test_conforms(check):
    check()


def test_comes_in_by_the_front_door():
    assert Plugins.load().make("decoder", Spec("mesh-template", faces=900)) == MeshTemplate(faces=900)


def test_has_the_abilities_it_names():
    for ability in (Pullback, DesignChecks, Displace):
        assert isinstance(TINY, ability)


def off(vertices, radii, centre=(0, 0, 0)):
    """Mean and largest distance of points from an ellipsoid, to first order."""
    at = (vertices - np.asarray(centre)) / radii
    apart = np.abs((at**2).sum(1) - 1) / (2 * np.linalg.norm(at / radii, axis=1))
    return apart.mean(), apart.max()


# A bank of plates.

MIDDLE, HALF = np.array([2.5, 0.2, 0.0]), np.array([0.5, 0.05, 0.1])
SPACE = tuple(Parameter(name, "m") for name in ("length", "hole_radius", "hole_x"))


def plate(row):
    length, radius, x = row
    return plate_mesh(np.array([length, 1.7, 0.25, radius, x, 0.0]), segments=64)


def plates(meshes=None):
    parameters = np.concatenate([[MIDDLE], MIDDLE + np.diag(HALF)])
    names = ("middle", "long", "wide", "aside")
    return Exemplars(parameters, SPACE, meshes or [plate(p) for p in parameters], names, mesh_at=plate)


@pytest.fixture(scope="module")
def bank():
    return build_bank(plates(), Spec("mesh-template", faces=1500, cell=0.2, tolerance=0.0), probes=300)


def test_plates_are_fitted(bank):
    assert bank.fit_error.max() < 1e-4  # [box]: 0.25 mm of 2.5 m


@pytest.mark.parametrize("signs", [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, -1), (1, 1, -1), (-1, -1, 1)], ids=str)
def test_designs_at_twice_the_range_are_the_true_plates(bank, signs):
    """Plates are linear in length, radius and place but for where points of the template lie along the surface."""
    steps = 2.0 * np.array(signs)
    alpha = np.array([1 - steps.sum(), *steps])
    decoder = decoder_of(bank, Plugins.load())
    made, true = decode(bank, decoder, mixed_weights(bank, alpha)), plate(MIDDLE + steps * HALF)
    np.testing.assert_allclose(alpha @ bank.parameters, MIDDLE + steps * HALF)
    assert surface_distance(made, true) < 3e-4  # [m]
    np.testing.assert_allclose(made.extents, true.extents, atol=2e-3)
    assert topology(made) == topology(true)
    assert all(
        check.passed
        for check in decoder.design_checks(bank.shared, mixed_weights(bank, alpha), bank.frame.to_box(made))
    )


def test_designs_are_exactly_linear_and_of_one_connectivity(bank):
    decoder = decoder_of(bank, Plugins.load())
    meshes = [decode(bank, decoder, w, resolution=r) for w, r in zip(bank.weights, (32, 64, 32, 8), strict=True)]
    for alpha in ([0.25] * 4, [2.0, -1.5, 1.0, -0.5]):
        mix = decode(bank, decoder, mixed_weights(bank, np.array(alpha)))
        np.testing.assert_allclose(mix.vertices, np.tensordot(alpha, [m.vertices for m in meshes], 1), atol=2e-6)
        for mesh in (*meshes, mix):
            np.testing.assert_array_equal(mesh.faces, bank.shared["faces"])
        assert mismatches(bank, decoder, np.array(alpha), mixed_weights(bank, np.array(alpha)))[0] < 1e-6


def test_another_topology_is_named_with_both():
    meshes = [*plates().meshes[:3], shapes.box((2.5, 1.7, 0.25))]
    said = "aside: expected the template's topology, 1 body of genus 1, got 1 body of genus 0"
    with pytest.raises(FitError, match=said):
        build_bank(plates(meshes), Spec("mesh-template", faces=1000, cell=0.2), probes=10, accept="all")


# The decoder.


@pytest.fixture(scope="module")
def shared():
    return TINY.prepare([EGG, POT], mean=BALL, seed=0)


@pytest.fixture(scope="module")
def fitted(shared):
    return TINY.fit(shared, [EGG, POT], seed=0)


def test_ellipsoids_are_met_and_the_stated_error_is_the_error(shared, fitted):
    for weights, told, mesh in zip(*fitted, [EGG, POT], strict=True):
        apart = surface_distance(TINY.decode(shared, weights, resolution=1), mesh)
        assert apart < 0.0008
        assert told == pytest.approx(apart, rel=0.1)


@pytest.mark.parametrize("alpha", [0.5, 0.25, 1.5, -0.5])
def test_a_mix_of_ellipsoids_is_the_ellipsoid_between(shared, fitted, alpha):
    radii = alpha * FLAT + (1 - alpha) * TALL
    made = TINY.decode(shared, alpha * fitted[0][0] + (1 - alpha) * fitted[0][1], resolution=1)
    assert surface_distance(made, shapes.ellipsoid(radii, divisions=4)) < 0.0012  # facets with edges of 0.07


def test_same_seed_same_bits_whatever_is_fitted_beside(shared, fitted):
    told = []
    weights, _ = TINY.fit(shared, [BALL, POT, EGG], seed=0, progress=lambda done, message="", /: told.append(done))
    np.testing.assert_array_equal(weights[:0:-1], fitted[0])
    assert told == pytest.approx([1 / 3, 2 / 3, 1])


def test_meshes_inside_out_are_turned():
    inward, mean = EGG.copy(), BALL.copy()
    inward.invert()
    mean.invert()
    shared = AS_IS.prepare([EGG], mean=BALL, seed=0)
    for name, array in AS_IS.prepare([inward], mean=mean, seed=0).items():
        assert np.array_equal(array, shared[name]) or name in ("faces", "quality")
    weights, error = AS_IS.fit(shared, [EGG, inward], seed=0)
    assert error.max() < 0.0005
    for row in weights:
        assert AS_IS.decode(shared, row, resolution=1).volume == pytest.approx(EGG.volume, rel=0.01)


def test_an_open_exemplar_is_met_where_it_is(shared, caplog):
    sheet = trimesh.Trimesh(EGG.vertices, EGG.faces[EGG.triangles_center[:, 0] < 0.55], process=False)
    sheet.metadata["name"] = "car_017"
    with caplog.at_level(logging.WARNING, "lampopt"):
        weights, _ = TINY.fit(shared, [sheet], seed=0)
    assert "car_017: is open" in caplog.text
    vertices = TINY.decode(shared, weights[0], resolution=1).vertices
    assert off(vertices[vertices[:, 0] < 0.5], FLAT)[0] < 0.001


# Symmetry and detail.

VARIANTS = {
    "plain": TINY,
    "symmetric": replace(TINY, symmetry="y"),
    "detailed": replace(AS_IS, detail=0.03),
    "both": replace(AS_IS, symmetry="z", detail=0.03),
    "finer": replace(AS_IS, tolerance=1e-6, cell=0.3, symmetry="x"),
}


def bumpy(mesh, height=0.012, waves=24):
    """Bumps that no lattice of cells of 0.24 follows: waves along x and z, 2π / 24 long, their own mirror images."""
    x, _, z = mesh.vertices.T
    wave = 1 + height * np.cos(waves * x) * np.cos(waves * z) / np.linalg.norm(mesh.vertices, axis=1)
    return trimesh.Trimesh(mesh.vertices * wave[:, None], mesh.faces, process=False)


@pytest.fixture(scope="module", params=VARIANTS)
def variant(request):
    decoder = VARIANTS[request.param]
    shared = decoder.prepare([EGG], mean=BALL, seed=0)
    askew = bumpy(POT, waves=12)
    askew.vertices = askew.vertices @ [[1, 0.02, 0.02], [0, 1, 0.02], [0, 0, 1]] + 0.02 * askew.vertices**2
    return decoder, shared, decoder.fit(shared, [askew], seed=0)[0][0].astype(float)


def test_pullback_is_the_adjoint_of_decode(variant):
    decoder, shared, weights = variant
    draw = np.random.default_rng(0)
    mesh, still = (decoder.decode(shared, w, resolution=1) for w in (weights, 0 * weights))
    np.testing.assert_array_equal(still.vertices, shared["vertices"])
    for _ in range(3):
        way, gradient = draw.normal(size=weights.shape), draw.normal(size=mesh.vertices.shape)
        there = decoder.decode(shared, weights + way, resolution=1).vertices - mesh.vertices
        back = decoder.pullback(shared, weights, mesh, gradient)
        assert back.shape == weights.shape
        assert back @ way == pytest.approx((gradient * there).sum(), rel=1e-9, abs=1e-9 * np.linalg.norm(back))


def test_displace_is_decode_at_the_template_and_nothing_far_away(variant):
    decoder, shared, weights = variant
    mesh, still = decoder.decode(shared, weights, resolution=1), shared["vertices"]
    np.testing.assert_allclose(decoder.displace(shared, weights, still), mesh.vertices, atol=1e-7)
    np.testing.assert_allclose(decoder.evaluate(shared, weights, still), mesh.vertices, atol=1e-7)
    faces = mesh.faces[::7]
    middles = decoder.displace(shared, weights, still[faces].mean(1))
    np.testing.assert_allclose(middles, mesh.vertices[faces].mean(1), atol=0.01)
    far = np.random.default_rng(0).normal(size=(50, 3))
    far *= 3 / np.linalg.norm(far, axis=1, keepdims=True)
    np.testing.assert_array_equal(decoder.displace(shared, weights, far), far)
    ray = np.linspace(0.5, 3, 2000)[:, None] * [1.0, 0.2, -0.1]
    steps = np.linalg.norm(np.diff(decoder.displace(shared, weights, ray) - ray, axis=0), axis=1)
    assert steps.max() < 1e-3  # it dies away without a jump


def test_points_moved_in_blocks_go_where_they_go_together(variant, monkeypatch):
    decoder, shared, weights = variant
    points = np.random.default_rng(1).uniform(-1.5, 1.5, (200, 3))
    together = decoder.displace(shared, weights, points)
    monkeypatch.setattr("lampopt_template.template.BLOCK", 17)
    np.testing.assert_array_equal(decoder.displace(shared, weights, points), together)
    assert decoder.displace(shared, weights, np.empty((0, 3))).shape == (0, 3)


def test_shapes_beside_the_plane_of_symmetry_are_refused():
    """They would be met by one as wide as they and their mirror images together."""
    decoder = MeshTemplate(faces=500, cell=0.3, tolerance=0, symmetry="y")
    here, beside = shapes.box([0.8, 0.5, 0.4]), shapes.box([0.8, 0.5, 0.4], centre=[0, 0.1, 0])
    with pytest.raises(FitError, match=r"symmetry='y': expected its middle along y .* 20% of the width beside"):
        decoder.prepare([here, beside], mean=here, seed=0)
    shared = decoder.prepare([here, here], mean=here, seed=0)
    with pytest.raises(FitError, match="move it there, or leave symmetry out"):
        decoder.fit(shared, [beside], seed=0)
    assert decoder.fit(shared, [shapes.box([0.8, 0.5, 0.4], centre=[0.1, 0.004, 0])], seed=0)[1][0] < 0.01
    speck = shapes.box([0.005] * 3, centre=[0, 0.4, 0], divisions=0)  # left out, wherever it is
    assert decoder.fit(shared, [trimesh.util.concatenate([here, speck])], seed=0)[1][0] < 0.01


def test_symmetric_designs_are_their_own_mirror_images(variant):
    """Exactly, whatever the exemplar is, and with the faces turned over."""
    decoder, shared, weights = variant
    mesh, twins = decoder.decode(shared, weights, resolution=1), shared["twins"]
    if not decoder.symmetry:
        assert len(twins) == len(shared["plane"]) == 0
        return
    half = len(mesh.vertices) - len(twins)
    assert 0.8 < len(twins) / half < 1
    image = np.arange(half)
    image[twins] = half + np.arange(len(twins))
    image = np.concatenate([image, twins])
    np.testing.assert_array_equal(image[image], np.arange(len(image)))
    axis, at = "xyz".index(decoder.symmetry), shared["plane"][1]
    across = np.array(mesh.vertices)
    across[:, axis] = 2 * at - across[:, axis]
    np.testing.assert_allclose(mesh.vertices[image], across, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(mesh.vertices[image == np.arange(len(image)), axis], at)

    def cycles(faces):
        turns = (faces.argmin(1)[:, None] + np.arange(3)) % 3
        return set(map(tuple, np.take_along_axis(faces, turns, 1).tolist()))

    faces = np.array(mesh.faces)
    assert cycles(image[faces][:, ::-1]) == cycles(faces)
    assert topology(mesh) == topology(EGG)


def test_detail_follows_what_the_lattice_cannot():
    rough, apart = bumpy(POT, waves=18), []
    for detail in (0.0, 0.03):
        decoder = replace(AS_IS, detail=detail, cell=0.5)
        shared = decoder.prepare([POT], mean=BALL, seed=0)
        apart.append(decoder.fit(shared, [rough], seed=0)[1][0])
    assert apart[1] < apart[0] / 2


def test_the_lattice_is_finer_about_a_bump_alone():
    """The top of an ellipsoid with z raised by 0.08 exp(−r² / 0.1²): narrower than a coarse cell of 0.36."""
    base = shapes.ellipsoid(FLAT, divisions=4)

    def raised(x, y):
        return 0.08 * np.exp(-(x**2 + y**2) / 0.01)

    x, y, z = base.vertices.T
    bump = trimesh.Trimesh(np.stack([x, y, z + raised(x, y) * (z > 0)], 1), base.faces, process=False)
    apart = []
    for tolerance in (0.0, 1e-3):
        decoder = replace(AS_IS, tolerance=tolerance, cell=0.3)
        shared = decoder.prepare([bump], mean=base, seed=0)
        weights = decoder.fit(shared, [bump], seed=0)[0][0]
        x, y, z = decoder.decode(shared, weights, resolution=1).vertices.T
        top = (z > 0) & (x**2 + y**2 < 0.2**2)
        true = 0.2 * np.sqrt(1 - (x[top] / 0.6) ** 2 - (y[top] / 0.35) ** 2) + raised(x[top], y[top])
        apart.append(np.abs(z[top] - true).mean())
    fine = Template.of(shared, detailed=False).space.fine
    nodes = fine.nodes[shared["chosen"]]
    assert 8 <= len(nodes) < 0.1 * fine.size
    assert np.linalg.norm(nodes - [0, 0, 0.2], axis=1).max() < 0.6
    assert apart[1] < apart[0] / 3


# What it refuses.


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"faces": 19}, "faces: expected 20 to 2,000,000 triangles, got 19"),
        ({"faces": 2_000_001}, "faces"),
        ({"cell": 0.009}, r"cell: expected 0\.01 to 1, got 0\.009"),
        ({"cell": float("nan")}, "cell"),
        ({"stiffness": 0.0}, "stiffness: expected 1e-12 to 1"),
        ({"tolerance": -1e-4}, "tolerance: expected 0 to 1"),
        ({"detail": 1.5}, "detail"),
        ({"symmetry": "w"}, "symmetry: expected 'x', 'y', 'z' or '', got 'w'"),
    ],
)
def test_options_that_cannot_be(options, said):
    with pytest.raises(InputError, match=said):
        MeshTemplate(**options)


def test_arrays_that_do_not_fit(shared, fitted):
    size, points = fitted[0].shape[1], np.zeros((4, 3))
    mesh = TINY.decode(shared, fitted[0][0], resolution=1)
    with pytest.raises(InputError, match=f"weights: expected {size} .*{size - 1}"):
        TINY.decode(shared, np.zeros(size - 1), resolution=1)
    with pytest.raises(InputError, match=r"points: expected shape \(M, 3\), got \(4, 2\)"):
        TINY.evaluate(shared, np.zeros(size), points[:, :2])
    with pytest.raises(InputError, match=r"gradient: expected shape \(\d+, 3\), got \(5, 3\)"):
        TINY.pullback(shared, fitted[0][0], mesh, np.zeros((5, 3)))
    with pytest.raises(InputError, match=r"shared: expected vertices, .* got none of twins"):
        TINY.fit({name: a for name, a in shared.items() if name != "twins"}, [EGG], seed=0)
    assert TINY.evaluate(shared, np.zeros((2, 5, size)), points).shape == (2, 5, 4, 3)
    assert TINY.evaluate(shared, np.zeros(size), points[:0]).shape == (0, 3)


def specked(mesh):
    """`mesh` with a tetrahedron of a hundredth of its size beside it."""
    speck = trimesh.creation.icosphere(0, radius=0.01)
    speck.apply_translation(mesh.bounds[1] + 0.05)
    both = trimesh.util.concatenate([mesh, speck])
    both.metadata["name"] = "car_020"
    return both


def test_loose_specks_are_left_out_and_named(shared, caplog):
    (plain,), (with_speck,) = (TINY.fit(shared, [mesh], seed=0)[0] for mesh in (EGG, specked(EGG)))
    np.testing.assert_array_equal(with_speck, plain)
    assert "car_020: 1 loose specks are left out" in caplog.text
    again = TINY.prepare([EGG, BALL], mean=specked(BALL), seed=0)
    for name, array in TINY.prepare([EGG, BALL], mean=BALL, seed=0).items():
        np.testing.assert_array_equal(again[name], array)
    large = trimesh.util.concatenate([EGG, shapes.box((0.2, 0.2, 0.2), centre=(0.7, 0.7, 0.7))])
    assert without_specks(large) is large


def test_meshes_that_cannot_be_met(shared):
    torus = trimesh.creation.torus(0.4, 0.15)
    torus.metadata["name"] = "car_017"
    pair = trimesh.util.concatenate([shapes.box((0.2, 0.2, 0.2)), shapes.box((0.2, 0.2, 0.2), centre=(0.5, 0, 0))])
    pair.metadata["name"] = "car_018"
    empty = trimesh.Trimesh()
    empty.metadata["name"] = "car_019"
    sheet = trimesh.Trimesh(BALL.vertices, BALL.faces[1:], process=False)
    for mesh, said in (
        (torus, "car_017: expected the template's topology, 1 body of genus 0, got 1 body of genus 1: no motion"),
        (pair, "car_018: .*1 body of genus 0, got 2 bodies of genus 0"),
        (empty, "car_019: expected a surface, got a mesh without faces"),
    ):
        with pytest.raises(FitError, match=said):
            TINY.fit(shared, [mesh], seed=0)
        with pytest.raises(FitError, match=said):
            TINY.prepare([BALL, mesh], mean=BALL, seed=0)
    with pytest.raises(FitError, match="a mesh: expected a closed mesh as the template's, got one that is open"):
        TINY.prepare([BALL], mean=sheet, seed=0)
