"""Decoder `point-template`: gradients against autograd and differences, known solids, what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from threadpoolctl import threadpool_limits

from lampopt import Spec
from lampopt.errors import EmptyMesh, FitError, InputError
from lampopt.metrics import surface_distance
from lampopt.plugins import Plugins
from lampopt.protocols import DesignChecks, Pullback
from lampopt.testing import decoder_checks, shapes
from lampopt.topology import topology
from lampopt_template.point_template import PointTemplate
from lampopt_template.pushing import SOFT, Round, Sphere, Target, bend, even, stiff
from lampopt_template.sphere import BLOCK, OMEGA, Network, Push, evaluate, icosphere, pullback, spiral

TINY = PointTemplate(
    width=32, depth=2, octaves=1, degree=3, subdivision=3, start_steps=100, steps=60, learning_rate=1e-3
)
FLAT, TALL = np.array([0.6, 0.35, 0.2]), np.array([0.5, 0.3, 0.32])
BALL = shapes.ellipsoid((0.5, 0.5, 0.5), divisions=4)
EGG, POT = shapes.ellipsoid(FLAT, divisions=4), shapes.ellipsoid(TALL, divisions=4)
BRICK = shapes.box((1.0, 0.6, 0.5))
NETWORK = Network(16, 2, 2)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Products this small cost several times as much on threads that wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    with threadpool_limits(1):
        yield
    torch.set_num_threads(before)


@decoder_checks(PointTemplate.example())
def test_conforms(check):
    check()


def test_comes_in_by_the_front_door():
    assert Plugins.load().make("decoder", Spec("point-template", width=8)) == PointTemplate(width=8)


def test_has_the_abilities_it_names():
    assert isinstance(TINY, Pullback)
    assert isinstance(TINY, DesignChecks)


# The sphere and its network.


def network_by_hand(network, weights, points):
    """Offsets (m, 3) of one weight vector (D,) at points (m, 3), by the formula of `sphere.py`, in any precision."""
    hidden = [points]
    for k in range(network.octaves):
        hidden += [torch.sin(2**k * torch.pi * points), torch.cos(2**k * torch.pi * points)]
    hidden, at = torch.cat(hidden, -1), 0
    sizes = [3 + 6 * network.octaves, *[network.width] * network.depth, 3]
    for k in range(len(sizes) - 1):
        a, b = sizes[k], sizes[k + 1]
        hidden = hidden @ weights[at : at + a * b].reshape(a, b) + weights[at + a * b : at + a * b + b]
        at += a * b + b
        if k < len(sizes) - 2:
            hidden = torch.sin(OMEGA * hidden)
    assert at == len(weights) == network.size
    return hidden


def by_hand(push, weights, points):
    """Where one weight vector (D,) moves points (m, 3)."""
    size, ellipsoid = push.network.size, push.ellipsoid.double()
    moved = ellipsoid[0] + ellipsoid[1] * points + network_by_hand(push.network, weights[:size], points)
    if not push.degree:
        return moved
    at = points + network_by_hand(push.network, push.start.double(), points) / ellipsoid[1]
    ones = [torch.special.legendre_polynomial_p(at, torch.tensor(float(k))) for k in range(push.degree + 1)]
    n = push.degree + 1
    every = [(i, j, k) for i in range(n) for j in range(n) for k in range(n) if i + j + k < n]
    basis = torch.stack([ones[i][:, 0] * ones[j][:, 1] * ones[k][:, 2] for i, j, k in every], 1)
    return moved + basis @ weights[size:].reshape(-1, 3)


def pushes(degree):
    draw = np.random.default_rng(0)
    ellipsoid = torch.tensor(np.stack([[0.1, 0, 0], FLAT]).astype(np.float32))
    push = Push(NETWORK, degree, ellipsoid, torch.tensor(NETWORK.initial(draw)))
    coefficients = 0.1 * draw.normal(size=push.size - NETWORK.size)
    return push, np.concatenate([NETWORK.initial(draw), coefficients]).astype(np.float32)


@pytest.mark.parametrize("degree", [0, 1, 4])
def test_evaluate_and_pullback_are_the_formulas(degree):
    push, weights = pushes(degree)
    points = spiral(BLOCK + 137, 0.3)
    given = np.random.default_rng(1).normal(size=points.shape)
    leaf = torch.tensor(weights).double().requires_grad_()
    wanted = by_hand(push, leaf, torch.tensor(points))
    np.testing.assert_allclose(evaluate(push, weights, points), wanted.detach(), atol=5e-6)
    (wanted * torch.tensor(given)).sum().backward()
    np.testing.assert_allclose(pullback(push, weights, points, given), leaf.grad, rtol=1e-9, atol=1e-9)


def test_at_first_it_is_nearly_the_ellipsoid():
    network, points = PointTemplate()._network(), spiral(500, 0)
    push = Push(network, 0, torch.tensor([[0.1, 0, 0], FLAT.tolist()]), torch.zeros(network.size))
    moved = evaluate(push, network.initial(np.random.default_rng(0)), points)
    assert np.abs(moved - push.plain(torch.tensor(points)).numpy()).max() < 0.15


def test_what_is_stretched_is_found_by_polynomials_alone(start):
    decoder, stretch = TINY, np.diag([1.3, 0.9, 1.1, 1.0])
    push = decoder._push(start)
    egg = BALL.copy()
    egg.apply_transform(stretch)
    weights = bend(push, start["start"][None], [egg_target := Target(egg)], Sphere(3), np.random.SeedSequence(0))[0]
    np.testing.assert_array_equal(weights[: push.network.size], start["start"][: push.network.size])
    made = decoder.decode(start, weights, resolution=10)
    near, _ = egg_target.nearest(np.array(made.vertices))
    assert np.linalg.norm(near - made.vertices, axis=1).mean() < 0.002
    alone = replace(decoder, degree=0)
    plain = {**start, "start": start["start"][: push.network.size]}
    left = bend(alone._push(plain), plain["start"][None], [egg_target], Sphere(3), np.random.SeedSequence(0))
    np.testing.assert_array_equal(left[0], plain["start"])


def test_spiral_is_even():
    points = spiral(2000, 1.0)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1)
    np.testing.assert_allclose(points.T @ points / 2000, np.eye(3) / 3, atol=2e-3)
    assert spiral(0, 0).shape == (0, 3)


@pytest.mark.parametrize("subdivision", [0, 2])
def test_laplacian_counts_each_neighbour_once(subdivision):
    sphere = Sphere(subdivision)
    edges = trimesh.Trimesh(sphere.vertices, sphere.faces, process=False).edges_unique
    values = np.random.default_rng(0).normal(size=(2, len(sphere.vertices), 3))
    wanted = np.zeros_like(values)
    for i, j in edges:
        wanted[:, i] += values[:, i] - values[:, j]
        wanted[:, j] += values[:, j] - values[:, i]
    np.testing.assert_allclose(sphere.laplacian(torch.tensor(values)), wanted, atol=1e-12)


def test_a_turned_sphere_is_turned_and_not_mirrored():
    sphere = Sphere(1)
    for seed in range(5):
        turned = sphere.turned(np.random.default_rng(seed))
        np.testing.assert_allclose(turned @ turned.T, sphere.vertices @ sphere.vertices.T, atol=1e-12)
        assert np.linalg.det(turned[[0, 1, 2]]) == pytest.approx(np.linalg.det(sphere.vertices[[0, 1, 2]]))


# The loss, whose gradients are written by hand.


def test_gradients_of_the_loss():
    draw, sphere = np.random.default_rng(0), Sphere(1)
    count = len(sphere.vertices)
    points, places, moved = (torch.tensor(draw.normal(size=(2, 2 * count, 3))) for _ in range(3))
    normals = torch.nn.functional.normalize(torch.tensor(draw.normal(size=(2, 2 * count, 3))), dim=-1)
    reference = torch.tensor(draw.normal(size=(2, count, 3)))
    matched = Round(points, places, normals, torch.tensor(draw.random((2, 2 * count))), points, reference)
    leaf = moved.clone().requires_grad_()
    off = leaf - places
    plane = torch.sqrt((off * normals).sum(-1) ** 2 + SOFT**2)
    (matched.share * (plane + 0.3 * torch.sqrt((off**2).sum(-1) + SOFT**2))).sum().backward()
    np.testing.assert_allclose(matched.pull(moved, 0.3), leaf.grad, atol=1e-12)

    leaf = moved[:, :count].clone().requires_grad_()
    apart = leaf - reference
    edges = np.array(trimesh.Trimesh(sphere.vertices, sphere.faces, process=False).edges_unique)
    (0.05 * ((apart[:, edges[:, 0]] - apart[:, edges[:, 1]]) ** 2).sum() / 2).backward()
    np.testing.assert_allclose(stiff(sphere, 0.05)(matched, moved[:, :count]), leaf.grad, atol=1e-12)

    leaf = moved[:, :count].clone().requires_grad_()
    uneven = sphere.laplacian(leaf) / 6
    uneven = uneven - (uneven * normals[:, :count]).sum(-1, keepdim=True) * normals[:, :count]
    (0.2 * torch.sqrt((uneven**2).sum(-1) + SOFT**2).mean(1)).sum().backward()
    np.testing.assert_allclose(even(sphere, 0.2)(matched, moved[:, :count]), leaf.grad, atol=1e-12)


def test_places_lie_on_the_exemplar_evenly_with_normals_outward():
    inward = BRICK.copy()
    inward.invert()
    for mesh in (BRICK, inward):
        places, normals = Target(mesh).draw(20_000, np.random.default_rng(0))
        side = np.abs(places / [0.5, 0.3, 0.25])
        np.testing.assert_allclose(side.max(1), 1)
        assert ((places * normals).sum(1) > 0.2).all()
        assert (side.argmax(1) == 0).mean() == pytest.approx(0.3 / (0.3 + 0.5 + 0.6), abs=2e-3)
        near, upright = Target(mesh).nearest(np.array([[0.9, 0.1, 0.1], [0, 0, -0.4]]))
        np.testing.assert_allclose(near, [[0.5, 0.1, 0.1], [0, 0, -0.25]])
        np.testing.assert_allclose(upright, [[1, 0, 0], [0, 0, -1]], atol=1e-12)


# Fitting.


@pytest.fixture(scope="module")
def start():
    return TINY.prepare([BALL, BRICK], mean=BALL, seed=0)


@pytest.fixture(scope="module")
def fitted(start):
    return TINY.fit(start, [EGG, POT, BRICK], seed=0)


def test_a_sphere_is_learned(start):
    mesh = TINY.decode(start, start["start"], resolution=10)
    assert topology(mesh) == topology(BALL)
    assert np.linalg.norm(mesh.vertices, axis=1) == pytest.approx(np.full(len(mesh.vertices), 0.5), abs=0.003)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.125, rel=0.02)  # 642 vertices: 1 % inside of the sphere


def test_ellipsoids_are_learned_and_the_stated_error_is_the_error(start, fitted):
    weights, error = fitted
    for w, told, mesh, radii in ((weights[0], error[0], EGG, FLAT), (weights[1], error[1], POT, TALL)):
        made = TINY.decode(start, w, resolution=10)
        apart = surface_distance(made, mesh)
        assert apart < 0.003
        assert told == pytest.approx(apart, rel=0.1)
        on = ((TINY.evaluate(start, w, spiral(3000, 0.5)) / radii) ** 2).sum(1)
        assert np.abs(np.sqrt(on) - 1).mean() < 0.015  # points that no vertex of the template is at


def test_a_mix_of_ellipsoids_is_the_ellipsoid_between(start, fitted):
    assert surface_distance(EGG, POT) > 0.05
    for alpha in (0.5, 0.25, 1.2):
        mixed = alpha * fitted[0][0] + (1 - alpha) * fitted[0][1]
        true = shapes.ellipsoid(alpha * FLAT + (1 - alpha) * TALL, divisions=4)
        assert surface_distance(TINY.decode(start, mixed, resolution=10), true) < 0.005


def test_training_lowers_the_error(start, fitted):
    assert fitted[1][2] < 0.5 * replace(TINY, steps=2).fit(start, [BRICK], seed=0)[1][0]


def test_an_exemplar_inside_out_is_fitted_alike(start, fitted):
    inward = BRICK.copy()
    inward.invert()
    weights, error = TINY.fit(start, [EGG, POT, inward], seed=0)
    assert error[2] == pytest.approx(fitted[1][2], rel=0.3)
    assert TINY.decode(start, weights[2], resolution=10).volume > 0


def test_same_seed_same_bits_another_seed_others(start, fitted):
    again = TINY.prepare([BALL, BRICK], mean=BALL, seed=0)
    for name, array in start.items():
        np.testing.assert_array_equal(again[name], array)
    np.testing.assert_array_equal(TINY.fit(again, [EGG, POT, BRICK], seed=0)[0], fitted[0])
    assert not np.array_equal(TINY.fit(start, [EGG, POT, BRICK], seed=1)[0], fitted[0])
    assert not np.array_equal(TINY.prepare([BALL], mean=BALL, seed=1)["start"], start["start"])


def test_batch_mates_do_not_matter(start, fitted):
    points = TINY.probes(start, 300, 0)
    beside = TINY.evaluate(start, fitted[0][1], points)
    for batch, place in (([POT], 0), ([BRICK, BRICK, EGG, POT], 3)):
        weights = TINY.fit(start, batch, seed=0)[0][place]
        np.testing.assert_allclose(TINY.evaluate(start, weights, points), beside, atol=1e-3)


def test_every_design_has_one_connectivity(start, fitted):
    meshes = [TINY.decode(start, w, resolution=r) for w, r in ((fitted[0][0], 10), (fitted[0].mean(0), 200))]
    np.testing.assert_array_equal(meshes[0].faces, meshes[1].faces)
    np.testing.assert_array_equal(meshes[0].faces, icosphere(3)[1])
    np.testing.assert_array_equal(meshes[0].vertices, TINY.evaluate(start, fitted[0][0], start["vertices"]))


# Abilities.


def test_pullback_against_central_differences(start, fitted):
    draw, weights = np.random.default_rng(0), fitted[0][2].astype(float)
    mesh = TINY.decode(start, weights, resolution=10)
    gradient = draw.normal(size=mesh.vertices.shape)
    found = TINY.pullback(start, weights, mesh, gradient)
    assert found.shape == weights.shape
    push, points = TINY._push(start), torch.tensor(start["vertices"])

    def value(w):
        return float((by_hand(push, torch.tensor(w), points) * torch.tensor(gradient)).sum())

    for _ in range(5):
        way, step = draw.normal(size=weights.shape), 1e-6
        slope = (value(weights + step * way) - value(weights - step * way)) / (2 * step)
        assert found @ way == pytest.approx(slope, rel=1e-6, abs=1e-6 * np.linalg.norm(found))


def test_volume_grows_along_its_gradient(start, fitted):
    weights = fitted[0][0].astype(float)
    mesh = TINY.decode(start, weights, resolution=10)
    gradient = np.zeros_like(mesh.vertices)
    for k in range(3):
        after, last = mesh.triangles[:, (k + 1) % 3], mesh.triangles[:, (k + 2) % 3]
        np.add.at(gradient, mesh.faces[:, k], np.cross(after, last) / 6)
    slope = TINY.pullback(start, weights, mesh, gradient)
    step = 1e-3 / np.linalg.norm(slope)
    volumes = [TINY.decode(start, weights + s * step * slope, resolution=10).volume for s in (-1, 1)]
    assert (volumes[1] - volumes[0]) / (2 * step) == pytest.approx(float(slope @ slope), rel=0.01)


def test_checks_of_a_good_design_and_of_a_folded_one(start, fitted):
    mesh = TINY.decode(start, fitted[0][0], resolution=10)
    good = TINY.design_checks(start, fitted[0][0], mesh)
    assert {check.name: check.value for check in good} == {"flipped": 0.0, "crossing": 0.0}
    assert all(check.passed for check in good)
    folded = mesh.copy()
    folded.vertices[:, 0] = np.where(
        folded.vertices[:, 0] > 0.3, 0.3 - 5 * (folded.vertices[:, 0] - 0.3), folded.vertices[:, 0]
    )
    bad = {check.name: check for check in TINY.design_checks(start, fitted[0][0], folded)}
    assert bad["flipped"].value > 0.1
    assert not bad["flipped"].passed
    assert bad["crossing"].value > 0
    assert not bad["crossing"].passed


# What it refuses.


def test_other_topologies_are_named_with_both_genera(start):
    torus = trimesh.creation.torus(0.4, 0.15)
    torus.metadata["name"] = "car_017"
    with pytest.raises(FitError, match=r"car_017: .*genus 0, got genus 1, bodies 1"):
        TINY.fit(start, [BALL, torus], seed=0)
    with pytest.raises(FitError, match=r"car_017: .*genus 0, got genus 1"):
        TINY.prepare([BALL], mean=torus, seed=0)
    pair = trimesh.util.concatenate([shapes.box((0.2, 0.2, 0.2)), shapes.box((0.2, 0.2, 0.2), centre=(0.5, 0, 0))])
    pair.metadata["name"] = "car_018"
    with pytest.raises(FitError, match=r"car_018: .*one body of genus 0, got genus 0, bodies 2"):
        TINY.fit(start, [pair], seed=0)


def test_loose_specks_are_left_out(start, caplog):
    speck = trimesh.creation.icosphere(0, radius=0.01)
    speck.apply_translation(BALL.bounds[1])
    dirty = trimesh.util.concatenate([BALL, speck])
    (plain,), (with_speck,) = (TINY.fit(start, [mesh], seed=0)[0] for mesh in (BALL, dirty))
    np.testing.assert_allclose(with_speck, plain, atol=1e-6)
    assert "1 loose specks" in caplog.text


def test_open_and_empty_meshes_are_named(start):
    sheet = trimesh.Trimesh(BALL.vertices, BALL.faces[1:], process=False)
    sheet.metadata["name"] = "car_019"
    with pytest.raises(FitError, match="car_019: expected a closed surface"):
        TINY.fit(start, [BALL, sheet], seed=0)
    empty = trimesh.Trimesh()
    empty.metadata["name"] = "car_020"
    with pytest.raises(FitError, match="car_020: expected a mesh with faces"):
        TINY.prepare([BALL], mean=empty, seed=0)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"width": 0}, "width: expected at least 1"),
        ({"depth": 0}, "depth: expected at least 1"),
        ({"octaves": -1}, "octaves: expected at least 0"),
        ({"degree": -1}, "degree: expected at least 0"),
        ({"steps": 0}, "steps: expected at least 1"),
        ({"start_steps": 0}, "start_steps: expected at least 1"),
        ({"subdivision": 0}, "subdivision: expected 1 to 8, got 0"),
        ({"subdivision": 9}, "subdivision: expected 1 to 8, got 9"),
        ({"learning_rate": 0.0}, "learning_rate: expected more than 0"),
        ({"learning_rate": float("nan")}, "learning_rate"),
        ({"point": -1.0}, "point: expected a finite number of at least 0"),
        ({"evenness": float("nan")}, "evenness"),
        ({"stiffness": float("inf")}, "stiffness"),
    ],
)
def test_options_that_cannot_be(options, said):
    with pytest.raises(InputError, match=said):
        PointTemplate(**options)


def test_arrays_that_do_not_fit(start):
    size, points = TINY._size(), spiral(4, 0)
    mesh = TINY.decode(start, start["start"], resolution=10)
    with pytest.raises(InputError, match=f"weights: expected {size} .*{size - 1}"):
        TINY.evaluate(start, np.zeros(size - 1), points)
    with pytest.raises(InputError, match=r"weights: expected one vector \(D,\)"):
        TINY.decode(start, np.zeros((2, size)), resolution=10)
    with pytest.raises(InputError, match=r"points: expected shape \(M, 3\), got \(4, 2\)"):
        TINY.evaluate(start, np.zeros(size), points[:, :2])
    with pytest.raises(InputError, match=r"points: expected points of the unit sphere, got one 0\.5 off it"):
        TINY.evaluate(start, np.zeros(size), 1.5 * points)
    with pytest.raises(InputError, match=rf"shared: expected start of shape \({size},\)"):
        TINY.fit({**start, "start": np.zeros(3)}, [BALL], seed=0)
    with pytest.raises(InputError, match="shared: expected ellipsoid of shape"):
        TINY.evaluate({}, np.zeros(size), points)
    with pytest.raises(InputError, match="gradient: expected"):
        TINY.pullback(start, start["start"], mesh, np.zeros((5, 3)))
    with pytest.raises(InputError, match="mesh: expected the template's 1280 faces, got"):
        TINY.design_checks(start, start["start"], BALL)
    assert TINY.evaluate(start, np.zeros((2, 5, size)), points).shape == (2, 5, 4, 3)
    assert TINY.evaluate(start, np.zeros(size), np.zeros((0, 3))).shape == (0, 3)


def test_weights_past_numbers_have_no_mesh(start):
    with pytest.raises(EmptyMesh, match="no numbers"):
        TINY.decode(start, np.full(TINY._size(), np.nan, np.float32), resolution=10)
