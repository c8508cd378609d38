"""Certificates, at the edge of budgets and of rows, too."""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import pytest
from scipy.optimize import linprog

import ssp_lp.verification.certify as certificates
from formulations import (
    GUBS,
    MCMP,
    S3P,
    AlphaMCMP,
    CostBoundedReach,
    CostQuantile,
    CVaR,
    LeastQuantity,
    MaxProb,
)
from mazes import MAZE
from refusing import refused
from small_models import model_of
from ssp_lp import (
    DeterministicPolicy,
    MixedPolicy,
    ModelError,
    SolverError,
    certify,
    end_probability,
    evaluate,
    expected_cost,
    secondary_cost,
    solve,
    write_certificate,
)
from ssp_lp.processes.failure_semantics import Aim
from ssp_lp.verification import exact_proof
from ssp_lp.verification.certify import certificate_of
from ssp_lp.verification.exact_proof import best_lottery
from ssp_lp.verification.prove import EXCESS, Row

# A certificate trusts nothing: corrupt each part of a solution in turn.


PROBLEMS = [
    MCMP(MAZE, start="start", failure_budget=0.07),
    MCMP(MAZE, start="start", failure_budget=0.07, discount=0.99),
    MCMP(MAZE, start="start", failure_budget=0.07, give_up="dead_ends"),
    S3P(MAZE, start="start", failure_budget=0.07),
    S3P(MAZE, start="start", failure_budget=0.12, discount=0.99),
]


@pytest.fixture(params=PROBLEMS, ids=lambda p: f"{type(p).__name__}-{p.discount}")
def solution(request):
    return solve(request.param)


def test_a_true_solution_is_certified(solution):
    certificate = certify(solution)
    assert certificate.accepted
    assert certificate.gap <= 1e-8
    assert certificate.budget_slack >= -1e-12
    assert certificate.objective == pytest.approx(solution.objective, rel=1e-12)
    assert certificate.lower_bound <= certificate.objective


def alone(solution, member):
    """The solution with one policy instead of its lottery."""
    return replace(solution, policy=MixedPolicy((member,), np.ones(1)))


def test_a_policy_that_breaks_the_budget_is_refused(solution):
    proofs = [certify(alone(solution, member)) for member in solution.policy.policies]
    riskiest = max(proofs, key=lambda proof: proof.failure)
    assert (riskiest.accepted, riskiest.gap) == (False, np.inf)
    assert "budget" in riskiest.reason


@pytest.mark.parametrize(
    "solution", [p for p in PROBLEMS if p.discount is None], indirect=True, ids=range(3)
)
def test_a_worse_policy_has_an_honest_gap(solution):
    detour = DeterministicPolicy.from_actions(MAZE, {"start": "detour", "town": "walk"})
    certificate = certify(alone(solution, detour))
    assert certificate.accepted
    assert certificate.objective == pytest.approx(11.0)
    assert certificate.lower_bound <= solution.objective + 1e-9
    assert certificate.gap >= 0.1


@pytest.mark.parametrize("factor", [0.0, 0.5, 0.999, 1.001, 2.0, 100.0])
def test_a_wrong_price_never_lifts_the_bound(solution, factor):
    assert solution.failure_price is not None
    certificate = certify(replace(solution, failure_price=factor * solution.failure_price))
    assert certificate.lower_bound <= solution.objective * (1.0 + 1e-12)
    assert certificate.gap >= certify(solution).gap


@pytest.mark.parametrize("price", [-1.0, float("nan"), float("inf")])
def test_an_impossible_price_is_refused(solution, price):
    assert not certify(replace(solution, failure_price=price)).accepted


def test_a_wrong_value_function_never_lifts_the_bound(solution):
    values, rng = solution.value_function, np.random.default_rng(0)
    nothing = [np.full_like(values, number) for number in (np.inf, np.nan)]
    drawn = [values + rng.normal(size=values.shape) for _ in range(5)]
    shuffled = [rng.permutation(values.ravel()).reshape(values.shape) for _ in range(5)]
    for wrong in (2.0 * values, 0.5 * values, -values, *nothing, *drawn, *shuffled):
        certificate = certify(replace(solution, value_function=wrong))
        assert certificate.lower_bound <= solution.objective * (1.0 + 1e-12)
    for wrong in (np.zeros(1), None):
        refused(None, certify, replace(solution, value_function=wrong))


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_least_failure_is_certified_too(criterion):
    certificate = certify(solve(criterion(MAZE, start="start", failure_budget=None)))
    assert certificate.accepted
    assert certificate.gap <= 1e-8
    assert certificate.failure == 0.0


