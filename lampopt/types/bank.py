"""What is known before anything is asked: parameters, exemplars, the bank fitted to them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lampopt.errors import InputError
from lampopt.types.arrays import (
    ROUNDING,
    Array,
    Table,
    assign,
    frozen_array,
    frozen_arrays,
    normalisable,
    tuple_of,
    unique,
    whole,
)
from lampopt.types.calibration import Calibration
from lampopt.types.lowrank import LowRank

if TYPE_CHECKING:
    from trimesh import Trimesh

Scalar = str | int | float | bool


def _real(value: object) -> bool:
    """Whether `value` is one real number, Python's or numpy's."""
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


@dataclass(frozen=True)
class Parameter:
    """A named quantity with its unit ("" = dimensionless); in a bank also its range `low` to `high`."""

    name: str
    unit: str = ""
    low: float | None = None
    high: float | None = None

    def __post_init__(self) -> None:
        if not (isinstance(self.name, str) and isinstance(self.unit, str)):
            raise InputError(f"parameter: expected texts as name and unit, got {self.name!r} and {self.unit!r}")
        whole(self.name, "parameter name")
        whole(self.unit, f"unit of {self.name!r}")
        if not self.name or self.name != self.name.strip() or any(c in self.name for c in ".[]=\n"):
            raise InputError(f"parameter name {self.name!r}: expected text without '.', '[', ']', '=' or outer blanks")
        for value in (self.low, self.high):
            if value is not None and not (_real(value) and np.isfinite(value)):
                raise InputError(f"parameter {self.name!r}: expected finite numbers as its range, got {value!r:.200}")
        if self.spread != 0 and not 1e-100 <= self.spread <= 1e101:
            raise InputError(f"parameter {self.name!r}: expected a range that can be normalised, got {self.spread:.3g}")

    def __str__(self) -> str:
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def spread(self) -> float:
        """`high` − `low`; 0 where either is unknown, or where they differ by rounding."""
        if self.low is None or self.high is None:
            return 0.0
        spread = self.high - self.low
        return 0.0 if abs(spread) <= ROUNDING * max(abs(self.low), abs(self.high)) else spread


@dataclass(frozen=True, init=False)
class Spec:
    """A plugin chosen by name, with its options: plain scalars that a file can hold.

    >>> Spec("casadi", ridge=1e-3)
    Spec('casadi', ridge=0.001)
    """

    name: str
    options: Mapping[str, Scalar] = field(hash=False)

    def __init__(self, name: str, /, **options: Scalar) -> None:
        if not isinstance(name, str):
            raise InputError(f"plugin: expected a name, got {name!r}")
        for key, value in options.items():
            if not isinstance(value, (str, int, float, bool)):
                raise InputError(f"option {key!r} of {name!r}: expected text, a number or a truth value, got {value!r}")
        assign(self, name=name, options=Table((key, _native(value)) for key, value in sorted(options.items())))

    def __repr__(self) -> str:
        return f"Spec({', '.join([repr(self.name), *(f'{k}={v!r}' for k, v in self.options.items())])})"

    @classmethod
    def of(cls, choice: str | Spec) -> Spec:
        """`choice` itself, or a name without options."""
        return choice if isinstance(choice, Spec) else cls(choice)


def _native(value: Scalar) -> Scalar:
    """What a subclass, such as numpy's or an enumeration's, stands for."""
    if isinstance(value, str):
        return str.__str__(value)
    if isinstance(value, bool):
        return value
    return int(value) if isinstance(value, int) else float(value)


def _texts(table: object, what: str) -> Table[str]:
    """A read-only table of texts by name."""
    if not isinstance(table, Mapping) or not all(isinstance(v, str) for pair in table.items() for v in pair):
        raise InputError(f"{what}: expected texts such as 'measure.value' by name, got {table!r:.200}")
    return Table(table)


@dataclass(frozen=True, eq=False)
class Exemplars:
    """Meshes with known parameters, before any fitting.

    Parameters
    ----------
    parameters
        (N, d), in the units of `space`.
    space
        The d parameters.
    meshes
        N meshes [unit], a sequence that may load them lazily.
    names
        N distinct names.
    labels, label_space
        (N, p) values known of each exemplar (drag and the like), NaN where unknown.
    unit
        Length unit of the meshes.
    measured
        Which parameter can be measured on a mesh, and how: ``{"length": "extents.length"}``.
    mesh_at
        The true mesh [unit] at any parameters (d,), where the source knows it.
    """

    parameters: Array
    space: tuple[Parameter, ...]
    meshes: Sequence[Trimesh]
    names: tuple[str, ...]
    labels: Array = None  # type: ignore[assignment]  # filled in below, never None afterwards
    label_space: tuple[Parameter, ...] = ()
    unit: str = "m"
    measured: Mapping[str, str] = field(default_factory=dict)
    mesh_at: Callable[[Array], Trimesh] | None = None

    def __post_init__(self) -> None:
        names = tuple_of(str, self.names, "exemplars: names")
        space, label_space = (
            tuple_of(Parameter, getattr(self, name), f"exemplars: {name}") for name in ("space", "label_space")
        )
        n = len(names)
        if n == 0:
            raise InputError("exemplars: expected at least one, got none")
        labels = np.full((n, len(label_space)), np.nan) if self.labels is None else self.labels
        assign(
            self,
            space=space,
            label_space=label_space,
            names=names,
            parameters=frozen_array(self.parameters, "parameters", (n, len(space))),
            labels=frozen_array(labels, "labels", (n, len(label_space)), nan=True),
            measured=_texts(self.measured, "measured"),
        )
        assign(
            self,
            parameters=normalisable(self.parameters, [q.name for q in space], "parameter"),
            labels=normalisable(self.labels, [q.name for q in label_space], "label"),
        )
        if not isinstance(self.unit, str):
            raise InputError(f"unit: expected text such as 'm', got {self.unit!r}")
        if not all(hasattr(self.meshes, ability) for ability in ("__len__", "__getitem__")):
            raise InputError(f"exemplars: expected a sequence of meshes, got {self.meshes!r:.200}")
        if len(self.meshes) != n:
            raise InputError(f"exemplars: expected {n} meshes, one for each name, got {len(self.meshes)}")
        unique(self.names, "exemplar")
        unique([q.name for q in (*self.space, *self.label_space)], "parameter or label")
        unknown = sorted(set(self.measured) - {q.name for q in self.space})
        if unknown:
            raise InputError(f"measured: {unknown} are no parameters; known are {[q.name for q in self.space]}")

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, eq=False)
class Frame:
    """One similarity transform for a whole bank: the user's `unit` to the decoder's box [-1, 1]³ and back.

    A point x [unit] lies at (x − centre) · scale in the box. Scaling mesh by mesh would erase size parameters.
    """

    scale: float
    centre: Array
    unit: str = "m"

    def __post_init__(self) -> None:
        if not (_real(self.scale) and 1e-101 <= self.scale <= 1e101):
            raise InputError(f"frame: expected a positive scale, got {self.scale!r:.200}")
        if not isinstance(self.unit, str):
            raise InputError(f"frame: expected text such as 'm' as its unit, got {self.unit!r:.200}")
        assign(self, scale=float(self.scale), centre=frozen_array(self.centre, "frame centre", (3,)))

    def to_box(self, mesh: Trimesh) -> Trimesh:
        """A copy of `mesh` [unit] in the decoder's box."""
        moved = mesh.copy()
        moved.vertices = (np.asarray(mesh.vertices) - self.centre) * self.scale
        return moved

    def to_user(self, mesh: Trimesh) -> Trimesh:
        """A copy of a decoded `mesh` (box) in the user's unit and place."""
        moved = mesh.copy()
        moved.vertices = np.asarray(mesh.vertices) / self.scale + self.centre
        moved.units = self.unit
        return moved


