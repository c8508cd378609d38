"""Edge cases, and problems whose numbers are far apart."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from formulations import ISSPUDE, MCMP, S3P, MaxProb
from small_models import each_meaning, each_method, model_of
from ssp_lp import (
    SSP,
    InfeasibleError,
    LinearProgramming,
    ModelError,
    SolverError,
    certify,
    evaluate,
    solve,
)
from ssp_lp.column_generation.compiled_problem import CompiledExplicit
from ssp_lp.dynamic_programming import chain_solvers, equations
from ssp_lp.dynamic_programming.dual_bound import sub_solution
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.methods.rows import lagrange_bound
from ssp_lp.options import Status
from ssp_lp.processes.goal_reach import max_goal_probability, min_goal_probability
from written_models import written

# Numbers at the edge of floating point: slow loops, rare goals, long walks, wide lattices.


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
    with pytest.raises(SolverError, match=r"may be infeasible.*between 0 and 0\.3"):
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


# The edges of the problem: each a right answer by hand, or the right named error.


FORK = written(
    """
    s fast: 0.9 g 1, 0.1 d 1
    s safe: 0.98 g 3, 0.02 d 3
    d stay: d 1
    """
)
"""A fast road that fails with 0.1, a safe one that fails with 0.02."""
criteria = pytest.mark.parametrize("criterion", [MCMP, S3P])


@each_method
@criteria
def test_budgets_around_the_least_failure(criterion, method):
    least = solve(criterion(FORK, start="s", failure_budget=None))
    assert least.failure_probability == pytest.approx(0.02, abs=1e-15)
    assert least.objective == pytest.approx(3.02 if criterion is MCMP else 3.0)
    above = solve(criterion(FORK, start="s", failure_budget=0.02 + 1e-9), method)
    assert above.objective == pytest.approx(least.objective, rel=1e-6)
    assert above.objective < least.objective
    assert above.failure_probability <= 0.02 + 1e-9 + 1e-12
    for below in (0.02 - 1e-9, 0.02 - 1e-6):
        with pytest.raises(InfeasibleError) as caught:
            solve(criterion(FORK, start="s", failure_budget=below), method)
        assert caught.value.least_failure == pytest.approx(0.02, abs=1e-14)
        assert caught.value.failure_budget == below
    equal = solve(criterion(FORK, start="s", failure_budget=0.02 - 1e-11), method)
    assert equal.objective == pytest.approx(least.objective, rel=1e-9)
    assert "counts as equal" in equal.note
    assert certify(equal).accepted


@each_method
@pytest.mark.parametrize(
    ("budget", "discount"), [(None, None), (0.0, None), (1.0, None), (0.1, 0.9)]
)
@criteria
def test_start_at_the_goal(criterion, budget, discount, method):
    solution = solve(criterion(FORK, "g", failure_budget=budget, discount=discount), method)
    assert (solution.objective, solution.failure_probability, solution.gap) == (0.0, 0.0, 0.0)
    assert certify(solution).accepted


def test_a_start_lottery_shares_one_budget():
    """Half the mass may fail with 0.06 in the mean: equal weights of fast and safe."""
    start = {"s": 0.5, "d": 0.1, "g": 0.4}
    with pytest.raises(InfeasibleError) as caught:
        solve(MCMP(FORK, start=start, failure_budget=0.1))
    assert caught.value.least_failure == pytest.approx(0.5 * 0.02 + 0.1)
    solution = solve(MCMP(FORK, start=start, failure_budget=0.13))
    assert solution.objective == pytest.approx(0.5 * (2.0 + 0.06) + 0.1)
    ratio = solve(S3P(FORK, start=start, failure_budget=0.13))
    assert ratio.objective == pytest.approx(0.5 * (0.5 * 0.9 * 1 + 0.5 * 0.98 * 3) / 0.87)


@each_meaning
def test_budget_one_lets_failure_be_free(give_up):
    solution = solve(MCMP(FORK, "s", 1.0, give_up=give_up, charge_failing_step=False))
    assert solution.failure_price == 0.0
    assert solution.objective == pytest.approx(0.0 if give_up == "anywhere" else 1.0)
    assert solve(S3P(FORK, start="s", failure_budget=1.0)).objective == pytest.approx(1.0)


def test_extreme_costs():
    """In case S they have no common unit: levels, not layers."""
    model = written(
        """
        s cheap: 0.7 g 1e-6, 0.3 d 1e-6
        s dear: t 1e6
        t go: 0.5 g 1e-6, 0.5 t 1e-6
        """
    )
    dear = 1e6 + 2e-6
    solution = solve(MCMP(model, start="s", failure_budget=0.15))
    assert solution.objective == pytest.approx(0.5 * dear + 0.5e-6, rel=1e-9)
    assert solution.failure_price == pytest.approx((dear - 1e-6) / 0.3, rel=1e-9)
    assert solution.gap <= 1e-8
    assert solve(MCMP(model, start="s")).objective == pytest.approx(dear, rel=1e-12)
    assert solve(S3P(model, start="s")).objective == pytest.approx(dear, rel=1e-12)
    solution = solve(S3P(model, start="s", failure_budget=0.15))
    assert solution.objective == pytest.approx((0.5 * 0.7e-6 + 0.5 * dear) / 0.85, rel=1e-9)
    assert solution.gap <= 1e-9


@criteria
def test_the_surrogate_can_be_infeasible_where_the_problem_is_not(criterion):
    """E[0.9^T] = 0.09 / (1 - 0.81)."""
    model = written("s go: 0.1 g 1, 0.9 s 1")
    assert solve(criterion(model, start="s", failure_budget=0.0)).failure_probability == 0.0
    with pytest.raises(InfeasibleError) as caught:
        solve(criterion(model, start="s", failure_budget=0.05, discount=0.9))
    assert caught.value.least_failure == pytest.approx(0.0, abs=1e-14)
    assert caught.value.least_discounted_failure == pytest.approx(1 - 0.09 / 0.19)


def test_an_enormous_price_needs_few_layers():
    """A budget barely above the least failure: kappa is 1e7, the steps are a few."""
    model = written(f"s a: 0.5 g 1, {0.5 - 1e-7} s 1, 1e-7 d 1\n s b: 0.4 g 2, 0.6 s 2")
    solution = solve(S3P(model, start="s", failure_budget=1e-8))
    assert solution.failure_price > 1e6
    assert max(solution.gap, certify(solution).gap) <= 1e-8


@pytest.mark.parametrize(
    "wrong",
    [
        *({"failure_budget": budget} for budget in (-0.1, 1.1, math.nan)),
        *({"discount": discount} for discount in (1.0, 0.0, -0.5, math.nan)),
        {"failure_budget": None, "discount": 0.9},
        *({"start": start} for start in ("nowhere", {"s": 0.5}, {"s": -0.5, "g": 1.5})),
    ],
    ids=str,
)
@criteria
def test_problems_stated_wrongly(criterion, wrong):
    with pytest.raises(ModelError):
        criterion(**({"model": FORK, "start": "s", "failure_budget": 0.1} | wrong))


def test_arguments_of_solve_stated_wrongly():
    problem = MCMP(FORK, start="s", failure_budget=0.05)
    for wrong in ({"method": "magic"}, {"method": 3}, {"tolerance": 0.0}, {"time_limit": -1.0}):
        with pytest.raises(ModelError):
            solve(problem, **wrong)
    with pytest.raises(ModelError, match="backend must be one of"):
        LinearProgramming("magic")
    with pytest.raises(ModelError):
        replace(problem, give_up="never")


LONG_SHOT = f"""
    a long: 1e-10 g 1, {1 - 1.5e-10} a 1, 5e-11 d 1
    a walk: b 1
    b go: 0.9 g 1, 0.1 d 1
    d stay: d 1
    """
"""The policy nearest to the goal in steps succeeds once in 10^10 runs: no guide to the cap."""

SMALL_CAP = "a u: c 1\n a die: d 0\n c u: g 1\n d stay: d 0"

SLACK = """
    a u: 0.5 c 3, 0.25 d 3, 0.25 a 1
    a v: b 1
    b u: 0.75 g 0, 0.25 d 1
    b loop: b 0
    c u: g 2
    d u: 0.25 g 0, 0.75 a 1
    d w: 0.5 b 0, 0.5 b 1
    """
"""Values that are exactly 0 stay so when others are lowered."""


@pytest.mark.parametrize(
    ("model", "asked", "best"),
    [
        (LONG_SHOT, {"failure_budget": 0.2}, 2.0),
        (SMALL_CAP, {"failure_budget": 0.0, "cost_cap": 1}, 2.0),
        *((SLACK, {"failure_budget": budget}, 1.0) for budget in (0.9999, 0.999999, 1.0)),
    ],
)
def test_bounds_of_case_s_that_were_lost_once(model, asked, best):
    solution = solve(S3P(written(model), "a", **asked))
    assert solution.objective == pytest.approx(best, rel=1e-9 if model is SLACK else 1e-12)
    assert solution.gap <= 1e-9


@each_method
def test_a_budget_that_a_policy_meets_to_the_last_digit_needs_no_lottery(method):
    """Waiting succeeds with 1/12 at no cost, and its failure is summed to a digit above 11/12."""
    model = written("a on: b 1\n a wait: 0.2 b 0, 0.8 a 0\n b back: a 1\n b go: g 0")
    asked = {"give_up": "anywhere", "charge_failing_step": False, "discount": 0.5}
    solution = solve(MCMP(model, "a", failure_budget=11 / 12, **asked), method)
    assert (solution.objective, solution.gap) == (0.0, 0.0)
    assert solution.policy.weights.tolist() == [1.0]
