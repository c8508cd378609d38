"""The best single policy, for a controller that may not toss a coin.

The best lottery attains c*; one deterministic policy that keeps to the budget may have to cost
more. It is found by a mixed-integer program over the states of the process (case S: state and
accumulated cost): x counts expected visits, a binary y per pair says which is taken,

    x_pair <= V_state * y_pair,   sum over the pairs of a state of y = 1.

**The bound V on visits** is the greatest expected number of visits of the state over all policies,
randomised ones included, that keep to the budget and cost no more than the best policy known
beforehand: a linear program for each state (one for all states together where there are many), 1
where no state can be visited twice. No better policy is lost by it. It is finite because what
costs nothing and could go on for ever is collapsed in the process. Under a discount it cannot
exceed 1 / (1 - discount). V is an optimum over all policies with a margin for rounding, so that an
answer whose visits come up to it needs no second try with a larger one.

The ratio of case S is minimised by Dinkelbach's iteration. Every policy is read off y and measured
exactly on the process; one that keeps to the budget only within HiGHS's tolerances is refused and
excluded by a further row. The lower bound is the better of the lottery's and HiGHS's dual bound,
lowered by 1e-9 of itself: that carries HiGHS's tolerances and is not a checked sub-solution. Where
it misses the tolerance for that, the best policies, whose values are exact, are excluded one by
one, and HiGHS's bound is needed of the others alone.

A deterministic optimum has no price of failure unless the budget is slack: as a function of the
budget it is a step function.

Policies that leave a collapsed component by a way that depends on where it was entered, or go on
beyond the cap of case S otherwise than by the tails, are counted in the bound but not searched: a
gap may then remain that is not due to the time limit. Policies with more memory than the state of
the process, which could take coins from chance itself, are not counted at all where the bound is
HiGHS's.

A state without a choice, and one that is left free, has no y.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, cast

import highspy
import numpy as np
import scipy.sparse as sp

from ssp_lp.accumulated_cost.process import LayeredProcess
from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.column_generation.column import Column, relative_gap
from ssp_lp.column_generation.compiled_problem import (
    CompiledAccumulatedCost,
    CompiledExplicit,
    CompiledProblem,
)
from ssp_lp.compiled.deadline import WithIncumbent, is_late
from ssp_lp.errors import Argument, ModelError, SolverError
from ssp_lp.linear_programming.highs import HighsOptions, highs_lp, highs_solver, run_highs
from ssp_lp.linear_programming.linear_program import LinearProgram
from ssp_lp.model.graph import reached_along
from ssp_lp.policies.policy import as_lottery
from ssp_lp.processes.conditions import FAILURE_ROW
from ssp_lp.processes.explicit_process import ExplicitProcess
from ssp_lp.processes.failure_label import FailureLabelled
from ssp_lp.processes.quotient import Quotient
from ssp_lp.programs.occupation_program import rows_program
from ssp_lp.solution import Answer, Solution

if TYPE_CHECKING:
    from ssp_lp.methods.columns import RefinedOutcome

_OPEN = 1e-6  # relative gap from which determinism is said to cost at most so much
_DUAL = 1e-9  # relative error that is allowed to HiGHS's bound
_RATIOS = 30  # Dinkelbach's iteration converges in a handful
_SPREADS = (1e-6, 0.03, 0.1, 0.3, 1.0, 3.0)  # relative distances of prices, up and down
_SKIPS = 8  # states skipped on the way between two policies
_REFUSED = 100  # policies that keep to the budget by HiGHS's tolerances only
_EXCLUDED = (
    8  # policies that are as good as the best but for HiGHS's tolerances; each costs a search
)
_ROUNDING = 1e-13
_SMALL = 1e-10  # relative
"""A policy's failure, summed in another order, may lie so far above the budget that it meets."""


