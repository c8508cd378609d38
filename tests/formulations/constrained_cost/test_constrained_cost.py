"""ConstrainedCost (C-SSP) on drawn models: all policies enumerated, and a program of lotteries."""

import pytest
from hypothesis import assume, given, strategies as st

from charged_problems import charged_problems, limits_of
from checks import CLOSE, GAP, library_model, plain
from formulations import ConstrainedCost
from references import constrained, mcmp
from references.frontier import least_failure
from ssp_lp import InfeasibleError, certify, solve
from strategies import discounts, often, semantics

METHODS = ("columns", "lp")
shares = st.sampled_from([0.5, 0.25, 0.9, 0.75, 0.1, 0.5, 0.0, 1.0, 2.0, -0.5, "zero"])
"""Where a bound lies between the least attainable total and that of the cheapest policy."""

budgets = st.sampled_from([0.1, None, 0.0, 0.25, 0.5, 1.0, "below"])
"""Where the failure budget lies between the least failure (0) and sure failure (1)."""


def bounds_of(every, places, budget):
    """A bound for each place between the least total and that of the cheapest policy within."""
    within = [one for one in every if budget is None or one.failure <= budget + 1e-9] or every
    cheapest = min(within, key=lambda one: one.cost)
    bounds = []
    for row, place in enumerate(places):
        least = constrained.least_total(within, row)
        if place == "zero":
            bounds.append(0.0)
        elif place == -0.5:
            bounds.append(0.5 * least)
        else:
            bounds.append(least + place * max(cheapest.secondary[row] - least, 0.0))
    return bounds


def check_optimal(solution, bounds, budget):
    """Gap, certificate, prices (Karush, Kuhn, Tucker), lottery and the rows of the policy."""
    assert 0.0 <= solution.gap <= GAP
    certificate = certify(solution)
    assert certificate.accepted, certificate.reason
    assert certificate.gap <= GAP
    assert certificate.objective == pytest.approx(solution.objective, **CLOSE)
    spent = dict(solution.secondary_costs)
    allowed = {f"r{k}": bound for k, bound in enumerate(bounds)}
    assert list(spent) == list(allowed)
    if solution.failure_price is not None:
        found = solution.evaluation.discounted_failure
        spent["failure"] = solution.failure_probability if found is None else found
        allowed["failure"] = budget
    assert set(solution.prices) == set(allowed)
    tight = 0
    for name, bound in allowed.items():
        price, slack = solution.prices[name], bound - spent[name]
        assert price >= 0.0
        assert slack >= -1e-9 * bound
        assert price * slack <= 1e-8 * (1.0 + solution.objective)
        tight += slack <= 1e-9 * (1.0 + bound)
    members = len(solution.policy.policies)
    assert members <= tight + 1
    assert min(solution.policy.weights) > 0.0


@often(200)
@given(
    charged_problems(),
    st.tuples(shares, shares, shares),
    budgets,
    semantics,
    discounts,
)
def test_the_best_lottery_over_all_policies(drawn_charges, places, place, meaning, discount):
    """Both methods meet the enumerated optimum, or prove that there is none."""
    drawn, charges = drawn_charges
    discount = None if place is None else discount
    every = constrained.measured(
        drawn.choices, drawn.goals, drawn.start, charges, discount=discount, **meaning
    )
    least = least_failure(mcmp.points(plain(drawn), drawn.start, discount=discount, **meaning))
    budget = place
    if place == "below":
        budget = 0.5 * least
    elif place is not None:
        budget = least + place * (1.0 - least)
    at_least = budget is None or (budget < 1.0 and abs(budget - least) <= 1e-10)
    allowed = [one for one in every if one.failure <= least + 1e-9] if at_least else every
    assume(allowed)
    bounds = bounds_of(allowed, places[: len(charges)], budget)
    model = library_model(drawn)
    problem = ConstrainedCost(
        model,
        drawn.start,
        limits_of(model, charges, bounds),
        failure_budget=budget,
        discount=discount,
        **meaning,
    )
    row = None if at_least else budget
    excess = constrained.least_excess(allowed, row, bounds)
    assume(not 1e-13 < excess < 1e-6)
    for method in METHODS:
        if excess > 1e-13:
            check_refused(problem, method, allowed, bounds, row)
            continue
        solution = solve(problem, method)
        value = constrained.best_lottery(allowed, row, bounds)
        if value is None:
            value = constrained.best_lottery(
                allowed, row, [bound * (1 + 1e-12) + 1e-12 for bound in bounds]
            )
        assert solution.objective == pytest.approx(value, **CLOSE)
        check_optimal(solution, bounds, budget)


def check_refused(problem, method, every, bounds, budget):
    """The error names rows that cannot be kept together, and no fewer would do."""
    with pytest.raises(InfeasibleError) as caught:
        solve(problem, method)
    named = caught.value.conflicting_rows
    assert named
    for name in named:
        assert name in str(caught.value) or name == "failure"

    def excess(names):
        kept = [k for k in range(len(bounds)) if f"r{k}" in names]
        part = [
            constrained.Measured(o.cost, o.failure, tuple(o.secondary[k] for k in kept))
            for o in every
        ]
        limit = budget if "failure" in names else None
        return constrained.least_excess(part, limit, [bounds[k] for k in kept])

    assert excess(named) > 1e-9 or budget is None
    for left_out in named if budget is not None else ():
        assert excess(set(named) - {left_out}) <= 1e-9
