"""The randomised policy equivalent to a lottery (section 2.2 of the paper)."""

from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given, strategies as st

from formulations import MCMP, S3P
from games import RETRY, criteria, drawn_problem, hand_problem
from references.chain import start_distribution
from ssp_lp import evaluate
from ssp_lp.analysis.evaluation import equivalent_randomised_policy
from ssp_lp.game import bayes_adaptive, stationary_game
from ssp_lp.policies import DeterministicPolicy, MixedPolicy
from strategies import often, problems
from written_models import written

few = often(12)


def _distributions(policy, problem, steps):
    """Distribution of (state, total cost) at times 0 .. steps; giving up at s ends in -1 - s."""
    model, lottery = problem.model, [(policy, 1.0)]
    if isinstance(policy, MixedPolicy):
        lottery = list(zip(policy.policies, policy.weights.tolist(), strict=True))
    after = [defaultdict(float) for _ in range(steps + 1)]
    for member, weight in lottery:
        now = defaultdict(float)
        for state, mass in start_distribution(problem.start).items():
            at = model.index_of(state)
            now[at, int(member.start_memory(np.array([at]))[0]), 0.0] += weight * mass
        for time in range(steps + 1):
            for (state, _, paid), mass in now.items():
                after[time][state, round(paid, 9)] += mass
            now = _step(model, member, now)
    return after


def _step(model, member, now):
    """One step of one member's distribution over (state, memory, total cost)."""
    later = defaultdict(float)
    for (state, memory, paid), mass in now.items():
        pairs = model.pair_offsets[state : state + 2]
        if state < 0 or model.goal_mask[state] or pairs[0] == pairs[1]:
            later[state, memory, paid] += mass
            continue
        found = member.branches(np.array([state]), np.array([memory]))
        for pair, share in zip(found.pair.tolist(), found.probability.tolist(), strict=True):
            if pair < 0:
                later[-1 - state, memory, paid] += mass * share
                continue
            for k in range(model.outcome_offsets[pair], model.outcome_offsets[pair + 1]):
                successor, cost = int(model.successors[k]), float(model.costs[k])
                step = (np.array([part]) for part in (memory, pair, successor, cost))
                there = int(member.remember(*step)[0])
                later[successor, there, paid + cost] += mass * share * model.probabilities[k]
    return later


def _states(distribution):
    """The distribution of the state alone."""
    found = defaultdict(float)
    for (state, _), mass in distribution.items():
        found[state] += mass
    return found


def _distance(left, right):
    return max(abs(left[k] - right[k]) for k in {*left, *right})


@criteria
def test_a_stationary_lottery_and_its_stationary_policy_agree_in_total(criterion):
    """Stationary lotteries: equal expected discounted visits, so equal objective and J_cond.

    Section 2.2 claims equal distributions at each time, which needs a policy that remembers time.
    """
    problem = hand_problem(criterion, RETRY, 0.13, 0.999)
    lottery = stationary_game(problem).policy
    assert len(lottery.policies) == 2
    single = equivalent_randomised_policy(lottery, problem)
    one, both = (evaluate(policy, problem) for policy in (single, lottery))
    assert one.objective == pytest.approx(both.objective, rel=1e-9)
    assert one.discounted_failure == pytest.approx(both.discounted_failure, rel=1e-9)


def test_no_stationary_policy_has_the_distribution_of_a_lottery_at_each_time():
    """Half "a" (leaves with 0.5), half "b" (with 0.1): P(x at t) = (0.5^t + 0.9^t) / 2.

    A stationary policy of the state alone has q^t. The equivalent one visits "x" as often, which
    is 1 / (1 - q) = (2 + 10) / 2 times.
    """
    model = written("x a: 0.5 x 1, 0.5 g 1\n x b: 0.9 x 1, 0.1 g 1")
    problem = MCMP(model, start="x", failure_budget=1.0)
    members = tuple(DeterministicPolicy.from_actions(model, {"x": u}) for u in "ab")
    lottery = MixedPolicy(members, np.array([0.5, 0.5]))
    single = equivalent_randomised_policy(lottery, problem)
    at = model.index_of("x")
    both, one = (_distributions(p, problem, 6) for p in (lottery, single))
    for time in range(7):
        assert _states(both[time])[at] == pytest.approx((0.5**time + 0.9**time) / 2)
        assert _states(one[time])[at] == pytest.approx((5 / 6) ** time)
    cost = evaluate(lottery, problem).expected_cost
    assert cost == pytest.approx(6.0)
    assert evaluate(single, problem).expected_cost == pytest.approx(cost)


@few
@given(problems(most_live=3), st.sampled_from([0.5, 0.9]), st.sampled_from([0.25, 0.1, 0.5]))
def test_with_time_in_the_memory_states_agree_at_each_time_in_case_m(drawn, gamma, share):
    """Section 2.2 for the lotteries of section 3.4, case M: the same states at each time.

    Total costs agree in the mean only: the policy does not remember them.
    """
    problem = drawn_problem(MCMP, drawn, share, gamma)
    lottery = bayes_adaptive(problem, tolerance=1e-7).policy
    single = equivalent_randomised_policy(lottery, problem)
    steps = 6
    both, one = (_distributions(p, problem, steps) for p in (lottery, single))
    for before, after in zip(both, one, strict=True):
        assert _distance(_states(before), _states(after)) <= 1e-10
        mean = [sum(paid * mass for (_, paid), mass in d.items()) for d in (before, after)]
        assert mean[0] == pytest.approx(mean[1], abs=1e-9)


@pytest.mark.slow
@few
@given(problems(most_live=2, most_cost=2), st.sampled_from([0.25, 0.1, 0.5]))
def test_with_time_and_cost_in_the_memory_both_agree_at_each_time_in_case_s(drawn, share):
    """Section 2.2 for the lotteries of section 3.4, case S: the same (state, cost) at each time."""
    problem = drawn_problem(S3P, drawn, share, 0.5)
    lottery = bayes_adaptive(problem, tolerance=1e-6).policy
    single = equivalent_randomised_policy(lottery, problem)
    both, one = (_distributions(p, problem, 5) for p in (lottery, single))
    for before, after in zip(both, one, strict=True):
        assert _distance(before, after) <= 1e-10


@criteria
def test_a_lottery_over_policies_of_time_keeps_its_numbers(criterion):
    """RETRY: real cost, real failure and discounted failure of the lottery, all at once."""
    problem = hand_problem(criterion, RETRY, 0.3, 0.95)
    lottery = bayes_adaptive(problem, tolerance=1e-7).policy
    one = evaluate(equivalent_randomised_policy(lottery, problem), problem)
    both = evaluate(lottery, problem)
    for name in ("expected_cost", "success_cost", "failure_probability", "discounted_failure"):
        assert getattr(one, name) == pytest.approx(getattr(both, name), rel=1e-7), name
