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
from own_criteria import Lateness
from small_models import FIRST
from ssp_lp import (
    SSP,
    ModelError,
    arrival_cost,
    certify,
    evaluate,
    secondary_cost,
    solve,
    trace_frontier,
    visits,
)
from ssp_lp.formulation import (
    ExponentialUtility,
    FailureSemantics,
    Formulation,
    GiveUp,
    Quantity,
    Start,
)


@dataclass(frozen=True, eq=False)
class CautiousUtility(Formulation):
    """Greatest expected exponential utility of the total cost, within a failure budget."""

    model: SSP
    start: Start
    failure_budget: float = 0.05

    measure = ExponentialUtility(rate=-0.1, bonus=1.0)


@dataclass(frozen=True, eq=False)
class PenaltyWithinBudget(Formulation):
    """Least cost plus a penalty for failing, which is limited besides."""

    model: SSP
    start: Start
    failure_budget: float = 0.05

    @property
    def semantics(self) -> FailureSemantics:
        return FailureSemantics(GiveUp.ANYWHERE, penalty=3.0)


# The budget makes the alley 4/9 likely: 0.1 a + 0.01 (1 - a) = 0.05.
ALLEY = 4.0 / 9.0


def test_a_utility_within_a_budget() -> None:
    arriving = {"alley": 0.9 * (np.exp(-0.4) + 1.0), "road": 0.99 * (np.exp(-0.9) + 1.0)}
    best = max(
        a * arriving["alley"] + (1.0 - a) * arriving["road"] for a in (0.0, ALLEY)
    )  # linear in a, and a <= 4/9
    solution = solve(CautiousUtility(FIRST, "depot"))
    assert solution.objective == pytest.approx(best, rel=1e-12)
    free = solve(replace(CautiousUtility(FIRST, "depot"), failure_budget=1.0))
    assert free.objective == pytest.approx(solve(EGUBS(FIRST, "depot", -0.1, 1.0)).objective)


def test_a_penalty_within_a_budget() -> None:
    solution = solve(PenaltyWithinBudget(FIRST, "depot"))
    cost = ALLEY * 3.8 + (1.0 - ALLEY) * 8.96
    assert solution.objective == pytest.approx(cost + 3.0 * 0.05, rel=1e-12)
    price = (8.96 - 3.8) / 0.09
    assert solution.failure_price == pytest.approx(price, rel=1e-9)
    assert solution.budget_slope == pytest.approx(price - 3.0, rel=1e-9)


@pytest.mark.parametrize("criterion", [CautiousUtility, PenaltyWithinBudget])
def test_everything_else_is_inherited(criterion) -> None:
    problem = criterion(FIRST, "depot")
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


def test_a_frontier_of_ones_own_criterion_and_a_wrong_start() -> None:
    frontier = trace_frontier(PenaltyWithinBudget(FIRST, "depot"))
    known = solve(PenaltyWithinBudget(FIRST, "depot", failure_budget=0.03)).objective
    assert frontier.objective_at(0.03) == pytest.approx(known, rel=1e-9)
    slopes = [(8.96 - 3.8) / 0.09 - 3.0, (3.8 + 0.3 - 3.0) / 0.9]  # to the alley, to giving up
    assert frontier.price == pytest.approx(slopes, rel=1e-9)
    with pytest.raises(ModelError, match="nowhere"):
        CautiousUtility(FIRST, "nowhere")


def test_replace_works_on_every_formulation() -> None:
    """A copy asks what it says, and a budget that a share made follows the share."""
    fuel = {"fuel": secondary_cost({"depot": {"alley": 2.0}}) <= 1.0}
    stated = [
        *(formulation(FIRST, "depot") for formulation in (MCMP, S3P, MaxProb, MinProb, ISSPUDE)),
        *(formulation(FIRST, "depot") for formulation in (MinCost, ConstrainedCost)),
        AlphaMCMP(FIRST, "depot", 0.95),
        LeastQuantity(FIRST, "depot", visits("wreck")),
        CostBudgetedMaxProb(FIRST, "depot", 5.0),
        CVaR(FIRST, "depot", 0.5),
        CostQuantile(FIRST, "depot", 0.5),
        CostBoundedReach(FIRST, "depot", 5),
        FinitePenalty(FIRST, "depot", 3.0),
        EGUBS(FIRST, "depot", -0.1, 1.0),
        GUBS(FIRST, "depot", lambda cost: np.maximum(1.0 - cost, 0.0), 1.0),
    ]
    for problem in stated:
        copied = replace(problem, constraints=fuel)
        assert set(copied.constraints) == {"fuel"}
        assert copied.failure_budget == problem.failure_budget
    limited = ConstrainedCost(FIRST, "depot", {"fuel": CostLimit({"depot": {"alley": 2.0}}, 1.0)})
    with pytest.raises(ModelError, match="names a limit of ConstrainedCost"):
        replace(limited, constraints=fuel)
    shared = MCMP(FIRST, "depot", reach_fraction=0.96)
    assert shared.failure_budget == pytest.approx(1.0 - 0.96 * 0.99)
    assert replace(shared, reach_fraction=0.95).failure_budget == pytest.approx(1.0 - 0.95 * 0.99)
    assert replace(shared, reach_fraction=None, failure_budget=0.2).failure_budget == 0.2


