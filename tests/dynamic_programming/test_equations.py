"""Equations of policies and bounds: exact rational solutions, verified errors, endless chains."""

import gc
from fractions import Fraction
from weakref import ref

import numpy as np
import pytest
import scipy.sparse as sp

from ssp_lp import SolverError
from ssp_lp.compiled import accelerator
from ssp_lp.compiled.deadline import Stop, until
from ssp_lp.dynamic_programming import chain_solvers as solvers, equations
from ssp_lp.dynamic_programming.bellman import Moves
from ssp_lp.dynamic_programming.chain_solvers import factorised
from ssp_lp.dynamic_programming.dual_bound import DualBound, dual_bound, shortfall, sub_solution
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.equations import DIRECT_STATES, System, strong_components
from ssp_lp.dynamic_programming.evaluation import acyclic_totals, evaluate_chain
from ssp_lp.dynamic_programming.policy_iteration import (
    improve_backwards,
    iterate_policy,
)


@pytest.fixture(params=[False, True], ids=["numpy", "numba"])
def compiled(request, monkeypatch):
    """Run every loop compiled, or none."""
    if request.param and not accelerator.has_accelerator():
        pytest.skip("no compiled loops here")
    monkeypatch.setenv(accelerator.SWITCH, "numba" if request.param else "none")
    return bool(request.param)


def fractions(numbers):
    """The floats as they are."""
    return np.array([Fraction(x) for x in np.ravel(numbers).tolist()]).reshape(np.shape(numbers))


def slow_chain(rng):
    """Transitions and exits of up to 6 states, left with probabilities down to 1e-14."""
    n = int(rng.integers(1, 7))
    steps = rng.random((n, n)) * (rng.random((n, n)) < 0.6) * (1.0 - np.eye(n))
    exits = 10.0 ** -rng.uniform(1, 14, n) * (rng.random(n) < 0.5)
    total = steps.sum(axis=1) + exits
    total[total == 0.0] = 1.0
    return steps / total[:, None], exits / total


def exact_totals(steps, exits, rewards):
    """Gauss and Jordan in fractions; what departs is the sum of the steps and of the exit."""
    n, steps = len(exits), fractions(steps)
    rows = np.hstack([-steps, fractions(rewards)])
    for i in range(n):
        rows[i, i] = Fraction(float(exits[i])) + steps[i].sum() - steps[i, i]
    for i in range(n):
        pivot = next(k for k in range(i, n) if rows[k, i] != 0)
        rows[[i, pivot]] = rows[[pivot, i]]
        rows[i] /= rows[i, i]
        for k in set(range(n)) - {i}:
            rows[k] -= rows[k, i] * rows[i]
    return rows[:, n:]


@pytest.mark.parametrize("seed", range(40))
def test_totals_are_as_wrong_as_they_say(compiled, seed):
    """Against fractions: the verified bound holds and is small, whatever the exits."""
    steps, exits = slow_chain(np.random.default_rng(seed))
    rewards = np.stack([np.ones(len(exits)), exits], axis=1)
    system = System(sp.csr_array(steps), exits)
    if system.closed.size:
        with pytest.raises(SolverError, match="for ever"):
            evaluate_chain(system, rewards)
        return
    totals, exact = evaluate_chain(system, rewards), exact_totals(steps, exits, rewards)
    wrong = abs(fractions(totals.values) + fractions(totals.low) - exact)
    largest = abs(exact).max(axis=0)
    assert (wrong <= fractions(totals.error) + largest / 2**52).all()
    assert (wrong <= Fraction(1, 10**12) * largest).all()


