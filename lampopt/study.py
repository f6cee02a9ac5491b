"""What is asked: the same thing as a Python object and as TOML."""

from __future__ import annotations

import re
import sys
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from math import inf, isinf
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

from lampopt.choices import (
    Value,
    beside_address,
    checks_of,
    is_value,
    measures_of,
    models_of,
    names_of,
    native,
    spec_of,
    table_beside,
    table_of,
    value_list,
    value_pair,
    written_checks,
    written_measures,
    written_models,
)
from lampopt.errors import InputError, StudyError
from lampopt.experiments import Experiments
from lampopt.goals import Linear, Minimise, Objective, Reduce, linear_of, objective_of
from lampopt.lamp import load_bank
from lampopt.meshfile import FORMATS
from lampopt.protocols import Measure, Model
from lampopt.quantities import Quantities
from lampopt.reading import brief, content
from lampopt.safeguards import NAMES as SAFE
from lampopt.types import LEVELS, Bank, Needs, Spec
from lampopt.units import number, said

LARGEST = 2**22  # bytes of a study: 100,000 values of a sweep take three quarters of it
# A key of a thousand parts costs tomllib a million steps, and gigabytes soon after; no study needs four.
LONG_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){16}""")


@dataclass(frozen=True, eq=False)
class Study:
    """One question to a bank.

    Parameters
    ----------
    bank
        The bank, or the path of its `.lamp` file.
    targets
        Wanted values by name: numbers in the bank's units, or text with a unit ("1420 mm").
    keep
        Names held at the reference's values, at the bank's mean where there is no reference.
    reference
        The exemplar to stay near: "this car, roof lower".
    ranges
        Names to be kept between two values.
    hard
        Targets that must be met exactly, whatever it costs the others.
    weights
        What a missed target weighs, by name; 1 by default.
    objective
        Reduce(...), which needs a reference, Minimise(...) or Maximise(...) of a label, a model's or a measure's value.
    linear
        Weighted sums kept within limits, by a name of their own: Linear(...).
    alpha
        Lowest and highest coefficient; (0, 1) stays between the exemplars.
    ridge
        Weight of the distance from the reference, or from the mean: λ (paper, appendix P). None: the solver's.
    norm
        In which that distance is taken: 2, or 1 for few exemplars that change.
    safe
        Checks that the solver has to keep within their limits: "alpha", "mismatch", "jacobian".
    models
        Models whose values can be asked for as `name.value`: their files, or objects, by name.
    measured
        Which measured value tells an asked one, as `measure.value` by name, besides what the bank declares.
    turns
        How often what was made is measured and the ask corrected, so that the measured value hits the target.
    solver
        Name or Spec.
    measures
        Measures to report beside the checks: their names, or a table of name → Spec or measure object. The values come
        as `name.value`.
    checks
        Checks by plugins: names, or Specs where they have options.
    limits
        Limits that replace the bank's and the defaults.
    level
        Where to stop: judge by "alpha", by "field" or by "mesh"; what needs more is not asked, plugins' checks neither.
    resolution
        Cells along the decoder's box.
    sweep
        Values by name for `lampopt.sweep`: every combination.
    experiments
        Or a plan of targets for `lampopt.sweep`: `Experiments(ranges, count)`.
    format
        Of the meshes written: stl, obj, ply, glb.
    requires
        Plugins that must be installed.
    seed
        For whatever draws.
    """

    bank: Bank | Path | str
    targets: Mapping[str, Value] = field(default_factory=dict)
    keep: tuple[str, ...] = ()
    reference: str | None = None
    ranges: Mapping[str, tuple[Value, Value]] = field(default_factory=dict)
    hard: tuple[str, ...] = ()
    weights: Mapping[str, float] = field(default_factory=dict)
    objective: Objective | None = None
    linear: Mapping[str, Linear] = field(default_factory=dict)
    alpha: tuple[float, float] | None = None
    ridge: float | None = None
    norm: int = 2
    safe: tuple[str, ...] = ()
    models: Mapping[str, str | Path | Model] = field(default_factory=dict)
    measured: Mapping[str, str] = field(default_factory=dict)
    turns: int = 0
    solver: str | Spec = "kkt"
    measures: Sequence[str] | Mapping[str, str | Spec | Measure] = ()
    checks: Sequence[str | Spec] = ()
    limits: Mapping[str, float] = field(default_factory=dict)
    level: Needs = "mesh"
    resolution: int = 128
    sweep: Mapping[str, Sequence[Value]] = field(default_factory=dict)
    experiments: Experiments | None = None
    format: str = "stl"
    requires: tuple[str, ...] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        if not isinstance(self.bank, Bank | Path | str):
            raise StudyError(f"bank: expected a Bank or the path of a .lamp file, got {said(self.bank)}")
        if not isinstance(self.solver, str | Spec):
            raise StudyError(f"solver: expected a name or a Spec, got {said(self.solver)}")
        if not isinstance(self.objective, Objective | None):
            raise StudyError(f"objective: expected Reduce, Minimise or Maximise(name, ...), got {said(self.objective)}")
        for name in ("keep", "hard", "safe", "requires"):
            _assign(self, name, names_of(getattr(self, name), name))
        _assign(self, "checks", checks_of(self.checks))
        _assign(self, "measures", measures_of(self.measures))
        if not isinstance(self.reference, str | None):
            raise StudyError(f"reference: expected the name of an exemplar, got {said(self.reference)}")
        for name in ("targets", "weights", "limits"):
            table = {key: native(value) for key, value in table_of(getattr(self, name), name).items()}
            _assign(self, name, MappingProxyType(table))
        for key, target in self.targets.items():
            if not is_value(target):
                raise StudyError(
                    f"targets: {key}: expected a finite number or text such as '1420 mm', got {said(target)}"
                )
        for name in ("resolution", "seed", "ridge", "norm", "turns"):
            _assign(self, name, native(getattr(self, name)))
        _checked(self)
        for name, read in (("ranges", value_pair), ("sweep", value_list)):
            value = {key: read(v, f"{name}: {key}") for key, v in table_of(getattr(self, name), name).items()}
            _assign(self, name, MappingProxyType(value))
        if not isinstance(self.experiments, Experiments | None):
            raise StudyError(f"experiments: expected Experiments(ranges, count), got {said(self.experiments)}")
        if self.sweep and self.experiments is not None:
            raise StudyError("sweep and experiments: expected one of them, got both: leave one out")
        _assign(self, "solver", Spec.of(self.solver))
        if self.level not in LEVELS:
            raise StudyError(f"level: expected one of {', '.join(LEVELS)}, got {said(self.level)}")
        if self.format not in FORMATS:
            raise StudyError(f"format: expected one of {', '.join(FORMATS)}, got {said(self.format)}")
        if (
            isinstance(self.resolution, bool)
            or not isinstance(self.resolution, int)
            or not 4 <= self.resolution <= 4096
        ):
            raise StudyError(f"resolution: expected a whole number from 4 to 4096, got {said(self.resolution)}")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or not 0 <= self.seed < 2**63:
            raise StudyError(f"seed: expected a whole number of at least 0 and below 2**63, got {said(self.seed)}")
        for key, limit in self.limits.items():
            if isinstance(limit, bool) or not isinstance(limit, int | float) or not 0 <= limit <= sys.float_info.max:
                raise StudyError(f"limits: {key}: expected a finite number of at least 0, got {said(limit)}")
        asked = self.names
        for name, times in Counter(asked).items():
            if times > 1 or name in self.ranges:
                raise StudyError(f"{name!r} is asked for twice: name it in one of targets, keep, ranges and objective")
        if isinstance(self.objective, Reduce) and self.reference is None:
            raise StudyError(f"objective: {self.objective} needs a reference; name an exemplar")
        varied = [*self.sweep, *(self.experiments.ranges if self.experiments else ())]
        if unknown := sorted({*self.hard} - {*asked, *varied}):
            raise StudyError(f"hard: {brief(unknown)} are not asked for; asked for are {brief([*asked, *varied])}")

    def opened(self) -> Bank:
        """The bank, loaded if the study names a file."""
        return self.bank if isinstance(self.bank, Bank) else load_bank(self.bank)

    @property
    def names(self) -> list[str]:
        """What is asked to have a value: targets, then keeps, then the objective that is one."""
        reduced = [self.objective.name] if isinstance(self.objective, Reduce) else []
        return [*self.targets, *self.keep, *reduced]

    def asked(self, known: Bank | Quantities) -> dict[str, float]:
        """Every wanted value by name, in the bank's units: targets, then keeps, then the objective."""
        known = _quantities(known)
        wanted = {name: self.value(known, name, value) for name, value in self.targets.items()}
        for name in self.keep:
            wanted[name] = known.at(name, self.reference, self._address(name))
        if isinstance(self.objective, Reduce):
            name = self.objective.name
            wanted[name] = self.objective.of(known.at(name, self.reference, self._address(name)))
        return wanted

    def _address(self, name: str) -> str | None:
        """Where the reference's value is measured: on the reference as the bank makes it, if designs are measured."""
        return self.measured.get(name) if self.turns else None

    def bounds(self, known: Bank | Quantities) -> dict[str, tuple[float, float]]:
        """The ranges in the bank's units."""
        known = _quantities(known)
        return {
            name: (self._end(known, name, low), self._end(known, name, high))
            for name, (low, high) in self.ranges.items()
        }

    def _end(self, known: Quantities, name: str, value: Value) -> float:
        return value if isinstance(value, float) and isinf(value) else self.value(known, name, value)

    def value(self, known: Bank | Quantities, name: str, value: Value) -> float:
        """One value of `name` in the bank's unit."""
        return number(value, _quantities(known)[name].unit, name)

    def to_be_measured(self) -> Mapping[str, Spec | Measure]:
        """The measures by the name under which their values are reported."""
        return cast("Mapping[str, Spec | Measure]", self.measures)  # whatever was given

    def to_toml(self) -> str:
        """The study as TOML; `from_toml` gives it back.

        A bank's path stays as it was given: a relative one is read from beside the file that the text is written to.

        Raises
        ------
        StudyError
            If its bank is in no file, or it is longer than what `read` reads.
        """
        import tomli_w

        if "name" in Spec.of(self.solver).options:
            raise StudyError(f"solver: {self.solver} has an option `name`, which TOML could not tell from the solver's")
        path = self.bank.path if isinstance(self.bank, Bank) else self.bank
        if path is None:
            raise StudyError("bank: is in no file, so TOML cannot name it: build it with store=, or use store_bank")
        document: dict[str, Any] = {"bank": str(path)}
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name == "bank" or value is None or value == () or value == {}:
                continue
            if isinstance(value, Reduce | Minimise):
                document[item.name] = value.written()
            elif item.name == "linear":
                document[item.name] = {name: one.written() for name, one in value.items()}
            elif item.name == "models":
                document[item.name] = written_models(value)
            elif item.name == "measured":
                document[item.name] = {name: beside_address(address, Path.cwd()) for name, address in value.items()}
            elif isinstance(value, Spec):
                document[item.name] = {"name": value.name, **value.options}
            elif isinstance(value, Experiments):
                document[item.name] = value.written()
            elif item.name == "measures":
                document[item.name] = written_measures(value)
            elif item.name == "checks":
                document[item.name] = written_checks(value)
            elif isinstance(value, Mapping):
                document[item.name] = {k: list(v) if isinstance(v, tuple) else native(v) for k, v in value.items()}
            else:
                document[item.name] = list(value) if isinstance(value, tuple) else value
        text = tomli_w.dumps(document)
        if (length := len(text.encode(errors="surrogatepass"))) > LARGEST:
            raise StudyError(
                f"study: {length:,} bytes as TOML, of which at most {LARGEST:,} are read back: sweep parts of it, one "
                "after the other, into the same folder"
            )
        return text

    @classmethod
    def from_toml(cls, text: str, *, folder: Path | None = None) -> Study:
        """A study from TOML text; a relative bank path is taken from `folder`.

        Raises
        ------
        StudyError
            If the text is no TOML, or says what no study has.
        """
        if not isinstance(text, str):
            raise StudyError(f"study: expected TOML text, got {said(text)}")
        if LONG_KEY.search(text):
            raise StudyError("study: expected keys of a few parts, got one of 16 or more")
        try:
            document = tomllib.loads(text)
        except (ValueError, RecursionError, MemoryError) as error:
            raise StudyError(f"study: not valid TOML: {brief(error) or 'it nests too deep'}") from error
        known = {item.name for item in fields(cls)}
        if unknown := sorted(set(document) - known):
            raise StudyError(
                f"study: unknown entries {brief(', '.join(unknown))}; known are {', '.join(sorted(known))}"
            )
        if not isinstance(document.get("bank"), str):
            raise StudyError("study: expected an entry `bank` with the path of a .lamp file")
        document["bank"] = (folder or Path()) / document["bank"]
        if isinstance(solver := document.get("solver"), dict):
            document["solver"] = spec_of(solver, "solver")
        if "experiments" in document:
            document["experiments"] = Experiments.read(document["experiments"])
        if isinstance(measures := document.get("measures"), dict):
            document["measures"] = {n: table_beside(choice, f"measures: {n}", folder) for n, choice in measures.items()}
        if isinstance(checks := document.get("checks"), list):
            document["checks"] = [table_beside(choice, "checks", folder) for choice in checks]
        if isinstance(measured := document.get("measured"), dict):
            document["measured"] = {name: beside_address(address, folder) for name, address in measured.items()}
        if isinstance(models := document.get("models"), dict):
            document["models"] = {
                name: str((folder or Path()) / file) if isinstance(file, str) and not file.startswith("<") else file
                for name, file in models.items()
            }
        if "objective" in document:
            document["objective"] = objective_of(document["objective"])
        return cls(**document)

    @classmethod
    def read(cls, path: str | Path) -> Study:
        """The study in a TOML file; a relative bank path is taken from beside it.

        Raises
        ------
        StudyError
            Naming the file and the entry, if it cannot be read or says what no study has.
        """
        try:
            text = content(path, largest=LARGEST).decode("utf-8-sig")
        except (InputError, ValueError) as error:
            raise StudyError(f"{brief(path)}: cannot be read as a study: {brief(error)}") from error
        try:
            return cls.from_toml(text, folder=Path(path).parent)
        except InputError as error:
            raise StudyError(f"{brief(path)}: {error}") from error


