"""How a search begins: columns on both sides of the budget, found by pricing alone.

The cheapest policy of least failure takes two stages to find. A search does not need it: any
policy that keeps to the budget will do to begin with, and one is found at a steep price of
failure, if not at the first guess then at a steeper one. Only where that fails, because the budget
is near the least failure or below it, is the least failure itself worked out.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from ssp_lp.column_generation.compiled_problems.compiled_problem import (
    CompiledProblem,
    LeastFailure,
)
from ssp_lp.column_generation.failure_row import FailureRow
from ssp_lp.column_generation.pricing.pricing_problem import Column, PricingProblem
from ssp_lp.column_generation.secant import Secant
from ssp_lp.compiled.deadline import STOPS, Stop, closing, has_answer, heed, is_late
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.options import SolveOptions

_STEEP = 5.0  # first price of failure, in costs of a policy that goes for the goal
_STEPS = (3.0, 15.0, 255.0)  # relative steps of the price until both sides are known
_LEAST_FACTOR = 1.5  # by which the price moves at least while it is a guess
_HINTED_STEPS = (1.0, 1e2, 1e4, 1e6)  # the same from a guess, in units of the guess's uncertainty


@dataclass(frozen=True)
class DualGuess:
    """A price to begin with, such as the dual of a linear program or of a coarser process."""

    price: float
    spread: float  # relative uncertainty
    slack: bool = False  # whether the budget was slack there, so that one side is all there is


def columns_at(pricing: PricingProblem, least: LeastFailure, row: FailureRow) -> Secant:
    """Begin at the policy of least failure; the budget is raised to it by rounding."""
    row = replace(row, budget=max(row.budget, least.column.failure))
    return Secant(pricing, row, least.column)


def columns_by_pricing(
    compiled: CompiledProblem,
    row: FailureRow,
    guess: DualGuess | None,
    options: SolveOptions,
) -> Secant | None:
    """Price failure up and down until the columns found lie on both sides of the budget.

    Args:
        compiled: says the process and the pricing.
        row: budget and form of the objective.
        guess: a price to begin with; None: a multiple of what a run costs.
        options: deadline, and who is told after each pricing call.

    Raises:
        Stop: the time ended before a column that keeps to the budget was found.

    Returns:
        None where no column that keeps to the budget was found.
    """
    pricing, last, price = _begun_with_columns(compiled, row, guess)
    if price is None:
        return None
    steps = _STEPS if guess is None else tuple(guess.spread * step for step in _HINTED_STEPS)
    one_sided = price == 0.0 or (guess is not None and guess.slack)
    inside: Column | None = None
    outside: Column | None = None
    work, calls, began, took = Work(), 0, time.perf_counter(), 0.0
    try:
        for step in (*steps, None):
            began = time.perf_counter()
            last, calls = pricing.minimise(price, last, inside, outside), calls + 1
            took = max(took, time.perf_counter() - began)
            work, value = work + last.work, row.objective(last.cost, last.goal)
            if row.breaks(last):
                outside = last
            elif value < np.inf:
                inside = last
                has_answer(by_itself=True)
            if options.progress is not None:
                options.progress(calls, price, value if last is inside else np.inf)
            enough = one_sided or outside is not None or is_late()
            if step is None or (inside is not None and enough):
                break
            price = _initial_price(
                price, step, last.failure, row.budget, is_hinted=guess is not None
            )
    except STOPS as stop:
        heed(stop)
        took = max(took, time.perf_counter() - began)
        inside = last = _initial_column_within(pricing, row, stop, inside, last)
    if inside is None or last is None:
        return None
    return Secant(pricing, row, inside, outside, last, calls, work, took=took)


def _begun_with_columns(
    compiled: CompiledProblem, row: FailureRow, guess: DualGuess | None
) -> tuple[PricingProblem, Column | None, float | None]:
    """The pricing problem, and a column and a price to begin with; a Stop says what was under way.

    Raises:
        Stop: the time ended before they were known.
    """
    doing = "the process was still being built"
    try:
        pricing = compiled.pricing()
        doing = "the totals of a first policy were being worked out"
        return pricing, *_initial_policy(pricing, row, guess)
    except STOPS as stop:
        heed(stop)
        raise Stop(told=doing) from stop


def _initial_column_within(
    pricing: PricingProblem, row: FailureRow, stop: BaseException, *known: Column | None
) -> Column:
    """The best policy within the budget that is known when the time ends.

    Args:
        pricing: was stopped.
        row: the budget.
        stop: what stopped it.
        known: columns so far.

    Raises:
        Stop: none of them keeps to the budget.
    """
    columns = _measured_columns(known)
    try:
        with closing():
            if not _columns_within(row, columns):
                reached = pricing.incumbent(stop.choice) if isinstance(stop, Stop) else None
                columns += _measured_columns([pricing.first() if reached is None else reached])
    except STOPS as again:
        heed(again)
    kept = _columns_within(row, columns)
    if not kept:
        least = min((column.failure for column in columns), default=1.0)
        raise Stop(told=f"the safest policy known by then fails with {least:.6g}") from stop
    return min(kept, key=lambda column: row.objective(column.cost, column.goal))


def _measured_columns(known: Iterable[Column | None]) -> list[Column]:
    """Columns that stand for a policy, not for a guess at one."""
    return [c for c in known if c and (c.choice is not None or c.policy is not None)]


def _columns_within(row: FailureRow, columns: list[Column]) -> list[Column]:
    """The columns that keep to the budget and have a worth."""
    return [c for c in columns if not row.breaks(c) and row.objective(c.cost, c.goal) < np.inf]


def _initial_price(
    price: float, step: float, failure: float, budget: float, *, is_hinted: bool
) -> float:
    """A price towards the other side of the budget, at most the factor 1 + step away.

    Failure falls about as fast as the price rises; the square of their ratio overshoots, so that
    the columns found lie on both sides and not far apart.
    """
    most = 1.0 + step
    if is_hinted or budget <= 0.0 or failure <= 0.0:
        return price / most if failure <= budget else price * most
    factor = (failure / budget) ** 2
    least = min(_LEAST_FACTOR, most)
    if failure <= budget:
        return price * float(np.clip(factor, 1.0 / most, 1.0 / least))
    return price * float(np.clip(factor, least, most))


def _initial_policy(
    pricing: PricingProblem, row: FailureRow, guess: DualGuess | None
) -> tuple[Column | None, float | None]:
    """A policy to start from and the first price; None where the goal seems out of reach."""
    if guess is not None:
        return None, guess.price
    first = pricing.first()
    typical = first.cost if first.goal <= 0.0 else row.objective(first.cost, first.goal)
    return first, _STEEP * typical if typical > 0.0 else 1.0
