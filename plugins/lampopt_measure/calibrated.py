"""Direct measurements mapped onto labelled parameters, on exemplars of which both are known (paper, appendix H).

A data set's "car length" may be a change from a base car; the wheelbase of a mesh can be measured. What leads from one
to the other is a straight line, fitted on the exemplars and judged by leaving each of them out.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError, MeasureError
from lampopt.measured import resolve_address, values_of
from lampopt.metrics import conformal_quantile, twins
from lampopt.protocols import Gradient, Measure
from lampopt.types import Array, frozen_array

if TYPE_CHECKING:
    from trimesh import Trimesh

SINGLE = 1e-6  # of a measured value: rounding of single precision
BEYOND = 0.1  # of the exemplars' spread, how far past them a measured value may lie before it counts as outside


@dataclass(frozen=True)
class Calibrated:
    """Fits each asked value as ``intercept + Σ slope × measured value``, by least squares.

    Parameters
    ----------
    by
        What is measured: addresses `measure.value`, separated by commas.
    """

    by: str = "extents.length"

    def __post_init__(self) -> None:
        if not self.addresses or len(set(self.addresses)) < len(self.addresses):
            raise InputError(
                f"calibrated: by: expected addresses such as 'wheels.wheelbase', each once, got {self.by!r}"
            )

    @property
    def addresses(self) -> tuple[str, ...]:
        """What is measured."""
        return tuple(part.strip() for part in self.by.split(",") if part.strip())

    def fit(
        self, meshes: Sequence[Trimesh], values: Array, names: Sequence[str], units: Sequence[str], *, seed: int
    ) -> CalibratedMeasure:
        """Calibrate on n meshes with values (n, p), NaN where one is not known; `seed` is not used: nothing is drawn.

        Raises
        ------
        InputError
            If values, names and units do not go together, there are too few exemplars for the line, or what is measured
            or asked for does not vary over them.
        MeasureError
            If a feature is not there, naming the mesh's place in `meshes`.
        """
        values = frozen_array(values, "calibrated: values", (len(meshes), len(names)), nan=True)
        if not len(names) == len(units) == len(set(names)) > 0:
            raise InputError(f"calibrated: expected names, each once, and as many units, got {names} and {units}")
        gauge = Gauge(self.addresses)
        measured = np.array([gauge.at(mesh, f"calibrated: mesh {i}") for i, mesh in enumerate(meshes)])
        lines, left_out = [], np.full(values.shape, np.nan)
        for column, name in enumerate(names):
            known = np.isfinite(values[:, column])
            line, left_out[known, column] = _line(measured[known], values[known, column], name, self.addresses)
            lines.append(line)
        return CalibratedMeasure(
            names=tuple(names),
            units=tuple(units),
            addresses=self.addresses,
            lines=np.array(lines),
            left_out=left_out,
            values=values,
            measured=measured,
        )


def _line(measured: Array, values: Array, name: str, addresses: Sequence[str]) -> tuple[Array, Array]:
    """(1 + k,) intercept and slopes; each exemplar's error (n,) by the line through all that are not its twins."""
    k = measured.shape[1]
    still = np.ptp(measured, axis=0) <= SINGLE * np.abs(measured).max(0) if len(measured) > 1 else np.zeros(k, bool)
    if still.any():
        same = ", ".join(address for address, one in zip(addresses, still, strict=True) if one)
        raise InputError(f"calibrated: {same}: the same on all exemplars, {name} cannot be told from it")
    group = _groups(measured) if len(measured) else np.empty(0, int)
    if (n := len({*group})) < k + 2:
        raise InputError(f"calibrated: {name}: expected at least {k + 2} exemplars with a value, got {n}")
    size = float(np.abs(values).max())
    if not 1e-100 < size < 1e100 or np.ptp(values) <= 1e-12 * size:
        raise InputError(
            f"calibrated: {name}: expected values that vary, of a size that computers hold, got {values[:3]} ..."
        )
    middle, spread = measured.mean(0), np.ptp(measured, axis=0)
    design = np.column_stack([np.ones(len(measured)), (measured - middle) / spread])
    q, r = np.linalg.qr(design)
    if np.abs(np.diag(r)).min() < 1e-9 * np.abs(np.diag(r)).max():
        raise InputError(f"calibrated: {', '.join(addresses)}: depend on each other over the exemplars, leave one out")
    found = np.linalg.solve(r, q.T @ values)
    slopes, missed = found[1:] / spread, values - design @ found
    for rows in (np.flatnonzero(group == one) for one in {*group}):
        missed[rows] = np.linalg.solve((1 + 1e-9) * np.eye(len(rows)) - q[rows] @ q[rows].T, missed[rows])
    return np.r_[found[0] - middle @ slopes, slopes], missed


