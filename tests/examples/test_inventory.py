"""The season's stock: the grid model against the world it was made from."""

import numpy as np

from examples.domains.inventory import START, season, table
from ssp_lp import WorldSimulator


def test_the_model_keeps_to_its_budget_and_the_world_nearly():
    """The grid forgets where in its cell the stock was: what it claims of the world is no proof."""
    ((budget, cost, failure, low, high, world_cost),) = table(budgets=(0.05,), episodes=4000)
    assert abs(failure - budget) < 1e-6
    assert low - 0.01 < failure < high + 0.01
    assert abs(world_cost - cost) < 0.02 * cost


def test_the_week_goes_on_and_the_stock_goes_down():
    world = season(cells=60)
    state = WorldSimulator(world, START)
    begin, cell = state.reset(500, np.random.default_rng(0))
    assert set(cell.tolist()) == {25 * 8}
    after, where, cost = state.step(begin, 4 * cell + 1, np.random.default_rng(1))
    assert (after[:, 1] == 1.5).all()
    assert (after[:, 0] < 35.0).all()
    assert (cost >= 30.0).all()
    assert (where[after[:, 0] < 0.0] == world.end_state("sold out")).all()
