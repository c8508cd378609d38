"""The result of ``solve``: the optimum, its proof, and the policy that attains it."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ssp_lp.analysis.evaluation import (
    Evaluation,
    cost_in_words,
    equivalent_randomised_policy,
    evaluate,
    failing_in_words,
    giving_up_in_words,
)
from ssp_lp.analysis.explanation import Explanation, explanation
from ssp_lp.analysis.what_if import Number, WhatIf, what_if
from ssp_lp.arrays import ROUNDED, FloatArray, IntArray, ReadOnlyCopies, read_only
from ssp_lp.column_generation.column import least_of, relative_gap
from ssp_lp.column_generation.compiled_problem import CompiledExplicit, GoalFacts
from ssp_lp.dynamic_programming.bellman import Work
from ssp_lp.dynamic_programming.evaluation import PROVED_OF_MANY
from ssp_lp.errors import ModelError, in_short
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.graph import dead_ends
from ssp_lp.model.report import ByName, Facts, Table
from ssp_lp.options import Status
from ssp_lp.policies import MixedPolicy, StochasticPolicy
from ssp_lp.policies.chain import reached_table
from ssp_lp.policies.cost_aware import CostAwarePolicy
from ssp_lp.policies.policy import UNDECIDED, Policy, as_lottery
from ssp_lp.policies.remembering import Default, acting_everywhere
from ssp_lp.policies.table import PolicyTable
from ssp_lp.problem import Problem, on_one_model, pulled_back
from ssp_lp.processes.conditions import FAILURE_ROW
from ssp_lp.processes.failure_semantics import (
    AS_IS,
    Aim,
    FailureSemantics,
    GiveUp,
    GoalShare,
    ObjectiveSense,
)
from ssp_lp.processes.past_failing import labelled_past_failing
from ssp_lp.processes.quantities import Quantity, objective_of
from ssp_lp.programs.occupation_measure import StateValues

_LEAST_LIMIT = 1.0  # least seconds for numbers computed later, if the call was shorter


@dataclass(frozen=True)
class Run:
    """Record of a method's run: its name, the reason for choosing it, and counts of its work."""

    method: str  # "columns", "lp", "game" or "deterministic"
    reason: str  # why this method was chosen, and what it did
    pricing_calls: int
    seconds: float
    work: Work = field(default_factory=Work)  # Bellman sweeps, and products with a policy's rows
    program: str = ""  # the linear program's own report, where one was solved
    time_limit: float | None = None  # seconds of the call, and of numbers computed later
    deterministic: bool = False  # whether the best policy that is not mixed was sought


