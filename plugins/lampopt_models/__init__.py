"""Models: labels learned from parameters, no mesh needed; each with its evidence, its intervals and its range."""

from lampopt import hookimpl


@hookimpl
def lampopt_models() -> dict[str, str]:
    """Regressions by name; from the simplest on, and the choice among them."""
    return {
        "linear": "lampopt_models.regressions:Linear",
        "quadratic": "lampopt_models.regressions:Quadratic",
        "gaussian-process": "lampopt_models.regressions:GaussianProcess",
        "boosted-trees": "lampopt_models.regressions:BoostedTrees",
        "best": "lampopt_models.regressions:Best",
    }
