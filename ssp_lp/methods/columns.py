"""Problems with one row, or none: search, and refine until the gap meets the tolerance."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ssp_lp.arrays import LEAST_BUDGET
from ssp_lp.column_generation.column import FailureRow, relative_gap
from ssp_lp.column_generation.compiled_problem import (
    CompiledAccumulatedCost,
    CompiledArrivalCost,
    CompiledFailureLabel,
    CompiledProblem,
    LeastFailure,
    checked_least_failure,
)
from ssp_lp.column_generation.search import (
    DualGuess,
    Generated,
    columns_at,
    columns_by_pricing,
    generate,
)
from ssp_lp.compiled.deadline import STOPS, Stop, closing, has_answer, heed, is_late, prepared
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import Argument, ModelError
from ssp_lp.methods.full_program import check_agreement, solve_program
from ssp_lp.options import Game, SolveOptions
from ssp_lp.policies import DeterministicPolicy, MixedPolicy
from ssp_lp.problem import Problem
from ssp_lp.processes.failure_semantics import Aim, FailureSemantics, ObjectiveSense
from ssp_lp.processes.goal_reach import extreme_goal_reach
from ssp_lp.solution import Found, Run, Solution, assembled, remarks

_REASONS = {
    "columns": "column generation, as asked",
    "unlimited": "no failure row: policy iteration at one price",
    "lp": "the full linear program, as asked; lottery recovered by pricing at its dual",
}


def extreme_goal(problem: Problem, options: SolveOptions) -> Solution:
    """The greatest or the least goal probability; the full program, where asked for, agrees."""
    compiled, aim = problem.compile(), problem.semantics.aim
    reach = extreme_goal_reach(problem.model, aim, compiled.start)
    objective, bound = float(compiled.start @ reach.goal), float(compiled.start @ reach.bound)
    greatest, reason, program = aim is Aim.GREATEST_GOAL, "one stage: policy iteration", ""
    if options.program is not None:
        row = FailureRow(1.0, ratio=False)
        optimum = solve_program(compiled, row, options.program.backend, options.deadline)
        check_agreement(optimum, 1.0 - objective if greatest else objective)
        reason, program = "the full linear program agrees with policy iteration", optimum.report
    policy = DeterministicPolicy(problem.model, reach.decision)
    sign = -1.0 if greatest else 1.0
    found = Found(policy, sign * objective, sign * bound, max(1.0 - objective, 0.0))
    run = Run(options.method, reason, 1, 0.0, program=program)
    return assembled(problem, found, run, ObjectiveSense(0.0 if greatest else None))


def cheapest_at_least_failure(problem: Problem) -> Solution:
    """The cheapest of the policies that fail least, by two stages.

    Raises:
        InfeasibleError: case S, and the goal cannot be reached.
    """
    least = checked_least_failure(problem.compile(), None)
    row = FailureRow(least.column.failure, problem.ratio)
    objective = row.objective(least.column.cost, least.column.goal)
    reason = "two stages: greatest goal probability, then least cost"
    found = Found(least.policy, objective, least.objective_bound, least.column.failure)
    return assembled(problem, found, Run("columns", reason, 2, 0.0))


def best_within_budget(
    problem: Problem, options: SolveOptions, *, deterministic: bool = False
) -> Solution:
    """The best lottery within the budget, or the best single policy.

    Args:
        problem: the problem.
        options: tolerance and limits.
        deterministic: no lotteries.

    Raises:
        InfeasibleError: no policy keeps to the budget.
        SolverError: the linear program's answer fails its check.
    """
    budget = problem.failure_budget
    outcome = refined_optimum(problem.compile(), 1.0 if budget is None else budget, options)
    found = outcome.found
    price = max(found.price - found.objective, 0.0) if outcome.row.ratio else found.price
    unlimited = options.program is None and not problem.ratio and outcome.row.budget >= 1.0
    reason = (
        f"{_REASONS['unlimited' if unlimited else options.method]}, {outcome.calls} pricing calls"
    )
    answer = outcome.answer(price, remarks(problem, outcome.row.budget, found.finished))
    solution = assembled(problem, answer, outcome.run(options, reason))
    if not deterministic:
        return solution
    from ssp_lp.methods.deterministic import best_deterministic

    reason += "; then one policy by mixed-integer programs"
    single = best_deterministic(solution, outcome, options.tolerance, options.deadline)
    return replace(single, run=replace(single.run, reason=reason))


_LEAST_TOLERANCE = 1e-15
_UNSETTLED = "the utility has not come near its limit within the table of costs: a gap is left"


def solve_for_worth(problem: Problem, compiled: CompiledProblem, options: SolveOptions) -> Solution:
    """Maximise what arriving is worth beyond failing.

    Args:
        problem: its measure is an expectation that is to be large.
        compiled: charges minus what an arrival is worth beyond failing.
        options: method, tolerance and limits.

    Raises:
        InfeasibleError: the budget is below the least failure probability.
        SolverError: the linear program's answer fails its check.
    """
    if problem.failure_budget is None:
        least = checked_least_failure(compiled, None)
        found = Found(least.policy, least.column.cost, least.objective_bound, least.column.failure)
        run = Run("columns", "two stages: greatest goal probability, then greatest worth", 2, 0.0)
        return assembled(problem, found, run, ObjectiveSense(problem.semantics.failing_worth))
    failing = problem.semantics.failing_worth
    outcome = refined_optimum(compiled, problem.failure_budget, options)
    gained, worth = -outcome.found.objective, failing - outcome.found.objective
    if (
        failing != 0.0
        and 0.0 < abs(worth) < gained
        and not _is_met_by_row(outcome, failing, options)
    ):
        finer = max(options.tolerance * abs(worth) / gained, _LEAST_TOLERANCE)
        outcome = outcome.followed_by(
            refined_optimum(
                outcome.compiled, problem.failure_budget, replace(options, tolerance=finer)
            )
        )
    answer = outcome.answer(outcome.found.price, _note_on_row(problem, outcome, options))
    return assembled(
        problem, answer, outcome.run(options, _reason_of_row(outcome)), ObjectiveSense(failing)
    )


def _is_met_by_row(outcome: RefinedOutcome, failing: float, options: SolveOptions) -> bool:
    """Whether one row's outcome meets the tolerance."""
    worth, bound = failing - outcome.found.objective, failing - outcome.found.lower_bound
    return relative_gap(bound, worth) <= options.tolerance


