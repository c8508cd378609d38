"""The criteria of the law of success costs: closed forms, edges, refusals; draws by references."""

import warnings
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction
from math import exp, inf, nan

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st

import cost_law_models as models
from checks import GAP, library_model, optimum, plain
from cost_law_models import SAFE_OR_FAST, SHARP, falling
from formulations import EGUBS, GUBS, S3P, CostBoundedReach, CostQuantile, CVaR, compare_criteria
from references import s3p, s3p_program
from small_models import model_of
from ssp_lp import (
    SSP,
    DeterministicPolicy,
    InfeasibleError,
    MixedPolicy,
    ModelError,
    certify,
    evaluate,
    solve,
)
from ssp_lp.methods.risk import _TailMeanSearch, feasible_set
from ssp_lp.options import CERTIFYING
from strategies import often, problems


def always(model, action):
    """The policy that takes one action at "x"."""
    return MixedPolicy((DeterministicPolicy.from_actions(model, {"x": action}),), np.ones(1))


@pytest.mark.parametrize("p", [Fraction(1, 2), Fraction(3, 10), Fraction(9, 10)])
def test_trying_again_until_it_works(p):
    """The geometric law."""
    model = model_of(models.retry(float(p)))
    for bound in (0, 1, 2, 5, 5.5):
        value = float(models.retry_within(p, int(bound)))
        assert optimum(CostBoundedReach(model, "x", bound)) == pytest.approx(value, **SHARP)
    for level in (0.2, 0.51, 0.75, 0.99):
        tries = models.retry_quantile(float(p), level)
        assert optimum(CostQuantile(model, "x", level)) == tries
        assert optimum(CostQuantile(model, "x", level, 0.5)) == tries
        cvar = models.retry_cvar(float(p), level)
        assert optimum(CVaR(model, "x", level)) == pytest.approx(cvar, **SHARP)
    assert optimum(CVaR(model, "x", 0.0)) == pytest.approx(float(1 / p), **SHARP)
    for rate in (-0.1, -1.0):
        value = models.retry_utility(float(p), rate)
        for bonus in (0.0, 2.0):
            found = optimum(EGUBS(model, "x", rate, bonus))
            assert found == pytest.approx(value + bonus, **SHARP)


@pytest.mark.parametrize("rate", [-0.7, -1.5])
def test_the_bonus_at_which_the_safe_move_pays(rate):
    """Below the bonus "fast" is played, above it "safe", and at it both are worth the same."""
    bonus = models.switching_bonus(rate)
    assert bonus > 0.1
    below, above = (solve(EGUBS(SAFE_OR_FAST, "x", rate, bonus + by)) for by in (-0.05, 0.05))
    assert (below.failure_probability, above.failure_probability) == (0.25, 0.0)
    assert below.objective == pytest.approx(0.75 * (exp(rate) + bonus - 0.05), **SHARP)
    assert above.objective == pytest.approx(exp(3 * rate) + bonus + 0.05, **SHARP)
    value = exp(3 * rate) + bonus
    assert optimum(EGUBS(SAFE_OR_FAST, "x", rate, bonus)) == pytest.approx(value, **SHARP)


@pytest.mark.parametrize("cost", [0.1, Fraction(1, 10)])
def test_a_deadline_just_reachable(cost):
    """0.1 + 0.1 + 0.1 <= 0.3, though not in floating point."""
    steps = {"a": [(1.0, "b", cost)], "b": [(1.0, "c", cost)],
             "c": [(0.5, "g", cost), (0.5, "c", cost)]}  # fmt: skip
    model = model_of({state: {"go": outcomes} for state, outcomes in steps.items()})
    assert optimum(CostBoundedReach(model, "a", 0.3)) == 0.5
    assert optimum(CostBoundedReach(model, "a", 0.29)) == 0.0
    assert optimum(CostBoundedReach(model, "a", 0.7)) == pytest.approx(1 - 2.0**-5, **SHARP)
    assert optimum(CostQuantile(model, "a", 0.5)) == pytest.approx(0.3, abs=1e-12)
    assert optimum(CVaR(model, "a", 0.0)) == pytest.approx(0.4, **SHARP)


