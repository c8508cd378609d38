"""Numbers at the edge of floating point: slow loops, rare goals, long walks, wide lattices."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from formulations import ISSPUDE, MCMP, S3P, MaxProb
from small_models import model_of
from ssp_lp import SSP, InfeasibleError, SolverError, certify, evaluate, solve
from ssp_lp.accumulated_cost.totals import Window
from ssp_lp.column_generation.compiled_problem import CompiledExplicit
from ssp_lp.dynamic_programming import chain_solvers, equations
from ssp_lp.dynamic_programming.dual_bound import sub_solution
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.methods.rows import lagrange_bound
from ssp_lp.options import Status
from ssp_lp.processes.goal_reach import max_goal_probability, min_goal_probability


@pytest.mark.parametrize("leak", [1e-6, 1e-10, 1e-13])
@pytest.mark.parametrize("loop_cost", [0, 1])
def test_slow_loops_lose_no_probability(leak: float, loop_cost: int) -> None:
    model = model_of(
        {
            "x": {"slow": [(1 - leak, "x", loop_cost), (leak, "g", 1)]},
            "z": {"a": [(0.5, "g", 1), (0.5, "d", 1)]},
            "d": {},
        }
    )
    problem = MCMP(model, {"x": 0.75, "z": 0.25}, 0.125)
    solution = solve(problem)
    certificate = certify(solution)
    assert certificate.accepted
    assert certificate.failure == pytest.approx(0.125, abs=1e-14)
    wait = loop_cost * (1 - leak) / leak
    assert solution.objective == pytest.approx(1 + 0.75 * wait, rel=1e-9)
    assert solution.evaluation.ends["wandering"] <= 1e-14
    assert max_goal_probability(model)[model.index_of("x")] == pytest.approx(1.0, abs=1e-15)
    assert min_goal_probability(model)[model.index_of("x")] == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize("rare", [1e-9, 1e-12, 1e-15])
def test_rare_goals_keep_their_digits(rare: float) -> None:
    model = model_of(
        {
            "x": {
                "a": [(rare, "g", 1), (1 - rare, "d", 1)],
                "b": [(2 * rare, "g", 3), (1 - 2 * rare, "d", 1)],
            },
            "d": {},
        }
    )
    least = solve(S3P(model, "x"))
    assert least.objective == pytest.approx(3.0, rel=1e-12)
    assert least.gap <= 1e-12
    assert solve(S3P(model, "x", 1.0)).objective == pytest.approx(1.0, rel=1e-9)


def test_a_strong_discount_is_no_infeasibility() -> None:
    """Twelve steps of cost 20 at discount 0.01: E[gamma^T] is 1e-24, the ratio 240 / gamma."""
    chain: dict[Any, Any] = {i: {"on": [(1.0, i + 1, 20)]} for i in range(11)}
    chain[11] = {"on": [(1.0, "g", 20)]}
    for discount in (0.5, 0.05, 0.01):
        solution = solve(S3P(model_of(chain), 0, 1.0, discount=discount))
        assert solution.objective == pytest.approx(240 / discount, rel=1e-9)


def test_long_walks() -> None:
    """A symmetric walk on 0 .. n with a reflecting start takes n^2 steps."""
    n = 1500
    walk: dict[Any, Any] = {0: {"on": [(1.0, 1, 1)]}}
    for i in range(1, n):
        walk[i] = {"on": [(0.5, i - 1, 1), (0.5, "g" if i == n - 1 else i + 1, 1)]}
    problem = MCMP(model_of(walk), 0, 0.5, give_up="dead_ends")
    solution = solve(problem)
    assert solution.objective == pytest.approx(n**2, rel=1e-7)
    assert evaluate(solution.policy, problem).objective == pytest.approx(n**2, rel=1e-7)


def test_slack_budgets_with_free_steps_are_proved() -> None:
    model = model_of(
        {"a": {"x": [(1.0, "b", 0)]}, "b": {"x": [(1.0, "c", 1)]}, "c": {"x": [(1.0, "g", 0)]}}
    )
    for budget in (0.0, 0.3, 1.0):
        solution = solve(S3P(model, "a", budget))
        assert solution.objective == pytest.approx(1.0)
        assert solution.gap <= 1e-8


def test_a_waiting_loop_does_not_widen_the_gap_of_least_failure() -> None:
    model = model_of(
        {"a": {"wait": [(1.0, "a", 1)], "go": [(0.5, "g", 2), (0.5, "d", 1)]}, "d": {}}
    )
    assert solve(S3P(model, "a")).gap <= 1e-12


def test_steps_that_skip_many_layers() -> None:
    """Steps of 1 and of 90 units: 90 (1 - 1e-3) + 1e-3 in the mean where that is allowed."""
    model = model_of(
        {
            "x": {"dear": [(1.0, "y", 90)], "risky": [(0.9, "y", 1), (0.1, "d", 1)]},
            "y": {"on": [(0.5, "g", 1), (0.5, "y", 1)]},
            "d": {},
        }
    )
    for budget in (0.0, 0.05):
        by_columns = solve(S3P(model, "x", budget))
        by_program = solve(S3P(model, "x", budget), "lp")
        assert by_program.objective == pytest.approx(by_columns.objective, rel=1e-8)
        risky = budget / 0.1
        paid = (1 - risky) * 92 + 0.9 * risky * 3
        assert by_columns.objective == pytest.approx(paid / (1 - budget), rel=1e-9)


def test_the_window_slides() -> None:
    window = Window(np.arange(6.0).reshape(3, 2))
    layers = [np.array([10.0 + i, 20.0 + i]) for i in range(25)]
    for i, layer in enumerate(layers):
        window.push(layer)
        expected = [*reversed(layers[max(i - 2, 0) : i + 1]), *np.arange(6.0).reshape(3, 2)][:3]
        assert np.array_equal(window.ahead, np.array(expected))


@pytest.mark.parametrize("seed", range(20))
def test_sub_solutions_are_sub_solutions(seed: int) -> None:
    """Whatever values are given, the checked ones never exceed the optimum."""
    import scipy.sparse as sp

    rng = np.random.default_rng(seed)
    n, actions = 6, 3
    offsets = np.arange(0, n * actions + 1, actions)
    dense = rng.random((n * actions, n)) * (rng.random((n * actions, n)) < 0.5)
    dense *= rng.uniform(0.5, 0.99) / np.maximum(dense.sum(axis=1, keepdims=True), 1e-9)
    cost = rng.choice([0.0, 1.0, 2.5], size=n * actions)
    dynamics = Dynamics(offsets, sp.csr_array(dense), 1.0 - dense.sum(axis=1))
    optimum = np.zeros(n)
    for _ in range(5000):
        optimum = (cost + dense @ optimum).reshape(n, actions).min(axis=1)
    for given in (optimum, optimum * 1.1, optimum + rng.normal(size=n), np.full(n, np.inf)):
        checked = sub_solution(dynamics, cost, given)
        assert (checked <= optimum * (1 + 1e-12)).all()
    assert sub_solution(dynamics, cost, optimum) == pytest.approx(optimum)


@pytest.mark.parametrize("rows", [1, 2, 7, 40])
def test_what_prices_take_off_a_bound_is_rounded_up(rows: int) -> None:
    """``least - prices @ bounds`` beside fractions, where the two nearly cancel, too."""
    rng = np.random.default_rng(rows)
    for _ in range(100):
        prices = rng.random(rows) * 10.0 ** rng.uniform(-3, 3, rows)
        bounds = rng.normal(size=rows)
        paid = sum((Fraction(p) * Fraction(b) for p, b in zip(prices, bounds, strict=True)), 0)
        least = float(paid) * float(rng.choice([1.0, 1.0 + 1e-15, 0.5]))
        told = Fraction(lagrange_bound(least, prices, bounds))
        size = Fraction(float(prices @ np.abs(bounds))) + abs(Fraction(least))
        assert told <= Fraction(least) - paid
        assert Fraction(least) - paid - told <= (rows + 4) * Fraction(1, 2**50) * size


def starting_over(steps: int) -> SSP:
    """From 0 towards the goal (0.7) or the pit, as many even steps each that may lead back to 0.

    Both ends are as far away, so that the first step decides; the start is left with 0.5^steps.
    """
    moves: dict[Any, Any] = {0: {"go": [(0.7, 1, 1.0), (0.3, -1, 1.0)]}, "pit": {}}
    for row, end in ((1, "goal"), (-1, "pit")):
        for k in range(1, steps + 1):
            ahead = end if k == steps else row * (k + 1)
            moves[row * k] = {"go": [(0.5, ahead, 1.0), (0.5, 0, 1.0)]}
    return model_of(moves, goal="goal")


def test_a_model_that_nearly_always_starts_over_is_reduced_once(monkeypatch) -> None:
    """The chain of 599 states is left with 1e-90 a step; the goal's probability is 0.7."""
    reductions: list[int] = []
    monkeypatch.setattr(
        equations,
        "reduction_solver",
        lambda *chain: reductions.append(1) or chain_solvers.reduction_solver(*chain),
    )
    model = starting_over(299)
    assert solve(MaxProb(model, 0)).objective == pytest.approx(0.7, rel=1e-12)
    assert len(reductions) == 1


