"""Decoder `point-template`: a sphere pushed onto each exemplar by a network, from one shared start (paper, app. O)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import EmptyMesh, FitError, InputError
from lampopt.protocols import Progress, Shared
from lampopt.topology import topology
from lampopt.types import Array, Check
from lampopt_template.specks import without_specks

if TYPE_CHECKING:
    from trimesh import Trimesh

    from lampopt_template.pushing import Target
    from lampopt_template.sphere import Network, Push

START, FIRST, BENT, LATER = range(4)  # streams of random numbers, none of which repeats another
HURRY = 4.0  # times the learning rate for the shared start, which has farther to go
FINEST = 4  # subdivision of the sphere that is matched while fitting: the surface between is the network's anyway
FINEST_DECODED = 8  # a million faces
FLIPPED = 1e-3  # share of the area that may face backward
SAMPLES = 10_000  # places at which the error is told
ON_SPHERE = 1e-3  # how far from it a point may be: float32 is nearer


@dataclass(frozen=True)
class PointTemplate:
    """A sphere, an ellipsoid's size, pushed by Fourier features and a sine network onto closed meshes of genus 0.

    Every design has the template's connectivity, whatever `resolution` is asked for: `subdivision` alone sets it.

    Parameters
    ----------
    width, depth
        Of the hidden layers.
    octaves
        Fourier features sin, cos of 2^k πu for k below it; few, as for any network that is to move rather than redraw.
    degree
        Of polynomials in the shared start's surface, which are fitted first and linear in the weights: they take the
        changes of a whole body, which a network would mix with a loss. 0 is the paper's decoder, the network alone.
    subdivision
        Of the icosphere that is decoded: 20 · 4^subdivision faces.
    start_steps, steps
        Optimizer steps for the shared start, and for each exemplar from there.
    learning_rate
        Adam's first, for exemplars; the shared start takes HURRY times that.
    point
        Weight of the distance to a matched place beside that to the plane there; 0 lets points slide freely.
    evenness
        Of the shared start: how strongly a vertex is kept amid its neighbours; what keeps triangles from folding.
    stiffness
        Of what the network adds to the shared start for an exemplar: what keeps triangles from folding there, and
        exemplars aligned.
    """

    width: int = 96
    depth: int = 3
    octaves: int = 2
    degree: int = 6
    subdivision: int = 5
    start_steps: int = 1500
    steps: int = 150
    learning_rate: float = 5e-4
    point: float = 0.1
    evenness: float = 0.1
    stiffness: float = 0.1

    def __post_init__(self) -> None:
        least = {"width": 1, "depth": 1, "octaves": 0, "degree": 0, "start_steps": 1, "steps": 1}
        for name, low in least.items():
            if getattr(self, name) < low:
                raise InputError(f"{name}: expected at least {low}, got {getattr(self, name)}")
        if not 1 <= self.subdivision <= FINEST_DECODED:
            raise InputError(f"subdivision: expected 1 to {FINEST_DECODED}, got {self.subdivision}")
        if not 0 < self.learning_rate < 1:
            raise InputError(f"learning_rate: expected more than 0 and less than 1, got {self.learning_rate}")
        for name in ("point", "evenness", "stiffness"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise InputError(f"{name}: expected a finite number of at least 0, got {getattr(self, name)}")

    @classmethod
    def example(cls) -> PointTemplate:
        """A cheap instance for `lampopt.testing`."""
        return cls(width=32, depth=2, degree=3, subdivision=3, start_steps=120, steps=40, learning_rate=1e-3)

    @property
    def bounds(self) -> Array:
        """(2, 3): the box [-1, 1]³."""
        return np.array([[-1.0] * 3, [1.0] * 3])

    def prepare(self, meshes: Sequence[Trimesh], *, mean: Trimesh, seed: int) -> Shared:
        """`start` weights (D,) fitted to `mean`, the `ellipsoid` (2, 3) they add to, the sphere's `vertices`, `faces`.

        Raises
        ------
        FitError
            Where `mean` is not one closed body of genus 0.
        """
        from lampopt_template.pushing import Sphere, even, train
        from lampopt_template.sphere import icosphere

        target, sphere = _target(mean), Sphere(min(self.subdivision, FINEST))
        low, high = target.vertices[target.faces].min((0, 1)), target.vertices[target.faces].max((0, 1))
        ellipsoid, size = np.stack([(low + high) / 2, (high - low) / 2]), self._size()
        start = np.zeros(size, np.float32)
        first = self._network().initial(np.random.default_rng(_stream(seed, START)))
        start[: len(first)] = first
        push = self._push({"start": start, "ellipsoid": ellipsoid})
        weights = train(
            push,
            start[None],
            [target],
            sphere,
            even(sphere, self.evenness),
            steps=self.start_steps,
            rate=HURRY * self.learning_rate,
            point=self.point,
            seed=_stream(seed, FIRST),
            progress=None,
        )
        vertices, faces = icosphere(self.subdivision)
        return {"start": weights[0], "ellipsoid": ellipsoid, "vertices": vertices, "faces": faces}

    def fit(
        self, shared: Shared, meshes: Sequence[Trimesh], *, seed: int, progress: Progress | None = None
    ) -> tuple[Array, Array]:
        """Weights (n, D) and mean surface errors (n,) [box], the larger way between decoded and true surface.

        Raises
        ------
        FitError
            Naming a mesh that is not one closed body of genus 0.
        """
        from lampopt.metrics import surface_distance
        from lampopt_template.pushing import Sphere, bend, stiff, train

        push, given = self._push(shared), list(meshes)
        start = np.repeat(np.asarray(shared["start"], np.float32)[None], len(given), 0)
        targets, sphere = [_target(mesh) for mesh in given], Sphere(min(self.subdivision, FINEST))
        weights = train(
            push,
            bend(push, start, targets, sphere, _stream(seed, BENT)),
            targets,
            sphere,
            stiff(sphere, self.stiffness),
            steps=self.steps,
            rate=self.learning_rate,
            point=self.point,
            seed=_stream(seed, LATER),
            progress=progress,
        )
        made = (self.decode(shared, w, resolution=1) for w in weights)
        error = [surface_distance(a, b, SAMPLES) for a, b in zip(made, given, strict=True)]
        if progress:
            progress(1.0, "fitted")
        return weights, np.array(error)

    def evaluate(self, shared: Shared, weights: Array, points: Array) -> Array:
        """Where weights (..., D) move points (M, 3) of the unit sphere: (..., M, 3) [box]."""
        from lampopt_template.sphere import evaluate

        points = np.asarray(points)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"points: expected shape (M, 3), got {points.shape}")
        off = np.abs(np.linalg.norm(points, axis=1) - 1)
        if not (off <= ON_SPHERE).all():  # and not if one is NaN
            raise InputError(f"points: expected points of the unit sphere, got one {off.max():.3g} off it")
        weights, push = self._fitting(weights), self._push(shared)
        flat = [evaluate(push, w, points) for w in weights.reshape(-1, push.size)]
        return np.array(flat, np.float32).reshape(*weights.shape[:-1], len(points), 3)

    def decode(self, shared: Shared, weights: Array, *, resolution: int) -> Trimesh:
        """The pushed sphere of weights (D,). `resolution` is ignored: connectivity is the same for every design.

        Raises
        ------
        EmptyMesh
            If the weights push points to where there are no numbers.
        """
        from trimesh import Trimesh

        vertices = self.evaluate(shared, weights, self._checked(shared, "vertices", (-1, 3)))
        if vertices.ndim != 2:
            raise InputError(f"weights: expected one vector (D,), got shape {np.shape(weights)}")
        if not np.isfinite(vertices).all():
            raise EmptyMesh("the weights push the sphere to where there are no numbers; mix nearer to the exemplars")
        return Trimesh(vertices.astype(float), np.array(shared["faces"]), process=False)

    def probes(self, shared: Shared, count: int, seed: int) -> Array:
        """(count, 3) points even over the unit sphere."""
        from lampopt_template.sphere import spiral

        return spiral(count, np.random.default_rng(seed).uniform(0, 2 * np.pi))

    def pullback(self, shared: Shared, weights: Array, mesh: Trimesh, gradient: Array) -> Array:
        """(D,) from a gradient (V, 3) by the vertices of `mesh`, which `decode` made of weights (D,)."""
        from lampopt_template.sphere import pullback

        vertices, gradient = self._checked(shared, "vertices", (-1, 3)), np.asarray(gradient, float)
        if gradient.shape != vertices.shape or np.shape(mesh.vertices) != vertices.shape:
            raise InputError(
                f"gradient: expected {vertices.shape}, as the decoded mesh has it, got a gradient {gradient.shape} for "
                f"a mesh of {len(mesh.vertices)} vertices"
            )
        return pullback(self._push(shared), self._fitting(weights), vertices, gradient)

    def design_checks(self, shared: Shared, weights: Array, mesh: Trimesh) -> list[Check]:
        """Whether the surface passes through itself, and how much of it has turned over against the shared start."""
        from lampopt.intersections import self_intersections

        start = self.decode(shared, self._checked(shared, "start", (self._size(),)), resolution=1)
        if np.shape(mesh.faces) != np.shape(start.faces):
            raise InputError(f"mesh: expected the template's {len(start.faces)} faces, got {len(mesh.faces)}")
        across, before = _across(mesh), _across(start)
        area = np.linalg.norm(across, axis=1)
        flipped = float(area[(across * before).sum(1) < 0].sum() / (area.sum() or 1.0))
        crossing = len(np.unique(self_intersections(mesh)))
        return [
            Check("flipped", flipped, "<=", FLIPPED, "", "mesh", "share of the area that faces against the start's"),
            Check("crossing", float(crossing), "=", 0.0, "faces", "mesh", "that pass through another"),
        ]

    def _network(self) -> Network:
        from lampopt_template.sphere import Network

        return Network(self.width, self.depth, self.octaves)

    def _size(self) -> int:
        polynomials = (self.degree + 1) * (self.degree + 2) * (self.degree + 3) // 6 if self.degree else 0
        return self._network().size + 3 * polynomials

    def _push(self, shared: Shared) -> Push:
        import torch

        from lampopt_template.sphere import Push

        network = self._network()
        ellipsoid = self._checked(shared, "ellipsoid", (2, 3)).astype(np.float32)
        start = self._checked(shared, "start", (self._size(),)).astype(np.float32)[: network.size]
        return Push(network, self.degree, torch.as_tensor(ellipsoid), torch.as_tensor(start))

    def _fitting(self, weights: Array) -> Array:
        weights, size = np.asarray(weights), self._size()
        if weights.shape[-1:] != (size,):
            raise InputError(f"weights: expected {size} for these options, got shape {weights.shape}")
        return weights

    def _checked(self, shared: Shared, name: str, shape: tuple[int, ...]) -> Array:
        """The array `name` of what is shared; −1 stands for any length."""
        found = np.shape(shared[name]) if name in shared else None
        if (
            found is None
            or len(found) != len(shape)
            or any(w not in (-1, f) for f, w in zip(found, shape, strict=True))
        ):
            raise InputError(
                f"shared: expected {name} of shape {shape}, got { {k: v.shape for k, v in shared.items()} }"
            )
        return np.asarray(shared[name])


def _stream(seed: int, stream: int) -> np.random.SeedSequence:
    """The source of one kind of draw, the same for every exemplar: it keeps their weights aligned."""
    return np.random.SeedSequence(seed, spawn_key=(stream,))


def _target(mesh: Trimesh) -> Target:
    from lampopt_template.pushing import Target

    name = mesh.metadata.get("name", "mesh")
    if len(mesh.faces) == 0:
        raise FitError(f"{name}: expected a mesh with faces, got none; remove it from the exemplars")
    shape = topology(mesh)
    if shape.bodies > 1:
        mesh = without_specks(mesh)
        shape = topology(mesh)
    if not shape.closed:
        raise FitError(f"{name}: expected a closed surface, got an open one; close it, or take decoder sdf-mlp")
    if (shape.bodies, shape.genus) != (1, 0):
        raise FitError(
            f"{name}: a sphere can be pushed onto one body of genus 0, got genus {shape.genus}, bodies "
            f"{shape.bodies}; take a decoder of distances, such as sdf-mlp"
        )
    return Target(mesh)


def _across(mesh: Trimesh) -> Array:
    """(F, 3) normals of faces, as long as twice their area."""
    a, b, c = (np.asarray(mesh.vertices)[np.asarray(mesh.faces)[:, k]] for k in range(3))
    return np.cross(b - a, c - a)