def test_trying_a_limited_number_of_times():
    """Within a budget late successes are done without: quantile, CVaR and bounded reach."""
    model = model_of(models.QUIT_OR_RETRY)
    for budget in (0.05, 0.3):
        for level in (0.4, 0.7, 0.95):
            value = models.quit_or_retry_quantile(level, budget)
            assert optimum(CostQuantile(model, "x", level, budget)) == value
        assert optimum(CostBoundedReach(model, "x", 2, budget)) == pytest.approx(0.75, **SHARP)
    for budget, value in ((0.25, 5 / 3), (None, 3.0), (0.0, 3.0)):
        assert optimum(CVaR(model, "x", 0.5, budget)) == pytest.approx(value, **SHARP)


def test_a_budget_makes_the_fast_move_affordable():
    """Bounded reach 3/4 w, with the weight w = 4 * budget of the fast move, for bounds 1 and 2."""
    for budget in (0.05, 0.1, 0.2):
        weight = 4 * budget
        for bound, value in ((0, 0.0), (1, 0.75 * weight), (2, 0.75 * weight), (3, 1.0)):
            found = optimum(CostBoundedReach(SAFE_OR_FAST, "x", bound, budget))
            assert found == pytest.approx(value, **SHARP)
        early = 0.75 * weight / (1 - budget)  # given success
        assert optimum(CostQuantile(SAFE_OR_FAST, "x", early - 1e-6, budget)) == 1.0
        assert optimum(CostQuantile(SAFE_OR_FAST, "x", early + 1e-6, budget)) == 3.0
        assert optimum(CVaR(SAFE_OR_FAST, "x", 0.0, budget)) == pytest.approx(3 - 2 * early)
    assert optimum(CostBoundedReach(SAFE_OR_FAST, "x", 1, None)) == 0.0
    assert optimum(CostQuantile(SAFE_OR_FAST, "x", 0.5, 0.25)) == 1.0


CHANCY = {
    "x": {
        "fast": [(0.75, "g", 1), (0.25, "d", 1)],
        "slow": [(0.5, "g", 2), (0.4, "y", 2), (0.1, "d", 1)],
    },
    "y": {"again": [(0.5, "g", 1), (0.5, "x", 1)], "quit": [(1.0, "d", 0)]},
    "d": {},
}
MODEL = model_of(CHANCY)
LEAST = 1 / 8
"""Of "slow" and "again": f = 1/10 + 2/5 * 1/2 * f."""


def test_the_ends_of_the_scales():
    """CVaR at level 0 is S3P; late bounds and great bonuses are MAXPROB."""
    for budget in (None, LEAST + 0.1, 0.8):
        mean = solve(S3P(MODEL, "x", budget)).objective
        assert optimum(CVaR(MODEL, "x", 0.0, budget)) == pytest.approx(mean, **SHARP)
    late = optimum(CostBoundedReach(MODEL, "x", 200))
    assert late == pytest.approx(1 - LEAST, **SHARP)
    assert late <= 1 - LEAST + 1e-12
    assert solve(EGUBS(MODEL, "x", -0.5, 1e3)).failure_probability == pytest.approx(LEAST)


def test_utilities_that_are_other_criteria():
    """GUBS with u = exp is eGUBS, and with a step at the bound CostBoundedReach."""
    for rate, bonus in ((-0.3, 0.0), (-0.3, 1.5), (-2.0, 0.1)):
        general = GUBS(MODEL, "x", lambda c, r=rate: np.exp(r * np.asarray(c)), bonus)
        special = optimum(EGUBS(MODEL, "x", rate, bonus))
        assert optimum(general) == pytest.approx(special, **SHARP)
        lower = replace(general, utility_at_infinity=-2.0)
        dearer = EGUBS(MODEL, "x", rate, bonus + 2.0)
        assert optimum(lower) == pytest.approx(optimum(dearer) - 2.0, **SHARP)
    for bound in (0, 1, 2, 5):
        step = GUBS(MODEL, "x", lambda c, b=bound: np.where(np.asarray(c) <= b, 1.0, 0.0), 0.0)
        assert optimum(step) == pytest.approx(optimum(CostBoundedReach(MODEL, "x", bound)), **SHARP)


