"""A template moved onto surfaces by smooth displacements, without knowing which point belongs to which.

Minimised over coefficients c of the displacement u, for a target surface:

    Σ_v a_v (n_v · (x_v + u(x_v) − q_v))²  +  Σ_s a_s (n_s · (y_s + u(y_s) − s))²  +  λ ∫ |∂²u|²

with q_v the target's point nearest to the template's moved vertex v and n_v its normal; y_s the moved template's point
nearest to the target's sample s and n_s that one's normal; a areas. What a point does along the surface is left to the
smoothness, so that nothing is held where it happens to lie. λ is lowered step by step (Amberg et al. 2007); each step
is one of Gauss and Newton, its linear system solved by conjugate gradients. The preconditioner, that system with all
directions weighted alike, depends on the template alone: it is factored once for all exemplars.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lampopt.types import Array
from lampopt_template.lattice import Sparse
from lampopt_template.surface import Surface
from lampopt_template.template import Template

AGREE = (0.3, 0.7)  # cosines between normals at which a pair begins to count, and counts in full
ALONG = 1e-3  # weight of moving along the surface, of that of moving across it: keeps the system definite
ROUGH, FINE = 1e-1, 3e-2  # of the residual at which conjugate gradients stop, before the last steps and in them
MOST = 40  # conjugate gradients a step
TURNED = 0.5  # what opposite normals add to the distance of a pair [template's size], while pairs are sought roughly
TINY = 1e-9  # part of a mean diagonal that keeps a factor from failing
POINTS, MORE = 2000, 6_000  # vertices, and samples, of a step that seeks pairs roughly, and of the last ones
LAST = 3  # steps at the lowest stiffness
log = logging.getLogger("lampopt")


class Registration:
    """A template ready to be moved onto surfaces: what all registrations share.

    Parameters
    ----------
    template
        What is moved.
    stiffness
        λ of each step, falling; lengths are the template's, areas parts of its own.
    """

    def __init__(self, template: Template, stiffness: Sequence[float]) -> None:
        from scipy.linalg import cho_factor
        from scipy.sparse import csr_array, diags_array, eye_array

        self.template, self.stiffness = template, tuple(stiffness)
        self.rows: Sparse = template.space.rows(template.surface.vertices)
        self.areas: Array = template.surface.vertex_areas / template.surface.vertex_areas.sum()
        self.bending: Sparse = template.space.bending()
        mass = csr_array(self.rows.T @ diags_array(self.areas) @ self.rows)
        least = TINY * mass.trace() / template.space.size  # a function may be the sum of finer ones
        mass = mass + least * eye_array(template.space.size)
        self._factors = {
            s: cho_factor((mass + s * self.bending).toarray(), check_finite=False) for s in set(self.stiffness)
        }

    def onto(self, target: Surface, *, seed: int = 0) -> Array:
        """Coefficients (size, 3) that move the template onto `target`."""
        rng = np.random.default_rng(seed)
        size, fold = self.template.size, self.template.fold
        samples = target.samples(self.template.space.coarse.cell / 4, rng)
        found = fold(self._boxed(target))
        for number, stiffness in enumerate([*self.stiffness, *[self.stiffness[-1]] * (LAST - 1)]):
            last = number >= len(self.stiffness) - 1
            now = Surface(self.template.surface.vertices + self.rows @ found, self.template.surface.faces)
            most = MORE if last else POINTS
            some, few = (rng.permutation(len(points))[:most] for points in (now.vertices, samples[0]))
            chosen = [part[few] for part in samples]
            if last:
                pairs = self._close(now, target, chosen, some)
            else:
                pairs = self._rough(now, chosen, some, TURNED / 2 * size)
            found = found + self._step(pairs, found, stiffness, FINE if last else ROUGH)
            log.debug("stiffness %.0e: %s", stiffness, pairs)
        return found

    def _boxed(self, target: Surface) -> Array:
        """The coefficients that stretch and shift the template's box to the target's."""
        low, high = (
            np.array([end(s.vertices, axis=0) for s in (self.template.surface, target)]) for end in (np.min, np.max)
        )
        nodes = self.template.space.coarse.nodes
        wide = np.where(high[0] > low[0], high[0] - low[0], 1.0)
        return self.template.space.affine(low[1] + (nodes - low[0]) / wide * (high[1] - low[1]) - nodes)

    def _rough(self, now: Surface, samples: Sequence[Array], some: Array, turned: float) -> _Pairs:
        """Pairs of a few vertices and samples, by places and normals together, so that shapes may be far apart."""
        from scipy.spatial import cKDTree

        spots, facing, share = samples
        points, normals = now.vertices[some], now.vertex_normals[some]
        here, there = np.concatenate([points, turned * normals], 1), np.concatenate([spots, turned * facing], 1)
        to, back = cKDTree(there).query(here)[1], cKDTree(here).query(there)[1]
        rows = self.rows[some]
        return _Pairs(
            _Way.of(rows, points, normals, spots[to], facing[to], self.areas[some]),
            _Way.of(rows[back], points[back], normals[back], spots, facing, share),
        )

    def _close(self, now: Surface, target: Surface, samples: Sequence[Array], some: Array) -> _Pairs:
        """Pairs of many vertices and samples with the nearest points of the other surface."""
        from scipy.sparse import csr_array

        spots, facing, share = samples
        points, normals = now.vertices[some], now.vertex_normals[some]
        near, back = target.near(points, curved=True), now.near(spots)
        pick = csr_array(
            (back.weights.ravel(), now.faces[back.faces].ravel(), np.arange(0, 3 * len(spots) + 1, 3)),
            shape=(len(spots), len(now.vertices)),
        )
        return _Pairs(
            _Way.of(self.rows[some], points, normals, near.points, near.normals, self.areas[some]),
            _Way.of(pick @ self.rows, back.points, back.normals, spots, facing, share),
        )

    def _step(self, pairs: _Pairs, now: Array, stiffness: float, tolerance: float) -> Array:
        """One step of Gauss and Newton from the coefficients `now`."""
        from scipy.linalg import cho_solve

        factor, fold = self._factors[stiffness], self.template.fold

        def system(c: Array) -> Array:
            return fold(pairs.normal(c) + stiffness * (self.bending @ c))

        step, rest = np.zeros_like(now), fold(pairs.pull() - stiffness * (self.bending @ now))
        along, before, first = np.zeros_like(now), 1.0, 0.0
        for number in range(MOST):
            eased = cho_solve(factor, rest, check_finite=False)
            left = float((rest * eased).sum())
            first = first or left
            if left <= tolerance**2 * first or left <= 1e-24:
                break
            along = eased + (left / before if number else 0.0) * along
            pushed = system(along)
            length = left / float((along * pushed).sum())
            step, rest, before = step + length * along, rest - length * pushed, left
        return step


@dataclass(frozen=True, eq=False)
class _Way:
    """Points of the template, by the `rows` (M, size) of the functions there, with the planes that they belong on."""

    rows: Sparse
    normals: Array
    gaps: Array
    areas: Array
    weights: Array

    @classmethod
    def of(cls, rows: Sparse, points: Array, facing: Array, to: Array, normals: Array, areas: Array) -> _Way:
        """`points` belong on the planes through `to` across `normals`, as far as they face alike."""
        agree = np.clip(((facing * normals).sum(1) - AGREE[0]) / (AGREE[1] - AGREE[0]), 0, 1)
        areas = areas / areas.sum()
        return cls(rows, normals, (normals * (to - points)).sum(1), areas, areas * agree)

    def normal(self, c: Array) -> Array:
        """The normal equations' matrix times `c` (size, 3)."""
        moved = self.rows @ c
        across = (self.weights * (self.normals * moved).sum(1))[:, None] * self.normals
        return np.asarray(self.rows.T @ (across + ALONG * self.areas[:, None] * moved))

    def pull(self) -> Array:
        """The right hand side (size, 3)."""
        return np.asarray(self.rows.T @ ((self.weights * self.gaps)[:, None] * self.normals))

    def __str__(self) -> str:
        agree = float(self.weights.sum())
        return f"rms {np.sqrt((self.weights * self.gaps**2).sum() / max(agree, 1e-30)):.2e} where {agree:.1%} agree"


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Both ways: the template's points on the target, the target's on the template."""

    there: _Way
    back: _Way

    def normal(self, c: Array) -> Array:
        return self.there.normal(c) + self.back.normal(c)

    def pull(self) -> Array:
        return self.there.pull() + self.back.pull()

    def __str__(self) -> str:
        return f"{self.there} there, {self.back} back"
