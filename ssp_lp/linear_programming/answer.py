"""A backend's answer to a linear program, with residuals recomputed from the program."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.linear_programming.linear_program import LinearProgram


@dataclass(frozen=True, eq=False)
class LPAnswer:
    """Primal and dual values; a row's dual is d objective / d right side."""

    backend: str
    x: FloatArray  # [columns]
    dual: FloatArray  # [rows]
    status: str
    seconds: float
    iterations: int | None = None  # of a simplex method that was given a basis to start from


@dataclass(frozen=True)
class Residuals:
    """How well an answer satisfies the program, each relative to the numbers at hand."""

    primal: float  # largest violation of a row or of x >= 0
    dual: float  # largest negative reduced cost
    gap: float  # between the primal and the dual objective

    @property
    def worst(self) -> float:
        """The largest of the three."""
        return max(self.primal, self.dual, self.gap)


def residuals(program: LinearProgram, answer: LPAnswer) -> Residuals:
    """Recompute primal and dual residuals and the duality gap; nan counts as infinite."""
    activity = program.matrix @ answer.x
    violation = np.maximum(program.lower - activity, activity - program.upper)
    primal = max(float(violation.max(initial=0.0)), float((-answer.x).max(initial=0.0)))
    reduced = program.cost - program.matrix.T @ answer.dual
    bounds = np.where(np.isfinite(program.upper), program.upper, program.lower)
    value, dual_value = float(program.cost @ answer.x), float(bounds @ answer.dual)
    figures = (
        primal / (1.0 + float(np.abs(answer.x).max(initial=0.0))),
        float((-reduced).max(initial=0.0)) / (1.0 + float(np.abs(answer.dual).max(initial=0.0))),
        abs(value - dual_value) / (1.0 + abs(value)),
    )
    return Residuals(*(f if np.isfinite(f) else float("inf") for f in figures))