def test_starts_at_the_goal_at_a_dead_end_and_in_between():
    """C = 0 at the goal; at a dead-end failing's worth, or nothing to be conditioned on."""
    model, start = SAFE_OR_FAST, {"g": 0.5, "d": 0.25, "x": 0.25}
    assert optimum(EGUBS(model, "g", -0.5, 2.0)) == 3.0
    assert optimum(GUBS(model, "g", lambda c: np.maximum(0.5 - c, -4.0), 2.0, -4.0)) == 2.5
    for budget in (None, 0.0, 1.0):
        assert optimum(CostBoundedReach(model, "g", 0, budget)) == 1.0
        assert optimum(CostQuantile(model, "g", 0.9, budget)) == 0.0
        assert optimum(CVaR(model, "g", 0.9, budget)) == 0.0
    for bound, value in enumerate((0.5, 0.6875, 0.6875, 0.75)):
        assert optimum(CostBoundedReach(model, start, bound)) == pytest.approx(value, **SHARP)
    assert optimum(CostQuantile(model, start, 0.6)) == 0.0
    assert optimum(CostQuantile(model, start, 0.7)) == 3.0
    value = 0.5 * 3.0 + 0.25 * (exp(-1.5) + 2.0)
    assert optimum(EGUBS(model, start, -0.5, 2.0)) == pytest.approx(value, **SHARP)
    assert optimum(CVaR(model, start, 0.0)) == pytest.approx(1.0, **SHARP)


@pytest.mark.parametrize(
    ("model", "start"), [(SAFE_OR_FAST, "d"), (model_of(models.UNREACHABLE), "x")]
)
def test_a_goal_out_of_reach(model, start):
    assert optimum(EGUBS(model, start, -0.5, 2.0)) == 0.0
    assert optimum(GUBS(model, start, lambda c: np.exp(-np.asarray(c)), 2.0, -3.0)) == -3.0
    assert optimum(CostBoundedReach(model, start, 3)) == 0.0
    assert optimum(CostBoundedReach(model, start, 3, None)) == 0.0
    for budget in (None, 0.5, 1.0):
        for criterion in (CostQuantile, CVaR):
            with pytest.raises(InfeasibleError) as caught:
                solve(criterion(model, start, 0.5, budget))
            assert caught.value.least_failure == 1.0
    with pytest.raises(InfeasibleError):
        solve(CostBoundedReach(model, start, 3, 0.5))


def test_free_cycles():
    """Trying for nothing in a loop reaches the goal at cost 0; a bound of 0 is a bound."""
    model = model_of(models.FREE_CYCLE)
    for start in ("x", "y"):
        assert optimum(CostBoundedReach(model, start, 0)) == pytest.approx(1.0, **SHARP)
        assert optimum(CostQuantile(model, start, 0.99)) == 0.0
        assert optimum(CostQuantile(model, start, 0.9, 0.3)) == 0.0
        assert optimum(CVaR(model, start, 0.9)) == pytest.approx(0.0, abs=1e-9)
        assert optimum(EGUBS(model, start, -1.0, 0.5)) == pytest.approx(1.5, **SHARP)
    loop = model_of({"x": {"loop": [(1.0, "x", 0)], "out": [(1.0, "g", 5)]}})
    assert optimum(CVaR(loop, "x", 0.5)) == pytest.approx(5.0, **SHARP)
    assert optimum(CostQuantile(loop, "x", 0.5, 0.9)) == 5.0
    assert optimum(CostBoundedReach(loop, "x", 4)) == 0.0
    assert optimum(GUBS(loop, "x", lambda c: -np.minimum(c, 9.0), 0.0, -9.0)) == -5.0


