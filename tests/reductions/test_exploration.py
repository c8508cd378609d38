"""Implicit models: the answer is that of the whole model, and what is not known is named."""

from __future__ import annotations

import math
import pickle
import signal
import time
from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ssp_lp import (
    GIVE_UP,
    MCMP,
    S3P,
    SSP,
    CVaR,
    DeterministicPolicy,
    InfeasibleError,
    LeastQuantity,
    MaxProb,
    MinCost,
    MixedPolicy,
    ModelError,
    OutOfTimeError,
    certify,
    end_probability,
    evaluate,
    secondary_cost,
    simulate,
    solve,
    trace_frontier,
    visits,
    write_certificate,
)
from ssp_lp.io import save_model
from ssp_lp.methods.approaches import Case, approach_to
from ssp_lp.reductions import exploration
from tests.campaigns.explored_models import compare
from tests.support.problems.cases import NAMES, load_case, published

GOAL = 3
HOLE = "hole"


def steps(place: Hashable) -> dict[str, list[tuple[float, Hashable, float]]]:
    """A walk on all whole numbers: to the left surely, to the right past a hole."""
    if not isinstance(place, int):
        return {}
    right = [(0.9, place + 1, 1.0), (0.1, HOLE, 1.0)]
    return {"left": [(1.0, place - 1, 1.0)], "right": right}


def distance(place: Hashable) -> float:
    return abs(place - GOAL) if isinstance(place, int) else float("inf")


def walk(**options: Any) -> SSP:
    return SSP.implicit(0, steps, {GOAL}, **{"cost_bound": distance, **options})


SURE = {"failure_budget": 0.5, "give_up": "dead_ends"}


@pytest.mark.parametrize("block", range(2))
def test_drawn_models_are_answered_as_when_built_whole(
    block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exploration, "FIRST", 1)
    for seed in range(1000 + 15 * block, 1015 + 15 * block):
        assert "wrong" not in compare(seed)


@pytest.mark.parametrize(
    "name", [n for n in NAMES if n.startswith(("prism", "storm", "gubs_river"))]
)
def test_published_models_are_answered_as_when_built_whole(name: str) -> None:
    (model, start), case = published(name), load_case(name, "unit")
    transitions = case.floats()
    implicit = SSP.implicit(start, lambda state: transitions.get(state, {}), case.goal)
    least = 1.0 - solve(MaxProb(model, start)).objective
    for budget in (least + 0.3 * (1.0 - least), 1.0):
        whole, part = (solve(MCMP(m, start, min(budget, 1.0))) for m in (model, implicit))
        assert part.objective == pytest.approx(whole.objective, rel=1e-9, abs=1e-9)


def test_a_walk_without_end_is_solved_near_its_start() -> None:
    solution = solve(MCMP(walk(), 0, **SURE))
    part = solution.problem.model
    assert solution.objective == pytest.approx(1.0 + 0.9 + 0.81)
    assert part.n_states < 300
    assert part.find(-1_000) is None
    assert [solution.policy.action(k) for k in (0, 1, 2, 3)] == ["right"] * 3 + [None]
    assert "assuming that no policy reaches the goal for less than cost_bound" in solution.note
    assert "states explored in" in solution.summary()


def test_the_explored_part_is_evaluated_simulated_and_certified() -> None:
    problem = MCMP(walk(), 0, failure_budget=0.3)
    solution = solve(problem)
    for asked in (problem, solution.problem):
        assert evaluate(solution.policy, asked).objective == pytest.approx(solution.objective)
    assert simulate(solution.policy, problem, episodes=500, seed=1).failure_probability.low < 0.3
    proof = certify(solution)
    assert proof.accepted
    assert proof.gap < 1e-9
    assert "assuming that" in proof.summary()
    assert "assuming" not in certify(solve(MCMP(walk(cost_bound=None), 0, 0.3))).summary()


def test_a_policy_that_rests_on_unexplored_states_is_refused() -> None:
    solution = solve(MCMP(walk(), 0, **SURE))
    part = solution.problem.model
    way_out = np.where(part.fringe, part.pair_offsets[:-1], -2)
    left = {place: "left" for place in part.states[: part.n_expanded] if place != HOLE}
    decision = DeterministicPolicy.from_actions(part, left).decision
    away = DeterministicPolicy(part, np.where(part.fringe, way_out, decision))
    forged = exploration.replace(solution, policy=MixedPolicy((away,), np.ones(1)))
    proof = certify(forged)
    assert not proof.accepted
    assert "not explored" in proof.reason


def test_the_explored_part_as_an_ordinary_model() -> None:
    part = solve(MCMP(walk(), 0, **SURE)).problem.model
    plain = part.explored()
    assert type(plain) is SSP
    assert plain.n_states == part.n_states - 2
    assert {plain.action_of(pair) for pair in range(plain.n_pairs)} == {"left", "right"}
    unexplored = plain.state_labels["unexplored"]
    assert (np.diff(plain.pair_offsets)[unexplored] == 0).all()
    assert solve(MCMP(plain, 0, **SURE)).objective == pytest.approx(2.71)


