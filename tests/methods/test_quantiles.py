"""Quantiles: one sweep answers all bounds, and the search ends at the first that is kept."""

import math

import numpy as np
import pytest

from examples.solver_comparison.instances.families import corridor, layered
from formulations import EGUBS, CostBoundedReach, CostQuantile, CVaR
from small_models import model_of
from ssp_lp import certify, evaluate, solve, success_costs
from ssp_lp.accumulated_cost.charges import LateCharge
from ssp_lp.methods import risk
from ssp_lp.methods.risk import _Guess, feasible_set
from ssp_lp.options import SolveOptions
from written_models import written

FREE_STEPS = written(
    """
    a in: 0.5 b 0, 0.5 G 1
    a by: 0.9 G 2, 0.1 D 0
    b in: 0.7 c 1, 0.3 D 1
    b up: a 2
    c in: 0.8 G 0, 0.2 b 0
    c up: a 0
    """,
    "G",
)


@pytest.mark.parametrize("on", [False, True], ids=["numpy", "compiled"])
@pytest.mark.parametrize("budget", [None, 0.2])
@pytest.mark.parametrize(
    ("model", "start"),
    [
        (layered(5, 4, seed=2), 0),
        (layered(5, 4, seed=2), {0: 0.7, 20: 0.2, 1: 0.1}),  # 20 is the goal
        (corridor(12), 0),
        (FREE_STEPS, "a"),
    ],
)
def test_what_is_best_depends_on_what_is_left(model, start, budget, on, accelerate):
    """The bounds of one sweep at the greatest bound are those of a sweep at each."""
    accelerate(on)
    question = feasible_set(CostQuantile(model, start, 0.5, budget))
    for guess in (_Guess(0.3, {}), _Guess(0.6, {}, slack=True), _Guess(5.0, {})):
        shares = question.exceedance_bounds(30, guess)
        for number in range(0, 31, 3):
            charge = LateCharge(question.thresholds.total(number))
            alone = question.charge_bound(charge, guess)
            assert shares(number) == pytest.approx(alone, rel=1e-12, abs=1e-13)


