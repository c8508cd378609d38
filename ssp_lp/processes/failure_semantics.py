"""What is counted, who may give up where, what failing costs, and where an episode starts.

And how costs and arrivals of a model are counted, by that, at the pairs of an augmented process.
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
from ssp_lp.arrays import LEAST_BUDGET, MACHINE_EPSILON, BoolArray, FloatArray, segment_minima
from ssp_lp.errors import (
    Argument,
    ModelError,
    check_between_0_and_1,
    check_flag,
    in_short,
    is_number,
    wrong_argument,
)
from ssp_lp.model import SSP
from ssp_lp.model.graph import attention_pairs, attention_states, goal_pairs, hopeless_states
from ssp_lp.model.product import ProductSSP
from ssp_lp.processes.live_rows import cost_means, costless_pairs, successor_means
from ssp_lp.processes.quotient import Quotient

if TYPE_CHECKING:
    from ssp_lp.accumulated_cost.cost_law import CostLaw
    from ssp_lp.processes.conditions import UpperRow


class GiveUp(enum.StrEnum):
    """States in which a policy of case M may give up (mathematics, section 2).

    ``ANYWHERE`` is the linear program of Trevizan et al. (2017); ``ATTENTION`` is the paper's
    stopping time of section 2.4, which may only fall where the goal can be avoided for sure;
    ``DEAD_ENDS`` pays until a dead-end is entered, as Storm does.
    """

    ANYWHERE = "anywhere"
    ATTENTION = "attention"
    DEAD_ENDS = "dead_ends"


class Aim(enum.StrEnum):
    """Aim of a criterion: little cost, or much or little of the goal."""

    LEAST_COST = "least_cost"
    GREATEST_GOAL = "greatest_goal"
    LEAST_GOAL = "least_goal"


@dataclass(frozen=True)
class FailureSemantics:
    """The choices that decide what an episode is worth.

    A penalty is paid for failing, on top of the cost until then; under a discount it is paid for
    the discounted failure. An infinite one forbids failing: only policies that reach the goal
    surely are left. Where a measure is named, it is what counts of the total cost of a success.
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
        """Whether a policy that may fail is worth nothing."""
        return self.penalty == np.inf

    @property
    def counts_law(self) -> bool:
        """Whether a measure of the law of the total cost counts, in place of its mean."""
        return self.measure is not None

    @property
    def risk(self) -> CostQuantileOf | TailMeanOf | None:
        """The measure of the law that only a search answers; None: a single program does."""
        if self.measure is None or self.measure.is_expectation:
            return None
        return cast("CostQuantileOf | TailMeanOf", self.measure)

    def worth_of(self, law: CostLaw) -> float:
        """What a law of success costs is worth, by the measure or its mean."""
        return law.conditional_mean if self.measure is None else self.measure.of(law)

    @property
    def failing_worth(self) -> float:
        """Worth of a run that fails, by the measure; 0 without one."""
        return 0.0 if self.measure is None else self.measure.failing

    @property
    def maximises(self) -> bool:
        """Whether failure semantics ask for a worth, the greater the better."""
        return self.measure is not None and self.measure.maximised

    def charge(self, ratio: bool) -> Charge | None:
        """Charge of arriving by these failure semantics; None: no total is counted (case M)."""
        if self.measure is not None:
            return self.measure.charge
        return TOTAL_COST if ratio else None

    @property
    def sense(self) -> ObjectiveSense:
        """Sense of the objective by the failure semantics, no quantity being minimised instead."""
        if self.aim is Aim.GREATEST_GOAL:
            return ObjectiveSense(0.0)
        return ObjectiveSense(self.failing_worth) if self.maximises else AS_ASKED

    @property
    def counts_cost_alone(self) -> bool:
        """Whether only a budget can keep a policy from failing: no penalty, aim or measure."""
        return self.penalty == 0.0 and self.aim is Aim.LEAST_COST and not self.counts_law


_MOST_NAMED = 3  # states of a start that an error names
_ROUNDED = 2e-14  # of what a difference is taken from, sums along a process included


