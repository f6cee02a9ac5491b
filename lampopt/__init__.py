"""lampopt: parameter-controlled shapes from a few dozen exemplars."""

from lampopt.bank import build_bank
from lampopt.exemplars import exemplars
from lampopt.hookspecs import hookimpl
from lampopt.lamp import load_bank, store_bank
from lampopt.loop import design, measure, run, sweep
from lampopt.study import Reduce, Study
from lampopt.types import Bank, Check, Design, Exemplars, Frame, Mix, Parameter, Problem, Result, Spec

__all__ = [
    "Bank",
    "Check",
    "Design",
    "Exemplars",
    "Frame",
    "Mix",
    "Parameter",
    "Problem",
    "Reduce",
    "Result",
    "Spec",
    "Study",
    "build_bank",
    "design",
    "exemplars",
    "hookimpl",
    "load_bank",
    "measure",
    "run",
    "store_bank",
    "sweep",
]
