"""The criteria of the law of success costs on drawn problems, against the references."""

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st

from checks import GAP, library_model, plain
from cost_law_models import SHARP
from formulations import EGUBS, GUBS, S3P, CostBoundedReach, CostQuantile, CVaR
from references import accumulated, accumulated_program
from ssp_lp import SSP, InfeasibleError, certify, evaluate, solve
from strategies import Draw, often, problems

CLOSE = {"rel": 1e-7, "abs": 1e-8}
"""The library certifies 1e-8; HiGHS is right to 1e-10, magnified by the price of the budget."""
AROUND = 1e-8
"""Within a budget the reference cannot tell a level from a neighbour as near as this."""

shares = st.sampled_from([0.5, 0.1, 0.25, 0.75, 1.0])
levels = st.sampled_from([0.5, 0.9, 0.29, 0.75])
bounds = st.integers(0, 7)
risks = st.sampled_from([-0.5, -0.1, -2.0])
bonuses = st.sampled_from([0.3, 0.0, 1.0, 20.0])


def budget_within(model, start, share):
    """A budget at a share of the way from the least failure to sure failure, and the least."""
    greatest = accumulated.goal_probability(model, start)
    return 1.0 - greatest + share * greatest, 1.0 - greatest


def check(problem, value, close=SHARP):
    """Value, bounds on the right side, evaluation, certificate and budget of one problem."""
    solution = solve(problem)
    room = close["abs"] + close["rel"] * abs(value)
    assert solution.objective == pytest.approx(value, **close)
    assert 0.0 <= solution.gap <= GAP
    if isinstance(problem, (CostQuantile, CVaR)):
        assert solution.upper_bound is None
        assert solution.lower_bound <= min(solution.objective + 1e-12, value + room)
    else:
        assert solution.lower_bound == solution.objective
        assert solution.upper_bound >= max(solution.objective - 1e-12, value - room)
    found = evaluate(solution.policy, problem)
    assert found.objective == pytest.approx(solution.objective, rel=1e-9, abs=1e-12)
    certificate = certify(solution)
    assert certificate.accepted, certificate.reason
    assert certificate.gap <= GAP
    assert certificate.objective == pytest.approx(solution.objective, rel=1e-9, abs=1e-12)
    assert found.failure_probability == pytest.approx(solution.failure_probability, abs=1e-12)
    if getattr(problem, "failure_budget", None) is not None:
        assert solution.failure_probability <= problem.failure_budget + 1e-12
    return solution


@often(80)
@given(problems(), risks, bonuses)
def test_exponential_utility(drawn, risk_factor, bonus):
    """EGUBS by backward induction from a layer where exp(risk_factor * cost) has vanished."""
    value = accumulated.exponential_utility(plain(drawn), drawn.start, risk_factor, bonus)
    check(EGUBS(library_model(drawn), drawn.start, risk_factor, bonus), value)


UTILITIES = {
    "exponential": lambda cost: np.exp(-0.4 * np.asarray(cost, dtype=float)),
    "step": lambda cost: np.where(np.asarray(cost) <= 3, 1.0, 0.0),
    "two steps": lambda cost: np.where(np.asarray(cost) <= 1, 1.0, 0.4 * (np.asarray(cost) <= 5)),
    "line": lambda cost: np.maximum(1.0 - np.asarray(cost) / 8, 0.0),
    "hyperbola": lambda cost: 1.0 / (1.0 + np.asarray(cost)),
    "constant": lambda cost: np.zeros(np.shape(cost)),
}
"""Non-increasing utilities with limit 0."""


@often(60)
@given(problems(), st.sampled_from(sorted(UTILITIES)), bonuses, st.sampled_from([0.0, -0.5]))
def test_expected_utility(drawn, name, bonus, at_infinity):
    """GUBS for utilities of any shape; failing may be worth less than any cost."""
    utility = UTILITIES[name]
    low, high = accumulated.expected_utility(
        plain(drawn), drawn.start, lambda c: float(utility(c)), bonus, 150, at_infinity, limit=0.0
    )
    assume(high - low <= 1e-9)
    problem = GUBS(library_model(drawn), drawn.start, utility, bonus, at_infinity)
    check(problem, (low + high) / 2)


