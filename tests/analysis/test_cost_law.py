"""The law of success costs: closed forms, a plain dynamic programme in fractions, identities."""

from dataclasses import dataclass, replace
from fractions import Fraction
from math import exp, inf, isnan, log, sqrt

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from checks import library_model, plain
from formulations import MCMP, S3P
from laws import law_of, one_way
from ledger import Ledger
from plain_policies import memory_chain
from references import cost_law as reference
from references.chain import STOP, start_distribution
from small_models import model_of
from ssp_lp import (
    GIVE_UP,
    SSP,
    DeterministicPolicy,
    InfeasibleError,
    MixedPolicy,
    ModelError,
    SolverError,
    StochasticPolicy,
    TimedPolicy,
    cross_check,
    evaluate,
    simulate,
    solve,
    success_costs,
    trace_frontier,
)
from ssp_lp.analysis.chain import policy_chain
from ssp_lp.analysis.total_cost import arrivals, followed_sums
from ssp_lp.policies.policy import Branches, Policy
from ssp_lp.processes.failure_semantics import FailureSemantics
from ssp_lp.processes.layered.measures_of_law import (
    CostQuantileOf,
    ExpectedUtility,
    ExponentialUtility,
    Measure,
    TailMeanOf,
    WithinBound,
)
from strategies import DEAD_ENDS, Draw, often, problems

LEVELS = (0.0, 0.25, 0.5, 0.9, 0.95, 0.99)
SHARES = ((1.0,), (0.5, 0.5), (0.25, 0.75))


@st.composite
def decisions(draw, drawn):
    """A randomised stationary policy that may give up, by live state."""
    table = {}
    for state, actions in drawn.choices.items():
        if state in DEAD_ENDS:
            continue
        shares = draw(st.sampled_from(SHARES))
        names = draw(st.permutations([*actions, STOP]))
        table[state] = dict(zip(names, shares, strict=False))
        if sum(table[state].values()) < 1.0:
            table[state] = {next(iter(actions)): 1.0}
    return table


@st.composite
def played(draw, **size):
    """A drawn problem with a drawn policy, and both as the library sees them."""
    drawn = draw(problems(**size))
    table = draw(decisions(drawn))
    return drawn, table


def library_policy(model, table):
    named = {
        s: {GIVE_UP if a == STOP else a: w for a, w in acts.items()} for s, acts in table.items()
    }
    return StochasticPolicy.from_actions(model, named)


def law_and_problem(drawn, table):
    model = library_model(drawn)
    problem = MCMP(model, start=drawn.start, failure_budget=1.0, give_up="anywhere")
    policy = library_policy(model, table)
    return success_costs(policy, problem), policy, problem


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
    monkeypatch.setattr(followed_sums, "_MOST_SUMS", 3)
    law = one_way(steps)
    rounded = [law.within(4.0), law.excess(2.0), law.quantile(0.7), law.tail_mean(0.7)]
    assert rounded[0] <= exact[0] + 1e-12
    for up, true in zip(rounded[1:], exact[1:], strict=True):
        assert true - 1e-12 <= up <= true * (1.0 + 2e-3)
    assert utility * (1.0 - 2e-3) <= law.expectation(lambda cost: np.exp(-cost), 0.0) <= utility


def test_a_table_that_would_be_too_large(monkeypatch):
    """The atoms of a billion layers one by one; steps of a million layers are sums instead."""
    monkeypatch.setattr(arrivals, "_MOST_WORK", 10_000_000)
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


# Against the plain dynamic programme


def check_law(law, expected, most):
    """All atoms up to a cost, and what is summed from them."""
    costs, masses = law.upto(most)
    assert costs.tolist() == [float(c) for c in sorted(expected)]
    assert masses == pytest.approx([float(expected[c]) for c in sorted(expected)], rel=1e-11)
    for bound in {Fraction(0), most / 2, most, *expected}:
        mass = sum((m for c, m in expected.items() if c <= bound), Fraction(0))
        assert law.within(bound) == pytest.approx(float(mass), rel=1e-11)
        assert law.within(float(bound)) == law.within(bound)


