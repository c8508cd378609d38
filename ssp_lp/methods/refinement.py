"""Refinement: solve on finer and finer processes until the gap meets the tolerance.

A process that truncates or rounds the accumulated cost leaves a gap between the bound and the value
of the best policy. A method therefore solves a sequence of finer and finer processes and yields the
optimum of each (column generation by :func:`finer_optima`); :func:`refine` decides when to stop.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

import numpy as np

from ssp_lp.column_generation.column import FailureRow, two_sided_gap
from ssp_lp.column_generation.compiled_problem import CompiledProblem, LeastFailure
from ssp_lp.column_generation.search import DualGuess, Generated, Master
from ssp_lp.compiled.deadline import Stop, WithIncumbent, is_late
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import ModelError, SolverError
from ssp_lp.options import SolveOptions
from ssp_lp.policies import MixedPolicy
from ssp_lp.processes.failure_semantics import AS_IS, ObjectiveSense
from ssp_lp.solution import Answer


@dataclass(frozen=True)
class Proved:
    """A bound of the objective of all feasible policies, and the objective of one such policy."""

    attained: float
    bound: float
    allowed: float  # largest failure of the policies that the bound is about
    reason: str = ""  # why there is no proof
    tail: float = 0.0  # case S: the part of the relative gap that is due to the cap
    least_failure_bound: float | None = None  # with least failure: lower bound of all failures

    @property
    def gap(self) -> float:
        """Relative gap between the value and the bound."""
        return two_sided_gap(self.attained, self.bound)


def proved_objective(
    sense: ObjectiveSense,
    objective: float,
    bound: float,
    allowed: float,
    *,
    paid: float = 0.0,
    tail: float = 0.0,
) -> Proved:
    """Return the proof for the stated objective, from a bound of the minimised value.

    Args:
        sense: relation between minimised value and stated objective.
        objective: stated objective of a policy.
        bound: lower bound of the minimised value.
        allowed: the bound holds for policies that fail with at most this probability.
        paid: sum over the rows of price times bound, whose rounding affects a dual bound.
        tail: part of the relative gap that is due to the cap on accumulated cost.
    """
    constant = sense.constant
    value = objective + sense.offset if constant is None else constant - objective
    bound = sense.bound_or_value(value, bound, paid)
    return Proved(
        objective, objective if bound == value else sense.stated(bound), allowed, tail=tail
    )


TRIAL_TOLERANCE = 1e-2  # relative gap of a trial, whose price gives the next cap
SPREAD = 1e-6  # relative uncertainty of the final price of a search or program

_Compiled = TypeVar("_Compiled", bound=CompiledProblem)


@dataclass(frozen=True, eq=False, kw_only=True)
class Optimum(Answer, Generic[_Compiled]):
    """The best lottery that column generation found, with its proof and the work done."""

    policy: MixedPolicy
    compiled: _Compiled
    row: FailureRow  # with the budget raised to the least failure, if need be
    generated: Generated  # the lottery over columns of the process
    search: Master  # the final restricted master
    calls: int  # pricing calls of all searches
    work: Work  # of all searches
    least: LeastFailure | None = None  # if it had to be computed
    program: str = ""  # report of the last linear program
    sense: ObjectiveSense = AS_IS  # relation between the value and the objective asked for

    @property
    def kappa(self) -> float:
        """Price of failure: the dual of the failure row; in case S plus the optimal ratio."""
        return (self.value if self.compiled.ratio else 0.0) + (self.price or 0.0)

    @property
    def gap(self) -> float:
        """Relative gap of the stated objective; infinite if no feasible policy was found."""
        worth = self.sense.stated
        is_attained = np.isfinite(self.value)
        return two_sided_gap(worth(self.value), worth(self.bound)) if is_attained else np.inf

    def guess(self, spread: float | None = None) -> DualGuess:
        """Return the price of failure, as a first price for a similar problem.

        Args:
            spread: relative uncertainty of the price for that problem; None: the uncertainty for
                the next finer process.
        """
        if spread is None:
            spread = TRIAL_TOLERANCE if self.compiled.is_guess else SPREAD
        return DualGuess(self.kappa, spread, slack=len(self.generated.columns) == 1)

    def followed_by(self, other: Optimum[_Compiled]) -> Optimum[_Compiled]:
        """Return ``other``, the optimum of a later search, with the work of both searches."""
        return replace(other, calls=self.calls + other.calls, work=self.work + other.work)


def finer_optima(
    optimum: Optimum[_Compiled],
    attempt: Callable[[_Compiled, SolveOptions, Optimum[_Compiled]], Optimum[_Compiled]],
    options: SolveOptions,
    patience: int,
) -> Iterator[Optimum[_Compiled]]:
    """Yield an optimum, then the optima of finer and finer problems, each with the work so far.

    The sequence ends if the problem cannot be refined, or if refining does not help any more.

    Args:
        optimum: optimum of the first problem. Without a value function it has no proved bound: then
            it is not yielded, and only its price is used.
        attempt: solves a finer problem, given the options and the optimum of the last problem.
        options: progress callback and limits.
        patience: number of refinements that must together halve the gap. If they do not, refining
            stops, unless part of the gap is due to the cap on accumulated cost.
    """
    gaps = list[float]()
    while True:
        if optimum.values is not None:
            gaps.append(optimum.gap)
            yield optimum
        is_stuck = len(gaps) > patience and gaps[-1] > 0.5 * gaps[-1 - patience]
        if is_stuck and optimum.compiled.tail_loss(optimum.kappa) == 0.0:
            return
        finer = optimum.compiled.refined(optimum.kappa)
        if finer is None:
            return
        try:
            new = attempt(finer, options.after(optimum.calls), optimum)
        except SolverError:
            if gaps and is_late():
                return
            raise
        optimum = optimum.followed_by(new)


class _WithGap(Protocol):
    """An optimum or a proved bound from one process, with its gap."""

    @property
    def gap(self) -> float: ...


_Attempt = TypeVar("_Attempt", bound=_WithGap)


def refine(attempts: Iterable[_Attempt], tolerance: float) -> _Attempt:
    """Return the result of least gap, from results on finer and finer processes.

    It takes further results until the gap is within the tolerance, the results end, or the time
    limit is reached.

    Args:
        attempts: results, each from a finer process than the one before. The sequence also ends if
            it raises ModelError because a table would be too large.
        tolerance: relative gap.

    Raises:
        Stop: the time limit was reached before the first attempt ended.
    """
    best: _Attempt | None = None
    with WithIncumbent() as search:
        try:
            for attempt in attempts:
                if best is None or attempt.gap <= best.gap:
                    best = attempt
                if best.gap <= tolerance or is_late():
                    break
        except ModelError:
            if best is None:
                raise
    if best is None:
        raise search.stop or Stop
    return best
