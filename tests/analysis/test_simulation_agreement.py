"""Simulated episodes against exact evaluation, with a fixed seed and four standard errors."""

from math import sqrt
from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import given, strategies as st

from checks import library_model
from formulations import MCMP, S3P
from small_models import model_of
from ssp_lp import InfeasibleError, evaluate, simulate, solve
from strategies import budgets, often, problems

SIGMAS = 4.0
EPISODES = 4_000
WALK = {
    "a": {
        "slow": [(0.5, "b", 1), (0.5, "a", 1)],
        "fast": [(0.6, "G", 2), (0.3, "b", 1), (0.1, "pit", 1)],
        "wait": [(1.0, "a", 1)],
    },
    "b": {"on": [(0.9, "G", 1), (0.1, "a", 2)], "jump": [(0.7, "G", 0), (0.3, "wall", 0)]},
    "pit": {"stuck": [(1.0, "pit", 3)]},
    "wall": {},
}


def close_in_probability(count, episodes, probability):
    """Whether a count lies within four standard errors of its expectation."""
    sigma = sqrt(max(probability * (1 - probability), 0.0) / episodes)
    return abs(count / episodes - probability) <= SIGMAS * sigma + 1e-9


def close_to_estimate(estimate, value):
    """Whether a value lies within the interval, widened to four standard errors."""
    normal = NormalDist().inv_cdf(0.5 + estimate.confidence / 2)
    widen = SIGMAS / normal
    low = estimate.value - widen * (estimate.value - estimate.low)
    high = estimate.value + widen * (estimate.high - estimate.value)
    return low - 1e-9 <= value <= high + 1e-9


def check_report(report, evaluation, episodes):
    """Counts and estimates of a report against the exact evaluation."""
    assert report.episodes == episodes
    assert sum(report.ends.values()) == episodes
    goals = report.ends.get("goal", 0)
    assert close_in_probability(goals, episodes, evaluation.goal_probability)
    assert report.goal_probability.value == pytest.approx(goals / episodes)
    assert close_to_estimate(report.goal_probability, evaluation.goal_probability)
    if goals > 100:
        assert close_to_estimate(report.conditional_cost, evaluation.conditional_cost)


@pytest.mark.parametrize("formulation", [MCMP, S3P])
@pytest.mark.parametrize("discount", [None, 0.95])
@pytest.mark.parametrize("budget", [0.15, 0.4])
def test_ends_and_costs_of_a_lottery(formulation, discount, budget):
    """Ends by label; the cost estimates of a case-M solution that has an end to its episodes."""
    model = model_of(WALK, "G", labels={"wall": ["wall"]})
    problem = formulation(
        model, start={"a": 0.75, "b": 0.25}, failure_budget=budget, discount=discount
    )
    solution = solve(problem)
    evaluation = evaluate(solution.policy, problem)
    report = simulate(
        solution.policy,
        problem,
        episodes=20_000,
        rng=np.random.default_rng(7),
        max_steps=2_000,
    )
    check_report(report, evaluation, 20_000)
    for end in ("goal", "wall", "dead_end", "gave_up"):
        found, exact = report.ends.get(end, 0), evaluation.ends.get(end, 0.0)
        assert close_in_probability(found, 20_000, exact), end
    if formulation is MCMP:
        assert close_to_estimate(report.expected_cost, evaluation.expected_cost)


@often(40)
@given(problems(most_live=3), st.sampled_from([MCMP, S3P]), budgets)
def test_drawn_problems(drawn, formulation, place):
    """The goal is reached as often as the evaluation says, and at that cost."""
    budget = 0.5 if isinstance(place, str) else place
    problem = formulation(library_model(drawn), start=drawn.start, failure_budget=budget)
    try:
        solution = solve(problem)
    except InfeasibleError:
        return
    evaluation = evaluate(solution.policy, problem)
    report = simulate(
        solution.policy,
        problem,
        episodes=EPISODES,
        rng=np.random.default_rng(11),
        max_steps=300,
    )
    check_report(report, evaluation, EPISODES)
