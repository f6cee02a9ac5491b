"""What a checker has to do: asked about designs of a bank of boxes, or about its own `example_design()`."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any, get_args

import numpy as np

from lampopt.bank import build_bank
from lampopt.loop import run
from lampopt.protocols import Checker
from lampopt.study import Study
from lampopt.testing import shapes
from lampopt.testing.bench import same_mesh
from lampopt.testing.engine import COMMON, CheckFunction, NotApplicable, expect, require
from lampopt.types import Bank, Check, Design, Exemplars, Needs, Parameter


@cache
def _boxes() -> tuple[Bank, list[Design], frozenset[str]]:
    """A bank of five boxes, and a box between them and one beyond; how lampopt's own checks of these are called."""
    sizes = np.array([[1.0, 0.5], [1.2, 0.5], [1.4, 0.6], [1.1, 0.7], [1.3, 0.8]])
    meshes = [shapes.box([length, width, 0.4], divisions=3) for length, width in sizes]
    space = (Parameter("length", "m"), Parameter("width", "m"))
    measured = {"length": "extents.length", "width": "extents.width"}
    bank = build_bank(Exemplars(sizes, space, meshes, tuple("abcde"), measured=measured), "vertex-template")
    asks = ({"length": 1.25, "width": 0.6}, {"length": 1.6})
    found = [run(Study(bank, ask)) for ask in asks]
    return bank, [result.design for result in found], frozenset(check.name for check in found[0].checks)


def _asked(checker: Any) -> tuple[Bank, tuple[Design, ...]]:
    if hasattr(checker, "example_design"):
        bank, *designs = checker.example_design()
    else:
        bank, designs, _ = _boxes()
    return bank, tuple(replace(design) for design in designs)  # each makes a mesh of its own, which may be spoilt


def _told(checker: Any) -> list[tuple[Check, ...]]:
    """What it says of each design."""
    bank, designs = _asked(checker)
    return [tuple(checker(bank, design)) for design in designs]


def check_checker_protocol(checker: Any) -> None:
    """Checks run in the order of what they need, so that a sweep stops before the dear ones."""
    require(checker, Checker)
    expect(checker.needs in get_args(Needs), f"needs: expected one of {get_args(Needs)}, got {checker.needs!r}")


def check_checks_are_told(checker: Any) -> None:
    """A design is accepted by its checks, each known by a name of its own and grouped by what it needed."""
    bank, designs = _asked(checker)
    for design in designs:
        found = checker(bank, design)
        good = isinstance(found, (list, tuple)) and all(isinstance(check, Check) for check in found)
        expect(good, f"expected a list of lampopt.Check, got {found!r:.80}")
        names = [check.name for check in found]
        expect(all(names) and len(set(names)) == len(names), f"expected distinct names, got {names}")
        taken = set(names) & _boxes()[2]
        expect(not taken, f"expected names of its own, got {sorted(taken)}, as lampopt's are called")
        other = {check.needs for check in found} - {checker.needs}
        expect(not other, f"expected checks that need {checker.needs!r} as it says, got {sorted(other)}")
    if not any(_told(checker)):
        raise NotApplicable("it says nothing about boxes; `example_design()` tells what it is made for")


def check_checking_is_deterministic(checker: Any) -> None:
    """A design that is made again from its record has to be judged as it was, whatever was judged in between."""
    first, again = _told(checker), _told(checker)
    expect(repr(first) == repr(again), f"judged twice, a design gets {first} and {again}")


def check_design_is_left(checker: Any) -> None:
    """The checks that follow see the same design, and the user's file is written from it."""
    bank, designs = _asked(checker)
    for design in designs:
        mesh = design.mesh
        before = None if mesh is None else mesh.copy()
        checker(bank, design)
        if mesh is not None and before is not None:
            expect(same_mesh(mesh, before), "the checker changed the mesh that it was given: expected a copy to be")


def check_no_mesh_is_made_unasked(checker: Any) -> None:
    """A sweep judges a hundred thousand mixes before it makes a mesh: what looks at one has to say so in `needs`."""
    if checker.needs == "mesh":
        raise NotApplicable("it says that it needs a mesh")
    bank, designs = _asked(checker)
    for design in designs:
        checker(bank, design)
        made = "mesh" in vars(design)
        expect(not made, f"it says that it needs {checker.needs!r}, and has a mesh made: expected needs = 'mesh'")


CHECKS: tuple[CheckFunction, ...] = (
    check_checker_protocol,
    *COMMON,
    check_checks_are_told,
    check_checking_is_deterministic,
    check_design_is_left,
    check_no_mesh_is_made_unasked,
)
