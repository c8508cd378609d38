"""Case S where the sums of costs are too many to tell apart: both bounds by split costs.

The optimum of the model with split costs bounds that of the true one from below
(``split_model.py``). The policies found there remember the nearest multiple of what they paid.
What they cost and how they fail on the true model is evaluated exactly, and the lottery is chosen
by that, which bounds the optimum from above. Where the value is smooth in the cost paid both miss
it by about the square of the unit, else by a share of the unit.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from fractions import Fraction

import numpy as np

from ssp_lp.analysis.evaluation import evaluate
from ssp_lp.arrays import read_only
from ssp_lp.column_generation.failure_row import FailureRow, relative_gap
from ssp_lp.column_generation.initial_columns import DualGuess
from ssp_lp.column_generation.pricing.pricing_problem import Column, excess_failure
from ssp_lp.compiled.deadline import STOPS, Stop, closing, has_answer, heed, is_late
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import ModelError
from ssp_lp.methods.assembling import Found, assembled
from ssp_lp.methods.incumbent import Incumbent
from ssp_lp.methods.refinement import RefinedOutcome
from ssp_lp.methods.split_model import layers_of_split, split_optimum, split_units
from ssp_lp.options import SolveOptions
from ssp_lp.policies import CostAwarePolicy, DeterministicPolicy, MixedPolicy
from ssp_lp.policies.policy import Policy
from ssp_lp.problem import Problem
from ssp_lp.processes.totals.lattice import totals_of
from ssp_lp.processes.totals.step_sums import step_lattice
from ssp_lp.solution import CUT_SHORT, Run, Solution

_ROUGH = 1e-4  # how exactly the first model of split costs is solved
_ROUGH_FIRST = 1e-3  # and one that only says where a price lies, with steps far below a unit
_ENOUGH = 0.3  # of the tolerance: as exactly at least
_SHARE = 0.1  # of the gap that splitting leaves: as exactly is the next one solved
_SPREAD = 1e-2  # relative uncertainty of a price from a coarser unit
_BESIDE = (1.003, 1.01, 1.03, 1.1, 1.5, 10.0, 1e3)  # times the price: policies of the other side
_REACH = 0.5  # of the totals that matter: so far they are remembered at first
_CELLS = 100_000_000  # states times levels that a policy measured truly may have
_ROUNDING = 1e-12  # of the budget, or of what it leaves: so far a policy may seem to break it


@dataclass(frozen=True, eq=False)
class _Split:
    """The best that is known: a lottery of the true model, and a bound of all others."""

    lottery: MixedPolicy | None = None
    value: float = np.inf  # cost given success
    failure: float = 1.0
    bound: float = 0.0
    price: float = 0.0  # kappa
    layers: int = 0
    end: float = 0.0  # the total that they reach up to
    calls: int = 0
    work: Work = field(default_factory=Work)
    note: str = ""

    @property
    def gap(self) -> float:
        """Relative gap between both sides."""
        return relative_gap(self.value, self.bound) if np.isfinite(self.value) else np.inf


def solve_on_split_costs(problem: Problem, span: float, options: SolveOptions) -> Solution:
    """The best lottery and the best lower bound that finer and finer units give.

    Args:
        problem: of case S, failure alone limited.
        span: the totals that matter, ``span_to_split``.
        options: tolerance and limits.

    Raises:
        InfeasibleError: no policy keeps to the budget.
        Stop: the time ended before one that does was found.
    """
    best, guess = _begun_with_incumbent(problem), None
    asked: int | None = getattr(problem, "cost_levels", None)
    reach, units = _REACH * span, list(split_units(problem, span))
    for unit in units:
        is_first = best.lottery is not None and unit != units[-1] and parts_of(problem, unit) > 2
        enough = max(_ROUGH, _ENOUGH * options.tolerance)
        rough = _ROUGH_FIRST if is_first else min(_SHARE * best.gap, enough)
        finer = replace(options.after(best.calls), tolerance=rough)
        try:
            outcome = split_optimum(problem, unit, finer, guess, asked, reach)
            best = _bounded_by_split(best, outcome)
            if not is_first:
                with closing():
                    best = _improved_split(problem, best, outcome)
        except STOPS as stop:
            if best.lottery is None:
                raise
            heed(stop)
        except ModelError:  # a table of so many layers is too large
            if best.lottery is None:
                raise
            break
        if is_late() or best.gap <= options.tolerance:
            break
        guess, reach = DualGuess(outcome.found.price, _SPREAD), outcome.found.price
    return _concluded_on_split(problem, best, options)


def _begun_with_incumbent(problem: Problem) -> _Split:
    """A policy of case M, with what it costs given success; nothing, where there is none."""
    incumbent = Incumbent(problem)
    incumbent.find()
    has_answer(by_itself=incumbent.solution is not None)
    known = incumbent.solution
    if known is None:
        return _Split()
    lottery = known.policy
    return _Split(lottery, known.objective, known.budget_used, known.lower_bound)


def proved_on_split_costs(
    solution: Solution, span: float, attained: float, options: SolveOptions
) -> tuple[float, float]:
    """A bound worked out afresh, and the failure that is allowed.

    Units get smaller until the gap is what the solution says, which is taken for no more than that,
    or as small as the tolerance, or until a smaller one brings next to nothing of what is missing.

    Args:
        solution: of a problem with split costs.
        span: the totals that matter.
        attained: what its policy attains.
        options: tolerance and limits.
    """
    problem, bound, guess = solution.problem, 0.0, None
    rough = replace(options, tolerance=max(options.tolerance, _SHARE * solution.gap))
    enough = max(options.tolerance, (1.0 + _SHARE) * solution.gap)
    allowed, before = problem.failure_budget or 0.0, -np.inf
    for unit in split_units(problem, span, finest=True):
        try:
            outcome = split_optimum(problem, unit, rough, guess)
        except ModelError:  # a table of so many layers is too large
            if guess is None:
                raise
            break
        bound, allowed = max(bound, outcome.found.lower_bound), max(allowed, outcome.row.budget)
        guess = DualGuess(outcome.found.price, _SPREAD)
        missing = (1.0 - enough) * attained - bound
        if missing <= 0.0 or bound - before < _SHARE * missing:
            break
        before = bound
    return bound, allowed


def _bounded_by_split(best: _Split, outcome: RefinedOutcome) -> _Split:
    """The best that is known with the bound that one unit gives."""
    found, calls, work = outcome.found, best.calls + outcome.calls, best.work + outcome.work
    note = "" if found.finished else CUT_SHORT
    bound, process = max(best.bound, found.lower_bound), layers_of_split(outcome).process
    known = replace(best, bound=bound, price=found.price, calls=calls, work=work, note=note)
    return replace(known, layers=process.cap, end=process.cap * process.base.unit)


def _improved_split(problem: Problem, best: _Split, outcome: RefinedOutcome) -> _Split:
    """The best that is known with one unit's policies, evaluated truly."""
    least, points, chosen = outcome.least, list[Column](), None
    if least is None or outcome.row.budget > least.column.failure:
        points = _true_points(problem, outcome)
        chosen = _best_of_points(points, outcome.row)
    if chosen is None:  # the least failure keeps to the budget, if nothing else does
        least = least or layers_of_split(outcome).least_failure()
        points.append(_true_point(problem, outcome, least.policy))
        chosen = _best_of_points(points, outcome.row) or [(len(points) - 1, 1.0)]
    members, weights = [points[k] for k, _ in chosen], np.array([weight for _, weight in chosen])
    failure = float(weights @ [point.failure for point in members])
    goal = float(weights @ [point.goal for point in members])
    value = outcome.row.objective(float(weights @ [point.cost for point in members]), goal)
    if value >= best.value:
        return best
    lottery = MixedPolicy(tuple(point.policy for point in members if point.policy), weights)
    return replace(best, lottery=lottery, value=value, failure=failure)


