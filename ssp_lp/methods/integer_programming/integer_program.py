"""The mixed-integer program of a single deterministic policy, by HiGHS.

    minimise    <cost, x>
    subject to  outflow(x) - inflow(x) = start,   <failure, x> <= budget,   x >= 0
                x_pair <= visits_state * y_pair,  sum over a state's pairs of y = 1,  y binary

A state without a choice, and one that is left free, has no y.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import highspy
import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.errors import SolverError
from ssp_lp.linear_programming.highs import HighsOptions, highs_lp, highs_solver, run_highs
from ssp_lp.linear_programming.linear_program import LinearProgram
from ssp_lp.methods.integer_programming.process_view import steps_between, within_reach
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.processes.quantities.conditions import FAILURE_ROW
from ssp_lp.programs.program_rows import rows_program

_LEAST_GAP = 1e-10
_POLL = 0.1  # seconds between two looks at whether HiGHS has ended

_OPTIONS: HighsOptions = {
    "mip_rel_gap": _LEAST_GAP,
    "mip_abs_gap": _LEAST_GAP,
    "mip_feasibility_tolerance": 1e-9,
    "primal_feasibility_tolerance": 1e-9,
    "dual_feasibility_tolerance": 1e-9,
}

_OVER = {
    highspy.HighsModelStatus.kInfeasible,
    highspy.HighsModelStatus.kUnboundedOrInfeasible,
}


def _run_integer_program(solver: highspy.Highs) -> None:
    """Run HiGHS beside this thread, which so hears of Ctrl-C and ends it."""
    solver.startSolve()
    try:
        while not solver.wait(_POLL)[0]:
            pass
    except KeyboardInterrupt:
        solver.cancelSolve()  # type: ignore[no-untyped-call]
        solver.wait()
        raise


@dataclass(frozen=True, eq=False)
class IntegerAnswer:
    """What HiGHS says; nothing in it is trusted but the bound."""

    x: FloatArray | None  # [pairs] None: no policy was found
    choice: IntArray | None  # [states]
    bound: float  # of <cost, x>; infinite where there is no policy
    finished: bool


class IntegerProgram:
    """The mixed-integer program of a process, from which policies can be excluded one by one."""

    def __init__(
        self, process: ExplicitProcess, budget: float, visits: FloatArray, free: BoolArray
    ) -> None:
        """State the program.

        Args:
            process: the process.
            budget: failure budget.
            visits: upper bounds of the expected visits, [states]; 0: out of reach.
            free: states that may randomise, [states].
        """
        self.process = process
        decided = (np.diff(process.pair_offsets) > 1) & (visits > 0.0) & ~free
        self.pairs = np.flatnonzero(decided[process.pair_state])
        lp = highs_lp(self._stated(budget, visits))
        upper = np.where(visits > 0.0, highspy.kHighsInf, 0.0)[process.pair_state]
        lp.col_upper_ = np.append(upper, np.ones(self.pairs.size))
        lp.integrality_ = [highspy.HighsVarType.kContinuous] * process.n_pairs + [
            highspy.HighsVarType.kInteger
        ] * self.pairs.size
        self._solver = highs_solver(lp, _OPTIONS)
        self._solver.HandleUserInterrupt = True

    def _stated(self, budget: float, visits: FloatArray) -> LinearProgram:
        """The occupation-measure program with the rows of y below it."""
        process, n_y = self.process, self.pairs.size
        base = rows_program(process, {FAILURE_ROW: (process.failure, budget)}, ratio=False)
        state = process.pair_state[self.pairs]
        picks, group = np.unique(state, return_inverse=True)
        each, one = np.arange(n_y), np.ones(n_y)
        taken = sp.csr_array((one, (each, self.pairs)), shape=(n_y, process.n_pairs))
        linked = sp.csr_array((-visits[state], (each, each)), shape=(n_y, n_y))
        single = sp.csr_array((one, (group, each)), shape=(picks.size, n_y))
        left = sp.vstack([base.matrix, taken, sp.csr_array((picks.size, process.n_pairs))])
        right = sp.vstack([sp.csr_array((base.matrix.shape[0], n_y)), linked, single])
        return LinearProgram(
            cost=np.append(process.cost, np.zeros(n_y)),
            matrix=sp.csc_array(sp.hstack([left, right])),
            lower=np.concatenate([base.lower, np.full(n_y, -np.inf), np.ones(picks.size)]),
            upper=np.concatenate([base.upper, np.zeros(n_y), np.ones(picks.size)]),
            rows=base.rows,
        )

    def forbid(self, choice: IntArray, reached: BoolArray) -> None:
        """Exclude all policies that agree with a choice in the states that it reaches."""
        position = np.flatnonzero(np.isin(self.pairs, choice[reached]))
        columns = (self.process.n_pairs + position).astype(np.int32)
        most = float(position.size) - 1.0
        self._solver.addRow(-highspy.kHighsInf, most, position.size, columns, np.ones(columns.size))

    def stop_at(self, tolerance: float) -> None:
        """Stop at a relative gap."""
        self._solver.setOptionValue("mip_rel_gap", max(tolerance, _LEAST_GAP))

    def start_at(self, x: FloatArray, choice: IntArray) -> None:
        """Tell HiGHS of a policy with which to begin."""
        given = highspy.HighsSolution()
        given.col_value = np.append(x, np.isin(self.pairs, choice)).tolist()
        self._solver.setSolution(given)

    def solve(self, cost: FloatArray, deadline: float) -> IntegerAnswer:
        """Minimise a cost of the pairs, [pairs], until the deadline of ``time.perf_counter``."""
        left = deadline - time.perf_counter()
        if left <= 0.0:
            return IntegerAnswer(None, None, -np.inf, finished=False)
        solver, n = self._solver, self.process.n_pairs
        solver.setOptionValue("time_limit", solver.getRunTime() + min(left, 1e9))
        solver.changeColsCost(n, np.arange(n, dtype=np.int32), cost)
        _run_integer_program(solver)
        status, info = solver.getModelStatus(), solver.getInfo()
        if status in _OVER:
            return IntegerAnswer(None, None, np.inf, finished=True)
        finished = status == highspy.HighsModelStatus.kOptimal
        bound = float(info.mip_dual_bound)
        if info.primal_solution_status != highspy.SolutionStatus.kSolutionStatusFeasible:
            return IntegerAnswer(None, None, bound, finished=False)
        values = np.asarray(solver.getSolution().col_value, dtype=np.float64)
        return IntegerAnswer(values[:n], self._choice(values), bound, finished)

    def _choice(self, values: FloatArray) -> IntArray:
        """The pair of greatest y, or of greatest x where there is no y, [states]."""
        n = self.process.n_pairs
        weight = values[:n].copy()
        weight[self.pairs] = values[n:]
        order = np.lexsort((weight, self.process.pair_state))
        return order[self.process.pair_offsets[1:] - 1]


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
    steps = steps_between(process)
    reached = within_reach(steps, process.start > 0)
    once = float(process.start.sum()) * (1.0 + _MARGIN)
    n_parts, _ = csgraph.connected_components(steps, directed=True, connection="strong")
    if n_parts == process.n_states and not steps.diagonal().any():
        return np.where(reached, once, 0.0)
    solver = _prepared_integer_program(process, budget, most, ratio)
    total = _greatest_by_integers(solver, np.ones(process.n_pairs), deadline)
    if total is None:
        return None
    visits = np.where(reached, total, 0.0)
    decided = np.flatnonzero(reached & (np.diff(process.pair_offsets) > 1))
    for state in decided if decided.size <= _EACH else ():
        own = _greatest_by_integers(
            solver, (process.pair_state == state).astype(np.float64), deadline
        )
        if own is None:
            return visits
        visits[state] = min(own, total)
    return visits


def _prepared_integer_program(
    process: ExplicitProcess, budget: float, most: float, ratio: float
) -> highspy.Highs:
    """The policies within the limit, as a program whose objective is still to be said."""
    limits = {FAILURE_ROW: (process.failure, budget + _ROOM)}
    program = rows_program(process, limits, ratio=False)
    lp = highs_lp(program)
    lp.sense_ = highspy.ObjSense.kMaximize
    solver = highs_solver(lp, {})
    row = process.cost - ratio * process.goal
    filled = np.flatnonzero(row).astype(np.int32)
    room = _ROOM * (1.0 + abs(most))
    solver.addRow(-highspy.kHighsInf, most + room, filled.size, filled, row[filled])
    return solver


def _greatest_by_integers(
    solver: highspy.Highs, counted: FloatArray, deadline: float
) -> float | None:
    """For the integer program, the greatest expected number of counted steps, with a margin."""
    left = deadline - time.perf_counter()
    if left <= 0.0:
        return None
    solver.setOptionValue("time_limit", solver.getRunTime() + min(left, 1e9))
    solver.changeColsCost(counted.size, np.arange(counted.size, dtype=np.int32), counted)
    run_highs(solver)
    status = solver.getModelStatus()
    if status == highspy.HighsModelStatus.kTimeLimit:
        return None
    if status != highspy.HighsModelStatus.kOptimal:
        raise SolverError(f"the visits have no bound: {solver.modelStatusToString(status)}")
    return float(solver.getInfo().objective_function_value) * (1.0 + _MARGIN) + _MARGIN
