"""Decoder `sdf-mlp`: gradients against autograd, samples against exact distances, what fitting promises."""

import importlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
import pytest
import torch
import trimesh

from lampopt import Spec, build_bank, hookimpl, store_bank
from lampopt.bank import decoder_of
from lampopt.decode import decode
from lampopt.errors import FitError, InputError
from lampopt.plugins import Plugins
from lampopt.testing import decoder_checks, shapes
from lampopt.topology import topology
from lampopt_sdf import optimizer as stepping
from lampopt_sdf import training
from lampopt_sdf.half import HalfPass, native
from lampopt_sdf.network import BLOCK, Network, Pass, evaluate
from lampopt_sdf.optimizer import Optimizer, orthogonal
from lampopt_sdf.samples import draw, on_surface
from lampopt_sdf.sdf_mlp import SdfMlp

HERE = Path(__file__).parent
TUTORIAL = HERE.parent / "examples" / "third_party_decoder"
sys.path[:0] = [str(p) for p in (HERE, TUTORIAL) if str(p) not in sys.path]
toys = importlib.import_module("toys")
GridSDF = importlib.import_module("lampopt_gridsdf").GridSDF

CPU = torch.device("cpu")
TINY = SdfMlp(width=24, depth=2, octaves=2, start_steps=300, steps=150, points=512, samples=4000, tolerance=0.0)
BALL = shapes.ellipsoid((0.5, 0.5, 0.5), divisions=3)
BRICK = shapes.box((1.1, 0.7, 0.6))
EGG = shapes.ellipsoid((0.3, 0.5, 0.4), divisions=3)
NETWORKS = pytest.mark.parametrize(
    "network", [Network(16, 3, 2, "relu"), Network(16, 2, 0, "sine"), Network(5, 1, 3, "relu")], ids=str
)


@decoder_checks(SdfMlp.example())
def test_conforms(check):
    check()


def test_comes_in_by_the_front_door():
    assert Plugins.load().make("decoder", Spec("sdf-mlp", width=8)) == SdfMlp(width=8)


# The network.


def by_hand(network, weights, points):
    """The formula of the paper's appendix C, one weight vector (D,) at points (m, 3), in any precision."""
    hidden = [points]
    for k in range(network.octaves):
        hidden += [torch.sin(2**k * torch.pi * points), torch.cos(2**k * torch.pi * points)]
    hidden, at = torch.cat(hidden, -1), 0
    sizes = [3 + 6 * network.octaves, *[network.width] * network.depth, 1]
    for k in range(len(sizes) - 1):
        a, b = sizes[k], sizes[k + 1]
        hidden = hidden @ weights[at : at + a * b].reshape(a, b) + weights[at + a * b : at + a * b + b]
        at += a * b + b
        if k < len(sizes) - 2:
            hidden = torch.relu(hidden) if network.activation == "relu" else torch.sin(network.omega * hidden)
    assert at == len(weights)
    return hidden[:, 0]


@NETWORKS
def test_forward_and_backward_are_autograds(network):
    draw = np.random.default_rng(0)
    weights = torch.tensor(np.stack([network.initial(draw) for _ in range(3)]))
    points = torch.tensor(draw.uniform(-1, 1, (3, 300, 3)).astype(np.float32))
    given = torch.tensor(draw.normal(size=(3, 300, 1)).astype(np.float32))
    found = torch.zeros_like(weights)
    with torch.no_grad():
        run, features = Pass(network, 3, CPU), network.features(points)
        values = run.forward(network.layers(weights), features)
        run.backward(network.layers(weights), network.layers(found), features, given.clone())
        once = found.clone()
        run.backward(network.layers(weights), network.layers(found), features, given.clone())
    for i in range(3):
        leaf = weights[i].double().requires_grad_()
        wanted = by_hand(network, leaf, points[i].double())
        (wanted * given[i, :, 0].double()).sum().backward()
        np.testing.assert_allclose(values[i, :, 0], wanted.detach(), atol=2e-6)
        room = 5e-6 * float(leaf.grad.abs().max())
        np.testing.assert_allclose(once[i], leaf.grad, atol=room)
        np.testing.assert_allclose(found[i], 2 * leaf.grad, atol=2 * room)  # it adds