def test_the_cap_of_case_s_is_reported():
    exact = certify(solve(S3P(MAZE, start="start", failure_budget=0.07)))
    assert exact.tail_gap <= 1e-9
    tight = certify(solve(S3P(MAZE, start="start", failure_budget=0.07, cost_cap=3.0)))
    assert tight.accepted
    assert tight.gap > 1e-3
    assert tight.tail_gap > 1e-3
    assert tight.lower_bound <= exact.objective <= tight.objective


RETRIES = model_of(
    {
        "a": {
            "fast": [(0.5, "goal", 1.0), (0.3, "a", 2.0), (0.2, "pit", 1.0)],
            "slow": [(0.4, "goal", 3.0), (0.55, "a", 1.0), (0.05, "pit", 1.0)],
        },
        "pit": {},
    },
    "goal",
)


@pytest.mark.parametrize(
    "problem",
    [
        CVaR(RETRIES, "a", 0.8, 0.3),
        CostQuantile(RETRIES, "a", 0.8, 0.3),
        GUBS(RETRIES, "a", lambda cost: np.exp(-cost / 5.0), 0.5),
        CostBoundedReach(RETRIES, "a", 6.0, 0.3),
    ],
    ids=["CVaR", "CostQuantile", "GUBS", "CostBoundedReach"],
)
def test_a_law_that_is_too_long_is_bounded_by_its_moments(problem, monkeypatch):
    """Then the certified value is no better than the exact one, and its bound holds."""

    def too_large(*given):
        raise ModelError("the distribution of success costs takes too large a table")

    solution = solve(problem)
    exact = certify(solution)
    monkeypatch.setattr(certificates, "evaluate_each", too_large)
    proof = certify(solution)
    assert proof.accepted
    if exact.upper_bound is None:
        assert proof.objective >= solution.objective - 1e-12
        assert proof.lower_bound <= solution.objective
    else:
        assert proof.objective <= solution.objective + 1e-12
        assert proof.upper_bound >= solution.objective
    assert proof.failure == pytest.approx(exact.failure)


# Budgets within a few units in the last place of the least failure keep the proof they had.


def drawn(seed, rare=False):
    """A small model of whole costs; its probabilities are 1 down to 1e-10 where it is rare."""
    rng = np.random.default_rng(seed)
    states, table = int(rng.integers(*((1, 6) if rare else (3, 8)))), {"d": {}}
    for place in range(states):
        table[place] = {}
        for action in range(int(rng.integers(1, 4))):
            ends = rng.choice(states + 2, size=int(rng.integers(1, 4)), replace=False)
            size = len(ends)
            shares = 10.0 ** -rng.integers(0, 11, size) if rare else rng.random(size) + 0.05
            cost = float(rng.integers(1 if rare else 0, 4))
            names = [{states: "g", states + 1: "d"}.get(end, end) for end in ends.tolist()]
            moves = zip((shares / shares.sum()).tolist(), names, strict=True)
            table[place][action] = [(share, name, cost) for share, name in moves]
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


# Rows of a certificate in a file: lotteries keep them exactly, as far as that is possible.


@pytest.mark.parametrize("seed", range(40))
def test_the_best_lottery_keeps_rows_exactly(seed):
    """Of random members, with rows that are met exactly, that contradict, or are stated twice.

    Its prices are such that no member is worth less at them; or all break the rows at them.
    """
    rng = np.random.default_rng([seed, 41])
    members, count, ratio = int(rng.integers(1, 6)), int(rng.integers(1, 4)), bool(seed % 2)
    low = 0 if ratio else -5  # a ratio is that of a cost
    costs = [Fraction(int(c)) for c in rng.integers(low, 6, members)]
    beyond = [[Fraction(int(a), 7) for a in rng.integers(-4, 5, members)] for _ in range(count)]
    beyond += [[-a for a in row] for row in beyond[: int(rng.integers(0, 2))]] + beyond[:1]
    if ratio:  # row 0 is failing, which is at most 1
        beyond[0] = [abs(a) for a in beyond[0]]
    rows = [Row(str(k), Fraction(1, 2 + k), Fraction(1, 2 + k)) for k in range(len(beyond))]
    taken = [[a + row.least for a in some] for some, row in zip(beyond, rows, strict=True)]
    goal = [1 - ratio * f for f in taken[0]]
    table = np.array(beyond, dtype=float).reshape(-1, members)
    known = linprog(
        [float(c) for c in costs], table, np.zeros(len(table)),
        np.array([list(map(float, goal))]), [1.0],
    )  # fmt: skip
    found = best_lottery(list(zip(costs, *taken, strict=True)), rows, Fraction(0), ratio=ratio)
    assert bool(found.weights) == known.success
    assert min(found.prices) >= 0
    worth = [c + sum(p * row[m] for p, row in zip(found.prices, beyond, strict=True))
             for m, c in enumerate(costs)]  # fmt: skip
    if found.weights:
        weights = found.weights
        assert min(weights) >= 0
        assert sum(w * g for w, g in zip(weights, goal, strict=True)) == 1
        assert all(sum(w * a for w, a in zip(weights, row, strict=True)) <= 0 for row in beyond)
        assert found.value == sum(w * c for w, c in zip(weights, costs, strict=True))
        assert float(found.value) == pytest.approx(known.fun, abs=1e-9)
        assert all(w >= found.value * g for w, g in zip(worth, goal, strict=True))
    else:
        assert all(w - c >= found.value * g
                   for w, c, g in zip(worth, costs, goal, strict=True))  # fmt: skip


