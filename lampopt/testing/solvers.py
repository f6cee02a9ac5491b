"""What a solver has to do, against a closed form of the kit's own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lampopt.errors import SolveError
from lampopt.protocols import Solver
from lampopt.testing.engine import COMMON, CheckFunction, NotApplicable, expect, require
from lampopt.types import Array, Mix, Problem

SUM = 1e-9
CLOSE = 1e-5  # for alpha; iterative solvers stop somewhere
HIT = 1e-6  # for rows that can be met


def problem(k: int = 3, n: int = 8, **changes: Any) -> Problem:
    """k soft rows of n exemplars with uneven weights and centre; the target lies beyond the exemplars' range."""
    draw = np.random.default_rng(7)
    matrix, reach = draw.uniform(-1, 1, (k, n)), draw.normal(size=n)
    fields: dict[str, Any] = {
        "names": tuple(f"q{i}" for i in range(k)),
        "matrix": matrix,
        "target": matrix @ (reach - reach.mean() + 1 / n),
        "weight": draw.uniform(0.5, 2, k),
        "centre": draw.dirichlet(np.ones(n)),
        "ridge": 0.0,
    }
    return Problem(**(fields | changes))


def closed_form(p: Problem) -> Array:
    """Alpha (N,) of a problem of rows and ridge alone (paper, equation (1)), on the null space of what is exact."""
    n = len(p.centre)
    exact = np.vstack([np.ones((1, n)), p.matrix[p.hard]])
    start = p.centre + np.linalg.lstsq(exact, np.append(1.0, p.target[p.hard]) - exact @ p.centre, rcond=None)[0]
    _, sizes, basis = np.linalg.svd(exact)
    free = basis[int((sizes > 1e-12).sum()) :].T
    root = np.sqrt(p.weight[~p.hard])[:, None]
    rows, gap = root * p.matrix[~p.hard], root[:, 0] * (p.target[~p.hard] - p.matrix[~p.hard] @ start)
    damp = np.sqrt(p.ridge or 0.0)
    system = np.vstack([rows @ free, damp * free])
    step = np.linalg.lstsq(system, np.concatenate([gap, damp * (p.centre - start)]), rcond=None)[0]
    return np.asarray(start + free @ step)


def _agree(found: Array, wanted: Array, what: str, tolerance: float = CLOSE) -> None:
    expect(found.shape == wanted.shape, f"{what}: expected alpha {wanted.shape}, got {found.shape}")
    apart = np.abs(found - wanted).max()
    expect(apart <= tolerance, f"{what}: alpha is {apart:.2e} from the closed form, expected <= {tolerance:g}")


def _ability(solver: Solver, p: Problem, words: tuple[str, ...]) -> Mix:
    """The mix, or NotApplicable where the solver refuses in words that name the ability."""
    try:
        return solver.solve(p)
    except SolveError as error:
        named = any(word in str(error).lower() for word in words)
        expect(named, f"refused without naming the ability (one of {', '.join(words)}): {error}")
        raise NotApplicable(f"refused: {error}") from error


def check_protocol(solver: Solver) -> None:
    """A study calls these members; solving returns a Mix."""
    require(solver, Solver)
    mix = solver.solve(problem())
    expect(isinstance(mix, Mix), f"solve: expected a Mix, got {type(mix).__name__}")
    expect(mix.alpha.shape == (8,), f"solve: expected alpha (8,), got {mix.alpha.shape}")


def check_alpha_sums_to_one(solver: Solver) -> None:
    """Affine mixing keeps what all exemplars share; any other sum scales the weights."""
    for ridge in (0.0, 1e-3, 1.0):
        total = float(solver.solve(problem(ridge=ridge)).alpha.sum())
        expect(abs(total - 1) <= SUM, f"ridge {ridge:g}: alpha sums to {total!r}")


def check_residual_and_status_are_true(solver: Solver) -> None:
    """Users read from these whether a design does what was asked."""
    for ridge in (0.0, 1.0):
        p = problem(ridge=ridge)
        mix = solver.solve(p)
        true = p.matrix @ mix.alpha - p.target
        good = mix.residual.shape == true.shape and np.abs(mix.residual - true).max() <= 1e-9
        expect(good, f"residual: expected matrix·alpha − target = {true}, got {mix.residual}")
        wanted = "exact" if np.abs(true).max() <= HIT else "inexact"
        expect(mix.status == wanted, f"status: expected {wanted!r} at residual {true}, got {mix.status!r}")