@NETWORKS
def test_evaluate_is_the_formula_in_one_flat_vector(network):
    draw = np.random.default_rng(1)
    weights, points = network.initial(draw), draw.uniform(-1, 1, (2 * BLOCK + 37, 3))
    assert weights.shape == (network.size,)
    assert weights.dtype == np.float32
    wanted = by_hand(network, torch.tensor(weights).double(), torch.tensor(points.astype(np.float32)).double())
    np.testing.assert_allclose(evaluate(network, weights, points, CPU), wanted, atol=2e-6)
    decoder = SdfMlp(width=network.width, depth=network.depth, octaves=network.octaves, activation=network.activation)
    np.testing.assert_allclose(decoder.evaluate({}, weights, points)[:, 0], wanted, atol=2e-6)


def test_layers_are_views_of_the_flat_vector():
    network = Network(4, 1, 0, "relu")
    assert network.shapes == ((3, 4), (4, 1))
    assert network.size == 3 * 4 + 4 + 4 + 1
    flat = torch.arange(21.0)[None]
    (first, bias), (last, end) = network.layers(flat)
    assert first[0].tolist() == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]]
    assert bias[0, 0].tolist() == [12, 13, 14, 15]
    assert last[0, :, 0].tolist() == [16, 17, 18, 19]
    assert end[0, 0].tolist() == [20]
    first.zero_()
    assert flat[0, :12].sum() == 0


@pytest.mark.parametrize("octaves", [0, 1, 4])
def test_features(octaves):
    z = torch.tensor([[0.25, -0.5, 1.0]])
    found = Network(4, 1, octaves, "relu").features(z)[0].numpy()
    waves = [wave(2**k * np.pi * z[0].numpy()) for k in range(octaves) for wave in (np.sin, np.cos)]
    np.testing.assert_allclose(found, np.concatenate([z[0].numpy(), *waves]), atol=1e-6)


@NETWORKS
def test_random_starts_neither_die_nor_burst(network):
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    for seed in range(5):
        values = evaluate(network, network.initial(np.random.default_rng(seed)), points, CPU)
        assert 1e-3 < values.std() < 3


# Samples.


def to_box(points, half):
    q = np.abs(points) - half
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)


def sampled(mesh, count=4000, seed=0):
    return draw(mesh, count, np.random.SeedSequence(seed))


def test_distances_are_exact_for_a_box():
    points, distances, surface = sampled(shapes.box((1.1, 0.7, 0.6)))
    assert (points.shape, distances.shape, surface.shape) == ((4000, 3), (4000,), (1000, 3))
    assert points.dtype == distances.dtype == np.float32
    np.testing.assert_allclose(distances, to_box(points.astype(float), np.array([0.55, 0.35, 0.3])), atol=1e-6)
    np.testing.assert_allclose(to_box(surface, np.array([0.55, 0.35, 0.3])), 0, atol=1e-9)


def test_distances_of_a_sphere():
    points, distances, surface = sampled(trimesh.creation.icosphere(subdivisions=5, radius=0.5))
    # the facets' middles lie below 4e-4 within the sphere (edge 0.035: circumradius²/2r), nothing lies outside it
    off = distances - (np.linalg.norm(points.astype(float), axis=1) - 0.5)
    assert off.min() > -1e-6
    assert off.max() < 4e-4
    np.testing.assert_allclose(np.linalg.norm(surface, axis=1), 0.5, atol=4e-4)


