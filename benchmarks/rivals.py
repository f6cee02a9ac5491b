"""What people use today for each stage, written from its published recipe: the slower half of benchmarks/speed.py.

One network a shape, the shapes one by one: SIREN (Sitzmann et al., 2020), 256×3, fitted to signed distances (its own
loss, by normals and the eikonal equation, takes longer still), Adam at 1e-4. A batch: inr2vec (De Luigi et al., 2023),
SIREN 512×4 from one shared file of weights, 16 networks in batched products, 10,000 points each a step, binary cross
entropy of (distance + 0.1) / 0.2, Adam at 1e-4. A mesh: every node of the grid (scikit-image). A mix: SciPy's SLSQP. A
mismatch: N + 1 networks evaluated.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize

from lampopt.types import Array, Bank, Problem

OMEGA = 30.0
SIREN_POINTS = 16_384  # a step
INR2VEC_POINTS, INR2VEC_BATCH = 10_000, 16
RATE = 1e-4
CLAMP = 0.1  # distance at which inr2vec's labels end [box]


@dataclass(frozen=True, eq=False)
class Fitted:
    """How long a rival took to one error: seconds a step, steps, and the error that it had then [box]."""

    step_s: float
    steps: int
    error: float


def siren(n: int, width: int, depth: int, seed: int) -> list[torch.Tensor]:
    """Matrices (n, in, out) and biases (n, 1, out) of `n` equal networks."""
    rng = torch.Generator().manual_seed(seed)
    found = []
    for k, (a, b) in enumerate(pairwise([3, *[width] * depth, 1])):
        reach = 1 / a if k == 0 else (6 / a) ** 0.5 / OMEGA
        for shape, size in (((1, a, b), reach), ((1, 1, b), a**-0.5)):
            one = (2 * torch.rand(shape, generator=rng) - 1) * size
            found.append(one.repeat(n, 1, 1).requires_grad_())
    return found


def forward(parameters: list[torch.Tensor], points: torch.Tensor) -> torch.Tensor:
    """(n, M) of points (n, M, 3)."""
    hidden = points
    for k in range(0, len(parameters), 2):
        hidden = torch.baddbmm(parameters[k + 1], hidden, parameters[k])
        if k < len(parameters) - 2:
            hidden = torch.sin(OMEGA * hidden)
    return hidden[..., 0]


Loss = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


def of_distances(found: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """Mean |f − d|."""
    return (found - true).abs().mean()


def of_labels(found: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """inr2vec's: cross entropy of clamped distances as labels from 0 to 1."""
    labels = (true.clamp(-CLAMP, CLAMP) + CLAMP) / (2 * CLAMP)
    return torch.nn.functional.binary_cross_entropy_with_logits(found, labels)


def distances(found: torch.Tensor) -> torch.Tensor:
    """What inr2vec's values say."""
    return torch.sigmoid(found) * 2 * CLAMP - CLAMP


def fitted(
    parameters: list[torch.Tensor],
    samples: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    loss: Loss,
    read: Callable[[torch.Tensor], torch.Tensor],
    *,
    points: int,
    error: float,
    most: int,
    look: int = 10,
    seed: int = 0,
) -> Fitted:
    """Train until the mean distance on the surface is at most `error` [box]; looks are not timed.

    `samples` are points (n, S, 3), distances (n, S) and surface points (n, Q, 3).
    """
    at, true, surface = samples
    rng = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(parameters, lr=RATE)
    spent, off = 0.0, float("inf")
    for step in range(1, most + 1):
        began = time.perf_counter()
        chosen = torch.randint(at.shape[1], (points,), generator=rng)
        optimizer.zero_grad()
        loss(forward(parameters, at[:, chosen]), true[:, chosen]).backward()
        optimizer.step()
        spent += time.perf_counter() - began
        if step % look == 0 or step == most:
            with torch.no_grad():
                off = float(read(forward(parameters, surface)).abs().mean())
            if off <= error:
                break
    return Fitted(spent / step, step, off)


def slsqp(problem: Problem) -> Array:
    """The mix (N,) nearest to the centre that meets every row of `problem`, as a general solver finds it."""
    centre = problem.centre

    def cost(alpha: Array) -> tuple[float, Array]:
        off = alpha - centre
        return float(off @ off), 2 * off

    rows = np.vstack([np.ones(len(centre)), problem.matrix])
    wanted = np.append(1.0, problem.target)
    held: list[Any] = [{"type": "eq", "fun": lambda alpha: rows @ alpha - wanted, "jac": lambda alpha: rows}]
    options = {"ftol": 1e-15, "maxiter": 200}
    found = minimize(cost, centre, jac=True, method="SLSQP", constraints=held, options=options)
    return np.asarray(found.x)


def mismatch(bank: Bank, evaluate: Callable[[Array, Array], Array], alpha: Array) -> float:
    """The paper's mismatch of `alpha` (N,) [box]: the mixed network and all N of the bank at every probe."""
    mixed = evaluate((alpha.astype(np.float32) @ bank.weights)[None], bank.probes)[0]
    each = np.stack([evaluate(np.asarray(row)[None], bank.probes)[0] for row in bank.weights])
    return float(np.linalg.norm(mixed - np.tensordot(alpha, each.astype(float), 1), axis=-1).mean())
