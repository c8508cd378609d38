"""The master program of column generation with several rows: a tiny program over known policies.

    minimise    sum_j w_j cost_j  (+ sum_k e_k)
    subject to  sum_j w_j (activity_kj - bound_k) (- scale_k e_k) <= 0
                sum_j w_j = 1,   w, e >= 0

As the weights sum to one, bounds are subtracted from the activities: what tells policies near a
bound apart is not lost in the size of the bound. With ``elastic`` the e_k measure by how much rows
are violated, in units of their scales, and costs are left out (phase 1). HiGHS's simplex method
finds an optimal basis; weights and prices are then recomputed from it by dense solves, and a few
simplex steps repair what HiGHS's tolerances let pass.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import MACHINE_EPSILON, FloatArray, IntArray
from ssp_lp.errors import SolverError
from ssp_lp.linear_programming.linear_program import LinearProgram

_OPTIONS: dict[str, bool | int | float | str] = {
    "presolve": "off",
    "solver": "simplex",
    "primal_feasibility_tolerance": 1e-10,
    "dual_feasibility_tolerance": 1e-10,
}
_NEGATIVE = 1e-14
"""A basic weight this far below 0 is the rounding of a 0."""

_BROKEN = 4.0 * MACHINE_EPSILON
"""A row that is violated by so much of its scale is met but for rounding."""

_TIED = 1e-14  # of the numbers that a reduced cost is made of: then it is 0
_PIVOT = 1e-13  # of the numbers that an entry is made of: then it is 0
_PIVOTS = 50
_LARGEST = (
    1e9  # entry that HiGHS is given, to which larger ones are cut: their weight is as good as 0
)


@dataclass(frozen=True, eq=False)
class MasterOptimum:
    """Weights of the policies and prices of the rows; at most (tight rows + 1) weights are > 0."""

    value: float
    weights: FloatArray  # [columns]
    prices: FloatArray  # [rows] >= 0
    excess: FloatArray  # [rows] violation in units of the scales; 0 unless elastic


@dataclass(frozen=True, eq=False)
class _Standard:
    """``minimise cost @ x, matrix @ x == right, x >= 0``: policies, excesses, slacks; scaled."""

    cost: FloatArray  # [variables]
    matrix: FloatArray  # [rows + 1, variables]; the last row says that weights sum to one
    right: FloatArray  # [rows + 1]
    rounding: FloatArray  # [variables] a value so far below 0 is a 0
    noise: FloatArray  # [rows + 1] of an entry, from what it is the difference of


def solve_master(
    cost: FloatArray, activity: FloatArray, bounds: FloatArray, scales: FloatArray, *, elastic: bool
) -> MasterOptimum:
    """Solve the master program.

    Args:
        cost: [columns].
        activity: what each policy takes of each row, [rows, columns].
        bounds: [rows].
        scales: size of each row's numbers, > 0, [rows].
        elastic: minimise the violation instead of the cost.

    Raises:
        SolverError: HiGHS finds no optimum, as where no lottery keeps to the bounds.
    """
    n_rows, n_columns = activity.shape
    top = 0.0 if elastic else float(np.abs(cost).max(initial=0.0))
    unit = top if top > 0.0 else 1.0
    units = scales if elastic else _master_spreads(activity, bounds, scales)
    program = _scaled_master(cost / unit, activity, bounds, scales, units, elastic=elastic)
    x, dual = _from_basis(program, _first_master_basis(program, activity, bounds, scales))
    x, weights = np.maximum(x, 0.0), np.maximum(x[:n_columns], 0.0)
    weights = np.where(weights > _NEGATIVE, weights, 0.0)
    weights = weights / weights.sum()
    excess = x[n_columns : n_columns + n_rows] if elastic else np.zeros(n_rows)
    return MasterOptimum(
        value=float(excess.sum()) if elastic else float(cost @ weights),
        weights=weights,
        prices=unit * np.maximum(-dual[:n_rows], 0.0) / units,
        excess=excess,
    )


def _master_spreads(activity: FloatArray, bounds: FloatArray, scales: FloatArray) -> FloatArray:
    """How far from its bound the policies take each row at most, [rows]."""
    spread = np.abs(activity - bounds[:, None]).max(axis=1, initial=0.0)
    return np.where(spread > MACHINE_EPSILON * scales, spread, scales)


def _scaled_master(
    cost: FloatArray,
    activity: FloatArray,
    bounds: FloatArray,
    scales: FloatArray,
    units: FloatArray,
    *,
    elastic: bool,
) -> _Standard:
    """The master in standard form, its rows divided by their units; elastic: their scales."""
    n_rows, n_columns = activity.shape
    n_excess = n_rows if elastic else 0
    priced = np.zeros(n_columns) if elastic else cost
    beyond = (activity - bounds[:, None]) / units[:, None]
    broken = _BROKEN * scales / units
    return _Standard(
        cost=np.concatenate([priced, np.ones(n_excess), np.zeros(n_rows)]),
        matrix=np.block(
            [
                [beyond, -np.eye(n_rows, n_excess), np.eye(n_rows)],
                [np.ones((1, n_columns)), np.zeros((1, n_excess + n_rows))],
            ]
        ),
        right=np.append(np.zeros(n_rows), 1.0),
        rounding=np.concatenate([np.full(n_columns, _NEGATIVE), broken[:n_excess], broken]),
        noise=np.append(broken, 0.0),
    )


def _first_master_basis(
    program: _Standard, activity: FloatArray, bounds: FloatArray, scales: FloatArray
) -> IntArray:
    """A basis to begin with: HiGHS's, or, where it finds the rows contradictory, of phase 1.

    Policies whose totals differ by no more than HiGHS's tolerances may keep to rows that it takes
    to be violated; the basis of least violation is feasible up to rounding if any is.
    """
    basis = _master_basis(program)
    if basis is not None:
        return basis
    n_rows, n_columns = activity.shape
    elastic = _scaled_master(np.zeros(n_columns), activity, bounds, scales, scales, elastic=True)
    found = _master_basis(elastic)
    if found is None:
        raise SolverError("the master program: HiGHS finds no basis, nor one of least violation")
    kept = [int(v) for v in found if v < n_columns]
    kept += [int(v) - n_rows for v in found if v >= n_columns + n_rows]
    return np.array(_completed_basis(program, kept), dtype=np.int64)


def _master_basis(program: _Standard) -> IntArray | None:
    """Variables of an optimal basis, found by HiGHS, [rows + 1].

    None where HiGHS finds none. No master is unbounded: where numbers far apart make HiGHS say so,
    its last basis is feasible.
    """
    import highspy  # only where there are rows

    from ssp_lp.linear_programming.highs import highs_lp, highs_solver, run_highs

    n_rows, n_variables = program.matrix.shape
    matrix, right = sp.csc_array(np.clip(program.matrix, -_LARGEST, _LARGEST)), program.right
    solver = highs_solver(highs_lp(LinearProgram(program.cost, matrix, right, right, {})), _OPTIONS)
    run_highs(solver)
    status = solver.getModelStatus()
    if status not in (highspy.HighsModelStatus.kOptimal, highspy.HighsModelStatus.kUnbounded):
        return None
    basic = highspy.HighsBasisStatus.kBasic
    basis = solver.getBasis()
    found = [i for i, state in enumerate(basis.col_status) if state == basic]
    first_slack = n_variables - (n_rows - 1)
    found += [first_slack + k for k, s in enumerate(basis.row_status[:-1]) if s == basic]
    return np.array(_completed_basis(program, found), dtype=np.int64)


def _completed_basis(program: _Standard, found: list[int]) -> list[int]:
    """A basis; a policy stands for the last row's own variable where HiGHS keeps that basic."""
    n_rows, n_variables = program.matrix.shape
    chosen = list(found)
    for variable in range(n_variables - 1, -1, -1):
        if len(chosen) == n_rows:
            break
        if variable in chosen:
            continue
        wider = program.matrix[:, [*chosen, variable]]
        if np.linalg.matrix_rank(wider) == len(chosen) + 1:
            chosen.append(variable)
    return chosen