def test_a_torn_surface_keeps_sides_and_exact_distances():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    torn = ball.copy()
    torn.update_faces(np.arange(len(ball.faces)) % 97 > 0)
    assert not torn.is_watertight
    points, distances, _ = sampled(torn)
    points = points.astype(float)
    away = np.linalg.norm(points, axis=1) - 0.5
    clear = np.abs(away) > 0.03  # farther from the surface than a hole is wide
    np.testing.assert_array_equal(np.sign(distances[clear]), np.sign(away[clear]))
    squared = igl.point_mesh_squared_distance(points, np.asarray(torn.vertices), np.asarray(torn.faces, np.int64))[0]
    np.testing.assert_allclose(np.abs(distances), np.sqrt(squared), atol=1e-6)


def test_overlapping_bodies_are_one_inside():
    both = trimesh.util.concatenate([shapes.box((1, 0.4, 0.4)), shapes.box((0.4, 1, 0.4))])
    points, distances, _ = sampled(both)
    inside = (to_box(points, np.array([0.5, 0.2, 0.2])) < -1e-3) | (to_box(points, np.array([0.2, 0.5, 0.2])) < -1e-3)
    outside = np.minimum(to_box(points, np.array([0.5, 0.2, 0.2])), to_box(points, np.array([0.2, 0.5, 0.2]))) > 1e-3
    assert (distances[inside] < 0).all()
    assert (distances[outside] > 0).all()


def test_most_points_are_near_the_surface_and_some_anywhere():
    points, distances, _ = sampled(BRICK, 10_000)
    assert (np.abs(distances) < 0.05).mean() > 0.6
    assert (np.abs(points) > 0.8).any(1).mean() > 0.05
    assert 0.3 < (distances < 0).mean() < 0.6


def test_samples_repeat_for_a_seed():
    for a, b in zip(sampled(EGG), sampled(EGG), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(sampled(EGG)[0], sampled(EGG, seed=1)[0])


def test_surface_points_are_even_and_correspond():
    solid = shapes.box((2, 1, 1), divisions=1)
    vertices, faces = np.asarray(solid.vertices), np.asarray(solid.faces)
    for seed in range(5):
        points = on_surface(vertices, faces, 10_000, np.random.default_rng(seed))
        ends = np.abs(points[:, 0]) > 1 - 1e-9
        assert ends.mean() == pytest.approx(0.2, abs=1e-3)  # 2 of 10 in area; strata leave little to chance
    points = on_surface(vertices, faces, 10_000, np.random.default_rng(0))
    shift = np.array([0.1, 0, 0])
    moved = on_surface(vertices + shift, faces, 10_000, np.random.default_rng(0))
    np.testing.assert_allclose(moved, points + shift, atol=1e-12)


def test_meshes_that_cannot_be_fitted_are_named():
    sheet = trimesh.Trimesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    sheet.metadata["name"] = "car_017"
    with pytest.raises(FitError, match="car_017: encloses nothing"):
        TINY.fit({"start": np.zeros(TINY._network().size, np.float32)}, [BALL, sheet], seed=0)
    empty = trimesh.Trimesh()
    empty.metadata["name"] = "car_018"
    with pytest.raises(FitError, match="car_018: expected a mesh with faces"):
        TINY.prepare([BALL], mean=empty, seed=0)


def test_a_surface_turned_inside_out_encloses_the_same():
    inward = BRICK.copy()
    inward.invert()
    points, distances, _ = sampled(inward)
    np.testing.assert_allclose(distances, to_box(points.astype(float), np.array([0.55, 0.35, 0.3])), atol=1e-6)


# Fitting.


@pytest.fixture(scope="module")
def start():
    return TINY.prepare([BALL, BRICK], mean=BALL, seed=0)


@pytest.fixture(scope="module")
def fitted(start):
    return TINY.fit(start, [BALL, BRICK], seed=0)


def test_a_sphere_is_learned():
    decoder = SdfMlp.example()
    shared = decoder.prepare([BALL], mean=BALL, seed=0)
    weights, error = decoder.fit(shared, [BALL], seed=0)
    assert error[0] < 0.004  # of half the box; 0.0016 was reached when this was written
    points = np.random.default_rng(0).uniform(-0.9, 0.9, (20_000, 3))
    true = np.linalg.norm(points, axis=1) - 0.5
    near = np.abs(true) < 0.05
    off = np.abs(decoder.evaluate(shared, weights[0], points[near])[:, 0] - true[near])
    assert off.mean() < 0.01  # not only its zero: it is a distance beside the surface
    mesh = decoder.decode(shared, weights[0], resolution=48)
    assert topology(mesh) == topology(BALL)
    assert np.linalg.norm(mesh.vertices, axis=1) == pytest.approx(np.full(len(mesh.vertices), 0.5), abs=0.02)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.125, rel=0.02)