@pytest.mark.parametrize("leak", [1e-6, 1e-9])
def test_free_loops_that_are_slow_to_leave_cost_no_digits(leak):
    """Waiting for free changes no total: half of what leaves the loop arrives."""
    loop = [(leak / 2, "g", 1), (leak / 2, "d", 1), (1.0 - leak, "x", 0)]
    solution = solve(CostBoundedReach(model_of({"x": {"wait": loop}, "d": {}}), "x", 1))
    assert solution.objective == pytest.approx(solution.evaluation.objective, rel=1e-12)
    assert solution.budget_used == pytest.approx(solution.failure_probability, rel=1e-12)


def test_levels_met_exactly():
    """Pr(C <= 1) = 1/2 is enough for the level 1/2."""
    model = model_of(models.TWO_LENGTHS)
    for budget in (None, 0.4):
        for level, cost in ((0.5, 1), (0.51, 2), (0.75, 2), (0.76, 5)):
            assert optimum(CostQuantile(model, "x", level, budget)) == cost
        assert optimum(CVaR(model, "x", 0.5, budget)) == pytest.approx(3.5, **SHARP)
        assert optimum(CVaR(model, "x", 0.75, budget)) == pytest.approx(5.0, **SHARP)
    assert optimum(CostQuantile(model_of(models.retry(0.3)), "x", 0.51)) == 2.0  # 0.7^2 = 0.49
    for level in (1e-12, 1e-17, 1e-300):  # the least cost: there is no cost of 0
        assert optimum(CostQuantile(model, "x", level)) == 1.0


def test_a_plain_policy_is_evaluated_and_a_worse_one_widens_the_gap():
    bounded = CostBoundedReach(SAFE_OR_FAST, "x", 3)
    quantile = CostQuantile(SAFE_OR_FAST, "x", 0.9, 0.5)
    fast, safe = (always(SAFE_OR_FAST, action) for action in ("fast", "safe"))
    for problem, worth in (
        (EGUBS(SAFE_OR_FAST, "x", -0.5, 2.0), 0.75 * (exp(-0.5) + 2.0)),
        (bounded, 0.75),
        (quantile, 1.0),
        (CVaR(SAFE_OR_FAST, "x", 0.9, 0.5), 1.0),
    ):
        assert evaluate(fast.policies[0], problem).objective == pytest.approx(worth, **SHARP)
    timid = certify(replace(solve(bounded), policy=fast))
    assert timid.objective == pytest.approx(0.75)
    assert timid.upper_bound >= 1.0 - 1e-9
    assert timid.gap >= 0.25 - 1e-9
    late = certify(replace(solve(quantile), policy=safe))
    assert late.objective == 3.0
    assert late.gap > 0.5


@pytest.mark.parametrize("failing", [0.5, 0.9, 0.99])
def test_cvar_refutes_thresholds_at_least_failure_without_a_price(failing):
    """All policies fail alike: what failing costs is no part of the risk given success.

    "steady" costs 2, "uncertain" 0 or 3, so that its mean is less and its worst quarter costs 3.
    """
    kept = 1.0 - failing
    uncertain = [(4 / 7 * kept, "g", 3), (3 / 7 * kept, "g", 0), (failing, "d", 0)]
    steady = [(kept, "g", 2), (failing, "d", 0)]
    model = model_of({"x": {"uncertain": uncertain, "steady": steady}, "d": {}})
    assert optimum(CVaR(model, "x", 0.75)) == pytest.approx(2.0, rel=2e-8)
    assert optimum(CVaR(model, "x", 0.75, failing)) == pytest.approx(2.0, rel=2e-8)


