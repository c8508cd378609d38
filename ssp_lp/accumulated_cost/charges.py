"""What arriving at the goal is charged for the total cost: one process, many criteria.

On the accumulated-cost process (paper, section 3.1.1) a run that reaches the goal at total cost c
is charged ``charge(c)``, one that fails nothing. The total cost itself gives S3P; a step, a kink
or a utility in its place give bounded reach, the conditional value at risk, or GUBS. A negative
charge is a reward. No charge falls as the total cost grows.

A measure is a number of the *law of success costs* of a policy, the sub-probability law of the
total cost C on the runs that reach the goal; what is missing from it is the failure probability.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Final, NamedTuple

import numpy as np

from ssp_lp.arrays import SAME_TOTAL, BoolArray, FloatArray
from ssp_lp.errors import ModelError

if TYPE_CHECKING:
    from ssp_lp.accumulated_cost.cost_law import CostLaw

Utility = Callable[[FloatArray], FloatArray]
"""A non-increasing function of the total cost, on arrays."""


def utilities(utility: Utility, costs: FloatArray, name: str = "utility") -> FloatArray:
    """The utility of each total cost, like ``costs``; errors call the function by its name.

    Raises:
        ModelError: the function does not take an array, or does not return as many finite numbers.
    """
    try:
        worth = np.asarray(utility(costs), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ModelError(f"{name} must take an array of costs: {error}") from error
    if worth.shape != costs.shape or not np.isfinite(worth).all():
        raise ModelError(f"{name} must map an array of costs to as many finite numbers")
    return worth


def _check_monotone(worth: FloatArray, growth: FloatArray, costs: FloatArray, rule: str) -> None:
    """Raise :class:`ModelError` where a charge of total costs, or its growth, is below 0."""
    wrong = (worth < 0.0) | np.append(growth < 0.0, False)
    if wrong.any():
        raise ModelError(f"{rule}: it does at cost {float(costs[int(np.argmax(wrong))]):g}")


class TailValues(NamedTuple):
    """Values of a stationary policy followed as a tail from some nodes on, arrays of one shape."""

    goal: FloatArray  # E[gamma^T; goal]
    failure: FloatArray  # 1 - goal, summed by itself: each is exact where it is small
    early: FloatArray  # E[gamma^(T - 1); goal]
    cost: FloatArray  # E[gamma^(T - 1) * cost; goal]
    moment: FloatArray  # E[exp(rate * cost); goal]; 0 where no charge needs it

    @classmethod
    def stacked(
        cls, policies: Sequence[TailValues], seen: Callable[[FloatArray], FloatArray]
    ) -> TailValues:
        """The tail values of several policies, a row each, read by some other index."""
        return cls(
            *(np.array([seen(each) for each in same]) for same in zip(*policies, strict=True))
        )

    def row(self, number: int) -> TailValues:
        """The tail values of one policy among several, by its number in the first index."""
        return TailValues(*[each[number] for each in self])

    def chosen(self, last: BoolArray) -> TailValues:
        """Tail values of the last policy where ``last``, of the first elsewhere, like ``last``."""
        return TailValues(*[np.where(last, each[-1], each[0]) for each in self])


class Charge(ABC):
    """A non-decreasing function of the total cost, by default affine from some cost on."""

    is_the_total: ClassVar[bool] = False  # whether it is the total cost itself

    @property
    def offset(self) -> float:
        """Intercept of the charge's line, ``offset + slope * cost``, at total cost 0."""
        return 0.0

    @property
    def slope(self) -> float:
        """Charge of arriving per unit of total cost, from ``settled`` on."""
        return 0.0

    @property
    def lowest(self) -> float:
        """The least charge of arriving at any total cost; at most 0."""
        return 0.0

    @property
    def is_concave(self) -> bool:
        """Whether interpolating the charge of arriving between two totals never exceeds it."""
        return False

    @abstractmethod
    def at(self, totals: FloatArray) -> FloatArray:
        """The charge of arriving at total costs, like ``totals``."""

    @property
    def settled(self) -> float | None:
        """Total cost beyond which the charge of arriving is affine; None: never."""
        return 0.0

    def is_affine_beyond(self, total: float) -> bool:
        """Whether the charge is its line at a total already; exponentials only come near theirs."""
        line = self.offset + self.slope * total
        return bool(np.isclose(float(self.at(np.array([total]))[0]), line, rtol=1e-9))

    def lossless(self, price: float) -> float:
        """Total from which on failing at its price is cheaper than arriving; 0: a flat charge."""
        return max((price - self.offset) / self.slope, 0.0) if self.slope > 0.0 else 0.0

    def beyond(self, paid: FloatArray, tail: TailValues) -> FloatArray:
        """E[charge; goal] of following a tail after some cost has been paid."""
        linear = self.slope * (tail.cost + paid * tail.early)
        return np.asarray(linear + self.offset * tail.goal if self.offset else linear)


