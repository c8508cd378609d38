"""Case S on a grid: costs split between two multiples of a unit bound the true optimum."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from examples.domains.domain import Domain
from examples.domains.windy_field import windy_field
from examples.formulating import real_costs
from examples.solver_comparison.instances import families
from formulations import S3P, MaxProb
from ssp_lp import SSP, CostAwarePolicy, certify, evaluate, solve
from ssp_lp.arrays import read_only
from ssp_lp.methods.rounding import is_split, with_split_costs
from ssp_lp.model.graph import dead_ends
from ssp_lp.problem import requirements
from ssp_lp.processes.rows import cost_means

EXACT, FEW = 20_000, 300  # totals that are told apart


def field(size: int, prices: int, seed: int) -> Domain:
    """A windy field with prices that share no unit."""
    drawn = np.random.default_rng(seed).uniform(0.5, 2.0, prices)
    return windy_field(size, prices=drawn.tolist(), seed=seed)


@pytest.mark.parametrize("unit", [Fraction(1, 7), Fraction(1, 4), Fraction(3)])
def test_splitting_keeps_every_mean(unit: Fraction) -> None:
    model = field(5, 40, 1).model
    split = with_split_costs(model, unit)
    ended = dead_ends(model) | model.goal_mask
    going_on = ~ended[split.successors]
    units = split.costs[going_on] / float(unit)
    np.testing.assert_allclose(units, np.rint(units), atol=1e-12)
    sums = np.add.reduceat(split.probabilities, split.outcome_offsets[:-1])
    np.testing.assert_allclose(sums, 1.0, rtol=1e-14)
    weights = np.random.default_rng(0).random(model.n_states)
    np.testing.assert_allclose(
        cost_means(split, weights), cost_means(model, weights), rtol=1e-13, atol=1e-15
    )


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("discount", [None, 0.97])
def test_both_sides_enclose_the_optimum(seed: int, discount: float | None) -> None:
    model, start = field(4, 5, seed)
    least = 1.0 - solve(MaxProb(model, start)).objective
    budget = [least, least + 0.05, 0.5, 0.9][seed % 4] if discount is None else 0.7
    exact = solve(S3P(model, start, budget, discount, cost_levels=EXACT))
    problem = S3P(model, start, budget, discount, cost_levels=FEW)
    if not is_split(problem, requirements(problem)):
        pytest.fail("this model was to be too rich for so few levels")
    found = solve(problem)
    assert found.lower_bound <= exact.objective * (1.0 + 1e-9)
    assert found.objective >= exact.lower_bound * (1.0 - 1e-9)
    assert found.gap < 2e-2
    members = [p for p in found.policy.policies if isinstance(p, CostAwarePolicy)]
    assert all(member.cap <= FEW for member in members)
    played = evaluate(found.policy, problem)
    assert played.objective == pytest.approx(found.objective, rel=1e-12)
    proof = certify(found)
    assert proof.accepted
    assert proof.lower_bound <= exact.objective * (1.0 + 1e-9)
    assert proof.gap <= 1.2 * found.gap + 1e-9


@pytest.mark.parametrize(
    "model",
    [
        families.hub(5, 9),
        families.ladder(3, 4),
        families.ring(30, leak=0.02),
        families.scattered(60),
        families.layered(8, 6),
    ],
    ids=["hub", "ladder", "ring", "scattered", "layered"],
)
@pytest.mark.parametrize("width", [None, 40])
def test_real_costs_on_every_structure(model: SSP, width: int | None) -> None:
    """Units far below a step, or, with few levels, far above it: both sides enclose the optimum."""
    problem = S3P(families.priced(model), 0, 0.3)
    found = solve(problem, tolerance=1e-3)
    assert found.gap <= 1e-3
    assert evaluate(found.policy, problem).objective == pytest.approx(found.objective, rel=1e-9)
    if width is not None:
        coarse = solve(replace(problem, cost_levels=width), tolerance=1e-3)
        assert coarse.lower_bound <= found.objective * (1.0 + 1e-9)
        assert coarse.objective >= found.lower_bound * (1.0 - 1e-9)


def test_a_thousand_prices_are_soon_settled() -> None:
    model, start = field(6, 1000, 0)
    found = solve(S3P(model, start, 0.4), tolerance=1e-5)
    assert found.gap <= 1e-5
    assert found.budget_used <= 0.4 + 1e-12


def test_finer_units_bring_the_bounds_together() -> None:
    model, start = field(6, 30, 2)
    gaps = [solve(S3P(model, start, 0.3, cost_levels=n)).gap for n in (60, 240, 960)]
    assert gaps[2] < 0.5 * gaps[1] < 0.25 * gaps[0]


def test_little_time_for_many_sums_gives_a_certified_answer_on_a_grid() -> None:
    problem = S3P(*real_costs.field(24, "3 prices"), 0.3)
    assert not is_split(problem, requirements(problem))
    found = solve(problem, time_limit=2.0)
    assert found.gap < 0.1
    proof = certify(found)
    assert proof.accepted
    assert proof.lower_bound <= proof.objective == pytest.approx(found.objective, rel=1e-12)


@pytest.mark.parametrize("levels", [1, 2, 3])
def test_no_more_totals_are_told_apart_than_asked(levels: int) -> None:
    model, start = field(4, 5, 0)
    exact = solve(S3P(model, start, 0.3, cost_levels=EXACT))
    found = solve(S3P(model, start, 0.3, cost_levels=levels))
    members = [p for p in found.policy.policies if isinstance(p, CostAwarePolicy)]
    assert all(member.cap <= levels for member in members)
    assert found.lower_bound <= exact.objective * (1.0 + 1e-9)
    assert found.objective >= exact.lower_bound * (1.0 - 1e-9)


def test_what_failing_steps_cost_changes_nothing() -> None:
    model, start = field(4, 30, 1)
    dear = np.where(dead_ends(model)[model.successors], 1e6, model.costs)
    dearer = replace(model, costs=read_only(dear), exact_costs={})
    asked = {"failure_budget": 0.4, "cost_levels": FEW}
    one, other = solve(S3P(model, start, **asked)), solve(S3P(dearer, start, **asked))
    assert other.objective == pytest.approx(one.objective, rel=1e-12)
    assert other.lower_bound == pytest.approx(one.lower_bound, rel=1e-12)


@pytest.mark.parametrize("share", [1.0, 0.7])
def test_rare_goals_are_measured_by_themselves(share: float) -> None:
    drawn, step = np.random.default_rng(0), 1e-9 ** (1 / 6)
    moves = {
        f"s{k}": {
            action: [(p, f"s{k + 1}", c * float(drawn.uniform(0.5, 2.0))), (1.0 - p, "pit", 1.0)]
            for action, p, c in [("safe", step, 3.0), ("quick", 0.9 * step, 1.0)]
        }
        for k in range(6)
    }
    model = SSP.from_transitions(
        {**moves, "pit": {}}, goal={"s6"}, treat_actionless_as_dead_ends=True
    )
    problem = S3P(model, "s0", reach_fraction=share, cost_levels=20)
    assert is_split(problem, requirements(problem))
    found = solve(problem)
    played = evaluate(found.policy, problem)
    assert played.objective == pytest.approx(found.objective, rel=1e-12)
    assert played.goal_probability >= share * 1e-9 * (1.0 - 1e-6)  # a budget near 1 is no finer


def test_a_gap_of_nothing_is_proved_at_once() -> None:
    model, start = field(4, 30, 2)
    least = 1.0 - solve(MaxProb(model, start)).objective
    found = solve(S3P(model, start, least, cost_levels=FEW))
    proof = certify(replace(found, lower_bound=found.objective))
    assert proof.accepted
    assert proof.gap <= 1e-9