LAWS = {
    "split": [(0.45, "g", 0), (0.55, "g", 80)],
    "sixty": [(0.999, "g", 60), (0.001, "g", 81)],
    "fifty": [(0.998, "g", 50), (0.002, "g", 81)],
    "seventy": [(0.99, "g", 70), (0.01, "g", 85)],
}
"""One decision: the mean is least for "split", the mean of the worse half for "fifty"."""
HALF = CVaR(model_of({"x": LAWS}), "x", 0.5)


def test_cvar_bounds_all_thresholds_of_an_interval():
    """One sweep bounds the least integrand at every threshold in it, and is sharp at one."""
    search = _TailMeanSearch(HALF, feasible_set(HALF), 0.5, CERTIFYING)
    least, count = {}, 6  # 0, 50, 60, 80, 81, 85
    for threshold in range(count):
        search.attempt(threshold)
        least[threshold] = search.tried[threshold].lower_bound
    assert search.best is not None
    assert search.best.value == pytest.approx(50.124) == pytest.approx(min(least.values()))
    for first in range(count):
        assert search.bound_between(first, first) == pytest.approx(least[first], rel=1e-8)
        for last in range(first, count):
            inside = min(least[threshold] for threshold in range(first, last + 1))
            assert search.bound_between(first, last) <= inside * (1.0 + 1e-9)


@pytest.mark.parametrize("action", list(LAWS))
def test_the_bound_of_a_cvar_certificate_does_not_depend_on_the_policy(action):
    """A worse policy widens the gap by what it loses, no more."""
    proved = certify(replace(solve(HALF), policy=always(HALF.model, action)))
    assert proved.lower_bound == pytest.approx(50.124)


