"""Semantics of failure: where a policy may give up, and what failing costs.

The module also checks start distributions and budgets, and gives the coefficients of costs and
arrivals at the pairs of an augmented process.
"""

from __future__ import annotations

import enum
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, cast

import numpy as np

from ssp_lp.accumulated_cost.charges import (
    TOTAL_COST,
    Charge,
    CostQuantileOf,
    Measure,
    TailMeanOf,
)
from ssp_lp.arrays import (
    LEAST_BUDGET,
    MACHINE_EPSILON,
    PROBABILITY_SUM,
    ROUNDED,
    BoolArray,
    FloatArray,
    segment_minima,
)
from ssp_lp.errors import (
    Argument,
    ModelError,
    as_percentage,
    check_between_0_and_1,
    check_flag,
    in_short,
    is_number,
    wrong_argument,
)
from ssp_lp.model import SSP
from ssp_lp.model.graph import attention_pairs, attention_states, hopeless_states, pairs_into
from ssp_lp.model.product import ProductSSP
from ssp_lp.processes.live_rows import cost_means, costless_pairs, successor_means
from ssp_lp.processes.quotient import Quotient

if TYPE_CHECKING:
    from ssp_lp.accumulated_cost.cost_law import CostLaw
    from ssp_lp.processes.conditions import UpperRow


class GiveUp(enum.StrEnum):
    """States in which a policy of case M may give up (mathematics, section 2).

    - ``ANYWHERE``: in every state, as in the linear program of Trevizan et al. (2017).
    - ``ATTENTION``: only in attention states, from which the goal can surely be avoided (paper,
      section 2.4).
    - ``DEAD_ENDS``: nowhere; a run pays until it enters a dead-end, as in Storm.
    """

    ANYWHERE = "anywhere"
    ATTENTION = "attention"
    DEAD_ENDS = "dead_ends"


class Aim(enum.StrEnum):
    """Aim of a criterion: least cost, or greatest or least goal probability."""

    LEAST_COST = "least_cost"
    GREATEST_GOAL = "greatest_goal"
    LEAST_GOAL = "least_goal"


@dataclass(frozen=True)
class FailureSemantics:
    """Semantics of an episode: where a policy may give up, what failing costs, and the objective.

    The penalty is paid for failing, in addition to the cost until then; with a discount it is paid
    for the discounted failure. An infinite penalty forbids failing: only policies that reach the
    goal surely are feasible. A measure, such as a quantile, replaces the mean of the total cost of
    successful runs.
    """

    give_up: GiveUp = GiveUp.ATTENTION
    charge_failing_step: bool = False
    penalty: float = 0.0
    aim: Aim = Aim.LEAST_COST
    measure: Measure | None = None

    def __post_init__(self) -> None:
        check_flag("charge_failing_step", self.charge_failing_step)

    @property
    def forbids_failing(self) -> bool:
        """Whether only policies that reach the goal surely are feasible."""
        return self.penalty == np.inf

    @property
    def counts_law(self) -> bool:
        """Whether a measure of the distribution of the total cost replaces its mean."""
        return self.measure is not None

    @property
    def risk(self) -> CostQuantileOf | TailMeanOf | None:
        """The measure of risk: a quantile or a tail mean, which needs several programs; or None."""
        if self.measure is None or self.measure.is_expectation:
            return None
        return cast("CostQuantileOf | TailMeanOf", self.measure)

    def value_of_law(self, law: CostLaw) -> float:
        """Return the measure (the mean, if there is none) of a law of costs of successful runs."""
        return law.conditional_mean if self.measure is None else self.measure.of(law)

    @property
    def failing_value(self) -> float:
        """Value that the measure gives to a run that fails; 0 without a measure."""
        return 0.0 if self.measure is None else self.measure.failing

    @property
    def maximises(self) -> bool:
        """Whether the measure is maximised."""
        return self.measure is not None and self.measure.maximised

    def charge(self, ratio: bool) -> Charge | None:
        """Return the charge of a run's total cost at the goal.

        None in case M, unless the problem minimises a measure such as a quantile or a tail mean.

        Args:
            ratio: whether the objective is a cost given success (case S).
        """
        if self.measure is not None:
            return self.measure.charge
        return TOTAL_COST if ratio else None

    @property
    def sense(self) -> ObjectiveSense:
        """Relation between the minimised value and the stated objective.

        It is meaningless if a quantity is the objective.
        """
        if self.aim is Aim.GREATEST_GOAL:
            return ObjectiveSense(0.0)
        return ObjectiveSense(self.failing_value) if self.maximises else AS_IS

    @property
    def counts_cost_alone(self) -> bool:
        """Whether only a budget limits failure: there is no penalty, aim or measure."""
        return self.penalty == 0.0 and self.aim is Aim.LEAST_COST and not self.counts_law


