"""Frontal area: what a vehicle covers of the view along its axis, exactly, from the outline that its edges draw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import MeasureError
from lampopt.types import Array

from .axes import check_axes, check_whole, oriented
from .example import simple_car
from .facets import Shape

if TYPE_CHECKING:
    from trimesh import Trimesh

SCALE = 1000.0  # size of what is handed to the polygon library, whose precision is absolute
MATCH = 1e-6  # of the size: how far the outline may be off the edge that draws it
UNDRAWN = 1e-4  # share of the outline that may come of no edge
CROSSINGS, LOOKED = 5e6, 100  # of edges in the view, what takes seconds; edges that it is told from
PAIRS = 10_000_000  # of parts of outline and edges near each other: what can be looked at in seconds


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
        """The area (1,). Raises EmptyMesh, and MeasureError, also for half a body or a surface that is crumpled."""
        shape = self._whole(mesh)
        polygons, size = _silhouette(shape)
        return np.array([sum(_area(polygon) for polygon in polygons) * size**2])

    def gradient(self, mesh: Trimesh) -> Array:
        """Derivative by the vertices (1, V, 3). Raises as a call does."""
        shape = self._whole(mesh)
        polygons, size = _silhouette(shape)
        start = np.concatenate(polygons) * size
        end = np.concatenate([np.roll(polygon, -1, axis=0) for polygon in polygons]) * size
        return _by_edges(shape, start, end)[None]

    def _whole(self, mesh: Trimesh) -> Shape:
        shape = oriented(mesh, self.forward, self.up)
        check_whole(shape)
        return shape

    def example_mesh(self) -> Trimesh:
        """A simple car."""
        return simple_car()


def _silhouette(shape: Shape) -> tuple[list[Array], float]:
    """The outline's polygons, holes clockwise, in units of the size given beside them."""
    from manifold3d import CrossSection, FillRule

    faces, flat = _seen(shape)
    if not len(faces):
        raise MeasureError("frontal-area: expected faces that can be seen from the front, got none")
    used = flat[np.unique(shape.faces)]
    size, middle = float(np.ptp(used, axis=0).max()) / SCALE, used.mean(axis=0)
    edges = _directed(faces, len(flat))
    _check_crossings(flat[edges[:, 0]], flat[edges[:, 1]])
    # About a point, the loops that the edges draw wind as often as faces cover it: their union is that of all faces.
    loops = [(flat[loop] - middle) / size for loop in _loops(edges)]
    polygons = [polygon for polygon in CrossSection(loops, FillRule.Positive).to_polygons() if len(polygon) > 2]
    if not polygons:
        raise MeasureError(f"frontal-area: expected an outline seen from the front, got a line {size * SCALE:.6g} long")
    return [np.asarray(polygon, float) + middle / size for polygon in polygons], size


def _seen(shape: Shape) -> tuple[Array, Array]:
    """The faces, all turned counter-clockwise as seen from the front, and the vertices in that view (V, 2)."""
    flat = shape.vertices[:, 1:]
    a, b, c = (flat[shape.faces[:, k]] for k in range(3))
    turn = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    return np.where((turn < 0)[:, None], shape.faces[:, ::-1], shape.faces)[turn != 0], flat


def _area(polygon: Array) -> float:
    x, y = (polygon - polygon.mean(axis=0)).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _check_crossings(start: Array, end: Array) -> None:
    """Raise MeasureError where edges cross more often than the polygon library gets done with, by those of a few."""
    way, count = end - start, 0
    low, high = np.minimum(start, end), np.maximum(start, end)
    looked = np.unique(np.linspace(0, len(start) - 1, LOOKED).astype(int))
    for k in looked:
        near = ((low <= high[k]) & (high >= low[k])).all(axis=1)
        here, run = start[near], way[near]
        apart = _turn(run, start[k] - here) * _turn(run, end[k] - here) < 0
        count += int((apart & (_turn(way[k], here - start[k]) * _turn(way[k], here + run - start[k]) < 0)).sum())
    crossings = count * len(start) / len(looked) / 2
    if crossings > CROSSINGS:
        raise MeasureError(
            f"frontal-area: expected folds and borders that cross at most about {CROSSINGS:.0e} times in the view from "
            f"the front, got about {crossings:.1e}: the surface is crumpled or frayed; wrap or repair the mesh first"
        )


def _turn(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


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
    off_by = MATCH * float(np.ptp(flat[np.unique(shape.faces)], axis=0).max())
    piece, edge = _beside(start, way, first, run, off_by)
    # where along the edge the outline's piece begins and ends, and how far it is off
    ends = [start[piece] - first[edge], start[piece] + way[piece] - first[edge]]
    along = [(away * run[edge]).sum(-1) / length[edge] ** 2 for away in ends]
    off = [np.abs(away[:, 0] * run[edge, 1] - away[:, 1] * run[edge, 0]) / length[edge] for away in ends]
    low, high = np.clip(np.minimum(*along), 0, 1), np.clip(np.maximum(*along), 0, 1)
    shared = np.where(np.maximum(*off) <= off_by, (high - low) * length[edge], 0)
    cover = np.bincount(piece, shared, len(start))
    drawn = cover > MATCH * long
    undrawn = float(long[~drawn].sum())
    kept = drawn[piece] & (shared > 0)
    piece, edge, shared, at = piece[kept], edge[kept], shared[kept], (low + high)[kept] / 2
    weight = shared * long[piece] / cover[piece]
    for side, share in ((0, 1 - at), (1, at)):
        np.add.at(slopes, edges[edge, side], (weight * share)[:, None] * outward[piece])
    if undrawn > UNDRAWN * float(long.sum()):
        raise MeasureError(
            f"frontal-area: expected an outline drawn by the mesh's edges, got {undrawn / long.sum():.2%} of it that "
            "no edge draws; it has no derivative here"
        )
    return np.asarray(slopes @ shape.turn[1:])


def _beside(start: Array, way: Array, first: Array, run: Array, within: float) -> tuple[Array, Array]:
    """Pairs of an outline's piece and an edge that may touch: some parts of them, cut alike, are near each other."""
    from scipy.spatial import cKDTree

    step = float(np.linalg.norm(np.concatenate([way, run]), axis=1).mean())
    pieces, of_piece = _parts(start, way, step)
    drawing, of_edge = _parts(first, run, step)
    one, other = cKDTree(pieces), cKDTree(drawing)
    reach = step + 2 * within  # of the middles of two parts no longer than a step that touch
    if one.count_neighbors(other, reach) > PAIRS:
        raise MeasureError(
            "frontal-area: expected an outline of pieces that lie apart, got one frayed all over, too long for a "
            "derivative; wrap or repair the mesh first"
        )
    near = one.sparse_distance_matrix(other, reach, output_type="coo_matrix")
    pairs = np.sort(of_piece[near.row] * np.int64(len(first)) + of_edge[near.col])
    pairs = pairs[np.diff(pairs, prepend=-1) > 0]
    return pairs // len(first), pairs % len(first)


def _parts(start: Array, way: Array, step: float) -> tuple[Array, Array]:
    """The middles (M, 2) of the parts, no longer than `step`, of segments, and the segment of each (M,)."""
    count = np.maximum(1, np.ceil(np.linalg.norm(way, axis=1) / step)).astype(np.int64)
    of = np.repeat(np.arange(len(start)), count)
    number = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return start[of] + ((number + 0.5) / count[of])[:, None] * way[of], of


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
