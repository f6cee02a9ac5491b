"""What a decoder has to do. Lengths are compared as parts of half the decoder's box."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from lampopt.errors import EmptyMesh, FitError
from lampopt.protocols import Decoder, Follow
from lampopt.testing import fresh
from lampopt.testing.bench import (
    BOX,
    LONGER,
    RESOLUTION,
    ROUND,
    SEED,
    bench,
    fit_again,
    mean_distance,
    same_mesh,
    writable,
)
from lampopt.testing.engine import (
    COMMON,
    CheckFunction,
    NotApplicable,
    changed_states,
    expect,
    must_raise,
    random_state,
    require,
)
from lampopt.testing.slopes import check_adjoint_agrees_with_differences, check_pullback_agrees_with_differences
from lampopt.types import Array

NEAR = 0.05  # mean distance of a fitted surface to its mesh
RATIO = 0.05  # how far a 1.2 times longer box may be off
MISMATCH = 0.01  # the paper's limit
WIDE = 0.1  # of the domain that probes span at least, along each axis
SAME = 1e-4  # what float32 may lose when points or weights are grouped otherwise


def check_protocol_and_bounds(decoder: Decoder) -> None:
    """Every stage calls these members and places meshes by these bounds."""
    require(decoder, Decoder)
    bounds = decoder.bounds
    good = isinstance(bounds, np.ndarray) and bounds.shape == (2, 3)
    expect(good, f"bounds: expected an array (2, 3), got {bounds!r}")
    expect(np.isfinite(bounds).all() and (bounds[1] > bounds[0]).all(), f"bounds: expected low < high, got {bounds}")


def check_prepare_gives_named_arrays(decoder: Decoder) -> None:
    """What exemplars share is written to the bank's file, which holds named arrays of numbers and nothing else."""
    shared = bench(decoder).prepared
    expect(isinstance(shared, Mapping), f"prepare: expected a mapping, got {type(shared).__name__}")
    for name, array in shared.items():
        expect(isinstance(name, str) and name, f"prepare: expected text as names, got {name!r}")
        good = isinstance(array, np.ndarray) and array.dtype.kind in "biuf"
        expect(good, f"prepare: {name!r}: expected a numpy array of numbers, got {type(array).__name__}")
        expect(np.isfinite(array).all(), f"prepare: {name!r}: expected finite values")


def check_prepare_is_deterministic(decoder: Decoder) -> None:
    """A bank that is resumed or built again has to start from the same place."""
    b = bench(decoder)
    again = decoder.prepare([m.copy() for m in b.meshes], mean=b.meshes[BOX].copy(), seed=SEED)
    expect(set(again) == set(b.shared), f"prepare: first gave {sorted(b.shared)}, then {sorted(again)}")
    differing = [name for name in b.shared if not np.array_equal(again[name], b.shared[name])]
    expect(not differing, f"prepare: two calls with seed {SEED} differ in {differing}")


def check_weights_are_flat_float32(decoder: Decoder) -> None:
    """Mixing is one matrix product, so weights are finite rows of one length whatever the meshes' topology."""
    b = bench(decoder)
    good = b.weights.ndim == 2 and len(b.weights) == len(b.meshes) and b.weights.shape[1] > 0
    expect(good, f"fit: expected weights ({len(b.meshes)}, D), got {b.weights.shape}")
    expect(b.weights.dtype == np.float32, f"fit: expected float32 weights, got {b.weights.dtype}")
    expect(np.isfinite(b.weights).all(), "fit: expected finite weights")


def check_fit_error_is_stated(decoder: Decoder) -> None:
    """A bank lists how well each exemplar was fitted, so that a bad one is seen before it is mixed."""
    b = bench(decoder)
    expect(b.error.shape == (len(b.meshes),), f"fit: expected error ({len(b.meshes)},), got {b.error.shape}")
    expect((np.isfinite(b.error) & (b.error >= 0)).all(), f"fit: expected errors of at least 0, got {b.error}")


def check_fit_is_deterministic(decoder: Decoder) -> None:
    """Hidden randomness makes a result that nobody can repeat."""
    b = bench(decoder)
    expect(np.array_equal(fit_again(b, [BOX, LONGER, ROUND]), b.weights), f"fit: two calls with seed {SEED} differ")


def check_fit_leaves_its_inputs(decoder: Decoder) -> None:
    """The shared start belongs to every exemplar, and the meshes to the user."""
    b = bench(decoder)
    expect(not b.touched, f"fit changed {', '.join(b.touched)}")


