"""Where in a box of parameters exemplars are taken."""

from __future__ import annotations

import numpy as np

from lampopt.types import Array

DESIGNS = ("lhs", "sobol", "random", "ends")


def draws(design: str, count: int, low: Array, high: Array, seed: int) -> Array:
    """`count` rows (count, d) between `low` and `high` (d,).

    `lhs`: Latin hypercube; `sobol`: the first rows of a scrambled Sobol sequence; `random`: independent.
    """
    from scipy.stats import qmc

    d = len(low)
    if design == "lhs":
        unit = qmc.LatinHypercube(d, rng=seed).random(count)
    elif design == "sobol":  # drawn in a whole power of two, which keeps the sequence balanced
        unit = qmc.Sobol(d, rng=seed).random_base2(max(count - 1, 0).bit_length())[:count]
    else:
        unit = np.random.default_rng(seed).random((count, d))
    return np.asarray(low + unit * (high - low))
