"""Fit n pushes of the sphere at once: match points with the surfaces both ways, take some steps of Adam, match again.

A match is a point u of the sphere, a place p on the exemplar and the normal there. Every round matches the vertices of
a sphere turned at random with the nearest places on the exemplar, and places drawn over the exemplar with the points of
the sphere that are pushed nearest to them. The loss weighs the distance to the plane at p, which lets a point slide
along the surface, and a little of the distance to p itself, which keeps it from sliding off an edge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, pi
from typing import TYPE_CHECKING

import igl
import numpy as np
import torch

from lampopt.protocols import Progress
from lampopt.types import Array
from lampopt_template.sphere import BLOCK, Push, icosphere

if TYPE_CHECKING:
    from trimesh import Trimesh

ROUND = 10  # steps between two matchings
BENDS = 8  # matchings by which the polynomials are found
RIDGE = 1e-4  # on their coefficients, times the degree squared: of two that fit, the smoother
SLIDE = 0.1  # least weight of the distance to a place beside that to the plane, for polynomials
WARM_UP = 50  # steps, or a fifth of all
SOFT = 1e-4  # distance below which the loss turns from |r| to r² [box]
Regular = Callable[["Round", torch.Tensor], torch.Tensor]


class Target:
    """A closed mesh to be reached, its nearest places found by a tree that is made once."""

    def __init__(self, mesh: Trimesh) -> None:
        self.vertices, self.faces = np.array(mesh.vertices, float), np.array(mesh.faces, np.int64)
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        across = np.cross(b - a, c - a)
        twice = np.linalg.norm(across, axis=1, keepdims=True)
        outward = np.sign(np.einsum("fk,fk->", a, across))  # of a mesh that is turned inside out, −1
        self.normals = outward * across / np.where(twice > 0, twice, 1.0)
        self._cumulated = np.cumsum(twice[:, 0])
        self._tree = igl.AABB()
        self._tree.init(self.vertices, self.faces)

    def nearest(self, points: Array) -> tuple[Array, Array]:
        """Nearest places (m, 3) to points (m, 3), and the normals there."""
        _, face, place = self._tree.squared_distance(self.vertices, self.faces, points)
        return place, self.normals[face]

    def draw(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Places (count, 3), even over the area and stratified along the faces, and the normals there."""
        at = np.searchsorted(self._cumulated, (np.arange(count) + rng.random(count)) / count * self._cumulated[-1])
        at = np.minimum(at, len(self.faces) - 1)
        root, other = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
        shares = np.stack([1 - root, root * (1 - other), root * other], 1)
        return (shares * self.vertices[self.faces[at]]).sum(1), self.normals[at]


class Sphere:
    """A triangulated unit sphere with the neighbours of its vertices."""

    def __init__(self, subdivision: int) -> None:
        self.vertices, self.faces = icosphere(subdivision)
        count = len(self.vertices)
        start, end = self.faces.ravel(), np.roll(self.faces, -1, 1).ravel()  # each edge once in each direction
        order = np.argsort(start, kind="stable")
        degree = np.bincount(start, minlength=count)
        place = np.arange(len(order)) - np.repeat(np.cumsum(degree) - degree, degree)
        neighbours = np.tile(np.arange(count)[:, None], (1, int(degree.max())))  # filled up with the vertex itself
        neighbours[start[order], place] = end[order]
        self._neighbours = torch.as_tensor(neighbours)

    def laplacian(self, values: torch.Tensor) -> torch.Tensor:
        """Σ over neighbours j of v_i − v_j for values (n, V, 3). Symmetric; only gathers, and so repeats to the bit."""
        return self._neighbours.shape[1] * values - values[:, self._neighbours].sum(2)

    def turned(self, rng: np.random.Generator) -> Array:
        """Its vertices (V, 3) after a random rotation."""
        axes, upper = np.linalg.qr(rng.normal(size=(3, 3)))
        axes = axes * np.sign(np.diag(upper))
        axes[:, 0] *= np.linalg.det(axes)
        return np.asarray(self.vertices @ axes.T)


