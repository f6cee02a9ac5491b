"""The surface a flow is solved around: cleaned, checked, turned into the wind, one length long.

What falsifies drag is taken away or refused: parts that float beside the body, openings, faces turned anyhow,
roughness. All that is done is said; none of it passes in silence.
"""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import blake2b
from typing import TYPE_CHECKING, Literal

import numpy as np

import lampopt
from lampopt.errors import EmptyMesh, InputError, MeasureError
from lampopt.intake import repaired
from lampopt.intersections import self_intersections
from lampopt.meshfile import join
from lampopt.topology import parts, topology
from lampopt.types import Array

from .outcomes import FlowError
from .smooth import LOCAL, ROUGH, TOO_ROUGH, roughness, smoothed

if TYPE_CHECKING:
    from trimesh import Trimesh

Half = Literal["auto", "yes", "no"]

ALIKE = 0.003  # of the length: how far left and right may be apart anywhere to be solved as one
SMALL = 0.1  # of the length: the largest extent of a part that floats and is taken for a leftover
NEAR = 0.005  # of the length: parts nearer than that touch
STANDS = 0.02  # of the length: how far above the ground a wheel may end, and how far below the body
WIDE, MOST = 0.1, 64  # of the diagonal: the widest hole that is closed, if it is flat; of how many edges at most
GAP = 60  # parts of the length: the gap that a wrap is advised with
DIGITS = 7  # of coordinates, in body lengths: what moving and scaling a mesh leaves the same


@dataclass(frozen=True, eq=False)
class Surface:
    """A closed surface in body lengths, the wind along x, z up: nose at x = 0, middle at y = 0, lowest point at z = 0.

    Parameters
    ----------
    vertices, faces
        (V, 3) and (F, 3), in an order of their own, so that one shape always is one file.
    length
        Of the mesh, along the wind [its unit].
    frontal_area
        Seen along the wind [length²].
    half
        Whether left and right are alike enough to solve one of them.
    notes
        What was mended, in words.
    """

    vertices: Array
    faces: Array
    length: float
    frontal_area: float
    half: bool
    notes: tuple[str, ...]

    @property
    def width(self) -> float:
        """Across the wind [length]."""
        return self._across(1)

    @property
    def height(self) -> float:
        """[length]."""
        return self._across(2)

    def _across(self, axis: int) -> float:
        return round(float(np.ptp(self.vertices[:, axis])), DIGITS)  # the same for what has the same digest

    @property
    def digest(self) -> str:
        """Of what a flow depends on."""
        parts = ((np.round(self.vertices, DIGITS) + 0.0).tobytes(), self.faces.tobytes(), bytes([self.half]))
        return blake2b(b"".join(parts), digest_size=16).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Surface) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def stl(self, lift: float) -> bytes:
        """As a file, raised by `lift` [length]."""
        from trimesh import Trimesh
        from trimesh.exchange.stl import export_stl

        raised = np.round(self.vertices, DIGITS) + np.array([0, 0, lift])
        data: bytes = export_stl(Trimesh(raised, self.faces, process=False))
        return data


def cleaned(mesh: Trimesh, *, wind: str, up: str, half: Half) -> Surface:
    """`mesh` as a flow is solved around it.

    Raises
    ------
    InputError
        If it is no mesh.
    EmptyMesh
        If it has no faces.
    FlowError
        "refused-mesh", saying what is wrong and what to do.
    """
    from trimesh import Trimesh

    if not isinstance(mesh, Trimesh):
        raise InputError(f"expected a mesh (trimesh.Trimesh), got {type(mesh).__name__}")
    if len(mesh.faces) == 0:
        raise EmptyMesh("expected a mesh with faces, got one without")
    faces, vertices = np.asarray(mesh.faces), np.asarray(mesh.vertices, float)
    if faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        raise _refused("expected faces between finite vertices, got some that are not there, or not finite")
    plain = Trimesh(vertices @ axes(wind, up).T, faces, process=False)
    plain.remove_unreferenced_vertices()
    try:
        join(plain)
    except InputError as error:
        raise _refused(str(error)) from error
    plain, done = repaired(plain, wide=WIDE, most=MOST)
    vertices, faces = np.asarray(plain.vertices, float), np.asarray(plain.faces, np.int64)
    faces, dropped = _without_fragments(vertices, faces)
    _check_closed(vertices, faces)
    used, place = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], place.reshape(-1, 3)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    length = float(high[0] - low[0])
    if not length > 0 or length < 0.05 * float((high - low).max()):
        raise _refused(
            f"expected a body that is long along the wind ({wind}), got one that measures {length:.4g} along it and "
            f"{float((high - low).max()):.4g} across; say where the wind blows to by wind="
        )
    vertices, mended = _smooth(_placed(vertices), faces)
    if mended:  # what was outermost is less so now: else the wheels would not reach the ground any more
        length *= float(np.ptp(vertices[:, 0]))
        vertices = _placed(vertices)
    vertices, faces = _in_order(vertices, faces)
    alike, said = _symmetry(vertices, faces, half)
    notes = (*done, *dropped, *mended, *said)
    return Surface(vertices, faces, length, _frontal_area(vertices, faces, alike), alike, notes)


