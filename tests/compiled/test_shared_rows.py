"""Rows that share their numbers are the rows, and choices followed forwards are worth the same."""

import numpy as np
import pytest
import scipy.sparse as sp

from examples.domains.navigation import navigation
from formulations import S3P
from ssp_lp.accumulated_cost.charges import TOTAL_COST, ExcessCharge
from ssp_lp.accumulated_cost.sweep import Sweep
from ssp_lp.column_generation.compiled_layers import CompiledLayered, LayeredPricing
from ssp_lp.column_generation.compiled_problem import GoalFacts, LayerAndTails
from ssp_lp.dynamic_programming import bellman
from ssp_lp.dynamic_programming.bellman import (
    PairCost,
    SharedRows,
    best_pairs,
    chosen_product,
    chosen_rows,
    safe_minima,
)
from ssp_lp.model import SSP
from ssp_lp.processes import live_rows as module
from ssp_lp.processes.live_rows import RowChoice, live_rows, shared_live_rows
from tests.support.compiled import assert_same, both

pytest.importorskip("numba")


def repeating_model(rng, states=200, kinds=7):
    """Each pair has one of a few laws; some of their outcomes are impossible, one is sure."""
    laws = [np.ones(1)]
    for _ in range(kinds - 1):
        weights = rng.integers(0, 4, rng.integers(2, 6)).astype(float)
        weights[0] += 1.0
        laws.append(weights / weights.sum())
    drawn = [laws[k] for k in rng.integers(0, kinds, 2 * states)]
    offsets = np.append(0, np.cumsum([len(law) for law in drawn]))
    return SSP.from_arrays(
        pair_offsets=np.append(np.arange(0, 2 * states + 1, 2), 2 * states),
        outcome_offsets=offsets,
        successors=rng.integers(0, states + 1, offsets[-1]),
        probabilities=np.concatenate(drawn),
        costs=1.0,
        goal_states=[states],
    )


@pytest.fixture
def sharing(monkeypatch, accelerate):
    """Let rows share their numbers in small models too."""
    monkeypatch.setattr(module, "_WORTH_SHARING", 0)
    monkeypatch.setattr(module, "MOST_CACHED", 512)
    accelerate(True)


@pytest.mark.usefixtures("sharing")
@pytest.mark.parametrize("survival", [1.0, 0.9])
@pytest.mark.parametrize("width", [1, 3])
def test_shared_rows_are_the_rows(survival, width):
    rng = np.random.default_rng(width)
    model = repeating_model(rng)
    node_of = np.where(rng.random(201) < 0.9, np.arange(201), -1).astype(np.int32)
    pair_at = np.where(rng.random(400) < 0.1, -1, np.arange(400)).astype(np.int32)
    ahead = rng.integers(0, width, model.n_outcomes).astype(np.int32) if width > 1 else None
    rows = RowChoice(model, node_of, 201, pair_at, ahead=ahead, width=width)
    shared, written = shared_live_rows(rows, survival), live_rows(rows, survival).matrix
    assert isinstance(shared, SharedRows)
    assert len(shared.data) * module._TIMES_SHARED <= shared.nnz
    assert_same(shared.written_out(), written)
    x = rng.random(201 * width)
    np.testing.assert_array_equal(shared @ x, written @ x)


@pytest.mark.slow
@pytest.mark.usefixtures("sharing")
def test_compiled_loops_read_both_kinds_of_rows_alike(monkeypatch):
    monkeypatch.setattr(bellman, "_FEW_ENTRIES", 0)
    rng = np.random.default_rng(5)
    model = repeating_model(rng)
    every, pairs = np.arange(201, dtype=np.int32), np.arange(400, dtype=np.int32)
    rows = RowChoice(model, every, 201, pairs)
    shared, written = shared_live_rows(rows), live_rows(rows).matrix
    assert isinstance(shared, SharedRows)
    offsets, values = model.pair_offsets, rng.normal(size=201)
    fixed, choice = rng.random(400), rng.integers(0, 400, 200).astype(np.int32)
    cost = PairCost(fixed, rng.random(400), 2.0)
    found = []
    for matrix in (shared, written):
        backup = best_pairs(offsets, matrix, cost, values)
        safe = safe_minima(offsets, matrix, cost, fixed, fixed, values)
        products = [
            chosen_product(matrix, choice, x) for x in (values, values[:, None] * [1, 2, 3, 4])
        ]
        found.append((backup.minima, backup.choice, safe, *products, chosen_rows(matrix, choice)))
    assert_same(*found)


