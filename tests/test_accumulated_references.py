"""The references of the criteria of success costs, against one another and closed forms."""

from math import exp

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from checks import plain
from references import accumulated, accumulated_policies, accumulated_program, s3p, s3p_program
from strategies import Draw, acyclic_problems, problems

EXACT = {"rel": 1e-11, "abs": 1e-12}
CLOSE = {"rel": 1e-7, "abs": 1e-8}
shares = st.sampled_from([0.5, 0.1, 0.25, 0.75, 1.0])
levels = st.sampled_from([0.5, 0.9, 0.3, 0.75])


def often(examples):
    """The same settings everywhere; only the number of examples differs."""
    return settings(max_examples=examples, deadline=None, derandomize=True)


def with_a_way_out(drawn):
    """Every live state can also fail at once, so that budgets bite."""
    choices = {
        s: {**actions, "quit": [(1.0, "d9", 0)]} if not s.startswith("d") else actions
        for s, actions in drawn.choices.items()
    }
    return Draw({**choices, "d9": {}}, drawn.goals, drawn.start)


tiny = acyclic_problems(most_live=2, most_actions=2).map(with_a_way_out)


def step(bound):
    """The utility 1{cost <= bound}."""
    return lambda cost: float(cost <= bound)


@often(60)
@given(tiny, st.sampled_from([-0.1, -1.0]), st.sampled_from([0.0, 0.3, 2.0]), st.integers(0, 6))
def test_sweeps_against_all_policies(drawn, risk_factor, bonus, bound):
    """Utilities, bounded reach, and everything at least failure."""
    model, start = plain(drawn), drawn.start
    found = accumulated_policies.laws(model, start)
    safest = accumulated_policies.safest(found)
    value = accumulated_policies.expected_utility(
        found, lambda cost: exp(risk_factor * cost), bonus, 0.0
    )
    assert accumulated.exponential_utility(model, start, risk_factor, bonus) == pytest.approx(
        value, **EXACT
    )
    for least, policies in ((False, found), (True, safest)):
        value = accumulated_policies.reach_within(policies, bound)
        assert accumulated.reach_within(model, start, bound, least=least)[-1] == pytest.approx(
            value, **EXACT
        )
    for level in (0.0, 0.3, 0.5, 0.9):
        if safest[0].success == 0.0:
            assert accumulated.quantile(model, start, level) is None
            assert accumulated.conditional_value_at_risk(model, start, level) is None
            continue
        assert accumulated.quantile(model, start, level) == accumulated_policies.quantile(
            safest, level
        )
        assert accumulated.conditional_value_at_risk(model, start, level) == pytest.approx(
            accumulated_policies.conditional_value_at_risk(safest, level), **EXACT
        )


@often(60)
@given(tiny, shares, levels, st.integers(0, 6))
def test_programs_against_all_lotteries(drawn, share, level, bound):
    """Within a budget: a lottery over two of all policies is enough."""
    model, start = plain(drawn), drawn.start
    found = accumulated_policies.laws(model, start)
    greatest = max(law.success for law in found)
    budget = 1.0 - greatest + share * greatest
    assert accumulated_program.reach_within(model, start, bound, budget) == pytest.approx(
        accumulated_policies.reach_within(found, bound, budget), **CLOSE
    )
    if greatest == 0.0:
        return
    assert accumulated_program.quantile(model, start, level, budget) == (
        accumulated_policies.quantile(found, level, budget)
    )
    low, high = accumulated_program.conditional_value_at_risk(model, start, level, budget)
    value = accumulated_policies.conditional_value_at_risk(found, level, budget)
    assert (low, high) == pytest.approx((value, value), **CLOSE)


@often(60)
@given(problems(attention=True), st.integers(0, 8))
def test_budgets_that_do_not_bind(drawn, bound):
    """The program within budget 1 is the sweep, free loops included."""
    model, start = plain(drawn), drawn.start
    swept = accumulated.reach_within(model, start, bound)
    assert accumulated_program.reach_within(model, start, bound, 1.0) == pytest.approx(
        swept[-1], **CLOSE
    )
    assert np.all(np.diff(swept) >= -1e-12)
    assert swept[-1] <= accumulated.goal_probability(model, start) + 1e-12


@often(60)
@given(problems())
def test_least_failure_against_enumeration(drawn):
    """The greatest goal probability, and CVaR at level 0, over all stationary policies."""
    model, start = plain(drawn), drawn.start
    failure, cost = s3p.at_least_failure(model, start)
    assert accumulated.goal_probability(model, start) == pytest.approx(1.0 - failure, **EXACT)
    value = accumulated.conditional_value_at_risk(model, start, 0.0)
    assert value == (None if cost is None else pytest.approx(cost, **EXACT))


@often(15)
@given(problems(most_live=2, most_actions=2), st.sampled_from([0.5, 0.25, 1.0]))
def test_cvar_at_level_zero_against_the_other_program(drawn, share):
    """Level 0 is S3P within the same budget."""
    model, start = plain(drawn), drawn.start
    probability = accumulated.goal_probability(model, start)
    if probability == 0.0:
        return
    budget = 1.0 - (1.0 - share) * probability
    low, high = accumulated_program.conditional_value_at_risk(model, start, 0.0, budget)
    under, over = s3p_program.ratio_bounds(model, start, budget)
    assert max(low, under) <= min(high, over) + 1e-7 * max(1.0, high)
