"""The best single deterministic policy within a failure budget, by mixed-integer programs."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sp
from scipy.sparse import linalg

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.engines.lp.integer import IntegerAnswer, IntegerProgram
from ssp_lp.engines.lp.visits import Limit, most_visits, within_reach
from ssp_lp.engines.oracles.oracle import Column
from ssp_lp.engines.process_view import ProcessView, process_view
from ssp_lp.engines.refinement import Outcome
from ssp_lp.engines.row import Row
from ssp_lp.policies.policy import Policy
from ssp_lp.process.explicit import ExplicitProcess

_ROUNDING = 1e-13
"""A policy's failure, summed in another order, may lie so far above the budget that it meets."""

_DUAL = 1e-9  # relative error that is allowed to HiGHS's bound
_RATIOS = 30  # Dinkelbach's iteration converges in a handful
_REFUSED = 100  # policies that keep to the budget by HiGHS's tolerances only


@dataclass(frozen=True, eq=False)
class Single:
    """The best policy found, measured, and a lower bound of the objective of every one."""

    column: Column
    policy: Policy
    objective: float
    lower_bound: float
    finished: bool  # false: stopped by a limit


@dataclass(eq=False)
class _Search:
    """The best policy so far, and the view that it is measured on."""

    view: ProcessView
    row: Row
    best: Single
    deadline: float
    refused: int = field(default=0)

    def take(self, answer: IntegerAnswer) -> bool:
        """Measure an answer's policy and keep it if it is the best; whether it is within budget."""
        choice = None if answer.choice is None else self.completed(answer.choice)[0]
        if choice is None:
            return False
        kept = False
        for column in self.view.measure(choice):
            if column.failure > self.row.budget + _ROUNDING:
                continue
            kept, value = True, self.row.objective(column.cost, column.goal)
            if value < self.best.objective:
                policy = self.view.instance.oracle().policy(column)
                self.best = replace(self.best, column=column, policy=policy, objective=value)
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


def best_single_policy(outcome: Outcome, deadline: float) -> Single:
    """Search for the best deterministic policy, stationary in the states of the process.

    The search begins with the best member of the best lottery that keeps to the budget; the
    lottery's own bound is the first lower bound.

    Args:
        outcome: of the search for the best lottery.
        deadline: on the clock of ``time.perf_counter``.

    Raises:
        ModelError: the process is of no known kind, or too large.
    """
    found, row, oracle = outcome.found, outcome.row, outcome.instance.oracle()
    inside = [c for c in found.columns if c.failure <= row.budget + _ROUNDING]
    first = min(inside, key=lambda c: row.objective(c.cost, c.goal))
    start = Single(
        column=first,
        policy=oracle.policy(first),
        objective=row.objective(first.cost, first.goal),
        lower_bound=found.lower_bound,
        finished=len(found.columns) == 1 and found.finished,
    )
    if len(found.columns) == 1 or time.perf_counter() > deadline:
        return start
    view = process_view(outcome.instance, found.price)
    search = _Search(view, row, start, deadline)
    is_loose = bool(view.free.any())
    bound, finished = _minimised(search, view.process, is_outer=False)
    if is_loose:
        bound, finished = _minimised(search, view.outer, is_outer=True)
    best = search.best
    bound = min(max(bound, found.lower_bound), best.objective)
    return replace(best, lower_bound=bound, finished=finished)


def _minimised(search: _Search, process: ExplicitProcess, *, is_outer: bool) -> tuple[float, bool]:
    """A lower bound of what policies of a process attain, and whether the search was finished.

    Case S by Dinkelbach's iteration. Where no policy is worth less than D >= -1 at the price c of
    success, ``cost >= c * goal + D``, so that ``cost / goal >= c + D / (1 - budget)`` for D < 0.

    Args:
        search: keeps the policies that are found.
        process: the process.
        is_outer: whether free states may randomise, so that answers are no policies.
    """
    row, known = search.row, search.best.objective
    limit = Limit(row.budget, 0.0, known) if row.ratio else Limit(row.budget, known)
    visits = most_visits(process, limit, search.deadline)
    if visits is None:
        return 0.0, False
    free = search.view.free if is_outer else np.zeros_like(search.view.free)
    program = IntegerProgram(process, row.budget + _ROUNDING, visits, free)
    if program.pairs.size == 0:
        return 0.0, True  # nothing is to be decided: the lottery's bound is all there is
    ratio, bound = known if row.ratio else 0.0, 0.0
    for _ in range(_RATIOS):
        cost = process.cost - ratio * process.goal
        _begin(search, program, cost)
        answer = _answered(search, program, cost, is_outer=is_outer)
        bound = max(bound, min(_bound(row, ratio, answer.bound), known))
        if not answer.finished:
            return bound, False
        better = _ratio(process, answer.x) if row.ratio and answer.x is not None else ratio
        if not better < ratio * (1.0 - _DUAL):
            return bound, True
        ratio = better
    return bound, False


def _begin(search: _Search, program: IntegerProgram, cost: FloatArray) -> None:
    """Begin at the best policy so far, where it is one of the process's."""
    choice = search.best.column.choice
    if choice is None or choice.shape != (program.process.n_states,):
        return
    chain = sp.csc_array(program.process.transitions[choice].T)
    stay = sp.csc_array(sp.eye_array(len(choice)) - chain)
    x = np.zeros(len(cost))
    x[choice] = linalg.spsolve(stay, program.process.start)
    program.start_at(x, choice)


def _answered(
    search: _Search, program: IntegerProgram, cost: FloatArray, *, is_outer: bool
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


def _bound(row: Row, ratio: float, value: float) -> float:
    """The objective's bound from the least ``cost - ratio * goal`` of any policy."""
    if not np.isfinite(value):
        return value
    safe, share = value - _DUAL * (1.0 + abs(value)), 1.0 - row.budget
    if not row.ratio:
        return safe
    if safe >= 0.0:
        return ratio
    return max(ratio + safe / share, 0.0) if share > 0.0 else 0.0


def _ratio(process: ExplicitProcess, x: FloatArray) -> float:
    goal = float(process.goal @ x)
    return float(process.cost @ x) / goal if goal > 0.0 else np.inf
