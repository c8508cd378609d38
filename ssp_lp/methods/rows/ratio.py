"""Costs given success within rows: Dinkelbach's iteration over column generation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.column_generation.constrained_search import Generated, Pace, Pool, generate
from ssp_lp.errors import InfeasibleError, SolverError
from ssp_lp.methods.rows.opening import Opening

_RATIOS = 40  # steps of Dinkelbach's iteration
_SETTLED = 1e-14  # relative change of a ratio that is rounding
_STEEP = 1e3  # factor of a ratio at which nothing reached the goal
_STEEPEST = 1e15


def generated(
    compiled: CompiledConstrained,
    opened: Opening,
    pace: Pace,
    centre: tuple[FloatArray, float],
) -> tuple[Generated, float]:
    """The best lottery over columns, and in case S its ratio (Dinkelbach's iteration)."""
    if not compiled.ratio:
        return generate(opened.pool, opened.rows, pace, centre=centre), 0.0
    pool, ratio, best = opened.pool, opened.rows.ratio, None
    if ratio == 0.0:
        ratio = _first_ratio(pool, opened.weights)
    for _ in range(_RATIOS):
        rows = replace(opened.rows, ratio=ratio)
        found = generate(pool, rows, pace, centre=centre)
        attained = _ratio_of(pool, found.master.weights)
        if best is None and not np.isfinite(attained):
            ratio *= _STEEP
            if ratio > _STEEPEST:
                raise InfeasibleError(
                    "no policy that keeps to all limits reaches the goal: no cost given success "
                    "exists",
                    failure_budget=compiled.budget,
                    least_failure=max(1.0 - compiled.greatest_goal, 0.0),
                )
            continue
        if best is not None and not attained < ratio * (1.0 - _SETTLED):
            kept = replace(best.master, weights=_padded(best.master.weights, pool))
            return replace(found, master=kept), ratio
        best, ratio, centre = found, attained, (found.prices, 0.0)
        if not found.finished or ratio == 0.0:
            break
    if best is None:
        raise SolverError("no policy that reaches the goal was found within the time limit")
    return replace(
        best, master=replace(best.master, weights=_padded(best.master.weights, pool))
    ), ratio


def _first_ratio(pool: Pool, weights: FloatArray) -> float:
    """A ratio to begin with: that of the known lottery, or some policy's."""
    attained = _ratio_of(pool, weights)
    if np.isfinite(attained) and attained > 0.0:
        return attained
    with np.errstate(divide="ignore", invalid="ignore"):
        known = pool.figures[0] / (1.0 - pool.figures[1])
    known = known[np.isfinite(known) & (known > 0.0)]
    return float(known.max()) if known.size else 1.0


def _ratio_of(pool: Pool, weights: FloatArray) -> float:
    """Cost given success of a lottery over the first columns; infinite where there is none."""
    cost, failure = pool.figures[:2, : weights.size] @ weights
    return float(cost / (1.0 - failure)) if failure < 1.0 - 1e-12 else float("inf")


def _padded(weights: FloatArray, pool: Pool) -> FloatArray:
    return np.append(weights, np.zeros(len(pool.columns) - weights.size))
