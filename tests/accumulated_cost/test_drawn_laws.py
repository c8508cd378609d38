"""Laws of success costs of drawn policies: a plain dynamic programme in fractions, identities."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, strategies as st

from checks import library_model, plain
from formulations import MCMP, S3P
from plain_policies import memory_chain
from references import cost_law as reference
from references.chain import STOP, start_distribution
from ssp_lp import (
    GIVE_UP,
    DeterministicPolicy,
    InfeasibleError,
    StochasticPolicy,
    TimedPolicy,
    evaluate,
    solve,
    success_costs,
)
from ssp_lp.accumulated_cost.charges import ExcessCharge
from ssp_lp.policies.policy import Branches, Policy
from strategies import DEAD_ENDS, Draw, often, problems

LEVELS = (0.0, 0.25, 0.5, 0.9, 0.95, 0.99)


@st.composite
def played(draw):
    """A drawn problem, and a randomised stationary policy that may give up, by live state."""
    drawn, decisions = draw(problems()), {}
    for state, actions in drawn.choices.items():
        if state in DEAD_ENDS:
            continue
        shares = draw(st.sampled_from([(1.0,), (0.5, 0.5), (0.25, 0.75)]))
        names = draw(st.permutations([*actions, STOP]))
        decisions[state] = dict(zip(names, shares, strict=False))
        if sum(decisions[state].values()) < 1.0:
            decisions[state] = {next(iter(actions)): 1.0}
    return drawn, decisions


def law_and_problem(drawn, decisions):
    model = library_model(drawn)
    problem = MCMP(model, start=drawn.start, failure_budget=1.0, give_up="anywhere")
    policy = StochasticPolicy.from_actions(
        model,
        {s: {GIVE_UP if a == STOP else a: w for a, w in d.items()} for s, d in decisions.items()},
    )
    return success_costs(policy, problem), policy, problem


def check_law(law, expected, most):
    """All atoms up to a cost, and what is summed from them."""
    costs, masses = law.upto(most)
    assert costs.tolist() == [float(c) for c in sorted(expected)]
    assert masses == pytest.approx([float(expected[c]) for c in sorted(expected)], rel=1e-11)
    for bound in {Fraction(0), most / 2, most, *expected}:
        mass = sum((m for c, m in expected.items() if c <= bound), Fraction(0))
        assert law.within(bound) == pytest.approx(float(mass), rel=1e-11)
        assert law.within(float(bound)) == law.within(bound)


@pytest.mark.slow
@often(150)
@given(played(), st.sampled_from([1, 10, 3]))
def test_randomised_policies_have_the_enumerated_law(drawn_and_decisions, parts):
    """Free cycles, wandering, giving up, starts at goals: atom by atom; costs in tenths, thirds."""
    drawn, decisions = drawn_and_decisions
    scaled = {
        s: {
            a: [(p, t, Fraction(c, parts) if parts == 3 else c / parts) for p, t, c in outcomes]
            for a, outcomes in actions.items()
        }
        for s, actions in drawn.choices.items()
    }
    drawn = Draw(scaled, drawn.goals, drawn.start)
    law, _, _ = law_and_problem(drawn, decisions)
    model, most = plain(drawn), Fraction(9, parts)
    moves = reference.moves_of(model, decisions)
    check_law(law, reference.law(model, start_distribution(drawn.start), moves, most), most)


@often(30)
@given(problems(most_live=3), st.sampled_from([0.5, 0.25, 0.05]))
def test_policies_that_remember_cost_have_the_enumerated_law(drawn, budget):
    """Members of S3P's lotteries, and their mixture."""
    problem = S3P(library_model(drawn), start=drawn.start, failure_budget=budget)
    try:
        policy = solve(problem).policy
    except InfeasibleError:
        return
    most, mixture = Fraction(8), {}
    for weight, member in zip(policy.weights, policy.policies, strict=True):
        begin, chain, moves = memory_chain(plain(drawn), start_distribution(drawn.start), member)
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
def test_memories_of_time_and_ones_that_go_back_have_the_enumerated_law(drawn):
    model = library_model(drawn)
    acting = [s for s in drawn.choices if drawn.choices[s]]
    first, last = (
        DeterministicPolicy.from_actions(model, {s: list(drawn.choices[s])[k] for s in acting})
        for k in (0, -1)
    )
    for policy in (Turns(model), TimedPolicy((first, last, first))):
        begin, chain, moves = memory_chain(plain(drawn), start_distribution(drawn.start), policy)
        expected = reference.law(chain, begin, reference.member_moves(chain, moves), Fraction(8))
        check_law(success_costs(policy, S3P(model, start=drawn.start)), expected, Fraction(8))


@pytest.mark.slow
@often(100)
@given(played())
def test_what_holds_for_every_law(drawn_and_decisions):
    law, policy, problem = law_and_problem(*drawn_and_decisions)
    found = evaluate(policy, problem)
    assert law.goal == pytest.approx(found.goal_probability, abs=1e-12)
    assert law.cost == pytest.approx(found.success_cost, rel=1e-12, abs=1e-12)
    # the excess is convex and falls by at most one
    values = np.array([law.excess(z) for z in np.arange(-1.0, 12.0, 0.5)])
    slope = np.diff(values) / 0.5
    assert (slope >= -law.goal - 1e-9).all()
    assert (slope <= 1e-9).all()
    assert (np.diff(slope) >= -1e-9).all()
    assert values[2] == pytest.approx(law.cost, rel=1e-12, abs=1e-12)
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
        expected = law.expectation(lambda c, r=rate: np.exp(r * c), 0.0)
        assert expected == pytest.approx(value, rel=1e-11)
    assert law.exponential(0.0) == pytest.approx(law.goal, rel=1e-13)
    hyperbola = law.expectation(lambda c: 3 - c / (1 + c), 2.0)
    assert hyperbola == pytest.approx(masses @ (3 - costs / (1 + costs)), rel=1e-10)
    # quantiles and tail means fit to it
    last = -1.0
    for level in LEVELS:
        value, tail = law.quantile(level), law.tail_mean(level)
        assert value >= last
        assert law.within(value) >= level * law.goal * (1 - 2e-12)
        assert value == 0.0 or law.within(value - 0.5) < max(level, 1e-300) * law.goal
        assert tail >= max(value, law.conditional_mean) - 1e-9 * (1 + abs(tail))
        share = (1 - level) * law.goal
        lower = min(z + law.excess(z) / share for z in np.arange(0.0, value + 3.0))
        assert tail == pytest.approx(lower, rel=1e-10, abs=1e-12)
        charge = ExcessCharge(value, 1.0 - level).at(costs)
        assert masses @ charge == pytest.approx(tail * law.goal, rel=1e-9, abs=1e-12)
        last = value
