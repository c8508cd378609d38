"""From a problem with rows to its solution."""

from __future__ import annotations

import numpy as np

from ssp_lp.analysis.evaluation import Evaluation, evaluate
from ssp_lp.arrays import FloatArray
from ssp_lp.column_generation.compiled_problems.constrained import CompiledConstrained
from ssp_lp.methods.assembling import assembled
from ssp_lp.methods.rows.optimum import RowsOptimum, Truth, rows_optimum
from ssp_lp.options import SolveOptions
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.policy import Policy
from ssp_lp.problem import Problem, compiled_constrained
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
    compiled = found.compiled
    many = int(np.isfinite(compiled.bounds).sum())
    reason = f"column generation with {many} rows, {found.calls} pricing calls"
    if found.program:
        reason = f"the full linear program, as asked, then {reason}"
    if compiled.charge is not None:
        reason = f"{reason}, {compiled.layers:,} layers of accumulated cost"
    run = Run(options.method, reason, found.calls, 0.0, found.work, found.program)
    return assembled(problem, found, run, compiled.sense)


def optimum_of(problem: Problem, stated: CompiledConstrained, options: SolveOptions) -> RowsOptimum:
    """The best lottery within all rows, its value taken from its own evaluation."""
    return rows_optimum(stated, options, _truth(problem, stated))


def _truth(problem: Problem, stated: CompiledConstrained) -> Truth | None:
    """What policies are worth on the model itself, where the process truncates them."""
    if stated.charge is None:
        return None

    def value(policy: MixedPolicy) -> float:
        """Of a lottery, in what is minimised."""
        attained = evaluate(policy, problem).objective
        return attained if stated.sense.constant is None else stated.sense.constant - attained

    def figures(policy: Policy) -> FloatArray:
        """Cost, failure and rows of one policy."""
        found = evaluate(policy, problem)
        failure = found.discounted_failure
        failure = found.failure_probability if failure is None else failure
        cost = found.objective * (1.0 - failure) if failure < 1.0 else 0.0
        if not stated.ratio:
            cost = value(MixedPolicy((policy,), np.ones(1)))
        return np.array([cost, failure, *taken(stated, found)])

    return Truth(value, figures)


def taken(stated: CompiledConstrained, found: Evaluation) -> list[float]:
    """What a policy takes of each row beside failure."""
    spent = found.secondary_costs
    return [row.activity(spent[row.condition.name]) for row in stated.side]
