"""Limits on accumulated costs, priced layer by layer: the same as on the process written out."""

import numpy as np
import pytest

import ssp_lp.column_generation.compiled_problem as compiled_problem
from formulations import GUBS, S3P, CostBoundedReach, CostQuantile, CVaR
from ssp_lp import SSP, InfeasibleError, certify, goal_probability, secondary_cost, solve, visits
from ssp_lp.accumulated_cost.written_out import OpenEnded
from ssp_lp.arrays import weighted
from ssp_lp.column_generation.layered_pricing import OpenEndedPricing
from ssp_lp.problem import compiled_constrained

_NEVER = 10**9  # entries of a layer


def drawn_model(rng: np.random.Generator) -> SSP:
    """Up to eight states with loops; every step costs one, two or three."""
    n = int(rng.integers(2, 9))
    transitions: dict = {}
    for state in range(n):
        transitions[state] = {}
        for action in range(int(rng.integers(1, 4))):
            reached = rng.choice([*range(n), "goal", "pit", "goal"], size=int(rng.integers(1, 4)))
            shares = rng.dirichlet(np.ones(len(reached)))
            transitions[state][f"a{action}"] = [
                (float(p), int(to) if to.isdigit() else str(to), float(rng.integers(1, 4)))
                for p, to in zip(shares, reached, strict=True)
            ]
    transitions[0]["go"] = [(0.6, "goal", 2.0), (0.2, "pit", 1.0), (0.2, 1, 1.0)]
    transitions["pit"] = {}
    return SSP.from_transitions(transitions, goal={"goal"}, treat_actionless_as_dead_ends=True)


def drawn_limits(model: SSP, rng: np.random.Generator) -> dict:
    """One to three limits."""
    fuel = np.round(rng.uniform(0.0, 2.0, model.n_pairs), 1)
    limits = [
        visits(0) <= float(rng.uniform(1.0, 2.5)),
        secondary_cost(fuel) <= float(rng.uniform(1.0, 8.0)),
        goal_probability() >= float(rng.uniform(0.1, 0.6)),
    ]
    return {f"limit {k}": limits[k] for k in range(3) if k == 0 or rng.random() < 0.6}


@pytest.mark.parametrize("seed", range(12))
def test_pricing_by_layers_is_pricing_on_the_process_written_out(seed: int) -> None:
    """Least priced totals, a policy's own totals and checked bounds, at prices some of them 0."""
    rng = np.random.default_rng(seed)
    model = drawn_model(rng)
    problem = S3P(model, 0, 0.4, constraints=drawn_limits(model, rng))
    compiled = compiled_constrained(problem)
    layered, written = compiled.augmented, compiled.explicit_pricing
    assert isinstance(layered, OpenEnded)
    counting = layered.counting()
    swept = OpenEndedPricing(layered, False, tuple(row.at(counting) for row in compiled.side))
    assert swept.value_shape == written.value_shape
    assert swept.n_rewards == written.n_rewards
    np.testing.assert_allclose(swept.first().figures, written.first().figures, rtol=1e-9)
    for _ in range(6):
        weights = rng.uniform(0.0, 30.0, swept.n_rewards) * (rng.random(swept.n_rewards) < 0.7)
        weights[0] = float(rng.integers(2))
        column, known = swept.minimise(weights), written.minimise(weights)
        least = float(known.figures @ weights)
        assert float(column.figures @ weights) == pytest.approx(least, rel=1e-9, abs=1e-9)
        bound = swept.prove(weights, column).bound
        assert bound <= least + 1e-12 * abs(least)
        assert bound == pytest.approx(least, rel=1e-9, abs=1e-9)
        again = swept.check(weights, swept.prove(weights, column).values).bound
        assert again == pytest.approx(bound, rel=1e-9, abs=1e-9)
        lowered = written.check(weights, weighted(known.totals, weights)).values - 1.0
        assert swept.check(weights, lowered).bound <= least


@pytest.mark.parametrize("seed", range(15))
def test_optima_by_layers_are_those_on_the_process_written_out(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(100 + seed)
    model = drawn_model(rng)
    limits, budget = drawn_limits(model, rng), float(rng.choice([0.2, 0.4, 0.7, 1.0]))
    discount = None if rng.random() < 0.7 else 0.95
    level, bound = float(rng.choice([0.5, 0.8])), float(rng.integers(3, 9))
    for problem in (
        S3P(model, 0, budget, discount=discount, constraints=limits),
        CVaR(model, 0, level, budget, constraints=limits),
        CostQuantile(model, 0, level, budget, constraints=limits),
        GUBS(model, 0, lambda cost: np.exp(-cost / 4.0), 0.5, constraints=limits),
        CostBoundedReach(model, 0, bound, budget, constraints=limits),
    ):
        found = []
        for least in (0, _NEVER):
            monkeypatch.setattr(compiled_problem, "_WORTH_SWEEPING", least)
            try:
                found.append(solve(problem))
            except InfeasibleError as error:
                found.append(error.least_failure)
        swept, written = found
        if isinstance(written, float):
            assert swept == written
            continue
        assert swept.objective == pytest.approx(written.objective, rel=1e-8, abs=1e-9)
        assert swept.gap <= max(1e-9, 2.0 * written.gap)
        proof = certify(swept)
        assert proof.accepted
        assert proof.gap <= max(1e-9, 2.0 * written.gap)


def test_the_open_end_of_a_slow_walk_is_bounded_by_a_constant() -> None:
    """Where failing is best beyond the cap, its price bounds all values, however long a walk is.

    Each step leads on with probability 1e-3 and back to the beginning else: 1e12 steps. The cost
    given success at a budget of 0.5 is that of the short way.
    """
    cells = 4
    transitions: dict = {
        0: {
            "short": [(0.6, "goal", 3.0), (0.4, "pit", 3.0)],
            "walk": [(1e-3, 1, 1.0), (1.0 - 1e-3, 0, 1.0)],
        }
    }
    for cell in range(1, cells):
        onward = cell + 1 if cell + 1 < cells else "goal"
        transitions[cell] = {"walk": [(1e-3, onward, 1.0), (1.0 - 1e-3, 0, 1.0)]}
    transitions["pit"] = {}
    model = SSP.from_transitions(transitions, goal={"goal"}, treat_actionless_as_dead_ends=True)
    solution = solve(S3P(model, 0, 0.5, constraints={"start": visits(0) <= 10.0}))
    assert solution.objective == pytest.approx(3.0, rel=1e-9)
    assert solution.gap <= 1e-9
