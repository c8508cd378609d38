"""Rows of a problem in cvxpy: expressions that are scaled, and rows at the values of a solution."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import cvxpy as cp
import numpy as np
from cvxpy.constraints.nonpos import Inequality
from cvxpy.constraints.zero import Equality

from ssp_lp.arrays import FloatArray
from ssp_lp.errors import ModelError
from ssp_lp.linear_programming.linear_program import MeasuredRow

_EXCUSED = 1e-7  # what a solver's tolerance breaks of a row


class ScaledExpression:
    """An affine expression of the visits of a ratio: what it is compared with is scaled, too.

    ``scaled`` is the expression of cvxpy's variables: the visits' value times ``scale``.
    """

    __array_ufunc__ = None  # numbers of numpy's go with it as others do

    def __init__(self, scaled: Any, scale: Any) -> None:
        """An expression that is already scaled, and the scale."""
        self.scaled, self._scale = scaled, scale

    def __array__(self, *_: object) -> None:
        """Refused: ``parameter * expression`` takes it for an array.

        Raises:
            ModelError: always.
        """
        raise ModelError("an expression of a cost given success stands to the left of what goes "
                         "with it: expression * parameter, expression <= parameter")  # fmt: skip

    def _other(self, other: Any) -> Any:
        """The other operand of a convex row: an expression of visits, a number or a parameter."""
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


def sides(row: Any, x: Any) -> tuple[Any, str, Any]:
    """Both sides of a convex row: what counts a variable, the sign, and the bound.

    Args:
        row: a constraint of cvxpy, <= or ==.
        x: the variable.
    """
    (left, right), relation = row.args, "<="
    if id(x) not in map(id, left.variables()):
        left, right, relation = right, left, ">="
    elif id(x) in map(id, right.variables()):
        left, right = left - right, cp.Constant(0.0)
    return left, "==" if isinstance(row, Equality) else relation, right


def affine_parts(expression: Any, x: Any, scale: Any) -> FloatArray | None:
    """Coefficients of a convex row's affine expression, of variable and scale, and its constant.

    Args:
        expression: one number of cvxpy's.
        x: the variable, which has a value.
        scale: the variable by which rows may be scaled, or a number: there is none.

    Returns:
        [entries + 2]; None where it is not affine, or counts other variables.
    """
    own = {id(x), id(scale)}
    if not expression.is_affine() or not own.issuperset(map(id, expression.variables())):
        return None
    variables = {id(variable): variable for variable in expression.variables()}
    values = {key: variable.value for key, variable in variables.items()}
    for variable in variables.values():
        variable.value = np.zeros(variable.shape)
    slopes = {id(variable): slope for variable, slope in expression.grad.items()}
    constant = float(np.ravel(expression.value)[0])
    for key, variable in variables.items():
        variable.value = values[key]
    taken: Any = slopes.get(id(x), 0.0)
    dense = taken.toarray() if hasattr(taken, "toarray") else taken
    beside = [float(slopes.get(id(scale), 0.0)), constant]
    return np.append(np.zeros(x.size) + np.ravel(dense), beside)


def bound_in_short(row: Any, x: Any) -> str:
    """The bound of a convex row in short, where it is one number."""
    if isinstance(row, Equality | Inequality):
        _, relation, bound = sides(row, x)
        if bound.value is not None and np.size(bound.value) == 1:
            return f"{relation} {np.ravel(bound.value)[0]:g}"
    return "as it is stated"


def measured_rows(
    rows: Mapping[str, Any], x: Any, scale: Any, value: float
) -> Iterator[MeasuredRow]:
    """Convex rows at the variables' values, entry by entry; only those with <= or ==.

    Args:
        rows: constraints by name.
        x: the variable that they count.
        scale: the variable by which rows may be scaled.
        value: of the scale.
    """
    for name, row in rows.items():
        if not isinstance(row, Equality | Inequality):
            continue
        spent, relation, bound = sides(row, x)
        unit = value if id(scale) in map(id, row.variables()) else 1.0
        worth = np.nan if row.dual_value is None else row.dual_value
        parts = np.broadcast_arrays(spent.value, bound.value, worth)
        for k, (each, limit, price) in enumerate(zip(*map(np.ravel, parts), strict=True)):
            label = name if parts[0].size == 1 else f"{name}[{k}]"
            duals = (None, None) if np.isnan(price) else (float(price), float(price * unit))
            yield MeasuredRow(label, float(each / unit), float(limit / unit), relation, *duals)


def broken_rows(rows: Mapping[str, Any]) -> dict[str, float]:
    """Violation of each convex row at the variables' values, relative to its sides; 0 if little."""
    broken = dict[str, float]()
    for name, row in rows.items():
        off = max(float(np.max(row.violation(), initial=0.0)) - _EXCUSED, 0.0)
        largest = (float(np.abs(side.value).max(initial=0.0)) for side in row.args)
        broken[name] = off / max(*largest, off, _EXCUSED)
    return broken
