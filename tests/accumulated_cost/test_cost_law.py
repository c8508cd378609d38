"""The law of success costs: closed forms, and its edges."""

from fractions import Fraction
from math import exp, inf, isnan, log

import numpy as np
import pytest

from formulations import S3P
from laws import law_of, one_way
from small_models import model_of
from ssp_lp import (
    GIVE_UP,
    SSP,
    DeterministicPolicy,
    MixedPolicy,
    ModelError,
    success_costs,
)
from ssp_lp.accumulated_cost import cost_law, law as following

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
    for n in (0, 1, 7, 100):
        assert law.excess(n) == pytest.approx(q**n / p, rel=1e-11)
    assert law.excess(2.5) == pytest.approx(q**2 / p - 0.5 * q**2)
    assert law.quantile(0.95) == np.ceil(log(0.05) / log(q))
    assert law.exponential(-0.2) == pytest.approx(p * exp(-0.2) / (1 - q * exp(-0.2)), rel=1e-13)
    assert law.expectation(lambda c: np.exp(-0.2 * c), 0.0) == pytest.approx(
        law.exponential(-0.2), rel=1e-12
    )
    assert law.tail_mean(1 - q**5) == pytest.approx(5 + 1 / p, rel=1e-9)


def test_far_out_the_tail_keeps_its_digits():
    """The excess is summed from what waits, not left over from a difference."""
    law = one_way([(0.5, "G", 1), (0.5, "a", 1)])
    assert law.excess(40) == pytest.approx(2 * 0.5**40, rel=1e-12)
    assert law.tail_mean(1 - 0.5**30) == pytest.approx(32.0, rel=1e-6)


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
        assert law.quantile(level) == n
        assert law.quantile(level + 1e-9) == n + 1


def test_a_level_at_an_edge_given_success():
    """0.76 of a goal probability of 0.8 is level 0.95."""
    parts = [(0.04, "G", 1)] * 19 + [(0.04, "G", 9), (0.2, "pit", 5)]
    law = one_way(parts, pit={})
    assert law.goal == pytest.approx(0.8)
    assert law.quantile(0.95) == 1.0
    assert law.tail_mean(0.95) == pytest.approx(9.0)
    assert law.tail_mean(0.9) == pytest.approx(5.0)


def test_three_tenths_are_within_three_tenths():
    """0.1 + 0.1 + 0.1 exceeds 0.3 in floats, not here; numpy's floats are floats."""
    chain = {"b": {"go": [(1.0, "c", 0.1)]}, "c": {"go": [(1.0, "G", 0.1)]}}
    model = SSP.from_transitions({"a": {"go": [(1.0, "b", 0.1)]}, **chain}, goal={"G"})
    law = law_of(model, dict.fromkeys("abc", "go"))
    assert law.within(0.3) == 1.0
    assert law.within(np.float64(0.3)) == 1.0
    assert law.within(Fraction(3, 10)) == 1.0
    assert law.within(0.1 + 0.2) == 1.0
    assert law.within(0.29999999999999993) == 0.0
    assert law.within(Fraction(3, 10) - Fraction(1, 10**30)) == 0.0
    assert law.quantile(0.5) == 0.3
    assert law.upto(0.3).costs.tolist() == [0.3]


def test_thirds_given_as_fractions():
    """A quantile is the float of a fraction, and is within itself."""
    third = Fraction(1, 3)
    law = one_way([(0.5, "G", third), (0.25, "G", 2 * third), (0.25, "a", third)])
    for level in (0.4, 0.6, 0.9, 0.99):
        value = law.quantile(level)
        assert law.within(value) >= level
        assert law.within(value * (1 - 1e-12)) < level
    assert law.within(2 * third) == pytest.approx(0.875)
    assert law.within(2 / 3) == pytest.approx(0.875)


def test_the_quantile_of_a_lottery_is_that_of_the_mixture():
    """Half 1 and half 10: the median is 1 and the 3/4-quantile 10, no mean of both."""
    model = SSP.from_transitions({"a": {"x": [(1, "G", 1)], "y": [(1, "G", 10)]}}, goal={"G"})
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
    law = law_of(SSP.from_transitions(choices, goal={"G"}), dict.fromkeys(choices, "go"), 0)
    mass, expected = np.eye(n)[0], []
    for _ in range(30):
        expected.append(mass @ matrix[:, -1])
        mass = mass @ matrix[:, :-1]
    assert law.upto(30).probabilities == pytest.approx(expected, rel=1e-12)
    assert law.excess(30) == pytest.approx(law.cost - np.minimum(
        np.arange(1, 31), 30) @ expected - 30 * (1 - sum(expected)), rel=1e-9)  # fmt: skip


