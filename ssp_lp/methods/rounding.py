"""Costs as multiples of a unit, where the sums of costs are too many to tell apart.

**Split costs, case S.** The optimum of the model with split costs bounds that of the true one from
below. The policies found there remember the nearest multiple of what they paid. What they cost and
how they fail on the true model is evaluated exactly, and the lottery is chosen by that, which
bounds the optimum from above. Where the value is smooth in the cost paid both miss it by about the
square of the unit, else by a share of the unit.

A step of cost c that goes on becomes two, whose costs are the multiples of a unit next to c, with
probabilities that keep the mean. At a price of failure the value as a function of the cost already
paid is a minimum of affine functions, hence concave, so that no policy of the true model does
better than the best one of this (mathematics, section 8): its optimum is a lower bound, and its
totals are layers of a lattice.

**Rounded costs, criteria of the law of the total cost.** With every cost rounded down to a multiple
of a unit a model has a lattice of totals, and as no charge falls as the total grows its optimum
bounds every policy of the true model from below. With every cost rounded up its best policy, which
remembers the rounded total, is one of the true model too: it reaches the goal as often, and later
by the rounded costs than by the true ones. So the two optima enclose the truth, whatever the unit,
and approach each other as that gets smaller (mathematics, section 8). A coarse unit answers in a
moment; finer ones follow, by the time left.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import cast

import numpy as np

from ssp_lp.accumulated_cost.charges import CostQuantileOf, TailMeanOf, WithinBound
from ssp_lp.accumulated_cost.totals import MOST_SUMS, step_costs, sums_in, totals_of
from ssp_lp.analysis.cost_law import measured_costs
from ssp_lp.analysis.evaluation import Evaluation, evaluate
from ssp_lp.arrays import SAME_TOTAL, offsets_of, read_only
from ssp_lp.column_generation.column import (
    Column,
    FailureRow,
    excess_failure,
    relative_gap,
    two_sided_gap,
)
from ssp_lp.column_generation.compiled_problem import CompiledAccumulatedCost
from ssp_lp.column_generation.search import DualGuess
from ssp_lp.compiled.deadline import Stop, WithIncumbent, closing, has_answer, is_late
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.errors import ModelError
from ssp_lp.methods.columns import (
    RefinedOutcome,
    best_within_budget,
    cheapest_at_least_failure,
    refined_optimum,
)
from ssp_lp.methods.incumbent import Incumbent
from ssp_lp.methods.refinement import Proved, refine
from ssp_lp.methods.risk import Near, exactly_refuted, least_risk, question_of_compiled
from ssp_lp.model import SSP
from ssp_lp.model.graph import dead_ends
from ssp_lp.options import CERTIFYING, SolveOptions
from ssp_lp.policies import CostAwarePolicy, DeterministicPolicy, MixedPolicy
from ssp_lp.policies.policy import Policy
from ssp_lp.problem import (
    Problem,
    Requirements,
    Restated,
    TotalScale,
    compiled_constrained,
    requirements,
)
from ssp_lp.processes.failure_semantics import start_distribution
from ssp_lp.solution import CUT_SHORT, Found, Run, Solution, assembled

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


def solve_on_split_costs(problem: Problem, options: SolveOptions) -> Solution:
    """The best lottery and the best lower bound that finer and finer units give.

    Args:
        problem: of case S, failure alone limited.
        options: tolerance and limits.

    Raises:
        InfeasibleError: no policy keeps to the budget.
        Stop: the time ended before one that does was found.
    """
    best = refine(_split_attempts(problem, options), options.tolerance)
    return _split_solution(problem, best, options)


def _split_attempts(problem: Problem, options: SolveOptions) -> Iterator[_Split]:
    """The best that is known after each unit."""
    best, guess, span = _incumbent_split(problem), None, span_of_steps(problem)
    asked: int | None = getattr(problem, "cost_levels", None)
    reach, units = _REACH * span, list(split_units(problem, span))
    if best.lottery is not None:
        yield best
    for unit in units:
        is_first = best.lottery is not None and unit != units[-1] and parts_of(problem, unit) > 2
        enough = max(_ROUGH, _ENOUGH * options.tolerance)
        rough = _ROUGH_FIRST if is_first else min(_SHARE * best.gap, enough)
        finer = replace(options.after(best.calls), tolerance=rough)
        try:
            outcome = split_optimum(problem, unit, finer, guess, asked, reach)
            best = _with_split_bound(best, outcome)
            if not is_first:
                with WithIncumbent() as improving, closing():
                    best = _with_true_lottery(problem, best, outcome)
                if improving.stop and best.lottery is None:
                    raise improving.stop
        except ModelError:  # a table of so many layers is too large
            if best.lottery is None:
                raise
            return
        yield best
        guess, reach = DualGuess(outcome.found.price, _SPREAD), outcome.found.price


def _incumbent_split(problem: Problem) -> _Split:
    """A policy of case M, with what it costs given success; nothing, where there is none."""
    incumbent = Incumbent(problem)
    incumbent.find()
    has_answer(by_itself=incumbent.solution is not None)
    known = incumbent.solution
    if known is None:
        return _Split()
    lottery = known.policy
    return _Split(lottery, known.objective, known.budget_used, known.lower_bound)


def prove_on_split_costs(solution: Solution, evaluation: Evaluation, _: float) -> Proved:
    """A bound worked out afresh, and the failure that is allowed.

    Units get smaller until the gap is what the solution says, which is taken for no more than that,
    or as small as the tolerance, or until a smaller one brings next to nothing of what is missing.

    Args:
        solution: of a problem with split costs.
        evaluation: what its policy attains.
    """
    rough = replace(CERTIFYING, tolerance=max(CERTIFYING.tolerance, _SHARE * solution.gap))
    enough = max(CERTIFYING.tolerance, (1.0 + _SHARE) * solution.gap)
    return refine(_split_proofs(solution.problem, evaluation.objective, enough, rough), enough)


def _split_proofs(
    problem: Problem, attained: float, enough: float, rough: SolveOptions
) -> Iterator[Proved]:
    """The best bound that units prove, until a finer one adds next to nothing to it."""
    guess, proved, before = None, Proved(attained, 0.0, problem.failure_budget or 0.0), -np.inf
    for unit in split_units(problem, span_of_steps(problem), finest=True):
        try:
            outcome = split_optimum(problem, unit, rough, guess)
        except ModelError:  # a table of so many layers is too large
            if guess is None:
                raise
            return
        bound = max(proved.bound, outcome.found.lower_bound)
        proved = Proved(attained, bound, max(proved.allowed, outcome.row.budget))
        yield proved
        guess = DualGuess(outcome.found.price, _SPREAD)
        if bound - before < _SHARE * ((1.0 - enough) * attained - bound):
            return
        before = bound


def _with_split_bound(best: _Split, outcome: RefinedOutcome) -> _Split:
    """The best that is known with the bound that one unit gives."""
    generated, calls, work = outcome.found, best.calls + outcome.calls, best.work + outcome.work
    note = "" if generated.finished else CUT_SHORT
    bound, process = max(best.bound, generated.lower_bound), layers_of_split(outcome).process
    known = replace(best, bound=bound, price=generated.price, calls=calls, work=work, note=note)
    return replace(known, layers=process.cap, end=process.cap * process.base.unit)


def _with_true_lottery(problem: Problem, best: _Split, outcome: RefinedOutcome) -> _Split:
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
    return max(int(np.ceil(float(unit) / float(step_costs(problem.model)[1][1]))), 1)


def _true_points(problem: Problem, outcome: RefinedOutcome) -> list[Column]:
    """Policies that split costs found, measured on the true model, on both sides of the budget.

    What keeps to the budget with split costs may break it by rounding, and the other way round:
    then prices beside the optimal one are tried.

    Raises:
        Stop: the time ended before one within the budget was measured.
    """
    compiled, generated = layers_of_split(outcome), outcome.found
    pricing, one_sided = compiled.pricing(), len(outcome.found.columns) == 1
    points: list[Column] = []
    last = generated.columns[0]
    with WithIncumbent() as search:
        for column in generated.columns:
            points.append(_true_point(problem, outcome, pricing.policy(column)))
        for factor in _BESIDE:
            within = [_keeps_to_budget(point, outcome.row) for point in points]
            if is_late() or (any(within) and (one_sided or not all(within))):
                break
            price = generated.price * factor if not any(within) else generated.price / factor
            last = pricing.minimise(price, last)
            points.append(_true_point(problem, outcome, pricing.policy(last)))
    if search.stop and not any(_keeps_to_budget(point, outcome.row) for point in points):
        raise search.stop
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
    evaluation = evaluate(policy, problem)
    failure, goal = evaluation.failure_probability, evaluation.goal_probability
    if evaluation.discounted_failure is not None:
        failure, goal = evaluation.discounted_failure, 1.0 - evaluation.discounted_failure
    cost = evaluation.objective * goal if goal > 0.0 else 0.0
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


def _split_solution(problem: Problem, best: _Split, options: SolveOptions) -> Solution:
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
    answer = Found(best.lottery, best.value, best.bound, best.failure, price, note=note)
    return assembled(problem, answer, run)


_WIDEST = 1_000.0  # times as dear may one step be as another, or a unit rounds too much to nothing
_FEW_SUMS = 1_000  # that are told apart exactly rather than by a grid
_SECONDS = 1.5e-8  # that a search takes for each sum and outcome
_MARGIN = 1.25  # beyond a price from a coarser unit: what is paid there still counts for something
_TRIES = 6  # units, until levels are as few as is asked for


def is_split(problem: Problem, asked: Requirements, seconds: float = np.inf) -> bool:
    """Whether the costs of a problem are to be split.

    They are in case S where the sums of costs are too many to be told apart, or, where these are
    known to be told apart, if that hardly ends in the time that is left; where failure alone is
    limited, and no step is far dearer than others.

    Args:
        problem: the problem.
        asked: what it asks.
        seconds: that are left.
    """
    on_grid = asked.totals is TotalScale.GRID
    is_mean = asked.ratio and asked.measure is None and not (asked.rows or asked.least_failure)
    if not is_mean or getattr(problem, "cost_cap", None) is not None:
        return False
    if not on_grid and not (np.isfinite(seconds) and asked.totals is TotalScale.SUMS):
        return False
    steps = step_costs(problem.model)[1]
    if len(steps) <= 1 or steps[-1] > _WIDEST * steps[1]:
        return False
    levels: int | None = getattr(problem, "cost_levels", None) if on_grid else MOST_SUMS
    most = _FEW_SUMS if levels is None else int(levels)
    sums = sums_in(problem.model, span_of_steps(problem), most)
    if on_grid:
        return sums is None
    many = most if sums is None else len(sums)
    return _SECONDS * many * problem.model.n_outcomes > seconds


def with_split_costs(model: SSP, unit: Fraction) -> SSP:
    """The model with each step that goes on split between two multiples of a unit.

    The last step of an episode is left as it is: whatever it costs, nothing has to remember it.

    Args:
        model: the model.
        unit: of which costs become multiples.
    """
    ended = dead_ends(model) | model.goal_mask
    units = np.where(ended[model.successors], 0.0, model.costs / float(unit))
    whole = np.floor(units * (1.0 + SAME_TOTAL))
    share = np.clip(units - whole, 0.0, 1.0)  # of the multiple above
    share[share <= SAME_TOTAL * units] = 0.0
    copies = 1 + (share > 0.0)
    outcome = np.repeat(np.arange(model.n_outcomes), copies)
    is_above = np.append(False, outcome[1:] == outcome[:-1])
    part = np.where(is_above, share[outcome], 1.0 - share[outcome])
    cost = totals_of((whole[outcome] + is_above).astype(np.int64), unit)
    return replace(
        model,
        outcome_offsets=read_only(offsets_of(copies)[model.outcome_offsets]),
        successors=read_only(model.successors[outcome]),
        probabilities=read_only(model.probabilities[outcome] * part),
        costs=read_only(np.where(ended[model.successors[outcome]], model.costs[outcome], cost)),
        exact_costs={},
    )


def split_units(problem: Problem, span: float, *, finest: bool = False) -> Iterator[Fraction]:
    """Smaller and smaller units, none of which splits a step into nothing, if these are few.

    Args:
        problem: of case S.
        span: the totals that matter.
        finest: as far as there is room, whatever is asked for.
    """
    cheapest = float(step_costs(problem.model)[1][1])
    return rounding_units(problem, span, cheapest=cheapest, finest=finest)


def span_of_steps(problem: Problem) -> float:
    """The totals that matter; what a step costs that only ends an episode is not remembered."""
    return span_of_totals(problem, float(step_costs(problem.model)[1][-1]))


def split_optimum(
    problem: Problem,
    unit: Fraction,
    options: SolveOptions,
    guess: DualGuess | None,
    most: int | None = None,
    reach: float = np.inf,
) -> RefinedOutcome:
    """The optimum with split costs, of a larger unit where levels are more than asked for.

    Where no larger one makes them few enough, they are cut where as many are passed.

    Args:
        problem: of case S.
        unit: of which costs become multiples.
        options: tolerance and limits.
        guess: of the price of failure; None: nothing is known.
        most: levels; None: any number.
        reach: total up to which layers are told apart at first; infinite: a guess is made.

    Raises:
        InfeasibleError: no policy keeps to the budget.
        ModelError: a table of so many layers is too large.
        Stop: the time ended before a policy that keeps to the budget was found.
    """
    budget = 1.0 if problem.failure_budget is None else problem.failure_budget
    for tried in range(_TRIES):
        model = with_split_costs(problem.model, unit)
        start, fixed = start_distribution(model, problem.start), None
        if most is not None and tried + 1 == _TRIES:
            fixed = (most - 0.5) * float(unit)
        cap = None if np.isinf(reach) or fixed else int(np.ceil(_MARGIN * reach / float(unit))) + 1
        compiled = CompiledAccumulatedCost(model, start, problem.discount, fixed, cap)
        outcome = refined_optimum(compiled, budget, options, guess)
        layers = layers_of_split(outcome).process.cap
        if most is None or layers <= most or is_late():
            break
        unit = short_decimal(1.02 * float(unit) * layers / most)
    return outcome


def layers_of_split(outcome: RefinedOutcome) -> CompiledAccumulatedCost:
    """The process that a search on split costs ended with."""
    return cast("CompiledAccumulatedCost", outcome.compiled)  # as it was handed to the search


def _solved_on_lattice(
    problem: Restated, options: SolveOptions, near: Near | None = None
) -> Solution:
    """The solution of a problem of rounded costs, exact but for these."""
    if not requirements(problem).is_risk:
        solved = cheapest_at_least_failure if problem.failure_budget is None else best_within_budget
        return solved(problem, options)
    question = question_of_compiled(problem.compile(), problem.failure_budget)
    return least_risk(problem, options, question, near)


def solve_on_rounded_costs(problem: Problem, options: SolveOptions) -> Solution:
    """The best policy for rounded costs, and the bound of costs rounded the other way.

    Args:
        problem: a criterion of the law of the total cost, failure alone limited.
        options: tolerance and limits.

    Raises:
        InfeasibleError: no policy keeps to the budget.
        Stop: the time ended before one that does was found.
    """
    best = refine(_rounded_attempts(problem, options), options.tolerance)
    return _rounded_solution(problem, best, options)


@dataclass(frozen=True, eq=False)
class _Rounded:
    """The best policy that is known, by costs rounded up, and a bound of all others."""

    solution: Solution
    bound: float
    unit: Fraction

    @property
    def gap(self) -> float:
        """Relative gap between what costs rounded up and down say."""
        return two_sided_gap(self.solution.objective, self.bound)


def _rounded_attempts(problem: Problem, options: SolveOptions) -> Iterator[_Rounded]:
    """The best policy, and the best bound, that are known after each unit."""
    attempt: _Rounded | None = None
    sign = -1.0 if problem.semantics.maximises else 1.0
    bound, span, measure = _no_worse(problem), span_of_totals(problem), problem.semantics.measure
    for unit in rounding_units(problem, span):
        best = None if attempt is None else attempt.solution
        rough = float(unit) / span if attempt is None else _SHARE * attempt.gap
        finer = replace(options, tolerance=max(options.tolerance, rough))
        try:
            near = None if best is None else _starting_point(problem, best)
            # the best policy of costs rounded up, on the model itself
            solution = _solved_on_lattice(_with_rounded_costs(problem, unit, up=True), finer, near)
            members = tuple(_rounding_up(p, problem.model, unit) for p in solution.policy.policies)
            policy = MixedPolicy(members, solution.policy.weights)
            solution = replace(solution, policy=policy, value_function=None)
            if measure is not None and measure.is_a_total:
                law = measured_costs(policy, problem)
                if law.is_finer:
                    attained = min(measure.of(law), solution.objective)
                    solution = replace(solution, objective=attained)
            if best is None or sign * solution.objective < sign * best.objective:
                best = solution
            with WithIncumbent():
                proved = lattice_bound(problem, unit, finer, best.objective, near)[0]
                bound = sign * max(sign * bound, sign * proved)
        except ModelError:  # a table of so many layers is too large
            if best is None:
                raise
            return
        attempt = _Rounded(best, bound, unit)
        yield attempt


def prove_on_rounded_costs(solution: Solution, evaluation: Evaluation, _: float) -> Proved:
    """A bound worked out afresh, and the failure that is allowed.

    Units get smaller until the gap is what the solution says, which is taken for no more than that.

    Args:
        solution: of ``solve_on_rounded_costs``.
        evaluation: what its policy attains.
    """
    rough = replace(CERTIFYING, tolerance=max(CERTIFYING.tolerance, _SHARE * solution.gap))
    enough = max(CERTIFYING.tolerance, (1.0 + _SHARE) * solution.gap)
    return refine(_rounded_proofs(solution.problem, evaluation.objective, rough), enough)


def _rounded_proofs(problem: Problem, attained: float, rough: SolveOptions) -> Iterator[Proved]:
    """The best bound that is known after each unit."""
    sign = -1.0 if problem.semantics.maximises else 1.0
    bound, allowed = _no_worse(problem), np.inf
    for unit in rounding_units(problem, span_of_totals(problem), finest=True):
        try:
            proved, allowed = lattice_bound(problem, unit, rough, attained)
        except ModelError:  # a table of so many layers is too large
            if np.isinf(allowed):
                raise
            return
        bound = sign * max(sign * bound, sign * proved)
        yield Proved(attained, bound, allowed)


def lattice_bound(
    problem: Problem,
    unit: Fraction,
    options: SolveOptions,
    attained: float,
    near: Near | None = None,
) -> tuple[float, float]:
    """What no policy does better than, by costs rounded down, and the failure that is allowed.

    A quantile is one of the totals: exact ones may prove what is attained to be the best.

    Args:
        problem: the problem.
        unit: of which costs are multiples.
        options: tolerance and limits.
        attained: what some policy does.
        near: where a search may begin; None: unknown.
    """
    rounded, budget = _with_rounded_costs(problem, unit, up=False), problem.failure_budget
    measure = problem.semantics.measure
    if isinstance(measure, CostQuantileOf):
        question = question_of_compiled(rounded.compile(), budget)
        bound = exactly_refuted(question, problem.model, measure.level, attained)
        if bound > 0.0:
            return bound, question.allowed
    solution = _solved_on_lattice(rounded, options, near)
    bound = solution.lower_bound if solution.upper_bound is None else solution.upper_bound
    return bound, solution.budget_used if budget is None else max(budget, solution.budget_used)


def _starting_point(problem: Problem, best: Solution) -> Near | None:
    """Where a risk's search may begin, from the policy of coarser costs."""
    match problem.semantics.measure:
        case CostQuantileOf(level) | TailMeanOf(level):
            quantile = measured_costs(best.policy, problem).quantile(level)
            price = best.failure_price
            return Near(quantile, 0.0 if price is None else price + best.objective)
    return None


