"""The constrained occupation-measure program that every formulation compiles to.

    minimise    <cost, x>                     (case S: <cost, x> / <goal, x>)
    subject to  outflow(x) - inflow(x) = start
                <failure, x> <= budget
                <row_k, x> <= bound_k                 (any number of secondary costs, by name)
                x >= 0

x counts the expected visits of each pair of the process. The ratio of case S becomes linear by
Charnes and Cooper's scaling: x and the start are scaled by t >= 0 so that <goal, x> = 1, and the
failure row becomes <failure, x> - budget * t <= 0, every other one likewise. The normalising row
then has the only nonzero right side, so that its dual is c*.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import FloatArray
from ssp_lp.compiled.deadline import check_time, pieces
from ssp_lp.linear_programming.linear_program import LinearProgram
from ssp_lp.processes.explicit_process import ExplicitProcess


def rows_program(
    process: ExplicitProcess, limits: Mapping[str, tuple[FloatArray, float]], ratio: bool
) -> LinearProgram:
    """The occupation program of a process with any named program rows.

    Args:
        process: the substochastic process.
        limits: name -> (coefficient of each pair, [pairs], and bound).
        ratio: case S, the objective <cost, x> / <goal, x>; the last column is then t.
    """
    n_states, n_pairs, n_limits = process.n_states, process.n_pairs, len(limits)
    bounds, free = np.array([bound for _, bound in limits.values()]), np.full(n_limits, -np.inf)
    cost, upper = process.cost, np.concatenate([process.start, bounds])
    lower = np.concatenate([process.start, free])
    places = {name: slice(n_states + k, n_states + k + 1) for k, name in enumerate(limits)}
    rows = {"balance": slice(0, n_states)} | places
    taken = [row for row, _ in limits.values()]
    if ratio:
        taken, last = [*taken, process.goal], n_states + n_limits
        rows["normaliser"] = slice(last, last + 1)
    # a column of the program for each pair, gathered as rows of the transposed matrix
    columns = list[sp.csr_array]()
    for some in pieces(n_pairs, process.transitions.nnz):
        count = some.stop - some.start
        place = np.ones(count), process.pair_state[some], np.arange(count + 1)
        balance = sp.csr_array(place, shape=(count, n_states)) - process.transitions[some]
        each = [sp.csr_array(row[some, None]) for row in taken]
        columns.append(sp.csr_array(sp.hstack([balance, *each])) if each else balance)
    if ratio:
        columns.append(sp.csr_array(np.append(-upper, 0.0)[None, :]))
        cost = np.append(cost, 0.0)
        upper = np.append(np.zeros(last), 1.0)
        lower = np.concatenate([np.zeros(n_states), free, [1.0]])
    check_time()
    matrix = sp.csc_array(sp.csr_array(sp.vstack(columns)).T)
    return LinearProgram(cost, matrix, lower, upper, rows)


_ROUNDING = 1e-9  # of the greatest coefficient: a solver's tolerance


@dataclass(frozen=True, eq=False)
class ProgramRow:
    """``<coefficients, x> <= bound``: a quantity of the visits and how much of it is allowed."""

    name: str
    coefficients: FloatArray  # [pairs]
    bound: float
    words: str  # what is bounded

    @property
    def largest(self) -> float:
        """Size of the program row's greatest coefficient."""
        return float(np.abs(self.coefficients).max(initial=0.0))

    @property
    def scale(self) -> float:
        """Scale of a program row: its bound, or its greatest coefficient."""
        return max(abs(self.bound), self.largest)

    def violation(self, activity: float) -> float:
        """Violation of a program row by an activity, relative to the bound; 0 if kept.

        What is nothing beside the coefficients is excused.
        """
        excused = _ROUNDING * self.largest
        left = max(activity - self.bound - excused, 0.0)
        return left / max(abs(self.bound), excused, 1e-300) if left else 0.0
