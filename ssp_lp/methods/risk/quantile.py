"""The least quantile of the total cost given success, by Newton's method on its bound.

With a charge of 1 for every arrival beyond B the least E[charge | goal] is the least Pr(C > B |
goal), which falls as B grows. The least B at which it keeps to 1 - level is the answer; its policy
is the one that keeps to B most often. At given prices of failure and of the other rows a lower
bound of that share is known for every B, where failure alone is limited by one sweep; so the
greatest B that is refuted at those prices is, and at the best prices it is the answer's neighbour.
The search alternates: the best prices at a B, and the first B that they do not refute.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import replace

from ssp_lp.analysis.total_cost.cost_law import success_costs
from ssp_lp.arrays import QUANTILE
from ssp_lp.compiled.deadline import STOPS, Stop, heed, is_late
from ssp_lp.methods.assembling import Found, assembled
from ssp_lp.methods.risk.question import Near, Question, Trial, question_remarks
from ssp_lp.options import SolveOptions
from ssp_lp.problem import Problem
from ssp_lp.processes.layered.charges import LateCharge
from ssp_lp.solution import Run, Solution

_ROUGH = 1e-2  # how exactly a share is worked out that need only lie on one side of another
_NEWTON = 6  # steps, after which the bounds in question are halved, or doubled while none is kept
_ABOVE = 1e-9  # relative: by which a price of failure lies above a share, where both are equal


def least_quantile(
    problem: Problem,
    question: Question,
    level: float,
    options: SolveOptions,
    near: Near | None = None,
) -> Solution:
    """Search for the least bound that some policy keeps to.

    Args:
        problem: the problem.
        question: the policies that count.
        level: in (0, 1).
        options: method, tolerance and limits.
        near: where the quantile may be; None: unknown.

    Raises:
        ModelError: the quantile lies beyond the largest table of costs.
        Stop: the time ended before some policy kept to a bound.
    """
    places, kept, calls, kappa = question.thresholds, None, 0, 0.0 if near is None else near.kappa
    low, refuted, high, tried = -1, -1, 0, 0  # too low, proved so; kept to; and bounds tried
    number = places.number(question.typical if near is None else near.total)
    rough = replace(options, tolerance=max(options.tolerance, _ROUGH))
    try:
        while kept is None or (high - low > 1 and not is_late()):
            trial = question.attempt(LateCharge(places.total(number)), rough, kappa)
            calls, kappa, tried = calls + trial.calls, trial.kappa, tried + 1
            if trial.lower_bound <= _late_share(level) < trial.value and not is_late():
                trial = question.attempt(LateCharge(places.total(number)), options, kappa)
                calls, kappa = calls + trial.calls, trial.kappa
            if trial.value <= _late_share(level):
                kept, high = trial, number
            else:
                low = number
            if kept is None and is_late():
                break
            last = high if kept else 2 * number + 1
            refuted = max(refuted, _last_refuted(question, trial, level, refuted, last))
            low, number = max(low, refuted), max(low, refuted) + 1
            if tried > _NEWTON:
                number = (low + high) // 2 if kept is not None else last
        if kept is not None and not is_late():  # of all that keep to the bound: most often
            best = question.attempt(LateCharge(places.total(high)), options, kappa)
            calls, kept = calls + best.calls, min(kept, best, key=lambda trial: trial.value)
    except STOPS as stop:
        heed(stop)
    if kept is None:
        below = _beyond_refuted(question, refuted)
        raise Stop(told=f"no policy's quantile lies below {below:g}")
    law = success_costs(kept.policy, problem)
    objective = law.quantile(level)
    found = Found(
        policy=kept.policy,
        value=objective,
        bound=min(_beyond_refuted(question, refuted), objective),
        failure=1.0 - law.goal,
        note=question_remarks(question, in_time=high - low <= 1),
    )
    reason = f"{tried} cost bounds, {calls} pricing calls"
    return assembled(problem, found, Run(options.method, reason, calls, 0.0))


def quantile_bound(
    question: Question, level: float, quantile: float, options: SolveOptions
) -> float:
    """Prove afresh that no policy has a lower quantile than this one, or than one below it.

    Args:
        question: the policies that count.
        level: in (0, 1).
        quantile: what no policy undercuts.
        options: tolerance and limits.
    """
    number = question.thresholds.number(quantile)
    if number == 0:
        return 0.0
    trial = question.attempt(LateCharge(question.thresholds.total(number - 1)), options)
    return _beyond_refuted(question, _last_refuted(question, trial, level, -1, number))


def _last_refuted(question: Question, trial: Trial, level: float, first: int, last: int) -> int:
    """The greatest number of a bound that no policy keeps to, as is proved at a trial's prices.

    Args:
        question: the policies that count.
        trial: of some bound.
        level: in (0, 1).
        first: a number that is too low.
        last: a number that is looked for below.
    """
    share = _late_share(level)
    slack = trial.kappa <= trial.value * (1.0 + _ABOVE)  # of the budget
    kappa = share * (1.0 + _ABOVE) if slack else max(trial.kappa, share)
    shares = question.late_shares(last, kappa, trial.prices, slack=slack)
    numbers = range(first + 1, last)
    return first + bisect_left(numbers, True, key=lambda number: shares(number) <= share)


def _beyond_refuted(question: Question, refuted: int) -> float:
    """The least total that can occur beyond one that is refuted; -1: none is."""
    places = question.thresholds
    if places.sharp:
        return places.total(refuted + 1)
    return places.total(refuted) if refuted >= 0 else 0.0


def _late_share(level: float) -> float:
    """The share of the successes that may lie beyond the quantile, with the slack of its law.

    Below 1, however low the level: some success must be in time, beyond what may be rounding.
    """
    return 1.0 - max(level, QUANTILE) * (1.0 - QUANTILE)
