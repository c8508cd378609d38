"""``solve``: solve a problem by a method and return a proved solution."""

from __future__ import annotations

import logging
import time
from contextlib import suppress
from dataclasses import replace
from functools import partial
from math import isfinite

import numpy as np

from ssp_lp.accumulated_cost.policy_layers import giving_up_where_lost
from ssp_lp.analysis.evaluation import evaluate
from ssp_lp.arrays import LEAST_BUDGET, RELATIVE_GAP
from ssp_lp.compiled.deadline import (
    Deadline,
    Stop,
    WithIncumbent,
    closing,
    ensure_incumbent,
    interrupted,
    until,
)
from ssp_lp.dynamic_programming.evaluation import PROVED_OF_MANY
from ssp_lp.errors import ModelError, OutOfTimeError, SolverError
from ssp_lp.methods.approaches import Case, approach_to, refusal
from ssp_lp.methods.incumbent import Incumbent, broken_limit
from ssp_lp.model.arguments import explained
from ssp_lp.model.ssp import ImplicitSSP
from ssp_lp.options import (
    Game,
    Method,
    Progress,
    SolveOptions,
    options_of,
    parse_method,
    progress_shown,
)
from ssp_lp.problem import Problem, check_problem, least_failure_bound, pulled_back
from ssp_lp.processes.conditions import Condition
from ssp_lp.processes.failure_semantics import GiveUp, goal_out_of_reach
from ssp_lp.reductions.exploration import explore
from ssp_lp.reductions.robust import robust
from ssp_lp.reductions.rounded_totals import rounded_down, solve_rounded
from ssp_lp.solution import Solution

_ROUNDING = 1e-12  # of sums of probabilities, and of a row relative to its size
_SEARCH, _PROOF = logging.getLogger("ssp_lp.search"), logging.getLogger("ssp_lp.proof")


@explained
def solve(
    problem: Problem,
    method: Method | str | None = None,
    *,
    tolerance: float = RELATIVE_GAP,
    time_limit: float | None = None,
    progress: Progress | None = None,
    verbose: bool = False,
) -> Solution:
    """Solve a problem to a certified relative gap.

    Args:
        problem: a formulation, such as ``MCMP(...)`` or ``S3P(...)``.
        method: ``ColumnGeneration()`` (the default), ``LinearProgramming(backend)``, ``Game()`` or
            ``DeterministicPolicies(...)``; or the name of one with its defaults: "columns", "lp",
            "game", "deterministic".
        tolerance: relative gap to reach.
        time_limit: seconds after which the best policy so far is returned with its certified gap,
            if one that satisfies all limits was found. Ctrl-C has the same effect at once;
            ``Solution.status`` says why the call ended.
        progress: called after each pricing call with (calls, failure price, objective).
        verbose: show each phase and how far it has come (``progress_shown``).

    Returns:
        The solution, with every number recomputed from the model. ``upper_bound`` is the certified
        bound if a probability is maximised, ``lower_bound`` in all other problems.

    Raises:
        ModelError: a wrong argument, or a method that does not support the problem.
        InfeasibleError: the budget is below the least failure probability, which the error carries,
            a constraint cannot be satisfied, or failing is forbidden and cannot be avoided.
        SolverError: the method's answer does not pass its check.
        OutOfTimeError: the time limit passed before a policy was found.
        KeyboardInterrupt: Ctrl-C came before a policy was found.
    """
    check_problem(problem, "solve")
    is_explored = isinstance(problem.model, ImplicitSSP)
    if is_explored or problem.box is not None:
        each = partial(solve, method=method, tolerance=tolerance, progress=progress)
        with progress_shown(verbose):
            return (explore if is_explored else robust)(problem, each, time_limit)
    began, chosen = time.perf_counter(), parse_method(method)
    options = options_of(chosen, tolerance, began, time_limit, progress)
    if (refused := refusal(problem, chosen)) is not None:
        raise refused

    once = partial(_solved_with_proof, method=chosen, options=options)
    with progress_shown(verbose):
        down = rounded_down(problem) if problem.tracked is not problem else None
        found = once(problem) if down is None else solve_rounded(problem, down, once, tolerance)
    reason = found.run.reason
    if method is None:
        reason = reason.replace("as asked", "which scales best for one failure row")
    seconds = time.perf_counter() - began
    run = replace(found.run, reason=reason, seconds=seconds, time_limit=time_limit)
    return replace(found, problem=problem, policy=pulled_back(found.policy, problem), run=run)


