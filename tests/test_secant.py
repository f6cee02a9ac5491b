"""Labels by parameters: planes over exemplars, and what measured designs teach them."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))
import small

from lampopt.secant import Plane, explained


def labelled(values, count=7):
    cars = small.boxes(count=count)
    return small.bank(small.boxes(count=count, labels=np.asarray(values(cars.parameters), float)[:, None]))


def test_an_affine_label_is_told_exactly():
    bank = labelled(lambda p: 3 + p @ np.arange(1, p.shape[1] + 1))
    plane = explained(bank, "drag")
    np.testing.assert_allclose(plane.values, bank.labels[:, 0], atol=1e-12)


def test_the_share_left_out_is_that_of_fits_without_each_exemplar():
    draw = np.random.default_rng(5)
    for noise in np.linspace(0, 3, 13):
        bank = labelled(lambda p, noise=noise: p[:, 0] + noise * draw.normal(size=len(p)) * np.ptp(p[:, 0]))
        p, y = bank.parameters, bank.labels[:, 0]
        missed = []
        for left in range(len(p)):
            rest = np.arange(len(p)) != left
            fit = np.linalg.lstsq(np.column_stack([np.ones(rest.sum()), p[rest]]), y[rest], rcond=None)[0]
            missed.append(y[left] - fit @ [1, *p[left]])
        r2 = 1 - np.square(missed).sum() / np.square(y - y.mean()).sum()
        assert (explained(bank, "drag") is not None) == (r2 > 0.5)


def test_as_many_parameters_as_exemplars_explain_nothing():
    bank = labelled(lambda p: p[:, 0], count=3)
    assert explained(bank, "drag") is None


def test_exemplars_without_a_label_have_no_say():
    bank = labelled(lambda p: np.where(np.arange(len(p)) < 2, np.nan, p[:, 0]))
    known = np.isfinite(bank.labels[:, 0])
    np.testing.assert_allclose(explained(bank, "drag").values[known], bank.labels[known, 0], atol=1e-12)


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_a_measured_design_is_told_and_what_it_does_not_show_stays(seed):
    draw = np.random.default_rng(seed)
    before = Plane(draw.normal(size=(9, 4)), draw.normal(size=4), draw.normal(size=4), 1.7)
    alpha = draw.dirichlet(np.ones(9))
    after = before.through(alpha, 2.5)
    assert alpha @ after.values == pytest.approx(2.5)
    step = after.at - before.at
    assert after.value - after.slope @ step == pytest.approx(1.7)
    across = np.linalg.svd(step[None])[2][1:]
    np.testing.assert_allclose(across @ after.slope, across @ before.slope, atol=1e-9)
