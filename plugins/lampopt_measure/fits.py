"""Lines, planes and circles fitted to parts of a mesh by total least squares, with derivatives; what lies between them.

A fit minimises the squared distance, integrated over the facets (trapezoid rule at their corners). Its derivative is
that of the minimum, by the implicit function theorem; which facets take part is taken as constant.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lampopt.errors import InputError, MeasureError
from lampopt.types import Array

from .facets import TIE, Direction, Facets, direction
from .quantity import Quantity, atan2, combined, sqrt

Vector = tuple[Quantity, Quantity, Quantity]
SEEDS = {2: 24, 3: 14}  # places along the facets that a consensus is sought from, by points a feature needs
ROUNDS = 20  # of fitting and choosing anew; a choice that comes back ends it, mostly after three
CHUNK = 2_000_000  # pairs of candidate and facet that are looked at in one go
STRAIGHT = 5.0  # sizes of what is fitted to: no arc has a larger radius
ALIKE = 1e-9  # relative gap of two spreads below which no direction is the main one


@dataclass(frozen=True, eq=False)
class Line:
    """A straight line through `point` along the unit vector `direction`; `rms` distance of the `facets` fitted to."""

    point: Vector
    direction: Vector
    rms: float
    facets: Facets


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane through `point` with unit `normal`, to the side that the facets face."""

    point: Vector
    normal: Vector
    rms: float
    facets: Facets


@dataclass(frozen=True, eq=False)
class Circle:
    """A circle across its axis: in the plane of a section, or around triangles at their mean position along it."""

    centre: Vector
    radius: Quantity
    rms: float
    facets: Facets


def line(facets: Facets, within: float | None = None) -> Line:
    """The line of least squares through segments; `within` a distance [L] only those that agree with most of them.

    Without `within` all take part. With it the line that most of the length lies near is sought, from pairs of places
    spread evenly along the segments, and fitted to what is near. Raises MeasureError where no line is determined.
    """
    kept = (
        facets
        if within is None
        else _agreeing(facets, 2, _line_through, _line_distances, _least_line, within, "a line")
    )
    _, spreads, axes = _spread(kept, "a line")
    if spreads[2] - spreads[1] <= ALIKE * spreads[2]:
        raise MeasureError("line: expected points that stretch out one way, got them spread alike")
    rms = math.sqrt(max(float(spreads[0] + spreads[1]), 0.0))
    return Line(_centroid(kept), _axis(kept, spreads, axes, 2), rms, kept)


def plane(facets: Facets, within: float | None = None) -> Plane:
    """The plane of least squares through triangles or segments; `within` as for `line`. Raises MeasureError."""
    kept = (
        facets
        if within is None
        else _agreeing(facets, 3, _plane_through, _plane_distances, _least_plane, within, "a plane")
    )
    _, spreads, axes = _spread(kept, "a plane")
    if spreads[1] - spreads[0] <= ALIKE * spreads[2]:
        raise MeasureError("plane: expected points that spread two ways, got them along a line or all around")
    sign = math.copysign(1.0, float(kept.size @ (kept.normals @ axes[:, 0])))
    return Plane(_centroid(kept), _axis(kept, spreads, axes * sign, 0), math.sqrt(max(float(spreads[0]), 0.0)), kept)


def circle(
    facets: Facets, within: float | None = None, axis: Direction | None = None, largest: float | None = None
) -> Circle:
    """The circle of least distance to the segments of a section, or to triangles around a known `axis`.

    `within` as for `line`. A radius above `largest` [L] is none: without it, above five times the size of what is
    fitted to, an arc of less than about 11°, since a line that is a little bent would pass for one. Raises MeasureError
    where no circle is determined.
    """
    if largest is not None and not largest > 0:
        raise InputError(f"circle: largest: expected a radius above 0, got {largest!r:.100}")
    if facets.plane is None and axis is None:
        raise MeasureError("circle: expected a section, got triangles; cut first, or name the axis")
    way = np.asarray(facets.plane if axis is None else direction(axis))
    across = np.linalg.svd(way[None])[2][1:]  # (2, 3) a basis across it

    def through(points: Array) -> Array:
        return _circles_through(points @ across.T)

    def distances(circles: Array, points: Array) -> Array:
        from_centre = np.linalg.norm(points @ across.T - circles[:, None, :2], axis=-1)
        return np.asarray(np.abs(from_centre - circles[:, None, 2]))

    def least(near: Facets) -> Array:
        return _least_circle(near.corners @ across.T, near.size / near.corners.shape[1])

    kept = facets if within is None else _agreeing(facets, 3, through, distances, least, within, "a circle")
    x, y, radius = least(kept.required("something to fit a circle to"))
    bound = largest or STRAIGHT * max(float(np.ptp(kept.corners @ side)) for side in across)
    if radius > bound:
        raise MeasureError(
            f"circle: expected a radius of at most {bound:.6g}, got {radius:.6g} of what is nearly straight; if it is "
            "an arc, say how large it may be: largest="
        )
    return _circle(kept, across, np.array([x, y]), radius)


