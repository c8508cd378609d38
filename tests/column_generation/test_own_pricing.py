"""A process of one's own: what the search asks of it, and nothing else.

Trips on a map that never fail. Its pricing problem is a shortest path, found by SciPy; the library
knows neither the graph nor the paths, and finds the best lottery within limits of tolls all the
same, with the prices that prove it.
"""

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.optimize import linprog

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.column_generation.column import Column, PricingProblem, Proof, required
from ssp_lp.column_generation.search import Master, Pool, generate
from ssp_lp.options import SolveOptions


@dataclass(frozen=True, eq=False)
class Trips(PricingProblem):
    """Paths from the first place to the last one: a length, and tolls beside it."""

    heads: IntArray  # [roads] where each begins, and where it ends
    tails: IntArray
    rewards: FloatArray  # [roads, 2 + tolls]: length, failing (none), tolls

    @property
    def n_rewards(self):
        return self.rewards.shape[1]

    @property
    def n_places(self):
        return int(self.tails.max()) + 1

    @property
    def value_shape(self):
        return (self.n_places,)

    def first(self):
        return self.minimise(np.eye(self.n_rewards)[0])

    def minimise(self, weights, *warm):
        values, onward = self._distances(weights)
        place, choice = 0, []
        while place != self.n_places - 1:
            choice.append(onward[place])
            place = self.tails[choice[-1]]
        figures = self.rewards[choice].sum(axis=0)
        return Column.of_rewards(figures, np.array(choice), totals=values)

    def prove(self, weights, best, *, slack=False):
        return self.check(weights, self._distances(weights)[0])

    def check(self, weights, values, *, slack=False):
        self.check_shape(values)
        lack = values[self.heads] - self.rewards @ weights - values[self.tails]
        bound = float(values[0] - values[-1] - self.n_places * max(lack.max(), 0.0))
        return Proof(float(weights[1]), float(weights[1]), bound, values)

    def pulled_back(self, column):
        return required(column.choice).tolist()

    def _distances(self, weights):
        """Distance of each place from the last one, and the road to take there (Bellman, Ford)."""
        price, onward = self.rewards @ weights, np.zeros(self.n_places, dtype=int)
        values = np.full(self.n_places, np.inf)
        values[-1] = 0.0
        for _ in range(self.n_places):
            for road in np.flatnonzero(price + values[self.tails] < values[self.heads]):
                values[self.heads[road]] = price[road] + values[self.tails[road]]
                onward[self.heads[road]] = road
        return values, onward


@pytest.mark.parametrize("seed", range(6))
def test_the_search_asks_a_process_for_columns_and_bounds_alone(seed):
    """The best lottery of paths within two tolls is the least cost of a flow within them."""
    rng = np.random.default_rng(seed)
    n, roads = 8, 30
    heads = np.append(np.arange(n - 1), rng.integers(0, n - 1, roads))
    tails = np.append(np.arange(1, n), rng.integers(1, n, roads))
    rewards = np.round(rng.uniform(0.1, 3.0, (len(heads), 4)), 1)
    rewards[:, 1] = 0.0
    trips = Trips(heads, tails, rewards)
    cheapest = trips.first().rewards
    pool = Pool(trips, [trips.minimise(weights) for weights in np.eye(4)[[0, 2, 3]]])
    least = pool.rewards.min(axis=1)
    bounds = least[2:] + 0.6 * (cheapest[2:] - least[2:]) + 0.5
    rows = pool.rows(np.array([2, 3]), bounds)
    begun = Master(pool, rows, np.zeros(2), elastic=True)
    assert generate(begun, SolveOptions(1e-12)).objective <= 1e-12  # phase 1
    found = generate(Master(pool, rows, np.zeros(2)), SolveOptions(1e-12))
    flow = sp.csr_array((np.ones(len(heads)), (heads, np.arange(len(heads)))), (n, len(heads)))
    flow -= sp.csr_array((np.ones(len(tails)), (tails, np.arange(len(tails)))), (n, len(tails)))
    known = linprog(rewards[:, 0], rewards[:, 2:].T, bounds, flow, np.eye(n)[0] - np.eye(n)[-1])
    assert found.objective == pytest.approx(known.fun, rel=1e-9)
    assert (found.rewards[2:] <= bounds * (1.0 + 1e-12)).all()
    proof = pool.proved(rows.weights(found.prices))
    assert proof.bound - found.prices @ bounds == pytest.approx(known.fun, rel=1e-9)
    routes = [trips.policy(column) for column in found.columns]
    assert all(tails[route[-1]] == n - 1 for route in routes)
