"""The whole trade-off between cost and failure: the turning points of the optimal frontier."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.arrays import LEAST_BUDGET, RELATIVE_GAP, FloatArray
from ssp_lp.column_generation.compiled_problems.compiled_problem import (
    CompiledProblem,
    checked_least_failure,
)
from ssp_lp.column_generation.failure_constraint import Row
from ssp_lp.column_generation.pricing.pricing_problem import Column, PricingProblem
from ssp_lp.column_generation.secant_search import Bracket, search
from ssp_lp.dynamic_programming.work import Work
from ssp_lp.errors import InfeasibleError, ModelError
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem, by_rows
from ssp_lp.processes.failure_semantics import Aim

_REFINEMENTS = 6


@dataclass(frozen=True, eq=False)
class Frontier:
    """Turning points of the lower convex hull of (failure, cost), by increasing failure.

    Between two of them the optimum is their lottery: cost is piecewise linear and convex in the
    failure. In case S ``cost`` is E[cost; goal], and the objective is cost / goal along a segment.
    Under a discount all three are discounted.
    """

    failure: FloatArray  # [points] increasing
    goal: FloatArray  # [points] 1 - failure
    cost: FloatArray  # [points] decreasing
    price: FloatArray  # [points - 1] price of failure on each segment, decreasing
    gap: float  # no policy lies below a segment by more than this share of its safer end's cost
    ratio: bool  # case S
    complete: bool  # whether it begins at the least failure, not at the steepest price asked for
    pricing_calls: int
    work: Work  # passes over the process
    _pricing: PricingProblem
    _columns: tuple[Column, ...]

    @property
    def objective(self) -> FloatArray:
        """Objective at each turning point, [points]."""
        return self.cost / self.goal if self.ratio else self.cost

    def objective_at(self, budget: float) -> float:
        """Least objective within a failure budget; no pricing call is made.

        Raises:
            InfeasibleError: the budget is below the least failure.
            ModelError: the frontier was not traced down to the budget.
        """
        number, weight = self._locate(budget)
        row = Row(budget, self.ratio)
        if weight == 0.0:
            return row.objective(float(self.cost[number]), float(self.goal[number]))
        ends = np.array([1.0 - weight, weight])
        pair = slice(number, number + 2)
        return row.objective(float(ends @ self.cost[pair]), float(ends @ self.goal[pair]))

    def policy_at(self, budget: float) -> MixedPolicy:
        """A policy that attains :meth:`objective_at`; no pricing call is made.

        Raises:
            InfeasibleError: the budget is below the least failure.
            ModelError: the frontier was not traced down to the budget.
        """
        number, weight = self._locate(budget)
        if weight == 0.0:
            return MixedPolicy((self._pricing.policy(self._columns[number]),), np.ones(1))
        members = tuple(self._pricing.policy(c) for c in self._columns[number : number + 2])
        return MixedPolicy(members, np.array([1.0 - weight, weight]))

    def _locate(self, budget: float) -> tuple[int, float]:
        """The turning point at or before the budget, and the weight of the next one."""
        least = float(self.failure[0])
        if not self.complete and not budget >= least:
            raise ModelError(
                f"the frontier was traced from failure {least:.12g} on, which the budget "
                f"{budget!r} is below; a steeper steepest_price traces more of it"
            )
        if not budget >= least - LEAST_BUDGET:
            raise InfeasibleError(
                f"every policy fails with at least {least:.12g}, above the budget {budget!r}",
                failure_budget=budget,
                least_failure=least,
            )
        number = max(int(np.searchsorted(self.failure, budget, side="right")) - 1, 0)
        if number == len(self.failure) - 1 or budget <= least:
            return number, 0.0
        width = float(self.failure[number + 1] - self.failure[number])
        return number, (budget - float(self.failure[number])) / width


def trace_frontier(
    problem: Problem,
    *,
    gap: float = RELATIVE_GAP,
    steepest_price: float | None = None,
    point_limit: int | None = None,
    time_limit: float | None = None,
    progress: Callable[[int, int], None] | None = None,
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
        point_limit: stop splitting after so many turning points; ``gap`` is then what was reached.
        time_limit: seconds after which splitting stops; segments that wait are still priced once,
            so that ``gap`` is honest.
        progress: called after each pricing call with (calls, turning points so far).

    Raises:
        ModelError: an argument out of range, or a problem without a failure budget.
        InfeasibleError: case S, and the goal cannot be reached from the start.
    """
    if problem.semantics.aim is not Aim.LEAST_COST or problem.semantics.forbids_failing:
        raise ModelError(f"{type(problem).__name__} has no failure budget to trace: trace MCMP's")
    if problem.semantics.measure is not None:
        raise ModelError(f"{type(problem).__name__} is no mean of costs to trace: trace S3P's")
    if by_rows(problem):
        raise ModelError(f"{type(problem).__name__} has several rows: trace MCMP's frontier")
    if not 0.0 < gap < 1.0:
        raise ModelError(f"gap must lie strictly between 0 and 1, not {gap!r}")
    if point_limit is not None and point_limit < 2:
        raise ModelError(f"point_limit must be at least 2, not {point_limit!r}")
    if steepest_price is not None and not 0.0 < steepest_price < np.inf:
        raise ModelError(f"steepest_price must be a positive number, not {steepest_price!r}")
    deadline = np.inf if time_limit is None else time.perf_counter() + time_limit
    limits = _Limits(gap, steepest_price, point_limit, deadline, progress)
    compiled = problem.compile()
    if steepest_price is None:
        compiled = compiled.for_program()
    elif compiled.is_trial:
        compiled = compiled.refined(steepest_price) or compiled
    calls, work = 0, Work()
    for _ in range(_REFINEMENTS):
        traced = _trace(compiled, limits)
        calls, work = calls + traced.pricing_calls, work + traced.work
        lost = _share_lost(compiled, traced)
        finer = compiled.refined(float(traced.price[0])) if lost > gap else None
        traced = replace(traced, gap=max(traced.gap, lost))
        if finer is None or time.perf_counter() > deadline:
            break
        compiled = finer
    return replace(traced, pricing_calls=calls, work=work)


