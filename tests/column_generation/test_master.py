"""The restricted master: its closed form for one limit, and the ratio of case S over a pool."""

from __future__ import annotations

from itertools import combinations
from typing import Any, cast

import numpy as np
import pytest

from ssp_lp.column_generation.column import Column
from ssp_lp.column_generation.restricted_master import solve_master
from ssp_lp.column_generation.search import Master, Pool, Rows, secant

FAILURE = np.ones(1, dtype=np.int64)


@pytest.mark.parametrize("seed", range(40))
def test_the_secant_is_the_master_of_one_limit(seed: int) -> None:
    """Value and price are those of the simplex method, and no column lies below the line."""
    rng = np.random.default_rng(seed)
    cost, taken = rng.uniform(0.0, 10.0, 9), rng.uniform(0.0, 1.0, 9) ** 3
    bound = np.array([rng.uniform(taken.min(), 1.1)])
    found = secant(cost, taken, bound)
    known = solve_master(cost, taken[None, :], bound, bound, elastic=False)
    assert found.value == pytest.approx(known.value, rel=1e-12)
    assert found.weights.sum() == pytest.approx(1.0, rel=1e-14)
    assert found.weights @ taken <= bound[0] * (1.0 + 1e-14)
    assert found.weights @ cost == pytest.approx(found.value, rel=1e-12)
    line = found.value + found.prices[0] * (bound[0] - taken)
    assert (cost >= line - 1e-12).all()


def test_the_small_weight_of_a_secant_is_exact() -> None:
    """The safe column is taken as often as the limit asks for, to the last digit."""
    for room in (1e-3, 1e-9, 1e-15):
        found = secant(np.array([5.0, 1.0]), np.array([-1.0, 0.0]), np.array([-room]))
        assert found.weights[0] == room


def test_nothing_limited_takes_the_cheapest_column() -> None:
    found = secant(np.array([3.0, 2.0, 4.0]), np.zeros(0), np.zeros(0))
    assert (found.value, found.weights.tolist(), found.prices.size) == (2.0, [0.0, 1.0, 0.0], 0)


@pytest.mark.parametrize("by_goal", [False, True])
@pytest.mark.parametrize("seed", range(20))
def test_a_ratio_over_a_pool_is_least_at_a_pair_of_columns(seed: int, by_goal: bool) -> None:
    """A ratio within one limit is least at a column, or where two columns meet the limit."""
    rng = np.random.default_rng(seed)
    failure, ratios = rng.uniform(0.0, 0.9, 7), rng.uniform(1.0, 5.0, 7)
    budget = rng.uniform(failure.min(), 1.0)
    columns = [
        Column(c * (1.0 - f), f, 1.0 - f, None, by_goal=by_goal)
        for c, f in zip(ratios.tolist(), failure.tolist(), strict=True)
    ]
    least = min(c for c, f in zip(ratios, failure, strict=True) if f <= budget)
    for one, other in combinations(columns, 2):
        safe, risky = sorted((one, other), key=lambda column: column.failure)
        if safe.failure < budget < risky.failure:
            w = (budget - safe.failure) / (risky.failure - safe.failure)
            cost = (1.0 - w) * safe.cost + w * risky.cost
            least = min(least, cost / (1.0 - budget))
    bound = np.array([budget - 1.0 if by_goal else budget])
    rows = Rows(FAILURE, bound, np.ones(1), 2, by_goal, ratio=10.0)
    master = Master(Pool(cast("Any", None), columns), rows, np.zeros(1), given_success=True)
    master.solve()
    assert master.objective == pytest.approx(least, rel=1e-12)
    assert master.rows.ratio == pytest.approx(least, rel=1e-12)
