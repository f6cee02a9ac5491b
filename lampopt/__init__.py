"""lampopt: parameter-controlled shapes from a few dozen exemplars."""

from lampopt.active import Pursuit, Trial, active
from lampopt.asktell import AskTell, Candidate
from lampopt.bank import build_bank
from lampopt.calibrate import calibrate
from lampopt.compare import compare
from lampopt.compress import compress
from lampopt.enrich import enrich
from lampopt.exemplars import exemplars
from lampopt.experiments import Experiments, experiments
from lampopt.explore import Exploration, SafeInterval, explore
from lampopt.extrapolation import extrapolation_volume
from lampopt.fitted import fit_model, fit_surrogate, load_measure, load_model
from lampopt.front import Front, Reduction, front
from lampopt.goals import Linear, Maximise, Minimise, Reduce
from lampopt.hookspecs import hookimpl
from lampopt.intake import intake, wrap
from lampopt.label import label
from lampopt.lamp import load_bank, store_bank
from lampopt.loop import design, measure, report, results, run, sweep
from lampopt.members import add_exemplars, remove_exemplars
from lampopt.motion import Sensitivities, sensitivities, template_of, warp
from lampopt.preview import Preview
from lampopt.recommend import Compared, Comparison
from lampopt.residuals import Residual, residuals
from lampopt.response import Response
from lampopt.study import Study
from lampopt.types import Bank, Check, Design, Exemplars, Frame, Mix, Parameter, Problem, Result, Spec

__all__ = [
    "AskTell",
    "Bank",
    "Candidate",
    "Check",
    "Compared",
    "Comparison",
    "Design",
    "Exemplars",
    "Experiments",
    "Exploration",
    "Frame",
    "Front",
    "Linear",
    "Maximise",
    "Minimise",
    "Mix",
    "Parameter",
    "Preview",
    "Problem",
    "Pursuit",
    "Reduce",
    "Reduction",
    "Residual",
    "Response",
    "Result",
    "SafeInterval",
    "Sensitivities",
    "Spec",
    "Study",
    "Trial",
    "active",
    "add_exemplars",
    "build_bank",
    "calibrate",
    "compare",
    "compress",
    "design",
    "enrich",
    "exemplars",
    "experiments",
    "explore",
    "extrapolation_volume",
    "fit_model",
    "fit_surrogate",
    "front",
    "hookimpl",
    "intake",
    "label",
    "load_bank",
    "load_measure",
    "load_model",
    "measure",
    "remove_exemplars",
    "report",
    "residuals",
    "results",
    "run",
    "sensitivities",
    "store_bank",
    "sweep",
    "template_of",
    "warp",
    "wrap",
]
