"""The edges of the problem: each a right answer by hand, or the right named error."""

import math
from dataclasses import replace

import pytest

from formulations import MCMP, S3P
from small_models import each_meaning, each_method
from ssp_lp import InfeasibleError, LinearProgramming, ModelError, certify, solve
from written_models import written

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
