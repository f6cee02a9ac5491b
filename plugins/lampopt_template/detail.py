"""What a smooth displacement leaves over: a displacement along the template's normals, smooth over a shorter length.

Minimised over d, one value a vertex: Σ_v a_v (g_v − d_v)² + ℓ⁴ ∫ (Δd)², with g_v the gap to the target along the
normal. The matrix depends on the template alone and is factored once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lampopt.types import Array
from lampopt_template.surface import Surface

STEPS = 4
AGREE = 0.5  # cosine of the normals from which a gap counts


@dataclass(frozen=True, eq=False)
class Detail:
    """The displacement of a template's vertices along its normals that is smooth over `length`."""

    surface: Surface
    length: float

    @cached_property
    def _solve(self) -> Any:
        import igl
        from scipy.sparse import csc_array, diags_array
        from scipy.sparse.linalg import splu

        areas = self.surface.vertex_areas
        laplacian = csc_array(igl.cotmatrix(self.surface.vertices, self.surface.faces))
        inverse = diags_array(1 / np.maximum(areas, 1e-12 * areas.sum()))
        rough = self.length**4 * (laplacian.T @ inverse @ laplacian)
        return splu(csc_array(diags_array(areas) + rough)), rough

    def onto(self, target: Surface, moved: Array) -> Array:
        """(V,) displacements that bring `moved` (V, 3) vertices onto `target`."""
        factor, rough = self._solve
        along = np.zeros(len(moved))
        for _ in range(STEPS):
            now = Surface(moved + self.surface.vertex_normals * along[:, None], self.surface.faces)
            near = target.near(now.vertices, curved=True)
            slope = (near.normals * self.surface.vertex_normals).sum(1)
            gap = (near.normals * (near.points - now.vertices)).sum(1) / np.where(np.abs(slope) > AGREE, slope, 1.0)
            seen = ((near.normals * now.vertex_normals).sum(1) > AGREE) & (slope > AGREE)
            along = along + factor.solve(self.surface.vertex_areas * seen * gap - rough @ along)
        return np.asarray(along)
