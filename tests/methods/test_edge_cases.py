"""The edges of the problem: each a right answer by hand, or the right named error."""

from __future__ import annotations

import math

import numpy as np
import pytest

from formulations import MCMP, S3P
from small_models import model_of
from ssp_lp import SSP, InfeasibleError, LinearProgramming, ModelError, certify, solve

GIVE_UPS = ["anywhere", "attention", "dead_ends"]


def fork(stay_cost: float = 1.0) -> SSP:
    """A fast road that fails with 0.1, a safe one that fails with 0.02."""
    return model_of(
        {
            "s": {
                "fast": [(0.9, "g", 1.0), (0.1, "d", 1.0)],
                "safe": [(0.98, "g", 3.0), (0.02, "d", 3.0)],
            },
            "d": {"stay": [(1.0, "d", stay_cost)]},
        }
    )


@pytest.mark.parametrize("method", ["columns", "lp"])
@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_budgets_around_the_least_failure(criterion: type, method: str) -> None:
    least = solve(criterion(fork(), start="s", failure_budget=None))
    assert least.failure_probability == pytest.approx(0.02, abs=1e-15)
    above = solve(criterion(fork(), start="s", failure_budget=0.02 + 1e-9), method)
    assert above.objective == pytest.approx(least.objective, rel=1e-6)
    assert above.objective < least.objective
    assert above.failure_probability <= 0.02 + 1e-9 + 1e-12
    with pytest.raises(InfeasibleError) as caught:
        solve(criterion(fork(), start="s", failure_budget=0.02 - 1e-9), method)
    assert caught.value.least_failure == pytest.approx(0.02, abs=1e-14)
    assert caught.value.failure_budget == 0.02 - 1e-9
    equal = solve(criterion(fork(), start="s", failure_budget=0.02 - 1e-11), method)
    assert equal.objective == pytest.approx(least.objective, rel=1e-9)
    assert "counts as equal" in equal.note
    assert certify(equal).accepted


def test_least_failure_by_hand() -> None:
    model = fork()
    assert solve(MCMP(model, start="s")).objective == pytest.approx(3.0 + 0.02)
    free = MCMP(model, start="s", charge_failing_step=False)
    assert solve(free).objective == pytest.approx(3.0)
    assert solve(S3P(model, start="s")).objective == pytest.approx(3.0)


@pytest.mark.parametrize("budget", [None, 0.0, 0.05, 1.0])
@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_start_at_the_goal(criterion: type, budget: float | None) -> None:
    solution = solve(criterion(fork(), start="g", failure_budget=budget))
    assert solution.objective == 0.0
    assert solution.failure_probability == 0.0
    assert solution.gap == 0.0
    assert certify(solution).accepted


def test_start_in_a_dead_end() -> None:
    model = fork(stay_cost=7.0)
    for budget in (0.0, 0.05, 0.999):
        with pytest.raises(InfeasibleError) as caught:
            solve(MCMP(model, start="d", failure_budget=budget))
        assert caught.value.least_failure == 1.0
    for unlimited in (1.0, None):
        charged = solve(MCMP(model, start="d", failure_budget=unlimited))
        assert charged.objective == pytest.approx(7.0)
        free = MCMP(model, start="d", failure_budget=unlimited, charge_failing_step=False)
        assert solve(free).objective == 0.0
    for budget in (None, 0.0, 1.0):
        with pytest.raises(InfeasibleError) as caught:
            solve(S3P(model, start="d", failure_budget=budget))
        assert caught.value.least_failure == 1.0


def test_a_start_lottery_shares_one_budget() -> None:
    start = {"s": 0.5, "d": 0.1, "g": 0.4}
    with pytest.raises(InfeasibleError) as caught:
        solve(MCMP(fork(), start=start, failure_budget=0.1))
    assert caught.value.least_failure == pytest.approx(0.5 * 0.02 + 0.1)
    # half the mass may fail with 0.06 in the mean: equal weights of fast and safe
    solution = solve(MCMP(fork(), start=start, failure_budget=0.13))
    assert solution.objective == pytest.approx(0.5 * (2.0 + 0.06) + 0.1)
    ratio = solve(S3P(fork(), start=start, failure_budget=0.13))
    assert ratio.objective == pytest.approx(0.5 * (0.5 * 0.9 * 1 + 0.5 * 0.98 * 3) / 0.87)


@pytest.mark.parametrize("give_up", GIVE_UPS)
def test_budget_one_lets_failure_be_free(give_up: str) -> None:
    solution = solve(
        MCMP(fork(), start="s", failure_budget=1.0, give_up=give_up, charge_failing_step=False)
    )
    assert solution.failure_price == 0.0
    expected = 0.0 if give_up == "anywhere" else 1.0
    assert solution.objective == pytest.approx(expected)
    assert solve(S3P(fork(), start="s", failure_budget=1.0)).objective == pytest.approx(1.0)