@pytest.mark.parametrize("back", [0.5, 0.75, 0.9, 1 / 3])
def test_what_cancels_to_rounding_is_no_gap(back):
    """Worth nothing and surely reached: success is worth what failing costs, taken off that."""
    steps = {"a": {"on": [(1.0, "c", 1)]}, "c": {"try": [(back, "a", 1), (1 - back, "goal", 1)]}}
    model = SSP.from_transitions(steps, goal={"goal"})
    check(GUBS(model, "a", UTILITIES["constant"], 0.0, -0.5), 0.0)


@often(80)
@given(problems(), bounds, st.booleans())
def test_reach_within_a_bound(drawn, bound, least):
    """The greatest probability of arriving in time, over all policies or those of least failure."""
    value = accumulated.reach_within(plain(drawn), drawn.start, bound, least=least)[-1]
    budget = {"failure_budget": None} if least else {}
    solution = check(CostBoundedReach(library_model(drawn), drawn.start, bound, **budget), value)
    if least:
        greatest = accumulated.goal_probability(plain(drawn), drawn.start)
        assert solution.goal_probability == pytest.approx(greatest, abs=1e-11)


@often(60)
@given(problems(), bounds, shares)
def test_reach_within_a_bound_and_a_budget(drawn, bound, share):
    """A lottery within the failure budget."""
    model = plain(drawn)
    budget, _ = budget_within(model, drawn.start, share)
    value = accumulated_program.reach_within(model, drawn.start, bound, budget)
    check(CostBoundedReach(library_model(drawn), drawn.start, bound, budget), value, CLOSE)


@often(80)
@given(problems(), levels)
def test_quantile_at_least_failure(drawn, level):
    """The least deadline that is met often enough; a level that is met exactly is met."""
    problem = CostQuantile(library_model(drawn), drawn.start, level)
    value = accumulated.quantile(plain(drawn), drawn.start, level)
    if value is None:
        check_hopeless(problem)
        return
    solution = check(problem, value)
    greatest = accumulated.goal_probability(plain(drawn), drawn.start)
    assert solution.goal_probability == pytest.approx(greatest, abs=1e-11)


@often(60)
@given(problems(attention=True), levels, shares)
def test_quantile_within_a_budget(drawn, level, share):
    """The least deadline, where failing instead of being late is possible."""
    model, start = plain(drawn), drawn.start
    budget, least = budget_within(model, start, share)
    problem = CostQuantile(library_model(drawn), start, level, budget)
    if least >= 1.0:
        check_hopeless(problem)
        return
    value = solve(problem).objective
    low, high = (
        accumulated_program.quantile(model, start, near, budget)
        for near in (level - AROUND, level + AROUND)
    )
    assert value in (low, high)
    check(problem, value)


@often(80)
@given(problems(), st.sampled_from([0.5, 0.0, 0.9, 0.29]))
def test_cvar_at_least_failure(drawn, level):
    """The least mean of the worst share of the costs."""
    problem = CVaR(library_model(drawn), drawn.start, level)
    value = accumulated.conditional_value_at_risk(plain(drawn), drawn.start, level)
    if value is None:
        check_hopeless(problem)
        return
    solution = check(problem, value)
    greatest = accumulated.goal_probability(plain(drawn), drawn.start)
    assert solution.goal_probability == pytest.approx(greatest, abs=1e-11)


