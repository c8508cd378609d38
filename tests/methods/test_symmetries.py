"""Changes of a problem that change its answer in a known way, or not at all."""

from itertools import pairwise

import pytest
from hypothesis import given, strategies as st

from checks import CLOSE, budget_of, library_model, plain
from formulations import MCMP, S3P
from references import mcmp
from references.chain import start_distribution
from ssp_lp import InfeasibleError, solve
from strategies import Draw, budgets, discounts, meanings, often, problems

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


def check_same(drawn, changed, place, setting, scale=1.0):
    """Both problems have the same answers, up to the scale of the costs."""
    budget = budget_of(place, mcmp.points(plain(drawn), drawn.start, **setting))
    before, after = answers(drawn, budget, setting), answers(changed, budget, setting)
    for (kind, value), (changed_kind, changed_value) in zip(before, after, strict=True):
        assert kind == changed_kind
        factor = scale if kind == "optimum" else 1.0
        assert changed_value == pytest.approx(factor * value, **CLOSE)


@pytest.mark.slow
@often(16)
@given(PROBLEM, budgets, SETTING, st.randoms(use_true_random=False))
def test_relabelled_and_reordered_with_split_outcomes(drawn, place, setting, random):
    """States renamed and listed in another order, actions too; outcomes in two halves."""

    def name(state):
        return ("state", sum(map(ord, state)), state)

    order = list(drawn.choices)
    random.shuffle(order)
    choices = {
        name(state): {
            (action, "new"): [(p / 2, name(s), cost) for p, s, cost in reversed(outcomes * 2)]
            for action, outcomes in reversed(drawn.choices[state].items())
        }
        for state in order
    }
    start = {name(state): weight for state, weight in start_distribution(drawn.start).items()}
    changed = Draw(choices, frozenset(map(name, drawn.goals)), start)
    check_same(drawn, changed, place, setting)


@pytest.mark.slow
@often(16)
@given(PROBLEM, budgets, SETTING, st.sampled_from([0.1, 0.25, 3, 1000]))
def test_scaled_costs_with_dominated_actions_and_states_that_nobody_visits(
    drawn, place, setting, scale
):
    """The optimum times the same number; each action once more, one dearer; some off all paths."""

    def scaled(outcomes, more=0):
        return [(p, s, round(scale * (cost + more), 6)) for p, s, cost in outcomes]

    choices = {
        state: {
            (action, more): scaled(outcomes, more)
            for action, outcomes in actions.items()
            for more in (0, 1)
        }
        for state, actions in drawn.choices.items()
    } | {"far": {"back": [(1.0, "a", 1)], "end": [(1.0, "grave", 0)]}, "grave": {}}
    check_same(drawn, Draw(choices, drawn.goals, drawn.start), place, setting, scale)


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