def test_budget_zero() -> None:
    model = model_of(
        {
            "s": {"risk": [(0.5, "g", 1.0), (0.5, "d", 1.0)], "sure": [(1.0, "g", 9.0)]},
            "d": {},
        }
    )
    for criterion in (MCMP, S3P):
        solution = solve(criterion(model, start="s", failure_budget=0.0))
        assert solution.objective == pytest.approx(9.0)
        assert solution.failure_probability <= 1e-12
        assert solution.gap <= 1e-8


@pytest.mark.parametrize("give_up", GIVE_UPS)
@pytest.mark.parametrize("method", ["columns", "lp"])
def test_a_loop_that_costs_nothing(give_up: str, method: str) -> None:
    """Mathematics, section 4: one state, a loop of cost 0, a way out of cost 5."""
    model = SSP.from_transitions({"s": {"loop": [(1, "s", 0)], "out": [(1, "g", 5)]}}, goal={"g"})
    for budget in (0.0, 0.25, 0.5, 1.0):
        problem = MCMP(model, start="s", failure_budget=budget, give_up=give_up)
        solution = solve(problem, method)
        assert solution.objective == pytest.approx(5.0 * (1.0 - budget), abs=1e-12)
        assert solution.failure_probability == pytest.approx(budget, abs=1e-12)
        assert certify(solution).accepted
    assert solve(S3P(model, start="s", failure_budget=0.5), method).objective == pytest.approx(5.0)


def test_an_end_component_that_never_pays() -> None:
    """Three states that can be toured for free, with one exit far from the entry."""
    model = model_of(
        {
            "a": {"on": [(1, "b", 0)]},
            "b": {"on": [(0.5, "c", 0), (0.5, "a", 0)], "back": [(1, "a", 0)]},
            "c": {"on": [(1, "a", 0)], "out": [(0.5, "g", 2), (0.5, "a", 2)]},
        }
    )
    for give_up in GIVE_UPS:
        solution = solve(MCMP(model, start="a", failure_budget=0.1, give_up=give_up))
        # "out" is taken at most twice on average; failing with 0.1 saves a tenth of 4
        assert solution.objective == pytest.approx(3.6)
        assert solution.evaluation.objective == pytest.approx(3.6)
    assert solve(MCMP(model, start="a")).objective == pytest.approx(4.0)
    assert solve(S3P(model, start="a")).objective == pytest.approx(4.0)
    relaxed = solve(S3P(model, start="a", failure_budget=0.5))
    assert relaxed.objective == pytest.approx(2.0)  # succeed at the first "out", else wander off
    assert relaxed.failure_probability == pytest.approx(0.5)


def test_two_goals_and_extreme_costs() -> None:
    model = SSP.from_transitions(
        {
            "s": {
                "cheap": [(0.7, "g1", 1e-6), (0.3, "d", 1e-6)],
                "dear": [(1.0, "t", 1e6)],
            },
            "t": {"go": [(0.5, "g2", 1e-6), (0.5, "t", 1e-6)]},
            "d": {},
        },
        goal={"g1", "g2"},
        treat_actionless_as_dead_ends=True,
    )
    dear = 1e6 + 2e-6
    solution = solve(MCMP(model, start="s", failure_budget=0.15))
    assert solution.objective == pytest.approx(0.5 * dear + 0.5e-6, rel=1e-9)
    assert solution.failure_price == pytest.approx((dear - 1e-6) / 0.3, rel=1e-9)
    assert solution.gap <= 1e-8
    assert solve(MCMP(model, start="s")).objective == pytest.approx(dear, rel=1e-12)
    assert solve(S3P(model, start="s")).objective == pytest.approx(dear, rel=1e-12)
    given_success = (0.5 * 0.7e-6 + 0.5 * dear) / 0.85  # no common unit: levels, not layers
    solution = solve(S3P(model, start="s", failure_budget=0.15))
    assert solution.objective == pytest.approx(given_success, rel=1e-9)
    assert solution.gap <= 1e-9


def test_the_surrogate_can_be_infeasible_where_the_problem_is_not() -> None:
    model = SSP.from_transitions({"s": {"go": [(0.1, "g", 1), (0.9, "s", 1)]}}, goal={"g"})
    for criterion in (MCMP, S3P):
        assert solve(criterion(model, start="s", failure_budget=0.0)).failure_probability == 0.0
        with pytest.raises(InfeasibleError) as caught:
            solve(criterion(model, start="s", failure_budget=0.05, discount=0.9))
        assert caught.value.least_failure == pytest.approx(0.0, abs=1e-14)
        # E[0.9^T] = 0.09 / (1 - 0.81)
        assert caught.value.least_discounted_failure == pytest.approx(1 - 0.09 / 0.19)


