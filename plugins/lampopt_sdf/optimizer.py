"""Steps of n networks at once: momentum made orthogonal for what lies between hidden layers, Adam for all else.

An orthogonal step turns every direction of a layer alike (Jordan et al., 2024, Muon), where Adam's follows the few that
the gradient is full of: a network comes to the same error in half the steps, of a quarter of the points, and stays
nearer to the shared start (benchmarks/optimizers.py). torch.optim.Muon takes one matrix at a time; here those of all
networks are views of flat rows, and go through the iteration together.
"""

from __future__ import annotations

import torch

from lampopt_sdf.network import Network

MOMENTUM = 0.95
ROUNDS = 5  # of Newton and Schulz's iteration
# Its coefficients (Jordan et al.): singular values of 0.001 to 1 come to 0.7 to 1.2.
QUINTIC = (3.4445, -4.7750, 2.0315)


class Optimizer:
    """Moves `weights` (n, D) by their gradient.

    Parameters
    ----------
    network
        Whose weights they are.
    weights
        Altered in place; beside them they get a gradient of zero, to be filled before each step.
    reach
        Of orthogonal steps of hidden layers, as a part of the rate that Adam's coordinates have and of the square root
        of the width; 0: they take Adam's steps too.
    """

    def __init__(self, network: Network, weights: torch.Tensor, *, reach: float) -> None:
        self._network, self._weights, self._reach = network, weights, reach
        weights.grad = torch.zeros_like(weights)
        fused = weights.device.type in ("cpu", "cuda")
        self._adam = torch.optim.Adam([weights], betas=(0.9, 0.99), eps=1e-10, fused=fused)
        self._momentum = torch.zeros_like(self._hidden(weights)) if self._reach else torch.empty(len(weights), 0)

    def step(self, rate: float, *, half: bool = False) -> None:
        """One step, its direction worked out in bfloat16 with `half`; the gradient is not kept."""
        assert self._weights.grad is not None
        gradient = self._hidden(self._weights.grad)
        if self._reach:
            self._momentum.mul_(MOMENTUM).add_(gradient)
            ahead = gradient.add(self._momentum, alpha=MOMENTUM).flatten(0, 1)
            turned = orthogonal(ahead, torch.bfloat16 if half else torch.float32).view_as(gradient)
            gradient.zero_()  # Adam leaves alone what has none
        for group in self._adam.param_groups:
            group["lr"] = rate
        self._adam.step()
        if self._reach:
            self._hidden(self._weights).sub_(turned, alpha=rate * self._reach * float(self._network.width) ** 0.5)

    def only(self, keep: torch.Tensor, weights: torch.Tensor) -> Optimizer:
        """The same for those rows that `keep` (n,) says, whose weights are `weights`, as far as they are."""
        found = Optimizer(self._network, weights, reach=self._reach)
        found._momentum.copy_(self._momentum[keep])
        (state,) = self._adam.state.values()
        found._adam.state[weights] = {name: part[keep] if part.ndim else part.clone() for name, part in state.items()}
        return found

    def _hidden(self, rows: torch.Tensor) -> torch.Tensor:
        """A view (n, depth - 1, width, width) of what lies between hidden layers in rows (n, D)."""
        width, depth = self._network.width, self._network.depth
        first = (self._network.shapes[0][0] + 1) * width
        layers = rows[:, first : first + (depth - 1) * width * (width + 1)]
        return layers.view(len(rows), depth - 1, width + 1, width)[:, :, :width]  # the last row is the bias


def orthogonal(matrices: torch.Tensor, precision: torch.dtype = torch.float32) -> torch.Tensor:
    """(k, w, w) about the nearest orthogonal ones to `matrices`, by Newton and Schulz's iteration."""
    a, b, c = QUINTIC
    found: torch.Tensor = (matrices / matrices.norm(dim=(1, 2), keepdim=True).clamp_min(1e-12)).to(precision)
    for _ in range(ROUNDS):
        square = torch.bmm(found, found.transpose(1, 2))
        found = torch.baddbmm(found, torch.baddbmm(square, square, square, beta=b, alpha=c), found, beta=a)
    return found