@often(300)
@given(played(), st.sampled_from([1, 10, 3]))
def test_randomised_policies_have_the_enumerated_law(drawn_and_table, parts):
    """Free cycles, wandering, giving up, starts at goals: atom by atom; costs in tenths, thirds."""
    drawn, table = drawn_and_table
    drawn = Draw(
        {
            s: {
                a: [(p, t, Fraction(c, parts) if parts == 3 else c / parts) for p, t, c in outcomes]
                for a, outcomes in actions.items()
            }
            for s, actions in drawn.choices.items()
        },
        drawn.goals,
        drawn.start,
    )
    law, _, _ = law_and_problem(drawn, table)
    model, most = plain(drawn), Fraction(9, parts)
    start = start_distribution(drawn.start)
    expected = reference.law(model, start, reference.moves_of(model, table), most)
    check_law(law, expected, most)


@often(100)
@given(problems(most_live=3), st.sampled_from([0.5, 0.25, 0.05]))
def test_policies_that_remember_cost_have_the_enumerated_law(drawn, budget):
    """Members of S3P's lotteries, and their mixture."""
    problem = S3P(library_model(drawn), start=drawn.start, failure_budget=budget)
    try:
        policy = solve(problem).policy
    except InfeasibleError:
        return
    start, most, mixture = start_distribution(drawn.start), Fraction(8), {}
    for weight, member in zip(policy.weights, policy.policies, strict=True):
        begin, chain, moves = memory_chain(plain(drawn), start, member)
        found = reference.law(chain, begin, reference.member_moves(chain, moves), most)
        check_law(success_costs(member, problem), found, most)
        for cost, mass in found.items():
            mixture[cost] = mixture.get(cost, 0) + Fraction(float(weight)) * mass
    check_law(success_costs(policy, problem), mixture, most)


class Turns(Policy):
    """A user's own policy: the first and the last action in turns. Its memory goes back."""

    def __init__(self, model):
        self.model = model

    def start_memory(self, states):
        return np.zeros(len(states), dtype=np.int64)

    def branches(self, states, memory):
        first, last = self.model.pair_offsets[states], self.model.pair_offsets[states + 1] - 1
        pair = np.where(memory == 0, first, last)
        return Branches(np.arange(len(states)), pair, np.ones(len(states)))

    def remember(self, memory, pairs, successors, costs):
        return 1 - memory


@often(60)
@given(problems())
def test_a_memory_that_goes_back_has_the_enumerated_law(drawn):
    model = library_model(drawn)
    begin, chain, moves = memory_chain(plain(drawn), start_distribution(drawn.start), Turns(model))
    expected = reference.law(chain, begin, reference.member_moves(chain, moves), Fraction(8))
    law = success_costs(Turns(model), S3P(model, start=drawn.start))
    check_law(law, expected, Fraction(8))


# The ledger: a second road to the same law


def ledger_law(policy, model, start, unit, horizon):
    """Pr(goal, C = layer) by the visits of a chain that keeps accounts, [horizon + 1]."""
    ledger = Ledger(policy, unit, horizon)
    weights = np.array([start.get(s, 0.0) for s in model.states])
    chain = policy_chain(model, ledger, weights)
    visits = chain.push(chain.start)
    arrives = chain.goal[chain.target] > 0
    layer = ledger.layer(chain.memory)[chain.source] + np.rint(chain.cost / float(unit))
    mass = visits[chain.source] * chain.probability
    keep = arrives & (layer <= horizon)
    found = np.bincount(layer[keep].astype(int), weights=mass[keep], minlength=horizon + 1)
    at_once = np.arange(horizon + 1) == 0
    return found + at_once * float(chain.start[chain.goal > 0].sum())


@often(120)
@given(played(), st.sampled_from(["plain", "timed", "turns", "ledger"]))
def test_a_ledger_beside_any_memory_gives_the_same_law(drawn_and_table, kind):
    drawn, table = drawn_and_table
    law, policy, problem = law_and_problem(drawn, table)
    model = problem.model
    if kind == "timed":
        policy = TimedPolicy((policy, policy, policy))
    elif kind == "turns":
        policy = Turns(model)
        law = success_costs(policy, problem)
    elif kind == "ledger":
        policy = Ledger(policy, Fraction(1), 2)
    assume(evaluate(policy, problem).ends["wandering"] < 1e-12)
    masses = ledger_law(policy, model, start_distribution(drawn.start), Fraction(1), 6)
    expected = np.zeros(7)
    costs, found = law.upto(6)
    expected[costs.astype(int)] = found
    assert masses == pytest.approx(expected, rel=1e-11, abs=1e-15)


