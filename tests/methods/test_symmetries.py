"""Changes of a problem that change its answer in a known way, or not at all."""

from itertools import pairwise

import pytest
from hypothesis import given, strategies as st

from checks import CLOSE, budget_of, library_model, plain
from formulations import MCMP, S3P
from references import mcmp
from ssp_lp import InfeasibleError, solve
from strategies import Draw, budgets, discounts, meanings, often, problems

drawn_settings = often(50)


def answers(drawn, budget, discount, give_up):
    """The optimum of both cases, or the least failure where the budget is too small."""
    model, found = library_model(drawn), []
    for formulation, extra in ((MCMP, {"give_up": give_up}), (S3P, {})):
        problem = formulation(
            model, start=drawn.start, failure_budget=budget, discount=discount, **extra
        )
        try:
            solution = solve(problem)
        except InfeasibleError as error:
            found.append(("infeasible", error.least_failure))
        else:
            found.append(("optimum", solution.objective))
    return found


def check_same(drawn, changed, place, discount, give_up, scale=1.0):
    """Both problems have the same answers, up to the scale of the costs."""
    points = mcmp.points(plain(drawn), drawn.start, give_up=give_up, discount=discount)
    budget = budget_of(place, points)
    before = answers(drawn, budget, discount, give_up)
    after = answers(changed, budget, discount, give_up)
    for (kind, value), (changed_kind, changed_value) in zip(before, after, strict=True):
        assert kind == changed_kind
        factor = scale if kind == "optimum" else 1.0
        assert changed_value == pytest.approx(factor * value, **CLOSE)


def with_outcomes(drawn, change):
    """The same problem with every action's list of outcomes changed."""
    choices = {
        state: {action: change(outcomes) for action, outcomes in actions.items()}
        for state, actions in drawn.choices.items()
    }
    return Draw(choices, drawn.goals, drawn.start)


@drawn_settings
@given(problems(most_live=3), budgets, discounts, meanings, st.randoms(use_true_random=False))
def test_relabelled_and_reordered(drawn, place, discount, give_up, random):
    """States renamed and listed in another order, actions too."""

    def name(state):
        return ("state", sum(map(ord, state)), state)

    order = list(drawn.choices)
    random.shuffle(order)
    choices = {
        name(state): {
            (action, "new"): [(p, name(s), cost) for p, s, cost in reversed(outcomes)]
            for action, outcomes in reversed(drawn.choices[state].items())
        }
        for state in order
    }
    start = drawn.start
    if isinstance(start, dict):
        renamed = {name(state): weight for state, weight in start.items()}
    else:
        renamed = {name(start): 1.0}
    goals = frozenset(name(state) for state in drawn.goals)
    check_same(drawn, Draw(choices, goals, renamed), place, discount, give_up)


@drawn_settings
@given(
    problems(most_live=3),
    budgets,
    discounts,
    meanings,
    st.sampled_from([0.1, 0.25, 3, 1000]),
)
def test_scaled_costs(drawn, place, discount, give_up, scale):
    """Every cost times a positive number: the optimum times that number."""
    changed = with_outcomes(
        drawn, lambda outcomes: [(p, s, round(scale * cost, 6)) for p, s, cost in outcomes]
    )
    check_same(drawn, changed, place, discount, give_up, scale)


@drawn_settings
@given(problems(most_live=3), budgets, discounts, meanings)
def test_a_dominated_action(drawn, place, discount, give_up):
    """Each action once more, one dearer: nothing changes."""
    choices = {
        state: actions
        | {
            (action, "dearer"): [(p, s, cost + 1) for p, s, cost in outcomes]
            for action, outcomes in actions.items()
        }
        for state, actions in drawn.choices.items()
    }
    check_same(drawn, Draw(choices, drawn.goals, drawn.start), place, discount, give_up)


@drawn_settings
@given(problems(most_live=3), budgets, discounts, meanings)
def test_split_outcomes_and_states_that_nobody_visits(drawn, place, discount, give_up):
    """Outcomes in two halves, a second dead-end and a second live state off every path."""
    changed = with_outcomes(
        drawn, lambda outcomes: [(p / 2, s, cost) for p, s, cost in outcomes for _ in range(2)]
    )
    far = {"far": {"back": [(1.0, "a", 1)], "end": [(1.0, "grave", 0)]}, "grave": {}}
    extended = Draw(changed.choices | far, drawn.goals, drawn.start)
    check_same(drawn, extended, place, discount, give_up)


@drawn_settings
@given(problems(most_live=3), discounts, meanings)
def test_a_larger_budget_costs_no_more(drawn, discount, give_up):
    """The optimum falls with the budget, and case M is convex in it."""
    points = mcmp.points(plain(drawn), drawn.start, give_up=give_up, discount=discount)
    grid = [budget_of(share, points) for share in (0.0, 0.25, 0.5, 0.75)]
    rows = [answers(drawn, budget, discount, give_up) for budget in grid]
    for case in (0, 1):
        column = [value for kind, value in (row[case] for row in rows) if kind == "optimum"]
        room = 1e-7 * (1 + max(column, default=0.0))
        assert all(a >= b - room for a, b in pairwise(column))
        if case == 0 and len(column) == 4:
            assert column[1] <= (column[0] + column[2]) / 2 + room
            assert column[2] <= (column[1] + column[3]) / 2 + room
