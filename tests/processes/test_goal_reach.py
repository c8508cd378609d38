"""Greatest goal probabilities, and least failures, where failing is all but impossible in places.

Reference: value iteration from below and from above, state by state in a stated order, with the
equations written out; its two values enclose the truth but for rounding.
"""

import pickle
import time
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from examples.solver_comparison.instances.families import (
    corridor,
    headings,
    holes,
    racetrack,
    river,
    sysadmin,
    tandem,
)
from formulations import MCMP, S3P, AlphaMCMP, MaxProb, MinCost
from small_models import model_of
from ssp_lp import SSP, InfeasibleError, OutOfTimeError, Status, certify, evaluate, solve
from ssp_lp.accumulated_cost.totals import Resolution, resolution_of_costs
from ssp_lp.compiled.deadline import Stop
from ssp_lp.dynamic_programming import extreme_reach
from ssp_lp.dynamic_programming.extreme_reach import attaining_pairs
from ssp_lp.model.graph import attention_states
from ssp_lp.policies import DeterministicPolicy
from ssp_lp.processes.goal_reach import greatest_goal_reach
from ssp_lp.processes.live_rows import costless_pairs
from ssp_lp.processes.quotient import build_quotient

_ENDS = 60.0  # seconds; what is looked at here took for ever


