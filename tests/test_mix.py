"""Mixed weights and what they predict, against float64 products."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lampopt.errors import InputError
from lampopt.mix import mixed_weights, predicted
from lampopt.types import Bank, Frame, Parameter, Spec


def bank(n=7, size=1000, seed=0):
    draw = np.random.default_rng(seed)
    return Bank(
        (Parameter("a", "m", 0, 1), Parameter("b", "", -5, 5)), draw.uniform(-5, 5, (n, 2)), (), np.empty((n, 0)),
        tuple(map(str, range(n))), draw.normal(size=(n, size)).astype(np.float32), {}, Frame(1.0, np.zeros(3)),
        Spec("none"), np.zeros((1, 3)), np.zeros((n, 1, 1)), np.zeros(n),
    )  # fmt: skip


def coefficients(seed, *shape):
    alpha = np.random.default_rng(seed).normal(size=shape)
    return alpha + (1 - alpha.sum(-1, keepdims=True)) / shape[-1]


@settings(max_examples=30, deadline=None)
@given(n=st.integers(1, 12), seed=st.integers(0, 1000), reach=st.floats(0, 20))
def test_equals_the_product_in_double_precision(n, seed, reach):
    b = bank(n, 50, seed)
    alpha = 1 / n + reach * (coefficients(seed, n) - 1 / n)
    found = mixed_weights(b, alpha)
    wanted = alpha @ b.weights.astype(float)
    assert found.shape == (50,)
    assert found.dtype == np.float32
    # rounding of n products: each at most half an ulp of |alpha_i w_i|, twice over
    room = 2 * n * np.finfo(np.float32).eps * (np.abs(alpha) @ np.abs(b.weights.astype(float)))
    assert (np.abs(found - wanted) <= room + 1e-12).all()


def test_a_one_hot_mix_is_the_exemplar_to_the_bit():
    b = bank()
    for i in range(7):
        np.testing.assert_array_equal(mixed_weights(b, np.eye(7)[i]), b.weights[i])


def test_a_batch_is_one_by_one():
    b, alpha = bank(), coefficients(1, 3, 7)
    found = mixed_weights(b, alpha)
    assert found.shape == (3, 1000)
    np.testing.assert_allclose(found, [mixed_weights(b, row) for row in alpha], atol=1e-5)
    assert mixed_weights(b, np.empty((0, 7))).shape == (0, 1000)
    assert predicted(b, alpha).shape == (3, 2)


def test_lists_will_do():
    b = bank(2, 3)
    np.testing.assert_allclose(mixed_weights(b, [0.5, 0.5]), b.weights.mean(0), atol=1e-6)


@pytest.mark.parametrize("alpha", [np.ones(6), np.ones(8), np.ones((7, 3)), np.ones(()), np.ones(0)])
def test_one_coefficient_an_exemplar(alpha):
    with pytest.raises(InputError, match="alpha: expected 7 coefficients, one per exemplar, got shape"):
        mixed_weights(bank(), alpha)


def test_predicted_is_the_same_mix_of_parameters():
    b, alpha = bank(), coefficients(2, 7)
    np.testing.assert_allclose(predicted(b, alpha), b.parameters.T @ alpha, atol=1e-12)
    for i in range(7):
        np.testing.assert_array_equal(predicted(b, np.eye(7)[i]), b.parameters[i])


def test_the_bank_stays_as_it_is():
    b = bank()
    before = b.weights.copy()
    mixed_weights(b, coefficients(3, 7))[:] = 0
    np.testing.assert_array_equal(b.weights, before)
