"""The best single deterministic policy within a failure budget, by mixed-integer programs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from scipy.sparse import linalg

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.column_generation.failure_row import FailureRow, relative_gap
from ssp_lp.column_generation.generation import Generated
from ssp_lp.compiled.deadline import STOPS, heed, is_late
from ssp_lp.methods.assembling import Found
from ssp_lp.methods.integer_programming.integer_program import (
    IntegerAnswer,
    IntegerProgram,
    most_visits,
)
from ssp_lp.methods.integer_programming.process_view import ProcessView, process_view, within_reach
from ssp_lp.methods.refinement import RefinedOutcome
from ssp_lp.processes.explicit import ExplicitProcess

_ROUNDING = 1e-13
_SMALL = 1e-10  # relative
"""A policy's failure, summed in another order, may lie so far above the budget that it meets."""

_DUAL = 1e-9  # relative error that is allowed to HiGHS's bound
_RATIOS = 30  # Dinkelbach's iteration converges in a handful
_SPREADS = (1e-6, 0.03, 0.1, 0.3, 1.0, 3.0)  # relative distances of prices, up and down
_SKIPS = 8  # states skipped on the way between two policies
_REFUSED = 100  # policies that keep to the budget by HiGHS's tolerances only


@dataclass(eq=False)
class _PolicySearch:
    """The best policy so far, and the view that it is measured on."""

    view: ProcessView
    row: FailureRow
    best: Found  # its bound holds of every policy
    tolerance: float  # relative
    deadline: float
    refused: int = 0
    choice: IntArray | None = None  # [states] of the best policy, where it was found here

    def take(self, answer: IntegerAnswer) -> bool:
        """Measure an answer's policy and keep it if it is the best; whether it is within budget."""
        return answer.choice is not None and self.offer(answer.choice)

    def offer(self, choice: IntArray) -> bool:
        """Measure a choice and keep it if it is the best; whether it is within budget."""
        whole = self.completed(choice)[0]
        if whole is None:
            return False
        kept = False
        for column in self.view.measure(whole):
            if column.failure > _allowed_in_search(self.row):
                continue
            kept, value = True, self.row.objective(column.cost, column.goal)
            if value <= self.best.value:
                self.choice = whole
            if value < self.best.value:
                policy = self.view.compiled.pricing().policy(column)
                better = Found(policy, value, self.best.bound, column.failure)
                self.best = better
        return kept

    def completed(self, choice: IntArray) -> tuple[IntArray | None, BoolArray]:
        """The choice where it leads, a safe one elsewhere; None if it holds mass for ever."""
        process = self.view.process
        chain = sp.csr_array(process.transitions[choice])
        chain.eliminate_zeros()
        reached = within_reach(chain, process.start > 0)
        leaks = process.goal[choice] + process.failure[choice] > 0
        leaves = within_reach(sp.csr_array(chain.T), leaks)
        if (reached & ~leaves).any():
            return None, reached
        return np.where(reached, choice, self.view.safe), reached


def best_single_policy(
    outcome: RefinedOutcome, tolerance: float, deadline: float
) -> tuple[Found, bool]:
    """Search for the best deterministic policy, stationary in the states of the process.

    The search begins with the best member of the best lottery that keeps to the budget and the
    policies between its members; the lottery's own bound is the first lower bound.

    Args:
        outcome: of the search for the best lottery.
        tolerance: relative gap at which to stop.
        deadline: on the clock of ``time.perf_counter``.

    Returns:
        The policy, with a bound of every one, and whether the search was finished.

    Raises:
        ModelError: the process is of no known kind, or too large.
    """
    found, row, pricing = outcome.found, outcome.row, outcome.compiled.pricing()
    inside = [c for c in found.columns if c.failure <= _allowed_in_search(row)]
    first = min(inside, key=lambda c: row.objective(c.cost, c.goal))
    value = row.objective(first.cost, first.goal)
    start = Found(pricing.policy(first), value, found.lower_bound, first.failure)
    if len(found.columns) == 1 or is_late():
        return start, len(found.columns) == 1 and found.finished
    try:
        view = process_view(outcome.compiled, found.price)
    except STOPS as stop:
        heed(stop)
        return start, False
    search = _PolicySearch(view, row, start, tolerance, deadline)
    try:
        return _searched_policy(search, found)
    except STOPS as stop:
        heed(stop)
        return search.best, False


def _searched_policy(search: _PolicySearch, found: Generated) -> tuple[Found, bool]:
    """Walk between two policies, then solve the programs; the search keeps the best policy."""
    view, tolerance = search.view, search.tolerance
    _search_between(search, found.price)
    if relative_gap(search.best.value, found.lower_bound) <= tolerance:
        return search.best, True
    bound, finished = _minimised_in_search(search, view.process, is_outer=False)
    if view.free.any():
        bound, finished = _minimised_in_search(search, view.outer, is_outer=True)
    best = search.best
    return replace(best, bound=min(max(bound, found.lower_bound), best.value)), finished


def _allowed_in_search(row: FailureRow) -> float:
    """The budget, with room for rounding."""
    return row.budget + min(_ROUNDING, _SMALL * row.budget)