def angle(a: Line | Plane | Direction, b: Line | Plane | Direction) -> Quantity:
    """Between two lines, planes or directions, 0 to 90 [deg]; a plane stands for its surface, not for its normal."""
    first, second = _heading(a), _heading(b)
    cosine, sine = abs(dot(first, second)), norm(cross(first, second))
    return atan2(cosine, sine) if isinstance(a, Plane) != isinstance(b, Plane) else atan2(sine, cosine)


def slope(of: Line, over: Direction = "x", up: Direction = "z") -> Quantity:
    """How far a line rises, going `over`: −90 to 90 [deg]."""
    rise, run = (dot(of.direction, _constant(direction(way))) for way in (up, over))
    return atan2(rise, run) if float(run) >= 0 else atan2(-rise, -run)


def distance(a: Line | Plane | Circle | Vector, b: Line | Plane | Circle | Vector) -> Quantity:
    """Between two features: points or centres; a point and a line or plane; two lines.

    Of two planes, or of a plane and a line, the distance of the second one's middle from the first.
    """
    if isinstance(b, Plane) and not isinstance(a, Plane):
        a, b = b, a
    apart = difference(_place(b), _place(a))
    if isinstance(a, Plane):
        return abs(dot(apart, a.normal))
    if isinstance(a, Line) and isinstance(b, Line):
        normal = cross(a.direction, b.direction)
        if float(norm(normal)) > 1e-6:
            return abs(dot(apart, normal)) / norm(normal)
    for feature in (a, b):
        if isinstance(feature, Line):
            return norm(cross(apart, feature.direction))
    return norm(apart)