def check_reachable_target_is_hit(solver: Solver) -> None:
    """What some mix of the exemplars can do is what users may ask for."""
    for k in (1, 3, 7):
        p = problem(k)
        worst = np.abs(p.matrix @ solver.solve(p).alpha - p.target).max()
        expect(worst <= HIT, f"{k} reachable rows are missed by {worst:.2e}")


def check_hard_rows_are_met(solver: Solver) -> None:
    """A hard row is a promise whatever the ridge."""
    p = problem(ridge=1.0, hard=np.array([True, False, False]))
    found = solver.solve(p).alpha
    gap = abs(float(p.matrix[0] @ found - p.target[0]))
    expect(gap <= HIT, f"a hard row is missed by {gap:.2e}")
    _agree(found, closed_form(p), "one hard row of three")


def check_closed_form_agrees(solver: Solver) -> None:
    """There is one right answer to equation (1), whichever solver is chosen."""
    for k in (2, 7, 9):  # fewer rows than exemplars, just enough, too many
        for ridge in (1e-6, 1e-3, 1.0):
            p = problem(k, ridge=ridge)
            p = replace(p, target=p.target + 0.1 * np.sin(np.arange(k)))
            _agree(solver.solve(p).alpha, closed_form(p), f"{k} rows, ridge {ridge:g}")


def check_freedom_stays_near_the_centre(solver: Solver) -> None:
    """\"This car, roof lower\" means near this car: of all mixes that hit, the nearest."""
    p = problem()
    _agree(solver.solve(p).alpha, closed_form(p), "ridge 0")


def check_nothing_asked_is_the_centre(solver: Solver) -> None:
    """A study without targets asks for the reference itself."""
    p = problem(0)
    _agree(solver.solve(p).alpha, np.array(p.centre), "no rows", 1e-8)


def check_negative_alpha_is_allowed(solver: Solver) -> None:
    """Without negative coefficients nothing lies beyond the exemplars."""
    p = Problem(("q",), np.array([[-1.0, 0.0, 1.0]]), np.array([2.0]), ridge=0.0)
    mix = solver.solve(p)
    expect(mix.alpha.min() < -0.1, f"target 2 of a range ±1: expected a negative coefficient, got {mix.alpha}")


def check_conflicts_are_named(solver: Solver) -> None:
    """Contradictory wishes are a finding to report, with the rows to relax, not a crash."""
    base = problem()
    names, matrix = ("a", "b", "free"), np.stack([base.matrix[0], base.matrix[0], base.matrix[1]])
    for hard in (False, True):
        p = Problem(names, matrix, np.array([0.2, -0.2, 0.1]), hard=np.full(3, hard), ridge=0.0)
        mix = solver.solve(p)
        expect(
            mix.status in ("infeasible", "inexact"), f"hard={hard}: expected status 'infeasible', got {mix.status!r}"
        )
        clashing = {name for conflict in mix.conflicts for name in conflict.names}
        expect(clashing == {"a", "b"}, f"hard={hard}: rows a and b clash, the conflicts name {sorted(clashing)}")
        target = np.array(p.target)
        for conflict in mix.conflicts:
            target[[names.index(name) for name in conflict.names]] += conflict.amounts
        expect(abs(target[0] - target[1]) <= HIT, f"hard={hard}: the amounts leave a at {target[0]}, b at {target[1]}")


def check_exemplar_order_does_not_matter(solver: Solver) -> None:
    """The order of a table's rows is no information."""
    p, order = problem(ridge=1e-3), np.array([3, 1, 7, 0, 6, 2, 5, 4])
    permuted = replace(p, matrix=p.matrix[:, order], centre=p.centre[order])
    _agree(solver.solve(permuted).alpha, solver.solve(p).alpha[order], "exemplars in another order")


