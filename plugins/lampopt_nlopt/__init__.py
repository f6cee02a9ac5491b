"""Solver `nlopt`: objectives and constraints of any kind, with their gradients or without."""

from lampopt import hookimpl


@hookimpl
def lampopt_solvers() -> dict[str, type | str]:
    """Offer `nlopt`."""
    return {"nlopt": "lampopt_nlopt.solver:NLopt"}
