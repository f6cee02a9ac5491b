"""Boxes, and a decoder that gets every box right: banks in milliseconds, answers known in closed form.

CALLS counts what the decoder did; INTERRUPT makes it press Ctrl-C in the so-manieth batch; the environment variable
SMALL_SLOW makes every fit and decode take that many seconds.
"""

import os
import sqlite3
import time
from collections import Counter
from contextlib import closing
from dataclasses import dataclass
from importlib.metadata import entry_points

import numpy as np
import toys

import lampopt
from lampopt.errors import EmptyMesh, FitError
from lampopt.plugins import Plugins
from lampopt.testing import shapes
from lampopt.types import Exemplars, Parameter

CALLS = Counter()
INTERRUPT = [0]
LENGTHS = np.array([2.0, 2.2, 2.4, 2.6, 2.8, 3.0, 2.5])
WIDTHS = np.array([1.0, 1.4, 1.1, 1.3, 1.2, 1.0, 1.4])
COLUMNS = "key, target, alpha, residual, status, message, conflicts, checks, accepted, provenance, mesh, digest"
DRAG = np.array([0.30, 0.34, np.nan, 0.38, np.nan, 0.36, 0.33])


@dataclass(frozen=True)
class Stretch:
    """Decoder: weights are a box's three extents and its middle; exactly affine, so every mix is a true box."""

    @property
    def bounds(self):
        return np.array([[-1.0] * 3, [1.0] * 3])

    def prepare(self, meshes, *, mean, seed):
        CALLS["prepare"] += 1
        return {"mean": mean.extents, "template": np.asarray(shapes.box([1, 1, 1]).vertices)}

    def fit(self, shared, meshes, *, seed, progress=None):
        _slow()
        CALLS["batches"] += 1
        if CALLS["batches"] == INTERRUPT[0]:
            raise KeyboardInterrupt
        CALLS["fit"] += len(meshes)
        for mesh in meshes:
            if not mesh.is_watertight:
                raise FitError("expected a closed mesh, got an open one")
        return np.stack([np.append(m.extents, m.bounds.mean(0)) for m in meshes]).astype("f4"), np.zeros(len(meshes))

    def evaluate(self, shared, weights, points):
        CALLS["evaluate"] += 1
        return points * weights[..., None, :3] + weights[..., None, 3:]

    def decode(self, shared, weights, *, resolution):
        _slow()
        CALLS["decode"] += 1
        if (weights[:3] <= 0).any():
            raise EmptyMesh("a box of no size")
        return shapes.box(weights[:3].astype(float), centre=weights[3:].astype(float))

    def probes(self, shared, count, seed):
        return np.random.default_rng(seed).choice(shared["template"], count)


@dataclass(frozen=True)
class Linear(Stretch):
    """The same as a signed field (C = 1), the largest coordinate beyond the box: not linear in its weights."""

    def evaluate(self, shared, weights, points):
        beyond = np.abs(points - weights[..., None, 3:]) - weights[..., None, :3] / 2
        return beyond.max(-1, keepdims=True)


class Plugin:
    """Offers all of it."""

    @lampopt.hookimpl
    def lampopt_decoders(self):
        return {"stretch": Stretch, "stretch-field": Linear}

    @lampopt.hookimpl
    def lampopt_measures(self):
        return {"size": toys.Size}


def plugins(*extra):
    """Ours and this one; nothing else that happens to be installed."""
    mine = ("kkt", "measure")
    block = [p.name for p in entry_points(group="lampopt") if p.name not in mine]
    return Plugins.load([("small", Plugin()), *extra], block=block)


def boxes(*, unit="m", scale=1.0, shift=(0, 0, 0), count=7, mesh_at=False, meshes=None, **kinds):
    """Exemplars: boxes of given length and width and of height 0.8, in `unit`, each `scale` as large."""
    parameters = scale * np.column_stack([LENGTHS, WIDTHS])[:count]

    def at(row):
        return shapes.box([*row, 0.8 * scale], centre=np.asarray(shift, float))

    space = (Parameter("length", unit), Parameter("width", unit))
    names = tuple(f"box_{i}" for i in range(count))
    kinds = {"labels": DRAG[:count, None], "label_space": (Parameter("drag"),), **kinds}
    meshes = [at(row) for row in parameters] if meshes is None else meshes
    return Exemplars(parameters, space, meshes, names, unit=unit, mesh_at=at if mesh_at else None, **kinds)


def bank(exemplars=None, decoder="stretch", **options):
    options = {"probes": 16, "batch": 2, "plugins": plugins(), **options}
    return lampopt.build_bank(exemplars or boxes(), decoder, **options)


def same(one, other):
    """Whether two banks agree in everything but the file they are in."""
    arrays = ("parameters", "labels", "weights", "probes", "probe_values", "fit_error", "measured")
    plain = ("space", "label_space", "names", "decoder", "measured_by", "mesh_facts", "limits", "provenance")
    return (
        all(getattr(one, name) == getattr(other, name) for name in plain)
        and all(_equal(np.asarray(getattr(one, name)), np.asarray(getattr(other, name))) for name in arrays)
        and one.shared.keys() == other.shared.keys()
        and all(_equal(one.shared[name], other.shared[name]) for name in one.shared)
        and (one.frame.scale, one.frame.unit) == (other.frame.scale, other.frame.unit)
        and _equal(one.frame.centre, other.frame.centre)
        and _same_evidence(one.calibration, other.calibration)
    )


def _same_evidence(one, other):
    if one is None or other is None:
        return one is other
    arrays = ("values", "errors", "exemplars")
    plain = ("tolerance", "checks")
    return all(getattr(one, name) == getattr(other, name) for name in plain) and all(
        _equal(getattr(one, name), getattr(other, name)) for name in arrays
    )


def _equal(one, other):
    return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()


def _slow():
    time.sleep(float(os.environ.get("SMALL_SLOW", 0)))


def rows(folder):
    """What a run folder's database holds but for times."""
    with closing(sqlite3.connect(folder / "runs.sqlite")) as database:
        return sorted(database.execute(f"SELECT {COLUMNS} FROM designs").fetchall())


def files(folder):
    """What its designs' folders hold."""
    return {p.relative_to(folder): p.read_bytes() for p in (folder / "designs").rglob("*") if p.is_file()}


def told(result):
    """A result as plain values."""
    mesh = result.design.mesh
    return (
        dict(result.design.target),
        result.design.mix.alpha.tobytes(),
        result.design.weights.tobytes(),
        [(c.name, repr(c.value), c.sense, c.limit, c.unit, c.needs, c.note) for c in result.checks],
        dict(result.provenance),
        None if mesh is None else (mesh.vertices.tobytes(), mesh.faces.tobytes(), mesh.units),
    )