def risky_or_safe(chance, cost, length=1):
    """A way of so many steps to a choice: a risk of this chance, or this cost more."""
    table = {f"way {k}": {"on": [(1.0, f"way {k + 1}", 1.0)]} for k in range(length)}
    table[f"way {length}"] = {
        "risky": [(1.0 - chance, "g", 1.0), (chance, "d", 1.0)],
        "safe": [(1.0, "g", cost)],
    }
    return model_of({**table, "d": {}})


@pytest.mark.parametrize("length", [1, 600])
@pytest.mark.parametrize(
    ("chance", "cost", "budget"),
    [(1e-9, 5.0, 1e-12), (0.5, 1e15, 0.25), (0.5, 1e15, 1e-12), (0.5, 2.0, 0.5), (0.3, 1e15, 0.3)],
)
def test_tiny_budgets_and_huge_costs(length, chance, cost, budget, tmp_path):
    """The lottery takes the risk as often as it may; 600 states have no proof in fractions."""
    model = risky_or_safe(chance, cost, length)
    written = write_certificate(solve(MCMP(model, "way 0", budget)), tmp_path / "one")
    share = Fraction(str(budget)) / Fraction(str(chance))
    known = length + 1 + (1 - share) * (Fraction(str(cost)) - 1)
    assert written.exceeded == {}
    assert written.lower <= known <= written.upper
    assert written.upper - written.lower <= known / 10**15


@pytest.mark.parametrize("length", [1, 600])
@pytest.mark.parametrize(("low", "high"), [(0.1, 0.1), (0.25, 0.25), (0.1, 0.2)])
def test_limits_from_both_sides(length, low, high, tmp_path):
    """Of 600 states and in decimals a row that is met exactly is exceeded by next to nothing."""
    model = risky_or_safe(0.5, 3.0, length)
    few = {"few": end_probability("d") <= high, "some": end_probability("d") >= low}
    written = write_certificate(solve(MCMP(model, "way 0", 1.0, constraints=few)), tmp_path / "one")
    known = length + 1 + (1 - 2 * Fraction(str(high))) * 2
    assert written.lower <= known <= written.upper + Fraction(1, 10**20)
    assert all(excess <= EXCESS for excess in written.exceeded.values())


@pytest.mark.parametrize("length", [1, 600])
@pytest.mark.parametrize("chance", [1e-12, 3e-9, 0.1])
def test_least_failures_that_are_tiny(length, chance, tmp_path):
    """No way is without risk: the least failure is proved as nearly as it is small."""
    table = {f"way {k}": {"on": [(1.0, f"way {k + 1}", 1.0)]} for k in range(length)}
    table[f"way {length}"] = {
        "less": [(1.0 - chance, "g", 1.0), (chance, "d", 1.0)],
        "more": [(1.0 - 2.0 * chance, "g", 0.5), (2.0 * chance, "d", 0.5)],
    }
    model = model_of({**table, "d": {}})
    for problem in (MCMP(model, "way 0", None), S3P(model, "way 0", None)):
        written = write_certificate(solve(problem), tmp_path / "one")
        assert written.lower <= length + 1 <= written.upper
        assert all(excess <= EXCESS * Fraction(str(chance)) for excess in written.exceeded.values())
    share = write_certificate(solve(AlphaMCMP(model, "way 0", 0.5)), tmp_path / "one")
    assert share.lower <= share.upper
    most = write_certificate(solve(MaxProb(model, "way 0")), tmp_path / "one")
    assert most.lower <= 1 - Fraction(str(chance)) <= most.upper


def test_a_quantile_without_a_limit_of_failure_needs_failing_surely_to_the_last_digit(tmp_path):
    """A bound of failing surely that lies below 0 by a unit proves nothing of a ratio."""
    way = {"safe": [(1.0, "g", 0.0)], "on": [(1.0, "y", 0.0)]}
    risk = {"risk": [(6 / 7, "d", 1.0), (1 / 7, "g", 2.0)]}
    problem = CostQuantile(model_of({"x": way, "y": risk, "d": {}}), "x", 0.8, 1.0)
    written = write_certificate(solve(problem), tmp_path / "one")
    assert (written.lower, written.upper) == (0, 0)