@pytest.mark.usefixtures("sharing")
def test_rows_that_hardly_repeat_are_written_out(monkeypatch):
    """Whether too many numbers differ for sharing to gain, or there is no room for them."""
    model = repeating_model(np.random.default_rng(1))
    every, pairs = np.arange(201, dtype=np.int32), np.arange(400, dtype=np.int32)
    rows = RowChoice(model, every, 201, pairs)
    monkeypatch.setattr(module, "MOST_CACHED", 8)
    assert isinstance(shared_live_rows(rows), sp.csr_array)
    monkeypatch.setattr(module, "MOST_CACHED", 512)
    monkeypatch.setattr(module, "_TIMES_SHARED", 1_000)
    assert isinstance(shared_live_rows(rows), sp.csr_array)


def navigation_at(costs):
    """A small grid whose pairs cost the given numbers in turn."""
    model, start = navigation(6, 5)
    priced = SSP.from_arrays(
        pair_offsets=model.pair_offsets,
        outcome_offsets=model.outcome_offsets,
        successors=model.successors,
        probabilities=model.probabilities,
        costs=np.repeat(np.resize(costs, model.n_pairs), np.diff(model.outcome_offsets)),
        goal_states=np.flatnonzero(model.goal_mask),
        treat_actionless_as_dead_ends=True,
    )
    return priced, model.index_of(start)


def measured(compiled):
    """What the best choice at a price comes to, and the same with other tails."""
    pricing = compiled.pricing()
    assert isinstance(pricing, LayeredPricing)
    found = pricing.minimise(25.0)
    assert found.choice is not None
    again = pricing.measure(found.choice, 20.0)
    return found.cost, found.failure, found.goal, again.cost, again.failure, again.goal


@pytest.mark.usefixtures("sharing")
@pytest.mark.parametrize("costs", [(1.0,), (1.0, 2.0, 3.0), (0.0, 1.0)])
@pytest.mark.parametrize("discount", [None, 0.97])
def test_a_choice_is_worth_the_same_forwards_and_backwards(
    monkeypatch, accelerate, costs, discount
):
    model, start = navigation_at(costs)
    monkeypatch.setattr(Sweep, "one_pass", None)
    problem = S3P(model, start, 0.9, discount=discount, cost_cap=30.0)
    forwards, backwards = both(accelerate, lambda: measured(problem.compile()))
    assert forwards == pytest.approx(backwards, rel=1e-13)


@pytest.mark.usefixtures("sharing")
@pytest.mark.parametrize("charge", [TOTAL_COST, ExcessCharge(7.5, 0.8)])
def test_sums_of_steps_are_followed_likewise(monkeypatch, accelerate, charge):
    model, start = navigation_at((2.0**0.5, 1.0, 0.5))
    monkeypatch.setattr(Sweep, "one_pass", None)
    begins = np.zeros(model.n_states)
    begins[start] = 1.0
    facts = GoalFacts(model, begins)
    layer = LayerAndTails(facts, counts_law=True, by_sums=True)
    compiled = CompiledLayered(facts, layer, charge, cap=14.0)
    forwards, backwards = both(accelerate, lambda: measured(compiled))
    assert forwards == pytest.approx(backwards, rel=1e-13)


@pytest.mark.parametrize("price", [3.0, 12.0, 30.0])
@pytest.mark.parametrize("cap", [12.0, 40.0])
def test_a_followed_choice_says_what_the_cap_costs(monkeypatch, accelerate, price, cap):
    """Without a second sweep, and never less than the two sweeps find."""
    model, start = navigation(6, 5)
    monkeypatch.setattr(Sweep, "one_pass", None)
    accelerate(True)
    pricing = S3P(model, start, 0.9, cost_cap=cap).compile().pricing()
    assert isinstance(pricing, LayeredPricing)
    proof = pricing.check(price, np.full(pricing.value_shape, np.inf))
    assert proof.choice is not None
    swept, followed = pricing.tail_loss(price), pricing.tail_loss(price, proof=proof)
    assert followed == pytest.approx(swept, rel=1e-9, abs=1e-14)
    assert (swept == 0.0) == (price <= cap)
