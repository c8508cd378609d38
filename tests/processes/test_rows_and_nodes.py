"""Rows of limits say what was asked, and a quotient can be taken apart again."""

import numpy as np
import pytest

from formulations import MCMP
from small_models import FREE_PAIR, TWO_MOVES, model_of
from ssp_lp import failure_probability, goal_probability, solve
from ssp_lp.processes.goal_reach import cheapest_reach, greatest_goal_reach
from ssp_lp.processes.live_rows import costless_pairs
from ssp_lp.processes.quotient import build_quotient

MOVES = model_of(TWO_MOVES)


def rows_of(limit):
    """The upper rows of a limit, on TWO_MOVES."""
    (condition,) = MCMP(MOVES, "x", constraints={"one": limit}).conditions
    return condition.rows


def taken(row, goal):
    """What a row takes of a policy that reaches the goal with this probability."""
    parts = [w * (1.0 - goal if term.others else goal) for w, term in row.terms]
    assert all(weight >= 0.0 for weight, _ in row.terms)
    return sum(parts) + row.constant


@pytest.mark.parametrize("sense", ["<=", ">=", "=="])
@pytest.mark.parametrize("weights", [(1.0, 0.0), (0.0, 1.0), (2.0, -0.5), (-1.0, 0.25), (0.3, 3.0)])
@pytest.mark.parametrize("constant", [0.0, 0.5, -2.0])
def test_a_row_is_kept_where_its_limit_is(sense, weights, constant):
    """Weights of both signs and constants: complements take their place, the bound with them."""
    a, b = weights
    quantity = a * goal_probability() + b * failure_probability() + constant
    for bound in (-1.5, 0.0, 0.25, 0.7):
        limit = quantity <= bound if sense == "<=" else quantity >= bound
        limit = quantity == bound if sense == "==" else limit
        rows = rows_of(limit)
        assert len(rows) == (2 if sense == "==" else 1)
        for goal in np.linspace(0.0, 1.0, 23):
            value = a * goal + b * (1.0 - goal) + constant
            if abs(value - bound) > 1e-9:
                kept = {"<=": value < bound, ">=": value > bound, "==": False}[sense]
                assert all(taken(row, goal) <= row.bound for row in rows) == kept
            assert any(
                taken(row, goal) - row.bound == pytest.approx(row.sign * (value - bound), abs=1e-9)
                for row in rows
            )


def test_the_rounding_of_a_complement_forbids_nothing():
    """0.3 times the goal is to be 0.1 + 0.2, which a float has as a little more than 0.3."""
    (row,) = rows_of(0.3 * goal_probability() >= 0.1 + 0.2)
    assert row.bound == 0.0
    sure = MCMP(MOVES, "x", constraints={"sure": 0.3 * goal_probability() >= 0.1 + 0.2})
    assert solve(sure).goal_probability == 1.0
    (row,) = rows_of(goal_probability() >= 1.1)
    assert row.bound == pytest.approx(-0.1)


def test_a_quotient_is_split_into_the_states_again():
    """States that turn into each other for free are one node, then each one with all its pairs."""
    model = model_of(FREE_PAIR)
    whole = build_quotient(model, free=costless_pairs(model))
    assert whole.n_nodes == 1
    apart = whole.split()
    live = np.flatnonzero(apart.node_of >= 0)
    assert [model.states[k] for k in live] == ["x", "y"]
    assert apart.node_of[live].tolist() == [0, 1]
    assert not apart.merged.any()
    acting = apart.pair_at[apart.pair_at >= 0]
    assert sorted(acting.tolist()) == np.flatnonzero(np.isin(model.pair_state, live)).tolist()
    assert model.pair_state[acting].tolist() == live[apart.pair_node[apart.pair_at >= 0]].tolist()
    assert np.array_equal(apart.lift(np.array([3.0, 4.0]))[live], [3.0, 4.0])


def test_every_free_component_is_merged():
    """Two pairs of states, each of which is one node that says what it is made of."""
    twice = {
        f"{state}{k}": {
            action: [(p, to if to in "gd" else f"{to}{k}", cost) for p, to, cost in outcomes]
            for action, outcomes in actions.items()
        }
        for state, actions in FREE_PAIR.items()
        if state != "d"
        for k in range(2)
    }
    twice["x0"]["over"] = [(1.0, "x1", 1)]
    model = model_of({**twice, "d": {}})
    whole = build_quotient(model, free=costless_pairs(model), free_exits=True)
    states = [model.index_of(state) for state in ("x0", "y0", "x1", "y1")]
    nodes = whole.node_of[states].tolist()
    assert nodes[0] == nodes[1] != nodes[2] == nodes[3]
    assert whole.n_nodes == 2
    assert whole.merged[states].all()
    assert sorted(whole.pair_node[whole.gives_up].tolist()) == [0, 1]  # or stay for ever


def test_choices_of_many_layers_are_those_of_each_layer():
    """Also if members of a merged component move to the one whose pair is taken."""
    ways = {k: {"on": [(1.0, "g", 3.0)], "off": [(1.0, "d", 1.0)]} for k in "abc"}
    for k, after in zip("abc", "bca", strict=True):
        ways[k]["free"] = [(1.0, after, 0.0)]
    model = model_of({**ways, "d": {}, "e": {"on": [(1.0, "a", 2.0)]}})
    quotient = build_quotient(model, free=costless_pairs(model))
    first, most = quotient.pair_offsets[:-1], np.diff(quotient.pair_offsets)
    assert sorted(most.tolist()) == [1, 6]
    choice = np.arange(12, dtype=np.uint8)[:, None] % most
    for _ in range(2):  # also from the cache
        for layer, places in zip(choice, quotient.positions(first, choice), strict=True):
            pairs = quotient.pull_back(first + layer)
            live = quotient.node_of >= 0
            own = np.where(pairs < 0, pairs, pairs - model.pair_offsets[:-1])
            np.testing.assert_array_equal(places[live], own[live])


def test_every_action_of_greatest_goal_probability_may_be_used():
    """Of four ways three reach the goal with 3/4, one by a detour; the cheapest is taken."""
    model = model_of(
        {
            "x": {
                "dear": [(0.75, "g", 9), (0.25, "d", 9)],
                "round": [(0.5, "y", 1), (0.5, "z", 1)],
                "fair": [(0.75, "g", 4), (0.25, "d", 4)],
                "rash": [(0.7, "g", 1), (0.3, "d", 1)],
            },
            "y": {"on": [(1.0, "g", 8)]},
            "z": {"on": [(0.5, "g", 8), (0.5, "d", 8)]},
            "d": {},
        }
    )
    reach = greatest_goal_reach(model)
    first = model.pair_offsets[model.index_of("x")]
    assert reach.goal[model.index_of("x")] == 0.75
    assert reach.usable[first : first + 4].tolist() == [True, True, True, False]
    cheapest = cheapest_reach(model, reach)
    assert model.action_of(int(cheapest.decision[model.index_of("x")])) == "fair"
    assert cheapest.values.cost[model.index_of("x")] == pytest.approx(3.0)