def best_deterministic(
    mixed: Solution, outcome: RefinedOutcome, tolerance: float, deadline: float
) -> Solution:
    """Solve for the best single deterministic policy, beside the best lottery.

    The search begins with the best member of the lottery that keeps to the budget and the policies
    between its members; the lottery's own bound is the first lower bound.

    Args:
        mixed: the best lottery; its value function is kept.
        outcome: of the search that found it.
        tolerance: relative gap at which to stop.
        deadline: on the clock of ``time.perf_counter``.

    Raises:
        ModelError: the process is too large.
    """
    generated, row = outcome.generated, outcome.row
    most = row.budget + min(_ROUNDING, _SMALL * row.budget)
    inside = [column for column in generated.columns if column.failure <= most]
    column = min(inside, key=lambda c: row.objective(c.cost, c.goal))
    value, policy = row.objective(column.cost, column.goal), outcome.compiled.pricing().policy
    incumbent = Answer(policy(column), value, generated.lower_bound, column.failure)
    search = _PolicySearch(outcome, most, incumbent, tolerance, deadline)
    finished = len(generated.columns) == 1 and generated.finished
    if len(generated.columns) > 1 and not is_late():
        with WithIncumbent():
            finished = search.run()
    single = search.best
    gap = relative_gap(single.value, single.bound)
    cost = f"{'at most ' if gap > _OPEN else ''}{max(single.value - mixed.objective, 0.0):.9g}"
    remarks = [
        f"deterministic: the mixed optimum is {mixed.objective:.9g}, determinism costs {cost}"
    ]
    if mixed.note:
        remarks.append(mixed.note)
    if not finished and "stopped" not in mixed.note:
        remarks.append("stopped before the search was finished; the gap is honest")
    if finished and gap > max(_OPEN, 2.0 * tolerance):
        remarks.append("the gap is what policies outside the search could gain at most")
    is_slack = (
        len(generated.columns) == 1 and mixed.failure_price == mixed.problem.semantics.penalty
    )
    return replace(
        mixed,
        policy=as_lottery(single.policy),
        failure_price=mixed.failure_price if is_slack else None,
        prices=mixed.prices if is_slack else {},
        objective=single.value,
        lower_bound=min(single.bound, single.value),
        budget_used=single.failure,
        note="; ".join(remarks),
    )


