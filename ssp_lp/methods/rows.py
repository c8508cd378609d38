"""Problems with several limits, solved by column generation with a price for each row.

Column generation runs phase 1 and phase 2 (``column_generation.search``). If the full linear
program is solved first, its duals are the first prices. A cost given success is found by
Dinkelbach's iteration: at the optimum the least ``cost + ratio * failure`` equals the ratio.

If accumulated cost is truncated at a cap, the truncated process gives a lower bound, and the exact
value of the policy an upper bound. If the first cap is a guess, a rough search finds prices, and
from these follows a cap that causes no error. The lottery of one search is the start of the next
one, at a higher cap, until both bounds agree.

If totals are rounded to a grid, the rounded process gives a lower bound for every policy. Its
policies remember the rounded total. They are evaluated with the true costs, and the lottery is
chosen by these values, so that it satisfies the budget and all limits.

Phase 1 ends with a feasible lottery, or with an irreducible set of conflicting rows. The conflict
is proved by prices z >= 0 at which ``z @ activity`` of every policy exceeds ``z @ bounds``
(Farkas), never by the status of a program. Rows are deleted from the set while the remaining rows
are still in conflict.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ssp_lp.accumulated_cost.totals import Resolution
from ssp_lp.analysis.evaluation import Evaluation, evaluate
from ssp_lp.arrays import BELOW_RATIO, MACHINE_EPSILON, RELATIVE_GAP, FloatArray, read_only
from ssp_lp.column_generation.column import (
    Column,
    FailureRow,
    PricingProblem,
    Proof,
    least_of,
    relative_gap,
)
from ssp_lp.column_generation.compiled_problem import ATTAINABLE, CompiledExplicit
from ssp_lp.column_generation.explicit_pricing import LARGEST
from ssp_lp.column_generation.search import (
    Generated,
    Master,
    Pool,
    Rows,
    generate,
    lottery_within,
    without_negligible_prices,
)
from ssp_lp.compiled.deadline import Stop, WithIncumbent, closing, is_late, is_limited
from ssp_lp.errors import Argument, InfeasibleError, ModelError, SolverError
from ssp_lp.methods.full_program import ProgramOptimum, check_agreement, solve_program
from ssp_lp.methods.refinement import (
    TRIAL_TOLERANCE,
    Optimum,
    Proved,
    finer_optima,
    proved_objective,
    refine,
)
from ssp_lp.options import CERTIFYING, Game, SolveOptions
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.cost_aware import levels_of
from ssp_lp.policies.policy import Policy
from ssp_lp.problem import Problem, RestatedProblem, compiled_constrained
from ssp_lp.processes.conditions import FAILURE_ROW
from ssp_lp.processes.failure_semantics import (
    RARE_GOAL,
    Aim,
    FailureSemantics,
    goal_out_of_reach,
)
from ssp_lp.solution import CUT_SHORT, Run, Solution, assembled

_PATIENCE = 6  # refinements in which the gap must at least halve
_COARSE_TOTALS = 64  # totals of the first, coarse grid
_COARSE_GAP = 1e-4  # relative gap on the coarse grid
_COARSE = 0.5  # relative gap of a search that only decides feasibility
_FINER = 1e-3  # factor of the tolerance if a complement is minimised, which may be much larger


def solve_constrained(problem: Problem, options: SolveOptions) -> Solution:
    """Solve a problem with constraints in addition to its failure budget.

    Args:
        problem: the problem, without a measure of risk.
        options: method, tolerance and limits.

    Returns:
        The solution; its objective is infinite if there was only time for a bound.

    Raises:
        InfeasibleError: no policy satisfies the failure budget and the limits; it names an
        irreducible set of conflicting rows.
        SolverError: the time limit was reached before a feasible policy was found, or the
        solution of the linear program fails its check.
    """
    stated = compiled_constrained(problem).counting_rare_success(problem.failure_budget)
    try:
        optimum = rows_optimum(stated, options, true_figures(problem, stated))
        is_rare = is_success_rare(stated, 1.0 - optimum.failure)
        if is_rare or _success_may_be_rare(stated, optimum, options):
            stated = replace(stated, by_goal=True)
            truth = true_figures(problem, stated)
            again = rows_optimum(stated, options.after(optimum.calls), truth)
            again = optimum.followed_by(again)
            optimum = again if again.gap <= optimum.gap else optimum
    except Stop as stop:
        if not isinstance(stop.choice, Optimum):
            raise
        optimum = stop.choice
    compiled = optimum.compiled
    if compiled.budget is None and stated.budget is not None:
        equal = "the failure budget counts as equal to the least failure"
        optimum = replace(optimum, note="; ".join(filter(None, [equal, optimum.note])))
    many = int(np.isfinite(compiled.bounds).sum())
    reason = f"column generation with {many} rows, {optimum.calls} pricing calls"
    if optimum.program:
        reason = f"the full linear program, as asked, then {reason}"
    if compiled.charge is not None:
        reason = f"{reason}, {compiled.layers:,} layers of accumulated cost"
    run = Run(options.method, reason, optimum.calls, 0.0, optimum.work, optimum.program)
    return assembled(problem, optimum, run, compiled.sense)


def _success_may_be_rare(
    stated: CompiledExplicit, optimum: Optimum[CompiledExplicit], options: SolveOptions
) -> bool:
    """Return whether counting success directly gives a better optimum than counting 1 - failure.

    This happens if success is very rare. The search that counts success directly has slightly
    tighter limits, so that the tolerance of a limit alone cannot make its optimum better.
    """
    if not stated.may_be_rare or optimum.gap <= options.tolerance or is_late():
        return False
    tighter = tuple(
        replace(row, bound=row.bound - _TIGHTER * abs(row.bound)) for row in stated.side
    )
    try:
        rarer = rows_optimum(replace(stated, by_goal=True, side=tighter, priced=None), options)
    except (InfeasibleError, SolverError):
        return False
    return not rarer.granted and rarer.value < optimum.value * (1.0 - options.tolerance)


def is_success_rare(stated: CompiledExplicit, goal: float) -> bool:
    """Return whether success must be counted directly, because 1 - failure would lose its digits.

    Args:
        stated: the problem.
        goal: goal probability of the best policy found.
    """
    return stated.may_be_rare and 0.0 < goal < RARE_GOAL


def rows_optimum(
    stated: CompiledExplicit, options: SolveOptions, truth: Truth | None = None
) -> Optimum[CompiledExplicit]:
    """Return the best lottery within all rows, refined until the gap meets the tolerance.

    Args:
        stated: the problem.
        options: method, tolerance and limits.
        truth: evaluates policies on the model if the process has accumulated cost.

    Raises:
        InfeasibleError: no policy satisfies all rows; it names conflicting rows.
        SolverError: the time limit was reached before a feasible policy was found, or the
        solution of the linear program fails its check.
        Stop: the time limit was reached before a policy was evaluated; it carries an optimum
        with a bound alone.
    """
    guess: Optimum[CompiledExplicit] | None = None
    if stated.charge is not None and options.program is None:
        stated = stated.with_tails(exact=False)
    if stated.resolution is not None and stated.charge is not None:
        coarse = stated.at_resolution(Resolution(grid=_COARSE_TOTALS, most=_COARSE_TOTALS))
        guess = _rows_attempt(coarse, SolveOptions(_COARSE_GAP, options.deadline), None, None)
        lossless = stated.charge.lossless_total(guess.kappa)  # failing is optimal from there on
        stated = stated.at_resolution(stated.resolution.up_to(lossless))
    try:
        attempts = finer_optima(
            _rows_attempt(stated, options, truth, guess),
            lambda finer, later, before: _rows_attempt(finer, later, truth, before),
            options,
            _PATIENCE,
        )
        best = refine(attempts, options.tolerance)
    except Stop:
        if guess is None:
            raise
        best = replace(guess, value=np.inf)
    if best.gap <= options.tolerance:
        return best
    compiled, note = best.compiled, best.note or (CUT_SHORT if is_late() else "")
    levels = f"{compiled.layers:,} levels"
    if compiled.totals is not None:
        levels = f"{levels} up to {compiled.totals.values[-1]:.6g}"
    if not np.isfinite(best.value):
        if is_late():
            bound = best.bound if guess is None else max(best.bound, guess.bound)
            raise Stop(replace(best, bound=bound, note=note))
        raise SolverError(
            f"no policy on {levels} of accumulated cost satisfies the limits: set more ",
            Argument("cost_levels"),
            ", or allow more time",
        )
    if compiled.is_rounded and not note:
        note = f"totals are rounded to {levels}: raise cost_levels for a smaller gap"
    return replace(best, note=note)


def _rows_attempt(
    stated: CompiledExplicit,
    options: SolveOptions,
    truth: Truth | None,
    before: Optimum[CompiledExplicit] | None,
) -> Optimum[CompiledExplicit]:
    """Return the optimum of one search subject to all rows, with a bound proved at its last prices.

    A search whose cap is only a guess (``is_guess``) ends at a coarse gap. Its bound is proved only
    under a time limit, which may end the call before a search with a better cap.

    Args:
        stated: the problem.
        options: method, tolerance and limits.
        truth: evaluates policies on the model if the process has accumulated cost, else None.
        before: optimum on a coarser process, whose lottery or prices start the search, or None.
    """
    finer, rough = _FINER if stated.sense.constant else 1.0, TRIAL_TOLERANCE * stated.is_guess
    options = replace(options, tolerance=max(finer * options.tolerance, rough))
    program: ProgramOptimum | None = None
    taken_on = None if before is None else _continued_search(before.search, stated.pricing())
    compiled, rule = opened(stated, options) if taken_on is None else (stated, taken_on)
    if before is not None and taken_on is None and np.isfinite(before.value):
        rule = search_from_prices(compiled, rule, before.value, before.prices)
    if options.program is not None:
        program, rule = search_from_duals(compiled, rule, options)
    generated = best_lottery(compiled, rule, options)
    pool, rows, ratio = rule.pool, rule.rows, generated.ratio
    cost, failure, value = float(generated.rewards[0]), generated.failure, generated.objective
    size = abs(cost) + ratio * abs(float(generated.rewards[1]))
    if program is not None and generated.finished:
        check_agreement(program, value)
    prices = without_negligible_prices(generated.prices, pool.sizes(rows), size)
    bound, values, is_proved = 0.0, None, not stated.is_guess or is_limited()
    if is_proved:
        values = compiled.pricing().infinite
        with WithIncumbent(), closing():  # without time left the values stay infinite
            bound, proof = rows_bound(compiled, rows, prices, pool.proved)
            values = read_only(proof.values)
    policy, taken = generated.lottery(compiled.pricing()), generated.rewards[rows.index].tolist()
    taken = dict(zip(names_of(compiled, rows), taken, strict=True))
    if truth is not None and compiled.is_rounded:
        value = np.inf
        with WithIncumbent(), closing():  # without time left there is a bound alone
            taken = {}  # those of the process are rounded
            repaired = true_lottery(compiled, rows, pool, rows.weights(prices), truth[1])
            if repaired is not None:
                policy, failure = repaired.lottery(compiled.pricing()), repaired.failure
                value = truth[0](policy)
    elif truth is not None and is_proved:
        known = None if stated.exact_tails else _true_value(generated, compiled)
        value = truth[0](policy) if known is None else known
    named = dict.fromkeys(compiled.names, 0.0)  # rows without a limit have price 0
    named |= zip(names_of(compiled, rows), prices.tolist(), strict=True)
    if compiled.budget is None:  # with least failure there is no price of failure
        del named[FAILURE_ROW]
    granted, note = _raised_bounds(compiled, rows, generated.finished)
    paid = float(prices @ np.abs(rows.bounds))
    budget = 1.0 if compiled.budget is None else compiled.budget
    return Optimum(
        compiled=compiled,
        row=FailureRow(budget, compiled.ratio),
        generated=generated,
        search=rule,
        calls=pool.calls,
        work=pool.work,
        program="" if program is None else program.report,
        sense=compiled.sense,
        policy=policy,
        value=value,
        bound=compiled.sense.bound_or_value(value, least_of(bound, value), paid),
        failure=failure,
        price=named.get(FAILURE_ROW),
        prices=named,
        values=values,
        note=note,
        granted=granted,
        taken=taken,
    )


def _true_value(generated: Generated, compiled: CompiledExplicit) -> float | None:
    """Return the value of a lottery by the exact costs of its policies; None if one is unknown."""
    costs = [compiled.pricing().true_cost(column) for column in generated.columns]
    known = [cost for cost in costs if cost is not None]
    if len(known) < len(costs):
        return None
    cost = float(generated.weights @ known)
    return cost / generated.goal if compiled.ratio else cost


def _continued_search(search: Master, pricing: PricingProblem) -> Master | None:
    """Return a master that continues a search on a process with a higher cap.

    Only the costs of policies depend on the cap, not their failure or their activity in a row. So
    the lottery of the search still satisfies the rows. The result is None if there is no cap.

    Args:
        search: the master of the search with the lower cap.
        pricing: the pricing problem with the higher cap.
    """
    known = pricing.reevaluated(search.lottery[0])
    if known is None:
        return None
    pool, ratio = Pool(pricing, known), search.given_success
    return Master(pool, search.rows, search.prices, given_success=ratio, floor=search.floor)


def _raised_bounds(
    compiled: CompiledExplicit, rows: Rows, finished: bool
) -> tuple[dict[str, float], str]:
    """Return the bounds that phase 1 raised, and a note if it raised any or the search was stopped.

    A bound that lies below the attainable value by rounding alone is raised to that value.

    Args:
        compiled: the problem, with the stated bounds.
        rows: the limited rows, with the bounds that the search used.
        finished: whether the search ended before the time limit.

    Returns:
        The raised bounds by name, and the note.
    """
    stated = dict(zip(compiled.names, compiled.bounds.tolist(), strict=True))
    counted = zip(names_of(compiled, rows), rows.bounds.tolist(), strict=True)
    granted = {name: bound for name, bound in counted if bound > stated[name]}
    remarks = [
        f"the bound of {name!r} lies {bound - stated[name]:.1e} below "
        "the attainable value and counts as equal to it"
        for name, bound in granted.items()
    ]
    return granted, "; ".join([*remarks, *([] if finished else [CUT_SHORT])])


_TRACE = 1e-15  # a weight this small is a rounded 0
_MOST = 8  # most policies of the search that are evaluated
_STEEPER = (0.01, 0.1, 1.0, 100.0)  # relative increases of the prices, one for each new policy
_LUCK = 1e-12  # share of the greatest goal probability that a row's tolerance may allow
_TIGHTER = 1e-12  # share of a bound, far above its tolerance
_CLOSE = 1e-12  # relative gap of a bound that needs no further proof


Truth = tuple[Callable[[MixedPolicy], float], Callable[[Policy], FloatArray]]
"""Evaluation on the model, for a process that truncates or rounds totals: the minimised value of a
lottery, and the cost, failure and rows of one policy."""


def best_lottery(compiled: CompiledExplicit, master: Master, options: SolveOptions) -> Generated:
    """Return the best lottery within the limits: phase 2, from the master that phase 1 returned.

    Raises:
        InfeasibleError: case S, and no policy within the limits reaches the goal.
        SolverError: the time limit was reached before a policy that reaches the goal was found.
    """
    generated = generate(master, options)
    if not np.isfinite(generated.objective):
        if not generated.finished:
            raise SolverError("no policy that reaches the goal was found within the time limit")
        raise InfeasibleError(
            "no policy within all limits reaches the goal: no cost given success exists",
            failure_budget=compiled.budget,
            least_failure=max(1.0 - compiled.greatest_goal, 0.0),
        )
    return generated


def true_lottery(
    compiled: CompiledExplicit,
    rows: Rows,
    pool: Pool,
    weights: FloatArray,
    figures: Callable[[Policy], FloatArray],
) -> Generated | None:
    """Return the best lottery within the rows, with its policies evaluated on the model.

    Candidates are the best policies found on the rounded process, and policies that are optimal at
    higher prices.

    Args:
        compiled: the problem.
        rows: the limited rows.
        pool: policies of the rounded process.
        weights: weights of the rewards that rank these policies, [rewards].
        rewards: returns the cost, failure and rows of a policy on the model, [rewards].

    Returns:
        None if no lottery satisfies the rows and reaches the goal: the grid is too coarse.
    """
    pricing, order = compiled.pricing(), np.argsort(weights @ pool.rewards, kind="stable")
    best, points = pool.columns[int(order[0])], [pool.columns[k] for k in order[:_MOST].tolist()]
    if not compiled.ratio and rows.index.size == 0:
        points = [best]
    else:  # steeper prices give policies that offset a violation by rounding
        worth = weights[0] * float(best.rewards @ weights)
        least = np.where(rows.bounds > 0.0, worth / rows.scales, 0.0)
        for factor in _STEEPER:
            steeper = weights.copy()
            steeper[rows.index] += factor * np.maximum(weights[rows.index], least)
            points.append(pricing.minimise(steeper, best))
    by_goal = compiled.by_goal
    measured = [
        Column.of_rewards(figures(policy), None, by_goal=by_goal, policy=policy)
        for policy in map(pricing.policy, points)
    ]
    luck = _goal_floor(compiled)
    return lottery_within(pricing, measured, rows, ratio=compiled.ratio, floor=luck)


def _goal_floor(compiled: CompiledExplicit) -> float:
    """Return the goal probability that may be an artefact of a limit's tolerance.

    Lotteries of at most this goal probability do not count as reaching the goal.
    """
    is_told = compiled.by_goal or not compiled.ratio or compiled.limits_failure
    return 0.0 if is_told else _LUCK * compiled.greatest_goal


def true_figures(
    problem: Problem,
    stated: CompiledExplicit,
    value: Callable[[MixedPolicy], float] | None = None,
) -> Truth | None:
    """Return two functions that evaluate policies on the model, not on a truncated process.

    The first returns the minimised value of a lottery, the second the cost, failure and rows of one
    policy, [rewards]. The result is None without accumulated cost, since the process is then exact.

    Args:
        problem: the problem.
        stated: the problem, compiled.
        value: returns the minimised value of a lottery; None: the value of the problem's objective.
    """
    if stated.charge is None:
        return None
    plain = problem.unrolled
    asked = (plain.start, plain.ratio, plain.failure_budget, plain.semantics)
    unlimited = RestatedProblem(plain.model, *asked, discount=plain.discount)

    def own_value(policy: MixedPolicy) -> float:
        """Return the minimised value of a lottery, from its objective.

        ``stated`` converts in both directions, since ``constant - value`` is its own inverse.
        """
        return stated.sense.stated(evaluate(policy, unlimited).objective)

    def figures(policy: Policy) -> FloatArray:
        """Return cost, failure and rows of one policy, [rewards]."""
        evaluation, alone = evaluate(policy, problem), MixedPolicy((policy,), np.ones(1))
        goal, cost = evaluation.limited_goal, 0.0
        if not stated.ratio:
            cost = (value or own_value)(alone)
        elif goal > 0.0:
            cost = goal * (value(alone) if value else evaluation.objective)
        ending = -goal if stated.by_goal else evaluation.limited_failure
        return np.array([cost, ending, *row_activities(stated, evaluation)])

    return value or own_value, figures


def row_activities(stated: CompiledExplicit, evaluation: Evaluation) -> list[float]:
    """Return the activity of an evaluated policy in each row other than failure."""
    spent = evaluation.secondary_costs
    return [row.activity(spent[row.condition.name]) for row in stated.side]


def opened(stated: CompiledExplicit, options: SolveOptions) -> tuple[CompiledExplicit, Master]:
    """Run phase 1; return the problem to solve, and the master from which phase 2 starts.

    If the budget equals the least failure, the problem to solve is that of least failure. The least
    failure is not computed if a policy of phase 1 fails less often than the budget allows.
    """
    if not (stated.limits_failure and stated.is_whole):
        compiled = stated.at_least_failure()
        return compiled, phase_one(compiled, stated, options)
    try:
        search = phase_one(stated, stated, options)
    except (InfeasibleError, SolverError):
        compiled = stated.at_least_failure()
        if compiled is stated:
            raise
    else:
        compiled = stated.at_least_failure(*search.pool.columns)
        if compiled is stated:
            return stated, search
    return compiled, phase_one(compiled, stated, options)


def phase_one(
    compiled: CompiledExplicit, stated: CompiledExplicit, options: SolveOptions
) -> Master:
    """Run phase 1: add columns until a lottery satisfies all rows.

    Args:
        compiled: the problem to solve: ``stated`` or, if the budget equals the least failure, the
            problem of least failure.
        stated: the problem with the stated budget.
        options: tolerance and limits.

    Returns:
        The master of phase 2. A bound that lies below the attainable value by rounding alone is
        raised to that value. In case S the ratio is the cost given success of a known lottery.

    Raises:
        InfeasibleError: the rows are in conflict.
        SolverError: no feasible lottery was found, and no conflict was proved.
        Stop: the time limit was reached first.
    """
    pricing = compiled.pricing()
    pool = Pool(pricing, [pricing.first()])
    cheapest = pool.minimise(np.eye(1, pricing.n_rewards)[0])
    pool.add(cheapest)
    limited = np.flatnonzero(np.isfinite(compiled.bounds))
    rows = pool.rows(1 + limited, compiled.bounds[limited])
    elastic = Master(pool, rows, np.zeros(limited.size), elastic=True)
    generated = generate(elastic, options)
    if not _satisfies_rows(generated, rows):
        generated = _without_tiny_weights(generated, rows)
    if _satisfies_rows(generated, rows):
        raised = rows.bounds + np.maximum(generated.excess, 0.0) * rows.scales
        ratio = pool.first_ratio(generated) if compiled.ratio else 0.0
        return Master(
            pool,
            replace(rows, bounds=raised, ratio=ratio),
            np.zeros(limited.size),
            cheapest.cost,
            given_success=compiled.ratio,
            floor=_goal_floor(compiled),
        )
    if compiled.budget is None and stated.budget is not None:
        anyhow = replace(stated, budget=1.0)
        phase_one(anyhow, anyhow, options)  # raises if the limits conflict at any failure
    with closing():
        first = _proved_conflict(pool, rows, generated)
    if first is None and not generated.finished:
        raise Stop
    if first is None:
        raise SolverError(
            "rounding ended the search before it found a policy within all limits or proved that "
            "the limits conflict: relax a limit slightly"
        )
    raise _infeasible(compiled, stated, _irreducible_conflict(pool, rows, first, options), rows)


class _Conflict(NamedTuple):
    """Rows that no lottery satisfies together, with the proof (Farkas)."""

    rows: tuple[int, ...]  # positions
    shares: FloatArray  # [rows] > 0, sum 1: weights of the rows
    least: float  # certified lower bound of the weighted activity of every policy
    allowed: float  # weighted sum of the bounds


def _infeasible(
    compiled: CompiledExplicit, stated: CompiledExplicit, conflict: _Conflict, rows: Rows
) -> InfeasibleError:
    """Return the InfeasibleError that names the conflicting rows and the least failure."""
    at_least, budget = compiled.budget is None, stated.budget
    places = (rows.index[list(conflict.rows)] - 1).tolist()
    named, names = [compiled.names[k] for k in places], [compiled.texts[k] for k in places]
    every = "every policy of least failure" if at_least else "every policy"
    both = conflict.least, conflict.allowed
    side = compiled.side[places[0] - 1] if len(places) == 1 and places[0] > 0 else None
    if side is not None and side.sign < 0.0:  # a lower limit: report the quantity itself
        both = side.offset - both[0], side.offset - both[1]
    digits = next((d for d in (6, 9, 12) if f"{both[0]:.{d}g}" != f"{both[1]:.{d}g}"), 17)
    least, allowed = (f"{number:.{digits}g}" for number in both)
    if side is not None and side.sign < 0.0:
        words = f"{side.condition.name!r} is at most {least} under {every}, {allowed} required"
    elif len(names) == 1:
        words = f"{names[0]!r} is at least {least} under {every}, {allowed} allowed"
    else:
        bounds = rows.bounds[list(conflict.rows)]
        limits = [
            f"{name!r} <= {bound:.12g}" if bound >= 0.0 else f"{name[2:]!r} >= {-bound:.12g}"
            for name, bound in zip(names, bounds, strict=True)
        ]
        together = f"{', '.join(limits[:-1])} and {limits[-1]}"
        terms = zip(conflict.shares, names, strict=True)
        total = " + ".join(f"{share:.{digits}g} {name}" for share, name in terms)
        words = (
            f"no policy satisfies {together} together: {total} is at least {least} under {every}, "
            f"{allowed} allowed"
        )
    if at_least and budget is not None:
        words = f"no policy satisfies {FAILURE_ROW!r} <= {budget:.12g} and the limits: {words}"
        named = [FAILURE_ROW, *named]

    if far := goal_out_of_reach(compiled.facts.model, compiled.facts.start):
        words = f"{far}: {words}"
    least_failure, discount = compiled.failure_at_least, compiled.facts.discount
    return InfeasibleError(
        words,
        failure_budget=budget,
        least_failure=least_failure(None),
        least_discounted_failure=None if discount is None else least_failure(discount),
        conflicting_rows=tuple(named),
    )


def _proved_conflict(pool: Pool, rows: Rows, generated: Generated) -> _Conflict | None:
    """Return the conflict of rows that the prices of phase 1 prove (Farkas), or None.

    Args:
        pool: the policies of phase 1.
        rows: the rows of phase 1.
        generated: the result of phase 1.
    """
    sizes = pool.sizes(rows)
    matters = generated.prices * sizes > ATTAINABLE * min(generated.objective, 1.0)
    prices = np.where(matters, generated.prices, 0.0)
    total = float(prices.sum())
    if total <= 0.0:
        return None
    shares = prices / total
    least = pool.proved(rows.weights(shares, 0.0)).bound
    allowed = float(shares @ rows.bounds)
    size = float(shares @ np.abs(rows.bounds))
    room = (ATTAINABLE + 4.0 * len(shares) * MACHINE_EPSILON) * size
    if least <= allowed + room:
        return None
    members = tuple(np.flatnonzero(shares).tolist())
    return _Conflict(members, shares[list(members)], least, allowed)


def _irreducible_conflict(
    pool: Pool, rows: Rows, first: _Conflict, options: SolveOptions
) -> _Conflict:
    """Return an irreducible conflict of rows, by the deletion filter (Chinneck 1991).

    Args:
        pool: known policies; new ones are added.
        rows: all rows.
        first: a conflict among them.
        options: tolerance and limits.
    """
    conflict = first
    for row in first.rows:
        rest = tuple(k for k in conflict.rows if k != row)
        if not rest or len(rest) == len(conflict.rows):
            continue
        kept = list(rest)
        bounds, scales = rows.bounds[kept], rows.scales[kept]
        part = replace(rows, index=rows.index[kept], bounds=bounds, scales=scales)
        elastic = Master(pool, part, np.zeros(len(rest)), elastic=True)
        ended = generate(elastic, options)
        smaller = None if _satisfies_rows(ended, part) else _proved_conflict(pool, part, ended)
        if smaller is not None:
            conflict = smaller._replace(rows=tuple(rest[k] for k in smaller.rows))
    return conflict


def _satisfies_rows(generated: Generated, rows: Rows) -> bool:
    """Return whether phase 1 ended with every row satisfied within its tolerance."""
    return bool((generated.excess * rows.scales <= ATTAINABLE * np.abs(rows.bounds)).all())


def _without_tiny_weights(generated: Generated, rows: Rows) -> Generated:
    """Return the result of phase 1 without members of negligible weight.

    Phase 1 may give a member a negligible weight to satisfy one row to its last digit, although the
    member violates another row.
    """
    weights = np.where(generated.weights > _TRACE, generated.weights, 0.0)
    weights /= weights.sum()
    taken = weights @ np.stack([column.rewards[rows.index] for column in generated.columns])
    excess = np.maximum(taken - rows.bounds, 0.0) / rows.scales
    return replace(generated, weights=weights, excess=excess)


def names_of(compiled: CompiledExplicit, rows: Rows) -> list[str]:
    """Return the names of the limited rows."""
    return [compiled.names[index - 1] for index in rows.index.tolist()]


def search_from_prices(
    compiled: CompiledExplicit, rule: Master, ratio: float, prices: Mapping[str, float]
) -> Master:
    """Return a master with other first prices of the rows and, in case S, another first ratio.

    Args:
        compiled: the problem.
        rule: the master.
        ratio: the first ratio of case S; 0: that of ``rule``.
        prices: first prices, by name of the row; 0 if a name is missing.
    """
    rows = replace(rule.rows, ratio=ratio or rule.rows.ratio) if compiled.ratio else rule.rows
    begun = np.array([prices.get(name, 0.0) for name in names_of(compiled, rows)])
    return replace(rule, rows=rows, prices=begun, bound=0.0)


def search_from_duals(
    compiled: CompiledExplicit, rule: Master, options: SolveOptions
) -> tuple[ProgramOptimum, Master]:
    """Solve the full linear program; return its optimum, and a master with its duals as prices."""
    if compiled.ratio:  # feasibility is decided here, not by the LP solver
        best_lottery(compiled, rule, replace(options, tolerance=_COARSE))
    pricing, rows = compiled.explicit_pricing, rule.rows
    limited = zip(names_of(compiled, rows), rows.index, rows.bounds.tolist(), strict=True)
    limits = {name: (pricing.rewards[:, index], bound) for name, index, bound in limited}
    process = replace(pricing.process, cost=np.ascontiguousarray(pricing.rewards[:, 0]))
    program = solve_program(process, limits, options, ratio=compiled.ratio)
    rule = search_from_prices(compiled, rule, program.objective, program.prices)
    weights = rule.rows.weights(rule.prices)
    column = rule.pool.minimise(weights)
    rule.pool.add(column)
    bound = float(column.rewards @ weights) - float(rule.prices @ rows.bounds)
    return program, replace(rule, bound=bound)


def lagrange_bound(least: float, prices: FloatArray, bounds: FloatArray) -> float:
    """Return the Lagrangian lower bound ``least - prices @ bounds``, rounded down.

    Args:
        least: certified lower bound of ``cost + prices @ activity`` of every policy.
        prices: >= 0, [rows].
        bounds: [rows].
    """
    paid = float(prices @ bounds)
    return least - paid - (len(prices) + 1.0) * MACHINE_EPSILON * float(prices @ np.abs(bounds))


def limited_rows(compiled: CompiledExplicit) -> Rows:
    """Return the rows of a problem that have a bound, each with scale 1."""
    limited = np.flatnonzero(np.isfinite(compiled.bounds))
    ones, n_rewards = np.ones(limited.size), 1 + len(compiled.names)
    return Rows(1 + limited, compiled.bounds[limited], ones, n_rewards, compiled.by_goal)


def rows_bound(
    compiled: CompiledExplicit,
    rows: Rows,
    prices: FloatArray,
    prove: Callable[[FloatArray], Proof],
    least_goal: float | None = None,
) -> tuple[float, Proof]:
    """Return the best lower bound of the objective that the rows' prices prove, with its proof.

    In case S, if ``cost - ratio * goal >= D`` for every lottery within the rows, the cost given
    success is at least ``ratio + D / goal``. Two ratios are tried: ``rows.ratio``, and a slightly
    smaller one.

    Args:
        compiled: the problem.
        rows: the limited rows; in case S with the ratio to prove.
        prices: >= 0, [rows].
        prove: returns a checked lower bound of every policy's weighted rewards, given the weights.
        least_goal: a lower bound of the goal probability of all lotteries within the rows; None:
            computed only if the bound is poor without it.
    """
    if not compiled.ratio:
        proof = prove(rows.weights(prices))
        proved = _lagrangian_excess(compiled, rows, prices, proof) + compiled.sense.shift
        lowest = -1.0 if compiled.sense.constant == 0.0 and compiled.by_goal else 0.0
        return max(proved, lowest), proof  # else it is a sum of terms of at least 0
    proofs: list[tuple[float, float, Proof]] = []

    def best(goal: float) -> tuple[float, Proof]:
        """Return the best bound, if every lottery has at least this goal probability."""
        goal = max(goal, compiled.least_goal, 1.0 / LARGEST)
        proved = [(max(r + min(beyond, 0.0) / goal, 0.0), proof) for r, beyond, proof in proofs]
        return max(proved, key=lambda pair: pair[0])

    for ratio in (rows.ratio, rows.ratio * BELOW_RATIO):
        at = replace(rows, ratio=ratio)
        proof = prove(at.weights(prices))
        proofs.append((ratio, _lagrangian_excess(compiled, at, prices, proof), proof))
        if relative_gap(rows.ratio, (bound := best(least_goal or 0.0))[0]) <= _CLOSE:
            return bound
    if least_goal is None and relative_gap(rows.ratio, bound[0]) > RELATIVE_GAP:
        return best(least_goal_within(compiled, rows))
    return bound


def _lagrangian_excess(
    compiled: CompiledExplicit, rows: Rows, prices: FloatArray, proof: Proof
) -> float:
    """Return a lower bound of ``cost + prices @ (activity - bounds)`` minus a constant.

    The constant is the amount that every episode pays: in case S the ratio, otherwise the shift of
    the objective. If rounding would dominate the difference, it is summed without cancellation.

    Args:
        compiled: the problem.
        rows: the limited rows.
        prices: >= 0, [rows].
        proof: proof of the weighted rewards at these prices.
    """
    paid, less = rows.ratio if compiled.ratio else compiled.sense.shift, -np.inf
    if compiled.by_goal and compiled.ratio:
        paid = 0.0  # the reward is the goal, not failure
    beyond = lagrange_bound(proof.bound, prices, rows.bounds) - paid
    if paid > 0.0 and beyond < 0.0:
        weights = replace(rows, ratio=0.0).weights(prices)
        less = compiled.pricing().bound_less_constant(weights, rows.ratio, paid, proof.values)
    return max(beyond, lagrange_bound(less, prices, rows.bounds))


def least_goal_within(compiled: CompiledExplicit, rows: Rows) -> float:
    """Return a certified lower bound of the goal probability of lotteries within the rows.

    A separate search minimises the goal probability within all rows, which together may imply a
    greater goal probability than each row alone. The search needs no accumulated cost.

    Args:
        compiled: the problem, settled.
        rows: all limited rows.
    """
    if compiled.budget is None or not compiled.is_whole:
        return compiled.least_goal
    semantics = FailureSemantics(aim=Aim.LEAST_GOAL)
    reach = replace(
        compiled, semantics=semantics, charge=None, ratio=False, resolution=None, priced=None
    )
    try:
        opened = phase_one(reach, reach, CERTIFYING)
    except InfeasibleError:
        return 0.0  # no lottery is within the rows: there is nothing to prove
    generated = generate(opened, CERTIFYING)
    return rows_bound(reach, replace(rows, ratio=0.0), generated.prices, opened.pool.proved)[0]


def bound_at(
    compiled: CompiledExplicit, prices: Mapping[str, float], ratio: float, least_goal: float
) -> float:
    """Return a lower bound of the objective of all lotteries within the rows, proved at prices.

    Args:
        compiled: the problem, settled.
        prices: multipliers of the rows, >= 0, by name; 0 if a name is missing.
        ratio: case S: the value to prove.
        least_goal: a lower bound of the goal probability of these lotteries.
    """
    pool = Pool(compiled.pricing(), [compiled.pricing().first()])
    rows = replace(limited_rows(compiled), ratio=ratio)
    multipliers = np.array([prices.get(name, 0.0) for name in names_of(compiled, rows)])
    pool.add(pool.minimise(rows.weights(multipliers)))
    return rows_bound(compiled, rows, multipliers, pool.proved, least_goal)[0]


def prove_limits(solution: Solution, evaluation: Evaluation, _: float) -> Proved:
    """Prove a lower bound of the objective from a solution's value function and its row prices.

    Raises:
        ModelError: the solution has no value function, or one that does not fit the problem.
    """
    stated, values = compiled_constrained(solution.problem), solution.value_function
    stated = stated.counting_rare_success(solution.problem.failure_budget)
    if is_success_rare(stated, evaluation.limited_goal):
        stated = replace(stated, by_goal=True)
    compiled = stated.at_least_failure()
    if values is None:
        raise ModelError("the solution has no value function to certify: solve the problem again")
    if not np.isfinite(evaluation.objective):
        return Proved(
            evaluation.objective, 0.0, 1.0, f"the policy's objective is {evaluation.objective}"
        )
    values = np.asarray(values)
    levels = levels_of(solution.policy.policies)
    if levels is not None:
        compiled = compiled.at_resolution(Resolution(fixed=tuple(levels.tolist())))
    compiled = compiled.matching(values)
    least = compiled.least.column.failure if compiled.budget is None else 0.0
    budget, claims = max(stated.budget or 0.0, least), (evaluation.objective, solution.lower_bound)
    own_values = None if solution.method == Game.name else values  # the game's layers differ
    pricing = compiled.pricing()

    def prove(weights: FloatArray) -> Proof:
        """Return the proof at weights of the rewards, from the solution's value function.

        A value function of the game has other layers: then the pricing problem is solved instead.
        """
        if own_values is None:
            return pricing.prove(weights, pricing.minimise(weights))
        return pricing.check(weights, own_values)

    ratios = [claim for claim in claims if claim > 0.0] if compiled.ratio else [0.0]
    return proved_at_prices(compiled, evaluation, budget, solution.prices, prove, ratios)


def proved_at_prices(
    compiled: CompiledExplicit,
    evaluation: Evaluation,
    budget: float,
    named: Mapping[str, float],
    prove: Callable[[FloatArray], Proof],
    ratios: Sequence[float] = (0.0,),
) -> Proved:
    """Return a lottery's objective and the bound that prices of the rows prove.

    Args:
        compiled: the problem.
        evaluation: evaluation of the lottery.
        budget: the failure budget.
        named: prices of the rows, by name; 0 if a name is missing.
        prove: returns a checked lower bound of every policy's weighted rewards, given the weights.
        ratios: the ratios to try in case S.
    """
    prices = np.array([named.get(name, 0.0) for name in compiled.names])
    if not ((prices >= 0.0) & (prices <= LARGEST)).all():
        return Proved(evaluation.objective, 0.0, budget, "a price is not a number >= 0")
    rows, spent = limited_rows(compiled), [evaluation.limited_failure]
    if compiled.by_goal:
        spent = [-evaluation.limited_goal]
    spent += row_activities(compiled, evaluation)
    places, bounds = rows.index - 1, rows.bounds
    prices, most = prices[places], bounds + ATTAINABLE * np.abs(bounds)
    rows = replace(rows, bounds=np.clip(np.array(spent)[places], bounds, most))
    bounded = [rows_bound(compiled, replace(rows, ratio=r), prices, prove)[0] for r in ratios]
    lower = max(bounded, default=0.0)
    if 0 in places and not compiled.by_goal:
        budget = float(rows.bounds[0])
    paid = float(prices @ np.abs(bounds))
    return proved_objective(compiled.sense, evaluation.objective, lower, budget, paid=paid)