def test_sine_learns_it_too():
    decoder = replace(SdfMlp.example(), activation="sine", octaves=0, start_steps=400)
    shared = decoder.prepare([BALL], mean=BALL, seed=0)
    assert decoder.fit(shared, [BALL], seed=0)[1][0] < 0.004


def test_a_value_does_not_depend_on_the_points_beside_it(start, fitted):
    points, draw = np.random.default_rng(0).uniform(-1, 1, (3 * BLOCK + 5, 3)), np.random.default_rng(1)
    whole = TINY.evaluate(start, fitted[0][1], points)
    for size in (1, 7, BLOCK, 2 * BLOCK + 1):
        some = draw.permutation(len(points))[:size]
        np.testing.assert_array_equal(TINY.evaluate(start, fitted[0][1], points[some]), whole[some])


# How weights step.


def test_orthogonal_turns_all_directions_alike():
    matrices = torch.tensor(np.random.default_rng(0).normal(size=(3, 24, 24)) * [[[1e-6]], [[1.0]], [[1e6]]]).float()
    for precision in (torch.float32, torch.bfloat16):
        found = orthogonal(matrices, precision).float()
        sizes = torch.linalg.svdvals(found)
        assert float(sizes[:, :-3].min()) > 0.6  # the least of a square matrix are too small to come up in five rounds
        assert float(sizes.max()) < 1.3
        nearest = [torch.linalg.svd(matrix) for matrix in matrices]
        for one, (left, _, right) in zip(found, nearest, strict=True):
            along = torch.diagonal(left.T @ one @ right.T)  # its singular directions are kept
            assert float(along[:-3].min()) > 0.5
    for tiny in (0.0, 1e-24, 1e-19, 1e-14):  # momentum of a layer that has died fades away
        assert torch.isfinite(orthogonal(torch.full((1, 4, 4), tiny))).all()


@pytest.mark.parametrize("depth", [1, 3])
def test_without_reach_every_weight_takes_adams_step(depth):
    network, draw = Network(6, depth, 1, "relu"), np.random.default_rng(0)
    weights = torch.tensor(draw.normal(size=(2, network.size))).float()
    gradients = torch.tensor(draw.normal(size=(4, 2, network.size))).float()
    leaf = weights.clone().requires_grad_()
    adam = torch.optim.Adam([leaf], lr=0.01, betas=(0.9, 0.99), eps=1e-10)
    optimizer = Optimizer(network, weights, reach=0.0 if depth > 1 else 0.3)  # there is nothing hidden to turn
    for gradient in gradients:
        leaf.grad = gradient.clone()
        adam.step()
        weights.grad.copy_(gradient)
        optimizer.step(0.01)
    np.testing.assert_allclose(weights, leaf.detach(), rtol=1e-5, atol=1e-6)


def test_orthogonal_steps_are_of_hidden_matrices_alone():
    network, draw = Network(6, 3, 1, "relu"), np.random.default_rng(0)
    weights = torch.tensor(draw.normal(size=(2, network.size))).float()
    gradient = torch.tensor(draw.normal(size=(2, network.size))).float()
    stepped = {}
    for reach in (0.0, 0.5):
        own = weights.clone()
        optimizer = Optimizer(network, own, reach=reach)
        own.grad.copy_(gradient)
        optimizer.step(0.01)
        stepped[reach] = network.layers(own)
    for k, (before, adam, muon) in enumerate(zip(network.layers(weights), *stepped.values(), strict=True)):
        np.testing.assert_array_equal(adam[1], muon[1])
        if k in (0, 3):
            np.testing.assert_array_equal(adam[0], muon[0])
        else:
            wanted = orthogonal(network.layers(gradient)[k][0]) * (0.01 * 0.5 * 6**0.5)
            np.testing.assert_allclose(before[0] - muon[0], wanted, atol=1e-6)