@dataclass(frozen=True)
class TotalCostCharge(Charge):
    """The total cost itself: case S."""

    is_the_total = is_concave = True
    slope = 1.0

    def at(self, totals: FloatArray) -> FloatArray:
        """The charge of case S: the total costs themselves."""
        return np.asarray(totals)


TOTAL_COST: Final = TotalCostCharge()


@dataclass(frozen=True)
class LateCharge(Charge):
    """1 for arriving at a cost beyond the bound, 0 else.

    A total within :data:`~ssp_lp.arrays.SAME_TOTAL` of the bound is the bound, summed in another
    way.
    """

    bound: float | Fraction

    offset = 1.0  # of an arrival beyond the bound

    def at(self, totals: FloatArray) -> FloatArray:
        """The charge of arriving within the bound on the total cost, or beyond it."""
        return np.where(np.asarray(totals) <= self.settled, self.lowest, self.offset)

    @property
    def settled(self) -> float:
        """The bound from which on arriving is charged as late, with room for rounding."""
        return float(self.bound) * (1.0 + SAME_TOTAL)


@dataclass(frozen=True)
class ExcessCharge(Charge):
    """``z + max(cost - z, 0) / share``: the integrand of Rockafellar and Uryasev's formula.

    With a ``first`` it is the least of the integrands for first <= z <= threshold, or less:
    ``max(first, min(cost, threshold)) + max(cost - threshold, 0) / share``.
    """

    threshold: float  # z
    share: float  # 1 - level
    first: float | None = None  # None: the threshold

    @cached_property
    def offset(self) -> float:
        """Intercept at total cost 0 of the line of the charge for an excess over z."""
        return self.threshold * (1.0 - self.slope)

    @cached_property
    def slope(self) -> float:
        """Slope of the charge for an excess over the threshold z."""
        return 1.0 / self.share

    def at(self, totals: FloatArray) -> FloatArray:
        """The charge of arriving by Rockafellar and Uryasev's integrand, like ``totals``."""
        late = np.maximum(np.asarray(totals) - self.threshold, 0.0)
        first = self.threshold if self.first is None else self.first
        return np.asarray(np.clip(totals, first, self.threshold) + late * self.slope)

    @property
    def settled(self) -> float:
        """The threshold of the charge for an excess: from there on it is a line."""
        return self.threshold


class Measure(ABC):
    """A number of the law of success costs."""

    maximised: ClassVar[bool] = False  # whether more is better
    is_expectation: ClassVar[bool] = False  # one program answers it; else trials are searched
    is_a_total: ClassVar[bool] = False  # of costs as they are paid: rounded ones only come near it

    @property
    def failing(self) -> float:
        """Worth of a run that fails, where the measure of the total cost is an expectation."""
        return float("inf")

    @property
    @abstractmethod
    def words(self) -> str:
        """The measure of the law of the total cost in words, for summaries and errors."""

    @property
    def charge(self) -> Charge:
        """The charge of arriving whose expectation the measure is; of a search, the first one."""
        return TOTAL_COST

    @abstractmethod
    def of(self, law: CostLaw) -> float:
        """The measure's value on a policy's law of the total cost."""


