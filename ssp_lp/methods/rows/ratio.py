"""Costs given success within rows: Dinkelbach's iteration over column generation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.column_generation.generation import Generated, generate
from ssp_lp.column_generation.stabilised_master import StabilisedMaster
from ssp_lp.errors import InfeasibleError, SolverError
from ssp_lp.options import SolveOptions

_RATIOS = 40  # steps of Dinkelbach's iteration
_SETTLED = 1e-14  # relative change of a ratio that is rounding
_STEEP = 1e3  # factor of a ratio at which nothing reached the goal
_STEEPEST = 1e15


def generated(
    compiled: CompiledConstrained, opened: StabilisedMaster, options: SolveOptions
) -> tuple[Generated, float]:
    """The best lottery over columns, and in case S its ratio (Dinkelbach's iteration)."""
    if not compiled.ratio:
        return generate(replace(opened), options), 0.0
    rule, best, ratio = opened, None, opened.rows.ratio
    for _ in range(_RATIOS):
        rule = replace(rule, rows=replace(opened.rows, ratio=ratio))
        found = generate(rule, options)
        attained = found.ratio
        if best is None and not np.isfinite(attained):
            ratio *= _STEEP
            if ratio > _STEEPEST:
                raise InfeasibleError(
                    "no policy that keeps to all limits reaches the goal: no cost given success "
                    "exists",
                    failure_budget=compiled.budget,
                    least_failure=max(1.0 - compiled.greatest_goal, 0.0),
                )
            rule = opened
            continue
        if best is not None and not attained < ratio * (1.0 - _SETTLED):
            return replace(found, columns=best.columns, weights=best.weights), ratio
        best, ratio, rule = found, attained, replace(rule, prices=found.prices, bound=0.0)
        if not found.finished or ratio == 0.0:
            break
    if best is None:
        raise SolverError("no policy that reaches the goal was found within the time limit")
    return best, ratio
