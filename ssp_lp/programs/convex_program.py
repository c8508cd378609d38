"""The bridge to cvxpy: the same program, open to any convex objective, row and solver."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import cvxpy as cp
import numpy as np

from ssp_lp.dynamic_programming.leaving import leaving_choice
from ssp_lp.errors import SolverError
from ssp_lp.programs.decomposition import balanced_visits
from ssp_lp.programs.occupation_measure import OccupationMeasure, Told

if TYPE_CHECKING:
    from ssp_lp.programs.occupation_program import OccupationProgram

_RESIDUAL = 1e-2  # of a row: first-order methods are far off by default, but not so far
_SOLVED = ("optimal", "optimal_inaccurate")


class ConvexProgram:
    """An occupation program stated in cvxpy.

    ``x`` is the variable, ``constraints`` holds the rows by name and takes further ones,
    ``objective`` may be replaced by any convex expression, ``bounds`` holds a cvxpy parameter for
    each row's bound: setting ``bounds[name].value`` and solving again compiles nothing anew. In
    case S ``x`` is the visits times ``scale``, chosen so that the goal's probability is 1.
    """

    def __init__(self, program: OccupationProgram) -> None:
        """State the program.

        Args:
            program: the program.
        """
        process = program.process
        self.program = program
        self.x = cp.Variable(process.n_pairs, nonneg=True, name="x")
        self.scale: Any = cp.Variable(nonneg=True, name="t") if program.ratio else 1.0
        self.objective: Any = process.cost @ self.x
        self.bounds = {
            row.name: cp.Parameter(value=row.bound, name=row.name) for row in program.rows
        }
        balance = program.linear.matrix[program.linear.rows["balance"], : process.n_pairs]
        self.constraints: dict[str, Any] = {
            "balance": balance @ self.x == process.start * self.scale
        }
        for row in program.rows:
            limit = self.bounds[row.name] * self.scale
            self.constraints[row.name] = row.coefficients @ self.x <= limit
        if program.ratio:
            self.constraints["normaliser"] = process.goal @ self.x == 1.0
        self._stated = dict(self.constraints), self.objective
        self._compiled: tuple[tuple[int, ...], Any] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles carry what is stated; what a solver holds of it cannot be copied."""
        return vars(self) | {"_compiled": None}

    @property
    def problem(self) -> Any:
        """The cvxpy problem; the same object until a constraint or the objective is changed."""
        key = (id(self.objective), *(id(c) for c in self.constraints.values()))
        if self._compiled is None or self._compiled[0] != key:
            stated = cp.Problem(cp.Minimize(self.objective), list(self.constraints.values()))
            self._compiled = key, stated
        return self._compiled[1]

    def solve(self, solver: str | None = None, **options: Any) -> OccupationMeasure:
        """Solve by one of cvxpy's solvers; options are passed on to it.

        Raises:
            InfeasibleError: no visits satisfy the constraints.
            SolverError: the solver failed, or stopped without an answer.
        """
        began = time.perf_counter()
        try:
            self.problem.solve(solver=solver, **options)
        except cp.SolverError as error:
            raise SolverError(f"cvxpy: {error}") from error
        status = str(self.problem.status)
        if status in ("infeasible", "infeasible_inaccurate"):
            raise self._bounded.infeasible()
        if status not in _SOLVED or self.x.value is None:
            raise SolverError(f"cvxpy: the program is {status}")
        scale, ratio, program = 1.0, 0.0, self._bounded
        if program.ratio:
            scale = float(self.scale.value)
            ratio = self._price("normaliser", -1.0)
        prices = {
            row.name: self._price(row.name) for row in program.rows if self._is_kept(row.name)
        }
        seconds, solver = time.perf_counter() - began, self.problem.solver_stats.solver_name
        told = Told(prices, ratio, scale, f"cvxpy, {solver}", status, seconds)
        visits = np.asarray(self.x.value) / scale
        if not self._is_as_stated:  # rows of the user's see every visit
            process = program.process
            otherwise = leaving_choice(process.dynamics, process.goal)
            return told.measure(program, balanced_visits(process, visits, otherwise), None)
        measure = program.optimal(visits, told)
        if measure.residual > _RESIDUAL:
            raise SolverError(
                f"cvxpy: the answer breaks a row by {measure.residual:.1e}, relative to its bound"
            )
        return measure

    @property
    def _is_as_stated(self) -> bool:
        """Whether neither the objective nor a constraint was changed or added."""
        constraints, objective = self._stated
        now = [(name, id(c)) for name, c in self.constraints.items()]
        return now == [(name, id(c)) for name, c in constraints.items()] and (
            objective is self.objective
        )

    @property
    def _bounded(self) -> OccupationProgram:
        """The program with the bounds that the parameters have now."""
        return self.program.bounded_by(
            {name: np.asarray(bound.value).item() for name, bound in self.bounds.items()}
        )

    def _is_kept(self, name: str) -> bool:
        """Whether a row of the convex program is still as it was stated."""
        return self.constraints.get(name) is self._stated[0][name]

    def _price(self, name: str, sign: float = 1.0) -> float:
        """A row's multiplier as the solver gives it; 0 where it has none or was replaced."""
        value = self.constraints[name].dual_value if self._is_kept(name) else None
        return 0.0 if value is None else max(sign * float(np.ravel(value)[0]), 0.0)
