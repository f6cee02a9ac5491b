"""Where the shape changed, and the pressure on it: two views of the design."""

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from scipy.spatial import cKDTree
from trimesh.proximity import closest_point

TURN, TILT = np.radians(-58), np.radians(25)


def pictures(before, after, compared, path):
    """Draw the design twice: moved outward or inward [mm], and its pressure coefficient."""
    middles = after.triangles_center
    nearest, _, _ = closest_point(before, middles)
    moved = ((middles - nearest) * after.face_normals).sum(1)
    flow = compared.design
    low, high = after.bounds
    at = (middles - [low[0], (low[1] + high[1]) / 2, low[2]]) / flow.length
    if flow.half:
        at[:, 1] = -np.abs(at[:, 1]) if flow.points[:, 1].min() < -1e-6 else np.abs(at[:, 1])
    pressure = flow.pressure[cKDTree(flow.points).query(at)[1]]
    figure = Figure(figsize=(13, 4.2), dpi=150, facecolor="white")
    left, right = figure.subplots(1, 2)
    most = float(np.quantile(np.abs(moved), 0.995)) or 1.0
    for axis, values, limits, colours, name in (
        (left, moved, (-most, most), "RdBu_r", "moved outward [mm]"),
        (right, pressure, (-1.0, 1.0), "coolwarm", "pressure coefficient"),
    ):
        shown = _drawn(axis, after, values, limits, colours)
        figure.colorbar(shown, ax=axis, shrink=0.7, label=name)
    change = compared.drag
    figure.suptitle(f"drag {100 * change.value:+.1f} ± {100 * change.error:.1f} %, solved anew", fontsize=11)
    figure.savefig(path, bbox_inches="tight")


def _drawn(axis, mesh, values, limits, colours):
    eye = np.array([np.cos(TILT) * np.cos(TURN), np.cos(TILT) * np.sin(TURN), np.sin(TILT)])
    across = np.array([-np.sin(TURN), np.cos(TURN), 0])
    screen = np.stack([across, np.cross(eye, across)], 1)
    front = np.flatnonzero(mesh.face_normals @ eye > 0)
    front = front[np.argsort(mesh.triangles_center[front] @ eye)]  # far ones first
    shape = PolyCollection((mesh.vertices @ screen)[mesh.faces[front]], array=values[front], cmap=colours, clim=limits)
    shape.set(edgecolors="face", linewidths=0.1)
    axis.add_collection(shape)
    axis.autoscale_view()
    axis.set_aspect("equal")
    axis.set_axis_off()
    return shape
