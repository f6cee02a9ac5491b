"""Decoder `mesh-template`: a clean mesh, moved smoothly onto each exemplar; the weights are the motion's coefficients.

A design's vertices are x + Σ_k B_k(x) c_k + n d, exactly linear in its weights (c, d): the map of assumption A1, with
control points. There is one connectivity for all designs and no surface to be extracted.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from lampopt.errors import FitError, InputError
from lampopt.protocols import Progress, Shared
from lampopt.topology import Topology, topology
from lampopt.types import Array, Check
from lampopt_template.detail import Detail
from lampopt_template.health import health_checks, least_quality
from lampopt_template.lattice import Lattice, Refined
from lampopt_template.registration import Registration
from lampopt_template.remesh import edge_of, remeshed
from lampopt_template.specks import without_specks
from lampopt_template.surface import Surface
from lampopt_template.template import AXES, FADE, Template, called, mirrored_half

if TYPE_CHECKING:
    from trimesh import Trimesh

STIFFEST = 1.0  # what registration begins with: hardly more than an affine map
STEP = 100.0  # each stiffness over the next one
MARGIN = 0.05  # of the lattice around the template [template's size]
BESIDE = 0.02  # of the template's width, that an exemplar's middle may be beside its plane of symmetry
PILOTS = 6  # exemplars that are registered to find where the lattice wants to be finer
log = logging.getLogger("lampopt")
T = TypeVar("T")
U = TypeVar("U")


@dataclass(frozen=True)
class MeshTemplate:
    """A template mesh, and the smooth displacements that bring it onto exemplars of the same topology.

    Parameters
    ----------
    faces
        Triangles of the template, about.
    remesh
        Whether the template is given even triangles; without, the mean exemplar's own are taken as they are.
    cell
        Of the displacement's lattice [template's largest extent].
    stiffness
        The lowest weight of bending, where registration ends: less follows rougher shapes, and their noise.
    tolerance
        Mean distance that is left, over a place as large as half a cell and over exemplars, above which the lattice is
        made finer there [template's largest extent]; 0: never.
    detail
        Over which length a displacement along the template's normals is smooth that comes on top of the lattice's
        [template's largest extent]; 0: there is none.
    symmetry
        "x", "y" or "z": shapes are mirror images of themselves across that axis, exactly; "" without.
    """

    faces: int = 30_000
    remesh: bool = True
    cell: float = 0.09
    stiffness: float = 2e-7
    tolerance: float = 2e-4
    detail: float = 0.0
    symmetry: str = ""

    def __post_init__(self) -> None:
        if not 20 <= self.faces <= 2_000_000:
            raise InputError(f"faces: expected 20 to 2,000,000 triangles, got {self.faces}")
        least = {"cell": 0.01, "stiffness": 1e-12, "tolerance": 0.0, "detail": 0.0}
        for name, low in least.items():
            if not low <= getattr(self, name) <= 1:
                raise InputError(f"{name}: expected {low:g} to 1, got {getattr(self, name)}")
        if self.symmetry not in ("", "x", "y", "z"):
            raise InputError(f"symmetry: expected 'x', 'y', 'z' or '', got {self.symmetry!r}")

    @classmethod
    def example(cls) -> MeshTemplate:
        """A cheap instance for `lampopt.testing`."""
        return cls(faces=2000, cell=0.2)

    @property
    def bounds(self) -> Array:
        """(2, 3): the box [-1, 1]³."""
        return np.array([[-1.0] * 3, [1.0] * 3])

    def prepare(self, meshes: Sequence[Trimesh], *, mean: Trimesh, seed: int) -> Shared:
        """The template and the lattice that moves it, finer where exemplars ask for it.

        Raises FitError where an exemplar is of another topology than the mean, or beside its plane of symmetry, naming
        it; loose specks aside.
        """
        if len({topology(mean).bodies, *(topology(mesh).bodies for mesh in meshes)}) > 1:
            mean = without_specks(mean)
        if (wanted := topology(mean)).genus is None:
            raise FitError(
                f"{called(mean)}: expected a closed mesh as the template's, got one that is open: "
                "close it (`lampopt wrap`)"
            )
        sizes = []
        for mesh in meshes:  # one at a time: there may be thousands
            alike = _alike(mesh, wanted)
            self._expect_one_plane(alike, mean.bounds)
            sizes.append(_size(alike))
        template = self._template(mean)
        pilots = [Surface.of(_alike(meshes[i], wanted)) for i in _outer(np.array(sizes))]
        registration = self._registration(template)
        plain = replace(template, detailed=False)  # the lattice is to do what it can before detail comes on top
        moved = _each(lambda target: plain.moved(self._onto(plain, registration, target, seed)), pilots)
        quality = min(least_quality(vertices, template.surface.faces) for vertices in moved)
        template = replace(template, quality=quality)
        if self.tolerance:
            template = replace(template, space=self._refined(template, pilots, moved))
        return template.arrays()

    def fit(
        self, shared: Shared, meshes: Sequence[Trimesh], *, seed: int, progress: Progress | None = None
    ) -> tuple[Array, Array]:
        """Weights (n, D) and mean surface errors (n,) [box]: the larger of there and back."""
        template = self._of(shared)
        wanted, registration = topology(template.mesh(template.surface.vertices)), self._registration(template)
        said = progress or (lambda done, message="", /: None)

        bounds = np.array([template.surface.vertices.min(0), template.surface.vertices.max(0)])

        def fitted(mesh: Trimesh) -> tuple[Array, float]:
            alike = _alike(mesh, wanted)
            self._expect_one_plane(alike, bounds)
            target = Surface.of(alike)
            weights = self._onto(template, registration, target, seed).astype(np.float32)
            made = Surface(template.moved(weights), template.surface.faces)
            return weights, max(made.away(target), target.away(made))

        weights, errors = zip(*_each(fitted, meshes, said), strict=True)
        return np.array(weights), np.array(errors)

    def evaluate(self, shared: Shared, weights: Array, points: Array) -> Array:
        """Where points (M, 3) of the template go to (..., M, 3) by weights (..., D)."""
        weights, points = np.asarray(weights), np.asarray(points, float)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"points: expected shape (M, 3), got {points.shape}")
        template = self._of(shared)
        moved = np.array([*map(template.carrier(points), weights.reshape(-1, weights.shape[-1]))])
        return moved.reshape(*weights.shape[:-1], len(points), 3)

    def decode(self, shared: Shared, weights: Array, *, resolution: int) -> Trimesh:
        """The moved template [box]. It has the template's triangles, whatever the `resolution`."""
        template = self._of(shared)
        return template.mesh(template.moved(weights))

    def probes(self, shared: Shared, count: int, seed: int) -> Array:
        """(count, 3) points drawn evenly on the template."""
        return self._of(shared).surface.drawn(count, np.random.default_rng(seed))

    def pullback(self, shared: Shared, weights: Array, mesh: Trimesh, gradient: Array) -> Array:
        """(D,) derivatives by the weights of what has `gradient` (V, 3) by the vertices; exact, they being linear."""
        template, gradient = self._of(shared), np.asarray(gradient, float)
        if gradient.shape != template.surface.vertices.shape:
            raise InputError(f"gradient: expected shape {template.surface.vertices.shape}, got {gradient.shape}")
        return template.pulled(gradient)

    def displace(self, shared: Shared, weights: Array, points: Array) -> Array:
        """Points (M, 3) of the space around the template moved along; far from the lattice they stay.

        Within the lattice they move as it does; beyond, its motion at the nearest place in it dies away.
        """
        template = self._of(shared)
        return template.displaced(np.asarray(points, float), weights, FADE * template.size)

    def design_checks(self, shared: Shared, weights: Array, mesh: Trimesh) -> Sequence[Check]:
        """Whether the moved template is a sound surface."""
        return health_checks(self._of(shared), weights, np.asarray(mesh.vertices))

    def _expect_one_plane(self, mesh: Trimesh, of: Array) -> None:
        """FitError where the middle of `mesh` is not where that of the template with bounds `of` (2, 3) is.

        One plane is all shapes': a shape beside it would be met by one as wide as it and its mirror image together.
        """
        if not self.symmetry:
            return
        axis = AXES.index(self.symmetry)
        (low, high), (own_low, own_high) = of[:, axis], np.asarray(mesh.bounds)[:, axis]
        off = abs(own_low + own_high - low - high) / 2 / (high - low)
        if off > BESIDE:
            raise FitError(
                f"{called(mesh)}: symmetry={self.symmetry!r}: expected its middle along {self.symmetry} where the "
                f"template's is, got it {off:.0%} of the width beside it: move it there, or leave symmetry out"
            )

    def _of(self, shared: Shared) -> Template:
        return Template.of(shared, detailed=self.detail > 0)

    def _template(self, mean: Trimesh) -> Template:
        given = Surface.of(mean)
        vertices, faces = given.vertices, given.faces
        twins, plane = np.empty(0, np.int64), np.empty(0)
        edge = edge_of(float(mean.area), self.faces)
        if self.remesh:
            vertices, faces = remeshed(vertices, faces, edge)
        if self.symmetry:
            vertices, faces, twins, plane = mirrored_half(vertices, faces, AXES.index(self.symmetry), edge / 4)
        size = float(np.ptp(vertices, axis=0).max())
        space = Refined(Lattice.around(vertices, self.cell * size, MARGIN * size), np.empty(0, np.int64))
        quality = least_quality(vertices, faces)
        return Template(Surface(vertices, faces), twins, plane, space, self.detail > 0, quality)

    def _registration(self, template: Template) -> Registration:
        number = max(round(np.log(STIFFEST / self.stiffness) / np.log(STEP)), 1)
        # ∫ |∂²u|² goes with length where u² goes with its square
        return Registration(template, (template.size * np.geomspace(STIFFEST, self.stiffness, number + 1)).tolist())

    def _onto(self, template: Template, registration: Registration, target: Surface, seed: int) -> Array:
        """The weights (D,) that move the template onto `target`."""
        weights = registration.onto(target, seed=seed).ravel()
        if not template.detailed:
            return weights
        moved = replace(template, detailed=False).moved(weights)
        along = Detail(template.surface, self.detail * template.size).onto(target, moved)
        along[template.twins] = (along[template.twins] + along[template.half :]) / 2
        return np.concatenate([weights, along[: template.half]])

    def _refined(self, template: Template, targets: Sequence[Surface], moved: Sequence[Array]) -> Refined:
        """The lattice with finer functions where it leaves more than `tolerance` to the targets."""
        fine = template.space.fine
        cells = np.floor((template.surface.vertices - fine.low) / fine.cell).astype(np.int64)
        _, cell = np.unique(cells, axis=0, return_inverse=True)
        areas = template.surface.vertex_areas
        left = np.zeros(cell.max() + 1)
        for target, vertices in zip(targets, moved, strict=True):
            near = target.near(vertices, curved=True)
            gap = (near.normals * (near.points - vertices)).sum(1)
            left += (np.bincount(cell, areas * gap) / np.bincount(cell, areas)) ** 2
        rough = np.sqrt(left / len(targets)) > self.tolerance * template.size
        log.info("lattice: finer at %d of %d places", rough.sum(), len(rough))
        chosen = template.space.where(template.surface.vertices[rough[cell]])
        if len(template.plane):
            axis = int(template.plane[0])
            image = np.flip(np.arange(fine.size).reshape(fine.count), axis).ravel()
            chosen = np.union1d(chosen, image[chosen])
        return Refined(template.space.coarse, chosen)


def _each(do: Callable[[T], U], things: Sequence[T], progress: Progress = lambda done, message="", /: None) -> list[U]:
    """`do` of each of `things`, in threads: most of the work leaves Python alone, and is one thread's by itself."""
    from threadpoolctl import threadpool_limits

    workers = min(len(things), len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1)
    found: list[U] = []
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(max(workers, 1)) as pool:
        for number, one in enumerate(pool.map(do, things)):
            found.append(one)
            progress((number + 1) / len(things))
    return found


def _alike(mesh: Trimesh, wanted: Topology) -> Trimesh:
    """`mesh`, without specks if it has more bodies than wanted; FitError where it is closed and of another topology."""
    if len(mesh.faces) == 0 or not mesh.area > 0:
        raise FitError(f"{called(mesh)}: expected a surface, got a mesh without faces")
    found = topology(mesh)
    if found.bodies > wanted.bodies:
        mesh = without_specks(mesh)
        found = topology(mesh)
    if found.genus is None:
        log.warning("%s: is open: the template is moved onto what there is of it", called(mesh))
    elif (found.bodies, found.genus) != (wanted.bodies, wanted.genus):
        raise FitError(
            f"{called(mesh)}: expected the template's topology, {_said(wanted)}, got {_said(found)}: no motion of "
            "the template makes one of the other; leave it out, or take decoder 'sdf-mlp'"
        )
    return mesh


def _said(shape: Topology) -> str:
    return f"{shape.bodies} bod{'y' if shape.bodies == 1 else 'ies'} of genus {shape.genus}"


def _size(mesh: Trimesh) -> list[float]:
    """Its extents, and how large its volume and its surface are, as lengths."""
    return [*mesh.extents.tolist(), float(np.cbrt(abs(mesh.volume))), float(np.sqrt(mesh.area))]


def _outer(sizes: Array) -> list[int]:
    """Exemplars whose sizes (N, 5) differ most, each from those before it."""
    away = np.linalg.norm(sizes - sizes.mean(0), axis=1)
    chosen: list[int] = []
    while len(chosen) < min(PILOTS, len(sizes)):
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(sizes - sizes[chosen[-1]], axis=1))
    return chosen
