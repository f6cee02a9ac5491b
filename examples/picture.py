"""Shaded pictures of meshes side by side, to one scale."""

from pathlib import Path

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from PIL import Image
from trimesh import Trimesh

COLOURS = ("#8fa3b5", "#e08a3c")
FINE = 4  # drawn that much larger and averaged: smooth outlines, no seams between triangles
LIGHT = np.array([-0.35, -0.35, 0.87])


def picture(shown: dict[str, Trimesh], path: Path, *, turn: float = -58, tilt: float = 40) -> None:
    """Draw each mesh above its caption, seen from `tilt` degrees above the horizon and `turn` degrees around."""
    a, b = np.radians(turn), np.radians(tilt)
    eye = np.array([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)])
    right = np.array([-np.sin(a), np.cos(a), 0])
    screen = np.stack([right, np.cross(eye, right)], 1)  # (3, 2)
    flat = {caption: mesh.subdivide_to_size(mesh.scale / 60) for caption, mesh in shown.items()}
    outlines = [mesh.vertices @ screen for mesh in flat.values()]
    widths = [np.ptp(points[:, 0]) for points in outlines]
    low, high = min(p[:, 1].min() for p in outlines), max(p[:, 1].max() for p in outlines)
    figure = Figure(figsize=(10, 11 * (high - low) / sum(widths)), dpi=FINE * 160, facecolor="white")
    axes = figure.subplots(1, len(flat), width_ratios=widths, squeeze=False)[0]
    for axis, (caption, mesh), points, colour in zip(axes, flat.items(), outlines, COLOURS * len(flat), strict=False):
        front = np.flatnonzero(mesh.face_normals @ eye > 0)
        front = front[np.argsort(mesh.triangles_center[front] @ eye)]  # far ones first
        shade = 0.45 + 0.55 * np.clip(mesh.face_normals[front] @ LIGHT, 0, 1)
        fill = np.clip(shade[:, None] * [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)] * 1.08, 0, 1)
        shape = points[mesh.faces[front]]
        axis.add_collection(PolyCollection(shape, facecolors=fill, edgecolors="none", antialiaseds=False))
        middle = (points[:, 0].min() + points[:, 0].max()) / 2
        axis.set(xlim=middle + 0.52 * np.ptp(points[:, 0]) * np.array([-1, 1]), ylim=(low, high), aspect="equal")
        axis.set_title(caption, y=-0.14, fontsize=11, color="#333333")
        axis.set_axis_off()
    figure.savefig(path, bbox_inches="tight", pad_inches=0.15)
    with Image.open(path) as large:
        large.convert("RGB").reduce(FINE).save(path, optimize=True)
