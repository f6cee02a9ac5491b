"""A decoder at work on three small meshes: prepared and fitted once, looked at by many checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lampopt.protocols import Corresponding, Decoder
from lampopt.testing import shapes
from lampopt.testing.engine import changed_states, random_state, read_only
from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

RESOLUTION = 40
SEED = 3
BOX, LONGER, ROUND = 0, 1, 2  # the meshes


@dataclass(frozen=True, eq=False)
class Bench:
    """A decoder at work: three meshes prepared and fitted once, read-only, with what was noticed on the way."""

    decoder: Decoder
    half: float
    meshes: tuple[Trimesh, ...]
    prepared: Any  # as it came, and as it should be
    shared: Mapping[str, Array]
    weights: Array
    error: Array
    points: Array
    touched: tuple[str, ...]
    moved: tuple[str, ...]
    reports: tuple[float, ...]

    def evaluate(self, weights: Array, points: Array | None = None) -> Array:
        """The decoder's values at `points`, by default the bench's probes."""
        given = np.array(self.points if points is None else points)
        return np.asarray(self.decoder.evaluate(writable(self.shared), np.array(weights), given))

    def decode(self, weights: Array) -> Trimesh:
        """The decoder's mesh of `weights`."""
        return self.decoder.decode(writable(self.shared), np.array(weights), resolution=RESOLUTION)


def writable(shared: Mapping[str, Array]) -> dict[str, Array]:
    """Copies that a decoder may spoil without spoiling the bench."""
    return {name: np.array(array) for name, array in shared.items()}


def meshes_for(decoder: Decoder) -> tuple[float, tuple[Trimesh, ...]]:
    """Half the box's shortest side, and a box, a box 1.2 times longer, an ellipsoid, at 0.6 of it and less.

    Each has triangles of its own, but for decoders that need the same ones.
    """
    from trimesh import Trimesh

    low, high = np.asarray(decoder.bounds, float)
    centre, half = (low + high) / 2, float((high - low).min()) / 2
    size = half * np.array([1.0, 0.7, 0.6])
    if isinstance(decoder, Corresponding):
        one = shapes.box(size, centre=centre, divisions=3)
        ways = np.asarray(one.vertices) - centre
        round_ = ways / np.linalg.norm(ways / (0.55 * size), axis=1, keepdims=True)
        at = (ways, ways * [1.2, 1, 1], round_)
        return half, tuple(Trimesh(centre + vertices, one.faces, process=False) for vertices in at)
    return half, (
        shapes.box(size, centre=centre),
        shapes.box(size * [1.2, 1, 1], centre=centre, divisions=3),
        shapes.ellipsoid(0.55 * size, centre=centre, divisions=3),
    )


_LATEST: list[Bench] = []  # fitting is dear and the checks of one decoder run in a row


def bench(decoder: Decoder) -> Bench:
    """The decoder's bench, made once for as long as the same object is asked for."""
    if not _LATEST or _LATEST[0].decoder is not decoder:
        _LATEST[:] = [_make(decoder)]
    return _LATEST[0]


def _make(decoder: Decoder) -> Bench:
    half, meshes = meshes_for(decoder)
    before = random_state()
    own = [m.copy() for m in (*meshes, meshes[BOX])]  # the last as the mean
    prepared = decoder.prepare(own[:-1], mean=own[-1], seed=SEED)
    shared = {name: read_only(array) for name, array in prepared.items()}
    given, copies, reports = writable(shared), [m.copy() for m in meshes], list[float]()
    weights, error = decoder.fit(given, copies, seed=SEED, progress=lambda done, message="", /: reports.append(done))
    points = decoder.probes(writable(shared), 500, SEED)
    first = np.array(weights)[BOX]
    decoder.evaluate(writable(shared), first, np.array(points))
    decoder.decode(writable(shared), np.array(first), resolution=RESOLUTION)
    moved = changed_states(before, random_state())
    touched = [f"shared[{n!r}]" for n in shared if n not in given or not np.array_equal(given[n], shared[n])]
    touched += [f"shared[{n!r}] (new)" for n in given if n not in shared]
    touched += [f"mesh {i}" for i, m in enumerate(copies) if not same_mesh(m, meshes[i])]
    theirs = zip(own, (*meshes, meshes[BOX]), strict=True)
    touched += [f"mesh {i} (in prepare)" for i, (m, given) in enumerate(theirs) if not same_mesh(m, given)]
    weights, error, points = map(read_only, (weights, error, points))
    return Bench(
        decoder, half, meshes, prepared, shared, weights, error, points, tuple(touched), tuple(moved), tuple(reports)
    )


def same_mesh(a: Trimesh, b: Trimesh) -> bool:
    """Whether vertices and faces are equal to the bit."""
    return np.array_equal(a.vertices, b.vertices) and np.array_equal(a.faces, b.faces)


def fit_again(b: Bench, which: list[int]) -> Array:
    """Weights of some of the bench's meshes, fitted once more as one batch."""
    meshes = [b.meshes[i].copy() for i in which]
    return np.asarray(b.decoder.fit(writable(b.shared), meshes, seed=SEED)[0])


def mean_distance(mesh: Trimesh, to: Trimesh) -> float:
    """Mean distance of points on `mesh` to the surface of `to`."""
    import igl

    points = np.concatenate([np.asarray(mesh.vertices), np.asarray(mesh.triangles_center)])
    squared = igl.point_mesh_squared_distance(points, np.asarray(to.vertices, float), np.asarray(to.faces, np.int64))[0]
    return float(np.sqrt(squared).mean())
