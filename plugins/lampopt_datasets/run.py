"""The designs of a run as exemplars: what a bank made teaches the next (the paper's generation of data sets)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

import lampopt
from lampopt.errors import InputError
from lampopt.measured import following_ratio
from lampopt.reading import brief, plain_file
from lampopt.types import Array, Bank, Check, Exemplars, Parameter, Result

from .example import temporary

if TYPE_CHECKING:
    from trimesh import Trimesh

VALUES = ("predicted", "measured")
HELD = 1e-3  # of the bank's range: a parameter that varies by less was held, what remains is rounding
VARIED = 0.25  # of the bank's range: only where it varies by that much does a measurement follow it clearly


@dataclass(frozen=True)
class Run:
    """The designs of a run folder that have a mesh, in the order of its last sweep; each is named after its folder.

    They are those of the study that was asked last; what others left in the folder is left out.

    Parameters
    ----------
    folder
        A folder that `lampopt.run` or `lampopt.sweep` has written.
    accepted
        Only designs that passed every check; False takes the rejected ones too.
    parameters
        `predicted`: what the mix of each design promises, Pᵀalpha; it is what was asked for where a target is met.
        `measured`: what the study's measures found instead, for those parameters that the bank declares measurable;
        the study has to name these measures.
    labels
        Comma-separated measured values, such as "volume.volume", that are to be labels; by default all that the study's
        measures gave.
    """

    folder: str
    accepted: bool = True
    parameters: str = "predicted"
    labels: str = ""

    def __post_init__(self) -> None:
        if self.parameters not in VALUES:
            raise InputError(f"run: parameters: expected one of {', '.join(VALUES)}, got {self.parameters!r}")

    @staticmethod
    def example() -> Run:
        """Three designs of ellipsoids in a temporary folder that is removed when Python ends, for `lampopt.testing`."""
        from trimesh.creation import icosphere

        folder = temporary("run")
        lengths = np.array([1.6, 2.0, 2.4])
        meshes = [icosphere(subdivisions=3) for _ in lengths]
        for mesh, length in zip(meshes, lengths, strict=True):
            mesh.vertices *= (length / 2, 0.6, 0.5)
        given = Exemplars(lengths[:, None], (Parameter("length", "m"),), meshes, ("short", "middle", "long"))
        network = lampopt.Spec(
            "sdf-mlp", width=32, depth=2, octaves=1, start_steps=150, steps=50, points=512, samples=2000
        )
        bank = lampopt.build_bank(given, decoder=network, store=folder / "bank.lamp")
        loose = {"mismatch": 1.0, "mismatch.band": 1.0}  # a network as small as this is quick, not good
        study = lampopt.Study(bank, measures=("extents",), limits=loose, resolution=32)
        for _ in lampopt.sweep(study, {"length": [1.8, 2.0, 2.2]}, folder=folder / "run", report=False):
            pass
        return Run(str(folder / "run"))

    def __call__(self) -> Exemplars:
        """The exemplars; meshes load on access.

        Raises
        ------
        InputError
            If there is no run in the folder, no design that is wanted, or none that has a mesh.
        """
        folder = Path(self.folder)
        try:
            plain_file(folder / "study.toml")
        except InputError as error:
            raise InputError(
                f"run {brief(folder)}: expected a folder written by lampopt.run or lampopt.sweep, with study.toml and "
                f"runs.sqlite in it: {error}"
            ) from error
        bank = lampopt.Study.read(folder / "study.toml").opened()
        found = self._wanted(folder)
        space = tuple(Parameter(q.name, q.unit) for q in bank.space)
        parameters = np.stack([result.design.predicted for result in found])
        if self.parameters == "measured":
            parameters = _measured(parameters, found, bank, folder)
        spread = np.array([q.spread for q in bank.space])
        held = np.ptp(parameters, axis=0) <= HELD * spread
        parameters[:, held] = parameters.mean(axis=0)[held]
        varied = {q.name for q, kept in zip(space, np.ptp(parameters, axis=0) >= VARIED * spread, strict=True) if kept}
        label_space, labels = self._labels(found, space, folder)
        return Exemplars(
            parameters=parameters,
            space=space,
            meshes=Made(tuple(result.design.make_mesh for result in found), tuple(map(_name, found)), folder),
            names=tuple(map(_name, found)),
            labels=labels,
            label_space=label_space,
            unit=bank.frame.unit,
            measured={name: address for name, address in bank.measured_by.items() if name in varied},
        )

    def _wanted(self, folder: Path) -> list[Result]:
        every = list(lampopt.results(folder))
        wanted = [result for result in every if result.accepted or not self.accepted]
        if not every:
            raise InputError(f"run {folder}: no design is recorded; run its study first")
        if not wanted:
            failed = Counter(check.name for result in every for check in result.checks if not check.passed)
            reasons = ", ".join(f"{name} ({count})" for name, count in failed.most_common())
            raise InputError(
                f"run {folder}: all {len(every)} designs were rejected, by {reasons}: ask for less, or take rejected "
                "ones too with accepted=False"
            )
        meshed = [result for result in wanted if result.folder is not None and result.folder != folder]
        if not meshed:
            raise InputError(
                f"run {folder}: none of its {len(wanted)} designs has a mesh: the study stopped at a level below; run "
                "it again with level = 'mesh'"
            )
        return meshed

    def _labels(self, found: Sequence[Result], space: Sequence[Parameter], folder: Path) -> tuple[Any, Array]:
        """What the study's measures gave: the labels' space, and their values (N, p), NaN where there is none."""
        given = [{check.name: check for check in result.checks if _is_measured(check)} for result in found]
        first = {name: check for checks in reversed(given) for name, check in checks.items()}
        asked = [name.strip() for name in self.labels.split(",") if name.strip()]
        if unknown := [name for name in asked if name not in first]:
            known = ", ".join(first) or "none: the study names no measures"
            raise InputError(f"run {folder}: labels: {', '.join(unknown)} not measured; known are {known}")
        chosen = {name: first[name] for name in asked or sorted(first)}
        for checks in given:
            for name, check in checks.items():
                if name in chosen and check.unit != chosen[name].unit:
                    raise InputError(
                        f"run {folder}: {name} is in [{chosen[name].unit}] and in [{check.unit}]: choose other labels"
                    )
        taken = Counter([*map(_value, chosen), *(q.name for q in space)])
        titles = {name: _value(name) if taken[_value(name)] == 1 else name.replace(".", "_") for name in chosen}
        values = [[checks[name].value if name in checks else np.nan for name in chosen] for checks in given]
        labels = np.array(values, float).reshape(len(found), len(chosen))
        labels[~np.isfinite(labels)] = np.nan
        return tuple(Parameter(titles[name], chosen[name].unit) for name in chosen), labels


@dataclass(frozen=True, eq=False)
class Made(Sequence["Trimesh"]):
    """The designs' meshes [unit of the bank]; every access loads anew and nothing is kept."""

    makers: tuple[Callable[[], Trimesh | None], ...]
    names: tuple[str, ...]
    folder: Path

    def __len__(self) -> int:
        return len(self.makers)

    @overload
    def __getitem__(self, index: int) -> Trimesh: ...
    @overload
    def __getitem__(self, index: slice) -> Made: ...
    def __getitem__(self, index: int | slice) -> Any:
        if isinstance(index, slice):
            return Made(self.makers[index], self.names[index], self.folder)
        mesh = self.makers[index]()
        if mesh is None:
            raise InputError(
                f"run {self.folder}: design {self.names[index]}: its mesh is gone and cannot be made again"
            )
        return mesh


