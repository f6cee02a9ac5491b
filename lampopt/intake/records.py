"""What intake says: a `Health` for every mesh, a `Finding` for everything that wants to be known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["refused", "doubtful", "note"]


@dataclass(frozen=True)
class Health:
    """What one mesh is like, as it is used: after its repairs.

    Parameters
    ----------
    name
        The exemplar's.
    vertices, faces
        How many there are.
    closed
        Watertight: every edge has two faces, in opposite directions.
    bodies
        What faces hold together by their edges.
    genus
        Through-holes, summed over bodies; None if not closed.
    open_edges, holes
        Edges with one face, and how many openings they lie around.
    crowded_edges
        Edges with three faces or more.
    opposed_edges
        Edges whose two faces disagree about which side is out.
    inward
        Parts of the surface that face inward.
    crossings
        Pairs of faces that cross; None if they were not looked for.
    degenerate, duplicates, unreferenced
        Faces without area, faces that repeat another (in either sense), vertices without a face.
    unseen
        Share of the area that a field of winding numbers has outside on both sides of; 1: nothing is enclosed.
    extents, centre
        Of the bounding box [unit].
    repairs
        What was mended, in words.
    """

    name: str
    vertices: int
    faces: int
    closed: bool
    bodies: int
    genus: int | None
    open_edges: int
    holes: int
    crowded_edges: int
    opposed_edges: int
    inward: int
    crossings: int | None
    degenerate: int
    duplicates: int
    unreferenced: int
    unseen: float
    extents: tuple[float, float, float]
    centre: tuple[float, float, float]
    repairs: tuple[str, ...] = ()


@dataclass(frozen=True)
class Finding:
    """One thing about one exemplar: what was expected, what arrived, what to do.

    `severity`: "refused" cannot be used, "doubtful" wants to be looked at and accepted by name, a "note" stops nothing.
    `exemplar` is "" where the family as a whole is meant.
    """

    exemplar: str
    kind: str
    severity: Severity
    message: str

    def __str__(self) -> str:
        return f"exemplar {self.exemplar!r}: {self.message}" if self.exemplar else self.message
