"""The best deterministic policy, for a controller without a lottery.

The best lottery attains c*; the best deterministic policy within the budget may cost more. It is
found by a mixed-integer program over the states of the process (case S: state and accumulated
cost). x counts expected visits; a binary y per pair selects the pair of each state:

    x_pair <= V_state * y_pair,   sum over the pairs of a state of y = 1.

**The bound V on visits** is the greatest expected number of visits of the state over all policies,
also randomised ones, that satisfy the budget and cost no more than the best known policy. It takes
a linear program for each state (one for all states together if there are many), and is 1 if no
state can be visited twice. It excludes no better policy. It is finite because free end components
are collapsed in the process, and at most 1 / (1 - discount) under a discount. V includes a margin
for rounding, so that a solution that attains it needs no second try with a larger V.

The ratio of case S is minimised by Dinkelbach's iteration. Every policy is read off y and evaluated
exactly on the process; one that satisfies the budget only within HiGHS's tolerances is refused and
excluded by a further row. The lower bound is the better of two bounds: the bound of the lottery,
and HiGHS's dual bound, which is lowered by 1e-9 of itself because it is not a checked sub-solution.
If the gap misses the tolerance for this reason, the best policies, whose values are exact, are
excluded one by one, so that HiGHS's bound is needed only for the other policies.

A deterministic optimum is a step function of the budget: it has no price of failure unless the
budget is slack.

The bound holds for two kinds of policies that are not searched, so a gap may remain even without a
time limit: policies whose exit from a collapsed component depends on the entry, and policies that
differ from the tails beyond the cap of case S. HiGHS's bound does not hold for policies with more
memory than the state of the process, which could randomise by observed chance.

States with one pair, and states that may randomise, have no y.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import highspy
import numpy as np
import scipy.sparse as sp

from ssp_lp.accumulated_cost.process import LayeredProcess
from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.column_generation.column import Column, relative_gap
from ssp_lp.column_generation.compiled_layers import CompiledLayered
from ssp_lp.column_generation.compiled_problem import CompiledExplicit, CompiledProblem
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
    from ssp_lp.methods.refinement import Optimum

_OPEN = 1e-6  # relative gap above which the cost of determinism is reported as "at most"
_DUAL = 1e-9  # relative tolerance of HiGHS's bound
_RATIOS = 30  # most steps of Dinkelbach's iteration, which takes a handful
_SPREADS = (1e-6, 0.03, 0.1, 0.3, 1.0, 3.0)  # relative distances from the price, up and down
_SKIPS = 8  # most states skipped between two policies
_REFUSED = 100  # most policies that satisfy the budget only within HiGHS's tolerances
_EXCLUDED = 8  # most policies excluded as equal to the best within HiGHS's tolerances
_ROUNDING = 1e-13
_SMALL = 1e-10  # relative
"""Feasibility tolerance of the budget, since failure may be summed in another order."""


def best_deterministic(
    mixed: Solution, outcome: Optimum[Any], tolerance: float, deadline: float
) -> Solution:
    """Solve for the best deterministic policy, given the best lottery.

    The search begins with the best member of the lottery within the budget, and with policies that
    combine its members. The lower bound of the lottery is the first lower bound.

    Args:
        mixed: the best lottery; its value function is kept.
        outcome: outcome of the search that found it.
        tolerance: relative gap at which to stop.
        deadline: by ``time.perf_counter``.

    Raises:
        ModelError: the process is too large.
    """
    generated, row = outcome.generated, outcome.row
    most = row.budget + min(_ROUNDING, _SMALL * row.budget)
    inside = [column for column in generated.columns if column.failure <= most]
    column = min(inside, key=lambda c: row.objective(c.cost, c.goal))
    value, policy = row.objective(column.cost, column.goal), outcome.compiled.pricing().policy
    incumbent = Answer(policy(column), value, outcome.bound, column.failure)
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
        remarks.append("stopped before the search was finished; the gap is still certified")
    if finished and gap > max(_OPEN, 2.0 * tolerance):
        remarks.append("the gap bounds the gain of policies outside the search")
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
    """A search for the best deterministic policy. Mutable: ``best`` improves."""

    outcome: Optimum[Any]  # outcome of the search for the best lottery
    most: float  # the budget plus a tolerance for rounding
    best: Answer  # the incumbent; its bound holds for every policy
    tolerance: float  # relative
    deadline: float
    refused: int = 0

    @cached_property
    def relaxation(self) -> _DeterministicRelaxation:
        """The explicit process, with its relaxation."""
        return deterministic_relaxation(self.outcome.compiled, self.outcome.kappa)

    def run(self) -> bool:
        """Search by walks and integer programs; return whether the search was finished."""
        relaxation, bound = self.relaxation, self.outcome.bound
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
        """Evaluate a choice, keep it if it is the best; return whether it is within the budget."""
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
        """Evaluate policies between two optimal ones, as close to the budget as possible.

        Two policies that are optimal at prices just below and above the lottery's price are both
        optimal at it. So is every policy that follows one in some states and the other elsewhere:
        among these, the policy of largest failure within the budget is cheapest. Policies of prices
        farther away differ in more states.
        """
        compiled, price = self.relaxation.compiled, self.outcome.kappa
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
        """Switch states from one policy to another within the budget, in order, by bisection.

        Args:
            safe: a choice within the budget, [states].
            risky: another choice, [states].
            order: the states in which they differ.
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
        """Return a lower bound of deterministic policies by integer programs; whether they ended.

        Case S uses Dinkelbach's iteration. If ``cost - c * goal >= D`` for every policy within the
        budget, then ``cost / goal >= c + D / (1 - budget)`` for D < 0.

        Args:
            process: the process.
            free: states that may randomise, so that solutions are not deterministic, [states].
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
            return 0.0, True  # no decisions: the lottery's bound remains
        bound, excluded = 0.0, 0
        for _ in range(_RATIOS):
            answer = self._solved_without_refused(program, process.cost - ratio * process.goal)
            least = answer.bound
            if np.isfinite(least):
                least -= _DUAL * (1.0 + abs(least))
                if row.ratio:
                    beyond = least / share if share > 0.0 else -np.inf
                    least = ratio if least >= 0.0 else max(ratio + beyond, 0.0)
            bound = max(bound, min(least, self.best.value))  # excluded policies have no lower value
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
        """Solve the integer program, excluding policies that violate the budget when evaluated."""
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
    """Return a choice with the pairs of another one in some states, [states]."""
    mixed = choice.copy()
    mixed[states] = other[states]
    return mixed


_MOST_PAIRS = 500_000
_ENDLESS = 1e9  # price of failure, relative to 1 + the optimal one, at which no tail gives up


@dataclass(frozen=True, eq=False)
class _DeterministicRelaxation:
    """A process, and a relaxation that contains all its deterministic policies.

    The exit of a deterministic policy from a collapsed component may depend on the entry, and the
    policy may differ from the tails beyond the cap of case S. ``relaxed`` allows for both. Some
    states ``may_randomise``. Beyond the cap any success probability that some policy attains is
    allowed, and success costs only the amount paid at the cap.
    """

    compiled: CompiledProblem
    process: ExplicitProcess
    relaxed: ExplicitProcess
    may_randomise: BoolArray  # [states] reachable from the start
    fallback: IntArray  # [states] pairs of a policy that leaves from every state
    measure: Callable[[IntArray], list[Column]]  # evaluates the policies of a choice exactly

    def completed(self, choice: IntArray) -> tuple[IntArray | None, BoolArray]:
        """Return the choice, with ``fallback`` in unreached states; None if it may never leave."""
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
    """Build a process explicitly, with its relaxation for deterministic policies.

    Args:
        compiled: a problem of case M or S.
        price: price of failure of the best lottery.

    Raises:
        ModelError: there are too many pairs.
    """
    exact = compiled.for_program()
    if exact.n_columns > _MOST_PAIRS:
        raise ModelError(
            Argument("method", "deterministic"),
            f": a mixed-integer program of {exact.n_columns:,} pairs is too large (at most "
            f"{_MOST_PAIRS:,}): set a lower ",
            Argument("cost_cap"),
            ", or use a coarser grid of costs",
        )
    process = relaxed = exact.explicit()
    free = np.zeros(process.n_states, dtype=np.bool_)
    if exact.charge is None:
        labelled = cast("CompiledExplicit", exact)
        merged = _merged_nodes(cast("FailureLabelled", labelled.augmented).quotient)
        free[: len(merged)] = merged

        def measure(choice: IntArray) -> list[Column]:
            """Evaluate a choice."""
            return [labelled.explicit_pricing.measure(choice.astype(np.int32))]

    else:
        layered = cast("CompiledLayered", exact)
        base, cap, pricing = layered.layer.base, layered.layers, layered.pricing()
        beyond = np.arange((base.width - 1) * base.n_nodes) + cap * base.n_nodes
        free[: cap * base.n_nodes] = np.tile(_merged_nodes(base.quotient), cap)
        free[beyond] = True
        relaxed = _with_loose_tails(process, layered.process, beyond)

        def measure(choice: IntArray) -> list[Column]:
            """Evaluate the decisions below the cap, followed by the tails of three prices."""
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
    """Return a process whose tails attain the greatest and the least success at the cost paid.

    From accumulated cost r on, success costs at least ``r * E[gamma^(T-1); goal]``, and its
    probability lies between the greatest and the least. So for every policy some mixture of the
    tails costs no more.
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
    """Return a mask of the nodes that stand for several states, [nodes]."""
    members = np.bincount(quotient.node_of[quotient.merged], minlength=quotient.n_nodes)
    return np.asarray(members > 1)


