"""Problems with a failure row at most: column generation, refined until the gap is met."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from ssp_lp.analysis.evaluation import Evaluation, evaluate
from ssp_lp.arrays import BELOW_RATIO, LEAST_BUDGET, RELATIVE_GAP
from ssp_lp.column_generation.column import CONTRADICTION, FailureRow, relative_gap
from ssp_lp.column_generation.compiled_problem import (
    CompiledExplicit,
    CompiledProblem,
    LeastFailure,
    checked_least_failure,
)
from ssp_lp.column_generation.search import (
    DualGuess,
    Generated,
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
from ssp_lp.methods.deterministic import best_deterministic
from ssp_lp.methods.full_program import check_agreement, solve_program
from ssp_lp.methods.refinement import Proved, refine
from ssp_lp.options import CERTIFYING, Game, SolveOptions
from ssp_lp.policies import DeterministicPolicy, MixedPolicy
from ssp_lp.policies.cost_aware import levels_of
from ssp_lp.problem import Problem
from ssp_lp.processes.conditions import FAILURE_ROW
from ssp_lp.processes.failure_semantics import (
    Aim,
    FailureSemantics,
    ObjectiveSense,
    start_distribution,
)
from ssp_lp.processes.goal_reach import extreme_goal_reach
from ssp_lp.solution import Answer, Run, Solution, assembled, remarks

_REASONS = {
    "columns": "column generation, as asked",
    "unlimited": "no failure row: policy iteration at one price",
    "lp": "the full linear program, as asked; lottery recovered by pricing at its dual",
}


def extreme_goal(problem: Problem, options: SolveOptions) -> Solution:
    """Solve for the greatest or least goal probability, checked by the full program if chosen."""
    compiled, aim = problem.compile(), problem.semantics.aim
    reach = extreme_goal_reach(problem.model, aim, compiled.facts.start)
    objective, bound = (
        float(compiled.facts.start @ reach.goal),
        float(compiled.facts.start @ reach.bound),
    )
    greatest, reason, program = aim is Aim.GREATEST_GOAL, "one stage: policy iteration", ""
    if options.program is not None:
        process = compiled.explicit()
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
    outcome = refined_optimum(compiled, budget, options, guess)
    generated = outcome.generated
    worth, bound = sense.worth(generated.objective), sense.worth(generated.lower_bound)
    gained, is_met = -generated.objective, relative_gap(bound, worth) <= options.tolerance
    if sense.constant and 0.0 < abs(worth) < gained and not is_met:  # cancellation in the worth
        finer = max(options.tolerance * abs(worth) / gained, _LEAST_TOLERANCE)
        exactly = replace(options, tolerance=finer)
        outcome = outcome.followed_by(refined_optimum(outcome.compiled, budget, exactly))
        generated = outcome.generated
    beyond = generated.objective if outcome.row.ratio else 0.0
    price = max(generated.price - beyond, 0.0)
    compiled, unlimited = outcome.compiled, not problem.ratio and outcome.row.demanded <= 0.0
    relaxed = replace(options, deterministic=False).method
    reason = _REASONS["unlimited" if unlimited and options.program is None else relaxed]
    if sense.constant is not None:
        reason = f"backward sweeps over {compiled.layers:,} layers of accumulated cost"
        if compiled.cost_horizon > 0.0:
            reason = f"{reason}, exact from cost {compiled.cost_horizon:.6g} on"
    reason = f"{reason}, {outcome.calls} pricing calls"
    notes = [remarks(problem, outcome.row.budget, generated.finished)]
    if compiled.charge is not None and compiled.charge.settled is None:
        notes += [_UNSETTLED] * (outcome.gap > options.tolerance)
    answer = Answer(
        outcome.lottery,
        generated.objective,
        generated.lower_bound,
        generated.failure,
        price,
        generated.values,
        note="; ".join(note for note in notes if note),
    )
    run = Run(options.method, reason, outcome.calls, 0.0, outcome.work, outcome.program)
    solution = assembled(problem, answer, run, sense)
    if not options.deterministic:
        return solution
    reason += "; then one policy by mixed-integer programs"
    single = best_deterministic(solution, outcome, options.tolerance, options.deadline)
    return replace(single, run=replace(single.run, reason=reason, deterministic=True))


def prove_goal(solution: Solution, evaluation: Evaluation, _: float) -> Proved:
    """Prove an upper or lower bound of the goal probability."""
    problem = solution.problem
    start = start_distribution(problem.model, problem.start)
    reach = extreme_goal_reach(problem.model, problem.semantics.aim, start)
    return Proved(evaluation.objective, float(start @ reach.bound), 1.0)


_STEEP_PRICES = (1e1, 1e3, 1e5)
"""Prices of failure, in units of the objective, at which least failure is proved optimal."""

_LITTLE = 1e-13  # relative loss of the bound by the cap that is accepted
_SURELY = 1.0 - 1e-9  # share of the budget: a lower failure proves that the least is below it


def prove_least_failure(solution: Solution, evaluation: Evaluation, _: float) -> Proved:
    """Prove a lower bound of the cost of policies of least failure, by finite prices of failure.

    Such a bound holds for every policy. If rounding leaves a gap at these prices, the bound of the
    second stage is used, over the pairs that were found to attain the greatest goal probability.
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
    proved = _proof_of_stated_optimum(sense, evaluation, bound, allowed)
    return replace(proved, least_failure_bound=safest.proved)


