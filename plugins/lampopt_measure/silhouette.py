"""Frontal area: what a vehicle covers of the view along its axis, exactly, from the outline that its edges draw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import MeasureError
from lampopt.types import Array

from .axes import check_axes, oriented
from .example import simple_car
from .facets import Shape

if TYPE_CHECKING:
    from trimesh import Trimesh

SCALE = 1000.0  # size of what is handed to the polygon library, whose precision is absolute
MATCH = 1e-6  # of the size: how far the outline may be off the edge that draws it
UNDRAWN = 1e-4  # share of the outline that may come of no edge
CHUNK = 2_000_000  # pairs of outline and edge that are looked at in one go


@dataclass(frozen=True)
class FrontalArea:
    """Area of the silhouette seen along the vehicle's axis; holes that one can look through are taken off.

    It is the union of all faces as seen from the front, so open and loose meshes have one too. Its outline consists of
    pieces of the mesh's edges, and these carry the derivative. Walls along the axis are seen edge-on: there the
    derivative is the mean over the edges that lie behind one another.

    Parameters
    ----------
    forward, up
        Where nose and roof point, as for `vehicle`.
    """

    forward: str = ""
    up: str = "z"

    names = ("frontal_area",)
    units = ("L^2",)

    def __post_init__(self) -> None:
        check_axes(self.forward, self.up)

    def __call__(self, mesh: Trimesh) -> Array:
        """The area (1,). Raises EmptyMesh, MeasureError."""
        shape = oriented(mesh, self.forward, self.up)
        polygons, size = _silhouette(shape)
        return np.array([sum(_area(polygon) for polygon in polygons) * size**2])

    def gradient(self, mesh: Trimesh) -> Array:
        """Derivative by the vertices (1, V, 3). Raises EmptyMesh, MeasureError."""
        shape = oriented(mesh, self.forward, self.up)
        polygons, size = _silhouette(shape)
        start = np.concatenate(polygons) * size
        end = np.concatenate([np.roll(polygon, -1, axis=0) for polygon in polygons]) * size
        return _by_edges(shape, start, end)[None]

    def example_mesh(self) -> Trimesh:
        """A simple car."""
        return simple_car()


def _silhouette(shape: Shape) -> tuple[list[Array], float]:
    """The outline's polygons, holes clockwise, in units of the size given beside them."""
    from manifold3d import CrossSection, FillRule

    faces, flat = _seen(shape)
    if not len(faces):
        raise MeasureError("frontal-area: expected faces that can be seen from the front, got none")
    size = float(np.ptp(flat, axis=0).max()) / SCALE
    middle = flat.mean(axis=0)
    # About a point, the loops that the edges draw wind as often as faces cover it: their union is that of all faces.
    loops = [(flat[loop] - middle) / size for loop in _loops(_directed(faces, len(flat)))]
    polygons = CrossSection(loops, FillRule.Positive).to_polygons()
    return [np.asarray(polygon, float) + middle / size for polygon in polygons if len(polygon) > 2], size


def _seen(shape: Shape) -> tuple[Array, Array]:
    """The faces, all turned counter-clockwise as seen from the front, and the vertices in that view (V, 2)."""
    flat = shape.vertices[:, 1:]
    a, b, c = (flat[shape.faces[:, k]] for k in range(3))
    turn = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    return np.where((turn < 0)[:, None], shape.faces[:, ::-1], shape.faces)[turn != 0], flat


def _area(polygon: Array) -> float:
    x, y = (polygon - polygon.mean(axis=0)).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _by_edges(shape: Shape, start: Array, end: Array) -> Array:
    """(V, 3) what the area gains as the edges that draw the outline move outward."""
    faces, flat = _seen(shape)
    edges = _drawing(faces, len(flat))
    first, run = flat[edges[:, 0]], flat[edges[:, 1]] - flat[edges[:, 0]]
    length = np.linalg.norm(run, axis=1)
    first, run, edges, length = (part[length > 0] for part in (first, run, edges, length))
    slopes = np.zeros((len(flat), 2))
    way = end - start
    long = np.linalg.norm(way, axis=1)
    start, way, long = start[long > 0], way[long > 0], long[long > 0]
    outward = np.stack([way[:, 1], -way[:, 0]], axis=1) / long[:, None]
    off_by = MATCH * float(np.ptp(flat, axis=0).max())
    undrawn = 0.0
    step = max(1, CHUNK // len(edges))
    for k in range(0, len(start), step):
        here = slice(k, k + step)
        # where along each edge the outline's piece begins and ends, and how far it is off
        ends = [start[here, None] - first[None], start[here, None] + way[here, None] - first[None]]
        along = [(away * run).sum(-1) / length**2 for away in ends]
        off = [np.abs(away[..., 0] * run[:, 1] - away[..., 1] * run[:, 0]) / length for away in ends]
        low = np.clip(np.minimum(*along), 0, 1)
        high = np.clip(np.maximum(*along), 0, 1)
        shared = np.where(np.maximum(*off) <= off_by, (high - low) * length, 0)
        cover = shared.sum(axis=1)
        drawn = cover > MATCH * long[here]
        undrawn += float(long[here][~drawn].sum())
        piece, edge = np.nonzero(shared * drawn[:, None])
        weight = shared[piece, edge] * long[here][piece] / cover[piece]
        at = (low + high)[piece, edge] / 2
        for side, share in ((0, 1 - at), (1, at)):
            np.add.at(slopes, edges[edge, side], (weight * share)[:, None] * outward[here][piece])
    if undrawn > UNDRAWN * float(long.sum()):
        raise MeasureError(
            f"frontal-area: expected an outline drawn by the mesh's edges, got {undrawn / long.sum():.2%} of it that "
            "no edge draws; it has no derivative here"
        )
    return np.asarray(slopes @ shape.turn[1:])


def _drawing(faces: Array, vertices: int) -> Array:
    """(E, 2) the edges at which the faces that are seen fold over or end."""
    return np.unique(np.sort(_directed(faces, vertices), axis=1), axis=0)


def _directed(faces: Array, vertices: int) -> Array:
    """(E, 2) the edges at which the faces that are seen fold over or end, as these run, none that cancels another."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    low, high = ends.min(axis=1), ends.max(axis=1)
    keys, place = np.unique(low * vertices + high, return_inverse=True)
    net = np.bincount(place, np.where(ends[:, 0] == low, 1, -1)).astype(int)
    edges = np.stack([keys // vertices, keys % vertices], axis=1)
    edges = np.where((net < 0)[:, None], edges[:, ::-1], edges)
    return np.repeat(edges, np.abs(net), axis=0)


def _loops(edges: Array) -> list[Array]:
    """Closed loops of vertices through directed edges (E, 2), of which as many end in a vertex as begin there."""
    leaving, arriving = np.argsort(edges[:, 0], kind="stable"), np.argsort(edges[:, 1], kind="stable")
    following = np.empty(len(edges), np.int64)
    following[arriving] = leaving
    after, left, loops = following.tolist(), set(range(len(edges))), []
    while left:
        edge = first = left.pop()
        loop = [first]
        while (edge := after[edge]) != first:
            left.remove(edge)
            loop.append(edge)
        loops.append(edges[loop, 0])
    return loops
