"""Names that a study may ask for: columns over the exemplars, values of models, values of measures.

A column (parameter, label, declared measured value) is linear in alpha. A model's value is a function of Pᵀalpha, and
a measure's one of the decoded mesh. A name without a dot that is no column may be the value of a model or a measure
that the study names; `model.value` and `measure.value` say it all.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lampopt.chain import Chain
from lampopt.errors import InputError, PluginError, StudyError
from lampopt.measured import keeping, resolve_address
from lampopt.protocols import Interval, Measure, Model
from lampopt.reading import brief
from lampopt.solve import Column, column, columns
from lampopt.types import Array, Bank
from lampopt.units import factor, filled

if TYPE_CHECKING:
    from lampopt.plugins import Plugins


@dataclass(frozen=True, eq=False)
class Quantity:
    """One name that can be asked for, with its unit, and what tells its value.

    Parameters
    ----------
    name, unit
        As the study calls it.
    column
        Where it is linear in alpha.
    model, measure
        Who tells it otherwise: what it is called, the object, the value's place in it.
    """

    name: str
    unit: str
    column: Column | None = None
    model: tuple[str, Model, int] | None = None
    measure: tuple[str, Measure, int] | None = None


@dataclass(frozen=True, eq=False)
class Quantities:
    """All names that a study of `bank` may ask for.

    Parameters
    ----------
    bank
        The bank.
    models, measures
        By the names under which the study has them.
    chain
        What makes a measure's mesh; None where nothing is decoded.
    plugins
        Where measures come from that the study does not name.
    kept_in
        Where these keep what they work out, in folders of their names; None for nowhere.
    """

    bank: Bank
    models: Mapping[str, Model] = field(default_factory=dict)
    measures: Mapping[str, Measure] = field(default_factory=dict)
    chain: Chain | None = None
    plugins: Plugins | None = None
    kept_in: Path | None = None
    _at: dict[tuple[str, str | None, str | None], float] = field(default_factory=dict, repr=False)

    def __getitem__(self, name: str) -> Quantity:
        """The quantity called `name`.

        Raises
        ------
        StudyError
            If there is none, several have that name, or no mix can change it.
        """
        found = [*self._called(name)]
        if len(found) == 1:
            return found[0]
        if found:
            raise StudyError(f"{name!r}: may be {', or '.join(f'{q.name!r} of {teller(q)}' for q in found)}: say which")
        if "." in name and (made := self._installed(name)) is not None:
            return made
        more = [
            f"{key}.{value}" for table in (self.models, self.measures) for key, m in table.items() for value in m.names
        ]
        if name not in columns(self.bank) and more:
            raise StudyError(
                f"{name!r}: neither a parameter, a label nor a measured value; known are "
                f"{brief(', '.join([*columns(self.bank), *more]))}"
            )
        return _of_column(column(self.bank, name))

    def measured(self, address: str) -> Quantity:
        """The measured value at `address`: of a measure of the study, of an installed one, or in the file of one.

        Raises
        ------
        StudyError, InputError
            If there is none.
        """
        key, _, value = address.partition(".")
        if ":" not in address and key in self.measures:
            name, measure = key, self.measures[key]
            if value not in measure.names:
                known = ", ".join(f"{key}.{v}" for v in measure.names)
                raise StudyError(f"measured: {address!r}: expected one of {known}")
            place = tuple(measure.names).index(value)
        else:
            if self.plugins is None:
                raise StudyError(f"measured: {address!r}: nothing is installed here")
            name, measure, place = resolve_address(address, self.plugins)
            measure = measure if ":" in address else self._kept(name, measure)
        unit = filled(measure.units[place], self.bank.frame.unit)
        return Quantity(address, unit, measure=(name, measure, place))

    def _called(self, name: str) -> Iterator[Quantity]:
        """Everything that may be meant."""
        if name in columns(self.bank):
            yield _of_column(column(self.bank, name))
        for key, model in self.models.items():
            for place, (value, unit) in enumerate(zip(model.names, model.units, strict=True)):
                if name in (f"{key}.{value}", value):
                    yield Quantity(f"{key}.{value}", unit, model=(key, model, place))
        for key, measure in self.measures.items():
            for place, (value, unit) in enumerate(zip(measure.names, measure.units, strict=True)):
                if (name == f"{key}.{value}" and name not in columns(self.bank)) or (
                    name == value and name not in columns(self.bank)
                ):
                    unit = filled(unit, self.bank.frame.unit)
                    yield Quantity(f"{key}.{value}", unit, measure=(key, measure, place))

    def _installed(self, name: str) -> Quantity | None:
        """A value of an installed measure that the study does not name besides."""
        key, _, value = name.partition(".")
        measure: Measure
        if key in self.measures:
            measure = self.measures[key]
        elif self.plugins is None or ("measure", key) not in self.plugins.offers:
            return None
        else:
            measure = self._kept(key, self.plugins.make("measure", key))
        if value not in measure.names:
            raise StudyError(
                f"{name!r}: measure {key!r} has no such value; it has {', '.join(f'{key}.{v}' for v in measure.names)}"
            )
        place = tuple(measure.names).index(value)
        return Quantity(name, filled(measure.units[place], self.bank.frame.unit), measure=(key, measure, place))

    def _kept(self, key: str, measure: Measure) -> Measure:
        return measure if self.kept_in is None else keeping(measure, self.kept_in / key)

    def at(self, name: str, reference: str | None, address: str | None = None) -> float:
        """The value of `name` at an exemplar; at the bank's mean where there is no reference.

        With `address` it is what is measured there on the exemplar as the bank decodes it, which is what a design is
        to be compared with. It is worked out once, however many designs ask for it.

        Raises
        ------
        StudyError
            If there is no such exemplar, or it has no value for it.
        """
        if (key := (name, reference, address)) not in self._at:
            self._at[key] = self._value_at(name, reference, address)
        return self._at[key]

    def _value_at(self, name: str, reference: str | None, address: str | None) -> float:
        quantity = self[name]
        if reference is not None and reference not in self.bank.names:
            known = ", ".join(self.bank.names)
            raise StudyError(f"reference {reference!r}: no exemplar of this bank; there are {known}")
        n = len(self.bank)
        alpha = np.full(n, 1 / n) if reference is None else np.eye(n)[self.bank.names.index(reference)]
        told = quantity if address is None else self.measured(address)
        if address is not None:
            value = self.value(told, alpha) * factor(told.unit, quantity.unit, f"{address!r} for {name!r}")
        elif quantity.column is not None:
            values = quantity.column.values
            value = float(np.nanmean(values)) if reference is None else float(values[self.bank.names.index(reference)])
        else:
            value = self.value(quantity, alpha)
        if value != value:
            what = "the mean shape" if reference is None else f"the reference {reference!r}"
            raise StudyError(f"{name!r}: {what} has no value for it; choose another{self._why_not(told, alpha)}")
        return value

    def value(self, quantity: Quantity, alpha: Array) -> float:
        """What `quantity` is for alpha (N,); NaN where a mesh lacks what is measured."""
        if quantity.column is not None:
            return float(alpha @ quantity.column.values)
        if quantity.model is not None:
            name, model, place = quantity.model
            return float(answered(name, model, (alpha @ inputs_of(self.bank, name, model))[None])[0, place])
        assert quantity.measure is not None
        if self.chain is None:
            raise StudyError(f"{quantity.name!r}: is measured on meshes, which nothing makes here")
        name, measure, place = quantity.measure
        return float(self.chain.values(name, measure, alpha)[place])

    def outside(self, quantity: Quantity, alpha: Array) -> bool:
        """Whether its value at alpha (N,) is told of a mesh outside what its measure was made for: it tells nothing."""
        if quantity.measure is None or self.chain is None or not isinstance(quantity.measure[1], Interval):
            return False
        mesh = self.chain.mesh(alpha)
        return mesh is not None and bool(quantity.measure[1].outside(mesh))

    def _why_not(self, quantity: Quantity, alpha: Array) -> str:
        """What a measure that has no value said."""
        if quantity.measure is None or self.chain is None:
            return ""
        why = self.chain.why_not(*quantity.measure[:2], alpha)
        return f": {why}" if why else ""

    def over_exemplars(self, quantity: Quantity) -> Array:
        """(N,) what a model says of the exemplars."""
        assert quantity.model is not None
        name, model, place = quantity.model
        return answered(name, model, inputs_of(self.bank, name, model))[:, place]


def inputs_of(bank: Bank, name: str, model: Model) -> Array:
    """(N, inputs) the exemplars' parameters that a model needs.

    Raises
    ------
    StudyError
        If it needs one that the bank does not have.
    """
    known = [q.name for q in bank.space]
    if missing := [name for name in model.inputs if name not in known]:
        raise StudyError(f"model {name!r}: needs {', '.join(missing)}; the bank's parameters are {', '.join(known)}")
    return bank.parameters[:, [known.index(name) for name in model.inputs]]


def answered(name: str, model: Model, parameters: Array) -> Array:
    """(B, p) what a model says at parameters (B, d).

    Raises
    ------
    StudyError
        Where it refuses them.
    PluginError
        If it returns values of another shape.
    """
    try:
        values = np.asarray(model(parameters), float)
    except InputError as error:
        raise StudyError(f"model {name!r}: {error}") from error
    if values.shape != (wanted := (len(parameters), len(model.names))):
        raise PluginError(f"model {name!r}: expected values of shape {wanted}, got {values.shape}")
    return values


def _of_column(found: Column) -> Quantity:
    return Quantity(found.name, found.unit, column=found)


def error_of(quantity: Quantity) -> Quantity | None:
    """The standard error that a measure tells of this value of its own: `VALUE_error`, in the same unit."""
    if quantity.measure is None:
        return None
    name, measure, place = quantity.measure
    names, units = tuple(measure.names), tuple(measure.units)
    error = f"{names[place]}_error"
    if error not in names or units[names.index(error)] != units[place]:
        return None
    return Quantity(f"{quantity.name}_error", quantity.unit, measure=(name, measure, names.index(error)))


def teller(quantity: Quantity) -> str:
    """Who tells a quantity's value, in words."""
    if quantity.model is not None:
        return f"model {quantity.model[0]!r}"
    return "the bank" if quantity.measure is None else f"measure {quantity.measure[0]!r}"


def named(quantities: Sequence[Quantity]) -> str:
    """Their names, for a message."""
    return ", ".join(q.name for q in quantities)