@dataclass(frozen=True)
class Round:
    """Matches of n exemplars, V of the sphere's vertices first: points of the sphere, places, normals (n, m, 3)."""

    points: torch.Tensor
    places: torch.Tensor
    normals: torch.Tensor
    share: torch.Tensor  # (n, m) what each weighs; 0 where template and exemplar face away from each other
    base: torch.Tensor  # (n, m, 3) what the network adds to
    reference: torch.Tensor  # (n, V, 3) where the shared start would move the vertices from there

    def pull(self, moved: torch.Tensor, point: float) -> torch.Tensor:
        """The loss's gradient (n, m, 3) by where the points have moved to; `point`: of the distance to the place."""
        off = moved - self.places
        plane = (off * self.normals).sum(-1, keepdim=True)
        along = plane / torch.sqrt(plane**2 + SOFT**2) * self.normals
        towards = off / torch.sqrt((off**2).sum(-1, keepdim=True) + SOFT**2)
        return self.share.unsqueeze(-1) * (along + point * towards)


def even(sphere: Sphere, weight: float) -> Regular:
    """For the shared start: every vertex amid its neighbours, but along the surface only, so that edges stay."""

    def gradient(matched: Round, moved: torch.Tensor) -> torch.Tensor:
        normals = matched.normals[:, : moved.shape[1]]
        uneven = sphere.laplacian(moved) / 6
        uneven = uneven - (uneven * normals).sum(-1, keepdim=True) * normals
        pull = uneven / torch.sqrt((uneven**2).sum(-1, keepdim=True) + SOFT**2)
        return weight / 6 / moved.shape[1] * sphere.laplacian(pull)

    return gradient


def stiff(sphere: Sphere, weight: float) -> Regular:
    """For exemplars: the Dirichlet energy of what the network adds to the shared start; the same at any subdivision."""

    def gradient(matched: Round, moved: torch.Tensor) -> torch.Tensor:
        return weight * sphere.laplacian(moved - matched.reference)

    return gradient