@dataclass(eq=False)
class _PolicySearch:
    """The best policy so far, and the process that it is measured on. Mutable: it improves."""

    outcome: RefinedOutcome  # of the search for the best lottery
    most: float  # failure of a policy that keeps to the budget: rounding is allowed for
    best: Answer  # its bound holds of every policy
    tolerance: float  # relative
    deadline: float
    refused: int = 0

    @cached_property
    def relaxation(self) -> _DeterministicRelaxation:
        """The process written out for the search for deterministic policies, as a relaxation."""
        return deterministic_relaxation(self.outcome.compiled, self.outcome.generated.price)

    def run(self) -> bool:
        """Search deterministic policies by walks and integer programs; whether it was finished."""
        relaxation, bound = self.relaxation, self.outcome.generated.lower_bound
        self._walk_between_members()
        if relative_gap(self.best.value, bound) <= self.tolerance:
            return True
        free = relaxation.may_randomise
        proved, finished = self._integer_bound(relaxation.process, np.zeros_like(free))
        if free.any():
            proved, finished = self._integer_bound(relaxation.relaxed, free)
        self.best = replace(self.best, bound=min(max(proved, bound), self.best.value))
        return finished

    def offer(self, choice: IntArray) -> bool:
        """Measure a choice and keep it if it is the best; whether it is within the budget."""
        relaxation, row, kept = self.relaxation, self.outcome.row, False
        whole = relaxation.completed(choice)[0]
        for column in () if whole is None else relaxation.measure(whole):
            if column.failure > self.most:
                continue
            kept, value = True, row.objective(column.cost, column.goal)
            if value < self.best.value:
                policy = relaxation.compiled.pricing().policy(column)
                self.best = Answer(policy, value, self.best.bound, column.failure)
        return kept

    def _walk_between_members(self) -> None:
        """Begin with deterministic policies between two members, as near the budget as may be.

        The two that are best at prices just beside the lottery's are both optimal at it, and so is
        every policy that follows the one in some states and the other elsewhere: of these, the one
        that fails most within the budget is cheapest. Farther prices differ in more states.
        """
        compiled, price = self.relaxation.compiled, self.outcome.generated.price
        for spread in _SPREADS:
            if is_late():
                return
            safe, risky = (
                compiled.explicit_choice(compiled.pricing().minimise(price * factor))
                for factor in (1.0 + spread, 1.0 / (1.0 + spread))
            )
            differing = np.flatnonzero(safe != risky)
            for order in (differing, differing[::-1]):
                if self.offer(safe):
                    self._walk(safe, risky, order)

    def _walk(self, safe: IntArray, risky: IntArray, order: IntArray) -> None:
        """Change a deterministic policy's states in order within the budget, by bisection.

        Args:
            safe: a choice that keeps to the budget, [states].
            risky: another, [states].
            order: states in which they differ.
        """
        here = safe
        for _ in range(_SKIPS):
            kept, broken = 0, order.size + 1  # states changed, and too many
            while broken - kept > 1 and not is_late():
                middle = (kept + broken) // 2
                within = self.offer(_with_states(here, risky, order[:middle]))
                kept, broken = (middle, broken) if within else (kept, middle)
            here, order = _with_states(here, risky, order[:kept]), order[kept + 1 :]
            if order.size == 0:
                return

    def _integer_bound(self, process: ExplicitProcess, free: BoolArray) -> tuple[float, bool]:
        """Lower bound of deterministic policies by integer programs, and whether they ended.

        Case S by Dinkelbach's iteration. Where no policy is worth less than D >= -1 at the price c
        of success, ``cost >= c * goal + D``, so that ``cost / goal >= c + D / (1 - budget)`` for
        D < 0.

        Args:
            process: the process.
            free: states that may randomise, so that answers are no policies, [states].
        """
        row, incumbent = self.outcome.row, self.best.value
        share, ratio, most = 1.0 - row.budget, 0.0, incumbent
        if row.ratio:
            ratio, most = incumbent, 0.0
        visits = most_visits(process, row.budget, most, ratio, self.deadline)
        if visits is None:
            return 0.0, False
        gap = 0.0 if row.ratio else self.tolerance
        program = _IntegerProgram(process, self.most, visits, free, max(gap, _LEAST_GAP))
        if program.pairs.size == 0:
            return 0.0, True  # nothing is to be decided: the lottery's bound is all there is
        bound, excluded = 0.0, 0
        for _ in range(_RATIOS):
            answer = self._solved_without_refused(program, process.cost - ratio * process.goal)
            least = answer.bound
            if np.isfinite(least):
                least -= _DUAL * (1.0 + abs(least))
                if row.ratio:
                    beyond = least / share if share > 0.0 else -np.inf
                    least = ratio if least >= 0.0 else max(ratio + beyond, 0.0)
            bound = max(bound, min(least, self.best.value))  # no policy that is excluded has less
            if not answer.finished:
                return bound, False
            better = ratio
            if row.ratio and answer.x is not None:
                goal = float(process.goal @ answer.x)
                better = float(process.cost @ answer.x) / goal if goal > 0.0 else np.inf
            if better < ratio * (1.0 - _DUAL):
                ratio = better
                continue
            is_met = relative_gap(self.best.value, bound) <= self.tolerance
            if is_met or answer.choice is None or free.any() or excluded == _EXCLUDED:
                return bound, True
            excluded += 1
            self._exclude(program, answer.choice)
        return bound, False

    def _solved_without_refused(self, program: _IntegerProgram, cost: FloatArray) -> _IntegerAnswer:
        """Solve the integer program again without policies that break the budget when measured."""
        while True:
            answer = program.solve(cost, self.deadline)
            choice = answer.choice
            if choice is None or self.offer(choice) or program.free.any():
                return answer
            if self.refused == _REFUSED:
                return replace(answer, finished=False)
            self.refused += 1
            self._exclude(program, choice)

    def _exclude(self, program: _IntegerProgram, choice: IntArray) -> None:
        """Exclude the policy of a choice from an integer program."""
        program.forbid(choice[self.relaxation.completed(choice)[1]])


def _with_states(choice: IntArray, other: IntArray, states: IntArray) -> IntArray:
    """A deterministic choice with another one's pairs in some states, [states]."""
    mixed = choice.copy()
    mixed[states] = other[states]
    return mixed


_MOST_PAIRS = 500_000
_ENDLESS = 1e9  # price of failure, relative to 1 + the optimal one, by which no tail fails at will


