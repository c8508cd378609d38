"""Split and rounded costs: multiples of a unit, for models with too many distinct total costs.

**Split costs, case S.** The optimum of the model with split costs is a lower bound of the optimum
of the true model, the stated one. Its policies remember the cost paid, rounded to the nearest
multiple of the unit. They are evaluated exactly on the true model, and the best lottery of them is
an upper bound. Both bounds differ from the optimum by about the square of the unit if the value is
smooth in the cost paid, else by a share of the unit.

Each outcome of cost c that does not end the episode is split into two, whose costs are the
multiples of the unit next to c, with probabilities that preserve the mean. At a price of failure
the value as a function of the cost paid is a minimum of affine functions, hence concave. So no
policy of the true model is better than the best one of the model with split costs (mathematics,
section 8). All totals of the latter are multiples of the unit.

If the exact totals are multiples of a unit, but very many, the problem is first solved with costs
split on a coarser unit, usually one that divides most of the costs. If the few costs that are split
hardly matter, both bounds already agree. Otherwise a search on all exact totals follows, which
starts at the price of failure found.

**Rounded costs, criteria of the distribution of the total cost.** If every cost is rounded down to
a multiple of a unit, all totals are multiples, too. Since charges do not fall when the total grows,
the optimum is a lower bound for every policy of the true model. If every cost is rounded up, the
best policy remembers the rounded total. It is also a policy of the true model, where it has the
same goal probability and at most the rounded costs. The two optima enclose the true one for every
unit, and converge as the unit gets smaller (mathematics, section 8). Coarse units are solved in a
moment; finer ones follow as time allows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from typing import Any, cast

import numpy as np

from ssp_lp.accumulated_cost.charges import WithinBound
from ssp_lp.accumulated_cost.totals import MOST_SUMS, common_unit, step_costs, sums_in, totals_of
from ssp_lp.analysis.evaluation import Evaluation, measured_costs, success_figures
from ssp_lp.arrays import SAME_TOTAL, offsets_of, read_only
from ssp_lp.column_generation.column import (
    Column,
    FailureRow,
    relative_gap,
    two_sided_gap,
)
from ssp_lp.column_generation.compiled_layers import CompiledLayered
from ssp_lp.column_generation.search import DualGuess, Rows, lottery_within
from ssp_lp.compiled.deadline import WithIncumbent, closing, ensure_incumbent, is_late
from ssp_lp.errors import ModelError, SolverError
from ssp_lp.methods.columns import (
    best_within_budget,
    cheapest_at_least_failure,
    refined_optimum,
)
from ssp_lp.methods.incumbent import Incumbent, cheapest_way_bound
from ssp_lp.methods.refinement import Optimum, Proved, refine
from ssp_lp.methods.risk import Hint, feasible_compiled, least_risk
from ssp_lp.model import SSP
from ssp_lp.model.graph import dead_ends, goal_approach, stored_with_model
from ssp_lp.options import CERTIFYING, SolveOptions
from ssp_lp.policies import CostAwarePolicy, DeterministicPolicy, MixedPolicy
from ssp_lp.policies.policy import Policy
from ssp_lp.problem import Problem, RestatedProblem, TotalScale, compiled_constrained
from ssp_lp.processes.live_rows import uniform_cost
from ssp_lp.solution import CUT_SHORT, Answer, Run, Solution, assembled

_ROUGH = 1e-4  # tolerance of the first model of split costs
_ROUGH_FIRST = 1e-3  # tolerance of a model for its price alone, whose steps are far below a unit
_ENOUGH = 0.3  # least tolerance of split costs, relative to the solve's tolerance
_SHARE = 0.1  # tolerance of the next model, relative to the current gap
_SPREAD = 1e-2  # relative uncertainty of a price from a coarser unit
_HALFWAY = 1e-6  # distance from the middle of two levels, in levels, that rounding decides
_STRETCH = 1e-7  # relative stretching of levels, so that no cost is halfway
_MET = 0.75  # share of the tolerance that the next unit should leave as gap
_BELOW_FINEST = 0.6  # least unit that may be chosen to meet the tolerance, in finest units
_BESIDE = (1.003, 1.01, 1.03, 1.1, 1.5, 10.0, 1e3)  # factors of the price for further policies
_SHIFT = 1e-9  # change of a failure by rounding above which neighbouring policies are tried
_APART = (0.1, 0.5, 2.0)  # distances from the budget of such policies, in shifts
_REACH = 0.5  # first cap, as a share of the span of totals
_CELLS = 100_000_000  # most states times levels of a policy that is evaluated
_ROUNDING = 1e-12  # feasibility tolerance, relative to the smaller of budget and 1 - budget


def solve_on_split_costs(problem: Problem, options: SolveOptions) -> Solution:
    """Solve case S with costs split on finer and finer units.

    Args:
        problem: a problem of case S, with a limit on failure alone.
        options: tolerance and limits.

    Raises:
        InfeasibleError: no policy satisfies the budget.
        Stop: the time limit was reached before a policy satisfied the budget.
    """
    best = refine(_split_attempts(problem, options), options.tolerance)
    if best.note != CUT_SHORT and (best.gap <= options.tolerance or is_late()):
        return replace(best, note="")
    return best


def _split_attempts(problem: Problem, options: SolveOptions) -> Iterator[Solution]:
    """Yield, after each unit, the best lottery on the true model so far, and the best bound."""
    incumbent, best, outcome, bound = Incumbent(problem), None, None, 0.0
    ensure_incumbent(by_itself=incumbent.find() is not None)
    if (solution := incumbent.solution) is not None:
        best = Answer(solution.policy, solution.objective, 0.0, solution.budget_used)
        bound = solution.lower_bound
        yield replace(solution, note="")
    most, cheapest = problem.cost_levels, float(step_costs(problem.model)[1][1])
    units, guess = list(_split_units(problem)), None
    finest, reach = float(units[-1]), _MARGIN * _REACH * _span_of_steps(problem)
    while units:
        unit = units.pop(0)
        for_price = best is not None and unit != finest and float(unit) > 2.0 * cheapest
        value, gap = np.inf, np.inf
        if best is not None:
            value, gap = best.value, relative_gap(best.value, bound)
        rough = min(_SHARE * gap, max(_ROUGH, _ENOUGH * options.tolerance))
        finer = replace(options, tolerance=_ROUGH_FIRST if for_price else rough)
        calls = 0 if outcome is None else outcome.calls
        new = split_optimum(problem, unit, finer.after(calls), guess, most, reach)
        outcome = new if outcome is None else outcome.followed_by(new)
        bound = max(bound, outcome.bound)
        outcome = replace(outcome, bound=bound)
        own, price = float(_unit_of(outcome)), outcome.kappa
        total, guess = outcome.compiled.layers * own, outcome.guess(_SPREAD)
        reach = total if total > _FAR_BEYOND * price else _MARGIN * price
        if not for_price:  # a coarse unit only gives the price
            with WithIncumbent() as measuring, closing():
                lottery = _true_lottery(problem, outcome)
                best = lottery if lottery.value < value else best
            if measuring.stop and best is None:
                raise measuring.stop
        if best is None:
            continue
        more = "raise cost_levels for a smaller gap" if most else "more would be too many"
        note = f"totals are rounded to {outcome.compiled.layers:,} levels up to {total:.6g}: {more}"
        gap = relative_gap(best.value, bound)
        if units and most is None and gap > options.tolerance and not for_price:
            # the gap falls with the square of the unit
            enough = own * np.sqrt(_MET * options.tolerance / gap)
            if _BELOW_FINEST * finest <= enough < float(unit):
                sufficient = short_decimal(enough)
                units = [sufficient, *(u for u in units if u < sufficient)]
        yield _split_solution(problem, options, outcome, best, note)


def _split_run(options: SolveOptions, outcome: Optimum[Any]) -> Run:
    """Return the record of a search on split costs: method, reason, calls and work."""
    reason = (
        f"costs split between {outcome.compiled.layers:,} layers, {outcome.calls} pricing calls"
    )
    return Run(options.method, reason, outcome.calls, 0.0, outcome.work)


def _split_solution(
    problem: Problem, options: SolveOptions, outcome: Optimum[Any], lottery: Answer, note: str
) -> Solution:
    """Return a lottery on the true model as a solution, with the lower bound of split costs.

    Args:
        problem: the problem.
        options: method.
        outcome: optimum of the model with split costs.
        lottery: the lottery, evaluated on the true model.
        note: the solution's note, unless the search was cut short.
    """
    price = max(outcome.kappa - lottery.value, 0.0)
    note = note if outcome.generated.finished else CUT_SHORT
    answer = replace(lottery, bound=outcome.bound, price=price, note=note)
    return assembled(problem, answer, _split_run(options, outcome))


def solve_on_fine_lattice(problem: Problem, options: SolveOptions) -> Solution:
    """Solve case S with very many totals: first on a coarser unit, then from the price found there.

    Args:
        problem: a problem of case S, with a limit on failure alone.
        options: tolerance and limits.

    Raises:
        InfeasibleError: no policy satisfies the budget.
        Stop: the time limit was reached before a policy satisfied the budget.
    """
    coarse = coarser_unit(problem)
    if coarse is None or options.deterministic or options.program:
        return best_within_budget(problem, options)
    return refine(_lattice_attempts(problem, options, *coarse), options.tolerance)


def _lattice_attempts(
    problem: Problem, options: SolveOptions, unit: Fraction, is_of_most: bool
) -> Iterator[Solution]:
    """Yield the best lottery with costs split on a coarser unit, then the optimum on all totals.

    Args:
        problem: a problem of case S.
        options: tolerance and limits.
        unit: the coarser unit.
        is_of_most: whether the unit divides most costs. If it does not, the coarse search only
            gives a price, and its lottery is evaluated only if the time ends in the second search.
    """
    rough = options if is_of_most else replace(options, tolerance=_ROUGH_FIRST)
    outcome, optimum = split_optimum(problem, unit, rough, None), None
    first, later = _split_run(options, outcome), options.after(outcome.calls)
    with WithIncumbent() as search:
        if not is_of_most:
            optimum = best_within_budget(problem, later, outcome.guess(_SPREAD))
    with WithIncumbent(), closing():
        if optimum is None:
            yield _split_solution(problem, options, outcome, _true_lottery(problem, outcome), "")
    if search.stop:
        raise search.stop
    optimum = optimum or best_within_budget(problem, later, outcome.guess(_SPREAD))
    run = optimum.run
    reason, calls = f"{first.reason}, then {run.reason}", outcome.calls + run.pricing_calls
    run = replace(run, reason=reason, pricing_calls=calls, work=outcome.work + run.work)
    yield replace(optimum, run=run)


def prove_by_units(solution: Solution, evaluation: Evaluation, _: float) -> Proved:
    """Prove a bound by split or rounded costs, from the model alone.

    Units get smaller until the gap is within the tolerance, or hardly larger than the gap that the
    solution claims. This claim only decides when to stop. With split costs the proof also stops
    when a smaller unit hardly improves the bound.

    Args:
        solution: a solution of a problem with split or rounded costs.
        evaluation: evaluation of its policy.
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
    """Yield the best bound by costs split on finer and finer units, until it hardly rises.

    Args:
        problem: a problem of case S.
        attained: objective of the policy.
        enough: relative gap at which no further bound is needed.
        rough: tolerance of each solve.
    """
    guess, bound, allowed, before = None, 0.0, problem.failure_budget or 0.0, -np.inf
    for unit in _split_units(problem, finest=True):
        outcome = split_optimum(problem, unit, rough, guess)
        guess = outcome.guess(_SPREAD)
        bound, allowed = max(bound, outcome.bound), max(allowed, outcome.row.budget)
        yield Proved(attained, bound, allowed)
        if bound - before < _SHARE * ((1.0 - enough) * attained - bound):
            return
        before = bound