def _rounding_up(policy: Policy, model: SSP, unit: Fraction) -> CostAwarePolicy:
    """A policy of the model with rounded costs on the model itself.

    One that remembers nothing is given a layer to remember, so that its law is rounded alike.

    Raises:
        ModelError: it remembers something else than the cost paid.
    """
    if isinstance(policy, CostAwarePolicy):
        return replace(policy, model=model, rounds_up=True)
    if not isinstance(policy, DeterministicPolicy):
        raise ModelError(f"a {type(policy).__name__} does not remember the cost paid")
    pair, first = policy.decision, model.pair_offsets[:-1]
    position = np.where(pair < 0, pair, pair - first)[None, :]
    never = np.full(model.n_states, np.inf)
    return CostAwarePolicy(model, float(unit), position, pair[None, :], never, rounds_up=True)


def _with_rounded_costs(problem: Problem, unit: Fraction, *, up: bool) -> Restated:
    """The problem with costs that are multiples of a unit."""
    model = problem.model
    kinds, kind = np.unique(model.costs, return_inverse=True)
    units = kinds / float(unit)
    whole = np.ceil(units * (1.0 - SAME_TOTAL)) if up else np.floor(units * (1.0 + SAME_TOTAL))
    measure = problem.semantics.measure
    if isinstance(measure, WithinBound):  # one step beyond the bound is as late as any
        whole = np.minimum(whole, np.ceil(float(measure.bound) / float(unit)) + 2.0)
    costs = totals_of(whole.astype(np.int64), unit)[kind]
    rounded = replace(model, costs=read_only(costs), exact_costs={})
    asked = problem.start, problem.ratio, problem.failure_budget, problem.semantics
    return Restated(rounded, *asked)