def check_global_random_state_is_left(decoder: Decoder) -> None:
    """A decoder that draws from a global generator changes, and is changed by, everything around it."""
    b, before = bench(decoder), random_state()  # torch, where it has been loaded meanwhile, is watched now
    decoder.fit(writable(b.shared), [b.meshes[BOX].copy()], seed=SEED + 1)  # the same seed would leave the same state
    moved = sorted({*b.moved, *changed_states(before, random_state())})
    expect(not moved, f"the global random state of {', '.join(moved)} moved; draw from a generator made of `seed`")


def check_progress_runs_from_0_to_1(decoder: Decoder) -> None:
    """Progress bars and callers that wait read the fraction done."""
    reports = np.array(bench(decoder).reports, float)
    ordered = ((reports >= 0) & (reports <= 1)).all() and (np.diff(reports) >= 0).all()
    expect(ordered, f"fit: expected progress from 0 up to 1, got {reports[:5]} … {reports[-5:]}")


def check_fit_ignores_batch_mates(decoder: Decoder) -> None:
    """An exemplar added later is fitted in another batch and still has to lie where the others do."""
    b = bench(decoder)
    apart = np.abs(b.evaluate(fit_again(b, [ROUND, LONGER])[1]) - b.evaluate(b.weights[LONGER])).mean() / b.half
    expect(apart < MISMATCH, f"a mesh fitted in another batch evaluates {apart:.4f} apart, expected < {MISMATCH}")


def check_evaluate_gives_points_by_channels(decoder: Decoder) -> None:
    """Mismatch and field checks rely on finite values (M, C)."""
    b = bench(decoder)
    values = b.evaluate(b.weights[BOX])
    good = values.ndim == 2 and len(values) == len(b.points) and values.shape[1] > 0
    expect(good, f"evaluate: expected ({len(b.points)}, C), got {values.shape}")
    expect(np.isfinite(values).all(), "evaluate: expected finite values")


def check_evaluate_is_pointwise(decoder: Decoder) -> None:
    """Points are evaluated in chunks; statistics over a batch of points would make the cuts visible."""
    b = bench(decoder)
    whole, cut = b.evaluate(b.weights[ROUND]), len(b.points) // 3
    parts = np.concatenate([b.evaluate(b.weights[ROUND], part) for part in np.split(b.points, [1, cut])])
    apart = np.abs(whole - parts).max()
    expect(apart <= SAME * b.half, f"evaluate: points in chunks and as a whole differ by {apart:.2e}")


def check_evaluate_is_stateless(decoder: Decoder) -> None:
    """Designs are evaluated in any order and in several threads; memory of the last one would leak into the next."""
    b = bench(decoder)
    first = b.evaluate(b.weights[BOX])
    b.evaluate(b.weights[ROUND])
    expect(np.array_equal(first, b.evaluate(b.weights[BOX])), "evaluate: a, b, a gives two values for a")


def check_evaluate_takes_batches_of_weights(decoder: Decoder) -> None:
    """Sweeps evaluate many designs at once and have to see what a single design gives."""
    b = bench(decoder)
    single = np.stack([b.evaluate(w) for w in b.weights])
    batch = b.evaluate(b.weights[:, None])
    wanted = (len(single), 1, *single.shape[1:])
    expect(batch.shape == wanted, f"evaluate: weights {b.weights[:, None].shape} give {batch.shape}, expected {wanted}")
    apart = np.abs(batch[:, 0] - single).max()
    expect(apart <= SAME * b.half, f"evaluate: weights in a batch and one by one differ by {apart:.2e}")


def check_probes_cover_the_domain(decoder: Decoder) -> None:
    """Linearity is judged at these points, the same ones whenever the bank is read."""
    b = bench(decoder)
    low, high = np.asarray(decoder.bounds, float)
    expect(b.points.shape == (500, 3), f"probes: expected shape (500, 3), got {b.points.shape}")
    expect(((b.points >= low) & (b.points <= high)).all(), "probes: expected points inside of `bounds`")
    wide = np.ptp(b.points, axis=0) >= WIDE * (high - low)
    expect(wide.all(), f"probes: expected points all over the domain, they span {np.ptp(b.points, axis=0).tolist()}")
    again = decoder.probes(writable(b.shared), 500, SEED)
    expect(np.array_equal(again, b.points), f"probes: two calls with seed {SEED} differ")


