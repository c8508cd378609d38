"""Costs without a common unit, and risks that are tiny."""

from __future__ import annotations

from dataclasses import replace
from math import exp

import numpy as np
import pytest

from formulations import EGUBS, GUBS, CostBoundedReach, CostQuantile, CVaR
from small_models import model_of
from ssp_lp import SSP, ModelError, certify, evaluate, solve
from ssp_lp.io import Controller, load_policy, save_policy, write_controller
from ssp_lp.policies import CostAwarePolicy

# Costs without a common unit: totals told apart one by one, or rounded to levels.


ROOT = 2.0**0.5


def test_a_controller_keeps_irrational_totals(tmp_path) -> None:
    """Two hops, straight or across: the second depends on what the first has cost."""
    hops = {
        "straight": [(1.0, "mid", 2.0)],
        "across": [(0.5, "mid", ROOT), (0.5, "mid", 2.0 * ROOT)],
    }
    last = {"sure": [(1.0, "home", ROOT)], "bold": [(0.6, "home", 1.0), (0.4, "sea", 1.0)]}
    model = model_of({"quay": hops, "mid": last, "sea": {}, "home": {}}, "home")
    problem = CostBoundedReach(model, "quay", 1.0 + 2.0 * ROOT)  # in time after any first hop
    solution = solve(problem)
    assert solution.objective == pytest.approx(1.0)  # straight, sure
    problem = CostBoundedReach(model, "quay", 2.0 * ROOT)
    solution = solve(problem)  # across: sure if it was cheap; else neither is in time
    assert solution.objective == pytest.approx(0.5)
    save_policy(solution.policy, tmp_path / "policy.zip")
    loaded = load_policy(tmp_path / "policy.zip", model)
    assert evaluate(loaded, problem).objective == solution.objective
    write_controller(solution.policy, tmp_path / "controller.json")
    controller = Controller(tmp_path / "controller.json")
    controller.reset(0)
    assert controller.action("quay") == "across"
    controller.observe("mid", ROOT * (1.0 + 1e-12))  # an observed cost near a level
    assert controller.action("mid") == "sure"
    assert all(isinstance(p, CostAwarePolicy) for p in solution.policy.policies)


def a_corridor(seed: int) -> SSP:
    """Eight rooms in a row, each left on foot or by a lift that may fall, costs from the reals."""
    rng = np.random.default_rng(seed)
    rooms: dict[str, dict[str, list]] = {}
    for room in range(8):
        after, back = f"r{room + 1}", f"r{max(room - 1, 0)}"
        slow, fast, again = rng.uniform(0.5, 2.0, 3).tolist()
        rooms[f"r{room}"] = {
            "walk": [(0.8, after, slow), (0.2, back, again)],
            "lift": [(0.93, after, fast / 3.0), (0.07, "shaft", fast / 3.0)],
        }
    return model_of({**rooms, "shaft": {}}, "r8")


@pytest.mark.slow
@pytest.mark.parametrize(
    "problem",
    [
        CostBoundedReach(a_corridor(0), "r0", 9.0, 0.3),
        GUBS(a_corridor(1), "r0", lambda c: 1.0 / (1.0 + 3.0 * np.asarray(c, float) / 20.0), 0.3),
        CVaR(a_corridor(2), "r0", 0.8, 0.3),
        CostQuantile(a_corridor(3), "r0", 0.8, 0.3),
    ],
    ids=lambda problem: type(problem).__name__,
)
def test_more_levels_of_rounded_costs_leave_less_gap(problem) -> None:
    coarse = solve(replace(problem, cost_levels=64))
    fine = solve(replace(problem, cost_levels=1024))
    assert 2.0 * fine.gap < coarse.gap
    bounds = [
        (s.lower_bound, s.objective) if s.upper_bound is None else (s.objective, s.upper_bound)
        for s in (coarse, fine)
    ]
    assert bounds[0][0] <= bounds[1][0] * (1.0 + 1e-9)
    assert bounds[1][1] <= bounds[0][1] * (1.0 + 1e-9)
    for solution in (coarse, fine):
        told = evaluate(solution.policy, problem)
        assert told.objective == pytest.approx(solution.objective, rel=1e-5)
        assert told.failure_probability <= problem.failure_budget + 1e-9
        certificate = certify(solution)
        assert certificate.accepted
        assert certificate.gap < 2.0 * solution.gap + 1e-4


def test_a_controller_rounds_costs_up_as_its_policy_does(tmp_path) -> None:
    model = a_corridor(4)
    solution = solve(CostBoundedReach(model, "r0", 9.0, 0.3, cost_levels=64))
    policy = next(p for p in solution.policy.policies if isinstance(p, CostAwarePolicy))
    save_policy(policy, tmp_path / "policy.zip")
    loaded = load_policy(tmp_path / "policy.zip", model)
    assert loaded.rounds_up
    write_controller(policy, tmp_path / "controller.json")
    controller = Controller(tmp_path / "controller.json")
    controller.reset(0)
    memory, state = policy.start_memory(np.array([0])), 0
    for after in ("r1", "r2", "r1", "r2", "r3"):
        assert controller.action(model.states[state]) == model.action_of(
            int(loaded.branches(np.array([state]), memory).pair[0])
        )
        controller.observe(after, 0.71)
        there = np.array([model.index_of(after)])
        memory = loaded.remember(memory, np.array([0]), there, np.array([0.71]))
        state = int(there[0])
    assert memory[0] == min(5 * int(np.ceil(0.71 / policy.unit)), policy.cap)


