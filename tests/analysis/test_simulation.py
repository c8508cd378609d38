"""Simulation: intervals and ends."""

from __future__ import annotations

from dataclasses import replace
from math import log, sqrt
from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.stats import binomtest

from checks import library_model
from drawn_policies import drawn_model, drawn_policy
from formulations import MCMP, S3P, LeastQuantity, MaxProb, MinCost
from small_models import TRIES
from ssp_lp import (
    DeterministicPolicy,
    InfeasibleError,
    ModelError,
    SSPError,
    end_probability,
    evaluate,
    simulate,
    solve,
    visits,
)
from ssp_lp.analysis.simulation import greatest_total, mean_estimate, proportion_estimate
from strategies import budgets, often, problems
from written_models import written

# Simulated episodes against exact evaluation; intervals that hold for rare dear events.


SIGMAS = 4.0
WALK = written(
    """
    a slow: 0.5 b 1, 0.5 a 1
    a fast: 0.6 g 2, 0.3 b 1, 0.1 pit 1
    a wait: a 1
    b on: 0.9 g 1, 0.1 a 2
    b jump: 0.7 g 0, 0.3 wall 0
    pit stuck: pit 3
    """,
    labels={"wall": ["wall"]},
)
GO = DeterministicPolicy.from_actions(TRIES, {"door": "try"})


def close_in_probability(count, episodes, probability):
    """Whether a count lies within four standard errors of its expectation."""
    sigma = sqrt(max(probability * (1 - probability), 0.0) / episodes)
    return abs(count / episodes - probability) <= SIGMAS * sigma + 1e-9


def close_to_estimate(estimate, value):
    """Whether a value lies within the interval, widened to four standard errors."""
    widen = SIGMAS / NormalDist().inv_cdf(0.5 + estimate.confidence / 2)
    low = estimate.value - widen * (estimate.value - estimate.low)
    high = estimate.value + widen * (estimate.high - estimate.value)
    return low - 1e-9 <= value <= high + 1e-9


def simulated(problem, **asked):
    """A report whose counts and estimates are those of the exact evaluation, and that."""
    policy = solve(problem).policy
    evaluation = evaluate(policy, problem)
    report = simulate(policy, problem, **asked)
    episodes, goals = asked["episodes"], report.ends.get("goal", 0)
    assert report.episodes == sum(report.ends.values()) == episodes
    assert close_in_probability(goals, episodes, evaluation.goal_probability)
    assert report.goal_probability.value == pytest.approx(goals / episodes)
    assert close_to_estimate(report.goal_probability, evaluation.goal_probability)
    if goals > 100:
        assert close_to_estimate(report.conditional_cost, evaluation.conditional_cost)
    return report, evaluation


@pytest.mark.parametrize("formulation", [MCMP, S3P])
@pytest.mark.parametrize("discount", [None, 0.95])
@pytest.mark.parametrize("budget", [0.15, 0.4])
def test_ends_and_costs_of_a_lottery(formulation, discount, budget):
    """Ends by label; the cost estimates of a case-M solution that has an end to its episodes."""
    problem = formulation(WALK, {"a": 0.75, "b": 0.25}, failure_budget=budget, discount=discount)
    report, evaluation = simulated(problem, episodes=20_000, seed=7, max_steps=2_000)
    for end in ("goal", "wall", "dead_end", "gave_up"):
        found, exact = report.ends.get(end, 0), evaluation.ends.get(end, 0.0)
        assert close_in_probability(found, 20_000, exact), end
    if formulation is MCMP:
        assert close_to_estimate(report.expected_cost, evaluation.expected_cost)


@often(13)
@given(problems(most_live=3), st.sampled_from([MCMP, S3P]), budgets)
def test_drawn_problems(drawn, formulation, place):
    """The goal is reached as often as the evaluation says, and at that cost."""
    budget = 0.5 if isinstance(place, str) else place
    problem = formulation(library_model(drawn), start=drawn.start, failure_budget=budget)
    try:
        simulated(problem, episodes=4_000, seed=11, max_steps=300)
    except InfeasibleError:
        return


# What is paid after failing


def drawn_plain_policy(draw, model):
    """Any action in each state, so that many a goal is lost before a dead-end is entered."""
    acting = np.flatnonzero((np.diff(model.pair_offsets) > 0) & ~model.goal_mask).tolist()
    pairs = [int(draw.integers(*model.pair_offsets[s : s + 2])) for s in acting]
    actions = {model.states[s]: model.action_of(k) for s, k in zip(acting, pairs, strict=True)}
    return DeterministicPolicy.from_actions(model, actions)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
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
                policy, problem, episodes=2_000, seed=seed, max_steps=400, confidence=0.99999
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
    model = written(
        """
        a go: 0.5 g 1, 0.5 b 1
        b on: c 1
        b back: a 9
        c on: d 2
        c back: a 9
        """,
        labels={"pit": ["d"]},
    )
    policy = DeterministicPolicy.from_actions(model, {"a": "go", "b": "on", "c": "on"})
    plain = MCMP(model, "a", 1.0, charge_failing_step=False)
    counted = replace(plain, constraints={"p": end_probability("pit") <= 0.5})
    for problem, later in ((plain, None), (counted, 1.5), (S3P(model, "a", 1.0), None)):
        exact = evaluate(policy, problem)
        report = simulate(policy, problem, episodes=1_000, seed=0)
        assert exact.expected_cost == report.expected_cost.value == 1.0
        assert exact.cost_after_failing == later
        if later is not None:
            assert report.cost_after_failing.low < later < report.cost_after_failing.high


