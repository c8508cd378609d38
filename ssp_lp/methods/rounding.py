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

A lattice of many totals is looked at through a coarser unit first, most often that of most costs.
Where only costs that hardly matter are split by it, both sides meet at once, and the search on all
totals is spared; else it begins near its price.

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
from dataclasses import replace
from fractions import Fraction
from typing import cast

import numpy as np

from ssp_lp.accumulated_cost.charges import WithinBound
from ssp_lp.accumulated_cost.totals import (
    MOST_SUMS,
    common_unit,
    step_costs,
    sums_in,
    totals_of,
)
from ssp_lp.analysis.evaluation import Evaluation, evaluate, measured_costs
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
from ssp_lp.compiled.deadline import WithIncumbent, closing, ensure_incumbent, is_late
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
from ssp_lp.methods.risk import Near, least_risk, question_of_compiled
from ssp_lp.model import SSP
from ssp_lp.model.graph import dead_ends, goal_approach, kept
from ssp_lp.options import CERTIFYING, SolveOptions
from ssp_lp.policies import CostAwarePolicy, DeterministicPolicy, MixedPolicy
from ssp_lp.policies.policy import Policy
from ssp_lp.problem import Problem, Requirements, Restated, TotalScale, compiled_constrained
from ssp_lp.processes.failure_semantics import start_distribution
from ssp_lp.processes.live_rows import uniform_cost
from ssp_lp.solution import CUT_SHORT, Answer, Run, Solution, assembled

_ROUGH = 1e-4  # how exactly the first model of split costs is solved
_ROUGH_FIRST = 1e-3  # and one that only says where a price lies, with steps far below a unit
_ENOUGH = 0.3  # of the tolerance: as exactly at least
_SHARE = 0.1  # of the gap that splitting leaves: as exactly is the next one solved
_ROUGH_COARSE = 1e-5  # how exactly a lattice of a coarser unit is solved, for its price
_SPREAD = 1e-2  # relative uncertainty of a price from a coarser unit
_HALFWAY = 1e-6  # of a level: a cost so near to the middle between two
_STRETCH = 1e-7  # of levels, so that no cost is halfway
_MET = 0.75  # of the tolerance: a unit is chosen that should leave so much
_BELOW_FINEST = 0.6  # of the finest unit of all: one that meets the tolerance may be so small
_BESIDE = (1.003, 1.01, 1.03, 1.1, 1.5, 10.0, 1e3)  # times the price: policies of the other side
_SHIFT = 1e-9  # of a failure by rounding, from which policies beside are looked for
_APART = (0.1, 0.5, 2.0)  # shifts beyond the budget at which a policy is tried
_REACH = 0.5  # of the totals that matter: so far they are remembered at first
_CELLS = 100_000_000  # states times levels that a policy measured truly may have
_ROUNDING = 1e-12  # of the budget, or of what it leaves: so far a policy may seem to break it


def solve_on_split_costs(problem: Problem, options: SolveOptions) -> Solution:
    """Solve on split costs: best lottery and best bound that finer and finer units give.

    Args:
        problem: of case S, failure alone limited.
        options: tolerance and limits.

    Raises:
        InfeasibleError: no policy keeps to the budget.
        Stop: the time ended before one that does was found.
    """
    best = refine(_split_attempts(problem, options), options.tolerance)
    if best.note != CUT_SHORT and (best.gap <= options.tolerance or is_late()):
        return replace(best, note="")
    return best