@dataclass(frozen=True, eq=False, repr=False)
class Solution(Facts, ReadOnlyCopies):
    """The optimal value c*, a certified bound of it, and a lottery that attains the value.

    ``objective`` and ``budget_used`` are computed exactly from the policy on the augmented process.
    The other numbers about the policy are evaluated on the model on first use.
    """

    problem: Problem
    policy: MixedPolicy
    objective: float  # c*: the exact value of the policy
    lower_bound: float  # certified, of the optimum; if a probability is maximised, the attained one
    failure_price: (
        float | None
    )  # lambda >= 0, or the penalty; None: no price exists, with least failure
    value_function: FloatArray | None  # sub-solution: [process states], or [layers, nodes]
    budget_used: float  # failure of the policy (discounted, if that is limited), as measured
    run: Run
    note: str = ""
    status: Status = Status.OPTIMAL
    upper_bound: float | None = None  # of a greatest probability, certified; None for least costs
    prices: Mapping[str, float] = field(default_factory=dict)  # multiplier of each row, by name
    least_failure_bound: float | None = None  # certified, of every policy; with least failure only
    granted: Mapping[str, float] = field(default_factory=dict)
    """Bounds that only rounding makes infeasible: name -> least attainable value, used instead."""
    taken: Mapping[str, float] = field(default_factory=dict)
    """Values of the limited quantities by name, if the method measures them."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "prices", ByName(self.prices))

    @cached_property
    def evaluation(self) -> Evaluation:
        """Evaluation of the policy on the model, computed on first use.

        The computation may take as long as the time limit of ``solve``, or a second if that is
        longer.

        Raises:
            OutOfTimeError: it takes longer; ``evaluate(policy, problem)`` has no time limit.
        """
        limit = self.run.time_limit
        limit = None if limit is None else max(limit, _LEAST_LIMIT)
        return evaluate(self.policy, self.problem, time_limit=limit)

    @cached_property
    def values(self) -> StateValues:
        """Values of the states at the optimal prices: ``values["depot"]``.

        The value of a state is the least expected cost from there, with each limited quantity
        charged at its price (``prices``); in case S, c* times the goal probability is subtracted.
        Actions have values and advantages, too. The problem's linear program
        (:meth:`ssp_lp.formulation.Formulation.program`) is built to compute them.

        Raises:
            ModelError: the criterion is not a linear program, or the problem's class has none.
        """
        values: StateValues = self.problem.program().values_at(self.prices, self.objective)
        return values

    def policy_table(self) -> PolicyTable:
        """Return the decisions that the solution's policy reaches from the start, nearest first.

        ``solution.policy.table()`` has the decisions of all states.

        Raises:
            ModelError: the policy is of a class whose memory is not known.
        """
        return reached_table(self.policy, self.problem.start_mass)

    @explained
    def explain(self, state: Hashable, cost_paid: float | None = None) -> Explanation:
        """Compare the actions of a state: cost, failure, value at the optimal prices, and excess.

        Args:
            state: a state of the model or, with a horizon, of the product on (state, steps taken).
            cost_paid: in case S the cost paid before; None: the least one in the program.

        Raises:
            ModelError: the criterion is not a linear program, or the state has no decision.

        Example:
            >>> from ssp_lp import MCMP, SSP, solve
            >>> routes = {"alley": [(0.9, "home", 4.0), (0.1, "wreck", 2.0)],
            ...           "road": [(0.99, "home", 9.0), (0.01, "wreck", 5.0)]}
            >>> model = SSP.from_transitions({"depot": routes, "wreck": {}}, goal={"home"},
            ...                              treat_actionless_as_dead_ends=True)
            >>> print(solve(MCMP(model, "depot", failure_budget=0.05)).explain("depot"))
            depot: value = cost + 57.3333 x failure
              action   taken  cost  failure    value  excess
              alley   0.4444   3.8      0.1  9.53333       0
              road    0.5556  8.96     0.01  9.53333       0
        """
        ratio = self.objective if self.problem.ratio else 0.0
        randomised = self.randomised_policy
        return explanation(self.values, self.prices, ratio, randomised, state, cost_paid)

    @explained
    def what_if(
        self,
        by: Callable[[Number], Hashable] | None = None,
        *,
        time_limit: float | None = None,
    ) -> WhatIf:
        """Return the derivatives of the optimum by each probability, cost, bound and start.

        They are computed from visits and values of the problem's program, which is solved for this
        purpose. If several lotteries are optimal, the left and the right derivative may differ:
        they are the extremes over all optimal lotteries. If several prices are optimal, the program
        is solved six more times for each number.

        Args:
            by: maps a :class:`Number` to a group. The numbers of a group change together, since one
                quantity may stand in many places. A number that is mapped to None is left out.
            time_limit: seconds, after which the remaining derivatives are None.

        Raises:
            ModelError: another criterion than MCMP, S3P, MaxProb, MinCost and FinitePenalty.
            OutOfTimeError: the program is not solved within ``time_limit``.
            SolverError: the program is too large.

        Example:
            >>> from ssp_lp import MCMP, SSP, solve
            >>> routes = {"alley": [(0.9, "home", 4.0), (0.1, "wreck", 4.0)],
            ...           "road": [(0.99, "home", 9.0), (0.01, "wreck", 9.0)]}
            >>> model = SSP.from_transitions({"depot": routes, "wreck": {}}, goal={"home"},
            ...                              treat_actionless_as_dead_ends=True)
            >>> print(solve(MCMP(model, "depot", failure_budget=0.05)).what_if())
            the optimum 6.77777778 moves with each number by
              number                               at  derivative   matters
              cost of road in depot                 9    0.555556         5
              failure budget                     0.05    -55.5556   2.77778
              chance of wreck by alley in depot   0.1     24.6914   2.46914
              cost of alley in depot                4    0.444444   1.77778
              chance of wreck by road in depot   0.01     30.8642  0.308642
        """
        own = (p for p in self.policy.policies if isinstance(p, CostAwarePolicy))
        cap = max((p.last_total for p in own), default=0.0)
        return what_if(self.problem, by, time_limit=time_limit, cap=cap)

    @explained
    def policy_everywhere(
        self, default: Default | None = None, *, least_after: Quantity | None = None
    ) -> MixedPolicy:
        """Return the policy extended to every state that has actions.

        Where the plan has no decision, the policy takes the best action at the optimal price of
        failing, with costs counted as in case M and without giving up. If there is no price, it
        takes the action of least failure. These actions are computed on first use.
        :func:`ssp_lp.acting_everywhere` describes the actions after giving up and in dead-ends.

        Args:
            default: takes precedence over these actions: an action, for all states that have it,
                ``{state: action}``, or a policy without memory; None: no default.
            least_after: quantity, such as ``end_probability("crash")``, which actions after giving
                up and in dead-ends minimise without changing the plan.

        Raises:
            ModelError: an unknown state or action, or a quantity that cannot change after failing.
        """
        later = None if least_after is None else _least_after(self.problem.model, least_after)
        return acting_everywhere(self.policy, default, self._greedy, later)

    @cached_property
    def _greedy(self) -> IntArray:
        """Best pair of each state at the price of failing; negative codes: none, [states]."""
        model, semantics = self.problem.model, self.problem.semantics
        live = ~(dead_ends(model) | model.goal_mask)
        if not live.any():
            return np.full(model.n_states, UNDECIDED)
        pays = FailureSemantics(GiveUp.DEAD_ENDS, semantics.charge_failing_step)
        compiled = CompiledExplicit(GoalFacts(model, live / live.sum()), pays)
        price = None if semantics.aim is not Aim.LEAST_COST else self.failure_price
        if price is None or price == np.inf:
            best = compiled.least_failure().policy
        else:
            pricing = compiled.pricing()
            best = pricing.policy(
                pricing.minimise(price + (self.objective if self.problem.ratio else 0.0))
            )
        states = np.arange(model.n_states)
        return best.branches(states, np.zeros_like(states)).pair

    @property
    def gap(self) -> float:
        """Relative gap between the objective and its certified bound.

        If failure must be least, it is at least ``failure_gap``.
        """
        if self.upper_bound is not None:
            gap = relative_gap(self.upper_bound, self.objective)
        else:
            gap = relative_gap(self.objective, self.lower_bound)
        return gap if self.least_failure_bound is None else max(gap, self.failure_gap)

    @property
    def failure_gap(self) -> float:
        """Relative gap between the goal probability and its upper bound; 0 with a failure budget.

        The bound of the objective holds for policies of least failure. If this gap is not 0,
        another policy may fail less.
        """
        return gap_of_least_failure(self.budget_used, self.least_failure_bound)

    @property
    def failure_probability(self) -> float:
        """The solution's exact, undiscounted probability of never reaching the goal."""
        return self.evaluation.failure_probability

    @property
    def goal_probability(self) -> float:
        """The solution's exact, undiscounted probability of reaching the goal."""
        return self.evaluation.goal_probability

    @property
    def secondary_costs(self) -> Mapping[str, float]:
        """Values of the limited quantities by name, discounted if the problem is."""
        return self.evaluation.secondary_costs

    @property
    def discounted_failure(self) -> float | None:
        """The paper's discounted failure (section 2.5); None if the problem has no discount."""
        return self.evaluation.discounted_failure

    @property
    def expected_cost(self) -> float:
        """The solution's undiscounted expected cost until failing or the goal."""
        return self.evaluation.expected_cost

    @property
    def conditional_cost(self) -> float:
        """The solution's undiscounted expected cost given that the goal is reached."""
        return self.evaluation.conditional_cost

    @property
    def budget_slope(self) -> float | None:
        """Decrease of the optimum c* per unit of the failure budget: -d c* / d budget.

        In case M this is the price of failure minus the penalty, if there is one; in case S it is
        the price of failure divided by 1 - budget. If a probability is maximised, the value is the
        increase of the optimum. None without a price, or if the penalty is infinite.
        """
        price, budget = self._multiplier, self.problem.failure_budget
        if price is None or budget is None or not self.problem.ratio:
            return price
        return 0.0 if price == 0.0 else price / (1.0 - budget) if budget < 1.0 else float("inf")

    @property
    def _multiplier(self) -> float | None:
        """Multiplier of the failure row: the failure price minus the penalty."""
        penalty = self.problem.semantics.penalty
        if self.failure_price is None or penalty == float("inf"):
            return None
        return self.failure_price - penalty

    @property
    def adversary_weight(self) -> float | None:
        """Weight alpha* of the objective's MDP in the paper's game (section 3.2), in [0, 1].

        Case M: c* / (c* + price * budget). Case S: c* (1 - e) / (c* (1 - e) + (c* + price) e),
        where e is the budget, or the policy's failure if the price is 0. None where
        ``budget_slope`` is None, and for problems that the game does not support: with constraints,
        or functions of the distribution of costs.
        """
        price, budget = self._multiplier, self.problem.failure_budget
        unknown = self.problem.has_rows or self.problem.semantics.counts_law
        if price is None or budget is None or unknown:
            return None
        mine, other = self.objective, price * budget
        if self.problem.ratio:
            spent = budget
            if price == 0.0:
                surrogate = self.evaluation.discounted_failure
                spent = self.failure_probability if surrogate is None else surrogate
            mine, other = self.objective * (1 - spent), (self.objective + price) * spent
        return mine / (mine + other) if mine + other > 0 else 1.0

    @property
    def method(self) -> str:
        """Name of the method that found the solution."""
        return self.run.method

    @property
    def seconds(self) -> float:
        """Wall-clock seconds that ``solve`` took for the solution."""
        return self.run.seconds

    @cached_property
    def randomised_policy(self) -> StochasticPolicy | MixedPolicy:
        """The stationary randomised policy that is equivalent to the lottery (section 2.2).

        It visits each augmented state as often as the lottery does, in expectation. These are the
        model's states in case M, and (state, accumulated cost) in case S. If totals are rounded to
        levels, its cost differs from the lottery's by rounding. With a horizon it also remembers
        the time.
        """
        policy = equivalent_randomised_policy(self.policy, self.problem)
        if policy.model is self.problem.model:
            return policy
        return pulled_back(as_lottery(policy), self.problem)

    def __repr__(self) -> str:
        """Return a line with the problem, the objective, its gap, the failure and the method."""
        failure = "failure" if self.problem.discount is None else "discounted failure"
        return (
            f"Solution({self._title}: objective {self.objective:.9g}, gap {self.gap:.1e}, "
            f"{failure} {self.budget_used:.6g}, method {self.method})"
        )

    @property
    def _title(self) -> str:
        """Title of a solution's summary: criterion, limit on failing, discount."""
        discount = self.problem.discount
        setting = "exact" if discount is None else f"discount {discount:g}"
        horizon = self.problem.horizon
        within = "" if horizon is None else f", within {horizon:,} step{'s' * (horizon > 1)}"
        return f"{type(self.problem).__name__}, {self._limit_on_failing}{within}, {setting}"

    def tables(self) -> list[Table]:
        """Return a table of objective, bounds, ways of failing, costs, prices and method."""
        failing, limits = failing_in_words(self.evaluation.ends), self.secondary_costs.items()
        bound = self.upper_bound
        side, bound = ("lower", self.lower_bound) if bound is None else ("upper", bound)
        shares = self.policy.weights
        lottery = f"lottery over {len(shares)} ({', '.join(f'{share:.4f}' for share in shares)})"
        facts = [
            ("objective c*", self.objective),
            (f"{side} bound", bound, f"(relative gap {self.gap:.1e})"),
            ("failure probability", self.failure_probability),
            ("least failure", unproved_failure(self.budget_used, self.least_failure_bound)),
            ("failing", failing),
            ("giving up", self._giving_up()),
            ("discounted failure", self.discounted_failure),
            ("cost given success", cost_in_words(self.conditional_cost)),
            ("cost until failure", self.expected_cost),
            ("costs", "" if self.problem.model.costs.any() else _ALL_FREE),
            ("failure price", self.failure_price),
            *((name, spent, f"(price {self.prices.get(name, 0.0):.6g})") for name, spent in limits),
            ("policy", lottery if len(shares) > 1 else "no lottery"),
            ("method", f"{self.method}: {self.run.reason}, {self.seconds:.3g} s"),
            ("status", "" if self.status is Status.OPTIMAL else str(self.status)),
            ("note", self.note),
        ]  # fmt: skip
        return [Table(facts, title=self._title, digits={"objective c*": 9, f"{side} bound": 9})]

    def _giving_up(self) -> str:
        """Return the summary's row on giving up by choice: share, first state and remedy."""
        share = self.evaluation.ends.get("gave_up", 0.0)
        if share <= 0.0 or self.problem.semantics.give_up is GiveUp.DEAD_ENDS:
            return ""
        place = giving_up_in_words(self.policy, self.problem, share)
        words = f"{share:.6g} by choice, {place}" if place else f"{share:.6g} by choice"
        return f"{words}; give_up='dead_ends' forbids it"

    @property
    def _limit_on_failing(self) -> str:
        """Limit on failing, or the criterion's measure, in words."""
        budget, semantics = self.problem.failure_budget, self.problem.semantics
        limit = "least failure" if budget is None else f"failure budget {budget:g}"
        if semantics.measure is not None:
            asked = semantics.measure.words
            return asked if budget is not None and budget >= 1.0 else f"{asked}, {limit}"
        if semantics.aim is not Aim.LEAST_COST:
            return f"{str(semantics.aim).replace('_', ' ')} probability"
        if semantics.penalty > 0.0:
            return "no failure" if semantics.forbids_failing else f"penalty {semantics.penalty:g}"
        return limit


