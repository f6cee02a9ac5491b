"""What can go wrong on the caller's side.

Wrong input and broken plugins raise; a bad outcome (an infeasible target, an unsafe shape) is a result with its
reasons. Every message says what was expected, what arrived and what to do.
"""


class LampoptError(Exception):
    """Root of every error that lampopt raises on purpose."""


class InputError(LampoptError, ValueError):
    """An argument, array, table or option that cannot be used."""


class StudyError(InputError):
    """A study that asks for what does not exist: an unknown name, a wrong unit, a constant parameter."""


class BankError(InputError):
    """A bank file or folder that cannot be read or does not fit what is asked of it."""


class PluginError(LampoptError):
    """A plugin that is missing, broken, misspelt or clashes with another."""


class FitError(LampoptError):
    """A mesh that a decoder cannot fit, named."""


class SolveError(LampoptError):
    """A problem that a solver is not able to take, by the name of the missing ability."""


class SweepError(LampoptError):
    """A sweep that lost a worker, or whose measure failed in passing; what is finished is kept."""


class MeasureError(LampoptError):
    """A feature that is not there to be measured."""

    passing = False  # whether trying again may help


class EmptyMesh(LampoptError):  # noqa: N818  # the name is the protocol's
    """A field without a zero level set, or a mesh without faces."""


def may_pass(error: Exception) -> bool:
    """Whether what failed may come out if it is tried again: a measure's solver was killed, say."""
    return isinstance(error, MeasureError) and bool(error.passing)
