"""How points move when a design does: space along with it, its vertices by each parameter.

For decoders that keep one connectivity and move a template (`Displace`), so that a solver's mesh, a load or a name of a
boundary goes along with the design.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lampopt.bank import decoder_of
from lampopt.decode import decode
from lampopt.errors import InputError, PluginError
from lampopt.mix import mixed_weights, predicted
from lampopt.plugins import Plugins, returned
from lampopt.protocols import Decoder, Displace, Solver
from lampopt.reading import path_of
from lampopt.solve import columns, pose, solve
from lampopt.types import Array, Bank, Design, Spec

if TYPE_CHECKING:
    from trimesh import Trimesh

log = logging.getLogger("lampopt")
STEP = 0.1  # of a parameter's range, to either side: exact where vertices are linear in weights
ROUNDS = 60  # of the search for where a point comes from
FOUND = 1e-9  # how near it has to come [box]
HALVED = 8  # times at most that a step of the search is, until it helps
HELD = 1e-3  # of a step: what moves by less is held
SMALL = 1e-6  # step of the motion's derivative [box]


def warp(
    bank: Bank, design: Design, points: Array, *, start: Design | None = None, plugins: Plugins | None = None
) -> Array:
    """Points that move along with a design: a volume mesh around it, a finer tessellation of it.

    Parameters
    ----------
    bank
        Of a decoder that can displace space, such as `mesh-template`.
    design
        Where they go.
    points
        (M, 3) [user's unit], in the space about `start`.
    start
        The design that they belong to; by default the decoder's template (weights of 0, see `template_of`).

    Returns
    -------
    Array
        (M, 3) moved points [user's unit].

    Raises
    ------
    PluginError
        If the bank's decoder cannot displace space.
    InputError
        If `points` are none, or `start` folds space so that it cannot be told where they come from.
    """
    _design(design, "design")
    found: Decoder = decoder_of(bank, plugins or Plugins.load().report())
    if not isinstance(found, Displace):
        raise PluginError(
            f"decoder {bank.decoder.name!r}: cannot displace space, which warp needs: build the bank with "
            "'mesh-template'"
        )
    moving: Displace = found
    given = _points(points)

    def displaced(weights: Array, at: Array) -> Array:
        answer = moving.displace(bank.shared, weights, at)
        return returned(f"decoder {bank.decoder.name!r}: displace", answer, (len(at), 3))

    here = (given - bank.frame.centre) * bank.frame.scale
    rest = here
    if start is not None:
        still = (np.asarray(template_of(bank, plugins=plugins).vertices) - bank.frame.centre) * bank.frame.scale
        rest = _origin(lambda x: displaced(_design(start, "start").weights, x), here, still)
    return np.asarray(given + (displaced(design.weights, rest) - here) / bank.frame.scale)  # what stays, stays exactly


def template_of(bank: Bank, *, plugins: Plugins | None = None) -> Trimesh:
    """The mesh that a template decoder moves [user's unit], at rest: what `warp` starts from."""
    decoder = decoder_of(bank, plugins or Plugins.load().report())
    if not isinstance(decoder, Displace):
        raise PluginError(f"decoder {bank.decoder.name!r}: has no template to be displaced")
    return decode(bank, decoder, np.zeros(bank.weights.shape[1], np.float32))


def _design(given: object, what: str) -> Design:
    if not isinstance(given, Design):
        raise InputError(f"{what}: expected a Design, such as result.design, got {type(given).__name__}")
    return given


def _points(given: object) -> Array:
    try:
        points = np.asarray(given, float)
    except (TypeError, ValueError) as error:
        raise InputError(f"points: expected numbers of shape (M, 3), got {given!r:.80}") from error
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points: expected numbers of shape (M, 3), got shape {points.shape}")
    if not np.isfinite(points).all():
        raise InputError(
            f"points: expected finite numbers, got others in {int((~np.isfinite(points)).any(1).sum())} rows"
        )
    return points


def _origin(moved: Callable[[Array], Array], wanted: Array, still: Array) -> Array:
    """Which points are moved to `wanted` (M, 3): Newton's steps from where the nearest of points `still` comes from."""
    from scipy.spatial import cKDTree

    there = moved(still)
    at: Array = wanted - (there - still)[cKDTree(there).query(wanted)[1]]
    off = wanted - moved(at)
    for _ in range(ROUNDS):
        left = _unmet(off)
        if not len(left):
            break
        here, gap = at[left], off[left]
        ends = [moved(here + sign * SMALL * way) for way in np.eye(3) for sign in (1, -1)]
        slope = np.stack([(one - other) / (2 * SMALL) for one, other in zip(ends[::2], ends[1::2], strict=True)], -1)
        step = np.einsum("mij,mj->mi", np.linalg.pinv(slope), gap)
        for _ in range(HALVED):
            worse = np.linalg.norm(wanted[left] - moved(here + step), axis=1) > np.linalg.norm(gap, axis=1)
            if not worse.any():
                break
            step[worse] /= 2
        at[left] = here + step
        off[left] = wanted[left] - moved(at[left])
    if len(left := _unmet(off)):
        raise InputError(
            f"start: for {len(left)} of {len(wanted)} points, such as number {left[0]}, it cannot be told where its "
            "motion brings them from: it folds space there, or nothing comes to lie there; begin from a design nearer "
            "to the template"
        )
    return at


def _unmet(off: Array) -> Array:
    """Which of the points are still `off` (M, 3)."""
    return np.flatnonzero(np.abs(off).max(1, initial=0.0) > FOUND)


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """How a design's vertices move by each parameter, all others held.

    `names` and `units` of the k parameters; `mesh` of the design [user's unit]; `motion` (k, V, 3) [user's unit by the
    parameter's unit]; `steps` (k,) how far each parameter was moved to either side.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    mesh: Trimesh
    motion: Array
    steps: Array

    def of(self, name: str) -> Array:
        """(V, 3) motion by one parameter."""
        if name not in self.names:
            raise InputError(f"{name!r}: expected one of {', '.join(self.names)}")
        return np.asarray(self.motion[self.names.index(name)])

    def picture(self, name: str, path: str | Path, *, width: int = 900) -> None:
        """Write a picture of the design, red where it grows with the parameter, blue where it shrinks (PNG)."""
        from lampopt.reporting.render import saved

        motion = self.of(name)
        step = float(self.steps[self.names.index(name)])
        low, high = (self._moved(sign * step * motion) for sign in (-1, 1))
        saved(high, low, path_of(path, "path"), width=width)

    def _moved(self, by: Array) -> Trimesh:
        mesh = self.mesh.copy()
        mesh.vertices = np.asarray(mesh.vertices) + by
        return mesh


def sensitivities(
    bank: Bank,
    design: Design,
    names: Sequence[str] | None = None,
    *,
    solver: str | Spec = "kkt",
    plugins: Plugins | None = None,
) -> Sensitivities:
    """How the vertices of `design` move by each parameter: d(vertices)/d(parameter), the other parameters held.

    Parameters
    ----------
    names
        Parameters; by default all that differ over the bank.
    solver
        What chooses the mixes on either side.

    Raises
    ------
    PluginError
        If the decoder makes another triangulation for each design.
    InputError
        If a name is no parameter that differs over the bank.
    """
    _design(design, "design")
    if isinstance(names, str):
        raise InputError(f"names: expected a list of names, got {names!r}")
    plugins = plugins or Plugins.load().report()
    decoder, chosen = decoder_of(bank, plugins), columns(bank)
    free = {q.name: q for q in bank.space if q.spread > 0}
    wanted = tuple(free) if names is None else tuple(names)
    if unknown := [name for name in wanted if name not in free]:
        raise InputError(f"names: {', '.join(map(repr, unknown))}: expected some of {', '.join(free)}")
    at = {q.name: float(v) for q, v in zip(bank.space, design.predicted, strict=True) if q.name in free}
    solving: Solver = plugins.make("solver", solver)
    mesh = decode(bank, decoder, design.weights)

    def asked(target: dict[str, float]) -> Array:
        posed = pose(bank, target)
        mix = solve(posed, solving)
        wide = {name: float(np.ptp(chosen[name].values)) for name in target}
        reached = {q.name: float(v) for q, v in zip(bank.space, predicted(bank, mix.alpha), strict=True)}
        off.update(name for name in target if abs(reached[name] - target[name]) > HELD * STEP * wide[name])
        return mix.alpha

    def vertices(alpha: Array) -> Array:
        made = decode(bank, decoder, mixed_weights(bank, alpha))
        if not np.array_equal(made.faces, mesh.faces):
            raise PluginError(
                f"decoder {bank.decoder.name!r}: makes another triangulation for each design, so that vertices do not "
                "move: build the bank with 'mesh-template'"
            )
        return np.asarray(made.vertices, float)

    motion, steps = [], []
    off = set[str]()
    for name in wanted:
        step, off = STEP * float(np.ptp(chosen[name].values)), set[str]()
        more, less = (asked({**at, name: at[name] + sign * step}) for sign in (1, -1))
        # About the design's own mix: another with the same parameters may move otherwise.
        ahead, behind = (vertices(design.mix.alpha + sign * (more - less) / 2) for sign in (1, -1))
        if off:
            log.warning(
                "sensitivities: no mix of these exemplars changes %s alone: %s cannot be as asked, so that the motion "
                "by %s is not by it alone", name, ", ".join(sorted(off)), name
            )  # fmt: skip
        motion.append((ahead - behind) / (2 * step))
        steps.append(step)
    return Sensitivities(wanted, tuple(free[name].unit for name in wanted), mesh, np.array(motion), np.array(steps))
