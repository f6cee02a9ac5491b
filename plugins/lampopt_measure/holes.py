"""Round through-holes along the axes x, y, z: found in plane sections, measured there and on their walls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError, MeasureError
from lampopt.types import Array

from .basic import solid
from .facets import Facets, highest, lowest, surface
from .facets import section as cut
from .quantity import Quantity, combined, maximum, mean, minimum, sqrt
from .section import over, section

if TYPE_CHECKING:
    from trimesh import Trimesh

LEVELS = 32  # sections along each axis; a part of fewer slabs is cut in the middle of each
THIN = 1e-6  # share of the part: a slab thinner than that is rounding
ROUND = 0.02  # what a loop's polar moment may exceed a circle's by; a square does by 5 %, an octagon by 0.3 %
ASIDE = 0.25  # radii that the centres of one hole's loops may lie apart: one that slants is none along an axis
WALL = 0.3  # radii that a hole's wall may lie off its circle
INWARD = 0.7  # cosine: a hole's wall looks at its axis within 45°


@dataclass(frozen=True)
class Hole:
    """Radius and centre of one round through-hole, relative to the middle of the part's bounding box.

    The hole may run along any coordinate axis, through the whole part or one wall of it; a stepped bore is one hole.
    Its radius is that of the circle of the same area, in the section of median area over its depth; there its centre
    lies. Along its axis the centre is the middle of the wall of that radius.

    Parameters
    ----------
    which
        By size: 1 the largest, 2 the next, ...; −1 the smallest.
    along
        Only holes along "x", "y" or "z"; "" for all.
    """

    which: int = 1
    along: str = ""

    names = ("radius", "x", "y", "z")
    units = ("L",) * 4

    def __post_init__(self) -> None:
        if isinstance(self.which, bool) or not isinstance(self.which, int) or self.which == 0:
            raise InputError(f"hole: which: expected 1, 2, ... or -1, -2, ..., got {self.which!r:.100}")
        _check_along(self.along)

    def __call__(self, mesh: Trimesh) -> Array:
        """The four values (4,).

        Raises
        ------
        EmptyMesh, MeasureError
            If the mesh is open, its faces do not all point outward, or there are not so many round through-holes.
        InputError
            If an option is none.
        """
        return np.array([float(value) for value in self._values(solid(mesh, "hole"))])

    def gradient(self, mesh: Trimesh) -> Array:
        """Derivatives by the vertices (4, V, 3). Raises as a call does, and MeasureError for loose triangles."""
        return np.stack([value.gradient(len(mesh.vertices)) for value in self._values(_whole(mesh, "hole"))])

    def _values(self, mesh: Trimesh) -> list[Quantity]:
        found = bores(mesh, self.along)
        if abs(self.which) > len(found):
            radii = ", ".join(f"{bore.radius:.6g}" for bore in found[:10])
            raise MeasureError(
                f"hole: expected at least {abs(self.which)} round through-holes{_along(self.along)}, got {len(found)}"
                + (f" of radius {radii}" if found else "")
            )
        return found[self.which - 1 if self.which > 0 else self.which].measured(mesh)


@dataclass(frozen=True)
class Holes:
    """How many round through-holes there are along the coordinate axes, and their radii: largest, smallest, sum.

    Two walls in line have a hole each, and so has a bore that another one crosses on both sides of it.

    Parameters
    ----------
    along
        Only holes along "x", "y" or "z"; "" for all.
    """

    along: str = ""

    names = ("count", "largest", "smallest", "sum")
    units = ("", "L", "L", "L")

    def __post_init__(self) -> None:
        _check_along(self.along)

    def __call__(self, mesh: Trimesh) -> Array:
        """The four values (4,). Raises as `Hole` does, and MeasureError where there is no such hole."""
        radii = [bore.radius for bore in bores(solid(mesh, "holes"), self.along)]
        if not radii:
            raise MeasureError(f"holes: expected a round through-hole{_along(self.along)}, got none")
        return np.array([len(radii), max(radii), min(radii), sum(radii)])

    def gradient(self, mesh: Trimesh) -> Array:
        """Derivatives by the vertices (4, V, 3), of the count 0. Raises as a call does and as `Hole` does."""
        self(_whole(mesh, "holes"))
        radii = [bore.measured(mesh)[0] for bore in bores(mesh, self.along)]
        values = (combined(float(len(radii))), maximum(*radii), minimum(*radii), mean(radii) * len(radii))
        return np.stack([value.gradient(len(mesh.vertices)) for value in values])


@dataclass(frozen=True)
class Bore:
    """A round through-hole as it was found.

    Parameters
    ----------
    axis
        0, 1, 2: along x, y, z.
    centre
        (2,) across the axis, in the order that follows it: y, z for x.
    radius
        [L].
    level
        Of the section of median area, as a fraction of the part's size along the axis.
    ends
        Between which levels it lies, as fractions too.
    """

    axis: int
    centre: tuple[float, float]
    radius: float
    level: float
    ends: tuple[float, float]

    def measured(self, mesh: Trimesh) -> list[Quantity]:
        """Radius and centre (x, y, z) relative to the middle of the box, with derivatives."""
        whole = surface(mesh)
        ends = [(lowest(whole, towards), highest(whole, towards)) for towards in np.eye(3)]
        low, high = ends[self.axis]
        at = low + self.level * (high - low)
        loop = ring(cut(mesh, np.eye(3)[self.axis], at), self.axis, self.centre, self.radius)
        area, first, second = area_and_centre(loop, self.axis)
        centre = {self._beside[0]: first, self._beside[1]: second, self.axis: self._depth(whole)}
        return [sqrt(area / np.pi), *(centre[k] - (ends[k][0] + ends[k][1]) / 2 for k in range(3))]

    def _across(self, points: Array) -> Array:
        """(M, 2) points relative to the hole's axis."""
        return np.asarray(points[:, self._beside] - self.centre)

    @property
    def _beside(self) -> list[int]:
        """The two other axes, in the order that follows the hole's."""
        return [(self.axis + 1) % 3, (self.axis + 2) % 3]

    def _depth(self, whole: Facets) -> Quantity:
        """The mean of the wall's area along the axis."""
        away = self._across(whole.middles)
        far = np.linalg.norm(away, axis=1)
        looks = whole.normals[:, self._beside]
        low, size = whole.corners[..., self.axis].min(), np.ptp(whole.corners[..., self.axis])
        place = (whole.middles[:, self.axis] - low) / size
        near = (np.abs(far - self.radius) < WALL * self.radius) & (place > self.ends[0]) & (place < self.ends[1])
        wall = whole.where(near & (-(looks * away).sum(axis=1) > INWARD * far)).required("a hole's wall")
        along, area = wall.middles[:, self.axis], wall.size.sum()
        mean = float(along @ wall.size / area)
        by_corners = np.zeros(wall.corners.shape)
        by_corners[..., self.axis] = wall.size[:, None] / (3 * area)
        return wall.quantity(mean, by_corners, (along - mean) / area)


