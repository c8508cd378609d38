"""Criteria of the law of real costs on rounded costs: both sides hold, and are proved alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from itertools import product
from typing import Any

import numpy as np
import pytest

from formulations import EGUBS, GUBS, S3P, CostBoundedReach, CostQuantile, CVaR
from small_models import model_of
from ssp_lp import SSP, MixedPolicy, ModelError, Solution, Status, certify, evaluate, solve
from ssp_lp.accumulated_cost.sweep import Sweep
from ssp_lp.column_generation.column import Column
from ssp_lp.column_generation.layered_pricing import LayeredPricing
from ssp_lp.dynamic_programming.equations import System
from ssp_lp.methods import rounding
from ssp_lp.methods.risk import exactly_refuted, question_of_compiled

STEP = 2.0**0.5
DEAR = [1e4, 1e8, 1e12]


def corridor(costs: list[float], dear: float) -> SSP:
    """Rooms in a row; a lift is quick, may fall, and may ask for a dear rescue."""
    rooms = {
        f"r{k}": {
            "walk": [(0.8, f"r{k + 1}", costs[0]), (0.2, f"r{max(k - 1, 0)}", costs[1])],
            "lift": [(0.93, f"r{k + 1}", costs[2]), (0.05, "shaft", 0.0), (0.02, "r0", dear)],
        }
        for k in range(5)
    }
    return model_of({**rooms, "shaft": {}}, "r5")


def questions(model: SSP, levels: int) -> list:
    """One of each criterion, on few levels."""

    def utility(total):
        return 1.0 / (1.0 + total / 10.0)

    return [
        CVaR(model, "r0", 0.8, 0.2, cost_levels=levels),
        CostQuantile(model, "r0", 0.9, 0.2, cost_levels=levels),
        CostBoundedReach(model, "r0", 9.0, 0.2, cost_levels=levels),
        GUBS(model, "r0", utility, 0.5, cost_levels=levels),
        EGUBS(model, "r0", -0.1, 0.5, cost_levels=levels),
    ]


@pytest.mark.parametrize("number", range(5))
def test_a_certificate_proves_the_gap_that_the_solution_states(number: int) -> None:
    """Costs of one kind as well, whose rounded multiples have a unit of their own."""
    for costs in ([STEP, STEP, STEP], [STEP, 3.0**0.5, np.pi / 3.0]):
        solution = solve(questions(corridor(costs, 3.0 * STEP), 50)[number])
        certificate = certify(solution)
        assert certificate.accepted
        assert certificate.gap <= 1.1 * solution.gap + 1e-9


@pytest.mark.parametrize("dear", DEAR)
def test_a_policy_beside_a_dear_step_can_be_evaluated(dear: float) -> None:
    problem = CostBoundedReach(corridor([1.3, STEP, 0.4], dear), "r0", 9.0, 0.2, cost_levels=200)
    solution = solve(problem)
    assert certify(solution).accepted
    attained = evaluate(solution.policy, problem).objective
    assert solution.objective - 1e-9 <= attained <= solution.upper_bound + 1e-9


def test_where_nothing_costs_anything_the_bound_may_be_far() -> None:
    model = corridor([0.0, 0.0, 0.0], 0.0)
    solution = solve(CostBoundedReach(model, "r0", 1e9, 0.2))
    assert solution.objective == pytest.approx(1.0, abs=1e-9)
    assert solve(CVaR(model, "r0", 0.8, 0.2)).objective == 0.0


def test_a_bound_that_the_policy_exceeds_is_refused() -> None:
    """From above as from below: one of the two is wrong."""
    from ssp_lp.verification.certify import certificate_of

    model = corridor([1.3, STEP, 0.4], 2.0)
    problem = questions(model, 50)[2]
    found = evaluate(solve(problem).policy, problem)
    assert not certificate_of(found, 0.9 * found.objective, 1.0, above=True).accepted
    assert not certificate_of(found, 1.1 * found.objective, 1.0).accepted
    assert certificate_of(found, 1.1 * found.objective, 1.0, above=True).accepted


@pytest.mark.parametrize("unit", [0.0, -1.0, np.nan, np.inf])
def test_a_unit_must_be_one(unit: float) -> None:
    policy = solve(questions(corridor([1.3, STEP, 0.4], 2.0), 20)[0]).policy.policies[0]
    with pytest.raises(ModelError, match="unit"):
        replace(policy, unit=unit)


def test_a_unit_too_small_proves_nothing_false() -> None:
    """Steps that pass more layers than there are numbers overstate no success."""
    problem = questions(corridor([1.3, STEP, 0.4], 2.0), 20)[0]
    solution = solve(problem)
    least = solution.lower_bound
    members = tuple(replace(policy, unit=1e-300) for policy in solution.policy.policies)
    forged = replace(solution, policy=MixedPolicy(members, solution.policy.weights))
    assert evaluate(forged.policy, problem).objective >= least - 1e-9
    assert certify(forged).objective >= least - 1e-9


def pressed_at(turn: int, work: Callable[..., Any]) -> Callable[..., Any]:
    """A function at whose k-th call somebody presses Ctrl-C."""
    calls = iter(range(10))

    def interrupted(*asked: Any) -> Any:
        if next(calls) == turn:
            raise KeyboardInterrupt
        return work(*asked)

    return interrupted


def check_interrupted(solution: Solution, best: Solution) -> None:
    """As good a policy as the one known, bounds that hold, and why the search ended."""
    assert solution.status is Status.INTERRUPTED
    evaluated = evaluate(solution.policy, best.problem).objective
    assert evaluated == pytest.approx(evaluate(best.policy, best.problem).objective, rel=1e-12)
    if solution.upper_bound is None:
        assert solution.lower_bound <= min(best.objective, solution.objective) + 1e-12
    else:
        assert solution.upper_bound >= max(best.objective, solution.objective) - 1e-12
    assert certify(solution).accepted


@pytest.mark.parametrize("turn", [0, 1])
@pytest.mark.parametrize("number", range(5))
def test_ctrl_c_while_a_bound_is_worked_out_keeps_the_policy(
    number: int, turn: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Units of 128 and 200 in the totals that matter: the bound of the first or of the second."""
    monkeypatch.setattr(rounding, "exactly_refuted", lambda *_: 0.0)  # else the first is enough
    problem = questions(corridor([1.3, STEP, 0.4], 2.0), 200)[number]
    best = solve(replace(problem, cost_levels=128) if turn == 0 else problem)
    pressed = pressed_at(turn, rounding.lattice_bound)
    monkeypatch.setattr(rounding, "lattice_bound", pressed)
    solution = solve(problem)
    monkeypatch.undo()
    check_interrupted(solution, best)


