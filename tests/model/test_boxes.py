"""Models from counts, boxes around their probabilities, and draws of their posterior."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.stats import binom

from ssp_lp import SSP, Boxes, ModelError, posterior_draws
from ssp_lp.arrays import segment_sums
from ssp_lp.model.boxes import greatest_mean

ROWS = [
    ("a", "go", "home", 80, 1.0),
    ("a", "go", "pit", 0, 1.0),
    ("a", "go", "a", 20, 2.0),
    ("a", "wait", "a", 7, 0.5),
    ("a", "go", "home", 100, 1.0),
]


def test_probabilities_are_shares_and_rows_of_one_outcome_are_added_up():
    model = SSP.from_counts(ROWS, goal={"home"}, dead_ends={"pit"})
    assert model.counts.tolist() == [180.0, 0.0, 20.0, 7.0]
    assert model.probabilities.tolist() == [0.9, 0.0, 0.1, 1.0]
    assert [model.states[k] for k in model.successors] == ["home", "pit", "a", "a"]


def test_rows_and_columns_are_the_same_table_and_goals_have_no_rows():
    names = ("state", "action", "successor", "count", "cost")
    rows = [("home", "stay", "home", 3, 0.0), *ROWS]
    table = dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))
    model = SSP.from_counts(table, goal={"home"})
    again = SSP.from_counts(rows, goal={"home"})
    assert model.counts.tolist() == again.counts.tolist() == [180.0, 0.0, 20.0, 7.0]
    by_name = table | {"fuel": [1.0] * len(rows)}
    two = SSP.from_counts(by_name, goal={"home"}, cost=["cost", "fuel"])
    assert [*two.named_costs] == ["cost", "fuel"]
    assert two.counts.tolist() == model.counts.tolist()


@pytest.mark.parametrize("name", ["counts", "probability", "state", "action", "successor"])
def test_costs_are_those_of_the_column_whatever_its_name(name):
    places = {"from": ["a", "a"], "by": ["go", "go"], "to": ["home", "a"], "count": [3, 1]}
    columns = {"state": "from", "action": "by", "successor": "to"}
    table = places | {name: [7, 5], "fuel": [1, 2]}
    model = SSP.from_counts(table, {"home"}, cost=name, **columns)
    both = SSP.from_counts(table, {"home"}, cost=["fuel", name], **columns)
    assert model.costs.tolist() == both.named_costs[name].tolist() == [7.0, 5.0]
    assert not model.named_costs
    assert both.costs.tolist() == [1.0, 2.0]
    assert model.counts.tolist() == both.counts.tolist() == [3.0, 1.0]


def test_rows_in_turns_keep_their_counts_and_rows_at_a_goal_are_left_out():
    rows = [("home", "stay", "home", 0, 0.0), ("b", "go", "home", 2, 1.0), *ROWS,
            ("b", "go", "a", np.int64(6), np.float64(3.0))]  # fmt: skip
    model = SSP.from_counts(rows, goal={"home"})
    assert [*model.states] == ["home", "b", "a", "pit"]
    assert model.counts.tolist() == [2.0, 6.0, 180.0, 0.0, 20.0, 7.0]
    assert model.probabilities.tolist() == [0.25, 0.75, 0.9, 0.0, 0.1, 1.0]
    assert model.costs.tolist() == [1.0, 3.0, 1.0, 1.0, 2.0, 0.5]


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([("a", "go", "home", 1.5, 1.0)], "the count 1.5 is not a whole number >= 0"),
        ([("a", "go", "home", -1, 1.0)], "the count -1 is not a whole number >= 0"),
        ([("a", "go", "home", 0, 1.0)], "no counts"),
        ([("a", "go", "home", 1)], "row .*'home', 1"),
        ([("a", "go", "home", "90", 1.0)], "'90', 1.0.*count, cost.*the count '90' is not a whole"),
        ([("a", "go", "home", True, 1.0)], "the count True is not a whole number"),
        ([ROWS[0], {"state": "a"}], "row 1 of the table must be .state, action.* not .'state'"),
        ([("a", "go", ["home"], 1, 1.0)], "row 0, column 'successor'"),
        ([1, 2], "row 0 of the table must be .state, .* not 1"),
        ([], "the table has no rows"),
        (np.array([[1, 1, 2, 3, 1]]), "columns by name"),
        (3, "columns by name"),
        ({"state": "a", "action": "b", "successor": "c", "count": [1, 2], "cost": [1]}, "lengths"),
    ],
)
def test_wrong_tables_are_named(rows, words):
    with pytest.raises(ModelError, match=words):
        SSP.from_counts(rows, goal={"home"})


def test_intervals_are_those_of_clopper_and_pearson():
    model = SSP.from_counts(ROWS, goal={"home"})
    boxes = Boxes.from_counts(model, confidence=0.9)
    error = 0.1 / 6  # three intervals, two sides; the sure pair needs none
    low, high, n = boxes.low, boxes.high, 200
    for k, seen in ((0, 180), (2, 20)):
        assert binom.sf(seen - 1, n, low[k]) == pytest.approx(error, rel=1e-9)
        assert binom.cdf(seen, n, high[k]) == pytest.approx(error, rel=1e-9)
    assert low[1] == 0.0
    assert (1.0 - high[1]) ** n == pytest.approx(error, rel=1e-9)
    assert (low[3], high[3]) == (1.0, 1.0)


def test_a_pair_of_two_successors_needs_one_interval():
    model = SSP.from_counts([("a", "go", "b", 30, 1.0), ("a", "go", "a", 70, 1.0)], goal={"b"})
    boxes = Boxes.from_counts(model, confidence=0.95)
    assert binom.sf(29, 100, boxes.low[0]) == pytest.approx(0.025, rel=1e-9)
    assert boxes.low[0] + boxes.high[1] == pytest.approx(1.0, abs=1e-12)


def test_boxes_hold_the_truth_as_often_as_they_say():
    rng, truth, trials = np.random.default_rng(1), np.array([0.6, 0.35, 0.05]), 400
    held = 0
    for seen in rng.multinomial(50, truth, size=trials):
        rows = [("a", "go", to, int(n), 1.0) for to, n in zip("bca", seen, strict=True)]
        boxes = Boxes.from_counts(SSP.from_counts(rows, goal={"b"}), confidence=0.8)
        held += bool(((boxes.low <= truth) & (truth <= boxes.high)).all())
    assert held >= trials * 0.8 - 3 * np.sqrt(trials * 0.16)


def test_draws_have_the_mean_and_spread_of_the_posterior():
    model = SSP.from_counts(ROWS, goal={"home"})
    drawn = np.array([m.probabilities for m in posterior_draws(model, 4000, seed=3)])
    shape = np.array([181.0, 1.0, 21.0])
    mean = shape / shape.sum()
    spread = np.sqrt(mean * (1.0 - mean) / (shape.sum() + 1.0))
    assert (np.abs(drawn[:, :3].mean(axis=0) - mean) <= 4.0 * spread / np.sqrt(4000)).all()
    assert drawn[:, :3].std(axis=0) == pytest.approx(spread, rel=0.1)
    assert (drawn[:, 3] == 1.0).all()
    again = posterior_draws(model, 2, seed=np.random.default_rng(3))
    assert (
        again[1].probabilities.tolist()
        == posterior_draws(model, 2, seed=3)[1].probabilities.tolist()
    )


def test_the_greatest_mean_is_that_of_a_linear_program():
    rng = np.random.default_rng(5)
    lengths = rng.integers(1, 6, size=40)
    offsets = np.append(0, np.cumsum(lengths))
    inside = np.concatenate([rng.dirichlet(np.ones(n)) for n in lengths])
    low = inside * rng.uniform(0.0, 1.0, inside.size)
    high = np.minimum(inside + rng.uniform(0.0, 0.5, inside.size), 1.0)
    worth = rng.integers(-3, 4, inside.size).astype(float)  # ties
    chosen = greatest_mean(low, high, worth, offsets)
    assert (low - 1e-15 <= chosen).all()
    assert (chosen <= high + 1e-15).all()
    assert segment_sums(chosen, offsets) == pytest.approx(1.0)
    for begin, end in pairwise(offsets):
        part = slice(begin, end)
        sides = np.stack([low[part], high[part]], axis=1)
        best = linprog(-worth[part], A_eq=np.ones((1, end - begin)), b_eq=[1.0], bounds=sides)
        assert chosen[part] @ worth[part] == pytest.approx(-best.fun, abs=1e-9)


def test_boxes_are_narrowed_to_what_distributions_have_and_checked():
    model = SSP.from_counts(ROWS, goal={"home"})
    boxes = Boxes(model, low=[0.5, 0.0, 0.1, 1.0], high=[1.0, 0.9, 0.2, 1.0])
    assert boxes.high.tolist() == pytest.approx([0.9, 0.4, 0.2, 1.0])
    for low, high in (([0.9, 0.1, 0.1, 1.0], [1.0] * 4), ([0.0] * 4, [0.3, 0.3, 0.3, 1.0])):
        with pytest.raises(ModelError, match="action 'go' of state 'a'"):
            Boxes(model, low=low, high=high)
    with pytest.raises(ModelError, match="each of 4 outcomes"):
        Boxes(model, low=[0.0], high=[1.0])
    with pytest.raises(ModelError, match="low must be an array, not 'ab'"):
        Boxes(model, "ab", "cd")
    with pytest.raises(ModelError, match="confidence must lie strictly between 0 and 1, not 'x'"):
        Boxes(model, low=[0.0] * 4, high=[1.0] * 4, confidence="x")
    with pytest.raises(ModelError, match=r"not 95; did you mean 0\.95\?"):
        Boxes(model, low=[0.0] * 4, high=[1.0] * 4, confidence=95)
    with pytest.raises(ModelError, match=r"not 95; did you mean 0\.95\?"):
        Boxes.from_counts(model, confidence=95)
    with pytest.raises(ModelError, match="model must be an SSP, not 3"):
        Boxes(3, [0], [1])
    plain = SSP.from_transitions({"a": {"go": [(1.0, "b", 1.0)]}}, goal={"b"})
    with pytest.raises(ModelError, match="from_counts"):
        Boxes.from_counts(plain)


def test_the_report_says_what_was_never_seen_and_where_counts_are_few():
    text = str(Boxes.from_counts(SSP.from_counts(ROWS, goal={"home"})))
    assert "successors never seen: 1" in text
    assert "pairs of fewer than 1,000 counts: 1" in text