class Reward(Charge, Measure):
    """An expectation to be maximised: its charge is minus what arriving is worth beyond failing."""

    maximised = is_expectation = True

    @property
    def failing(self) -> float:
        """Worth of a run that fails under a reward for arriving: none."""
        return 0.0

    @property
    def charge(self) -> Charge:
        """The reward for arriving, itself the charge."""
        return self


@dataclass(frozen=True)
class WithinBound(LateCharge, Reward):
    """Pr(the goal is reached at a total cost of at most ``bound``): 1 for arriving in time."""

    offset = 0.0  # of arriving late
    lowest = -1.0  # of arriving in time

    @property
    def words(self) -> str:
        """The measure Pr(C <= bound) of the law of the total cost, in words."""
        return f"goal within cost {float(self.bound):g}"

    def of(self, law: CostLaw) -> float:
        """The measure Pr(C <= bound) of a law of the total cost."""
        return law.within(self.bound)


@dataclass(frozen=True)
class ExpectedUtility(Reward):
    """E[utility of the total cost] + bonus * Pr(goal); a run that fails costs infinity (GUBS).

    Beyond every table the utility is taken to be what it falls to, which understates it.
    """

    utility: Utility
    bonus: float
    at_infinity: float
    settled = None  # where a utility becomes constant is not known

    @property
    def failing(self) -> float:
        """The utility of an infinite total cost, which a run that fails has."""
        return self.at_infinity

    @property
    def words(self) -> str:
        """The measure E[utility of the total cost] in words."""
        return f"expected utility, goal bonus {self.bonus:g}"

    @property
    def offset(self) -> float:
        """Minus the bonus for arriving: the charge where no utility is left."""
        return -self.bonus

    @property
    def lowest(self) -> float:
        """The least charge of arriving by utility: minus the worth of arriving at no cost."""
        return float(self.at(np.zeros(1))[0])

    def at(self, totals: FloatArray) -> FloatArray:
        """Charge of arriving by utility: minus (utility + bonus - utility of failing).

        Raises:
            ModelError: the utility is no non-increasing function with this limit.
        """
        cost, back = np.unique(totals, return_inverse=True)
        worth = utilities(self.utility, cost) - self.at_infinity
        rule = (
            f"not increase with the cost nor fall below utility_at_infinity = {self.at_infinity:g}"
        )
        _check_monotone(worth, -np.diff(worth), cost, f"utility must {rule}")
        return np.asarray(-(worth + self.bonus))[back].reshape(np.shape(totals))

    def of(self, law: CostLaw) -> float:
        """The measure E[utility] of a law of the total cost."""
        reached = law.expectation(self.utility, self.at_infinity) + self.bonus * law.goal
        return reached + self.at_infinity * (1.0 - law.goal)


@dataclass(frozen=True)
class ExponentialUtility(Reward):
    """E[exp(rate * total cost); goal] + bonus * Pr(goal), rate < 0 (eGUBS).

    What a tail is worth factors exactly.
    """

    rate: float
    bonus: float
    is_concave = True  # minus a convex exponential

    @property
    def words(self) -> str:
        """The measure E[exponential utility of the total cost] in words."""
        return f"utility exp({self.rate:g} cost), goal bonus {self.bonus:g}"

    @property
    def offset(self) -> float:
        """Minus the bonus for arriving, the charge's limit under exponential utility."""
        return -self.bonus

    @property
    def lowest(self) -> float:
        """The least charge by exponential utility: minus the worth of arriving at no cost."""
        return -(1.0 + self.bonus)

    def at(self, totals: FloatArray) -> FloatArray:
        """Charge of arriving by exponential utility: minus utility and bonus."""
        return np.asarray(-(np.exp(self.rate * np.asarray(totals)) + self.bonus))

    def beyond(self, paid: FloatArray, tail: TailValues) -> FloatArray:
        """Charge of a tail, ``-(exp(rate * paid) * E[exp(rate * cost)] + bonus * goal)``."""
        return np.asarray(-(np.exp(self.rate * paid) * tail.moment + self.bonus * tail.goal))

    def of(self, law: CostLaw) -> float:
        """The measure E[exponential utility] of a law of the total cost."""
        return law.exponential(self.rate) + self.bonus * law.goal


