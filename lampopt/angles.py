"""What a mix makes of angles: it moves surfaces in proportion to them, but a slope goes with the tangent.

No exemplar shows it: within a bank's range the difference drowns in the fits' noise (at 8° it is 0.7 % of the motion),
and three times as far out it is the largest error that is left. So it is worked out from the law instead.
"""

from __future__ import annotations

import numpy as np

from lampopt.protocols import Decoder, Displace
from lampopt.types import Array, Bank
from lampopt.units import factor

UNITS = ("deg", "degree", "degrees", "°", "rad", "radian", "radians", "mrad")
WIDEST = 60.0  # of exemplars' angles, up to which they are taken for slopes; beyond, for turns, which have no one law
STEEPEST = 85.0  # of what is asked for: the tangent grows beyond all bounds
PROBES = 4096  # where motion is looked at
NEAR = 0.05  # of the surface, where a signed distance tells how that moves [box]


def deviations(bank: Bank, decoder: Decoder, alpha: Array) -> Array:
    """How far surfaces are off, on average, if each angle acts by its tangent (...,) [box].

    With s_k the surface's motion by angle k over the exemplars (least squares at the probes) and τ = tan that is

        Σ_k s_k (τ(p_k) − Σ_i alpha_i τ(p_ik)),    p_k = Σ_i alpha_i p_ik

    NaN where no parameter that differs is a slope, or the decoder's values at the probes are neither distances nor
    places. Takes alpha (..., N).
    """
    columns, to_radians = _angles(bank)
    channels = bank.probe_values.shape[-1]
    if not len(columns) or not (channels == 1 or (channels == 3 and isinstance(decoder, Displace))):
        return np.full(alpha.shape[:-1], np.nan)
    values = np.asarray(bank.probe_values[:, :PROBES], float)
    if channels == 1:
        values = values[:, (np.abs(values) <= NEAR).any((0, 2))]
        if not values.shape[1]:
            return np.full(alpha.shape[:-1], np.nan)
    angles = bank.parameters[:, columns] * to_radians
    steepest = np.radians(STEEPEST)
    bent = np.tan(np.clip(alpha @ angles, -steepest, steepest)) - alpha @ np.tan(angles)
    motion = _motion(bank, values)[columns] / to_radians[:, None, None]
    return np.asarray(np.linalg.norm(np.tensordot(bent, motion, 1), axis=-1).mean(-1))


def _angles(bank: Bank) -> tuple[Array, Array]:
    """Which parameters are slopes, and what brings each to radians."""
    units = {k: factor(q.unit, "rad", q.name) for k, q in enumerate(bank.space) if q.unit in UNITS and q.spread > 0}
    widest = np.radians(WIDEST)
    slopes = {k: one for k, one in units.items() if np.abs(bank.parameters[:, k]).max() * one <= widest}
    return np.array(list(slopes), int), np.array(list(slopes.values()))


def _motion(bank: Bank, values: Array) -> Array:
    """(d, M, C) change of `values` (N, M, C) by each parameter, over the exemplars."""
    known = np.column_stack([bank.parameters, np.ones(len(bank))])
    scale = np.abs(known).max(0)
    scale[scale == 0] = 1.0
    return np.tensordot(np.linalg.pinv(known / scale)[:-1] / scale[:-1, None], values, 1)
