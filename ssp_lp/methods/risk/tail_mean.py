"""The least conditional value at risk of the total cost given success.

For any policy it is the least over z of z + E[(C - z)^+ | goal] / share, share = 1 - level
(Rockafellar and Uryasev 2000), attained at the quantile, a total that can occur. So the optimum is
the least over such z of F(z), the least E[charge | goal] with that integrand as the charge: S3P
with a kink. The search alternates between the best policy at z and that policy's own quantile.

F is a least of convex functions and need not be convex itself, so that values on both sides of a z
prove nothing of it. What is proved is proved of whole intervals: for a <= z <= b and every c

    z + (c - z)^+ / share  >=  max(a, min(b, c)) + (c - b)^+ / share.

For c <= z the left side is z, and the right one max(a, min(b, c)) <= z. For z < c <= b the right
side is c, and the left one z + (c - z) / share >= c. For c > b the left side falls by 1 / share - 1
where z rises by 1, and at z = b both are equal. The right side is a charge that does not fall as c
grows: one backward sweep at any price of failure bounds F on all of [a, b] from below. Intervals
whose bound lies below the best value are split, the weakest first, down to single totals, which are
searched; beyond the best value none is needed, as F(z) >= z. The bound of the whole is the least of
what is left: it is what the sweeps say, whenever the search ends.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from heapq import heappop, heappush, heapreplace

import numpy as np

from ssp_lp.analysis.total_cost.cost_law import success_costs
from ssp_lp.compiled.deadline import STOPS, heed, is_late
from ssp_lp.methods.assembling import Found, assembled
from ssp_lp.methods.risk.question import Near, Question, Trial, question_remarks
from ssp_lp.options import SolveOptions
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem
from ssp_lp.processes.layered.charges import ExcessCharge
from ssp_lp.solution import Run, Solution

_TIED = 1e-12  # relative difference of values that is rounding
_PRICES = 8  # of failure that are tried at a threshold before it is searched
_FACTOR = 1.5  # between the first two
_NEAR = 0.02  # relative distance of prices at which trying others ends


@dataclass(frozen=True, eq=False)
class _BestTailMean:
    """The least value so far, who attains it, and what its search took."""

    value: float
    policy: MixedPolicy
    failure: float
    threshold: int  # number of the policy's quantile
    kappa: float  # price of failure
    calls: int
    prices: Mapping[str, float]  # of constraints, by name

    @property
    def price(self) -> float:
        """What failing costs beyond the value; 0 where that is rounding."""
        beyond = self.kappa - self.value
        return beyond if beyond > _TIED * self.value else 0.0


@dataclass(eq=False)
class _TailMeanSearch:
    """A search over thresholds. Mutable: it learns."""

    problem: Problem
    question: Question
    level: float
    options: SolveOptions
    best: _BestTailMean | None = None
    tried: dict[int, Trial] = field(default_factory=dict)  # by the number of the threshold
    kappas: dict[int, float] = field(default_factory=dict)  # what failing is worth there
    sweeps: int = 0

    @property
    def in_time(self) -> bool:
        """Whether there is time left."""
        return not is_late()

    def attempt(self, threshold: int) -> _BestTailMean:
        """The better of the best so far and the best policy at a threshold."""
        best = self.best
        charge = ExcessCharge(self.question.thresholds.total(threshold), 1.0 - self.level)
        trial = self.question.attempt(charge, self.options, self._kappa(threshold))
        self.tried[threshold], self.kappas[threshold] = trial, trial.kappa
        law = success_costs(trial.policy, self.problem)
        value = law.tail_mean(self.level)
        quantile = self.question.thresholds.number(law.quantile(self.level))
        calls = trial.calls + (0 if best is None else best.calls)
        tied = _TIED if quantile == threshold else -_TIED  # of equals: whose z is its quantile
        if best is not None and value > best.value * (1.0 + tied):
            self.best = replace(best, calls=calls)
        else:
            found = value, trial.policy, 1.0 - law.goal, quantile, trial.kappa, calls
            self.best = _BestTailMean(*found, trial.prices)
        return self.best

    def refuted(self, first: int, last: int) -> float:
        """A lower bound of F on all thresholds between two, and at them, by one sweep.

        Of a single one the price of failure is sought that proves most: the bound is concave in it.
        """
        places, middle = self.question.thresholds, (first + last) // 2
        charge = ExcessCharge(places.total(last), 1.0 - self.level, places.total(first))
        kappa = self._kappa(middle)
        bound = self._swept(charge, middle, kappa)
        if first < last or self.question.budget is None or kappa <= 0.0:
            return bound
        factor = _FACTOR if bound > 0.0 else 1.0 / _FACTOR
        for _ in range(_PRICES):
            if bound >= self.target or abs(factor - 1.0) < _NEAR:
                break
            other = self._swept(charge, middle, kappa * factor)
            if other > bound:
                bound, kappa = other, kappa * factor
            else:
                factor = factor**-0.5
        self.kappas[middle] = kappa
        return bound

    @property
    def target(self) -> float:
        """The value that thresholds must not fall below."""
        return 0.0 if self.best is None else self.best.value * (1.0 - self.options.tolerance)

    def _swept(self, charge: ExcessCharge, threshold: int, kappa: float) -> float:
        """The bound at a guess of what failing is worth."""
        near, target = self._nearest(threshold), self.target
        prices: Mapping[str, float] = {} if near is None else near.prices
        self.sweeps += 1
        return self.question.refuted_below(
            charge, max(kappa, target), prices, slack=kappa <= target
        )

    def _kappa(self, threshold: int) -> float:
        """What failing may be worth at a threshold, between those at which it is known."""
        known = sorted(self.kappas)
        if not known:
            return 0.0
        return float(np.interp(threshold, known, [self.kappas[number] for number in known]))

    def _nearest(self, threshold: int) -> Trial | None:
        """The trial at the nearest threshold."""
        if not self.tried:
            return None
        return self.tried[min(self.tried, key=lambda number: abs(number - threshold))]


def least_tail_mean(
    problem: Problem,
    question: Question,
    level: float,
    options: SolveOptions,
    near: Near | None = None,
) -> Solution:
    """Find a policy by alternating, and prove that no other threshold gives a better one.

    Args:
        problem: the problem.
        question: the policies that count.
        level: in [0, 1).
        options: method, tolerance and limits.
        near: where the best threshold may be; None: unknown.
    """
    search = _TailMeanSearch(problem, question, level, options)
    best, bound = _proved_tail_mean(search, near)
    sweeps = f", {search.sweeps} sweeps over intervals" if search.sweeps else ""
    reason = f"{len(search.tried)} thresholds, {best.calls} pricing calls{sweeps}"
    price = None if question.budget is None else best.price
    note = question_remarks(question, in_time=search.in_time)
    found = Found(
        best.policy,
        best.value,
        min(bound, best.value),
        best.failure,
        price,
        None,
        best.prices,
        note,
    )
    return assembled(problem, found, Run(options.method, reason, best.calls, 0.0))


def tail_mean_bound(
    problem: Problem, question: Question, level: float, options: SolveOptions
) -> float:
    """Prove a lower bound of every policy's tail mean afresh.

    Args:
        problem: the problem.
        question: the policies that count.
        level: in [0, 1).
        options: tolerance and limits.
    """
    return _proved_tail_mean(_TailMeanSearch(problem, question, level, options))[1]


def _proved_tail_mean(
    search: _TailMeanSearch, near: Near | None = None
) -> tuple[_BestTailMean, float]:
    """The best policy, and a lower bound of every policy's tail mean."""
    places, best = search.question.thresholds, search.attempt(0)
    whole = search.tried[0].lower_bound
    if search.level == 0.0:
        return best, max(whole, 0.0)  # the whole mean: the least threshold is best
    if near is not None:
        search.kappas.setdefault(places.number(near.total), near.kappa)
    try:
        while best.threshold not in search.tried and search.in_time:
            best = search.attempt(best.threshold)
    except STOPS as stop:
        heed(stop)
    last = places.number(best.value) + 1
    least = whole * (1.0 - search.level)  # no tail's mean is below its share of the whole's
    bounds = [trial.lower_bound for trial in search.tried.values()]
    known = sorted(number for number in search.tried if number < last)
    between = 1 if places.sharp else 0  # else every real number has to be covered
    weakest = [
        (least, after + between, before - between)
        for after, before in zip(known, [*known[1:], last + 1], strict=True)
        if before - after > between
    ]
    while weakest and search.in_time and weakest[0][0] < search.target:
        try:
            _split_thresholds(search, weakest, bounds)
        except STOPS as stop:
            heed(stop)
    best = search.best or best
    return best, max(min([*bounds, *(part[0] for part in weakest), best.value]), 0.0)


def _split_thresholds(
    search: _TailMeanSearch, weakest: list[tuple[float, int, int]], bounds: list[float]
) -> None:
    """Refute the interval of the least bound, or halve it; of one threshold a policy is found.

    Args:
        search: what is known.
        weakest: bound, first and last threshold of each interval, a heap; changed.
        bounds: of what will not be looked at again; added to.
    """
    places = search.question.thresholds
    bound, first, final = weakest[0]
    if search.best is not None and places.total(first) >= search.best.value:
        heappop(weakest)
        return  # as F(z) >= z
    bound = max(bound, search.refuted(first, final))
    if bound >= search.target:
        heapreplace(weakest, (bound, first, final))
    elif first == final:
        search.attempt(first)
        bounds.append(max(bound, search.tried[first].lower_bound))
        heappop(weakest)
    elif final - first == 1 and not places.sharp:
        bounds.append(bound)
        heappop(weakest)
    else:
        middle, between = (first + final) // 2, 1 if places.sharp else 0
        heapreplace(weakest, (bound, first, middle))
        heappush(weakest, (bound, middle + between, final))
