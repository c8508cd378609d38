"""Least quantile and least conditional value at risk of the total cost given success.

Both are searches over thresholds. At each threshold a trial minimises E[charge(C) | goal], where C
is the total cost and the charge depends on the threshold.

**The quantile** is found by Newton's method over a bound B. With a charge of 1 if C > B, a trial
finds the least Pr(C > B | goal), which falls as B grows. The answer is the least B at which it is
at most 1 - level, with the policy of that trial. Prices of failure and of the other rows give a
lower bound of Pr(C > B | goal) for every B (by one sweep, if only failure is limited). They refute
each B whose lower bound is above 1 - level. The optimal prices at the largest infeasible B refute
it, and the next B is the answer. The search alternates between the optimal prices at a B and the
first B that they do not refute.

**The conditional value at risk** of a policy is the least over z of z + E[(C - z)^+ | goal] / share
with share = 1 - level (Rockafellar and Uryasev 2000). The least is attained where z is the policy's
quantile, which is a total that can occur. Let F(z) be the least E[charge | goal] over all policies,
for the charge z + (C - z)^+ / share. The optimum is the least F(z) over all such totals z. The
search alternates between the best policy at z and that policy's own quantile.

F is a minimum of convex functions and need not be convex itself, so that values on both sides of a
z prove nothing at z. Bounds are proved for whole intervals: for a <= z <= b and every c

    z + (c - z)^+ / share  >=  max(a, min(b, c)) + (c - b)^+ / share.

For c <= z the left side is z, and the right one max(a, min(b, c)) <= z. For z < c <= b the right
side is c, and the left one z + (c - z) / share >= c. For c > b the left side falls by 1 / share - 1
where z rises by 1, and at z = b both are equal. The right side is a charge that does not fall as c
grows: one backward sweep at any price of failure gives a lower bound of F on all of [a, b].
Intervals whose bound lies below the best value are split, the weakest first, down to single totals,
which are searched. Thresholds beyond the best value are not needed, as F(z) >= z. The lower bound
of the optimum is the least bound of all intervals, whenever the search ends.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from heapq import heappop, heappush, heapreplace
from typing import NamedTuple, cast

import numpy as np

from ssp_lp.accumulated_cost.charges import (
    TOTAL_COST,
    Charge,
    CostQuantileOf,
    ExcessCharge,
    LateCharge,
    TailMeanOf,
)
from ssp_lp.accumulated_cost.cost_law import CostLaw
from ssp_lp.accumulated_cost.totals import MOST_SUMS, last_steps, room_of, step_costs, sums_in
from ssp_lp.analysis.evaluation import Evaluation, complement, success_costs
from ssp_lp.arrays import QUANTILE
from ssp_lp.column_generation.column import FailureRow, Proof, required
from ssp_lp.column_generation.compiled_layers import CompiledLayered
from ssp_lp.column_generation.compiled_problem import CompiledExplicit, checked_least_failure
from ssp_lp.column_generation.search import DualGuess
from ssp_lp.compiled.deadline import Stop, WithIncumbent, is_late
from ssp_lp.errors import ModelError
from ssp_lp.methods.columns import refined_optimum
from ssp_lp.methods.incumbent import cheapest_way_bound
from ssp_lp.methods.refinement import Proved
from ssp_lp.methods.rows import (
    bound_at,
    least_goal_within,
    limited_rows,
    rows_optimum,
    true_figures,
)
from ssp_lp.model import SSP
from ssp_lp.options import CERTIFYING, SolveOptions
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem, compiled_constrained, compiled_totals
from ssp_lp.processes.conditions import FAILURE_ROW
from ssp_lp.solution import CUT_SHORT, Answer, Run, Solution, assembled


def least_risk(
    problem: Problem,
    options: SolveOptions,
    feasible: _Feasible | None = None,
    hint: Hint | None = None,
) -> Solution:
    """Solve for the least quantile, or conditional value at risk, of the cost given success.

    Args:
        problem: the problem; it has the measure and its level.
        options: method, tolerance and limits.
        feasible: the feasible policies, if already compiled; None: those of the problem.
        hint: a first threshold and a price of failure there, or None.

    Raises:
        InfeasibleError: the budget is below the least failure, or the goal is out of reach.
        ModelError: the layers of accumulated cost do not fit into memory.
    """
    feasible = feasible_set(problem) if feasible is None else feasible
    is_quantile = isinstance(problem.semantics.risk, CostQuantileOf)
    search = least_quantile if is_quantile else least_tail_mean
    return search(problem, feasible, options, hint)


def prove_risk(solution: Solution, evaluation: Evaluation, _: float) -> Proved:
    """Prove a lower bound of the least risk, from the model alone.

    Args:
        solution: the solution to certify.
        evaluation: evaluation of its policy. For a quantile, only thresholds below the policy's
            value are tried, so the bound is at most this value.
    """
    problem, value, bound = solution.problem, evaluation.objective, 0.0
    feasible, risk = feasible_set(problem), _risk_of(problem)
    level = risk.level
    try:
        if isinstance(risk, TailMeanOf):
            bound = _TailMeanSearch(problem, feasible, level, CERTIFYING).run()[1]
        elif (number := feasible.thresholds.number(value)) > 0:
            trial = feasible.attempt(LateCharge(feasible.thresholds.total(number - 1)), CERTIFYING)
            refuted = _last_excluded(feasible, trial, level, -1, number)
            bound = _total_above_excluded(feasible, refuted)
    except ModelError:  # too many layers
        bound = cheapest_way_bound(problem)
    return Proved(value, bound, feasible.allowed)


def _risk_of(problem: Problem) -> CostQuantileOf | TailMeanOf:
    return cast("CostQuantileOf | TailMeanOf", problem.semantics.risk)


@dataclass(frozen=True)
class _Multiples:
    """Thresholds that are multiples of a unit.

    If ``sharp``, the unit divides all costs; otherwise it is the mesh of a grid.
    """

    unit: Fraction
    sharp: bool = True  # whether no total can lie between two of them

    def total(self, number: int) -> float:
        """Return ``number`` times the unit, as the nearest float."""
        return float(number * self.unit)

    def number(self, total: float) -> int:
        """Return the index of the multiple nearest to a total."""
        return round(total / float(self.unit))


class _Sums:
    """Thresholds at the possible total costs: sums of step costs that end with a step to the goal.

    Mutable: sums are computed as needed.

    Raises:
        ModelError: too many sums are needed.
    """

    sharp = True

    def __init__(self, model: SSP) -> None:
        self._model = model
        self._steps, self._last = step_costs(model)[1], last_steps(model)[1]
        self._grow(4.0 * float(max(self._steps[-1], self._last[-1])) or 1.0)

    def total(self, number: int) -> float:
        """Return the total with a given index, or the greatest total if there are fewer."""
        size = 0
        while size < len(self._totals) <= number:
            size = len(self._totals)
            self._grow(2.0 * self._cap)
        return float(self._totals[min(number, len(self._totals) - 1)])

    def number(self, total: float) -> int:
        """Return the index of the possible total that is nearest to a cost."""
        while self._cap <= total * (1.0 + 1e-9):
            self._grow(2.0 * self._cap)
        return int(np.abs(self._totals - total).argmin())

    def _grow(self, cap: float) -> None:
        """Compute all possible totals below a cap; raise ModelError if there are too many."""
        sums = sums_in(self._model, cap, MOST_SUMS)
        if sums is None:
            raise ModelError(f"over {MOST_SUMS:,} distinct totals below {cap:g}: round the costs")
        every = np.unique((sums[:, None] + self._last).ravel())
        every = every[every < cap]
        room = room_of(np.union1d(self._steps, self._last), cap)
        self._cap, self._totals = cap, every[np.diff(every, prepend=-np.inf) > room]


_Thresholds = _Multiples | _Sums
"""The possible totals, numbered 0, 1, ..."""


_AHEAD = 8.0  # exact thresholds need few sums up to this multiple of the typical cost
_FINE = 500  # thresholds of a grid in a typical cost
_NEARBY = 1e-2  # relative uncertainty of a price from another threshold
_ROUNDING = 1e-14
"""Distance of a budget above the least failure, relative to the goal, that counts as 0."""


@dataclass(frozen=True, eq=False)
class _Trial:
    """The policy of least E[charge | goal], with its value and a lower bound."""

    value: float
    lower_bound: float
    policy: MixedPolicy
    kappa: float  # price of failure at the optimum
    calls: int
    prices: Mapping[str, float] = field(default_factory=dict)  # of constraints, by name


Hint = tuple[float, float]
"""A start of a search, from coarser costs: the quantile of a good policy, and the price of failure
there (0: unknown)."""

_Charge = LateCharge | ExcessCharge


class _Guess(NamedTuple):
    """Prices at which a lower bound is proved: of failure and of the further rows."""

    kappa: float  # price of failure
    rows: Mapping[str, float]  # prices of further rows, by name
    slack: bool = False
    """Whether the budget is presumably slack: then use the form cost - price * goal, which is
    exact if failing is optimal."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Feasible(ABC):
    """The feasible policies of a problem, with the operations that a search over thresholds needs.

    The operations minimise E[charge | goal] for a charge of the total cost, and compute its lower
    bounds at given prices.
    """

    budget: float | None  # failure budget; None: policies of least failure
    allowed: float  # largest failure: the budget, or the least failure
    typical: float  # cost given success of the policy of least failure
    thresholds: _Thresholds  # the totals that can occur, or a grid
    note: str = ""

    @abstractmethod
    def attempt(self, charge: _Charge, options: SolveOptions, kappa: float = 0.0) -> _Trial:
        """Minimise E[charge | goal] over the feasible policies.

        Args:
            charge: function of the total cost.
            options: method, tolerance and limits.
            kappa: a guess of the price of failure, to choose the cap; 0: unknown.
        """

    @abstractmethod
    def charge_bound(self, charge: _Charge, guess: _Guess) -> float:
        """Return a lower bound of E[charge | goal] for all feasible policies, at given prices."""

    def exceedance_bounds(self, number: int, guess: _Guess) -> Callable[[int], float]:
        """Return a function from the number of a threshold B to a lower bound of Pr(C > B | goal).

        C is the total cost; the bound holds for all feasible policies.

        Args:
            number: number of the greatest threshold that the function is called with.
            guess: the prices at which the lower bounds are proved.
        """
        return lambda k: self.charge_bound(LateCharge(self.thresholds.total(k)), guess)


