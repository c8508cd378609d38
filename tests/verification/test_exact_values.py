"""The writer's exact values and lotteries, against policies enumerated in fractions."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from formulations import MCMP, S3P, MinCost
from refusing import refused
from small_models import model_of
from ssp_lp import DeterministicPolicy, MixedPolicy, SolverError, solve
from ssp_lp.verification import certificate_file, exact_proof
from ssp_lp.verification.certificate_file import certificate_of
from ssp_lp.verification.certificate_lines import check
from ssp_lp.verification.exact_proof import (
    ONE,
    _best_of_block,
    _dynamics_of,
    _of_few_digits,
    _Way,
    best_lottery,
    best_values,
    lower_bound,
    near_choice,
    solved,
    sub_solution,
)
from ssp_lp.verification.prove import Row


def exact_values(chosen):
    """The values of nodes with one way each, by elimination in fractions."""
    n = len(chosen)
    rows = [[Fraction(i == j) for j in range(n)] + [Fraction(way.own, way.total)]
            for i, way in enumerate(chosen)]  # fmt: skip
    for i, way in enumerate(chosen):
        for a, j in way.outcomes:
            rows[i][j] -= Fraction(a, way.total)
    for k in range(n):
        pivot = next(i for i in range(k, n) if rows[i][k])
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [x / rows[k][k] for x in rows[k]]
        for i in range(n):
            if i != k and rows[i][k]:
                rows[i] = [x - rows[i][k] * y for x, y in zip(rows[i], rows[k], strict=True)]
    return [row[-1] for row in rows]


def drawn(seed, cost=6):
    """Ways of some nodes, each of which ends with some probability; the last may end at once."""
    rng = np.random.default_rng([seed, 44])
    nodes, ways = int(rng.integers(2, 5)), []
    for node in range(nodes):
        for _ in range(int(rng.integers(1, 4))):
            ends, total = bool(rng.random() < 0.2), int(rng.integers(2, 12))
            place = rng.choice(nodes, size=min(2, nodes), replace=False).tolist()
            left = total - 1
            outcomes = []
            for j in place:
                a = int(rng.integers(0, left + 1))
                left -= a
                outcomes += [(a, j)] if a and not ends else []
            price = Fraction(int(rng.integers(-1, cost)), int(rng.integers(1, 8)))
            ways.append(_Way(node, total, outcomes, int(price * total * ONE // 1)))
    return ways


def optimal(ways):
    """The least value of each node over all policies."""
    nodes = ways[-1].node + 1
    of = [[way for way in ways if way.node == i] for i in range(nodes)]
    each = [exact_values(chosen) for chosen in product(*of)]
    return [min(values) for values in zip(*each, strict=True)]


def first_ways(ways):
    """The number of each node's first way."""
    return [next(n for n, way in enumerate(ways) if way.node == i)
            for i in range(ways[-1].node + 1)]  # fmt: skip


def allowed(ways, values):
    """Whether each inequality v <= own + mean v holds, in whole numbers."""
    return all(
        values[node] * total <= own + sum(a * values[j] for a, j in outcomes)
        for node, total, outcomes, own in ways
    )


