"""Forward and backward passes of ReLU networks in bfloat16: a quarter of the time where the processor multiplies it.

Eight bits of a number are enough for a step's direction, not for where a surface is. So what hidden layers make is in
bfloat16, forward and backward; not so the first layer, which sees coordinates, the distances that the last one tells,
what biases gather over the points, and the sums over blocks of them.
"""

from __future__ import annotations

import torch

from lampopt_sdf.network import BLOCK, Layers, Network

HALF = torch.bfloat16


class HalfPass:
    """What `Pass` does for a ReLU network, roughly. Not shared between threads: whoever computes makes one."""

    def __init__(self, network: Network, n: int, device: torch.device) -> None:
        self.network = network
        shape = (n, BLOCK, network.width)
        self._first = torch.empty(shape, device=device)
        self._hidden = [torch.empty(shape, device=device, dtype=HALF) for _ in range(network.depth)]
        self._back = [torch.empty(shape, device=device, dtype=HALF) for _ in range(2)]
        self._layers: Layers = []  # all but the first, in bfloat16, of the last forward pass

    def forward(self, layers: Layers, features: torch.Tensor) -> torch.Tensor:
        """Values (n, m, 1) at features (n, m, F), m ≤ BLOCK."""
        m = features.shape[1]
        self._layers = [(matrix.to(HALF), bias.to(HALF)) for matrix, bias in layers[1:]]
        first = torch.baddbmm(layers[0][1], features, layers[0][0], out=self._first[:, :m])
        hidden = self._hidden[0][:, :m].copy_(first.relu_())
        for (matrix, bias), kept in zip(self._layers[:-1], self._hidden[1:], strict=True):
            hidden = torch.baddbmm(bias, hidden, matrix, out=kept[:, :m]).relu_()
        return torch.baddbmm(layers[-1][1], hidden.float(), layers[-1][0])

    def backward(self, layers: Layers, gradients: Layers, features: torch.Tensor, gradient: torch.Tensor) -> None:
        """Add to `gradients` what the last `forward` contributes, given the values' gradient (n, m, 1)."""
        m = features.shape[1]
        back = gradient.to(HALF)
        for k in range(len(layers) - 1, 0, -1):
            hidden = self._hidden[k - 1][:, :m]
            gradients[k][0].add_(torch.bmm(hidden.transpose(1, 2), back))
            gradients[k][1].add_(back.sum(1, keepdim=True, dtype=torch.float32))
            before = self._back[k % 2][:, :m]
            torch.bmm(back, self._layers[k - 1][0].transpose(1, 2), out=before)
            back = torch.ops.aten.threshold_backward.grad_input(before, hidden, 0, grad_input=before)
        gradients[0][0].baddbmm_(features.transpose(1, 2), back.float())
        gradients[0][1].add_(back.sum(1, keepdim=True, dtype=torch.float32))


def native(device: torch.device) -> bool:
    """Whether `device` multiplies bfloat16 faster than float32: processors with instructions for it."""
    if device.type != "cpu":
        return False
    capable: dict[str, object] = getattr(torch.cpu, "get_capabilities", dict)()  # torch knows since 2.11
    return any(capable.get(name, False) for name in ("avx512_bf16", "amx_bf16"))