def _solved_with_proof(problem: Problem, method: Method, options: SolveOptions) -> Solution:
    """Solve a problem, and check the answer."""
    solution: Solution | None = None
    too_large: ModelError | None = None
    incumbent, inner = Incumbent(problem, options.deterministic), problem
    with until(options.deadline, prepare=incumbent.find) as deadline:
        with WithIncumbent() as search:
            inner, left = problem.unrolled, options.deadline - time.perf_counter()
            if left < 1.0:  # compiling a large process may take longer
                ensure_incumbent()
            by_program, by_game = options.program is not None, isinstance(method, Game)
            case = Case(inner, left, by_program, by_game=by_game)
            try:
                solution = approach_to(case).solve(inner, options)
            except ModelError as error:
                if inner.semantics.risk is None:
                    raise
                too_large = error  # a table of totals: return the incumbent
        if solution is None or not isfinite(solution.objective):
            with WithIncumbent(), closing():
                incumbent.find()
            if solution is None or incumbent.solution is None:
                solution = incumbent.solution  # or keep its bound, with that policy below
        if solution is None:
            raise too_large or _error_without_answer(problem, deadline, search.stop) from None
        if inner.failure_budget is None and solution.least_failure_bound is None:
            with WithIncumbent():
                bound = least_failure_bound(inner)
                solution = replace(solution, least_failure_bound=bound)
        if not problem.has_rows and problem.semantics.give_up is not GiveUp.DEAD_ENDS:
            with WithIncumbent():
                policy = giving_up_where_lost(solution.policy)
                if policy is not solution.policy:
                    solution = replace(solution, policy=policy)
        if deadline.was_met:
            with WithIncumbent(), closing():
                solution = incumbent.improving(solution)
    _check_solution(solution, None if deadline.was_met else options.deadline)
    figures = solution.run.method, solution.run.pricing_calls, solution.objective
    _SEARCH.info("%s: %d pricing calls, objective %.9g", *figures)
    bound = solution.lower_bound if solution.upper_bound is None else solution.upper_bound
    _PROOF.info("bound %.9g, relative gap %.1e", bound, solution.gap)
    notes, tolerance = [solution.note], options.tolerance
    if solution.budget_used >= 1.0:
        notes.insert(0, goal_out_of_reach(inner.model, inner.start_mass))
    if solution.least_failure_bound is not None and solution.failure_gap > PROVED_OF_MANY:
        shown = f"{solution.failure_gap:.1e}: some policy may fail less than this one"
        notes.append(f"the least failure is proved only up to {shown}")
    elif not any(notes) and solution.gap > tolerance:
        notes.append(f"the gap of {solution.gap:.1e} misses the tolerance of {tolerance:g}")
    demanding = [limit for limit in inner.conditions if limit.lower is not None]
    if demanding:
        strictest = max(demanding, key=lambda limit: limit.least_goal)
        notes.append(_redundant_budget(inner.failure_budget, strictest))
    note, status = "; ".join(filter(None, notes)), deadline.status(solution.gap, tolerance)
    if (note, status) == (solution.note, solution.status):
        return solution
    return replace(solution, note=note, status=status)


def _redundant_budget(budget: float | None, limit: Condition) -> str:
    """Return a note on a failure budget that a limit makes redundant, else an empty text."""
    least = limit.least_goal
    if budget is None or budget >= 1.0 or least <= 1.0 - budget + LEAST_BUDGET:
        return ""
    told = f"limit {limit.name!r} lets at most {1.0 - least:.6g} fail"
    return f"the failure budget of {budget:g} is redundant: {told}"


def _error_without_answer(
    problem: Problem, deadline: Deadline, stop: BaseException | None
) -> BaseException:
    """Return the error of ``solve`` if the time ended before a policy was found."""
    progress = stop.note if isinstance(stop, Stop) else ""
    if deadline.is_interrupted:
        return interrupted(progress)
    progress, model = progress or "no policy was evaluated", problem.model
    size = f"the model has {model.n_states:,} states and {model.n_outcomes:,} outcomes"
    return OutOfTimeError(
        f"the time limit of {max(deadline.at - deadline.began, 0.0):.3g} s ended before a policy "
        f"that satisfies all limits was found ({progress}; {size}): allow more time"
    )


def _check_solution(solution: Solution, deadline: float | None) -> None:
    """Check the properties that every answer of ``solve`` must have, by whatever method.

    Args:
        solution: the answer.
        deadline: time at which evaluating the policy's limits must end; None: it is not evaluated.

    Raises:
        SolverError: a probability outside [0, 1], a violated budget or limit, weights that are no
            lottery, or a value that is not a number.
    """
    budget, used = solution.problem.failure_budget, solution.budget_used
    weights = solution.policy.weights.tolist()
    faults = []
    if not isfinite(solution.objective):
        faults.append(f"its value is {solution.objective!r}")
    if not 0.0 <= used <= 1.0 + _ROUNDING:
        faults.append(f"its failure is {used!r}")
    if budget is not None and used > budget + LEAST_BUDGET:
        faults.append(f"its failure is {used!r}, {budget!r} allowed")
    if not (min(weights) >= 0.0 and abs(sum(weights) - 1.0) <= _ROUNDING):
        faults.append("its weights are no probabilities")
    taken, granted = solution.taken, solution.granted
    for condition in solution.problem.conditions if taken else ():
        for row in (each.by_digits for each in condition.rows):
            most = granted.get(row.name, row.bound)
            if taken.get(row.name, np.inf) > most + _ROUNDING * row.size:
                faults.append(
                    f"it takes {taken[row.name]!r} of {row.text!r}, {row.bound!r} allowed"
                )
    if not taken and solution.problem.conditions and deadline is not None and not faults:
        left = deadline - time.perf_counter()
        with suppress(OutOfTimeError, ModelError):  # a law with too many totals
            limit = left if isfinite(left) else None
            evaluation = evaluate(solution.policy, solution.problem, time_limit=limit)
            broken = broken_limit(solution.problem, evaluation, raised_bounds=granted)
            faults += [broken] if broken else []
    if faults:
        raise SolverError(
            f"the answer fails its check: {', '.join(faults)}; please report the model"
        )