def check_row_order_does_not_matter(solver: Solver) -> None:
    """The order of a study's targets is no information."""
    p, order = problem(ridge=1e-3, hard=np.array([True, False, False])), [2, 0, 1]
    rows = {name: getattr(p, name)[order] for name in ("matrix", "target", "weight", "hard")}
    permuted = replace(p, names=tuple(p.names[i] for i in order), **rows)
    _agree(solver.solve(permuted).alpha, solver.solve(p).alpha, "rows in another order")


def check_inputs_are_left(solver: Solver) -> None:
    """The same problem goes to other solvers and into the record."""
    p = problem(ridge=1e-3, hard=np.array([True, False, False]))
    names = ("matrix", "target", "weight", "hard", "centre", "range_matrix")
    before = {name: np.array(getattr(p, name)) for name in names}
    solver.solve(p)
    changed = [name for name in names if not np.array_equal(before[name], getattr(p, name))]
    expect(not changed, f"solve changed {changed}")


def check_solve_is_deterministic(solver: Solver) -> None:
    """A design made again from its record has to be the same design."""
    first = solver.solve(problem(ridge=1e-3)).alpha
    solver.solve(problem(5, ridge=1.0))
    expect(np.array_equal(first, solver.solve(problem(ridge=1e-3)).alpha), "solve: a, b, a gives two answers for a")


def check_many_is_one_by_one(solver: Solver) -> None:
    """A sweep has to find what its designs would find alone."""
    p = problem(ridge=1e-3)
    targets = p.target + np.linspace(-1, 1, 4)[:, None] * [1.0, 0.5, -0.5]
    for ridges in (None, np.array([0.0, 1e-6, 1e-3, 1.0])):
        batch = solver.solve_many(p, targets, ridges)
        each = [1e-3] * 4 if ridges is None else ridges.tolist()
        alone = [solver.solve(replace(p, target=t, ridge=r)) for t, r in zip(targets, each, strict=True)]
        expect(len(batch) == 4, f"solve_many: 4 targets give {len(batch)} mixes")
        apart = np.abs(batch.alpha - np.stack([m.alpha for m in alone])).max()
        expect(apart <= 1e-9, f"solve_many: alpha is {apart:.2e} from one by one, ridges {ridges}")
        apart = np.abs(batch.residual - np.stack([m.residual for m in alone])).max()
        expect(apart <= 1e-9, f"solve_many: residuals are {apart:.2e} from one by one")
        status = tuple(m.status for m in alone)
        expect(batch.status == status, f"solve_many: status {batch.status}, one by one {status}")


def check_ranges_are_kept_or_refused(solver: Solver) -> None:
    """A range that is ignored lets a forbidden design pass for a good one."""
    p, row = problem(1, ridge=1.0), problem(2).matrix[1]
    floor = float(row @ closed_form(p)) + 0.3
    ranged = replace(
        p, range_names=("r",), range_matrix=row[None], range_low=np.array([floor]), range_high=np.array([np.inf])
    )
    active = Problem(
        ("q0", "r"), np.stack([p.matrix[0], row]), np.array([p.target[0], floor]), np.append(p.weight, 1.0),
        np.array([False, True]), centre=p.centre, ridge=1.0,
    )  # fmt: skip
    mix = _ability(solver, ranged, ("range", "inequalit"))
    _agree(mix.alpha, closed_form(active), "an active range", 1e-4)
    turned = replace(ranged, range_matrix=-row[None], range_low=np.array([-np.inf]), range_high=np.array([-floor]))
    _agree(solver.solve(turned).alpha, closed_form(active), "an active range, its high end", 1e-4)


def check_bounds_are_kept_or_refused(solver: Solver) -> None:
    """Bounds on alpha are how a study stays inside what the exemplars span."""
    one = Problem(("q",), np.array([[-1.0, 0.0, 1.0]]), np.ones(1), hard=np.ones(1), ridge=0.0, alpha_low=np.zeros(3))
    mix = _ability(solver, one, ("bound", "alpha_low"))
    _agree(mix.alpha, np.array([0.0, 0.0, 1.0]), "alpha >= 0", 1e-4)
    two = Problem(("q",), np.array([[0.0, 1.0, 1.0]]), np.array([2.0]), ridge=0.0, alpha_high=np.array([3.0, 0.8, 0.7]))
    _agree(solver.solve(two).alpha, np.array([-0.5, 0.8, 0.7]), "alpha <= 0.8 and 0.7", 1e-4)


