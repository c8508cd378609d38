"""A goal out of reach is called that by every criterion, whether or not it has an answer then."""

import pytest

from formulations import (
    EGUBS,
    GUBS,
    ISSPUDE,
    MCMP,
    S3P,
    AlphaMCMP,
    CostBoundedReach,
    CostQuantile,
    CVaR,
    FinitePenalty,
    MaxProb,
    MinCost,
    MinProb,
)
from ssp_lp import SSP, InfeasibleError, expected_cost, goal_probability, solve

LOST = SSP.from_transitions(
    {
        "a": {"go": [(1.0, "b", 1.0)], "leap": [(0.5, "a", 1.0), (0.5, "pit", 2.0)]},
        "b": {"back": [(1.0, "a", 1.0)]},
        "far": {"step": [(1.0, "G", 1.0)]},
        "pit": {},
    },
    goal={"G"},
    treat_actionless_as_dead_ends=True,
)
WORDS = "the goal cannot be reached from 'a'"
LIMITED = {"constraints": {"cost": expected_cost() <= 2.0}}

WITHOUT_ANSWER = [
    (MinCost, ()),
    (MCMP, (0.5,)),
    (MCMP, (0.5, 0.9)),
    (S3P, ()),
    (S3P, (1.0,)),
    (S3P, (0.5, 0.9)),
    (ISSPUDE, ()),
    (CVaR, (0.5,)),
    (CVaR, (0.5, 1.0)),
    (CostQuantile, (0.5,)),
]
ANSWERED = [
    (MaxProb, (), 0.0),
    (MinProb, (), 0.0),
    (MCMP, (), 1.0),
    (MCMP, (1.0,), 1.0),
    (AlphaMCMP, (0.5,), 0.0),
    (FinitePenalty, (5.0,), 5.0),
    (EGUBS, (-0.1, 1.0), 0.0),
    (GUBS, (lambda cost: 1.0 / (1.0 + cost), 1.0), 0.0),
    (CostBoundedReach, (5.0,), 0.0),
]


@pytest.mark.parametrize("limits", [{}, LIMITED, {"horizon": 3}])
@pytest.mark.parametrize(("criterion", "asked"), WITHOUT_ANSWER)
def test_where_no_answer_exists_the_error_says_why(criterion, asked, limits):
    with pytest.raises(InfeasibleError, match=WORDS) as caught:
        solve(criterion(LOST, "a", *asked, **limits))
    assert caught.value.least_failure == 1.0


@pytest.mark.parametrize("limits", [{}, LIMITED, {"horizon": 3}])
@pytest.mark.parametrize(("criterion", "asked", "value"), ANSWERED)
def test_where_an_answer_exists_its_note_says_so(criterion, asked, value, limits):
    solution = solve(criterion(LOST, "a", *asked, **limits))
    assert solution.objective == value
    assert WORDS in solution.note
    assert WORDS in solution.summary()


@pytest.mark.parametrize("method", ["columns", "lp", "game", "deterministic"])
@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_every_method_says_so(criterion, method):
    with pytest.raises(InfeasibleError, match=WORDS):
        solve(criterion(LOST, "a", failure_budget=0.5, discount=0.9), method)


def test_several_beginnings_and_a_limit_on_the_goal_itself():
    both = {"a": 0.5, "b": 0.5}
    assert f"{WORDS} or 'b'" in solve(MCMP(LOST, both)).note
    with pytest.raises(InfeasibleError, match=WORDS):
        solve(MaxProb(LOST, "a", constraints={"goal": goal_probability() >= 0.5}))
    assert "cannot be reached" not in solve(MCMP(LOST, {"a": 0.5, "far": 0.5})).note
