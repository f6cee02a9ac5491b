"""What can become of a flow solution besides numbers: every way to fail has a name."""

from __future__ import annotations

from typing import Literal, get_args

from lampopt.errors import MeasureError

Outcome = Literal[
    "absent",  # no OpenFOAM where it was looked for
    "refused-mesh",  # a surface that no flow can be solved around, or that would give a wrong one
    "bad-grid",  # no grid, or one that fails the checks
    "diverged",  # coefficients that grow without bound, or are no numbers
    "not-settled",  # all iterations done, and the mean still moves
    "killed",  # a tool ended by a signal from outside
    "disk-full",
    "timed-out",
    "failed",  # a tool that ended with an error of its own
]
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
ROOM = "make room, or name another folder="
LASTING = frozenset({"bad-grid", "diverged", "not-settled"})  # trying again gives them again: they are kept as results


class FlowError(MeasureError):
    """A flow that was not solved. `outcome` names the way; the message says where the log is and what to do.

    `passing` says whether trying again may help.
    """

    def __init__(self, message: str, outcome: Outcome) -> None:
        super().__init__(message, outcome)
        self.outcome: Outcome = outcome
        self.passing = outcome not in LASTING and outcome != "refused-mesh"

    def __str__(self) -> str:
        return f"openfoam-drag: {self.outcome}: {self.args[0]}"