def _split_attempts(problem: Problem, options: SolveOptions) -> Iterator[Solution]:
    """Best lottery of the true model and best bound after each unit of split costs."""
    incumbent, best, bound, calls, work = Incumbent(problem), None, 0.0, 0, Work()
    ensure_incumbent(by_itself=incumbent.find() is not None)
    if (solution := incumbent.solution) is not None:
        best = Answer(solution.policy, solution.objective, 0.0, solution.budget_used)
        bound = solution.lower_bound
        yield replace(solution, note="")
    most, cheapest = _levels_asked(problem), float(step_costs(problem.model)[1][1])
    units, guess, reach = (
        list(_split_units(problem)),
        None,
        _MARGIN * _REACH * _span_of_steps(problem),
    )
    finest = units[-1]
    while units:
        unit = units.pop(0)
        for_price = best is not None and unit != finest and float(unit) > 2.0 * cheapest
        value, gap = np.inf, np.inf
        if best is not None:
            value, gap = best.value, relative_gap(best.value, bound)
        rough = min(_SHARE * gap, max(_ROUGH, _ENOUGH * options.tolerance))
        finer = replace(options.after(calls), tolerance=_ROUGH_FIRST if for_price else rough)
        outcome = split_optimum(problem, unit, finer, guess, most, reach)
        generated, layers = outcome.generated, outcome.compiled.layers
        bound, calls = max(bound, generated.lower_bound), calls + outcome.calls
        work, price, total = work + outcome.work, generated.price, layers * float(_unit_of(outcome))
        reach = total if total > _FAR_BEYOND * price else _MARGIN * price
        guess = DualGuess(price, _SPREAD, slack=len(generated.columns) == 1)
        if not for_price:  # a coarse unit only says where the price lies
            with WithIncumbent() as measuring, closing():
                lottery = _true_lottery(problem, outcome)
                best = lottery if lottery.value < value else best
            if measuring.stop and best is None:
                raise measuring.stop
        if best is None:
            continue
        levels = f"{layers:,} levels up to {layers * float(_unit_of(outcome)):.6g}"
        more = "more of them leave a smaller gap" if most else "no room for more of them"
        note = f"totals are rounded to {levels}: {more}" if generated.finished else CUT_SHORT
        gap = relative_gap(best.value, bound)
        if units and most is None and gap > options.tolerance and not for_price:
            # the gap falls with the square of the unit
            enough = float(_unit_of(outcome)) * np.sqrt(_MET * options.tolerance / gap)
            if _BELOW_FINEST * float(finest) <= enough < float(unit):
                sufficient = short_decimal(enough)
                units = [sufficient, *(u for u in units if u < sufficient)]
        reason = f"costs split between {layers:,} layers, {calls} pricing calls"
        answer = replace(best, bound=bound, price=max(price - best.value, 0.0), note=note)
        yield assembled(problem, answer, Run(options.method, reason, calls, 0.0, work))


def solve_on_fine_lattice(problem: Problem, options: SolveOptions) -> Solution:
    """Solve on a lattice of many totals, of which a coarser unit says first where the price lies.

    Args:
        problem: of case S, failure alone limited.
        options: tolerance and limits.

    Raises:
        InfeasibleError: no policy keeps to the budget.
        Stop: the time ended before one that does was found.
    """
    coarse = coarser_unit(problem, problem.requirements)
    if coarse is None or options.deterministic or options.program:
        return best_within_budget(problem, options)
    return refine(_lattice_attempts(problem, options, *coarse), options.tolerance)


def _lattice_attempts(
    problem: Problem, options: SolveOptions, unit: Fraction, is_of_most: bool
) -> Iterator[Solution]:
    """Best lottery that costs split on a lattice's coarser unit give; then the optimum."""
    closely = replace(options, tolerance=max(_ROUGH_COARSE, options.tolerance))
    outcome = split_optimum(problem, unit, options if is_of_most else closely, None)
    generated, calls, work = outcome.generated, outcome.calls, outcome.work
    reason = f"costs split between {outcome.compiled.layers:,} layers, {calls} pricing calls"
    lottery: Answer | None = None
    with WithIncumbent(), closing():
        lottery = _true_lottery(problem, outcome)
    if lottery is not None:
        price = max(generated.price - lottery.value, 0.0)
        note = "" if generated.finished else CUT_SHORT
        answer = replace(lottery, bound=generated.lower_bound, price=price, note=note)
        yield assembled(problem, answer, Run(options.method, reason, calls, 0.0, work))
    guess = DualGuess(generated.price, _SPREAD, slack=len(generated.columns) == 1)
    optimum = best_within_budget(problem, options.after(calls), guess)
    run = optimum.run
    reason, calls = f"{reason}, then {run.reason}", calls + run.pricing_calls
    run = replace(run, reason=reason, pricing_calls=calls, work=work + run.work)
    yield replace(optimum, run=run)


