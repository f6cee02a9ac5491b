"""The records that flow between the stages: frozen, read-only, checked when they are made.

Letters (docs/notation.md): N exemplars, d parameters, p labels, D weights, k rows, M points, C channels, B designs.
"""

from lampopt.types.arrays import ROUNDING, Array, frozen_array
from lampopt.types.bank import Bank, Exemplars, Frame, Parameter, Scalar, Spec, expect_bank
from lampopt.types.calibration import Calibration
from lampopt.types.design import LEVELS, Check, Design, Needs, Result, Sense
from lampopt.types.lowrank import LowRank
from lampopt.types.problem import (
    BOUNDS,
    Conflict,
    Expressible,
    Mix,
    MixBatch,
    Problem,
    Status,
    Term,
    called,
    gave,
    missed,
    rough,
)

__all__ = [
    "BOUNDS",
    "LEVELS",
    "ROUNDING",
    "Array",
    "Bank",
    "Calibration",
    "Check",
    "Conflict",
    "Design",
    "Exemplars",
    "Expressible",
    "Frame",
    "LowRank",
    "Mix",
    "MixBatch",
    "Needs",
    "Parameter",
    "Problem",
    "Result",
    "Scalar",
    "Sense",
    "Spec",
    "Status",
    "Term",
    "called",
    "expect_bank",
    "frozen_array",
    "gave",
    "missed",
    "rough",
]
