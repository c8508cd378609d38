"""An answer in hand before a search: what comes back where the time is too short for its own."""

import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from examples.solver_comparison.instances.families import corridor, grid, layered, scattered
from formulations import EGUBS, MCMP, S3P, CostBoundedReach, CostQuantile, CVaR
from own_criteria import Lateness
from small_models import model_of
from ssp_lp import SSP, ModelError, OutOfTimeError, Status, certify, evaluate, solve, visits
from ssp_lp.compiled import deadline
from ssp_lp.compiled.deadline import Stop
from ssp_lp.methods.incumbent import Incumbent, _incumbent_value, by_moments, cheapest_way_bound
from written_models import written

LAYERED = layered(6, 5, seed=2)


def held(problem):
    """The incumbent, looked for."""
    incumbent = Incumbent(problem)
    incumbent.find()
    return incumbent


def with_real_costs(model):
    """The model with a cost of its own for every pair."""
    factor = np.random.default_rng(1).uniform(0.5, 1.5, model.n_pairs)
    costs = model.costs * np.repeat(factor, np.diff(model.outcome_offsets))
    return replace(model, costs=costs, exact_costs={})


def dense(states):
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
    "case S, limits": lambda: S3P(grid(40), 0, 0.2, constraints={"early": visits(41) <= 1.5}),
}


@pytest.mark.parametrize("name", SEARCHES)
def test_no_search_ends_without_a_policy(name, monkeypatch):
    """Where the time is short an answer of case M comes back, in the criterion's own numbers.

    However busy the machine, there is time for that one.
    """
    monkeypatch.setattr(deadline, "_PREPARED_SHARE", 0.0)
    monkeypatch.setattr(deadline, "_PREPARING", 100.0)
    problem = SEARCHES[name]()
    solution = solve(problem, time_limit=0.3)
    assert solution.status in (Status.TIME_LIMIT, Status.OPTIMAL)
    found = evaluate(solution.policy, problem)
    assert found.objective == pytest.approx(solution.objective, rel=1e-9)
    assert found.failure_probability <= problem.failure_budget + 1e-12
    assert 0.0 < cheapest_way_bound(problem) <= solution.lower_bound <= solution.objective
    if "limits" in name:
        assert found.secondary_costs["early"] <= 1.5 + 1e-9


@pytest.mark.parametrize(
    "problem",
    [
        S3P(LAYERED, 0, 0.1),
        S3P(LAYERED, 0, 0.1, constraints={"first": visits(0) <= 1.0}),
        S3P(LAYERED, {0: 0.5, 1: 0.5}, 0.3, discount=0.99),
        CVaR(LAYERED, 0, 0.7, 0.1),
        CostQuantile(LAYERED, 0, 0.7, 0.1),
        CostQuantile(LAYERED, 0, 0.7, 1.0),
        S3P(LAYERED, 0, None, horizon=6),
        CostBoundedReach(LAYERED, 0, 20.0),
        EGUBS(LAYERED, 0, -0.1, 1.0),
    ],
    ids=lambda criterion: type(criterion).__name__,
)
def test_the_incumbent_keeps_to_the_budget_and_lies_beside_the_optimum(problem):
    """Certified, too: without time for a search the cheapest way is the bound."""
    best, incumbent = solve(problem), held(problem)
    found = incumbent.solution
    assert found is not None
    budget = problem.failure_budget
    assert found.budget_used <= (best.budget_used if budget is None else budget) + 1e-12
    if found.upper_bound is None:
        assert found.lower_bound <= best.objective * (1.0 + 1e-12)
        assert best.lower_bound <= found.objective * (1.0 + 1e-9)
    else:
        assert best.objective <= found.upper_bound * (1.0 + 1e-12)
        assert found.objective <= best.upper_bound * (1.0 + 1e-9)
    assert incumbent.improving(best).gap <= best.gap
    if not problem.constraints:  # the cheapest of least failure is one policy
        single = Incumbent(problem, deterministic=True)
        assert single.find() is single
        assert len(single.solution.policy.policies) == 1
    for limit in (None, 20.0):
        certificate = certify(replace(found, status=Status.TIME_LIMIT), time_limit=limit)
        assert certificate.accepted
        assert certificate.objective == pytest.approx(found.objective)
    with pytest.raises(ModelError, match="time_limit"):
        evaluate(found.policy, problem, time_limit=-1.0)