def _true_lottery(problem: Problem, outcome: Optimum[Any]) -> Answer:
    """Return the best lottery of policies found with one unit, evaluated on the true model."""
    row, least, columns, found = outcome.row, outcome.least, list[Column](), None
    pricing = outcome.compiled.pricing()
    pricing = pricing.counting_success() if row.by_goal else pricing
    rows = Rows.of_failure(row, pricing)
    if least is None or row.budget > least.column.failure:
        columns = _true_columns(problem, outcome)
        found = lottery_within(pricing, columns, rows, ratio=True)
    if found is None:  # the policy of least failure is feasible if any is
        least = least or outcome.compiled.least_failure()
        safest = _true_column(problem, outcome, least.policy)
        rows = Rows.of_failure(row.raised_to(safest), pricing)
        found = lottery_within(pricing, [*columns, safest], rows, ratio=True)
    if found is None:
        raise SolverError("the safest policy fails surely at unrounded costs: round the costs")
    return Answer(found.lottery(pricing), found.objective, 0.0, found.failure)


def _true_columns(problem: Problem, outcome: Optimum[Any]) -> list[Column]:
    """Evaluate on the true model the policies that were found with split costs.

    A policy that satisfies the budget with split costs may violate it on the true model, and vice
    versa. If all policies lie on one side of the budget, others are found at nearby prices.

    Raises:
        Stop: the time limit was reached before a policy within the budget was evaluated.
    """
    generated, pricing, row = outcome.generated, outcome.compiled.pricing(), outcome.row
    columns, last, one_sided = list[Column](), generated.columns[0], len(generated.columns) == 1
    with WithIncumbent() as search:
        columns.append(_true_column(problem, outcome, pricing.policy(last), last))
        shift = columns[0].failure - generated.columns[0].failure
        if abs(shift) > _SHIFT:
            columns += _columns_beside(problem, outcome, shift)
        for column in generated.columns[1:] if len(columns) == 1 else ():
            columns.append(_true_column(problem, outcome, pricing.policy(column), column))
        for factor in _BESIDE:
            within = [_satisfies_budget(column, row) for column in columns]
            if is_late() or (any(within) and (one_sided or not all(within))):
                break
            price = outcome.kappa / factor if any(within) else outcome.kappa * factor
            last = pricing.minimise(price, last)
            columns.append(_true_column(problem, outcome, pricing.policy(last), last))
    if search.stop and not any(_satisfies_budget(column, row) for column in columns):
        raise search.stop
    return columns