def test_ctrl_c_while_the_answer_is_measured_keeps_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A utility that never settles is measured beyond its table, last of all."""
    problem = questions(corridor([1.3, STEP, 0.4], 2.0), 50)[3]
    best = solve(problem)
    pressed = pressed_at(0, rounding.measured_costs)
    monkeypatch.setattr(rounding, "measured_costs", pressed)
    solution = solve(problem)
    monkeypatch.undo()
    check_interrupted(solution, best)
    assert solution.upper_bound == pytest.approx(best.upper_bound, rel=1e-14)
    assert solution.gap > best.gap


@pytest.mark.parametrize("budget", [None, 0.25])
@pytest.mark.parametrize("level", [0.5, 0.9, 0.99])
def test_a_quantile_is_one_of_the_totals(level: float, budget: float | None) -> None:
    """Rounded costs and exact totals find what all sums say, and prove it."""
    model = corridor([1.3, STEP, 0.4], 2.0)
    exact = solve(CostQuantile(model, "r0", level, budget))
    assert exact.gap <= 1e-9
    solution = solve(CostQuantile(model, "r0", level, budget, cost_levels=1_000))
    assert solution.objective == pytest.approx(exact.objective, rel=1e-12)
    assert solution.gap <= 1e-9
    certificate = certify(solution)
    assert certificate.accepted
    assert certificate.gap <= 1e-9


@pytest.mark.parametrize("seed", range(6))
def test_exact_totals_refute_what_no_policy_keeps_to_and_nothing_else(seed: int) -> None:
    """Drawn rooms, beside the optimum that all sums give, for units of any size."""
    draw = np.random.default_rng(seed)
    model = corridor(draw.choice([0.4, 1.3, STEP, 3.0**0.5, 0.1 * np.pi], 3).tolist(), 2.0)
    level, budget = float(draw.uniform(0.3, 0.99)), [None, 0.25][seed % 2]
    best = solve(CostQuantile(model, "r0", level, budget)).objective
    problem = CostQuantile(model, "r0", level, budget, cost_levels=50)
    for unit in (Fraction(3, 10), Fraction(1, 50)):
        rounded = rounding._with_rounded_costs(problem, unit, up=False)
        question = question_of_compiled(rounded.compile(), budget)
        assert exactly_refuted(question, model, level, 0.9 * best) == pytest.approx(0.9 * best)
        assert exactly_refuted(question, model, level, best) == pytest.approx(best, rel=1e-9)
        assert exactly_refuted(question, model, level, best * (1.0 + 1e-8)) == 0.0
        assert exactly_refuted(question, model, level, 1.1 * best) == 0.0


@pytest.mark.parametrize("budget", [None, 0.25, 1.0])
def test_a_quantile_is_nothing_where_enough_begins_at_the_goal(budget: float | None) -> None:
    model, start = corridor([1.3, STEP, 0.4], 2.0), {"r0": 0.5, "r5": 0.5}
    solution = solve(CostQuantile(model, start, 0.4, budget, cost_levels=200))
    assert solution.objective == solution.lower_bound == 0.0
    assert certify(solution).accepted


@pytest.mark.parametrize("levels", [None, 5])
@pytest.mark.parametrize("seed", range(4))
def test_a_stationary_optimum_needs_no_rounding(seed: int, levels: int | None) -> None:
    """Without a bonus the moments of the 16 stationary policies say it all."""
    draw, ways = np.random.default_rng(seed), []
    for _ in range(4):
        shares, costs = draw.dirichlet(np.ones(3), 2), draw.uniform(0.3, 2.0, (2, 3))
        after = draw.integers(0, 4, (2, 3))
        after[:, 1] = draw.integers(4, 6, 2)  # 4 is the goal, 5 the trap
        ways.append((shares, after, costs))
    choices = {
        f"s{s}": {
            f"a{a}": [
                (p, ("s0", "s1", "s2", "s3", "home", "pit")[to], cost)
                for p, to, cost in zip(*(part[a].tolist() for part in way), strict=True)
            ]
            for a in range(2)
        }
        for s, way in enumerate(ways)
    }
    best = 0.0
    for chosen in product(range(2), repeat=4):
        moves = np.zeros((4, 6))
        for s, (shares, after, costs) in enumerate(ways):
            np.add.at(moves[s], after[chosen[s]], (shares * np.exp(-costs))[chosen[s]])
        best = max(best, float(np.linalg.solve(np.eye(4) - moves[:, :4], moves[:, 4])[0]))
    problem = EGUBS(model_of({**choices, "pit": {}}, "home"), "s0", -1.0, 0.0, cost_levels=levels)
    solution = solve(problem)
    assert solution.objective == pytest.approx(best, rel=1e-12)
    assert solution.gap <= 1e-12
    assert certify(solution).accepted


def test_a_safest_policy_that_loses_the_goal_on_the_way_makes_no_budget_infeasible(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Free steps may take it so long that rounding fails it: that says nothing of any budget."""
    solution = solve(CVaR(corridor([1.3, STEP, 0.4], 2.0), "r0", 0.8, 0.2, cost_levels=200))
    within = LayeredPricing.minimise

    def lost(self: LayeredPricing, price: float, *warm: Column | None) -> Column:
        found = within(self, price, *warm)
        return replace(found, failure=found.failure + 0.5, goal=found.goal - 0.5)

    monkeypatch.setattr(LayeredPricing, "minimise", lost)
    with pytest.raises(ModelError, match="so long that its failure cannot be told"):
        CVaR(corridor([1.0, 1.0, 0.0], 2.0), "r0", 0.8, 0.2).compile().least_failure()
    certificate = certify(solution)  # what the cheapest way costs, in place of a search
    assert certificate.accepted
    assert 0.0 < certificate.lower_bound <= solution.lower_bound


def test_runs_within_a_layer_that_hardly_end_are_evaluated_with_care(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A solver that loses a part of what ends is seen, and its totals are verified."""
    table = {
        "a": {"go": [(0.5, "b", 0.0), (0.3, "g", 1.0), (0.2, "d", 1.0)]},
        "b": {"go": [(0.75, "a", 0.0), (0.25, "g", 2.0)]},
        "d": {},
    }
    sweep = S3P(model_of(table), "a", 0.9).compile().pricing().sweep
    choice = sweep.room_for_choice()
    choice[:] = 0
    exact = sweep.measure(choice, 1.0)
    with monkeypatch.context() as broken:
        broken.setattr(Sweep, "one_pass", None)
        solved = System.solve
        broken.setattr(System, "solve", lambda self, right, *a: 1.1 * solved(self, right, *a))
        assert np.allclose(Sweep(sweep.process).measure(choice, 1.0), exact, rtol=1e-12)