def test_a_ledger_refuses_what_it_cannot_book():
    model = SSP.from_transitions({"a": {"go": [(1.0, "b", 0.25)]}, "b": {"go": [(1, "G", 1)]}},
                                 goal={"G"})  # fmt: skip
    policy = DeterministicPolicy.from_actions(model, dict.fromkeys("ab", "go"))
    with pytest.raises(ModelError, match="no whole number"):
        policy_chain(model, Ledger(policy, Fraction(1), 4), np.array([1.0, 0.0, 0.0]))
    with pytest.raises(ModelError, match="unit above 0"):
        Ledger(policy, Fraction(0), 4)
    assert "4 layers of cost 1" in repr(Ledger(policy, Fraction(1), 4))


# Identities


@often(200)
@given(played())
def test_what_holds_for_every_law(drawn_and_table):
    law, policy, problem = law_and_problem(*drawn_and_table)
    found = evaluate(policy, problem)
    assert law.goal == pytest.approx(found.goal_probability, abs=1e-12)
    assert law.cost == pytest.approx(found.success_cost, rel=1e-12, abs=1e-12)
    if law.goal == 0.0:
        return
    assert law.cost / law.goal == pytest.approx(found.conditional_cost, rel=1e-12)
    costs, masses = law.all_but(1e-13 * law.goal)
    assert masses.sum() == pytest.approx(law.goal, rel=1e-11)
    assert masses @ costs == pytest.approx(law.cost, rel=1e-9, abs=1e-12)
    assert law.tail_mean(0.0) == pytest.approx(law.conditional_mean, rel=1e-11, abs=1e-12)
    for rate in (-0.1, -1.0):
        value = law.exponential(rate)
        assert value == pytest.approx(masses @ np.exp(rate * costs), rel=1e-10)
        assert law.expectation(lambda c, r=rate: np.exp(r * c), 0.0) == pytest.approx(
            value, rel=1e-11
        )
    assert law.exponential(0.0) == pytest.approx(law.goal, rel=1e-13)
    hyperbola = law.expectation(lambda c: 3 - c / (1 + c), 2.0)
    assert hyperbola == pytest.approx(masses @ (3 - costs / (1 + costs)), rel=1e-10)


@often(150)
@given(played())
def test_quantiles_and_tail_means_fit_together(drawn_and_table):
    law, _, _ = law_and_problem(*drawn_and_table)
    assume(law.goal > 0)
    last = -1.0
    for level in LEVELS:
        value, tail = law.quantile(level), law.tail_mean(level)
        assert value >= last
        assert law.within(value) >= level * law.goal * (1 - 2e-12)
        assert value == 0.0 or law.within(value - 0.5) < max(level, 1e-300) * law.goal
        assert tail >= max(value, law.conditional_mean) - 1e-9 * (1 + abs(tail))
        lower = min(
            z + law.excess(z) / ((1 - level) * law.goal) for z in np.arange(0.0, value + 3.0)
        )
        assert tail == pytest.approx(lower, rel=1e-10, abs=1e-12)
        last = value


@often(100)
@given(played())
def test_the_excess_is_convex_and_falls_by_at_most_one(drawn_and_table):
    law, _, _ = law_and_problem(*drawn_and_table)
    at = np.arange(-1.0, 12.0, 0.5)
    values = np.array([law.excess(z) for z in at])
    slope = np.diff(values) / 0.5
    assert (slope >= -law.goal - 1e-9).all()
    assert (slope <= 1e-9).all()
    assert (np.diff(slope) >= -1e-9).all()
    assert values[2] == pytest.approx(law.cost, rel=1e-12, abs=1e-12)


@often(100)
@given(played(), st.sampled_from([0.1, 7, 0.25]))
def test_scaling_the_costs_scales_the_quantiles(drawn_and_table, factor):
    drawn, table = drawn_and_table
    exact = Fraction(repr(factor))
    scaled = {
        s: {a: [(p, t, float(exact * c)) for p, t, c in o] for a, o in actions.items()}
        for s, actions in drawn.choices.items()
    }
    law, _, _ = law_and_problem(drawn, table)
    other, _, _ = law_and_problem(Draw(scaled, drawn.goals, drawn.start), table)
    assume(law.goal > 0)
    for level in LEVELS:
        assert other.quantile(level) == float(exact * Fraction(law.quantile(level)))
        assert other.tail_mean(level) == pytest.approx(factor * law.tail_mean(level), rel=1e-10)


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