def _least_after(model: SSP, quantity: Quantity) -> IntArray:
    """Return for each state the pair that minimises a quantity after failing, [states].

    UNDECIDED where all pairs are equal.

    Raises:
        ModelError: the quantity counts nothing after failing, or nothing can follow failing.
    """
    live, failing = ~model.goal_mask, FailureSemantics()
    asked = objective_of(model, live / max(live.sum(), 1), quantity)
    label = labelled_past_failing(model, (), asked, failing, ratio=False, discount=None)
    if label is None:
        raise ModelError(
            "the quantity counts nothing that may come after failing: use an end probability, or "
            "visits or a cost with through_failure=True"
        )
    begins = label.after & ~label.ended & label.finite[0]
    decision = np.full(model.n_states, UNDECIDED)
    decision[model.pair_state[label.staying_after]] = label.staying_after
    if begins.any():
        start = begins / begins.sum()
        least = objective_of(label, start, quantity).minimised()
        facts = GoalFacts(label, start)
        pricing = CompiledExplicit(facts, failing, objective=least).pricing()
        states = np.flatnonzero(begins)
        best = pricing.policy(pricing.minimise(0.0)).branches(states, np.zeros_like(states))
        here, acts = label.original_state[states], best.pair >= 0
        decision[here[acts]] = label.original_pair[best.pair[acts]]
    return decision