def test_orthogonal_steps_look_ahead_along_their_momentum():
    network, draw = Network(6, 3, 1, "relu"), np.random.default_rng(0)
    weights = torch.tensor(draw.normal(size=(2, network.size))).float()
    gradients = torch.tensor(draw.normal(size=(3, 2, network.size))).float()
    optimizer, wanted = Optimizer(network, weights, reach=0.5), network.layers(weights.clone())[1][0]
    momentum = torch.zeros_like(wanted)
    for gradient in gradients:
        weights.grad.copy_(gradient)
        optimizer.step(0.01)
        own = network.layers(gradient)[1][0]
        momentum = 0.95 * momentum + own
        wanted = wanted - 0.01 * 0.5 * 6**0.5 * orthogonal(own + 0.95 * momentum)  # Nesterov's
        np.testing.assert_allclose(network.layers(weights)[1][0], wanted, atol=1e-6)


def test_those_that_go_on_keep_their_momentum():
    network, draw = Network(6, 3, 1, "relu"), np.random.default_rng(0)
    gradients = torch.tensor(draw.normal(size=(4, 3, network.size))).float()
    whole, keep = torch.tensor(draw.normal(size=(3, network.size))).float(), torch.tensor([True, False, True])
    all_three, two = Optimizer(network, whole, reach=0.2), None
    for k, gradient in enumerate(gradients):
        if k == 2:
            some = whole[keep]
            two = all_three.only(keep, some)
        if two is not None:
            some.grad.copy_(gradient[keep])
            two.step(0.01)
        whole.grad.copy_(gradient)
        all_three.step(0.01)
    np.testing.assert_allclose(some, whole[keep], atol=1e-5)


@pytest.mark.parametrize("points", [7, BLOCK])
@pytest.mark.parametrize("network", [Network(16, 3, 2, "relu"), Network(5, 1, 3, "relu")], ids=str)
def test_half_the_bits_give_nearly_the_same_values_and_directions(network, points):
    draw = np.random.default_rng(0)
    weights = torch.tensor(np.stack([network.initial(draw) for _ in range(3)]))
    features = network.features(torch.tensor(draw.uniform(-1, 1, (3, points, 3))).float())
    given = torch.tensor(draw.normal(size=(3, points, 1))).float()
    values, sums = [], []
    for kind in (Pass, HalfPass):
        found, run, layers = torch.ones_like(weights), kind(network, 3, CPU), network.layers(weights)
        values.append(run.forward(layers, features))
        run.backward(layers, network.layers(found), features, given.clone())
        sums.append(found - 1)
    assert float((values[1] - values[0]).abs().max()) < 0.02 * float(values[0].abs().max())
    for exact, rough in zip(network.layers(sums[0]), network.layers(sums[1]), strict=True):
        for one, other in zip(exact, rough, strict=True):
            assert float((one - other).norm()) < 0.06 * float(one.norm())  # a step's direction within 3.5 degrees