# Simulation

WALK = {
    "a": {"slow": [(0.5, "b", 1), (0.5, "a", 1)],
          "fast": [(0.6, "G", 2), (0.3, "b", 1), (0.1, "pit", 1)], "wait": [(1.0, "a", 1)]},
    "b": {"on": [(0.9, "G", 1), (0.1, "a", 2)], "jump": [(0.7, "G", 0), (0.3, "pit", 0)]},
    "pit": {"stuck": [(1.0, "pit", 3)]},
}  # fmt: skip


def test_simulated_totals_follow_the_law():
    """Within Dvoretzky, Kiefer and Wolfowitz's band, which holds with probability 1 - 1e-6."""
    model = SSP.from_transitions(WALK, goal={"G"})
    problem = S3P(model, start={"a": 0.75, "b": 0.25}, failure_budget=0.15)
    policy = solve(problem).policy
    law = success_costs(policy, problem)
    report = simulate(policy, problem, episodes=40_000, rng=np.random.default_rng(3))
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


# Measures in evaluate, and methods that know none


BY_THREE = WithinBound(3)


@dataclass(frozen=True)
class Measured(S3P):
    """S3P's model and start, with another number to count."""

    counted: Measure = BY_THREE

    @property
    def semantics(self) -> FailureSemantics:
        return replace(super().semantics, measure=self.counted)


def bonus(counted, law):
    return ExpectedUtility(lambda c: 1 / (1 + c), counted, 0.0).of(law)


@pytest.mark.parametrize(
    ("measure", "value"),
    [
        (WithinBound(3), lambda law: law.within(3)),
        (CostQuantileOf(0.9), lambda law: law.quantile(0.9)),
        (TailMeanOf(0.9), lambda law: law.tail_mean(0.9)),
        (ExponentialUtility(-0.5, 2.0), lambda law: law.exponential(-0.5) + 2.0 * law.goal),
        (ExpectedUtility(lambda c: 1 / (1 + c), 2.0, 0.0), lambda law: bonus(2.0, law)),
    ],
    ids=lambda p: type(p).__name__,
)
def test_evaluate_counts_what_the_problem_measures(measure, value):
    model = SSP.from_transitions(WALK, goal={"G"})
    plain_problem = S3P(model, start="a", failure_budget=0.2)
    policy = solve(plain_problem).policy
    problem = Measured(model, start="a", failure_budget=0.2, counted=measure)
    found, same = evaluate(policy, problem), evaluate(policy, plain_problem)
    assert found.objective == value(success_costs(policy, problem))
    assert replace(found, objective=same.objective) == same


def test_a_measure_of_a_goal_that_is_never_reached():
    model = SSP.from_transitions(WALK, goal={"G"})
    policy = DeterministicPolicy.from_actions(model, {"a": "wait"})
    for measure in (CostQuantileOf(0.9), TailMeanOf(0.9)):
        assert isnan(evaluate(policy, Measured(model, start="a", counted=measure)).objective)


def test_the_game_and_the_frontier_refuse_measures():
    model = SSP.from_transitions(WALK, goal={"G"})
    problem = Measured(model, start="a", failure_budget=0.2, discount=0.99)
    assert not problem.semantics.counts_cost_alone
    for ask in (trace_frontier, cross_check, lambda p: solve(p, method="game")):
        with pytest.raises(ModelError, match="Measured"):
            ask(problem)


def test_a_chain_that_holds_mass_is_no_obstacle():
    """Pushing mass through a recurrent class fails; following the live part does not."""
    model = SSP.from_transitions(WALK, goal={"G"})
    policy = DeterministicPolicy.from_actions(model, {"a": "wait"})
    with pytest.raises(SolverError):
        policy_chain(model, policy, np.eye(4)[0]).push(np.ones(1))
    assert success_costs(policy, S3P(model, start="a")).goal == 0.0