def _reason_of_row(outcome: RefinedOutcome) -> str:
    """Why the search on one row ended, in words."""
    layers = ""
    if isinstance(outcome.compiled, CompiledArrivalCost):
        process, horizon = outcome.compiled.process, outcome.compiled.cost_horizon
        layers = f"{process.cap:,} layers of accumulated cost"
        layers += f", exact from cost {horizon:.6g} on" if horizon > 0.0 else ""
    return f"backward sweeps over {layers}, {outcome.calls} pricing calls"


def _note_on_row(problem: Problem, outcome: RefinedOutcome, options: SolveOptions) -> str:
    """What a reader should know of an answer with one row."""
    found, here = outcome.found, outcome.compiled
    told = remarks(problem, outcome.row.budget, found.finished)
    unsettled = isinstance(here, CompiledArrivalCost) and here.charge.settled is None
    if unsettled and relative_gap(found.objective, found.lower_bound) > options.tolerance:
        told = f"{told}; {_UNSETTLED}" if told else _UNSETTLED
    return told


def solve_by_game(problem: Problem, options: SolveOptions) -> Solution:
    """The paper's own construction, which knows neither columns nor programs."""
    from ssp_lp.game.stationary import stationary_game, value_function

    compiled = problem.compile()
    if isinstance(compiled, CompiledAccumulatedCost) and compiled.fixed_cap is not None:
        asked, cap = Argument("method", "game"), Argument("cost_cap")
        raise ModelError(asked, " chooses its own cap M: leave ", cap, " out")
    found = stationary_game(problem, tolerance=options.tolerance, progress=options.progress)
    replies = found.threshold.responses
    reason = f"the paper's game, {found.threshold.games} values of c"
    work = Work(backups=sum(r.sweeps for r in replies))
    price = max(found.price - found.objective, 0.0) if problem.ratio else found.price
    answer = Found(
        policy=found.policy,
        value=found.objective,
        bound=found.lower_bound,
        failure=found.threshold.condition,
        price=price,
        values=value_function(found),
        note=remarks(problem, found.threshold.budget, found.threshold.in_time),
    )
    return assembled(problem, answer, Run(Game.name, reason, len(replies), 0.0, work))