def test_an_enormous_price_needs_few_layers() -> None:
    """A budget barely above the least failure: kappa is 1e7, the steps are a few."""
    model = model_of(
        {
            "s": {
                "a": [(0.5, "g", 1), (0.5 - 1e-7, "s", 1), (1e-7, "d", 1)],
                "b": [(0.4, "g", 2), (0.6, "s", 2)],
            },
            "d": {},
        }
    )
    solution = solve(S3P(model, start="s", failure_budget=1e-8))
    assert solution.failure_price is not None
    assert solution.failure_price > 1e6
    assert solution.gap <= 1e-8
    assert certify(solution).gap <= 1e-8


@pytest.mark.parametrize(
    "wrong",
    [
        {"failure_budget": -0.1},
        {"failure_budget": 1.1},
        {"failure_budget": math.nan},
        {"failure_budget": 0.1, "discount": 1.0},
        {"failure_budget": 0.1, "discount": 0.0},
        {"failure_budget": None, "discount": 0.9},
        {"start": "nowhere"},
        {"start": {"s": 0.5}},
        {"start": {"s": -0.5, "g": 1.5}},
    ],
)
@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_problems_stated_wrongly(criterion: type, wrong: dict[str, object]) -> None:
    with pytest.raises(ModelError):
        criterion(**({"model": fork(), "start": "s"} | wrong))


def test_arguments_of_solve_stated_wrongly() -> None:
    problem = MCMP(fork(), start="s", failure_budget=0.05)
    for wrong in ({"method": "magic"}, {"method": 3}, {"tolerance": 0.0}, {"time_limit": -1.0}):
        with pytest.raises(ModelError):
            solve(problem, **wrong)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match="backend must be one of"):
        LinearProgramming("magic")
    with pytest.raises(ModelError):
        MCMP(fork(), start="s", give_up="never")


def test_a_time_limit_returns_an_honest_gap() -> None:
    solution = solve(MCMP(fork(), start="s", failure_budget=0.05), time_limit=0.0)
    assert solution.failure_probability <= 0.05 + 1e-12
    assert solution.lower_bound <= solution.objective
    assert np.isfinite(solution.gap)


def test_a_long_shot_is_no_guide_to_the_cap() -> None:
    """The policy nearest to the goal in steps succeeds once in 10^10 runs."""
    p = 1e-10
    model = model_of(
        {
            "a": {
                "long": [(p, "g", 1), (1 - 1.5 * p, "a", 1), (0.5 * p, "d", 1)],
                "walk": [(1.0, "b", 1)],
            },
            "b": {"go": [(0.9, "g", 1), (0.1, "d", 1)]},
            "d": {"stay": [(1.0, "d", 1)]},
        }
    )
    solution = solve(S3P(model, "a", 0.2))
    assert solution.objective == pytest.approx(2.0, rel=1e-12)
    assert solution.gap <= 1e-9


def test_a_budget_equal_to_the_least_failure_keeps_its_bound_under_a_small_cap() -> None:
    model = model_of(
        {
            "a": {"u": [(1.0, "c", 1)], "die": [(1.0, "d", 0)]},
            "c": {"u": [(1.0, "g", 1)]},
            "d": {"stay": [(1.0, "d", 0)]},
        }
    )
    solution = solve(S3P(model, "a", 0.0, cost_cap=1))
    assert solution.objective == pytest.approx(2.0, rel=1e-12)
    assert solution.gap <= 1e-9


@pytest.mark.parametrize("budget", [0.9999, 0.999999, 1.0])
def test_a_slack_budget_near_one_keeps_its_bound(budget: float) -> None:
    """Values that are exactly 0 stay so when others are lowered."""
    model = model_of(
        {
            "a": {"u": [(0.5, "c", 3), (0.25, "d", 3), (0.25, "a", 1)], "v": [(1.0, "b", 1)]},
            "b": {"u": [(0.75, "g", 0), (0.25, "d", 1)], "loop": [(1.0, "b", 0)]},
            "c": {"u": [(1.0, "g", 2)]},
            "d": {"u": [(0.25, "g", 0), (0.75, "a", 1)], "w": [(0.5, "b", 0), (0.5, "b", 1)]},
        }
    )
    solution = solve(S3P(model, "a", budget))
    assert solution.objective == pytest.approx(1.0, rel=1e-9)
    assert solution.gap <= 1e-9


@pytest.mark.parametrize("method", ["columns", "lp"])
def test_a_budget_that_a_policy_meets_to_the_last_digit_needs_no_lottery(method):
    """Waiting succeeds with 1/12 at no cost, and its failure is summed to a digit above 11/12."""
    steps = {
        "a": {"on": [(1.0, "b", 1)], "wait": [(0.2, "b", 0), (0.8, "a", 0)]},
        "b": {"back": [(1.0, "a", 1)], "go": [(1.0, "goal", 0)]},
    }
    model = SSP.from_transitions(steps, goal={"goal"})
    asked = {"give_up": "anywhere", "charge_failing_step": False, "discount": 0.5}
    solution = solve(MCMP(model, "a", failure_budget=11 / 12, **asked), method)
    assert (solution.objective, solution.gap) == (0.0, 0.0)
    assert solution.policy.weights.tolist() == [1.0]
