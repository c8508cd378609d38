"""Upper bounds on the expected visits of states, by linear programs over all policies."""

from __future__ import annotations

import time
from dataclasses import dataclass

import highspy
import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from ssp_lp.arrays import BoolArray, FloatArray
from ssp_lp.errors import SolverError
from ssp_lp.linear_programming.highs import highs_lp
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.programs.program_rows import occupation_program

_MARGIN = 1e-6
"""Relative room above the optimum of a linear program, a thousand times HiGHS's tolerances."""

_ROOM = 1e-9  # relative, in the rows that say which policies count
_EACH = 400  # states up to which each gets a program of its own


@dataclass(frozen=True)
class Limit:
    """Which policies count: ``<failure, x> <= budget`` and ``<cost - ratio * goal, x> <= most``."""

    budget: float
    most: float
    ratio: float = 0.0


def most_visits(process: ExplicitProcess, limit: Limit, deadline: float) -> FloatArray | None:
    """Bound the expected visits of each state over all policies within a limit, [states].

    States out of reach get 0. Where no state can be visited twice all others get 1. Else one
    linear program finds the greatest expected number of visits of all states together, and, where
    there are few states, one more for each state the greatest number of its own visits. They are
    finite: what costs nothing and could go on for ever has been collapsed in the process, so that
    a limited cost limits the visits.

    Args:
        process: the process; policies may be randomised.
        limit: of failure and cost; the cost of a policy at least as good as a known one.
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
    solver = _prepared(process, limit)
    total = _greatest(solver, np.ones(process.n_pairs), deadline)
    if total is None:
        return None
    most = np.where(reached, total, 0.0)
    decided = np.flatnonzero(reached & (np.diff(process.pair_offsets) > 1))
    for state in decided if decided.size <= _EACH else ():
        own = _greatest(solver, (process.pair_state == state).astype(np.float64), deadline)
        if own is None:
            return most
        most[state] = min(own, total)
    return most


def within_reach(steps: sp.csr_array, start: BoolArray) -> BoolArray:
    """States to which a path leads, the first ones included, [states]."""
    n = len(start)
    first = sp.csr_array(start.astype(np.float64)[None, :])
    below = sp.vstack([steps, first])
    graph = sp.csr_array(sp.hstack([below, sp.csr_array((n + 1, 1))]))
    order = csgraph.breadth_first_order(graph, n, return_predecessors=False)
    reached = np.zeros(n + 1, dtype=np.bool_)
    reached[order] = True
    return reached[:n]


def steps_between(process: ExplicitProcess) -> sp.csr_array:
    """Steps between states by whatever pair, [states, states]."""
    of_state = sp.csr_array(
        (np.ones(process.n_pairs), np.arange(process.n_pairs), process.pair_offsets),
        shape=(process.n_states, process.n_pairs),
    )
    graph = sp.csr_array(of_state @ process.transitions)
    graph.eliminate_zeros()
    return graph


def _prepared(process: ExplicitProcess, limit: Limit) -> highspy.Highs:
    """The policies within the limit, as a program whose objective is still to be said."""
    program = occupation_program(process, limit.budget + _ROOM, ratio=False)
    lp = highs_lp(program)
    lp.sense_ = highspy.ObjSense.kMaximize
    solver = highspy.Highs()  # type: ignore[no-untyped-call]
    for name, value in {"output_flag": False, "threads": 1}.items():
        if solver.setOptionValue(name, value) != highspy.HighsStatus.kOk:
            raise SolverError(f"HiGHS refuses the option {name}={value!r}")
    if solver.passModel(lp) == highspy.HighsStatus.kError:
        raise SolverError("HiGHS refuses the linear program")
    row = process.cost - limit.ratio * process.goal
    filled = np.flatnonzero(row).astype(np.int32)
    most = limit.most + _ROOM * (1.0 + abs(limit.most))
    solver.addRow(-highspy.kHighsInf, most, filled.size, filled, row[filled])
    return solver


def _greatest(solver: highspy.Highs, counted: FloatArray, deadline: float) -> float | None:
    """The greatest expected number of counted steps, with a margin; None: out of time."""
    left = deadline - time.perf_counter()
    if left <= 0.0:
        return None
    solver.setOptionValue("time_limit", solver.getRunTime() + min(left, 1e9))
    solver.changeColsCost(counted.size, np.arange(counted.size, dtype=np.int32), counted)
    solver.run()
    status = solver.getModelStatus()
    if status == highspy.HighsModelStatus.kTimeLimit:
        return None
    if status != highspy.HighsModelStatus.kOptimal:
        raise SolverError(f"the visits have no bound: {solver.modelStatusToString(status)}")
    return float(solver.getInfo().objective_function_value) * (1.0 + _MARGIN) + _MARGIN
