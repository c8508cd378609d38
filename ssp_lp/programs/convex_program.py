"""Occupation programs in cvxpy, with any convex objective, convex constraints and any solver."""

from __future__ import annotations

import time
import warnings
from collections.abc import Collection, Hashable, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import cvxpy as cp
import numpy as np
from cvxpy.constraints.constraint import Constraint
from cvxpy.constraints.nonpos import Inequality
from cvxpy.constraints.zero import Equality

from ssp_lp.arrays import FloatArray
from ssp_lp.errors import ModelError, SolverError, in_short, wrong_argument
from ssp_lp.linear_programming.linear_program import MeasuredRow, check_bounds
from ssp_lp.model.report import ByName
from ssp_lp.processes.failure_semantics import AS_IS
from ssp_lp.processes.quantities import Quantity
from ssp_lp.programs.augmented import BOUND_TO_START
from ssp_lp.programs.occupation_measure import NOISES, OccupationMeasure

if TYPE_CHECKING:
    from ssp_lp.programs.occupation_program import OccupationProgram

_ATOMS: Any = cp  # mypy knows only some attributes
_ACCEPTED = 1e-5  # largest accepted violation, relative to a row's bound
_NOISES = (0.0, 1e-9, 1e-7, 1e-5)  # relative errors of prices to try
_OBJECTIVE = "the objective's value"
_EXCUSED = 1e-7  # violation of a row that a solver's tolerance allows
_SOLVED = ("optimal", "optimal_inaccurate")
_INFEASIBLE = ("infeasible", "infeasible_inaccurate")
_PLAIN: Mapping[str, Mapping[str, Any]] = {  # HiGHS's presolve rejects some feasible programs
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


class _ScaledExpression:
    """An affine expression of the visits in case S, which users compare with unscaled bounds.

    The variables of cvxpy are the visits times a variable ``scale``. ``scaled`` is the expression
    in these variables. A bound is multiplied by ``scale`` when the two are compared.
    """

    __array_ufunc__ = None  # numpy's numbers leave the operators to this class

    def __init__(self, scaled: Any, scale: Any) -> None:
        """Store an expression in the scaled variables, and the scale variable."""
        self.scaled, self._scale = scaled, scale

    def __array__(self, *_: object) -> None:
        """Raise an error: ``parameter * expression`` would treat the expression as an array.

        Raises:
            ModelError: always.
        """
        raise ModelError("an expression of a cost given success must be the left operand: "
                         "write expression * parameter, expression <= parameter")  # fmt: skip

    def _other(self, other: Any) -> Any:
        """Return an operand in the scaled variables: an expression, a number or a parameter."""
        return other.scaled if isinstance(other, _ScaledExpression) else other * self._scale

    def __add__(self, other: Any) -> _ScaledExpression:
        return _ScaledExpression(self.scaled + self._other(other), self._scale)

    def __mul__(self, factor: Any) -> _ScaledExpression:
        """Return the product with a number or a parameter."""
        return _ScaledExpression(factor * self.scaled, self._scale)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> _ScaledExpression:
        return self * -1.0

    def __sub__(self, other: Any) -> _ScaledExpression:
        return _ScaledExpression(self.scaled - self._other(other), self._scale)

    def __rsub__(self, other: Any) -> _ScaledExpression:
        return _ScaledExpression(self._other(other) - self.scaled, self._scale)

    def __le__(self, bound: Any) -> Any:
        """Return cvxpy's constraint that the expression is at most a bound."""
        return self.scaled <= self._other(bound)

    def __ge__(self, bound: Any) -> Any:
        """Return cvxpy's constraint that the expression is at least a bound."""
        return self.scaled >= self._other(bound)

    def __eq__(self, value: Any) -> Any:
        """Return cvxpy's constraint that the expression equals a value."""
        return self.scaled == self._other(value)

    __hash__ = None  # type: ignore[assignment]


class Conflict(dict[str, str]):
    """Rows that cannot be satisfied together: for each name, the bound in short."""

    def __repr__(self) -> str:
        """Return a line for each row."""
        if not self:
            return "no rows contradict each other"
        lines = (f"\n  {name}: {told}" for name, told in self.items())
        return f"rows that contradict each other:{''.join(lines)}"


class ConvexProgram:
    """An occupation program stated in cvxpy.

    - ``x`` is the variable: the expected visits. In case S it is the visits times ``scale``, a
      second variable, such that the goal probability of ``x`` is 1.
    - ``constraints`` has the rows by name; further constraints may be added.
    - ``objective`` may be replaced by any convex expression.
    - Bounds, start and costs are parameters of cvxpy. The problem is not compiled again if
      ``bounds[name].value`` is set, or :meth:`solve` is called with a start or an objective.
    """

    def __init__(self, program: OccupationProgram) -> None:
        """Write an occupation program in cvxpy.

        Args:
            program: the program.
        """
        process = program.process
        self.program = program
        self.x = cp.Variable(process.n_pairs, nonneg=True, name="x")
        self.scale: Any = cp.Variable(nonneg=True, name="t") if program.ratio else 1.0
        self.start = cp.Parameter(process.n_states, value=process.start, name="start")
        self.cost = cp.Parameter(process.n_pairs, value=process.cost, name="cost")
        self._constant = cp.Parameter(value=0.0, name="constant")
        self.objective: Any = self.cost @ self.x + self._constant * self.scale
        rows = program.rows
        self.bounds = {row.name: cp.Parameter(value=row.bound, name=row.name) for row in rows}
        balance = program.linear.matrix[program.linear.rows["balance"], : process.n_pairs]
        begun: Any = self.start
        if program.ratio:  # cvxpy compiles a product of matrices a hundred times faster
            column = _ATOMS.reshape(begun, (process.n_states, 1), order="F")
            begun = column @ _ATOMS.reshape(self.scale, (1,), order="F")
        self.constraints: dict[str, Any] = {"balance": balance @ self.x == begun}
        for row in rows:
            limit = self.bounds[row.name] * self.scale
            self.constraints[row.name] = row.coefficients @ self.x <= limit
        if program.ratio:
            self.constraints["normaliser"] = process.goal @ self.x == 1.0
        self._stated = dict(self.constraints), self.objective
        self._compiled: tuple[tuple[int, ...], Any] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the compiled problem, which cannot be copied or pickled."""
        return vars(self) | {"_compiled": None}

    def __repr__(self) -> str:
        """Return the program as in a paper, with the objective and rows changed in cvxpy."""
        own = self.program.rows
        named = {"balance", "normaliser", *(row.name for row in own)}
        added = [f"{name}: {row}" for name, row in self.constraints.items() if name not in named]
        changed = [] if self.objective is self._stated[1] else [f"objective: {self.objective}"]
        return "\n  ".join(["ConvexProgram in cvxpy: " + repr(self.program), *changed, *added])

    def visits(self, state: Hashable, action: Hashable | None = None) -> Any:
        """Return the expected visits of a state or action, over all copies, as a cvxpy expression.

        In case S, compare the result with unscaled bounds: ``scale`` is applied automatically.

        Raises:
            ModelError: unknown state or action.
        """
        return self._expressed(self.program.visits(state, action), 0.0)

    def expression(self, quantity: Quantity) -> Any:
        """Return a quantity as a cvxpy expression of the visits.

        Raises:
            ModelError: unknown states, actions or ends, or costs of the wrong shape.
        """
        return self._expressed(*self.program.expression(quantity))

    def _expressed(self, coefficients: FloatArray, constant: float) -> Any:
        """Return an affine cvxpy expression of the visits, scaled in case S."""
        scaled = coefficients @ self.x + constant * self.scale
        return _ScaledExpression(scaled, self.scale) if self.program.ratio else scaled

    @property
    def problem(self) -> Any:
        """The cvxpy problem; the same object until a constraint or the objective is replaced.

        Raises:
            ModelError: an entry of ``constraints`` is not a constraint, or it or the objective is
                not convex; the message names it.
        """
        key = (id(self.objective), *(id(c) for c in self.constraints.values()))
        if self._compiled is None or self._compiled[0] != key:
            self._compiled = key, _stated_problem(self._minimised, self.constraints)
        return self._compiled[1]

    def solve(
        self,
        solver: str | None = None,
        *,
        start: Hashable | Mapping[Hashable, float] | None = None,
        objective: Quantity | None = None,
        **options: Any,
    ) -> OccupationMeasure:
        """Solve the program by cvxpy; if a row is violated, again at the tightest tolerances.

        Bounds, start and costs that are given here also apply to later calls, until they are given
        again.

        Args:
            solver: a solver of cvxpy; None: cvxpy's choice.
            start: another start: a state, or {state: probability}. A program that depends on its
                start (distinguished costs, episodes that end where they begin) is rebuilt with
                another ``x``.
            objective: a quantity in place of the costs; other terms of the objective remain.
            options: bounds of rows by name, ``failure=0.2``; others are passed on to the solver.

        Raises:
            ModelError: no such row or start, a start that needs another program although
                constraints were changed, a parameter without a value, an option that the solver
                does not have, or an objective or constraint that is not convex.
            InfeasibleError: no visits satisfy the constraints; :meth:`conflict` names them.
            SolverError: the solver failed, stopped without an answer, or violates a row.
        """
        began, as_stated = time.perf_counter(), self._is_as_stated
        opened = {"failure"} if self.program.at_least and as_stated else set[str]()
        bounds = {n: options.pop(n) for n in self.bounds.keys() | opened if n in options}
        check_bounds(bounds)
        for name in (name for name, bound in bounds.items() if bound == np.inf):
            hint = f"; del convex.constraints[{name!r}] removes the row"
            raise wrong_argument(name, "be finite", np.inf, hint)
        start = self._start if start is None else start
        program = self.program.bounded_by(self._now | bounds) if as_stated else self.program
        program = program if start is None else program.started(start)
        if program.process.transitions is not self.program.process.transitions:  # rebuilt
            if not as_stated:
                raise ModelError(BOUND_TO_START)
            ConvexProgram.__init__(self, program)
        self.start.value = program.process.start
        if objective is not None:
            self.cost.value, self._constant.value = self.program.expression(objective)
        for name, bound in bounds.items():
            self.bounds[name].value = bound
        for tight in (False, True):
            if not _solve_stated(self.problem, solver, options, tight=tight):
                raise self._bounded.infeasible()
            measure, broken, solvers = self._answer(began)
            if max(broken.values(), default=0.0) <= _ACCEPTED:
                return measure
        name = max(broken, key=lambda row: broken[row])
        excess = f"by {broken[name]:.1e}, relative to its bound"
        if name in solvers:
            raise SolverError(f"cvxpy: the answer breaks {name!r} {excess}: try another solver, "
                              "or tighter tolerances by its options")  # fmt: skip
        kept = _OBJECTIVE if name == _OBJECTIVE else f"constraint {name!r}"
        raise SolverError(f"{kept} is attained only by visits that circulate for ever, which no "
                          f"policy has: the policy's visits break it {excess}")  # fmt: skip

    def _answer(self, began: float) -> tuple[OccupationMeasure, dict[str, float], set[str]]:
        """Return the solver's answer as the measure of a policy, with the violations of rows.

        Visits up to a noise level are set to 0. The level is the smallest one at which the visits
        are those of a policy that satisfies the rows.

        Args:
            began: time at which solving began, by ``time.perf_counter``.

        Returns:
            The measure; the relative violation of each row by it; and the names of the rows that
            the solver's own answer violates, or may violate.
        """
        problem, given, solvers = self.problem, self.measure(), _broken_rows(self._added)
        program, scale = given.program, self._scale
        solver, status = f"cvxpy, {problem.solver_stats.solver_name}", str(problem.status)
        prices = ByName({row.name: self._price(row.name) for row in program.rows})
        origin = solver, status, time.perf_counter() - began
        given = OccupationMeasure(program, given.visits, prices, None, *origin)
        as_stated = self._is_as_stated
        for noise in NOISES[: 1 if as_stated else None]:
            if as_stated:
                measure = program.optimal(given, self._price("normaliser", -1.0))
            else:
                measure = given.balanced(noise)
                self.x.value = measure.visits * scale
            stated = {row.name: row.violation(measure.activity[row.name]) for row in program.rows}
            broken = {"balance": measure.imbalance, **stated, **_broken_rows(self._added)}
            if not as_stated:
                value = float(np.ravel(self._minimised.value)[0])
                broken[_OBJECTIVE] = max(value - problem.value, 0.0) / (1.0 + abs(value))
            if max(broken.values()) <= _ACCEPTED:
                break
        if not as_stated:
            added = tuple(self._measured_rows())
            proved, minimum = self._least_proved(), None if self._minimises_cost else value
            measure = replace(measure, own=added, minimised=minimum, optimal_value_from_dual=proved)
        by_solver = {"balance", *stated, *(name for name, off in solvers.items() if off > 0.0)}
        return measure, broken, by_solver

    def _least_proved(self) -> float | None:
        """Return a lower bound by the duals of all rows, recomputed from the model.

        The Lagrangian, which is the objective plus the rows at their prices, is minimised over all
        visits that satisfy flow balance. If the minimum is -inf because a solver's price is
        slightly too high, prices and ratio are lowered by the solver's tolerance.

        Returns:
            The bound; None if a row or the objective is not linear or has other variables than
            the program's, if a row has no dual (integer programs), or if nothing is proved.
        """
        program, rows = self._bounded, dict(self.constraints)
        own, priced = self._affine(self._minimised), list[FloatArray]()
        kept, prices = ("balance", "normaliser")[: 1 + program.ratio], list[float]()
        if own is None or not all(self._is_stated(n) and rows.pop(n) is not None for n in kept):
            return None
        for row in rows.values():
            if not isinstance(row, Equality | Inequality) or row.dual_value is None:
                return None
            charge = _ATOMS.sum(_ATOMS.multiply(row.dual_value, row.expr))
            if (part := self._affine(charge)) is None:
                return None
            priced.append(part)
            prices.append(float(np.abs(row.dual_value).max(initial=0.0)))
        for noise in _NOISES:
            lagrangian = own
            for part, price in zip(priced, prices, strict=True):
                gainful = part[:-2].min(initial=0.0) < 0.0
                less = noise * (1.0 + max(prices) / price) if gainful else 0.0
                if less < 1.0 and np.abs(part).max() > noise * np.abs(own).max():
                    lagrangian = lagrangian + (1.0 - less) * part
            cost, (by_scale, constant) = lagrangian[:-2], lagrangian[-2:].tolist()
            ratio = float(cost @ np.asarray(self.x.value)) + by_scale * self._scale
            ratio = (ratio - noise * abs(ratio)) * program.ratio
            _, value = program.least_of_visits(cost, by_scale, ratio)
            if np.isfinite(value):
                return (program.sense if self._minimises_cost else AS_IS).stated(value + constant)
        return None

    def _affine(self, expression: Any) -> FloatArray | None:
        """Return the coefficients of ``x``, that of ``scale``, and the constant, [pairs + 2].

        The result is None if the expression is not affine or has other variables.
        """
        variables, own = expression.variables(), {id(self.x), id(self.scale)}
        if not expression.is_affine() or not own.issuperset(map(id, variables)):
            return None
        values = [variable.value for variable in variables]
        for variable in variables:
            variable.value = np.zeros(variable.shape)
        slopes = {id(variable): slope for variable, slope in expression.grad.items()}
        constant = float(np.ravel(expression.value)[0])
        for variable, value in zip(variables, values, strict=True):
            variable.value = value
        taken: Any = slopes.get(id(self.x), 0.0)
        dense = taken if np.isscalar(taken) else taken.toarray()
        by_scale = float(slopes.get(id(self.scale), 0.0))
        return np.append(np.zeros(self.x.size) + np.ravel(dense), [by_scale, constant])

    def _sides(self, row: Any) -> tuple[Any, str, Any]:
        """Split a row with <= or == into the side that contains ``x``, the sign, and the bound."""
        (left, right), relation = row.args, "<="
        if id(self.x) not in map(id, left.variables()):
            left, right, relation = right, left, ">="
        elif id(self.x) in map(id, right.variables()):
            left, right = left - right, cp.Constant(0.0)
        return left, "==" if isinstance(row, Equality) else relation, right

    def _measured_rows(self) -> Iterator[MeasuredRow]:
        """Yield each scalar entry of the added rows (<= or ==), with its value, bound and dual."""
        for name, row in self._added.items():
            if not isinstance(row, Equality | Inequality):
                continue
            spent, relation, bound = self._sides(row)
            unit = self._scale if id(self.scale) in map(id, row.variables()) else 1.0
            worth = np.nan if row.dual_value is None else row.dual_value
            parts = np.broadcast_arrays(spent.value, bound.value, worth)
            for k, (each, limit, price) in enumerate(zip(*map(np.ravel, parts), strict=True)):
                label = name if parts[0].size == 1 else f"{name}[{k}]"
                duals = (None, None) if np.isnan(price) else (float(price), float(price * unit))
                yield MeasuredRow(label, float(each / unit), float(limit / unit), relation, *duals)

    @property
    def _minimised(self) -> Any:
        """The objective as a cvxpy expression."""
        own = self.objective
        return own.scaled if isinstance(own, _ScaledExpression) else own

    @property
    def _minimises_cost(self) -> bool:
        """Whether the objective is still the program's expected cost, with its own costs."""
        unchanged = np.array_equal(np.asarray(self.cost.value), self.program.process.cost)
        return self.objective is self._stated[1] and unchanged and self._constant.value == 0.0

    def conflict(self, solver: str | None = None, **options: Any) -> Conflict:
        """Find rows, also added ones, that cannot be satisfied together; empty if there are none.

        The set is irreducible: if any one of its rows is removed, the other rows can be satisfied.
        To find it, each row is left out once, and put back if the remaining rows become feasible.
        (HiGHS's irreducible subsets are not used: they split the flow balance into single rows, and
        do not support nonlinear rows.)

        Args:
            solver: a solver of cvxpy; None: cvxpy's choice.
            options: options of the solver.

        Raises:
            SolverError: the solver failed.
        """
        always = ("balance", "normaliser")
        names = [name for name in self.constraints if name not in always]

        def can_be_kept(some: Collection[str]) -> bool:
            kept = [row for name, row in self.constraints.items() if name in (*always, *some)]
            return _solve_stated(cp.Problem(cp.Minimize(0.0), kept), solver, options)

        if can_be_kept(names):
            return Conflict()
        for name in [*names]:
            fewer = [other for other in names if other != name]
            if not can_be_kept(fewer):
                names = fewer
        if self.program.ratio:
            self.scale.value = 1.0  # so that bounds are reported unscaled
        return Conflict({name: self._bound_in_short(self.constraints[name]) for name in names})

    def _bound_in_short(self, row: Any) -> str:
        """Return a row's bound, such as "<= 3"; if it has several bounds, "as it is stated"."""
        if isinstance(row, Equality | Inequality):
            _, relation, bound = self._sides(row)
            if bound.value is not None and np.size(bound.value) == 1:
                return f"{relation} {np.ravel(bound.value)[0]:g}"
        return "as it is stated"

    def measure(self) -> OccupationMeasure:
        """Return the occupation measure at the present values of the variables.

        The values may come from any cvxpy problem with these variables.

        Raises:
            SolverError: the variables have no values.
        """
        if self.x.value is None:
            raise SolverError("the program's variables have no values yet: solve a problem first")
        return self._bounded.measure(np.asarray(self.x.value) / self._scale)

    @property
    def _scale(self) -> float:
        """Value of the scale t; 1 in case M."""
        return float(self.scale.value) if self.program.ratio else 1.0

    @property
    def _is_as_stated(self) -> bool:
        """Whether objective, costs and constraints are unchanged."""
        left = [(name, id(row)) for name, row in self.constraints.items()]
        return self._minimises_cost and left == [(n, id(row)) for n, row in self._stated[0].items()]

    @property
    def _added(self) -> dict[str, Any]:
        """Constraints that the user added or replaced, by name."""
        return {n: row for n, row in self.constraints.items() if not self._is_stated(n)}

    @property
    def _now(self) -> dict[str, float]:
        """Current values of the bounds' parameters, by name."""
        return {name: np.asarray(bound.value).item() for name, bound in self.bounds.items()}

    @property
    def _start(self) -> dict[Hashable, float] | None:
        """Current value of the start's parameter, by state; None if it is unchanged."""
        start, augmented = np.asarray(self.start.value), self.program.augmented
        if np.array_equal(start, self.program.process.start):
            return None
        states = augmented.quotient.first_states.tolist()
        if augmented.copies > 1 or len(states) != len(start):
            raise ModelError("start.value cannot be set where the columns depend on the start: "
                             "use solve(start=...), which rebuilds the program")  # fmt: skip
        return {augmented.model.states[k]: p for k, p in zip(states, start.tolist(), strict=True)}

    @property
    def _bounded(self) -> OccupationProgram:
        """The linear program of the unchanged rows, at the current bounds and start."""
        program = self.program if self._start is None else self.program.started(self._start)
        program = program.bounded_by(self._now, anew=False)
        if all(map(self._is_stated, self.bounds)):
            return program
        left = program.with_rows(lambda row: row if self._is_stated(row.name) else None)
        return replace(left, remade=None)

    def _is_stated(self, name: str) -> bool:
        """Return whether a row is unchanged."""
        return name in self._stated[0] and self.constraints.get(name) is self._stated[0][name]

    def _price(self, name: str, sign: float = 1.0) -> float:
        """Return cvxpy's multiplier of a row, at least 0; 0 if the row has none."""
        row = self.constraints.get(name)
        if row is None or row.dual_value is None:
            return 0.0
        return max(sign * float(np.ravel(row.dual_value)[0]), 0.0)


def _stated_problem(objective: Any, constraints: Mapping[str, Any]) -> Any:
    """Build the cvxpy problem of minimising an objective within named constraints.

    Raises:
        ModelError: an entry is not a constraint, or not convex; the message names it and says
            what is allowed.
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
        raise ModelError(f"the objective must be a scalar cvxpy expression: {error}") from error
    if not problem.objective.is_dcp():
        raise ModelError("the objective is minimised, and is not convex as cvxpy reads it: "
                         "add convex terms, such as cp.square(x), or subtract concave ones, "
                         "such as cp.entr(x)")  # fmt: skip
    return problem


def _solve_stated(
    problem: Any, solver: str | None, options: Mapping[str, Any], *, tight: bool = False
) -> bool:
    """Solve a convex problem by cvxpy.

    If HiGHS was requested and fails, it runs again without its presolve. If no solver was requested
    and cvxpy's choice fails, HiGHS runs.

    Args:
        problem: the problem.
        solver: a solver of cvxpy; None: cvxpy's choice.
        options: options of the solver.
        tight: whether to set the smallest tolerances that the solver supports, if these are known.

    Returns:
        True if there is an optimum, False if the constraints are infeasible.

    Raises:
        ModelError: a parameter has no value, or the solver does not have an option.
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
                if tight:  # the answer is judged by its residuals, not by its status
                    warnings.simplefilter("ignore")
                problem.solve(solver=one, **attempt)
        except cp.SolverError as error:
            failure = failure or str(error)
            continue
        except (TypeError, ValueError, AttributeError) as error:
            raise ModelError(f"cvxpy: {error}; keywords other than names of rows are options of "
                             "the solver") from error  # fmt: skip
        failure = f"the problem is {problem.status}"
        if problem.status in _SOLVED:
            return True
        if problem.status in _INFEASIBLE and (one is None or name not in _PLAIN):
            return False
    if str(problem.status) in _INFEASIBLE:
        return False
    raise SolverError(f"cvxpy: {failure}")


def _broken_rows(rows: Mapping[str, Any]) -> dict[str, float]:
    """Return each row's violation relative to its sides; 0 if within a solver's tolerance."""
    broken = dict[str, float]()
    for name, row in rows.items():
        off = max(float(np.max(row.violation(), initial=0.0)) - _EXCUSED, 0.0)
        largest = (float(np.abs(side.value).max(initial=0.0)) for side in row.args)
        broken[name] = off / max(*largest, off, _EXCUSED)
    return broken
