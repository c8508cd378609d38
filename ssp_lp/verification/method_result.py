"""A method: one way to an answer, with all that its answer can be judged by."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from ssp_lp.analysis.evaluation import Evaluation, evaluate_each
from ssp_lp.column_generation.compiled_problems.compiled_accumulated_cost import (
    CompiledAccumulatedCost,
)
from ssp_lp.errors import InfeasibleError, ModelError, SolverError
from ssp_lp.game.setting import checked_setting
from ssp_lp.options import LinearProgramming, parse_method
from ssp_lp.problem import Problem
from ssp_lp.solution import Solution
from ssp_lp.solve import solve
from ssp_lp.verification.certificate import failure_of

METHODS = ("lp", "columns", "game")

MOST_COLUMNS = 60_000
"""Largest program that is solved from nothing. The paper's robot has 24,000 columns in case M,
seconds for an interior point; case S has one to two millions, which take it many minutes."""


@dataclass(frozen=True)
class Member:
    """A deterministic member of a method's lottery, evaluated on the model."""

    weight: float
    cost: float  # J_obj: case M E[r_tau], case S E[cost; goal]; discounted where the problem is
    failure: float  # J_cond: what the budget limits


@dataclass(frozen=True)
class MethodResult:
    """What one method says. A method that gave no answer has a note and no numbers."""

    name: str
    note: str = ""
    failed: bool = False  # it was asked and gave no answer
    infeasible: InfeasibleError | None = None  # what it raised, where no policy keeps the budget
    objective: float | None = None  # c*
    lower_bound: float | None = None
    gap: float | None = None
    adversary_weight: float | None = None  # alpha*
    failure_price: float | None = None
    evaluated: float | None = None  # objective of the policy, evaluated on the model
    failure_probability: float | None = None
    discounted_failure: float | None = None
    expected_cost: float | None = None
    conditional_cost: float | None = None
    members: tuple[Member, ...] = ()
    seconds: float | None = None

    @property
    def answered(self) -> bool:
        """Whether there is an answer to compare."""
        return self.objective is not None

    @property
    def least_failure(self) -> float | None:
        """The least failure, as limited by the budget, of a method that says infeasible."""
        error = self.infeasible
        if error is None:
            return None
        surrogate = error.least_discounted_failure
        return error.least_failure if surrogate is None else surrogate

    @property
    def spent(self) -> float | None:
        """The failure that the budget limits: discounted under a discount, else the real one."""
        surrogate = self.discounted_failure
        return self.failure_probability if surrogate is None else surrogate


def result_of(name: str, solution: Solution) -> MethodResult:
    """The row of a solution, its policy and each member evaluated on the model."""
    found, each = evaluate_each(solution.policy, solution.problem)
    return MethodResult(
        name=name,
        note="; ".join(part for part in (solution.note, solution.run.program) if part),
        objective=solution.objective,
        lower_bound=solution.lower_bound,
        gap=solution.gap,
        adversary_weight=solution.adversary_weight,
        failure_price=solution.failure_price,
        evaluated=found.objective,
        failure_probability=found.failure_probability,
        discounted_failure=found.discounted_failure,
        expected_cost=found.expected_cost,
        conditional_cost=found.conditional_cost,
        members=_members_of_result(solution, each),
        seconds=solution.seconds,
    )


def result_by(
    name: str, problem: Problem, lp_backend: str | None = None, time_limit: float | None = None
) -> MethodResult:
    """Ask one method, unless it cannot be asked.

    Args:
        name: "lp", "columns" or "game".
        problem: the problem.
        lp_backend: the solver of the linear program, whatever its size; None: chosen by size.
        time_limit: seconds for this method.
    """
    method, reason = parse_method(name), ""
    if name == LinearProgramming.name:
        backend, reason = _program_backend(problem, lp_backend)
        method = LinearProgramming(backend)
    elif name == "game":
        reason = _game_reason(problem)
    if reason:
        return MethodResult(name, note=f"not asked: {reason}")
    began = time.perf_counter()
    try:
        solution = solve(problem, method, time_limit=time_limit)
    except InfeasibleError as error:
        result = MethodResult(name, note=f"infeasible: {error}", failed=True, infeasible=error)
    except (SolverError, ModelError) as error:
        if isinstance(error, ModelError) and name != "game":
            raise  # the model is at fault, not the size of this method's table
        result = MethodResult(name, note=f"failed: {error}", failed=True)
    else:
        result = result_of(name, solution)
    return replace(result, seconds=time.perf_counter() - began)


def _members_of_result(solution: Solution, each: list[Evaluation]) -> tuple[Member, ...]:
    """Each member of a lottery by itself."""
    members = []
    for found, weight in zip(each, solution.policy.weights, strict=True):
        failure, cost = failure_of(found), found.objective
        if solution.problem.ratio:
            cost = cost * (1.0 - failure) if failure < 1.0 else 0.0
        members.append(Member(float(weight), cost, failure))
    return tuple(members)


def _game_reason(problem: Problem) -> str:
    """Why the game cannot be asked; empty if it can."""
    try:
        checked_setting(problem)
    except ModelError as error:
        return str(error)
    compiled = problem.compile()
    if isinstance(compiled, CompiledAccumulatedCost) and compiled.fixed_cap is not None:
        return "the game chooses its own cap M: leave cost_cap out"
    return ""


def _program_backend(problem: Problem, asked: str | None) -> tuple[str | None, str]:
    """The backend for a problem's program, and why the program is not solved at all."""
    if problem.failure_budget is None:
        return None, "at least failure there is one method, the two stages of column generation"
    if asked is not None:
        return asked, ""
    columns = _columns_of_method(problem)
    if columns <= MOST_COLUMNS:
        return None, ""
    return None, f"{columns:,} columns are too many to solve from nothing"


def _columns_of_method(problem: Problem) -> int:
    """Columns of the first program that the LP method would solve."""
    compiled = problem.compile().for_program()
    if isinstance(compiled, CompiledAccumulatedCost):
        return compiled.process.cap * len(compiled.base.quotient.pair_at)
    return compiled.explicit().n_pairs
