"""Compiled loops and their numpy twins: the same numbers, bit by bit where sums are ordered."""

from itertools import product

import numpy as np
import pytest
import scipy.sparse as sp

from examples.paper_robot.robot import RobotGrid, grid_model, start_state
from formulations import MCMP, S3P, MaxProb
from ssp_lp import ModelError, certify, solve
from ssp_lp.accumulated_cost import sweep
from ssp_lp.compiled import accelerator
from ssp_lp.dynamic_programming import bellman
from ssp_lp.dynamic_programming.bellman import (
    PairCost,
    best_pairs,
    chosen_product,
    chosen_rows,
    safe_minima,
)
from ssp_lp.dynamic_programming.equations import System
from ssp_lp.model import SSP
from ssp_lp.processes.live_rows import RowChoice, live_rows
from tests.support.compiled import assert_same, both

pytest.importorskip("numba")


def random_pairs(rng, states=60):
    """Pairs of random numbers of successors, some empty; some states without pairs."""
    offsets = np.append(0, np.cumsum(rng.integers(0, 5, states))).astype(np.int32)
    lengths = rng.integers(0, 7, offsets[-1])
    indptr = np.append(0, np.cumsum(lengths)).astype(np.int32)
    data = rng.random(indptr[-1]) / 8
    columns = rng.integers(0, states, indptr[-1]).astype(np.int32)
    return offsets, sp.csr_array((data, columns, indptr), shape=(len(lengths), states))


@pytest.mark.parametrize("seed", range(5))
def test_backups_are_the_same_to_the_last_bit(accelerate, seed):
    rng = np.random.default_rng(seed)
    offsets, transitions = random_pairs(rng)
    values = rng.normal(size=60)
    fixed = np.round(rng.random(transitions.shape[0]), 1)
    cost = PairCost(fixed, rng.random(fixed.size), 3.0)
    held = np.minimum(offsets[:-1], fixed.size - 1)
    some = np.diff(offsets) > 0

    def work():
        backup = best_pairs(offsets, transitions, cost, values, held)
        safe = safe_minima(offsets, transitions, cost, fixed, fixed, values)
        return backup.minima, backup.choice[some], backup.current_values[some], safe

    assert_same(*both(accelerate, work))


@pytest.mark.parametrize("vectors", [1, 2, 3, 4])
def test_chains_are_the_same(accelerate, vectors, monkeypatch):
    monkeypatch.setattr(bellman, "_FEW_ENTRIES", 0)
    rng = np.random.default_rng(vectors)
    _, transitions = random_pairs(rng, 3_000)
    choice = rng.integers(0, transitions.shape[0], 3_000).astype(np.int32)
    reward = rng.random((3_000, vectors))

    def work():
        copied = chosen_rows(transitions, choice)
        return chosen_product(transitions, choice, reward), copied @ reward

    compiled, plain = both(accelerate, work)
    assert_same(compiled, plain)
    chain = sp.csr_array(transitions[choice])
    exits = 1.0 - chain.sum(axis=1)
    solved = both(accelerate, lambda: System(chain, exits).solve(reward))
    np.testing.assert_allclose(*solved, rtol=1e-13)
    x = solved[0]
    np.testing.assert_allclose(x, reward + transitions[choice] @ x, rtol=1e-13)


@pytest.mark.parametrize("slow", [0.86, 0.99, 0.9999])
def test_slowly_leaving_chains_are_solved_too(accelerate, slow):
    """Beyond the reach of sweeps: a ring that leaks little; every total is 1 / (1 - slow)."""
    n = 2_000
    after = (np.arange(n) + 1) % n
    ring = sp.csr_array((np.full(n, slow), (np.arange(n), after)), shape=(n, n))
    rows = sp.csr_array(0.5 * ring + 0.5 * slow * sp.eye_array(n, format="csr"))
    for on in (True, False):
        accelerate(on)
        totals = System(rows, np.full(n, 1.0 - slow)).solve(np.ones(n))
        np.testing.assert_allclose(totals, 1.0 / (1.0 - slow), rtol=1e-10)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("departing", [False, True])
def test_rows_are_the_same(accelerate, seed, departing):
    rng = np.random.default_rng(seed)
    lengths = rng.integers(1, 6, 80)
    offsets = np.append(0, np.cumsum(lengths))
    weights = rng.integers(0, 3, offsets[-1]) + (np.diff(offsets, prepend=0).sum() == 0)
    weights[offsets[:-1]] += 1
    chance = weights / np.repeat(np.add.reduceat(weights, offsets[:-1]), lengths)
    model = SSP.from_arrays(
        pair_offsets=np.append(np.arange(0, 81, 2), 80),
        outcome_offsets=offsets,
        successors=rng.integers(0, 41, offsets[-1]),
        probabilities=chance,
        costs=1.0,
        goal_states=[40],
    )
    node_of = np.where(rng.random(41) < 0.8, np.arange(41), -1).astype(np.int32)
    pair_at = np.where(rng.random(80) < 0.1, -1, np.arange(80)).astype(np.int32)
    home = model.pair_state.astype(np.int32) if departing else None
    ahead = rng.integers(0, 3, offsets[-1]).astype(np.int32)
    for choice in (
        RowChoice(model, node_of, 41, pair_at, home),
        RowChoice(model, node_of, 41, pair_at, home, ahead, 3),
    ):
        assert_same(*both(accelerate, lambda c=choice: live_rows(c, 0.9)))