_MOST_NAMED = 3  # most states of a start in an error


@dataclass(frozen=True)
class ObjectiveSense:
    """Relation between the value that is minimised and the stated objective.

    They differ, for example, if the stated objective is a maximum.
    """

    constant: float | None = None  # a maximised objective is this minus the minimised value
    shift: float = 0.0  # added to the charge of every episode, so that no charge is negative
    offset: float = 0.0  # the minimised value minus the stated objective

    def stated(self, value: float) -> float:
        """Return the stated objective that belongs to a minimised value."""
        return value - self.offset if self.constant is None else self.constant - value

    def stated_bound(self, bound: float) -> float:
        """Return the bound of the stated objective that a bound of the minimised value implies.

        If rounding affects it, it is rounded down for a minimum and up for a maximum.
        """
        worth = self.stated(bound)
        if self.constant is None:
            return worth if worth + self.offset == bound else float(np.nextafter(worth, -np.inf))
        return worth if self.constant - worth == bound else float(np.nextafter(worth, np.inf))

    def bound_or_value(self, value: float, bound: float, paid: float = 0.0) -> float:
        """Return the bound, or the value if the two differ by rounding only.

        Args:
            value: minimised value of a lottery.
            bound: lower bound of the minimised value of every lottery.
            paid: sum of price times bound over the rows, whose rounding affects a bound by duals.
        """
        taken = abs(self.offset if self.constant is None else self.constant)
        taken = max(taken, paid) if taken > 0.0 else 0.0  # 0 if the objective is not a difference
        return value if abs(value - bound) <= 2.0 * ROUNDED * taken else bound


AS_IS = ObjectiveSense()


def survival_of(discount: float | None) -> float:
    """Return the factor of every transition probability: the discount, or 1 without one."""
    return 1.0 if discount is None else discount


def parse_give_up(value: str | GiveUp) -> GiveUp:
    """Convert a word to :class:`GiveUp`; raise :class:`ModelError` if it is unknown."""
    try:
        return GiveUp(value)
    except ValueError as error:
        choices = ", ".join(repr(str(g)) for g in GiveUp)
        raise wrong_argument("give_up", f"be one of {choices}", value) from error


def dead_end_charges(
    model: SSP, dead: BoolArray, semantics: FailureSemantics, costs: FloatArray | None = None
) -> FloatArray:
    """Return the charge of entering each dead-end, [states].

    With ``charge_failing_step`` it is the least expected cost of an action of the dead-end. It is 0
    for dead-ends without actions and for other states.

    Args:
        model: the model.
        dead: dead-ends, [states].
        semantics: whether failing is charged.
        costs: expected stage costs, [pairs]; None: computed here.
    """
    if not semantics.charge_failing_step:
        return np.zeros(model.n_states)
    least = segment_minima(cost_means(model) if costs is None else costs, model.pair_offsets)
    return np.where(dead & np.isfinite(least), least, 0.0)


def give_up_charges(
    model: SSP,
    wandering: BoolArray,
    semantics: FailureSemantics,
    costs: FloatArray | None = None,
) -> FloatArray:
    """Return the charge of giving up in each state, [states]; infinite where this is not allowed.

    Args:
        model: the model.
        wandering: states of zero-cost end components, where staying for ever is free, [states].
        semantics: where giving up is allowed and whether it is charged.
        costs: expected stage costs, [pairs]; None: computed here.
    """
    if (label := model.failure_label) is not None:  # the product says where giving up is allowed
        allowed = label.stops | label.after | np.append(label.is_open, label.is_open)
    else:
        allowed = giving_up_states(model, semantics.give_up)
    charge = np.where(allowed, 0.0, np.inf)
    if semantics.charge_failing_step and allowed.any():
        costs = cost_means(model) if costs is None else costs
        if label is not None:
            costs = np.where(label.priced, costs, np.inf)
        elif semantics.give_up is GiveUp.ATTENTION:
            costs = np.where(attention_pairs(model, allowed), costs, np.inf)
        least = segment_minima(costs, model.pair_offsets)
        charge = np.where(allowed & (np.isfinite(least) | (label is None)), least, charge)
    charge[wandering] = 0.0
    return charge


def giving_up_states(model: SSP, give_up: GiveUp, usable: BoolArray | None = None) -> BoolArray:
    """Return a mask of the states in which giving up is allowed, dead-ends included, [states].

    Args:
        model: the model.
        give_up: where a policy may give up.
        usable: pairs that attain the least failure, [pairs]. If given, a policy may take only these
            pairs, and may give up only in states without such a pair.
    """
    if (label := model.failure_label) is not None:
        usable = np.zeros(model.n_pairs, dtype=np.bool_) if usable is None else usable
        acting = np.bincount(model.pair_state[usable & label.finite[1]], minlength=model.n_states)
        return np.asarray(label.stops & (acting == 0))
    if give_up is GiveUp.DEAD_ENDS or usable is not None:
        return np.zeros(model.n_states, dtype=np.bool_)
    return ~model.goal_mask if give_up is GiveUp.ANYWHERE else attention_states(model)