def test_four_steps_of_five_are_in_half_the_bits(start, monkeypatch):
    turned, turn = [], stepping.orthogonal
    monkeypatch.setattr(stepping, "orthogonal", lambda given, kind: turned.append(kind) or turn(given, kind))
    calls, forward = [], HalfPass.forward
    monkeypatch.setattr(HalfPass, "forward", lambda self, *given: calls.append(len(given[1])) or forward(self, *given))
    decoder = replace(TINY, precision="bfloat16")
    weights, error = decoder.fit(start, [EGG, BRICK], seed=0)
    assert calls == [2] * (4 * TINY.steps // 5)
    assert turned == [torch.bfloat16] * len(calls) + [torch.float32] * (TINY.steps - len(calls))
    exact = replace(TINY, precision="float32").fit(start, [EGG, BRICK], seed=0)[0]
    assert calls == [2] * (4 * TINY.steps // 5)
    assert not np.array_equal(weights, exact)
    replace(decoder, tolerance=float(error.mean())).fit(start, [EGG, BRICK], seed=0)
    assert calls[-1] == 1  # the one that is not finished goes on in half the bits


@pytest.mark.parametrize("optimizer", ["muon", "adam"])
def test_half_the_bits_lose_nothing(optimizer):
    errors = []
    for precision in ("float32", "bfloat16"):
        decoder = replace(SdfMlp.example(), optimizer=optimizer, precision=precision)
        shared = decoder.prepare([BALL, BRICK], mean=BALL, seed=0)
        errors.append(decoder.fit(shared, [BALL, BRICK], seed=0)[1].mean())
    assert errors[1] < 1.15 * errors[0]


def test_orthogonal_steps_stay_nearer_to_the_start_at_the_same_error(start):
    errors, away = [], []
    for optimizer in ("adam", "muon"):
        weights, error = replace(TINY, optimizer=optimizer, precision="float32").fit(start, [EGG, BRICK], seed=0)
        errors.append(error.mean())
        away.append(np.linalg.norm(weights - start["start"], axis=1).mean())
    assert errors[1] < 1.25 * errors[0]
    assert away[1] < 0.85 * away[0]


def test_bfloat16_is_taken_where_the_processor_knows_it(monkeypatch):
    for capable, wanted in (({"avx512_bf16": True}, True), ({"amx_bf16": True}, True), ({"avx512_f": True}, False)):
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda capable=capable: capable)
        assert native(CPU) is wanted
        assert SdfMlp()._half() is wanted
        assert not SdfMlp(activation="sine")._half()
        assert SdfMlp(precision="bfloat16")._half()
        assert not SdfMlp(precision="float32")._half()
    assert not native(torch.device("meta"))


def test_training_lowers_the_error(start, fitted):
    short = replace(TINY, steps=5).fit(start, [BRICK], seed=0)[1][0]
    assert fitted[1][1] < 0.3 * short


def test_the_stated_error_is_the_error(start, fitted):
    weights, error = fitted
    surface = np.asarray(BRICK.sample(20_000, seed=0))
    assert np.abs(TINY.evaluate(start, weights[1], surface)).mean() == pytest.approx(error[1], rel=0.1)


def test_same_seed_same_bits_another_seed_others(start, fitted):
    again = TINY.prepare([BALL, BRICK], mean=BALL, seed=0)
    np.testing.assert_array_equal(again["start"], start["start"])
    np.testing.assert_array_equal(TINY.fit(again, [BALL, BRICK], seed=0)[0], fitted[0])
    assert not np.array_equal(TINY.fit(start, [BALL, BRICK], seed=1)[0], fitted[0])
    assert not np.array_equal(TINY.prepare([BALL], mean=BALL, seed=1)["start"], start["start"])


@pytest.mark.parametrize("own", [False, True], ids=["one order", "own orders"])
def test_batch_mates_do_not_matter(start, own):
    decoder = replace(TINY, seed_per_exemplar=own)
    points = TINY.probes({}, 300, 0)
    alone = decoder.evaluate(start, decoder.fit(start, [BRICK], seed=0)[0][0], points)
    for batch, place in (([BALL, BRICK], 1), ([BRICK, EGG, EGG], 0), ([EGG, BALL, EGG, BRICK], 3)):
        weights = decoder.fit(start, batch, seed=0)[0][place]
        np.testing.assert_allclose(decoder.evaluate(start, weights, points), alone, atol=1e-3)


def test_a_seed_per_exemplar_draws_apart(start, fitted):
    own = replace(TINY, seed_per_exemplar=True)
    weights, _ = own.fit(start, [BALL, BRICK], seed=0)
    assert (np.abs(weights - fitted[0]).max(1) > 1e-3).all()
    twice, _ = own.fit(start, [BALL, BALL], seed=0)
    # The seed belongs to the mesh, not to its place; on some processors BLAS rounds by where in memory a matrix lies.
    np.testing.assert_allclose(twice[0], twice[1], atol=1e-5)


def test_a_finished_exemplar_stops_and_leaves_the_others(start, monkeypatch):
    meshes = [EGG, BRICK]  # neither is the mean that the start was fitted to
    weights, error = TINY.fit(start, meshes, seed=0)
    first, last = np.argsort(error)
    between = float(error.mean())  # one reaches this, the other does not
    assert error[first] < 0.97 * between
    sizes = []
    step = training._Batch.step
    monkeypatch.setattr(
        training._Batch,
        "step",
        lambda self, *given, **how: sizes.append(len(self.weights)) or step(self, *given, **how),
    )
    stopped, reached = replace(TINY, tolerance=between).fit(start, meshes, seed=0)
    assert sizes == sorted(sizes, reverse=True) and {*sizes} == {2, 1}  # it costs no more steps
    assert not np.array_equal(stopped[first], weights[first])
    assert reached[first] == pytest.approx(between, rel=0.3)  # judged on some of the points, then on all
    # Some processors round products of one matrix otherwise than those of two.
    np.testing.assert_allclose(stopped[last], weights[last], atol=1e-3)
    assert reached[last] == pytest.approx(error[last], rel=1e-2)


def test_when_all_are_finished_it_stops(start):
    told = []
    decoder = replace(TINY, steps=2000, tolerance=0.05)
    decoder.fit(start, [BALL, BRICK], seed=0, progress=lambda done, message="": told.append(done))
    assert told[-1] == 1
    assert told[-2:-1] < [0.5]  # or nothing at all before the end


def mismatch(decoder, meshes):
    shared = decoder.prepare(meshes, mean=meshes[0], seed=0)
    weights, error = decoder.fit(shared, meshes, seed=0)
    points = decoder.probes(shared, 2000, 1)
    values = decoder.evaluate(shared, weights, points)
    middle = decoder.evaluate(shared, weights.mean(0), points)
    return float(np.abs(middle - values.mean(0)).mean()), error


@pytest.mark.parametrize(
    "meshes",
    [
        [BALL, shapes.ellipsoid((0.4, 0.4, 0.4), divisions=3)],
        [shapes.box((1, 0.7, 0.6)), shapes.box((1.2, 0.7, 0.6))],
    ],
    ids=["spheres", "boxes"],
)
def test_without_a_shared_start_weights_do_not_mix(meshes):
    shared, _ = mismatch(TINY, meshes)
    own, error = mismatch(replace(TINY, shared_start=False), meshes)
    assert error.max() < 0.02  # each is fitted well by itself
    assert shared < 0.01  # the paper's limit
    assert own > 0.05
    assert own > 10 * shared  # 150 times for SdfMlp.example()


def test_no_shared_start_ignores_the_mean():
    ablation = replace(TINY, shared_start=False)
    a, b = (ablation.prepare([BALL, BRICK], mean=mean, seed=0)["start"] for mean in (BALL, BRICK))
    np.testing.assert_array_equal(a, b)


# What it refuses.


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"width": 0}, "width: expected at least 1"),
        ({"depth": 0}, "depth: expected at least 1"),
        ({"octaves": -1}, "octaves: expected at least 0"),
        ({"steps": 0}, "steps: expected at least 1"),
        ({"start_steps": 0}, "start_steps: expected at least 1"),
        ({"points": 0}, "points: expected at least 1"),
        ({"samples": 10, "points": 20}, "samples: expected at least as many as points"),
        ({"activation": "tanh"}, "activation: expected one of relu, sine, got 'tanh'"),
        ({"optimizer": "sgd"}, "optimizer: expected one of muon, adam, got 'sgd'"),
        ({"precision": "float16"}, "precision: expected one of auto, float32, bfloat16, got 'float16'"),
        ({"precision": "bfloat16", "activation": "sine"}, "precision: a sine of bfloat16 is noise"),
        ({"learning_rate": -1.0}, "learning_rate"),
        ({"tolerance": 1.0}, "tolerance"),
        ({"tolerance": float("nan")}, "tolerance"),
    ],
)
def test_options_that_cannot_be(options, said):
    with pytest.raises(InputError, match=said):
        SdfMlp(**options)


