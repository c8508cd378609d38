"""Building models: three builders that agree, large arrays, and errors that name the place."""

from fractions import Fraction

import numpy as np
import pytest

from formulations import MCMP, S3P
from refusing import refused
from small_models import model_of
from ssp_lp import SSP, ModelError, solve
from ssp_lp.arrays import segment_chunks
from ssp_lp.io import from_matrices

CHAIN = {
    0: {"on": [(0.5, 1, 1.0), (0.5, 0, 2.0)]},
    1: {"on": [(0.5, 2, 1.0), (0.25, 2, 3.0), (0.25, 3, 0.0)], "back": [(1.0, 0, 0.5)]},
    3: {},
}
IN_ARRAYS = {
    "pair_offsets": [0, 1, 3, 3, 3],
    "outcome_offsets": [0, 2, 5, 6],
    "successors": [1, 0, 2, 2, 3, 0],
    "probabilities": [0.5, 0.5, 0.5, 0.25, 0.25, 1.0],
    "costs": [1.0, 2.0, 1.0, 3.0, 0.0, 0.5],
}
END = {"treat_actionless_as_dead_ends": True}


@pytest.mark.parametrize(
    "model",
    [
        SSP.from_transitions(CHAIN, goal={2}, **END),
        SSP.from_successors(0, CHAIN.__getitem__, goal={2}, **END),
        SSP.from_arrays(**IN_ARRAYS, goal_states=[2], **END),
    ],
    ids=["transitions", "successors", "arrays"],
)
def test_the_builders_agree(model):
    assert (model.n_states, model.n_pairs, model.n_outcomes) == (4, 3, 6)
    # x = 1.5 + x / 2 + y / 2 and y = 1.25, failing with a quarter
    assert solve(MCMP(model, start=0)).objective == pytest.approx(4.25)
    assert solve(S3P(model, start=0)).objective == pytest.approx(3.0 + 5.0 / 3.0)
    for name in IN_ARRAYS:
        with pytest.raises(ValueError, match="read-only"):
            getattr(model, name)[0] = 1


@pytest.mark.parametrize(
    ("outcomes", "complaint"),
    [
        ([(0.5, "g", 1.0)], "sum to 0.5"),
        ([(-0.5, "g", 1.0), (1.5, "g", 1.0)], "negative probability"),
        ([(float("nan"), "g", 1.0)], "NaN"),
        ([(1.0, "g", -1.0)], "negative cost"),
        ([(1.0, "g", float("inf"))], "infinite cost"),
        ([(1.0, "g", 2e150)], "has a cost above 1e[+]150: rescale"),
        ([(1.0, "g", float("nan"))], "cost that is NaN"),
        ([(1.0, "elsewhere", 1.0)], "'elsewhere'"),
        ([(1.0, "g")], "triple"),
        ([(1.0, "g", "free")], "not a number"),
        ([("0.5", "g", 1.0), (0.5, "x", 1.0)], "has a probability that is not a number: '0.5'"),
        ([], "no outcomes"),
    ],
)
def test_errors_name_state_and_action(outcomes, complaint):
    text = refused(complaint, SSP.from_transitions, {"s": {"go": outcomes}}, goal={"g"})
    assert "'go'" in text
    assert "'s'" in text


GO = {"s": {"go": [(1.0, "g", 1.0)]}}


@pytest.mark.parametrize(
    ("choices", "options", "complaint"),
    [
        (GO | {"d": {}}, {}, "list all dead-ends, dead_ends="),
        ({"s": {"go": [(1.0, "s", 1.0)]}}, {"goal": ()}, "no goal"),
        (GO, {"state_labels": {"wall": ["w"]}}, "not a state"),
        (GO, {"goal": "g"}, "set of states"),
        (GO, {"state_labels": {"wall": "wall"}}, "not a string"),
        (GO, {"state_labels": {"gave_up": ["s"]}}, "reserved"),
    ],
)
def test_errors_about_states_and_names(choices, options, complaint):
    refused(complaint, SSP.from_transitions, choices, **({"goal": {"g"}} | options))


def test_exploration_stops_at_the_limit_and_reports_progress():
    seen = []
    line = (0, lambda s: {"on": [(1.0, s + 1, 1.0)]}, lambda s: s == 50)
    assert SSP.from_successors(*line, progress=seen.append).n_states == seen[-1] == 51
    refused("state_limit=20", SSP.from_successors, *line, state_limit=20)


