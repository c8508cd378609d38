"""An answer in hand before a search: what comes back where the time is too short for its own."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from examples.solver_comparison.instances.families import corridor, grid, layered, scattered
from formulations import EGUBS, MCMP, S3P, CostBoundedReach, CostQuantile, CVaR
from own_criteria import Lateness
from ssp_lp import SSP, ModelError, OutOfTimeError, Status, certify, evaluate, solve, visits
from ssp_lp.compiled import deadline
from ssp_lp.compiled.deadline import Stop
from ssp_lp.methods.incumbent import Incumbent, _judged, by_moments, worth_bound

LIMIT = 0.3


def with_real_costs(model: SSP) -> SSP:
    """The model with a cost of its own for every pair."""
    factor = np.random.default_rng(1).uniform(0.5, 1.5, model.n_pairs)
    costs = model.costs * np.repeat(factor, np.diff(model.outcome_offsets))
    return replace(model, costs=costs, exact_costs={})


def dense(states: int) -> SSP:
    """Many actions with many successors each, all over the model."""
    rng, shape = np.random.default_rng(3), (states, 20, 20)
    successors, drawn = rng.integers(0, states, shape), rng.random(shape)
    successors = np.where(drawn < 0.01, states, np.where(drawn > 0.999, states + 1, successors))
    n = states * 20
    return SSP.from_arrays(
        pair_offsets=np.append(np.arange(0, n + 1, 20), [n, n]),
        outcome_offsets=np.arange(0, 20 * n + 1, 20),
        successors=successors.ravel(),
        probabilities=np.full(successors.size, 0.05),
        costs=np.repeat(rng.integers(1, 10, n).astype(float), 20),
        goal_states=[states],
        treat_actionless_as_dead_ends=True,
    )


SEARCHES = {
    "case S, scattered real costs": lambda: S3P(with_real_costs(scattered(1500)), 0, 0.02),
    "case S, layered real costs": lambda: S3P(with_real_costs(layered(60, 30)), 0, 0.05),
    "tail mean, windy grid": lambda: CVaR(grid(50), 0, 0.9, 0.2),
    "tail mean, dense": lambda: CVaR(dense(150), 0, 0.9, 0.05),
    "quantile, dense": lambda: CostQuantile(dense(200), 0, 0.9, 0.05),
    "quantile, corridor": lambda: CostQuantile(corridor(150), 0, 0.9, 0.01),
    "case S, limits": lambda: S3P(
        grid(40), 0, 0.2, constraints={"early": visits(41) <= 1.5}
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SEARCHES)
def test_no_search_ends_without_a_policy(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the time is short an answer of case M comes back, in the criterion's own numbers.

    However busy the machine, there is time for that one.
    """
    monkeypatch.setattr(deadline, "_PREPARED_SHARE", 0.0)
    monkeypatch.setattr(deadline, "_PREPARING", 100.0)
    problem: Any = SEARCHES[name]()
    solution = solve(problem, time_limit=LIMIT)
    assert solution.status in (Status.TIME_LIMIT, Status.OPTIMAL)
    found = evaluate(solution.policy, problem)
    assert found.objective == pytest.approx(solution.objective, rel=1e-9)
    assert found.failure_probability <= problem.failure_budget + 1e-12
    assert 0.0 < worth_bound(problem) <= solution.lower_bound <= solution.objective
    if "limits" in name:
        assert found.secondary_costs["early"] <= 1.5 + 1e-9


@pytest.mark.parametrize(
    "problem",
    [
        pytest.param(criterion, id=type(criterion).__name__)
        for model in [layered(6, 5, seed=2)]
        for criterion in (
            S3P(model, 0, 0.1),
            S3P(model, {0: 0.5, 1: 0.5}, 0.3, discount=0.99),
            CVaR(model, 0, 0.7, 0.1),
            CostQuantile(model, 0, 0.7, 0.1),
            CostQuantile(model, 0, 0.7, 1.0),
            S3P(model, 0, None, horizon=6),
            CostBoundedReach(model, 0, 20.0),
            EGUBS(model, 0, -0.1, 1.0),
        )
    ],
)
def test_the_incumbent_keeps_to_the_budget_and_lies_beside_the_optimum(problem: Any) -> None:
    best, held = solve(problem), Incumbent(problem)
    held.find()
    found = held.solution
    assert found is not None
    budget = problem.failure_budget
    assert found.budget_used <= (best.budget_used if budget is None else budget) + 1e-12
    if found.upper_bound is None:
        assert found.lower_bound <= best.objective * (1.0 + 1e-12)
        assert best.lower_bound <= found.objective * (1.0 + 1e-9)
    else:
        assert best.objective <= found.upper_bound * (1.0 + 1e-12)
        assert found.objective <= best.upper_bound * (1.0 + 1e-9)
    improved = held.improving(best)
    assert improved.gap <= best.gap


