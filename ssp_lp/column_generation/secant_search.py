"""Column generation (Dantzig-Wolfe) for one failure row: a secant search on its price.

Deterministic policies are the columns; the master program has the failure row and convexity, so
its optimum lies on an edge of the lower convex hull of the points (failure, cost). The search
keeps a feasible column A and an infeasible column B, prices failure at the slope between them,
and ends when no policy lies below their line. In case S the objective is the ratio
``cost / (1 - failure)`` (paper, eq. s3p_gamma_j_obj): as long as no column is infeasible the
price is the ratio itself (Dinkelbach's iteration).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.column_generation.failure_constraint import Row, least_of
from ssp_lp.column_generation.pricing.pricing_problem import (
    Column,
    PricingProblem,
    Proof,
    excess_failure,
)
from ssp_lp.dynamic_programming.deadline import Deadline, OutOfTimeError
from ssp_lp.dynamic_programming.work import Work

_ROUNDS = 200
_SAME_COST = 1e-15  # relative
_SAME_FAILURE = 1e-15  # of columns, one of which is the other, found again
_SAME_SMALL = 1e-14  # the same, relative to failures that are small and to goals that are rare


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What the search found: an edge of the hull, the price there, and a certified bound."""

    columns: tuple[Column, ...]  # one or two
    weights: FloatArray  # [columns]
    price: float  # kappa: price of failure at which the columns are optimal
    objective: float  # cost, or cost / (1 - failure)
    lower_bound: float
    proof: Proof  # behind the bound
    rounds: int  # pricing calls
    work: Work  # what they took, with the proof
    finished: bool  # false: stopped by the time limit

    @property
    def failure(self) -> float:
        """What the lottery fails with."""
        pairs = zip(self.weights, self.columns, strict=True)
        return float(sum(weight * column.failure for weight, column in pairs))


@dataclass(frozen=True, eq=False)
class Bracket:
    """The two columns between which the lottery lies; ``outside`` is missing while none is."""

    row: Row
    inside: Column  # keeps to the budget
    outside: Column | None = None  # cheaper, and breaks it

    @property
    def slope(self) -> float:
        """Price of failure at which both columns are worth the same; in case S the ratio so far."""
        if self.outside is not None:
            saved = self.inside.cost - self.outside.cost
            return max(saved / excess_failure(self.outside, self.inside), 0.0)
        return self.row.objective(self.inside.cost, self.inside.goal) if self.row.ratio else 0.0

    @property
    def weight(self) -> float:
        """Weight of the column beyond the budget at which the lottery meets the budget."""
        if self.outside is None:
            return 0.0
        room = self.row.spare(self.inside) / excess_failure(self.outside, self.inside)
        return float(min(max(room, 0.0), 1.0))

    @property
    def objective(self) -> float:
        """Objective of the lottery."""
        w = self.weight
        if self.outside is None or w == 0.0:
            return self.row.objective(self.inside.cost, self.inside.goal)
        return self.row.objective(
            (1.0 - w) * self.inside.cost + w * self.outside.cost,
            (1.0 - w) * self.inside.goal + w * self.outside.goal,
        )

    def improved_by(self, found: Column, price: float, tolerance: float) -> bool:
        """Whether a column lies below the line through ``inside`` at this price."""
        below = self.inside.cost - found.cost - price * excess_failure(found, self.inside)
        scale = abs(self.objective) * (self.inside.goal if self.row.ratio else 1.0)
        return below > 0.1 * tolerance * max(scale, 1e-300)

    def updated(self, found: Column) -> Bracket:
        """The bracket with an improving column in its place.

        A column that never succeeds has no ratio: the price was too low, nothing is learnt.
        """
        if self.row.breaks(found):
            return replace(self, outside=found)
        if self.row.objective(found.cost, found.goal) == np.inf:
            return self
        return replace(self, inside=found)

    def has(self, found: Column) -> bool:
        """Whether a column is the one beyond the budget again, up to rounding."""
        known = self.outside
        if known is None:
            return False
        same = min(_SAME_FAILURE, _SAME_SMALL * min(known.failure, known.goal))
        is_near = abs(excess_failure(found, known)) <= same
        return is_near and found.cost >= known.cost - _SAME_COST * abs(known.cost)


def search(
    pricing: PricingProblem,
    bracket: Bracket,
    *,
    tolerance: float,
    last: Column | None = None,
    deadline: float = np.inf,
    report: Callable[[int, float, float], None] | None = None,
) -> SearchResult:
    """Find the best lottery over policies whose failure keeps to the budget.

    Args:
        pricing: minimises and measures at a price.
        bracket: columns to begin with; the inside one keeps to the budget.
        tolerance: relative gap at which pricing stops.
        last: a column to start the first pricing from; the inside one if left out.
        deadline: on the clock of ``time.perf_counter``.
        report: called after each pricing call with (calls, price, objective).
    """
    found, calls, work, row = bracket.inside if last is None else last, 0, Work(), bracket.row
    finished = False
    while calls < _ROUNDS and not (calls > 0 and time.perf_counter() > deadline):
        price = bracket.slope
        try:
            if found.found_at != price:
                begun = found, bracket.inside, bracket.outside
                found = pricing.minimise(price, *begun, deadline=Deadline(deadline))
                calls, work = calls + 1, work + found.work
        except OutOfTimeError:
            break
        if report is not None:
            report(calls, price, bracket.objective)
        if bracket.improved_by(found, price, tolerance):
            finished = bracket.has(found)
            if finished:
                break
            bracket = bracket.updated(found)
            continue
        finished = not (row.ratio and bracket.outside is not None and price < bracket.objective)
        if finished:
            break
        bracket = Bracket(
            row, bracket.inside
        )  # the budget is slack: go on with Dinkelbach's iteration
    return _conclude(pricing, bracket, found, calls, work, finished, tolerance)


def _aligned(pricing: PricingProblem, bracket: Bracket, price: float) -> Bracket:
    """Both columns with what they fix by a price fixed at the same one, if they still bracket."""
    if bracket.outside is None:
        return bracket
    inside, outside = (
        pricing.aligned(bracket.inside, price),
        pricing.aligned(bracket.outside, price),
    )
    still = bracket.row.breaks(outside) and not bracket.row.breaks(inside)
    return Bracket(bracket.row, inside, outside) if still else bracket


def _conclude(
    pricing: PricingProblem,
    bracket: Bracket,
    last: Column,
    calls: int,
    work: Work,
    finished: bool,
    tolerance: float,
) -> SearchResult:
    price = bracket.slope
    bracket = _aligned(pricing, bracket, price)
    row, weight, best = bracket.row, bracket.weight, bracket.objective
    columns: tuple[Column, ...] = (bracket.inside,)
    weights = np.ones(1)
    if bracket.outside is not None and weight > 0.0:
        columns, weights = (bracket.inside, bracket.outside), np.array([1.0 - weight, weight])
    price = max(price, best) if row.ratio else price
    slack = row.ratio and price <= best  # then prove it just below the ratio: Row.lower_bound
    proof = pricing.prove(price * (1.0 - 0.25 * tolerance) if slack else price, last, slack=slack)
    return SearchResult(
        columns=columns,
        weights=weights,
        price=price,
        objective=best,
        lower_bound=least_of(row.lower_bound(proof), best),
        proof=proof,
        rounds=calls,
        work=work + proof.work,
        finished=finished,
    )