def start_distribution(model: SSP, start: Hashable | Mapping[Hashable, float]) -> FloatArray:
    """Return the start distribution over states, [states].

    Args:
        start: the label of a state, or ``{label: probability}``.

    Raises:
        ModelError: unknown state, negative probability, or a sum that is not one.
    """
    if isinstance(start, (list, set, np.ndarray)):
        hint = "; several states are written dict(zip(states, probabilities))"
        if isinstance(start, np.ndarray):
            hint += ", a state tuple(array.tolist())"
        raise wrong_argument("start", "be a state or {state: probability}", start, hint)
    weights = start if isinstance(start, Mapping) else {start: 1.0}
    distribution = np.zeros(model.n_states)
    for state, probability in weights.items():
        if not is_number(probability):
            given = in_short(probability)
            raise ModelError(f"start probability of state {state!r} must be a number, not {given}")
        if not 0.0 <= float(probability) <= 1.0 + 1e-12:
            raise ModelError(f"start probability {probability!r} of state {state!r}: not in [0, 1]")
        distribution[model.index_of(state, "start")] += float(probability)
    total = float(distribution.sum())
    if abs(total - 1.0) > PROBABILITY_SUM:
        raise ModelError(f"start probabilities sum to {total:.12g}, not to 1")
    return distribution / total


class GoalShare(float):
    """A failure budget that is 1 minus a demanded goal probability.

    If the demanded probability is very small, the budget is rounded to 1. The object keeps the
    exact demanded probability, which :func:`demanded_goal` returns.
    """

    required: float

    def __new__(cls, demanded: float) -> GoalShare:
        """Return the budget 1 - demanded, for a demanded goal probability in [0, 1]."""
        budget = super().__new__(cls, 1.0 - demanded)
        budget.required = demanded
        return budget

    def __getnewargs__(self) -> tuple[float]:
        """Return the arguments from which copies and pickles are made."""
        return (self.required,)


def required_goal(budget: float) -> float:
    """Return the goal probability that a failure budget demands: 1 - budget.

    The result is exact if the budget is a ``GoalShare``.
    """
    return budget.required if isinstance(budget, GoalShare) else 1.0 - budget


RARE_GOAL = 1e-3
"""Demanded goal probability below which the goal replaces failure in the rewards.

For larger goal probabilities 1 - failure has 13 correct digits, and failure itself may be rare.
"""


def goal_out_of_reach(model: SSP, start: FloatArray) -> str:
    """Return a message if no policy reaches the goal from the start; else an empty string.

    Args:
        model: the model.
        start: distribution over its states, [states].
    """
    begins = start.nonzero()[0]
    if not hopeless_states(model)[begins].all():
        return ""
    named = [model.states[k] for k in begins[:_MOST_NAMED].tolist()]
    while isinstance(model, ProductSSP) and model.is_hidden:  # as the user calls them
        named, model = [label for label, _ in named], model.original
    names = " or ".join(repr(label) for label in named)
    return f"the goal cannot be reached from {names}{' or ...' * (begins.size > len(named))}"


def check_penalty(penalty: float) -> None:
    """Check the penalty of failing.

    Raises:
        ModelError: it is not a positive number, or is infinite.
    """
    if not is_number(penalty) or not 0.0 < penalty < float("inf"):
        hint = "; MinCost forbids failing"
        raise wrong_argument("penalty", "be a positive number", penalty, hint)


def check_failure_setting(
    failure_budget: float | None,
    discount: float | None,
    reach_fraction: float | None = None,
    charge_failing_step: object = False,
) -> None:
    """Check the budget, discount, share, and the charge of the failing step.

    Raises:
        ModelError: a budget or a share outside [0, 1], a budget together with a share, a discount
            outside (0, 1), least failure together with a discount, or a charge that is not a bool.
    """
    check_flag("charge_failing_step", charge_failing_step)
    budgets = {"failure_budget": failure_budget, "reach_fraction": reach_fraction}
    for name, value in {**budgets, "discount": discount}.items():
        if value is not None and (isinstance(value, bool) or not isinstance(value, Real)):
            is_list = isinstance(value, (list, tuple, np.ndarray))
            hint = "; sweep(criterion, ...) states a problem for each of several" if is_list else ""
            raise wrong_argument(name, "be a number or None", value, hint)
    if reach_fraction is not None and failure_budget is not None:
        either = Argument("failure_budget"), " or ", Argument("reach_fraction")
        raise ModelError("give ", *either, ", not both: each determines the other")
    if reach_fraction is not None and not 0.0 <= reach_fraction <= 1.0:
        hint = as_percentage(reach_fraction)
        raise wrong_argument("reach_fraction", "lie between 0 and 1", reach_fraction, hint)
    if failure_budget is not None and not -LEAST_BUDGET <= failure_budget <= 1.0 + LEAST_BUDGET:
        hint = as_percentage(failure_budget)
        raise wrong_argument("failure_budget", "be a probability", failure_budget, hint)
    if discount is not None:
        check_between_0_and_1("discount", discount, "; leave it out for the exact setting")
    if failure_budget is None and reach_fraction is None and discount is not None:
        raise ModelError(
            Argument("failure_budget", None),
            " (least failure) supports no discount: leave ",
            Argument("discount"),
            " out, or give a budget for the discounted failure",
        )