# Intervals of mean costs

LAWS = {
    "rare and dear": ([1.0, 1000.0], [0.9997, 0.0003]),
    "rare and free": ([0.0, 1000.0], [0.001, 0.999]),
    "a toss": ([1.0, 3.0], [0.5, 0.5]),
    "three kinds": ([0.0, 1.0, 200.0], [0.3, 0.69, 0.01]),
    "always": ([2.0], [1.0]),
}


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("size", [20, 1000])
def test_they_cover_the_mean_as_often_as_they_say(name, size):
    """At least 95 % of 400 samples, less four deviations of such a count."""
    values, shares = (np.array(part) for part in LAWS[name])
    draw, held, truth = np.random.default_rng(7), 0, float(values @ shares)
    for _ in range(400):
        sample = draw.choice(values, size=size, p=shares)
        found = mean_estimate(sample, 0.95, float(values.max()))
        assert 0.0 <= found.low <= found.value <= found.high <= values.max()
        held += found.low <= truth + 1e-9 and truth - 1e-9 <= found.high
    assert held / 400 >= 0.95 - 4.0 * np.sqrt(0.95 * 0.05 / 400)


def test_the_lower_end_asks_for_no_greatest_cost():
    """It is the mean of the sample without so much of its upper tail as chance may have added."""
    sample = np.random.default_rng(5).exponential(3.0, 2000)
    found = [mean_estimate(sample, 0.95, most) for most in (100.0, 1e9)]
    assert found[0].low == found[1].low > 2.5
    without = np.sort(sample)[: -int(np.ceil(2000 * np.sqrt(np.log(40.0) / 4000.0)))]
    assert 0.99 * without.sum() / 2000 <= found[0].low <= without.sum() / 2000 + sample.max() * 0.04


def test_a_simulation_that_shows_no_rare_event_knows_of_it():
    """One step, that is dear once in three thousand times."""
    toll = written("gate cross: 0.9997 g 1, 0.0003 g 1000")
    policy = DeterministicPolicy.from_actions(toll, {"gate": "cross"})
    problem, held = MCMP(toll, "gate"), 0
    for seed in range(60):
        report = simulate(policy, problem, episodes=1000, seed=seed)
        for found in (report.conditional_cost, report.expected_cost):
            assert found.high < 40.0
            held += found.low <= 1.2997 <= found.high
    assert held >= 117


def test_the_greatest_total_of_an_episode():
    """A loop counts as often as there are steps; what is on the way counts once."""
    rooms = """
        a on: 0.5 b 2, 0.5 c 9
        a skip: d 10
        b on: d 3
        c on: d 1
        d on: 0.9 g 4, 0.1 pit 50
        pit stay: pit 70
        """
    model = written(rooms)
    assert greatest_total(model, 10_000)[0] == 9.0 + 1.0 + 50.0
    assert greatest_total(model, 1)[0] == 50.0
    assert greatest_total(TRIES, 100)[0] == 100 * float(TRIES.costs.max())
    assert greatest_total(written(rooms + "\n b back: b 0.25"), 100)[0] == 25.0 + 60.0


def test_costs_that_are_cut_say_so_and_too_many_episodes_are_refused():
    problem = MCMP(TRIES, "door")
    report = simulate(GO, problem, episodes=500, seed=0, max_steps=2)
    cut = report.ends["unfinished"]
    assert report.note == f"costs are cut: {cut} episodes were unfinished after 2 steps"
    assert report.note in repr(report)
    played_out = simulate(GO, problem, episodes=500, seed=0)  # it may try for ever
    assert played_out.note.startswith("upper ends of costs allow for an unseen episode of 10,000")
    words = "episodes must be a whole number >= 1 and <= 100,000,000, not 1000000000000"
    with pytest.raises(ModelError, match=words):
        simulate(GO, problem, episodes=10**12, seed=0)
    with pytest.raises(ModelError, match=words):
        GO.start_many(10**12)


@pytest.mark.parametrize("confidence", [0.9, 0.95, 0.9999])
def test_intervals_of_proportions_are_those_of_clopper_and_pearson(confidence):
    for trials in (1, 2, 7, 40, 1000):
        for hits in {0, 1, trials // 3, trials - 1, trials}:
            found = proportion_estimate(hits, trials, confidence)
            known = binomtest(hits, trials).proportion_ci(confidence, "exact")
            assert (found.low, found.high) == pytest.approx((known.low, known.high), abs=1e-10)


def test_intervals_of_means_by_hand():
    """Of one episode anything up to the greatest cost is possible; of many, Maurer and Pontil's."""
    one = mean_estimate(np.array([3.0]), 0.95, 10.0)
    assert (one.value, one.low, one.high, one.standard_error) == (3.0, 0.0, 10.0, None)
    two = mean_estimate(np.array([1.0, 3.0]), 0.95, 10.0)
    assert two.high == 10.0  # the bound of the theorem is 2 + sqrt(2 ln 80) + 70 ln 80 / 3
    assert two.low == pytest.approx(1.0 - sqrt(log(40.0) / 4.0))  # from 0 to 1 all costs are more
    many = mean_estimate(np.tile([0.0, 2.0], 5_000), 0.95, 10.0)
    deviation = sqrt(10_000 / 9_999)
    spread = deviation * sqrt(2.0 * log(80.0) / 10_000)
    assert many.high == pytest.approx(1.0 + spread + 70.0 * log(80.0) / (3.0 * 9_999), rel=1e-12)
    assert many.low == pytest.approx(2.0 * (0.5 - sqrt(log(40.0) / 20_000)), rel=1e-12)
