"""What is measured on a shape, and what that says of the parameter it stands for."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from lampopt.measured import following_ratio, resolve_address, values_of
from lampopt.plugins import Plugins
from lampopt.types import Array, Bank
from lampopt.units import factor, filled

if TYPE_CHECKING:
    from trimesh import Trimesh

SAME = 0.05  # of its range that a measurement may be off its parameter and still be that parameter itself
log = logging.getLogger("lampopt")


def measured(bank: Bank, mesh: Trimesh, plugins: Plugins) -> dict[str, float]:
    """The measurable parameters' measurements on `mesh`, in their units; left out where they are not there."""
    found: dict[str, float] = {}
    known: dict[str, Array | None] = {}
    units = {q.name: q.unit for q in bank.space}
    for parameter, address in bank.measured_by.items():
        try:
            name, measure, place = resolve_address(address, plugins)
            if name not in known:
                known[name] = None
                known[name] = values_of(name, measure, mesh)
            values = known[name]
            if values is not None:
                scale = factor(filled(measure.units[place], bank.frame.unit), units[parameter], address)
                found[parameter] = float(values[place]) * scale
        except Exception as error:  # noqa: BLE001  # a stranger's measure, on a shape that may be broken
            log.info("report: %s is not measured: %s", address, error)
    return found


def is_itself(bank: Bank, parameter: str) -> bool:
    """Whether what is measured for `parameter` is its value, and no other quantity that follows it."""
    if parameter not in bank.measured_by:
        return True
    given, read = _columns(bank, parameter)
    return bool(np.abs(read - given).max() <= SAME * np.ptp(given))


def read_back(bank: Bank, parameter: str, value: float, mixed: Mapping[str, float]) -> float:
    """The value of `parameter` that a measurement of `value` tells.

    That is the measurement where it is the parameter itself. Where it only follows it (a length, for a parameter that
    is a change of length), it is the mixed value plus what the measurement is off its own mixed value, in the
    parameter's terms: as the drift checks judge.

    Parameters
    ----------
    mixed
        What the mix should have, by parameter and by measured address.
    """
    if is_itself(bank, parameter):
        return value
    place = [q.name for q in bank.space].index(parameter)
    ratio = following_ratio(bank.parameters, place, _columns(bank, parameter)[1])
    off = value - mixed[bank.measured_by[parameter]]
    return mixed[parameter] + off / ratio if ratio else float("nan")


def _columns(bank: Bank, parameter: str) -> tuple[Array, Array]:
    """Values (N,) of a parameter and of its measurement over the exemplars."""
    at = [q.name for q in bank.space].index(parameter)
    return bank.parameters[:, at], bank.measured[:, list(bank.measured_by).index(parameter)]