def free_pairs(
    model: SSP, aim: Aim, side: Iterable[UpperRow] = (), objective: UpperRow | None = None
) -> BoolArray:
    """Return a mask of the pairs that add nothing to the objective and the limits, [pairs].

    A policy may fail at no cost by staying for ever in an end component of these pairs. A pair of
    positive cost may be among them if the model's cost is neither the objective nor limited.

    Args:
        model: the model.
        aim: the objective, unless ``objective`` is given.
        side: the limits.
        objective: a quantity that is minimised instead of the aim.
    """
    if objective is not None:
        free = objective.free
    elif aim is Aim.GREATEST_GOAL:
        free = np.ones(model.n_pairs, dtype=np.bool_)  # only leaving a component has a risk
    else:
        free = (
            ~pairs_into(model, model.goal_mask) if aim is Aim.LEAST_GOAL else costless_pairs(model)
        )
    for row in side:
        free = free & row.free
    return free


_DUST = 8.0 * MACHINE_EPSILON  # rounding error of a difference, relative to the leaving mass


@dataclass(frozen=True, eq=False)
class Counting:
    """Coefficients of costs, arrivals and ends on a process.

    Every method returns a coefficient for each pair, [pairs], and an amount for the start, due to
    episodes that begin on a goal or dead-end and end there (``failure_label.with_start``).
    """

    quotient: Quotient
    escape: FloatArray  # [pairs] divisors of the rows
    goal: FloatArray  # [pairs] mass that reaches the goal
    failure: FloatArray  # [pairs] mass that fails
    start: FloatArray  # [states]
    semantics: FailureSemantics
    survival: float  # the discount, 1 in the exact setting

    def cost(self, model: SSP) -> tuple[FloatArray, float]:
        """Return the expected secondary cost of each pair, [pairs], and of the start.

        Charges of failing are included, as in the model's own cost.

        Args:
            model: the model with the secondary cost as its cost.
        """
        cost, entering = stage_costs(model, self.quotient, self.semantics, self.survival)
        return cost / self.escape, float(self.start @ entering)

    def arrivals(self, states: BoolArray) -> tuple[FloatArray, float]:
        """Return the probability that each pair enters some states, [pairs], and that of the start.

        Arrivals after failing do not count.
        """
        into = self.quotient.at_pairs(successor_means(self.quotient.model, states))
        ended = states & (self.quotient.node_of < 0)
        return self.survival * into / self.escape, float(self.start[ended].sum())

    def endings(self) -> tuple[FloatArray, float]:
        """Return the mass of each pair that ends by goal or failure, [pairs], and at the start."""
        return self.goal + self.failure, float(self.start[self.quotient.node_of < 0].sum())

    def other_endings(self, states: BoolArray) -> tuple[FloatArray, float]:
        """Return the mass that ends outside given states: of pairs, [pairs], and of the start."""
        if (states == self.quotient.model.goal_mask).all():
            return self.failure, float(self.start[self.quotient.dead].sum())
        (every, at_once), (into, there) = self.endings(), self.arrivals(states)
        left = every - into
        return np.where(left <= _DUST * every, 0.0, left), max(at_once - there, 0.0)


def stage_costs(
    model: SSP, quotient: Quotient, semantics: FailureSemantics, survival: float
) -> tuple[FloatArray, FloatArray]:
    """Return the expected cost of each pair, including the charges of failing.

    Args:
        model: the model with the costs.
        quotient: the live part of the model.
        semantics: the charges of giving up and of entering a dead-end.
        survival: the discount, or 1.

    Returns:
        The cost of each pair, [quotient pairs], and the charge of entering each dead-end, [states].
    """
    means, charges = cost_means(model), np.zeros(quotient.n_nodes)
    if quotient.gives_up.any():
        by_state = give_up_charges(model, quotient.merged, semantics, means)
        charges = quotient.least_over_members(by_state)
    entering = model.of_all_states(dead_end_charges(model, quotient.dead, semantics, means))
    stage = quotient.at_pairs(means, charges)
    if entering.any():
        stage = stage + survival * quotient.at_pairs(successor_means(model, entering))
    return stage, entering
