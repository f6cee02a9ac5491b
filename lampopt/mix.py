"""Affine mixing: alpha → one flat weight vector and the parameters it predicts (paper, section 3)."""

from __future__ import annotations

import numpy as np

from lampopt.errors import InputError
from lampopt.types import Array, Bank


def mixed_weights(bank: Bank, alpha: Array) -> Array:
    """Wᵀ alpha: (D,) float32 from alpha (N,), or (B, D) from (B, N). Computed without a second copy of the bank.

    Raises
    ------
    InputError
        If `alpha` has not one coefficient per exemplar.
    """
    alpha = np.asarray(alpha)
    if alpha.shape[-1:] != (len(bank),):
        raise InputError(f"alpha: expected {len(bank)} coefficients, one per exemplar, got shape {alpha.shape}")
    largest = float(np.finfo(np.float32).max)
    with np.errstate(over="ignore", invalid="ignore"):  # a mix too far out to be represented has no surface; no crash
        mixed = np.clip(alpha, -largest, largest).astype(np.float32) @ bank.weights
    return np.asarray(np.nan_to_num(mixed, nan=largest, posinf=largest, neginf=-largest))


def predicted(bank: Bank, alpha: Array) -> Array:
    """Pᵀ alpha: (..., d) parameters [units of the bank's space] from alpha (..., N)."""
    return np.asarray(alpha @ bank.parameters)
