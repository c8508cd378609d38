"""Theorems of section 2."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from checks import CLOSE, library_model, plain
from formulations import MCMP, S3P
from games import drawn_problem
from plain_policies import library_policy, memory_chain, stationary_policies
from references import mcmp, s3p
from references.chain import long_run_average, mean, start_distribution
from ssp_lp import evaluate
from ssp_lp.game import bayes_adaptive, stationary_game
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.remembering import TimedPolicy
from strategies import discounts, meanings, often, problems

# A user's own stationary policies: exact evaluation, and the paper's theorems of section 2.5.


drawn_settings = often(33)


@drawn_settings
@given(problems(most_live=3), meanings, st.booleans(), discounts, st.data())
def test_evaluation_under_case_m(drawn, give_up, charge, discount, data):
    """Tau comes from the policy's own chain; a class that pays for ever costs infinity."""
    reference, model = plain(drawn), library_model(drawn)
    decisions = data.draw(stationary_policies(drawn, reference, give_up))
    begin = start_distribution(drawn.start)
    problem = MCMP(
        model,
        start=drawn.start,
        failure_budget=1.0,
        discount=discount,
        give_up=give_up,
        charge_failing_step=charge,
    )
    evaluation = evaluate(library_policy(model, decisions), problem)
    failure, cost = mcmp.evaluate(reference, begin, decisions, give_up, charge)
    assert evaluation.failure_probability == pytest.approx(failure, abs=1e-12)
    assert evaluation.goal_probability == pytest.approx(1 - failure, abs=1e-12)
    assert evaluation.expected_cost == pytest.approx(cost, **CLOSE)
    if discount is None:
        assert evaluation.objective == pytest.approx(cost, **CLOSE)
        assert evaluation.discounted_failure is None
    else:
        failure, cost = mcmp.evaluate(reference, begin, decisions, give_up, charge, discount)
        assert evaluation.discounted_failure == pytest.approx(failure, abs=1e-12)
        assert evaluation.objective == pytest.approx(cost, **CLOSE)


@drawn_settings
@given(problems(most_live=3), discounts, st.data())
def test_evaluation_under_case_s(drawn, discount, data):
    """Cost on success, its ratio to the success, exact and discounted."""
    reference, model = plain(drawn), library_model(drawn)
    decisions = data.draw(stationary_policies(drawn, reference, "dead_ends"))
    begin = start_distribution(drawn.start)
    problem = S3P(model, start=drawn.start, failure_budget=1.0, discount=discount)
    evaluation = evaluate(library_policy(model, decisions), problem)
    weight, cost = (mean(begin, part) for part in s3p.values(reference, decisions, None))
    assert evaluation.goal_probability == pytest.approx(weight, abs=1e-12)
    assert evaluation.success_cost == pytest.approx(cost, **CLOSE)
    if weight > 0:
        assert evaluation.conditional_cost == pytest.approx(cost / weight, **CLOSE)
        weight, cost = (mean(begin, part) for part in s3p.values(reference, decisions, discount))
        assert evaluation.objective == pytest.approx(cost / weight, **CLOSE)


@pytest.mark.slow
@drawn_settings
@given(problems(), meanings, st.data())
def test_failure_is_the_long_run_average_of_not_being_at_the_goal(drawn, give_up, data):
    """Theorem t2-0; stopping and dead-ends stay where they are."""
    reference, model = plain(drawn), library_model(drawn)
    decisions = data.draw(stationary_policies(drawn, reference, give_up))
    problem = MCMP(model, start=drawn.start, failure_budget=1.0, give_up=give_up)
    evaluation = evaluate(library_policy(model, decisions), problem)
    average = long_run_average(reference, start_distribution(drawn.start), decisions)
    assert evaluation.failure_probability == pytest.approx(average, abs=1e-6)


@pytest.mark.slow
@drawn_settings
@given(problems(), meanings, st.data())
def test_discounted_failure_falls_to_the_failure(drawn, give_up, data):
    """Theorems t2-1 and t2-2: F <= L(gamma) <= F + (1 - gamma) E[T; goal], and L falls in gamma."""
    reference, model = plain(drawn), library_model(drawn)
    decisions = data.draw(stationary_policies(drawn, reference, give_up))
    policy = library_policy(model, decisions)
    steps = plain(
        type(drawn)(
            {
                s: {a: [(p, t, 1.0) for p, t, _ in outcomes] for a, outcomes in actions.items()}
                for s, actions in drawn.choices.items()
            },
            drawn.goals,
            drawn.start,
        )
    )
    time = mean(start_distribution(drawn.start), s3p.values(steps, decisions, None)[1])
    before = 1.0
    for gamma in (0.5, 0.9, 0.999, 1 - 1e-6, 1 - 1e-9):
        problem = MCMP(
            model, start=drawn.start, failure_budget=1.0, discount=gamma, give_up=give_up
        )
        evaluation = evaluate(policy, problem)
        failure, surrogate = evaluation.failure_probability, evaluation.discounted_failure
        assert surrogate >= failure - 1e-12
        assert surrogate <= failure + (1 - gamma) * time + 1e-12
        assert surrogate <= before + 1e-12
        before = surrogate


# Theorems t2-0, t2-1 and t2-2 for lotteries and for policies with a memory (section 2.5).


few = often(12)


def _check(drawn, model, policy):
    """Failure is the long-run average, the surrogate is E[1 - gamma^T] and falls to it."""
    reference, begin = plain(drawn), start_distribution(drawn.start)
    chains = [memory_chain(reference, begin, member) for member in policy.policies]
    average = sum(
        weight * long_run_average(chain, start, moves)
        for weight, (start, chain, moves) in zip(policy.weights, chains, strict=True)
    )
    before = 1.0
    for gamma in (0.5, 0.9, 0.999, 1 - 1e-6):
        problem = MCMP(model, start=drawn.start, failure_budget=1.0, discount=gamma)
        found = evaluate(policy, problem)
        assert found.failure_probability == pytest.approx(average, abs=1e-6)  # t2-0
        surrogate = 1.0 - sum(
            weight * mean(start, s3p.values(chain, moves, gamma)[0])
            for weight, (start, chain, moves) in zip(policy.weights, chains, strict=True)
        )
        assert found.discounted_failure == pytest.approx(surrogate, abs=1e-11)
        assert found.failure_probability - 1e-12 <= surrogate <= before + 1e-12  # t2-2
        before = surrogate
    assert before == pytest.approx(average, abs=1e-3)  # t2-1


@pytest.mark.slow
@few
@given(problems(most_live=3), st.sampled_from([(1.0,), (0.5, 0.5), (0.2, 0.8)]), st.data())
def test_lotteries_of_policies_that_depend_on_time(drawn, weights, data):
    """t2-0 to t2-2 for every lottery over policies that change their minds twice."""
    model, reference = library_model(drawn), plain(drawn)
    members = [
        TimedPolicy(
            tuple(
                library_policy(model, data.draw(stationary_policies(drawn, reference, "attention")))
                for _ in range(3)
            )
        )
        for _ in weights
    ]
    _check(drawn, model, MixedPolicy(tuple(members), np.array(weights)))


@pytest.mark.slow
@pytest.mark.parametrize("solver", [stationary_game, bayes_adaptive])
@few
@given(problems(most_live=2), st.sampled_from([0.25, 0.1, 0.5]))
def test_optimal_lotteries_of_case_s(solver, drawn, share):
    """t2-0 to t2-2 for lotteries over policies of the accumulated cost, with and without time."""
    problem = drawn_problem(S3P, drawn, share, 0.5)
    _check(drawn, problem.model, solver(problem, tolerance=1e-6).policy)
