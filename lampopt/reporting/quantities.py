"""What the designs of a run are compared by: columns of numbers, one a design."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lampopt.reporting.charts import DUST
from lampopt.reporting.gather import Gathered, Line
from lampopt.solve import columns
from lampopt.study import Study
from lampopt.types import Array, Bank

SAME = 1e-6  # of the largest value: what differs by less is the same, the rest being single precision
NOTHING = 1e-3  # of a check's limit: likewise
BEYOND = 1e100  # as good as infinite
CALLED = {"target": "largest error", "alpha": "‖alpha − centre‖", "mismatch": "mismatch"}


@dataclass(frozen=True, eq=False)
class Quantity:
    """One number of every design: `values` (B,) [unit], NaN where a design has none that is finite.

    `group` says what it is: asked, mixed, measured or judged. A design beyond the `limit`, if there is one, is
    rejected. `more` says that a large value is the good one.
    """

    name: str
    unit: str
    group: str
    values: Array
    limit: float | None = None
    more: bool = False

    @classmethod
    def of(cls, name: str, unit: str, group: str, values: npt.ArrayLike, limit: float | None = None) -> Quantity:
        """One of `values` of any kind: what is not finite is not known."""
        found = np.array(values, float)
        return cls(name, unit, group, np.where(np.abs(found) < BEYOND, found, np.nan), limit)

    @property
    def known(self) -> Array:
        """Which designs have it (B,)."""
        return np.asarray(~np.isnan(self.values))

    @property
    def low(self) -> float:
        """The least value."""
        return float(np.nanmin(self.values))

    @property
    def high(self) -> float:
        """The largest value."""
        return float(np.nanmax(self.values))

    @property
    def common(self) -> bool:
        """Whether half of the designs have it at least."""
        return bool(2 * self.known.sum() >= len(self.values) > 0)

    @property
    def tells(self) -> bool:
        """Whether it is common, and tells designs apart: it differs by more than rounding, and than what matters."""
        if not self.common:
            return False
        least = max(SAME * max(abs(self.low), abs(self.high)), NOTHING * (self.limit or 0.0), DUST)
        return self.high - self.low > least

    @property
    def label(self) -> str:
        """Name and unit, as beside an axis."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def asked(bank: Bank, gathered: Gathered) -> list[Quantity]:
    """What was asked, name by name."""
    known, found = columns(bank), []
    for name in gathered.asked():
        unit = known[name].unit if name in known else ""
        found.append(Quantity.of(name, unit, "asked", _of(line.target.get(name) for line in gathered.lines)))
    return found


def measured(lines: Sequence[Line]) -> list[Quantity]:
    """What checks report without judging it; a value in another unit than the first one's is not comparable."""
    units: dict[str, str] = {}
    for line in lines:
        for name, (_, unit) in line.values.items():
            units.setdefault(name, unit)
    found = []
    for name, unit in units.items():
        each = (line.values.get(name, (None, unit)) for line in lines)
        found.append(Quantity.of(name, unit, "measured", _of(value if u == unit else None for value, u in each)))
    return found


def judged(lines: Sequence[Line], name: str) -> Quantity:
    """What check `name`, one of those that are compared, found."""
    checks = [line.judged.get(name) for line in lines]
    first = next((check for check in checks if check is not None), None)
    values = _of(None if check is None else check.value for check in checks)
    unit, limit = ("", None) if first is None else (first.unit, first.limit)
    return Quantity.of(CALLED[name], unit, "judged", values, limit)


def scored(lines: Sequence[Line]) -> Quantity:
    """The worst check of each design, as a part of its limit."""
    return Quantity.of("worst / limit", "", "judged", [line.score for line in lines], 1.0)


def objective(study: Study, bank: Bank, lines: Sequence[Line]) -> Quantity | None:
    """What the study wants less of (or more of, by a negative fraction), as the mix should have it; None if nothing."""
    if study.objective is None:
        return None
    name, known = study.objective.name, columns(bank)
    values = _of(line.predicted.get(name) for line in lines)
    found = Quantity.of(name, known[name].unit if name in known else "", "mixed", values)
    return Quantity(found.name, found.unit, found.group, found.values, None, study.objective.maximised)


def _of(values: Iterable[float | None]) -> list[float]:
    return [np.nan if value is None else value for value in values]
