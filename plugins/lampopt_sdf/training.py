"""Fit n networks at once: Adam on the stacked weights, one learning-rate schedule, the same order of points for all."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi

import numpy as np
import torch

from lampopt.protocols import Progress
from lampopt.types import Array
from lampopt_sdf.network import BLOCK, Network, Pass

WARM_UP = 50  # steps
NEAR = 0.05  # distance at which a point weighs half of one on the surface [box]
LOOK = 50  # steps between looks at the reached error


@dataclass(frozen=True)
class Samples:
    """Points (n, S, 3), distances (n, S) and surface points (n, Q, 3) of n exemplars."""

    points: torch.Tensor
    distances: torch.Tensor
    surface: torch.Tensor


def train(
    network: Network,
    start: Array,
    samples: Samples,
    orders: list[np.random.Generator],
    *,
    steps: int,
    points: int,
    rate: float,
    tolerance: float,
    progress: Progress | None,
) -> tuple[Array, Array]:
    """Weights (n, D) and mean distance on the surface (n,) after at most `steps` steps from `start` (n, D).

    The loss is |f − d| / (1 + |d| / NEAR): near points count, and no gradient is lost to a clamped prediction. An
    exemplar whose error falls to `tolerance` is finished and stays as it is. `orders` is one generator for all
    exemplars, or one each.
    """
    with torch.no_grad():
        device = samples.points.device
        n, count = samples.distances.shape
        weights = torch.tensor(start, dtype=torch.float32, device=device)
        weights.grad = torch.zeros_like(weights)
        layers, gradients = network.layers(weights), network.layers(weights.grad)
        optimizer = torch.optim.Adam([weights], lr=rate, betas=(0.9, 0.99), eps=1e-10)
        run = Pass(network, n, device)
        importance = 1 / (1 + samples.distances.abs() / NEAR) / points
        running = torch.ones(n, dtype=torch.bool, device=device)
        rows = torch.arange(n, device=device)[:, None]
        finished = weights.clone()
        order = _Order(orders, count, points)
        for step in range(steps):
            chosen = torch.as_tensor(next(order), device=device)  # (1 or n, points)
            weights.grad.zero_()
            for at in range(0, points, BLOCK):
                index = (rows, chosen[:, at : at + BLOCK].expand(n, -1))
                features = network.features(samples.points[index])
                off = run.forward(layers, features)[..., 0] - samples.distances[index]
                run.backward(layers, gradients, features, (off.sign() * importance[index]).unsqueeze(-1))
            for group in optimizer.param_groups:
                group["lr"] = rate * min(1.0, (step + 1) / WARM_UP) * 0.5 * (1 + cos(pi * step / steps))
            optimizer.step()
            if tolerance > 0 and (step + 1) % LOOK == 0:
                reached = running & (_error(network, run, layers, samples.surface[:, :BLOCK]) <= tolerance)
                finished[reached] = weights[reached]
                running &= ~reached
                if not running.any():
                    break
            if progress and (step + 1) % 10 == 0:
                progress((step + 1) / steps, f"step {step + 1} of {steps}")
        finished[running] = weights[running]
        error = _error(network, run, network.layers(finished), samples.surface)
        if progress:
            progress(1.0, "fitted")
        return finished.cpu().numpy(), error.cpu().numpy().astype(float)


class _Order:
    """Endless blocks of indices (len(generators), points): each sample once before any comes again."""

    def __init__(self, generators: list[np.random.Generator], count: int, points: int) -> None:
        self._generators, self._count, self._points = generators, count, points
        self._left = np.empty((len(generators), 0), np.int64)

    def __iter__(self) -> _Order:
        return self

    def __next__(self) -> Array:
        while self._left.shape[1] < self._points:
            fresh = np.stack([g.permutation(self._count) for g in self._generators])
            self._left = np.concatenate([self._left, fresh], 1)
        block, self._left = self._left[:, : self._points], self._left[:, self._points :]
        return block


def _error(
    network: Network, run: Pass, layers: list[tuple[torch.Tensor, torch.Tensor]], surface: torch.Tensor
) -> torch.Tensor:
    """(n,) mean |f| at points (n, Q, 3) of the true surfaces."""
    total = torch.zeros(len(surface), device=surface.device)
    for at in range(0, surface.shape[1], BLOCK):
        features = network.features(surface[:, at : at + BLOCK])
        total += run.forward(layers, features)[..., 0].abs().sum(1)
    return total / surface.shape[1]
