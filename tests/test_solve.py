"""What is asked, posed as a problem and told back in the user's units."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lampopt.errors import InputError, PluginError, StudyError
from lampopt.solve import column, columns, explain, pose, solve, solve_many
from lampopt.types import Bank, Conflict, Frame, Mix, MixBatch, Parameter, Spec
from lampopt_kkt.kkt import KKT

LENGTH, WIDTH = [2.0, 3.0, 2.5, 2.2, 2.8, 2.4], [1400.0, 1500.0, 2000.0, 1700.0, 1600.0, 1900.0]
DRAG = [0.30, np.nan, 0.25, 0.28, np.nan, 0.35]


def bank(**changes):
    """Six exemplars: length [m], width [mm], a constant; drag known of four, lift of none, mass the same for all."""
    n = 6
    given = {
        "space": (Parameter("length", "m", 2, 3), Parameter("width", "mm", 1400, 2000), Parameter("wheels", "", 4, 4)),
        "parameters": np.column_stack([LENGTH, WIDTH, np.full(n, 4.0)]),
        "label_space": (Parameter("drag"), Parameter("lift", "N"), Parameter("mass", "kg")),
        "labels": np.column_stack([DRAG, np.full(n, np.nan), np.full(n, 1200.0)]),
        "names": tuple(f"car_{i}" for i in range(n)),
        "weights": np.random.default_rng(0).normal(size=(n, 7)),
        "shared": {},
        "frame": Frame(1.0, np.zeros(3)),
        "decoder": Spec("none"),
        "probes": np.zeros((1, 3)),
        "probe_values": np.zeros((n, 1, 1)),
        "fit_error": np.zeros(n),
        "measured_by": {"length": "extents.length"},
        "measured": np.array(LENGTH)[:, None] + 0.01,
    }
    return Bank(**(given | changes))


def test_columns_are_parameters_labels_and_measured_values():
    found = columns(bank())
    assert list(found) == ["length", "width", "wheels", "drag", "lift", "mass", "extents.length"]
    assert [c.unit for c in found.values()] == ["m", "mm", "", "", "N", "kg", "m"]
    np.testing.assert_array_equal(found["width"].values, WIDTH)
    np.testing.assert_array_equal(found["drag"].values, DRAG)
    np.testing.assert_allclose(found["extents.length"].values, np.array(LENGTH) + 0.01)


def test_the_ends_of_the_range_are_minus_one_and_one():
    for name, low, high in (("length", 2, 3), ("width", 1400, 2000), ("drag", 0.25, 0.35)):
        c = column(bank(), name)
        np.testing.assert_allclose(c.normalised([low, (low + high) / 2, high, 2 * high - low]), [-1, 0, 1, 3])
        assert (c.low, c.spread) == (low, pytest.approx(high - low))


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=9).filter(lambda v: np.ptp(v) > 1e-3),
    st.floats(-1e6, 1e6),
)
def test_normalised_is_affine_with_ends_at_one(values, value):
    n = len(values)
    b = bank(
        space=(Parameter("q", "m"),), parameters=np.array(values)[:, None], names=tuple(map(str, range(n))),
        labels=np.zeros((n, 3)), weights=np.ones((n, 2)), probe_values=np.zeros((n, 1, 1)), fit_error=np.zeros(n),
        measured_by={}, measured=None,
    )  # fmt: skip
    c = column(b, "q")
    scaled = c.normalised(c.values)
    assert (scaled.min(), scaled.max()) == (pytest.approx(-1), pytest.approx(1))
    assert (c.normalised(value) + 1) / 2 * c.spread + c.low == pytest.approx(value, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("roof", r"'roof': neither a parameter, a label nor a measured value; known are length, width, wheels, drag"),
        ("wheels", "'wheels': all exemplars have 4: no mix can change it"),
        ("mass", r"'mass': all exemplars have 1200 kg: no mix can change it"),
        ("lift", r"'lift': no exemplar of this bank has a value for it"),
        ("extents.width", r"'extents.width': neither"),
        ("Length", r"'Length': neither"),
    ],
)
def test_what_cannot_be_asked_is_refused(name, said):
    with pytest.raises(StudyError, match=said):
        pose(bank(), {name: 1.0})
    with pytest.raises(StudyError, match=said):
        pose(bank(), {}, ranges={name: (0.0, 1.0)})


def test_a_posed_problem_is_normalised():
    posed = pose(bank(), {"length": 3.5, "width": 1400.0}, hard=["width"])
    p = posed.problem
    assert p.names == ("length", "width")
    np.testing.assert_allclose(p.target, [2.0, -1.0])
    np.testing.assert_allclose(p.matrix[0], 2 * (np.array(LENGTH) - 2) - 1)
    np.testing.assert_allclose(p.matrix[1], (np.array(WIDTH) - 1700) / 300)
    assert p.hard.tolist() == [False, True]
    np.testing.assert_allclose(p.centre, 1 / 6)
    assert posed.active.tolist() == list(range(6))
    np.testing.assert_allclose(posed.normalised(np.array([[3.5, 1400.0], [2.5, 1700.0]])), [[2, -1], [0, 0]])


def test_ranges_are_normalised_rows_of_their_own():
    p = pose(bank(), {"length": 2.5}, ranges={"length": (2.25, 3.0), "width": (1400.0, np.inf)}).problem
    assert p.range_names == ("length (range)", "width (range)")
    np.testing.assert_allclose(p.range_low, [-0.5, -1])
    np.testing.assert_allclose(p.range_high, [1, np.inf])
    np.testing.assert_allclose(p.range_matrix[0], p.matrix[0])
    with pytest.raises(StudyError, match="expected low ≤ high, got 3 to 2"):
        pose(bank(), {}, ranges={"length": (3.0, 2.0)})
    with pytest.raises(StudyError, match="expected low ≤ high"):
        pose(bank(), {}, ranges={"length": (np.nan, 2.0)})
    for end in (-np.inf, np.inf):
        with pytest.raises(StudyError, match="expected a range with numbers in it"):
            pose(bank(), {}, ranges={"length": (end, end)})


@pytest.mark.parametrize("ranges", [None, (1000.0, 1e15), (-1e15, 1500.0)])
def test_what_no_mix_can_be_told_apart_at_is_refused(ranges):
    targets, ranges = ({"width": 1e15}, {}) if ranges is None else ({}, {"width": ranges})
    with pytest.raises(StudyError, match=r"width: expected a value within 1e\+09 half ranges .* mm: is the unit right"):
        pose(bank(), targets, ranges=ranges)


def test_what_differs_by_rounding_does_not_differ():
    """0.1 + 0.2 is not 0.3, and no direction for a mix to go."""
    noisy = np.array([0.3, 0.1 + 0.2] * 3)
    given, even = (bank(parameters=np.column_stack([LENGTH, WIDTH, column])) for column in (noisy, np.full(6, 0.3)))
    np.testing.assert_array_equal(given.parameters, even.parameters)
    assert Parameter("wheels", "", 0.3, 0.1 + 0.2).spread == 0
    with pytest.raises(StudyError, match=r"'wheels': all exemplars have 0\.3: no mix can change it"):
        column(given, "wheels")
    labelled = bank(labels=np.column_stack([DRAG, np.full(6, np.nan), noisy]))
    assert columns(labelled)["mass"].spread == 0


def test_exemplars_without_the_label_take_no_part():
    posed = pose(bank(), {"drag": 0.2, "length": 2.6})
    assert posed.active.tolist() == [0, 2, 3, 5]
    assert posed.problem.matrix.shape == (2, 4)
    # length keeps the range of the whole bank, not of those that take part
    np.testing.assert_allclose(posed.problem.target, [-2, 0.2])
    mix = solve(posed, KKT())
    assert mix.alpha.shape == (6,)
    assert mix.alpha[[1, 4]].tolist() == [0, 0]
    assert mix.alpha.sum() == pytest.approx(1)
    assert np.nan_to_num(DRAG) @ mix.alpha == pytest.approx(0.2)
    assert np.array(LENGTH) @ mix.alpha == pytest.approx(2.6)
    np.testing.assert_allclose(posed.centre(), [0.25, 0, 0.25, 0.25, 0, 0.25])


def test_a_range_on_a_label_leaves_them_out_too():
    assert pose(bank(), {"length": 2.5}, ranges={"drag": (0.2, 0.3)}).active.tolist() == [0, 2, 3, 5]


def test_labels_that_no_exemplar_has_together():
    labels = np.column_stack([[1.0, 2.0, 3.0, np.nan, np.nan, np.nan], [np.nan] * 3 + [1.0, 2.0, 3.0], np.zeros(6)])
    with pytest.raises(StudyError, match="no exemplar has all of drag, lift"):
        pose(bank(labels=labels), {"drag": 1.0, "lift": 1.0})


def test_a_single_labelled_exemplar_cannot_move_its_label():
    labels = np.column_stack([[1.0] + [np.nan] * 5, np.zeros(6), np.zeros(6)])
    with pytest.raises(StudyError, match="'drag': all exemplars have 1"):
        pose(bank(labels=labels), {"drag": 2.0})


def test_the_centre_is_the_reference():
    posed = pose(bank(), {"length": 2.5}, reference="car_2")
    assert posed.problem.centre.tolist() == [0, 0, 1, 0, 0, 0]
    np.testing.assert_allclose(solve(posed, KKT()).alpha, np.eye(6)[2], atol=1e-12)  # car_2 is 2.5 m long
    with pytest.raises(StudyError, match=r"reference 'bus': no exemplar of this bank; there are car_0, car_1"):
        pose(bank(), {"length": 2.5}, reference="bus")
    with pytest.raises(StudyError, match="reference 'car_1': lacks a label"):
        pose(bank(), {"drag": 0.3}, reference="car_1")
    assert pose(bank(), {"drag": 0.3}, reference="car_3").problem.centre.tolist() == [0, 0, 1, 0]


def test_nothing_asked_is_the_mean():
    mix = solve(pose(bank(), {}), KKT())
    np.testing.assert_allclose(mix.alpha, 1 / 6)
    assert mix.status == "exact"


def test_a_measured_value_can_be_asked():
    mix = solve(pose(bank(), {"extents.length": 2.61}), KKT())
    assert np.array(LENGTH) @ mix.alpha == pytest.approx(2.6)


def test_a_contradiction_is_told_in_the_users_units():
    # what is measured is the parameter and 0.01 m: 2.5 m and 2.71 m ask for 0.2 m that do not exist
    posed = pose(bank(), {"length": 2.5, "width": 1650.0, "extents.length": 2.71})
    mix = solve(posed, KKT())
    assert mix.status == "infeasible"
    assert [set(c.names) for c in mix.conflicts] == [{"length", "extents.length"}]
    assert "length 2.5 → 2.6 m, extents.length 2.71 → 2.61 m would agree" in mix.message
    assert "width" not in mix.message


def test_a_unit_that_is_none_leaves_no_blank():
    values = np.column_stack([[0.2, 0.3, 0.4, 0.5, 0.6, 0.7], [0.4, 0.6, 0.8, 1.0, 1.2, 1.4], np.zeros(6)])
    labels = (Parameter("drag"), Parameter("twice"), Parameter("mass"))
    mix = solve(pose(bank(labels=values, label_space=labels), {"drag": 0.4, "twice": 0.8 + 0.1}), KKT())
    # both rows normalise alike, 0.1 in 1.0 is 0.2 in half ranges; each gives half of it
    assert mix.message.endswith("drag 0.4 → 0.425, twice 0.9 → 0.85 would agree; drag 0.4 → 0.45 alone would be enough")


def test_explain_adds_nothing_where_nothing_clashes():
    posed = pose(bank(), {"length": 2.6, "width": 1600.0})
    mix = solve(posed, KKT())
    assert mix.message == explain(posed, mix) == "every target is met"


def test_explain_takes_any_solvers_conflicts():
    posed = pose(bank(), {"width": 1700.0, "length": 2.5})
    mix = Mix(np.full(6, 1 / 6), np.zeros(2), "infeasible", "cannot", (Conflict(("length",), np.array([0.5])),))
    assert explain(posed, mix) == "cannot; length 2.5 → 2.75 m would agree"


def test_several_conflicts_are_told_one_by_one():
    posed = pose(bank(), {"width": 1700.0, "length": 2.5})
    first = Conflict(("length",), np.array([0.5]), np.array([0.5]))
    second = Conflict(("length", "width"), np.array([0.1, 0.2]))
    mix = Mix(np.full(6, 1 / 6), np.zeros(2), "infeasible", "cannot", (first, second))
    assert explain(posed, mix) == (
        "cannot; (1) length: length 2.5 → 2.75 m would agree; "
        "(2) length + width: length 2.5 → 2.55 m, width 1700 → 1760 mm would agree"
    )


def test_a_conflict_may_name_a_range():
    posed = pose(bank(), {"width": 1700.0, "length": 2.5}, ranges={"drag": (0.3, 0.4)})
    clash = Conflict(("length", "drag (range)"), np.array([0.5, 0.1]))
    mix = Mix(np.full(4, 1 / 4), np.zeros(2), "infeasible", "cannot", (clash,))
    assert explain(posed, mix) == "cannot; length 2.5 → 2.75 m, drag (range) up to 0.4 → 0.405 would agree"


def test_the_columns_are_built_once_a_problem(monkeypatch):
    built = []
    monkeypatch.setattr("lampopt.solve.columns", lambda bank: built.append(1) or columns(bank))
    pose(bank(), {"length": 2.5, "width": 1700.0}, ranges={"drag": (0.2, 0.4)})
    assert len(built) == 1


@pytest.mark.parametrize("names", [["length", "width"], ["drag", "length"], ["length", "extents.length"], []])
def test_many_targets_are_one_by_one(names):
    middle = {"length": 2.5, "width": 1700.0, "drag": 0.3, "extents.length": 2.51}
    targets = [{name: middle[name] * (1 + 0.02 * i * (name != "length")) for name in names} for i in range(4)]
    posed = pose(bank(), targets[0])
    many = solve_many(posed, targets, KKT())
    for mix, target in zip(many, targets, strict=True):
        alone = solve(pose(bank(), target), KKT())
        np.testing.assert_allclose(mix.alpha, alone.alpha, atol=1e-9)
        np.testing.assert_allclose(mix.residual, alone.residual, atol=1e-9)
        assert (mix.status, mix.message) == (alone.status, alone.message)
        assert [c.names for c in mix.conflicts] == [c.names for c in alone.conflicts]
    if "extents.length" in names:
        assert [m.status for m in many] == ["exact"] + ["infeasible"] * 3
        assert "length 2.5 → " in many[1].message


def test_targets_must_be_numbers():
    with pytest.raises(InputError):
        pose(bank(), {"length": float("nan")})


@dataclass(frozen=True)
class Flatters:
    """A solver that returns what it is given, and says of it that every target is met."""

    answer: object

    def solve(self, problem):
        return self.answer

    def solve_many(self, problem, targets, ridges=None):
        return self.answer


def test_a_residual_is_computed_not_believed():
    posed = pose(bank(), {"length": 2.9})
    middle, target = np.full(6, 1 / 6), [{"length": 2.9}, {"length": 2.8}]
    mix = solve(posed, Flatters(Mix(middle, np.zeros(1), "exact")))
    assert mix.residual == pytest.approx(2 * (np.mean(LENGTH) - 2.9))
    many = solve_many(posed, target, Flatters(MixBatch([middle, middle], np.zeros((2, 1)), ("exact", "exact"))))
    assert [m.residual[0] for m in many] == pytest.approx([2 * (np.mean(LENGTH) - t["length"]) for t in target])


@pytest.mark.parametrize("answer", [None, Mix([0.5, 0.5], [0.0], "exact"), MixBatch([[0.5, 0.5]], [[0.0]], ("exact",))])
def test_what_is_no_mix_of_the_exemplars_is_refused(answer):
    posed = pose(bank(), {"length": 2.9})
    with pytest.raises(PluginError, match=r"^solver Flatters: expected a Mix with alpha \(6,\), got (None|Mix)"):
        solve(posed, Flatters(answer))
    with pytest.raises(PluginError, match=r"^solver Flatters: expected a MixBatch with alpha \(1, 6\), got (None|Mix)"):
        solve_many(posed, [{"length": 2.9}], Flatters(answer))
