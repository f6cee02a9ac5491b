"""Which designs join a bank: of a run folder or of results, each under its name, none that has not proved itself."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, overload

from lampopt import lamp
from lampopt.errors import InputError
from lampopt.reading import brief
from lampopt.record import KEY
from lampopt.types import Bank, Check, Result
from lampopt.units import said

if TYPE_CHECKING:
    from trimesh import Trimesh

REJECTED = "rejected"  # as `leave_out`: whoever was
TOLD = 20  # designs that are named in one message


@dataclass(frozen=True, eq=False)
class Newcomer:
    """A design that is to join: the exemplar's `name`, and `key`, that of the design, with its run before it."""

    name: str
    key: str
    result: Result

    @property
    def judged(self) -> bool:
        """Whether its mesh was looked at, not only its mix."""
        return any(check.needs == "mesh" for check in self.result.checks)

    def mesh(self) -> Trimesh:
        """Its mesh [unit of its bank], a copy that nobody else holds."""
        made = self.result.design.__dict__.get("mesh")  # held already by whoever holds the result
        found = self.result.design.make_mesh() if made is None else made.copy()
        if found is None:
            raise InputError(f"design {self.name!r}: its mesh is gone and cannot be made again")
        return found


@dataclass(frozen=True, eq=False)
class Meshes(Sequence["Trimesh"]):
    """The designs' meshes; every access makes or loads one anew, and none is kept."""

    newcomers: Sequence[Newcomer]
    make: Callable[[Newcomer], Trimesh] = Newcomer.mesh

    def __len__(self) -> int:
        return len(self.newcomers)

    @overload
    def __getitem__(self, index: int) -> Trimesh: ...
    @overload
    def __getitem__(self, index: slice) -> Meshes: ...
    def __getitem__(self, index: int | slice) -> Any:
        if isinstance(index, slice):
            return Meshes(self.newcomers[index], self.make)
        return self.make(self.newcomers[index])


def named(result: Result, maker: Bank, name: str | None = None) -> Newcomer:
    """`result` under its name, by default its key: that of its folder, or a hash where it was not recorded."""
    folder = None if result.folder is None else result.folder.absolute()
    if folder is not None and folder.parent.name == "designs" and KEY.fullmatch(folder.name):
        key, run = folder.name, f"{folder.parent.parent.name}/"
    else:
        target, alpha = dict(result.design.target), lamp.digest(result.design.mix.alpha)
        told = json.dumps([maker.provenance.get("plan"), target, alpha], sort_keys=True)
        key, run = hashlib.blake2b(told.encode(), digest_size=12).hexdigest(), ""
    return Newcomer(name or key, run + key, result)


def given_by(bank: Bank, designs: object) -> Iterator[Newcomer]:
    """Results as they were given, each made by `bank`."""
    wanted = "designs: expected a run folder or results, such as those of lampopt.run"
    if isinstance(designs, Result):
        designs = [designs]
    if not isinstance(designs, Iterable):
        raise InputError(f"{wanted}, got {said(designs):.80}")
    pairs = designs.items() if isinstance(designs, Mapping) else ((None, result) for result in designs)
    for name, result in pairs:
        if not isinstance(result, Result):
            raise InputError(f"{wanted}, got {said(result):.80}")
        if not isinstance(name, str | None) or name == "":
            raise InputError(f"designs: expected results by the names that they are to have, got {said(name):.80}")
        found = named(result, bank, name)
        same = result.provenance.get("bank.plan") == bank.provenance.get("plan")
        if not same or result.design.mix.alpha.shape != (len(bank),):
            raise InputError(
                f"design {found.name!r}: was made by another bank: name its run folder, which knows the bank, or give "
                "the results of this one"
            )
        yield found


def chosen_of(found: Iterable[Newcomer], only: Iterable[str], leave_out: Iterable[str]) -> list[Newcomer]:
    """Those that join: of `only`, or of all, without `leave_out`.

    Raises
    ------
    InputError
        Naming all at once that were rejected, with the checks that they failed, or that were not judged by their mesh;
        or if a name is unknown, or nobody is left.
    """
    wanted, named = _names(only, "only"), [REJECTED] if leave_out == REJECTED else leave_out
    left = _names(named, "leave_out", f", or {REJECTED!r} for all that were")
    without_rejected = REJECTED in left
    left = left - {REJECTED}
    chosen, seen, told = list[Newcomer](), list[str](), list[str]()
    for newcomer in found:
        seen.append(newcomer.name)
        if newcomer.name in left or (wanted and newcomer.name not in wanted):
            continue
        if newcomer.result.accepted and newcomer.judged:
            chosen.append(newcomer)
        elif newcomer.result.accepted:
            told.append(f"design {newcomer.name!r}: was not judged by its mesh: run its study with level = 'mesh'")
        elif not without_rejected:
            failed = ", ".join(_shown(check) for check in newcomer.result.checks if not check.passed)
            told.append(f"design {newcomer.name!r}: was rejected by {failed}")
    if unknown := sorted((wanted | left) - set(seen)):
        raise InputError(f"designs: no {brief(', '.join(unknown))} among them; there are {brief(', '.join(seen))}")
    if told:
        more = [f"and {len(told) - TOLD} more"] if len(told) > TOLD else []
        lines = "\n  ".join([f"{len(told)} of {len(seen)} designs cannot join:", *told[:TOLD], *more])
        hint = f"leave them out by name, or all that were rejected: leave_out={REJECTED!r}, --leave-out {REJECTED}"
        raise InputError(f"{lines}\n{hint}")
    if not chosen:
        raise InputError(f"designs: expected at least one that was accepted and may join, got none of {len(seen)}")
    return chosen


def _shown(check: Check) -> str:
    limit = "" if check.limit is None else f" (expected {check.sense} {check.limit:.4g})"
    return f"{check.name} {check.value:.4g}{limit}"


def _names(given: object, what: str, more: str = "") -> set[str]:
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise InputError(f"{what}: expected a list of names of designs{more}, got {said(given):.80}")
    names = list(given)
    if wrong := [name for name in names if not isinstance(name, str)]:
        raise InputError(f"{what}: expected a list of names of designs{more}, got one with {said(wrong[0]):.80}")
    return set(names)
