"""Solver `casadi`: bounds, inequalities, models and labels as targets, constraints and objectives."""

from lampopt import hookimpl


@hookimpl
def lampopt_solvers() -> dict[str, type | str]:
    """Offer `casadi`."""
    return {"casadi": "lampopt_casadi.solver:CasADi"}