def _no_worse(problem: Problem) -> float:
    """What is known of the optimum before anything is solved."""
    semantics, charge = problem.semantics, problem.semantics.charge(problem.ratio)
    if charge is None or not semantics.maximises:
        return 0.0
    return semantics.failing_worth - charge.lowest


def _rounded_solution(problem: Problem, attempt: _Rounded, options: SolveOptions) -> Solution:
    """The best policy with the best bound, and what a reader should know."""
    best, bound = attempt.solution, attempt.bound
    maximised, attained = problem.semantics.maximises, best.objective
    measure = problem.semantics.measure
    if measure is not None and measure.charge.settled is None and not is_late():
        with WithIncumbent():
            attained = measure.of(measured_costs(best.policy, problem))  # beyond its table, too
    told = best.note
    if two_sided_gap(attained, bound) > options.tolerance and not is_late():
        more = "no room for more levels"
        if getattr(problem, "cost_levels", None) is not None:
            more = "more levels leave a smaller gap"
        told = f"costs are rounded to multiples of {float(attempt.unit):g}: {more}"
    return replace(
        best,
        problem=problem,
        objective=attained,
        lower_bound=attained if maximised else min(bound, attained),
        upper_bound=max(bound, attained) if maximised else None,
        note=told,
    )


_FIRST = 128  # units in the totals that matter, at first
_FINER = 4.0  # times as many next
_QUICK = 3e8  # units times outcomes that a sweep soon passes over
_MOST = 8_192  # unless more are asked for
_ROOM = 6_000_000  # states times units
_FINEST = 65_536  # in any case
_ROOM_FOR_DIGITS = 1.1  # by which a number of two digits may lie above another
_WORTH_WHILE = 1.5  # times as many units: no reason to search again for fewer
_TYPICAL = 2.0  # costs given success of the safest policy: beyond them few totals matter
_RARE = 20.0  # times as dear as all that matters may a single step be