@dataclass(frozen=True)
class ObjectiveSense:
    """A minimum in place of a maximum, or of a quantity with negative weights on ends."""

    constant: float | None = None  # what is maximised is this, less what is minimised
    shift: float = 0.0  # what every episode is charged on top, so that no charge is negative
    offset: float = 0.0  # what is minimised is so much more than what is asked

    def worth(self, value: float) -> float:
        """Worth asked for, from the minimised objective's value."""
        return value - self.offset if self.constant is None else self.constant - value

    def worth_of_bound(self, bound: float) -> float:
        """Worth of a bound of the objective, rounded outwards where it is a difference."""
        worth = self.worth(bound)
        if self.constant is None:
            return worth if worth + self.offset == bound else float(np.nextafter(worth, -np.inf))
        return worth if self.constant - worth == bound else float(np.nextafter(worth, np.inf))

    def settled_bound(self, value: float, bound: float, paid: float = 0.0) -> float:
        """The objective's bound, or its value where only rounding parts them.

        Args:
            value: what a lottery attains, in what is minimised.
            bound: of every lottery.
            paid: what the bounds of rows are worth at their prices, which is taken off a bound.
        """
        taken = abs(self.offset if self.constant is None else self.constant)
        taken = max(taken, paid) if taken > 0.0 else 0.0  # else what is asked is no difference
        return value if abs(value - bound) <= _ROUNDED * taken else bound


AS_ASKED = ObjectiveSense()


def survival_of(discount: float | None) -> float:
    """Survival factor of every transition: the discount, 1 in the exact setting."""
    return 1.0 if discount is None else discount


def parse_give_up(value: str | GiveUp) -> GiveUp:
    """Turn a word into a :class:`GiveUp` of failure semantics; :class:`ModelError` if unknown."""
    try:
        return GiveUp(value)
    except ValueError as error:
        choices = ", ".join(repr(str(g)) for g in GiveUp)
        raise wrong_argument("give_up", f"be one of {choices}", value) from error


def dead_end_charges(
    model: SSP, dead: BoolArray, semantics: FailureSemantics, costs: FloatArray | None = None
) -> FloatArray:
    """Charge of entering each dead-end, once: its least expected stage cost, [states].

    Zero for other states, for dead-ends without actions and without ``charge_failing_step``.

    Args:
        dead: dead-ends, [states].
        semantics: whether they are charged.
        costs: expected stage costs, [pairs]; None: worked out here.
    """
    if not semantics.charge_failing_step:
        return np.zeros(model.n_states)
    least = segment_minima(cost_means(model) if costs is None else costs, model.pair_offsets)
    return np.where(dead & np.isfinite(least), least, 0.0)


def give_up_charges(
    model: SSP,
    attention: BoolArray,
    wandering: BoolArray,
    semantics: FailureSemantics,
    costs: FloatArray | None = None,
) -> FloatArray:
    """Charge of giving up in each state, infinite where it is not allowed, [states].

    Args:
        attention: attention states, [states].
        wandering: states of zero-cost end components, where staying for ever is free, [states].
        semantics: where giving up is allowed and whether it is charged.
        costs: expected stage costs, [pairs]; None: worked out here.
    """
    charge = np.full(model.n_states, np.inf)
    if (label := model.failure_label) is not None:  # who may give up is declared
        allowed = label.stops | label.after | np.append(label.is_open, label.is_open)
        charge[allowed] = 0.0
        if semantics.charge_failing_step:
            costs = cost_means(model) if costs is None else costs
            least = segment_minima(np.where(label.priced, costs, np.inf), model.pair_offsets)
            charge = np.where(allowed & np.isfinite(least), least, charge)
    elif semantics.give_up is not GiveUp.DEAD_ENDS:
        anywhere = semantics.give_up is GiveUp.ANYWHERE
        allowed = ~model.goal_mask & (anywhere | attention)
        charge[allowed] = 0.0
        if semantics.charge_failing_step:
            costs = cost_means(model) if costs is None else costs
            if not anywhere:
                costs = np.where(attention_pairs(model, attention), costs, np.inf)
            charge[allowed] = segment_minima(costs, model.pair_offsets)[allowed]
    charge[wandering] = 0.0
    return charge