def check_objectives_are_minimised_or_refused(solver: Solver) -> None:
    """An objective that is ignored leaves a design called optimal that is not."""
    p, aim = problem(0, ridge=1.0), np.eye(8)[2]
    asked = replace(p, objectives=(lambda alpha: (float((alpha - aim) @ (alpha - aim)), 2 * (alpha - aim)),))
    mix = _ability(solver, asked, ("objective",))
    _agree(mix.alpha, (p.centre + aim) / 2, "‖alpha − aim‖² + ‖alpha − centre‖²", 1e-3)
    other = np.eye(8)[5]
    more = (*asked.objectives, lambda alpha: (float((alpha - other) @ (alpha - other)), 2 * (alpha - other)))
    both = solver.solve(replace(asked, objectives=more))
    _agree(both.alpha, (p.centre + aim + other) / 3, "two objectives", 1e-3)


def check_constraints_are_kept_or_refused(solver: Solver) -> None:
    """A constraint that is ignored lets a forbidden design pass for a good one."""
    unit = np.eye(4)[0]
    p = Problem((), np.empty((0, 4)), np.empty(0), ridge=1.0)
    asked = replace(p, constraints=(lambda alpha: (float(alpha[0] - 0.1), unit),))
    mix = _ability(solver, asked, ("constraint",))
    _agree(mix.alpha, np.array([0.1, 0.3, 0.3, 0.3]), "alpha[0] <= 0.1", 1e-3)
    other = np.eye(4)[1]
    both = solver.solve(replace(asked, constraints=(*asked.constraints, lambda alpha: (float(alpha[1] - 0.2), other))))
    _agree(both.alpha, np.array([0.1, 0.2, 0.35, 0.35]), "alpha[0] <= 0.1, alpha[1] <= 0.2", 1e-3)


def check_equalities_are_kept_or_refused(solver: Solver) -> None:
    """A hard target on what is measured is an equality: ignored, a miss passes for a hit."""
    unit = np.eye(4)[0]
    p = Problem((), np.empty((0, 4)), np.empty(0), ridge=1.0)
    for wanted in (0.1, 0.7):
        asked = replace(p, equalities=(lambda alpha, wanted=wanted: (float(alpha[0] - wanted), unit),))
        mix = _ability(solver, asked, ("equalit",))
        rest = (1 - wanted) / 3
        _agree(mix.alpha, np.array([wanted, rest, rest, rest]), f"alpha[0] = {wanted}", 1e-3)


def check_norm_1_is_used_or_refused(solver: Solver) -> None:
    """Norm 1 is chosen for few exemplars that change; norm 2 in its place changes all of them."""
    p = Problem(("q",), np.array([[-1.0, -0.5, 1.0]]), np.array([0.5]), hard=np.ones(1), ridge=1.0, norm=1)
    step = (0.5 + 1 / 6) / 2  # the two ends alone move: target less the row's mean, shared by a span of 2
    mix = _ability(solver, p, ("norm",))
    _agree(mix.alpha, np.array([1 / 3 - step, 1 / 3, 1 / 3 + step]), "norm 1", 1e-4)


CHECKS: tuple[CheckFunction, ...] = (
    check_protocol,
    *COMMON,
    check_alpha_sums_to_one,
    check_residual_and_status_are_true,
    check_reachable_target_is_hit,
    check_hard_rows_are_met,
    check_closed_form_agrees,
    check_freedom_stays_near_the_centre,
    check_nothing_asked_is_the_centre,
    check_negative_alpha_is_allowed,
    check_conflicts_are_named,
    check_exemplar_order_does_not_matter,
    check_row_order_does_not_matter,
    check_inputs_are_left,
    check_solve_is_deterministic,
    check_many_is_one_by_one,
    check_ranges_are_kept_or_refused,
    check_bounds_are_kept_or_refused,
    check_objectives_are_minimised_or_refused,
    check_constraints_are_kept_or_refused,
    check_equalities_are_kept_or_refused,
    check_norm_1_is_used_or_refused,
)
