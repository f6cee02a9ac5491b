"""A mesh seen as a vehicle: along it to the rear, across it to the right, and up."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import MeasureError

from .facets import Shape, direction

if TYPE_CHECKING:
    from trimesh import Trimesh

ALIKE = 0.9  # horizontal sides nearer than this to each other do not tell which way a body points


def oriented(mesh: Trimesh, forward: str = "", up: str = "z") -> Shape:
    """`mesh` with x to the rear, y to the right and z up.

    Parameters
    ----------
    forward, up
        Where its nose and its roof point: "x", "-x", "y", ... Without `forward` it lies along its longer horizontal
        side, its nose at the low end (as in the source `morph`).

    Raises
    ------
    EmptyMesh, MeasureError
        If there are no faces, the horizontal sides are too alike to tell, or both ways are one.
    InputError
        If an axis is none.
    """
    plain = Shape.of(mesh)
    top = direction(up)
    if forward:
        rear = -direction(forward)
        if rear @ top:
            raise MeasureError(f"forward: expected an axis across up = {up!r}, got {forward!r}")
    else:
        size = np.ptp(plain.vertices[np.unique(plain.faces)], axis=0)
        short, long = sorted((k for k in range(3) if not top[k]), key=lambda k: float(size[k]))
        if size[short] > ALIKE * size[long]:
            raise MeasureError(
                f"forward: cannot tell which way the body points: it measures {size[short]:.6g} along "
                f"{'xyz'[short]} and {size[long]:.6g} along {'xyz'[long]}; say it, as in forward='-{'xyz'[long]}'"
            )
        rear = np.eye(3)[long]
    return Shape.of(mesh, np.stack([rear, np.cross(top, rear), top]))
