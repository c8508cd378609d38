"""The law of success costs in use: simulated totals, what problems measure, and who refuses."""

from dataclasses import dataclass, replace
from math import isnan, log, sqrt

import numpy as np
import pytest

from formulations import S3P
from ssp_lp import (
    SSP,
    DeterministicPolicy,
    ModelError,
    SolverError,
    cross_check,
    evaluate,
    simulate,
    solve,
    success_costs,
    trace_frontier,
)
from ssp_lp.accumulated_cost.charges import (
    CostQuantileOf,
    ExpectedUtility,
    ExponentialUtility,
    Measure,
    TailMeanOf,
    WithinBound,
)
from ssp_lp.policies.chain import policy_chain
from ssp_lp.processes.failure_semantics import FailureSemantics

WALK = {
    "a": {"slow": [(0.5, "b", 1), (0.5, "a", 1)],
          "fast": [(0.6, "G", 2), (0.3, "b", 1), (0.1, "pit", 1)], "wait": [(1.0, "a", 1)]},
    "b": {"on": [(0.9, "G", 1), (0.1, "a", 2)], "jump": [(0.7, "G", 0), (0.3, "pit", 0)]},
    "pit": {"stuck": [(1.0, "pit", 3)]},
}  # fmt: skip


def test_simulated_totals_follow_the_law():
    """Within Dvoretzky, Kiefer and Wolfowitz's band, which holds with probability 1 - 1e-6."""
    model = SSP.from_transitions(WALK, goal={"G"})
    problem = S3P(model, start={"a": 0.75, "b": 0.25}, failure_budget=0.15)
    policy = solve(problem).policy
    law = success_costs(policy, problem)
    report = simulate(policy, problem, episodes=40_000, rng=np.random.default_rng(3))
    sample = report.success_costs
    assert sample.size == report.ends["goal"]
    width = sqrt(log(2 / 1e-6) / (2 * sample.size))
    for bound in range(12):
        share = float((sample <= bound).mean())
        assert abs(law.within(bound) / law.goal - share) <= width
    for level in (0.25, 0.5, 0.9, 0.95):
        seen = float(np.quantile(sample, level, method="inverted_cdf"))
        assert law.quantile(level - width) <= seen <= law.quantile(level + width)
    spread = 4 * sample.std() / sqrt(sample.size)
    assert sample.mean() == pytest.approx(law.conditional_mean, abs=spread)


# Measures in evaluate, and methods that know none


BY_THREE = WithinBound(3)


@dataclass(frozen=True)
class Measured(S3P):
    """S3P's model and start, with another number to count."""

    counted: Measure = BY_THREE

    @property
    def semantics(self) -> FailureSemantics:
        return replace(super().semantics, measure=self.counted)


def bonus(counted, law):
    return ExpectedUtility(lambda c: 1 / (1 + c), counted, 0.0).of(law)


@pytest.mark.parametrize(
    ("measure", "value"),
    [
        (WithinBound(3), lambda law: law.within(3)),
        (CostQuantileOf(0.9), lambda law: law.quantile(0.9)),
        (TailMeanOf(0.9), lambda law: law.tail_mean(0.9)),
        (ExponentialUtility(-0.5, 2.0), lambda law: law.exponential(-0.5) + 2.0 * law.goal),
        (ExpectedUtility(lambda c: 1 / (1 + c), 2.0, 0.0), lambda law: bonus(2.0, law)),
    ],
    ids=lambda p: type(p).__name__,
)
def test_evaluate_counts_what_the_problem_measures(measure, value):
    model = SSP.from_transitions(WALK, goal={"G"})
    plain_problem = S3P(model, start="a", failure_budget=0.2)
    policy = solve(plain_problem).policy
    problem = Measured(model, start="a", failure_budget=0.2, counted=measure)
    found, same = evaluate(policy, problem), evaluate(policy, plain_problem)
    assert found.objective == value(success_costs(policy, problem))
    assert replace(found, objective=same.objective) == same


def test_a_measure_of_a_goal_that_is_never_reached():
    model = SSP.from_transitions(WALK, goal={"G"})
    policy = DeterministicPolicy.from_actions(model, {"a": "wait"})
    for measure in (CostQuantileOf(0.9), TailMeanOf(0.9)):
        assert isnan(evaluate(policy, Measured(model, start="a", counted=measure)).objective)


def test_the_game_and_the_frontier_refuse_measures():
    model = SSP.from_transitions(WALK, goal={"G"})
    problem = Measured(model, start="a", failure_budget=0.2, discount=0.99)
    assert not problem.semantics.counts_cost_alone
    for ask in (trace_frontier, cross_check, lambda p: solve(p, method="game")):
        with pytest.raises(ModelError, match="Measured"):
            ask(problem)


def test_a_chain_that_holds_mass_is_no_obstacle():
    """Pushing mass through a recurrent class fails; following the live part does not."""
    model = SSP.from_transitions(WALK, goal={"G"})
    policy = DeterministicPolicy.from_actions(model, {"a": "wait"})
    with pytest.raises(SolverError):
        policy_chain(model, policy, np.eye(4)[0]).push(np.ones(1))
    assert success_costs(policy, S3P(model, start="a")).goal == 0.0
