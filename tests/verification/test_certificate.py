"""Certificates, at the edge of budgets and of rows, too."""

from __future__ import annotations

import gzip
import json
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from scipy.optimize import linprog

import ssp_lp.verification.certify as certificates
from forged import AWAY, COST, DEAD, GOAL, state, verdict
from formulations import GUBS, MCMP, S3P, AlphaMCMP, CostBoundedReach, CostQuantile, CVaR, MaxProb
from mazes import MAZE
from refusing import refused
from small_models import model_of
from ssp_lp import (
    DeterministicPolicy,
    MixedPolicy,
    ModelError,
    certify,
    check_certificate,
    end_probability,
    secondary_cost,
    solve,
    write_certificate,
)
from ssp_lp.verification.checker import EXCESS
from ssp_lp.verification.lottery import best_mixture

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
        raise ModelError("the law of success costs takes too large a table")

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


# Rows of a certificate: forged excess is refused, honest lotteries keep rows as exactly.


DEAR = 10**15
FORGED = Fraction(1, 10**12)  # of a bound: by so much a lottery might once exceed it


def cheap_or_dear(path, excess, prices, v, cost=DEAR, **asked):
    """Action 0 is free and fails a little more than may; 1 never fails, for a huge cost."""
    half = (1 + excess) / 2
    both = state(free=([[str(1 - half), 1], [str(half), 2]], ["0"]), dear=([["1", 1]], [str(cost)]))
    rows = len(prices)
    taken = [str(half)] * rows
    proof = [{"v": str(v), "members": [[0, "1", "0", *taken]]}, AWAY, AWAY]
    asked = {"objective": COST, "failure": "0.5", **asked}
    return verdict(path, [both, GOAL, DEAD], {"prices": prices}, proof, **asked)


AT_LEAST = {"name": "often", "at_least": "0.5", "quantity": {
    "constant": "0", "terms": [["1", "end", "goal"]]}}  # fmt: skip


@pytest.mark.parametrize(("price", "v"), [(0, 0), (2000 * DEAR // 1001, 999 * DEAR // 1001)])
@pytest.mark.parametrize("asked", [{}, {"failure": None, "rows": [AT_LEAST]}])
def test_an_excess_that_pays_is_refused(price, v, asked, tmp_path):
    """The best lottery within the budget costs 1,000: not 0, and not "at least 999, at most 0"."""
    prices = [str(price)]
    said = cheap_or_dear(tmp_path / "x", FORGED, prices, v, **asked)
    assert said.reason.startswith("lottery <= bound of row ")


@pytest.mark.parametrize("cost", [10**15, 10**30, 10**33])
def test_prices_pay_for_what_a_lottery_takes(cost, tmp_path):
    """At an excess that is let pass no price makes "at least" more than "at most"."""
    excess = EXCESS / 2
    price = 2 * cost  # at which both actions are worth the same, but for the excess
    said = cheap_or_dear(tmp_path / "x", excess, [str(price)], cost, cost)
    assert (said.reason, said.lower, said.upper) == ("", -cost * excess, 0)
    assert said.exceeded == {"failure": excess / 2}
    assert "it is one for a bound that is so much looser" in str(said)
    higher = cheap_or_dear(tmp_path / "x", excess, [str(price)], cost + 1, cost)
    assert higher.reason.startswith("v <= c + sum p v at s")


def test_an_excess_beyond_what_is_let_pass(tmp_path):
    said = cheap_or_dear(tmp_path / "x", EXCESS * Fraction(11, 10), ["0"], 0)
    assert said.reason.startswith("lottery <= bound of row failure fails")
    tiny = cheap_or_dear(tmp_path / "x", EXCESS, ["0", "0"], 0, rows=[AT_LEAST])
    assert tiny.accepted


@pytest.mark.parametrize("seed", range(40))
def test_the_best_lottery_keeps_rows_exactly(seed):
    """Of random members, with rows that are met exactly, that contradict, or are stated twice."""
    rng = np.random.default_rng([seed, 41])
    members, rows = int(rng.integers(1, 6)), int(rng.integers(0, 4))
    costs = [Fraction(int(c)) for c in rng.integers(-5, 6, members)]
    beyond = [[Fraction(int(a), 7) for a in rng.integers(-4, 5, members)] for _ in range(rows)]
    beyond += [[-a for a in row] for row in beyond[: int(rng.integers(0, 2))]] + beyond[:1]
    table = np.array(beyond, dtype=float).reshape(-1, members)
    known = linprog(
        [float(c) for c in costs], table if len(table) else None,
        np.zeros(len(table)) if len(table) else None, np.ones((1, members)), [1.0],
    )  # fmt: skip
    weights = best_mixture(costs, beyond)
    assert bool(weights) == known.success
    if weights:
        assert min(weights) >= 0
        assert sum(weights) == 1
        assert all(sum(w * a for w, a in zip(weights, row, strict=True)) <= 0 for row in beyond)
        least = sum(w * c for w, c in zip(weights, costs, strict=True))
        assert float(least) == pytest.approx(known.fun, abs=1e-9)


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


def test_a_bound_below_every_policy_by_rounding_is_stated_as_it_is_kept(tmp_path):
    """No policy fails with less than 0.06: a file asks for that, and says so."""
    model = model_of({"x": {"go": [(0.94, "g", 2.0), (0.06, "d", 2.0)]}, "d": {}})
    asked = MCMP(model, "x", 0.05999999999999994)
    written = write_certificate(solve(asked), tmp_path / "one")
    assert written.asked == f"{asked!r}, but for rounding of failure"
    assert (written.lower, written.upper, written.exceeded) == (2, 2, {})
    question = json.loads(gzip.decompress((tmp_path / "one").read_bytes()).splitlines()[0])
    assert 0 < Fraction(question["failure"]) - Fraction("0.06") < Fraction(1, 10**15)
    assert check_certificate(tmp_path / "one") == written


def test_a_limit_that_is_broken_by_rounding(tmp_path):
    """An amount of fuel that every policy burns, asked for to a few units less."""
    model = model_of({"x": {"go": [(0.5, "g", 1.0), (0.5, "x", 1.0)]}})
    fuel = secondary_cost({"x": {"go": 0.3}})
    tight = MCMP(model, "x", 1.0, constraints={"fuel": fuel <= 0.6 - 2.0**-53})
    written = write_certificate(solve(tight), tmp_path / "one")
    assert (written.lower, written.upper, written.exceeded) == (2, 2, {})
    assert written.asked.endswith("but for rounding of fuel")


def test_a_share_of_surely_by_the_last_digit_of_its_number(tmp_path):
    """An end that comes surely, asked for with a little more than surely."""
    model = model_of({"x": {"go": [(1.0, "d", 1.0)]}, "d": {}}, labels={"crash": ["d"]})
    asked = {"end": end_probability("crash") >= 1.0 + 2.0**-52}
    written = write_certificate(solve(MaxProb(model, "x", constraints=asked)), tmp_path / "one")
    assert (written.lower, written.upper, written.exceeded) == (0, 0, {})
    assert written.asked.endswith("but for rounding of end")
