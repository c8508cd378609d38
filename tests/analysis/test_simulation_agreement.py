"""Simulated episodes against exact evaluation, with a fixed seed and four standard errors."""

from math import sqrt
from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import given, strategies as st

from checks import library_model
from drawn_policies import drawn_model, drawn_policy
from formulations import MCMP, S3P, LeastQuantity, MaxProb, MinCost
from small_models import model_of
from ssp_lp import (
    DeterministicPolicy,
    InfeasibleError,
    SSPError,
    end_probability,
    evaluate,
    simulate,
    solve,
    visits,
)
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


def drawn_plain_policy(draw, model):
    """Any action in each state, so that many a goal is lost before a dead-end is entered."""
    acting = np.flatnonzero((np.diff(model.pair_offsets) > 0) & ~model.goal_mask).tolist()
    pairs = [int(draw.integers(*model.pair_offsets[s : s + 2])) for s in acting]
    actions = {model.states[s]: model.action_of(k) for s, k in zip(acting, pairs, strict=True)}
    return DeterministicPolicy.from_actions(model, actions)


@pytest.mark.parametrize("seed", range(15))
def test_costs_until_failing_and_after_it_are_one_number_each(seed):
    """Of every criterion and every policy: simulated as evaluated, under one name."""
    draw = np.random.default_rng(seed)
    model = drawn_model(draw, [0.0, 1.0, 2.0])
    other = drawn_plain_policy(draw, model)
    if seed % 3:
        other = drawn_policy(draw, model, on_levels=seed % 3 == 1)
    pit, seen = {"pit": end_probability("pit") <= 0.9}, {"seen": visits(1) <= 1.0}
    beyond = {"seen": visits(1, through_failure=True) <= 1.0}
    asked = [
        *(MCMP(model, 0, 0.6, give_up=word) for word in ("anywhere", "attention", "dead_ends")),
        *(MCMP(model, 0, 0.9, constraints=limits) for limits in (pit, beyond)),
        *(S3P(model, 0, 0.9, constraints=limits) for limits in ({}, pit, seen)),
        MinCost(model, 0),
        MaxProb(model, 0, constraints=pit),
        LeastQuantity(model, 0, visits(1), 0.9),
    ]
    for problem in asked:
        for made in (other, None):
            try:
                policy = solve(problem).policy if made is None else made
                exact = evaluate(policy, problem)
            except SSPError:
                continue
            report = simulate(
                policy, problem, episodes=2_000, rng=seed, max_steps=400, confidence=0.99999
            )
            goes_on = problem.unrolled is not problem
            assert (exact.cost_after_failing is not None) == goes_on
            assert (report.cost_after_failing is not None) == goes_on
            for name in ("expected_cost", "cost_after_failing")[: 1 + goes_on]:
                cost, estimate = getattr(exact, name), getattr(report, name)
                if cost == np.inf:  # paid for ever: or cut off after so many steps
                    assert estimate.value == np.inf or report.ends["unfinished"]
                    continue
                assert estimate.low - 1e-9 <= cost <= estimate.high + 1e-9, (problem, name)


def test_what_is_paid_once_the_goal_is_lost_is_not_the_cost():
    """Three steps of 1 after the goal is lost: 1 until failing, 3 later where they count."""
    moves = {"a": {"go": [(0.5, "g", 1), (0.5, "b", 1)]}, "d": {}}
    moves |= {
        "b": {"on": [(1.0, "c", 1)], "back": [(1.0, "a", 9)]},
        "c": {"on": [(1.0, "d", 2)], "back": [(1.0, "a", 9)]},
    }
    model = model_of(moves, "g", labels={"pit": ["d"]})
    policy = DeterministicPolicy.from_actions(model, {"a": "go", "b": "on", "c": "on"})
    plain = MCMP(model, "a", 1.0, charge_failing_step=False)
    counted = MCMP(
        model, "a", 1.0, charge_failing_step=False, constraints={"p": end_probability("pit") <= 0.5}
    )
    for problem, later in ((plain, None), (counted, 1.5), (S3P(model, "a", 1.0), None)):
        exact = evaluate(policy, problem)
        report = simulate(policy, problem, episodes=1_000, rng=0)
        assert exact.expected_cost == report.expected_cost.value == 1.0
        assert exact.cost_after_failing == later
        if later is not None:
            assert report.cost_after_failing.low < later < report.cost_after_failing.high