@pytest.mark.parametrize("seed", range(40))
def test_values_are_allowed_and_next_to_the_greatest(seed):
    """No value is above the optimum, nor below it by 1e-27 of the greatest; the choice attains it.

    Where ending at once is best, its cost is the value, to the last digit, if that is allowed.
    """
    ways = drawn(seed)
    best, room = optimal(ways), 2 * Fraction(ONE, 10**28)
    choice, values = sub_solution(ways, near_choice(ways, _dynamics_of(ways, ways[-1].node + 1)))
    size = max(1, *(abs(v) / ONE for v in best))
    assert allowed(ways, values)
    for value, known in zip(values, best, strict=True):
        assert known - room * size <= value <= known
    attained = exact_values([ways[n] for n in choice])
    assert [ways[n].node for n in choice] == list(range(len(best)))
    assert all(abs(a - b) <= 10**16 for a, b in zip(attained, best, strict=True))
    for i, known in enumerate(best):
        ends = [w.own // w.total for w in ways if w.node == i and not w.outcomes]
        if ends and min(ends) == known != values[i]:
            assert not allowed(ways, [*values[:i], min(ends), *values[i + 1 :]])
    for begin in (first_ways(ways), choice):
        again = best_values(ways, begin)
        assert all(abs(a - b) <= 10**16 for a, b in zip(again[1], best, strict=True))
        assert min(again[2]) >= -(10**15)
        known = [(w.own + sum(a * again[1][j] for a, j in w.outcomes)) // w.total - again[1][w.node]
                 for w in ways]  # fmt: skip
        assert again[2] == known


@pytest.mark.parametrize("seed", range(20))
def test_equations_hold_up_to_some_units(seed):
    """Of any policy, and of values of very many digits; a sum of ways that end is a quotient."""
    ways = drawn(seed, cost=10 ** (1 + seed % 5 * 3))
    chosen = [ways[n] for n in first_ways(ways)]
    values = solved(chosen)
    for way, value in zip(chosen, values, strict=True):
        lack = way.own + sum(a * values[j] for a, j in way.outcomes) - way.total * value
        assert abs(lack) <= 4 * way.total
    known = exact_values(chosen)
    assert all(abs(a - b) <= 10**4 for a, b in zip(values, known, strict=True))
    ends = [way._replace(outcomes=[]) for way in chosen]
    assert solved(ends) == [way.own // way.total for way in ends]


def test_without_outcomes_the_cheapest_way_is_taken():
    """Values are rounded down to 1e-30."""
    third = ONE // 3
    ways = [_Way(0, 1, [], 2 * ONE), _Way(0, 3, [], 3 * third), _Way(1, 2, [], -ONE)]
    choice, values = sub_solution(ways, ())
    assert choice == [1, 2]
    assert values == [third // 10**30 * 10**30, -ONE // 2]
    assert list(_best_of_block(ways)) == [(values[0], 1), (values[1], 2)]
    free = [way._replace(own=0, outcomes=[(1, 0)]) for way in ways]
    assert sub_solution(free, [0, 2]) == ([0, 2], [0, 0])


def test_the_nodes_of_a_free_cycle_have_one_value():
    """0 and 1 lead to each other for nothing; from 0 one leaves for 5, from 1 for 3; 2 asks 1 more.

    The best way from 0 is that to 1, and the value of 2 is 1 + 3 / 2.
    """
    ways = [
        _Way(0, 1, [(1, 1)], 0), _Way(0, 1, [], 5 * ONE), _Way(1, 1, [(1, 0)], 0),
        _Way(1, 1, [], 3 * ONE), _Way(2, 2, [(1, 0)], 2 * ONE),
    ]  # fmt: skip
    assert list(_best_of_block(ways)) == [(3 * ONE, 0), (3 * ONE, 3), (5 * ONE // 2, 4)]
    dear = [way._replace(own=1) if way.outcomes and not way.own else way for way in ways]
    assert [w for _, w in _best_of_block(dear)] == [0, 3, 4]


def test_what_no_policy_leaves_has_no_values(monkeypatch):
    ways = [_Way(0, 1, [(1, 0)], ONE)]
    refused("from some states no run can end", near_choice, ways, _dynamics_of(ways, 1),
            error=SolverError)  # fmt: skip
    ways = drawn(3)
    monkeypatch.setattr(exact_proof, "_IMPROVEMENTS", 0)
    refused("policy iteration does not end", best_values, ways, first_ways(ways),
            error=SolverError)  # fmt: skip


def test_a_price_of_few_digits_is_no_greater():
    for price in (Fraction(2, 3), Fraction(-2, 3), Fraction(5), Fraction(1, 10**40)):
        short = _of_few_digits(price)
        assert price - Fraction(1, 10**30) < short <= price
        assert (short * 10**30).denominator == 1


def test_a_bound_of_a_ratio():
    """N + p F >= b: with F <= 1/4, N / (1 - F) is at least p if b >= 3/4 p, else 4/3 b."""
    objective = SimpleNamespace(constant=Fraction(1, 2))

    def bound(ratio, begin, *prices, rows=(Fraction(1, 4), Fraction(3))):
        program = SimpleNamespace(objective=objective, question={"ratio": ratio})
        return lower_bound(program, [Fraction(p) for p in prices], begin, rows)

    assert bound(False, 2 * ONE, 4, 0) == Fraction(5, 2) - 1
    assert bound(False, 2 * ONE, 4, 1) == Fraction(5, 2) - 1 - 3
    assert bound(True, 4 * ONE, 4, 0) == 4  # 7/2 is at least 3
    assert bound(True, 2 * ONE, 4, 0) == Fraction(4, 3) * Fraction(3, 2)
    assert bound(True, 7 * ONE // 2, 4, 0) == 4  # equal to 3
    sure = (Fraction(1), Fraction(3))
    assert bound(True, 2 * ONE, 4, 0, rows=sure) is None
    assert bound(True, 4 * ONE, 4, 0, rows=sure) == 4


STAYS = model_of({"x": {"stay": [(1.0, "x", 4.0)], "go": [(0.5, "g", 1.0), (0.5, "x", 1.0)]}})
REST = model_of({"x": {"stay": [(1.0, "x", 0.0)], "go": [(0.5, "g", 1.0), (0.5, "d", 1.0)]},
                 "d": {}})  # fmt: skip
REST_OR_GO = {"stay": [(1.0, "y", 0.0)], "go": [(0.5, "g", 1.0), (0.5, "d", 1.0)]}


@pytest.mark.parametrize(
    ("problem", "decision"),
    [(MinCost(STAYS, "x"), None), (MCMP(STAYS, "x", 0.5, give_up="dead_ends"), "stay"),
     (MCMP(STAYS, "x", 0.5), "stay"), (MCMP(STAYS, "x", 0.5, give_up="dead_ends"), None)],
    ids=["gives up where failing is forbidden", "stays for ever at a cost",
         "stays for ever where it might give up", "gives up nowhere"],
)  # fmt: skip
def test_a_policy_that_stops_where_it_may_not(problem, decision):
    honest = solve(problem)
    assert certificate_of(honest)
    where = STAYS.index_of("x")
    pair = -1 if decision is None else int(STAYS.pair_offsets[where])
    forged = DeterministicPolicy(STAYS, np.where(np.arange(STAYS.n_states) == where, pair, -1))
    forged = replace(honest, policy=MixedPolicy((forged,), np.ones(1)))
    words = "the answer is not proved: a policy gives up where this is forbidden"
    refused(words, certificate_of, forged, error=SolverError)


@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_a_policy_that_stays_for_nothing_waits(criterion):
    """Half of the runs may fail: waiting for ever costs nothing, and is a column of its own."""
    problem = criterion(REST, "x", 0.9)
    stays = DeterministicPolicy.from_actions(REST, {"x": "stay"})
    honest = solve(problem)
    members = (stays, *honest.policy.policies)
    lottery = MixedPolicy(members, np.full(len(members), 1.0 / len(members)))
    lines = certificate_of(replace(honest, policy=lottery))
    bounds, _, _ = check(lambda: iter(lines))
    assert bounds.lower <= bounds.upper <= bounds.lower + Fraction(1, 10**19)
    assert float(bounds.upper) == pytest.approx(honest.objective, abs=1e-15)


# The master program, and members beyond the cap.


@pytest.mark.parametrize("bound", [Fraction(1, 2), Fraction(-1, 2), Fraction(7), Fraction(-7)])
def test_a_row_may_be_exceeded_by_a_share_of_its_bound_or_of_1(bound):
    """By a tenth here; beyond that no lottery satisfies it, and a price shows it."""
    edge, row = bound + min(abs(bound), Fraction(1)) / 10, Row("row", bound, bound)
    for value, feasible in ((edge, True), (edge + Fraction(1, 10**9), False)):
        found = best_lottery([[Fraction(3), value]], [row], Fraction(1, 10), ratio=False)
        assert bool(found.weights) == feasible
        assert feasible or found.prices == [1 / (value - edge)] or found.prices[0] > 0
    exact = best_lottery([[Fraction(3), bound]], [row], Fraction(0), ratio=False)
    assert (exact.weights, exact.value) == ([1], 3)


def test_a_member_that_never_succeeds_takes_no_part_in_a_ratio():
    """It costs nothing and fails surely; 3 with success 1/2 is a ratio of 6."""
    members = [[Fraction(0), Fraction(1)], [Fraction(3), Fraction(1, 2)]]
    row = Row("failure", Fraction(1), Fraction(1))
    found = best_lottery(members, [row], Fraction(0), ratio=True)
    assert found.value == 6
    assert found.weights[1] * Fraction(1, 2) == 1


@pytest.mark.parametrize("cap", [1, 2, 5, 6, 11, 40])
def test_a_way_beyond_the_cap_is_followed_to_its_end(cap, monkeypatch):
    """Two steps of 5, of which none, one or both end below the cap; and half of a loop of 1."""
    monkeypatch.setattr(certificate_file, "_first_cap", lambda *given: Fraction(cap))
    way = {"x": {"on": [(1.0, "y", 5.0)]}, "y": {"on": [(1.0, "g", 5.0)]}}
    loop = {"x": {"go": [(0.5, "g", 1.0), (0.5, "x", 1.0)]}}
    for table, known in ((way, 10), (loop, 2)):
        lines = certificate_of(solve(S3P(model_of(table), "x", 0.5)))
        bounds, _, _ = check(lambda lines=lines: iter(lines))
        assert bounds.lower <= known <= bounds.upper
        assert bounds.upper - bounds.lower < Fraction(1, 10**19)


@pytest.mark.parametrize("cap", [1, 4, 20])
def test_a_policy_that_waits_beyond_the_cap(cap, monkeypatch):
    """It pays 3 and rests for ever; the other one goes on, and arrives with 1/2 for 4."""
    monkeypatch.setattr(certificate_file, "_first_cap", lambda *given: Fraction(cap))
    model = model_of({"x": {"on": [(1.0, "y", 3.0)]}, "y": REST_OR_GO, "d": {}})
    honest = solve(S3P(model, "x", 0.75))
    rests = DeterministicPolicy.from_actions(model, {"x": "on", "y": "stay"})
    members = (rests, *honest.policy.policies)
    lottery = MixedPolicy(members, np.full(len(members), 1.0 / len(members)))
    lines = certificate_of(replace(honest, policy=lottery))
    bounds, _, _ = check(lambda: iter(lines))
    assert bounds.lower <= 4 <= bounds.upper <= bounds.lower + Fraction(1, 10**18)


@pytest.mark.parametrize("cap", [1, 2, 4, 20])
def test_what_exceeds_the_cap_waits_where_its_node_does(cap, monkeypatch):
    """Half of the runs arrive for 3, the others come to where one may rest for ever for nothing."""
    monkeypatch.setattr(certificate_file, "_first_cap", lambda *given: Fraction(cap))
    table = {"x": {"on": [(0.5, "g", 3.0), (0.5, "y", 3.0)]}, "y": REST_OR_GO, "d": {}}
    model = model_of(table)
    honest = solve(S3P(model, "x", 0.5))
    rests = DeterministicPolicy.from_actions(model, {"x": "on", "y": "stay"})
    members = (rests, *honest.policy.policies)
    lottery = MixedPolicy(members, np.full(len(members), 1.0 / len(members)))
    for policy in (lottery, MixedPolicy((rests,), np.ones(1))):
        lines = certificate_of(replace(honest, policy=policy))
        bounds, _, _ = check(lambda lines=lines: iter(lines))
        assert bounds.lower <= 3 <= bounds.upper <= bounds.lower + Fraction(1, 10**18)
