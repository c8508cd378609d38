"""Checked lower bounds: never above the optimum, and near it even where many pairs tie."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse as sp

from ssp_lp.dynamic_programming.dual_bound import dual_bound, shortfall, sub_solution
from ssp_lp.dynamic_programming.dynamics import Dynamics


def test_ties_between_a_cost_and_a_free_step_do_not_drop_the_bound() -> None:
    """The first state's pairs: step on for free, or pay what stepping on leads to."""
    total = 35.863654166323165
    transitions = sp.csr_array(np.array([[0.0, 1.0], [0.0, 0.0], [0.0, 0.0]]))
    cost = np.array([0.0, total - 5e-14, total - 5e-14])
    offsets = np.array([0, 2, 3], dtype=np.int32)
    dynamics = Dynamics(offsets, transitions, np.array([0.0, 1.0, 1.0]))
    lowered = sub_solution(dynamics, cost, np.full(2, total))
    assert lowered == pytest.approx([total, total], rel=1e-12)
    assert not shortfall(dynamics, cost, lowered).any()


@pytest.mark.parametrize("seed", range(20))
def test_what_passes_is_a_lower_bound(seed: int) -> None:
    """Against value iteration to convergence, from values that are too high by chance."""
    rng = np.random.default_rng(seed)
    offsets = np.arange(0, 31, 3, dtype=np.int32)
    dense = rng.random((30, 10)) * (rng.random((30, 10)) < 0.3)
    dense /= np.maximum(dense.sum(axis=1, keepdims=True), 1e-12) / rng.uniform(0.5, 0.95, (30, 1))
    cost = np.round(rng.random(30), 1)
    optimum = np.zeros(10)
    for _ in range(2_000):
        optimum = (cost + dense @ optimum).reshape(10, 3).min(axis=1)
    guess = optimum * (1.0 + rng.normal(scale=1e-8, size=10))
    dynamics = Dynamics(offsets, sp.csr_array(dense), 1.0 - dense.sum(axis=1))
    lowered = sub_solution(dynamics, cost, guess)
    assert (lowered <= optimum * (1.0 + 1e-14) + 1e-14).all()
    assert lowered == pytest.approx(optimum, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_chain_of_waits_is_bounded_to_its_last_digits(
    compiled: bool, accelerate: Callable[[bool], None]
) -> None:
    """Each of 400 states waits with probability 1 - p at cost c, or with 1 - q at cost d.

    A row and its exits are the truth: the value is the sum of the least of c / p and d / q.
    """
    accelerate(compiled)
    rng, n = np.random.default_rng(3), 400
    on, cost = rng.uniform(0.01, 1.0, (n, 2)), rng.uniform(0.1, 10.0, (n, 2))
    rows = np.repeat(np.arange(2 * n), 2)
    columns = np.stack([np.repeat(np.arange(n), 2), np.repeat(np.arange(n) - 1, 2)], axis=1)
    data = np.stack([1.0 - on.ravel(), on.ravel()], axis=1)
    inside = columns.ravel() >= 0
    entries = data.ravel()[inside], (rows[inside], columns.ravel()[inside])
    exits = np.where(columns[:, 1] < 0, on.ravel(), 0.0)
    dynamics = Dynamics(2 * np.arange(n + 1), sp.csr_array(entries, shape=(2 * n, n)), exits)
    exact = [
        [Fraction(c) / Fraction(p) for c, p in zip(*s, strict=True)]
        for s in zip(cost, on, strict=True)
    ]
    optimum = np.cumsum(np.array([min(each) for each in exact]))
    choice = 2 * np.arange(n) + np.array([each[1] < each[0] for each in exact])
    for noise in (0.0, 1e-15, 1e-14):
        values = optimum.astype(np.float64) * (1.0 + noise * rng.standard_normal(n))
        bound = dual_bound(dynamics, cost.ravel(), values, choice=choice)
        proved = [
            Fraction(v) + Fraction(low) for v, low in zip(bound.values, bound.low, strict=True)
        ]
        assert all(b <= v for b, v in zip(proved, optimum, strict=True))
        assert all(b >= v * (1 - Fraction(1, 10**11)) for b, v in zip(proved, optimum, strict=True))