def prove_by_units(solution: Solution, evaluation: Evaluation, _: float) -> Proved:
    """Prove a bound afresh by rounding units, and the failure that is allowed.

    Units get smaller until the gap is what the solution says, which is taken for no more than that,
    or as small as the tolerance; of split costs, until a smaller one brings next to nothing of what
    is missing.

    Args:
        solution: of a problem with split or rounded costs.
        evaluation: what its policy attains.
    """
    problem, attained = solution.problem, evaluation.objective
    rough = replace(CERTIFYING, tolerance=max(CERTIFYING.tolerance, _SHARE * solution.gap))
    enough = max(CERTIFYING.tolerance, (1.0 + _SHARE) * solution.gap)
    if not problem.semantics.counts_law:
        return refine(_split_proofs(problem, attained, enough, rough), enough)
    return refine(_rounded_proofs(problem, attained, rough), enough)


def _split_proofs(
    problem: Problem, attained: float, enough: float, rough: SolveOptions
) -> Iterator[Proved]:
    """Best bound that units of split costs prove, until a finer one adds next to nothing."""
    guess, bound, allowed, before = None, 0.0, problem.failure_budget or 0.0, -np.inf
    for unit in _split_units(problem, finest=True):
        outcome = split_optimum(problem, unit, rough, guess)
        guess = DualGuess(outcome.generated.price, _SPREAD)
        bound, allowed = max(bound, outcome.generated.lower_bound), max(allowed, outcome.row.budget)
        yield Proved(attained, bound, allowed)
        if bound - before < _SHARE * ((1.0 - enough) * attained - bound):
            return
        before = bound


def _true_lottery(problem: Problem, outcome: RefinedOutcome) -> Answer:
    """Best lottery over one rounding unit's policies, evaluated on the true model."""
    row, least, columns, members = outcome.row, outcome.least, list[Column](), None
    if least is None or row.budget > least.column.failure:
        columns = _true_columns(problem, outcome)
        members = _best_lottery(columns, row)
    if members is None:  # the least failure keeps to the budget, if nothing else does
        least = least or outcome.compiled.least_failure()
        columns.append(_true_column(problem, outcome, least.policy))
        members = _best_lottery(columns, row) or [(columns[-1], 1.0)]
    weights = np.array([weight for _, weight in members])
    cost, failure, goal = weights @ [(c.cost, c.failure, c.goal) for c, _ in members]
    lottery = MixedPolicy(tuple(c.policy for c, _ in members if c.policy), weights)
    return Answer(lottery, row.objective(float(cost), float(goal)), 0.0, float(failure))


def _true_columns(problem: Problem, outcome: RefinedOutcome) -> list[Column]:
    """Policies that split costs found, measured on the true model, on both sides of the budget.

    What keeps to the budget with split costs may break it by rounding, and the other way round:
    then prices beside the optimal one are tried.

    Raises:
        Stop: the time ended before one within the budget was measured.
    """
    generated, pricing, row = outcome.generated, outcome.compiled.pricing(), outcome.row
    columns, last, one_sided = list[Column](), generated.columns[0], len(generated.columns) == 1
    with WithIncumbent() as search:
        columns.append(_true_column(problem, outcome, pricing.policy(generated.columns[0])))
        shift = columns[0].failure - generated.columns[0].failure
        if abs(shift) > _SHIFT:
            columns += _columns_beside(problem, outcome, shift)
        for column in generated.columns[1:] if len(columns) == 1 else ():
            columns.append(_true_column(problem, outcome, pricing.policy(column)))
        for factor in _BESIDE:
            within = [_keeps_to_budget(column, row) for column in columns]
            if is_late() or (any(within) and (one_sided or not all(within))):
                break
            price = generated.price / factor if any(within) else generated.price * factor
            last = pricing.minimise(price, last)
            columns.append(_true_column(problem, outcome, pricing.policy(last)))
    if search.stop and not any(_keeps_to_budget(column, row) for column in columns):
        raise search.stop
    return columns


