"""Which shapes of a family face another way than the others: turned by 180°, or lying on another axis."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import permutations, product
from typing import TYPE_CHECKING

import numpy as np

from lampopt.types import Array

if TYPE_CHECKING:
    from trimesh import Trimesh

UNLIKE = 2.5  # times as far from its fellows as is usual, from which on a pose is suspicious
BETTER = 0.5  # part of its distance that another pose must reach
NO_WORSE = 0.005, 0.02  # distances [extents], [diagonal] up to which a pose is as good as any
NEAREST = 0.25  # share of the fellows that a shape has to be near to
SOME = 16  # fellows that it is held against

Surface = tuple[Array, Array]  # vertices about the centre in parts of the extents, faces


def facing(points: Array, extents: Array, mesh_of: Callable[[int], Trimesh]) -> Iterator[tuple[int, str]]:
    """Which shapes face another way, and how to turn each: (index, "180° about z").

    First every shape is held against the one in the middle: that with the least median distance to all. Those that are
    much farther from it than is usual, and much nearer in another pose, are then held against some of their fellows: a
    shape at the end of the family's range has a quarter of these near it as it is; one that is turned has not.

    For half turns every shape is stretched to the same extents first, so that only its form counts; for quarter turns
    its proportions count too. A turn that leaves a shape as it is brings it no nearer: symmetric shapes are never odd.

    Parameters
    ----------
    points
        (N, n, 3) points on each surface, about the centre, in parts of the extents.
    extents
        (N, 3) of the shapes [unit], positive.
    mesh_of
        Gives one mesh by its index.
    """

    def surface(i: int) -> Surface:
        mesh = mesh_of(i)
        middle = (mesh.bounds[0] + mesh.bounds[1]) / 2
        return (np.asarray(mesh.vertices, float) - middle) / extents[i], np.ascontiguousarray(mesh.faces, np.int64)

    fellows = np.unique(np.linspace(0, len(points) - 1, SOME).astype(int))
    middle = _middle(points, fellows)
    base = surface(middle)
    others = np.delete(np.arange(len(points)), middle)
    half = [(name, turn) for name, turn in _poses() if np.abs(np.diag(turn)).all()]
    lying = [(name, turn) for name, turn in _poses() if not np.abs(np.diag(turn)).all()]
    scales = extents / np.linalg.norm(extents, axis=1, keepdims=True)
    told: set[int] = set()
    for stretch, turns, least in ((np.ones_like(scales), half, NO_WORSE[0]), (scales, lying, NO_WORSE[1])):
        clouds = points * stretch[:, None]
        given = _distances(base, stretch[middle], clouds)
        far = given > max(UNLIKE * float(np.median(given[others])), least)
        suspects: list[tuple[int, str, Array]] = []
        for i in np.flatnonzero(far).tolist():
            poses = np.stack([clouds[i] @ turn.T for _, turn in turns])
            turned = _distances(base, stretch[middle], poses)
            best = int(turned.argmin())
            if i not in told and turned[best] < BETTER * given[i]:
                suspects.append((i, turns[best][0], poses[best]))
        for i, name in _confirmed(suspects, clouds, stretch, fellows, surface):
            told.add(i)
            yield i, name


def _middle(points: Array, candidates: Array) -> int:
    """The candidate with the least median distance to all."""
    from scipy.spatial import KDTree

    spread = [[float(tree.query(cloud)[0].mean()) for cloud in points] for tree in map(KDTree, points[candidates])]
    return int(candidates[np.median(spread, axis=1).argmin()])


def _confirmed(
    suspects: list[tuple[int, str, Array]],
    clouds: Array,
    stretch: Array,
    fellows: Array,
    surface: Callable[[int], Surface],
) -> Iterator[tuple[int, str]]:
    """Those of the suspects (index, pose, cloud in that pose) that have no fellows near them as they are."""
    if not suspects:
        return
    odd = [i for i, _, _ in suspects]
    asked = np.concatenate([clouds[fellows], clouds[odd], np.stack([cloud for _, _, cloud in suspects])])
    away = np.stack([_distances(surface(k), stretch[k], asked) for k in fellows.tolist()], 1)
    away[np.append(np.r_[fellows, odd], odd)[:, None] == fellows] = np.inf  # nobody is a fellow of his own
    near = np.sort(away, axis=1)[:, int(np.ceil(NEAREST * (len(fellows) - 2)))]
    usual, given, turned = np.split(near, [len(fellows), len(fellows) + len(odd)])
    for (i, name, _), now, then in zip(suspects, given, turned, strict=True):
        if now > UNLIKE * np.median(usual) and then < BETTER * now:
            yield i, name


def _distances(surface: Surface, stretch: Array, clouds: Array) -> Array:
    """Mean distances (k,) of clouds (k, n, 3) to a surface that is stretched."""
    import igl

    flat = np.ascontiguousarray(clouds.reshape(-1, 3), float)
    squared = igl.point_mesh_squared_distance(flat, np.ascontiguousarray(surface[0] * stretch), surface[1])[0]
    return np.asarray(np.sqrt(squared).reshape(clouds.shape[:2]).mean(1))


def _poses() -> list[tuple[str, Array]]:
    """The 23 turns of a cube onto itself, by name: (name, rotation (3, 3))."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.zeros((3, 3))
        turn[range(3), order] = signs
        if np.linalg.det(turn) > 0 and not np.array_equal(turn, np.eye(3)):
            found.append((_name(turn), turn))
    return found


def _name(turn: Array) -> str:
    """A turn as a person does it: "90° about x", "180° about z", "120° about (1, 1, -1)"."""
    angle = round(np.degrees(np.arccos((np.trace(turn) - 1) / 2)))
    if angle == 180:
        axis = (turn + np.eye(3))[:, np.argmax(np.diag(turn))]
    else:
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    axis = np.sign(np.round(axis, 6)).astype(int)
    if np.abs(axis).sum() == 1:
        k = int(np.abs(axis).argmax())
        return f"{angle * axis[k]}° about {'xyz'[k]}"
    return f"{angle}° about ({', '.join(map(str, axis))})"
