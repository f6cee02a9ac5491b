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
    """How far surfaces are off, on average, if each angle p_k acts by its tangent (...,) [box].

    With s_k the surface's motion by τ(p_k) = tan p_k over the exemplars (least squares at the probes) that is

        | Σ_k s_k (τ(Σ_i alpha_i p_ik) − Σ_i alpha_i τ(p_ik)) |

    NaN where no parameter that differs is a slope, or the decoder's values at the probes are neither signed distances
    nor places of a template that it displaces. Takes alpha (..., N).
    """
    slopes, angles = _angles(bank)
    channels = bank.probe_values.shape[-1]
    step = max(1, bank.probe_values.shape[1] // PROBES)
    values = np.asarray(bank.probe_values[:, ::step], float)
    if channels == 1:
        values = values[:, (np.abs(values) <= NEAR).any((0, 2))]
    judged = channels == 1 or (channels == 3 and isinstance(decoder, Displace))
    if not (judged and len(slopes) and values.shape[1]):
        return np.full(alpha.shape[:-1], np.nan)
    asked = alpha @ angles
    share = np.minimum(1.0, np.radians(STEEPEST) / np.maximum(np.abs(asked), 1e-300))  # of the way to there
    tangents = np.tan(angles)
    bent = np.tan(share * asked) - share * (alpha @ tangents)
    off = np.tensordot(bent, _motion(bank, slopes, tangents, values), 1)
    return np.asarray(np.linalg.norm(off, axis=-1).mean(-1))


def _angles(bank: Bank) -> tuple[Array, Array]:
    """Which k parameters are slopes, and those of the exemplars (N, k) [rad]."""
    units = {k: factor(q.unit, "rad", q.name) for k, q in enumerate(bank.space) if q.unit in UNITS and q.spread > 0}
    found = {k: bank.parameters[:, k] * one for k, one in units.items()}
    slopes = [k for k, angles in found.items() if np.abs(angles).max() <= np.radians(WIDEST) * (1 + 1e-9)]
    return np.array(slopes, int), np.array([found[k] for k in slopes]).T


def _motion(bank: Bank, slopes: Array, tangents: Array, values: Array) -> Array:
    """(k, M, C) change of `values` (N, M, C) by each of the `tangents` (N, k) of the parameters `slopes`."""
    known = np.array(bank.parameters)
    known[:, slopes] = tangents
    known -= known.mean(0)
    spread = np.ptp(known, axis=0)
    known = known / np.where(spread > 0, spread, 1.0)
    # Where exemplars are fewer than parameters, causes share what they may each have done, as in a mix.
    found = np.linalg.pinv(known)[slopes] / spread[slopes, None]
    return np.tensordot(found, values - values.mean(0), 1)
