"""One mesh against the others: size, place, facing, bodies and genus.

What is usual is told by medians, so that a few odd ones among many do not move it; nothing is odd among fewer than
`FEW`, but for a size that only another unit explains. A mesh is odd where it is both far out in itself and far out
beside how its fellows differ among each other: families are allowed to be wide.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from math import comb
from typing import TYPE_CHECKING

import numpy as np

from lampopt.intake.edges import arrays
from lampopt.intake.facing import facing
from lampopt.intake.records import Finding, Health
from lampopt.intake.sizes import FEW, WIDE, diagonal, sizes
from lampopt.metrics import sample_surface
from lampopt.types import Array, Parameter

if TYPE_CHECKING:
    from trimesh import Trimesh

AWAY = 1.0  # usual sizes away from the usual place
RARE = 0.1  # share of the meshes up to which a genus or number of bodies is odd
MAJORITY = 0.75  # share that makes one usual
CHANCE = 0.01  # of odd shapes all being at one end of a parameter, below which it is no chance
POINTS = 256  # of each surface
LOOK = {"genus": "look for a hole that should not be there, or is missing", "bodies": "look for loose parts"}


class Fellows:
    """The meshes of a family, each seen once and kept as a handful of points."""

    def __init__(self, unit: str, space: Sequence[Parameter]) -> None:
        self._unit, self._space = unit, space
        self._health: list[Health] = []
        self._parameters: list[Array] = []
        self._points: list[Array] = []

    def add(self, health: Health, mesh: Trimesh, parameters: Array) -> None:
        """Take note of one more and of its parameters (d,)."""
        from trimesh import Trimesh

        self._health.append(health)
        self._parameters.append(parameters)
        if min(health.extents) > 0:  # a flat one has no side to lie on
            vertices, faces = arrays(mesh)
            points = sample_surface(Trimesh(vertices, faces, process=False), POINTS)
            points *= max(health.extents) / np.array(health.extents)
        else:
            points = np.empty((0, 3))
        self._points.append(points.astype(np.float32))

    def findings(self, mesh_of: Callable[[str], Trimesh]) -> Iterator[Finding]:
        """What is odd about whom; `mesh_of` gives one mesh by name."""
        odd = list(sizes(self._health, self._unit, np.array(self._parameters)))
        yield from odd
        scaled = {finding.exemplar for finding in odd}  # their place follows from their size
        yield from _places([h for h in self._health if h.name not in scaled], self._unit)
        yield from self._facing(mesh_of)
        yield from _shapes(self._health)

    def _facing(self, mesh_of: Callable[[str], Trimesh]) -> Iterator[Finding]:
        full = [i for i, points in enumerate(self._points) if len(points)]
        if len(full) < FEW:
            return
        names = [self._health[i].name for i in full]
        extents = np.array([self._health[i].extents for i in full])
        odd = dict(facing(np.stack([self._points[i] for i in full]), extents, lambda i: mesh_of(names[i])))
        column = _explained(np.array(self._parameters)[full], list(odd))
        for i, pose in odd.items():
            about = f"expected to face as its fellows do, got one that fits them when turned by {pose}"
            if column is None:
                yield Finding(names[i], "facing", "doubtful", f"{about}; turn it, or accept it")
            else:
                why = (
                    f"parameter {self._space[column].name!r} explains it: all such, and no others, are at one end of it"
                )
                yield Finding(names[i], "facing", "note", f"{about}; {why}")


def _places(family: Sequence[Health], unit: str) -> Iterator[Finding]:
    if len(family) < FEW:
        return
    centres = np.array([h.centre for h in family])
    size = float(np.median([diagonal(h) for h in family]))
    usual = np.median(centres, axis=0)
    away = np.linalg.norm(centres - usual, axis=1)
    limit = max(AWAY * size, WIDE * float(np.median(away)))
    for health, distance in zip(family, away.tolist(), strict=True):
        if distance > limit:
            where, there = (", ".join(f"{x:.3g}" for x in point) for point in (usual, health.centre))
            yield Finding(
                health.name,
                "place",
                "doubtful",
                f"expected a centre near ({where}) {unit}, as its fellows have, got ({there}): "
                f"{distance / size:.3g} times their size away; move it, or accept it",
            )


def _explained(parameters: Array, odd: list[int]) -> int | None:
    """The parameter (N, d) that has all the odd ones at one end, where chance would hardly have put them there."""
    count, d = parameters.shape
    if not odd or 2 * d > CHANCE * comb(count, len(odd)):
        return None
    others = np.delete(parameters, odd, axis=0)
    below = parameters[odd].max(0) < others.min(0)
    above = parameters[odd].min(0) > others.max(0)
    return int(np.argmax(below | above)) if (below | above).any() else None


def _shapes(family: Sequence[Health]) -> Iterator[Finding]:
    for what in ("bodies", "genus"):
        known = {h.name: getattr(h, what) for h in family if getattr(h, what) is not None}
        counts = Counter(known.values())
        if len(counts) < 2:
            continue
        (usual, often), *_ = counts.most_common(1)
        clear = len(known) >= FEW and often >= MAJORITY * len(known)
        for name, value in known.items():
            if value != usual and clear and counts[value] <= max(1, RARE * len(known)):
                message = f"expected {_said(what, usual)}, as {often} of {len(known)} have, got {value}"
                yield Finding(name, what, "doubtful", f"{message}; {LOOK[what]}, and accept or remove it")
        if not clear or any(n > max(1, RARE * len(known)) for v, n in counts.items() if v != usual):
            listed = ", ".join(f"{value} ({n})" for value, n in sorted(counts.items()))
            yield Finding("", what, "note", f"the exemplars differ in {what}: {listed}; a mix of them may be torn")


def _said(what: str, value: int) -> str:
    return f"{value} {what if value != 1 else 'body'}" if what == "bodies" else f"genus {value}"