_ALL_FREE = "none: every step costs 0, so that policies differ only in failing"


@dataclass(frozen=True, eq=False)
class Answer:
    """A method's answer, in terms of the quantity that the method minimises."""

    policy: MixedPolicy | Policy
    value: float
    bound: float  # of all policies that satisfy the limits; at most the value
    failure: float  # of the policy
    price: float | None = None  # multiplier of the failure row; None if it has none
    values: FloatArray | None = None  # the checked sub-solution
    prices: Mapping[str, float] = field(default_factory=dict)  # multipliers of all rows, by name
    note: str = ""
    least_failure_bound: float | None = None  # of every policy's failure, with least failure
    granted: Mapping[str, float] = field(default_factory=dict)  # bounds that count, if raised
    taken: Mapping[str, float] = field(default_factory=dict)  # of the limited rows, if measured


def assembled(problem: Problem, found: Answer, run: Run, sense: ObjectiveSense = AS_IS) -> Solution:
    """Return the solution of a problem as stated, given a method's answer.

    Args:
        problem: the problem.
        found: the method's answer, in terms of the quantity that it minimises.
        run: the method and its work.
        sense: relation between the minimised quantity and the objective of the problem.

    Raises:
        SolverError: the bound lies above the value by more than rounding.
    """
    policy = found.policy
    if not isinstance(policy, MixedPolicy):
        policy = MixedPolicy((policy,), np.ones(1))
    bound = sense.bound_or_value(found.value, least_of(found.bound, found.value))
    objective, limit = sense.stated(found.value), sense.stated_bound(bound)
    maximised, prices = sense.constant is not None, found.prices
    if not prices and found.price is not None and not problem.semantics.forbids_failing:
        prices = {FAILURE_ROW: found.price}
    return Solution(
        problem=problem,
        policy=policy,
        objective=objective,
        lower_bound=objective if maximised else limit,
        failure_price=None if found.price is None else found.price + problem.semantics.penalty,
        value_function=None if found.values is None else read_only(found.values),
        budget_used=found.failure,
        run=run,
        note=found.note,
        upper_bound=max(limit, objective) if maximised else None,
        prices=prices,
        least_failure_bound=found.least_failure_bound,
        granted=found.granted,
        taken=found.taken,
    )