def _assign(study: Study, name: str, value: object) -> None:
    object.__setattr__(study, name, value)


def _quantities(known: Bank | Quantities) -> Quantities:
    return known if isinstance(known, Quantities) else Quantities(known)


def _checked(study: Study) -> None:
    """What is asked of the solver besides targets and ranges, and of those that measure."""
    for name, weight in study.weights.items():
        if isinstance(weight, bool) or not isinstance(weight, int | float) or not 0 < weight <= sys.float_info.max:
            raise StudyError(f"weights: {name}: expected a positive number, got {said(weight)}")
    linear = {name: linear_of(value, name) for name, value in table_of(study.linear, "linear").items()}
    _assign(study, "linear", MappingProxyType(linear))
    most = sys.float_info.max  # a whole number may be beyond any float
    if study.alpha is not None:
        ends = [native(value) for value in study.alpha] if isinstance(study.alpha, Sequence) else []
        plain = all(
            isinstance(v, int | float)
            and not isinstance(v, bool)
            and (v in (-inf, inf) or abs(v) <= sys.float_info.max)
            for v in ends
        )
        if len(ends) != 2 or not plain or not ends[0] < ends[1]:
            raise StudyError(f"alpha: expected the lowest and the highest coefficient, got {said(study.alpha)}")
        _assign(study, "alpha", (float(ends[0]), float(ends[1])))
    ridge: object = study.ridge
    if ridge is not None and (isinstance(ridge, bool) or not isinstance(ridge, int | float) or not 0 <= ridge <= most):
        raise StudyError(f"ridge: expected a number of at least 0, got {said(ridge)}")
    if study.norm not in (1, 2):
        raise StudyError(f"norm: expected 1 or 2, got {said(study.norm)}")
    if isinstance(study.turns, bool) or not isinstance(study.turns, int) or not 0 <= study.turns <= 100:
        raise StudyError(f"turns: expected a whole number from 0 to 100, got {said(study.turns)}")
    if unknown := sorted(set(study.safe) - set(SAFE)):
        raise StudyError(f"safe: {brief(unknown)} cannot be kept by a solver; what can are {', '.join(SAFE)}")
    _assign(study, "models", models_of(study.models))
    measured = table_of(study.measured, "measured")
    if wrong := [name for name, address in measured.items() if not isinstance(address, str)]:
        raise StudyError(
            f"measured: {wrong[0]}: expected an address, such as 'extents.length', got {said(measured[wrong[0]])}"
        )
    _assign(study, "measured", MappingProxyType(dict(measured)))
