"""The law of success costs: closed forms, runs of millions of steps, and its edges."""

from decimal import ROUND_CEILING, Decimal, localcontext
from fractions import Fraction
from itertools import pairwise
from math import exp, inf, isnan, log, sqrt

import numpy as np
import pytest

from formulations import (
    EGUBS,
    GUBS,
    S3P,
    CostBoundedReach,
    CostQuantile,
    CVaR,
)
from laws import law_of, one_way
from small_models import model_of
from ssp_lp import (
    GIVE_UP,
    DeterministicPolicy,
    MixedPolicy,
    ModelError,
    cross_check,
    evaluate,
    simulate,
    solve,
    success_costs,
    trace_frontier,
)
from ssp_lp.accumulated_cost import arrivals as following, cost_law
from ssp_lp.accumulated_cost.charges import ExpectedArrivalCost
from ssp_lp.policies.chain import policy_chain
from written_models import written

WALK = written(
    """
    a slow: 0.5 b 1, 0.5 a 1
    a fast: 0.6 G 2, 0.3 b 1, 0.1 pit 1
    a wait: a 1
    b on: 0.9 G 1, 0.1 a 2
    b jump: 0.7 G 0, 0.3 pit 0
    pit stuck: pit 3
    """,
    "G",
)
WAITING = DeterministicPolicy.from_actions(WALK, {"a": "wait"})


# Closed forms


def test_tries_until_success_are_geometric():
    """P(C = n) = p (1 - p)^(n - 1), tail q^n, E[(C - n)^+] = q^n / p."""
    p, q = 0.3, 0.7
    law = one_way([(p, "G", 1), (q, "a", 1)])
    costs, masses = law.upto(40)
    assert costs.tolist() == list(range(1, 41))
    assert masses == pytest.approx([p * q ** (n - 1) for n in range(1, 41)], rel=1e-12)
    for n in (0, 1, 7, 300):
        assert law.within(n) == pytest.approx(1 - q**n, rel=1e-13)
    for n in (0, 1, 7, 100):  # summed from what waits, not left over from a difference
        assert law.excess(n) == pytest.approx(q**n / p, rel=1e-11)
    assert law.excess(2.5) == pytest.approx(q**2 / p - 0.5 * q**2)
    assert law.quantile(0.95) == np.ceil(log(0.05) / log(q))
    value = p * exp(-0.2) / (1 - q * exp(-0.2))
    assert law.exponential(-0.2) == pytest.approx(value, rel=1e-13)
    assert law.expectation(lambda c: np.exp(-0.2 * c), 0.0) == pytest.approx(value, rel=1e-12)
    assert law.tail_mean(1 - q**5) == pytest.approx(5 + 1 / p, rel=1e-9)
    assert law.tail_mean(1 - q**60) == pytest.approx(60 + 1 / p, rel=1e-6)


@pytest.mark.parametrize(("level", "value"), [(0.95, 1.0), (0.9500001, 100.0), (0.0, 1.0)])
def test_a_level_at_an_atoms_edge(level, value):
    """Mass 0.95 has level 0.95, whatever the sum of its parts is rounded to."""
    parts = [(0.05, "b", 1.0)] * 19 + [(0.05, "b", 100.0)]
    law = one_way(parts, b={"go": [(1.0, "G", 0.0)]})
    assert law.quantile(level) == value
    assert law.quantile(0.95 * (1 - 1e-9)) == 1.0


@pytest.mark.parametrize("chance", [0.3, 0.05, 0.1])
def test_levels_that_a_geometric_law_attains_exactly(chance):
    """Summed in floats, 1 - 0.7^6 comes out below itself: the quantile is 6 all the same."""
    law = one_way([(chance, "G", 1), (1 - chance, "a", 1)])
    for n in range(1, 12):
        level = float(1 - (1 - Fraction(repr(chance))) ** n)
        assert (law.quantile(level), law.quantile(level + 1e-9)) == (n, n + 1)


def test_a_level_at_an_edge_given_success():
    """0.76 of a goal probability of 0.8 is level 0.95."""
    parts = [(0.04, "G", 1)] * 19 + [(0.04, "G", 9), (0.2, "pit", 5)]
    law = one_way(parts, pit={})
    assert law.goal == pytest.approx(0.8)
    assert law.quantile(0.95) == 1.0
    assert (law.tail_mean(0.95), law.tail_mean(0.9)) == pytest.approx((9.0, 5.0))