def test_actions_at_a_goal_and_outcomes_of_probability_zero_do_not_exist():
    model = model_of(GO | {"g": {"on": [(1.0, "s", 5.0)]}})
    assert model.n_pairs == 1
    assert solve(MCMP(model, start="s")).objective == 1.0
    go, out = [(1.0, "d", 1.0), (0.0, "g", 1.0)], [(1.0, "g", 4.0)]
    model = model_of({"s": {"go": go, "out": out}, "d": {}})
    assert solve(MCMP(model, start="s", failure_budget=0.0)).objective == pytest.approx(4.0)
    assert not np.isnan(solve(S3P(model, start="s", failure_budget=0.3)).objective)


@pytest.mark.parametrize(
    ("first", "second", "layers"),
    [(Fraction(1, 3), Fraction(1, 7), (7, 3)), (0.1, 0.3, (1, 3))],
)
def test_the_lattice_of_costs_is_exact(first, second, layers):
    """Costs 1/3 and 1/7 as fractions have the unit 1/21; 0.1 and 0.3 as floats 1/10."""
    tries = [(0.5, "g", second), (0.5, "t", second)]
    model = model_of({"s": {"go": [(1.0, "t", first)]}, "t": {"go": tries}})
    problem = S3P(model, start="s", failure_budget=0.5)
    unit = problem.compile().layer.base.unit
    assert (float(first) / unit, float(second) / unit) == pytest.approx(layers)
    # nobody can fail here; two tries on average
    assert solve(problem).objective == pytest.approx(float(first + 2 * second))


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"goal_states": [False, True]}, "not a mask"),
        ({"goal_states": [5]}, "indices of states"),
        ({"states": ["a", "a"]}, "several states"),
        ({"actions": ["x", "x"]}, "twice"),
        ({"successors": [0.5, 1.0]}, "integers"),
        ({"successors": [0, 7]}, "not a state"),
        ({"pair_offsets": [0, 1, 1]}, "run from 0"),
        ({"costs": [1.0, 2.0, 3.0]}, "costs must be"),
    ],
)
def test_arrays_that_do_not_fit(changed, complaint):
    parts = {"pair_offsets": [0, 2, 2], "outcome_offsets": [0, 1, 2], "successors": [0, 1]}
    parts |= {"probabilities": [1.0, 1.0], "costs": 1.0, "goal_states": [1]}
    assert SSP.from_arrays(**parts).costs.tolist() == [1.0, 1.0]
    assert SSP.from_arrays(**(parts | {"costs": [1.0, 3.0]})).costs.tolist() == [1.0, 3.0]
    refused(complaint, SSP.from_arrays, **(parts | changed))


@pytest.fixture(params=[1 << 22, 4, 1])
def chunk(request, monkeypatch):
    """How many entries are worked on at a time."""
    monkeypatch.setattr("ssp_lp.arrays.CHUNK", request.param)
    return request.param


def parts(n_pairs=6, spread=3):
    """Arrays of a model in which every state has one pair with equally likely outcomes."""
    n_outcomes = n_pairs * spread
    return {
        "pair_offsets": np.append(np.arange(n_pairs + 1), n_pairs),
        "outcome_offsets": np.arange(0, n_outcomes + 1, spread),
        "successors": np.arange(n_outcomes, dtype=np.int32) % (n_pairs + 1),
        "probabilities": np.full(n_outcomes, 1 / spread),
        "costs": np.arange(n_outcomes, dtype=np.float64),
        "goal_states": [n_pairs],
    }


def test_arrays_of_the_right_type_are_kept(chunk):
    given = parts(spread=4)
    model = SSP.from_arrays(**given)
    for name in ("pair_offsets", "outcome_offsets", "successors", "probabilities", "costs"):
        assert np.shares_memory(getattr(model, name), given[name]), name
        assert given[name].flags.writeable, name


def test_one_cost_for_all_takes_no_room(chunk):
    model = SSP.from_arrays(**(parts() | {"costs": 2.5}))
    assert model.costs.strides == (0,)
    assert model.costs.tolist() == [2.5] * model.n_outcomes
    for cost, complaint in [(-1.0, "negative cost"), (np.nan, "NaN"), (np.inf, "infinite cost")]:
        words = f"action 0 of state 0 .*{complaint}"
        refused(words, SSP.from_arrays, **(parts() | {"costs": cost}))


