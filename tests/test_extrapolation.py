"""The volume that is reached: counted one by one, and against closed forms; no mesh is made."""

import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binomtest

from lampopt import design, extrapolation_volume
from lampopt.errors import InputError, StudyError
from lampopt.extrapolation import _wilson

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402

PLUGINS = small.plugins()


def test_all_of_it_where_nothing_is_ever_off():
    """An affine decoder without a limit on alpha: every draw is valid, so the ratio is f^d."""
    before = small.CALLS["decode"]
    found = extrapolation_volume(small.bank(), 3, 500, limits={"alpha": 1e9}, plugins=PLUGINS)
    assert (found.share, found.by_mismatch, found.ratio) == (1.0, 1.0, 9.0)
    assert found.parameters == ("length", "width")
    assert found.rejected == {}
    assert small.CALLS["decode"] == before


def test_the_share_is_that_of_designs_made_one_by_one():
    bank = small.bank(decoder="stretch-field", probes=200)
    limits = {"mismatch": 0.02, "mismatch.band": 0.05, "alpha": 1.5}
    count = 300
    found = extrapolation_volume(bank, 2.5, count, limits=limits, seed=4, plugins=PLUGINS)
    low, high = bank.parameters.min(0), bank.parameters.max(0)
    draws = (low + high) / 2 + 2.5 * (high - low) / 2 * np.random.default_rng(4).uniform(-1, 1, (count, 2))
    names = ("length", "width")
    results = [
        design(bank, dict(zip(names, row, strict=True)), level="field", limits=limits, plugins=PLUGINS) for row in draws
    ]
    assert found.share == np.mean([result.accepted for result in results])
    assert 0.05 < found.share < 0.95
    assert found.by_mismatch == np.mean([result.check("mismatch").value <= 0.01 for result in results])
    failed = Counter(check.name for result in results for check in result.checks if not check.passed)
    assert found.rejected == failed
    assert len(failed) > 1


def test_a_closed_form_share():
    """Alpha is affine in the one target, so the limit on it cuts an interval whose part of the range is known."""
    bank = small.bank()
    values = bank.parameters[:, 0]
    centred = values - values.mean()
    limit = 1.0  # ‖alpha − 1/N‖ = |t − mean| / ‖centred‖
    low, high = values.min(), values.max()
    middle, half = (low + high) / 2, 2 * (high - low)
    inside = np.clip(values.mean() + limit * np.linalg.norm(centred) * np.array([-1, 1]), middle - half, middle + half)
    expected = np.ptp(inside) / (2 * half)
    found = extrapolation_volume(bank, 4, 4000, parameters=("length",), limits={"alpha": limit}, plugins=PLUGINS)
    assert found.interval[0] < expected < found.interval[1]
    assert found.ratio == pytest.approx(4 * found.share)


def test_same_seed_same_draws_and_another_seed_others():
    bank = small.bank(decoder="stretch-field")
    one, two, other = (extrapolation_volume(bank, 2.0, 400, seed=s, plugins=PLUGINS) for s in (0, 0, 1))
    assert one == two == extrapolation_volume(bank, np.float32(2), np.int64(400), seed=0, plugins=PLUGINS)
    assert one != other


def test_progress_comes_to_its_end():
    told = []
    extrapolation_volume(small.bank(), 2.0, 600, progress=lambda done, _="": told.append(done), plugins=PLUGINS)
    assert told == sorted(told)
    assert told[-1] == 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"f": 0}, "range factor above 0"),
        ({"f": 1e60}, "at most 1000"),
        ({"f": float("inf")}, "finite number"),
        ({"f": "wide"}, "expected a number"),
        ({"f": 2, "count": 0}, "count: expected at least 1"),
        ({"f": 2, "count": 2.5}, "whole number"),
        ({"f": 2, "count": 10**12}, "at most 1,000,000"),
        ({"f": 2, "seed": -1}, "seed: expected at least 0"),
        ({"f": 2, "seed": None}, "seed: expected at least 0"),
        ({"f": 2, "parameters": ()}, "at least one that differs"),
        ({"f": 2, "parameters": ("length", "length")}, "each once"),
        ({"f": 2, "parameters": "length"}, "a list of names"),
        ({"f": 2, "limits": {"mismatsch": 1}}, "unknown mismatsch"),
    ],
)
def test_what_cannot_be_asked(arguments, message):
    with pytest.raises(InputError, match=message):
        extrapolation_volume(small.bank(), **arguments, plugins=PLUGINS)


def test_a_path_is_no_bank():
    with pytest.raises(InputError, match=r"expected a Bank, got 'a\.lamp'; load one"):
        extrapolation_volume("a.lamp", 2)


def test_an_unknown_parameter_is_told():
    with pytest.raises(StudyError, match="'roof': neither a parameter"):
        extrapolation_volume(small.bank(), 2, parameters=("roof",), plugins=PLUGINS)


@settings(deadline=None)
@given(st.integers(1, 10_000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_the_interval_is_wilsons(numbers):
    passed, count = numbers
    expected = binomtest(passed, count).proportion_ci(0.95, method="wilson")
    assert _wilson(passed, count) == pytest.approx((expected.low, expected.high), abs=1e-9)
