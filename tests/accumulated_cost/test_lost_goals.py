"""Policies that remember their cost stop where they have lost the goal: same numbers, no waste."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from formulations import S3P, CostQuantile, CVaR
from small_models import model_of
from ssp_lp import SSP, certify, evaluate, solve
from ssp_lp.policies.chain import policy_chain, reaching_in_chain
from ssp_lp.processes.failure_semantics import start_distribution


def drawn_rooms(seed: int, cheapest: int = 1) -> SSP:
    """Six rooms with costly ways on, back and out; from most the goal can be avoided for ever."""
    draw = np.random.default_rng(seed)
    names = [f"r{k}" for k in range(6)]
    choices: dict[str, dict[str, list]] = {"pit": {}, "g": {}}
    for k, name in enumerate(names):
        after, back = [*names, "g"][k + 1], names[max(k - 1, 0)]
        cost = draw.integers(cheapest, 5, size=3).tolist()
        share = round(float(draw.uniform(0.1, 0.5)), 2)
        choices[name] = {
            "on": [(1.0 - share, after, cost[0]), (share, back, cost[1])],
            "leap": [(0.8, after, 1), (0.2, draw.choice(["pit", back]), cost[2])],
            "round": [(1.0, back, cost[2])],
        }
    return model_of(choices, "g")


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("cheapest", [0, 1])
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("criterion", ["S3P", "CVaR", "CostQuantile"])
def test_nothing_is_paid_once_the_goal_is_lost(
    criterion: str, seed: int, cheapest: int, compiled: bool, accelerate: Callable[[bool], None]
) -> None:
    if compiled:
        pytest.importorskip("numba")
    accelerate(compiled)
    model = drawn_rooms(seed, cheapest)
    problem = {
        "S3P": lambda: S3P(model, "r0", failure_budget=0.75),
        "CVaR": lambda: CVaR(model, "r0", 0.7, 0.75),
        "CostQuantile": lambda: CostQuantile(model, "r0", 0.7, 0.75),
    }[criterion]()
    solution = solve(problem)
    start = start_distribution(model, "r0")
    for member in solution.policy.policies:
        chain = policy_chain(model, member, start)
        lost = ~reaching_in_chain(chain, chain.goal > 0)
        assert not chain.per_node(chain.cost)[lost].any()
    found = evaluate(solution.policy, problem)
    assert found.objective == pytest.approx(solution.objective, rel=1e-9)
    assert found.failure_probability <= 0.75 + 1e-9
    assert certify(solution).accepted
