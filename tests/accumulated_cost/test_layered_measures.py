"""Policies that remember their cost: layer by layer they attain what their chain says."""

from __future__ import annotations

from dataclasses import fields
from functools import partial

import numpy as np
import pytest

from drawn_policies import CLOSE, drawn_model, drawn_policy
from formulations import MCMP, S3P, MinCost
from small_models import model_of
from ssp_lp import SSP, CostAwarePolicy, ModelError, certify, evaluate, solve
from ssp_lp.accumulated_cost import policy_layers
from ssp_lp.analysis import evaluation
from ssp_lp.analysis.evaluation import layered_measures
from ssp_lp.policies.chain import policy_chain
from ssp_lp.policies.policy import UNDECIDED
from ssp_lp.processes.failure_semantics import start_distribution

GIVE_UPS = ["attention", "anywhere", "dead_ends"]


@pytest.mark.parametrize("is_compiled", [False, True])
@pytest.mark.parametrize("zero", [[], [0.0]], ids=["paying", "free steps"])
@pytest.mark.parametrize("discount", [None, 0.9])
def test_layers_attain_what_the_written_out_chain_does(
    is_compiled: bool, zero: list[float], discount: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policy_layers, "accelerated", lambda entries: is_compiled)
    draw, compared = np.random.default_rng(7), 0
    for turn in range(18):
        model = drawn_model(draw, [0.5, 1.0, 1.5, 3.0, *zero])
        policy = drawn_policy(draw, model, on_levels=turn % 3 == 2)
        problems = [S3P(model, {0: 0.5, 1: 0.5}, failure_budget=0.5, discount=discount)] + [
            MCMP(model, 0, 0.5, discount, give_up=give_up, charge_failing_step=turn % 2 == 0)
            for give_up in GIVE_UPS
        ]
        for problem in problems:
            start = start_distribution(model, problem.start)
            found = layered_measures(policy, problem, start, 0)
            try:
                truth = evaluation._evaluated_measures(policy_chain(model, policy, start), problem)
            except ModelError:  # gives up where it may not: the chain names the state
                assert found is None
                continue
            assert found is not None
            compared += 1
            for name in (field.name for field in fields(truth)):
                here, there = getattr(found, name), getattr(truth, name)
                if there is None:  # nothing is paid after failing
                    assert here is None, name
                    continue
                assert here == pytest.approx(there, rel=CLOSE, abs=CLOSE), name
    assert compared > 30


def test_failing_where_that_is_forbidden_costs_without_end() -> None:
    ways = {
        "go": [(0.5, "g", 1.0), (0.5, "x", 1.0)],
        "dare": [(0.9, "g", 1.0), (0.1, "d", 1.0)],
    }
    steps = {"x": ways, "d": {}}
    model = model_of(steps)
    problem = MinCost(model, "x")
    start, tails = start_distribution(model, "x"), np.full((1, 3), UNDECIDED)
    tails[0, model.index_of("x")] = 0
    for dares in (0, 1):
        decision = np.full((2, 3), UNDECIDED)
        decision[:, model.index_of("x")] = [0, dares]
        policy = CostAwarePolicy(model, 1.0, decision, tails, np.full(3, 9.0))
        found = layered_measures(policy, problem, start, 0)
        truth = evaluation._evaluated_measures(policy_chain(model, policy, start), problem)
        assert found is not None
        assert found.expected_cost == pytest.approx(truth.expected_cost)
        assert np.isinf(found.expected_cost) == (dares == 1)


def test_a_lottery_is_evaluated_the_same_either_way(
    coarse_robot: tuple[SSP, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    solution = solve(S3P(*coarse_robot, failure_budget=0.3))
    assert len(solution.policy.policies) == 2
    written_out = evaluate(solution.policy, solution.problem)
    monkeypatch.setattr(evaluation, "layered_measures", partial(layered_measures, least_nodes=0))
    streamed = evaluate(solution.policy, solution.problem)
    assert streamed.objective == pytest.approx(written_out.objective, rel=CLOSE)
    assert dict(streamed.ends) == pytest.approx(dict(written_out.ends), rel=CLOSE, abs=CLOSE)
    assert certify(solution).accepted