@dataclass(frozen=True, eq=False)
class _DeterministicRelaxation:
    """The process that policies live on, and one of which they are special cases.

    A deterministic policy may leave a collapsed component by a way that depends on where it came
    in, and may go on beyond the cap of case S by other policies than the tails. In ``relaxed`` this
    is allowed for: some states ``may_randomise``, and beyond the cap success costs no more than
    what had been paid at its border, with any probability that some policy attains.
    """

    compiled: CompiledProblem
    process: ExplicitProcess
    relaxed: ExplicitProcess
    may_randomise: BoolArray  # [states] those within reach of the start
    fallback: IntArray  # [states] pairs of a policy that leaves from every state
    measure: Callable[[IntArray], list[Column]]  # a choice to policies, each measured exactly

    def completed(self, choice: IntArray) -> tuple[IntArray | None, BoolArray]:
        """The choice where it leads, a safe one elsewhere; None if it holds mass for ever."""
        process = self.process
        chain = sp.csr_array(process.transitions[choice])
        chain.eliminate_zeros()
        back, start = sp.csr_array(chain.T), np.flatnonzero(process.start > 0)
        reached = reached_along(chain.indices, chain.indptr, start)
        leaks = process.goal[choice] + process.failure[choice] > 0
        leaves = reached_along(back.indices, back.indptr, np.flatnonzero(leaks))
        if (reached & ~leaves).any():
            return None, reached
        return np.where(reached, choice, self.fallback), reached


def deterministic_relaxation(compiled: CompiledProblem, price: float) -> _DeterministicRelaxation:
    """Write a process out as a relaxation for deterministic policies.

    Args:
        compiled: of case M or S.
        price: of failure at the best lottery.

    Raises:
        ModelError: there are too many pairs.
    """
    exact = compiled.for_program()
    if exact.n_columns > _MOST_PAIRS:
        raise ModelError(
            Argument("method", "deterministic"),
            f": a mixed-integer program of {exact.n_columns:,} pairs is too large (at most "
            f"{_MOST_PAIRS:,}); a coarser grid of costs or a lower ",
            Argument("cost_cap"),
            " makes it less",
        )
    process = relaxed = exact.explicit()
    free = np.zeros(process.n_states, dtype=np.bool_)
    if exact.charge is None:
        labelled = cast("CompiledExplicit", exact)
        merged = _merged_nodes(cast("FailureLabelled", labelled.augmented).quotient)
        free[: len(merged)] = merged

        def measure(choice: IntArray) -> list[Column]:
            """A choice, measured."""
            return [labelled.explicit_pricing.measure(choice.astype(np.int32))]

    else:
        layered = cast("CompiledAccumulatedCost", exact)
        base, cap, pricing = layered.base, layered.layers, layered.pricing()
        beyond = np.arange((base.width - 1) * base.n_nodes) + cap * base.n_nodes
        free[: cap * base.n_nodes] = np.tile(_merged_nodes(base.quotient), cap)
        free[beyond] = True
        relaxed = _with_loose_tails(process, layered.process, beyond)

        def measure(choice: IntArray) -> list[Column]:
            """A choice followed by the tails of each price, measured."""
            within = choice[: cap * base.n_nodes].reshape(cap, base.n_nodes)
            shift = np.arange(cap)[:, None] * len(base.gain) + base.pair_offsets[:-1]
            tails = (price, 0.0, _ENDLESS * (1.0 + price))
            return [pricing.measure((within - shift).astype(np.int32), tail) for tail in tails]

    return _DeterministicRelaxation(
        compiled=exact,
        process=process,
        relaxed=relaxed,
        may_randomise=free & _reached_states(process),
        fallback=exact.explicit_choice(exact.pricing().minimise(price)),
        measure=measure,
    )


def _with_loose_tails(
    process: ExplicitProcess, layered: LayeredProcess, beyond: IntArray
) -> ExplicitProcess:
    """Relax tails of deterministic policies to the greatest and least success at the cost paid.

    Every success from accumulated cost r on costs at least ``r * E[gamma^(T-1); goal]``, and its
    probability lies between the two: their mixtures are no dearer than any policy.
    """
    base, tails = layered.base, layered.tails
    n_layers = base.width - 1
    first = process.pair_offsets[beyond]
    last = process.pair_offsets[beyond + 1] - 1
    paid = np.repeat(layered.cap + np.arange(n_layers), base.n_nodes) * base.unit / base.survival
    cost, goal, failure = process.cost.copy(), process.goal.copy(), process.failure.copy()
    for pairs, success in ((first, tails.greatest_goal), (last, tails.least_goal)):
        share = np.tile(np.clip(success, 0.0, 1.0), n_layers)
        cost[pairs], goal[pairs], failure[pairs] = paid * share, share, 1.0 - share
    return replace(process, cost=cost, goal=goal, failure=failure)


