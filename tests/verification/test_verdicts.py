"""Verdicts on policies, by hand: when a certificate accepts, what it states, and its reasons."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ssp_lp.verification.certify as certificates
from formulations import MCMP, S3P, CostBoundedReach, CVaR, MaxProb
from refusing import refused
from small_models import FIRST, model_of
from ssp_lp import (
    DeterministicPolicy,
    MixedPolicy,
    ModelError,
    OutOfTimeError,
    Status,
    certify,
    evaluate,
    secondary_cost,
    solve,
)
from ssp_lp.methods.incumbent import cheapest_way_bound
from ssp_lp.verification.certify import certificate_of

PAID = evaluate(solve(MCMP(FIRST, "depot", 0.05)).policy, MCMP(FIRST, "depot", 0.05))


def paid(objective, failure=0.25):
    """An evaluation of this objective, and of this failure."""
    return replace(PAID, objective=objective, goal_probability=1.0 - failure,
                   failure_probability=failure, discounted_failure=None)  # fmt: skip


@pytest.mark.parametrize(("beyond", "accepted"), [(5e-13, True), (-0.25, True), (5e-12, False)])
def test_failing_is_compared_with_the_budget(beyond, accepted):
    told = certificate_of(paid(8.0, 0.25 + beyond), 7.0, 0.25)
    assert told.accepted is accepted
    assert told.reason == "" if accepted else "above the budget 0.25" in told.reason
    assert told.budget_slack == pytest.approx(-beyond, abs=1e-15)
    assert (told.failure, told.budget, told.objective) == (0.25 + beyond, 0.25, 8.0)


@pytest.mark.parametrize("size", [8.0, -8.0, 1e6])
def test_a_bound_may_pass_the_value_by_rounding_alone(size):
    """By 1e-9 of the value, and 1e-12; a lower bound upwards, an upper bound downwards."""
    for above, side in ((False, "below"), (True, "above")):
        sign = -1.0 if above else 1.0
        near, far = (size + sign * part * abs(size) for part in (0.9e-9, 1.2e-9))
        kept = certificate_of(paid(size), near, 0.5, above=above)
        assert (kept.accepted, kept.gap) == (True, 0.0)
        assert kept.lower_bound == size if not above else kept.upper_bound == size
        wrong = certificate_of(paid(size), far, 0.5, above=above)
        assert f"lies {side} its bound" in wrong.reason
        assert (wrong.accepted, wrong.gap) == (False, np.inf)
        assert wrong.lower_bound == far
    assert certificate_of(paid(0.0), 0.9e-12, 0.5).accepted
    assert not certificate_of(paid(0.0), 1.1e-12, 0.5).accepted


def test_both_sides_of_a_gap():
    """(8 - 6) / 8 of a cost, (0.8 - 0.6) / 0.8 of a probability; a sign changes no distance."""
    cost = certificate_of(paid(8.0), 6.0, 0.5, tail=0.125)
    assert (cost.lower_bound, cost.upper_bound, cost.gap, cost.tail_gap) == (6.0, None, 0.25, 0.125)
    assert certificate_of(paid(-6.0), -8.0, 0.5).gap == pytest.approx(1 / 3)
    assert certificate_of(paid(8.0), 6.0, 0.5).tail_gap == 0.0
    goal = certificate_of(paid(0.6), 0.8, 0.5, above=True)
    assert (goal.lower_bound, goal.upper_bound) == (0.6, 0.8)
    assert goal.gap == pytest.approx(0.25)
    risky = certificate_of(paid(0.6, 0.75), 0.8, 0.5, above=True)
    assert (risky.accepted, risky.lower_bound, risky.upper_bound) == (False, 0.6, 0.8)


def test_a_least_failure_that_is_not_proved_widens_the_gap():
    """The goal is reached with 0.75, and nobody reaches it with more than 0.9: 1 / 6 of 0.9."""
    told = replace(certificate_of(paid(8.0), 8.0, 0.25), least_failure_bound=0.1)
    assert told.gap == pytest.approx(1 / 6)
    assert "between 0.1 and 0.25" in told.summary()
    assert replace(told, lower_bound=6.0).gap == 0.25
    upper = replace(told, upper_bound=8.0)
    assert upper.gap == pytest.approx(1 / 6)
    assert replace(upper, upper_bound=16.0).gap == 0.5
    assert replace(told, least_failure_bound=0.25).gap == 0.0


@pytest.mark.parametrize(
    ("objective", "failure", "words"),
    [
        (np.nan, 1.0, "the goal is never reached"),
        (np.nan, 0.25, "the policy's objective is nan"),
        (np.inf, 0.25, "the policy's objective is inf"),
        (np.inf, 0.75, "above the budget 0.5"),
        (0.0, 1.0, "above the budget 0.5"),
    ],
)
def test_why_a_policy_is_refused(objective, failure, words):
    told = certificate_of(paid(objective, failure), 7.0, 0.5)
    assert not told.accepted
    assert words in told.reason
    assert told.lower_bound == 7.0
    assert certificate_of(paid(objective, failure), 7.0, 0.5, "known before").reason == (
        "known before"
    )


def test_what_a_certificate_shows():
    """The side of its bound, and why it refuses; a least failure that is proved is not shown."""
    cost = certificate_of(paid(8.0), 6.0, 0.5)
    shown = cost.summary()
    for words in ("accepted", "lower bound", "0.25 of 0.5", "8", "6"):
        assert words in shown
    assert "upper bound" not in shown
    assert "least failure" not in shown
    assert "upper bound" in certificate_of(paid(0.6), 0.8, 0.5, above=True).summary()
    assert "refused: so it is" in certificate_of(paid(8.0), 6.0, 0.5, "so it is").summary()


# What certify does where the time or the room for a table is not enough.


LAWS = [CVaR(FIRST, "depot", 0.9, 0.05), CostBoundedReach(FIRST, "depot", 8.0, 0.05)]
OTHERS = [MCMP(FIRST, "depot", 0.05), CVaR(FIRST, "depot", 0.9)]
"""A cost, and a tail mean of least failure: the cheapest way bounds neither."""


def failing(error):
    """A function that ends in an error."""

    def fail(*given, **named):
        raise error

    return fail


@pytest.mark.parametrize("problem", [*LAWS, *OTHERS])
@pytest.mark.parametrize("error", [OutOfTimeError("late"), ModelError("too large a table")])
def test_a_proof_that_does_not_come_is_that_of_the_cheapest_way(problem, error, monkeypatch):
    """Of a law of total costs; other criteria end in the error, as do proofs by its values."""
    solution = solve(problem)
    late = isinstance(error, OutOfTimeError)
    case = certificates.Case.of_solution(solution)
    approach = certificates.approach_to(case)
    with monkeypatch.context() as broken:
        if late:
            broken.setattr(certificates, "_proved", failing(error))
        else:
            broken.setattr(
                certificates, "approach_to", lambda case: replace(approach, prove=failing(error))
            )
        if not (case.has_cheapest_way and (late or approach.afresh)):
            refused(str(error), certify, solution, error=type(error))
            return
        told = certify(solution)
    assert told.accepted
    cheapest = cheapest_way_bound(problem)
    assert (told.lower_bound if told.upper_bound is None else told.upper_bound) == cheapest
    assert told.least_failure_bound is None
    assert certify(solution).gap <= told.gap


def test_a_table_that_is_too_large_for_other_criteria_is_an_error(monkeypatch):
    solution = solve(MCMP(FIRST, "depot", 0.05))
    monkeypatch.setattr(certificates, "evaluate_each", failing(ModelError("too large a table")))
    refused("too large a table", certify, solution)


@pytest.mark.parametrize("problem", LAWS)
def test_the_better_of_two_bounds_is_stated(problem, monkeypatch):
    """A wide proof gives way to the cheapest way, a narrow or a refused one does not."""
    solution = solve(problem)
    case = certificates.Case.of_solution(solution)
    approach, cheapest = certificates.approach_to(case), cheapest_way_bound(problem)
    above = certify(solution).upper_bound is not None
    honest = approach.prove(solution, solution.evaluation, 0.0)
    for far, reason, known in (
        (1e3, "", cheapest), (1e3, "forged", None), (1e-12, "", None),
    ):  # fmt: skip
        bound = honest.attained + (far if above else -far)
        wide = replace(honest, bound=bound, reason=reason)
        with monkeypatch.context() as broken:
            stated = replace(approach, prove=lambda *_, wide=wide: wide)
            broken.setattr(certificates, "approach_to", lambda case, stated=stated: stated)
            told = certify(solution)
        assert told.reason == reason
        if not reason:
            side = told.upper_bound if above else told.lower_bound
            assert side == pytest.approx(bound if known is None else known, rel=1e-12)


def test_an_answer_without_a_search_is_bounded_by_the_cheapest_way(monkeypatch):
    """A search that was cut short before it had values: its proof is not tried, but afresh."""
    problem = S3P(FIRST, "depot", 0.05)
    solution = replace(solve(problem), value_function=None, status=Status.TIME_LIMIT)
    told = certify(solution)
    assert told.accepted
    assert told.lower_bound == cheapest_way_bound(problem)
    refused(None, certify, replace(solution, status=Status.OPTIMAL))
    refused(None, certify, replace(solve(OTHERS[0]), value_function=None, status=Status.TIME_LIMIT))
    afresh = solve(LAWS[0])
    cut_short = certify(replace(afresh, value_function=None, status=Status.TIME_LIMIT))
    assert cut_short.lower_bound == certify(afresh).lower_bound > cheapest_way_bound(LAWS[0])


def test_the_cheapest_way_bounds_no_cost_until_failure():
    """Failing for nothing with 1/2 costs 5 in the mean, less than any way to the goal, 10."""
    risky, safe = [(0.5, "g", 10.0), (0.5, "d", 0.0)], [(1.0, "g", 10.0)]
    model = model_of({"x": {"risky": risky, "safe": safe}, "d": {}})
    solution = solve(MCMP(model, "x", 0.5, give_up="dead_ends", charge_failing_step=False))
    assert solution.objective == pytest.approx(5.0)
    safe = DeterministicPolicy.from_actions(model, {"x": "safe"})
    told = certify(replace(solution, policy=MixedPolicy((safe,), np.ones(1))))
    assert (told.objective, told.lower_bound) == pytest.approx((10.0, 5.0))
    assert told.gap == pytest.approx(0.5)


def test_the_least_failure_is_bounded_too():
    """0.01 by the road; a budget asks for no such bound."""
    least, limited = (certify(solve(MCMP(FIRST, "depot", budget))) for budget in (None, 0.05))
    assert least.least_failure_bound == pytest.approx(0.01)
    assert least.least_failure_bound <= 0.01 + 1e-15
    assert limited.least_failure_bound is None
    assert "least failure" not in least.summary()
    tail = certify(solve(CVaR(FIRST, "depot", 0.9)))
    assert tail.least_failure_bound == pytest.approx(0.01)


def test_a_limit_that_is_broken_is_named():
    """The safe road takes 5 litres, of which 3 are there; failing is compared before limits."""
    fuel = {"depot": {"alley": 1.0, "road": 5.0}}
    problem = MCMP(FIRST, "depot", 0.5, constraints={"fuel": secondary_cost(fuel) <= 3.0})
    solution = solve(problem)
    assert certify(solution).accepted
    road = DeterministicPolicy.from_actions(FIRST, {"depot": "road"})
    told = certify(replace(solution, policy=MixedPolicy((road,), np.ones(1))))
    assert not told.accepted
    assert "fuel" in told.reason


def test_a_time_limit_is_one_of_the_whole_call(monkeypatch):
    """What the evaluation has taken is no longer left for the proof."""
    solution, left = solve(MCMP(FIRST, "depot", 0.05)), []
    clock, limited = iter([100.0, 107.0]), certificates.limited
    monkeypatch.setattr(certificates, "perf_counter", lambda: next(clock))
    monkeypatch.setattr(
        certificates, "limited", lambda t, doing: left.append(t) or limited(None, doing)
    )
    assert certify(solution, time_limit=10.0).accepted
    assert left == [10.0, 3.0]
    clock, left[:] = iter([100.0, 111.0]), []
    certify(solution, time_limit=10.0)
    assert left == [10.0, 0.0]


def test_a_probability_is_bounded_from_above_and_a_cost_from_below():
    least = certify(solve(MCMP(FIRST, "depot", 0.05)))
    most = certify(solve(MaxProb(FIRST, "depot")))
    assert (least.upper_bound, most.upper_bound) == (None, pytest.approx(0.99))
    assert most.lower_bound == pytest.approx(0.99)
    assert least.lower_bound == pytest.approx(20 / 3)
