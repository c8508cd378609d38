"""Laws of success costs of drawn policies: a plain dynamic programme in fractions, identities."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st

from checks import library_model, plain
from formulations import MCMP, S3P
from laws import one_way
from ledger import Ledger
from plain_policies import memory_chain
from references import cost_law as reference
from references.chain import STOP, start_distribution
from ssp_lp import (
    GIVE_UP,
    SSP,
    DeterministicPolicy,
    InfeasibleError,
    ModelError,
    StochasticPolicy,
    TimedPolicy,
    evaluate,
    solve,
    success_costs,
)
from ssp_lp.policies.chain import policy_chain
from ssp_lp.policies.policy import Branches, Policy
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
