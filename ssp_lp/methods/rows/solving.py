"""From a problem with rows to its solution."""

from __future__ import annotations

import numpy as np

from ssp_lp.methods.assembling import Found, assembled
from ssp_lp.methods.rows.optimum import RowsOptimum, optimum_of
from ssp_lp.options import SolveOptions
from ssp_lp.problem import Problem, compiled_constrained
from ssp_lp.processes.quantities.conditions import FAILURE_ROW
from ssp_lp.solution import Run, Solution


def solve_constrained(problem: Problem, options: SolveOptions) -> Solution:
    """Solve a problem with constraints beside its failure budget.

    Args:
        problem: the problem; no measure of risk.
        options: method, tolerance and limits.

    Raises:
        InfeasibleError: no policy keeps to the failure budget and the limits; names the smallest
            conflict that was found.
        SolverError: the time ran out before any such policy was found, or the linear program's
            answer fails its check.
    """
    found = optimum_of(problem, compiled_constrained(problem), options)
    return _solution(problem, found, options)


def _solution(problem: Problem, found: RowsOptimum, options: SolveOptions) -> Solution:
    """The optimum in the problem's own terms."""
    compiled = found.compiled
    many = int(np.isfinite(compiled.bounds).sum())
    reason = f"column generation with {many} rows, {found.calls} pricing calls"
    if found.program:
        reason = f"the full linear program, as asked, then {reason}"
    if compiled.charge is not None:
        reason = f"{reason}, {compiled.layers:,} layers of accumulated cost"
    answer = Found(
        policy=found.policy,
        value=found.value,
        bound=found.bound,
        failure=found.failure,
        price=found.prices.get(FAILURE_ROW),
        values=found.values,
        prices=found.prices,
        note=found.note,
    )
    run = Run(options.method, reason, found.calls, 0.0, found.work, found.program)
    return assembled(problem, answer, run, compiled.sense)
