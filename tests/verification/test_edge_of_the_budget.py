"""Budgets within a few units in the last place of the least failure keep the proof they had."""

from dataclasses import replace

import numpy as np
import pytest

from formulations import MCMP, S3P, MaxProb
from small_models import model_of
from ssp_lp import certify, solve


def drawn(seed, rare=False):
    """A small model of whole costs; its probabilities are 1 down to 1e-10 where it is rare."""
    rng = np.random.default_rng(seed)
    states, table = int(rng.integers(*((1, 6) if rare else (3, 8)))), {"d": {}}
    for state in range(states):
        table[state] = {}
        for action in range(int(rng.integers(1, 4))):
            ends = rng.choice(states + 2, size=int(rng.integers(1, 4)), replace=False)
            size = len(ends)
            shares = 10.0 ** -rng.integers(0, 11, size) if rare else rng.random(size) + 0.05
            cost = float(rng.integers(1 if rare else 0, 4))
            names = [{states: "g", states + 1: "d"}.get(end, end) for end in ends.tolist()]
            moves = zip((shares / shares.sum()).tolist(), names, strict=True)
            table[state][action] = [(share, name, cost) for share, name in moves]
    return model_of(table)


@pytest.mark.parametrize("seed", [11, 12, 17, 24, 30, 57, 94, 105])
@pytest.mark.parametrize("criterion", [S3P, MCMP])
def test_a_budget_just_above_the_least_failure_is_proved_by_both(seed, criterion):
    model = drawn(seed)
    budget = 1.0 - solve(MaxProb(model, 0)).objective
    for units in range(8):
        solution = solve(criterion(model, 0, failure_budget=float(budget)))
        certificate = certify(solution)
        assert certificate.accepted
        assert certificate.gap <= max(1e-9, 10.0 * solution.gap), units
        budget = np.nextafter(budget, 2.0)


def test_a_lottery_that_beats_the_least_failure_by_rounding_keeps_the_proof():
    """Hardly any mass passes by 1, where failing early saves much: 1e-14 of it tells nothing."""
    on, stays, lost = 0.49693458213497843, 0.49799036259519697, 0.005075055269824562
    onward, back = 0.003391633322673214, 0.22417694165728505
    table = {
        0: {0: [(onward, 1, 0.0), (back, 1, 3.0), (0.7724314250200418, "d", 2.0)]},
        1: {
            0: [(on, 5, 0.0), (stays, 1, 1.0), (lost, "d", 0.0)],
            1: [(0.9999999999999999, 3, 1.0)],
        },
        3: {0: [(1.0, 5, 2.0)]},
        5: {1: [(1.0, "g", 3.0)]},
        "d": {},
    }
    for budget in (0.7724314250200417, 0.7724314250200418, 0.772431425020042):
        solution = solve(S3P(model_of(table), 0, failure_budget=budget))
        assert certify(solution).gap <= max(1e-9, 10.0 * solution.gap), budget


@pytest.mark.parametrize("seed", range(40))
def test_a_budget_below_a_rare_least_failure_by_rounding_is_accepted(seed):
    """A budget that counts as the least failure is that one, in the proof as in the search."""
    model = drawn(seed, rare=True)
    least = solve(MCMP(model, 0, failure_budget=None)).failure_probability
    for below in (9e-11, 1e-12, 1e-8 * least, 1e-12 * least):
        if least - below >= 0.0 and below <= 9e-11:
            certificate = certify(solve(MCMP(model, 0, failure_budget=least - below)))
            assert certificate.accepted, certificate


def test_a_policy_that_breaks_a_budget_no_policy_keeps_is_refused():
    model = drawn(11)
    budget = solve(MCMP(model, 0, failure_budget=None)).failure_probability
    assert budget > 0.01
    least = solve(MCMP(model, 0, failure_budget=budget))
    problem = MCMP(model, 0, failure_budget=0.5 * budget)
    assert "above the budget" in certify(replace(least, problem=problem)).reason