def check_decode_gives_a_closed_mesh(decoder: Decoder) -> None:
    """Volumes, printing and meshing for flow need a closed surface with faces outward."""
    b = bench(decoder)
    low, high = np.asarray(decoder.bounds, float)
    for weights in b.weights:
        mesh = b.decode(weights)
        expect(mesh.is_watertight, "decode: expected a closed mesh")
        expect(mesh.is_winding_consistent and mesh.volume > 0, f"decode: faces point inward, volume {mesh.volume:.3g}")
        inside = (np.asarray(mesh.vertices) >= low - 1e-6) & (np.asarray(mesh.vertices) <= high + 1e-6)
        expect(inside.all(), f"decode: the mesh leaves `bounds`: {np.asarray(mesh.bounds).tolist()}")


def check_decode_is_deterministic(decoder: Decoder) -> None:
    """A design that is made again from its record has to be the same design."""
    b = bench(decoder)
    first = b.decode(b.weights[BOX])
    b.decode(b.weights[ROUND])
    expect(same_mesh(first, b.decode(b.weights[BOX])), "decode: a, b, a gives two meshes for a")


def check_follow_is_decode(decoder: Decoder) -> None:
    """A search sees meshes made one after another; a design is made alone, and has to be the one that was seen."""
    if not isinstance(decoder, Follow):
        raise NotApplicable("it makes every mesh anew")
    b = bench(decoder)
    follow = decoder.follow(writable(b.shared), resolution=RESOLUTION)
    way = [b.weights[BOX] + np.float32(t) * (b.weights[LONGER] - b.weights[BOX]) for t in (0.0, 0.01, 0.03, 0.02, 1.0)]
    for weights in (*way, b.weights[ROUND], way[0]):
        found, alone = follow(np.array(weights)), b.decode(weights)
        apart = max(mean_distance(found, alone), mean_distance(alone, found)) / b.half
        expect(apart <= SAME, f"follow: a mesh {apart:.2e} from that of decode, expected <= {SAME} [half box]")


def check_surface_is_near_the_mesh(decoder: Decoder) -> None:
    """A design can be no better than the exemplars it is mixed of."""
    b = bench(decoder)
    for mesh, weights in zip(b.meshes, b.weights, strict=True):
        made = b.decode(weights)
        apart = max(mean_distance(made, mesh), mean_distance(mesh, made)) / b.half
        expect(apart < NEAR, f"decoded surface is {apart:.3f} from the mesh on average, expected < {NEAR} [half box]")


def check_size_is_recovered(decoder: Decoder) -> None:
    """Scaling each mesh to fit the box would erase the sizes that users ask for."""
    b = bench(decoder)
    ratio = b.decode(b.weights[LONGER]).extents[0] / b.decode(b.weights[BOX]).extents[0]
    expect(abs(ratio - 1.2) < RATIO, f"a box 1.2 times longer came out {ratio:.3f} times longer")


def check_one_hot_mix_is_the_exemplar(decoder: Decoder) -> None:
    """Mixed weights come from a matrix product in another precision and memory layout; values must not notice."""
    b = bench(decoder)
    layouts: dict[str, Callable[[Array], Array]] = {
        "float64": lambda w: w.astype(float),
        "reversed memory": lambda w: np.ascontiguousarray(w[::-1])[::-1],
        "strided memory": lambda w: np.repeat(w, 2)[::2],
    }
    for alpha, row in zip(np.eye(len(b.weights)), b.weights, strict=True):
        wanted = b.evaluate(np.array(row))
        for name, layout in layouts.items():
            mixed = layout((alpha @ b.weights.astype(float)).astype(np.float32))
            apart = np.abs(decoder.evaluate(writable(b.shared), mixed, np.array(b.points)) - wanted).max()
            expect(apart <= SAME * b.half, f"a one-hot mix in {name} is {apart:.2e} from its exemplar")


def check_neighbours_are_aligned(decoder: Decoder) -> None:
    """Weights mix meaningfully only if neighbours fitted from the shared start lie close and straight."""
    b = bench(decoder)
    middle = b.evaluate(b.weights[[BOX, LONGER]].mean(0))
    mismatch = np.abs(middle - (b.evaluate(b.weights[BOX]) + b.evaluate(b.weights[LONGER])) / 2).mean() / b.half
    expect(mismatch < MISMATCH, f"mismatch {mismatch:.4f} half way between neighbours, expected < {MISMATCH}")


