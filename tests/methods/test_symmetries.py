"""Changes of a problem that change its answer in a known way, or not at all."""

from itertools import pairwise

import pytest
from hypothesis import given, strategies as st

from checks import budget_of, library_model, plain
from formulations import MCMP, S3P
from references import mcmp
from ssp_lp import InfeasibleError, solve
from strategies import discounts, meanings, often, problems

PROBLEM = problems(most_live=3)
SETTING = st.fixed_dictionaries({"discount": discounts, "give_up": meanings})


def answers(drawn, budget, setting):
    """The optimum of both cases, or the least failure where the budget is too small."""
    model, found = library_model(drawn), []
    discounted = {"failure_budget": budget, "discount": setting["discount"]}
    for problem in (MCMP(model, drawn.start, budget, **setting),
                    S3P(model, drawn.start, **discounted)):  # fmt: skip
        try:
            found.append(("optimum", solve(problem).objective))
        except InfeasibleError as error:
            found.append(("infeasible", error.least_failure))
    return found


@pytest.mark.slow
@often(16)
@given(PROBLEM, SETTING)
def test_a_larger_budget_costs_no_more(drawn, setting):
    """The optimum falls with the budget, and case M is convex in it."""
    points = mcmp.points(plain(drawn), drawn.start, **setting)
    grid = [budget_of(share, points) for share in (0.0, 0.25, 0.5, 0.75)]
    for case, row in enumerate(zip(*(answers(drawn, b, setting) for b in grid), strict=True)):
        column = [value for kind, value in row if kind == "optimum"]
        room = 1e-7 * (1 + max(column, default=0.0))
        assert all(a >= b - room for a, b in pairwise(column))
        if case == 0 and len(column) == 4:
            assert column[1] <= (column[0] + column[2]) / 2 + room
            assert column[2] <= (column[1] + column[3]) / 2 + room