@pytest.mark.parametrize("criterion", [MCMP, S3P])
@pytest.mark.parametrize("discount", [None, 0.999])
def test_solutions_are_the_same_with_and_without(accelerate, criterion, discount):
    grid = RobotGrid(segments=12, headings=8)
    problem = criterion(grid_model(grid), start_state(grid), 0.12, discount=discount)
    compiled, plain = both(accelerate, lambda: solve(problem))
    assert compiled.objective == pytest.approx(plain.objective, rel=1e-12)
    assert max(compiled.gap, plain.gap) <= 1e-9
    assert compiled.failure_probability == pytest.approx(plain.failure_probability, abs=1e-12)
    assert compiled.run.work.backups > 0
    assert compiled.run.work.products > 0
    if discount is None:  # the same loops once more, on all cores
        from ssp_lp.compiled.cores import on_all_cores

        accelerate(True)
        with on_all_cores():
            everywhere = solve(problem)
        assert everywhere.objective == pytest.approx(plain.objective, rel=1e-12)


def test_a_table_too_large_to_keep_is_proved_again(monkeypatch, coarse_robot):
    problem = S3P(*coarse_robot, 0.2)
    kept = solve(problem)
    monkeypatch.setattr(sweep, "KEPT_VALUES", 0)
    dropped = solve(problem)
    assert np.isinf(dropped.value_function).all()
    assert dropped.value_function.shape == kept.value_function.shape
    assert dropped.lower_bound == kept.lower_bound
    assert certify(dropped).gap == pytest.approx(certify(kept).gap, abs=1e-12)


def test_the_switch_knows_its_words(monkeypatch):
    for word, on in (("none", False), ("numba", True), ("", True)):
        monkeypatch.setenv(accelerator.SWITCH, word)
        assert accelerator.has_accelerator() is on
    for word, runs in (("none", False), ("numba", True), ("", False)):
        monkeypatch.setenv(accelerator.SWITCH, word)
        assert accelerator.accelerated(1, "test.short") is runs  # "numba": nothing is too short
    monkeypatch.setenv(accelerator.SWITCH, "fortran")
    with pytest.raises(ModelError, match="SSP_LP_ACCELERATOR"):
        accelerator.accelerated(1, "test.short")


def test_rows_are_filled_within_their_arrays():
    """As plain Python, where reading beyond an array's end is an error rather than luck."""
    from ssp_lp.compiled import matrix_rows as rows

    n, none = 5, np.zeros(0, dtype=np.int32)
    numbers = np.arange(n + 1, dtype=np.int32)
    departs, counts = np.empty(n), np.empty(n, dtype=np.int32)
    outcomes = numbers, np.zeros(n, dtype=np.int32), np.ones(n)
    node_of, pair_at = np.zeros(1, dtype=np.int32), numbers[:n]
    indices, data = np.empty(n, dtype=np.int32), np.empty(n)
    for home, kept in ((none, n), (np.ones(n, dtype=np.int32), n)):
        rows.count_rows.py_func(*outcomes, node_of, pair_at, home, counts, departs, np.empty(n))
        assert counts.sum() == kept
        rows.fill_rows.py_func(
            *outcomes, none, node_of, 1, pair_at, home, departs, 1.0, numbers, indices, data
        )
        np.testing.assert_array_equal(data, np.ones(n))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "costs", "budget", "back"),
    [
        *((12, (1.0, 0.0), *case) for case in ((0.3, 1.0), (0.6, 1.0), (0.6, 0.0))),
        (3, (1.0, 2.0**0.5), 0.6, 1.0),  # sums are many layers
        *((3, (2.0**0.5, 0.0, 1.0), *case) for case in ((0.3, 1.0), (0.6, 0.0))),
    ],
)
def test_all_layers_in_one_pass_are_as_layer_by_layer(
    accelerate, monkeypatch, n, costs, budget, back
):
    """Sums and multiples of a unit as layers, free steps in order or round within them."""
    choices = {"d": {"stuck": [(1.0, "d", 1.0)]}}
    for i, (k, cost) in product(range(n), enumerate(costs)):
        falls = 0.1 + 0.1 * k / 3
        before = 0.3 - falls, max(i - 2, 0), back * (cost + 1.0)
        choices.setdefault(i, {})[k] = [(0.7, i + 1, cost), before, (falls, "d", 1.0)]
    model = SSP.from_transitions(choices, goal={n})
    least = solve(MaxProb(model, start=0)).failure_probability
    problem = S3P(model, start=0, failure_budget=least + budget * (1.0 - least))
    accelerate(True)
    passed = solve(problem)
    assert certify(passed).accepted
    monkeypatch.setattr(sweep.Sweep, "one_pass", None)
    layer_by_layer = solve(problem)
    accelerate(False)
    interpreted = solve(problem)
    for other in (layer_by_layer, interpreted):
        assert passed.objective == pytest.approx(other.objective, rel=1e-13)
        assert passed.lower_bound == pytest.approx(other.lower_bound, rel=1e-9)
        assert passed.failure_probability == pytest.approx(other.failure_probability, rel=1e-12)
    assert passed.gap <= 1e-9