def _true_column(problem: Problem, outcome: RefinedOutcome, policy: Policy) -> Column:
    """Policy of the model with split costs on the true one, where memory is the nearest level.

    Where a step is less than a unit its levels are parts of one: else it would round to nothing.
    """
    if isinstance(policy, CostAwarePolicy):
        unit, most = _unit_of(outcome), _levels_asked(problem)
        room = _CELLS // max(problem.model.n_states, 1) if most is None else most
        # parts of which the cheapest step takes one at least
        parts = int(np.ceil(float(unit) / float(step_costs(problem.model)[1][1])))
        parts = max(min(parts, room // policy.cap), 1)
        levels = totals_of(np.arange(policy.cap * parts + 1), unit / parts)
        halves = step_costs(problem.model)[1] / float(unit / parts) % 1.0 - 0.5
        if (np.abs(halves) < _HALFWAY).any():  # else rounding chooses the nearest level
            levels = levels * (1.0 + _STRETCH)
        nearest = np.minimum((np.arange(policy.cap * parts) + parts // 2) // parts, policy.cap - 1)
        policy = replace(
            policy,
            model=problem.model,
            levels=read_only(levels),
            decision=policy.decision[nearest] if parts > 1 else policy.decision,
            tail_threshold=policy.tail_threshold * float(unit),
        )
    elif isinstance(policy, DeterministicPolicy):
        policy = replace(policy, model=problem.model)
    evaluation = evaluate(policy, problem)
    failure, goal = evaluation.limited_failure, evaluation.goal_probability
    if evaluation.discounted_failure is not None:
        goal = 1.0 - failure
    cost = evaluation.objective * goal if goal > 0.0 else 0.0
    return Column(cost, failure, goal, None, policy=policy)


def _columns_beside(problem: Problem, outcome: RefinedOutcome, shift: float) -> list[Column]:
    """Policies that split costs found on the way, measured truly, next to the budget on both sides.

    Rounding shifts how often all of them fail by about as much.

    Args:
        problem: of case S.
        outcome: of the search on split costs.
        shift: of how often they fail, by rounding.
    """
    pricing, row, first = outcome.compiled.pricing(), outcome.row, outcome.generated.columns[0]
    tried = {pricing.policy(first).memory_size}  # each has its own number of layers
    columns = list[Column]()
    for above in (False, True):
        for apart in _APART:
            off = (apart if above else -apart) * abs(shift) - shift
            policy = pricing.policy_failing(first, row.budget + off, above=above)
            if policy is None or policy.memory_size in tried:
                continue
            tried.add(policy.memory_size)
            columns.append(_true_column(problem, outcome, policy))
            if _keeps_to_budget(columns[-1], row) != above:
                break
    return columns


def _keeps_to_budget(column: Column, row: FailureRow) -> bool:
    """Whether a policy of split costs keeps to the budget on the true model, up to rounding."""
    return row.spare(column) >= -_ROUNDING * min(row.budget, 1.0 - row.budget)


def _best_lottery(columns: list[Column], row: FailureRow) -> list[tuple[Column, float]] | None:
    """Members and weights of split costs' cheapest lottery given success; None: none is allowed.

    A ratio is least at a vertex: a policy within the budget, or two between which it lies.
    """
    best, members = np.inf, None
    for inside in columns:
        if not _keeps_to_budget(inside, row) or inside.goal <= 0.0:
            continue
        if (value := row.objective(inside.cost, inside.goal)) < best:
            best, members = value, [(inside, 1.0)]
        for outside in columns:
            if row.spare(outside) >= 0.0 or row.spare(inside) <= 0.0:
                continue
            weight = row.spare(inside) / excess_failure(outside, inside)
            cost = (1.0 - weight) * inside.cost + weight * outside.cost
            value = row.objective(cost, (1.0 - weight) * inside.goal + weight * outside.goal)
            if value < best:
                best, members = value, [(inside, 1.0 - weight), (outside, weight)]
    return members


_WIDEST = 1_000.0  # times as dear may one step be as another, or a unit rounds too much to nothing
_FEW_SUMS = 1_000  # that are told apart exactly rather than by a grid
_SECONDS = 1.5e-8  # that a search takes for each sum and outcome
_FAR_BEYOND = 1.5  # times the price: a cap that had to be so high is kept
_MARGIN = 1.05  # beyond a price from a coarser unit: what is paid there still counts for something
_TRIES = 6  # units, until levels are as few as is asked for
_OUTCOMES = 1_000  # of a model that takes some time
_MANY = 200.0  # totals of a lattice at least that a coarser unit is worth looking at for
_FEWER = 4.0  # times as few are its own
_MOSTLY = 0.95  # of the outcomes: a unit of their costs is that of most


@kept
def _unit_of_steps(model: SSP) -> tuple[float, float, Fraction, Fraction]:
    """Costs of a lattice's steps: the least, the mean, their unit, and that of most of them."""
    going_on = ~(dead_ends(model) | model.goal_mask)[model.successors]
    costs, counts = np.unique(model.costs[going_on], return_counts=True)
    paid = costs > 0.0
    costs, counts = costs[paid], counts[paid]
    order = np.argsort(-counts, kind="stable")
    share = np.cumsum(counts[order]) / max(counts.sum(), 1)
    most = costs[order[: 1 + int(np.searchsorted(share, _MOSTLY))]]
    units = [common_unit(some, model.exact_costs) for some in (costs, most)]
    mean = float(costs @ counts) / max(int(counts.sum()), 1)
    return float(costs.min(initial=np.inf)), mean, units[0], units[1]


def coarser_unit(problem: Problem, asked: Requirements) -> tuple[Fraction, bool] | None:
    """A coarser unit to look first at totals that are told apart exactly, and are many.

    Args:
        problem: the problem.
        asked: what it asks.

    Returns:
        The unit, no larger than any step, and whether it divides most costs. None: it is of no use,
        or the problem is not case S with failure alone limited.
    """
    is_mean = asked.ratio and not (asked.law or asked.rows or asked.least_failure)
    is_exact = asked.totals in (TotalScale.UNITS, TotalScale.SUMS) and problem.cost_cap is None
    model = problem.model
    if not (is_mean and is_exact) or model.n_outcomes < _OUTCOMES or uniform_cost(model):
        return None
    begins = goal_approach(model)[1][start_distribution(model, problem.start) > 0.0]
    least, mean, unit, of_most = _unit_of_steps(model)
    likely = float(begins.max(initial=0)) * mean
    if likely < _MANY * unit:
        return None
    fine = short_decimal(min(_TYPICAL * likely / _FIRST, least / _ROOM_FOR_DIGITS))
    for coarse in (of_most, fine):
        if _FEWER * unit <= coarse <= least * (1.0 + SAME_TOTAL):
            return coarse, coarse is of_most
    return None


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
    is_mean = asked.ratio and not (asked.law or asked.rows or asked.least_failure)
    if asked.totals is TotalScale.UNITS:
        return seconds <= 0.0 and coarser_unit(problem, asked) is not None
    is_timed = np.isfinite(seconds) and asked.totals is TotalScale.SUMS
    if not (is_mean and (on_grid or is_timed)) or problem.cost_cap is not None:
        return False
    steps = step_costs(problem.model)[1]
    if len(steps) <= 1 or steps[-1] > _WIDEST * steps[1]:
        return False
    most = (_levels_asked(problem) or _FEW_SUMS) if on_grid else MOST_SUMS
    sums = sums_in(problem.model, _span_of_steps(problem), most)
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
    multiple = (whole[outcome] + is_above).astype(np.int64)
    cost, kinds = totals_of(multiple, unit), np.unique(multiple)
    meant = {c: int(k) * unit for c, k in zip(totals_of(kinds, unit).tolist(), kinds, strict=True)}
    return replace(
        model,
        outcome_offsets=read_only(offsets_of(copies)[model.outcome_offsets]),
        successors=read_only(model.successors[outcome]),
        probabilities=read_only(model.probabilities[outcome] * part),
        costs=read_only(np.where(ended[model.successors[outcome]], model.costs[outcome], cost)),
        exact_costs={**model.exact_costs, **meant},
    )


def _levels_asked(problem: Problem) -> int | None:
    """Number of totals for rounding to tell apart; None: as many as there is room for."""
    return problem.cost_levels


def _split_units(problem: Problem, *, finest: bool = False) -> Iterator[Fraction]:
    """Finer and finer units of split costs, without one that splits no step, if these are few.

    That which a lattice of many totals is looked at by comes first.

    Args:
        problem: of case S.
        finest: as far as there is room, whatever is asked for.
    """
    cheapest = float(step_costs(problem.model)[1][1])
    if coarse := coarser_unit(problem, problem.requirements):
        yield coarse[0]
    yield from rounding_units(problem, _span_of_steps(problem), cheapest=cheapest, finest=finest)


def _span_of_steps(problem: Problem) -> float:
    """Totals that matter to split costs; steps that only end an episode are not remembered."""
    return span_of_totals(problem, float(step_costs(problem.model)[1][-1]))


def split_optimum(
    problem: Problem,
    unit: Fraction,
    options: SolveOptions,
    guess: DualGuess | None,
    most: int | None = None,
    reach: float = np.inf,
) -> RefinedOutcome:
    """Optimum with split costs, of a larger unit where totals are more than asked for.

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
        cap = None if np.isinf(reach) or fixed else int(np.ceil(reach / float(unit))) + 1
        compiled = CompiledAccumulatedCost(model, start, problem.discount, fixed, cap)
        outcome = refined_optimum(compiled, budget, options, guess)
        layers = outcome.compiled.layers
        if most is None or layers <= most or is_late():
            break
        unit = short_decimal(1.02 * float(unit) * layers / most)
    return outcome


def _unit_of(outcome: RefinedOutcome) -> Fraction:
    """Rounding unit of the process that a search on split costs ended with."""
    return cast("CompiledAccumulatedCost", outcome.compiled).base.exact_unit


def _solved_on_lattice(
    problem: Restated, options: SolveOptions, near: Near | None = None
) -> Solution:
    """Solution of a problem of rounded costs, exact but for the rounding."""
    if not problem.requirements.is_risk:
        solved = cheapest_at_least_failure if problem.failure_budget is None else best_within_budget
        return solved(problem, options)
    question = question_of_compiled(problem.compile(), problem.failure_budget)
    return least_risk(problem, options, question, near)


def solve_on_rounded_costs(problem: Problem, options: SolveOptions) -> Solution:
    """Solve on rounded costs: the best policy by costs rounded up, the bound by costs rounded down.

    Args:
        problem: a criterion of the law of the total cost, failure alone limited.
        options: tolerance and limits.

    Raises:
        InfeasibleError: no policy keeps to the budget.
        Stop: the time ended before one that does was found.
    """
    best = refine(_rounded_attempts(problem, options), options.tolerance)
    maximised, charge = problem.semantics.maximises, problem.semantics.charge(problem.ratio)
    attained, note = best.objective, best.note
    bound = best.lower_bound if best.upper_bound is None else best.upper_bound
    if charge is not None and charge.settled is None and not is_late():
        with WithIncumbent():  # beyond its table, too
            attained = problem.semantics.worth_of(measured_costs(best.policy, problem))
    if two_sided_gap(attained, bound) > options.tolerance and not is_late():
        unit = cast("CostAwarePolicy", best.policy.policies[0]).unit
        more = "no room for more levels"
        if _levels_asked(problem) is not None:
            more = "more levels leave a smaller gap"
        note = f"costs are rounded to multiples of {unit:g}: {more}"
    return replace(
        best,
        problem=problem,
        objective=attained,
        lower_bound=attained if maximised else min(bound, attained),
        upper_bound=max(bound, attained) if maximised else None,
        note=note,
    )


def _rounded_attempts(problem: Problem, options: SolveOptions) -> Iterator[Solution]:
    """Best policy by costs rounded up, with the best bound of all, after each unit."""
    best, semantics, risk = None, problem.semantics, problem.semantics.risk
    sign = -1.0 if semantics.maximises else 1.0
    bound, span = _trivial_bound(problem), span_of_totals(problem)
    for unit in rounding_units(problem, span):
        rough = float(unit) / span if best is None else _SHARE * best.gap
        finer = replace(options, tolerance=max(options.tolerance, rough))
        near = None  # where a risk's search may begin, from the policy of coarser costs
        if best is not None and risk is not None:
            quantile = measured_costs(best.policy, problem).quantile(risk.level)
            price = best.failure_price
            near = quantile, 0.0 if price is None else price + best.objective
        # the best policy of costs rounded up, on the model itself
        solution = _solved_on_lattice(_with_rounded_costs(problem, unit, up=True), finer, near)
        members = tuple(_rounding_up(p, problem.model, unit) for p in solution.policy.policies)
        policy = MixedPolicy(members, solution.policy.weights)
        solution = replace(solution, policy=policy, value_function=None)
        if risk is not None and risk.is_a_total:
            law = measured_costs(policy, problem)
            if law.is_finer:
                attained = min(risk.of(law), solution.objective)
                solution = replace(solution, objective=attained)
        if best is None or sign * solution.objective < sign * best.objective:
            best = solution
        with WithIncumbent():
            proved = lattice_bound(problem, unit, finer, near)[0]
            bound = sign * max(sign * bound, sign * proved)
        best = replace(best, lower_bound=bound, upper_bound=bound if semantics.maximises else None)
        yield best


def _rounded_proofs(problem: Problem, attained: float, rough: SolveOptions) -> Iterator[Proved]:
    """Best bound by rounded costs after each unit."""
    sign, bound = -1.0 if problem.semantics.maximises else 1.0, _trivial_bound(problem)
    for unit in rounding_units(problem, span_of_totals(problem), finest=True):
        proved, allowed = lattice_bound(problem, unit, rough)
        bound = sign * max(sign * bound, sign * proved)
        yield Proved(attained, bound, allowed)


def lattice_bound(
    problem: Problem,
    unit: Fraction,
    options: SolveOptions,
    near: Near | None = None,
) -> tuple[float, float]:
    """Bound by costs rounded down to a lattice, and the failure that is allowed.

    Args:
        problem: the problem.
        unit: of which costs are multiples.
        options: tolerance and limits.
        near: where a search may begin; None: unknown.
    """
    rounded, budget = _with_rounded_costs(problem, unit, up=False), problem.failure_budget
    solution = _solved_on_lattice(rounded, options, near)
    bound = solution.lower_bound if solution.upper_bound is None else solution.upper_bound
    return bound, solution.budget_used if budget is None else max(budget, solution.budget_used)


def _rounding_up(policy: Policy, model: SSP, unit: Fraction) -> CostAwarePolicy:
    """Policy of the model with rounded costs on the model itself.

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
    """Problem with costs rounded to multiples of a unit."""
    model = problem.model
    kinds, kind = np.unique(model.costs, return_inverse=True)
    units = kinds / float(unit)
    whole = np.ceil(units * (1.0 - SAME_TOTAL)) if up else np.floor(units * (1.0 + SAME_TOTAL))
    charge = problem.semantics.charge(problem.ratio)
    if isinstance(charge, WithinBound):  # one step beyond the bound is as late as any
        whole = np.minimum(whole, np.ceil(float(charge.bound) / float(unit)) + 2.0)
    costs = totals_of(whole.astype(np.int64), unit)[kind]
    rounded = replace(model, costs=read_only(costs), exact_costs={})
    return Restated(
        rounded, problem.start, problem.ratio, problem.failure_budget, problem.semantics
    )


def _trivial_bound(problem: Problem) -> float:
    """Bound of the optimum that is known before any rounded problem is solved."""
    semantics, charge = problem.semantics, problem.semantics.charge(problem.ratio)
    if charge is None or not semantics.maximises:
        return 0.0
    return semantics.failing_worth - charge.lowest


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
    """Finer and finer rounding units, as far as is asked for.

    Args:
        problem: with ``cost_levels`` if these are limited.
        span: the totals that matter.
        cheapest: step that is to be a unit at least, if that makes no great many.
        finest: as far as there is room, whatever is asked for.
    """
    room = min(max(_MOST, _ROOM // problem.model.n_states), _FINEST)
    most = (None if finest else _levels_asked(problem)) or room
    least_unit = _ROOM_FOR_DIGITS * span / cheapest
    is_quick = least_unit * problem.model.n_outcomes <= _QUICK
    many = float(min(max(_FIRST, least_unit if is_quick else 0.0), most))
    while many <= most:
        yield short_decimal(span / many)
        many = min(_FINER * many, float(most)) if _WORTH_WHILE * many <= most else _FINER * many


def short_decimal(size: float) -> Fraction:
    """Rounding unit of two digits, the least that is no smaller: multiples are short decimals."""
    power = Fraction(10) ** (int(np.floor(np.log10(size))) - 1)
    return int(np.ceil(size / float(power) * (1.0 - SAME_TOTAL))) * power


def span_of_totals(problem: Problem, dearest: float | None = None) -> float:
    """Totals that matter to rounding: up to the bound, or some typical costs.

    Args:
        problem: the problem.
        dearest: the greatest cost of a single step to be remembered; None: of any step.
    """
    charge = problem.semantics.charge(problem.ratio)
    dearest = float(problem.model.costs.max(initial=0.0)) if dearest is None else dearest
    if isinstance(charge, WithinBound) and charge.bound > 0.0:
        return float(charge.bound)
    typical = _TYPICAL * compiled_constrained(problem).typical_cost
    settled = 0.0 if charge is None else charge.settled or 0.0
    return max(typical, dearest / _RARE, settled) or 1.0