def rounding_units(
    problem: Problem, span: float, *, cheapest: float = np.inf, finest: bool = False
) -> Iterator[Fraction]:
    """Smaller and smaller units, as far as is asked for.

    Args:
        problem: with ``cost_levels`` if these are limited.
        span: the totals that matter.
        cheapest: step that is to be a unit at least, if that makes no great many.
        finest: as far as there is room, whatever is asked for.
    """
    asked: int | None = None if finest else getattr(problem, "cost_levels", None)
    room = min(max(_MOST, _ROOM // problem.model.n_states), _FINEST)
    most = asked or room
    least = _ROOM_FOR_DIGITS * span / cheapest
    is_quick = least * problem.model.n_outcomes <= _QUICK
    many = float(min(max(_FIRST, least if is_quick else 0.0), most))
    while many <= most:
        yield short_decimal(span / many)
        many = min(_FINER * many, float(most)) if _WORTH_WHILE * many <= most else _FINER * many


def short_decimal(size: float) -> Fraction:
    """The least number of two digits that is no smaller: its multiples are short decimals."""
    power = Fraction(10) ** (int(np.floor(np.log10(size))) - 1)
    return int(np.ceil(size / float(power) * (1.0 - SAME_TOTAL))) * power


def span_of_totals(problem: Problem, dearest: float | None = None) -> float:
    """The totals that matter: up to the bound, or some typical costs.

    Args:
        problem: the problem.
        dearest: the greatest cost of a single step to be remembered; None: of any step.
    """
    measure = problem.semantics.measure
    dearest = float(problem.model.costs.max(initial=0.0)) if dearest is None else dearest
    if isinstance(measure, WithinBound) and measure.bound > 0.0:
        return float(measure.bound)
    typical = _TYPICAL * compiled_constrained(problem).typical_cost
    settled = 0.0 if measure is None else measure.charge.settled or 0.0
    return max(typical, dearest / _RARE, settled) or 1.0
