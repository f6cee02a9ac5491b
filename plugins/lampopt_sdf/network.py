"""The network of the paper's appendix C, for many flat weight vectors at once: forward and backward by hand.

    gamma(z) = [z, sin(2^0 πz), cos(2^0 πz), …],   h_k = φ(W_k h_{k-1} + b_k),   f(z; w) = W_K h_{K-1} + b_K

Weights (n, D) are one tensor; each layer is a view of it, so an optimizer sees a single leaf. Points go through in
blocks small enough to stay in the cache, in buffers that are made once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import pi

import numpy as np
import torch

from lampopt.types import Array

Layers = list[tuple[torch.Tensor, torch.Tensor]]  # matrices (n, in, out), biases (n, 1, out)
BLOCK = 1024  # points that go through the layers together: activations of a batch stay in the cache


@dataclass(frozen=True)
class Network:
    """Fourier features of `octaves`, `depth` hidden layers of `width`, activation "relu" or "sine"."""

    width: int
    depth: int
    octaves: int
    activation: str
    omega: float = 30.0  # frequency of the sine (Sitzmann et al. 2020, SIREN)

    @cached_property
    def shapes(self) -> tuple[tuple[int, int], ...]:
        """(in, out) of each layer."""
        sizes = [3 + 6 * self.octaves, *[self.width] * self.depth, 1]
        return tuple(pairwise(sizes))

    @property
    def size(self) -> int:
        """D: the number of weights."""
        return sum((a + 1) * b for a, b in self.shapes)

    def initial(self, rng: np.random.Generator) -> Array:
        """(D,) random weights: He for ReLU, Sitzmann et al. for sine."""
        parts = []
        for k, (a, b) in enumerate(self.shapes):
            if self.activation == "sine":
                reach = 1 / a if k == 0 else np.sqrt(6 / a) / self.omega
                parts += [rng.uniform(-reach, reach, (a, b)), rng.uniform(-1, 1, b) / np.sqrt(a)]
            else:
                last = k == len(self.shapes) - 1
                parts += [rng.normal(0, np.sqrt(2 / a) * (0.3 if last else 1.0), (a, b))]
                parts += [np.zeros(b) if last else rng.uniform(-1, 1, b) * (0.5 if k == 0 else 0.1)]
        return np.concatenate([p.ravel() for p in parts]).astype(np.float32)

    def layers(self, weights: torch.Tensor) -> Layers:
        """Views (n, in, out) and (n, 1, out) of `weights` (n, D)."""
        found, at = [], 0
        for a, b in self.shapes:
            matrix = weights[:, at : at + a * b].view(-1, a, b)
            bias = weights[:, at + a * b : at + (a + 1) * b].unsqueeze(1)
            found.append((matrix, bias))
            at += (a + 1) * b
        return found

    def features(self, points: torch.Tensor) -> torch.Tensor:
        """gamma: (..., 3) → (..., 3 + 6·octaves)."""
        parts = [points]
        for k in range(self.octaves):
            parts += [torch.sin(2**k * pi * points), torch.cos(2**k * pi * points)]
        return torch.cat(parts, -1)


class Pass:
    """Forward and backward passes of one `Network` for `n` weight vectors, in buffers of its own.

    Not shared between threads: whoever computes makes one.
    """

    def __init__(self, network: Network, n: int, device: torch.device) -> None:
        self.network = network
        shape = (n, BLOCK, network.width)
        # of each hidden layer: what goes into the activation and what comes out (ReLU works in place)
        self._before = [torch.empty(shape, device=device) for _ in range(network.depth)]
        sine = network.activation == "sine"
        self._after = [torch.empty(shape, device=device) for _ in self._before] if sine else self._before
        self._back = [torch.empty(shape, device=device) for _ in range(2)]

    def forward(self, layers: Layers, features: torch.Tensor) -> torch.Tensor:
        """Values (n, m, 1) at features (n, m, F), m ≤ BLOCK."""
        hidden = features
        for k, (matrix, bias) in enumerate(layers[:-1]):
            before, after = self._before[k][:, : features.shape[1]], self._after[k][:, : features.shape[1]]
            torch.baddbmm(bias, hidden, matrix, out=before)
            if self.network.activation == "sine":
                torch.sin(before.mul_(self.network.omega), out=after)
            else:
                before.relu_()
            hidden = after
        return torch.baddbmm(layers[-1][1], hidden, layers[-1][0])

    def backward(
        self,
        layers: Layers,
        gradients: Layers,
        features: torch.Tensor,
        gradient: torch.Tensor,
    ) -> None:
        """Add to `gradients` what the last `forward` contributes, given the values' gradient (n, m, 1)."""
        m = features.shape[1]
        for k in range(len(layers) - 1, -1, -1):
            hidden = self._after[k - 1][:, :m] if k else features
            gradients[k][0].baddbmm_(hidden.transpose(1, 2), gradient)
            gradients[k][1].add_(gradient.sum(1, keepdim=True))
            if k:
                back = self._back[k % 2][:, :m]
                torch.bmm(gradient, layers[k][0].transpose(1, 2), out=back)
                if self.network.activation == "sine":
                    back.mul_(torch.cos(self._before[k - 1][:, :m])).mul_(self.network.omega)
                else:
                    torch.ops.aten.threshold_backward.grad_input(back, hidden, 0, grad_input=back)
                gradient = back


