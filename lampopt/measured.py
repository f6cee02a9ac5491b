"""Parameters that can be measured: addresses such as `extents.length`, and their values on the exemplars.

A parameter that no measure tells directly may be told by a learned one, `ramp.measure:ramp` (paper, section 4).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError, MeasureError, PluginError
from lampopt.fitted import load_measure
from lampopt.plugins import Plugins
from lampopt.protocols import Keeping, Measure
from lampopt.types import Array, Exemplars
from lampopt.units import factor, filled

if TYPE_CHECKING:
    from trimesh import Trimesh

UNITS = (1000.0, 304.8, 100.0, 25.4, 12.0, 10.0, 1 / 0.3048, 1 / 0.0254)  # of length, apart from each other
SLIP = 0.02  # by which a ratio may miss one of them
log = logging.getLogger("lampopt")
FOLLOWS = 0.9  # least R² of a declared measurement against its parameter
APART = 1e-3  # of a parameter's spread, the least that the others must leave of it to be told apart


def measure_all(exemplars: Exemplars, measured_by: Mapping[str, str], plugins: Plugins) -> Array:
    """Values (N, len(measured_by)) read off the exemplars' meshes, each in its parameter's unit.

    Raises
    ------
    InputError
        If one cannot be read, or does not follow its parameter over the exemplars.
    PluginError
        If a measure returns something else than its values.
    """
    values = measure_each(exemplars, measured_by, plugins)
    index = {q.name: i for i, q in enumerate(exemplars.space)}
    for (parameter, address), column in zip(measured_by.items(), values.T, strict=True):
        r2 = follows(exemplars.parameters, index[parameter], column)
        if r2 < FOLLOWS:
            raise InputError(
                f"measured: {address!r} does not follow parameter {parameter!r} over the exemplars (R² {r2:.2f}, "
                f"the other parameters' share taken out; expected {FOLLOWS}): it measures something else, or the table "
                "is wrong"
            )
        _tell_unit(parameter, address, exemplars.parameters[:, index[parameter]], column)
    return values


def _tell_unit(parameter: str, address: str, given: Array, read: Array) -> None:
    """Warn where all that is read is what was given, in another unit of length, say."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = read / given
    if np.isfinite(ratios).all() and any(np.allclose(ratios, by, rtol=SLIP) for u in UNITS for by in (u, 1 / u)):
        log.warning(
            "measured: %s is %.4g times what the exemplars' %s is: are the meshes in the unit that was told (unit=)?",
            *(address, float(np.median(ratios)), parameter),
        )


def measure_each(exemplars: Exemplars, measured_by: Mapping[str, str], plugins: Plugins) -> Array:
    """As `measure_all`, whether or not the values follow their parameters: few exemplars do not tell."""
    if not measured_by:
        return np.empty((len(exemplars), 0))
    index = {q.name: i for i, q in enumerate(exemplars.space)}
    if unknown := sorted(set(measured_by) - set(index)):
        raise InputError(f"measured: {unknown} are no parameters; known are {list(index)}")
    asked = [resolve_address(address, plugins) for address in measured_by.values()]
    values = np.empty((len(exemplars), len(asked)))
    for row, name in enumerate(exemplars.names):
        mesh = exemplars.meshes[row]  # by index: a loader's IndexError would end an iteration
        known: dict[str, Array] = {}
        for column, (address, (key, measure, place)) in enumerate(zip(measured_by.values(), asked, strict=True)):
            try:
                if key not in known:
                    known[key] = values_of(key, measure, mesh)
            except MeasureError as error:
                raise InputError(f"measured: {address!r} cannot be read off exemplar {name!r}: {error}") from error
            values[row, column] = known[key][place]
            if not np.isfinite(values[row, column]):
                raise InputError(f"measured: {address!r} is {values[row, column]:g} for exemplar {name!r}")
    for column, ((parameter, address), (_, measure, place)) in enumerate(zip(measured_by.items(), asked, strict=True)):
        q = exemplars.space[index[parameter]]
        unit = filled(measure.units[place], exemplars.unit)
        values[:, column] *= factor(unit, q.unit, f"measured: {address!r} for parameter {parameter!r}")
    return values


