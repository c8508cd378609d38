"""Building models: three builders that agree, and errors that name the place."""

from fractions import Fraction

import numpy as np
import pytest

from formulations import MCMP, S3P
from ssp_lp import SSP, ModelError, solve

CHAIN = {
    0: {"on": [(0.5, 1, 1.0), (0.5, 0, 2.0)]},
    1: {"on": [(0.5, 2, 1.0), (0.25, 2, 3.0), (0.25, 3, 0.0)], "back": [(1.0, 0, 0.5)]},
    3: {},
}


def from_transitions():
    return SSP.from_transitions(CHAIN, goal={2}, treat_actionless_as_dead_ends=True)


def from_successors():
    return SSP.from_successors(0, lambda s: CHAIN[s], goal={2}, treat_actionless_as_dead_ends=True)


def from_arrays():
    return SSP.from_arrays(
        pair_offsets=[0, 1, 3, 3, 3],
        outcome_offsets=[0, 2, 5, 6],
        successors=[1, 0, 2, 2, 3, 0],
        probabilities=[0.5, 0.5, 0.5, 0.25, 0.25, 1.0],
        costs=[1.0, 2.0, 1.0, 3.0, 0.0, 0.5],
        goal_states=[2],
        treat_actionless_as_dead_ends=True,
    )


@pytest.mark.parametrize("build", [from_transitions, from_successors, from_arrays])
def test_the_builders_agree(build):
    model = build()
    assert (model.n_states, model.n_pairs, model.n_outcomes) == (4, 3, 6)
    # x = 1.5 + x / 2 + y / 2 and y = 1.25, failing with a quarter
    assert solve(MCMP(model, start=0)).objective == pytest.approx(4.25)
    assert solve(S3P(model, start=0)).objective == pytest.approx(3.0 + 5.0 / 3.0)


def test_costs_per_pair_and_in_common():
    parts = {
        "pair_offsets": [0, 1, 2, 2],
        "outcome_offsets": [0, 1, 2],
        "successors": [1, 2],
        "probabilities": [1.0, 1.0],
        "goal_states": [2],
    }
    assert SSP.from_arrays(costs=2.0, **parts).costs.tolist() == [2.0, 2.0]
    assert SSP.from_arrays(costs=[1.0, 3.0], **parts).costs.tolist() == [1.0, 3.0]
    with pytest.raises(ModelError, match="costs must be"):
        SSP.from_arrays(costs=[1.0, 2.0, 3.0], **parts)


def test_arrays_are_read_only():
    model = from_arrays()
    for array in (model.probabilities, model.costs, model.successors, model.pair_offsets):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


@pytest.mark.parametrize(
    ("outcomes", "complaint"),
    [
        ([(0.5, "g", 1.0)], "sum to 0.5"),
        ([(-0.5, "g", 1.0), (1.5, "g", 1.0)], "negative probability"),
        ([(float("nan"), "g", 1.0)], "NaN"),
        ([(1.0, "g", -1.0)], "negative cost"),
        ([(1.0, "g", float("inf"))], "infinite cost"),
        ([(1.0, "g", float("nan"))], "cost that is NaN"),
        ([(1.0, "elsewhere", 1.0)], "'elsewhere'"),
        ([(1.0, "g")], "triple"),
        ([(1.0, "g", "free")], "no number"),
        ([("0.5", "g", 1.0), (0.5, "x", 1.0)], "has a probability that is no number: '0.5'"),
        ([], "no outcomes"),
    ],
)
def test_errors_name_state_and_action(outcomes, complaint):
    with pytest.raises(ModelError, match=complaint) as caught:
        SSP.from_transitions({"s": {"go": outcomes}}, goal={"g"})
    assert "'go'" in str(caught.value)
    assert "'s'" in str(caught.value)


def test_errors_about_states():
    with pytest.raises(ModelError, match="treat_actionless_as_dead_ends"):
        SSP.from_transitions({"s": {"go": [(1.0, "g", 1.0)]}, "d": {}}, goal={"g"})
    with pytest.raises(ModelError, match="no goal"):
        SSP.from_transitions({"s": {"go": [(1.0, "s", 1.0)]}}, goal=())
    with pytest.raises(ModelError, match="not a state"):
        SSP.from_transitions(
            {"s": {"go": [(1.0, "g", 1.0)]}}, goal={"g"}, state_labels={"wall": ["w"]}
        )