def test_the_bound_of_the_least_total_is_attained_where_one_way_leads() -> None:
    """Two ways of three steps and one of cost 0.1 + 0.2, of which dead-ends take no part."""
    model = SSP.from_transitions(
        {
            "a": {"go": [(0.5, "b", 0.1), (0.5, "pit", 0.0)], "round": [(1.0, "c", 0.0)]},
            "b": {"go": [(1.0, "g", 0.2)]},
            "c": {"go": [(1.0, "b", 0.4)], "stay": [(1.0, "c", 0.0)]},
            "pit": {},
        },
        goal={"g"},
        treat_actionless_as_dead_ends=True,
    )
    for level in (0.1, 0.9):
        risky = CostQuantile(model, "a", level, 0.5)
        assert worth_bound(risky) == pytest.approx(0.3, rel=1e-11)
        assert worth_bound(risky) <= solve(risky).objective
    assert worth_bound(S3P(model, {"a": 0.5, "c": 0.5}, 0.5)) == pytest.approx(0.3, rel=1e-11)
    assert worth_bound(CVaR(model, "c", 0.5)) == pytest.approx(0.6, rel=1e-11)
    assert worth_bound(CostBoundedReach(model, "c", 0.5)) == 0.0
    assert worth_bound(CostBoundedReach(model, "c", 0.7)) == pytest.approx(1.0)