def dot(a: Vector, b: Vector) -> Quantity:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def difference(a: Vector, b: Vector) -> Vector:
    """a − b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def norm(a: Vector) -> Quantity:
    """Euclidean length."""
    return sqrt(dot(a, a))


def _heading(feature: Line | Plane | Direction) -> Vector:
    if isinstance(feature, Line):
        return feature.direction
    return feature.normal if isinstance(feature, Plane) else _constant(direction(feature))


def _place(feature: Line | Plane | Circle | Vector) -> Vector:
    if isinstance(feature, Circle):
        return feature.centre
    return feature.point if isinstance(feature, Line | Plane) else feature


def _constant(vector: Array) -> Vector:
    return (combined(vector[0]), combined(vector[1]), combined(vector[2]))


def _spread(facets: Facets, what: str) -> tuple[Array, Array, Array]:
    """Centroid, variances (3,) ascending, and main axes (3, 3) as columns, signs fixed."""
    size = float(facets.required(f"something to fit {what} to").size.sum())
    if not size > 0:
        raise MeasureError(f"expected something with a size to fit {what} to, got points only")
    middle = (facets.size @ facets.middles) / size
    away = facets.corners - middle
    spread = np.einsum("s,smi,smj->ij", facets.size, away, away) / (size * facets.corners.shape[1])
    spreads, axes = np.linalg.eigh(spread)
    return middle, spreads, axes * np.sign(axes[np.abs(axes).argmax(axis=0), range(3)])


def _centroid(facets: Facets) -> Vector:
    size, count = float(facets.size.sum()), facets.corners.shape[1]
    middle = (facets.size @ facets.middles) / size
    share = np.broadcast_to((facets.size / size / count)[:, None], facets.corners.shape[:2])
    by_size = (facets.middles - middle) / size
    x, y, z = (
        facets.quantity(float(middle[k]), share[..., None] * np.eye(3)[k], by_size[:, k]).collected() for k in range(3)
    )
    return (x, y, z)


def _axis(facets: Facets, spreads: Array, axes: Array, chosen: int) -> Vector:
    """Main axis `chosen` as quantities, by perturbation of the eigenvectors of the spread."""
    count, size = facets.corners.shape[1], float(facets.size.sum())
    own, away = axes[:, chosen], facets.corners - (facets.size @ facets.middles) / size
    others = [k for k in range(3) if k != chosen]
    gaps = spreads[chosen] - spreads[others]
    parts = []
    for component in range(3):
        # d axis = Σ u (uᵀ dC axis) / gap over the other axes u, so that its component is the trace of dC with this
        turn = np.outer(own, (axes[component, others] / gaps) @ axes[:, others].T)
        turn = (turn + turn.T) / 2
        turned = away @ turn
        by_corners = 2 / (size * count) * facets.size[:, None, None] * turned
        by_size = ((turned * away).sum(axis=(1, 2)) / count) / size  # the trace of the turn with the spread is 0
        parts.append(facets.quantity(float(own[component]), by_corners, by_size).collected())
    return (parts[0], parts[1], parts[2])


def _least_circle(points: Array, weights: Array) -> Array:
    """Centre and radius (3,) of least squared distance to (S, 2, 2) points: Kåsa's circle, bettered by Gauss–Newton."""
    flat, weight = points.reshape(-1, 2), np.repeat(weights, points.shape[1])
    middle, size = flat.mean(axis=0), float(np.ptp(flat, axis=0).max())
    if not size > 0:
        raise MeasureError("circle: expected points apart from each other, got them all in one place")
    near = (flat - middle) / size
    root = np.sqrt(weight / weight.sum())[:, None]
    design = np.column_stack([2 * near, np.ones(len(near))])
    solution, _, rank, _ = np.linalg.lstsq(root * design, root[:, 0] * (near**2).sum(axis=1), rcond=1e-9)
    if rank < 3:
        raise MeasureError("circle: expected points on an arc, got them along a line")
    found = np.array([*solution[:2], math.sqrt(solution[2] + float(solution[:2] @ solution[:2]))])
    for _ in range(ROUNDS):
        ray = near - found[:2]
        reach = np.linalg.norm(ray, axis=1)
        slopes = np.column_stack([-ray / np.maximum(reach, 1e-12)[:, None], -np.ones(len(near))])
        step = np.linalg.lstsq(root * slopes, -root[:, 0] * (reach - found[2]), rcond=1e-12)[0]
        found = found + step
        if np.abs(step).max() < 1e-13:
            break
    if not (np.isfinite(found).all() and 0 < found[2] < 1e3):
        raise MeasureError("circle: expected points on an arc, got them along a line")
    return np.asarray(np.append(middle + size * found[:2], size * found[2]))


def _circle(facets: Facets, across: Array, centre: Array, radius: float) -> Circle:
    """The circle as quantities: the implicit function theorem on ∂F/∂(centre, radius) = 0."""
    plane = np.cross(across[0], across[1])
    count = facets.corners.shape[1]
    weight = (facets.size / count)[:, None]
    ray = facets.corners @ across.T - centre
    reach = np.linalg.norm(ray, axis=-1)
    unit, off = ray / reach[..., None], reach - radius
    # H = ∂²F/∂c² per point = u uᵀ + (off / reach) (1 − u uᵀ); the mixed derivative by the point is its negative
    outer = unit[..., :, None] * unit[..., None, :]
    bend = outer + (off / reach)[..., None, None] * (np.eye(2) - outer)
    second = np.zeros((3, 3))
    second[:2, :2] = (weight[..., None, None] * bend).sum(axis=(0, 1))
    second[:2, 2] = second[2, :2] = (weight[..., None] * unit).sum(axis=(0, 1))
    second[2, 2] = count * weight.sum()
    by_point = np.concatenate([bend, unit[..., None, :]], axis=-2) * weight[..., None, None]  # (S, 2, 3, 2)
    by_size = (off[..., None] * np.concatenate([unit, np.ones((*unit.shape[:2], 1))], axis=-1)).sum(axis=1) / count
    if np.linalg.cond(second / second[2, 2]) > 1e12:
        raise MeasureError("circle: expected points on an arc, got them along a line")
    inverse = np.linalg.inv(second)
    corner_slopes, size_slopes = np.einsum("ab,smbi->asmi", inverse, by_point), np.einsum("ab,sb->as", inverse, by_size)
    values = (*centre, radius)
    first, last, size = (
        facets.quantity(float(values[k]), corner_slopes[k] @ across, size_slopes[k]).collected() for k in range(3)
    )
    level = facets.quantity(  # along the axis, where a section lies and triangles have their mean
        float((facets.corners @ plane).mean()),
        np.broadcast_to(plane / facets.corners[..., 0].size, facets.corners.shape),
    ).collected()
    x, y, z = (first * across[0, k] + last * across[1, k] + level * plane[k] for k in range(3))
    rms = math.sqrt(float((weight * off**2).sum() / (count * weight.sum())))
    return Circle((x, y, z), size, rms, facets)