def waiting(first: float) -> SSP:
    """Try for a unit of time until it succeeds, 1 in 10 being lost; or pay at once."""
    return SSP.from_transitions(
        {
            "gate": {
                "try": [(0.5, "in", first), (0.4, "gate", first), (0.1, "out", first)],
                "pay": [(1.0, "in", 4.0 * first)],
            },
            "out": {},
        },
        goal={"in"},
        treat_actionless_as_dead_ends=True,
    )


@pytest.mark.parametrize("first", [1.0, 2.0**0.5])
def test_the_mean_lateness_given_success(first: float) -> None:
    """Of trying, sum_k 0.5 0.4^(k - 1) max(k - 2, 0) / (5/6) = 4/15; of paying 2, at budget 0."""
    model = waiting(first)
    for budget, best in ((None, 2.0), (1.0, 4.0 / 15.0), (0.2, 4.0 / 15.0)):
        problem = Lateness(model, "gate", 2.0 * first, budget)
        solution = solve(problem)
        assert solution.objective == pytest.approx(best * first, rel=1e-9)
        assert certify(solution).gap < 1e-9
    # an extreme point: try until the failure of 0.05 is used up, or pay; a lottery of both
    problem = Lateness(model, "gate", 2.0 * first, 0.05)
    solution, measure = solve(problem), problem.program().solve()
    assert solve(problem, "lp").objective == pytest.approx(solution.objective, rel=1e-9)
    assert measure.objective == pytest.approx(solution.objective, rel=1e-9)
    assert evaluate(measure.mixed_policy(), problem).objective == pytest.approx(
        solution.objective, rel=1e-9
    )
    limited = replace(problem, failure_budget=0.2, constraints={"turns": visits("gate") <= 1.0})
    assert solve(limited).objective >= solution.objective * (1.0 - 1e-9)
    assert certify(solve(limited)).gap < 1e-9
    hurried = replace(problem, failure_budget=0.9, horizon=1)
    assert solve(hurried).objective == pytest.approx(0.0, abs=1e-12)


def test_arrival_costs_add_and_scale() -> None:
    """Half the total cost, and the lateness beyond 1 and 3, beside what each outcome is charged."""

    @dataclass(frozen=True, eq=False)
    class Delay(Formulation):
        model: SSP
        start: Start
        ratio = True

        @property
        def quantity(self) -> Quantity:
            late = [
                arrival_cost(lambda c, due=due: np.maximum(c - due, 0.0), affine_from=due)
                for due in (1.0, 3.0)
            ]
            return 0.5 * arrival_cost() + late[0] + 2.0 * late[1] + 1.0

    model = SSP.from_transitions({"a": {"go": [(0.5, "g", 2.0), (0.5, "g", 7.0)]}}, goal={"g"})
    charged = [0.5 * c + max(c - 1.0, 0.0) + 2.0 * max(c - 3.0, 0.0) + 1.0 for c in (2.0, 7.0)]
    assert solve(Delay(model, "a")).objective == pytest.approx(sum(charged) / 2.0, rel=1e-12)


def test_what_an_arrival_cost_is_not() -> None:
    with pytest.raises(ModelError, match="ratio = True"):
        LeastQuantity(FIRST, "depot", arrival_cost())
    with pytest.raises(ModelError, match="cannot be limited"):
        MCMP(FIRST, "depot", 0.1, constraints={"late": arrival_cost() <= 3.0})
    with pytest.raises(ModelError, match="not fall"):
        solve(Falling(FIRST, "depot"))
    with pytest.raises(ModelError, match="function"):
        arrival_cost(3.0)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class Falling(Formulation):
    model: SSP
    start: Start
    failure_budget: float | None = 0.05
    ratio = True

    @property
    def quantity(self) -> Quantity:
        return arrival_cost(lambda cost: np.maximum(10.0 - cost, 0.0), affine_from=20.0)
