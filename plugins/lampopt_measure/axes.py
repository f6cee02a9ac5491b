"""A mesh seen as a vehicle: along it to the rear, across it to the right, and up."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError, MeasureError

from .facets import Shape, direction

if TYPE_CHECKING:
    from trimesh import Trimesh

ALIKE = 0.9  # horizontal sides nearer than this to each other do not tell which way a body points


def check_axes(forward: str = "", up: str = "z") -> None:
    """Raise InputError where the two options are no axes, or one axis."""
    for option, axis in (("forward", forward), ("up", up)):
        if not isinstance(axis, str) or (
            axis.removeprefix("-") not in ("x", "y", "z") and not (option == "forward" and not axis)
        ):
            raise InputError(f"{option}: expected one of x, -x, y, -y, z, -z, got {axis!r:.80}")
    if forward and forward.removeprefix("-") == up.removeprefix("-"):
        raise InputError(f"forward: expected an axis across up = {up!r}, got {forward!r}")


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
        If there are no faces, or the horizontal sides are too alike to tell.
    InputError
        If an axis is none, or both are one.
    """
    check_axes(forward, up)
    plain = Shape.of(mesh)
    top = direction(up)
    if forward:
        rear = -direction(forward)
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
