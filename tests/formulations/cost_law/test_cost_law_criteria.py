"""The criteria of the law of success costs on drawn problems, against the references."""

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st

from checks import GAP, library_model, plain
from cost_law_models import SHARP
from formulations import EGUBS, GUBS, CostBoundedReach, CostQuantile, CVaR
from references import s3p, s3p_program
from ssp_lp import SSP, InfeasibleError, certify, evaluate, solve
from strategies import Draw, often, problems

CLOSE = {"rel": 1e-7, "abs": 1e-8}
"""The library certifies 1e-8; HiGHS is right to 1e-10, magnified by the price of the budget."""
AROUND = 1e-8
"""Within a budget the reference cannot tell a level from a neighbour as near as this."""

shares = st.sampled_from([None, 0.5, None, 0.1, 0.25, 0.75, 1.0])
"""Where the budget lies between the least failure (None: at it) and sure failure (1)."""
levels = st.sampled_from([0.5, 0.9, 0.29, 0.75])
bounds = st.integers(0, 7)
drawn_problems = st.one_of(problems(), problems(attention=True))


def least_failure(drawn):
    return s3p.at_least_failure(plain(drawn), drawn.start)[0]


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
    found, certificate = evaluate(solution.policy, problem), certify(solution)
    assert certificate.accepted, certificate.reason
    assert certificate.gap <= GAP
    for judged in (found, certificate):
        assert judged.objective == pytest.approx(solution.objective, rel=1e-9, abs=1e-12)
    assert found.failure_probability == pytest.approx(solution.failure_probability, abs=1e-12)
    if problem.failure_budget is not None:
        assert solution.failure_probability <= problem.failure_budget + 1e-12
    return solution


def check_hopeless(problem):
    """Where no run can succeed there is no cost given success."""
    with pytest.raises(InfeasibleError) as caught:
        solve(problem)
    assert caught.value.least_failure == pytest.approx(1.0, abs=1e-12)


UTILITIES = {
    "exponential": lambda cost: np.exp(-0.4 * np.asarray(cost, dtype=float)),
    "step": lambda cost: np.where(np.asarray(cost) <= 3, 1.0, 0.0),
    "two steps": lambda cost: np.where(np.asarray(cost) <= 1, 1.0, 0.4 * (np.asarray(cost) <= 5)),
    "line": lambda cost: np.maximum(1.0 - np.asarray(cost) / 8, 0.0),
    "hyperbola": lambda cost: 1.0 / (1.0 + np.asarray(cost)),
    "constant": lambda cost: np.zeros(np.shape(cost)),
}
"""Non-increasing utilities with limit 0."""
bonuses = st.sampled_from([0.3, 0.0, 1.0, 20.0])


@often(80)
@given(problems(), st.sampled_from([-0.5, -0.1, -2.0]), bonuses)
def test_exponential_utility(drawn, rate, bonus):
    """EGUBS up to a cost at which exp(rate * cost) has vanished."""
    value = s3p_program.exponential_utility(plain(drawn), drawn.start, rate, bonus)
    check(EGUBS(library_model(drawn), drawn.start, rate, bonus), value)


@often(60)
@given(problems(), st.sampled_from(sorted(UTILITIES)), bonuses, st.sampled_from([0.0, -0.5]))
def test_expected_utility(drawn, name, bonus, at_infinity):
    """GUBS for utilities of any shape; failing may be worth less than any cost."""
    utility = UTILITIES[name]
    low, high = s3p_program.expected_utility(
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


@pytest.mark.parametrize("criterion", [CostBoundedReach, CostQuantile, CVaR])
@often(120)
@given(drawn=drawn_problems, share=shares, level=levels, bound=bounds)
def test_within_a_budget_and_at_least_failure(criterion, drawn, share, level, bound):
    """A level that is met exactly is met; at least failure no success is given up for it."""
    model, start, least = plain(drawn), drawn.start, least_failure(drawn)
    budget = None if share is None else least + share * (1.0 - least)
    level = 0.0 if criterion is CVaR and level == 0.75 else level
    asked = bound if criterion is CostBoundedReach else level
    problem = criterion(library_model(drawn), start, asked, budget)
    close = SHARP if share is None else CLOSE
    if criterion is CostBoundedReach:
        value = s3p_program.reach_within(model, start, bound, budget)
    elif least >= 1.0:
        check_hopeless(problem)
        return
    elif criterion is CostQuantile:
        value, close = solve(problem).objective, SHARP
        around = (0.0,) if share is None else (-AROUND, AROUND)
        assert value in [s3p_program.quantile(model, start, level + by, budget) for by in around]
    else:
        low, high = s3p_program.conditional_value_at_risk(model, start, level, budget)
        assume(high - low <= 1e-8 * max(1.0, high))
        value = (low + high) / 2
    solution = check(problem, value, close)
    if share is None:
        assert solution.goal_probability == pytest.approx(1.0 - least, abs=1e-11)


@often(40)
@given(problems())
def test_budgets_below_the_least_failure(drawn):
    """Refused, with the least failure; a budget of exactly that is kept by least failure."""
    model, start, least = library_model(drawn), drawn.start, least_failure(drawn)
    assume(1e-6 < least < 1.0)
    for criterion, asked in ((CostBoundedReach, 4), (CostQuantile, 0.5), (CVaR, 0.5)):
        with pytest.raises(InfeasibleError) as caught:
            solve(criterion(model, start, asked, 0.5 * least))
        assert caught.value.least_failure == pytest.approx(least, abs=1e-10)
        exactly, known = (solve(criterion(model, start, asked, b)) for b in (least, None))
        assert exactly.objective == pytest.approx(known.objective, **CLOSE)
        assert exactly.failure_probability <= least + 1e-10


def twisted(drawn, name=lambda state: state, unit=1, dearer=False):
    """Other names and the opposite order, another unit of cost, every action once more, dearer."""
    choices = {
        name(state): {
            f"{again} {action}": [
                (p, name(to), unit * (cost + again)) for p, to, cost in outs[::-1]
            ]
            for again in range(1 + dearer)
            for action, outs in reversed(actions.items())
        }
        for state, actions in reversed(drawn.choices.items())
    }
    start = drawn.start if isinstance(drawn.start, dict) else {drawn.start: 1.0}
    start = {name(state): p for state, p in start.items()}
    return Draw(choices, frozenset(map(name, drawn.goals)), start)


@often(12)
@given(problems(), levels, bounds, st.sampled_from([0.5, 0.1, 0.25, 0.75, 1.0]))
def test_symmetries(drawn, level, bound, share):
    least = least_failure(drawn)
    budget = least + share * (1.0 - least)
    numbers = {}
    for unit, twist in (
        (1, twisted(drawn, name=lambda state: numbers.setdefault(state, 100 - len(numbers)))),
        (1, twisted(drawn, dearer=True)),
        (4, twisted(drawn, unit=4)),
    ):
        values = []
        for one, scale in ((drawn, 1), (twist, unit)):
            model, start = library_model(one), one.start
            problem = EGUBS(model, start, -0.6 / scale, 0.7)
            values.append([solve(problem).objective])
            problem = CostBoundedReach(model, start, bound * scale, budget)
            values[-1].append(solve(problem).objective)
            if least < 1.0:
                for criterion in (CostQuantile, CVaR):
                    problem = criterion(model, start, level, budget)
                    values[-1].append(solve(problem).objective / scale)
        assert values[1] == pytest.approx(values[0], **CLOSE)
