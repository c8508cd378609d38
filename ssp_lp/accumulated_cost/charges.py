"""Charges: functions of the total cost at the goal, for many criteria on one process.

On the accumulated-cost process (paper, section 3.1.1) a run that reaches the goal at total cost c
is charged ``charge(c)``, and a run that fails is charged 0. If the charge is the total cost itself,
the criterion is S3P; a step function gives bounded reach, a function with a kink the conditional
value at risk, a utility GUBS. A negative charge is a reward. Charges do not fall as the total cost
grows.

A measure is a number that is computed from the *law of success costs* of a policy: the
sub-probability law of the total cost C on the runs that reach the goal. Its missing mass is the
failure probability.
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
    """Return the utility of each total cost, in the shape of ``costs``.

    Raises:
        ModelError: the function does not take an array, or does not return as many finite numbers;
            the message calls it ``name``.
    """
    try:
        worth = np.asarray(utility(costs), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ModelError(f"{name} must take an array of costs: {error}") from error
    if worth.shape != costs.shape or not np.isfinite(worth).all():
        raise ModelError(f"{name} must return a finite number for each cost of the array")
    return worth


def _check_monotone(values: FloatArray, growth: FloatArray, costs: FloatArray, rule: str) -> None:
    """Check the sign of a function of the cost and of its differences.

    Args:
        values: values that must be non-negative, [costs].
        growth: differences of neighbouring values that must be non-negative, [costs - 1].
        costs: increasing, [costs].
        rule: beginning of the error's message.

    Raises:
        ModelError: a value or a difference is negative.
    """
    wrong = (values < 0.0) | np.append(growth < 0.0, False)
    if wrong.any():
        raise ModelError(f"{rule}: it does at cost {float(costs[int(np.argmax(wrong))]):g}")


class TailValues(NamedTuple):
    """Expected values of following a stationary policy (a tail) from each node.

    T is the number of steps to the goal. All arrays have one shape.
    """

    goal: FloatArray  # E[gamma^T; goal]
    failure: FloatArray  # 1 - goal, computed separately: the smaller of the two is exact
    early: FloatArray  # E[gamma^(T - 1); goal]
    cost: FloatArray  # E[gamma^(T - 1) * cost; goal]
    moment: FloatArray  # E[exp(rate * cost); goal]; 0 if no charge needs it

    @classmethod
    def stacked(
        cls, policies: Sequence[TailValues], seen: Callable[[FloatArray], FloatArray]
    ) -> TailValues:
        """Stack the values of several policies as rows; ``seen`` maps each array first."""
        return cls(
            *(np.array([seen(each) for each in same]) for same in zip(*policies, strict=True))
        )

    def row(self, number: int) -> TailValues:
        """Return the values of one policy among several, by its row."""
        return TailValues(*[each[number] for each in self])

    def chosen(self, last: BoolArray) -> TailValues:
        """Return values of the last policy where ``last`` is true, elsewhere of the first policy.

        The arrays have the shape of ``last``.
        """
        return TailValues(*[np.where(last, each[-1], each[0]) for each in self])


class Charge(ABC):
    """A non-decreasing function of the total cost, by default affine above some total."""

    is_the_total: ClassVar[bool] = False  # whether it is the total cost itself

    @property
    def offset(self) -> float:
        """Intercept of the affine part, ``offset + slope * cost``, at total cost 0."""
        return 0.0

    @property
    def slope(self) -> float:
        """Slope of the affine part, which begins at total cost ``affine_from_total``."""
        return 0.0

    @property
    def lowest(self) -> float:
        """A lower bound of the charge at all total costs, at most 0."""
        return 0.0

    @property
    def is_concave(self) -> bool:
        """Whether the charge is concave, so that linear interpolation never exceeds it."""
        return False

    @abstractmethod
    def at(self, totals: FloatArray) -> FloatArray:
        """Return the charge at total costs, in the shape of ``totals``."""

    @property
    def affine_from_total(self) -> float | None:
        """Total cost beyond which the charge is affine; None if it never is."""
        return 0.0

    def is_affine_beyond(self, total: float) -> bool:
        """Return whether the charge equals its affine part at a total, up to rounding."""
        line = self.offset + self.slope * total
        return bool(np.isclose(float(self.at(np.array([total]))[0]), line, rtol=1e-9))

    def lossless_total(self, price: float) -> float:
        """Return the total at which the affine part equals a price of failing; 0 if constant."""
        return max((price - self.offset) / self.slope, 0.0) if self.slope > 0.0 else 0.0

    def beyond(self, paid: FloatArray, tail: TailValues) -> FloatArray:
        """Return E[charge; goal] if a tail is followed after some cost has been paid.

        Args:
            paid: cost paid before, in a shape that fits the tail's arrays.
            tail: values of the tail.
        """
        linear = self.slope * (tail.cost + paid * tail.early)
        return np.asarray(linear + self.offset * tail.goal if self.offset else linear)


@dataclass(frozen=True)
class TotalCostCharge(Charge):
    """The total cost itself: case S."""

    is_the_total = is_concave = True
    slope = 1.0

    def at(self, totals: FloatArray) -> FloatArray:
        """Return the total costs themselves."""
        return np.asarray(totals)


TOTAL_COST: Final = TotalCostCharge()


@dataclass(frozen=True)
class LateCharge(Charge):
    """A charge of 1 for total costs beyond the bound, else 0.

    A total within :data:`~ssp_lp.arrays.SAME_TOTAL` of the bound counts as equal to it.
    """

    bound: float | Fraction

    offset = 1.0  # charge beyond the bound

    def at(self, totals: FloatArray) -> FloatArray:
        """Return 0 within the bound and 1 beyond it, in the shape of ``totals``."""
        return np.where(np.asarray(totals) <= self.affine_from_total, self.lowest, self.offset)

    @property
    def affine_from_total(self) -> float:
        """The bound, with a tolerance for rounding."""
        return float(self.bound) * (1.0 + SAME_TOTAL)


@dataclass(frozen=True)
class ExcessCharge(Charge):
    """``z + max(cost - z, 0) / share``: the integrand of Rockafellar and Uryasev's formula.

    If ``first`` is given, the charge is a lower bound of these integrands for every z between
    ``first`` and ``threshold``: ``max(first, min(cost, threshold)) + max(cost - threshold, 0) /
    share``.
    """

    threshold: float  # z
    share: float  # 1 - level
    first: float | None = None  # None: the threshold

    @cached_property
    def offset(self) -> float:
        """Intercept of the affine part at total cost 0."""
        return self.threshold * (1.0 - self.slope)

    @cached_property
    def slope(self) -> float:
        """Slope of the charge beyond the threshold z."""
        return 1.0 / self.share

    def at(self, totals: FloatArray) -> FloatArray:
        """Return the charge at total costs, in the shape of ``totals``."""
        late = np.maximum(np.asarray(totals) - self.threshold, 0.0)
        first = self.threshold if self.first is None else self.first
        return np.asarray(np.clip(totals, first, self.threshold) + late * self.slope)

    @property
    def affine_from_total(self) -> float:
        """The threshold, from which the charge is affine."""
        return self.threshold


class Measure(ABC):
    """A number computed from the distribution of the total cost of successful runs."""

    maximised: ClassVar[bool] = False  # whether it is maximised
    is_expectation: ClassVar[bool] = False  # whether one program is enough; else it needs a search
    is_a_total: ClassVar[bool] = False  # whether it is itself a total cost, which rounding changes

    @property
    def failing(self) -> float:
        """Value of a run that fails, if the measure is an expectation."""
        return float("inf")

    @property
    @abstractmethod
    def words(self) -> str:
        """Description of the measure, for summaries and errors."""

    @property
    def charge(self) -> Charge:
        """Charge whose mean is the measure or, for a risk measure, with which its search begins."""
        return TOTAL_COST

    @abstractmethod
    def of(self, law: CostLaw) -> float:
        """Return the value of the measure for a law."""


class Reward(Charge, Measure):
    """A maximised expectation; the charge is the value of failing minus the value of success."""

    maximised = is_expectation = True

    @property
    def failing(self) -> float:
        """Value of a run that fails: 0."""
        return 0.0

    @property
    def charge(self) -> Charge:
        """This object, which is a charge as well."""
        return self


@dataclass(frozen=True)
class WithinBound(LateCharge, Reward):
    """Pr(goal, C <= bound): a reward of 1 for total costs within the bound."""

    offset = 0.0  # charge beyond the bound
    lowest = -1.0  # charge within the bound

    @property
    def words(self) -> str:
        """Description of the measure."""
        return f"goal within cost {float(self.bound):g}"

    def of(self, law: CostLaw) -> float:
        """Return Pr(goal, C <= bound) of a law."""
        return law.within(self.bound)


@dataclass(frozen=True)
class ExpectedUtility(Reward):
    """E[utility of the total cost] + bonus * Pr(goal); failing has infinite cost (GUBS).

    Beyond the cap, the greatest total that is distinguished, the utility is replaced by its limit,
    which is a lower bound.
    """

    utility: Utility
    bonus: float
    at_infinity: float
    affine_from_total = None  # the total from which a utility is constant is unknown

    @property
    def failing(self) -> float:
        """Utility of a run that fails: the utility of infinite cost."""
        return self.at_infinity

    @property
    def words(self) -> str:
        """Description of the measure."""
        return f"expected utility, goal bonus {self.bonus:g}"

    @property
    def offset(self) -> float:
        """The limit of the charge at infinite cost: minus the bonus."""
        return -self.bonus

    @property
    def lowest(self) -> float:
        """The charge at total cost 0."""
        return float(self.at(np.zeros(1))[0])

    def at(self, totals: FloatArray) -> FloatArray:
        """Return minus (utility + bonus - utility at infinity), in the shape of ``totals``.

        Raises:
            ModelError: the utility increases, or falls below its limit at infinity.
        """
        cost, back = np.unique(totals, return_inverse=True)
        worth = utilities(self.utility, cost) - self.at_infinity
        rule = (
            f"not increase with the cost nor fall below utility_at_infinity = {self.at_infinity:g}"
        )
        _check_monotone(worth, -np.diff(worth), cost, f"utility must {rule}")
        return np.asarray(-(worth + self.bonus))[back].reshape(np.shape(totals))

    def of(self, law: CostLaw) -> float:
        """Return the expected utility of a law."""
        reached = law.expectation(self.utility, self.at_infinity) + self.bonus * law.goal
        return reached + self.at_infinity * (1.0 - law.goal)


@dataclass(frozen=True)
class ExponentialUtility(Reward):
    """E[exp(rate * total cost); goal] + bonus * Pr(goal), rate < 0 (eGUBS).

    The utility of a sum of costs is the product of their utilities. So the expected utility of a
    tail policy is known exactly, whatever cost was paid before.
    """

    rate: float
    bonus: float
    is_concave = True  # minus a convex exponential

    @property
    def words(self) -> str:
        """Description of the measure."""
        return f"utility exp({self.rate:g} cost), goal bonus {self.bonus:g}"

    @property
    def offset(self) -> float:
        """The limit of the charge at infinite cost: minus the bonus."""
        return -self.bonus

    @property
    def lowest(self) -> float:
        """The charge at total cost 0."""
        return -(1.0 + self.bonus)

    def at(self, totals: FloatArray) -> FloatArray:
        """Return minus (utility + bonus), in the shape of ``totals``."""
        return np.asarray(-(np.exp(self.rate * np.asarray(totals)) + self.bonus))

    def beyond(self, paid: FloatArray, tail: TailValues) -> FloatArray:
        """Return ``-(exp(rate * paid) * E[exp(rate * cost); goal] + bonus * Pr(goal))``."""
        return np.asarray(-(np.exp(self.rate * paid) * tail.moment + self.bonus * tail.goal))

    def of(self, law: CostLaw) -> float:
        """Return the expected utility of a law."""
        return law.exponential(self.rate) + self.bonus * law.goal


@dataclass(frozen=True)
class ExpectedArrivalCost(Charge, Measure):
    """E[f(total cost) | goal], minimised; f >= 0 is non-decreasing, and affine above some total."""

    function: Utility
    affine_from: float = 0.0
    is_expectation = True

    @property
    def charge(self) -> Charge:
        """The charge f itself."""
        return self

    @property
    def words(self) -> str:
        """Description of the measure."""
        return "arrival cost given success"

    @property
    def is_concave(self) -> bool:
        """Whether f is affine for all total costs."""
        return self.affine_from == 0.0

    @property
    def slope(self) -> float:
        """Slope of the affine part of f."""
        first, last = self.at(self.affine_from + np.array([0.0, max(self.affine_from, 1.0)]))
        return float(last - first) / max(self.affine_from, 1.0)

    @property
    def offset(self) -> float:
        """Intercept of the affine part of f at total cost 0."""
        return float(self.at(np.array([self.affine_from]))[0]) - self.slope * self.affine_from

    def at(self, totals: FloatArray) -> FloatArray:
        """Return f at total costs, in the shape of ``totals``.

        Raises:
            ModelError: f does not take an array, falls as the cost grows, or is below 0.
        """
        cost, back = np.unique(totals, return_inverse=True)
        charge = utilities(self.function, cost, "an arrival cost")
        rule = "an arrival cost must be at least 0 and not fall as the total cost grows"
        _check_monotone(charge, np.diff(charge), cost, rule)
        return charge[back].reshape(np.shape(totals))

    @property
    def affine_from_total(self) -> float:
        """Total cost from which f is affine."""
        return self.affine_from

    def of(self, law: CostLaw) -> float:
        """Return E[f(C) | goal] of a law; nan if the goal probability is 0."""
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
        """Description of the measure."""
        return f"{self.level:g}-quantile of the cost given success"

    def of(self, law: CostLaw) -> float:
        """Return the quantile of a law: the least B with Pr(C <= B | goal) >= level."""
        return law.quantile(self.level)


@dataclass(frozen=True)
class TailMeanOf(Measure):
    """The conditional value at risk of the total cost given success: the mean of its upper tail.

    It is the least z + E[(C - z)^+ | goal] / (1 - level) over z, attained at the quantile
    (Rockafellar and Uryasev).
    """

    level: float

    @property
    def words(self) -> str:
        """Description of the measure."""
        return f"conditional value at risk {self.level:g} given success"

    def of(self, law: CostLaw) -> float:
        """Return the mean of the costliest share ``1 - level`` of a law; nan without success."""
        return law.tail_mean(self.level)