def _groups(measured: Array) -> Array:
    """(n,) the number of the group of each row: of one shape that was given more than once there is one."""
    spread = np.ptp(measured, axis=0)
    return twins(measured / np.where(spread > 0, spread, 1.0), SINGLE)


@dataclass(frozen=True)
class Gauge:
    """The values at `addresses`, each measure called once a mesh."""

    addresses: tuple[str, ...]

    @cached_property
    def parts(self) -> list[tuple[str, Measure, int]]:
        """Name, measure and place of each value, found when first asked for."""
        from lampopt.plugins import Plugins

        plugins = Plugins.load()
        return [resolve_address(address, plugins) for address in self.addresses]

    def at(self, mesh: Trimesh, whose: str = "calibrated") -> Array:
        """(k,) measured on `mesh`. Raises MeasureError saying `whose` feature is not there."""
        known: dict[str, Array] = {}
        for name, measure, _ in self.parts:
            if name not in known:
                try:
                    known[name] = values_of(name, measure, mesh)
                except MeasureError as error:
                    raise MeasureError(f"{whose}: {name}: {error}") from error
        found = np.array([known[name][place] for name, _, place in self.parts])
        if not np.isfinite(found).all():
            raise MeasureError(f"{whose}: expected finite values of {', '.join(self.addresses)}, got {found}")
        return found

    def gradient(self, mesh: Trimesh) -> Array:
        """(k, V, 3). Raises MeasureError where a measure has none."""
        known: dict[str, Array] = {}
        for name, measure, _ in self.parts:
            if not isinstance(measure, Gradient):
                raise MeasureError(f"calibrated: measure {name!r} has no gradient")
            if name not in known:
                known[name] = np.asarray(measure.gradient(mesh), float)
        return np.array([known[name][place] for name, _, place in self.parts])


