"""Solver `kkt`: the closed form of equation (1)."""

from lampopt import hookimpl


@hookimpl
def lampopt_solvers() -> dict[str, type | str]:
    """Offer `kkt`."""
    return {"kkt": "lampopt_kkt.kkt:KKT"}