def _proof_of_stated_optimum(
    sense: ObjectiveSense, evaluation: Evaluation, bound: float, allowed: float, tail: float = 0.0
) -> Proved:
    """Return the proof for the stated objective, from a bound of the minimised value."""
    objective = evaluation.objective
    value = sense.worth(objective)  # ``constant - value`` is its own inverse
    if sense.constant is not None and sense.settled_bound(value, bound) == value:
        return Proved(objective, objective, allowed)
    return Proved(objective, sense.worth(bound), allowed, tail=tail)


def prove_within_budget(solution: Solution, evaluation: Evaluation, attained: float) -> Proved:
    """Prove the lower bound that the price of failure gives.

    Args:
        solution: the solution to certify.
        evaluation: evaluation of its policy.
        attained: the least failure of a known policy.

    Raises:
        ModelError: the solution has no price and value function, or these do not fit the problem.
    """
    problem, budget = solution.problem, max(solution.problem.failure_budget or 0.0, 0.0)
    is_priced = not solution.run.deterministic or solution.failure_price is not None
    if not is_priced:  # the bound is that of lotteries: solve for their prices
        solution = best_within_budget(problem, CERTIFYING)
    sense, price, values = problem.semantics.sense, solution.failure_price, solution.value_function
    if price is None or values is None:
        raise ModelError("the solution has no price and value function to certify")
    penalty = problem.semantics.penalty  # part of the cost, not of the failure row's price
    price = 0.0 if price == penalty else price - penalty
    if not (np.isfinite(price) and price >= 0.0):
        reason = f"the price is not a number >= {penalty:g}"
        return Proved(evaluation.objective, sense.worth(0.0), budget, reason)
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
    is_least = least is not None and least.is_proved and row.leaves_only(least.column)
    if least is not None and is_least and least.column.goal > 0.0:
        # the least failure is exact to the last digit
        is_kept = evaluation.limited_failure <= budget
        value = sense.worth(evaluation.objective)
        if not (is_kept and relative_gap(least.objective_bound, value) > CONTRADICTION):
            bound = max(bound, least.objective_bound)
    return _proof_of_stated_optimum(sense, evaluation, bound, row.budget, tail)


def _bound_by_values(
    compiled: CompiledProblem, row: FailureRow, price: float, slack: bool, solution: Solution
) -> tuple[float, float]:
    """Return the lower bound that values prove, and the relative gap that truncation leaves."""
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
    """Solve by the paper's construction, the game, without columns or linear programs.

    With a fixed M (``options.tail``) the policy is evaluated exactly, and the bound is still that
    of all policies.
    """
    from ssp_lp.game.optimum import stationary_game, value_function

    equilibrium = stationary_game(problem, tolerance=options.tolerance, progress=options.progress)
    replies = equilibrium.threshold.responses
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
        values=value_function(equilibrium),
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