def giving_up_states(model: SSP, give_up: GiveUp, usable: BoolArray | None = None) -> BoolArray:
    """States in which the failure semantics allow giving up, dead-ends included, [states].

    Args:
        model: the model.
        give_up: where a policy may.
        usable: pairs that attain the least failure, where only they may be used, [pairs]: nobody
            gives up who can go on.
    """
    if (label := model.failure_label) is not None:
        usable = np.zeros(model.n_pairs, dtype=np.bool_) if usable is None else usable
        acting = np.bincount(model.pair_state[usable & label.finite[1]], minlength=model.n_states)
        return np.asarray(label.stops & (acting == 0))
    if give_up is GiveUp.DEAD_ENDS or usable is not None:
        return np.zeros(model.n_states, dtype=np.bool_)
    return ~model.goal_mask if give_up is GiveUp.ANYWHERE else attention_states(model)


def start_distribution(model: SSP, start: Hashable | Mapping[Hashable, float]) -> FloatArray:
    """The distribution over states in which an episode begins, [states].

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
            raise ModelError(f"start probability of state {state!r} is no number: {given}")
        if not 0.0 <= float(probability) <= 1.0 + 1e-12:
            raise ModelError(f"start probability of state {state!r} is {probability!r}")
        distribution[model.index_of(state, "start")] += float(probability)
    total = float(distribution.sum())
    if abs(total - 1.0) > 1e-9:
        raise ModelError(f"start probabilities sum to {total:.12g}, not to 1")
    return distribution / total


class GoalShare(float):
    """A failure budget that follows from a demanded goal probability.

    Where that is rare the budget is 1 but for rounding: whoever limits failing asks
    :func:`demanded_goal` for what it is made of.
    """

    demanded: float

    def __new__(cls, demanded: float) -> GoalShare:
        """The budget that leaves a demanded goal probability, in [0, 1]."""
        budget = super().__new__(cls, 1.0 - demanded)
        budget.demanded = demanded
        return budget

    def __getnewargs__(self) -> tuple[float]:
        """Copied by what is demanded."""
        return (self.demanded,)


def demanded_goal(budget: float) -> float:
    """Goal probability that a failure budget demands; of a share, without its rounding."""
    return budget.demanded if isinstance(budget, GoalShare) else 1.0 - budget


RARE_GOAL = 1e-3
"""Demanded goal probability below which success is counted in place of failing.

More often than that, 1 - failure has 13 digits of it; and failing may be rare itself.
"""


def goal_out_of_reach(model: SSP, start: FloatArray) -> str:
    """Words for a goal that no policy reaches from any state of a start; "": some policy does.

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
    """Check the penalty of failing, a number of the failure semantics.

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
    """Check budget, discount, share, and whether the failing step is paid.

    Raises:
        ModelError: a budget or a share outside [0, 1], both of them, a discount outside (0, 1),
            least failure together with a discount, or a charge that is no truth value.
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
        raise ModelError("give ", *either, ", not both: each says the other")
    if reach_fraction is not None and not 0.0 <= reach_fraction <= 1.0:
        hint = as_percentage(reach_fraction)
        raise wrong_argument("reach_fraction", "lie between 0 and 1", reach_fraction, hint)
    if failure_budget is not None and not -LEAST_BUDGET <= failure_budget <= 1.0 + LEAST_BUDGET:
        hint = as_percentage(failure_budget)
        raise wrong_argument("failure_budget", "be a probability", failure_budget, hint)
    if discount is not None:
        check_between_0_and_1("discount", discount, "; left out it is exact")
    if failure_budget is None and reach_fraction is None and discount is not None:
        raise ModelError(
            Argument("failure_budget", None),
            " (least failure) is exact only: leave ",
            Argument("discount"),
            " out, or give a budget for the discounted surrogate",
        )


