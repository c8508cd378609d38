"""How a search begins: columns on both sides of the budget, found by pricing alone.

The cheapest policy of least failure takes two stages to find. A search does not need it: any
policy that keeps to the budget will do to begin with, and one is found at a steep price of
failure, if not at the first guess then at a steeper one. Only where that fails, because the budget
is near the least failure or below it, is the least failure itself worked out.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from ssp_lp.engines.column_generation import Edge
from ssp_lp.engines.instance import Instance, LeastFailure
from ssp_lp.engines.oracles.oracle import Column, Oracle, Work
from ssp_lp.engines.row import Row

_STEEP = 5.0  # first price of failure, in costs of a policy that goes for the goal
_STEPS = (3.0, 15.0, 255.0)  # relative steps of the price until both sides are known
_HINTED_STEPS = (1.0, 1e2, 1e4, 1e6)  # the same from a hint, in units of the hint's uncertainty


@dataclass(frozen=True)
class Hint:
    """A price to begin with, such as the dual of a linear program or of a coarser instance."""

    price: float
    spread: float  # relative uncertainty


@dataclass(frozen=True, eq=False)
class Opening:
    """An edge to begin with; its inside column keeps to the budget."""

    edge: Edge
    last: Column  # the last one found: a warm start
    calls: int = 0
    work: Work = field(default_factory=Work)
    least: LeastFailure | None = None  # where it had to be worked out


def open_at(least: LeastFailure, row: Row) -> Opening:
    """An opening from the policy of least failure; the budget is raised to it by rounding."""
    row = replace(row, budget=max(row.budget, least.column.failure))
    return Opening(Edge(row, least.column), least.column, least=least)


def open_by_pricing(
    instance: Instance,
    row: Row,
    hint: Hint | None,
    deadline: float,
    report: Callable[[int, float, float], None] | None,
) -> Opening | None:
    """Price failure up and down until the columns found lie on both sides of the budget.

    Args:
        instance: says the process and the oracle.
        row: budget and form of the objective.
        hint: a price to begin with; None: a multiple of what a run costs.
        deadline: on the clock of ``time.perf_counter``.
        report: called after each oracle call with (calls, price, objective).

    Returns:
        None where no column that keeps to the budget was found.
    """
    oracle = instance.oracle()
    last, price = _beginning(oracle, row, hint)
    if price is None:
        return None
    steps = _STEPS if hint is None else [hint.spread * step for step in _HINTED_STEPS]
    inside: Column | None = None
    outside: Column | None = None
    calls, work = 0, Work()
    for step in (*steps, None):
        last, calls = oracle.minimise(price, last), calls + 1
        work = work + last.work
        if last.failure <= row.budget and row.objective(last.cost, last.goal) < float("inf"):
            inside = last
        elif last.failure > row.budget:
            outside = last
        if report is not None:
            known = float("inf") if inside is None else row.objective(inside.cost, inside.goal)
            report(calls, price, known)
        both = inside is not None and outside is not None
        late = inside is not None and time.perf_counter() > deadline
        if step is None or both or late:
            break
        price = price / (1.0 + step) if inside is not None else price * (1.0 + step)
    if inside is None:
        return None
    return Opening(Edge(row, inside, outside), last, calls, work)


def _beginning(oracle: Oracle, row: Row, hint: Hint | None) -> tuple[Column, float | None]:
    """A policy to start from and the first price; None where the goal seems out of reach."""
    first = oracle.first()
    if hint is not None:
        return first, hint.price
    if first.goal <= 0.0:
        return first, None
    typical = row.objective(first.cost, first.goal)
    return first, _STEEP * typical if typical > 0.0 else 1.0