def as_solved(solution: Solution, verb: str) -> Solution:
    """Return a solution whose policy and problem are restated on the model that was solved.

    This is the model of the unrolled problem; ``verb`` names the function that was called, for
    errors.

    Raises:
        ModelError: the argument is not a Solution.
    """
    if not isinstance(solution, Solution):
        raise ModelError(f"{verb}() takes a solution from solve(problem), not {in_short(solution)}")
    policy, problem = on_one_model(solution.policy, solution.problem, verb)
    return replace(solution, policy=policy, problem=problem)


def gap_of_least_failure(failure: float, bound: float | None) -> float:
    """Return the relative gap between a goal probability and its upper bound, 0 within rounding.

    Args:
        failure: failure probability of the policy.
        bound: lower bound of every policy's failure; None: the problem does not ask for least
            failure.
    """
    proved = failure if bound is None else bound
    return relative_gap(1.0 - proved, 1.0 - failure) if failure - proved > ROUNDED else 0.0


def unproved_failure(failure: float, bound: float | None) -> str:
    """Return the interval of the least failure in words; empty if it is proved to rounding."""
    if bound is None or gap_of_least_failure(failure, bound) <= PROVED_OF_MANY:
        return ""
    return f"between {bound:.9g} and {failure:.9g}, not proved further"


CUT_SHORT = "stopped before the tolerance was met; the gap is still certified"
"""Note on every search that ran out of time, or was interrupted."""


def remarks(problem: Problem, granted: float, finished: bool) -> str:
    """Return notes on a solution: a budget raised to the least failure, a search cut short."""
    budget, notes = problem.failure_budget, [CUT_SHORT] * (not finished)
    if budget is not None and granted > budget and not isinstance(budget, GoalShare):
        below = f"{granted - budget:.1e} below the least failure"
        notes.insert(0, f"the budget lies {below} and counts as equal to it")
    return "; ".join(notes)