def test_sums_that_round_are_divided_out_of_a_copy(chunk):
    given = parts(spread=3)
    given["probabilities"][3:6] = 0.1, 0.2, 0.7 + 1e-12
    before = given["probabilities"].copy()
    model = SSP.from_arrays(**given)
    assert given["probabilities"].tolist() == before.tolist()
    sums = [np.add.reduce(before[k : k + 3]) for k in range(0, 18, 3)]
    assert model.probabilities.tolist() == (before / np.repeat(sums, 3)).tolist()


def test_actions_are_numbered_within_their_state(chunk):
    given = parts()
    given["pair_offsets"] = np.array([0, 2, 2, 5, 6, 6, 6, 6])
    model = SSP.from_arrays(**given, treat_actionless_as_dead_ends=True)
    assert [model.action_of(pair) for pair in range(6)] == [0, 1, 0, 1, 2, 0]
    assert list(model.action_names) == [0, 1, 2]


@pytest.mark.parametrize(
    ("name", "faults", "complaint"),
    [
        ("successors", {10: 7, 13: -1}, "state 3 has a successor that is not a state"),
        ("probabilities", {4: -0.5, 11: np.nan}, "state 3 has a probability that is NaN"),
        ("probabilities", {4: np.inf, 11: -0.5}, "state 3 has a negative probability"),
        ("probabilities", {16: np.inf}, "state 5 has an infinite probability"),
        ("probabilities", {9: 0.5, 16: 0.5}, "state 3: probabilities sum to 1.16666666667"),
        ("costs", {4: -0.5, 11: np.nan}, "state 3 has a cost that is NaN"),
        ("costs", {4: np.inf, 11: -0.5, 14: -1.0}, "state 3 has a negative cost"),
        ("costs", {2: np.inf, 11: np.inf}, "state 0 has an infinite cost"),
    ],
)
def test_rules_are_checked_in_turn_and_name_the_first_outcome(chunk, name, faults, complaint):
    given = parts()
    given[name][list(faults)] = list(faults.values())
    refused(complaint, SSP.from_arrays, **given)


def test_offsets_that_fall_and_pairs_without_outcomes(chunk):
    given = parts()
    given["outcome_offsets"][2:4] = 9, 6
    refused("outcome_offsets decreases at position 2", SSP.from_arrays, **given)
    given["outcome_offsets"][3] = 9
    refused("state 2 has no outcomes", SSP.from_arrays, **given)


def test_pieces_cover_every_segment_once(chunk):
    offsets = np.array([0, 0, 3, 3, 4, 11, 11], dtype=np.int32)
    found = list(segment_chunks(offsets))
    assert [k for some in found for k in range(some.start, some.stop)] == list(range(6))
    for some in found:
        assert offsets[some.stop] - offsets[some.start] <= chunk or some.stop - some.start == 1


def test_state_labels_are_given_alike_in_every_builder():
    """By members, or by what holds of just them; names may be added to any model."""
    chain = {0: {"go": [(0.9, 1, 1.0), (0.1, 2, 1.0)]}, 1: {"go": [(1.0, 3, 1.0)]}}
    low = {"low": [0, 1]}, {"low": lambda s: s < 2}
    table = {
        "state": [0, 0, 1], "action": ["go"] * 3, "successor": [1, 2, 3],
        "probability": [0.9, 0.1, 1.0], "cost": [1.0] * 3,
    }  # fmt: skip
    arrays = {
        "pair_offsets": [0, 1, 2, 2, 2], "outcome_offsets": [0, 2, 3], "successors": [1, 2, 3],
        "probabilities": [0.9, 0.1, 1.0], "costs": 1.0, "goal_states": [3],
    }  # fmt: skip
    step = np.zeros((1, 4, 4))
    step[0, [0, 0, 1], [1, 2, 3]] = 0.9, 0.1, 1.0
    lax = {"treat_actionless_as_dead_ends": True}
    for labels in low:
        models = [
            SSP.from_transitions(chain, {3}, state_labels=labels, **lax),
            SSP.from_successors(0, lambda s: chain.get(s, {}), {3}, state_labels=labels, **lax),
            SSP.from_frame(table, {3}, state_labels=labels),
            SSP.from_arrays(**arrays, state_labels=labels, **lax),
            from_matrices(step, {3}, costs=np.ones(4), state_labels=labels),
            SSP.from_transitions(chain, {3}, **lax).with_labels(labels),
        ]
        for model in models:
            assert {model.states[k] for k in model.state_labels["low"]} == {0, 1}
            both = model.with_labels({"high": [3]})
            assert {*both.state_labels} == {"low", "high"}
    with pytest.raises(ModelError, match="not a state"):
        models[0].with_labels({"low": [7]})
