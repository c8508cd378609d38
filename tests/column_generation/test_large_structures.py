"""Twelve thousand states and more: the answer's two sides worked out apart from the library.

The policy is measured by scipy on its own chain, and the value function is checked to be a
sub-solution by one plain backup: together they prove the optimum (mathematics, section 5).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from examples.solver_comparison.instances.families import (
    corridor,
    grid,
    layered,
    ring,
    river,
    rooms,
    scattered,
)
from formulations import MCMP, S3P, MaxProb
from ssp_lp import SSP, Solution, certify, solve
from ssp_lp.policies import DeterministicPolicy

GAP = 1e-9
ENDED = 1e-18  # probability of going on at which a process that mixes fast has ended

DRAWS: dict[str, list[Callable[[], SSP]]] = {
    "layered": [
        lambda k=k: layered(*((1_200, 10), (120, 100), (12, 1_000))[k % 3], seed=k)
        for k in range(9)
    ],
    "scattered": [lambda k=k: scattered(12_000, seed=k) for k in range(4)],
    "grid": [lambda k=k: grid(110, wind=(0.0, 0.1, 0.3)[k % 3], seed=k) for k in range(12)],
    "river": [
        lambda k=k: river(*((60, 201), (200, 61))[k % 2], current=0.1 * (1 + k // 2))
        for k in range(6)
    ],
    "corridor": [lambda k=k: corridor(12_000, drift=0.01 * (1 + k)) for k in range(6)],
    "rooms": [lambda k=k: rooms(*((30, 20), (120, 10))[k % 2], seed=k) for k in range(8)],
    "ring": [lambda k=k: ring(12_000, leak=10.0 ** -(3 + k)) for k in range(5)],
}
MODELS = [(family, number) for family, draws in DRAWS.items() for number in range(len(draws))]


@cache
def drawn(family: str, number: int) -> SSP:
    """The model, which all tests of one worker share."""
    return DRAWS[family][number]()


def transitions(model: SSP) -> sp.csr_array:
    parts = model.probabilities, model.successors, model.outcome_offsets
    return sp.csr_array(parts, shape=(model.n_pairs, model.n_states))


def stage_costs(model: SSP) -> np.ndarray:
    return np.add.reduceat(model.probabilities * model.costs, model.outcome_offsets[:-1])


def measured(model: SSP, policy: DeterministicPolicy, *, mixes: bool) -> tuple[float, float]:
    """Expected cost and failure from state 0, from the visits of the policy's chain."""
    n = model.n_states - 2
    acting = np.flatnonzero(policy.decision[:n] >= 0)
    taken = transitions(model)[policy.decision[acting]]
    chain = sp.csc_array(
        sp.csr_array((taken.data, taken.indices, taken.indptr))[:, acting].T
        if taken.shape[1] == model.n_states
        else taken
    )
    begin = (acting == 0).astype(float)
    if mixes:
        visits, going = np.zeros(acting.size), begin
        while going.sum() > ENDED:
            visits, going = visits + going, chain @ going
    else:
        visits = splu(sp.csc_array(sp.eye_array(acting.size) - chain)).solve(begin)
    goal = float(visits @ taken[:, [n]].toarray().ravel())
    return float(visits @ stage_costs(model)[policy.decision[acting]]), 1.0 - goal


def least_advantage(model: SSP, solution: Solution) -> float:
    """The least of ``c + price * failing + P v - v`` over all pairs; v is 0 at both ends."""
    values, n = np.append(solution.value_function, [0.0, 0.0]), model.n_states - 2
    trapped = np.zeros(n + 2)
    trapped[n + 1] = solution.failure_price
    ahead = stage_costs(model) + transitions(model) @ (values + trapped)
    return float((ahead - values[model.pair_state]).min() / max(1.0, np.abs(values).max()))


@cache
def least_failure(family: str, number: int) -> float:
    return 1.0 - solve(MaxProb(drawn(family, number), 0)).objective


@pytest.mark.parametrize("share", [0.02, 0.5])
@pytest.mark.parametrize(("family", "number"), MODELS)
def test_both_sides_of_the_optimum(family: str, number: int, share: float) -> None:
    model = drawn(family, number)
    least = least_failure(family, number)
    budget = least + share * (1.0 - least) * 0.1
    solution = solve(MCMP(model, 0, budget, give_up="dead_ends"))
    assert solution.gap <= GAP
    cost = failure = 0.0
    for weight, member in zip(solution.policy.weights, solution.policy.policies, strict=True):
        its_cost, its_failure = measured(model, member, mixes=family == "scattered")
        cost, failure = cost + weight * its_cost, failure + weight * its_failure
    assert solution.objective == pytest.approx(cost, rel=1e-8)
    assert solution.failure_probability == pytest.approx(failure, abs=1e-8)
    assert failure <= budget + 1e-8
    assert least_advantage(model, solution) >= -1e-12
    bound = solution.value_function[0] - solution.failure_price * budget
    assert bound == pytest.approx(solution.objective, rel=1e-8)


@pytest.mark.parametrize(("family", "number"), MODELS)
def test_at_least_failure_all_agree(family: str, number: int) -> None:
    """MaxProb, MCMP and S3P of the same model: one probability, certified three times."""
    model = drawn(family, number)
    cheapest = solve(MCMP(model, 0))
    assert cheapest.gap <= GAP
    assert cheapest.goal_probability == pytest.approx(1.0 - least_failure(family, number), rel=1e-9)
    proof = certify(cheapest)
    assert proof.accepted, proof.reason
    assert proof.lower_bound <= cheapest.objective
    given_success = solve(S3P(model, 0))
    assert given_success.goal_probability == pytest.approx(cheapest.goal_probability, rel=1e-9)
    assert certify(given_success).accepted


@pytest.mark.parametrize(("family", "number"), MODELS[::3])
def test_a_budget_between_two_has_a_cost_between(family: str, number: int) -> None:
    """The least cost is convex in the budget, and the price of failure its slope."""
    model, least = drawn(family, number), least_failure(family, number)
    budgets = least + (1.0 - least) * np.array([0.01, 0.02, 0.03])
    low, middle, high = (solve(MCMP(model, 0, budget, give_up="anywhere")) for budget in budgets)
    assert low.objective * (1 + GAP) >= middle.objective >= high.objective * (1 - GAP)
    assert 2 * middle.objective <= (low.objective + high.objective) * (1 + GAP)
    step = budgets[1] - budgets[0]
    room = GAP * low.objective
    assert low.objective - middle.objective >= middle.failure_price * step - room
    assert middle.objective - high.objective <= middle.failure_price * step + room
