"""A season's stock: order every week, and do not run out. A continuous world, discretised.

Stock is a real number, a week's demand a gamma variable. A week with more demand than stock loses
the customer: that is failing. The grid model's policies are simulated in the continuous world.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter

import numpy as np
from scipy.stats import gamma

from ssp_lp import (
    MCMP,
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

WEEKS, ROOM, ORDERS, START = 8, 60.0, (0, 10, 20, 30), (25.0, 0.5)  # pieces, middle of a week
DELIVERY, PIECE, STORAGE = 20.0, 1.0, 0.5  # costs


def week(point, order, noise):
    """Order, then serve the demand; return new stock and week, the cost, and the end if any."""
    (stock, now), (demand,) = point, noise
    filled = np.minimum(stock + order, ROOM)
    left = filled - demand
    cost = DELIVERY * (order > 0) + PIECE * (filled - stock) + STORAGE * np.maximum(left, 0.0)
    end = np.where(left < 0.0, 2, np.where(now + 1.0 > WEEKS, 1, 0))
    return (left, now + 1.0), cost, end


def season(cells: int = 120) -> ContinuousModel:
    """Return the season with the stock divided into a number of cells."""
    demand = Distribution(gamma(4.0, scale=2.5).ppf)  # mean 10, standard deviation 5
    grid = Grid([Axis(0.0, ROOM, cells), Axis(0.0, WEEKS, WEEKS)])
    return ContinuousModel(grid, ORDERS, week, noise=[demand], dead_ends={"sold out": 0.0})


def table(budgets=(0.01, 0.05, 0.1), episodes: int = 20_000) -> list[tuple[float, ...]]:
    """Return for each budget cost and failure in the model, and the simulated failure and cost."""
    world, rows = season(), []
    model, real = discretise(world, Quadrature((4, 1, 200))), WorldSimulator(world, START)
    for budget in budgets:
        problem = MCMP(model, world.grid.cell_of(START), budget)
        found = solve(problem)
        played = simulate(found.policy, problem, episodes=episodes, seed=0, simulator=real)
        there = *played.failure_probability[1:3], played.expected_cost.value
        rows.append((budget, found.objective, found.failure_probability, *there))
    return rows


if __name__ == "__main__":
    ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter).parse_args()
    print("budget    cost  failure   in the world         cost there")
    for row in table():
        print("{:6.2f} {:7.2f} {:8.4f}   {:.4f} .. {:.4f} {:12.2f}".format(*row))
