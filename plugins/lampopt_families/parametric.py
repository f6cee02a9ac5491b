"""What parametric families have in common: named ranges, draws over them, meshes made on access."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array, Exemplars, Parameter

from .draws import DESIGNS, draws

if TYPE_CHECKING:
    from trimesh import Trimesh

MOST = 100_000  # exemplars; beyond lies a slip, or a machine out of memory
DRAWS = 100  # exemplars, unless `count` says otherwise, by a number above 0
SEEDS = 2**63  # what a draw can begin from


def check_draws(name: str, design: str, *, count: int, seed: int) -> None:
    """Raise InputError for draws that cannot be made, `name` being the source that is asked for them."""
    if design not in DESIGNS:
        raise InputError(f"{name}: design: expected one of {', '.join(DESIGNS)}, got {design!r:.100}")
    if not whole(count) or not 0 <= count <= MOST:
        raise InputError(f"{name}: count: expected a whole number from 0 to {MOST:,}, got {count!r:.100}")
    if not whole(seed) or not 0 <= seed < SEEDS:
        raise InputError(f"{name}: seed: expected a whole number below 2^63, 0 or more, got {seed!r:.100}")


def check_edge(name: str, edge: float, finest: float, coarsest: float) -> None:
    """Raise InputError unless a mesh can have edges of this length [mm]."""
    if isinstance(edge, bool) or not isinstance(edge, int | float) or not finest <= edge <= coarsest:
        raise InputError(f"{name}: edge: expected {finest:g} to {coarsest:g} mm, got {edge!r:.100}")


def real(name: str, parameters: Array) -> Array:
    """`parameters` as floating point. Raises InputError for what are no real numbers, `name` being the source."""
    try:
        given = np.asarray(parameters)
    except ValueError as error:
        raise InputError(f"{name}: expected one row of parameters, got rows that differ in length") from error
    if given.dtype.kind not in "iuf":
        raise InputError(f"{name}: expected parameters that are real numbers, got {given.dtype}")
    return given.astype(float)


def whole(value: object) -> bool:
    """Whether `value` is a whole number; True and False are none."""
    return isinstance(value, int) and not isinstance(value, bool)


@dataclass(frozen=True, eq=False)
class Family:
    """A family of shapes by formula.

    Parameters
    ----------
    name
        Of the source; it begins the exemplars' names and every message.
    space
        The d parameters.
    low, high
        (d,) the range that exemplars are drawn from [each parameter's unit].
    unit
        Length unit of the meshes.
    measured
        Which parameter can be measured how: parameter → address.
    mesh
        The true mesh at parameters (d,), also outside the range. Raises InputError naming a parameter for which there
        is none.
    """

    name: str
    space: tuple[Parameter, ...]
    low: Array
    high: Array
    unit: str
    measured: Mapping[str, str]
    mesh: Callable[[Array], Trimesh]

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters' names."""
        return tuple(q.name for q in self.space)

    def checked_options(self, count: int, design: str, seed: int) -> None:
        """Raise InputError for draws that cannot be made."""
        check_draws(self.name, design, count=count, seed=seed)
        if design == "ends" and count not in (0, self.ends):
            raise InputError(
                f"{self.name}: design 'ends' has {self.ends} exemplars, got count={count}; "
                "for another count choose lhs, sobol or random"
            )

    @property
    def ends(self) -> int:
        """How many exemplars the design `ends` has: the middle of the range and each parameter's two ends."""
        return 2 * len(self.space) + 1

    def exemplars(self, count: int, design: str, seed: int) -> Exemplars:
        """The exemplars, with `count` 0 as many as the design has, or DRAWS; names say the end, or count them."""
        self.checked_options(count, design, seed)
        if design == "ends":
            names, parameters = self._at_the_ends()
        else:
            count = count or DRAWS
            names = tuple(f"{self.name}_{i:0{len(str(count - 1))}d}" for i in range(count))
            parameters = draws(design, count, self.low, self.high, seed)
        return Exemplars(
            parameters=parameters,
            space=self.space,
            meshes=Made(self.mesh, parameters),
            names=names,
            unit=self.unit,
            measured=self.measured,
            mesh_at=self.mesh,
        )

    def _at_the_ends(self) -> tuple[tuple[str, ...], Array]:
        middle = (self.low + self.high) / 2
        rows, names = [middle], ["middle"]
        for k, name in enumerate(self.names):
            for end, values in (("low", self.low), ("high", self.high)):
                rows.append(np.where(np.arange(len(middle)) == k, values[k], middle))
                names.append(f"{name}_{end}")
        return tuple(names), np.array(rows)

    def widened(self, factor: float) -> tuple[Array, Array]:
        """Low and high (d,) of the range widened about its middle: `factor` 3 is ±100 % beyond each end."""
        middle, half = (self.low + self.high) / 2, (self.high - self.low) / 2
        return middle - factor * half, middle + factor * half

    def parameters(self, given: Array) -> Array:
        """`given` as (d,) finite numbers. Raises InputError saying what they should be."""
        values = real(self.name, given)
        if values.shape != (len(self.space),):
            raise InputError(
                f"{self.name}: expected {len(self.space)} parameters, {', '.join(self.names)}, got shape {values.shape}"
            )
        if wrong := [f"{n} is {v}" for n, v in zip(self.names, values, strict=True) if not np.isfinite(v)]:
            raise InputError(f"{self.name}: expected finite parameters, got {'; '.join(wrong)}")
        return values


@dataclass(frozen=True, eq=False)
class Made(Sequence["Trimesh"]):
    """The meshes at `parameters` (N, d), made on access."""

    mesh: Callable[[Array], Trimesh]
    parameters: Array

    def __len__(self) -> int:
        return len(self.parameters)

    @overload
    def __getitem__(self, index: int) -> Trimesh: ...
    @overload
    def __getitem__(self, index: slice) -> Made: ...
    def __getitem__(self, index: int | slice) -> Any:
        if isinstance(index, slice):
            return Made(self.mesh, self.parameters[index])
        return self.mesh(self.parameters[index])