def test_the_bound_of_the_least_total_is_attained_where_one_way_leads():
    """Two ways of three steps and one of cost 0.1 + 0.2, of which dead-ends take no part."""
    model = written(
        """
        a go: 0.5 b 0.1, 0.5 pit 0
        a round: c 0
        b go: g 0.2
        c go: b 0.4
        c stay: c 0
        """
    )
    for level in (0.1, 0.9):
        risky = CostQuantile(model, "a", level, 0.5)
        assert cheapest_way_bound(risky) == pytest.approx(0.3, rel=1e-11)
        assert cheapest_way_bound(risky) <= solve(risky).objective
    for problem, bound in (
        (S3P(model, {"a": 0.5, "c": 0.5}, 0.5), 0.3),
        (CVaR(model, "c", 0.5), 0.6),
        (CostBoundedReach(model, "c", 0.5), 0.0),
        (CostBoundedReach(model, "c", 0.7), 1.0),
        (Lateness(model, "c", 0.4), 0.2),  # charged what its total costs
        (Lateness(model, "c", 0.7), 0.0),
    ):
        assert cheapest_way_bound(problem) == pytest.approx(bound, rel=1e-11)


def test_ctrl_c_while_an_answer_is_looked_for_ends_the_call(monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(Incumbent, "_cheapest_policy", interrupted)
    monkeypatch.setattr(deadline, "_PREPARED_SHARE", 0.0)
    with pytest.raises(KeyboardInterrupt):
        solve(CVaR(LAYERED, 0, 0.7, 0.1), time_limit=60.0)


def test_what_a_search_finds_is_kept_where_it_is_better(monkeypatch):
    """Looked for at once, the incumbent changes no answer of a search that ends by itself."""
    monkeypatch.setattr(deadline, "_PREPARED_UNLIMITED", 0.0)
    plain = solve(S3P(LAYERED, 0, 0.1))
    assert plain.status is Status.OPTIMAL
    assert "case M" not in plain.run.reason
    assert held(MCMP(LAYERED, 0, 0.1)).solution is None  # case M has no other


def test_numbers_worked_out_later_keep_the_limit(monkeypatch):
    solution = solve(CVaR(LAYERED, 0, 0.9, 0.1), time_limit=60.0)
    assert solution.run.time_limit == 60.0
    assert solution.evaluation.objective == pytest.approx(solution.objective)
    monkeypatch.setattr(deadline, "_GRACE", 0.0)
    monkeypatch.setattr("ssp_lp.solution._LEAST_LIMIT", 0.0)
    late = replace(solution, run=replace(solution.run, time_limit=0.0))
    with pytest.raises(OutOfTimeError, match="before the policy was evaluated"):
        _ = late.failure_probability
    with pytest.raises(OutOfTimeError, match="before the policy was evaluated"):
        certify(solution, time_limit=0.0)


def test_rounding_of_a_budget_is_measured_by_the_budget():
    """A policy that fails with 5e-11 keeps to no budget of 1e-12; one of least failure may."""
    model = written(f"y on: g 1\n x road: {1.0 - 5e-11} g 1, 5e-11 pit 1\n x wait: y 9")
    problem = S3P(model, "x", failure_budget=1e-12)
    policy = solve(S3P(model, "x", failure_budget=1.0)).policy
    assert evaluate(policy, problem).failure_probability == pytest.approx(5e-11)
    assert _incumbent_value(problem, policy, 0.0) is None
    assert _incumbent_value(problem, policy, 1e-10) is not None


@pytest.mark.parametrize("level", [0.3, 0.9])
def test_mean_and_variance_tell_a_law_of_two_totals(level):
    """Of two totals 2 and 12, the dearer with probability 1 - level: the bounds are attained."""
    model = written(f"a go: 0.5 b 1, 0.5 pit 5\n b go: {level} g 1, {1.0 - level} g 11")
    policy = solve(MCMP(model, "a", 0.9)).policy
    dear, within = CVaR(model, "a", level, 0.9), CostBoundedReach(model, "a", 12.0, 0.9)
    assert by_moments(policy, dear).objective == pytest.approx(12.0, rel=1e-5)
    assert by_moments(policy, CostQuantile(model, "a", level, 0.9)).objective >= 12.0 - 1e-9
    assert by_moments(policy, within).objective == pytest.approx(0.5 * level, rel=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_mean_and_variance_bound_what_the_law_says(seed):
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


def test_a_law_that_takes_too_long_leaves_a_policy_with_a_bound(monkeypatch):
    problem = CVaR(LAYERED, 0, 0.9, 0.1)
    exact = solve(problem)

    def never(*asked):
        raise Stop

    monkeypatch.setattr("ssp_lp.analysis.evaluation._measured_law", never)
    monkeypatch.setattr(sys.modules["ssp_lp.solving"], "approach_to", never)
    found = solve(problem, time_limit=5.0)
    assert found.lower_bound <= exact.objective <= found.objective
    assert "mean and variance" in found.note
    monkeypatch.undo()
    assert evaluate(found.policy, problem).objective <= found.objective


def test_a_better_policy_from_beside_keeps_the_proof_of_the_search():
    """The search's prices and values go with its bound, at the same worth of failing."""
    problem = S3P(layered(6, 5, seed=3), 0, 0.1)
    best, incumbent = solve(problem), held(problem)
    found = 1.01 * incumbent.solution.objective  # of a search that was cut short
    price = best.failure_price + best.objective - found
    assert price > 0.0
    cut = replace(best, objective=found, failure_price=price, status=Status.TIME_LIMIT)
    improved = incumbent.improving(cut)
    assert improved.policy is incumbent.solution.policy
    proof = certify(improved)
    assert proof.accepted
    assert proof.lower_bound == pytest.approx(best.lower_bound, rel=1e-9)


def test_the_policy_of_least_failure_proves_a_bound_where_it_is_found_on_a_smaller_process():
    """Its totals are those of safest pairs alone: no state behind the bridge is among them."""
    model = model_of(
        {
            "a": {"road": [(1.0, "g", 4.0)], "bridge": [(1.0, "b", 1.0)]},
            "b": {"on": [(0.5, "g", 1.0), (0.5, "pit", 1.0)]},
            "pit": {},
        }
    )
    compiled = MCMP(model, "a", 0.2).compile()
    proof = compiled.pricing().prove(100.0, compiled.least_failure().column)
    assert proof.bound == pytest.approx(4.0, rel=1e-12)


def test_a_policy_found_when_the_time_ends_is_still_evaluated(monkeypatch):
    """The search in case M ends at the deadline; the time to close evaluates its lottery."""
    monkeypatch.setattr(deadline, "_GRACE", 0.0)
    monkeypatch.setattr(deadline, "_CLOSING", 60.0)
    for problem in (S3P(grid(8), 0, 0.2), CVaR(grid(8), 0, 0.9, 0.2)):
        late = Incumbent(problem)
        late.policies[False] = Incumbent(problem).find().policies[False]
        with deadline.until(time.perf_counter() - 1.0):
            assert late.find() is late
        assert late.solution.budget_used <= 0.2
        attained = evaluate(late.solution.policy, problem).objective
        assert late.solution.objective >= attained * (1.0 - 1e-9)
