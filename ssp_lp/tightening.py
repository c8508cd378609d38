"""A failure budget that holds for all probabilities in boxes: a lottery over plans, and a bound.

A plan is a deterministic policy. Each plan of the lottery counts with its own worst cost and its
own worst failure probability, so the lottery satisfies the budget whatever the probabilities are.
The bound is the optimum of the problem at one choice of probabilities: the worst choice for the
best plan at some price of failure (Lagrange). The worst case of every lottery is at least this
optimum. A gap between value and bound may remain, because in the true worst case of a lottery all
plans have the same probabilities, for cost and failure alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from ssp_lp.analysis.worst_case import worst_case
from ssp_lp.arrays import IMPROVEMENT, LEAST_BUDGET, BoolArray, FloatArray, IntArray, expected
from ssp_lp.column_generation.column import two_sided_gap
from ssp_lp.column_generation.restricted_master import MasterOptimum
from ssp_lp.column_generation.search import secant
from ssp_lp.compiled.deadline import WithIncumbent, is_late, limited
from ssp_lp.errors import InfeasibleError, ModelError, check_between_0_and_1
from ssp_lp.model.arguments import explained
from ssp_lp.model.boxes import Boxes
from ssp_lp.model.report import Facts, Table
from ssp_lp.policies import DeterministicPolicy, MixedPolicy, Policy
from ssp_lp.policies.boxed_chain import MOST_ROUNDS, boxed_chain
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, as_lottery
from ssp_lp.problem import Problem, check_boxed, check_problem
from ssp_lp.reductions.robust import (
    check_ends,
    completed,
    ending,
    settled,
    solved_at,
    worst_loss,
    worst_means,
)
from ssp_lp.solving import solve

_BESIDE = 50  # most plans that differ from one in a single state


@dataclass(frozen=True, repr=False)
class Tightened(Facts):
    """A lottery that satisfies a failure budget at all probabilities in boxes, and a lower bound.

    ``objective`` and ``failure_probability`` are upper bounds of the lottery's cost and failure at
    all probabilities. ``lower_bound`` is a lower bound of the worst cost of every policy that
    satisfies the budget.
    """

    policy: MixedPolicy
    objective: float  # each plan's worst cost until failure, weighted
    lower_bound: float
    failure_probability: float  # each plan's worst failure probability, weighted
    failure_price: float  # cost of reducing the worst failure probability by one unit
    prices: int  # prices of failure that were tried

    @property
    def gap(self) -> float:
        """Relative gap between the objective and the lower bound, which may remain above 0."""
        return two_sided_gap(self.objective, self.lower_bound)

    def tables(self) -> list[Table]:
        """Return the worst values of the lottery, the bound and the gap."""
        weights = ", ".join(f"{weight:.6g}" for weight in self.policy.weights)
        return [
            Table([
                ("cost until failure, at most", self.objective),
                ("lower bound", self.lower_bound),
                ("gap", f"{self.gap:.1e}"),
                ("failure, at most", self.failure_probability),
                ("failure price", self.failure_price),
                ("weights", weights),
            ])
        ]  # fmt: skip


@explained
def tighten(
    problem: Problem, box: Boxes, *, tolerance: float = 1e-9, time_limit: float | None = None
) -> Tightened:
    """Find a lottery that satisfies a failure budget at all probabilities in boxes.

    Computed by column generation over plans, which are deterministic policies. In each round the
    plan with the best worst case is computed at a price of failure, then the optimal lottery at the
    worst probabilities for this plan, which gives more plans and a bound. The next price is that of
    this lottery, or of the best lottery over all plans so far. Finally the plans of the best
    lottery are changed, in all states or in one, as long as this improves the lottery.

    Args:
        problem: ``MCMP`` with a failure budget.
        box: boxes of the problem's model.
        tolerance: relative gap at which to stop, and distance below which two prices count as
            equal.
        time_limit: seconds after which the best lottery so far is returned.

    Raises:
        ModelError: another criterion, no budget, or a share of the goal probability; and as in
            ``FinitePenalty`` over boxes: constraints, a horizon, a discount,
            ``give_up="dead_ends"``, or a charge that depends on the successor.
        InfeasibleError: every policy fails with more than the budget at some probabilities.
        OutOfTimeError: the time limit passed before there was a lottery.

    Example:
        >>> from ssp_lp import MCMP, SSP, Boxes, tighten
        >>> model = SSP.from_transitions(
        ...     {"road": {"fast": [(0.9, "home", 1.0), (0.1, "ditch", 1.0)],
        ...               "safe": [(1.0, "home", 3.0)]}, "ditch": {}},
        ...     goal={"home"}, dead_ends={"ditch"})
        >>> boxes = Boxes(model, low=[0.8, 0.0, 1.0], high=[1.0, 0.2, 1.0])
        >>> plan = tighten(MCMP(model, "road", failure_budget=0.05), boxes)
        >>> round(plan.objective, 9), round(plan.lower_bound, 9), plan.policy.weights.round(9)
        (2.5, 2.5, array([0.75, 0.25]))
    """
    check_problem(problem, "tighten")
    check_between_0_and_1("tolerance", tolerance)
    semantics, budget = problem.semantics, problem.failure_budget
    if budget is None or problem.reach_fraction is not None or not semantics.counts_cost_alone:
        raise ModelError("tighten takes MCMP with a failure budget: MCMP(..., failure_budget=0.05)")
    check_boxed(problem, box)
    with limited(time_limit, "a lottery was found"):
        pool = _safest(problem, box)
        with WithIncumbent():
            first = 0.0
            with suppress(InfeasibleError):  # the model itself may lie outside the boxes
                first = solve(problem).failure_price or 0.0
            for price in pool.prices(first, tolerance):
                _, decision, worst, _ = settled(box, replace(semantics, penalty=price))
                at_worst = solved_at(problem, box, worst, solve)
                pool.lower_bound = max(pool.lower_bound, at_worst.lower_bound)
                pool.adverse_price = at_worst.failure_price or 0.0
                pool.add(decision)
                for policy in as_lottery(at_worst.policy).policies:
                    pool.add(completed(policy, decision, pool.ends))
            pool.refine(tolerance)
        return pool.tightened()


@dataclass(eq=False)
class _Pool:
    """Plans (deterministic policies) with their worst cost and failure, and a lower bound."""

    problem: Problem
    box: Boxes
    ends: IntArray  # decisions that give up wherever a plan may, [states]
    charges: FloatArray  # of ending there, [states]
    surely_ends: BoolArray  # states from which these surely end, [states]
    plans: dict[tuple[float, float], Policy] = field(default_factory=dict)  # by their worst values
    lower_bound: float = 0.0
    adverse_price: float = 0.0  # of the last optimum at adverse probabilities
    tried: list[float] = field(default_factory=list)

    def add(self, decision: IntArray) -> None:
        """Add the plan with these decisions, [states], if its worst cost is finite."""
        policy = DeterministicPolicy(self.problem.model, decision)
        worst = worst_case(policy, self.problem, self.box)
        if np.isfinite(worst.objective):
            self.plans.setdefault((worst.objective, worst.failure_probability), policy)

    def lottery(self) -> MasterOptimum:
        """Return the best lottery over the plans."""
        cost, failure = np.array(list(self.plans)).T
        return secant(cost, failure, np.array([self.problem.failure_budget]))

    def prices(self, first: float, tolerance: float) -> Iterator[float]:
        """Yield prices of failure to try, until the gap is closed or no further price is new."""
        price = first
        while len(self.tried) < MOST_ROUNDS:
            self.tried.append(price)
            yield price
            best = self.lottery()
            if two_sided_gap(best.value, self.lower_bound) <= tolerance:
                return
            for price in (self.adverse_price, float(best.prices[0])):
                if all(abs(price - other) > tolerance * price for other in self.tried):
                    break
            else:
                return

    def refine(self, tolerance: float) -> None:
        """Add plans similar to those of the best lottery, as long as this improves the lottery."""
        value = np.inf
        while (best := self.lottery()).value < value and not is_late():
            plans, value = [*self.plans.values()], best.value * (1.0 - IMPROVEMENT)
            if two_sided_gap(best.value, self.lower_bound) <= tolerance:
                return
            for k in np.flatnonzero(best.weights).tolist():
                for decision in self._beside(plans[k], float(best.prices[0])):
                    self.add(decision)

    def _beside(self, plan: Policy, price: float) -> Iterator[IntArray]:
        """Yield the decisions of plans that differ from a given plan, [states] each.

        The first one takes every action that seems better than the plan's own. The others differ in
        one state each, the best first. An action's value is its worst cost plus the price times its
        worst failure, if the given plan is followed afterwards; each of the two has its own worst
        probabilities.
        """
        box, model, start = self.box, self.box.support, self.problem.start_mass
        reached = np.zeros(model.n_states, dtype=np.bool_)
        reached[boxed_chain(box, plan, start).chain.state] = True
        decision = np.where(reached, cast("DeterministicPolicy", plan).decision, self.ends)
        missed = (~model.goal_mask).astype(np.float64)
        acting = self.surely_ends & (decision != UNDECIDED)
        stops = np.flatnonzero(reached & (self.ends == GIVE_UP_CODE))
        charges = missed * self.charges
        cost = worst_loss(box, decision, acting, charges, charges)
        failure = worst_loss(box, decision, acting, missed, None)
        means = (worst_means(box, worth)[1] for worth in (
            model.costs + cost[model.successors], failure[model.successors]))  # fmt: skip
        own, failing = means
        code = np.append(np.arange(model.n_pairs), np.full(stops.size, GIVE_UP_CODE))
        state = np.append(model.pair_state, stops)
        then = np.append(own + price * failing, charges[stops] + price)
        gain = (cost + price * failure)[state] - then
        some = np.flatnonzero((acting & reached)[state] & (code != decision[state]))
        some = some[np.argsort(-gain[some], kind="stable")]
        every = np.array(decision)
        for k in some[gain[some] > 0.0][::-1].tolist():
            every[state[k]] = code[k]
        yield every
        for k in some[:_BESIDE].tolist():
            other = np.array(decision)
            other[state[k]] = code[k]
            yield other

    def tightened(self) -> Tightened:
        """Return the best lottery with its bound."""
        best, policies = self.lottery(), [*self.plans.values()]
        used, failures = np.flatnonzero(best.weights), np.array([*self.plans])[:, 1]
        return Tightened(
            MixedPolicy(tuple(policies[k] for k in used), best.weights[used]),
            best.value,
            min(self.lower_bound, best.value),
            float(best.weights @ failures),
            float(best.prices[0]),
            len(self.tried),
        )


def _safest(problem: Problem, box: Boxes) -> _Pool:
    """Return a pool with one plan: that of least worst failure probability.

    Raises:
        InfeasibleError: even this plan's worst failure probability exceeds the budget.
    """
    budget, (ends, charges, rank, _) = problem.failure_budget, ending(box, problem.semantics)
    loss, decision, *_ = settled(box, problem.semantics, safest=True)
    check_ends(problem.model, (problem.start_mass > 0.0) & np.isinf(loss))
    least = float(expected(problem.start_mass, loss))
    if budget is not None and least > budget + LEAST_BUDGET:
        every = "policy of finite worst cost" if rank.any() else "policy"
        raise InfeasibleError(
            f"every {every} fails with probability {least:.6g} at some probabilities in the boxes, "
            f"above the budget {budget:.6g}: raise the budget, or collect more counts",
            failure_budget=budget,
            least_failure=least,
        )
    pool = _Pool(problem, box, ends, charges, rank == 0)
    pool.add(decision)
    return pool
