"""The bridge to cvxpy: the same program, open to any convex objective, row and solver."""

from __future__ import annotations

import time
from collections.abc import Hashable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import cvxpy as cp
import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.errors import SolverError
from ssp_lp.processes.quantities.quantity import Quantity
from ssp_lp.programs.occupation_measure import OccupationMeasure

if TYPE_CHECKING:
    from ssp_lp.programs.occupation_program import OccupationProgram

_RESIDUAL = 1e-2  # of a row: first-order methods are far off by default, but not so far
_SOLVED = ("optimal", "optimal_inaccurate")


class ScaledExpression:
    """An affine expression of the visits of a ratio: what it is compared with is scaled, too.

    ``scaled`` is the expression of cvxpy's variables: the visits' value times ``scale``.
    """

    def __init__(self, scaled: Any, scale: Any) -> None:
        """An expression that is already scaled, and the scale."""
        self.scaled, self._scale = scaled, scale

    def _other(self, other: Any) -> Any:
        """What is added or compared: an expression of visits, a number or a parameter."""
        return other.scaled if isinstance(other, ScaledExpression) else other * self._scale

    def __add__(self, other: Any) -> ScaledExpression:
        """The sum."""
        return ScaledExpression(self.scaled + self._other(other), self._scale)

    def __mul__(self, factor: Any) -> ScaledExpression:
        """The multiple by a number or a parameter."""
        return ScaledExpression(factor * self.scaled, self._scale)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> ScaledExpression:
        """The opposite."""
        return self * -1.0

    def __sub__(self, other: Any) -> ScaledExpression:
        """The difference."""
        return ScaledExpression(self.scaled - self._other(other), self._scale)

    def __rsub__(self, other: Any) -> ScaledExpression:
        """The difference."""
        return ScaledExpression(self._other(other) - self.scaled, self._scale)

    def __le__(self, bound: Any) -> Any:
        """A constraint of cvxpy: at most."""
        return self.scaled <= self._other(bound)

    def __ge__(self, bound: Any) -> Any:
        """A constraint of cvxpy: at least."""
        return self.scaled >= self._other(bound)

    def __eq__(self, value: Any) -> Any:
        """A constraint of cvxpy: equal."""
        return self.scaled == self._other(value)

    __hash__ = None  # type: ignore[assignment]


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

    def visits(self, state: Hashable, action: Hashable | None = None) -> Any:
        """How often a state is visited, or an action taken there, over all copies.

        An expression of cvxpy; of a ratio (case S) one that is compared with numbers as it is,
        see :class:`ScaledExpression`.

        Raises:
            ModelError: unknown state or action.
        """
        return self._expressed(self.program.visits(state, action), 0.0)

    def expression(self, quantity: Quantity) -> Any:
        """A quantity as an expression of the visits, as :meth:`visits` is one.

        Raises:
            ModelError: unknown states, actions or ends, or costs of the wrong shape.
        """
        return self._expressed(*self.program.expression(quantity))

    def _expressed(self, coefficients: FloatArray, constant: float) -> Any:
        """An affine expression of the visits."""
        scaled = coefficients @ self.x + constant * self.scale
        return ScaledExpression(scaled, self.scale) if self.program.ratio else scaled

    @property
    def problem(self) -> Any:
        """The cvxpy problem; the same object until a constraint or the objective is changed."""
        key = (id(self.objective), *(id(c) for c in self.constraints.values()))
        if self._compiled is None or self._compiled[0] != key:
            objective = getattr(self.objective, "scaled", self.objective)
            stated = cp.Problem(cp.Minimize(objective), list(self.constraints.values()))
            self._compiled = key, stated
        return self._compiled[1]

    def solve(self, solver: str | None = None, **options: Any) -> OccupationMeasure:
        """Solve by one of cvxpy's solvers.

        Args:
            solver: one of cvxpy's; None: as it chooses.
            options: bounds of rows by name, ``failure=0.2``; others are passed on to the solver.

        Raises:
            InfeasibleError: no visits satisfy the constraints.
            SolverError: the solver failed, or stopped without an answer.
        """
        began = time.perf_counter()
        for name in self.bounds.keys() & options.keys():
            self.bounds[name].value = options.pop(name)
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
            row.name: self._price(row.name) for row in program.rows if self._is_stated(row.name)
        }
        seconds, solver = time.perf_counter() - began, self.problem.solver_stats.solver_name
        visits, told = np.asarray(self.x.value) / scale, (f"cvxpy, {solver}", status, seconds)
        measure = OccupationMeasure(program, visits, prices, None, *told)
        if not self._is_as_stated:
            return self._kept_by(replace(measure, visits=measure.balanced))
        measure = program.optimal(measure, ratio)
        if measure.residual > _RESIDUAL:
            raise SolverError(
                f"cvxpy: the answer breaks a row by {measure.residual:.1e}, relative to its bound"
            )
        return measure

    def measure(self) -> OccupationMeasure:
        """The visits that the variables' values are, after any cvxpy problem with them was solved.

        Raises:
            SolverError: they have no values.
        """
        if self.x.value is None:
            raise SolverError("the program's variables have no values yet: solve a problem first")
        scale = self.scale.value if self.program.ratio else 1.0
        return self._bounded.measure(np.asarray(self.x.value) / float(scale))

    def _kept_by(self, measure: OccupationMeasure) -> OccupationMeasure:
        """A measure, if it keeps to the user's constraints as the solver's visits do.

        Raises:
            SolverError: only visits do that go round for ever, which no policy comes to.
        """
        self.x.value = measure.visits * (self.scale.value if self.program.ratio else 1.0)
        for name, constraint in self.constraints.items():
            size = max(float(np.abs(a.value).max(initial=0.0)) for a in constraint.args)
            off = float(np.max(constraint.violation(), initial=0.0))
            if not self._is_stated(name) and off > _RESIDUAL * max(size, 1e-3):
                raise SolverError(
                    f"constraint {name!r} is kept only by visits that go round for ever and that "
                    f"no policy comes to: those of the policy break it by {off:.1e}"
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

    def _is_stated(self, name: str) -> bool:
        """Whether a row of the convex program is still as it was stated."""
        return name in self._stated[0] and self.constraints.get(name) is self._stated[0][name]

    def _price(self, name: str, sign: float = 1.0) -> float:
        """A row's multiplier as the solver gives it; 0 where it has none or was replaced."""
        value = self.constraints[name].dual_value if self._is_stated(name) else None
        return 0.0 if value is None else max(sign * float(np.ravel(value)[0]), 0.0)
