"""Theorems t2-0, t2-1 and t2-2 for lotteries and for policies with a memory (section 2.5)."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from checks import library_model, plain
from formulations import MCMP, S3P
from games import drawn_problem
from plain_policies import library_policy, memory_chain, stationary_policies
from references import s3p
from references.chain import long_run_average, mean, start_distribution
from ssp_lp import evaluate
from ssp_lp.game import bayes_adaptive, stationary_game
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.remembering import TimedPolicy
from strategies import often, problems

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