def test_arrays_that_do_not_fit(start):
    size = TINY._network().size
    with pytest.raises(InputError, match=f"weights: expected {size} .*{size - 1}"):
        TINY.evaluate(start, np.zeros(size - 1), np.zeros((4, 3)))
    with pytest.raises(InputError, match=r"points: expected shape \(M, 3\), got \(4, 2\)"):
        TINY.evaluate(start, np.zeros(size), np.zeros((4, 2)))
    with pytest.raises(InputError, match=rf"shared: expected start weights of shape \({size},\)"):
        TINY.fit({"start": np.zeros(3)}, [BALL], seed=0)
    with pytest.raises(InputError, match="shared: expected start weights"):
        TINY.fit({}, [BALL], seed=0)
    assert TINY.evaluate(start, np.zeros((2, 5, size)), np.zeros((4, 3))).shape == (2, 5, 4, 1)
    assert TINY.evaluate(start, np.zeros(size), np.zeros((0, 3))).shape == (0, 1)


# Three decoders, each rebuilt from a stored bank in a fresh process.


class Offers:
    @hookimpl
    def lampopt_decoders(self):
        return {"grid": GridSDF, "radial": toys.Radial}


FRESH = """
import sys, json
sys.path[:0] = sys.argv[2:]
import numpy as np, toys
from lampopt import hookimpl, load_bank
from lampopt.bank import decoder_of
from lampopt.decode import decode
from lampopt.plugins import Plugins
from lampopt_gridsdf import GridSDF

class Offers:
    @hookimpl
    def lampopt_decoders(self):
        return {"grid": GridSDF, "radial": toys.Radial}

plugins = Plugins.load([("mine", Offers())])
answer = {}
for name in ("grid", "radial", "sdf-mlp"):
    bank = load_bank(f"{sys.argv[1]}/{name}.lamp")
    decoder = decoder_of(bank, plugins)
    values = np.stack([decoder.evaluate(bank.shared, w, bank.probes) for w in bank.weights])
    mesh = decode(bank, decoder, bank.weights.mean(0), resolution=32)
    answer[name] = [repr(decoder), float(np.abs(values - bank.probe_values).max()), mesh.volume, mesh.units]
print(json.dumps(answer))
"""


def test_three_decoders_come_back_from_their_files_in_a_fresh_process(tmp_path):
    plugins = Plugins.load([("mine", Offers())])
    options = {"steps": 50, "start_steps": 100, "width": 16, "depth": 2, "points": 256, "samples": 2000}
    specs = [Spec("grid", size=20), Spec("radial", divisions=3), Spec("sdf-mlp", **options)]
    wanted = {}
    for spec in specs:
        bank = store_bank(
            build_bank(toys.Boxes(count=3)(), spec, probes=300, plugins=plugins), tmp_path / f"{spec.name}.lamp"
        )
        decoder = decoder_of(bank, plugins)
        mesh = decode(bank, decoder, bank.weights.mean(0), resolution=32)
        wanted[spec.name] = (repr(decoder), mesh.volume)
    done = subprocess.run(
        [sys.executable, "-c", FRESH, tmp_path, HERE, TUTORIAL], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert set(answer) == set(wanted)
    for name, (options, apart, volume, unit) in answer.items():
        assert options == wanted[name][0]
        assert apart < 1e-6
        assert volume == pytest.approx(wanted[name][1], rel=1e-6)
        assert unit == "m"
