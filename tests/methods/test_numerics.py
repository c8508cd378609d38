"""Numbers at the edge of floating point: slow loops, rare goals, long walks, wide lattices."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from formulations import MCMP, S3P, MaxProb
from small_models import model_of
from ssp_lp import certify, evaluate, solve
from ssp_lp.accumulated_cost.totals import Window
from ssp_lp.dynamic_programming import chain_solvers, equations
from ssp_lp.dynamic_programming.dual_bound import sub_solution
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.methods.rows import lagrange_bound
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


def test_a_model_that_nearly_always_starts_over_is_reduced_once(monkeypatch) -> None:
    """The goal or the pit 300 even steps away, each of which may lead back to the start.

    Both ends are as many steps away, so that the first step decides: the goal is reached with its
    probability, though the chain of 599 states is left with 1e-90 a step.
    """
    moves: dict[Any, Any] = {0: {"go": [(0.7, 1, 1.0), (0.3, -1, 1.0)]}, "pit": {}}
    for row, end in ((1, "goal"), (-1, "pit")):
        for k in range(1, 300):
            ahead = end if k == 299 else row * (k + 1)
            moves[row * k] = {"go": [(0.5, ahead, 1.0), (0.5, 0, 1.0)]}
    model = model_of(moves, goal="goal")
    reductions: list[int] = []
    monkeypatch.setattr(
        equations,
        "reduction_solver",
        lambda *chain: reductions.append(1) or chain_solvers.reduction_solver(*chain),
    )
    assert solve(MaxProb(model, 0)).objective == pytest.approx(0.7, rel=1e-12)
    assert len(reductions) == 1
