"""The least conditional value at risk of the total cost given success.

For any policy it is the least over z of z + E[(C - z)^+ | goal] / (1 - level) (Rockafellar and
Uryasev 2000), attained at the quantile, which lies on the lattice of costs. So the optimum is the
least over z on the lattice of F(z), the least E[charge | goal] with that integrand as the charge:
S3P with a kink. The search alternates between the best policy at z and that policy's own quantile.
The proof then refutes every z: most by one backward sweep at the price of failure that was optimal
nearby; many by their neighbours, since with z the integrand rises by at most the step and falls by
at most level / (1 - level) of it; all that are dearer than the optimum because F(z) >= z.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from ssp_lp.analysis.total_cost.cost_law import success_costs
from ssp_lp.compiled.deadline import STOPS, heed, is_late
from ssp_lp.methods.assembling import Found, assembled
from ssp_lp.methods.risk.question import Question, Trial, cost_of, layer_of, remarks
from ssp_lp.options import SolveOptions
from ssp_lp.policies import MixedPolicy
from ssp_lp.problem import Problem
from ssp_lp.processes.layered.arrival_cost import Excess
from ssp_lp.solution import Run, Solution

_TIED = 1e-12  # relative difference of values that is rounding


@dataclass(frozen=True, eq=False)
class Best:
    """The least value so far, who attains it, and what its search took."""

    value: float
    policy: MixedPolicy
    failure: float
    layer: int  # the policy's quantile
    kappa: float  # price of failure
    calls: int
    prices: Mapping[str, float]  # of constraints, by name

    @property
    def price(self) -> float:
        """What failing costs beyond the value; 0 where that is rounding."""
        beyond = self.kappa - self.value
        return beyond if beyond > _TIED * self.value else 0.0


@dataclass(frozen=True, eq=False)
class _Search:
    """What does not change from threshold to threshold."""

    problem: Problem
    question: Question
    level: float
    options: SolveOptions

    def charge(self, layer: int) -> Excess:
        """The integrand at a threshold."""
        return Excess(layer, 1.0 - self.level, self.question.base.exact_unit)

    def attempt(self, layer: int, best: Best | None, kappa: float = 0.0) -> tuple[Best, Trial]:
        """The better of the best so far and the best policy at a threshold, and the trial."""
        trial = self.question.attempt(self.charge(layer), self.options, kappa)
        law = success_costs(trial.policy, self.problem)
        value = law.tail_mean(self.level)
        quantile = layer_of(self.question, law.quantile(self.level))
        calls = trial.calls + (0 if best is None else best.calls)
        tied = _TIED if quantile == layer else -_TIED  # of equals the one whose z is its quantile
        if best is not None and value > best.value * (1.0 + tied):
            return replace(best, calls=calls), trial
        failure = 1.0 - law.goal
        return Best(value, trial.policy, failure, quantile, trial.kappa, calls, trial.prices), trial

    def alternate(self, best: Best, bounds: dict[int, float]) -> Best:
        """Go on at the best policy's own quantile until its threshold has been tried.

        Args:
            best: to begin with.
            bounds: lower bounds of the thresholds tried; those tried here are added.
        """
        while best.layer not in bounds and not is_late():
            layer = best.layer
            try:
                best, trial = self.attempt(layer, best, best.kappa)
            except STOPS as stop:
                heed(stop)
                break
            bounds[layer] = trial.lower_bound
        return best

    def target(self, best: Best) -> float:
        """The value below which no threshold may lie."""
        return best.value * (1.0 - self.options.tolerance)

    def refute(self, best: Best, layer: int, step: int) -> tuple[Best, float]:
        """Bound all thresholds from a layer on, upwards or downwards.

        Returns:
            The best, which may have been found on the way, and the least bound; minus infinity
            where time ran out.
        """
        question, least = self.question, best.value
        slope = self.level / (1.0 - self.level) if step > 0 else 1.0
        kappa, prices = best.kappa, best.prices
        while layer >= 0:
            if cost_of(question, layer) >= (target := self.target(best)):  # as F(z) >= z
                if step > 0:
                    break
                layer -= 1
                continue
            if is_late():
                return best, float("-inf")
            priced = max(kappa, target)
            slack = kappa <= target
            try:
                here = question.refuted_below(self.charge(layer), priced, prices, slack=slack)
                if here < target:
                    best, trial = self.attempt(layer, best, kappa)
                    here, kappa, prices = max(here, trial.lower_bound), trial.kappa, trial.prices
            except STOPS as stop:
                heed(stop)
                return best, float("-inf")
            room = max(here - self.target(best), 0.0)
            skipped = int(room / (slope * question.base.unit))
            least = min(least, here if skipped == 0 else self.target(best))
            layer += step * (1 + skipped)
        return best, min(least, self.target(best))


def least_tail_mean(
    problem: Problem, question: Question, level: float, options: SolveOptions
) -> Solution:
    """Find a policy by alternating, and prove that no other threshold gives a better one.

    Args:
        problem: the problem.
        question: the policies that count.
        level: in [0, 1).
        options: method, tolerance and limits.
    """
    best, bound, in_time = _proved(_Search(problem, question, level, options))
    reason = f"thresholds on the lattice of costs, {best.calls} pricing calls"
    price = None if question.budget is None else best.price
    note = remarks(question, in_time=in_time)
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
    return _proved(_Search(problem, question, level, options))[1]


def _proved(search: _Search) -> tuple[Best, float, bool]:
    """The best policy, a lower bound of every policy's tail mean, and whether time sufficed.

    All thresholds on both sides of the best one are refuted; its own bound is known.
    """
    best, first = search.attempt(0, None)
    bounds = {0: first.lower_bound}
    if search.level == 0.0:
        return best, first.lower_bound, True  # the whole mean: the least threshold is best
    best = search.alternate(best, bounds)
    middle = best.layer
    own = bounds.get(middle, float("-inf"))
    best, above = search.refute(best, middle + 1, +1)
    best, below = search.refute(best, middle - 1, -1)
    bound = min(own, above, below)
    in_time = bound > float("-inf")
    if not in_time:
        bound = first.lower_bound * (1.0 - search.level)  # no tail's mean is below the whole's
    return best, max(bound, 0.0), in_time