_PATIENCE = 3

_TRIAL_TOLERANCE = 1e-2
"""A trial only learns the price, from which the next one's size follows."""

_LABEL_SPREAD = 0.25  # relative uncertainty of a price of case M in case S
_LABEL_MARGIN = 1.5  # cap, as a multiple of it

_NEAR = 1e-9  # of the budget: then it may be the least failure, whose own bound is exact
_SPREAD = 1e-6  # relative uncertainty of a price that a search or a program ended with


@dataclass(frozen=True, eq=False)
class RefinedOutcome:
    """The last search, the compiled problem that it ran on, and the work done in all."""

    found: Generated
    compiled: CompiledProblem
    row: FailureRow
    least: LeastFailure | None = None  # where it had to be worked out
    calls: int = 0
    work: Work = field(default_factory=Work)
    program: str = ""  # report of the last linear program

    @property
    def gap(self) -> float:
        """Relative gap of what refinement has come to."""
        return relative_gap(self.found.objective, self.found.lower_bound)

    @property
    def lottery(self) -> MixedPolicy:
        """The lottery on the model that the search ended with."""
        return self.found.lottery(self.compiled.pricing())

    def answer(self, price: float, note: str) -> Found:
        """What was found, as an answer.

        Args:
            price: multiplier of the failure row.
            note: what a reader should know.
        """
        found = self.found
        lottery, bound = self.lottery, found.lower_bound
        return Found(lottery, found.objective, bound, found.failure, price, found.values, note=note)

    def run(self, options: SolveOptions, reason: str) -> Run:
        """What was done, and why."""
        return Run(options.method, reason, self.calls, 0.0, self.work, self.program)

    def followed_by(self, other: RefinedOutcome) -> RefinedOutcome:
        """The other, with the work of both."""
        return replace(other, calls=self.calls + other.calls, work=self.work + other.work)


def refined_optimum(
    compiled: CompiledProblem,
    budget: float,
    options: SolveOptions,
    guess: DualGuess | None = None,
) -> RefinedOutcome:
    """Search on finer and finer compiled problems until the gap is met, or refining does not help.

    Args:
        compiled: the problem to begin with.
        budget: failure budget.
        options: method, tolerance and limits.
        guess: of the price; None: nothing is known.

    Raises:
        InfeasibleError: no policy keeps to the budget.
        SolverError: the linear program's answer fails its check.
        Stop: the time ended before a policy that keeps to the budget was found.
    """
    gaps: list[float] = []
    compiled = compiled if options.program is None else compiled.for_program()
    row = FailureRow(budget, compiled.ratio)
    try:
        row = replace(row, lowest=compiled.lowest)
        if guess is None and options.program is None:
            compiled, guess = _begun_by_label(compiled, budget)
        outcome = _refined_attempt(compiled, row, None, options, guess)
    except STOPS as stop:
        heed(stop)
        return _safest_refined(compiled, row, stop)
    while True:
        gaps.append(outcome.gap)
        if gaps[-1] <= options.tolerance:
            return outcome
        try:
            refined = outcome if is_late() else _refined_outcome(outcome, gaps, options)
        except STOPS as stop:
            heed(stop)
            refined = outcome
        if is_late():
            best = refined if refined.gap <= outcome.gap else outcome
            met = best.gap <= options.tolerance
            return replace(best, found=replace(best.found, finished=met))
        if refined.found is outcome.found:
            return refined
        outcome = refined


def _begun_by_label(
    compiled: CompiledProblem, budget: float
) -> tuple[CompiledProblem, DualGuess | None]:
    """The price, and with it the cap, of case M, where no policy at hand tells of either.

    Its process has one layer, and failing early saves about as much in both.
    """
    if not (isinstance(compiled, CompiledAccumulatedCost) and compiled.is_long_shot):
        return compiled, None
    has_answer()
    outcome, semantics = prepared(), FailureSemantics(charge_failing_step=False)
    if not isinstance(outcome, RefinedOutcome):
        model, start, discount = compiled.model, compiled.start, compiled.discount
        label = CompiledFailureLabel(model, start, semantics, discount)
        outcome = refined_optimum(label, budget, SolveOptions(_TRIAL_TOLERANCE))
    price = max(outcome.found.price, outcome.found.ratio)
    if not np.isfinite(price):
        return compiled, None
    return compiled.capped_at(_LABEL_MARGIN * price), DualGuess(
        price, _LABEL_SPREAD, slack=len(outcome.found.columns) == 1
    )


