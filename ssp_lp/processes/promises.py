"""Promises: limits on the probability that single runs satisfy a bound or a task.

For example, ``within(fuel, 10) >= 0.95`` means: with probability at least 0.95 the run reaches the
goal and uses at most 10 units. The model is extended by the total so far (one value stands for all
totals beyond the bound), or by the automaton of the task (:mod:`ssp_lp.model.tracked_product`). If
there are too many totals, amounts are rounded to multiples of a unit. If they are rounded up, every
policy that satisfies the rounded limit satisfies the stated limit. If they are rounded down, the
optimum bounds the objective of every policy that satisfies the stated limit.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, replace
from math import isfinite

import numpy as np

from ssp_lp.accumulated_cost.totals import MOST_SUMS, room_of, sums_of
from ssp_lp.arrays import MACHINE_EPSILON, SAME_TOTAL, FloatArray, IntArray
from ssp_lp.errors import ModelError, in_short, is_number
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.task import Task
from ssp_lp.model.tracked_product import Automaton, TrackedSSP
from ssp_lp.processes.conditions import ArrivalTerm
from ssp_lp.processes.quantities import Constraint, Quantity, RunEvent, run_amounts

_ROUNDING = 8.0 * MACHINE_EPSILON
_FEWEST, _MOST, _CELLS = 50, 2_000, 400_000  # levels of a rounded total; levels times states


@dataclass(frozen=True, eq=False, repr=False)
class _TotalEvent(RunEvent):
    """Event that a run's total of a quantity stays within a bound or, if ``passes``, exceeds it."""

    quantity: Quantity
    bound: float
    passes: bool = False  # runs that pass the bound, wherever they end
    rounds_down: bool = False  # amounts, if the totals are too many; otherwise up

    def __repr__(self) -> str:
        """Return the call that creates the quantity, as text."""
        return f"{'exceeds' if self.passes else 'within'}({self.quantity!r}, {self.bound:g})"

    def automaton(self, model: SSP) -> Automaton:
        """Return the automaton that follows the total of a run.

        Its values are the possible totals up to the bound, and one for all totals beyond it. With
        ``passes``, the value just after the bound is crossed differs from all later ones. If there
        are too many totals, amounts are rounded to multiples of a fraction of the bound.

        Raises:
            ModelError: an unknown name, or a quantity that is not a total of costs and visits.
        """
        amounts, begun = run_amounts(model, self.quantity)
        constant = self.quantity.constant
        bound = self.bound - constant
        if abs(bound) <= _ROUNDING * abs(constant):  # the constant equals the bound up to rounding
            bound = 0.0
        used = np.minimum(np.append(amounts, begun), 2.0 * abs(bound) + 1.0)  # beyond it at once
        steps, totals, room = _steps_and_totals(used, bound)
        unit = 0.0
        if totals is None or totals.size * steps.size > 1_000 * MOST_SUMS:  # moves of a table
            unit = bound / max(min(_CELLS // model.n_states, _MOST), _FEWEST)
            down = np.floor(used / unit * (1.0 + SAME_TOTAL))
            used = unit * (down if self.rounds_down else np.ceil(used / unit * (1.0 - SAME_TOTAL)))
            steps, totals, room = _steps_and_totals(used, bound)
        if totals is None:
            raise ModelError(f"too many distinct totals in {self!r}: round the amounts")
        unit = -unit if self.rounds_down else unit
        letter, over = np.searchsorted(steps, used), totals.size

        def value_of(total: FloatArray) -> IntArray:
            nearest = np.searchsorted(totals, total - room)
            return np.where(total > bound + room, over, nearest)

        words: list[Hashable] = [constant + total for total in totals.tolist()]
        table = value_of(totals[:, None] + steps)
        words += [f"passes {self.bound:g}"] * self.passes + [f"over {self.bound:g}"]
        last = np.full((1 + self.passes, steps.size), over + self.passes)
        n = model.n_outcomes
        begin = value_of(used[n:]) if bound >= 0.0 else np.full(model.n_states, over)
        rounded = f", rounded to multiples of {abs(unit):.3g}" if unit else ""
        name = f"the total of {self!r}{rounded}"
        letters = tuple(f"{step:g}" for step in steps.tolist())
        moves = np.vstack([table, last])
        return Automaton(name, tuple(words), letters, moves, letter[:n], begin, unit)

    def rounded_down(self) -> _TotalEvent:
        """Return the event whose amounts, if they must be rounded, are rounded down."""
        return replace(self, rounds_down=True)

    def is_safe(self, constraint: Constraint, is_stated: bool) -> bool:
        """Return whether a limit becomes stricter, never weaker, if amounts are rounded up.

        If so, every policy that satisfies the rounded limit satisfies the stated one. The result is
        False if the event occurs in the objective, or in a limit that belongs to the criterion.

        Args:
            constraint: the limit, or the objective as a limit.
            is_stated: whether it is one of the problem's ``constraints``.
        """
        at_most, at_least = constraint.upper is not None, constraint.lower is not None
        weights = [weight for weight, counted in constraint.quantity.terms if counted is self]
        rises = [(weight > 0.0) == self.passes for weight in weights]  # the more, the higher totals
        is_right = not (at_least and any(rises)) and not (at_most and not all(rises))
        return is_right and (is_stated or not rises)

    def term(self, product: TrackedSSP) -> ArrivalTerm:
        """Return the term that counts the event on the product of the model with the automaton.

        It counts arrivals at the goal within the bound or, if ``passes``, steps that cross the
        bound.
        """
        value, over = product.labels.number, len(product.automaton.words) - 1 - self.passes
        if self.passes:
            return ArrivalTerm(product, value == over)
        return ArrivalTerm(product, product.goal_mask & (value < over), final=True)


def _steps_and_totals(
    used: FloatArray, bound: float
) -> tuple[FloatArray, FloatArray | None, float]:
    """Return the distinct amounts, their possible totals, and the tolerance of equal totals.

    The totals are None if there are too many.

    Args:
        used: amount of each outcome and of each start, [amounts].
        bound: the greatest total that is distinguished.
    """
    steps = np.unique(used)
    moves = np.union1d(0.0, steps)
    room = room_of(moves, bound) if bound > 0.0 else 0.0
    return steps, sums_of(moves, bound + 2.0 * room, MOST_SUMS) if bound >= 0.0 else used[:0], room


@explained
def within(quantity: Quantity, bound: float) -> Quantity:
    """Return the quantity "probability of reaching the goal with a total of at most a bound".

    All other runs break the promise: with a larger total, by failing, giving up or wandering. The
    total is counted from the start, which counts as a visit, to the step onto the goal.

    Args:
        quantity: costs and visits that a run adds up, such as ``secondary_cost("fuel")``.
        bound: the largest total that satisfies the promise, >= 0.

    Raises:
        ModelError: not a quantity, or a bound that is not a number >= 0.
    """
    return _total_event("within", quantity, bound, passes=False)


@explained
def exceeds(quantity: Quantity, bound: float) -> Quantity:
    """Return the quantity "probability that the total of a run exceeds a bound".

    The step onto the goal, or into a dead-end, counts; the charge of giving up does not.

    Args:
        quantity: costs and visits that a run adds up, such as ``secondary_cost("fuel")``.
        bound: the largest total that does not count, >= 0.

    Raises:
        ModelError: not a quantity, or a bound that is not a number >= 0.
    """
    return _total_event("exceeds", quantity, bound, passes=True)


@dataclass(frozen=True, eq=False, repr=False)
class _TraceEvent(RunEvent):
    """Event that a run reaches the goal and its trace satisfies a task."""

    task: Task

    def __repr__(self) -> str:
        """Return the call that creates the quantity, as text."""
        return f"holds({self.task!r})"

    def automaton(self, model: SSP) -> Automaton:
        return self.task.automaton(model)

    def term(self, product: TrackedSSP) -> ArrivalTerm:
        """Return the term that counts reaching a goal with a trace that satisfies the task."""
        return ArrivalTerm(product, product.goal_mask & self.task.satisfied(product), final=True)


@explained
def holds(task: Task) -> Quantity:
    """Return the quantity "probability of reaching the goal with a trace that satisfies a task".

    A run that fails, gives up or wanders does not satisfy the task.

    Args:
        task: a task, such as ``task("F key & (!door U key)")``.

    Raises:
        ModelError: not a task.
    """
    if not isinstance(task, Task):
        raise ModelError(f"holds() takes a task, such as task('F key'), not {in_short(task)}")
    return Quantity(((1.0, _TraceEvent(task)),))


def _total_event(verb: str, quantity: Quantity, bound: float, *, passes: bool) -> Quantity:
    """Return the quantity of :func:`within` or, if ``passes``, of :func:`exceeds`, after checks."""
    if not isinstance(quantity, Quantity):
        hint = "a quantity first, such as secondary_cost('fuel')"
        raise ModelError(f"{verb}() takes {hint}, not {in_short(quantity)}")
    if not is_number(bound) or not (isfinite(bound) and bound >= 0.0):
        raise ModelError(f"the bound of {verb} must be a number >= 0, not {in_short(bound)}")
    return Quantity(((1.0, _TotalEvent(quantity, float(bound), passes)),))