def _weights(given: Any, n: int) -> Array | LowRank:
    """An array (n, D), or a `LowRank` of so many exemplars as it is."""
    if isinstance(given, LowRank) and len(given) == n:
        return given
    return frozen_array(given, "weights", (n, None), np.float32)


@dataclass(frozen=True, eq=False)
class Bank:
    """Exemplars fitted by one decoder from one shared start.

    Parameters
    ----------
    space, parameters
        The d parameters with their ranges; (N, d) values.
    label_space, labels
        The p labels; (N, p), NaN = unlabelled.
    names
        N exemplar names.
    weights
        (N, D) float32, held as mapped from the file; or a `LowRank`, which behaves as one (`lampopt.compress`).
    shared
        The decoder's named arrays: start weights, a template, a lattice.
    frame
        User's unit ⇄ decoder's box.
    decoder
        Spec that rebuilds the decoder, its defaults named too: those of a later version may be others.
    probes, probe_values
        (M, 3) points of the decoder's domain; (N, M, C) what each exemplar's decoder says there.
    fit_error
        (N,) mean distance between decoded and given surface, as the decoder states it [box].
    measured_by, measured
        Which parameters can be measured how; (N, len(measured_by)) their values on the exemplars' meshes.
    mesh_facts
        What the exemplars' meshes have in common: ``{"bodies": 1, "genus": 1}``; absent where they differ.
    limits
        Limits of checks that replace the defaults.
    calibration
        The evidence behind these limits, where they were calibrated.
    provenance
        Seeds, hashes, versions: where this bank comes from. Plain scalars.
    path
        The file it was read from or stored in, if any.
    """

    space: tuple[Parameter, ...]
    parameters: Array
    label_space: tuple[Parameter, ...]
    labels: Array
    names: tuple[str, ...]
    weights: Array | LowRank
    shared: Mapping[str, Array]
    frame: Frame
    decoder: Spec
    probes: Array
    probe_values: Array
    fit_error: Array
    measured_by: Mapping[str, str] = field(default_factory=dict)
    measured: Array = None  # type: ignore[assignment]  # filled in below, never None afterwards
    mesh_facts: Mapping[str, int] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    calibration: Calibration | None = None
    provenance: Mapping[str, Scalar] = field(default_factory=dict)
    path: Path | None = None

    def __post_init__(self) -> None:
        names = tuple_of(str, self.names, "bank: names")
        space, label_space = (tuple_of(Parameter, getattr(self, s), f"bank: {s}") for s in ("space", "label_space"))
        n, d, p = len(names), len(space), len(label_space)
        unique(names, "exemplar")
        unique([q.name for q in (*space, *label_space)], "parameter or label")
        probes = frozen_array(self.probes, "probes", (None, 3))
        measured = np.empty((n, 0)) if self.measured is None else self.measured
        assign(
            self,
            space=space,
            label_space=label_space,
            names=names,
            parameters=frozen_array(self.parameters, "parameters", (n, d)),
            labels=frozen_array(self.labels, "labels", (n, p), nan=True),
            weights=_weights(self.weights, n),
            shared=frozen_arrays(self.shared, "shared"),
            probes=probes,
            probe_values=frozen_array(self.probe_values, "probe_values", (n, len(probes), None), np.float32),
            fit_error=frozen_array(self.fit_error, "fit_error", (n,)),
            measured=frozen_array(measured, "measured", (n, len(self.measured_by))),
            measured_by=_texts(self.measured_by, "measured_by"),
            mesh_facts=Table(self.mesh_facts),
            limits=Table(self.limits),
            provenance=Table(self.provenance),
        )
        if n == 0:
            raise InputError("bank: expected at least one exemplar, got none")
        if self.probe_values.shape[2] == 0:
            raise InputError("probe_values: expected at least one value a probe, got none")
        if unknown := sorted(set(self.measured_by) - {q.name for q in self.space}):
            raise InputError(f"measured_by: {unknown} are no parameters; known are {[q.name for q in self.space]}")
        held = np.empty(0, int) if self.calibration is None else self.calibration.exemplars
        if held.max(initial=0) >= n or held.min(initial=0) < 0:
            raise InputError(f"calibration: expected exemplars from 0 to {n - 1}, got {held}")
        if odd := [name for name, value in self.provenance.items() if not isinstance(value, str | int | float | None)]:
            raise InputError(f"provenance: expected texts, numbers and truth values, got others for {odd!r:.200}")
        assign(
            self,
            parameters=normalisable(self.parameters, [q.name for q in space], "parameter"),
            labels=normalisable(self.labels, [q.name for q in label_space], "label"),
        )
        if not all(isinstance(value, int) and not isinstance(value, bool) for value in self.mesh_facts.values()):
            raise InputError(f"mesh_facts: expected whole numbers, got {dict(self.mesh_facts)}")

    def __len__(self) -> int:
        return len(self.names)


def expect_bank(given: object, who: str) -> None:
    """Raise InputError where `who` is given something else than a `Bank`."""
    if not isinstance(given, Bank):
        raise InputError(f"{who}: expected a Bank, got {given!r:.80}; read one with load_bank(path)")
