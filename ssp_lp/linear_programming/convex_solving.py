"""Problems that are stated in cvxpy: checked, solved, asked again, and rows that contradict."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from typing import Any

import cvxpy as cp
import numpy as np
from cvxpy.constraints.constraint import Constraint

from ssp_lp.errors import ModelError, SolverError, in_short
from ssp_lp.linear_programming.convex_rows import bound_in_short

_SOLVED = ("optimal", "optimal_inaccurate")
_INFEASIBLE = ("infeasible", "infeasible_inaccurate")
_PLAIN: Mapping[str, Mapping[str, Any]] = {  # HiGHS's presolve calls sound programs infeasible
    "HIGHS": {"presolve": "off"},
    "SCIPY": {"scipy_options": {"presolve": False}},
}
_TIGHT: Mapping[str, Mapping[str, float]] = {
    "CLARABEL": {"tol_feas": 1e-11, "tol_gap_abs": 1e-11, "tol_gap_rel": 1e-11},
    "ECOS": {"feastol": 1e-11, "abstol": 1e-11, "reltol": 1e-11},
    "HIGHS": {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    "OSQP": {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 200_000},
    "SCS": {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iters": 200_000},
}
_HOW = "a convex expression <= a concave one, or == between affine ones, such as cp.square(x) <= 1"


def stated(objective: Any, constraints: Mapping[str, Any]) -> Any:
    """The convex problem, in cvxpy, of minimising an objective within named constraints.

    Raises:
        ModelError: something is no constraint, or not convex; says which, and what is.
    """
    for name, row in constraints.items():
        if not isinstance(row, Constraint):
            raise ModelError(f"constraint {name!r} must compare expressions of cvxpy, such as "
                             f"convex.visits(state) <= 1.0, not {in_short(row)}")  # fmt: skip
        if not row.is_dcp():
            raise ModelError(f"constraint {name!r} is not convex as cvxpy reads it: {_HOW}")
    try:
        problem = cp.Problem(cp.Minimize(objective), list(constraints.values()))
    except (TypeError, ValueError) as error:
        raise ModelError(f"the objective must be one number of cvxpy's: {error}") from error
    if not problem.objective.is_dcp():
        raise ModelError("the objective is not convex as cvxpy reads it, and is to be minimised: "
                         "add what is convex, such as cp.square(x), or subtract what is concave, "
                         "such as cp.entr(x)")  # fmt: skip
    return problem


def solve_stated(
    problem: Any, solver: str | None, options: Mapping[str, Any], *, tight: bool = False
) -> bool:
    """Solve a convex problem by cvxpy; where HiGHS fails, again without its presolve.

    Where the solver that cvxpy chooses fails, by HiGHS.

    Args:
        problem: the problem.
        solver: one of cvxpy's; None: as it chooses.
        options: of the solver.
        tight: with tolerances as small as it takes; of those that are not known, as it is.

    Returns:
        Whether there is an optimum; else nothing satisfies the constraints.

    Raises:
        ModelError: a parameter has no value, or an option is none of the solver's.
        SolverError: the solver failed, or stopped without an answer.
    """
    if missing := [each.name() for each in problem.parameters() if each.value is None]:
        raise ModelError(f"parameter {missing[0]!r} has no value: set its .value before solving")
    name = str(solver or (problem.solver_stats.solver_name if tight else "")).upper()
    options = {**_TIGHT.get(name, {}), **options} if tight else dict(options)
    attempts = [(solver, options)]
    if solver is None:
        attempts.append(("SCIPY", {}))  # HiGHS, which every version of cvxpy has
    elif name in _PLAIN:
        attempts.append((solver, {**_PLAIN[name], **options}))
    failure = ""
    for one, attempt in attempts:
        try:
            with warnings.catch_warnings():
                if tight:  # an answer that is not as exact is judged as it is
                    warnings.simplefilter("ignore")
                problem.solve(solver=one, **attempt)
        except cp.SolverError as error:
            failure = failure or str(error)
            continue
        except (TypeError, ValueError, AttributeError) as error:
            raise ModelError(f"cvxpy: {error}; what is no bound of a row by its name is an option "
                             "of the solver") from error  # fmt: skip
        failure = f"the problem is {problem.status}"
        if problem.status in _SOLVED:
            return True
        if problem.status in _INFEASIBLE and (one is None or name not in _PLAIN):
            return False
    if str(problem.status) in _INFEASIBLE:
        return False
    raise SolverError(f"cvxpy: {failure}")


class Conflict(dict[str, str]):
    """Rows that contradict each other, by name, each with its bound."""

    def __repr__(self) -> str:
        """A line for each row."""
        if not self:
            return "no rows contradict each other"
        lines = (f"\n  {name}: {told}" for name, told in self.items())
        return f"rows that contradict each other:{''.join(lines)}"


def contradicting(
    rows: Mapping[str, Any],
    kept: Collection[Any],
    x: Any,
    scale: Any,
    solver: str | None,
    **options: Any,
) -> Conflict:
    """Convex constraints that contradict each other: without any of them the others can be kept.

    One after another is left out, and put back where that helps. (HiGHS's irreducible subsets are
    of single rows of balance, and know no row that is not linear.)

    Args:
        rows: constraints by name.
        kept: constraints that stand anyhow.
        x: the variable that rows count, and compare with their bounds.
        scale: the variable by which rows may be scaled: bounds are told where it is 1.
        solver: one of cvxpy's; None: as it chooses.
        options: of the solver.

    Returns:
        The rows; none where all can be kept.

    Raises:
        SolverError: the solver failed.
    """

    def can_be_kept(names: Collection[str]) -> bool:
        every = [*kept, *(rows[name] for name in names)]
        return solve_stated(cp.Problem(cp.Minimize(0.0), every), solver, options)

    names = list(rows)
    if can_be_kept(names):
        return Conflict()
    for name in rows:
        fewer = [other for other in names if other != name]
        if not can_be_kept(fewer):
            names = fewer
    if isinstance(scale, cp.Variable):
        scale.value = np.ones(scale.shape)
    return Conflict({name: bound_in_short(rows[name], x) for name in names})