def test_a_state_that_was_not_explored_is_named() -> None:
    policy = solve(MCMP(walk(), 0, **SURE)).policy
    with pytest.raises(ModelError, match="-5000 is not a state of the model, or was not explored"):
        policy.action(-5000)
    fringe = policy.policies[0].model.fringe
    state = policy.policies[0].model.states[int(np.argmax(fringe))]
    with pytest.raises(ModelError, match="no decision in state"):
        policy.action(state)


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda: S3P(walk(), 0, 0.3), "total cost of a run"),
        (lambda: CVaR(walk(), 0, 0.9, 0.3), "total cost of a run"),
        (lambda: MCMP(walk(), 0, 0.3, horizon=5), "horizon does not support"),
        (lambda: MCMP(walk(), 0, reach_fraction=0.5), "solve MaxProb first"),
        (lambda: MCMP(walk(), 7, 0.3), "7 is not a state in which"),
        (lambda: MCMP(walk(), {7: 1.0}, 0.3), "7 is not a state in which"),
        (lambda: _limited(end_probability(HOLE) <= 0.1), "limit visits of these states"),
        (lambda: _limited(end_probability(HOLE) >= 0.1), "limit visits of these states"),
        (lambda: walk(cost_bound=3.0), "cost_bound must be a function of a state"),
        (lambda: walk(state_labels={"unexplored": {1}}), "'unexplored' is reserved"),
        (lambda: write_certificate(solve(MCMP(walk(), 0, 0.3)), "never.cert"), "in memory"),
        (lambda: _limited(visits(2, through_failure=True) <= 1.0), "after failing"),
        (lambda: _limited(secondary_cost({0: {"left": 1.0}}) <= 1.0), "have names"),
        (lambda: MCMP(walk(), 0, 0.3).program(), "before it is explored"),
        (lambda: trace_frontier(MCMP(walk(), 0, 0.3)), "before it is explored"),
        (lambda: walk().n_states, "before it is explored"),
        (lambda: save_model(walk(), "never.npz"), "before it is explored"),
        (lambda: walk(growth=1.0), "growth must be a number above 1"),
        (lambda: solve(MCMP(walk(cost_bound=lambda k: -1.0), 0, 0.3)), "must be a number >= 0"),
        (lambda: solve(MCMP(walk(failure_bound=lambda k: 2.0), 0, 0.3)), r"in \[0, 1\]"),
    ],
)
def test_what_is_not_explored_is_refused_by_name(ask: Callable[[], object], words: str) -> None:
    with pytest.raises(ModelError, match=words):
        ask()


def _limited(limit: Any) -> MCMP:
    return MCMP(walk(), 0, 0.3, constraints={"limit": limit})


def test_a_bound_that_is_none_is_found_out() -> None:
    too_dear = walk(cost_bound=lambda k: 2.0 * distance(k))
    with pytest.raises(ModelError, match=r"cost_bound\(\d\) = \d is not a bound"):
        solve(MCMP(too_dear, 0, **SURE))
    too_sure = walk(failure_bound=lambda k: 0.25 if k == 2 else 0.0)
    with pytest.raises(ModelError, match=r"failure_bound\(2\) = 0.25 is not a bound"):
        solve(MCMP(too_sure, 0, **SURE))


def test_no_policy_within_the_budget_is_known_without_exploring_everything() -> None:
    bound = 1.0 - 0.9**3
    failing = walk(failure_bound=lambda k: 1.0 - 0.9 ** max(3 - k, 0) if k != HOLE else 1.0)
    with pytest.raises(InfeasibleError) as error:
        solve(MCMP(failing, 0, failure_budget=bound / 2))
    assert error.value.least_failure_interval == (pytest.approx(bound), 1.0)
    assert "even if unexplored states attain their bounds" in str(error.value)
    with pytest.raises(InfeasibleError):
        solve(MinCost(failing, 0))


def test_least_failure_is_proved_where_a_bound_closes_it() -> None:
    failing = walk(failure_bound=lambda k: 1.0 - 0.9 ** max(3 - k, 0) if k != HOLE else 1.0)
    solution = solve(MCMP(failing, 0, failure_budget=None))
    assert solution.failure_probability == pytest.approx(0.271)
    assert solution.objective == pytest.approx(2.71)


def test_limits_count_what_is_named() -> None:
    def paid(place: Hashable) -> dict[str, list[tuple[float, Hashable, dict[str, float]]]]:
        return {
            name: [(p, to, {"time": cost, "fuel": 2.0}) for p, to, cost in ends]
            for name, ends in steps(place).items()
        }

    model = SSP.implicit(
        0,
        paid,
        {GOAL},
        cost="time",
        cost_bound=lambda k: {"time": distance(k), "fuel": 2.0 * distance(k)},
        state_labels={"holes": {HOLE}},
    )
    limits = {
        "fuel": secondary_cost("fuel") <= 6.0,
        "far": visits(-4) <= 0.1,
        "holes": visits("holes") <= 0.28,
    }
    solution = solve(MCMP(model, 0, **SURE, constraints=limits))
    assert solution.secondary_costs["fuel"] == pytest.approx(5.42)
    assert solution.secondary_costs["holes"] == pytest.approx(0.271)
    assert solution.secondary_costs["far"] == 0.0
    tighter = {"fuel": secondary_cost("fuel") <= 5.0}
    with pytest.raises(InfeasibleError):
        solve(MinCost(model, 0, constraints=tighter))
    least = solve(LeastQuantity(model, 0, quantity=secondary_cost("fuel"), failure_budget=0.271))
    assert least.objective == pytest.approx(5.42)


