"""The references of the criteria of success costs, against one another and closed forms."""

from dataclasses import replace
from math import exp

import numpy as np
import pytest
from hypothesis import given, strategies as st

import cost_law_models as models
from checks import plain
from references import accumulated, accumulated_policies, accumulated_program, s3p, s3p_program
from references.chain import plain_model
from references.iteration import kept_actions, success
from strategies import Draw, acyclic_problems, often, problems

EXACT = {"rel": 1e-11, "abs": 1e-12}
CLOSE = {"rel": 1e-7, "abs": 1e-8}
shares = st.sampled_from([0.5, 0.1, 0.25, 0.75, 1.0])
levels = st.sampled_from([0.5, 0.9, 0.3, 0.75])


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


@often(40)
@given(problems(), st.sampled_from([0.0, 0.3, 2.0]))
def test_utilities_against_programs_on_any_model(drawn, bonus):
    """The same product by a linear program, free loops and endless runs included."""
    model, start = plain(drawn), drawn.start
    best = {s: float(p) for s, p in success(model).items()}

    def utility(cost):
        return exp(-0.5 * cost)

    data = accumulated_program.program(
        model,
        start,
        9,
        lambda cost: utility(cost) + bonus,
        lambda state, _: [(best[state], bonus * best[state])],
    )
    low, high = accumulated.expected_utility(model, start, utility, bonus, 9)
    assert accumulated_program.greatest(data, 1.0) == pytest.approx(low, **CLOSE)
    value = accumulated.exponential_utility(model, start, -0.5, bonus)
    assert low - 1e-12 <= value <= high + 1e-12


@often(60)
@given(problems(), st.integers(0, 5))
def test_least_failure_against_programs_on_any_model(drawn, z):
    """Kept actions, no way to stay: E[(C - z)^+; goal] and Pr(C <= z) by a linear program."""
    model, start = plain(drawn), drawn.start
    best = {s: float(p) for s, p in success(model).items()}
    onward, kept = accumulated.success_cost(model), kept_actions(model)
    must = replace(
        model,
        choices={
            state: {action: actions[action] for action in kept.get(state, [])}
            for state, actions in model.choices.items()
        },
        attention=model.dead_ends,
    )
    data = accumulated_program.program(
        must,
        start,
        z + 2,
        lambda cost: -max(cost - z, 0.0),
        lambda s, cost: [(best[s], (z - cost) * best[s] - onward[s])],
    )
    assert -accumulated_program.greatest(data, 1.0) == pytest.approx(
        accumulated.shortfall(model, start, z)[-1], **CLOSE
    )
    data = accumulated_program.program(
        must, start, z + 1, lambda cost: float(cost <= z), lambda s, _: [(best[s], 0.0)]
    )
    assert accumulated_program.greatest(data, 1.0) == pytest.approx(
        accumulated.reach_within(model, start, z, least=True)[-1], **CLOSE
    )


@pytest.mark.parametrize("p", [0.5, 0.3, 0.9])
def test_trying_again_until_it_works(p):
    """The geometric law: bounded reach, quantile, CVaR and expected utility."""
    model = plain_model(models.retry(p), {"g"})
    for bound, value in enumerate(accumulated.reach_within(model, "x", 7)):
        assert value == pytest.approx(models.retry_within(p, bound), **EXACT)
    for level in (0.0, 0.2, 0.5, 0.51, 0.75, 0.99):
        tries = models.retry_quantile(p, level)
        assert accumulated.quantile(model, "x", level) == tries
        assert accumulated_program.quantile(model, "x", level, 0.5) == tries
        cvar = models.retry_cvar(p, level)
        assert accumulated.conditional_value_at_risk(model, "x", level) == pytest.approx(cvar)
    for risk_factor in (-0.1, -1.0):
        assert accumulated.exponential_utility(model, "x", risk_factor, 2.0) == pytest.approx(
            models.retry_utility(p, risk_factor) + 2.0, **EXACT
        )


@pytest.mark.parametrize("risk_factor", [-0.2, -0.7])
def test_the_bonus_at_which_the_safe_move_pays(risk_factor):
    """3/4 (e^l + K) = e^3l + K at K = 3 e^l - 4 e^3l."""
    model = plain_model(models.FAST_OR_SAFE, {"g"})
    bonus = max(models.switching_bonus(risk_factor), 0.0)
    for more, fast in ((bonus + 0.1, False), (bonus / 2, bonus > 0)):
        value = 0.75 * (exp(risk_factor) + more) if fast else exp(3 * risk_factor) + more
        assert accumulated.exponential_utility(model, "x", risk_factor, more) == pytest.approx(
            value, **EXACT
        )


def test_trying_a_limited_number_of_times():
    """Late successes are done without, as far as the budget goes."""
    model = plain_model(models.QUIT_OR_RETRY, {"g"})
    for budget in (0.05, 0.3, 0.5):
        for level in (0.4, 0.7, 0.95):
            assert accumulated_program.quantile(model, "x", level, budget) == (
                models.quit_or_retry_quantile(level, budget)
            )
        assert accumulated_program.reach_within(model, "x", 2, budget) == pytest.approx(0.75)
    low, high = accumulated_program.conditional_value_at_risk(model, "x", 0.5, 0.25)
    assert (low, high) == pytest.approx((5 / 3, 5 / 3))  # law 2/3, 1/3 at 1, 2; worse half: 1, 2
    assert accumulated.conditional_value_at_risk(model, "x", 0.5) == pytest.approx(3.0)


def test_free_cycles_levels_met_exactly_and_starts():
    """Trying for nothing in a loop, ties of the level, starts at a goal and at a dead-end."""
    model = plain_model(models.FREE_CYCLE, {"g"})
    assert accumulated.reach_within(model, "x", 0) == [pytest.approx(1.0, **EXACT)]
    assert accumulated.quantile(model, "x", 0.99) == 0
    assert accumulated.conditional_value_at_risk(model, "x", 0.9) == pytest.approx(0.0, abs=1e-12)
    assert accumulated_program.quantile(model, "x", 0.9, 0.3) == 0
    assert accumulated.exponential_utility(model, "y", -1.0, 0.5) == pytest.approx(1.5, **EXACT)
    model = plain_model(models.TWO_LENGTHS, {"g"})
    for level, cost in ((0.5, 1), (0.51, 2), (0.75, 2), (0.76, 5)):
        assert accumulated.quantile(model, "x", level) == cost
        assert accumulated_program.quantile(model, "x", level, 0.4) == cost
    assert accumulated.conditional_value_at_risk(model, "x", 0.5) == pytest.approx(3.5)
    model = plain_model(models.FAST_OR_SAFE, {"g"})
    start = {"g": 0.5, "d": 0.25, "x": 0.25}
    assert accumulated.reach_within(model, start, 3) == pytest.approx([0.5, 0.6875, 0.6875, 0.75])
    assert accumulated.quantile(model, start, 0.6) == 0
    assert accumulated.quantile(model, start, 0.7) == 3
    assert accumulated.quantile(model, "d", 0.7) is None
    assert accumulated.exponential_utility(model, "d", -1.0, 2.0) == 0.0
