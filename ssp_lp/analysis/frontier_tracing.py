"""Tracing: the turning points of the frontier, each segment priced until nothing lies below."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from heapq import heappop, heappush

import numpy as np

from ssp_lp.analysis.frontier import Frontier
from ssp_lp.arrays import RELATIVE_GAP
from ssp_lp.column_generation.compiled_problems.compiled_problem import (
    CompiledProblem,
    checked_least_failure,
)
from ssp_lp.column_generation.failure_row import FailureRow
from ssp_lp.column_generation.generation import generate
from ssp_lp.column_generation.pricing.pricing_problem import Column, PricingProblem
from ssp_lp.column_generation.secant import Secant
from ssp_lp.compiled.deadline import STOPS, Stop, closing, heed, is_late, until
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import (
    ModelError,
    OutOfTimeError,
    check_between_0_and_1,
    check_whole,
    is_number,
    wrong_argument,
)
from ssp_lp.options import SolveOptions, deadline_of, progress_shown
from ssp_lp.problem import Problem, by_rows, check_problem, has_rows, unrolled
from ssp_lp.processes.failure_semantics import Aim

_REFINEMENTS = 6
_STEEP_SHARE = 3  # one in so many of the points that are allowed is sought at the steep end
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
            traced = _traced_and_refined(asked.compile(), limits)
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
    name = type(problem).__name__
    if problem.semantics.aim is not Aim.LEAST_COST or problem.semantics.forbids_failing:
        raise ModelError(f"{name} has no failure budget to trace: trace MCMP's")
    if problem.semantics.measure is not None:
        raise ModelError(f"{name} is no mean of costs to trace: trace S3P's")
    if has_rows(problem):
        raise ModelError(f"{name} has limits besides its failure budget: trace it without them")
    if by_rows(problem):
        raise ModelError(
            f"{name}'s costs have no common unit and too many sums to tell apart: round them, or "
            "trace MCMP's frontier"
        )
    return problem


def _traced_and_refined(compiled: CompiledProblem, limits: _Limits) -> Frontier:
    """Trace, and again on a finer process while a cap on the cost hides more than the gap.

    It hides most where the price is steepest, so that a few pricing calls at that end tell first
    how fine a process is needed; the rest is then traced once.
    """
    if limits.steepest_price is None:
        compiled = compiled.for_program()
    elif compiled.is_trial:
        compiled = compiled.refined(limits.steepest_price) or compiled
    calls, work, known, begun, steep_only = 0, Work(), None, None, compiled.ratio
    for _ in range(2 * _REFINEMENTS):
        try:
            traced = _traced(compiled, limits, begun, steep_only=steep_only)
        except STOPS as stop:
            heed(stop)
            if known is None:
                raise Stop from stop
            return known
        lost = _share_lost_in_tracing(compiled, traced)
        calls, work = calls + traced.pricing_calls, work + traced.work
        known = replace(traced, hidden=lost, pricing_calls=calls, work=work)
        is_fine = lost <= limits.gap or is_late()
        finer = None if is_fine else compiled.refined(float(traced.price[0]))
        if finer is None and not steep_only:
            break
        begun, compiled = (traced, compiled) if finer is None else (None, finer)
        steep_only = finer is not None
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
        check_between_0_and_1("gap", self.gap)
        most, steepest = self.point_limit, self.steepest_price
        if most is not None:
            check_whole("point_limit", most, 2)
        if steepest is not None and not (is_number(steepest) and 0.0 < steepest < np.inf):
            raise wrong_argument("steepest_price", "be a positive number", steepest)

    @property
    def may_stop(self) -> bool:
        """Whether some segments may be left, so that it matters which are split."""
        return self.point_limit is not None or self.has_deadline

    def allows(self, points: int) -> bool:
        """Whether a segment may still be split."""
        full = self.point_limit is not None and points >= self.point_limit
        return not full and not is_late()


def _share_lost_in_tracing(compiled: CompiledProblem, traced: Frontier) -> float:
    """How far below the traced frontier policies may lie that the cap on the cost hides."""
    if len(traced.price) == 0:
        return 0.0
    try:
        with closing():
            lost = max(compiled.tail_loss(float(p)) for p in (traced.price[0], traced.price[-1]))
    except STOPS as stop:
        heed(stop)
        return np.inf
    return lost / max(float(traced.cost.min()), 1e-300) if lost > 0.0 else 0.0


def _ends(compiled: CompiledProblem, limits: _Limits) -> tuple[list[Column], bool, int, Work]:
    """The first and last point to be traced; whether the last is known; calls made, and work.

    Raises:
        ModelError: at the steepest price it is best to fail.
    """
    pricing, row = compiled.pricing(), FailureRow(1.0, compiled.ratio)
    steepest, calls = limits.steepest_price, 0
    if steepest is None:
        first = checked_least_failure(compiled, None).column
    else:
        first, calls = pricing.minimise(steepest, pricing.first()), 1
        if row.ratio and row.objective(first.cost, first.goal) >= steepest:
            raise ModelError(
                f"at the price {steepest:g} of failure it is best to fail: "
                "steepest_price must lie above the least cost given success"
            )
    rule = Secant(pricing, row, first, calls=calls, work=first.work)
    free = generate(rule, SolveOptions(limits.gap))
    last = free.columns[-1]
    columns = [first] if last.failure <= first.failure else [first, last]
    return columns, free.finished, rule.calls, rule.work


def _traced(
    compiled: CompiledProblem, limits: _Limits, begun: Frontier | None, *, steep_only: bool
) -> Frontier:
    """The turning points of one process.

    Args:
        compiled: the problem.
        limits: how far to trace.
        begun: what is known of the same process.
        steep_only: split only the first segment, until it is settled.
    """
    pricing = compiled.pricing()
    waiting = _WaitingSegments(pricing, compiled.ratio, limits)
    if begun is None:
        columns, is_known, waiting.calls, work = _ends(compiled, limits)
        open_below = [1.0] * (len(columns) - 1)
    else:
        columns, is_known, work = list(begun._columns), not begun.ends_early, Work()
        open_below, waiting.priced = begun.below.tolist(), begun.priced
        if limits.point_limit is not None and len(columns) > 2:  # the worst segments come first
            columns, open_below = [columns[0], columns[-1]], [1.0]
    for inside, outside, below in zip(columns, columns[1:], open_below, strict=False):
        waiting.add(inside, outside, len(columns), below)
    columns = [replace(column, totals=None) for column in columns]
    while waiting.found and limits.allows(len(columns) * (_STEEP_SHARE if steep_only else 1)):
        inside, found, outside = heappop(waiting.found)[2]  # its ends, and the policy between them
        columns.append(replace(found, totals=None))  # only those waiting start others warmly
        at_most = waiting.below[inside.failure]
        beyond = at_most * inside.cost / max(found.cost, 1e-300)
        waiting.below[found.failure] = beyond
        waiting.add(inside, found, len(columns), at_most)
        if not steep_only:
            waiting.add(found, outside, len(columns), beyond)
    return Frontier.through(
        columns, waiting.below, pricing,
        tolerance=limits.gap, ends_early=not is_known, ratio=compiled.ratio,
        complete=limits.steepest_price is None,
        pricing_calls=waiting.calls, work=work + waiting.work,
    )  # fmt: skip


class _WaitingSegments:
    """Segments with a policy below them, the worst first where not all can be split. Grows."""

    def __init__(self, pricing: PricingProblem, ratio: bool, limits: _Limits) -> None:
        """Nothing waits."""
        self.found: list[tuple[float, int, tuple[Column, Column, Column]]] = []  # a heap
        self.calls, self.work = 0, Work()
        self.priced: dict[float, Column] = {}  # what was found before, by price
        self._pricing, self._ratio, self._limits = pricing, ratio, limits
        self.below: dict[float, float] = {}  # by a segment's safer failure; see Frontier.below

    def add(self, inside: Column, outside: Column, points: int, at_most: float = 1.0) -> None:
        """Price a segment, and keep it if a policy lies below it by more than the gap.

        Args:
            inside: its safer end.
            outside: its other end.
            points: turning points so far.
            at_most: the share by which policies may lie below it, as far as is known.
        """
        price = Secant(self._pricing, FailureRow(1.0, self._ratio), inside, outside).slope
        if price == 0.0 or at_most <= self._limits.gap:
            self.below[inside.failure] = 0.0 if price == 0.0 else at_most
            return
        try:
            found = self.priced.get(price)
            if found is None:
                found = replace(self._pricing.minimise(price, outside), found_at=price)
                self.calls, self.work = self.calls + 1, self.work + found.work
        except STOPS as stop:
            heed(stop)
            self.below[inside.failure] = at_most
            return
        below = self.below[inside.failure] = _share_below_segment(inside, outside, found, price)
        if below > self._limits.gap:
            urgency = -below if self._limits.may_stop else -float(self.calls)
            heappush(self.found, (urgency, self.calls, (inside, found, outside)))
        _LOG.debug("%d pricing calls, %d turning points", self.calls, points)
        try:
            if self._limits.progress is not None:
                self._limits.progress(self.calls, points)
        except STOPS as stop:
            heed(stop)


def _share_below_segment(inside: Column, outside: Column, found: Column, price: float) -> float:
    """How far a column lies below the line between two, relative to the cost; 0 outside of it."""
    if not inside.failure < found.failure < outside.failure:
        return 0.0
    below = inside.cost - found.cost - price * (found.failure - inside.failure)
    return max(below, 0.0) / max(inside.cost, 1e-300)
