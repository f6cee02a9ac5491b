"""Safe repairs: those that move no vertex and close no opening that could be meant."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from lampopt.intake.edges import Edges, arrays, components
from lampopt.intake.holes import MOST, WIDE, fill
from lampopt.intake.sides import inward, unseen
from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

FLAT = 1e-12  # height of a face in parts of the size below which it has no area
DOUBLE = 0.5  # share of faces with a reversed twin from which on a surface is taken to be drawn from both sides


def repaired(mesh: Trimesh, *, wide: float = WIDE, most: int = MOST) -> tuple[Trimesh, tuple[str, ...]]:
    """`mesh` with safe repairs made, and what was done, in words; the mesh itself where it needs none.

    In order: faces without area and faces given twice are dropped, faces are turned to agree with their neighbours,
    small holes (of at most `most` edges, no wider than `wide` of the diagonal) are closed with new faces between the
    vertices that are there, parts that face inward are turned.
    """
    from trimesh import Trimesh

    vertices, given = arrays(mesh)
    faces = given
    done: list[str] = []
    for step in (_drop_degenerate, _drop_twins, _agree, partial(fill, wide=wide, most=most), _outward):
        faces, words = step(vertices, faces)
        done += words
        if not len(faces):  # nothing would be left: not for us to mend
            return mesh, ()
    if faces is given:
        return mesh, ()
    return Trimesh(np.array(mesh.vertices), faces, process=False, metadata=dict(mesh.metadata)), tuple(done)


def degenerate(vertices: Array, faces: Array) -> Array:
    """(F,) which faces have no area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    twice = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([np.linalg.norm(p - q, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    size = float(np.ptp(vertices[faces], axis=(0, 1)).max()) if len(faces) else 0.0
    return np.asarray(twice <= FLAT * size * longest)


def twins(faces: Array) -> tuple[Array, Array]:
    """(F,) which faces repeat an earlier one in the same sense, and which have an earlier reversed twin."""
    turn = faces.argmin(1)[:, None]
    rolled = np.take_along_axis(faces, (turn + np.arange(3)) % 3, 1)  # smallest corner first, the sense kept
    _, first, name = np.unique(rolled, axis=0, return_index=True, return_inverse=True)
    again = first[name.reshape(-1)] != np.arange(len(faces))
    _, first, name = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True)
    return again, ~again & (first[name.reshape(-1)] != np.arange(len(faces)))


def orientable(faces: Array, edges: Edges) -> tuple[Array, Array]:
    """(F,) which faces to turn so that neighbours agree, the fewer in each part; (F,) which parts have two sides.

    Each face is there twice, as it is and turned; edges link what agrees. A part of one side only (a Möbius strip)
    is linked to itself turned.
    """
    n = len(faces)
    one, other = edges.paired.T // 3
    cross = np.where(edges.agree, 0, n)
    _, label = components(np.r_[one, one + n], np.r_[other + cross, other + n - cross], 2 * n)
    as_is, turned = label[:n], label[n:]
    size = np.bincount(as_is, minlength=label.max() + 1)  # faces that are as they are in each group
    two_sided = as_is != turned
    keep = (size[as_is] > size[turned]) | ((size[as_is] == size[turned]) & (as_is < turned))
    return two_sided & ~keep, two_sided


def _drop_degenerate(vertices: Array, faces: Array) -> tuple[Array, list[str]]:
    repeated = (faces == np.roll(faces, -1, axis=1)).any(1)
    kept = faces[~repeated]
    flat = degenerate(vertices, kept)
    if flat.any() and len(Edges.of(kept[~flat]).lone) <= len(Edges.of(kept).lone):  # else they hold others together
        kept = kept[~flat]
    if len(kept) == len(faces):
        return faces, []
    return kept, [f"dropped {count(len(faces) - len(kept), 'face')} without area"]


def _drop_twins(_: Array, faces: Array) -> tuple[Array, list[str]]:
    again, reverse = twins(faces)
    words = [f"dropped {count(int(again.sum()), 'face')} given twice"] if again.any() else []
    if reverse.sum() * 2 > DOUBLE * (~again).sum():
        words.append(f"dropped {count(int(reverse.sum()), 'face')} drawn from behind as well")
        again |= reverse
    return (faces[~again], words) if words else (faces, [])


def _agree(_: Array, faces: Array) -> tuple[Array, list[str]]:
    edges = Edges.of(faces)
    if edges.agree.all():
        return faces, []
    turn, _two_sided = orientable(faces, edges)
    if not turn.any():
        return faces, []
    return _turned(faces, turn), [f"turned {count(int(turn.sum()), 'face')} to agree with the neighbours"]


def _outward(vertices: Array, faces: Array) -> tuple[Array, list[str]]:
    edges = Edges.of(faces)
    parts, part = edges.parts()
    if parts == 1 and not len(edges.lone) and not edges.crowded:
        turn = np.full(len(faces), volume(vertices, faces) < 0)
    else:
        turn = inward(vertices, faces, part)[part]
        if turn.any() and unseen(vertices, _turned(faces, turn)) > unseen(vertices, faces):
            return faces, []  # a soup, where no side can be told
    if not turn.any():
        return faces, []
    some = f"{count(int(turn.sum()), 'face')} of {count(len(np.unique(part[turn])), 'part')}"
    what = "all faces" if turn.all() else some
    return _turned(faces, turn), [f"turned {what} outward"]


def volume(vertices: Array, faces: Array) -> float:
    """What closed, outward faces enclose; negative where they face inward."""
    a, b, c = (vertices[faces[:, k]] - vertices[faces[0, 0]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def _turned(faces: Array, turn: Array) -> Array:
    return np.where(turn[:, None], faces[:, ::-1], faces)


def count(n: int, one: str, many: str = "") -> str:
    """A number of things: "1 face", "3 faces"."""
    return f"{n} {one}" if n == 1 else f"{n} {many or one + 's'}"