def _agreeing(
    facets: Facets,
    needs: int,
    through: Callable[[Array], Array],
    distances: Callable[[Array, Array], Array],
    least: Callable[[Facets], Array],
    within: float,
    what: str,
) -> Facets:
    """The facets near the feature that most of their size is near: by consensus, then by fitting and choosing anew."""
    if not (isinstance(within, float | int | np.number) and within > 0):
        raise InputError(f"within: expected a distance above 0, got {within!r:.100}")
    facets.required(f"something to fit {what} to")
    grid = TIE * max(float(np.ptp(facets.corners[..., k])) for k in range(3)) + np.finfo(float).tiny
    facets = facets.where(np.lexsort(np.rint(facets.middles / grid).T))  # whatever the order of the mesh's faces
    passed = np.cumsum(facets.size)
    spread = np.unique(np.searchsorted(passed, passed[-1] * (np.arange(SEEDS[needs]) + 0.5) / SEEDS[needs]))
    if len(spread) < needs:
        return facets  # too few to disagree
    picked = facets.middles[np.array(list(combinations(spread, needs)))]
    features = through(picked)
    features = features[np.isfinite(features).all(axis=1)]
    if not len(features):
        raise MeasureError(f"expected places that determine {what}, got none")
    portion = max(1, CHUNK // len(facets))
    votes = np.concatenate(
        [
            (distances(features[i : i + portion], facets.middles) <= within) @ facets.size
            for i in range(0, len(features), portion)
        ]
    )
    kept = distances(features[[votes.argmax()]], facets.middles)[0] <= within
    for _ in range(ROUNDS):
        before, kept = kept, distances(least(facets.where(kept))[None], facets.middles)[0] <= within
        if np.array_equal(kept, before):
            break
        if not kept.any():
            raise MeasureError(
                f"expected {what} within {within:.6g} of what it is fitted to, got parts that agree on none: too "
                "rough, too coarse, or bent"
            )
    return facets.where(kept)


def _least_line(facets: Facets) -> Array:
    middle, _, axes = _spread(facets, "a line")
    return np.concatenate([middle, axes[:, 2]])


def _least_plane(facets: Facets) -> Array:
    middle, _, axes = _spread(facets, "a plane")
    return np.concatenate([middle, axes[:, 0]])


def _line_through(points: Array) -> Array:
    along = points[:, 1] - points[:, 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.concatenate([points[:, 0], along / np.linalg.norm(along, axis=1, keepdims=True)], axis=1)


def _line_distances(lines: Array, points: Array) -> Array:
    away = points[None] - lines[:, None, :3]
    return np.asarray(
        np.linalg.norm(away - (away * lines[:, None, 3:]).sum(-1, keepdims=True) * lines[:, None, 3:], axis=-1)
    )


def _plane_through(points: Array) -> Array:
    normals = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.concatenate([points[:, 0], normals / np.linalg.norm(normals, axis=1, keepdims=True)], axis=1)


def _plane_distances(planes: Array, points: Array) -> Array:
    return np.asarray(np.abs(points @ planes[:, 3:].T - (planes[:, :3] * planes[:, 3:]).sum(axis=1)).T)


def _circles_through(points: Array) -> Array:
    """Centre and radius (M, 3) of the circles through three points each (M, 3, 2)."""
    a, b = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    twice = 2 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    aa, bb = (a**2).sum(axis=1), (b**2).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = np.stack([b[:, 1] * aa - a[:, 1] * bb, a[:, 0] * bb - b[:, 0] * aa], axis=1) / twice[:, None]
    return np.column_stack([points[:, 0] + centre, np.linalg.norm(centre, axis=1)])