def check_wrong_length_is_refused(decoder: Decoder) -> None:
    """Weights of another bank or of other options must not be reshaped into a plausible surface."""
    b = bench(decoder)
    right = b.weights.shape[-1]
    for wrong in (right - 1, right + 1):
        weights = np.resize(b.weights[BOX], wrong)
        for name, call in (("evaluate", b.evaluate), ("decode", b.decode)):
            text = must_raise(partial(call, weights), ValueError, f"{name} with {wrong} weights instead of {right}")
            both = str(wrong) in text and str(right) in text
            expect(both, f"{name}: expected a message with both lengths, got {text!r}")


def check_no_surface_is_empty_mesh(decoder: Decoder) -> None:
    """A field without a surface is a result (a rejected design), which only EmptyMesh tells apart from a bug."""
    b = bench(decoder)
    if b.evaluate(b.weights[BOX]).shape[-1] != 1:
        raise NotApplicable("not a signed distance")
    low, high = np.asarray(decoder.bounds, float)
    step = np.linspace(low, high, 25).T
    lattice = np.stack(np.meshgrid(*step, indexing="ij"), -1).reshape(-1, 3)
    one = np.ones_like(b.weights[BOX])
    candidates = [one, 100 * one, -one, *(b.weights[i] * f for i in (BOX, ROUND) for f in (0.0, -1.0, 100.0, -100.0))]
    for weights in candidates:
        values = b.evaluate(weights.astype(np.float32), lattice)
        if np.isfinite(values).all() and values.min() > 0.05 * b.half:
            must_raise(partial(b.decode, weights), EmptyMesh, "decode of a field positive throughout")
            return
    raise NotApplicable("no weights were found that leave no surface")


def check_empty_mesh_is_refused(decoder: Decoder) -> None:
    """One broken file among the exemplars has to be named, not fitted to nothing."""
    from trimesh import Trimesh

    b = bench(decoder)
    empty = Trimesh(np.empty((0, 3)), np.empty((0, 3), int))
    must_raise(
        lambda: decoder.fit(writable(b.shared), [b.meshes[0], empty], seed=SEED), FitError, "fit of an empty mesh"
    )


def check_read_only_arrays_will_do(decoder: Decoder) -> None:
    """A bank's arrays are mapped from its file, and writing to them would change it under other readers."""
    b = bench(decoder)
    calls: dict[str, Callable[[], Any]] = {
        "evaluate": lambda: decoder.evaluate(b.shared, b.weights[BOX], b.points),
        "decode": lambda: decoder.decode(b.shared, b.weights[BOX], resolution=RESOLUTION),
        "probes": lambda: decoder.probes(b.shared, 10, SEED),
    }
    for name, call in calls.items():
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message=".*not writ")  # torch only warns before it would write
            try:
                call()
            except (ValueError, RuntimeError, UserWarning) as error:
                expect(False, f"{name} fails on read-only arrays: {error!r}")


def check_fresh_process_agrees(decoder: Decoder) -> None:
    """A bank is read years later by another process, with only the options and arrays that its file holds."""
    b = bench(decoder)
    here = b.evaluate(b.weights)
    there = fresh.evaluate(decoder, b.shared, b.weights, b.points)
    expect(there.shape == here.shape, f"values {here.shape} here, {there.shape} in a fresh process")
    apart = np.abs(there - here).max()
    expect(apart <= SAME * b.half, f"values differ by {apart:.2e} in a fresh process: state outside options and shared")


CHECKS: tuple[CheckFunction, ...] = (
    check_protocol_and_bounds,
    *COMMON,
    check_prepare_gives_named_arrays,
    check_prepare_is_deterministic,
    check_weights_are_flat_float32,
    check_fit_error_is_stated,
    check_fit_is_deterministic,
    check_fit_leaves_its_inputs,
    check_global_random_state_is_left,
    check_progress_runs_from_0_to_1,
    check_fit_ignores_batch_mates,
    check_evaluate_gives_points_by_channels,
    check_evaluate_is_pointwise,
    check_evaluate_is_stateless,
    check_evaluate_takes_batches_of_weights,
    check_probes_cover_the_domain,
    check_decode_gives_a_closed_mesh,
    check_decode_is_deterministic,
    check_surface_is_near_the_mesh,
    check_size_is_recovered,
    check_one_hot_mix_is_the_exemplar,
    check_neighbours_are_aligned,
    check_wrong_length_is_refused,
    check_no_surface_is_empty_mesh,
    check_empty_mesh_is_refused,
    check_read_only_arrays_will_do,
    check_fresh_process_agrees,
    check_pullback_agrees_with_differences,
    check_adjoint_agrees_with_differences,
    check_follow_is_decode,
)