def enclosed(model, sweeps):
    """The greatest goal probability from state 0 by sweeps over all states, from 0 and from 1."""
    probability = model.probabilities.reshape(-1, model.outcome_offsets[1])
    successors = model.successors.reshape(probability.shape)
    live, goal = int(np.count_nonzero(np.diff(model.pair_offsets))), int(model.goal_mask.argmax())
    home = np.repeat(np.arange(live), len(successors) // live)
    stays = successors == home[:, None]
    loops = np.where(stays, probability, 0.0).sum(axis=1)
    away = np.where(stays, 0.0, probability)
    low, high = np.zeros(model.n_states), np.ones(model.n_states)
    low[goal], high[live:] = 1.0, np.arange(live, model.n_states) == goal
    for _ in range(sweeps):
        for values in (low, high):
            total = (away * values[successors]).sum(axis=1)
            ahead = np.where(loops < 1.0, total / np.maximum(1.0 - loops, 1e-300), values[home])
            values[:live] = ahead.reshape(live, -1).max(axis=1)
    return float(low[0]), float(high[0])


@pytest.fixture(params=[False, True], ids=["numpy", "compiled"])
def either_way(request, accelerate):
    if request.param:
        pytest.importorskip("numba")
    accelerate(request.param)


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize(("side", "slip", "share", "seed"), [(34, 0.3, 0.1, 2), (33, 0.1, 0.1, 4)])
def test_the_greatest_probability_of_a_grid_with_holes(side, slip, share, seed):
    model = holes(side, slip=slip, share=share, seed=seed)
    solution = solve(MaxProb(model, 0), time_limit=_ENDS)
    low, high = enclosed(model, 2_000)
    assert low - 1e-9 <= solution.objective <= high + 1e-9
    assert solution.gap <= 1e-9
    attained = evaluate(solution.policy, solution.problem).goal_probability
    assert attained == pytest.approx(solution.objective, rel=1e-9)
    assert certify(solution).accepted


@pytest.mark.parametrize(
    ("side", "slip", "share", "seed"), [(44, 0.3, 0.1, 1), (60, 0.1, 0.07, 7), (60, 0.05, 0.1, 9)]
)
def test_least_failure_of_a_large_grid_ends_and_criteria_agree(side, slip, share, seed):
    """Where hardly anything fails, cost until failure and cost given success are one."""
    pytest.importorskip("numba")
    model = holes(side, slip=slip, share=share, seed=seed)
    best = solve(MaxProb(model, 0), time_limit=_ENDS)
    cheapest = solve(MCMP(model, 0), time_limit=_ENDS)
    assert best.gap <= 1e-9
    assert cheapest.failure_probability == pytest.approx(best.failure_probability, abs=1e-9)
    given_success = solve(S3P(model, 0), time_limit=_ENDS)
    assert given_success.gap <= 1e-6
    if best.failure_probability < 1e-9:
        assert given_success.objective == pytest.approx(cheapest.objective, rel=1e-6)
    share_of_best = solve(AlphaMCMP(model, 0, 0.9), time_limit=_ENDS)
    assert share_of_best.goal_probability == pytest.approx(0.9 * best.objective, rel=1e-9)
    assert share_of_best.objective <= cheapest.objective * (1 + 1e-9)


def test_what_fails_alike_does_not_hang_on_the_policy_found(monkeypatch):
    """Neither on its last digits nor on how long it takes: the cost is the same in any process."""
    pytest.importorskip("numba")
    model = holes(44, slip=0.3, share=0.1, seed=1)
    costs = []
    for accelerator in ("numba", "none"):
        monkeypatch.setenv("SSP_LP_ACCELERATOR", accelerator)
        costs.append(solve(MCMP(model, 0)).objective)
        _, found = greatest_goal_reach(model).solved
        slower = replace(found, totals=replace(found.totals, runs=1e6 * found.totals.runs))
        np.testing.assert_array_equal(attaining_pairs(slower), attaining_pairs(found))
    assert costs[0] == pytest.approx(costs[1], rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("budget", [0.05, 0.2])
def test_a_cost_given_success_is_swept_as_far_as_the_price_asks(budget):
    """From the price of failure on it is best to fail: totals beyond twice as much tell nothing."""
    pytest.importorskip("numba")
    model = holes(40, seed=3)
    solution = solve(S3P(model, 0, budget))
    assert solution.gap <= 1e-9
    assert solution.failure_probability == pytest.approx(budget, rel=1e-9)
    price = solution.objective + (solution.failure_price or 0.0)
    assert solution.run.work.backups <= 2.0 * (price + 2.0) * (solution.run.pricing_calls + 1)
    until_failing = solve(MCMP(model, 0, budget, charge_failing_step=False))
    assert solution.objective <= evaluate(until_failing.policy, solution.problem).objective
    assert certify(solution).accepted


def test_a_start_that_surely_reaches_the_goal_is_decided_on_the_graph():
    model = river(100, 1000)
    solution = solve(MaxProb(model, 0), time_limit=_ENDS)
    assert solution.objective == 1.0
    assert solution.gap == 0.0
    cheapest = solve(MinCost(model, 0), time_limit=_ENDS)
    assert cheapest.gap <= 1e-9
    known = solve(MCMP(model, 0), time_limit=_ENDS).objective
    assert known == pytest.approx(cheapest.objective, rel=1e-9)


@pytest.mark.slow
def test_a_racetrack_of_seventy_thousand_states_ends():
    pytest.importorskip("numba")
    model = racetrack(38)
    assert model.n_states == 70_758
    solution = solve(MaxProb(model, 0), time_limit=_ENDS)
    assert solution.gap <= 1e-9
    assert certify(solution).accepted


@pytest.mark.slow
def test_a_small_grid_whose_runs_are_long_has_an_answer():
    """Runs of 1e8 steps: a bound by state reduction took a minute where it was not compiled."""
    pytest.importorskip("numba")
    problem = MaxProb(holes(27, slip=0.01, share=0.2, seed=111), 0)
    solution = solve(problem, time_limit=_ENDS)
    assert solution.status is not Status.TIME_LIMIT
    attained = evaluate(solution.policy, problem).goal_probability
    assert attained == pytest.approx(solution.objective, rel=1e-9)
    assert solution.objective <= (solution.upper_bound or 0.0)


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize(
    "model",
    [holes(40, seed=3), racetrack(10), headings(20), tandem(40), sysadmin(11), corridor(1_200)],
    ids=["holes", "racetrack", "headings", "tandem", "sysadmin", "corridor"],
)
def test_sweeps_enclose_what_policy_iteration_settles(model):
    start = np.zeros(model.n_states)
    start[0] = 1.0
    settled = greatest_goal_reach(model, start=start)
    swept = greatest_goal_reach(model, start=start, precise=False)
    assert (swept.goal <= settled.bound + 1e-12).all()
    assert (swept.bound >= settled.goal - 1e-12).all()
    assert swept.bound[0] - swept.goal[0] <= 1e-11
    attained = evaluate(DeterministicPolicy(model, swept.decision), MaxProb(model, 0))
    assert swept.goal[0] - 1e-12 <= attained.goal_probability <= swept.bound[0] + 1e-12


@pytest.mark.usefixtures("either_way")
def test_where_the_time_ends_a_policy_towards_the_goal_is_in_hand(monkeypatch):
    def late(*_):
        raise Stop

    monkeypatch.setattr(extreme_reach, "_settled_reach", late)
    monkeypatch.setattr(extreme_reach, "_MOST_SWEEPS", 8)
    problem = MaxProb(headings(20), 0)
    solution = solve(problem)
    assert solution.upper_bound == 1.0
    assert solution.status is Status.TIME_LIMIT
    attained = evaluate(solution.policy, problem).goal_probability
    assert 0.0 < solution.objective <= attained + 1e-12


def test_where_no_policy_is_sure_the_least_failure_is_worked_out_when_it_is_read():
    problem = MinCost(headings(20), 0)
    with pytest.raises(InfeasibleError, match="surely from state 0") as caught:
        solve(problem)
    best = solve(MaxProb(problem.model, 0))
    copy = pickle.loads(pickle.dumps(caught.value))  # noqa: S301
    assert copy.least_failure == caught.value.least_failure
    assert copy.least_failure == pytest.approx(1.0 - best.objective, abs=1e-10)
    assert str(copy) == str(caught.value)


def test_a_share_of_a_greatest_probability_that_nobody_had_the_time_for_is_no_budget(monkeypatch):
    def late(*_):
        time.sleep(0.3)
        raise Stop

    monkeypatch.setattr(extreme_reach, "_settled_reach", late)
    monkeypatch.setattr(extreme_reach, "_MOST_SWEEPS", 1)
    monkeypatch.setattr("ssp_lp.problem.READING", 0.01)
    with pytest.raises(OutOfTimeError, match="failure_budget"):
        _ = AlphaMCMP(headings(20), 0, 0.9).failure_budget


def test_a_policy_whose_run_is_exponentially_long_is_evaluated():
    """A walk against the wind, which loses nothing: whoever arrives chooses 0.6."""
    pytest.importorskip("numba")
    length, onward = 1_300, 0.48
    walk = {
        k: {"go": [(onward, k + 1, 1.0), (1.0 - onward, max(k - 1, 0), 1.0)]} for k in range(length)
    }
    walk[length] = {"end": [(0.6, "home", 1.0), (0.4, "pit", 1.0)]}
    model = model_of({**walk, "pit": {}}, "home")
    solution = solve(MaxProb(model, 0))
    assert solution.objective == pytest.approx(0.6, rel=1e-12)
    ratio = (1.0 - onward) / onward
    steps = sum(ratio**i * (length - i) for i in range(length)) / onward
    assert solution.expected_cost == pytest.approx(steps + 1.0, rel=1e-9)


def test_a_grid_with_real_costs_has_too_many_sums_to_follow():
    """So many kinds of steps that to number what each leads to from every sum filled the memory."""
    model = holes(39, slip=0.2, share=0.08, seed=4)
    costs = model.costs * np.random.default_rng(4).uniform(0.5, 2.0, model.n_outcomes)
    assert resolution_of_costs(replace(model, costs=costs)) == Resolution()


def halls(seed):
    """Three free rings of rooms, with ways out of some of them, and passages that cost."""
    rng, ways = np.random.default_rng(seed), {}
    for hall in range(3):
        for room in range(4):
            here = {"round": [(1.0, (hall, (room + 1) % 4), 0.0)]}
            if rng.random() < 0.7 or room == 0:
                to = "G" if hall == 2 else (hall + 1, int(rng.integers(4)))
                here["out"] = [(0.8, to, 1.0), (0.2, (0, 0), 2.0)]
            if rng.random() < 0.5:
                here["across"] = [(0.5, (hall, (room + 2) % 4), 0.0), (0.5, (hall, 0), 0.0)]
            ways[hall, room] = here
    ways["lone"] = {"in": [(1.0, (0, 1), 1.0)], "far": [(1.0, (1, 1), 3.0)]}
    return SSP.from_transitions(ways, goal={"G"})


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("seed", range(5))
def test_all_layers_at_once_are_each_by_itself(seed):
    """Decisions of many layers pulled back, where free components are one place."""
    model = halls(seed)
    quotient = build_quotient(model, free=costless_pairs(model), exits=attention_states(model))
    assert quotient.merged.any()
    rng, first = np.random.default_rng(seed), quotient.pair_offsets[:-1]
    choice = rng.integers(0, np.diff(quotient.pair_offsets), (50, quotient.n_nodes))
    found = quotient.positions(first, choice)
    for layer, positions in zip(choice, found, strict=True):
        pairs = quotient.pull_back(first + layer)
        np.testing.assert_array_equal(
            positions, np.where(pairs < 0, pairs, pairs - model.pair_offsets[:-1])
        )


# Steps that lead to later states only: one pass from the last state to the first.


def states_in_order(seed):
    """A model of a goal, a dead-end and up to twelve states, and the greatest goal probabilities.

    Probabilities are multiples of 1/8, so that those of up to twelve steps have no rounding.
    """
    rng, ways = np.random.default_rng(seed), {}
    last = int(rng.integers(2, 13))
    best = {last: Fraction(1), last + 1: Fraction(0)}
    for state in reversed(range(last)):
        ways[state] = {}
        for action in range(int(rng.integers(1, 4))):
            after = rng.choice(np.arange(state + 1, last + 2), int(rng.integers(1, 4)))
            shares = np.diff([0, *np.sort(rng.integers(0, 9, after.size - 1)), 8])
            ways[state][str(action)] = [
                (int(share) / 8, int(t), 1.0) for share, t in zip(shares, after, strict=True)
            ]
        best[state] = max(
            sum(Fraction(p) * best[t] for p, t, _ in outcomes) for outcomes in ways[state].values()
        )
    ways = {state: ways[state] for state in range(last)} | {last + 1: {}}
    model = SSP.from_transitions(
        {**ways, last: {}}, goal={last}, treat_actionless_as_dead_ends=True
    )
    return model, best


@pytest.mark.parametrize("seed", range(40))
@pytest.mark.usefixtures("either_way")
def test_one_pass_finds_the_greatest_goal_probabilities(seed):
    model, best = states_in_order(seed)
    solution = solve(MaxProb(model, 0))
    assert solution.objective == pytest.approx(float(best[0]), rel=1e-14, abs=0.0)
    assert solution.upper_bound >= float(best[0]) * (1.0 - 1e-15)
    attained = evaluate(solution.policy, solution.problem).goal_probability
    assert attained == pytest.approx(float(best[0]), rel=1e-14, abs=0.0)
    hopeless = {state for state, value in best.items() if not value}
    (plan,) = solution.policy.policies
    assert not hopeless & set(plan.actions())


@pytest.mark.usefixtures("either_way")
def test_one_pass_keeps_the_action_where_the_goal_is_all_but_impossible():
    """Three steps of 1e-150 each: their product is no number, but it is not 0."""
    ways = {k: {"go": [(1e-150, k + 1, 1.0), (1.0, "d", 1.0)]} for k in range(3)}
    model = SSP.from_transitions(
        {**ways, 3: {}, "d": {}}, goal={3}, treat_actionless_as_dead_ends=True
    )
    solution = solve(MaxProb(model, 0))
    (plan,) = solution.policy.policies
    assert plan.actions() == {0: "go", 1: "go", 2: "go"}
