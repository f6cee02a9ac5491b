"""Tiny exact solids to fit, measure and compare. Closed, faces outward."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from trimesh import Trimesh


def box(extents: npt.ArrayLike = (1.0, 0.5, 0.4), *, centre: npt.ArrayLike = (0, 0, 0), divisions: int = 2) -> Trimesh:
    """A box with `extents` (3,) about `centre`, its 12 triangles split `divisions` times into four."""
    from trimesh import creation

    solid: Trimesh = creation.box(np.asarray(extents, float))
    for _ in range(divisions):
        solid = solid.subdivide()
    solid.apply_translation(np.asarray(centre, float))
    return solid


def ellipsoid(
    radii: npt.ArrayLike = (0.5, 0.3, 0.25), *, centre: npt.ArrayLike = (0, 0, 0), divisions: int = 2
) -> Trimesh:
    """An icosphere with vertices on the ellipsoid with `radii` (3,); its volume stays a little below 4/3·π·r₁r₂r₃."""
    from trimesh import creation

    solid: Trimesh = creation.icosphere(subdivisions=divisions)
    solid.apply_transform(np.diag([*np.asarray(radii, float), 1.0]))
    solid.apply_translation(np.asarray(centre, float))
    return solid


def plate_with_hole(extents: npt.ArrayLike = (1.0, 0.6, 0.1), radius: float = 0.15, *, sections: int = 32) -> Trimesh:
    """A plate about the origin with a round hole along z, exact but for the hole's `sections` flats (corners on it).

    Volume: length · width · height − sections/2 · radius² · sin(2π/sections) · height.
    """
    from trimesh import Trimesh

    x, y, z = np.asarray(extents, float) / 2
    angle = 2 * np.pi * np.arange(sections) / sections
    hole = radius * np.stack([np.cos(angle), np.sin(angle)], 1)
    # rays through the hole's corners meet the rim; the plate's own corners come in between
    ways = np.unique(np.concatenate([angle, np.arctan2([y, y, -y, -y], [x, -x, -x, x]) % (2 * np.pi)]).round(12))
    unit = np.stack([np.cos(ways), np.sin(ways)], 1)
    rim = unit / np.max(np.abs(unit) / [x, y], axis=1, keepdims=True)
    inner = np.searchsorted(angle, ways + 1e-9, side="right") - 1  # the last corner of the hole passed so far
    n, m = len(rim), sections
    level = [np.column_stack([part, np.full(len(part), h)]) for h in (z, -z) for part in (rim, hole)]
    top, bottom = 0, n + m
    faces: list[tuple[int, int, int]] = []
    for i in range(n):
        j, a, b = (i + 1) % n, n + inner[i], n + inner[(i + 1) % n]
        ring = [(a, i, j)] + ([(a, j, b)] if a != b else [])
        faces += [(p + top, q + top, r + top) for p, q, r in ring]
        faces += [(p + bottom, r + bottom, q + bottom) for p, q, r in ring]
        faces += [(i, i + bottom, j), (j, i + bottom, j + bottom)]
    for i in range(m):
        a, b = n + i, n + (i + 1) % m
        faces += [(a, b, a + bottom), (b, b + bottom, a + bottom)]
    return Trimesh(np.concatenate(level), np.array(faces), process=False)
