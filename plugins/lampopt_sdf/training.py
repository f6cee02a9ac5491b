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
        given, distances = _shuffled(samples, orders)
        features = network.features(given)
        importance = 1 / (1 + distances.abs() / NEAR) / points
        surface = network.features(samples.surface)
        look = surface[:, :: max(1, surface.shape[1] // BLOCK)]  # the points lie in face order: take some of all
        running = torch.ones(n, dtype=torch.bool, device=device)
        finished = weights.clone()
        for step in range(steps):
            first = step % (count // points) * points
            weights.grad.zero_()
            for at in range(first, first + points, BLOCK):
                part = slice(at, min(at + BLOCK, first + points))
                off = run.forward(layers, features[:, part]) - distances[:, part]
                run.backward(layers, gradients, features[:, part], off.sign_().mul_(importance[:, part]))
            for group in optimizer.param_groups:
                group["lr"] = rate * min(1.0, (step + 1) / WARM_UP) * 0.5 * (1 + cos(pi * step / steps))
            optimizer.step()
            if tolerance > 0 and (step + 1) % LOOK == 0:
                reached = running & (_error(run, layers, look) <= tolerance)
                finished[reached] = weights[reached]
                running &= ~reached
                if not running.any():
                    break
            if progress and (step + 1) % 10 == 0:
                progress((step + 1) / steps, f"step {step + 1} of {steps}")
        finished[running] = weights[running]
        error = _error(run, network.layers(finished), surface)
        if progress:
            progress(1.0, "fitted")
        return finished.cpu().numpy(), error.cpu().numpy().astype(float)


def _shuffled(samples: Samples, orders: list[np.random.Generator]) -> tuple[torch.Tensor, torch.Tensor]:
    """Points (n, S, 3) and distances (n, S, 1) in random order, once: each step then reads a slice, gathers nothing."""
    n, count = samples.distances.shape
    order = torch.as_tensor(np.stack([g.permutation(count) for g in orders]), device=samples.points.device).expand(
        n, -1
    )
    rows = torch.arange(n, device=order.device)[:, None]
    return samples.points[rows, order], samples.distances[rows, order].unsqueeze(-1)


def _error(run: Pass, layers: list[tuple[torch.Tensor, torch.Tensor]], surface: torch.Tensor) -> torch.Tensor:
    """(n,) mean |f| at features (n, Q, F) of points on the true surfaces."""
    total = torch.zeros(len(surface), device=surface.device)
    for at in range(0, surface.shape[1], BLOCK):
        total += run.forward(layers, surface[:, at : at + BLOCK])[..., 0].abs().sum(1)
    return total / surface.shape[1]