def parts_of(problem: Problem, unit: Fraction) -> int:
    """Parts of a unit of which the cheapest step takes one at least."""
    return max(int(np.ceil(float(unit) / float(step_lattice(problem.model)[1][1]))), 1)


def _true_points(problem: Problem, outcome: RefinedOutcome) -> list[Column]:
    """Policies that split costs found, measured on the true model, on both sides of the budget.

    What keeps to the budget with split costs may break it by rounding, and the other way round:
    then prices beside the optimal one are tried.

    Raises:
        Stop: the time ended before one within the budget was measured.
    """
    compiled, found = layers_of_split(outcome), outcome.found
    pricing, one_sided = compiled.pricing(), len(outcome.found.columns) == 1
    points: list[Column] = []
    last = found.columns[0]
    try:
        for column in found.columns:
            points.append(_true_point(problem, outcome, pricing.policy(column)))
        for factor in _BESIDE:
            within = [_keeps_to_budget(point, outcome.row) for point in points]
            if is_late() or (any(within) and (one_sided or not all(within))):
                break
            price = found.price * factor if not any(within) else found.price / factor
            last = pricing.minimise(price, last)
            points.append(_true_point(problem, outcome, pricing.policy(last)))
    except STOPS as stop:
        if not any(_keeps_to_budget(point, outcome.row) for point in points):
            raise
        heed(stop)
    return points


