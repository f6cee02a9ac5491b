"""Fit n networks at once: stacked weights, one learning-rate schedule, the same order of points for all."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi

import numpy as np
import torch

from lampopt.protocols import Progress
from lampopt.types import Array
from lampopt_sdf.half import HalfPass
from lampopt_sdf.network import BLOCK, Layers, Network, Pass
from lampopt_sdf.optimizer import Optimizer

WARM_UP = 50  # steps
NEAR = 0.05  # distance at which a point weighs half of one on the surface [box]
LOOK = 50  # steps between looks at the reached error
ROUGHLY = 0.8  # share of the steps whose direction may be worked out in bfloat16
CROWDED = 0.75  # share of a batch that goes on, at most, when the finished ones leave it


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
    reach: float,
    half: bool,
    progress: Progress | None,
) -> tuple[Array, Array]:
    """Weights (n, D) and mean distance on the surface (n,) after at most `steps` steps from `start` (n, D).

    The loss is |f − d| / (1 + |d| / NEAR): near points count, and no gradient is lost to a clamped prediction. An
    exemplar whose error falls to `tolerance` is finished and stays as it is. `orders` is one generator for all
    exemplars, or one each. `reach` is as of `Optimizer`; with `half` most steps are worked out in bfloat16.
    """
    with torch.no_grad():
        given, distances = _shuffled(samples, orders)
        features = network.features(given)
        surface = network.features(samples.surface)
        look = surface[:, :: max(1, surface.shape[1] // BLOCK)]  # the points lie in face order: take some of all
        finished = torch.tensor(start, dtype=torch.float32, device=given.device)
        weights = finished.clone()
        optimizer = Optimizer(network, weights, reach=reach)
        batch = _Batch.of(network, weights, optimizer, features, distances, look, half=half)
        left = torch.arange(len(finished), device=given.device)  # whom the batch's rows belong to
        count = distances.shape[1]
        for step in range(steps):
            first = step % (count // points) * points
            pace = rate * min(1.0, (step + 1) / WARM_UP) * 0.5 * (1 + cos(pi * step / steps))
            batch.step(first, points, pace, half=half and step < ROUGHLY * steps)
            if tolerance > 0 and (step + 1) % LOOK == 0:
                fresh = batch.running & (batch.error() <= tolerance)
                finished[left[fresh]] = batch.weights[fresh]
                batch.running &= ~fresh
                if not batch.running.any():
                    break
                if batch.running.float().mean() <= CROWDED:
                    left, batch = left[batch.running], batch.only(batch.running)
            if progress and (step + 1) % 10 == 0:
                progress((step + 1) / steps, f"step {step + 1} of {steps}")
        finished[left[batch.running]] = batch.weights[batch.running]
        error = _error(Pass(network, len(finished), given.device), network.layers(finished), surface)
        if progress:
            progress(1.0, "fitted")
        return finished.cpu().numpy(), error.cpu().numpy().astype(float)


@dataclass(eq=False)
class _Batch:
    """Networks that are trained together, with all that they see; `running` are those that are not finished."""

    run: Pass
    half: HalfPass | None
    weights: torch.Tensor
    optimizer: Optimizer
    features: torch.Tensor
    distances: torch.Tensor
    look: torch.Tensor
    running: torch.Tensor

    @classmethod
    def of(
        cls,
        network: Network,
        weights: torch.Tensor,
        optimizer: Optimizer,
        features: torch.Tensor,
        distances: torch.Tensor,
        look: torch.Tensor,
        *,
        half: bool,
    ) -> _Batch:
        running = torch.ones(len(weights), dtype=torch.bool, device=weights.device)
        run = Pass(network, len(weights), weights.device)
        rough = HalfPass(network, len(weights), weights.device) if half else None
        return cls(run, rough, weights, optimizer, features, distances, look, running)

    def step(self, first: int, points: int, rate: float, *, half: bool) -> None:
        """One step on `points` points from the `first`, its direction in bfloat16 with `half`."""
        assert self.weights.grad is not None
        run = self.half if half and self.half else self.run
        self.weights.grad.zero_()
        layers, gradients = self.run.network.layers(self.weights), self.run.network.layers(self.weights.grad)
        for at in range(first, first + points, BLOCK):
            part = slice(at, min(at + BLOCK, first + points))
            true = self.distances[:, part]
            off = run.forward(layers, self.features[:, part]).sub_(true).sign_()
            run.backward(layers, gradients, self.features[:, part], off.div_((1 + true.abs() / NEAR) * points))
        self.optimizer.step(rate, half=half)

    def error(self) -> torch.Tensor:
        """(n,) mean distance on some of the surface points."""
        return _error(self.run, self.run.network.layers(self.weights), self.look)

    def only(self, keep: torch.Tensor) -> _Batch:
        """Those that `keep` (n,) says, as far as they are: the finished ones cost no more."""
        weights = self.weights[keep]
        seen = (part[keep] for part in (self.features, self.distances, self.look))
        return _Batch.of(
            self.run.network, weights, self.optimizer.only(keep, weights), *seen, half=self.half is not None
        )


def _shuffled(samples: Samples, orders: list[np.random.Generator]) -> tuple[torch.Tensor, torch.Tensor]:
    """Points (n, S, 3) and distances (n, S, 1) in random order, once: each step then reads a slice, gathers nothing."""
    n, count = samples.distances.shape
    order = torch.as_tensor(np.stack([g.permutation(count) for g in orders]), device=samples.points.device).expand(
        n, -1
    )
    rows = torch.arange(n, device=order.device)[:, None]
    return samples.points[rows, order], samples.distances[rows, order].unsqueeze(-1)


def _error(run: Pass, layers: Layers, surface: torch.Tensor) -> torch.Tensor:
    """(n,) mean |f| at features (n, Q, F) of points on the true surfaces."""
    total = torch.zeros(len(surface), device=surface.device)
    for at in range(0, surface.shape[1], BLOCK):
        total += run.forward(layers, surface[:, at : at + BLOCK])[..., 0].abs().sum(1)
    return total / surface.shape[1]