@pytest.mark.slow
@pytest.mark.parametrize("criterion", [MCMP, S3P, ISSPUDE])
def test_a_least_failure_that_is_not_proved_is_reported_as_an_interval(criterion: Any) -> None:
    """Runs of 2^60 steps: the policy fails with 0.3, and all that is proved is MaxProb's bound."""
    model = starting_over(60)
    unproved = solve(MaxProb(model, 0)).gap
    solution = solve(criterion(model, 0))
    assert unproved > 0.1
    assert solution.budget_used == pytest.approx(0.3, rel=1e-12)
    assert solution.least_failure_bound is not None
    assert solution.least_failure_bound <= 0.3
    assert solution.failure_gap == pytest.approx(unproved, rel=1e-9)
    assert solution.gap >= solution.failure_gap
    assert solution.status is Status.TOLERANCE_MISSED
    assert "least failure is proved only up to" in solution.note
    assert "between 0 and 0.3" in solution.summary()
    certificate = certify(solution)
    assert certificate.least_failure_bound == solution.least_failure_bound
    assert certificate.gap >= unproved * (1.0 - 1e-9)
    assert "between 0 and 0.3" in str(certificate)


@pytest.mark.slow
@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_a_budget_below_an_unproved_least_failure_is_not_called_infeasible(criterion: Any) -> None:
    with pytest.raises(SolverError, match=r"not decided.*between 0 and 0\.3"):
        solve(criterion(starting_over(60), 0, failure_budget=0.1))