def test_exploration_stops_at_the_limit_and_reports_progress():
    seen = []
    model = SSP.from_successors(
        0, lambda s: {"on": [(1.0, s + 1, 1.0)]}, lambda s: s == 50, progress=seen.append
    )
    assert model.n_states == 51
    assert seen[-1] == 51
    with pytest.raises(ModelError, match="state_limit=20"):
        SSP.from_successors(
            0, lambda s: {"on": [(1.0, s + 1, 1.0)]}, lambda s: s == 50, state_limit=20
        )


def test_actions_at_a_goal_are_left_out():
    model = SSP.from_transitions(
        {"s": {"go": [(1.0, "g", 1.0)]}, "g": {"on": [(1.0, "s", 5.0)]}}, goal={"g"}
    )
    assert model.n_pairs == 1
    assert solve(MCMP(model, start="s")).objective == 1.0


def test_the_lattice_of_costs_is_exact():
    """Costs 1/3 and 1/7 as fractions have the unit 1/21; 0.1 and 0.3 as floats 1/10."""
    third, seventh = Fraction(1, 3), Fraction(1, 7)
    for costs, layers in (((third, seventh), (7, 3)), ((0.1, 0.3), (1, 3))):
        model = SSP.from_transitions(
            {
                "s": {"go": [(1.0, "t", costs[0])]},
                "t": {"go": [(0.5, "g", costs[1]), (0.5, "t", costs[1])]},
            },
            goal={"g"},
        )
        base = S3P(model, start="s", failure_budget=0.5).compile()
        unit = base.base.unit
        assert float(costs[0]) / unit == pytest.approx(layers[0])
        assert float(costs[1]) / unit == pytest.approx(layers[1])
        solution = solve(S3P(model, start="s", failure_budget=0.5))
        # nobody can fail here; two tries on average
        assert solution.objective == pytest.approx(float(costs[0] + 2 * costs[1]))


def test_outcomes_of_probability_zero_do_not_exist():
    model = SSP.from_transitions(
        {"s": {"go": [(1.0, "d", 1.0), (0.0, "g", 1.0)], "out": [(1.0, "g", 4.0)]}, "d": {}},
        goal={"g"},
        treat_actionless_as_dead_ends=True,
    )
    assert solve(MCMP(model, start="s", failure_budget=0.0)).objective == pytest.approx(4.0)
    assert not np.isnan(solve(S3P(model, start="s", failure_budget=0.3)).objective)


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"goal": "goal"}, "set of states"),
        ({"state_labels": {"wall": "wall"}}, "not a string"),
        ({"state_labels": {"gave_up": ["s"]}}, "taken"),
    ],
)
def test_names_that_would_be_misread(changed, complaint):
    parts = {"transitions": {"s": {"go": [(1.0, "goal", 1.0)]}}, "goal": {"goal"}}
    with pytest.raises(ModelError, match=complaint):
        SSP.from_transitions(**(parts | changed))


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"goal_states": [False, True]}, "no mask"),
        ({"goal_states": [5]}, "indices of states"),
        ({"states": ["a", "a"]}, "several states"),
        ({"actions": ["x", "x"]}, "twice"),
        ({"successors": [0.5, 1.0]}, "integers"),
        ({"successors": [0, 7]}, "no state"),
        ({"pair_offsets": [0, 1, 1]}, "run from 0"),
    ],
)
def test_arrays_that_do_not_fit(changed, complaint):
    parts = {
        "pair_offsets": [0, 2, 2],
        "outcome_offsets": [0, 1, 2],
        "successors": [0, 1],
        "probabilities": [1.0, 1.0],
        "costs": 1.0,
        "goal_states": [1],
    }
    assert SSP.from_arrays(**parts).n_pairs == 2
    with pytest.raises(ModelError, match=complaint):
        SSP.from_arrays(**(parts | changed))
