"""Gradients that a decoder carries back to its weights, held against differences along a few directions."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from lampopt.protocols import Adjoint, Decoder, Pullback
from lampopt.testing.bench import BOX, LONGER, ROUND, SEED, Bench, bench, writable
from lampopt.testing.engine import NotApplicable, expect
from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

DIRECTIONS = 6  # drawn at random, beside those towards two exemplars
MOVED = 0.01  # how much a step changes values, as a part of half the box
COSINE = 0.99  # what single precision and marching cubes leave of agreement
LENGTH = 0.1  # how much longer or shorter than the differences
CUT = 0.25  # the same where marching cubes cut a box's edges off: there its normals are not the field's


def check_pullback_agrees_with_differences(decoder: Decoder) -> None:
    """A solver follows a measured value's gradient through the decoded mesh to the weights, or away from it."""
    if not isinstance(decoder, Pullback):
        raise NotApplicable("it carries no gradients from vertices to weights")
    b = bench(decoder)
    at = _middle(b)
    mesh = b.decode(at)
    pulled = decoder.pullback(writable(b.shared), np.array(at), mesh, _volume_by_vertices(mesh))
    _compare("pullback", b, at, pulled, lambda weights: float(b.decode(weights).volume), CUT)


def check_adjoint_agrees_with_differences(decoder: Decoder) -> None:
    """Keeping the mismatch within its limit follows this gradient, or ends outside of it."""
    if not isinstance(decoder, Adjoint):
        raise NotApplicable("it carries no gradients from values to weights")
    b = bench(decoder)
    at = _middle(b)
    factors = np.random.default_rng(SEED).normal(size=b.evaluate(at).shape)
    pulled = decoder.adjoint(writable(b.shared), np.array(at), np.array(b.points), np.array(factors))
    _compare("adjoint", b, at, pulled, lambda weights: float((factors * b.evaluate(weights)).sum()), LENGTH)


def _middle(b: Bench) -> Array:
    """Half way between neighbours: the shape of no exemplar."""
    return np.asarray(b.weights[[BOX, LONGER]].mean(0), np.float32)


def _compare(name: str, b: Bench, at: Array, pulled: object, value: Callable[[Array], float], length: float) -> None:
    """Whether `pulled` is the gradient of `value`, along directions of which each step changes values alike."""
    found = np.asarray(pulled, float)
    expect(found.shape == at.shape, f"{name}: expected a gradient {at.shape}, got {found.shape}")
    expect(np.isfinite(found).all(), f"{name}: expected a finite gradient")
    size = float(np.linalg.norm(b.weights[LONGER] - b.weights[BOX]))
    drawn = np.random.default_rng(SEED).normal(size=(DIRECTIONS, len(at))) * size / np.sqrt(len(at))
    steps = [_sized(b, at, d) for d in (*drawn, b.weights[LONGER] - b.weights[BOX], b.weights[ROUND] - b.weights[BOX])]
    told = np.array([found @ step for step in steps])
    rough = np.array([(value(_float(at + step)) - value(_float(at - step))) / 2 for step in steps])
    lengths = float(np.linalg.norm(told)), float(np.linalg.norm(rough))
    if lengths[1] == 0:
        raise NotApplicable("nothing changes along the directions that were tried")
    cosine = float(told @ rough) / max(lengths[0] * lengths[1], 1e-300)
    ratio = lengths[0] / lengths[1]
    good = cosine >= COSINE and abs(ratio - 1) <= length
    expect(
        good,
        f"{name}: along {len(steps)} directions it goes with the differences by a cosine of {cosine:.4f} and is "
        f"{ratio:.3f} times as long, expected >= {COSINE} and 1 ± {length}",
    )


def _sized(b: Bench, at: Array, direction: Array) -> Array:
    """`direction`, so long that the values at the bench's points change by `MOVED` of half the box."""
    step = np.asarray(direction, float)
    for _ in range(2):  # the second corrects for what bends
        change = float(np.sqrt(np.mean((b.evaluate(_float(at + step)) - b.evaluate(at)) ** 2)))
        step = step * (MOVED * b.half / change if change > 0 else 1.0)
    return step


def _float(weights: Array) -> Array:
    return np.asarray(weights, np.float32)


def _volume_by_vertices(mesh: Trimesh) -> Array:
    """(V, 3) derivatives of the volume that a closed mesh holds."""
    faces, corners = np.asarray(mesh.faces), np.asarray(mesh.triangles, float)
    found = np.zeros((len(mesh.vertices), 3))
    for i in range(3):
        np.add.at(found, faces[:, i], np.cross(corners[:, (i + 1) % 3], corners[:, (i + 2) % 3]) / 6)
    return found