def _refined_outcome(
    outcome: RefinedOutcome, gaps: list[float], options: SolveOptions
) -> RefinedOutcome:
    """A finer search's outcome; with what was found before where refining does not help."""
    found, here = outcome.found, outcome.compiled
    if outcome.least is None and found.columns[0].failure >= outcome.row.budget - _NEAR:
        outcome = _refined_at_the_edge(outcome, options)
        if outcome.found is not found:
            return outcome
    is_stagnant = len(gaps) > _PATIENCE and gaps[-1] > 0.5 * gaps[-1 - _PATIENCE]  # rounding?
    if is_stagnant and here.tail_loss(found.price) == 0.0:
        return outcome
    finer = here.refined(found.price)
    if finer is None:
        return outcome
    spread = _TRIAL_TOLERANCE if here.is_trial else _SPREAD
    guess = DualGuess(found.price, spread, slack=len(found.columns) == 1)
    later = options.after(outcome.calls)
    return outcome.followed_by(_refined_attempt(finer, outcome.row, outcome.least, later, guess))


def _safest_refined(
    compiled: CompiledProblem, row: FailureRow, stop: BaseException
) -> RefinedOutcome:
    """The policy of least failure, where the time ended before any other within the budget.

    Raises:
        Stop: there is no time for it either.
    """
    if prepared() is not None:  # there is a better one already
        raise Stop from stop
    try:
        with closing():
            least = checked_least_failure(compiled, row.budget)
            rule = columns_at(compiled.pricing(), least, row)
            found = generate(rule, SolveOptions(_TRIAL_TOLERANCE))
    except STOPS as again:
        heed(again)
        told = stop.told if isinstance(stop, Stop) else ""
        raise Stop(told=told or "no policy was measured by then") from stop
    return RefinedOutcome(replace(found, finished=False), compiled, rule.row, least)


def _refined_at_the_edge(outcome: RefinedOutcome, options: SolveOptions) -> RefinedOutcome:
    """Work out the least failure; where the budget is equal to it, its policy is the answer."""
    least = checked_least_failure(outcome.compiled, outcome.row.budget)
    if not outcome.row.leaves_only(least.column):
        return replace(outcome, least=least)
    row = replace(outcome.row, budget=least.column.failure)
    later = options.after(outcome.calls)
    return outcome.followed_by(_refined_attempt(outcome.compiled, row, least, later, None))


def _refined_attempt(
    compiled: CompiledProblem,
    row: FailureRow,
    least: LeastFailure | None,
    options: SolveOptions,
    guess: DualGuess | None,
) -> RefinedOutcome:
    """One search, started from the dual of the linear program where that is the method.

    A budget equal to the least failure needs no program, whose feasibility would hang on rounding:
    the first column is the answer, and its own bound holds.
    """
    optimum = None
    if options.program is not None:
        least = checked_least_failure(compiled, row.budget) if least is None else least
        row = replace(row, budget=max(row.budget, least.column.failure))
        if row.budget > least.column.failure + LEAST_BUDGET:
            optimum = solve_program(compiled, row, options.program.backend, options.deadline)
            guess = DualGuess(optimum.price, _SPREAD)
    if guess is None and row.budget >= 1.0 and not row.ratio:
        guess = DualGuess(0.0, _SPREAD, slack=True)  # nothing is limited: no price has to be found
    rule = None
    if least is None or row.budget > least.column.failure:
        rule = columns_by_pricing(compiled, row, guess, options)
    if rule is None:
        least = checked_least_failure(compiled, row.budget) if least is None else least
        rule = columns_at(compiled.pricing(), least, row)
    finer = _TRIAL_TOLERANCE if compiled.is_trial else options.tolerance
    found = generate(rule, replace(options, tolerance=finer))
    if optimum is not None and found.finished:
        check_agreement(optimum, found.objective)
    if least is not None and rule.row.budget <= least.column.failure < 1.0:
        found = replace(found, lower_bound=max(found.lower_bound, least.objective_bound))
    report = "" if optimum is None else optimum.report
    return RefinedOutcome(found, compiled, rule.row, least, rule.calls, rule.work, report)
