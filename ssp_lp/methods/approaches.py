"""The table of approaches: each solves a class of problems and proves its solutions.

Each approach says which cases it can solve. ``solve`` and ``certify`` take the first one in the
table that can solve the case. :func:`refusal` explains why a method does not support a problem.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ssp_lp import options
from ssp_lp.analysis.evaluation import Evaluation
from ssp_lp.errors import Argument, ModelError
from ssp_lp.methods.columns import (
    best_within_budget,
    cheapest_at_least_failure,
    extreme_goal,
    prove_goal,
    prove_least_failure,
    prove_within_budget,
    solve_by_game,
)
from ssp_lp.methods.refinement import Proved
from ssp_lp.methods.risk import least_risk, prove_risk
from ssp_lp.methods.rounding import (
    coarser_unit,
    is_split,
    prove_by_units,
    solve_on_fine_lattice,
    solve_on_rounded_costs,
    solve_on_split_costs,
)
from ssp_lp.methods.rows import prove_limits, solve_constrained
from ssp_lp.policies.cost_aware import levels_of
from ssp_lp.problem import Problem, TotalScale
from ssp_lp.processes.failure_semantics import Aim
from ssp_lp.solution import Solution


@dataclass(frozen=True, eq=False)
class Case:
    """A problem to solve, or the problem of a solution whose bound must be proved."""

    problem: Problem
    seconds: float = np.inf  # time left
    by_program: bool = False  # by the full linear program
    on_levels: bool = False  # the policy remembers totals rounded to levels
    by_game: bool = False  # by the paper's construction, the game

    @staticmethod
    def of_solution(solution: Solution) -> Case:
        """Return the case of proving the bound of a solution.

        A solution without a value function may have been found with split costs, because time was
        short. Its case has no time left, so that the proof splits the costs as well.
        """
        seconds = 0.0 if solution.value_function is None else np.inf
        on_levels = levels_of(solution.policy.policies) is not None
        return Case(solution.problem, seconds, on_levels=on_levels)

    @property
    def has_cheapest_way(self) -> bool:
        """Whether the cost of the cheapest way to the goal gives a bound of the optimum."""
        return self.problem.counts_totals and self.problem.failure_budget is not None


@dataclass(frozen=True, eq=False)
class _Approach:
    """A way to solve a class of problems, and to prove a solution from the model alone."""

    answers: Callable[[Case], bool]
    solve: Callable[[Problem, options.SolveOptions], Solution]
    prove: Callable[[Solution, Evaluation, float], Proved]
    """Arguments: a solution, the evaluation of its policy, and the least failure of its members."""
    afresh: bool = False  # whether the proof uses no claims of the solution


def _is_on_rounded_costs(case: Case) -> bool:
    """Return whether the problem needs rounded costs because its total cost has too many values.

    Problems with constraints are never solved on rounded costs.
    """
    problem, written_out = case.problem, case.by_program or case.on_levels
    if problem.totals is not TotalScale.GRID or written_out:
        return False
    return problem.semantics.counts_law and not problem.has_rows


APPROACHES = (
    _Approach(lambda case: case.by_game, solve_by_game, prove_within_budget),
    _Approach(_is_on_rounded_costs, solve_on_rounded_costs, prove_by_units, afresh=True),
    _Approach(
        lambda case: not case.by_program and is_split(case.problem, case.seconds),
        solve_on_split_costs,
        prove_by_units,
        afresh=True,
    ),
    _Approach(
        lambda case: case.problem.semantics.risk is not None, least_risk, prove_risk, afresh=True
    ),
    _Approach(lambda case: case.problem.several_rows, solve_constrained, prove_limits),
    _Approach(
        lambda case: case.problem.semantics.aim is not Aim.LEAST_COST, extreme_goal, prove_goal
    ),
    _Approach(
        lambda case: case.problem.failure_budget is None,
        cheapest_at_least_failure,
        prove_least_failure,
    ),
    _Approach(
        lambda case: case.problem.ratio and coarser_unit(case.problem) is not None,
        solve_on_fine_lattice,
        prove_within_budget,
    ),
    _Approach(lambda case: True, best_within_budget, prove_within_budget),
)
"""The first approach that answers a case is taken."""


def approach_to(case: Case) -> _Approach:
    """Return the first approach of the table that can solve a case."""
    for approach in APPROACHES:
        if approach.answers(case):
            break
    return approach


def refusal(problem: Problem, method: options.Method) -> ModelError | None:
    """Return the error of a method that does not support a problem; None if it supports it."""
    if isinstance(method, options.ColumnGeneration | options.LinearProgramming):
        return None
    named = Argument("method", method.name)
    name = f"{type(problem).__name__}{' with limits' if problem.conditions else ''}"
    if isinstance(method, options.DeterministicPolicies) and (
        problem.several_rows or problem.totals is TotalScale.SUMS or problem.semantics.counts_law
    ):
        return ModelError(named, f" is not available for {name}")
    if not isinstance(method, options.Game):
        return None
    if problem.has_rows:
        return ModelError(named, f" supports no limits: use 'columns' or 'lp' for {name}")
    if problem.ratio and problem.cost_cap is not None:
        return ModelError("the game chooses its own cap M: leave ", Argument("cost_cap"), " out")
    if method.tail is not None and not problem.ratio:
        return ModelError(f"a tail is for a cost given success, not {name}: leave it out")
    from ssp_lp.game.optimum import checked_setting

    try:
        checked_setting(problem)
    except ModelError as error:
        return error
    return None