def test_an_infeasible_budget_is_told_by_what_is_proved(monkeypatch) -> None:
    """Proved up to 4e-9: the error says at least how often every policy fails, no more."""
    proved = 0.02 - 4e-9
    monkeypatch.setattr(CompiledExplicit, "proved_failure", lambda *_: proved)
    model = model_of({"x": {"go": [(0.98, "g", 1), (0.02, "pit", 1)]}, "pit": {}})
    with pytest.raises(
        InfeasibleError, match=r"at least 0\.019999996, .* policy with 0\.02"
    ) as told:
        solve(MCMP(model, "x", failure_budget=0.01))
    assert told.value.least_failure_interval == (proved, pytest.approx(0.02, rel=1e-15))
    assert told.value.least_failure == told.value.least_failure_interval[1]


@pytest.mark.parametrize("leak", [1e-9, 1e-11, 1e-13])
def test_what_is_lost_in_a_loop_that_hardly_leaks_is_no_least_failure(leak: float) -> None:
    """Each step of 300 states leaks by one of two actions: what one loses at a step adds up."""
    rng, moves = np.random.default_rng(1), dict[Any, Any](pit={})
    for state in range(300):
        moves[state] = {}
        for action in "ab":
            ahead, shares = rng.choice(300, 3, replace=False), rng.dirichlet(np.ones(3))
            leaks = leak * rng.uniform(0.1, 2.0) * (rng.random() < 0.5)
            share = float(rng.uniform(0.9, 1.0))
            outcomes = [
                (float(p) * (1.0 - leaks), int(j), 1.0) for p, j in zip(shares, ahead, strict=True)
            ]
            leaving = [(leaks * share, "g", 1.0), (leaks * (1.0 - share), "pit", 1.0)]
            moves[state][action] = outcomes + leaving * (leaks > 0.0)
    model = model_of(moves)
    likeliest = solve(MaxProb(model, 0))
    assert likeliest.gap <= 1e-9
    for problem in (MCMP(model, 0), S3P(model, 0), ISSPUDE(model, 0)):
        solution = solve(problem)
        assert solution.budget_used == pytest.approx(1.0 - likeliest.objective, abs=1e-10)
        assert solution.goal_probability == pytest.approx(likeliest.objective, rel=1e-9)
        assert solution.failure_gap <= 1e-9
    with pytest.raises(InfeasibleError) as told:
        solve(MCMP(model, 0, failure_budget=0.001))
    low, high = told.value.least_failure_interval
    assert low <= 1.0 - likeliest.objective <= high + 1e-12
    assert high - low <= 1e-9
