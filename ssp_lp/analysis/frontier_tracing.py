"""Tracing: the turning points of the frontier, each segment priced until nothing lies below."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from numbers import Real

import numpy as np

from ssp_lp.analysis.frontier import Frontier
from ssp_lp.arrays import RELATIVE_GAP
from ssp_lp.column_generation.compiled_problems.compiled_problem import (
    CompiledProblem,
    checked_least_failure,
)
from ssp_lp.column_generation.failure_constraint import Row
from ssp_lp.column_generation.generation import generate
from ssp_lp.column_generation.pricing.pricing_problem import Column, PricingProblem
from ssp_lp.column_generation.secant import Secant
from ssp_lp.compiled.deadline import STOPS, Stop, closing, heed, is_late, until
from ssp_lp.dynamic_programming.work import Work
from ssp_lp.errors import ModelError, OutOfTimeError
from ssp_lp.options import SolveOptions, deadline_of, progress_shown
from ssp_lp.problem import Problem, by_rows, check_problem, has_rows, is_whole, unrolled
from ssp_lp.processes.failure_semantics import Aim

_REFINEMENTS = 6
_LOG = logging.getLogger("ssp_lp.frontier")


def trace_frontier(
    problem: Problem,
    *,
    gap: float = RELATIVE_GAP,
    steepest_price: float | None = None,
    point_limit: int | None = None,
    time_limit: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    verbose: bool = False,
) -> Frontier:
    """Trace the frontier from the least failure to where more failure buys nothing.

    Each segment is priced at its own slope: either no policy lies below it and it is part of the
    frontier, or the policy found splits it. Case M ends at price 0; case S where the price falls
    to the ratio itself, beyond which failing more does not lower the cost given success.

    Args:
        problem: its failure budget does not matter.
        gap: how far a policy may lie below a segment, as a share of the cost at its safer end.
        steepest_price: begin with the policy that is best at this price of failure (kappa in case
            S) rather than at the least failure, near which the price grows without bound.
        point_limit: stop splitting after so many turning points, of which the segments with most
            below them get theirs first; ``gap`` is then what was reached.
        time_limit: seconds after which splitting stops, also within a pricing call, as Ctrl-C does
            at once. The points found are kept; ``open_segments`` says where others may be missing.
        progress: called after each pricing call with (calls, turning points so far).
        verbose: show how far it has come (``ssp_lp.progress_shown``).

    Raises:
        ModelError: an argument out of range, or a problem without a failure budget.
        InfeasibleError: case S, and the goal cannot be reached from the start.
        OutOfTimeError: the time limit passed before there was a point.
        KeyboardInterrupt: Ctrl-C came before there was one.
    """
    asked = _traceable(problem)
    deadline = deadline_of(time_limit, time.perf_counter())
    limits = _Limits(gap, steepest_price, point_limit, deadline < np.inf, progress)
    with progress_shown(verbose), until(deadline) as ended:
        try:
            traced = _traced_and_refined(_first_compiled(asked, steepest_price), limits)
        except Stop:
            if ended.is_interrupted:
                raise KeyboardInterrupt from None
            told = "the time limit ended before the least failure was known: allow more time"
            raise OutOfTimeError(told) from None
        _LOG.info("%d turning points, gap %.1e", len(traced.failure), traced.gap)
    status = ended.status(np.inf if traced.ends_early else traced.gap, gap)
    return replace(traced, _problem=problem, status=status)


def _traceable(problem: Problem) -> Problem:
    """The problem that is solved, which has one failure budget and a mean of costs.

    Raises:
        ModelError: it has not.
    """
    check_problem(problem, "trace_frontier")
    problem = unrolled(problem)
    if problem.semantics.aim is not Aim.LEAST_COST or problem.semantics.forbids_failing:
        raise ModelError(f"{type(problem).__name__} has no failure budget to trace: trace MCMP's")
    if problem.semantics.measure is not None:
        raise ModelError(f"{type(problem).__name__} is no mean of costs to trace: trace S3P's")
    name = type(problem).__name__
    if has_rows(problem):
        raise ModelError(f"{name} has several rows: trace MCMP's frontier")
    if by_rows(problem):
        raise ModelError(
            f"{name}'s costs have no common unit and too many sums to tell apart: round them, or "
            "trace MCMP's frontier"
        )
    return problem


def _first_compiled(problem: Problem, steepest_price: float | None) -> CompiledProblem:
    """The problem compiled finely enough for the steep end, as far as that is known before."""
    compiled = problem.compile()
    if steepest_price is None:
        return compiled.for_program()
    return compiled.refined(steepest_price) or compiled if compiled.is_trial else compiled


def _traced_and_refined(compiled: CompiledProblem, limits: _Limits) -> Frontier:
    """Trace, and again on a finer process while a cap on the cost hides more than the gap."""
    calls, work, known = 0, Work(), None
    for _ in range(_REFINEMENTS):
        try:
            traced = _trace(compiled, limits)
        except STOPS as stop:
            heed(stop)
            if known is None:
                raise Stop from stop
            return known
        calls, work = calls + traced.pricing_calls, work + traced.work
        lost = _share_lost(compiled, traced)
        known = replace(traced, hidden=lost, pricing_calls=calls, work=work)
        if lost <= limits.gap or is_late():
            break
        finer = compiled.refined(float(traced.price[0]))
        if finer is None:
            break
        compiled = finer
    return known or traced


@dataclass(frozen=True)
class _Limits:
    """How far to trace."""

    gap: float
    steepest_price: float | None
    point_limit: int | None
    has_deadline: bool
    progress: Callable[[int, int], None] | None

    def __post_init__(self) -> None:
        if not (isinstance(self.gap, Real) and 0.0 < self.gap < 1.0):
            raise ModelError(f"gap must lie strictly between 0 and 1, not {self.gap!r}")
        most, steepest = self.point_limit, self.steepest_price
        if most is not None and not (is_whole(most) and most >= 2):
            raise ModelError(f"point_limit must be at least 2, not {most!r}")
        if steepest is not None and not (isinstance(steepest, Real) and 0.0 < steepest < np.inf):
            raise ModelError(f"steepest_price must be a positive number, not {steepest!r}")

    @property
    def may_stop(self) -> bool:
        """Whether some segments may be left, so that it matters which are split."""
        return self.point_limit is not None or self.has_deadline

    def allows(self, points: int) -> bool:
        """Whether a segment may still be split."""
        full = self.point_limit is not None and points >= self.point_limit
        return not full and not is_late()


def _share_lost(compiled: CompiledProblem, traced: Frontier) -> float:
    """How far below the frontier policies may lie that the cap on accumulated cost hides."""
    if len(traced.price) == 0:
        return 0.0
    try:
        with closing():
            lost = max(compiled.tail_loss(float(p)) for p in (traced.price[0], traced.price[-1]))
    except STOPS as stop:
        heed(stop)
        return np.inf
    return lost / max(float(traced.cost.min()), 1e-300) if lost > 0.0 else 0.0


def _safest(
    compiled: CompiledProblem, pricing: PricingProblem, steepest_price: float | None
) -> tuple[Column, int]:
    """The turning point to begin with, and how many pricing calls it took.

    Raises:
        ModelError: at the steepest price it is best to fail.
    """
    if steepest_price is None:
        return checked_least_failure(compiled, None).column, 0
    first, row = pricing.minimise(steepest_price, pricing.first()), Row(1.0, compiled.ratio)
    if row.ratio and row.objective(first.cost, first.goal) >= steepest_price:
        raise ModelError(
            f"at the price {steepest_price:g} of failure it is best to fail: "
            "steepest_price must lie above the least cost given success"
        )
    return first, 1


def _trace(compiled: CompiledProblem, limits: _Limits) -> Frontier:
    pricing, row = compiled.pricing(), Row(1.0, compiled.ratio)
    first, calls = _safest(compiled, pricing, limits.steepest_price)
    rule = Secant(pricing, row, first, calls=calls, work=first.work)
    free = generate(rule, SolveOptions(limits.gap))
    last, calls, work = free.columns[-1], rule.calls, rule.work
    columns = [first] if last.failure <= first.failure else [first, last]
    waiting = _Waiting(pricing, compiled.ratio, limits, calls)
    if len(columns) == 2:
        waiting.add(first, last, len(columns))
    columns = [replace(column, totals=None) for column in columns]
    while waiting.found and limits.allows(len(columns)):
        inside, found, outside = waiting.next()
        columns.append(replace(found, totals=None))  # only those waiting start others warmly
        at_most = waiting.below[inside.failure]
        waiting.add(inside, found, len(columns), at_most)
        waiting.add(found, outside, len(columns), at_most * inside.cost / max(found.cost, 1e-300))
    ordered = tuple(sorted(columns, key=lambda c: c.failure))
    failure, cost = np.array([c.failure for c in ordered]), np.array([c.cost for c in ordered])
    return Frontier(
        failure=failure,
        goal=np.array([c.goal for c in ordered]),
        cost=cost,
        price=-np.diff(cost) / np.diff(failure),
        below=np.array([waiting.below[column.failure] for column in ordered[:-1]]),
        tolerance=limits.gap,
        hidden=0.0,
        ends_early=not free.finished,
        ratio=compiled.ratio,
        complete=limits.steepest_price is None,
        pricing_calls=waiting.calls,
        work=work + waiting.work,
        _pricing=pricing,
        _columns=ordered,
    )


class _Waiting:
    """Segments with a policy below them, the worst first where not all can be split. Grows."""

    def __init__(self, pricing: PricingProblem, ratio: bool, limits: _Limits, calls: int) -> None:
        """Nothing waits; ``calls`` were made before."""
        self.found: list[tuple[float, int, tuple[Column, Column, Column]]] = []  # a heap
        self.calls, self.work = calls, Work()
        self._pricing, self._ratio, self._limits = pricing, ratio, limits
        self.below: dict[float, float] = {}  # by a segment's safer failure; see Frontier.below

    def add(self, inside: Column, outside: Column, points: int, at_most: float = 1.0) -> None:
        """Price a segment, and keep it if a policy lies below it by more than the gap.

        Args:
            inside: its safer end.
            outside: its other end.
            points: turning points so far.
            at_most: the share by which policies may lie below it, where there is no time for that.
        """
        line = Secant(self._pricing, Row(1.0, self._ratio), inside, outside)
        if line.slope == 0.0:
            self.below[inside.failure] = 0.0
            return
        try:
            found = replace(self._pricing.minimise(line.slope, outside), found_at=line.slope)
        except STOPS as stop:
            heed(stop)
            self.below[inside.failure] = at_most
            return
        self.calls += 1
        below, self.work = _share_below(line, found), self.work + found.work
        self.below[inside.failure] = below
        if below > self._limits.gap:
            urgency = -below if self._limits.may_stop else -float(self.calls)
            heappush(self.found, (urgency, self.calls, (inside, found, outside)))
        _LOG.debug("%d pricing calls, %d turning points", self.calls, points)
        try:
            if self._limits.progress is not None:
                self._limits.progress(self.calls, points)
        except STOPS as stop:
            heed(stop)

    def next(self) -> tuple[Column, Column, Column]:
        """Take out the segment to split: its ends and the policy between them."""
        return heappop(self.found)[2]


def _share_below(line: Secant, found: Column) -> float:
    """How far a column lies below the line between two, relative to the cost; 0 outside of it."""
    inside, outside = line.inside, line.outside
    if outside is None or not inside.failure < found.failure < outside.failure:
        return 0.0
    below = inside.cost - found.cost - line.slope * (found.failure - inside.failure)
    return max(below, 0.0) / max(inside.cost, 1e-300)