def _true_column(
    problem: Problem, outcome: Optimum[Any], policy: Policy, split: Column | None = None
) -> Column:
    """Evaluate on the true model a policy that was found with split costs.

    On the true model the policy remembers the cost paid, rounded to the nearest level. Levels are
    multiples of the unit or, if the cheapest step would round to 0, of a fraction of the unit. A
    policy without a step whose cost was split needs no evaluation: its runs are those with split
    costs.

    Args:
        problem: a problem of case S.
        outcome: optimum of the model with split costs.
        policy: the policy.
        split: the policy's column with split costs, if known.
    """
    is_same = split is not None and not _takes_split_costs(policy, outcome, problem.model)
    if isinstance(policy, CostAwarePolicy):
        unit, most = _unit_of(outcome), problem.cost_levels
        room = _CELLS // max(problem.model.n_states, 1) if most is None else most
        # enough parts that the cheapest step is at least one of them
        parts = int(np.ceil(float(unit) / float(step_costs(problem.model)[1][1])))
        parts = max(min(parts, room // policy.cap), 1)
        levels = totals_of(np.arange(policy.cap * parts + 1), unit / parts)
        halves = step_costs(problem.model)[1] / float(unit / parts) % 1.0 - 0.5
        if (np.abs(halves) < _HALFWAY).any():  # otherwise rounding would choose the level
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
    if split is not None and is_same:
        return replace(split, choice=None, swept=None, policy=policy)
    cost, failure, goal = success_figures(policy, problem)
    return Column(cost, failure, goal, None, policy=policy)


def _takes_split_costs(policy: Policy, outcome: Optimum[Any], model: SSP) -> bool:
    """Return whether a policy may take, in any layer, a pair one of whose costs was split.

    Args:
        policy: a policy on the model with split costs.
        outcome: optimum of that model.
        model: the true model.
    """
    offsets = outcome.compiled.facts.model.outcome_offsets, model.outcome_offsets
    split = np.not_equal(*map(np.diff, offsets))
    states = np.unique(model.pair_state[split])
    if not isinstance(policy, CostAwarePolicy):
        return True
    decision = policy.decision[:, states]
    pairs = np.where(decision < 0, decision, model.pair_offsets[states] + decision)
    pairs = np.append(pairs, policy.tails[:, states])
    return bool(split[pairs[pairs >= 0]].any())


def _columns_beside(problem: Problem, outcome: Optimum[Any], shift: float) -> list[Column]:
    """Return columns on both sides of the budget, evaluated on the true model.

    The sweep that found the first column also found policies of other failure probabilities.
    Rounding changes all these failure probabilities by about ``shift``. The policies returned are
    those whose failure plus ``shift`` lies just below or just above the budget.

    Args:
        problem: a problem of case S.
        outcome: optimum of the model with split costs.
        shift: failure of the first column on the true model, minus that with split costs.
    """
    pricing, row, first = outcome.compiled.pricing(), outcome.row, outcome.generated.columns[0]
    columns, policy = list[Column](), pricing.policy(first)
    tried = {policy.cap} if isinstance(policy, CostAwarePolicy) else set[int]()
    for above in (False, True):
        for apart in _APART:
            off = (apart if above else -apart) * abs(shift) - shift
            policy = pricing.policy_failing(first, row.budget + off, tried, above=above)
            if policy is None:
                continue
            columns.append(_true_column(problem, outcome, policy))
            if _satisfies_budget(columns[-1], row) != above:
                break
    return columns


def _satisfies_budget(column: Column, row: FailureRow) -> bool:
    """Return whether an evaluated policy satisfies the budget, up to rounding."""
    return row.slack(column) >= -_ROUNDING * min(row.budget, 1.0 - row.budget)


_WIDEST = 1_000.0  # largest ratio of two step costs for split costs
_FEW_SUMS = 1_000  # sums up to which layers are exact
_SECONDS = 1.5e-8  # of a search for each sum and outcome
_FAR_BEYOND = 1.5  # a cap of more than this multiple of the price is used again
_MARGIN = 1.05  # cap, as a multiple of the price from a coarser unit
_TRIES = 6  # most units tried to satisfy the number of levels
_OUTCOMES = 1_000  # least outcomes of a model for a coarser unit
_MANY = 200.0  # least totals of a lattice for a coarser unit
_FEWER = 4.0  # least ratio of the unit of most costs to the unit; its square for another unit
_MOSTLY = 0.95  # share of the outcomes whose costs define the unit of most costs


@stored_with_model
def _unit_of_steps(model: SSP) -> tuple[float, float, Fraction, Fraction]:
    """Return the least and the mean positive step cost, and two units.

    The first unit divides all costs of steps, the second divides the costs of most outcomes. Last
    steps of an episode do not count.
    """
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


def coarser_unit(problem: Problem) -> tuple[Fraction, bool] | None:
    """Return a coarser unit for a first solve of case S with very many exact totals.

    Args:
        problem: the problem.

    Returns:
        The unit, which is at most the least step cost, and whether it divides most costs. None if a
        coarser unit does not help, or the problem is not case S with failure as the only limit.
    """
    if not problem.is_mean_within_budget or problem.cost_cap is not None:
        return None
    model = problem.model
    if problem.totals is TotalScale.GRID or model.n_outcomes < _OUTCOMES or uniform_cost(model):
        return None
    begins = goal_approach(model)[1][problem.start_mass > 0.0]
    least, mean, unit, of_most = _unit_of_steps(model)
    likely = float(begins.max(initial=0)) * mean
    if likely < _MANY * unit:
        return None
    fine = short_decimal(min(_TYPICAL * likely / _FIRST, least / _ROOM_FOR_DIGITS))
    for coarse, least_ratio in ((of_most, _FEWER), (fine, _FEWER**2)):
        if least_ratio * unit <= coarse <= least * (1.0 + SAME_TOTAL):
            return coarse, coarse is of_most
    return None


def is_split(problem: Problem, seconds: float = np.inf) -> bool:
    """Return whether the costs of a problem must be split.

    They are split in case S, if failure is the only limit, under two conditions: no step is far
    more expensive than the others; and the sums of costs are too many for exact layers, or are
    known to take longer than the time left.

    Args:
        problem: the problem.
        seconds: time left.
    """
    on_grid = problem.totals is TotalScale.GRID
    if problem.totals is TotalScale.UNITS:
        return seconds <= 0.0 and coarser_unit(problem) is not None
    is_timed = np.isfinite(seconds) and problem.totals is TotalScale.SUMS
    if problem.cost_cap is not None or not (
        problem.is_mean_within_budget and (on_grid or is_timed)
    ):
        return False
    steps = step_costs(problem.model)[1]
    if len(steps) <= 1 or steps[-1] > _WIDEST * steps[1]:
        return False
    most = (problem.cost_levels or _FEW_SUMS) if on_grid else MOST_SUMS
    sums = sums_in(problem.model, _span_of_steps(problem), most)
    if on_grid:
        return sums is None
    many = most if sums is None else len(sums)
    return _SECONDS * many * problem.model.n_outcomes > seconds


def with_split_costs(model: SSP, unit: Fraction) -> SSP:
    """Return the model in which each step costs one of the two nearest multiples of a unit.

    The multiple is drawn at random so that the mean cost stays the same. The cost of an episode's
    last step does not change, since no policy has to remember it.

    Args:
        model: the model.
        unit: unit of the costs.
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


def _split_units(problem: Problem, *, finest: bool = False) -> Iterator[Fraction]:
    """Yield finer and finer units on which to split costs, beginning with :func:`coarser_unit`.

    Args:
        problem: a problem of case S.
        finest: whether to go down to the finest unit that fits, and ignore ``cost_levels``.
    """
    cheapest = float(step_costs(problem.model)[1][1])
    if coarse := coarser_unit(problem):
        yield coarse[0]
    yield from rounding_units(problem, _span_of_steps(problem), cheapest=cheapest, finest=finest)


def _span_of_steps(problem: Problem) -> float:
    """Return :func:`span_of_totals`, with only the costs of steps that do not end the episode."""
    return span_of_totals(problem, float(step_costs(problem.model)[1][-1]))


def split_optimum(
    problem: Problem,
    unit: Fraction,
    options: SolveOptions,
    guess: DualGuess | None,
    most: int | None = None,
    reach: float = np.inf,
) -> Optimum[Any]:
    """Return the optimum with costs split on a unit, or on a larger unit to save layers.

    If the larger units that are tried have more than ``most`` layers, too, the accumulated cost is
    capped.

    Args:
        problem: a problem of case S.
        unit: unit of the costs.
        options: tolerance and limits.
        guess: a guess of the price of failure, or None.
        most: greatest number of layers; None: no limit.
        reach: accumulated cost of the first cap; infinite: the default first cap.

    Raises:
        InfeasibleError: no policy satisfies the budget.
        ModelError: the table of layers is too large.
        Stop: the time limit was reached before a policy satisfied the budget.
    """
    budget = 1.0 if problem.failure_budget is None else problem.failure_budget
    for tried in range(_TRIES):
        model = with_split_costs(problem.model, unit)
        start, fixed = problem.start_mass, None
        if most is not None and tried + 1 == _TRIES:
            fixed = (most - 0.5) * float(unit)
        cap = None if np.isinf(reach) or fixed else int(np.ceil(reach / float(unit))) + 1
        discount, caps = problem.discount, {"fixed_cap": fixed, "cap": cap}
        compiled = CompiledLayered.given_success(model, start, discount, **caps)
        outcome = refined_optimum(compiled, budget, options, guess)
        layers = outcome.compiled.layers
        if most is None or layers <= most or is_late():
            break
        unit = short_decimal(1.02 * float(unit) * layers / most)
    return outcome


def _unit_of(outcome: Optimum[Any]) -> Fraction:
    return cast("CompiledLayered", outcome.compiled).layer.base.exact_unit


def _solved_on_lattice(
    problem: RestatedProblem, options: SolveOptions, hint: Hint | None = None
) -> Solution:
    """Solve a problem with rounded costs, all of whose totals are multiples of one unit."""
    if problem.semantics.risk is None:
        solved = cheapest_at_least_failure if problem.failure_budget is None else best_within_budget
        return solved(problem, options)
    question = feasible_compiled(problem.compile(), problem.failure_budget)
    return least_risk(problem, options, question, hint)


def solve_on_rounded_costs(problem: Problem, options: SolveOptions) -> Solution:
    """Solve on rounded costs: a policy by costs rounded up, a bound by costs rounded down.

    Args:
        problem: a criterion of the law of the total cost, with failure as the only limit.
        options: tolerance and limits.

    Raises:
        InfeasibleError: no policy satisfies the budget.
        Stop: the time limit was reached before a policy satisfied the budget.
    """
    best = refine(_rounded_attempts(problem, options), options.tolerance)
    maximised, charge = problem.semantics.maximises, problem.semantics.charge(problem.ratio)
    attained, note = best.objective, best.note
    bound = best.lower_bound if best.upper_bound is None else best.upper_bound
    if charge is not None and charge.affine_from_total is None and not is_late():
        with WithIncumbent():  # also beyond the cap
            attained = problem.semantics.value_of_law(measured_costs(best.policy, problem))
    if two_sided_gap(attained, bound) > options.tolerance and not is_late():
        unit = cast("CostAwarePolicy", best.policy.policies[0]).unit
        more = "a finer unit would need too many levels"
        if problem.cost_levels is not None:
            more = "raise cost_levels for a smaller gap"
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
    """Yield, for each unit, the best policy so far (costs rounded up), and the best bound."""
    best, semantics, risk = None, problem.semantics, problem.semantics.risk
    sign = -1.0 if semantics.maximises else 1.0
    bound, span = cheapest_way_bound(problem), span_of_totals(problem)
    for unit in rounding_units(problem, span):
        rough = float(unit) / span if best is None else _SHARE * best.gap
        finer = replace(options, tolerance=max(options.tolerance, rough))
        hint = None  # where a search for a risk may begin, from the policy of coarser costs
        if best is not None and risk is not None:
            quantile = measured_costs(best.policy, problem).quantile(risk.level)
            price = best.failure_price
            hint = quantile, 0.0 if price is None else price + best.objective
        # the optimal policy of costs rounded up, on the model itself
        solution = _solved_on_lattice(_with_rounded_costs(problem, unit, up=True), finer, hint)
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
            proved = lattice_bound(problem, unit, finer, hint)[0]
            bound = sign * max(sign * bound, sign * proved)
        best = replace(best, lower_bound=bound, upper_bound=bound if semantics.maximises else None)
        yield best


def _rounded_proofs(problem: Problem, attained: float, rough: SolveOptions) -> Iterator[Proved]:
    """Yield, for finer and finer units, the best bound so far (costs rounded down)."""
    sign, bound = -1.0 if problem.semantics.maximises else 1.0, cheapest_way_bound(problem)
    for unit in rounding_units(problem, span_of_totals(problem), finest=True):
        proved, allowed = lattice_bound(problem, unit, rough)
        bound = sign * max(sign * bound, sign * proved)
        yield Proved(attained, bound, allowed)


def lattice_bound(
    problem: Problem,
    unit: Fraction,
    options: SolveOptions,
    hint: Hint | None = None,
) -> tuple[float, float]:
    """Return the bound of the optimum by costs rounded down to multiples of a unit.

    Args:
        problem: the problem.
        unit: unit of the rounded costs.
        options: tolerance and limits.
        hint: a first threshold of a risk measure and a price of failure there, or None.

    Returns:
        The bound, and the largest failure of the policies for which it holds.
    """
    rounded, budget = _with_rounded_costs(problem, unit, up=False), problem.failure_budget
    solution = _solved_on_lattice(rounded, options, hint)
    bound = solution.lower_bound if solution.upper_bound is None else solution.upper_bound
    return bound, solution.budget_used if budget is None else max(budget, solution.budget_used)


def _rounding_up(policy: Policy, model: SSP, unit: Fraction) -> CostAwarePolicy:
    """Return a policy of the model with costs rounded up as a policy of the model itself.

    The result remembers the sum of the rounded costs. A policy without memory gets one layer, so
    that it is evaluated with rounded costs as well.

    Raises:
        ModelError: the policy has a memory other than the cost paid.
    """
    if isinstance(policy, CostAwarePolicy):
        return replace(policy, model=model, rounds_up=True)
    if not isinstance(policy, DeterministicPolicy):
        raise ModelError(f"a {type(policy).__name__} does not remember the total cost so far")
    pair, first = policy.decision, model.pair_offsets[:-1]
    position = np.where(pair < 0, pair, pair - first)[None, :]
    never = np.full(model.n_states, np.inf)
    return CostAwarePolicy(model, float(unit), position, pair[None, :], never, rounds_up=True)


def _with_rounded_costs(problem: Problem, unit: Fraction, *, up: bool) -> RestatedProblem:
    """Return the problem with each cost rounded to a multiple of a unit, up or down."""
    model = problem.model
    kinds, kind = np.unique(model.costs, return_inverse=True)
    units = kinds / float(unit)
    whole = np.ceil(units * (1.0 - SAME_TOTAL)) if up else np.floor(units * (1.0 + SAME_TOTAL))
    charge = problem.semantics.charge(problem.ratio)
    if isinstance(charge, WithinBound):  # all totals beyond the bound are equal
        whole = np.minimum(whole, np.ceil(float(charge.bound) / float(unit)) + 2.0)
    costs = totals_of(whole.astype(np.int64), unit)[kind]
    rounded = replace(model, costs=read_only(costs), exact_costs={})
    return RestatedProblem(
        rounded, problem.start, problem.ratio, problem.failure_budget, problem.semantics
    )


_FIRST = 128  # units in the span of totals at first
_FINER = 4.0  # factor of the number of units from one solve to the next
_QUICK = 3e8  # most units times outcomes of a quick sweep
_MOST = 8_192  # most units, unless the user sets more
_ROOM = 6_000_000  # most states times units
_FINEST = 65_536  # most units in any case
_ROOM_FOR_DIGITS = 1.1  # most by which rounding up to two digits raises a number
_WORTH_WHILE = 1.5  # least factor of the number of units for another solve
_TYPICAL = 2.0  # span of totals, in costs given success of the safest policy
_RARE = 20.0  # most by which a single step may exceed the span


def rounding_units(
    problem: Problem, span: float, *, cheapest: float = np.inf, finest: bool = False
) -> Iterator[Fraction]:
    """Yield finer and finer units to which costs are rounded.

    Args:
        problem: its ``cost_levels``, if any, limit how many units the span may contain.
        span: greatest total that rounding must resolve.
        cheapest: least step cost: the first unit does not exceed it if that is quick to solve.
        finest: whether to go down to the finest unit that fits, and ignore ``cost_levels``.
    """
    room = min(max(_MOST, _ROOM // problem.model.n_states), _FINEST)
    most = (None if finest else problem.cost_levels) or room
    least_unit = _ROOM_FOR_DIGITS * span / cheapest
    is_quick = least_unit * problem.model.n_outcomes <= _QUICK
    many = float(min(max(_FIRST, least_unit if is_quick else 0.0), most))
    while many <= most:
        yield short_decimal(span / many)
        many = min(_FINER * many, float(most)) if _WORTH_WHILE * many <= most else _FINER * many


def short_decimal(size: float) -> Fraction:
    """Return the least number of two significant digits that is at least a size."""
    power = Fraction(10) ** (int(np.floor(np.log10(size))) - 1)
    return int(np.ceil(size / float(power) * (1.0 - SAME_TOTAL))) * power


def span_of_totals(problem: Problem, dearest: float | None = None) -> float:
    """Return the greatest total that rounding must resolve.

    It is the bound of a criterion that has one, otherwise a multiple of a typical total cost.

    Args:
        problem: the problem.
        dearest: greatest cost of a step that policies remember; None: of any step.
    """
    charge = problem.semantics.charge(problem.ratio)
    dearest = float(problem.model.costs.max(initial=0.0)) if dearest is None else dearest
    if isinstance(charge, WithinBound) and charge.bound > 0.0:
        return float(charge.bound)
    typical = _TYPICAL * compiled_constrained(problem).facts.typical_cost
    settled = 0.0 if charge is None else charge.affine_from_total or 0.0
    return max(typical, dearest / _RARE, settled) or 1.0