def _search_between(search: _PolicySearch, price: float) -> None:
    """Begin the search with policies between two, as near to the budget as changing states allows.

    The two that are best at prices just beside the lottery's are both optimal at it, and so is
    every policy that follows the one in some states and the other elsewhere: of these, the one that
    fails most within the budget is cheapest. Farther prices differ in more states.
    """
    compiled = search.view.compiled
    for spread in _SPREADS:
        if is_late():
            return
        safe, risky = (
            compiled.explicit_choice(compiled.pricing().minimise(price * factor))
            for factor in (1.0 + spread, 1.0 / (1.0 + spread))
        )
        differing = np.flatnonzero(safe != risky)
        for order in (differing, differing[::-1]):
            if search.offer(safe):
                _search_walk(search, safe, risky, order)


def _search_walk(search: _PolicySearch, safe: IntArray, risky: IntArray, order: IntArray) -> None:
    """Change states in order while that keeps to the budget, by bisection; skip one that does not.

    Args:
        search: keeps the policies on the way.
        safe: a choice that keeps to the budget, [states].
        risky: another, [states].
        order: states in which they differ.
    """
    here = safe
    for _ in range(_SKIPS):
        kept, broken = 0, order.size + 1  # states changed, and too many
        while broken - kept > 1 and not is_late():
            middle = (kept + broken) // 2
            within = search.offer(_mixed_choice(here, risky, order[:middle]))
            kept, broken = (middle, broken) if within else (kept, middle)
        here, order = _mixed_choice(here, risky, order[:kept]), order[kept + 1 :]
        if order.size == 0:
            return


def _minimised_in_search(
    search: _PolicySearch, process: ExplicitProcess, *, is_outer: bool
) -> tuple[float, bool]:
    """A lower bound of what policies of a process attain, and whether the search was finished.

    Case S by Dinkelbach's iteration. Where no policy is worth less than D >= -1 at the price c of
    success, ``cost >= c * goal + D``, so that ``cost / goal >= c + D / (1 - budget)`` for D < 0.

    Args:
        search: keeps the policies that are found.
        process: the process.
        is_outer: whether free states may randomise, so that answers are no policies.
    """
    row, known = search.row, search.best.value
    limits = (0.0, known) if row.ratio else (known, 0.0)
    visits = most_visits(process, row.budget, *limits, search.deadline)
    if visits is None:
        return 0.0, False
    free = search.view.free if is_outer else np.zeros_like(search.view.free)
    program = IntegerProgram(process, _allowed_in_search(row), visits, free)
    if not row.ratio:
        program.stop_at(search.tolerance)
    if program.pairs.size == 0:
        return 0.0, True  # nothing is to be decided: the lottery's bound is all there is
    ratio, bound = known if row.ratio else 0.0, 0.0
    for _ in range(_RATIOS):
        cost = process.cost - ratio * process.goal
        _begin_policy_search(search, program, cost)
        answer = _searched_program(search, program, cost, is_outer=is_outer)
        bound = max(bound, min(_bound_of_search(row, ratio, answer.bound), known))
        if not answer.finished:
            return bound, False
        better = ratio
        if row.ratio and answer.x is not None:
            goal = float(process.goal @ answer.x)
            better = float(process.cost @ answer.x) / goal if goal > 0.0 else np.inf
        if not better < ratio * (1.0 - _DUAL):
            return bound, True
        ratio = better
    return bound, False


def _begin_policy_search(search: _PolicySearch, program: IntegerProgram, cost: FloatArray) -> None:
    """Begin at the best policy so far, where it is one of the process's."""
    choice = search.choice
    if choice is None:
        return
    chain = sp.csc_array(program.process.transitions[choice].T)
    stay = sp.csc_array(sp.eye_array(len(choice)) - chain)
    x = np.zeros(len(cost))
    x[choice] = linalg.spsolve(stay, program.process.start)
    program.start_at(x, choice)


def _searched_program(
    search: _PolicySearch, program: IntegerProgram, cost: FloatArray, *, is_outer: bool
) -> IntegerAnswer:
    """Solve, and solve again without each policy that breaks the budget when it is measured."""
    while True:
        answer = program.solve(cost, search.deadline)
        if search.take(answer) or answer.choice is None or is_outer:
            return answer
        if search.refused == _REFUSED:
            return replace(answer, finished=False)
        search.refused += 1
        program.forbid(answer.choice, search.completed(answer.choice)[1])


def _bound_of_search(row: FailureRow, ratio: float, value: float) -> float:
    """The objective's bound from the least ``cost - ratio * goal`` of any policy."""
    if not np.isfinite(value):
        return value
    safe, share = value - _DUAL * (1.0 + abs(value)), 1.0 - row.budget
    if not row.ratio:
        return safe
    if safe >= 0.0:
        return ratio
    return max(ratio + safe / share, 0.0) if share > 0.0 else 0.0


def _mixed_choice(first: IntArray, second: IntArray, states: IntArray) -> IntArray:
    """The first choice of pairs, in some states the second, [states]."""
    mixed = first.copy()
    mixed[states] = second[states]
    return mixed
