"""What all exemplars share: the template's mesh, the functions that move it, its plane of symmetry."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array
from lampopt_template.lattice import Lattice, Refined, Sparse
from lampopt_template.surface import Surface

if TYPE_CHECKING:
    from trimesh import Trimesh

AXES = ("x", "y", "z")
BLOCK = 100_000  # points that are moved at once
FADE = 0.5  # over what distance from a template a motion of space dies away [template's size]
ARRAYS = ("vertices", "faces", "twins", "plane", "low", "cell", "spans", "chosen", "quality")


@dataclass(frozen=True, eq=False)
class Template:
    """A mesh that is moved by weights (c, d): x + Σ_k B_k(x) c_k + n d.

    Parameters
    ----------
    surface
        V vertices and F faces, faces outward. With a plane of symmetry the H vertices of one half come first.
    twins
        (V − H,) which vertex of the half each of the others is the mirror image of.
    plane
        (2,) the axis across the plane of symmetry and where the plane is on it; empty without.
    space
        The functions B_k.
    detailed
        Whether there are displacements d along the normals n, one a vertex of the half.
    quality
        How well formed triangles are on exemplars (`health.least_quality`).
    """

    surface: Surface
    twins: Array
    plane: Array
    space: Refined
    detailed: bool
    quality: float

    @classmethod
    def of(cls, shared: Mapping[str, Array], detailed: bool) -> Template:
        """From a bank's named arrays. Raises InputError where they are not a template's."""
        if missing := [name for name in ARRAYS if name not in shared]:
            raise InputError(f"shared: expected {', '.join(ARRAYS)}, got none of {', '.join(missing)}")
        lattice = Lattice(np.asarray(shared["low"], float), float(shared["cell"][0]), np.asarray(shared["spans"]))
        return cls(
            Surface(shared["vertices"], shared["faces"]),
            np.asarray(shared["twins"], np.int64),
            np.asarray(shared["plane"], float),
            Refined(lattice, np.asarray(shared["chosen"], np.int64)),
            detailed,
            float(shared["quality"][0]),
        )

    def arrays(self) -> dict[str, Array]:
        """What `of` makes it from again."""
        coarse = self.space.coarse
        return {
            "vertices": self.surface.vertices,
            "faces": self.surface.faces.astype(np.int32),
            "twins": self.twins.astype(np.int32),
            "plane": self.plane,
            "low": coarse.low,
            "cell": np.array([coarse.cell]),
            "spans": coarse.spans,
            "chosen": self.space.chosen,
            "quality": np.array([self.quality]),
        }

    @property
    def size(self) -> float:
        """The largest extent."""
        return float(np.ptp(self.surface.vertices, axis=0).max())

    @property
    def half(self) -> int:
        """H, the vertices that the others follow; V without a plane of symmetry."""
        return len(self.surface.vertices) - len(self.twins)

    @property
    def count(self) -> int:
        """D, the number of weights."""
        return 3 * self.space.size + (self.half if self.detailed else 0)

    @cached_property
    def rows(self) -> Sparse:
        """(H, size) the functions at the vertices of the half."""
        return self.space.rows(self.surface.vertices[: self.half])

    def parts(self, weights: Array) -> tuple[Array, Array]:
        """Coefficients (size, 3) and displacements along the normals (H,), if any, from weights (D,)."""
        weights = np.asarray(weights, float)
        if weights.shape != (self.count,):
            raise InputError(f"weights: expected {self.count} for this template, got shape {weights.shape}")
        coefficients, along = np.split(weights, [3 * self.space.size])
        return coefficients.reshape(-1, 3), along

    def moved(self, weights: Array) -> Array:
        """(V, 3) the vertices of a design."""
        coefficients, along = self.parts(weights)
        half = self.surface.vertices[: self.half] + self.rows @ coefficients
        if self.detailed:
            half = half + self.surface.vertex_normals[: self.half] * along[:, None]
        return self.whole(half)

    def carrier(self, points: Array) -> Callable[[Array], Array]:
        """Where points (M, 3) on and in the template go along with it: from weights (D,) to (M, 3).

        Beyond the lattice they move as the nearest place in it; a displacement along normals is that of the nearest
        place on the template, and dies away over the length of a cell.
        """
        rows, beside = self.space.rows(self._inside(points)), self._beside(points)
        return lambda weights: np.asarray(points + rows @ self.parts(weights)[0] + beside(weights))

    def displaced(self, points: Array, weights: Array, fade: float) -> Array:
        """Points (M, 3) of space moved as by `carrier`; beyond the lattice that dies away over the length `fade`."""
        coefficients, moved = self.parts(weights)[0], np.array(points, float)
        for first in range(0, len(points), BLOCK):
            block = moved[first : first + BLOCK]
            inside = self._inside(block)
            share = dying(np.linalg.norm(block - inside, axis=1) / fade)[:, None]
            near = share[:, 0] > 0
            own = self._beside(block[near])(weights)
            block[near] += self.space.displacement(inside[near], coefficients) * share[near] + own
        return moved

    def _inside(self, points: Array) -> Array:
        """The places of the lattice nearest to `points` (M, 3)."""
        return np.clip(points, self.space.coarse.low, self.space.coarse.high)

    def _beside(self, points: Array) -> Callable[[Array], Array]:
        """What displacements along normals add to the motion of `points` (M, 3): from weights (D,) to (M, 3)."""
        if not self.detailed:
            return lambda weights: np.zeros_like(points)
        near = self.surface.near(points)
        faces = self.surface.faces[near.faces]
        away = np.linalg.norm(points - near.points, axis=1) / self.space.coarse.cell
        beside = near.weights * dying(away)[:, None]

        def carried(weights: Array) -> Array:
            along = self.parts(weights)[1]
            corners = self._everywhere(self.surface.vertex_normals[: self.half] * along[:, None])
            return np.asarray(np.einsum("mk,mkc->mc", beside, corners[faces]))

        return carried

    def _everywhere(self, half: Array) -> Array:
        """(V, 3) displacements of all vertices from those of the half."""
        if not len(self.plane):
            return half
        others = half[self.twins]
        others[:, int(self.plane[0])] *= -1
        return np.concatenate([half, others])

    def whole(self, half: Array) -> Array:
        """(V, 3) the vertices from those of the half: their mirror images beside them, those on the plane on it."""
        if not len(self.plane):
            return half
        axis, at = int(self.plane[0]), self.plane[1]
        half[self._on_plane, axis] = at
        others = half[self.twins]
        others[:, axis] = 2 * at - others[:, axis]
        return np.concatenate([half, others])

    def pulled(self, gradient: Array) -> Array:
        """(D,) the derivatives by the weights of what has `gradient` (V, 3) by the vertices: the adjoint of `moved`."""
        half = np.array(gradient[: self.half], float)
        if len(self.plane):
            axis = int(self.plane[0])
            others = np.array(gradient[self.half :], float)
            others[:, axis] *= -1
            for k in range(3):
                half[:, k] += np.bincount(self.twins, others[:, k], self.half)
            half[self._on_plane, axis] = 0.0
        parts = [(self.rows.T @ half).ravel()]
        if self.detailed:
            parts.append((self.surface.vertex_normals[: self.half] * half).sum(1))
        return np.concatenate(parts)

    def fold(self, coefficients: Array) -> Array:
        """(size, 3) coefficients, kept to the symmetry."""
        if not len(self.plane):
            return coefficients
        axis = int(self.plane[0])
        mirrored = coefficients[self._mirrored].copy()
        mirrored[:, axis] *= -1
        return np.asarray((coefficients + mirrored) / 2)

    @cached_property
    def _mirrored(self) -> Array:
        """(size,) which function each one becomes across the plane."""
        return self.space.mirrored(int(self.plane[0]))

    @cached_property
    def _on_plane(self) -> Array:
        """(k,) those of the half that are their own mirror images."""
        own = np.ones(self.half, bool)
        own[self.twins] = False
        return np.flatnonzero(own)

    def mesh(self, vertices: Array) -> Trimesh:
        """`vertices` (V, 3) on the template's connectivity."""
        from trimesh import Trimesh

        return Trimesh(vertices, self.surface.faces, process=False)