def _placed(vertices: Array) -> Array:
    """One length long, nose at x = 0, middle at y = 0, lowest point at z = 0."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return np.asarray((vertices - [low[0], (low[1] + high[1]) / 2, low[2]]) / (high[0] - low[0]))


def axes(wind: str, up: str) -> Array:
    """(3, 3) rows: along the wind, across, up. Raises InputError where the options are no axes, or one axis."""
    named = {sign + axis: s * np.eye(3)[k] for k, axis in enumerate("xyz") for sign, s in (("", 1), ("-", -1))}
    for option, axis in (("wind", wind), ("up", up)):
        if not isinstance(axis, str) or axis not in named:
            raise InputError(f"{option}: expected one of x, -x, y, -y, z, -z, got {axis!r:.80}")
    if wind.removeprefix("-") == up.removeprefix("-"):
        raise InputError(f"wind: expected an axis across up = {up!r}, got {wind!r}")
    return np.stack([named[wind], np.cross(named[up], named[wind]), named[up]])


def _without_fragments(vertices: Array, faces: Array) -> tuple[Array, list[str]]:
    """The faces without small parts that float; larger ones have to stand on the ground, as wheels do.

    The ground is where the lowest of all but the small parts ends; what stands on it reaches up to the body.
    """
    part = parts(faces)
    if part.max() == 0:
        return faces, []
    corners = vertices[faces]
    low = np.array([corners[part == k].min(axis=(0, 1)) for k in range(part.max() + 1)])
    high = np.array([corners[part == k].max(axis=(0, 1)) for k in range(part.max() + 1)])
    body = int(np.argmax(np.prod(high - low, axis=1)))
    size, length = (high - low).max(axis=1), float((high - low)[body].max())
    joined = _joined_to(body, vertices, faces, part, NEAR * length)
    apart = [k for k in range(len(low)) if k not in joined]
    drop, kept = ([k for k in apart if (size[k] <= SMALL * length) == small] for small in (True, False))
    underside = low[[*joined], 2].min()
    ground = min(underside, low[kept, 2].min(initial=np.inf))
    for k in kept:
        if low[k, 2] > ground + STANDS * length or high[k, 2] < underside - STANDS * length:
            raise _refused(
                f"expected one body and what touches it, got a part {size[k] / length:.0%} as long as the body "
                "that floats beside it; take it away, or join it"
            )
    said = []
    if drop:
        what = "part that floated" if len(drop) == 1 else "parts that floated"
        said.append(f"dropped {len(drop)} {what} beside the body, up to {size[drop].max() / length:.1%} of its length")
    if kept:
        what = "part apart from the body that stands" if len(kept) == 1 else "parts apart from the body that stand"
        said.append(f"kept {len(kept)} {what} on the ground")
    return faces[~np.isin(part, drop)], said


def _joined_to(body: int, vertices: Array, faces: Array, part: Array, reach: float) -> set[int]:
    """Parts that touch the body, cross it or lie within it, or so with one that does."""
    import igl
    from trimesh import Trimesh

    def apart(points: Array, others: Array) -> float:
        """Of the nearest point from faces."""
        if not len(points):
            return np.inf
        squared = igl.point_mesh_squared_distance(points, vertices, np.ascontiguousarray(others))[0]
        return float(np.sqrt(squared.min()))

    crossing = part[self_intersections(Trimesh(vertices, faces, process=False))]
    joined, waiting = {body}, set(range(int(part.max()) + 1)) - {body}
    grown = True
    while grown and waiting:
        grown = False
        have = np.ascontiguousarray(faces[np.isin(part, [*joined])])
        for k in sorted(waiting):
            own = faces[part == k]
            with_k = crossing[(crossing == k).any(axis=1)]
            corners = np.ascontiguousarray(vertices[np.unique(own)])
            if (
                np.isin(with_k, [*joined]).any()
                or apart(corners, have) <= reach
                or (igl.fast_winding_number(vertices, have, corners) > 0.5).any()
                or apart(_beside(vertices[np.unique(have)], corners, reach), own) <= reach  # of large faces
            ):
                joined.add(k)
                waiting.discard(k)
                grown = True
    return joined


def _beside(points: Array, corners: Array, reach: float) -> Array:
    """Those of `points` that lie within the box about `corners`, grown by `reach`."""
    low, high = corners.min(axis=0) - reach, corners.max(axis=0) + reach
    return np.ascontiguousarray(points[((points >= low) & (points <= high)).all(axis=1)])


def _check_closed(vertices: Array, faces: Array) -> None:
    from trimesh import Trimesh

    body = Trimesh(vertices, faces, process=False)
    if topology(body).closed:
        return
    edges, counts = np.unique(np.sort(body.edges, axis=1), axis=0, return_counts=True)
    loose = edges[counts == 1]
    size = float(np.ptp(vertices[np.unique(faces)], axis=0).max())
    if len(loose):
        wide = float(np.ptp(vertices[np.unique(loose)], axis=0).max())
        what = f"got {len(loose)} edges with one face, spread over {wide / size:.1%} of its size"
    elif (counts > 2).any():
        what = f"got {int((counts > 2).sum())} edges with more than two faces"
    else:
        what = "got faces that disagree on which side is out"
    raise _refused(
        f"expected a closed surface, {what}, more than is mended safely; wrap it first: lampopt.wrap(mesh, "
        f"gap={size / GAP:.2g})"
    )


def _smooth(vertices: Array, faces: Array) -> tuple[Array, list[str]]:
    rough, local = roughness(vertices, faces)
    if rough <= ROUGH and local <= LOCAL:
        return vertices, []
    better = vertices if max(rough, local) > TOO_ROUGH else smoothed(vertices, faces)
    left, there = roughness(better, faces)
    if left > ROUGH or there > TOO_ROUGH:
        raise _refused(
            f"expected a smooth surface, got one that is rough by {rough:.2%} of the length, {local:.2%} in places, "
            f"more than smoothing can take away (up to {TOO_ROUGH:.2%}); drag would be the roughness's: decode it "
            "finer, or smooth it first"
        )
    told = f"{rough:.2%} of the length before, {left:.2%} after"
    return better, [f"smoothed: rough by {told}; in places by {local:.2%}, {there:.2%}"]


def _symmetry(vertices: Array, faces: Array, half: Half) -> tuple[bool, list[str]]:
    import igl

    if half == "no":
        return False, []
    mirrored = np.ascontiguousarray(vertices * [1, -1, 1])
    apart = np.sqrt(igl.point_mesh_squared_distance(mirrored, vertices, faces)[0])
    off = float(apart.max())
    if off <= ALIKE:
        said = f"left and right differ by up to {off:.2%} of the length: the side y > 0 is solved"
        return True, [said] if off > 1e-3 else []
    if half == "yes":
        return True, [f"left and right differ by {off:.2%} of the length: the side y > 0 stands for both, as asked"]
    return False, []


def _in_order(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """The same surface however it was listed."""
    order = np.lexsort(np.round(vertices, DIGITS).T)
    place = np.argsort(order)
    faces = place[faces]
    turn = (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3
    faces = np.take_along_axis(faces, turn, axis=1)
    return np.ascontiguousarray(vertices[order]), np.ascontiguousarray(faces[np.lexsort(faces.T[::-1])])


def _frontal_area(vertices: Array, faces: Array, half: bool) -> float:
    """Of the flow that is solved: where that is a half, of it and its mirror image."""
    from trimesh import Trimesh
    from trimesh.intersections import slice_faces_plane

    if half:
        side, drawn, _ = slice_faces_plane(vertices, faces, plane_normal=[0, 1, 0], plane_origin=[0, 0, 0])
        vertices, faces = np.concatenate([side, side * [1, -1, 1]]), np.concatenate([drawn, drawn + len(side)])
    mesh = Trimesh(vertices, faces, process=False)
    try:
        return float(lampopt.measure(lampopt.Spec("frontal-area", forward="-x"), mesh)["frontal_area"])
    except MeasureError as error:
        raise _refused(f"its frontal area cannot be measured: {error}") from error


def _refused(message: str) -> FlowError:
    return FlowError(message, "refused-mesh")