def test_ctrl_c_while_an_answer_is_looked_for_ends_the_call(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    problem = CVaR(layered(6, 5, seed=2), 0, 0.7, 0.1)
    monkeypatch.setattr(Incumbent, "_cheapest_policy", interrupted)
    with pytest.raises(KeyboardInterrupt):
        solve(problem, time_limit=60.0)


def test_what_a_search_finds_is_kept_where_it_is_better(monkeypatch: pytest.MonkeyPatch) -> None:
    """Looked for at once, the incumbent changes no answer of a search that ends by itself."""
    monkeypatch.setattr(deadline, "_PREPARED_UNLIMITED", 0.0)
    problem = S3P(layered(6, 5, seed=2), 0, 0.1)
    plain = solve(problem)
    assert plain.status is Status.OPTIMAL
    assert "case M" not in plain.run.reason


def test_criteria_of_case_m_have_no_other_incumbent() -> None:
    held = Incumbent(MCMP(layered(6, 5, seed=2), 0, 0.1))
    held.find()
    assert held.solution is None


@pytest.mark.parametrize(
    "criterion",
    [
        lambda model: S3P(model, 0, 0.1),
        lambda model: S3P(model, 0, 0.1, constraints={"first": visits(0) <= 1.0}),
        lambda model: CVaR(model, 0, 0.7, 0.1),
        lambda model: CostBoundedReach(model, 0, 20.0),
    ],
)
def test_an_incumbent_is_certified_with_or_without_time(criterion: Any) -> None:
    """Without time for a search the cheapest way is the bound; an evaluation needs its own."""
    problem = criterion(layered(6, 5, seed=2))
    held = Incumbent(problem)
    held.find()
    assert held.solution is not None
    solution = replace(held.solution, status=Status.TIME_LIMIT)
    for limit in (None, 20.0):
        certificate = certify(solution, time_limit=limit)
        assert certificate.accepted
        assert certificate.objective == pytest.approx(solution.objective)
    with pytest.raises(ModelError, match="time_limit"):
        evaluate(solution.policy, problem, time_limit=-1.0)


def test_numbers_worked_out_later_keep_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = CVaR(layered(6, 5, seed=2), 0, 0.9, 0.1)
    solution = solve(problem, time_limit=60.0)
    assert solution.run.time_limit == 60.0
    assert solution.evaluation.objective == pytest.approx(solution.objective)
    monkeypatch.setattr(deadline, "_GRACE", 0.0)
    monkeypatch.setattr("ssp_lp.solution._LEAST_LIMIT", 0.0)
    late = replace(solution, run=replace(solution.run, time_limit=0.0))
    with pytest.raises(OutOfTimeError, match="before the policy was evaluated"):
        _ = late.failure_probability
    with pytest.raises(OutOfTimeError, match="before the policy was evaluated"):
        certify(solution, time_limit=0.0)


def test_rounding_of_a_budget_is_measured_by_the_budget() -> None:
    """A policy that fails with 5e-11 keeps to no budget of 1e-12; one of least failure may."""
    moves = {"road": [(1.0 - 5e-11, "home", 1.0), (5e-11, "pit", 1.0)], "wait": [(1.0, "y", 9.0)]}
    model = SSP.from_transitions(
        {"y": {"on": [(1.0, "home", 1.0)]}, "x": moves, "pit": {}},
        goal={"home"},
        treat_actionless_as_dead_ends=True,
    )
    problem = S3P(model, "x", failure_budget=1e-12)
    policy = solve(S3P(model, "x", failure_budget=1.0)).policy
    assert evaluate(policy, problem).failure_probability == pytest.approx(5e-11)
    assert _judged(problem, policy, 0.0) is None
    assert _judged(problem, policy, 1e-10) is not None


@pytest.mark.parametrize("level", [0.3, 0.9])
def test_mean_and_variance_tell_a_law_of_two_totals(level: float) -> None:
    """Of two totals 2 and 12, the dearer with probability 1 - level: the bounds are attained."""
    model = SSP.from_transitions(
        {
            "a": {"go": [(0.5, "b", 1.0), (0.5, "pit", 5.0)]},
            "b": {"go": [(level, "g", 1.0), (1.0 - level, "g", 11.0)]},
            "pit": {},
        },
        goal={"g"},
        treat_actionless_as_dead_ends=True,
    )
    policy = solve(MCMP(model, "a", 0.9)).policy
    dear, within = CVaR(model, "a", level, 0.9), CostBoundedReach(model, "a", 12.0, 0.9)
    assert by_moments(policy, dear).objective == pytest.approx(12.0, rel=1e-5)
    assert by_moments(policy, CostQuantile(model, "a", level, 0.9)).objective >= 12.0 - 1e-9
    assert by_moments(policy, within).objective == pytest.approx(0.5 * level, rel=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_mean_and_variance_bound_what_the_law_says(seed: int) -> None:
    model = with_real_costs(layered(6, 5, seed=seed))
    policy = solve(MCMP(model, 0, 0.3)).policy
    for worse, problem in (
        (1.0, CVaR(model, 0, 0.8, 0.3)),
        (1.0, CostQuantile(model, 0, 0.8, 0.3)),
        (-1.0, CostBoundedReach(model, 0, 20.0, 0.3)),
        (-1.0, EGUBS(model, 0, -0.1, 1.0)),
    ):
        bound, exact = by_moments(policy, problem), evaluate(policy, problem)
        assert type(bound.objective) is float
        assert worse * bound.objective >= worse * exact.objective
        assert bound.failure_probability == exact.failure_probability


def test_a_law_that_takes_too_long_leaves_a_policy_with_a_bound(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = CVaR(layered(6, 5, seed=2), 0, 0.9, 0.1)
    exact = solve(problem)

    def never(*asked: Any) -> Any:
        raise Stop

    monkeypatch.setattr("ssp_lp.analysis.evaluation.measured_law", never)
    monkeypatch.setattr(sys.modules["ssp_lp.solve"], "approach_to", never)
    found = solve(problem, time_limit=5.0)
    assert found.lower_bound <= exact.objective <= found.objective
    assert "mean and variance" in found.note
    monkeypatch.undo()
    assert evaluate(found.policy, problem).objective <= found.objective


def test_a_better_policy_from_beside_keeps_the_proof_of_the_search() -> None:
    """The search's prices and values go with its bound, at the same worth of failing."""
    problem = S3P(layered(6, 5, seed=3), 0, 0.1)
    best, held = solve(problem), Incumbent(problem)
    held.find()
    assert held.solution is not None
    assert best.failure_price is not None
    found = 1.01 * held.solution.objective  # of a search that was cut short
    price = best.failure_price + best.objective - found
    assert price > 0.0
    cut = replace(best, objective=found, failure_price=price, status=Status.TIME_LIMIT)
    improved = held.improving(cut)
    assert improved.policy is held.solution.policy
    proof = certify(improved)
    assert proof.accepted
    assert proof.lower_bound == pytest.approx(best.lower_bound, rel=1e-9)


def test_the_cheapest_way_is_charged_what_its_total_costs() -> None:
    """Two steps of 1 and 2: late by 1 beyond a due time of 2, and in time for 4."""
    steps = {"a": {"go": [(1.0, "b", 1.0)]}, "b": {"go": [(1.0, "g", 2.0)]}}
    model = SSP.from_transitions(steps, goal={"g"})
    assert worth_bound(Lateness(model, "a", 2.0)) == pytest.approx(1.0, rel=1e-11)
    assert worth_bound(Lateness(model, "a", 4.0)) == 0.0
