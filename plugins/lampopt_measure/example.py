"""A car of flat panels and round wheels, in closed form: what the measures of a vehicle are tried on."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from trimesh import Trimesh

SIDE = (  # x, z of the outline from the side [m]
    (0.0, 0.30), (0.0, 0.62), (0.1, 0.75), (1.1, 0.88), (1.9, 1.40), (3.0, 1.40), (3.7, 1.00), (4.2, 0.96),
    (4.3, 0.62), (4.3, 0.32), (3.6, 0.15), (0.7, 0.15),
)  # fmt: skip
FRONT = ((-0.85, 0.10), (0.85, 0.10), (0.85, 0.85), (0.60, 1.45), (-0.60, 1.45), (-0.85, 0.85))  # y, z
WHEELS = ((0.85, 0.74, 0.31), (3.45, 0.73, 0.32))  # x, ± y and radius
TYRE, EDGE = 0.2, 0.08  # width of the tyres, longest edge of a face


def simple_car() -> Trimesh:
    """The car, closed, about 9,000 faces, its nose at x = 0 and the ground at z = 0 [m]."""
    vertices, faces = _simple_car()
    from trimesh import Trimesh

    return Trimesh(vertices.copy(), faces.copy(), process=False)


@cache
def _simple_car() -> tuple[np.ndarray, np.ndarray]:
    from manifold3d import CrossSection, Manifold

    side = CrossSection([SIDE[::-1]]).extrude(2).rotate((90, 0, 0)).translate((0, 1, 0))
    front = CrossSection([FRONT]).extrude(5).rotate((90, 0, 90))
    body = side ^ front
    for x, y, radius in WHEELS:
        wheel = Manifold.cylinder(TYRE, radius, circular_segments=128, center=True).rotate((90, 0, 0))
        for right in (-1, 1):
            body += wheel.translate((x, right * y, radius))
    mesh = body.refine_to_length(EDGE).to_mesh64()
    return np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts, np.int64)
