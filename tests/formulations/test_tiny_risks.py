"""EGUBS where an action risks next to nothing: the optimum by layers, in closed form and drawn."""

from math import exp

import numpy as np
import pytest

from formulations import EGUBS
from ssp_lp import SSP, certify, solve

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
