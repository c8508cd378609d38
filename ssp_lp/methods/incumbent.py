"""A first incumbent for criteria that need accumulated costs: the best policy of case M.

A policy that satisfies the budget and all limits in case M satisfies them in every criterion on the
same model. Its objective is evaluated by the problem's own criterion. Case M takes a few pricing
calls, while a search on accumulated costs may not find its first policy in minutes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import hypot, isinf, sqrt
from typing import Any

import numpy as np
import scipy.sparse as sp

from ssp_lp.accumulated_cost.charges import TOTAL_COST
from ssp_lp.analysis.evaluation import Evaluation, evaluate
from ssp_lp.arrays import LEAST_BUDGET
from ssp_lp.column_generation.compiled_problem import (
    ATTAINABLE,
    CompiledExplicit,
    GoalFacts,
    checked_least_failure,
)
from ssp_lp.compiled.deadline import WithIncumbent, closing, seconds_left, until
from ssp_lp.errors import SSPError
from ssp_lp.methods.columns import refined_optimum
from ssp_lp.methods.refinement import Optimum, Proved
from ssp_lp.methods.rows import rows_optimum
from ssp_lp.options import SolveOptions
from ssp_lp.policies import MixedPolicy
from ssp_lp.policies.chain import policy_chain
from ssp_lp.policies.policy import as_lottery
from ssp_lp.problem import Problem, RestatedProblem
from ssp_lp.processes.failure_semantics import (
    AS_IS,
    RARE_GOAL,
    GoalShare,
    ObjectiveSense,
)
from ssp_lp.processes.goal_reach import greatest_goal_reach
from ssp_lp.solution import CUT_SHORT, Answer, Run, Solution, assembled

_ROUGH = SolveOptions(1e-3)  # tolerance in case M, whose policy is not optimal anyway
_NOTHING = 1e-290  # a smaller bound is 0
_VARIANCE = 1e-6  # rounding error of a standard deviation, relative to the mean
_MOMENTS = "its objective is a bound by mean and variance: the exact value takes longer"
_DEAREST = 1.0 - 1e-12  # factor of the least total that covers the rounding of its sums


@dataclass(eq=False)
class Incumbent:
    """The best policy of case M. Mutable: ``solution`` is None until it is found and evaluated."""

    stated: Problem
    deterministic: bool = False  # the policy must be deterministic
    policies: dict[bool, MixedPolicy | None] = field(default_factory=dict, init=False)
    optimum: Optimum[Any] | None = field(default=None, init=False)  # of case M
    solution: Solution | None = field(default=None, init=False)

    def find(self) -> Incumbent | None:
        """Find the incumbent if the problem has accumulated costs and time allows.

        Returns:
            This object, or None if no incumbent was found.
        """
        if self.solution is not None:
            return self
        if not self.stated.counts_totals:
            return None
        problem = self.stated.unrolled
        for at_least_failure in (False, True):  # the cheapest policy may fail always
            with WithIncumbent(), suppress(SSPError):  # the search raises it again
                if at_least_failure not in self.policies:
                    half = time.perf_counter() + 0.5 * seconds_left()
                    with until(half):  # the other half is for the evaluation
                        policy = self._cheapest_policy(problem, at_least_failure=at_least_failure)
                    self.policies[at_least_failure] = policy
                policy = self.policies[at_least_failure]
                if policy is not None and not (self.deterministic and len(policy.policies) > 1):
                    room = LEAST_BUDGET if at_least_failure else 0.0
                    counts_law = problem.semantics.counts_law
                    with closing():
                        judge = by_moments if counts_law else evaluate
                        self.solution = _incumbent_value(problem, policy, room, judge)
                    if counts_law:  # a bound until its law is known
                        self.solution = _incumbent_value(problem, policy, room)
            if self.solution is not None:
                return self
        return None

    def improving(self, other: Solution) -> Solution:
        """Return a stopped search's solution, with the incumbent's policy if that is better.

        The result has the prices and the value function of the search, and the tighter one of two
        bounds: that of the search, and that of the cheapest way to the goal.

        Args:
            other: the solution of the search.
        """
        if not self.stated.counts_totals:
            return other
        best, bound = self.solution or other, cheapest_way_bound(self.stated.unrolled)
        sign = 1.0 if other.upper_bound is None else -1.0
        if sign * other.objective <= sign * best.objective:
            best = other
        price = other.failure_price
        if price is not None and best.problem.ratio:  # price + ratio does not change
            price = max(price + other.objective - best.objective, 0.0)
        best = replace(
            best, failure_price=price, value_function=other.value_function, prices=other.prices
        )
        if other.upper_bound is not None:
            return replace(best, upper_bound=max(min(other.upper_bound, bound), best.objective))
        return replace(best, lower_bound=min(max(other.lower_bound, bound), best.objective))

    def _cheapest_policy(self, problem: Problem, *, at_least_failure: bool) -> MixedPolicy | None:
        """Return a nearly optimal lottery of case M within all limits; None if there are no limits.

        Args:
            problem: the problem.
            at_least_failure: whether only policies of least failure are feasible.
        """
        model, budget = problem.model, problem.failure_budget
        start = problem.start_mass
        semantics = replace(problem.semantics, measure=None)
        budget = None if at_least_failure else budget
        side = tuple(row for condition in problem.conditions for row in condition.rows)
        facts = GoalFacts(model, start, problem.discount)
        compiled = CompiledExplicit(facts, semantics, side, budget)
        if side:
            return rows_optimum(compiled, _ROUGH).policy
        if budget is None:
            return as_lottery(checked_least_failure(compiled, problem.failure_budget).policy)
        if budget >= 1.0:
            return None
        self.optimum = refined_optimum(compiled, budget, _ROUGH)
        return self.optimum.policy


def _incumbent_value(
    problem: Problem,
    policy: MixedPolicy,
    slack: float,
    judge: Callable[..., Evaluation] = evaluate,
) -> Solution | None:
    """Return a policy of case M as a solution of a problem.

    The result is None if the policy violates a limit or never reaches the goal.

    Args:
        problem: the problem.
        policy: the policy.
        slack: amount by which the failure may exceed the budget, in addition to rounding.
        judge: returns the exact evaluation of the policy, or a pessimistic one.
    """
    evaluation, budget = judge(policy, problem), problem.failure_budget
    failure = evaluation.limited_failure
    allowed = 1.0 if budget is None else max(budget * (1.0 + ATTAINABLE), budget + slack)
    if not np.isfinite(evaluation.objective) or failure > allowed:
        return None
    if broken_limit(problem, evaluation, ATTAINABLE):
        return None
    bound, sense, sign = cheapest_way_bound(problem), AS_IS, 1.0
    if problem.semantics.maximises:
        sense, sign = ObjectiveSense(0.0), -1.0
    reason = "a policy of case M, which the search did not improve in time"
    note = CUT_SHORT if judge is evaluate else f"{CUT_SHORT}; {_MOMENTS}"
    answer = Answer(policy, sign * evaluation.objective, sign * bound, failure, note=note)
    return assembled(problem, answer, Run("columns", reason, 0, 0.0), sense)


def by_moments(policy: MixedPolicy, problem: Problem) -> Evaluation:
    """Evaluate a policy pessimistically, by mean and variance of its total cost.

    Let the total cost C, given success, have mean m and variance s^2. The objective is replaced by
    the worst value among all distributions of C with these moments:

    - Tail mean or quantile: ``m + s sqrt(level / (1 - level))``. The tail mean is the least over z
      of ``z + E[(C - z)^+] / (1 - level)`` (Rockafellar and Uryasev 2000), and ``E[(C - z)^+]`` is
      at most ``(sqrt(s^2 + (z - m)^2) - (z - m)) / 2`` (Scarf 1958).
    - Expected charge: Scarf's bound, or for B > m Cantelli's ``Pr(C <= B) >= d^2 / (s^2 + d^2)``
      with d = B - m.

    This takes three systems of linear equations, however many values the total cost has.

    Args:
        policy: a lottery on the problem's model.
        problem: a problem with a measure of the law of costs.
    """
    model, semantics, risk = problem.model, problem.semantics, problem.semantics.risk
    asked = problem.start, True, problem.failure_budget, replace(semantics, measure=None)
    evaluation = evaluate(policy, RestatedProblem(model, *asked, problem.conditions))
    start, squares = problem.start_mass, 0.0
    for member, weight in zip(policy.policies, policy.weights.tolist(), strict=True):
        chain = policy_chain(model, member, start)
        goal_ahead, cost_ahead = chain.arriving()
        later = chain.cost * goal_ahead[chain.target] + 2.0 * cost_ahead[chain.target]
        square = chain.accumulate(chain.per_node(chain.cost * later), chain.alive)
        squares += weight * float(chain.start @ square)
    goal, mean = evaluation.goal_probability, evaluation.conditional_cost
    if goal == 0.0 or isinf(mean * mean):
        return replace(evaluation, objective=np.nan)
    spread = sqrt(max(squares / goal - mean**2, 0.0) + (_VARIANCE * mean) ** 2)
    if risk is not None:
        odds = risk.level / (1.0 - risk.level)
        return replace(evaluation, objective=mean + spread * sqrt(odds))
    charge = semantics.charge(problem.ratio) or TOTAL_COST
    if charge.slope > 0.0:  # at most the charge where the line begins, plus the excess beyond it
        line = charge.affine_from_total or 0.0
        beyond = 0.5 * (hypot(spread, line - mean) - (line - mean))
        first = float(charge.at(np.array([line]))[0])
        return replace(evaluation, objective=first + charge.slope * beyond)
    away = spread * np.append(0.0, np.geomspace(1e-2, 1e4, 601))
    if charge.affine_from_total is not None:
        away = np.append(away, max(charge.affine_from_total - mean, 0.0))
    in_time = away**2 / np.maximum(spread**2 + away**2, 1e-300)
    charged = in_time * charge.at(mean + away) + (1.0 - in_time) * charge.offset
    return replace(evaluation, objective=semantics.failing_value - goal * float(charged.min()))


def prove_by_cheapest_way(problem: Problem, evaluation: Evaluation) -> Proved:
    """Return the bound of the optimum by the cheapest way to the goal; it needs no search."""
    return Proved(evaluation.objective, cheapest_way_bound(problem), problem.failure_budget or 0.0)


def broken_limit(
    problem: Problem,
    evaluation: Evaluation,
    slack: float = 2.0 * ATTAINABLE,
    raised_bounds: Mapping[str, float] | None = None,
) -> str:
    """Return a message about the first limit that a policy violates, or an empty string.

    Args:
        problem: the problem.
        evaluation: evaluation of the policy.
        slack: tolerance, relative to the magnitude of the limit.
        raised_bounds: bounds, by name, that replace the stated ones.
    """
    raised_bounds = raised_bounds or {}
    for condition in problem.conditions:
        spent = evaluation.secondary_costs[condition.name]
        for each in condition.rows:
            row = each.by_digits
            taken, most = row.activity(spent), raised_bounds.get(row.name, row.bound)
            if taken > most + slack * max(row.size, _NOTHING):
                return f"the policy spends {taken:.12g} of {row.text!r}, {row.bound:.12g} allowed"
    goal, budget = evaluation.limited_goal, problem.failure_budget
    demanded = budget.required if isinstance(budget, GoalShare) else 0.0
    if demanded < RARE_GOAL and goal < demanded * (1.0 - slack):
        return f"the goal probability is {goal:.12g}, {demanded:.12g} required"
    return ""


def cheapest_way_bound(problem: Problem) -> float:
    """Return a bound of the optimum from the cost of the cheapest way to the goal.

    No run to the goal costs less than the cheapest way, and charges do not fall when the total
    grows. The result is a lower bound of a minimised objective (a cost given success, its quantile
    or tail mean), and an upper bound of a maximised one.

    Args:
        problem: a problem with a cost given success, or a measure of its law.
    """
    model, semantics = problem.model, problem.semantics
    start = problem.start_mass
    # the least cost of a way from the start to the goal; 0 if there is none
    begins = np.asarray(model.outcome_offsets)[model.pair_offsets].astype(np.int32)
    ways = model.costs, model.successors.astype(np.int32), begins
    graph = sp.csr_array(ways, shape=(model.n_states, model.n_states))
    totals = sp.csgraph.dijkstra(graph, indices=np.flatnonzero(start > 0.0), min_only=True)
    least_total = _DEAREST * float(totals[model.goal_mask].min(initial=np.inf))
    least_total = least_total if np.isfinite(least_total) else 0.0
    charge = float((semantics.charge(problem.ratio) or TOTAL_COST).at(np.array([least_total]))[0])
    if not semantics.maximises:
        return charge
    charge = min(charge, 0.0)
    greatest = float(start @ greatest_goal_reach(model).bound)
    return semantics.failing_value - charge * min(greatest, 1.0)