@dataclass(frozen=True, eq=False)
class CalibratedMeasure:
    """What `Calibrated` fitted.

    Parameters
    ----------
    names, units
        (p,) as asked for.
    addresses
        (k,) what is measured.
    lines
        (p, 1 + k) intercept and slopes.
    left_out
        (n, p) each exemplar's error by the line through the others; NaN where it has no value.
    values
        (n, p) what the exemplars have.
    measured
        (n, k) what was measured on them.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    addresses: tuple[str, ...]
    lines: Array
    left_out: Array
    values: Array
    measured: Array

    def __post_init__(self) -> None:
        texts = (self.names, self.units, self.addresses)
        if not all(isinstance(text, str) and text.isprintable() for part in texts for text in part):
            raise InputError(f"calibrated: expected names, units and addresses as texts, got {texts!r:.200}")
        n, p, k = len(self.values), len(self.names), len(self.addresses)
        if not (len(self.units) == p > 0 and k > 0 and n > 1):
            raise InputError(f"calibrated: expected as many units as names, an address, exemplars, got {texts!r:.200}")
        shapes = {"lines": (p, 1 + k), "measured": (n, k), "values": (n, p), "left_out": (n, p)}
        for name, shape in shapes.items():
            gaps = name in ("values", "left_out")
            object.__setattr__(self, name, frozen_array(getattr(self, name), f"calibrated: {name}", shape, nan=gaps))
        if (np.isfinite(self.left_out).sum(0) < 2).any() or (np.isnan(self.values) & ~np.isnan(self.left_out)).any():
            raise InputError("calibrated: expected the errors of at least two exemplars that have a value")

    def __call__(self, mesh: Trimesh) -> Array:
        """Values (p,). Raises MeasureError where what is measured is not there."""
        self._with_faces(mesh)
        return np.asarray(self.lines[:, 0] + self.lines[:, 1:] @ self._gauge.at(mesh))

    def gradient(self, mesh: Trimesh) -> Array:
        """(p, V, 3). Raises MeasureError where what is measured has none."""
        return np.asarray(np.einsum("pk,kvc->pvc", self.lines[:, 1:], self._gauge.gradient(mesh)))

    def interval(self, mesh: Trimesh, level: float) -> Array:
        """(p, 2) low and high that hold the true value of a share `level` of shapes like the exemplars.

        The conformal quantile of the errors by leaving one out, infinite where there are too few exemplars to promise
        that: 0.9 needs nine. Raises InputError for a level that is none.
        """
        half = [conformal_quantile(self._by_shape(errors), level) for errors in self.left_out.T]
        return np.asarray(self(mesh)[:, None] + np.array(half)[:, None] * (-1.0, 1.0))

    def _by_shape(self, errors: Array) -> Array:
        """The largest of the errors (n,) of each shape that has one."""
        known = np.isfinite(errors)
        group, sizes = _groups(self.measured[known]), np.abs(errors[known])
        return np.array([sizes[group == one].max() for one in {*group}])

    def outside(self, mesh: Trimesh) -> bool:
        """Whether a measured value lies more than a tenth of their spread beyond the exemplars of one of the lines.

        Or beyond how they go together: where its leverage on the line is more than that of all of them, by as much.
        """
        found = self._gauge.at(mesh)
        for errors in self.left_out.T:
            known = self.measured[np.isfinite(errors)]
            low, high = known.min(0), known.max(0)
            room = BEYOND * (high - low)
            if ((found < low - room) | (found > high + room)).any():
                return True
            rows = (np.vstack([known, found]) - known.mean(0)) / (high - low)
            spread = np.linalg.lstsq(rows[:-1].T @ rows[:-1], rows.T, rcond=None)[0]
            leverage = np.einsum("nk,kn->n", rows, spread)
            if leverage[-1] > (1 + 2 * BEYOND) ** 2 * leverage[:-1].max():
                return True
        return False

    @property
    def mean_absolute_error(self) -> Array:
        """(p,) by leaving each exemplar out [units]."""
        return np.asarray(np.nanmean(np.abs(self.left_out), axis=0))

    @property
    def r2(self) -> Array:
        """(p,) by leaving each exemplar out."""
        known = np.isfinite(self.left_out)
        spread = np.nansum((np.where(known, self.values, np.nan) - np.nanmean(self.values, axis=0)) ** 2, axis=0)
        return np.asarray(1 - np.nansum(self.left_out**2, axis=0) / np.where(spread > 0, spread, np.nan))

    @property
    def cross_validated(self) -> dict[str, dict[str, float]]:
        """`r2` and `mean_absolute_error` by name."""
        rows = zip(self.names, self.r2.tolist(), self.mean_absolute_error.tolist(), strict=True)
        return {name: {"r2": r2, "mean_absolute_error": error} for name, r2, error in rows}

    def state(self) -> Mapping[str, Array]:
        """The arrays; the texts as JSON in bytes."""
        texts = json.dumps([self.names, self.units, self.addresses]).encode()
        return {
            "texts": np.frombuffer(texts, np.uint8),
            "lines": self.lines,
            "left_out": self.left_out,
            "values": self.values,
            "measured": self.measured,
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Array]) -> CalibratedMeasure:
        """The measure again."""
        names, units, addresses = (tuple(part) for part in json.loads(np.asarray(state["texts"]).tobytes()))
        rest = {name: state[name] for name in ("lines", "left_out", "values", "measured")}
        return cls(names=names, units=units, addresses=addresses, **rest)

    @cached_property
    def _gauge(self) -> Gauge:
        return Gauge(self.addresses)

    @staticmethod
    def _with_faces(mesh: Trimesh) -> None:
        if len(mesh.faces) == 0:
            raise MeasureError("calibrated: expected a mesh with faces, got none")
