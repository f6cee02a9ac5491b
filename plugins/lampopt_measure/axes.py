"""A mesh seen as a vehicle: along it to the rear, across it to the right, and up."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError, MeasureError
from lampopt.types import Array

from .facets import Facets, Shape, direction, section

if TYPE_CHECKING:
    from trimesh import Trimesh

ALIKE = 0.9  # horizontal sides nearer than this to each other do not tell which way a body points
BESIDE = 0.005  # of the width: how far inside either side a body is cut to tell a half from a whole
ALONG, UPRIGHT = 0.97, 0.8  # of length and height: a side that is so long and so high is one or a plane of symmetry
UNLIKE = 0.9  # of one side's height: another that is lower, or not as long, is none like it


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


def check_whole(shape: Shape) -> None:
    """Raise MeasureError where one side is a plane from nose to tail and up to the roof, and the other side is not.

    Only of what is longest from nose to tail, as vehicles are: a wing seen from above ends at its root as it likes.
    """
    used = shape.vertices[np.unique(shape.faces)]
    low, size = used.min(axis=0), np.ptp(used, axis=0)
    if not (size > 0).all() or size[0] < size.max():
        return
    left, right = (_share(section(shape, "y", float(low[1] + at * size[1])), size) for at in (BESIDE, 1 - BESIDE))
    for side, one, other in (("left", left, right), ("right", right, left)):
        if one[0] >= ALONG and one[1] >= UPRIGHT and (other[0] < ALONG or other[1] < UNLIKE * one[1]):
            raise MeasureError(
                f"expected a whole body, got one whose {side} side is cut off along a plane, as half a vehicle's; "
                "mirror it first, or say which way it points by forward="
            )


def _share(cut: Facets, size: Array) -> tuple[float, float]:
    """How much of a body's length and height a section spans."""
    if not len(cut):
        return 0.0, 0.0
    return float(np.ptp(cut.corners[..., 0]) / size[0]), float(np.ptp(cut.corners[..., 2]) / size[2])