def ring(segments: Facets, axis: int, centre: tuple[float, float], radius: float) -> Facets:
    """The closed loop of a section across `axis` that runs about `centre` at about `radius`."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = np.ascontiguousarray(segments.rows).reshape(-1, 2)
    _, node = np.unique(edges, axis=0, return_inverse=True)
    start, end = node.reshape(-1, 2).T
    count = int(node.max()) + 1
    _, label = connected_components(coo_array((np.ones(len(start), bool), (start, end)), (count, count)))
    away = segments.middles[:, [(axis + 1) % 3, (axis + 2) % 3]] - centre
    off = np.abs(np.linalg.norm(away, axis=1) - radius)
    return segments.where(label[start] == label[start[off.argmin()]])


def area_and_centre(loop: Facets, axis: int) -> tuple[Quantity, Quantity, Quantity]:
    """The area that the loop of a hole encloses, and its centroid along the two axes that follow `axis`.

    Raises MeasureError where it encloses none.
    """
    towards = np.eye(3)[axis]
    near = loop.corners.mean(axis=(0, 1))  # a fixed point amid the loop: about a far one moments drown in rounding
    p, q = loop.corners[:, 0] - near, loop.corners[:, 1] - near
    cross = np.cross(p, q) @ towards
    by_cross = np.stack([np.cross(q, towards), np.cross(towards, p)], axis=1)
    if not cross.sum() < 0:
        raise MeasureError(
            "expected a loop around the opening of a hole, got one around material; the surface crosses itself there"
        )
    area = loop.quantity(cross.sum() / 2, by_cross / 2)
    centre = []
    for k in ((axis + 1) % 3, (axis + 2) % 3):
        both = (p + q)[:, k]
        by = by_cross * both[:, None, None] + cross[:, None, None] * np.eye(3)[k]
        centre.append(loop.quantity((both * cross).sum() / 6, by / 6) / area + float(near[k]))
    return -area, centre[0], centre[1]


def bores(mesh: Trimesh, along: str = "") -> list[Bore]:
    """Every round through-hole of a closed mesh, the largest first. Raises InputError for an axis that is none."""
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    found = [bore for axis in range(3) if along in ("", "xyz"[axis]) for bore in _bores(vertices, faces, axis)]
    low, high = vertices[np.unique(faces)].min(0), vertices[np.unique(faces)].max(0)
    cell = THIN * float((high - low).max())

    def place(bore: Bore) -> tuple[int, int, tuple[int, ...]]:
        """Rounded, so that which of equal holes comes first does not depend on where the part lies."""
        ends = [low[(bore.axis + k) % 3] for k in (1, 2)]
        at = tuple(round((c - float(end)) / cell) for c, end in zip(bore.centre, ends, strict=True))
        return -round(bore.radius / cell), bore.axis, at

    return sorted(found, key=place)


@dataclass(frozen=True)
class _Ring:
    """One loop around a round opening, in one section."""

    number: int
    depth: float  # what the section stands for
    area: float
    centre: tuple[float, float]

    @property
    def radius(self) -> float:
        return float(np.sqrt(self.area / np.pi))


def _bores(vertices: Array, faces: Array, axis: int) -> list[Bore]:
    turned = vertices[:, [(axis + 1) % 3, (axis + 2) % 3, axis]]
    heights = np.unique(turned[np.unique(faces), 2])
    low, size = heights[0], heights[-1] - heights[0]
    levels, depths = _levels(heights)
    runs: list[list[_Ring]] = []
    for number, height in enumerate(levels):
        going = [run for run in runs if run[-1].number == number - 1]
        for opening in _rings(turned, faces, height, number, depths[number]):
            run = next((run for run in going if _same(run[-1], opening)), None)
            if run is None:
                runs.append([opening])
            else:
                run.append(opening)
    bounds = np.concatenate([[-np.inf], levels, [np.inf]])
    found = []
    for run in runs:
        typical = _median(run)
        height = levels[typical.number]
        ends = bounds[run[0].number], bounds[run[-1].number + 2]
        drift = np.hypot(*np.subtract(run[-1].centre, run[0].centre))
        if drift < ASIDE * typical.radius and _free(turned, faces, typical.centre, height, ends):
            level, *reach = (np.array([height, *ends]) - low) / size
            found.append(Bore(axis, typical.centre, typical.radius, float(level), (float(reach[0]), float(reach[1]))))
    return found


def _median(run: list[_Ring]) -> _Ring:
    """The ring of median area over the depth."""
    order = sorted(run, key=lambda opening: (opening.area, opening.number))
    passed = np.cumsum([opening.depth for opening in order])
    return order[int(np.searchsorted(passed, passed[-1] / 2 * (1 - 1e-9)))]  # rounding is not to choose between two


def _levels(heights: Array) -> tuple[Array, Array]:
    """Where to cut a part whose vertices lie at `heights`, and the depth that each cut stands for.

    A plain part is cut in the middle of every slab, another one evenly.
    """
    low, high = heights[0], heights[-1]
    gaps = np.diff(heights)
    slabs = gaps > THIN * (high - low)
    if slabs.sum() <= LEVELS:
        return (heights[:-1] + gaps / 2)[slabs], gaps[slabs]
    return low + (high - low) * (np.arange(LEVELS) + 0.5) / LEVELS, np.full(LEVELS, (high - low) / LEVELS)


def _rings(vertices: Array, faces: Array, height: float, number: int, depth: float) -> list[_Ring]:
    loops = section(vertices, faces, height)
    circular = np.abs(loops.polar) * 2 * np.pi <= (1 + ROUND) * loops.area**2
    return [
        _Ring(number, depth, -float(loops.area[i]), (float(loops.centroid[i, 0]), float(loops.centroid[i, 1])))
        for i in np.flatnonzero((loops.area < 0) & circular)
    ]


def _same(a: _Ring, b: _Ring) -> bool:
    return bool(np.hypot(a.centre[0] - b.centre[0], a.centre[1] - b.centre[1]) < ASIDE * min(a.radius, b.radius))


def _free(vertices: Array, faces: Array, centre: tuple[float, float], height: float, ends: tuple[float, float]) -> bool:
    """Whether an opening's axis meets no face between `ends`, and is outside the material at `height`."""
    met = over(vertices, faces, np.array(centre))
    if len(met) == 0:
        return True
    a, b, c = (vertices[met[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    flat = np.abs(normal[:, 2]) > 0
    away = np.array(centre) - a[flat, :2]
    at = np.sort(a[flat, 2] - (normal[flat, :2] * away).sum(axis=1) / normal[flat, 2])
    if ((at > ends[0]) & (at < ends[1])).any():
        return False
    above = at[at > height]  # where the axis meets an edge, two faces tell of one crossing
    crossings = len(above[:1]) + int((np.diff(above) > THIN * np.ptp(vertices[:, 2])).sum())
    return crossings % 2 == 0


def _whole(mesh: Trimesh, what: str) -> Trimesh:
    """`mesh`, whose faces share vertices: derivatives by the corners of loose triangles would tell of no loop."""
    if solid(mesh, what) is not mesh:
        raise MeasureError(f"{what}: expected faces that share vertices, got loose triangles; mesh.merge_vertices()")
    return mesh


def _check_along(along: str) -> None:
    if along not in ("", "x", "y", "z"):
        raise InputError(f"along: expected x, y, z or '' for all, got {along!r:.100}")


def _along(axis: str) -> str:
    return f" along {axis}" if axis else ""
