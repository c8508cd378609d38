"""The criteria beside MCMP and S3P with a budget: enumeration, identities, refusals."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from cases import PUBLISHED
from checks import CLOSE, GAP, check_certificate, check_evaluation, library_model, plain
from formulations import ISSPUDE, MCMP, S3P, AlphaMCMP, FinitePenalty, MaxProb, MinCost, MinProb
from references import mcmp, s3p
from references.chain import start_distribution
from references.frontier import constrained_optimum, least_failure
from ssp_lp import (
    InfeasibleError,
    certify,
    solve,
    trace_frontier,
)
from strategies import discounts, often, problems, semantics

METHODS = ("lp", "columns")
penalties = st.sampled_from([0.1, 1.0, 3.0, 10.0, 1000.0])
shares = st.sampled_from([0.0, 0.1, 0.5, 0.9, 0.999, 1.0])


def check_all(solution, value):
    """The value, a small gap on the right side, the evaluation and the certificate."""
    assert solution.objective == pytest.approx(value, **CLOSE)
    assert 0.0 <= solution.gap <= GAP
    check_evaluation(solution)
    certificate = certify(solution)
    assert certificate.accepted, certificate.reason
    assert certificate.gap <= GAP
    assert certificate.objective == pytest.approx(value, **CLOSE)


@often(100)
@given(problems())
def test_extreme_probabilities(drawn):
    """MAXPROB and MINPROB by enumeration, for every kind of start."""
    model, reference = library_model(drawn), plain(drawn)
    low = high = 0.0
    for state, mass in start_distribution(drawn.start).items():
        one, other = (
            (1.0, 1.0) if state in drawn.goals else s3p.goal_probability_range(reference, state)
        )
        low, high = low + mass * one, high + mass * other
    for method in METHODS:
        greatest = solve(MaxProb(model, drawn.start), method)
        check_all(greatest, high)
        assert greatest.lower_bound <= high * (1 + 1e-9) + 1e-12
        assert greatest.upper_bound >= high * (1 - 1e-9) - 1e-12
        least = solve(MinProb(model, drawn.start), method)
        check_all(least, low)
        assert least.lower_bound <= low * (1 + 1e-9) + 1e-12
        assert least.upper_bound is None
    assert MaxProb(model, drawn.start).dead_ends == reference.dead_ends
    assert MinProb(model, drawn.start).attention_states == reference.attention


@often(100)
@given(problems())
def test_the_plain_problem(drawn):
    """The cheapest policy that reaches the goal surely, if there is one."""
    points = mcmp.points(plain(drawn), drawn.start, give_up="dead_ends", charge_failing_step=False)
    proper = [point.cost for point in points if point.failure <= 1e-11]
    problem = MinCost(library_model(drawn), drawn.start)
    for method in METHODS:
        if proper:
            solution = solve(problem, method)
            check_all(solution, min(proper))
            assert solution.failure_price == np.inf
            assert solution.budget_slope is None
            continue
        with pytest.raises(InfeasibleError, match="surely from state") as caught:
            solve(problem, method)
        assert caught.value.least_failure == pytest.approx(least_failure(points), abs=1e-12)


@often(100)
@given(problems(), penalties, semantics, discounts)
def test_a_finite_penalty(drawn, penalty, meaning, discount):
    """The least of cost + penalty * failure over all policies, exact or discounted."""
    points = mcmp.points(plain(drawn), drawn.start, discount=discount, **meaning)
    value = min(point.cost + penalty * point.failure for point in points)
    problem = FinitePenalty(
        library_model(drawn), drawn.start, penalty, discount=discount, **meaning
    )
    for method in METHODS:
        solution = solve(problem, method)
        check_all(solution, value)
        check_certificate(solution)
        assert solution.failure_price == penalty
        assert solution.budget_slope == 0.0
        assert len(solution.policy.policies) == 1


@often(50)
@given(problems(), shares, semantics)
def test_a_share_of_the_greatest_probability(drawn, share, meaning):
    """The best lottery whose goal probability is the share of the greatest one."""
    points = mcmp.points(plain(drawn), drawn.start, **meaning)
    budget = 1.0 - share * (1.0 - least_failure(points))
    value = constrained_optimum(points, budget)
    model = library_model(drawn)
    for method in METHODS:
        for problem in (
            AlphaMCMP(model, drawn.start, share, **meaning),
            MCMP(model, drawn.start, reach_fraction=share, **meaning),
        ):
            assert problem.failure_budget == pytest.approx(budget, abs=1e-12)
            check_all(solve(problem, method), value)


@often(40)
@given(problems(), st.sampled_from([0.5, 0.9, 1.0]))
def test_s3p_and_isspude(drawn, share):
    """At least failure S3P is iSSPUDE, and a share is a budget."""
    model, begin = library_model(drawn), drawn.start
    least, cost = s3p.at_least_failure(plain(drawn), begin)
    if least >= 1 - 1e-12:
        with pytest.raises(InfeasibleError):
            solve(ISSPUDE(model, begin))
        return
    check_all(solve(ISSPUDE(model, begin)), cost)
    assert solve(S3P(model, begin)).objective == pytest.approx(cost, **CLOSE)
    problem = S3P(model, begin, reach_fraction=share)
    same = S3P(model, begin, failure_budget=1.0 - share * (1.0 - least))
    assert solve(problem).objective == pytest.approx(solve(same).objective, **CLOSE)


@often(40)
@given(problems(), semantics)
def test_penalties_run_along_the_frontier(drawn, meaning):
    """The optimum at penalty D is where the frontier's tangent of slope -D meets failure 0.

    That is the least of cost + D * failure over the frontier's turning points.
    """
    model = library_model(drawn)
    frontier = trace_frontier(MCMP(model, drawn.start, **meaning))
    for penalty in (0.5, 2.0, 25.0):
        solution = solve(FinitePenalty(model, drawn.start, penalty, **meaning))
        tangent = float((frontier.cost + penalty * frontier.failure).min())
        assert solution.objective == pytest.approx(tangent, **CLOSE)
        budget = solution.failure_probability
        on_frontier = frontier.objective_at(min(budget + 1e-12, 1.0))
        assert solution.expected_cost == pytest.approx(on_frontier, rel=1e-6, abs=1e-9)


@often(40)
@given(problems())
def test_the_cost_of_a_share_is_linear_up_to_the_best_ratio(drawn):
    """Giving up at the start is free: linear up to the least cost per probability, then convex."""
    model = library_model(drawn)
    points = mcmp.points(plain(drawn), drawn.start, **PUBLISHED)
    greatest = 1.0 - least_failure(points)
    hopeful = [(c / (1 - f), 1 - f) for f, c in points if f < 1 - 1e-12 and np.isfinite(c)]
    if not hopeful or any(start in drawn.goals for start in start_distribution(drawn.start)):
        return
    ratio = min(hopeful)[0]
    reach = max(goal for slope, goal in hopeful if slope <= ratio * (1 + 1e-12))
    grid = np.linspace(0.0, 1.0, 9)
    costs = [solve(AlphaMCMP(model, drawn.start, share)).objective for share in grid]
    for share, cost in zip(grid, costs, strict=True):
        line = ratio * share * greatest
        if share * greatest <= reach:
            assert cost == pytest.approx(line, **CLOSE)
        else:
            assert cost >= line - 1e-9
    assert (np.diff(costs, 2) >= -1e-9 * (1.0 + max(costs))).all()