def _reached_states(process: ExplicitProcess) -> BoolArray:
    """Return a mask of the states that are reachable from the start, [states]."""
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
    """Set the costs and the time left in HiGHS; return whether time is left."""
    left = deadline - time.perf_counter()
    if left <= 0.0:
        return False
    solver.setOptionValue("time_limit", solver.getRunTime() + min(left, 1e9))
    solver.changeColsCost(cost.size, np.arange(cost.size, dtype=np.int32), cost)
    return True


@dataclass(frozen=True, eq=False)
class _IntegerAnswer:
    """The answer of HiGHS; only its bound is trusted."""

    x: FloatArray | None  # [pairs] None: no policy was found
    choice: IntArray | None  # [states]
    bound: float  # lower bound of <cost, x>; infinite if there is no policy
    finished: bool


class _IntegerProgram:
    """The mixed-integer program of a process; policies can be excluded one by one."""

    def __init__(
        self,
        process: ExplicitProcess,
        budget: float,
        visits: FloatArray,
        free: BoolArray,
        gap: float,
    ) -> None:
        """Build the program.

        Args:
            process: the process.
            budget: failure budget.
            visits: upper bounds of the expected visits, [states]; 0: unreachable.
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
        """Exclude all policies that take these pairs, one for each state reached."""
        position = np.flatnonzero(np.isin(self.pairs, pairs))
        columns = (self.process.n_pairs + position).astype(np.int32)
        most = float(position.size) - 1.0
        self._solver.addRow(-highspy.kHighsInf, most, position.size, columns, np.ones(columns.size))

    def solve(self, cost: FloatArray, deadline: float) -> _IntegerAnswer:
        """Minimise a cost of the pairs, [pairs], until a deadline by ``time.perf_counter``."""
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
        # the pair of greatest y, or of greatest x without y
        order = np.lexsort((weight, self.process.pair_state))
        choice = order[self.process.pair_offsets[1:] - 1]
        return _IntegerAnswer(values[:n], choice, bound, finished)


_MARGIN = 1e-6
"""Relative margin above the optimum of a linear program, 1000 times HiGHS's tolerances."""

_ROOM = 1e-9  # relative margin of the rows for budget and value
_EACH = 400  # most states with a program each


def most_visits(
    process: ExplicitProcess, budget: float, most: float, ratio: float, deadline: float
) -> FloatArray | None:
    """Return an upper bound of the expected visits of each state over all policies, [states].

    Unreachable states get 0. If no state can be visited twice, all others get 1. Otherwise one
    linear program finds the greatest expected number of visits of all states together and, if
    there are few states, a further program for each state finds its own greatest number. These are
    finite: free end components are collapsed in the process, so that a limited cost limits the
    visits.

    Args:
        process: the process; policies may be randomised.
        budget: of failure.
        most: largest ``<cost - ratio * goal, x>``: the value of a known policy.
        ratio: reward of success; 0 in case M.
        deadline: by ``time.perf_counter``.

    Returns:
        The bounds; None if the time ran out.

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
        """Return the greatest expected number of counted steps, with a margin; None: no time."""
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