def called(mesh: Trimesh) -> str:
    """An exemplar's name, for messages."""
    return str(mesh.metadata.get("name", "a mesh"))


def dying(distance: Array) -> Array:
    """1 at distance 0, 0 from 1 on, smooth between."""
    return np.asarray((1 - np.minimum(distance, 1) ** 2) ** 2)


def mirrored_half(vertices: Array, faces: Array, axis: int, near: float) -> tuple[Array, Array, Array, Array]:
    """A surface that is its own mirror image across the middle of its box, made from its half on the high side.

    Vertices within `near` of the plane are put onto it first, so that no sliver is cut off.

    Returns
    -------
    tuple
        Vertices, those of the half first; faces; twins; plane, as a `Template` holds them.
    """
    from trimesh import Trimesh

    at = float(vertices[:, axis].min() + vertices[:, axis].max()) / 2
    vertices = vertices.copy()
    on = np.abs(vertices[:, axis] - at) < near
    vertices[on, axis] = at
    normal, origin = np.eye(3)[axis], at * np.eye(3)[axis]
    whole = Trimesh(vertices, faces, process=False)
    cut = whole.slice_plane(origin, normal)
    cut.merge_vertices()
    cut.update_faces(cut.nondegenerate_faces())
    cut.remove_unreferenced_vertices()
    half, sides = np.array(cut.vertices, float), np.asarray(cut.faces, np.int64)
    on_plane = np.abs(half[:, axis] - at) < 1e-9 * max(float(np.ptp(vertices, axis=0).max()), 1e-300)
    half[on_plane, axis] = at
    sides = sides[~on_plane[sides].all(1)]  # a face in the plane would be there twice
    twins = np.flatnonzero(~on_plane)
    image = np.arange(len(half))
    image[twins] = len(half) + np.arange(len(twins))
    others = half[twins].copy()
    others[:, axis] = 2 * at - others[:, axis]
    return (
        np.concatenate([half, others]),
        np.concatenate([sides, image[sides][:, ::-1]]),
        twins,
        np.array([float(axis), at]),
    )