def _merged_nodes(quotient: Quotient) -> BoolArray:
    """Nodes that stand for several states, where a deterministic policy is relaxed, [nodes]."""
    members = np.bincount(quotient.node_of[quotient.merged], minlength=quotient.n_nodes)
    return np.asarray(members > 1)


def _reached_states(process: ExplicitProcess) -> BoolArray:
    """States of a process to which a path leads from its start, [states]."""
    rows, start = process.transitions, np.flatnonzero(process.start > 0)
    return reached_along(rows.indices, rows.indptr[process.pair_offsets], start)


_LEAST_GAP = 1e-10

_OPTIONS: HighsOptions = {
    "mip_abs_gap": _LEAST_GAP,
    "mip_feasibility_tolerance": 1e-9,
    "primal_feasibility_tolerance": 1e-9,
    "dual_feasibility_tolerance": 1e-9,
}

_OVER = {highspy.HighsModelStatus.kInfeasible, highspy.HighsModelStatus.kUnboundedOrInfeasible}


def _has_time(solver: highspy.Highs, cost: FloatArray, deadline: float) -> bool:
    """Give HiGHS the integer program's first costs and the time left, if there is any."""
    left = deadline - time.perf_counter()
    if left <= 0.0:
        return False
    solver.setOptionValue("time_limit", solver.getRunTime() + min(left, 1e9))
    solver.changeColsCost(cost.size, np.arange(cost.size, dtype=np.int32), cost)
    return True


@dataclass(frozen=True, eq=False)
class _IntegerAnswer:
    """What HiGHS says; nothing in it is trusted but the bound."""

    x: FloatArray | None  # [pairs] None: no policy was found
    choice: IntArray | None  # [states]
    bound: float  # of <cost, x>; infinite where there is no policy
    finished: bool


class _IntegerProgram:
    """The mixed-integer program of a process, from which policies can be excluded one by one."""

    def __init__(
        self,
        process: ExplicitProcess,
        budget: float,
        visits: FloatArray,
        free: BoolArray,
        gap: float,
    ) -> None:
        """State the program.

        Args:
            process: the process.
            budget: failure budget.
            visits: upper bounds of the expected visits, [states]; 0: out of reach.
            free: states that may randomise, [states].
            gap: relative gap at which to stop.
        """
        self.process, self.free = process, free
        decided = (np.diff(process.pair_offsets) > 1) & (visits > 0.0) & ~free
        self.pairs = np.flatnonzero(decided[process.pair_state])
        base = rows_program(process, {FAILURE_ROW: (process.failure, budget)}, ratio=False)
        state, n_y = process.pair_state[self.pairs], self.pairs.size
        picks, group = np.unique(state, return_inverse=True)
        each, one = np.arange(n_y), np.ones(n_y)
        taken = sp.csr_array((one, (each, self.pairs)), shape=(n_y, process.n_pairs))
        linked = sp.csr_array((-visits[state], (each, each)), shape=(n_y, n_y))
        single = sp.csr_array((one, (group, each)), shape=(picks.size, n_y))
        left = sp.vstack([base.matrix, taken, sp.csr_array((picks.size, process.n_pairs))])
        right = sp.vstack([sp.csr_array((base.matrix.shape[0], n_y)), linked, single])
        stated = LinearProgram(  # the rows of y below those of the occupation measure
            cost=np.append(process.cost, np.zeros(n_y)),
            matrix=sp.csc_array(sp.hstack([left, right])),
            lower=np.concatenate([base.lower, np.full(n_y, -np.inf), np.ones(picks.size)]),
            upper=np.concatenate([base.upper, np.zeros(n_y), np.ones(picks.size)]),
            rows=base.rows,
        )
        lp = highs_lp(stated)
        upper = np.where(visits > 0.0, highspy.kHighsInf, 0.0)[process.pair_state]
        lp.col_upper_ = np.append(upper, np.ones(self.pairs.size))
        lp.integrality_ = [highspy.HighsVarType.kContinuous] * process.n_pairs + [
            highspy.HighsVarType.kInteger
        ] * self.pairs.size
        self._solver = highs_solver(lp, {**_OPTIONS, "mip_rel_gap": gap})

    def forbid(self, pairs: IntArray) -> None:
        """Exclude all policies that take these pairs, one for each state that they reach."""
        position = np.flatnonzero(np.isin(self.pairs, pairs))
        columns = (self.process.n_pairs + position).astype(np.int32)
        most = float(position.size) - 1.0
        self._solver.addRow(-highspy.kHighsInf, most, position.size, columns, np.ones(columns.size))

    def solve(self, cost: FloatArray, deadline: float) -> _IntegerAnswer:
        """Minimise a cost of the pairs, [pairs], until the deadline of ``time.perf_counter``."""
        solver, n = self._solver, self.process.n_pairs
        if not _has_time(solver, cost, deadline):
            return _IntegerAnswer(None, None, -np.inf, finished=False)
        run_highs(solver)
        status, info = solver.getModelStatus(), solver.getInfo()
        if status in _OVER:
            return _IntegerAnswer(None, None, np.inf, finished=True)
        finished = status == highspy.HighsModelStatus.kOptimal
        bound = float(info.mip_dual_bound)
        if info.primal_solution_status != highspy.SolutionStatus.kSolutionStatusFeasible:
            return _IntegerAnswer(None, None, bound, finished=False)
        values = np.asarray(solver.getSolution().col_value, dtype=np.float64)
        weight = values[:n].copy()
        weight[self.pairs] = values[n:]
        # the pair of greatest y, or of greatest x where there is no y
        order = np.lexsort((weight, self.process.pair_state))
        choice = order[self.process.pair_offsets[1:] - 1]
        return _IntegerAnswer(values[:n], choice, bound, finished)