# Edges


def test_free_cycles_stay_in_their_layer_and_free_wandering_fails():
    """From a one goes in free circles by b before one pays; c is free and never left."""
    model = model_of(
        {
            "a": {"go": [(0.5, "b", 0), (0.2, "a", 0), (0.2, "G", 2), (0.1, "c", 0)]},
            "b": {"go": [(1.0, "a", 0)]},
            "c": {"go": [(1.0, "c", 0)]},
        },
        "G",
    )
    law = law_of(model, dict.fromkeys("abc", "go"))
    assert law.goal == pytest.approx(2 / 3)
    assert law.within(1.9) == 0.0
    assert law.within(2) == pytest.approx(2 / 3)
    assert law.within(inf) == law.goal


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
    wander = {"on": [(1.0, "c", 3)], "out": [(1.0, "G", 1)]}
    model = model_of({"a": {"go": [(0.5, "c", 1), (0.5, "G", 1)]}, "c": wander}, "G")
    law = law_of(model, {"a": "go", "c": "on"})
    assert law.within(1e12) == pytest.approx(0.5)
    assert law.quantile(0.999) == 1.0
    assert law.all_but(1e-3).costs.tolist() == [1.0]


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
    assert law.expectation(lambda cost: 1.0 / (1.0 + cost), 0.0) == pytest.approx(
        0.25 + 0.5 / 1.123456789012345
    )


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


def test_too_many_sums_are_rounded_up(monkeypatch):
    """No total is understated, and none overstated by more than the steps' rounding."""
    steps = [(0.5, "a", 2**0.5), (0.25, "a", 3**0.5), (0.25, "G", 1.0)]
    law = one_way(steps)
    exact = [law.within(4.0), law.excess(2.0), law.quantile(0.7), law.tail_mean(0.7)]
    utility = law.expectation(lambda cost: np.exp(-cost), 0.0)
    monkeypatch.setattr(cost_law, "_MOST_SUMS", 3)
    law = one_way(steps)
    rounded = [law.within(4.0), law.excess(2.0), law.quantile(0.7), law.tail_mean(0.7)]
    assert rounded[0] <= exact[0] + 1e-12
    for up, true in zip(rounded[1:], exact[1:], strict=True):
        assert true - 1e-12 <= up <= true * (1.0 + 2e-3)
    assert utility * (1.0 - 2e-3) <= law.expectation(lambda cost: np.exp(-cost), 0.0) <= utility


def test_a_table_that_would_be_too_large(monkeypatch):
    """The atoms of a billion layers one by one; steps of a million layers are sums instead."""
    monkeypatch.setattr(following, "_MOST_WORK", 10_000_000)
    slow = one_way([(1e-9, "G", 1), (1 - 1e-9, "a", 1)])
    with pytest.raises(ModelError, match="too large a table"):
        slow.upto(1e9)
    wide = {f"s{i}": {"go": [(1.0, f"s{i + 1}", 1.0)]} for i in range(60)}
    wide["s60"] = {"go": [(0.5, "G", 1.0), (0.5, "G", 1e-6)]}
    law = law_of(SSP.from_transitions(wide, goal={"G"}), dict.fromkeys(wide, "go"), "s0")
    assert law.quantile(0.5) == pytest.approx(60 + 1e-6)
    assert law.goal == 1.0


def test_wrong_questions_are_refused():
    law = one_way([(1.0, "G", 1)])
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
    ):
        with pytest.raises(ModelError):
            ask()
    other = SSP.from_transitions({"a": {"go": [(1.0, "G", 1)]}}, goal={"G"})
    with pytest.raises(ModelError, match="another model"):
        success_costs(
            DeterministicPolicy.from_actions(other, {"a": "go"}),
            S3P(SSP.from_transitions({"a": {"go": [(1.0, "G", 1)]}}, goal={"G"}), start="a"),
        )
