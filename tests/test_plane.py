"""Labels by parameters: planes over exemplars, and what measured designs teach them."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))
import small

from lampopt.plane import Plane, explained
from lampopt.plugins import Plugins


def labelled(values, count=7):
    cars = small.boxes(count=count)
    return small.bank(small.boxes(count=count, labels=np.asarray(values(cars.parameters), float)[:, None]))


def plane(bank, label="drag", plugins=None):
    start = np.full(len(bank), 1 / len(bank))
    return explained(bank, label, start, float(np.nanmean(bank.labels[:, 0])), plugins)


def test_an_affine_label_is_told_exactly():
    bank = labelled(lambda p: 3 + p @ np.arange(1, p.shape[1] + 1))
    np.testing.assert_allclose(plane(bank).values, bank.labels[:, 0], atol=1e-12)


def test_a_quadratic_label_has_the_slope_of_the_place():
    bank = labelled(lambda p: p[:, 0] ** 2 + 3 * p[:, 1])
    found = plane(bank, plugins=Plugins.load())
    spread = np.ptp(bank.parameters, axis=0)
    for row in (bank.parameters[0], bank.parameters.mean(0)):
        np.testing.assert_allclose(found.prior(row / spread) / spread, [2 * row[0], 3], rtol=0.05)


def test_the_share_left_out_is_that_of_fits_without_each_exemplar():
    draw = np.random.default_rng(5)
    seen = set()
    for noise in np.linspace(0, 3, 13):
        bank = labelled(lambda p, noise=noise: p[:, 0] + noise * draw.normal(size=len(p)) * np.ptp(p[:, 0]))
        p, y = bank.parameters, bank.labels[:, 0]
        missed = []
        for left in range(len(p)):
            rest = np.arange(len(p)) != left
            fit = np.linalg.lstsq(np.column_stack([np.ones(rest.sum()), p[rest]]), y[rest], rcond=None)[0]
            missed.append(y[left] - fit @ [1, *p[left]])
        r2 = 1 - np.square(missed).sum() / np.square(y - y.mean()).sum()
        assert (plane(bank) is not None) == (r2 > 0)
        seen.add(r2 > 0)
    assert seen == {True, False}


def test_as_many_parameters_as_exemplars_explain_nothing():
    assert plane(labelled(lambda p: p[:, 0], count=3)) is None


def test_a_label_that_is_the_same_everywhere_tells_nothing():
    assert plane(labelled(lambda p: np.full(len(p), 0.3))) is None


def test_exemplars_without_a_label_have_no_say():
    bank = labelled(lambda p: np.where(np.arange(len(p)) < 2, np.nan, p[:, 0]))
    spread = np.ptp(bank.parameters[:, 0])
    np.testing.assert_allclose(plane(bank).slope, [spread, 0], atol=1e-9)


def test_what_parameters_do_not_tell_has_no_plane_by_any_model():
    noise = np.random.default_rng(4).normal(size=7)
    few = labelled(lambda p: np.where(np.arange(len(p)) < 2, p[:, 0], np.nan))
    for bank in (labelled(lambda p: noise), few):
        for plugins in (None, Plugins.load()):
            assert plane(bank, plugins=plugins) is None


def test_of_two_that_tell_something_the_better_one_is_taken():
    """Noise is what a quadratic model of few exemplars takes for curvature."""
    draw = np.random.default_rng(0)
    noisy = labelled(lambda p: p[:, 0] + 0.3 * draw.normal(size=len(p)) * np.ptp(p[:, 0]))
    curved = labelled(lambda p: 4 * (p[:, 0] - 2.5) ** 2 + p[:, 0])
    for bank, flat in ((noisy, True), (curved, False)):
        rows = bank.parameters / np.ptp(bank.parameters, axis=0)
        slopes = [plane(bank, plugins=Plugins.load()).prior(row) for row in rows[[0, -1]]]
        assert np.allclose(*slopes) == flat


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_a_plane_goes_through_the_last_design_and_learns_of_those_before(seed):
    draw = np.random.default_rng(seed)
    parameters, slope, wrong = draw.normal(size=(9, 4)), draw.normal(size=4), draw.normal(size=4)
    found = Plane(parameters, lambda _: wrong, ((parameters[0], 1.7),))
    np.testing.assert_allclose(found.slope, wrong)
    off = [np.linalg.norm(wrong - slope)]
    for k in range(6):
        alpha = np.full(9, 1 / 9) + 0.1 * (np.eye(9)[k + 1] - 1 / 9)
        alpha = draw.dirichlet(np.ones(9)) if k % 2 else alpha
        value = 1.7 + (alpha @ parameters - parameters[0]) @ slope
        found = found.through(alpha, value)
        assert alpha @ found.values == pytest.approx(value)
        off.append(np.linalg.norm(found.slope - slope))
    assert off[-1] < off[0]
    np.testing.assert_allclose(Plane(parameters, lambda _: slope, found.seen).slope, slope, atol=1e-9)


def test_a_plane_that_seeks_a_value_goes_through_the_design_nearest_to_it():
    parameters = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    found = Plane(parameters, lambda _: np.array([-1.0, 0.0]), ((parameters[0], 2.0),), wanted=1.0)
    found = found.through(np.array([0.5, 0.5, 0.0]), 1.4).through(np.array([0.0, 1.0, 0.0]), 3.0)
    np.testing.assert_array_equal(found.at, [0.5, 0.0])
    assert found.value == 1.4
    assert np.array([0.5, 0.5, 0.0]) @ found.values == pytest.approx(1.4)
    assert found.through(np.array([0.25, 0.75, 0.0]), 1.4).at[0] == 0.75  # of equals the later one