def test_a_loop_left_after_a_trillion_trillion_steps_is_exact(compiled):
    """No residual verifies 1e24 steps; state reduction without subtractions still has them."""
    nested = np.array([[0.0, 1.0 - 1e-12, 1e-12], [1.0, 0.0, 0.0], [1.0 - 1e-12, 0.0, 0.0]])
    system = System(sp.csr_array(nested), np.array([0.0, 0.0, 1e-12]))
    runs = evaluate_chain(system, np.ones((3, 1))).values[:, 0]
    assert runs == pytest.approx(2e24, rel=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_components_come_after_all_that_they_lead_to(compiled, seed):
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


def random_dynamics(rng, backwards):
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
def test_one_pass_over_components_is_the_optimum(compiled, seed, backwards):
    """Against value iteration; entries of one column that come twice count twice."""
    dynamics, cost = random_dynamics(np.random.default_rng(seed), backwards)
    first, values = np.asarray(dynamics.pair_offsets[:-1]), np.zeros(30)
    found = iterate_policy(dynamics, cost[:, None], np.ones(1), first)
    stays = 1.0 - dynamics.exits - np.asarray(dynamics.transitions.sum(axis=1)).ravel()
    for _ in range(20_000):
        ahead = cost + dynamics.transitions @ values + stays * values.repeat(3)
        values = ahead.reshape(30, 3).min(axis=1)
    assert found.values == pytest.approx(values, rel=1e-9)


def test_a_policy_that_never_leaves_is_no_policy(compiled):
    system = System(sp.csr_array(np.roll(np.eye(50), 1, axis=1)), np.zeros(50))
    assert np.array_equal(system.closed, np.arange(50))
    with pytest.raises(SolverError, match="for ever"):
        evaluate_chain(system, np.ones((50, 1)))


def test_a_passed_deadline_ends_policy_iteration():
    dynamics, cost = random_dynamics(np.random.default_rng(0), 8)
    plain = Dynamics(dynamics.pair_offsets, dynamics.transitions, dynamics.exits)
    with until(-10.0), pytest.raises(Stop):
        iterate_policy(plain, cost[:, None], np.ones(1), np.asarray(plain.pair_offsets[:-1]))


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("compiled", [True], indirect=True)
def test_sweeps_improve_a_policy_to_values_that_it_attains():
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
        assert process.improve_by_sweeps(cost, choice, values, 0.0, 400, is_sorted_anew=True)
        assert (values <= first * (1.0 + 1e-12)).all()
        measured = process.chain(choice).solve(cost[choice])
        assert (measured <= values * (1.0 + 1e-12)).all()


@pytest.mark.parametrize("seed", range(20))
def test_bounds_of_advantages_hold_in_fractions(compiled, seed):
    rng = np.random.default_rng(seed)
    steps, exits = slow_chain(rng)
    cost, values = rng.normal(size=(2, len(exits))) * 10.0 ** rng.uniform(-3, 8)
    home = np.arange(len(exits), dtype=np.int32)
    lower, upper = Moves(home, sp.csr_array(steps), exits).advantage_bounds(cost, values)
    v = fractions(values)
    moved = (fractions(steps) * (v[None, :] - v[:, None])).sum(axis=1)
    exact = fractions(cost) - fractions(exits) * v + moved
    assert all(low <= middle <= high for low, middle, high in zip(lower, exact, upper, strict=True))
    assert (upper - lower).max() <= 1e-13 * np.abs([*cost, *values]).max()


def scattered_chain(n, *, leak=0.01):
    """A chain of 4 moves to anywhere from each state: its factors fill in, iterations converge."""
    rng = np.random.default_rng(n)
    rows, ahead = np.repeat(np.arange(n), 4), rng.integers(1, n, 4 * n)  # never to itself
    steps = sp.csr_array((rng.random(4 * n) + 0.1, (rows, (rows + ahead) % n)), shape=(n, n))
    steps = sp.csr_array(steps.multiply(((1.0 - leak) / steps.sum(axis=1))[:, None]))
    return System(steps, np.full(n, leak))


@pytest.mark.parametrize("n", [300, 1_100, 2_400, 2_600])
def test_no_factors_are_made_where_they_fill_in(compiled, n, monkeypatch):
    """Totals and visits of scattered chains of any size are iterated, and agree with dense LU."""
    if n <= DIRECT_STATES and not compiled:
        pytest.skip("sparse factors of few states take less than a look at the structure")

    def small(equations, *, in_order=False):
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


@pytest.mark.parametrize("n", [40, 300, 1_100])
def test_visits_of_states_that_wait_count_every_step(compiled, n):
    """Each stays where it is with a probability of its own; whoever begins leaves in the end."""
    moving, rng = scattered_chain(n, leak=0.05), np.random.default_rng(n)
    stays, inflow = rng.uniform(0.0, 0.9, n), rng.random(n)
    matrix = sp.csr_array(moving.matrix.multiply((1.0 - stays)[:, None]) + sp.diags_array(stays))
    exits = 0.05 * (1.0 - stays)
    visits = System(sp.csr_array(matrix), exits).solve_transposed(inflow)
    assert np.abs(visits - matrix.T @ visits - inflow).max() <= 1e-12 * visits.max()
    assert float(visits @ exits) == pytest.approx(float(inflow.sum()), rel=1e-12)


@pytest.mark.parametrize("leak", [1e-2, 1e-6, 1e-9])
def test_totals_are_had_however_seldom_a_chain_is_left(compiled, leak):
    """Narrow or scattered: run lengths are 1 / leak, whether iterations get there or not."""
    n = 1_200
    here = np.arange(n)
    on = sp.csr_array((np.full(n, 0.5 * (1.0 - leak)), (here, (here + 1) % n)), shape=(n, n))
    ring = System(sp.csr_array(on + on.T), np.full(n, leak))
    for system in (ring, scattered_chain(n, leak=leak)):
        totals = evaluate_chain(system, np.ones((n, 1))).values
        assert np.allclose(totals * leak, 1.0, rtol=1e-15 / leak)


@pytest.mark.parametrize("side", [60, 150, 300])
def test_a_chain_that_nearly_always_starts_over_is_reduced_once(compiled, side, monkeypatch):
    """State 0 leads to one of two rows of states, each of which goes on or back to state 0.

    The odds of leaving at the two ends are products of probabilities, here in fractions.
    """
    rng, n = np.random.default_rng(side), 2 * side + 1
    to_right, on = float(rng.uniform(0.1, 0.9)), rng.uniform(0.3, 0.7, n)
    row, column = np.arange(1, n), np.arange(2, n + 1)
    steps, exits = sp.lil_array((n, n)), np.zeros(n)
    steps[0, 1], steps[0, side + 1] = to_right, 1.0 - to_right
    ends = np.array([side, n - 1])
    steps[row[row != side][:-1], column[row != side][:-1]] = on[row[row != side][:-1]]
    steps[row, 0], exits[ends] = 1.0 - on[row], on[ends]
    system, reductions = System(sp.csr_array(steps), exits), []
    monkeypatch.setattr(
        equations,
        "reduction_solver",
        lambda *chain: reductions.append(1) or solvers.reduction_solver(*chain),
    )
    leaving = np.zeros((n, 2))
    leaving[ends, [0, 1]] = on[ends]
    totals = evaluate_chain(system, leaving).values[0]
    odds = fractions([to_right, 1.0 - to_right]) * fractions(on)[1:].reshape(2, side).prod(axis=1)
    assert totals.tolist() == pytest.approx((odds / odds.sum()).astype(float).tolist(), rel=1e-13)
    evaluate_chain(system, leaving[:, :1])
    assert len(reductions) == 1


@pytest.mark.parametrize("seed", range(3))
def test_one_pass_without_cycles_chooses_and_knows_its_errors(seed, monkeypatch):
    """Layers with self-loops: the values of numpy, and totals as wrong as they say, at most."""
    if not accelerator.has_accelerator():
        pytest.skip("no compiled loops here")
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
    monkeypatch.setenv(accelerator.SWITCH, "numba")
    settled = acyclic_totals(dynamics, held, rewards, priced)
    kept = acyclic_totals(dynamics, held, rewards)
    assert np.array_equal(kept[0], held)
    for choice, totals in (settled, kept):
        exact = evaluate_chain(dynamics.chain(choice), rewards[choice], accuracy=1e-24)
        wrong = np.abs(totals.values - exact.values - exact.low)
        assert (wrong <= totals.error).all()
        assert totals.are_within(1e-12)
        assert (2.0 * totals.runs >= exact.runs).all()
    monkeypatch.setenv(accelerator.SWITCH, "none")
    _, least = improve_backwards(dynamics, rewards @ priced, held)
    assert np.allclose(settled[1].values @ priced, least, rtol=1e-14)


def test_the_equations_of_a_policy_are_let_go_at_once(compiled):
    """With them the arrays of a large component: nothing waits for rings of references."""
    chain = scattered_chain(2_000, leak=0.1)
    gc.disable()
    try:
        chain.solve(np.ones(2_000))
        chain.solve_transposed(np.ones(2_000))
        blocks = [ref(block) for block in chain._large.values()]
        del chain
        assert blocks
        assert [block() for block in blocks] == [None] * len(blocks)
    finally:
        gc.enable()


# Checked lower bounds: never above the optimum, and near it even where many pairs tie


def test_ties_between_a_cost_and_a_free_step_do_not_drop_the_bound():
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
def test_what_passes_is_a_lower_bound(seed):
    """Against value iteration to convergence, from values that are too high by chance."""
    rng = np.random.default_rng(seed)
    dense = rng.random((30, 10)) * (rng.random((30, 10)) < 0.3)
    dense /= np.maximum(dense.sum(axis=1, keepdims=True), 1e-12) / rng.uniform(0.5, 0.95, (30, 1))
    cost = np.round(rng.random(30), 1)
    optimum = np.zeros(10)
    for _ in range(2_000):
        optimum = (cost + dense @ optimum).reshape(10, 3).min(axis=1)
    guess = optimum * (1.0 + rng.normal(scale=1e-8, size=10))
    offsets = np.arange(0, 31, 3, dtype=np.int32)
    dynamics = Dynamics(offsets, sp.csr_array(dense), 1.0 - dense.sum(axis=1))
    lowered = sub_solution(dynamics, cost, guess)
    assert (lowered <= optimum * (1.0 + 1e-14) + 1e-14).all()
    assert lowered == pytest.approx(optimum, rel=1e-5, abs=1e-6)


def test_a_chain_of_waits_is_bounded_to_its_last_digits(compiled):
    """Each of 400 states waits with probability 1 - p at cost c, or with 1 - q at cost d.

    A row and its exits are the truth: the value is the sum of the least of c / p and d / q.
    """
    rng, n = np.random.default_rng(3), 400
    on, cost = rng.uniform(0.01, 1.0, (n, 2)), rng.uniform(0.1, 10.0, (n, 2))
    rows, home = np.repeat(np.arange(2 * n), 2), np.repeat(np.arange(n), 2)
    columns = np.stack([home, home - 1], axis=1)
    data = np.stack([1.0 - on.ravel(), on.ravel()], axis=1)
    inside = columns.ravel() >= 0
    entries = data.ravel()[inside], (rows[inside], columns.ravel()[inside])
    exits = np.where(columns[:, 1] < 0, on.ravel(), 0.0)
    dynamics = Dynamics(2 * np.arange(n + 1), sp.csr_array(entries, shape=(2 * n, n)), exits)
    exact = fractions(cost) / fractions(on)
    optimum = np.cumsum(exact.min(axis=1))
    choice = 2 * np.arange(n) + (exact[:, 1] < exact[:, 0])
    for noise in (0.0, 1e-15, 1e-14):
        values = optimum.astype(np.float64) * (1.0 + noise * rng.standard_normal(n))
        bound = dual_bound(dynamics, cost.ravel(), values, choice=choice)
        proved = fractions(bound.values) + fractions(bound.low)
        assert (proved <= optimum).all()
        assert (proved >= optimum * (1 - Fraction(1, 10**11))).all()


@pytest.mark.parametrize("n", [1, 2, 3, 17, 400])
def test_a_bound_at_the_start_is_rounded_down(n):
    """Beside the sum in fractions, for values of both signs and sizes, and shares of all kinds."""
    rng = np.random.default_rng(n)
    for _ in range(60):
        values = rng.normal(size=n) * 10.0 ** rng.uniform(-6, 6, n)
        low = rng.choice([0.0, 1e-17], n) * values * rng.random(n)
        start = rng.random(n) * (rng.random(n) < 0.7)
        start = start / start.sum() if start.any() else np.eye(n)[0]
        bound = DualBound(values, low)
        exact = (fractions(start) * (fractions(values) + fractions(low))).sum()
        told = Fraction(bound.at(start))
        assert told <= exact
        size = Fraction(float(start @ np.abs(values)))
        assert exact - told <= (n + 4) * Fraction(1, 2**51) * size
        first = np.eye(n)[0]  # a term of its own is no sum
        assert DualBound(values, np.zeros(n)).at(first) == values[0]
        assert (fractions(bound.rounded) <= fractions(values) + fractions(low)).all()