def evaluate(network: Network, weights: Array, points: Array, device: torch.device) -> Array:
    """Values (M,) of one weight vector (D,) at points (M, 3)."""
    with torch.no_grad():
        layers = network.layers(torch.as_tensor(np.array(weights, np.float32), device=device)[None])
        # Whole blocks: products of other sizes round otherwise, and a value would depend on the points beside it.
        given = torch.zeros((-(-len(points) // BLOCK) * BLOCK, 3), device=device)
        given[: len(points)] = torch.as_tensor(np.array(points, np.float32), device=device)
        run = Pass(network, 1, device)
        values = torch.empty(len(given), device=device)
        for start in range(0, len(given), BLOCK):
            block = network.features(given[start : start + BLOCK])[None]
            values[start : start + BLOCK] = run.forward(layers, block)[0, :, 0]
        return np.asarray(values[: len(points)].cpu().numpy())


def adjoint(network: Network, weights: Array, points: Array, gradient: Array, device: torch.device) -> Array:
    """(D,) Σ gradient·∂f/∂weights over points (M, 3), from a gradient by values (M,)."""
    with torch.no_grad():
        layers = network.layers(torch.as_tensor(np.array(weights, np.float32), device=device)[None])
        found = torch.zeros((1, network.size), device=device)
        sums = network.layers(found)
        given = torch.as_tensor(np.array(points, np.float32), device=device)
        by = torch.as_tensor(np.array(gradient, np.float32), device=device).reshape(1, -1, 1)
        run = Pass(network, 1, device)
        for start in range(0, len(given), BLOCK):
            features = network.features(given[start : start + BLOCK])[None]
            run.forward(layers, features)
            run.backward(layers, sums, features, by[:, start : start + BLOCK])
        return np.asarray(found[0].cpu().numpy(), float)


def slopes(network: Network, weights: Array, points: Array, device: torch.device) -> Array:
    """(M, 3) ∂f/∂z of one weight vector (D,) at points (M, 3)."""
    layers = network.layers(torch.as_tensor(np.array(weights, np.float32), device=device)[None])
    found = []
    for start in range(0, len(points), BLOCK):
        at = torch.tensor(np.array(points[start : start + BLOCK], np.float32), device=device, requires_grad=True)
        hidden = network.features(at)[None]
        for matrix, bias in layers[:-1]:
            before = torch.baddbmm(bias, hidden, matrix)
            hidden = torch.sin(network.omega * before) if network.activation == "sine" else torch.relu(before)
        value = torch.baddbmm(layers[-1][1], hidden, layers[-1][0])
        (slope,) = torch.autograd.grad(value.sum(), at)
        found.append(slope.cpu().numpy())
    return np.concatenate(found) if found else np.empty((0, 3))