@dataclass(frozen=True, eq=False, kw_only=True)
class _WithinBudget(_Feasible):
    """The feasible policies if failure is the only limit."""

    compiled: CompiledLayered

    def attempt(self, charge: _Charge, options: SolveOptions, kappa: float = 0.0) -> _Trial:
        """Minimise E[charge | goal] by column generation on layers of accumulated cost."""
        layer = self.compiled.layer
        shifts = not layer.by_sums and layer.base.instant.nnz == 0
        if shifts and isinstance(charge, ExcessCharge) and charge.affine_from_total == 0.0:
            # a multiple of the mean, for which one sweep covers many prices of failure
            mean, slope = self._least(TOTAL_COST, options, kappa / charge.slope), charge.slope
            value, bound, price = (
                slope * part for part in (mean.value, mean.lower_bound, mean.kappa)
            )
            return replace(mean, value=value, lower_bound=bound, kappa=price)
        return self._least(charge, options, kappa)

    def _least(self, charge: Charge, options: SolveOptions, kappa: float) -> _Trial:
        """Minimise E[charge | goal] for any charge; see :meth:`attempt`."""
        compiled = self._charging(charge, kappa)
        if self.budget is None:
            pricing = compiled.pricing()
            column = pricing.minimise(0.0)
            policy = MixedPolicy((pricing.policy(column),), np.ones(1))
            value = column.cost / column.goal
            return _Trial(value, min(self.share(pricing.prove(0.0)), value), policy, 0.0, 2)
        guess = DualGuess(kappa, _NEARBY) if kappa > 0.0 else None
        best = refined_optimum(compiled, self.budget, options, guess)
        return _Trial(best.value, best.bound, best.policy, best.kappa, best.calls)

    def charge_bound(self, charge: _Charge, guess: _Guess) -> float:
        """Return the lower bound of E[charge | goal] by one backward sweep at given prices."""
        return self.share(self._proof(charge, guess))

    def exceedance_bounds(self, number: int, guess: _Guess) -> Callable[[int], float]:
        """Return a function from a threshold's number to a lower bound of Pr(C > B | goal).

        If layers are multiples of a unit, one backward sweep gives all bounds: a run exceeds a
        smaller threshold B if, begun at total ``greatest - B``, it exceeds the greatest threshold.
        """
        if self.compiled.layer.by_sums:
            return super().exceedance_bounds(number, guess)
        proof = self._proof(LateCharge(self.thresholds.total(number)), guess)
        by_layer = required(proof.by_layer)
        last = len(by_layer) - 1
        return lambda k: self.share(replace(proof, bound=by_layer[min(number - k, last)]))

    def _proof(self, charge: _Charge, guess: _Guess) -> Proof:
        """Return the dual bound for a charge at the given price of failure."""
        kappa, slack = (0.0, False) if self.budget is None else (guess.kappa, guess.slack)
        return self._charging(charge, kappa).pricing().prove(kappa, slack=slack)

    def _charging(self, charge: Charge, kappa: float) -> CompiledLayered:
        """Return the compiled problem with a charge, and a cap large enough for a price of failure.

        Args:
            charge: function of the total cost.
            kappa: price of failure; 0: unknown.
        """
        compiled = self.compiled.charging(charge)
        if kappa <= 0.0 or self.budget is None:
            return compiled
        return self.compiled.charging(charge, compiled.lossless_units(kappa))

    def share(self, proof: Proof) -> float:
        """Return the lower bound of E[charge | goal] that a proof implies."""
        if self.budget is not None:
            return FailureRow(self.budget, ratio=True).lower_bound(proof)
        greatest = float(self.compiled.facts.start @ self.compiled.facts.greatest.bound)
        return max(proof.bound, 0.0) / min(greatest, 1.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class _WithinRows(_Feasible):
    """The feasible policies if failure and other quantities are limited."""

    problem: Problem
    compiled: CompiledExplicit

    def attempt(self, charge: _Charge, options: SolveOptions, kappa: float = 0.0) -> _Trial:
        """Minimise E[charge | goal] by column generation with all rows."""

        def value(policy: MixedPolicy) -> float:
            """Return E[charge | goal] of a lottery, by the distribution of its total cost."""
            law = success_costs(policy, self.problem)
            return _expected_charge(charge, law) / law.goal

        truth = true_figures(self.problem, self.compiled, value)
        best = rows_optimum(self.compiled.charging(charge), options, truth)
        return _Trial(best.value, best.bound, best.policy, best.kappa, best.calls, best.prices)

    def charge_bound(self, charge: _Charge, guess: _Guess) -> float:
        """Return a lower bound of E[charge | goal] at the optimal prices of another charge."""
        ratio = guess.kappa - guess.rows.get(FAILURE_ROW, 0.0)
        return bound_at(self.compiled.charging(charge), guess.rows, ratio, self._least_goal)

    @cached_property
    def _least_goal(self) -> float:
        """Lower bound of the goal probability of all lotteries within the rows."""
        return least_goal_within(self.compiled, limited_rows(self.compiled))


def _expected_charge(charge: _Charge, law: CostLaw) -> float:
    """Return E[charge; goal] for the distribution of a policy's total cost."""
    if isinstance(charge, LateCharge):
        return law.goal - law.within(charge.bound)
    return charge.threshold * law.goal + law.excess(charge.threshold) / charge.share


def feasible_set(problem: Problem) -> _Feasible:
    """Return the feasible policies of a problem, after a check of its budget.

    A budget above the least failure by no more than rounding counts as equal to it.

    Args:
        problem: a criterion given success.

    Raises:
        InfeasibleError: the budget is below the least failure, or the goal is out of reach.
    """
    if not problem.several_rows:
        return feasible_compiled(compiled_totals(problem), problem.failure_budget)
    compiled = compiled_constrained(problem).at_least_failure()
    budget, typical = compiled.budget, compiled.facts.typical_cost
    thresholds: _Thresholds = _Multiples(Fraction(typical / _FINE), sharp=False)
    if compiled.resolution is None:
        thresholds = _Multiples(compiled.base.exact_unit)
    else:
        with suppress(ModelError):  # too many sums
            sums = _Sums(compiled.facts.model)
            sums.number(_AHEAD * typical)
            thresholds = sums
    return _WithinRows(
        budget=budget,
        allowed=max(1.0 - compiled.least_goal, 0.0) if budget is None else budget,
        typical=typical,
        thresholds=thresholds,
        problem=problem,
        compiled=compiled,
    )


def feasible_compiled(compiled: CompiledLayered, budget: float | None) -> _WithinBudget:
    """Return the feasible policies of a compiled problem, after a check of its budget.

    Args:
        compiled: the compiled problem.
        budget: failure budget; None: policies of least failure.

    Raises:
        InfeasibleError: the budget is below the least failure, or the goal is out of reach.
    """
    column = checked_least_failure(compiled, budget).column
    allowed, note = column.failure, ""
    if budget is not None and budget > allowed + _ROUNDING * column.goal:
        allowed = budget
    else:
        if budget is not None and budget != allowed:
            side = "below" if budget < allowed else "above"
            away = abs(budget - allowed)
            note = f"the budget lies {away:.1e} {side} the least failure and counts as equal"
        compiled, budget = compiled.safest(), None
    layer, model = compiled.layer, compiled.facts.model
    return _WithinBudget(
        budget=budget,
        allowed=allowed,
        typical=column.cost / column.goal,
        thresholds=_Sums(model) if layer.by_sums else _Multiples(layer.base.exact_unit),
        note=note,
        compiled=compiled,
    )


_ROUGH = 1e-2  # tolerance of a share that is only compared with the level
_NEWTON = 6  # steps after which bounds are bisected, or doubled while all are infeasible
_ABOVE = 1e-9  # relative margin of a price above the share for a slack budget


def least_quantile(
    problem: Problem, feasible: _Feasible, options: SolveOptions, hint: Hint | None = None
) -> Solution:
    """Search for the least bound B with Pr(C > B | goal) <= 1 - level for some policy.

    Args:
        problem: the problem.
        feasible: the feasible policies.
        options: method, tolerance and limits.
        hint: a guess of the quantile and of the price of failure there, or None.

    Raises:
        ModelError: the quantile lies beyond the largest possible cap.
        Stop: the time limit was reached before a feasible bound was found.
    """
    level = _risk_of(problem).level
    places, (total, kappa) = feasible.thresholds, hint or (feasible.typical, 0.0)
    incumbent, calls, number = None, 0, places.number(total)
    low, refuted, high, tried = -1, -1, 0, 0  # infeasible, proved infeasible, feasible; trials
    rough = replace(options, tolerance=max(options.tolerance, _ROUGH))
    with WithIncumbent():
        while incumbent is None or (high - low > 1 and not is_late()):
            trial = feasible.attempt(LateCharge(places.total(number)), rough, kappa)
            calls, kappa, tried = calls + trial.calls, trial.kappa, tried + 1
            if trial.lower_bound <= _exceedance_limit(level) < trial.value and not is_late():
                trial = feasible.attempt(LateCharge(places.total(number)), options, kappa)
                calls, kappa = calls + trial.calls, trial.kappa
            if trial.value <= _exceedance_limit(level):
                incumbent, high = trial, number
            else:
                low = number
            if incumbent is None and is_late():
                break
            last = high if incumbent else 2 * number + 1
            refuted = max(refuted, _last_excluded(feasible, trial, level, refuted, last))
            low, number = max(low, refuted), max(low, refuted) + 1
            if tried > _NEWTON:
                number = (low + high) // 2 if incumbent is not None else last
        if incumbent is not None and not is_late():  # least Pr(C > B | goal)
            best = feasible.attempt(LateCharge(places.total(high)), options, kappa)
            calls += best.calls
            incumbent = min(incumbent, best, key=lambda trial: trial.value)
    if incumbent is None:
        below = _total_above_excluded(feasible, refuted)
        raise Stop(note=f"the least quantile is at least {below:g}")
    law = success_costs(incumbent.policy, problem)
    objective = law.quantile(level)
    answer = Answer(
        policy=incumbent.policy,
        value=objective,
        bound=min(_total_above_excluded(feasible, refuted), objective),
        failure=complement(law.goal),
        note="; ".join(filter(None, (feasible.note, CUT_SHORT if high - low > 1 else ""))),
    )
    reason = f"{tried} cost bounds, {calls} pricing calls"
    return assembled(problem, answer, Run(options.method, reason, calls, 0.0))


def _last_excluded(feasible: _Feasible, trial: _Trial, level: float, first: int, last: int) -> int:
    """Return the number of the greatest threshold that a trial's prices refute.

    A threshold B is refuted if Pr(C > B | goal) > 1 - level for all feasible policies.

    Args:
        feasible: the feasible policies.
        trial: gives the prices; the threshold of the trial does not matter.
        level: level of the quantile, in (0, 1).
        first: number of a refuted threshold.
        last: only smaller numbers are considered.
    """
    share = _exceedance_limit(level)
    slack = trial.kappa <= trial.value * (1.0 + _ABOVE)  # of the budget
    kappa = share * (1.0 + _ABOVE) if slack else max(trial.kappa, share)
    shares = feasible.exceedance_bounds(last, _Guess(kappa, trial.prices, slack))
    numbers = range(first + 1, last)
    return first + bisect_left(numbers, True, key=lambda number: shares(number) <= share)


def _total_above_excluded(feasible: _Feasible, refuted: int) -> float:
    """Return the least total above a refuted threshold: a lower bound of the quantile."""
    places = feasible.thresholds
    if places.sharp:
        return places.total(refuted + 1)
    return places.total(refuted) if refuted >= 0 else 0.0


def _exceedance_limit(level: float) -> float:
    """Return the greatest Pr(C > B | goal) at which B is a quantile: 1 - level, plus a tolerance.

    It is below 1 at every level, by more than rounding, so some success costs at most B.
    """
    return 1.0 - max(level, QUANTILE) * (1.0 - QUANTILE)


_TIED = 1e-12  # relative difference of values that is rounding


@dataclass(eq=False)
class _TailMeanSearch:
    """A search over thresholds for the least conditional value at risk. Mutable."""

    problem: Problem
    feasible: _Feasible
    level: float
    options: SolveOptions
    best: Answer | None = None
    quantile: int = 0  # number of the best policy's own quantile
    tried: dict[int, _Trial] = field(default_factory=dict)  # by the number of the threshold
    kappas: dict[int, float] = field(default_factory=dict)  # prices of failure there
    calls: int = 0
    sweeps: int = 0

    def attempt(self, threshold: int, options: SolveOptions | None = None) -> Answer:
        """Minimise the charge of a threshold; return the incumbent, updated if it was improved."""
        charge = ExcessCharge(self.feasible.thresholds.total(threshold), 1.0 - self.level)
        kappa = self._kappa(threshold)
        trial = self.feasible.attempt(charge, options or self.options, kappa)
        self.tried[threshold], self.kappas[threshold] = trial, trial.kappa
        self.calls += trial.calls
        law = success_costs(trial.policy, self.problem)
        value, best = law.tail_mean(self.level), self.best
        quantile = self.feasible.thresholds.number(law.quantile(self.level))
        tied = _TIED if quantile == threshold else -_TIED  # prefer z equal to the quantile
        if best is None or value <= best.value * (1.0 + tied):
            beyond = trial.kappa - value  # price of the failure row
            price = beyond if beyond > _TIED * value else 0.0
            failure = complement(law.goal)
            best = Answer(trial.policy, value, 0.0, failure, price, None, trial.prices)
            self.best, self.quantile = best, quantile
        return best

    def bound_between(self, first: int, last: int) -> float:
        """Return a lower bound of F (see the module) on all thresholds from first to last.

        The bound is proved at a price of failure that is interpolated between known ones. If the
        budget is slack at a tried threshold nearby, it is also proved at the price ``target``,
        which is enough to reach the target.
        """
        places, middle = self.feasible.thresholds, (first + last) // 2
        charge = ExcessCharge(places.total(last), 1.0 - self.level, places.total(first))
        numbers, bound = sorted(self.tried), 0.0
        nearest = min(numbers, key=lambda number: abs(number - middle))
        place = bisect_left(numbers, middle)
        beside = [self.tried[number] for number in numbers[max(place - 1, 0) : place + 1]]
        slack = [trial.kappa <= trial.value * (1.0 + _ABOVE) for trial in beside]
        prices = [] if all(slack) else [max(self._kappa(middle), self.target)]
        for kappa in dict.fromkeys(prices + [self.target] * any(slack)):
            guess = _Guess(kappa, self.tried[nearest].prices, kappa <= self.target)
            bound = max(bound, self.feasible.charge_bound(charge, guess))
            self.sweeps += 1
            if bound >= self.target:
                break
        return bound

    @property
    def target(self) -> float:
        """Value that the bounds must reach: the incumbent's value less the tolerance."""
        return 0.0 if self.best is None else self.best.value * (1.0 - self.options.tolerance)

    def _kappa(self, threshold: int) -> float:
        """Return the price of failure at a threshold, interpolated between known ones."""
        numbers = sorted(self.kappas)
        kappas = [self.kappas[number] for number in numbers]
        return float(np.interp(threshold, numbers, kappas)) if numbers else 0.0

    def run(self, hint: Hint | None = None) -> tuple[Answer, float]:
        """Run the search; return the best policy and a lower bound for every policy.

        Args:
            hint: a guess of the best threshold and of the price of failure there, or None.
        """
        places, options = self.feasible.thresholds, self.options
        rough = replace(options, tolerance=max(options.tolerance, _ROUGH))
        best = self.attempt(0, rough if self.level > 0.0 else options)
        if self.level > 0.0 and self.tried[0].lower_bound < self.target and not is_late():
            with WithIncumbent():
                best = self.attempt(0)
        whole = self.tried[0].lower_bound
        if self.level == 0.0:
            return best, max(whole, 0.0)  # the mean: the least threshold is optimal
        if hint is not None:
            self.kappas.setdefault(places.number(hint[0]), hint[1])
        elif self.quantile > 0 and self.tried[0].value > 0.0:  # in proportion to the value
            dearest = self.kappas[0] / self.tried[0].value
            self.kappas[self.quantile] = dearest * best.value
        with WithIncumbent():
            while self.quantile not in self.tried and not is_late():
                best = self.attempt(self.quantile)
        last = places.number(best.value) + 1
        least = whole * (1.0 - self.level)  # a lower bound of every tail mean
        bounds = [trial.lower_bound for trial in self.tried.values()]
        numbers = sorted(number for number in self.tried if number < last)
        between = 1 if places.sharp else 0  # a grid must cover all real numbers
        weakest = sorted(
            (least, *part)
            for after, before in zip(numbers, [*numbers[1:], last + 1], strict=True)
            if before - after > between
            for part in self._parts(self._reached(after, before, bounds), before - between, between)
        )
        while weakest and not is_late() and weakest[0][0] < self.target:
            with WithIncumbent():
                self._split(weakest, bounds)
        best = self.best or best
        return best, max(min([*bounds, *(part[0] for part in weakest), best.value]), 0.0)

    def _reached(self, after: int, before: int, bounds: list[float]) -> int:
        """Return the first threshold, after a tried one, that the known lower bounds do not refute.

        F falls by at most 1 / share - 1 where the threshold rises by 1. So the lower bound of F at
        the tried threshold also gives lower bounds at the thresholds that follow.

        Args:
            after: number of the tried threshold.
            before: number of the next tried threshold.
            bounds: bounds of settled thresholds; updated.
        """
        places, bound = self.feasible.thresholds, self.tried[after].lower_bound
        between, fall = 1 if places.sharp else 0, self.level / (1.0 - self.level)
        begin, final = places.total(after), before - between
        end = min(begin + max(bound - self.target, 0.0) / fall, places.total(final))
        reached = min(places.number(end), final)
        reached = max(reached - int(places.total(reached) > end), after)
        if reached > after:
            bounds.append(bound * (1.0 - 2.0 * _ROUNDING) - (places.total(reached) - begin) * fall)
        return reached + between

    def _parts(self, first: int, final: int, between: int) -> Iterator[tuple[int, int]]:
        """Yield the parts of an interval of thresholds, each as (first, last).

        Each part is twice as long as the part before; the shortest one is nearest to the quantile.

        Args:
            first: number of the first threshold.
            final: number of the last threshold.
            between: distance from the last threshold of a part to the first one of the next part.
        """
        is_below, length = final <= self.quantile, 1
        while first + 1 - between <= final:
            some = min(length - between, final - first)
            yield (final - some, final) if is_below else (first, first + some)
            if some == final - first:
                return
            first, final = (
                (first, final - some - between) if is_below else (first + some + between, final)
            )
            length *= 2

    def _split(self, weakest: list[tuple[float, int, int]], bounds: list[float]) -> None:
        """Raise the bound of the interval of thresholds whose bound is least, or halve it.

        The bound is raised by :meth:`refuted`. If it does not reach the target, the interval is
        halved; an interval of one threshold is solved by a trial.

        Args:
            weakest: heap of bound, first and last threshold of each interval; updated.
            bounds: bounds of settled thresholds; updated.
        """
        places, (bound, first, final) = self.feasible.thresholds, weakest[0]
        if self.best is not None and places.total(first) >= self.best.value:
            heappop(weakest)
            return  # as F(z) >= z
        bound = max(bound, self.bound_between(first, final))
        if bound >= self.target:
            heapreplace(weakest, (bound, first, final))
        elif first == final:
            self.attempt(first)
            bounds.append(max(bound, self.tried[first].lower_bound))
            heappop(weakest)
        elif final - first == 1 and not places.sharp:
            bounds.append(bound)
            heappop(weakest)
        else:
            middle, between = (first + final) // 2, 1 if places.sharp else 0
            heapreplace(weakest, (bound, first, middle))
            heappush(weakest, (bound, middle + between, final))


def least_tail_mean(
    problem: Problem, feasible: _Feasible, options: SolveOptions, hint: Hint | None = None
) -> Solution:
    """Minimise the conditional value at risk, with a proof for all thresholds.

    Args:
        problem: the problem.
        feasible: the feasible policies.
        options: method, tolerance and limits.
        hint: a guess of the best threshold and of the price of failure there, or None.
    """
    search = _TailMeanSearch(problem, feasible, _risk_of(problem).level, options)
    best, bound = search.run(hint)
    sweeps = f", {search.sweeps} sweeps over intervals" if search.sweeps else ""
    reason = f"{len(search.tried)} thresholds, {search.calls} pricing calls{sweeps}"
    price = None if feasible.budget is None else best.price
    note = "; ".join(filter(None, (feasible.note, CUT_SHORT if is_late() else "")))
    answer = replace(best, bound=min(bound, best.value), price=price, note=note)
    return assembled(problem, answer, Run(options.method, reason, search.calls, 0.0))