def _true_point(problem: Problem, outcome: RefinedOutcome, policy: Policy) -> Column:
    """A policy of the model with split costs on the true one, where memory is the nearest level.

    Where a step is less than a unit its levels are parts of one: else it would round to nothing.
    """
    unit = layers_of_split(outcome).base.exact_unit
    if isinstance(policy, CostAwarePolicy):
        asked: int | None = getattr(problem, "cost_levels", None)
        room = _CELLS // max(problem.model.n_states, 1) if asked is None else asked
        parts = max(min(parts_of(problem, unit), room // policy.cap), 1)
        levels = read_only(totals_of(np.arange(policy.cap * parts + 1), unit / parts))
        nearest = np.minimum((np.arange(policy.cap * parts) + parts // 2) // parts, policy.cap - 1)
        policy = replace(
            policy,
            model=problem.model,
            levels=levels,
            decision=policy.decision[nearest] if parts > 1 else policy.decision,
            tail_threshold=policy.tail_threshold * float(unit),
        )
    elif isinstance(policy, DeterministicPolicy):
        policy = replace(policy, model=problem.model)
    found = evaluate(policy, problem)
    failure, goal = found.failure_probability, found.goal_probability
    if found.discounted_failure is not None:
        failure, goal = found.discounted_failure, 1.0 - found.discounted_failure
    cost = found.objective * goal if goal > 0.0 else 0.0
    return Column(cost, failure, goal, None, policy=policy)


def _keeps_to_budget(point: Column, row: FailureRow) -> bool:
    """Whether a policy measured on the true model keeps to the budget, up to rounding."""
    return row.spare(point) >= -_ROUNDING * min(row.budget, 1.0 - row.budget)


def _best_of_points(points: list[Column], row: FailureRow) -> list[tuple[int, float]] | None:
    """Numbers and weights of the points whose lottery is cheapest given success; None: none is.

    A ratio is least at a vertex: a point within the budget, or two between which it lies.
    """
    best, chosen = np.inf, None
    for i, inside in enumerate(points):
        if not _keeps_to_budget(inside, row) or inside.goal <= 0.0:
            continue
        if (value := row.objective(inside.cost, inside.goal)) < best:
            best, chosen = value, [(i, 1.0)]
        for j, outside in enumerate(points):
            if row.spare(outside) >= 0.0 or row.spare(inside) <= 0.0:
                continue
            weight = row.spare(inside) / excess_failure(outside, inside)
            cost = (1.0 - weight) * inside.cost + weight * outside.cost
            value = row.objective(cost, (1.0 - weight) * inside.goal + weight * outside.goal)
            if value < best:
                best, chosen = value, [(i, 1.0 - weight), (j, weight)]
    return chosen


def _concluded_on_split(problem: Problem, best: _Split, options: SolveOptions) -> Solution:
    """The solution that the best that is known makes.

    Raises:
        Stop: no policy within the budget is known.
    """
    if best.lottery is None:
        raise Stop
    note = best.note
    if best.gap > options.tolerance and not is_late() and not note:
        levels = f"{best.layers:,} levels up to {best.end:.6g}"
        is_asked = getattr(problem, "cost_levels", None) is not None
        more = "more of them leave a smaller gap" if is_asked else "no room for more of them"
        note = f"totals are rounded to {levels}: {more}"
    price = max(best.price - best.value, 0.0)
    reason = f"costs split between {best.layers:,} layers, {best.calls} pricing calls"
    run = Run(options.method, reason, best.calls, 0.0, best.work)
    found = Found(best.lottery, best.value, best.bound, best.failure, price, note=note)
    return assembled(problem, found, run)