def _from_basis(program: _Standard, basis: IntArray) -> tuple[FloatArray, FloatArray]:
    """Values of the master's variables and duals of its rows, by dense solves with the basis.

    HiGHS's tolerances are relative to the dearest policy: where a value or a reduced cost is
    negative beyond rounding, steps of the dual or of the primal simplex method repair it.
    """
    basis = basis.copy()
    for _ in range(_PIVOTS):
        square = program.matrix[:, basis]
        values, dual = (
            _refined_solution(square, program.right),
            _refined_solution(square.T, program.cost[basis]),
        )
        reduced = program.cost - dual @ program.matrix
        reduced[basis] = 0.0
        size = np.abs(program.cost) + np.abs(dual) @ np.abs(program.matrix)
        reduced = np.where(np.abs(reduced) < _TIED * size, 0.0, reduced)
        broken = values + program.rounding[basis]
        step = _dual_step if broken.min() < 0.0 else _primal_step
        moved = step(program, basis, values, reduced)
        if moved is None:
            break
        basis[moved[0]] = moved[1]
    result = np.zeros(program.cost.size)
    result[basis] = values
    return result, dual


def _dual_step(
    program: _Standard, basis: IntArray, values: FloatArray, reduced: FloatArray
) -> tuple[int, int] | None:
    """The place of the variable that leaves and the variable that enters; None: there is none."""
    leaving = int(np.argmin(values + program.rounding[basis]))
    unit = np.zeros(len(basis))
    unit[leaving] = 1.0
    among = _refined_solution(program.matrix[:, basis].T, unit)
    row, sizes = among @ program.matrix, _PIVOT * np.abs(program.matrix) + program.noise[:, None]
    row[basis] = 0.0
    able = row < -np.abs(among) @ sizes
    if not able.any():
        return None
    ratio = np.where(able, np.maximum(reduced, 0.0), np.inf) / np.where(able, -row, 1.0)
    return leaving, int(np.argmin(ratio))


def _primal_step(
    program: _Standard, basis: IntArray, values: FloatArray, reduced: FloatArray
) -> tuple[int, int] | None:
    """The master's simplex step where all values are feasible and a reduced cost is negative."""
    entering = int(np.argmin(reduced))
    if reduced[entering] >= 0.0:
        return None
    square, entry = program.matrix[:, basis], program.matrix[:, entering]
    column, inverse = (
        _refined_solution(square, entry),
        _refined_solution(square, np.eye(len(basis))),
    )
    able = column > np.abs(inverse) @ (_PIVOT * np.abs(entry) + program.noise)
    if not able.any():
        return None
    ratio = np.where(able, np.maximum(values, 0.0), np.inf) / np.where(able, column, 1.0)
    return int(np.argmin(ratio)), entering


def _refined_solution(square: FloatArray, right: FloatArray) -> FloatArray:
    """A dense solve with one step of refinement."""
    try:
        x = np.linalg.solve(square, right)
        return x + np.linalg.solve(square, right - square @ x)
    except np.linalg.LinAlgError as error:
        raise SolverError("the master program's basis is singular") from error
