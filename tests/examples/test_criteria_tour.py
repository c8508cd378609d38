"""The tour of the criteria: they are one picture, and the table says what each attains."""

import math

import numpy as np
import pytest

from examples.formulating import criteria_tour
from formulations import AlphaMCMP, CostLimit, MaxProb, compare_criteria
from small_models import EXACT, TWO_MOVES, model_of
from ssp_lp import solve

STOPS = list(criteria_tour.tour())
each_domain = pytest.mark.parametrize("domain", [domain for _, domain in STOPS], ids=dict(STOPS))


@each_domain
def test_every_criterion_lies_on_the_frontier(domain):
    """Alpha-MCMP walks along it, and the finite penalty D is its tangent of slope D."""
    frontier = criteria_tour.free_frontier(domain)
    rows = criteria_tour.shares(domain, frontier) + criteria_tour.tangents(domain, frontier)
    assert len(rows) == len(criteria_tour.FRACTIONS) + len(criteria_tour.PENALTIES)
    for what, found, theory in rows:
        assert found == pytest.approx(theory, rel=1e-8, abs=1e-12), what


@each_domain
def test_the_cost_of_a_share_is_linear_up_to_the_best_ratio(domain):
    """Giving up at the start is free: linear up to the least cost per probability, then convex."""
    model, start = domain
    frontier = criteria_tour.free_frontier(domain)
    goal = 1.0 - frontier.failure
    greatest = solve(MaxProb(model, start)).objective
    ratios = frontier.cost[goal > 1e-9] / goal[goal > 1e-9]
    ratio = float(ratios.min())
    reach = float(goal[goal > 1e-9][ratios <= ratio * (1.0 + 1e-9)].max())
    shares = np.append(np.linspace(0.0, 1.0, 21), reach / greatest)
    costs = [solve(AlphaMCMP(model, start, float(min(s, 1.0)))).objective for s in shares]
    for share, cost in zip(shares, costs, strict=True):
        line = ratio * share * greatest
        if share * greatest <= reach * (1.0 + 1e-12):
            assert cost == pytest.approx(line, rel=1e-8, abs=1e-12)
        else:
            assert cost > line
    assert (np.diff(costs[:-1], 2) >= -1e-9 * max(costs)).all()


@pytest.mark.slow
def test_the_tour_prints_a_table_for_each_domain(capsys):
    criteria_tour.main()
    printed = capsys.readouterr().out
    assert printed.count("MaxProb") == printed.count("one picture") == len(STOPS)


def test_the_comparison_has_a_row_for_each_question():
    """Slow costs 2 and burns 4 for sure; fast costs 1, burns 1 and fails with 1/20."""
    compared = compare_criteria(
        model_of(TWO_MOVES),
        "x",
        failure_budgets=(0.02, 0.05),
        penalties=(10.0, 30.0),
        cost_bounds=(1,),
        levels=(0.9,),
        exponential_utilities=((-1.0, 1.0),),
        limits={"fuel": CostLimit({"x": {"slow": 4.0, "fast": 1.0}}, bound=2.5)},
    )
    utility = max(math.exp(-2.0) + 1.0, 0.95 * (math.exp(-1.0) + 1.0))
    for name, value in {
        "MCMP, failure budget 0.02": 1.6,
        "FinitePenalty, penalty 10": 1.5,
        "FinitePenalty, penalty 30": 2.0,
        "CostBoundedReach, cost 1": 0.95,
        "CostBoundedReach, cost 1, failure budget 0.05": 0.95,
        "EGUBS, risk factor -1, goal bonus 1": utility,
        "ConstrainedCost, failure budget 0.05": 1.0,
    }.items():
        assert compared[name].numbers[0] == pytest.approx(value, **EXACT), name
        assert compared[name].solution.objective == compared[name].numbers[0]
    cvar = compared["CVaR 0.9, failure budget 0.05"].numbers[0]
    assert cvar == pytest.approx(1.0, rel=1e-8)
    assert compared["S3P, failure budget 0.02"].numbers[2] == pytest.approx(79 / 49, rel=1e-9)
    assert compared["MaxProb"].numbers[0] == 1.0
    assert compared["CostQuantile 0.9, least failure"].numbers[0] == 2.0
    assert compared["CostQuantile 0.9, failure budget 0.05"].numbers[0] == 1.0
    limited = compared["ConstrainedCost, least failure"]
    assert limited.numbers[0] is None
    assert "'fuel' is at least 4" in limited.note
    with pytest.raises(KeyError):
        compared["no such criterion"]


def test_what_nobody_can_do_stays_in_the_table():
    model = model_of({"x": {"go": [(0.5, "g", 1), (0.5, "d", 1)]}, "d": {}})
    compared = compare_criteria(model, "x")
    row = compared["MCMP, failure budget 0.05"]
    assert row.solution is None
    assert row.numbers == (None,) * 5
    assert "0.5" in row.note
    assert row.note in compared.summary()
