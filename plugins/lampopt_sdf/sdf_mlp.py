"""Decoder `sdf-mlp`: one signed distance network per exemplar, all from one shared start (paper, section 3)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.decode import NarrowBand, field_to_mesh
from lampopt.errors import InputError
from lampopt.protocols import Progress, Shared
from lampopt.types import Array

if TYPE_CHECKING:
    import torch
    from trimesh import Trimesh

    from lampopt_sdf.network import Network
    from lampopt_sdf.training import Samples

RATES = {"relu": 2e-3, "sine": 2e-4}  # first learning rate for an exemplar
# Of weights that start at random and of those that start at the shared ones: times that rate, and reach of orthogonal
# steps. What moves little from the start stays aligned with what else does.
FRESH, FROM_START = {"muon": (2.5, 0.2), "adam": (1.5, 0.0)}, {"muon": (1.0, 0.05), "adam": (1.0, 0.0)}
PRECISIONS = ("auto", "float32", "bfloat16")
START, PROBES, ORDER, POINTS = range(4)  # streams of random numbers, none of which repeats another
STEEP = 0.1  # slope of the field below which a surface point's motion is not told by it; a distance has 1


@dataclass(frozen=True)
class SdfMlp:
    """Fourier features and an MLP, fitted to signed distances.

    Parameters
    ----------
    width, depth
        Of the hidden layers.
    octaves
        Fourier features sin, cos of 2^k πz for k below it; 0 leaves z alone. Few: a network that knows only low
        frequencies has to move its surface where one with many redraws it, and moving is what extrapolates.
    activation
        "relu" (the paper's) or "sine" (SIREN; take octaves=0).
    start_steps, steps
        Optimizer steps for the shared start, and for each exemplar from there.
    points
        Points an exemplar sees in one step.
    samples
        Points drawn about each exemplar, once.
    optimizer
        "muon": orthogonal steps of hidden layers, Adam's of the rest; or "adam" (the paper's) throughout.
    precision
        "auto": most steps in bfloat16 where the processor has instructions for it and the activation is "relu";
        "bfloat16", "float32".
    learning_rate
        The first, for exemplars; the shared start takes more of it. 0: what suits the activation.
    tolerance
        Mean surface error at which an exemplar is finished [box]; 0: never before `steps`.
    shared_start
        False is the ablation: each exemplar from random weights of its own (paper, tables 5 and 6).
    seed_per_exemplar
        True is the paper's second ablation: each exemplar sees points in an order of its own.
    device
        "cpu", or what torch calls another.
    """

    width: int = 96
    depth: int = 4
    octaves: int = 2
    activation: str = "relu"
    start_steps: int = 3000
    steps: int = 600
    points: int = 1024
    samples: int = 100_000
    optimizer: str = "muon"
    precision: str = "auto"
    learning_rate: float = 0.0
    tolerance: float = 1e-4
    shared_start: bool = True
    seed_per_exemplar: bool = False
    device: str = "cpu"

    def __post_init__(self) -> None:
        for name, least in (
            ("width", 1),
            ("depth", 1),
            ("octaves", 0),
            ("start_steps", 1),
            ("steps", 1),
            ("points", 1),
        ):
            if getattr(self, name) < least:
                raise InputError(f"{name}: expected at least {least}, got {getattr(self, name)}")
        if self.activation not in RATES:
            raise InputError(f"activation: expected one of {', '.join(RATES)}, got {self.activation!r}")
        for name, known in (("optimizer", tuple(FRESH)), ("precision", PRECISIONS)):
            if getattr(self, name) not in known:
                raise InputError(f"{name}: expected one of {', '.join(known)}, got {getattr(self, name)!r}")
        if self.precision == "bfloat16" and self.activation == "sine":
            raise InputError("precision: a sine of bfloat16 is noise: take float32 with activation='sine'")
        if self.samples < self.points:
            raise InputError(f"samples: expected at least as many as points ({self.points}), got {self.samples}")
        if not (0 <= self.learning_rate < 1 and 0 <= self.tolerance < 1):
            raise InputError(f"learning_rate, tolerance: expected 0 to 1, got {self.learning_rate}, {self.tolerance}")

    @classmethod
    def example(cls) -> SdfMlp:
        """A cheap instance for `lampopt.testing`."""
        return cls(width=48, depth=3, octaves=2, start_steps=800, steps=200, points=1024, samples=8000)

    @property
    def bounds(self) -> Array:
        """(2, 3): the box [-1, 1]³."""
        return np.array([[-1.0] * 3, [1.0] * 3])

    def prepare(self, meshes: Sequence[Trimesh], *, mean: Trimesh, seed: int) -> Shared:
        """The start weights (D,): fitted to `mean`, or random ones where there is to be no shared start."""
        first = self._network().initial(np.random.default_rng(_common(seed, START)))
        if not self.shared_start:
            return {"start": first}
        weights, _ = self._train(first[None], [mean], seed, self.start_steps, FRESH, None)
        return {"start": weights[0]}

    def fit(
        self, shared: Shared, meshes: Sequence[Trimesh], *, seed: int, progress: Progress | None = None
    ) -> tuple[Array, Array]:
        """Weights (n, D) and mean surface errors (n,) [box] of a batch, in batched matrix products."""
        if self.shared_start:
            start = np.repeat(self._checked(shared)[None], len(meshes), 0)
            return self._train(start, meshes, seed, self.steps, FROM_START, progress)
        start = np.stack([self._network().initial(np.random.default_rng(_own(seed, m, START))) for m in meshes])
        return self._train(start, meshes, seed, self.start_steps + self.steps, FRESH, progress)

    def evaluate(self, shared: Shared, weights: Array, points: Array) -> Array:
        """Signed distances (..., M, 1) of weights (..., D) at points (M, 3) [box]."""
        from lampopt_sdf.network import evaluate

        weights, points, network = np.asarray(weights), np.asarray(points), self._network()
        if weights.shape[-1:] != (network.size,):
            raise InputError(f"weights: expected {network.size} for this network, got shape {weights.shape}")
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"points: expected shape (M, 3), got {points.shape}")
        flat = [evaluate(network, w, points, self._device()) for w in weights.reshape(-1, network.size)]
        return np.array(flat, np.float32).reshape(*weights.shape[:-1], len(points), 1)

    def decode(self, shared: Shared, weights: Array, *, resolution: int) -> Trimesh:
        """The zero level set in the box, closed, faces outward. Raises EmptyMesh."""
        return field_to_mesh(lambda points: self.evaluate(shared, weights, points)[..., 0], self.bounds, resolution)

    def follow(self, shared: Shared, *, resolution: int) -> Callable[[Array], Trimesh]:
        """As `decode`, of one weight vector (D,) after another: near the last only a band about it is evaluated."""
        band = NarrowBand(self.bounds, resolution)
        return lambda weights: band.mesh(lambda points: self.evaluate(shared, weights, points)[..., 0])

    def adjoint(self, shared: Shared, weights: Array, points: Array, gradient: Array) -> Array:
        """(D,) from a gradient (M, 1) by the values of `evaluate` at points (M, 3)."""
        from lampopt_sdf.network import adjoint

        if np.shape(gradient) != (len(points), 1):
            raise InputError(f"gradient: expected shape {(len(points), 1)}, got {np.shape(gradient)}")
        return adjoint(self._network(), weights, points, gradient, self._device())

    def pullback(self, shared: Shared, weights: Array, mesh: Trimesh, gradient: Array) -> Array:
        """(D,) from a gradient (V, 3) by the vertices of `mesh`, the zero level set of weights (D,).

        A surface point moves along its normal by −δf / |∇f| (Remelli et al., 2020, MeshSDF). What a motion along the
        surface would change, a change of the vertices' places in their cells, is left out.
        """
        from lampopt_sdf.network import slopes

        points, gradient = np.asarray(mesh.vertices), np.asarray(gradient, float)
        if gradient.shape != points.shape:
            raise InputError(f"gradient: expected shape {points.shape}, a row for each vertex, got {gradient.shape}")
        slope = slopes(self._network(), weights, points, self._device())
        by = -(gradient * slope).sum(1) / np.maximum((slope**2).sum(1), STEEP**2)
        return self.adjoint(shared, weights, points, by[:, None])

    def probes(self, shared: Shared, count: int, seed: int) -> Array:
        """(count, 3) points drawn evenly in the box (paper, appendix N)."""
        return np.random.default_rng(_common(seed, PROBES)).uniform(-1.0, 1.0, (count, 3))

    def _network(self) -> Network:
        from lampopt_sdf.network import Network

        return Network(self.width, self.depth, self.octaves, self.activation)

    def _device(self, *, fit: bool = False) -> torch.device:
        """Where to compute: a bank fitted on a device that is not here is still evaluated, on the processor."""
        import torch

        try:
            return torch.zeros(0, device=self.device).device
        except (RuntimeError, AssertionError) as error:
            if fit:
                raise InputError(f"device: {self.device!r} cannot be used here: {error}") from error
            return torch.device("cpu")

    def _half(self) -> bool:
        """Whether to fit in bfloat16 where it suffices."""
        from lampopt_sdf.half import native

        if self.precision == "auto":
            return self.activation == "relu" and native(self._device())
        return self.precision == "bfloat16"

    def _checked(self, shared: Shared) -> Array:
        size = self._network().size
        if "start" not in shared or shared["start"].shape != (size,):
            raise InputError(
                f"shared: expected start weights of shape ({size},), got { {k: v.shape for k, v in shared.items()} }"
            )
        return np.asarray(shared["start"], np.float32)

    def _train(
        self,
        start: Array,
        meshes: Sequence[Trimesh],
        seed: int,
        steps: int,
        pace: Mapping[str, tuple[float, float]],
        progress: Progress | None,
    ) -> tuple[Array, Array]:
        from lampopt_sdf.training import train

        # The same draws for every exemplar keep their weights aligned (paper, appendix F: same seed beats own seeds).
        own, (hurry, reach) = self.seed_per_exemplar, pace[self.optimizer]
        orders = [np.random.default_rng(_own(seed, m, ORDER)) for m in meshes] if own else []
        return train(
            self._network(),
            start,
            self._samples(meshes, seed),
            orders or [np.random.default_rng(_common(seed, ORDER))],
            steps=steps,
            points=self.points,
            rate=hurry * (self.learning_rate or RATES[self.activation]),
            tolerance=self.tolerance,
            reach=reach,
            half=self._half(),
            progress=progress,
        )

    def _samples(self, meshes: Sequence[Trimesh], seed: int) -> Samples:
        import torch

        from lampopt_sdf.samples import draw
        from lampopt_sdf.training import Samples

        own = self.seed_per_exemplar
        drawn = [draw(m, self.samples, _own(seed, m, POINTS) if own else _common(seed, POINTS)) for m in meshes]
        stacked = (
            torch.as_tensor(np.array(part, np.float32), device=self._device(fit=True))
            for part in zip(*drawn, strict=True)
        )
        return Samples(*stacked)


def _common(seed: int, stream: int) -> np.random.SeedSequence:
    """The source of one kind of draw, the same for every exemplar."""
    return np.random.SeedSequence(seed, spawn_key=(stream,))


def _own(seed: int, mesh: Trimesh, stream: int) -> np.random.SeedSequence:
    """The source of one kind of draw that belongs to the mesh itself, whatever batch it is fitted in."""
    found = hashlib.blake2b(np.ascontiguousarray(mesh.vertices, float).tobytes(), digest_size=16)
    return np.random.SeedSequence(seed, spawn_key=(stream, *np.frombuffer(found.digest(), np.uint32).tolist()))