@dataclass(frozen=True)
class _Limits:
    """How far to trace."""

    gap: float
    steepest_price: float | None
    point_limit: int | None
    deadline: float  # on the clock of time.perf_counter
    progress: Callable[[int, int], None] | None

    def allows(self, points: int) -> bool:
        """Whether a segment may still be split."""
        full = self.point_limit is not None and points >= self.point_limit
        return not full and time.perf_counter() <= self.deadline


def _share_lost(compiled: CompiledProblem, traced: Frontier) -> float:
    """How far below the frontier policies may lie that the cap on accumulated cost hides."""
    if len(traced.price) == 0:
        return 0.0
    lost = max(compiled.tail_loss(float(p)) for p in (traced.price[0], traced.price[-1]))
    return lost / max(float(traced.cost.min()), 1e-300) if lost > 0.0 else 0.0


def _trace(compiled: CompiledProblem, limits: _Limits) -> Frontier:
    pricing, row = compiled.pricing(), Row(1.0, compiled.ratio)
    if limits.steepest_price is None:
        first, calls = checked_least_failure(compiled, None).column, 0
    else:
        first, calls = pricing.minimise(limits.steepest_price, pricing.first()), 1
        if row.ratio and row.objective(first.cost, first.goal) >= limits.steepest_price:
            raise ModelError(
                f"at the price {limits.steepest_price:g} of failure it is best to fail: "
                "steepest_price must lie above the least cost given success"
            )
    free = search(pricing, Bracket(row, first), tolerance=limits.gap, deadline=limits.deadline)
    last, calls, work = free.columns[-1], calls + free.rounds, first.work + free.work
    columns = [first] if last.failure <= first.failure else [first, last]
    waiting = [(first, last)] if len(columns) == 2 else []
    columns = [replace(column, totals=None) for column in columns]
    reached = 0.0
    while waiting:
        bracket = Bracket(Row(1.0, compiled.ratio), *waiting.pop())
        if bracket.outside is None or bracket.slope == 0.0:
            continue
        found, calls = pricing.minimise(bracket.slope, bracket.outside), calls + 1
        below, work = _share_below(bracket, found), work + found.work
        if below > limits.gap and limits.allows(len(columns)):
            columns.append(replace(found, totals=None))  # only those waiting start others warmly
            waiting += [(bracket.inside, found), (found, bracket.outside)]
        else:
            reached = max(reached, below)
        if limits.progress is not None:
            limits.progress(calls, len(columns))
    traced = _frontier(pricing, columns, max(reached, limits.gap), compiled.ratio)
    return replace(traced, complete=limits.steepest_price is None, pricing_calls=calls, work=work)


def _share_below(bracket: Bracket, found: Column) -> float:
    """How far a column lies below the bracket's line, relative to the cost; 0 outside of it."""
    if (
        bracket.outside is None
        or not bracket.inside.failure < found.failure < bracket.outside.failure
    ):
        return 0.0
    below = (
        bracket.inside.cost - found.cost - bracket.slope * (found.failure - bracket.inside.failure)
    )
    return max(below, 0.0) / max(bracket.inside.cost, 1e-300)


def _frontier(pricing: PricingProblem, columns: list[Column], gap: float, ratio: bool) -> Frontier:
    ordered = sorted(columns, key=lambda c: c.failure)
    failure = np.array([c.failure for c in ordered])
    cost = np.array([c.cost for c in ordered])
    return Frontier(
        failure=failure,
        goal=np.array([c.goal for c in ordered]),
        cost=cost,
        price=-np.diff(cost) / np.diff(failure),
        gap=gap,
        ratio=ratio,
        complete=True,
        pricing_calls=0,
        work=Work(),
        _pricing=pricing,
        _columns=tuple(ordered),
    )
