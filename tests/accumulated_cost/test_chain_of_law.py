"""The law of a policy that remembers its cost: from one sweep forwards it is that of its chain."""

from __future__ import annotations

import numpy as np
import pytest

from drawn_policies import CLOSE, drawn_model, drawn_policy
from ssp_lp import SSP, CostAwarePolicy, ModelError
from ssp_lp.accumulated_cost import policy_layers
from ssp_lp.accumulated_cost.cost_law import CostLaw
from ssp_lp.accumulated_cost.policy_layers import chain_of_law
from ssp_lp.analysis.cost_law import law_of_chains
from ssp_lp.policies.chain import policy_chain

ONE = np.ones(1)


def laws(model: SSP, policy: CostAwarePolicy, start: np.ndarray) -> tuple[CostLaw, CostLaw]:
    written = policy_chain(model, policy, start)
    short = chain_of_law(model, policy, start, least_nodes=0)
    return law_of_chains([(short, short)], ONE), law_of_chains([(written, written)], ONE)


@pytest.mark.parametrize("is_compiled", [False, True])
@pytest.mark.parametrize("zero", [[], [0.0]], ids=["paying", "free steps"])
def test_it_is_that_of_the_written_out_chain(
    is_compiled: bool, zero: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policy_layers, "accelerated", lambda entries: is_compiled)
    draw, compared = np.random.default_rng(11), 0
    for _ in range(40):
        model = drawn_model(draw, [0.5, 1.0, 1.5, 3.0, *zero])
        policy = drawn_policy(draw, model, on_levels=False)
        start = np.zeros(model.n_states)
        start[:2] = 0.5
        found, truth = laws(model, policy, start)
        assert found.goal == pytest.approx(truth.goal, rel=CLOSE, abs=CLOSE)
        assert found.cost == pytest.approx(truth.cost, rel=CLOSE, abs=CLOSE)
        if truth.goal < 1e-9:
            continue
        compared += 1
        for bound in (0.0, 0.5, 1.0, 2.0, 3.5, 7.0, 20.0):
            assert found.within(bound) == pytest.approx(truth.within(bound), rel=CLOSE, abs=CLOSE)
            assert found.excess(bound) == pytest.approx(truth.excess(bound), rel=1e-11, abs=CLOSE)
        for level in (0.0, 0.3123, 0.9456):
            assert found.quantile(level) == truth.quantile(level)
            assert found.tail_mean(level) == pytest.approx(truth.tail_mean(level), rel=1e-11)
        assert found.exponential(-0.3) == pytest.approx(truth.exponential(-0.3), rel=1e-11)
    assert compared > 15


def test_a_missing_decision_is_named_by_the_chain() -> None:
    model = SSP.from_transitions(
        {"x": {"go": [(1.0, "y", 1.0)]}, "y": {"go": [(1.0, "g", 1.0)]}}, {"g"}
    )
    decision, tails, start = np.full((2, 3), -2), np.full((1, 3), -2), np.zeros(3)
    live = [model.index_of(name) for name in "xy"]
    decision[0, live] = 0
    tails[0, live] = model.pair_offsets[live]
    start[live[0]] = 1.0
    policy = CostAwarePolicy(model, 1.0, decision, tails, np.full(3, 9.0))
    with pytest.raises(ModelError, match="no decision in state 'y'"):
        chain_of_law(model, policy, start, least_nodes=0)
