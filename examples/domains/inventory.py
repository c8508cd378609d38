"""A season's stock: order every week, and do not run out. A continuous world, made finite.

The stock is a real number, the week's demand a gamma variable. A week that asks for more than there
is loses the customer: that is failing. Ordering costs a delivery and each piece, storing costs
what is left. The grid model gives policies within a failure budget; what they do where stock is
real is played, and the interval is exact.

    python examples/domains/inventory.py
"""

import numpy as np
from scipy.stats import gamma

from formulations import MCMP
from ssp_lp import (
    Axis,
    ContinuousModel,
    Distribution,
    Grid,
    Quadrature,
    WorldSimulator,
    discretise,
    simulate,
    solve,
)

WEEKS, ROOM = 8, 60.0
ORDERS = (0, 10, 20, 30)
START = (25.0, 0.5)  # pieces; the middle of the first week
POINTS = (4, 1, 200)  # stock within its cell, week, levels of the demand
DELIVERY, PIECE, STORAGE = 20.0, 1.0, 0.5


def week(point, order, noise):
    """Order, then serve the demand: new stock, next week, cost, and how the episode ends."""
    (stock, now), (demand,) = point, noise
    filled = np.minimum(stock + order, ROOM)
    left = filled - demand
    cost = DELIVERY * (order > 0) + PIECE * (filled - stock) + STORAGE * np.maximum(left, 0.0)
    end = np.where(left < 0.0, 2, np.where(now + 1.0 > WEEKS, 1, 0))
    return (left, now + 1.0), cost, end


def season(cells: int = 120) -> ContinuousModel:
    """Return the season with the stock cut into so many cells."""
    demand = Distribution(gamma(4.0, scale=2.5).ppf)  # mean 10, standard deviation 5
    grid = Grid([Axis(0.0, ROOM, cells), Axis(0.0, WEEKS, WEEKS)])
    return ContinuousModel(grid, ORDERS, week, noise=[demand], dead_ends={"sold out": 0.0})


def table(budgets=(0.01, 0.05, 0.1), episodes: int = 20_000) -> list[tuple[float, ...]]:
    """Return a row for each budget: it, the model's cost and failure, and the world's interval."""
    world = season()
    model = discretise(world, Quadrature(POINTS))
    rows = []
    for budget in budgets:
        problem = MCMP(model, world.grid.cell_of(START), budget)
        solution = solve(problem)
        real = WorldSimulator(world, START)
        played = simulate(solution.policy, problem, episodes=episodes, rng=0, simulator=real)
        failed = played.failure_probability
        row = (budget, solution.objective, solution.failure_probability, failed.low, failed.high)
        rows.append((*row, played.expected_cost.value))
    return rows


if __name__ == "__main__":
    print("budget    cost  failure   in the world         cost there")
    for row in table():
        print("{:6.2f} {:7.2f} {:8.4f}   {:.4f} .. {:.4f} {:12.2f}".format(*row))