def _name(result: Result) -> str:
    return "" if result.folder is None else result.folder.name


def _value(address: str) -> str:
    """The value's own name, without that of its measure."""
    return address.partition(".")[2].replace(".", "_")


def _is_measured(check: Check) -> bool:
    """Whether this is a value of a measure: those are called `measure.value` and judge nothing."""
    return check.sense == "info" and "." in check.name


def _measured(parameters: Array, found: Sequence[Result], bank: Bank, folder: Path) -> Array:
    """`parameters` (N, d), each that the bank measures as it was measured, in place of predicted.

    What is measured may differ from the parameter by an offset or a factor (a change of length against a length). So a
    parameter is corrected by how far the measured value is from the one predicted, Mᵀalpha, over their ratio.
    """
    values = parameters.copy()
    for (name, address), known in zip(bank.measured_by.items(), bank.measured.T, strict=True):
        place = [q.name for q in bank.space].index(name)
        for row, result in enumerate(found):
            check = next((c for c in result.checks if c.name == address), None)
            if check is None or not np.isfinite(check.value):
                raise InputError(
                    f"run {folder}: design {_name(result)}: no value of {address}, which measures {name!r}: name "
                    f"{address.partition('.')[0]!r} among the study's measures and run it again, or take "
                    "parameters='predicted'"
                )
            off = check.value * _factor(check.unit, bank.space[place].unit) - float(result.design.mix.alpha @ known)
            values[row, place] += off / (following_ratio(bank.parameters, place, known) or 1.0)
    return values


def _factor(unit: str, to: str) -> float:
    if unit == to:
        return 1.0
    import pint

    registry = pint.get_application_registry()
    return float(registry.Quantity(1.0, unit or "dimensionless").to(to or "dimensionless").magnitude)
