"""Equations of policies: exact rational solutions, verified errors, chains that never leave."""

from __future__ import annotations

import gc
from fractions import Fraction
from weakref import ref

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse import linalg

from ssp_lp import SolverError
from ssp_lp.compiled import accelerator
from ssp_lp.compiled.deadline import Stop, until
from ssp_lp.dynamic_programming import equations, solvers
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.equations import DIRECT_STATES, System, strong_components
from ssp_lp.dynamic_programming.evaluation import acyclic_totals, advantage_bounds, evaluate_chain
from ssp_lp.dynamic_programming.policy_iteration import (
    improve_along_chain,
    iterate_policy,
    least_backwards,
)
from ssp_lp.dynamic_programming.solvers import factorised


@pytest.fixture(params=[False, True], ids=["numpy", "numba"])
def compiled(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Run every loop compiled, or none."""
    if request.param:
        pytest.importorskip("numba")
    monkeypatch.setattr(accelerator, "least_entries", lambda: 0 if request.param else 1 << 62)
    return bool(request.param)


def slow_chain(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Transitions and exits of up to 6 states, left with probabilities down to 1e-14."""
    n = int(rng.integers(1, 7))
    steps = rng.random((n, n)) * (rng.random((n, n)) < 0.6) * (1.0 - np.eye(n))
    exits = 10.0 ** -rng.uniform(1, 14, n) * (rng.random(n) < 0.5)
    total = steps.sum(axis=1) + exits
    total[total == 0.0] = 1.0
    return steps / total[:, None], exits / total


def exact_totals(steps: np.ndarray, exits: np.ndarray, reward: np.ndarray) -> list[Fraction]:
    """Gauss and Jordan in fractions; what departs is the sum of the steps and of the exit."""
    n = len(exits)
    rows = [
        [-Fraction(float(p)) for p in steps[i]] + [Fraction(float(reward[i]))] for i in range(n)
    ]
    for i in range(n):
        others = sum(Fraction(float(steps[i, j])) for j in range(n) if j != i)
        rows[i][i] = Fraction(float(exits[i])) + others
    for i in range(n):
        pivot = next(k for k in range(i, n) if rows[k][i] != 0)
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [value / rows[i][i] for value in rows[i]]
        for k in range(n):
            if k != i and rows[k][i] != 0:
                factor = rows[k][i]
                rows[k] = [a - factor * b for a, b in zip(rows[k], rows[i], strict=True)]
    return [row[n] for row in rows]


@pytest.mark.parametrize("seed", range(40))
def test_totals_are_as_wrong_as_they_say(compiled: bool, seed: int) -> None:
    """Against fractions: the verified bound holds and is small, whatever the exits."""
    steps, exits = slow_chain(np.random.default_rng(seed))
    rewards = np.stack([np.ones(len(exits)), exits], axis=1)
    system = System(sp.csr_array(steps), exits)
    if system.closed.size:
        with pytest.raises(SolverError, match="for ever"):
            evaluate_chain(system, rewards)
        return
    totals = evaluate_chain(system, rewards)
    for j in range(2):
        exact = exact_totals(steps, exits, rewards[:, j])
        largest = max(abs(value) for value in exact)
        for i, value in enumerate(exact):
            found = Fraction(float(totals.values[i, j])) + Fraction(float(totals.low[i, j]))
            assert abs(found - value) <= Fraction(float(totals.error[i, j])) + largest / 2**52
            assert abs(found - value) <= Fraction(1, 10**12) * largest


def test_a_loop_left_after_a_trillion_trillion_steps_is_exact(compiled: bool) -> None:
    """No residual verifies 1e24 steps; state reduction without subtractions still has them."""
    nested = np.zeros((3, 3))
    nested[0, 1], nested[0, 2] = 1.0 - 1e-12, 1e-12
    nested[1, 0] = 1.0
    nested[2, 0] = 1.0 - 1e-12
    system = System(sp.csr_array(nested), np.array([0.0, 0.0, 1e-12]))
    runs = evaluate_chain(system, np.ones((3, 1))).values[:, 0]
    assert runs == pytest.approx(2e24, rel=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_components_come_after_all_that_they_lead_to(compiled: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 60))
    rows = sp.csr_array((rng.random((n, n)) < 1.2 / n).astype(np.float64))
    found = strong_components(rows.indptr, rows.indices, rows.data)
    entry = rows.tocoo()
    assert (found.label[entry.row] >= found.label[entry.col]).all()
    assert np.array_equal(np.sort(found.order), np.arange(n))
    assert (np.diff(found.label[found.order]) >= 0).all()
    reach = (sp.csgraph.shortest_path(rows, unweighted=True) < np.inf) | np.eye(n, dtype=bool)
    assert np.array_equal(found.label[:, None] == found.label[None, :], reach & reach.T)


def random_dynamics(rng: np.random.Generator, backwards: int) -> tuple[Dynamics, np.ndarray]:
    """A process of 30 states that lead at most so many states back; some entries come twice."""
    n, actions, outcomes = 30, 3, 3
    home = np.repeat(np.arange(n), actions * outcomes)
    columns = np.maximum(home + rng.integers(-8, backwards + 1, home.size), -1)
    chance = rng.dirichlet(np.ones(outcomes), n * actions).ravel()
    pair = np.repeat(np.arange(n * actions), outcomes)
    inside = (columns >= 0) & (columns < n)
    exits = np.bincount(pair[~inside], weights=chance[~inside], minlength=n * actions) + 1e-3
    indptr = np.append(0, np.cumsum(np.bincount(pair[inside], minlength=n * actions)))
    kept = sp.csr_array((chance[inside] * 0.999, columns[inside], indptr), shape=(n * actions, n))
    offsets = np.arange(0, n * actions + 1, actions, dtype=np.int32)
    return Dynamics(offsets, kept, exits, is_reused=True), rng.random(n * actions)


@pytest.mark.parametrize("backwards", [0, 1, 4])
@pytest.mark.parametrize("seed", range(3))
def test_one_pass_over_components_is_the_optimum(compiled: bool, seed: int, backwards: int) -> None:
    """Against value iteration; entries of one column that come twice count twice."""
    dynamics, cost = random_dynamics(np.random.default_rng(seed), backwards)
    first = np.asarray(dynamics.pair_offsets[:-1])
    found = iterate_policy(dynamics, cost[:, None], np.ones(1), first)
    values = np.zeros(30)
    departs = dynamics.exits + np.asarray(dynamics.transitions.sum(axis=1)).ravel()
    for _ in range(20_000):
        ahead = (
            cost + dynamics.transitions @ values + (1.0 - departs) * values[first.repeat(3) // 3]
        )
        values = ahead.reshape(30, 3).min(axis=1)
    assert found.values == pytest.approx(values, rel=1e-9)


def test_a_policy_that_never_leaves_is_no_policy(compiled: bool) -> None:
    ring = sp.csr_array(np.roll(np.eye(50), 1, axis=1))
    system = System(ring, np.zeros(50))
    assert np.array_equal(system.closed, np.arange(50))
    with pytest.raises(SolverError, match="for ever"):
        evaluate_chain(system, np.ones((50, 1)))


def test_a_passed_deadline_ends_policy_iteration() -> None:
    rng = np.random.default_rng(0)
    dynamics, cost = random_dynamics(rng, 8)
    plain = Dynamics(dynamics.pair_offsets, dynamics.transitions, dynamics.exits)
    with until(-10.0), pytest.raises(Stop):
        iterate_policy(plain, cost[:, None], np.ones(1), np.asarray(plain.pair_offsets[:-1]))


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("compiled", [True], indirect=True)
def test_passes_along_the_chain_only_improve_and_end_at_the_optimum() -> None:
    rng = np.random.default_rng(12)
    for _ in range(30):
        n, actions = int(rng.integers(2, 40)), 3
        steps = rng.random((n * actions, n)) * (rng.random((n * actions, n)) < 2.5 / n)
        exits = 0.01 + 0.2 * rng.random(n * actions)
        total = steps.sum(axis=1) + exits
        rows = sp.csr_array(steps / total[:, None])
        process = Dynamics(np.arange(0, n * actions + 1, actions), rows, exits / total)
        cost = rng.random(n * actions)
        choice = np.arange(0, n * actions, actions, dtype=np.int32)
        first = process.chain(choice).solve(cost[choice])
        values = first.copy()
        assert improve_along_chain(process, cost, choice, values)
        assert (values <= first * (1.0 + 1e-12)).all()
        measured = process.chain(choice).solve(cost[choice])
        assert np.allclose(values, measured, rtol=1e-11)
        ahead = (cost + rows @ measured).reshape(n, actions).min(axis=1)
        assert np.allclose(ahead, measured, rtol=1e-10)


@pytest.mark.parametrize("seed", range(20))
def test_bounds_of_advantages_hold_in_fractions(compiled: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    steps, exits = slow_chain(rng)
    cost, values = rng.normal(size=(2, len(exits))) * 10.0 ** rng.uniform(-3, 8)
    home, rows = np.arange(len(exits), dtype=np.int32), sp.csr_array(steps)
    lower, upper = advantage_bounds((home, rows, exits), cost, values)
    exact = [
        Fraction(float(cost[i]))
        - Fraction(float(exits[i])) * Fraction(float(values[i]))
        + sum(
            Fraction(float(steps[i, j])) * (Fraction(float(values[j])) - Fraction(float(values[i])))
            for j in range(len(exits))
        )
        for i in range(len(exits))
    ]
    assert all(low <= middle <= high for low, middle, high in zip(lower, exact, upper, strict=True))
    assert (upper - lower).max() <= 1e-13 * np.abs([*cost, *values]).max()


def scattered_chain(n: int, *, leak: float = 0.01) -> System:
    """A chain of 4 moves to anywhere from each state: its factors fill in, iterations converge."""
    rng = np.random.default_rng(n)
    rows, ahead = np.repeat(np.arange(n), 4), rng.integers(1, n, 4 * n)  # never to itself
    steps = sp.csr_array((rng.random(4 * n) + 0.1, (rows, (rows + ahead) % n)), shape=(n, n))
    steps = sp.csr_array(steps.multiply(((1.0 - leak) / steps.sum(axis=1))[:, None]))
    return System(steps, np.full(n, leak))


@pytest.mark.parametrize("n", [300, 1_100, 2_400, 2_600])
def test_no_factors_are_made_where_they_fill_in(
    compiled: bool, n: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Totals and visits of scattered chains of any size are iterated, and agree with dense LU."""
    if n <= DIRECT_STATES and not compiled:
        pytest.skip("sparse factors of few states take less than a look at the structure")

    def small(equations: sp.csc_array, *, in_order: bool = False) -> linalg.SuperLU:
        """Factors of states that do not hang together with all the others."""
        assert equations.shape[0] < n // 2
        return factorised(equations, in_order=in_order)

    monkeypatch.setattr(solvers, "factorised", small)
    monkeypatch.setattr(equations, "factorised", small)
    monkeypatch.delattr(solvers, "band_solver")
    system, inflow = scattered_chain(n), np.eye(1, n)[0]
    dense = np.eye(n) - system.matrix.toarray()
    totals = system.solve(np.ones((n, 1)))[:, 0]
    assert np.allclose(totals, 100.0, rtol=1e-12)  # left with probability 1/100 a step
    assert np.abs(dense @ totals - 1.0).max() <= 1e-12 * 100.0
    visits = system.solve_transposed(inflow)
    assert np.abs(visits @ dense - inflow).max() <= 1e-13
    assert visits.sum() == pytest.approx(100.0, rel=1e-12)


@pytest.mark.parametrize("leak", [1e-2, 1e-6, 1e-9])
def test_totals_are_had_however_seldom_a_chain_is_left(compiled: bool, leak: float) -> None:
    """Narrow or scattered: run lengths are 1 / leak, whether iterations get there or not."""
    n = 1_200
    here = np.arange(n)
    on = sp.csr_array((np.full(n, 0.5 * (1.0 - leak)), (here, (here + 1) % n)), shape=(n, n))
    ring = System(sp.csr_array(on + on.T), np.full(n, leak))
    for system in (ring, scattered_chain(n, leak=leak)):
        totals = evaluate_chain(system, np.ones((n, 1))).values
        assert np.allclose(totals * leak, 1.0, rtol=1e-15 / leak)


@pytest.mark.parametrize("seed", range(3))
def test_one_pass_without_cycles_chooses_and_knows_its_errors(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Layers with self-loops: the values of numpy, and totals as wrong as they say, at most."""
    pytest.importorskip("numba")
    rng, depth, width, outcomes = np.random.default_rng(seed), 150, 8, 3
    n = depth * width
    home = np.repeat(np.arange(n), 2)
    to = (home // width + 1)[:, None] * width + rng.integers(0, width, (2 * n, outcomes))
    weights = rng.random((2 * n, outcomes + 1)) + 0.01
    weights /= weights.sum(axis=1)[:, None] * np.where(rng.random(2 * n) < 0.5, 1.0, 1.001)[:, None]
    rows, columns = np.repeat(np.arange(2 * n), outcomes + 1), np.column_stack([to, home]).ravel()
    inside = columns < n
    steps = (weights.ravel()[inside], (rows[inside], columns[inside]))
    transitions = sp.csr_array(steps, shape=(2 * n, n))
    exits = np.bincount(rows[~inside], weights.ravel()[~inside], minlength=2 * n)
    exits += np.maximum(1.0 - weights.sum(axis=1), 0.0)
    dynamics = Dynamics(np.arange(0, 2 * n + 1, 2), transitions, exits)
    rewards, priced = rng.random((2 * n, 2)), np.array([1.0, 0.5])
    held = np.arange(0, 2 * n, 2, dtype=np.int32)
    monkeypatch.setattr(accelerator, "least_entries", lambda: 0)
    settled = acyclic_totals(dynamics, held, rewards, priced)
    kept = acyclic_totals(dynamics, held, rewards)
    assert settled is not None
    assert kept is not None
    assert np.array_equal(kept[0], held)
    for choice, totals in (settled, kept):
        exact = evaluate_chain(dynamics.chain(choice), rewards[choice], accuracy=1e-24)
        wrong = np.abs(totals.values - exact.values - exact.low)
        assert (wrong <= totals.error).all()
        assert totals.are_within(1e-12)
        assert (2.0 * totals.runs >= exact.runs).all()
    monkeypatch.setattr(accelerator, "least_entries", lambda: 1 << 62)
    _, least = least_backwards(dynamics, rewards @ priced, held)
    assert np.allclose(settled[1].values @ priced, least, rtol=1e-14)


def test_the_equations_of_a_policy_are_let_go_at_once(compiled: bool) -> None:
    """With them the arrays of a large component: nothing waits for rings of references."""
    rng, n = np.random.default_rng(0), 2_000
    rows, columns = np.repeat(np.arange(n), 4), rng.integers(0, n, 4 * n)
    steps = sp.csr_array((rng.random(4 * n), (rows, columns)), shape=(n, n)) + sp.eye_array(n, k=1)
    left = 1.0 / (np.asarray(steps.sum(axis=1)).ravel() + 0.1)
    chain = System(sp.csr_array(sp.diags_array(left) @ steps), 0.1 * left)
    gc.disable()
    try:
        chain.solve(np.ones(n))
        chain.solve_transposed(np.ones(n))
        blocks = [ref(block) for block in chain._large.values()]
        del chain
        assert blocks
        assert [block() for block in blocks] == [None] * len(blocks)
    finally:
        gc.enable()