@dataclass(frozen=True)
class ExpectedArrivalCost(Charge, Measure):
    """E[f(total cost) | goal], to be small: f at least 0, non-decreasing, and a line in the end."""

    function: Utility
    affine_from: float = 0.0
    is_expectation = True

    @property
    def charge(self) -> Charge:
        """The function f of the total cost, itself the charge of arriving."""
        return self

    @property
    def words(self) -> str:
        """The measure E[f(C) | goal] of the law of the total cost, in words."""
        return "arrival cost given success"

    @property
    def is_concave(self) -> bool:
        """Whether the arrival cost f is a line from total cost 0 on."""
        return self.affine_from == 0.0

    @property
    def slope(self) -> float:
        """Slope of the charge f where it has become a line."""
        first, last = self.at(self.affine_from + np.array([0.0, max(self.affine_from, 1.0)]))
        return float(last - first) / max(self.affine_from, 1.0)

    @property
    def offset(self) -> float:
        """Intercept of the charge f's line at total cost 0."""
        return float(self.at(np.array([self.affine_from]))[0]) - self.slope * self.affine_from

    def at(self, totals: FloatArray) -> FloatArray:
        """The charge f of arriving at total costs, like ``totals``.

        Raises:
            ModelError: it does not take an array, falls as the cost grows, or is below 0.
        """
        cost, back = np.unique(totals, return_inverse=True)
        charge = utilities(self.function, cost, "an arrival cost")
        rule = "an arrival cost must be at least 0 and not fall as the total cost grows"
        _check_monotone(charge, np.diff(charge), cost, rule)
        return charge[back].reshape(np.shape(totals))

    @property
    def settled(self) -> float:
        """Total cost at which the line of the charge f begins."""
        return self.affine_from

    def of(self, law: CostLaw) -> float:
        """The measure E[f(C) | goal] of a law of the total cost; nan if no run succeeds."""
        if law.goal == 0.0:
            return float("nan")
        line = self.affine_from
        totals, probabilities = law.upto(line)
        late = float(self.at(np.array([line]))[0]) * (law.goal - law.within(line))
        late += self.slope * law.excess(line)
        return (float(probabilities @ self.at(totals)) + late) / law.goal


@dataclass(frozen=True)
class CostQuantileOf(Measure):
    """The level-quantile of the total cost given success."""

    is_a_total: ClassVar[bool] = True
    level: float

    @property
    def words(self) -> str:
        """The measure "quantile of the total cost" in words."""
        return f"{self.level:g}-quantile of the cost given success"

    def of(self, law: CostLaw) -> float:
        """The quantile of a law of the total cost: the least B with Pr(C <= B | goal) >= level."""
        return law.quantile(self.level)


@dataclass(frozen=True)
class TailMeanOf(Measure):
    """The conditional value at risk of the total cost given success: the mean of its worst share.

    By Rockafellar and Uryasev's formula it is z + E[(C - z)^+ | goal] / (1 - level) at the
    quantile z, and the least of these over all z.
    """

    level: float

    @property
    def words(self) -> str:
        """The measure "mean of the tail of the total cost" in words."""
        return f"conditional value at risk {self.level:g} given success"

    def of(self, law: CostLaw) -> float:
        """The measure "tail mean" of a law: of its costliest ``1 - level``; nan without success."""
        return law.tail_mean(self.level)
