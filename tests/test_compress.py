"""Weights by few directions: as the array that they stand for, and as far off as is stated."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lampopt
from lampopt import cli
from lampopt.errors import InputError
from lampopt.mix import mixed_weights
from lampopt.types.lowrank import LowRank

sys.path.insert(0, str(Path(__file__).parent))
import small


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_it_behaves_as_the_array_that_it_stands_for(seed):
    rng = np.random.default_rng(seed)
    n, rank, size = (int(k) for k in rng.integers(1, 9, 3))
    weights = LowRank(rng.normal(size=size), rng.normal(size=(n, rank)), rng.normal(size=(rank, size)))
    full = np.asarray(weights)
    assert full.shape == weights.shape and len(weights) == n and weights.dtype == full.dtype == np.float32
    alphas, column = rng.normal(size=(4, n)).astype(np.float32), rng.normal(size=size).astype(np.float32)
    for found, true in (
        (alphas @ weights, alphas @ full),
        (alphas[0] @ weights, alphas[0] @ full),
        (weights @ column, full @ column),
        (weights[n - 1], full[n - 1]),
        (weights[:, :2], full[:, :2]),
        (weights[np.arange(n) % 2 == 0], full[np.arange(n) % 2 == 0]),
        (np.stack([*weights]), full),
        (np.concatenate([weights, full]), np.concatenate([full, full])),
    ):
        np.testing.assert_allclose(found, true, atol=1e-4)


@pytest.fixture(scope="module")
def bank():
    """Boxes, each a little off what length and width tell, by so much that it is told from rounding."""
    made = small.bank()
    weights = made.weights + 1e-4 * np.random.default_rng(0).normal(size=made.weights.shape).astype(np.float32)
    values = np.stack([small.Stretch().evaluate({}, row, made.probes) for row in weights])
    return replace(made, weights=weights, probe_values=values, path=None)


def test_as_few_directions_as_the_error_allows(bank):
    coarse = lampopt.compress(bank, "1 mm", plugins=small.plugins())
    assert coarse.provenance["low_rank.rank"] == coarse.weights.directions.shape[0] == 2
    assert coarse.weights.nbytes < bank.weights.nbytes
    assert coarse.provenance["plan"] != bank.provenance["plan"]  # no build takes it for its own
    said = np.stack([small.Stretch().evaluate({}, row, bank.probes) for row in coarse.weights])
    off = np.linalg.norm(said - bank.probe_values, axis=-1) / bank.frame.scale
    assert coarse.provenance["low_rank.error"] == pytest.approx(off.mean(), rel=1e-3)
    assert off.mean() <= 1e-3
    assert coarse.provenance["low_rank.worst"] == pytest.approx(off.max(), rel=1e-3)
    alpha = np.array([0.5, -0.2, 0.3, 0.1, 0.1, 0.1, 0.1])
    assert mixed_weights(coarse, alpha) == pytest.approx(mixed_weights(bank, alpha), abs=1e-3)


def test_the_error_is_kept_on_all_probes_where_it_was_sought_on_few(bank, monkeypatch):
    monkeypatch.setattr(sys.modules["lampopt.compress"], "LOOK", 1)
    probes = np.array([[0.0, 0.0, 0.0], [0.5, 0.5, 0.5]])  # the first sees no length and no width, only the middle
    values = np.stack([small.Stretch().evaluate({}, row, probes) for row in bank.weights])
    made = lampopt.compress(replace(bank, probes=probes, probe_values=values), "1 mm", plugins=small.plugins())
    assert made.provenance["low_rank.error"] <= 1e-3
    assert made.provenance["low_rank.rank"] == 2


def test_files_keep_it_and_designs_come_of_it(bank, tmp_path):
    made = lampopt.compress(bank, "1 mm", plugins=small.plugins())
    stored = lampopt.store_bank(made, tmp_path / "few.lamp")
    assert isinstance(stored.weights, LowRank)
    for name in ("middle", "coefficients", "directions"):
        np.testing.assert_array_equal(getattr(stored.weights, name), getattr(made.weights, name))
    results = [
        lampopt.run(lampopt.Study(one, targets={"length": 2.7}), plugins=small.plugins()) for one in (stored, bank)
    ]
    few, all_ = (result.design.mesh.extents for result in results)
    assert few == pytest.approx(all_, abs=5e-3)
    assert results[0].accepted


def test_limits_for_other_weights_are_dropped():
    found = lampopt.calibrate(small.bank(), 0.1, plugins=small.plugins())
    made = lampopt.compress(found, "1 mm", plugins=small.plugins())
    assert found.calibration is not None
    assert made.calibration is None and not {*found.calibration.checks} & {*made.limits}


def test_where_nothing_is_gained_it_says_so(bank):
    for error in (1e-12, "20 µm"):
        with pytest.raises(InputError, match="nothing is gained"):
            lampopt.compress(bank, error, plugins=small.plugins())


def test_a_compressed_bank_is_changed_by_way_of_what_it_was_made_of(bank):
    made = lampopt.compress(bank, "1 mm", plugins=small.plugins())
    for change in (
        lambda: lampopt.compress(made, "2 mm", plugins=small.plugins()),
        lambda: lampopt.remove_exemplars(made, ["box_0"]),
        lambda: lampopt.add_exemplars(made, small.boxes(), plugins=small.plugins()),
    ):
        with pytest.raises(InputError, match="expected a bank with its own weights, got a compressed one"):
            change()


def test_a_design_of_too_few_directions_fails_its_mismatch(bank):
    made = lampopt.compress(bank, "500 mm", plugins=small.plugins())
    assert made.provenance["low_rank.rank"] < 2
    result = lampopt.run(lampopt.Study(made, targets={"length": 2.9, "width": 1.1}), plugins=small.plugins())
    assert not result.check("mismatch").passed


def test_products_that_overflow_are_no_weights():
    with pytest.raises(InputError, match="weights: expected finite values"):
        LowRank([0.0], [[3e38], [0.0]], [[3e38]])


@pytest.mark.parametrize("error", [0, -1.0, "0 mm", float("nan"), "3 kg", "little"])
def test_errors_are_positive_lengths(bank, error):
    with pytest.raises(InputError, match="error"):
        lampopt.compress(bank, error, plugins=small.plugins())


def test_the_command_line(tmp_path, capsys, monkeypatch):
    lampopt.store_bank(small.bank(), tmp_path / "boxes.lamp")
    plugins = small.plugins()
    monkeypatch.setattr("lampopt.plugins.Plugins.load", lambda *args, **options: plugins)
    out = tmp_path / "few.lamp"
    assert cli.main(["bank", "compress", str(tmp_path / "boxes.lamp"), "--error", "1 mm", "--out", str(out)]) == 0
    assert "2 directions of 7 exemplars" in capsys.readouterr().err
    assert isinstance(lampopt.load_bank(out).weights, LowRank)
    before = out.read_bytes()
    assert cli.main(["bank", "compress", str(tmp_path / "boxes.lamp"), "--error", "1 mm", "--out", str(out)]) == 2
    assert "is there already, and is not replaced" in capsys.readouterr().err
    assert out.read_bytes() == before