def test_three_tenths_are_within_three_tenths():
    """0.1 + 0.1 + 0.1 exceeds 0.3 in floats, not here; numpy's floats are floats."""
    law = law_of(
        written("a go: b 0.1\n b go: c 0.1\n c go: G 0.1", "G"), dict.fromkeys("abc", "go")
    )
    for bound in (0.3, np.float64(0.3), Fraction(3, 10), 0.1 + 0.2):
        assert law.within(bound) == 1.0
    for bound in (0.29999999999999993, Fraction(3, 10) - Fraction(1, 10**30)):
        assert law.within(bound) == 0.0
    assert law.quantile(0.5) == 0.3
    assert law.upto(0.3).costs.tolist() == [0.3]


def test_thirds_given_as_fractions():
    """A quantile is the float of a fraction, and is within itself."""
    third = Fraction(1, 3)
    law = one_way([(0.5, "G", third), (0.25, "G", 2 * third), (0.25, "a", third)])
    for level in (0.4, 0.6, 0.9, 0.99):
        value = law.quantile(level)
        assert law.within(value) >= level > law.within(value * (1 - 1e-12))
    assert law.within(2 * third) == law.within(2 / 3) == pytest.approx(0.875)


def test_the_quantile_of_a_lottery_is_that_of_the_mixture():
    """Half 1 and half 10: the median is 1 and the 3/4-quantile 10, no mean of both."""
    model = written("a x: G 1\n a y: G 10", "G")
    members = [DeterministicPolicy.from_actions(model, {"a": u}) for u in "xyx"]
    law = success_costs(MixedPolicy(members, np.array([0.5, 0.5, 0.0])), S3P(model, start="a"))
    assert (law.quantile(0.5), law.quantile(0.75)) == (1.0, 10.0)
    assert law.tail_mean(0.25) == pytest.approx((0.25 * 1 + 0.5 * 10) / 0.75)
    assert law.conditional_mean == pytest.approx(5.5)


@pytest.mark.parametrize("kind", ["dense", "sparse", "cyclic"])
def test_larger_chains_against_powers_of_their_matrix(kind):
    """Of unit costs P(C = n) = start Q^(n-1) h, whichever way the mass is sent on."""
    n, rng = 40, np.random.default_rng(5)
    matrix = rng.random((n, n + 1)) * (rng.random((n, n + 1)) < (1.0 if kind == "dense" else 0.1))
    matrix[:, -1] += 0.01
    if kind == "cyclic":  # mass travels as one block: few nodes are active at a time
        matrix[:, :-1] = 5.0 * np.roll(np.eye(n), 1, axis=1)
    matrix /= matrix.sum(axis=1, keepdims=True)
    choices = {
        i: {"go": [(float(p), "G" if j == n else j, 1.0) for j, p in enumerate(row) if p > 0]}
        for i, row in enumerate(matrix)
    }
    law = law_of(model_of(choices, "G"), dict.fromkeys(choices, "go"), 0)
    mass, expected = np.eye(n)[0], []
    for _ in range(30):
        expected.append(mass @ matrix[:, -1])
        mass = mass @ matrix[:, :-1]
    assert law.upto(30).probabilities == pytest.approx(expected, rel=1e-12)
    early = np.arange(1, 31) @ expected
    assert law.excess(30) == pytest.approx(law.cost - early - 30 * (1 - sum(expected)), rel=1e-9)


# Runs that take millions of steps

LEAVING = (1e-3, 1e-6, 1e-9, 1e-12)
SLACK = Decimal(1) - Decimal("1e-12")  # of a quantile's level


def tries_until(level, leaving):
    """The least number of tries within which a share of the runs has left."""
    with localcontext(prec=60):
        share = (1 - Decimal(level) * SLACK).ln() / (1 - Decimal(leaving)).ln()
        return max(int(share.to_integral_value(ROUND_CEILING)), 1)


def still_there(tries, leaving):
    with localcontext(prec=60):
        return (1 - Decimal(leaving)) ** int(tries)


