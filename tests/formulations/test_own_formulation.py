"""A user's own criterion: a few lines, and everything else inherited."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from formulations import (
    EGUBS,
    GUBS,
    ISSPUDE,
    MCMP,
    S3P,
    AlphaMCMP,
    ConstrainedCost,
    CostBoundedReach,
    CostBudgetedMaxProb,
    CostLimit,
    CostQuantile,
    CVaR,
    FinitePenalty,
    LeastQuantity,
    MaxProb,
    MinCost,
    MinProb,
)
from ssp_lp import SSP, ModelError, certify, evaluate, secondary_cost, solve, trace_frontier, visits
from ssp_lp.formulation import ExponentialUtility, FailureSemantics, Formulation, GiveUp, Start


@dataclass(frozen=True, eq=False)
class CautiousUtility(Formulation):
    """Greatest expected exponential utility of the total cost, within a failure budget."""

    model: SSP
    start: Start
    failure_budget: float = 0.05

    @property
    def semantics(self) -> FailureSemantics:
        return FailureSemantics(measure=ExponentialUtility(rate=-0.1, bonus=1.0))


@dataclass(frozen=True, eq=False)
class PenaltyWithinBudget(Formulation):
    """Least cost plus a penalty for failing, which is limited besides."""

    model: SSP
    start: Start
    failure_budget: float = 0.05

    @property
    def semantics(self) -> FailureSemantics:
        return FailureSemantics(GiveUp.ANYWHERE, penalty=3.0)


DEPOT = SSP.from_transitions(
    {
        "depot": {
            "alley": [(0.9, "home", 4.0), (0.1, "wreck", 2.0)],
            "road": [(0.99, "home", 9.0), (0.01, "wreck", 5.0)],
        },
        "wreck": {},
    },
    goal={"home"},
    treat_actionless_as_dead_ends=True,
)

# The budget makes the alley 4/9 likely: 0.1 a + 0.01 (1 - a) = 0.05.
ALLEY = 4.0 / 9.0


def test_a_utility_within_a_budget() -> None:
    arriving = {"alley": 0.9 * (np.exp(-0.4) + 1.0), "road": 0.99 * (np.exp(-0.9) + 1.0)}
    best = max(
        a * arriving["alley"] + (1.0 - a) * arriving["road"] for a in (0.0, ALLEY)
    )  # linear in a, and a <= 4/9
    solution = solve(CautiousUtility(DEPOT, "depot"))
    assert solution.objective == pytest.approx(best, rel=1e-12)
    free = solve(replace(CautiousUtility(DEPOT, "depot"), failure_budget=1.0))
    assert free.objective == pytest.approx(solve(EGUBS(DEPOT, "depot", -0.1, 1.0)).objective)


def test_a_penalty_within_a_budget() -> None:
    solution = solve(PenaltyWithinBudget(DEPOT, "depot"))
    cost = ALLEY * 3.8 + (1.0 - ALLEY) * 8.96
    assert solution.objective == pytest.approx(cost + 3.0 * 0.05, rel=1e-12)


@pytest.mark.parametrize("criterion", [CautiousUtility, PenaltyWithinBudget])
def test_everything_else_is_inherited(criterion) -> None:
    problem = criterion(DEPOT, "depot")
    solution = solve(problem)
    certificate = certify(solution)
    assert certificate.accepted
    assert certificate.gap < 1e-9
    assert solve(problem, "lp").objective == pytest.approx(solution.objective, rel=1e-9)
    measure = problem.program().solve()
    assert measure.objective == pytest.approx(solution.objective, rel=1e-9)
    assert measure.optimal_value_from_dual == pytest.approx(solution.objective, rel=1e-9)
    for policy in (solution.policy, measure.mixed_policy(), measure.randomised_policy()):
        assert evaluate(policy, problem).objective == pytest.approx(solution.objective, rel=1e-9)


def test_the_start_is_checked_for_everyone() -> None:
    with pytest.raises(ModelError, match="nowhere"):
        CautiousUtility(DEPOT, "nowhere")


def test_a_frontier_of_ones_own_criterion() -> None:
    frontier = trace_frontier(PenaltyWithinBudget(DEPOT, "depot"))
    known = solve(PenaltyWithinBudget(DEPOT, "depot", failure_budget=0.03)).objective
    assert frontier.objective_at(0.03) == pytest.approx(known, rel=1e-9)


def test_replace_works_on_every_formulation() -> None:
    """A copy asks what it says, and a budget that a share made follows the share."""
    fuel = {"fuel": secondary_cost({"depot": {"alley": 2.0}}) <= 1.0}
    stated = [
        *(formulation(DEPOT, "depot") for formulation in (MCMP, S3P, MaxProb, MinProb, ISSPUDE)),
        *(formulation(DEPOT, "depot") for formulation in (MinCost, ConstrainedCost)),
        AlphaMCMP(DEPOT, "depot", 0.95),
        LeastQuantity(DEPOT, "depot", visits("wreck")),
        CostBudgetedMaxProb(DEPOT, "depot", 5.0),
        CVaR(DEPOT, "depot", 0.5),
        CostQuantile(DEPOT, "depot", 0.5),
        CostBoundedReach(DEPOT, "depot", 5),
        FinitePenalty(DEPOT, "depot", 3.0),
        EGUBS(DEPOT, "depot", -0.1, 1.0),
        GUBS(DEPOT, "depot", lambda cost: np.maximum(1.0 - cost, 0.0), 1.0),
    ]
    for problem in stated:
        copied = replace(problem, constraints=fuel)
        assert set(copied.constraints) == {"fuel"}
        assert copied.failure_budget == problem.failure_budget
    limited = ConstrainedCost(DEPOT, "depot", {"fuel": CostLimit({"depot": {"alley": 2.0}}, 1.0)})
    with pytest.raises(ModelError, match="names a limit of ConstrainedCost"):
        replace(limited, constraints=fuel)
    shared = MCMP(DEPOT, "depot", reach_fraction=0.96)
    assert shared.failure_budget == pytest.approx(1.0 - 0.96 * 0.99)
    assert replace(shared, reach_fraction=0.95).failure_budget == pytest.approx(1.0 - 0.95 * 0.99)
    assert replace(shared, reach_fraction=None, failure_budget=0.2).failure_budget == 0.2