def test_what_is_refused() -> None:
    model = SSP.from_transitions({"a": {"go": [(1.0, "b", ROOT)]}, "b": {}}, goal={"b"})
    with pytest.raises(ModelError, match="cost_levels"):
        CVaR(model, "a", 0.5, cost_levels=0)


# EGUBS where an action risks next to nothing: the optimum by layers, in closed form and drawn.


RATE, BONUS = -0.02, 1.0


@pytest.mark.parametrize("risk", [1e-300, 1e-30, 1e-20, 1e-17, 1e-15, 1e-13, 1e-10])
def test_a_risk_that_no_probability_shows_does_not_slow_down(risk):
    """Fast is worth (1 - risk)(exp(rate) + bonus), slow exp(2 rate) + bonus: fast at the start."""
    model = SSP.from_transitions(
        {
            "a": {"fast": [(1.0 - risk, "g", 1.0), (risk, "pit", 1.0)], "slow": [(1.0, "g", 2.0)]},
            "pit": {},
        },
        goal={"g"},
        treat_actionless_as_dead_ends=True,
    )
    solution = solve(EGUBS(model, "a", RATE, BONUS))
    assert solution.objective == pytest.approx((1.0 - risk) * (exp(RATE) + BONUS), rel=1e-15)
    assert solution.gap <= 1e-14
    assert certify(solution).accepted


def test_a_chain_of_tiny_risks():
    """Each of 60 rooms has a fast way that risks 1e-18 and a slow one that risks nothing."""
    rooms = {
        k: {
            "fast": [(1.0, k + 1, 1.0), (1e-18, "pit", 1.0)],
            "slow": [(0.5, k + 1, 1.0), (0.5, k, 1.0)],
        }
        for k in range(60)
    }
    model = SSP.from_transitions(
        {**rooms, "pit": {}}, goal={60}, treat_actionless_as_dead_ends=True
    )
    solution = solve(EGUBS(model, 0, RATE, BONUS))
    assert solution.objective == pytest.approx(exp(60 * RATE) + BONUS, rel=1e-13)
    assert solution.gap <= 1e-12


def drawn(rng):
    """Up to five states; most actions risk 1e-30 to 1e-10, costs are 1 to 3."""
    n, table = int(rng.integers(2, 6)), {}
    for state in range(n):
        table[state] = {}
        for action in range(int(rng.integers(1, 4))):
            risk = float(rng.choice([0.0, 0.2, *(10.0 ** rng.uniform(-30, -10, 4))]))
            shares = rng.dirichlet(np.ones(int(rng.integers(1, 3)))) * (1.0 - risk)
            cost = int(rng.integers(1, 4))
            low = state if rng.random() < 0.8 else 0
            aims = [int(k) for k in rng.integers(low, n + 1, shares.size)]
            moves = [
                (float(p), "g" if t == n else t, cost) for p, t in zip(shares, aims, strict=True)
            ]
            table[state][action] = [*moves, *([(risk, "pit", cost)] if risk else [])]
    return {**table, "pit": {}}


def by_layers(table, rate, bonus):
    """The optimum from state 0, backwards from a cost at which no utility is left."""
    n = len(table) - 1
    pairs = [(state, moves) for state in range(n) for moves in table[state].values()]
    first = np.searchsorted([state for state, _ in pairs], np.arange(n))
    cost = np.array([moves[0][2] for _, moves in pairs])
    gain, steps = np.zeros(len(pairs)), np.zeros((len(pairs), n))
    for k, (_, moves) in enumerate(pairs):
        for p, target, _ in moves:
            if target == "g":
                gain[k] += p
            elif target != "pit":
                steps[k, target] += p
    goal = np.zeros(n)
    for _ in range(20_000):
        before, goal = goal, np.maximum.reduceat(gain + steps @ goal, first)
        if np.abs(goal - before).max() < 1e-17:
            break
    ahead = np.array([bonus * goal] * 3)  # 1, 2 and 3 units of cost ahead
    for paid in range(int(45.0 / -rate), -1, -1):
        arriving = gain * (np.exp(rate * (paid + cost)) + bonus)
        here = np.maximum.reduceat(arriving + (steps * ahead[cost - 1]).sum(axis=1), first)
        ahead = np.vstack([here, ahead[:-1]])
    return ahead[0][0]


@pytest.mark.parametrize("seed", range(60))
def test_drawn_models(seed):
    rng = np.random.default_rng(seed)
    table = drawn(rng)
    rate, bonus = -float(10.0 ** rng.uniform(-1.0, 0.3)), float(10.0 ** rng.uniform(-2, 2))
    model = SSP.from_transitions(table, goal={"g"}, treat_actionless_as_dead_ends=True)
    solution = solve(EGUBS(model, 0, rate, bonus))
    assert solution.objective == pytest.approx(by_layers(table, rate, bonus), rel=1e-11)
    assert solution.objective <= solution.upper_bound
    assert solution.gap <= 1e-9