_MARGIN = 1e-6
"""Relative room above the optimum of a linear program, a thousand times HiGHS's tolerances."""

_ROOM = 1e-9  # relative, in the rows that say which policies count
_EACH = 400  # states up to which each gets a program of its own


def most_visits(
    process: ExplicitProcess, budget: float, most: float, ratio: float, deadline: float
) -> FloatArray | None:
    """Bound the visits that an integer program allows each state, over all policies, [states].

    States out of reach get 0. Where no state can be visited twice all others get 1. Else one
    linear program finds the greatest expected number of visits of all states together, and, where
    there are few states, one more for each state the greatest number of its own visits. They are
    finite: what costs nothing and could go on for ever has been collapsed in the process, so that
    a limited cost limits the visits.

    Args:
        process: the process; policies may be randomised.
        budget: of failure.
        most: ``<cost - ratio * goal, x>`` of a policy that is as good as a known one.
        ratio: what success earns; 0 in case M.
        deadline: on the clock of ``time.perf_counter``.

    Returns:
        None where time ran out.

    Raises:
        SolverError: a program has no optimum.
    """
    rows, reached = process.transitions, _reached_states(process)
    waits = rows.indices == np.repeat(process.pair_state, np.diff(rows.indptr))
    once = float(process.start.sum()) * (1.0 + _MARGIN)
    if process.dynamics.components.largest <= 1 and not waits.any():
        return np.where(reached, once, 0.0)
    room = most + _ROOM * (1.0 + abs(most))
    limits = {
        FAILURE_ROW: (process.failure, budget + _ROOM),
        "value": (process.cost - ratio * process.goal, room),
    }
    lp = highs_lp(rows_program(process, limits, ratio=False))
    lp.sense_ = highspy.ObjSense.kMaximize
    solver = highs_solver(lp, {})

    def greatest(counted: FloatArray) -> float | None:
        """The greatest expected number of counted steps, with a margin; None: time ran out."""
        if not _has_time(solver, counted, deadline):
            return None
        run_highs(solver)
        status = solver.getModelStatus()
        if status == highspy.HighsModelStatus.kTimeLimit:
            return None
        if status != highspy.HighsModelStatus.kOptimal:
            raise SolverError(f"the visits have no bound: {solver.modelStatusToString(status)}")
        return float(solver.getInfo().objective_function_value) * (1.0 + _MARGIN) + _MARGIN

    total = greatest(np.ones(process.n_pairs))
    if total is None:
        return None
    visits = np.where(reached, total, 0.0)
    decided = np.flatnonzero(reached & (np.diff(process.pair_offsets) > 1))
    for state in decided if decided.size <= _EACH else ():
        own = greatest((process.pair_state == state).astype(np.float64))
        if own is None:
            return visits
        visits[state] = min(own, total)
    return visits
