"""The references against one another on drawn models, before they judge the library."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from references import mcmp, s3p, s3p_program
from references.chain import plain_model
from references.frontier import (
    constrained_optimum,
    constrained_ratio,
    least_failure,
    lower_hull,
    price_interval,
)
from strategies import acyclic_problems, discounts, meanings, often, problems

drawn_often = often(120)
shares = st.sampled_from([0.01, 0.1, 0.25, 0.5, 0.75, 0.95])


@drawn_often
@given(problems(), meanings, st.booleans(), discounts, shares)
def test_pairs_and_hull_give_one_frontier(drawn, give_up, charge, discount, share):
    """The best lottery over two policies lies on the lower hull, and has a price there."""
    model = plain_model(drawn.choices, drawn.goals)
    points = mcmp.points(
        model, drawn.start, give_up=give_up, charge_failing_step=charge, discount=discount
    )
    hull = lower_hull(points)
    least = least_failure(points)
    for budget in (least, least + share * (1 - least)):
        value = constrained_optimum(points, budget)
        read_off = np.interp(budget, [p.failure for p in hull], [p.cost for p in hull])
        assert value == pytest.approx(read_off, rel=1e-9, abs=1e-9)
        low, high = price_interval(points, budget, value)
        assert low <= high + 1e-6


@drawn_often
@given(problems(), st.booleans())
def test_meanings_of_giving_up_agree_at_least_failure(drawn, charge):
    """Below it they are ordered: the freer the choice to stop, the lower the cost."""
    model = plain_model(drawn.choices, drawn.goals)
    best = mcmp.at_least_failure(model, drawn.start, charge_failing_step=charge)
    values = []
    for give_up in ("anywhere", "attention", "dead_ends"):
        points = mcmp.points(model, drawn.start, give_up=give_up, charge_failing_step=charge)
        assert least_failure(points) == pytest.approx(best.failure, abs=1e-12)
        at_least = constrained_optimum(points, best.failure)
        assert at_least == pytest.approx(best.cost, rel=1e-9, abs=1e-9)
        values.append(constrained_optimum(points, 0.5 + 0.5 * best.failure))
    assert values[0] <= values[1] + 1e-9
    assert values[1] <= values[2] + 1e-9


@drawn_often
@given(acyclic_problems(), shares, discounts)
def test_product_by_enumeration_and_by_program(drawn, share, discount):
    """Runs of acyclic models end within ten layers: enumeration of the product is exact."""
    model = plain_model(drawn.choices, drawn.goals)
    least, value = s3p.at_least_failure(model, drawn.start, discount)
    if value is None:
        return
    budget = least + share * (1 - least)
    points = s3p.product_points(model, drawn.start, 10, discount)
    low, high = s3p_program.ratio_bounds(model, drawn.start, budget, discount=discount)
    assert (low, high) == pytest.approx([constrained_ratio(points, budget)] * 2, rel=1e-7)


@drawn_often
@given(st.one_of(problems(most_live=3), problems(most_live=3, attention=True)), shares, discounts)
def test_memory_of_the_cost_never_hurts(drawn, share, discount):
    """The product's optimum is at most the best lottery over policies that see states only."""
    model = plain_model(drawn.choices, drawn.goals)
    least, value = s3p.at_least_failure(model, drawn.start, discount)
    if value is None:
        return
    budget = least + share * (1 - least)
    low, high = s3p_program.ratio_bounds(model, drawn.start, budget, discount=discount)
    stationary = constrained_ratio(s3p.stationary_points(model, drawn.start, discount), budget)
    assert low <= high + 1e-7
    assert high <= min(stationary, value) * (1 + 1e-7) + 1e-7