def keeping(measure: Measure, folder: Path) -> Measure:
    """`measure`, which keeps what it works out in `folder` if it can."""
    return measure.kept_in(folder) if isinstance(measure, Keeping) else measure


def values_of(name: str, measure: Measure, mesh: Trimesh) -> Array:
    """What `measure`, called `name`, says of `mesh`: one value (p,) for each of its names, finite or not.

    Raises
    ------
    PluginError
        If names, units and values differ in number, or the values are no numbers. What `measure` raises is passed on.
    """
    names, units = tuple(measure.names), tuple(measure.units)
    if len(units) != len(names):
        raise PluginError(f"measure {name!r}: expected {len(names)} units, one for each of {names}, got {units}")
    answer = measure(mesh)
    try:
        if np.iscomplexobj(answer):
            raise TypeError("complex values")
        values = np.asarray(answer, float)
    except (TypeError, ValueError) as error:
        raise PluginError(f"measure {name!r}: expected numbers, got {answer!r:.80}: {error}") from error
    if values.shape != (len(names),):
        raise PluginError(
            f"measure {name!r}: expected values of shape ({len(names)},), one for each of {names}, got shape "
            f"{values.shape}"
        )
    return values


def follows(parameters: Array, index: int, values: Array) -> float:
    """R² of `values` (N,) on one parameter, both freed of what the other parameters explain where N allows.

    A car's bounding width follows its width parameter, though its greenhouse moves it too.
    """
    given = parameters[:, index]
    if len(given) < 3 or np.ptp(given) == 0:
        return 1.0
    others = np.delete(parameters, index, 1) - np.delete(parameters, index, 1).mean(0)
    if len(given) < others.shape[1] + 4:
        others = others[:, :0]
    rest = [v - v.mean() for v in (given, values)]
    rest = [v - others @ np.linalg.lstsq(others, v, rcond=None)[0] for v in rest]
    size = float(np.linalg.norm(rest[0]) * np.linalg.norm(rest[1]))
    return float(rest[0] @ rest[1] / size) ** 2 if size > 0 else 0.0


def following_ratio(parameters: Array, index: int, values: Array) -> float:
    """By how much `values` (N,) change with one of `parameters` (N, d), by least squares [value's unit / parameter's].

    The other parameters' share is taken out, as far as the N exemplars tell them from this one; where they do not, all
    of the change is this one's. 0 where the parameter has no spread.

    Parameters
    ----------
    parameters
        (N, d) [each in its unit], of N ≥ 1 exemplars.
    index
        Which of the d.
    values
        (N,) what is measured for it on the exemplars [any unit], finite.
    """
    spread = np.ptp(parameters, axis=0)
    if spread[index] == 0:
        return 0.0
    scaled = (parameters - parameters.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    own, others = scaled[:, index], np.delete(scaled, index, 1)
    alone = own - others @ np.linalg.lstsq(others, own, rcond=None)[0]
    if np.linalg.norm(alone) < APART * np.linalg.norm(own):
        alone = own
    return float(alone @ (values - values.mean()) / (alone @ own) / spread[index])


def split_address(address: str) -> tuple[str, str]:
    """`measure.value` in its two parts; `file:value` where a learned measure is meant, by the file that holds it."""
    measure, _, value = address.rpartition(":") if ":" in address else address.partition(".")
    if not measure:
        raise InputError(f"measured value {address!r}: expected 'measure.value', or 'file:value' of a learned one")
    return measure, value


def resolve_address(address: str, plugins: Plugins) -> tuple[str, Measure, int]:
    """What `address` names: the measure's name or file, the measure, the value's place in it.

    Raises
    ------
    InputError
        If there is no such file, or the measure has no such value: its values are listed.
    """
    name, value = split_address(address)
    kind, sign = ("file", ":") if ":" in address else ("measure", ".")
    measure: Measure = load_measure(name, plugins=plugins) if sign == ":" else plugins.make("measure", name)
    if value not in measure.names:
        known = ", ".join(f"{name}{sign}{v}" for v in measure.names)
        raise InputError(f"measured value {address!r}: expected '{kind}{sign}value', one of {known}")
    return name, measure, tuple(measure.names).index(value)