_TRIAL_TOLERANCE = 1e-2
"""Relative gap of a trial, whose price gives the next cap."""

_LABEL_SPREAD = 0.25  # relative uncertainty of a price of case M as a guess in case S
_LABEL_MARGIN = 1.5  # cap in case S, as a multiple of the price of case M

_NEAR = 1e-9  # distance of a failure from the budget at which this may be the least failure
_SPREAD = 1e-6  # relative uncertainty of the final price of a search or program


@dataclass(frozen=True, eq=False)
class RefinedOutcome:
    """Result of the last search, its compiled problem, and the work of all searches."""

    generated: Generated
    compiled: CompiledProblem
    row: FailureRow
    least: LeastFailure | None = None  # if it had to be computed
    calls: int = 0
    work: Work = field(default_factory=Work)
    program: str = ""  # report of the last linear program

    @property
    def gap(self) -> float:
        """Relative gap between the objective and its lower bound."""
        return relative_gap(self.generated.objective, self.generated.lower_bound)

    @property
    def lottery(self) -> MixedPolicy:
        """The lottery over policies of the model."""
        return self.generated.lottery(self.compiled.pricing())

    def followed_by(self, other: RefinedOutcome) -> RefinedOutcome:
        """Return the later outcome, with the work of both."""
        return replace(other, calls=self.calls + other.calls, work=self.work + other.work)