@often(60)
@given(problems(attention=True), st.sampled_from([0.5, 0.0, 0.9, 0.29]), shares)
def test_cvar_within_a_budget(drawn, level, share):
    """Within a budget; at level 0 it is S3P."""
    model, start = plain(drawn), drawn.start
    budget, least = budget_within(model, start, share)
    problem = CVaR(library_model(drawn), start, level, budget)
    if least >= 1.0:
        check_hopeless(problem)
        return
    low, high = accumulated_program.conditional_value_at_risk(model, start, level, budget)
    assume(high - low <= 1e-8 * max(1.0, high))
    check(problem, (low + high) / 2, CLOSE)
    if level == 0.0:
        mean = solve(S3P(library_model(drawn), start, budget)).objective
        assert solve(problem).objective == pytest.approx(mean, **SHARP)


def check_hopeless(problem):
    """Where no run can succeed there is no cost given success."""
    with pytest.raises(InfeasibleError) as caught:
        solve(problem)
    assert caught.value.least_failure == pytest.approx(1.0, abs=1e-12)


@often(40)
@given(problems())
def test_budgets_below_the_least_failure(drawn):
    """Refused, with the least failure; a budget of exactly that is kept by least failure."""
    model, start = library_model(drawn), drawn.start
    _, least = budget_within(plain(drawn), start, 0.0)
    assume(1e-6 < least < 1.0)
    for stated in (
        lambda budget: CostBoundedReach(model, start, 4, budget),
        lambda budget: CostQuantile(model, start, 0.5, budget),
        lambda budget: CVaR(model, start, 0.5, budget),
    ):
        with pytest.raises(InfeasibleError) as caught:
            solve(stated(0.5 * least))
        assert caught.value.least_failure == pytest.approx(least, abs=1e-10)
        exactly = solve(stated(least))
        assert exactly.objective == pytest.approx(solve(stated(None)).objective, **CLOSE)
        assert exactly.failure_probability <= least + 1e-10


@often(12)
@given(problems(), levels, bounds, shares)
def test_symmetries(drawn, level, bound, share):
    """Other names and orders, dominated actions, and another unit of cost change nothing."""
    start = drawn.start
    budget, least = budget_within(plain(drawn), start, share)
    for twist, unit in ((renamed, 1), (with_dearer_actions, 1), (in_units(4), 4)):
        one, other = drawn, twist(drawn)
        pairs = [
            [EGUBS(library_model(d), d.start, -0.6 / u, 0.7) for d, u in ((one, 1), (other, unit))],
            [
                CostBoundedReach(library_model(d), d.start, bound * u, budget)
                for d, u in ((one, 1), (other, unit))
            ],
        ]
        factors = [1, 1]
        if least < 1.0:
            pairs += [
                [CostQuantile(library_model(d), d.start, level, budget) for d in (one, other)],
                [CVaR(library_model(d), d.start, level, budget) for d in (one, other)],
            ]
            factors += [unit, unit]
        for (first, second), factor in zip(pairs, factors, strict=True):
            value = solve(first).objective * factor
            assert solve(second).objective == pytest.approx(value, **CLOSE), type(first).__name__


def renamed(drawn):
    """Numbers for names, and everything in the opposite order."""
    code = {}

    def name(state):
        return code.setdefault(state, 100 - len(code))

    choices = {
        name(state): {
            f"do {action}": [(p, name(s), cost) for p, s, cost in outcomes[::-1]]
            for action, outcomes in reversed(actions.items())
        }
        for state, actions in reversed(drawn.choices.items())
    }
    start = drawn.start
    start = {name(s): p for s, p in start.items()} if isinstance(start, dict) else name(start)
    return Draw(choices, frozenset(name(goal) for goal in drawn.goals), start)


def with_dearer_actions(drawn):
    """Every action once more, at a cost of 1 more."""
    choices = {
        state: actions
        | {f"dear {a}": [(p, s, cost + 1) for p, s, cost in o] for a, o in actions.items()}
        for state, actions in drawn.choices.items()
    }
    return Draw(choices, drawn.goals, drawn.start)


def in_units(unit):
    """All costs multiplied."""

    def twist(drawn):
        choices = {
            state: {a: [(p, s, unit * c) for p, s, c in o] for a, o in actions.items()}
            for state, actions in drawn.choices.items()
        }
        return Draw(choices, drawn.goals, drawn.start)

    return twist
