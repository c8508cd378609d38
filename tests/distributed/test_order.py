"""Orders of states: a model reordered is the same model, and a narrow order brings steps near."""

from dataclasses import fields

import numpy as np
import pytest

from examples.distributed.scaling import LENGTH, corridor
from formulations import MCMP
from random_models import drawn_model
from ssp_lp import SSP, ModelError, solve
from ssp_lp.distributed import narrow_order
from ssp_lp.distributed.order import inverse, reordered
from ssp_lp.distributed.slab import part_by_rows
from ssp_lp.model.graph import hopeless_states


def longest_step(model):
    """The most by which a step between states that have not lost the goal changes the number."""
    apart = model.goal_mask | hopeless_states(model)
    pairs = np.repeat(np.arange(model.n_pairs), np.diff(model.outcome_offsets))
    begin = model.pair_state[pairs]
    inside = ~apart[begin] & ~apart[model.successors]
    return int(np.abs(begin - model.successors)[inside].max())


def test_a_narrow_order_brings_the_cells_of_a_shuffled_corridor_near_each_other():
    rows, n_states, _ = corridor(12)
    tidy = part_by_rows(rows, 0, n_states, n_states, [n_states - 2])
    shuffled = reordered(tidy, np.random.default_rng(0).permutation(n_states))
    assert longest_step(shuffled) > 10 * LENGTH
    assert longest_step(reordered(shuffled, narrow_order(shuffled))) <= LENGTH


@pytest.mark.parametrize("seed", range(3))
def test_a_model_that_is_reordered_twice_is_itself_and_costs_the_same(seed):
    model, _ = drawn_model(seed, 11)
    model = model.with_labels({"some": ["s2", "s7", "pit"]})
    order = np.random.default_rng(seed).permutation(model.n_states)
    other = reordered(model, order)
    again = reordered(other, inverse(order))
    for one in fields(SSP):
        before, after = getattr(model, one.name), getattr(again, one.name)
        if one.name == "state_labels":
            assert {k: v.tolist() for k, v in before.items()} == {
                k: v.tolist() for k, v in after.items()
            }
        elif isinstance(before, np.ndarray):
            assert np.array_equal(before, after)
        else:
            assert list(before) == list(after)
    costs = [solve(MCMP(one, "s0", 0.9)).objective for one in (model, other)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-9)


def test_a_model_that_has_lost_its_goal_everywhere_keeps_its_order():
    lost = SSP.from_transitions(
        {"x": {"go": [(1.0, "y", 1.0)]}, "y": {}}, {"home"}, treat_actionless_as_dead_ends=True
    )
    assert narrow_order(lost).tolist() == [0, 1, 2]


@pytest.mark.parametrize("order", [[0, 0, 1], [0, 1], [0.0, 1.0, 2.0]])
def test_an_order_has_every_state_once(order):
    lost = SSP.from_transitions(
        {"x": {"go": [(1.0, "home", 1.0)]}, "y": {}}, {"home"}, treat_actionless_as_dead_ends=True
    )
    with pytest.raises(ModelError, match=r"each of the states 0 \.\. 2 once"):
        reordered(lost, order)
