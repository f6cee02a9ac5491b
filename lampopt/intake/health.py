"""One mesh looked at by itself."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import numpy as np

from lampopt.intake.edges import Edges, arrays
from lampopt.intake.records import Finding, Health, Severity
from lampopt.intake.repair import count, degenerate, orientable, twins
from lampopt.intake.sides import inward, unseen
from lampopt.intersections import self_intersections
from lampopt.topology import topology
from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

LOST = 0.25  # share of the area that a field may fail to see before it is doubtful
MOST = 100_000  # crossings counted
GAP = 60  # parts of the largest extent: the gap that a wrap is advised with


def examine(mesh: Trimesh, name: str, repairs: tuple[str, ...] = (), *, crossings: bool = True) -> Health:
    """The health of `mesh`, which has faces and finite vertices; `crossings` says whether those are counted."""
    vertices, faces = arrays(mesh)
    shape, edges = topology(mesh), Edges.of(faces)
    parts, part = edges.parts()
    again, reverse = twins(faces)
    used = np.asarray(mesh.vertices, float)[faces]
    low, high = used.min((0, 1)), used.max((0, 1))
    turned = inward(vertices, faces, part)
    sound = shape.closed and parts == 1 and not turned.any()  # a field of such a surface sees all of it
    return Health(
        name=name,
        vertices=len(vertices),
        faces=len(faces),
        closed=shape.closed,
        bodies=shape.bodies,
        genus=shape.genus,
        open_edges=len(edges.lone),
        holes=edges.holes()[0],
        crowded_edges=edges.crowded,
        opposed_edges=int((~edges.agree).sum()),
        inward=int(turned.sum()),
        crossings=len(self_intersections(mesh, most=MOST)) if crossings else None,
        degenerate=int(degenerate(vertices, faces).sum()),
        duplicates=int((again | reverse).sum()),
        unreferenced=len(vertices) - len(np.unique(faces)),
        unseen=0.0 if sound else unseen(vertices, faces),
        extents=_three(high - low),
        centre=_three((high + low) / 2),
        repairs=repairs,
    )


def own_findings(health: Health, mesh: Trimesh, unit: str, file: str | None) -> Iterator[Finding]:
    """What is to be said of a mesh by itself; `file` is where it comes from, where that is known."""

    def found(kind: str, severity: Severity, message: str) -> Finding:
        return Finding(health.name, kind, severity, message)

    if health.repairs:
        yield found("repaired", "note", f"repaired: {'; '.join(health.repairs)}")
    if health.unseen == 1:
        yield found(
            "hollow",
            "doubtful",
            "expected a surface that encloses something, got one that does not; turn its faces outward, remove it, or "
            f"wrap it: {_wrap(health, file)}",
        )
    elif health.unseen > LOST:
        yield found(
            "soup",
            "doubtful",
            f"expected faces that agree on what is inside, got {health.unseen:.0%} of the area with outside on both "
            f"sides: a field loses that part; wrap it: {_wrap(health, file)}",
        )
    elif health.inward:
        yield found("inward", "doubtful", _inward(health))
    if not health.closed:
        yield found("open", "note", f"{_open(health, mesh, unit)}; for one closed surface: {_wrap(health, file)}")
    if health.crossings:
        counted = f"{MOST} or more pairs" if health.crossings >= MOST else count(health.crossings, "pair")
        yield found("crossing", "note", f"passes through itself: {counted} of faces crossing; inside stays inside")
    if health.degenerate + health.duplicates + health.unreferenced:
        said = [f"{count(health.degenerate, 'face')} without area"] if health.degenerate else []
        said += [f"{count(health.duplicates, 'face')} given twice"] if health.duplicates else []
        said += [f"{count(health.unreferenced, 'vertex', 'vertices')} without a face"] if health.unreferenced else []
        yield found("leftovers", "note", f"has {', '.join(said)}: they do no harm")


def _inward(health: Health) -> str:
    what = "all of it" if health.inward == health.bodies == 1 else count(health.inward, "part")
    return f"expected faces turned outward, got {what} facing inward; let it be repaired, or turn the faces"


def _open(health: Health, mesh: Trimesh, unit: str) -> str:
    """How open a surface is, and what stands against closing it."""
    faces = np.asarray(mesh.faces, np.int64)
    edges = Edges.of(faces)
    said = []
    if health.holes:
        widest = max(_widths(np.asarray(mesh.vertices, float), edges), default=0.0)
        holes = "an opening" if health.holes == 1 else f"{health.holes} openings, the widest"
        said.append(f"{holes} {widest:.3g} {unit} wide ({count(health.open_edges, 'edge')} with one face)")
    if health.crowded_edges:
        said.append(f"{count(health.crowded_edges, 'edge')} with more than two faces")
    if health.opposed_edges:
        one_sided = not orientable(faces, edges)[1].all()
        what = "a part with one side only (a Möbius strip)" if one_sided else "faces that disagree on what is out"
        said.append(f"{what} ({count(health.opposed_edges, 'edge')})")
    return f"not watertight: {', '.join(said)}; a field of winding numbers closes it smoothly"


def _widths(vertices: Array, edges: Edges) -> Iterator[float]:
    """How wide each opening is: the diagonal of its bounding box [unit]."""
    holes, which = edges.holes()
    for hole in range(holes):
        rim = vertices[edges.start[edges.lone[which == hole]]]
        yield float(np.linalg.norm(np.ptp(rim, axis=0)))


def _wrap(health: Health, file: str | None) -> str:
    """What to type to wrap a mesh."""
    gap = f"{max(health.extents) / GAP:.2g}"
    if file is None:
        return f"lampopt.wrap(mesh, gap={gap})"
    out = Path(file).with_name(f"{Path(file).stem}_wrapped.ply")
    return f"lampopt wrap {quote(file)} --gap {gap} --out {quote(str(out))}"


def _three(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