@pytest.mark.parametrize("level", [0.05, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("budget", [None, 0.011, 0.1, 1.0])
def test_no_lesser_bound_is_kept_by_any_policy(level, budget):
    """Bounded reach without a budget is known by itself: what fails more is no success."""
    model = corridor(9)
    solution = solve(CostQuantile(model, 0, level, budget))
    law, quantile = success_costs(solution.policy, solution.problem), int(solution.objective)
    assert law.quantile(level) == quantile
    assert solution.gap == 0.0
    certificate = certify(solution)
    assert certificate.accepted
    assert certificate.gap == 0.0
    if budget is None:  # all policies of least failure reach the goal alike
        for bound, kept in ((quantile, True), (quantile - 1, False)):
            within = solve(CostBoundedReach(model, 0, bound, failure_budget=None)).objective
            assert (within >= level * law.goal * (1.0 - 1e-12)) == kept


@pytest.mark.slow
def test_a_corridor_of_many_layers_takes_few_bounds():
    """A walk of a thousand steps: every trial's prices refute nearly all that is too low."""
    problem = CostQuantile(corridor(30), 0, 0.9, 0.01)
    solution = solve(problem)
    assert solution.gap == 0.0
    assert int(solution.run.reason.split()[0]) <= 6
    assert evaluate(solution.policy, problem).objective == solution.objective > 1_000


def test_layers_settled_together_or_one_by_one_are_the_same_law(accelerate):
    """The compiled loop and its twin follow the same masses; costs leave layers out."""
    model = written(
        """
        a go: 0.2 b 3, 0.5 a 7, 0.3 G 5
        b go: 0.6 a 1, 0.2 G 11, 0.1 G 0, 0.1 D 1
        """,
        "G",
    )
    problem, atoms = CostQuantile(model, "a", 0.5), []
    policy = solve(problem).policy
    for on in (False, True):
        accelerate(on)
        atoms.append(success_costs(policy, problem).upto(200.0))
    np.testing.assert_array_equal(atoms[0].costs, atoms[1].costs)
    np.testing.assert_allclose(*(each.probabilities for each in atoms), rtol=1e-14)


def test_masses_too_small_for_a_number_end_in_nothing(accelerate):
    """Steps of 1e-200 twice over: no list of places is met again."""
    accelerate(True)
    model = written("a go: 1e-200 b 1, 0.5 a 1, 0.5 G 1\n b go: 1e-200 a 1, 1e-200 b 1, 1 G 1", "G")
    problem = CostQuantile(model, "a", 0.9)
    assert success_costs(solve(problem).policy, problem).quantile(0.9) == 4.0


def test_bounds_that_no_price_refutes_are_doubled(monkeypatch):
    """While no policy keeps to a bound the search does not creep from one to the next."""
    asked = CostQuantile(corridor(20), 0, 0.9999, 0.5)
    least = solve(asked).objective
    monkeypatch.setattr(risk, "_last_excluded", lambda *given: -1)
    found = risk.least_quantile(asked, feasible_set(asked), SolveOptions(), (1.0, 0.0))
    assert found.objective == least > 64
    assert int(found.run.reason.split()[0]) <= 7 + 2 * int(np.ceil(np.log2(least)))


RARE = 9e-7
SELDOM_LEFT = written(
    f"""
    a wait: {1.0 - RARE} a 5.0387, {RARE} G 5.0387
    a go: {1.0 - 8e-6} G 3.0326, 8e-6 D 0.9154
    b on: 0.9 G 4.8632, 0.1 b 4.8632
    b by: 0.7 D 8.2917, 0.1 G 8.2917, 0.2 b 8.2917
    b back: 0.9 G 6.6159, 0.05 D 6.6159, 0.05 a 6.6159
    """,
    "G",
)
"""Few sums lie below some steps, far too many below the cost of the only sure way."""


@pytest.mark.parametrize("level", [0.5, 0.75])
def test_totals_without_room_leave_an_answer(level):
    """Waiting is the only sure way: its cost is geometric."""
    rounds = np.ceil(np.log1p(-level) / np.log1p(-RARE))
    for problem in (
        CostQuantile(SELDOM_LEFT, "a", level, 0.0),
        CostQuantile(SELDOM_LEFT, "a", level, None),
        CVaR(SELDOM_LEFT, "a", level, None),
    ):
        solution = solve(problem)
        certificate = certify(solution)
        assert certificate.accepted
        for bound in (solution.lower_bound, certificate.lower_bound):
            assert 3.0326 * (1.0 - 1e-9) <= bound <= solution.objective
        if isinstance(problem, CostQuantile):
            assert solution.objective == pytest.approx(5.0387 * rounds, rel=1e-5)
        else:
            assert solution.objective >= 5.0387 * rounds


@pytest.mark.slow
def test_tables_cut_for_want_of_room_are_certified():
    for problem in (
        EGUBS(SELDOM_LEFT, "a", -1e-6, 1.0),
        CostBoundedReach(SELDOM_LEFT, "a", 5e6, 0.0),
    ):
        certificate = certify(solve(problem))
        assert certificate.accepted
        assert certificate.objective <= certificate.upper_bound


@pytest.mark.parametrize("shares", [(0.5, 0.3), (0.2, 0.6)])
def test_quantiles_and_tail_means_of_irrational_totals(shares):
    """Nothing, or the root of 2 or 5; or surely that of 2. A lottery of the two is no better."""
    chances, totals = [*shares, 0.9 - sum(shares)], [math.sqrt(k) for k in (0, 2, 5)]
    outcomes = [(p, "G", c) for p, c in zip(chances, totals, strict=True)]
    sure = [(0.9, "G", totals[1]), (0.1, "pit", 1.0)]
    model = model_of({"a": {"go": [*outcomes, (0.1, "pit", 1.0)], "sure": sure}}, "G")
    upto = np.cumsum(chances) / 0.9
    for level in (0.01, 0.1, 0.4, 0.8, 0.97):
        at = int(np.searchsorted(upto, level + 1e-9))
        quantile = solve(CostQuantile(model, "a", level, 1.0))
        assert quantile.objective == pytest.approx(min(totals[at], totals[1]), rel=1e-12)
        late = sum(p * c for p, c in zip(chances[at + 1 :], totals[at + 1 :], strict=True)) / 0.9
        mean = ((upto[at] - level) * totals[at] + late) / (1.0 - level)
        tail_mean = solve(CVaR(model, "a", level, 1.0))
        assert tail_mean.objective == pytest.approx(min(mean, totals[1]), rel=1e-9)


@pytest.mark.parametrize("level", [0.5, 0.9])
def test_the_least_tail_mean_is_proved_on_every_threshold(level):
    """The halves of an interval of thresholds are told apart where it does not begin at 0, too."""
    solution = solve(CVaR(layered(5, 4, seed=2), 0, level, 0.2), time_limit=10.0)
    assert solution.gap <= 1e-9


@pytest.mark.parametrize("slower", [False, True], ids=["one policy", "two policies"])
def test_thresholds_are_refuted_where_the_goal_cannot_be_avoided(slower):
    """Trying until it works: the tail beyond the k-th try costs k tries and then the mean."""
    again, tries = 0.99, 10
    actions = {"try": [(again, "x", 1.0), (1.0 - again, "g", 1.0)]}
    if slower:
        actions["later"] = [(0.995, "x", 1.0), (0.005, "g", 1.0)]
    problem = CVaR(model_of({"x": actions}), "x", 1.0 - again**tries, 1.0)
    solution = solve(problem)
    assert solution.objective == pytest.approx(tries + 1.0 / (1.0 - again), rel=1e-9)
    assert solution.gap <= 1e-9
    assert int(solution.run.reason.split()[0]) <= 4  # thresholds; each other one takes no search
    assert certify(solution).gap <= 1e-9