def test_a_program_too_large_to_keep_is_proved_alike(tmp_path, monkeypatch):
    """Columns at totals are built when they are needed; the bounds agree but for the room."""
    solution = solve(S3P(MAZE, "start", 0.1))
    kept = write_certificate(solution, tmp_path / "one")
    monkeypatch.setattr(exact_proof, "_MANY", 0)
    built = write_certificate(solution, tmp_path / "two")
    assert max(kept.lower, built.lower) <= min(kept.upper, built.upper)
    assert built.upper - built.lower <= Fraction(1, 10**9)


@pytest.mark.parametrize("written", [True, False])
def test_a_bound_below_every_policy_by_rounding_is_told(written, tmp_path):
    """No policy fails with less than 0.06; a fuel that every policy burns, but for some units."""
    model = model_of({"x": {"go": [(0.94, "g", 2.0), (0.06, "d", 2.0)]}, "d": {}})
    asked = MCMP(model, "x", 0.06 if written else 0.05999999999999994)
    loop = model_of({"x": {"go": [(0.5, "g", 1.0), (0.5, "x", 1.0)]}})
    fuel = secondary_cost({"x": {"go": 0.3}})
    most = 0.6 if written else 0.6 - 2.0**-53
    for problem, row in (
        (asked, "failure"), (MCMP(loop, "x", 1.0, constraints={"fuel": fuel <= most}), "fuel")
    ):  # fmt: skip
        if written:
            proved = write_certificate(solve(problem), tmp_path / "one")
            assert (proved.lower, proved.upper, proved.exceeded) == (2, 2, {})
        else:
            words = f"no policy satisfies row {row!r} exactly"
            refused(words, write_certificate, solve(problem), tmp_path / "one", error=SolverError)


# What certify lets pass, and what not.


def test_a_budget_is_kept_but_for_rounding():
    """A policy 5e-13 above its budget is accepted, one 5e-12 above it is not."""
    solution = solve(MCMP(risky_or_safe(0.5, 3.0), "way 0", 0.25))
    for beyond, accepted in ((5e-13, True), (5e-12, False)):
        problem = replace(solution.problem, failure_budget=0.25 - beyond)
        assert certify(replace(solution, problem=problem)).accepted == accepted


def test_a_limit_that_the_policy_breaks_is_named():
    """A policy that meets 0.25 exactly is refused where 0.2 is allowed."""
    few = {"few": end_probability("d") <= 0.25}
    solution = solve(MCMP(risky_or_safe(0.5, 3.0), "way 0", 1.0, constraints=few))
    assert certify(solution).accepted
    fewer = replace(solution.problem, constraints={"few": end_probability("d") <= 0.2})
    reason = certify(replace(solution, problem=fewer)).reason
    assert reason == "the policy spends 0.25 of 'few', 0.2 allowed"


@dataclass(frozen=True)
class LeastCostOfReaching(LeastQuantity):
    """A quantity takes the place of the objective, here of the goal probability."""

    aim = Aim.GREATEST_GOAL


def test_a_quantity_is_minimised_whatever_its_formulation_aims_at():
    """Half of the runs take the risk of 1/2: the cost is 1 + 1 + 1/2 * 2, bounded from below."""
    problem = LeastCostOfReaching(risky_or_safe(0.5, 3.0), "way 0", expected_cost(), 0.25)
    certificate = certify(solve(problem))
    assert certificate.upper_bound is None
    assert certificate.lower_bound <= 3.0
    assert (certificate.objective, certificate.gap) == pytest.approx((3.0, 0.0), abs=1e-9)


@pytest.mark.parametrize(
    ("changed", "above", "words"),
    [
        ({}, False, ""),
        ({}, True, ""),
        ({"objective": np.nan, "goal_probability": 0.0}, False, "the goal is never reached"),
        ({"objective": np.nan}, False, "the policy's objective is nan"),
        ({"objective": np.inf}, True, "the policy's objective is inf"),
        ({"objective": 2.0 - 1e-8}, False, "value 1.99999999 lies below its bound 2.0"),
        ({"objective": 2.0 + 1e-8}, True, "value 2.00000001 lies above its bound 2.0"),
        ({"objective": np.nan, "failure_probability": 0.3}, False, "fails with 0.3, above the"),
    ],
)
def test_a_verdict_names_what_contradicts_a_bound_of_2(changed, above, words):
    """No policy is better than a proved bound, nor worth anything if it is not a number."""
    solution = solve(MaxProb(risky_or_safe(0.5, 3.0), "way 0"))
    attained = evaluate(solution.policy, solution.problem)
    attained = replace(attained, **({"objective": 2.0, "failure_probability": 0.2} | changed))
    verdict = certificate_of(attained, 2.0, 0.25, above=above)
    assert verdict.accepted == (not words)
    assert words in verdict.reason
    assert verdict.gap == (np.inf if words else 0.0)
    assert (verdict.upper_bound is None) == (not above)
