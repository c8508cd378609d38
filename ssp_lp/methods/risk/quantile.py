"""The least quantile of the total cost given success, by bisection.

With a charge of 1 for every arrival beyond B the least E[charge | goal] is the least Pr(C > B |
goal), which falls as B grows. The least B at which it keeps to 1 - level is the answer; its policy
is the one that keeps to B most often.
"""

from __future__ import annotations

from ssp_lp.analysis.total_cost.cost_law import success_costs
from ssp_lp.arrays import QUANTILE
from ssp_lp.compiled.deadline import STOPS, Stop, heed, is_late
from ssp_lp.methods.assembling import Found, assembled
from ssp_lp.methods.risk.question import Near, Question, Trial, question_remarks
from ssp_lp.options import SolveOptions
from ssp_lp.problem import Problem
from ssp_lp.processes.layered.charges import LateCharge
from ssp_lp.solution import Run, Solution


def least_quantile(
    problem: Problem,
    question: Question,
    level: float,
    options: SolveOptions,
    near: Near | None = None,
) -> Solution:
    """Gallop up to a bound that some policy keeps, then bisect.

    Where totals are rounded a trial may neither keep to its bound nor refute it; then the greatest
    bound that is refuted is sought as well.

    Args:
        problem: the problem.
        question: the policies that count.
        level: in (0, 1).
        options: method, tolerance and limits.
        near: where the quantile may be; None: unknown.

    Raises:
        ModelError: the quantile lies beyond the largest table of costs.
    """
    kept, (low, refuted, high), calls = _searched_quantile(question, level, options, near)
    if not question.thresholds.sharp:
        refuted, more = _greatest_refuted_quantile(question, level, options, refuted, low)
        calls += more
    law = success_costs(kept.policy, problem)
    objective = law.quantile(level)
    found = Found(
        policy=kept.policy,
        value=objective,
        bound=min(_beyond_quantile(question, refuted), objective),
        failure=1.0 - law.goal,
        note=question_remarks(question, in_time=high - low <= 1),
    )
    reason = f"bisection over cost bounds, {calls} pricing calls"
    return assembled(problem, found, Run(options.method, reason, calls, 0.0))


def _searched_quantile(
    question: Question, level: float, options: SolveOptions, near: Near | None
) -> tuple[Trial, tuple[int, int, int], int]:
    """A quantile's trial that keeps to its bound, and the calls that it took.

    With it the numbers of bounds: the greatest that is too low, that is proved so, and the kept.
    """
    places = question.thresholds
    low, refuted, high, calls, late = -1, -1, 0, 0, False
    kept: Trial | None = None
    kappa, step = (0.0, 0) if near is None else (near.kappa, 1)
    high = 0 if near is None else places.number(near.total)
    while kept is None or (high - low > 1 and not late):
        middle = high if kept is None else (low + high) // 2
        if kept is not None and low < 0 < step:  # from what is near, in longer steps
            middle, step = max(middle, high - step), 2 * step
        try:
            trial = question.attempt(LateCharge(places.total(middle)), options, kappa)
        except STOPS as stop:
            heed(stop)
            if kept is None:
                raise Stop(told=_known_of_quantile(question, refuted)) from stop
            break
        calls, kappa = calls + trial.calls, trial.kappa if near is not None else 0.0
        if trial.value <= _allowed_beyond_quantile(level):
            kept, high = trial, middle
        else:
            low, refuted = middle, middle if _is_refuted_quantile(trial, level) else refuted
            high = 2 * middle + 1 if kept is None else high
        late = is_late()
        if late and kept is None:
            raise Stop(told=_known_of_quantile(question, refuted))
    return kept, (low, refuted, high), calls


def _greatest_refuted_quantile(
    question: Question, level: float, options: SolveOptions, refuted: int, low: int
) -> tuple[int, int]:
    """The greatest number up to ``low`` that a proof refutes, as far as time allows; the calls."""
    calls = 0
    while low - refuted > 1 and not is_late():
        middle = (low + refuted) // 2
        try:
            trial = question.attempt(LateCharge(question.thresholds.total(middle)), options)
        except STOPS as stop:
            heed(stop)
            break
        calls, is_low = calls + trial.calls, _is_refuted_quantile(trial, level)
        low, refuted = (low, middle) if is_low else (middle, refuted)
    return refuted, calls


def _known_of_quantile(question: Question, refuted: int) -> str:
    """What is known while no bound was found that some policy keeps to."""
    return f"no policy's quantile lies below {_beyond_quantile(question, refuted):g}"


def quantile_bound(
    question: Question, level: float, quantile: float, options: SolveOptions
) -> float:
    """Prove afresh that no policy has a lower quantile than this one; 0 if that fails.

    Args:
        question: the policies that count.
        level: in (0, 1).
        quantile: what no policy undercuts.
        options: tolerance and limits.
    """
    below = question.thresholds.number(quantile) - 1
    if below < 0 or not _is_refuted_quantile(
        question.attempt(LateCharge(question.thresholds.total(below)), options), level
    ):
        return 0.0
    return _beyond_quantile(question, below)


def _beyond_quantile(question: Question, refuted: int) -> float:
    """The least total that can occur beyond one that is refuted; -1: none is."""
    places = question.thresholds
    if places.sharp:
        return places.total(refuted + 1)
    return places.total(refuted) if refuted >= 0 else 0.0


def _allowed_beyond_quantile(level: float) -> float:
    """The share of the successes that may lie beyond the quantile, with the slack of its law.

    Below 1, however low the level: some success must be in time, beyond what may be rounding.
    """
    return 1.0 - max(level, QUANTILE) * (1.0 - QUANTILE)


def _is_refuted_quantile(trial: Trial, level: float) -> bool:
    """Whether a proof says that no policy has its quantile at the trial's bound."""
    return trial.lower_bound > _allowed_beyond_quantile(level)