def train(
    push: Push,
    start: Array,
    targets: list[Target],
    sphere: Sphere,
    regular: Regular,
    *,
    steps: int,
    rate: float,
    point: float,
    seed: np.random.SeedSequence,
    progress: Progress | None,
) -> Array:
    """Weights (n, D) after `steps` steps of the network from `start` (n, D); coefficients of polynomials stay.

    All see the same draws, which keeps them aligned.
    """
    size, given = push.network.size, torch.as_tensor(np.array(start, np.float32))
    weights = given[:, :size].clone().requires_grad_()
    optimizer = torch.optim.Adam([weights], lr=rate, betas=(0.9, 0.99), eps=1e-10)
    rounds = seed.spawn(-(-steps // ROUND))
    count, warm = len(sphere.vertices), max(1, min(WARM_UP, steps // 5))
    matched = None
    for step in range(steps):
        if matched is None or step % ROUND == 0:
            now = torch.cat([weights.detach(), given[:, size:]], 1)
            matched = match(push, now, targets, sphere, rounds[step // ROUND])
        optimizer.zero_grad()
        offsets = [push.network.offset(weights, part) for part in torch.split(matched.points, BLOCK, 1)]
        moved = matched.base + torch.cat([part.detach() for part in offsets], 1)
        gradient = matched.pull(moved, point)
        gradient[:, :count] += regular(matched, moved[:, :count])
        torch.autograd.backward(offsets, list(torch.split(gradient, BLOCK, 1)))
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1.0, (step + 1) / warm) * 0.5 * (1 + cos(pi * step / steps))
        optimizer.step()
        if progress and (step + 1) % ROUND == 0:
            progress((step + 1) / steps, f"step {step + 1} of {steps}")
    return np.asarray(torch.cat([weights.detach(), given[:, size:]], 1).numpy())


def bend(push: Push, start: Array, targets: list[Target], sphere: Sphere, seed: np.random.SeedSequence) -> Array:
    """Weights (n, D) like `start` (n, D) but for the polynomials' coefficients: least squares, matched BENDS times."""
    weights, size = torch.as_tensor(np.array(start, np.float32)), push.network.size
    if not push.powers:
        return np.array(start, np.float32)
    ridge = RIDGE * np.array([sum(powers) ** 2 for powers in push.powers])
    for k, one in enumerate(seed.spawn(BENDS)):
        matched = match(push, weights, targets, sphere, one)
        with torch.no_grad():
            rigid = push.plain(matched.points) + push.network.offset(weights, matched.points)
            polynomials = push.polynomials(matched.points)
        slide = max(SLIDE, 0.5**k)  # held at places first, along planes later
        for i, p in enumerate(polynomials.double().numpy()):
            off, normals, share = (
                a[i].double().numpy() for a in (matched.places - rigid, matched.normals, matched.share)
            )
            along = (normals[:, :, None] * p[:, None, :]).reshape(len(p), -1)  # by direction, then by polynomial
            matrix = along.T @ (share[:, None] * along)
            matrix += np.kron(np.eye(3), slide * p.T @ (share[:, None] * p)) + np.diag(np.tile(ridge, 3))
            right = along.T @ (share * (off * normals).sum(1)) + slide * ((share[:, None] * off).T @ p).ravel()
            found = np.linalg.solve(matrix, right).reshape(3, -1).T
            weights[i, size:] = torch.as_tensor(found.ravel().astype(np.float32))
    return np.asarray(weights.numpy())


def match(
    push: Push, weights: torch.Tensor, targets: list[Target], sphere: Sphere, seed: np.random.SeedSequence
) -> Round:
    """Match the sphere, turned at random, as weights (n, D) push it, with its targets."""
    turn, draw = seed.spawn(2)
    on_sphere = sphere.turned(np.random.default_rng(turn))
    points = torch.as_tensor(on_sphere.astype(np.float32)).expand(len(weights), -1, -1)
    with torch.no_grad():
        base = push.base(weights, points[:1])
        moved = (base + push.network.offset(weights, points)).double().numpy()
        reference = base + push.network.offset(push.start[None], points[:1])
    found = [
        _both_ways(on_sphere, x, sphere.faces, t, np.random.default_rng(draw))
        for x, t in zip(moved, targets, strict=True)
    ]
    stacked = [torch.as_tensor(np.stack(part).astype(np.float32)) for part in zip(*found, strict=True)]
    with torch.no_grad():
        base = push.base(weights, stacked[0])
    return Round(stacked[0], stacked[1], stacked[2], stacked[3], base, reference)


def _both_ways(
    on_sphere: Array, moved: Array, faces: Array, target: Target, rng: np.random.Generator
) -> tuple[Array, Array, Array, Array]:
    """Points of the sphere, places, normals (2V, 3) and shares (2V,): the template to the exemplar, then back."""
    count = len(moved)
    a, b, c = (np.ascontiguousarray(moved[faces[:, k]]) for k in range(3))
    across = np.cross(b - a, c - a)
    outward = np.stack([np.bincount(faces.ravel(), np.repeat(part, 3), count) for part in across.T], 1)
    place, normal = target.nearest(moved)
    drawn, upright = target.draw(count, rng)
    _, face, foot = igl.point_mesh_squared_distance(drawn, moved, faces)
    shares = igl.barycentric_coordinates(foot, a[face], b[face], c[face])
    shares = np.where(np.isfinite(shares).all(1, keepdims=True), shares, 1 / 3)  # faces without area have none
    back = (shares[:, :, None] * on_sphere[faces[face]]).sum(1)
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    facing = np.concatenate([(outward * normal).sum(1), (across[face] * upright).sum(1)]) > 0
    points, places = np.concatenate([on_sphere, back]), np.concatenate([place, drawn])
    return points, places, np.concatenate([normal, upright]), facing / count