def refined_optimum(
    compiled: CompiledProblem, budget: float, options: SolveOptions, guess: DualGuess | None = None
) -> RefinedOutcome:
    """Run column generation on finer and finer compiled problems until the gap is met.

    Args:
        compiled: the first problem.
        budget: failure budget.
        options: method, tolerance and limits.
        guess: a guess of the price, or None.

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
        row = replace(row, lowest=compiled.lowest)
        if options.program is not None:
            least = checked_least_failure(compiled, budget)
        elif guess is None:
            compiled, guess = _capped_by_case_m(compiled, budget)
        outcome = _attempt(compiled, row, least, options, guess)
    if search.stop:
        return _safest_outcome(compiled, row, least, search.stop)
    best = refine(_finer_outcomes(outcome, options), options.tolerance)
    if not is_late():
        return best
    return replace(best, generated=replace(best.generated, finished=best.gap <= options.tolerance))


def _finer_outcomes(outcome: RefinedOutcome, options: SolveOptions) -> Iterator[RefinedOutcome]:
    """Yield outcomes on finer problems, of least failure if the budget turns out to equal it."""
    gaps: list[float] = []
    while True:
        yield outcome
        gaps.append(outcome.gap)
        generated, compiled, row = outcome.generated, outcome.compiled, outcome.row
        later = options.after(outcome.calls)
        if outcome.least is None and generated.columns[0].failure >= row.budget - _NEAR:
            safest = checked_least_failure(compiled, row.budget)
            outcome = replace(outcome, least=safest)
            if row.leaves_only(safest.column):  # then its policy is the answer
                row = row.equal_to(safest.column)
                outcome = outcome.followed_by(_attempt(compiled, row, safest, later, None))
                continue
        is_stagnant = len(gaps) > _PATIENCE and gaps[-1] > 0.5 * gaps[-1 - _PATIENCE]
        is_done = is_stagnant and compiled.tail_loss(generated.price) == 0.0
        finer = None if is_done else compiled.refined(generated.price)
        if finer is None:
            yield outcome
            return
        spread = _TRIAL_TOLERANCE if compiled.is_trial else _SPREAD
        guess = DualGuess(generated.price, spread, slack=len(generated.columns) == 1)
        outcome = outcome.followed_by(_attempt(finer, row, outcome.least, later, guess))


def _capped_by_case_m(
    compiled: CompiledProblem, budget: float
) -> tuple[CompiledProblem, DualGuess | None]:
    """Return the problem with a first cap from the price of case M, if ``is_long_shot``.

    Case M has one layer, and its price is about that of case S.
    """
    if not compiled.is_long_shot:
        return compiled, None
    ensure_incumbent()
    incumbent, semantics = prepared(), FailureSemantics(charge_failing_step=False)
    outcome = None if incumbent is None else incumbent.outcome
    if outcome is None:
        label = CompiledExplicit(compiled.facts, semantics)
        outcome = refined_optimum(label, budget, SolveOptions(_TRIAL_TOLERANCE))
    price = max(outcome.generated.price, outcome.generated.given_success)
    if not np.isfinite(price):
        return compiled, None
    return compiled.capped_at(_LABEL_MARGIN * price), DualGuess(
        price, _LABEL_SPREAD, slack=len(outcome.generated.columns) == 1
    )


def _safest_outcome(
    compiled: CompiledProblem, row: FailureRow, least: LeastFailure | None, stop: BaseException
) -> RefinedOutcome:
    """Return the column of least failure after a stop without a column within the budget.

    Raises:
        Stop: there is no time for it either, or a better incumbent exists.
    """
    if prepared() is not None:  # a better incumbent exists
        raise Stop from stop
    with WithIncumbent(), closing():
        least = checked_least_failure(compiled, row.budget) if least is None else least
        row = row.raised_to(least.column)
        master = master_at(compiled.pricing(), row, least.column)
        generated = generate(master, SolveOptions(_TRIAL_TOLERANCE))
        generated = certified(master, replace(generated, finished=False), _TRIAL_TOLERANCE)
        return RefinedOutcome(generated, compiled, row, least)
    words = stop.told if isinstance(stop, Stop) else ""
    raise Stop(told=words or "no policy had been evaluated") from stop


def _attempt(
    compiled: CompiledProblem,
    row: FailureRow,
    least: LeastFailure | None,
    options: SolveOptions,
    guess: DualGuess | None,
) -> RefinedOutcome:
    """Run one search, started at the dual of the linear program if that is the method.

    If the budget equals the least failure, no program is solved, as its feasibility would depend
    on rounding: the column of least failure is the answer, with its own bound.
    """
    optimum = None
    if options.program is not None and least is not None:
        row = row.raised_to(least.column)
        if row.spare(least.column) > (0.0 if row.is_rare else LEAST_BUDGET):
            process = compiled.explicit()
            limits = {FAILURE_ROW: (process.failure, row.budget)}
            if row.is_rare:  # in units of the demanded goal, which is below solver tolerances
                limits = {FAILURE_ROW: (-process.goal / row.demanded, -1.0)}
            optimum = solve_program(process, limits, options, ratio=row.ratio)
            kappa = optimum.prices.get(FAILURE_ROW, 0.0) + row.ratio * optimum.objective
            guess = DualGuess(kappa, _SPREAD)
    if guess is None and row.demanded <= 0.0 and not row.ratio:
        guess = DualGuess(0.0, _SPREAD, slack=True)  # no limit, so the price is 0
    master = None
    if least is None or row.spare(least.column) > 0.0:
        master = columns_by_pricing(compiled, row, guess, options)
    if master is None:
        least = checked_least_failure(compiled, row.budget) if least is None else least
        row = row.raised_to(least.column)
        master = master_at(compiled.pricing(), row, least.column)
    finer = _TRIAL_TOLERANCE if compiled.is_trial else options.tolerance
    generated = generate(master, replace(options, tolerance=finer))
    generated = certified(master, generated, finer)
    if optimum is not None and generated.finished:
        check_agreement(optimum, generated.objective)
    is_least = least is not None and least.is_proved
    is_met = least is not None and row.spare(least.column) <= 0.0 < least.column.goal
    if least is not None and is_least and is_met:
        generated = replace(
            generated, lower_bound=max(generated.lower_bound, least.objective_bound)
        )
    report = "" if optimum is None else optimum.report
    pool = master.pool
    return RefinedOutcome(generated, compiled, row, least, pool.calls, pool.work, report)
