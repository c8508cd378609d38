"""Problems without limits other than a failure budget: column generation with refinement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssp_lp.analysis.evaluation import Evaluation, evaluate
from ssp_lp.arrays import BELOW_RATIO, LEAST_BUDGET, RELATIVE_GAP, expected
from ssp_lp.column_generation.column import CONTRADICTION, FailureRow, relative_gap
from ssp_lp.column_generation.compiled_problem import (
    CompiledExplicit,
    CompiledProblem,
    LeastFailure,
    checked_least_failure,
)
from ssp_lp.column_generation.search import (
    DualGuess,
    Pool,
    certified,
    columns_by_pricing,
    generate,
    master_at,
)
from ssp_lp.compiled.deadline import (
    Stop,
    WithIncumbent,
    closing,
    ensure_incumbent,
    is_late,
    prepared,
)
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import ModelError
from ssp_lp.methods.full_program import check_agreement, solve_program
from ssp_lp.methods.refinement import (
    SPREAD,
    TRIAL_TOLERANCE,
    Optimum,
    Proved,
    finer_optima,
    proved_objective,
    refine,
)
from ssp_lp.options import CERTIFYING, Game, SolveOptions
from ssp_lp.policies import DeterministicPolicy
from ssp_lp.policies.cost_aware import levels_of
from ssp_lp.problem import Problem
from ssp_lp.processes.conditions import FAILURE_ROW
from ssp_lp.processes.failure_semantics import Aim, FailureSemantics, ObjectiveSense
from ssp_lp.processes.goal_reach import extreme_goal_reach
from ssp_lp.solution import Answer, Run, Solution, assembled, remarks

_REASONS = {
    "columns": "column generation, as asked",
    "unlimited": "no failure row: policy iteration at one price",
    "lp": "the full linear program, as asked; lottery recovered by pricing at its dual",
}


def extreme_goal(problem: Problem, options: SolveOptions) -> Solution:
    """Solve for the greatest or least goal probability by policy iteration.

    If ``options`` choose the full linear program, it is solved as well, as a check.
    """
    aim, start = problem.semantics.aim, problem.start_mass
    reach = extreme_goal_reach(problem.model, aim, start)
    objective, bound = float(expected(start, reach.goal)), float(expected(start, reach.bound))
    greatest, reason, program = aim is Aim.GREATEST_GOAL, "one stage: policy iteration", ""
    if options.program is not None:
        process = problem.compile().explicit()
        limits = {FAILURE_ROW: (process.failure, 1.0)}
        optimum = solve_program(process, limits, options, ratio=False)
        check_agreement(optimum, 1.0 - objective if greatest else objective)
        reason, program = "the full linear program agrees with policy iteration", optimum.report
    policy = DeterministicPolicy(problem.model, reach.decision)
    sign = -1.0 if greatest else 1.0
    answer = Answer(policy, sign * objective, sign * bound, max(1.0 - objective, 0.0))
    run = Run(options.method, reason, 1, 0.0, program=program)
    return assembled(problem, answer, run, ObjectiveSense(0.0 if greatest else None))


def cheapest_at_least_failure(problem: Problem, options: SolveOptions) -> Solution:
    """Solve for the cheapest policy of greatest goal probability, in two stages.

    Raises:
        InfeasibleError: case S, and the goal cannot be reached.
    """
    safest = checked_least_failure(problem.compile(), None)
    row = FailureRow(safest.column.failure, problem.ratio)
    objective = row.objective(safest.column.cost, safest.column.goal)
    then = "greatest worth" if problem.semantics.maximises else "least cost"
    reason = f"two stages: greatest goal probability, then {then}"
    found = safest.policy, objective, safest.objective_bound, safest.column.failure
    answer = Answer(*found, least_failure_bound=safest.proved)
    run = Run(replace(options, program=None).method, reason, 2, 0.0)
    return assembled(problem, answer, run, problem.semantics.sense)


_LEAST_TOLERANCE = 1e-15
_UNSETTLED = "the utility is not close to its limit at the cap on costs, which leaves a gap"


def best_within_budget(
    problem: Problem, options: SolveOptions, guess: DualGuess | None = None
) -> Solution:
    """Solve within a failure budget: return the best lottery, or the best deterministic policy.

    Args:
        problem: the problem.
        options: tolerance, limits, and whether the policy must be deterministic.
        guess: a guess of the price of failure, or None.

    Raises:
        InfeasibleError: no policy satisfies the budget.
        SolverError: the solution of the linear program fails its check.
    """
    budget, sense = problem.failure_budget, problem.semantics.sense
    budget = 1.0 if budget is None else budget
    compiled = problem.compile()
    if guess is not None:
        compiled = compiled.capped_at((1.0 + guess.spread) * guess.price)
    optimum = refined_optimum(compiled, budget, options, guess)
    worth, bound = sense.stated(optimum.value), sense.stated(optimum.bound)
    gained, is_met = -optimum.value, relative_gap(bound, worth) <= options.tolerance
    if sense.constant and 0.0 < abs(worth) < gained and not is_met:  # cancellation in the worth
        finer = max(options.tolerance * abs(worth) / gained, _LEAST_TOLERANCE)
        exactly = replace(options, tolerance=finer)
        optimum = optimum.followed_by(refined_optimum(optimum.compiled, budget, exactly))
    compiled, unlimited = optimum.compiled, not problem.ratio and optimum.row.required <= 0.0
    relaxed = "lp" if options.program is not None else "unlimited" if unlimited else "columns"
    reason = _REASONS[relaxed]
    if sense.constant is not None:
        reason = f"backward sweeps over {compiled.layers:,} layers of accumulated cost"
        if compiled.cost_horizon > 0.0:
            reason = f"{reason}, exact from cost {compiled.cost_horizon:.6g} on"
    reason = f"{reason}, {optimum.calls} pricing calls"
    notes = [remarks(problem, optimum.row.budget, optimum.generated.finished)]
    if compiled.charge is not None and compiled.charge.affine_from_total is None:
        notes += [_UNSETTLED] * (optimum.gap > options.tolerance)
    note = "; ".join(filter(None, notes))
    answer = replace(optimum, note=note) if note else optimum
    run = Run(options.method, reason, optimum.calls, 0.0, optimum.work, optimum.program)
    solution = assembled(problem, answer, run, sense)
    if not options.deterministic:
        return solution
    from ssp_lp.methods.deterministic import best_deterministic

    reason += "; then one policy by branch and bound"
    single = best_deterministic(solution, optimum, options.tolerance)
    return replace(single, run=replace(single.run, reason=reason, deterministic=True))


def prove_goal(solution: Solution, evaluation: Evaluation, _: float) -> Proved:
    """Prove an upper or lower bound of the goal probability."""
    problem = solution.problem
    start = problem.start_mass
    reach = extreme_goal_reach(problem.model, problem.semantics.aim, start)
    return Proved(evaluation.objective, float(start @ reach.bound), 1.0)


_STEEP_PRICES = (1e1, 1e3, 1e5)
"""Prices of failure, in units of the objective, at which least failure is proved optimal."""

_LITTLE = 1e-13  # relative loss of the bound by the cap that is accepted
_SURELY = 1.0 - 1e-9  # share of the budget: a lower failure proves that the least is below it


def prove_least_failure(solution: Solution, evaluation: Evaluation, _: float) -> Proved:
    """Prove a lower bound of the cost of policies of least failure.

    Without accumulated cost the bound is proved at a high price of failure, and holds for every
    policy. With accumulated cost, or if rounding leaves a gap at every price, the bound comes from
    the second stage. It then holds for the policies that use only the pairs that were found to
    attain the greatest goal probability.
    """
    compiled, sense = solution.problem.compile(), solution.problem.semantics.sense
    safest = compiled.least_failure()
    allowed, bound = safest.column.failure, safest.objective_bound
    if compiled.charge is None and np.isfinite(evaluation.objective):
        pricing, column = compiled.pricing(), None
        for steps in _STEEP_PRICES:
            price = steps * max(evaluation.objective, 1.0)
            column = pricing.minimise(price, column)
            priced = FailureRow(allowed, ratio=False).lower_bound(pricing.prove(price, column))
            if relative_gap(evaluation.objective, priced) <= RELATIVE_GAP:
                bound = priced
                break
    proved = proved_objective(sense, evaluation.objective, bound, allowed)
    return replace(proved, least_failure_bound=safest.proved)


def prove_within_budget(solution: Solution, evaluation: Evaluation, attained: float) -> Proved:
    """Prove a lower bound of the objective from a solution's price of failure and values.

    Args:
        solution: the solution to certify.
        evaluation: evaluation of its policy.
        attained: the least failure probability among the policies of the solution's lottery.

    Raises:
        ModelError: the solution has no price and value function, or these do not fit the problem.
    """
    problem, budget = solution.problem, max(solution.problem.failure_budget or 0.0, 0.0)
    is_priced = not solution.run.deterministic or solution.failure_price is not None
    if not is_priced:  # the bound is that of lotteries: solve for their prices
        solution = best_within_budget(problem, CERTIFYING)
    sense, price, values = problem.semantics.sense, solution.failure_price, solution.value_function
    if price is None or values is None:
        raise ModelError("the solution lacks a price or a value function: solve the problem again")
    penalty = problem.semantics.penalty  # part of the cost, not of the failure row's price
    price = 0.0 if price == penalty else price - penalty
    if not (np.isfinite(price) and price >= 0.0):
        reason = f"the price is not a number >= {penalty:g}"
        return Proved(evaluation.objective, sense.stated(0.0), budget, reason)
    kappa = price
    if problem.ratio and evaluation.goal_probability > 0:
        kappa += evaluation.objective if is_priced else solution.objective
    levels = levels_of(solution.policy.policies, len(values))
    compiled, least = problem.compile().matching(np.asarray(values), levels), None
    compiled = compiled.counting_rare_success(budget)
    row = FailureRow(budget, problem.ratio, compiled.lowest)
    if attained >= budget * _SURELY:
        least = compiled.least_failure()
        if least.column.failure <= budget + LEAST_BUDGET:
            row = row.raised_to(least.column)  # by rounding only
    bound, tail = _bound_by_values(compiled, row, kappa, price == 0.0, solution)
    if tail > _LITTLE and (exact := compiled.for_program()) is not compiled:
        # better tails may reduce the loss by the cap
        bound, tail = _bound_by_values(exact, row, kappa, price == 0.0, solution)
    is_least = least is not None and least.is_proved and row.equals_least(least.column)
    if least is not None and is_least and least.column.goal > 0.0:
        # the least failure is exact to the last digit
        is_kept = evaluation.limited_failure <= budget
        value = sense.stated(evaluation.objective)
        if not (is_kept and relative_gap(least.objective_bound, value) > CONTRADICTION):
            bound = max(bound, least.objective_bound)
    return proved_objective(sense, evaluation.objective, bound, row.budget, tail=tail)


def _bound_by_values(
    compiled: CompiledProblem, row: FailureRow, price: float, slack: bool, solution: Solution
) -> tuple[float, float]:
    """Return the lower bound that a solution's value function proves, and the loss due to the cap.

    Args:
        compiled: the problem.
        row: the failure row.
        price: price of failure.
        slack: whether the budget is slack: the price of the failure row is 0.
        solution: has the value function, of the shape that ``compiled`` expects.

    Returns:
        The bound, and the part of the relative gap that is due to the cap on accumulated cost.
    """
    slack = slack and row.ratio
    price = price * BELOW_RATIO if slack else price
    by_success = slack or row.is_rare
    values = np.asarray(solution.value_function)
    proof = compiled.pricing().check(price, values, slack=by_success)
    bound = row.lower_bound(proof)
    lost = compiled.tail_loss(price, slack=by_success, proof=proof)
    if lost == 0.0:
        return bound, 0.0
    return bound, relative_gap(row.lower_bound(replace(proof, bound=proof.bound + lost)), bound)


def solve_by_game(problem: Problem, options: SolveOptions) -> Solution:
    """Solve by the paper's zero-sum game, without columns or linear programs.

    ``options.tail`` is the paper's M: once a run has cost M, the policy fails as surely as
    possible. If M is given, the policy is optimal for this M, and its objective is evaluated
    exactly. The lower bound comes from the game without a fixed M, and holds for all policies.
    """
    from ssp_lp.game.optimum import stationary_game

    equilibrium = stationary_game(problem, tolerance=options.tolerance, progress=options.progress)
    replies = equilibrium.threshold.game.responses
    reason = f"the paper's game, {equilibrium.threshold.games} values of c"
    work = Work(backups=sum(r.sweeps for r in replies))
    price = (
        max(equilibrium.price - equilibrium.objective, 0.0) if problem.ratio else equilibrium.price
    )
    answer = Answer(
        policy=equilibrium.policy,
        value=equilibrium.objective,
        bound=equilibrium.lower_bound,
        failure=equilibrium.threshold.condition,
        price=price,
        values=equilibrium.player.value_function(equilibrium.price, replies),
        note=remarks(problem, equilibrium.threshold.budget, equilibrium.threshold.in_time),
    )
    if options.tail is not None:
        capped = stationary_game(problem, tail=options.tail, tolerance=options.tolerance)
        value = evaluate(capped.policy, problem).objective
        note = f"c-hat_M is {capped.objective:.10g} where M is {options.tail:g} (section 3.5.1)"
        failure = capped.threshold.condition
        answer = replace(answer, policy=capped.policy, value=value, failure=failure, note=note)
    return assembled(problem, answer, Run(Game.name, reason, len(replies), 0.0, work))


_PATIENCE = 3

_LABEL_SPREAD = 0.25  # relative uncertainty of a price of case M as a guess in case S
_LABEL_MARGIN = 1.5  # cap in case S, as a multiple of the price of case M

_NEAR = 1e-9  # distance of a failure from the budget at which this may be the least failure


def refined_optimum(
    compiled: CompiledProblem, budget: float, options: SolveOptions, guess: DualGuess | None = None
) -> Optimum[CompiledProblem]:
    """Run column generation on finer and finer problems until the gap is within the tolerance.

    Args:
        compiled: the first problem.
        budget: failure budget.
        options: method, tolerance and limits.
        guess: a guess of the price of failure, or None.

    Raises:
        InfeasibleError: no policy satisfies the budget.
        SolverError: the solution of the linear program fails its check.
        Stop: the time limit was reached before a policy satisfied the budget.
    """
    compiled = compiled if options.program is None else compiled.for_program()
    row, least = FailureRow(budget, compiled.ratio), None
    if row.is_rare:
        compiled = compiled.counting_rare_success(budget)
    with WithIncumbent() as search:
        if (lowest := compiled.lowest) != row.lowest:
            row = replace(row, lowest=lowest)
        if options.program is not None:
            least = checked_least_failure(compiled, budget)
        elif guess is None:
            compiled, guess = _capped_by_case_m(compiled, budget)
        first = _attempt(compiled, row, least, options, guess)
    if search.stop:
        return _safest_optimum(compiled, row, least, search.stop)
    attempts = finer_optima(
        first,
        lambda finer, later, last: _attempt(finer, last.row, last.least, later, last.guess()),
        options,
        _PATIENCE,
    )
    best = refine(attempts, options.tolerance)
    if not is_late():
        return best
    return replace(best, generated=replace(best.generated, finished=best.gap <= options.tolerance))


def _capped_by_case_m(
    compiled: CompiledProblem, budget: float
) -> tuple[CompiledProblem, DualGuess | None]:
    """Return a case S problem with a first cap on accumulated cost, and a first price of failure.

    If the problem's own first cap is a poor guess (``is_cap_poor``), case M is solved, which needs
    no accumulated cost. The price of failure of case M is near that of case S, and the cap is a
    multiple of this price. Otherwise the problem is returned unchanged, without a price.
    """
    if not compiled.is_cap_poor:
        return compiled, None
    ensure_incumbent()
    incumbent, semantics = prepared(), FailureSemantics(charge_failing_step=False)
    optimum = None if incumbent is None else incumbent.optimum
    if optimum is None:
        label = CompiledExplicit(compiled.facts, semantics)
        optimum = refined_optimum(label, budget, SolveOptions(TRIAL_TOLERANCE))
    price = max(optimum.kappa, optimum.generated.given_success)
    if not np.isfinite(price):
        return compiled, None
    guess = replace(optimum.guess(_LABEL_SPREAD), price=price)
    return compiled.capped_at(_LABEL_MARGIN * price), guess


def _safest_optimum(
    compiled: CompiledProblem, row: FailureRow, least: LeastFailure | None, stop: BaseException
) -> Optimum[CompiledProblem]:
    """Return the policy of least failure, after a search that was stopped without any policy.

    Raises:
        Stop: a policy of case M is known, or ``solve`` finds one sooner, which is a better answer;
            or there is no time to compute the policy of least failure.
    """
    if prepared() is not None or compiled.charge is not None:
        raise Stop(note=stop.note if isinstance(stop, Stop) else "") from stop
    with WithIncumbent(), closing():
        least = checked_least_failure(compiled, row.budget) if least is None else least
        options = SolveOptions(TRIAL_TOLERANCE)
        optimum = _attempt(compiled, row, least, options, None, by_pricing=False)
        return replace(optimum, generated=replace(optimum.generated, finished=False))
    words = stop.note if isinstance(stop, Stop) else ""
    raise Stop(note=words or "no policy was evaluated") from stop


def _attempt(
    compiled: CompiledProblem,
    row: FailureRow,
    least: LeastFailure | None,
    options: SolveOptions,
    guess: DualGuess | None,
    *,
    by_pricing: bool = True,
) -> Optimum[CompiledProblem]:
    """Run column generation once, on one process.

    If ``options`` choose the full linear program, it is solved first, and its dual is the first
    price. If the budget equals the least failure, the answer is the policy of least failure, with
    the bound of this policy. No program is solved then, because rounding would decide whether the
    program is feasible. To save time, the least failure is not computed if a column fails clearly
    less often than the budget allows.

    Args:
        compiled: the problem.
        row: the failure row.
        least: the policy of least failure, if it is known.
        options: method, tolerance and limits.
        guess: a first price of failure, or None.
        by_pricing: whether to find the first columns by pricing. If not, or if pricing finds no
            column within the budget, the first column is the policy of least failure.
    """
    program = None
    if options.program is not None and least is not None:
        row = row.raised_to(least.column)
        if row.slack(least.column) > (0.0 if row.is_rare else LEAST_BUDGET):
            process = compiled.explicit()
            limits = {FAILURE_ROW: (process.failure, row.budget)}
            if row.is_rare:  # in units of the demanded goal, which is below solver tolerances
                limits = {FAILURE_ROW: (-process.goal / row.required, -1.0)}
            program = solve_program(process, limits, options, ratio=row.ratio)
            kappa = program.prices.get(FAILURE_ROW, 0.0) + row.ratio * program.objective
            guess = DualGuess(kappa, SPREAD)
    if guess is None and row.required <= 0.0 and not row.ratio:
        guess = DualGuess(0.0, SPREAD, slack=True)  # no limit, so the price is 0
    master = None
    if by_pricing and (least is None or row.slack(least.column) > 0.0):
        master = columns_by_pricing(compiled, row, guess, options)
    if master is None:
        least = checked_least_failure(compiled, row.budget) if least is None else least
        row = row.raised_to(least.column)
        master = master_at(Pool(compiled.pricing()), row, least.column)
    search = replace(options, tolerance=TRIAL_TOLERANCE) if compiled.is_guess else options
    generated = certified(master, row, generate(master, search), search.tolerance)
    if program is not None and generated.finished:
        check_agreement(program, generated.objective)
    bound, price = generated.lower_bound, max(generated.price - generated.ratio, 0.0)
    if least is not None and least.is_proved and row.slack(least.column) <= 0.0 < least.column.goal:
        bound = max(bound, least.objective_bound)  # of least failure, as the answer is
    optimum = Optimum(
        policy=generated.lottery(master.pool.pricing),
        value=generated.objective,
        bound=bound,
        failure=generated.failure,
        price=price,
        values=generated.values,
        compiled=compiled,
        row=row,
        least=least,
        generated=generated,
        search=master,
        calls=master.pool.calls,
        work=master.pool.work,
        program="" if program is None else program.report,
    )
    is_near = least is None and generated.columns[0].failure >= row.budget - _NEAR
    if not is_near or optimum.gap <= options.tolerance or is_late():
        return optimum
    least = checked_least_failure(compiled, row.budget)
    if not row.equals_least(least.column):
        return replace(optimum, least=least)
    equal, later = row.with_budget_of(least.column), options.after(optimum.calls)
    return optimum.followed_by(_attempt(compiled, equal, least, later, None))