def test_all_states_at_once() -> None:
    """Cells 0 .. 10^6 - 1 as numbers, the last one a pit."""
    n, goal = 1_000, 10 * 1_000 + 10
    pit = n * n - 1

    def ends(cells: np.ndarray) -> dict[str, Any]:
        x, y = cells % n, cells // n
        moves = [(x + 1, y), (x, y + 1), (x - 1, y), (x, y - 1)]
        to = np.stack([np.clip(u, 0, n - 1) + n * np.clip(v, 0, n - 1) for u, v in moves], axis=1)
        acting = cells != pit
        return {
            "actions": 4 * acting,
            "outcomes": np.full(4 * acting.sum(), 2),
            "successors": np.stack([to, np.full_like(to, pit)], axis=2)[acting].ravel(),
            "probabilities": np.tile([0.99, 0.01], 4 * acting.sum()),
            "costs": 1.0,
        }

    def far(cells: np.ndarray) -> np.ndarray:
        return np.where(cells == pit, np.inf, abs(cells % n - 10) + abs(cells // n - 10))

    field = SSP.implicit(0, ends, {goal}, cost_bound=far, vectorised=True)
    solution = solve(MCMP(field, 0, **SURE))
    assert solution.goal_probability == pytest.approx(0.99**20)
    assert solution.objective == pytest.approx(sum(0.99**k for k in range(20)))
    assert solution.problem.model.n_states < 2_000
    assert solution.policy.action(0) in (0, 1)


def test_the_time_limit_ends_the_rounds_with_a_bound() -> None:
    endless = walk(cost_bound=None)
    began = time.perf_counter()
    with pytest.raises(OutOfTimeError, match=r"states explored in .* the optimum is at least"):
        solve(MCMP(endless, 0, failure_budget=0.2), time_limit=1.0)
    assert time.perf_counter() - began < 4.0


@pytest.mark.parametrize("at", ["a successor", "a round"])
def test_ctrl_c_ends_the_rounds(at: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rounds = list[Case]()

    def successors(k: Hashable) -> dict[str, list[Any]]:
        if at == "a successor" and k == -400:
            signal.raise_signal(signal.SIGINT)
        return steps(k)

    def method(case: Case) -> Any:
        rounds.append(case)
        if at == "a round" and len(rounds) == 3:
            signal.raise_signal(signal.SIGINT)
        return approach_to(case)

    monkeypatch.setattr("ssp_lp.solving.approach_to", method)
    model = SSP.implicit(0, successors, {GOAL})
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background
    try:
        with pytest.raises(KeyboardInterrupt, match="states explored"):
            solve(MCMP(model, 0, failure_budget=0.2), time_limit=30.0)
    finally:
        signal.signal(signal.SIGINT, before)


def test_giving_up_is_allowed_where_the_goal_can_surely_be_avoided() -> None:
    assert solve(MCMP(walk(), 0, failure_budget=1.0)).policy.action(0) is GIVE_UP


def test_an_explored_solution_is_pickled() -> None:
    model = SSP.implicit(0, steps, {GOAL}, cost_bound=distance)
    solution = solve(MCMP(model, 0, **SURE))
    again = pickle.loads(pickle.dumps(solution))  # noqa: S301
    assert again.objective == solution.objective


def test_a_dead_end_beyond_which_nothing_arrives_is_charged_by_its_own_actions() -> None:
    """The start leads to states of infinite bound alone: failing uses 3 of fuel, whole or not."""
    road = {0: {"on": [(1.0, 1, {"time": 2.0, "fuel": 3.0})]}, 1: {}}
    model = SSP.implicit(
        0, lambda k: road[k], {9}, cost="time", cost_bound=lambda k: math.inf if k else 0.0
    )
    kept = {"fuel": secondary_cost("fuel") <= 1.0}
    with pytest.raises(InfeasibleError):
        solve(MCMP(model, 0, failure_budget=1.0, give_up="dead_ends", constraints=kept))
    fuel = LeastQuantity(
        model, 0, quantity=secondary_cost("fuel"), failure_budget=1.0, charge_failing_step=True
    )
    assert solve(replace(fuel, give_up="dead_ends")).objective == pytest.approx(3.0)


def test_a_limit_on_a_state_that_is_not_met_is_noted() -> None:
    solution = solve(MCMP(walk(), 0, 0.3, constraints={"pit": visits("pitt") <= 0.1}))
    assert "limits name states or labels that were not found: 'pitt'" in solution.note
