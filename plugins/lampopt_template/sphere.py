"""The unit sphere as a template, and the network that pushes it, for many flat weight vectors at once.

    f(u; w) = c + r ∘ u + P(f_0(u)) C + g(gamma(u); w)
    gamma(u) = [u, sin(2^0 πu), cos(2^0 πu), …],   h_k = sin(ω (W_k h_{k-1} + b_k)),   g = W_K h_{K-1} + b_K

The network g adds to an ellipsoid about c with radii r, so that it has little to do at first. P are polynomials of f_0,
where the shared start moves u, and their coefficients C are weights too: what makes a whole body longer or wider is
linear in the weights then, and mixes exactly. Weights (n, D) are one tensor and each layer is a view of it, so that an
optimizer sees a single leaf.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import pi

import numpy as np
import torch

from lampopt.types import Array

OMEGA = 10.0  # frequency of the sine (Sitzmann et al. 2020): a third of what suits images, for surfaces that move
BLOCK = 1024  # points that go through the layers together: their activations stay in the cache
TIMID = 0.1  # of the usual size of a last layer's random weights: the ellipsoid is a better start than noise


@dataclass(frozen=True)
class Network:
    """Fourier features of `octaves`, `depth` hidden layers of `width` with the sine, three outputs."""

    width: int
    depth: int
    octaves: int

    @cached_property
    def shapes(self) -> tuple[tuple[int, int], ...]:
        """(in, out) of each layer."""
        return tuple(pairwise([3 + 6 * self.octaves, *[self.width] * self.depth, 3]))

    @property
    def size(self) -> int:
        """D: the number of weights."""
        return sum((a + 1) * b for a, b in self.shapes)

    def initial(self, rng: np.random.Generator) -> Array:
        """(D,) random weights that leave the ellipsoid nearly as it is."""
        parts = []
        for k, (a, b) in enumerate(self.shapes):
            last = k == len(self.shapes) - 1
            reach = 1 / a if k == 0 else np.sqrt(6 / a) / OMEGA * (TIMID if last else 1.0)
            parts += [rng.uniform(-reach, reach, (a, b)), np.zeros(b) if last else rng.uniform(-1, 1, b) / np.sqrt(a)]
        return np.concatenate([p.ravel() for p in parts]).astype(np.float32)

    def offset(self, weights: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """g (n, m, 3) of weights (n, D) at points (n, m, 3) of the sphere."""
        waves = [wave(2**k * pi * points) for k in range(self.octaves) for wave in (torch.sin, torch.cos)]
        hidden, at = torch.cat([points, *waves], -1), 0
        for k, (a, b) in enumerate(self.shapes):
            matrix = weights[:, at : at + a * b].view(-1, a, b)
            bias = weights[:, at + a * b : at + (a + 1) * b].unsqueeze(1)
            at += (a + 1) * b
            if k < self.depth:  # the frequency goes to the weights: they are fewer than the activations
                hidden = torch.baddbmm(OMEGA * bias, hidden, OMEGA * matrix).sin()
            else:
                hidden = torch.baddbmm(bias, hidden, matrix)
        return hidden


@dataclass(frozen=True, eq=False)
class Push:
    """Everything that moves the sphere: `ellipsoid` (2, 3) is c and r, `start` (D',) the network's shared start."""

    network: Network
    degree: int
    ellipsoid: torch.Tensor
    start: torch.Tensor

    @cached_property
    def powers(self) -> list[tuple[int, int, int]]:
        """The degrees in x, y, z of each of the K polynomials; none for degree 0."""
        degrees = range(self.degree + 1)
        every = [(i, j, k) for i in degrees for j in degrees for k in degrees if i + j + k <= self.degree]
        return every if self.degree else []

    @property
    def size(self) -> int:
        """D: the network's weights, then the polynomials' coefficients."""
        return self.network.size + 3 * len(self.powers)

    def plain(self, points: torch.Tensor) -> torch.Tensor:
        """The ellipsoid (..., 3) at points (..., 3)."""
        return self.ellipsoid[0] + self.ellipsoid[1] * points

    def polynomials(self, points: torch.Tensor) -> torch.Tensor:
        """P (n, m, K): products of Legendre polynomials of where the shared start moves points (n, m, 3)."""
        x = points + self.network.offset(self.start[None].expand(len(points), -1), points) / self.ellipsoid[1]
        legendre = [torch.ones_like(x), x]
        for k in range(1, self.degree):
            legendre.append(((2 * k + 1) * x * legendre[k] - k * legendre[k - 1]) / (k + 1))
        parts = [legendre[i][..., 0] * legendre[j][..., 1] * legendre[k][..., 2] for i, j, k in self.powers]
        return torch.stack(parts, -1)

    def base(self, weights: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """What is linear in weights (n, D): (n, m, 3) at points (n or 1, m, 3)."""
        if not self.powers:
            return self.plain(points)
        return self.plain(points) + self.polynomials(points) @ self.coefficients(weights)

    def coefficients(self, weights: torch.Tensor) -> torch.Tensor:
        """C (n, K, 3), a view of weights (n, D)."""
        return weights[:, self.network.size :].view(-1, len(self.powers), 3)

    def __call__(self, weights: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """Where weights (n, D) move points (n, m, 3)."""
        return self.base(weights, points) + self.network.offset(weights, points)


def evaluate(push: Push, weights: Array, points: Array) -> Array:
    """(M, 3) where one weight vector (D,) moves points (M, 3), float32."""
    with torch.no_grad():
        w, given = (torch.as_tensor(np.array(a, np.float32)) for a in (weights, points))
        parts = [push(w[None], block[None])[0] for block in torch.split(given, BLOCK)]
        return np.asarray(torch.cat(parts).numpy())


def pullback(push: Push, weights: Array, points: Array, gradient: Array) -> Array:
    """(D,) from a gradient (M, 3) by where points (M, 3) are moved to, float64."""
    fine = Push(push.network, push.degree, push.ellipsoid.double(), push.start.double())
    w = torch.tensor(np.array(weights, float)[None], requires_grad=True)
    given, wanted = (torch.as_tensor(np.array(a, float)) for a in (points, gradient))
    for block, part in zip(torch.split(given, BLOCK), torch.split(wanted, BLOCK), strict=True):
        torch.autograd.backward([fine(w, block[None])], [part[None]])
    return np.zeros(push.size) if w.grad is None else np.asarray(w.grad[0].numpy())


def icosphere(subdivision: int) -> tuple[Array, Array]:
    """Vertices (V, 3) on the unit sphere and faces (F, 3) outward; a subdivision makes four of each face of 20."""
    from trimesh import creation

    sphere = creation.icosphere(subdivisions=subdivision)
    return np.array(sphere.vertices, float), np.array(sphere.faces, np.int64)


def spiral(count: int, turn: float) -> Array:
    """(count, 3) points even over the unit sphere: a Fibonacci spiral, turned by `turn` [rad] about z."""
    place = np.arange(count) + 0.5
    z = 1 - 2 * place / max(count, 1)
    angle, radius = turn + pi * (3 - np.sqrt(5)) * place, np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)
