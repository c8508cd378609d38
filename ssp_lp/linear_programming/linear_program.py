"""A linear program with named rows, as arrays, and an answer with its residuals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import BoolArray, FloatArray
from ssp_lp.errors import is_number, wrong_argument


@dataclass(frozen=True, eq=False)
class LinearProgram:
    """``minimise cost @ x`` with ``lower <= matrix @ x <= upper`` and ``x >= 0``, rows named."""

    cost: FloatArray  # [columns]
    matrix: sp.csc_array  # [rows, columns]
    lower: FloatArray  # [rows]
    upper: FloatArray  # [rows]
    rows: Mapping[str, slice]  # "balance", the limited rows and, in case S, "normaliser"

    @property
    def equality(self) -> BoolArray:
        """Rows of the linear program that are equations, [rows]."""
        return np.asarray(self.lower == self.upper)


@dataclass(frozen=True, eq=False)
class LPAnswer:
    """Primal and dual values; a row's dual is d objective / d right side."""

    backend: str
    x: FloatArray  # [columns]
    dual: FloatArray  # [rows]
    status: str
    seconds: float
    basis: BoolArray | None = None  # [columns + rows] those that are basic; None: not a vertex


class MeasuredRow(NamedTuple):
    """A row at a measure: what is spent, and what its bound is worth."""

    name: str
    spent: float
    bound: float
    relation: str = "<="
    price: float | None = None  # its multiplier; None: nothing is known of it
    dual: float | None = None  # what another unit of its bound improves: the price, in case M

    @property
    def slack(self) -> float:
        """Slack of a linear program's row: what is left of its bound."""
        return self.spent - self.bound if self.relation == ">=" else self.bound - self.spent

    def __str__(self) -> str:
        """The row with its numbers for its words."""
        worth = "" if self.price is None else f"   price {self.price:.6g}"
        if self.dual is not None and self.dual != self.price:
            worth += f" of the ratio: {self.dual:.6g} for another unit of the bound"
        return f"{self.name}: {self.spent:.9g} {self.relation} {self.bound:g}{worth}"


def check_bounds(bounds: Mapping[str, object]) -> None:
    """Raise :class:`ModelError`, naming the row, unless a linear program's bounds are numbers."""
    for name, bound in bounds.items():
        if not (is_number(bound) and float(bound) > -np.inf):
            raise wrong_argument(name, "be a number, the bound of its row", bound)


def answer_faults(program: LinearProgram, answer: LPAnswer) -> tuple[float, float]:
    """How well an answer satisfies a program, and how much that may be worth in the objective.

    Where a process is left with probability 1e-6 a step, what a row misses by counts a million
    times: in the objective violations are priced at the duals, negative reduced costs at the
    visits.

    Returns:
        The largest of the violation of a row or of x >= 0, the negative reduced cost, and the gap
        between the primal and the dual objective, each relative to the numbers at hand, nan
        counting as infinite; and what is worth most, relative to the objective.
    """
    x, dual, activity = answer.x, answer.dual, program.matrix @ answer.x
    short = np.maximum(np.maximum(program.lower - activity, activity - program.upper), 0.0)
    negative = np.maximum(program.matrix.T @ dual - program.cost, 0.0)  # reduced costs below 0
    bounds = np.where(np.isfinite(program.upper), program.upper, program.lower)
    value, dual_value = float(program.cost @ x), float(bounds @ dual)
    missed = max(float(short.max(initial=0.0)), float((-x).max(initial=0.0)))
    residuals = np.array(
        [
            missed / (1.0 + float(np.abs(x).max(initial=0.0))),
            float(negative.max(initial=0.0)) / (1.0 + float(np.abs(dual).max(initial=0.0))),
            abs(value - dual_value) / (1.0 + abs(value)),
        ]
    )
    worst = float(np.where(np.isfinite(residuals), residuals, np.inf).max())
    worth = float(np.append(short * np.abs(dual), negative * np.maximum(x, 0.0)).max(initial=0.0))
    return worst, worth / (1.0 + abs(value))
