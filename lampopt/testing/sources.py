"""What a source has to do."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from lampopt.protocols import Source
from lampopt.testing.bench import mean_distance, same_mesh
from lampopt.testing.engine import COMMON, CheckFunction, NotApplicable, expect, require
from lampopt.types import Exemplars

FEW = 4  # exemplars whose meshes are loaded
FITS = 0.02  # of a mesh's diagonal
ALIKE = 1e-3  # of it, the mean distance of two surfaces


def _few(exemplars: Exemplars) -> list[int]:
    return sorted({round(i) for i in np.linspace(0, len(exemplars) - 1, FEW)})


def check_source_protocol(source: Any) -> None:
    """A bank is built from exemplars, wherever they come from."""
    require(source, Source)
    found = source()
    expect(isinstance(found, Exemplars), f"expected Exemplars, got {type(found).__name__}")


def check_source_repeats_itself(source: Any) -> None:
    """A build that is resumed asks again and has to meet the same exemplars."""
    first, second = source(), source()
    for what in ("names", "space", "label_space", "unit", "measured"):
        a, b = getattr(first, what), getattr(second, what)
        expect(a == b, f"two calls give {what} {a} and {b}")
    expect(np.array_equal(first.parameters, second.parameters), "two calls give other parameters")
    expect(np.array_equal(first.labels, second.labels, equal_nan=True), "two calls give other labels")
    for i in _few(first):
        expect(same_mesh(first.meshes[i], second.meshes[i]), f"two calls give other meshes of {first.names[i]!r}")


def check_source_meshes_load(source: Any) -> None:
    """A mesh that cannot be used is cheaper to meet here than after an hour of fitting."""
    found = source()
    for i in _few(found):
        mesh, name = found.meshes[i], found.names[i]
        expect(len(mesh.faces) > 0, f"mesh of {name!r}: expected faces, got none")
        expect(np.isfinite(mesh.vertices).all(), f"mesh of {name!r}: expected finite vertices")


def check_source_meshes_are_closed(source: Any) -> None:
    """Inside and outside are certain on closed meshes only; a source of open ones says so with `watertight = False`."""
    if not getattr(source, "watertight", True):
        raise NotApplicable("the source says that its meshes are open")
    found = source()
    for i in _few(found):
        expect(found.meshes[i].is_watertight, f"mesh of {found.names[i]!r} is open and the source does not say so")


def check_source_meshes_can_be_read_twice(source: Any) -> None:
    """Fitting, measuring and hashing each read an exemplar, in any order, and have to see one mesh."""
    found = source()
    few = _few(found)
    first = [(np.array(found.meshes[i].vertices), np.array(found.meshes[i].faces)) for i in few]
    for (vertices, faces), i in zip(reversed(first), reversed(few), strict=True):
        mesh = found.meshes[i]
        same = np.array_equal(vertices, mesh.vertices) and np.array_equal(faces, mesh.faces)
        expect(same, f"mesh of {found.names[i]!r} differs when it is read again")


def check_source_meshes_end(source: Any) -> None:
    """Iterating over a sequence stops at IndexError; without it a loop never ends or ends in a crash."""
    found = source()
    try:
        found.meshes[len(found)]
    except IndexError:
        return
    expect(False, f"meshes[{len(found)}] of {len(found)}: expected IndexError, got a mesh")


def check_source_parameters_differ(source: Any) -> None:
    """Two exemplars with the same parameters and other shapes make the mix between them meaningless."""
    found = source()
    order = np.lexsort(found.parameters.T) if found.parameters.shape[1] else np.arange(len(found))
    for a, b in pairwise(order):
        if np.array_equal(found.parameters[a], found.parameters[b]):
            same = same_mesh(found.meshes[a], found.meshes[b])
            expect(same, f"{found.names[a]!r} and {found.names[b]!r} differ in shape and not in parameters")


def check_source_mesh_at_is_the_exemplar(source: Any) -> None:
    """Produced shapes are judged against this truth, so it has to be the truth where an exemplar shows it."""
    found = source()
    if found.mesh_at is None:
        raise NotApplicable("the source knows no true meshes")
    for i in _few(found):
        row = np.array(found.parameters[i])
        given, true = found.meshes[i], found.mesh_at(row)
        expect(np.array_equal(row, found.parameters[i]), "mesh_at changed the parameters that it was given")
        apart = np.abs(np.asarray(true.bounds) - np.asarray(given.bounds)).max() / given.scale
        expect(apart <= FITS, f"mesh_at the parameters of {found.names[i]!r} is {apart:.1%} of its size off")
        apart = max(mean_distance(true, given), mean_distance(given, true)) / given.scale
        expect(apart <= ALIKE, f"mesh_at the parameters of {found.names[i]!r} has another surface, {apart:.2%} off")


CHECKS: tuple[CheckFunction, ...] = (
    check_source_protocol,
    *COMMON,
    check_source_repeats_itself,
    check_source_meshes_load,
    check_source_meshes_are_closed,
    check_source_meshes_can_be_read_twice,
    check_source_meshes_end,
    check_source_parameters_differ,
    check_source_mesh_at_is_the_exemplar,
)