@pytest.mark.parametrize("leaving", LEAVING)
@pytest.mark.parametrize("level", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_loop_that_is_hardly_left(leaving, level):
    """Tries until the first success are geometric: all but the first `tries` are (1-p)^tries."""
    law = one_way([(leaving, "G", 1), (1 - leaving, "a", 1)])
    tries = tries_until(level, leaving)
    assert law.quantile(level) == pytest.approx(tries, rel=1e-11, abs=0)
    if leaving * (1 - level) > 1e-10:  # else layers are closer together than rounding
        assert law.quantile(level) == tries
    left = float(still_there(tries, leaving))
    assert law.within(tries) == pytest.approx(float(1 - still_there(tries, leaving)), rel=1e-13)
    assert law.excess(tries) == pytest.approx(left / leaving, rel=1e-13)
    expected = tries + left / leaving / (1 - level)
    assert law.tail_mean(level) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("leaving", LEAVING)
def test_what_is_lost_on_the_way_and_two_loops_one_after_the_other(leaving):
    """Failing three times as often as succeeding: the law given success is that of leaving.

    After n tries neither loop has let through, or the first alone: (1-p)^n + n p (1-p)^(n-1).
    """
    outcomes = [(leaving / 4, "G", 2), (leaving * 3 / 4, "pit", 9), (1 - leaving, "a", 2)]
    law, tries = one_way(outcomes, pit={}), tries_until(0.5, leaving)
    assert law.goal == pytest.approx(0.25, rel=1e-14)
    assert law.quantile(0.5) == pytest.approx(2 * tries, rel=1e-11, abs=0)
    half = float(1 - still_there(tries, leaving))
    assert law.within(2 * tries + 1) == pytest.approx(0.25 * half, rel=1e-13)
    onward = [(leaving, "G", 1), (1 - leaving, "b", 1)]
    law = one_way([(leaving, "b", 1), (1 - leaving, "a", 1)], b={"go": onward})
    for share in (0.1, 1.0, 5.0):
        tries = round(share / leaving)
        with localcontext(prec=60):
            first = tries * Decimal(leaving) * still_there(tries - 1, leaving)
            late = float(still_there(tries, leaving) + first)
        assert law.within(tries) == pytest.approx(1 - late, rel=1e-12)
        assert law.quantile(law.within(tries)) == pytest.approx(tries, rel=1e-10)


def test_free_loops_that_are_hardly_left_count_no_layers():
    """Each layer is a walk of 1e9 free steps, and one in 1e6 layers leads to the goal."""
    pays = {"go": [(1e-6, "G", 0), (1 - 1e-6, "a", 0)]}
    law = one_way([(1 - 1e-9, "b", 0), (1e-9, "c", 1)], b={"go": [(1.0, "a", 0)]}, c=pays)
    assert law.quantile(0.5) == tries_until(0.5, 1e-6)


@pytest.mark.parametrize("seed", range(12))
def test_many_layers_at_once_as_one_by_one(seed, monkeypatch):
    """Of small models with steps of cost 0 to 3, which may end in a pit."""
    rng, names, choices = np.random.default_rng(seed), [f"s{i}" for i in range(4)], {}
    for name in names:
        ends = [*rng.choice(names, 3).tolist(), "G", "pit"]
        weights = rng.integers(1, 9, len(ends)) * np.array([1, 1, 1, 0.02, 0.01])
        paid = rng.integers(0, 4, len(ends)).tolist()
        shares = (weights / weights.sum()).tolist()
        choices[name] = {"go": list(zip(shares, ends, paid, strict=True))}
    model = model_of(choices, "G")

    def make():
        return law_of(model, dict.fromkeys(names, "go"), names[0])

    monkeypatch.setattr(following, "_MOST_PLACES", 0)
    slow = make()
    monkeypatch.setattr(following, "_MOST_PLACES", 800)
    monkeypatch.setattr(following, "_WORK_OF_POWERS", 0.0)
    monkeypatch.setattr(following, "_FIRST_LAYERS", 2)
    for bound in (0, 1, 2, 7, 40, 300, 1000):
        fast = make()
        assert fast.within(bound) == pytest.approx(slow.within(bound), rel=1e-13)
        assert fast.excess(bound) == pytest.approx(slow.excess(bound), rel=1e-12, abs=1e-300)
    levels = (0.0, 0.3, 0.5, 0.9, 0.999)
    found = [make().quantile(level) for level in levels]
    assert found == [slow.quantile(level) for level in levels]
    assert all(low <= high for low, high in pairwise(found))


# Edges


def test_free_cycles_stay_in_their_layer_and_free_wandering_fails():
    """From a one goes in free circles by b before one pays; c is free and never left."""
    model = written("a go: 0.5 b 0, 0.2 a 0, 0.2 G 2, 0.1 c 0\n b go: a 0\n c go: c 0", "G")
    law = law_of(model, dict.fromkeys("abc", "go"))
    assert law.goal == law.within(inf) == pytest.approx(2 / 3)
    assert law.within(1.9) == 0.0
    assert law.within(2) == pytest.approx(2 / 3)


def test_a_free_loop_that_is_hardly_ever_left():
    """What leaves is never formed as 1 - p: the goal is reached for 1, the pit as often for 2."""
    law = one_way(
        [(1 - 2e-13, "a", 0), (1e-13, "b", 1), (1e-13, "pit", 2)],
        b={"go": [(0.25, "b", 0), (0.75, "G", 1)]},
        pit={},
    )
    assert law.within(1) == 0.0
    assert law.within(2) == pytest.approx(0.5, rel=1e-12)


def test_paid_wandering_fails_and_ends_the_sweep():
    """Visits of a recurrent class are infinite; following the live part ends."""
    model = written("a go: 0.5 c 1, 0.5 G 1\n c on: c 3\n c out: G 1", "G")
    law = law_of(model, {"a": "go", "c": "on"})
    assert law.within(1e12) == pytest.approx(0.5)
    assert law.quantile(0.999) == 1.0
    assert law.all_but(1e-3).costs.tolist() == [1.0]
    with pytest.raises(ModelError, match="wander for ever"):
        policy_chain(WALK, WAITING, np.eye(4)[0]).visits()
    assert success_costs(WAITING, S3P(WALK, start="a")).goal == 0.0


def test_starts_at_goals_and_dead_ends_and_giving_up():
    """A goal is reached at cost 0; a dead-end and giving up are missing mass."""
    model = model_of({"a": {"go": [(1.0, "G", 4)]}, "b": {"go": [(1.0, "G", 1)]}, "pit": {}}, "G")
    start = {"G": 0.25, "pit": 0.25, "a": 0.25, "b": 0.25}
    law = law_of(model, {"a": "go", "b": GIVE_UP}, start)
    assert law.goal == pytest.approx(0.5)
    assert [law.within(b) for b in (-1, 0, 3.9, 4)] == pytest.approx([0.0, 0.25, 0.25, 0.5])
    assert (law.quantile(0.0), law.quantile(0.5), law.quantile(0.51)) == (0.0, 0.0, 4.0)
    assert law.exponential(-1.0) == pytest.approx(0.25 + 0.25 * exp(-4))
    assert law.excess(-2.0) == pytest.approx(0.25 * 6 + 0.25 * 2)


def test_a_goal_that_is_never_reached():
    law = one_way([(1.0, "pit", 1)], pit={})
    assert (law.goal, law.cost, law.within(7), law.excess(3), law.exponential(-1)) == (0,) * 5
    assert isnan(law.quantile(0.5))
    assert isnan(law.tail_mean(0.5))
    assert isnan(law.conditional_mean)
    assert law.expectation(lambda c: 1 / (1 + c), 0.0) == 0.0
    assert law.upto(10).costs.size == 0
    assert "goal 0" in repr(law)
    for problem in (CVaR(WALK, "a", 0.9), CostQuantile(WALK, "a", 0.9)):
        assert isnan(evaluate(WAITING, problem).objective)


def test_costs_of_entering_dead_ends_do_not_refine_the_lattice():
    law = one_way([(0.5, "G", 2), (0.25, "a", 2), (0.25, "pit", 0.123456789012345)], pit={})
    assert law.quantile(0.5) == 2.0
    assert law.within(2) == pytest.approx(0.5)


def test_without_a_lattice_sums_are_followed_one_by_one():
    law = one_way([(0.5, "G", 1.0), (0.5, "G", 0.123456789012345)])
    assert law.goal == 1.0
    assert law.cost == pytest.approx((1 + 0.123456789012345) / 2)
    assert law.exponential(-1.0) == pytest.approx((exp(-1) + exp(-0.123456789012345)) / 2)
    assert (law.within(0.99), law.within(1.0)) == (0.5, 1.0)
    assert (law.quantile(0.5), law.quantile(0.6)) == (0.123456789012345, 1.0)
    assert law.excess(0.5) == pytest.approx(0.25)
    hyperbola = law.expectation(lambda cost: 1.0 / (1.0 + cost), 0.0)
    assert hyperbola == pytest.approx(0.25 + 0.5 / 1.123456789012345)


def test_two_ways_to_one_irrational_sum_are_one_atom():
    root = 2**0.5
    law = one_way(
        [(0.5, "one", 1.0), (0.25, "other", root), (0.25, "G", 3 * root)],
        one={"go": [(1.0, "G", root)]},
        other={"go": [(1.0, "G", 1.0)]},
    )
    assert law.all_but(1e-9).costs == pytest.approx([1 + root, 3 * root])
    assert law.within(1 + root) == law.within(root + 1) == 0.75
    assert law.tail_mean(0.5) == pytest.approx((0.25 * (1 + root) + 0.25 * 3 * root) / 0.5)


@pytest.mark.parametrize("cost", [0.847542, 0.8475421, 0.84754215, 0.8475421579])
def test_few_sums_of_a_fine_unit_are_followed_one_by_one(cost):
    """Tries that cost a number of many digits: the law is geometric, whatever the unit is."""
    law = one_way([(0.3, "a", cost), (0.69, "G", 0.5), (0.01, "pit", 0.1)], pit={})
    goal = 0.69 / 0.7
    assert law.within(5) == pytest.approx(0.69 * sum(0.3**k for k in range(6)), rel=1e-14)
    assert law.within(5) == pytest.approx(law.upto(5).probabilities.sum(), rel=1e-14)
    for tries in (0, 1, 5, 12, 20):
        level = 1.0 - 0.3 ** (tries + 1) - 0.1 * 0.3**tries
        assert law.quantile(level) == pytest.approx(0.5 + tries * cost, rel=1e-15)
    assert law.quantile(0.95) == pytest.approx(0.5 + 2 * cost)
    excess = goal * sum(0.7 * 0.3**k * (k - 2) * cost for k in range(3, 200))
    assert law.excess(0.5 + 2 * cost) == pytest.approx(excess, rel=1e-12)
    assert law.tail_mean(0.95) == pytest.approx(0.5 + 2 * cost + excess / 0.05 / goal, rel=1e-12)
    assert law.all_but(1e-6).costs == pytest.approx(0.5 + cost * np.arange(12))
    hyperbola = law.expectation(lambda c: 1.0 / (1.0 + c), 0.0)
    expected = goal * sum(0.7 * 0.3**k / (1.5 + k * cost) for k in range(60))
    assert hyperbola == pytest.approx(expected, rel=1e-12)


@pytest.mark.slow
def test_unlikely_sums_are_rounded_and_likely_ones_are_not():
    """Twelve rare detours at costs of their own beside one try: the likely totals stay exact."""
    rng = np.random.default_rng(0)
    rare = [(1e-7, "a", float(c)) for c in rng.integers(10**8, 10**9, 12) / 10**9]
    law = one_way([(0.5 - 1.2e-6, "a", 0.123456789), (0.5, "G", 1.0), *rare])
    for tries in range(1, 12):
        likely = 0.5 * sum((0.5 - 1.2e-6) ** k for k in range(tries + 1))
        assert law.within(1.0 + tries * 0.123456789) == pytest.approx(likely, rel=2e-5)
        level = likely - 0.1 * 0.5**tries  # reached with this try, not before
        assert law.quantile(level) == pytest.approx(1.0 + tries * 0.123456789, rel=1e-12)
    assert law.tail_mean(0.0) == pytest.approx(law.conditional_mean, rel=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_lotteries_of_policies_with_fine_costs_have_the_enumerated_law(seed):
    """Two states, costs of six to twelve digits, up to three policies: sums in fractions."""
    rng, digits = np.random.default_rng(seed), 10 ** int(np.random.default_rng(seed).choice([6, 9]))
    moves = {
        (state, action): [
            (Fraction(int(p), 100), to, Fraction(int(rng.integers(1, digits)), digits))
            for p, to in zip((70, 20, 10), ("G", str(rng.integers(2)), "pit"), strict=True)
        ]
        for state in "01"
        for action in "xy"
    }
    model = model_of(
        {s: {u: [(float(p), t, float(c)) for p, t, c in moves[s, u]] for u in "xy"} for s in "01"}
        | {"pit": {}},
        "G",
    )
    plays = [dict(zip("01", rng.choice(list("xy"), 2).tolist(), strict=True)) for _ in range(3)]
    weights, atoms = np.array([0.5, 0.25, 0.25]), dict[Fraction, float]()
    for weight, play in zip(weights.tolist(), plays, strict=True):
        ahead = {("0", Fraction(0)): weight}
        for _ in range(16):
            there = dict[tuple[str, Fraction], float]()
            for (state, paid), mass in ahead.items():
                for p, to, cost in moves[state, play[state]]:
                    if to == "G":
                        atoms[paid + cost] = atoms.get(paid + cost, 0.0) + mass * float(p)
                    elif to != "pit":
                        there[to, paid + cost] = there.get((to, paid + cost), 0.0) + mass * float(p)
            ahead = there
    members = [DeterministicPolicy.from_actions(model, play) for play in plays]
    law = success_costs(MixedPolicy(members, weights), S3P(model, "0"))
    costs, masses = sorted(atoms), np.array([atoms[c] for c in sorted(atoms)])
    arrived = np.cumsum(masses)
    for k in range(0, len(costs), max(len(costs) // 20, 1)):
        assert law.within(costs[k]) == pytest.approx(arrived[k], rel=1e-10)
    for level in (0.1, 0.5, 0.9, 0.99, 0.99999):
        place = int(np.searchsorted(arrived, level * law.goal * (1.0 - 1e-10)))
        assert law.quantile(level) == pytest.approx(float(costs[place]), rel=1e-12)
        late = masses @ np.maximum(np.array([float(c) for c in costs]) - float(costs[place]), 0.0)
        share = (1.0 - level) * law.goal
        wanted = float(costs[place]) + late / share
        assert law.tail_mean(level) == pytest.approx(wanted, rel=1e-6)


def test_too_many_sums_are_rounded_up(monkeypatch):
    """No total is understated, and none overstated by more than the steps' rounding."""

    def asked():
        law = one_way([(0.5, "a", 2**0.5), (0.25, "a", 3**0.5), (0.25, "G", 1.0)])
        utility = law.expectation(lambda cost: np.exp(-cost), 0.0)
        late = [law.excess(2.0), law.quantile(0.7), law.tail_mean(0.7)]
        return [law.within(4.0), utility], np.array(late)

    soon, late = asked()
    monkeypatch.setattr(cost_law, "_MOST_SUMS", 3)
    rounded_soon, rounded_late = asked()
    assert rounded_soon[0] <= soon[0] + 1e-12
    assert soon[1] * (1.0 - 2e-3) <= rounded_soon[1] <= soon[1]
    assert (late - 1e-12 <= rounded_late).all()
    assert (rounded_late <= late * (1.0 + 2e-3)).all()


def test_a_table_that_would_be_too_large(monkeypatch):
    """The atoms of a billion layers one by one; steps of a million layers are sums instead."""
    monkeypatch.setattr(following, "_MOST_WORK", 10_000_000)
    slow = one_way([(1e-9, "G", 1), (1 - 1e-9, "a", 1)])
    with pytest.raises(ModelError, match="too large a table"):
        slow.upto(1e9)
    wide = {f"s{i}": {"go": [(1.0, f"s{i + 1}", 1.0)]} for i in range(60)}
    wide["s60"] = {"go": [(0.5, "G", 1.0), (0.5, "G", 1e-6)]}
    law = law_of(model_of(wide, "G"), dict.fromkeys(wide, "go"), "s0")
    assert law.quantile(0.5) == pytest.approx(60 + 1e-6)
    assert law.goal == 1.0


def test_the_order_of_questions_does_not_matter():
    """How far the law was followed for one answer changes no other."""
    outcomes = [(0.05, "G", 1), (0.15, "G", 3), (0.8, "a", 2)]
    asked = [
        lambda law: law.excess(2.0),
        lambda law: law.quantile(0.999999),
        lambda law: law.within(5),
        lambda law: law.upto(11).probabilities.sum(),
        lambda law: law.all_but(0.2).costs[-1],
        lambda law: law.tail_mean(0.3),
    ]
    fresh = [ask(one_way(outcomes)) for ask in asked]
    law = one_way(outcomes)
    law.quantile(1 - 1e-9)
    assert [ask(law) for ask in asked] == pytest.approx(fresh, rel=1e-12)


def test_wrong_questions_are_refused():
    law = one_way([(1.0, "G", 1)])
    one, other = written("a go: G 1", "G"), written("a go: G 1", "G")
    for ask in (
        lambda: law.quantile(1.0),
        lambda: law.tail_mean(-0.1),
        lambda: law.exponential(0.1),
        lambda: law.within(float("nan")),
        lambda: law.excess(float("nan")),
        lambda: law.upto(inf),
        lambda: law.all_but(0.0),
        lambda: law.expectation(lambda c: 1.0, 0.0),
        lambda: law.expectation(lambda c: -c, -inf),
        lambda: success_costs(DeterministicPolicy.from_actions(one, {"a": "go"}), S3P(other, "a")),
    ):
        with pytest.raises(ModelError):
            ask()


# In use


def test_simulated_totals_follow_the_law():
    """Within Dvoretzky, Kiefer and Wolfowitz's band, which holds with probability 1 - 1e-6."""
    problem = S3P(WALK, start={"a": 0.75, "b": 0.25}, failure_budget=0.15)
    policy = solve(problem).policy
    law = success_costs(policy, problem)
    report = simulate(policy, problem, episodes=40_000, seed=np.random.default_rng(3))
    sample = report.success_costs
    assert sample.size == report.ends["goal"]
    width = sqrt(log(2 / 1e-6) / (2 * sample.size))
    for bound in range(12):
        share = float((sample <= bound).mean())
        assert abs(law.within(bound) / law.goal - share) <= width
    for level in (0.25, 0.5, 0.9, 0.95):
        seen = float(np.quantile(sample, level, method="inverted_cdf"))
        assert law.quantile(level - width) <= seen <= law.quantile(level + width)
    spread = 4 * sample.std() / sqrt(sample.size)
    assert sample.mean() == pytest.approx(law.conditional_mean, abs=spread)


@pytest.mark.parametrize(
    ("criterion", "value"),
    [
        (CostBoundedReach(WALK, "a", 3, 0.2), lambda law: law.within(3)),
        (CostQuantile(WALK, "a", 0.9, 0.2), lambda law: law.quantile(0.9)),
        (CVaR(WALK, "a", 0.9, 0.2), lambda law: law.tail_mean(0.9)),
        (EGUBS(WALK, "a", -0.5, 2.0), lambda law: law.exponential(-0.5) + 2.0 * law.goal),
        (
            GUBS(WALK, "a", lambda c: 1 / (1 + c), 2.0),
            lambda law: law.expectation(lambda c: 1 / (1 + c), 0.0) + 2.0 * law.goal,
        ),
    ],
    ids=lambda p: type(p).__name__,
)
def test_evaluate_counts_what_the_problem_measures(criterion, value):
    policy = solve(S3P(WALK, start="a", failure_budget=0.2)).policy
    law = success_costs(policy, criterion)
    assert evaluate(policy, criterion).objective == pytest.approx(value(law), rel=1e-12)
    for ask in (trace_frontier, cross_check, lambda p: solve(p, method="game")):
        with pytest.raises(ModelError, match=type(criterion).__name__):
            ask(criterion)


def test_what_lies_beyond_the_line_of_a_charge_is_a_sum_over_atoms():
    """Totals before, at and after the total from which the charge is a line."""
    atoms = {1.0: 0.3, 4.0: 0.2, 6.5: 0.2, 9.0: 0.1}
    outcomes = [(p, "g", total) for total, p in atoms.items()]
    model = model_of({"x": {"go": [*outcomes, (0.2, "d", 2.0)]}, "d": {}})
    policy = DeterministicPolicy.from_actions(model, {"x": "go"})
    law = success_costs(policy, S3P(model, "x", 1.0))
    for line in (0.0, 0.5, 1.0, 4.0, 5.0, 6.5, 8.0, 9.0, 20.0):
        beyond = sum(p * max(total - line, 0.0) for total, p in atoms.items())
        assert law.excess(line) == pytest.approx(beyond, rel=1e-13, abs=1e-15)

        def charge(c, line=line):
            return np.where(c <= line, 0.5 * c, 0.5 * line + 3.0 * (c - line))

        known = sum(p * float(charge(total)) for total, p in atoms.items()) / 0.8
        assert ExpectedArrivalCost(charge, line).of(law) == pytest.approx(known, rel=1e-12)