def as_percentage(share: float) -> str:
    """Hint for a failure budget above 1: the percentage that it may have meant."""
    return f"; did you mean {float(share) / 100.0:.12g}?" if 1.0 < share <= 100.0 else ""


def free_pairs(
    model: SSP, aim: Aim, side: Iterable[UpperRow] = (), objective: UpperRow | None = None
) -> BoolArray:
    """Pairs free in all that is minimised and limited, failing included, [pairs].

    To move among them for ever is a way to fail that costs nothing, whatever the model's own cost
    is: that counts only where it is asked for.

    Args:
        model: the model.
        aim: what is minimised unless there is an objective.
        side: what is limited.
        objective: a quantity that is minimised; None: what the aim counts.
    """
    if objective is not None:
        free = objective.free
    elif aim is Aim.GREATEST_GOAL:
        free = np.ones(model.n_pairs, dtype=np.bool_)  # only leaving a component risks anything
    else:
        free = ~goal_pairs(model) if aim is Aim.LEAST_GOAL else costless_pairs(model)
    for row in side:
        free = free & row.free
    return free


_DUST = 8.0 * MACHINE_EPSILON  # of what leaves by a pair: the rounding of a difference


@dataclass(frozen=True, eq=False)
class Counting:
    """A process as far as counting needs it: pairs of its quotient, and a source.

    The source is where start mass on goals and dead-ends enters (``programs.augmented``); what is
    counted there comes second in every answer.
    """

    quotient: Quotient
    departs: FloatArray  # [pairs] what rows were divided by
    goal: FloatArray  # [pairs] mass that reaches the goal
    failure: FloatArray  # [pairs] mass that fails
    start: FloatArray  # [states]
    semantics: FailureSemantics
    survival: float  # the discount, 1 in the exact setting

    def cost(self, model: SSP) -> tuple[FloatArray, float]:
        """A secondary cost of the model, charged by failure semantics as its own is, [pairs].

        Args:
            model: the model with the other costs.
        """
        cost, entering = stage_costs(model, self.quotient, self.semantics, self.survival)
        return cost / self.departs, float(self.start @ entering)

    def arrivals(self, states: BoolArray) -> tuple[FloatArray, float]:
        """Probability of stepping into some states until failing, [pairs], and at the start."""
        into = self.quotient.at_pairs(successor_means(self.quotient.model, states))
        ended = states & (self.quotient.node_of < 0)
        return self.survival * into / self.departs, float(self.start[ended].sum())

    def endings(self) -> tuple[FloatArray, float]:
        """Mass that leaves the process with each pair, by goal or failure, [pairs]."""
        return self.goal + self.failure, float(self.start[self.quotient.node_of < 0].sum())

    def other_endings(self, states: BoolArray) -> tuple[FloatArray, float]:
        """Mass that ends otherwise than by stepping into some final states, [pairs]."""
        if (states == self.quotient.model.goal_mask).all():
            return self.failure, float(self.start[self.quotient.dead].sum())
        (every, at_once), (into, there) = self.endings(), self.arrivals(states)
        left = every - into
        return np.where(left <= _DUST * every, 0.0, left), max(at_once - there, 0.0)


def stage_costs(
    model: SSP, quotient: Quotient, semantics: FailureSemantics, survival: float
) -> tuple[FloatArray, FloatArray]:
    """Expected cost of each pair with charges of failing; what entering each dead-end costs.

    Args:
        model: the model whose costs are meant.
        quotient: the live part of it.
        semantics: what giving up and entering a dead-end is charged.
        survival: the discount.

    Returns:
        [quotient pairs] and [states].
    """
    means, charges = cost_means(model), np.zeros(quotient.n_nodes)
    if quotient.gives_up.any():
        attention = attention_states(model)
        by_state = give_up_charges(model, attention, quotient.merged, semantics, means)
        charges = quotient.least_over_members(by_state)
    entering = model.of_all_states(dead_end_charges(model, quotient.dead, semantics, means))
    stage = quotient.at_pairs(means, charges)
    if entering.any():
        stage = stage + survival * quotient.at_pairs(successor_means(model, entering))
    return stage, entering