@pytest.mark.parametrize("price", [inf, -inf, nan])
def test_an_infinite_price_is_refused(price):
    for problem in (
        EGUBS(SAFE_OR_FAST, "x", -0.5, 1.0),
        CostBoundedReach(SAFE_OR_FAST, "x", 1, 0.5),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            proved = certify(replace(solve(problem), failure_price=price))
        assert (proved.accepted, proved.gap, "price" in proved.reason) == (False, inf, True)


def test_numbers_of_any_kind():
    """Fractions and numpy's numbers are numbers, and answers are floats."""
    model = model_of({"x": {"go": [(0.5, "g", 1), (0.5, "g", 3)]}})
    for number in (Fraction(1, 2), np.float32(0.5), np.float64(0.5)):
        for problem, value in (
            (EGUBS(model, "x", -number, number), (exp(-0.5) + exp(-1.5)) / 2 + 0.5),
            (GUBS(model, "x", falling, number, -number), (exp(-1) + exp(-3)) / 2 + 0.5),
            (CVaR(model, "x", number), 3.0),
            (CostQuantile(model, "x", number), 1.0),
            (CostBoundedReach(model, "x", 2 * number, number), 0.5),
        ):
            found = optimum(problem)
            assert type(found) is float
            assert found == pytest.approx(value, rel=2e-8)
    found = compare_criteria(model, "x", cost_bounds=(Fraction(5, 2),))
    assert found["CostBoundedReach, cost 2.5"].solution.objective == pytest.approx(0.5)


@pytest.mark.parametrize("chance", [1e-9, 1e-11, 1e-14])
def test_a_budget_of_one_limits_nothing_however_unlikely_the_goal_is(chance):
    """The fast way succeeds half as often, which a budget of 1 allows."""
    ways = {"slow": (chance, 9), "fast": (chance / 2, 1)}
    model = model_of(
        {"x": {w: [(p, "g", c), (1 - p, "d", 0)] for w, (p, c) in ways.items()}, "d": {}}
    )
    assert optimum(CostQuantile(model, "x", 0.5, 1.0)) == 1.0
    assert optimum(CVaR(model, "x", 0.5, 1.0)) == pytest.approx(1.0, rel=2e-8)
    assert optimum(CostQuantile(model, "x", 0.5)) == 9.0


@pytest.mark.parametrize("slow", [10, 100_000])
def test_a_budget_just_above_the_least_failure_is_another_problem(slow):
    """A trifle of failure buys a trifle of cost; only rounding counts as equal."""
    ways = {"slow": [(1.0, "g", slow)], "fast": [(0.999, "g", 0), (0.001, "d", 0)]}
    model, budget = model_of({"x": ways, "d": {}}), 5e-11
    solution = solve(CVaR(model, "x", 0.0, budget))
    assert solution.objective == pytest.approx(slow * (1.0 - budget / 1e-3), rel=1e-10)
    assert solution.gap <= 1e-8
    assert not solution.note
    assert "above the least failure" in solve(CVaR(model, "x", 0.0, 1e-15)).note
    assert not solve(CVaR(model, "x", 0.0, 0.0)).note


WRONG = {
    EGUBS: [(0.0, 1.0), (0.5, 1.0), (nan, 1.0)],
    GUBS: [(lambda c: 1.0 - falling(c), 1.0), (falling, 1.0, 2.0), (falling, nan)],
    CostBoundedReach: [(-1.0,), (nan,), (3, 1.5), (3, -0.1)],
    CostQuantile: [(-0.1,), (1.1,), (nan,), (0.5, 1.5)],
    CVaR: [(-0.1,), (1.0,), (nan,), (inf,), (0.5, -0.1)],
}
RIGHT = {EGUBS: (-0.5, 1.0), GUBS: (falling, 1.0), CostBoundedReach: (3,)}
NO_NUMBERS = {
    EGUBS: [("low", 1.0), (-1.0, None)],
    GUBS: [(falling, "much"), (1.0, falling), (falling, 1.0, "none")],
    CostBoundedReach: [("3",), (None,), (1j,), (np.array([1.0, 2.0]),)],
    CostQuantile: [("0.5",), (None,)],
    CVaR: [("0.5",), (Decimal("0.5"),)],
}


@pytest.mark.parametrize("criterion", WRONG)
def test_wrong_arguments(criterion):
    for asked in WRONG[criterion]:
        with pytest.raises(ModelError):
            solve(criterion(SAFE_OR_FAST, "x", *asked))
    for start in ("nowhere", {"x": 0.7}):
        with pytest.raises(ModelError, match=r"of the model|start"):
            criterion(SAFE_OR_FAST, start, *RIGHT.get(criterion, (0.5,)))
    for asked in NO_NUMBERS[criterion]:
        with pytest.raises(ModelError, match="must be a number"):
            criterion(SAFE_OR_FAST, "x", *asked)


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


@pytest.mark.slow
@often(26)
@given(problems(), st.sampled_from([-0.5, -0.1, -2.0]), bonuses)
def test_exponential_utility(drawn, rate, bonus):
    """EGUBS up to a cost at which exp(rate * cost) has vanished."""
    value = s3p_program.exponential_utility(plain(drawn), drawn.start, rate, bonus)
    check(EGUBS(library_model(drawn), drawn.start, rate, bonus), value)


@pytest.mark.slow
@often(20)
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


@pytest.mark.slow
@pytest.mark.parametrize("criterion", [CostBoundedReach, CostQuantile, CVaR])
@often(40)
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


@pytest.mark.slow
@often(13)
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


@pytest.mark.parametrize("rate", [1.0 / 300.0, 0.5])
def test_layers_of_a_utility_begin_at_a_typical_cost_or_where_it_has_vanished(rate):
    """One way of 300 steps: its total is the first cap's measure, unless nothing is left there."""
    steps = {k: {"on": [(1.0, k + 1 if k < 299 else "g", 1.0)]} for k in range(300)}
    solution = solve(GUBS(model_of(steps), 0, lambda c: np.exp(-rate * c), 0.5))
    assert solution.objective == pytest.approx(np.exp(-300.0 * rate) + 0.5, **SHARP)
    assert solution.gap <= 1e-9
    layers = int(solution.run.reason.split()[3])
    assert layers >= 300 if rate < 0.1 else layers < 300
    assert solution.run.pricing_calls == 1
