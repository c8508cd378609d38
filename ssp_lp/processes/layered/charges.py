"""What arriving at the goal is charged for the total cost: one process, many criteria.

On the accumulated-cost process (paper, section 3.1.1) a run that reaches the goal at total cost c
is charged ``charge(c)``, one that fails nothing. The total cost itself gives S3P; a step, a kink
or a utility in its place give bounded reach, the conditional value at risk, or GUBS. A negative
charge is a reward. No charge falls as the total cost grows.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

import numpy as np

from ssp_lp.arrays import SAME_TOTAL, BoolArray, FloatArray
from ssp_lp.errors import ModelError

Utility = Callable[[FloatArray], FloatArray]
"""A non-increasing function of the total cost, on arrays."""


def utilities(utility: Utility, costs: FloatArray) -> FloatArray:
    """The utility of each cost, like ``costs``.

    Raises:
        ModelError: the function does not take an array, or does not return as many finite numbers.
    """
    try:
        worth = np.asarray(utility(costs), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ModelError(f"utility must take an array of costs: {error}") from error
    if worth.shape != costs.shape or not np.isfinite(worth).all():
        raise ModelError("utility must map an array of costs to as many finite numbers")
    return worth


@dataclass(frozen=True, eq=False)
class TailValues:
    """What a stationary policy attains from some nodes on, arrays of one shape."""

    goal: FloatArray  # E[gamma^T; goal]
    failure: FloatArray  # 1 - goal, summed by itself: each is exact where it is small
    early: FloatArray  # E[gamma^(T - 1); goal]
    cost: FloatArray  # E[gamma^(T - 1) * cost; goal]
    moment: FloatArray  # E[exp(rate * cost); goal]; 0 where no charge needs it

    @classmethod
    def stacked(
        cls, policies: Sequence[TailValues], seen: Callable[[FloatArray], FloatArray]
    ) -> TailValues:
        """Several policies' values to be charged, one row each, seen by some other index."""
        return cls(
            np.array([seen(p.goal) for p in policies]),
            np.array([seen(p.failure) for p in policies]),
            np.array([seen(p.early) for p in policies]),
            np.array([seen(p.cost) for p in policies]),
            np.array([seen(p.moment) for p in policies]),
        )

    def row(self, number: int) -> TailValues:
        """The values to be charged of one policy of several, whose number is the first index."""
        return TailValues(
            self.goal[number],
            self.failure[number],
            self.early[number],
            self.cost[number],
            self.moment[number],
        )

    def chosen(self, last: BoolArray) -> TailValues:
        """Those of the last policy where ``last``, of the first elsewhere, like ``last``."""
        one, other = self.row(-1), self.row(0)
        return TailValues(
            np.where(last, one.goal, other.goal),
            np.where(last, one.failure, other.failure),
            np.where(last, one.early, other.early),
            np.where(last, one.cost, other.cost),
            np.where(last, one.moment, other.moment),
        )


class Charge(ABC):
    """A non-decreasing function of the total cost, by default affine from some cost on."""

    @property
    def offset(self) -> float:
        """``offset + slope * cost`` is the charge from ``settled`` on."""
        return 0.0

    @property
    def slope(self) -> float:
        """Charge per unit of cost from ``settled`` on."""
        return 0.0

    @property
    def lowest(self) -> float:
        """No charge is less; at most 0."""
        return 0.0

    @property
    def is_concave(self) -> bool:
        """Whether interpolating the charge never exceeds it."""
        return False

    @abstractmethod
    def at(self, totals: FloatArray) -> FloatArray:
        """The charge of total costs, like ``totals``."""

    @property
    def settled(self) -> float | None:
        """Total beyond which the charge is affine; None: never."""
        return 0.0

    def is_affine_beyond(self, total: float) -> bool:
        """Whether the charge is its line at a total already; exponentials only come near theirs."""
        line = self.offset + self.slope * total
        return bool(np.isclose(float(self.at(np.array([total]))[0]), line, rtol=1e-9))

    def lossless(self, price: float) -> float:
        """Total from which on failing is best at a price of it; 0 where the charge is settled."""
        return max((price - self.offset) / self.slope, 0.0) if self.slope > 0.0 else 0.0

    def beyond(self, paid: FloatArray, tail: TailValues) -> FloatArray:
        """E[charge; goal] of following a tail after so much has been paid."""
        linear = self.slope * (tail.cost + paid * tail.early)
        return np.asarray(linear + self.offset * tail.goal if self.offset else linear)


@dataclass(frozen=True)
class TotalCostCharge(Charge):
    """The total cost itself: case S."""

    @property
    def is_concave(self) -> bool:
        """True: a line is concave."""
        return True

    @property
    def slope(self) -> float:
        """1: the charge is the cost."""
        return 1.0

    def at(self, totals: FloatArray) -> FloatArray:
        """The costs themselves."""
        return np.asarray(totals)


TOTAL_COST: Final = TotalCostCharge()


@dataclass(frozen=True)
class LateCharge(Charge):
    """1 for arriving at a cost beyond the bound, 0 else; less 1 for every arrival if rewarded.

    A total within :data:`~ssp_lp.arrays.SAME_TOTAL` of the bound is the bound, summed in another
    way.
    """

    bound: float | Fraction
    rewarded: bool = False

    @property
    def offset(self) -> float:
        """What an arrival beyond the bound is charged."""
        return 0.0 if self.rewarded else 1.0

    @property
    def lowest(self) -> float:
        """What an arrival in time is charged."""
        return self.offset - 1.0

    def at(self, totals: FloatArray) -> FloatArray:
        """Whether the total exceeds the bound."""
        return np.where(np.asarray(totals) <= self.settled, self.lowest, self.offset)

    @property
    def settled(self) -> float:
        """The bound, with room for rounding."""
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

    @property
    def offset(self) -> float:
        """Where the line beyond z meets cost 0."""
        return self.threshold * (1.0 - self.slope)

    @property
    def slope(self) -> float:
        """The slope of the line beyond z."""
        return 1.0 / self.share

    def at(self, totals: FloatArray) -> FloatArray:
        """The integrand."""
        late = np.maximum(np.asarray(totals) - self.threshold, 0.0)
        first = self.threshold if self.first is None else self.first
        return np.asarray(np.clip(totals, first, self.threshold) + late * self.slope)

    @property
    def settled(self) -> float:
        """The threshold."""
        return self.threshold


@dataclass(frozen=True)
class UtilityCharge(Charge):
    """Minus what arriving is worth more than failing, by any utility of the total cost (GUBS).

    Beyond every table the utility is taken to be what it falls to, which understates it.
    """

    utility: Utility
    at_infinity: float
    bonus: float

    @property
    def offset(self) -> float:
        """Minus the bonus."""
        return -self.bonus

    @property
    def lowest(self) -> float:
        """Minus what arriving at no cost is worth."""
        return float(self.at(np.zeros(1))[0])

    def at(self, totals: FloatArray) -> FloatArray:
        """Minus (utility + bonus - utility of failing).

        Raises:
            ModelError: the utility is no non-increasing function with this limit.
        """
        cost, back = np.unique(totals, return_inverse=True)
        worth = utilities(self.utility, cost) - self.at_infinity
        wrong = (worth < 0.0) | np.append(np.diff(worth) > 0.0, False)
        if wrong.any():
            where = float(cost[int(np.argmax(wrong))])
            raise ModelError(
                f"utility must not increase with the cost nor fall below utility_at_infinity = "
                f"{self.at_infinity:g}: it does at cost {where:g}"
            )
        return np.asarray(-(worth + self.bonus))[back].reshape(np.shape(totals))

    @property
    def settled(self) -> None:
        """None: where a utility becomes constant is not known."""
        return


@dataclass(frozen=True)
class ExponentialCharge(Charge):
    """``-(exp(rate * cost) + bonus)``, rate < 0 (eGUBS); what a tail is worth factors exactly."""

    rate: float
    bonus: float

    @property
    def is_concave(self) -> bool:
        """True: it is minus a convex exponential."""
        return True

    @property
    def offset(self) -> float:
        """Minus the bonus, which is what is left in the limit."""
        return -self.bonus

    @property
    def lowest(self) -> float:
        """Minus what arriving at no cost is worth."""
        return -(1.0 + self.bonus)

    def at(self, totals: FloatArray) -> FloatArray:
        """Minus utility and bonus."""
        return np.asarray(-(np.exp(self.rate * np.asarray(totals)) + self.bonus))

    def beyond(self, paid: FloatArray, tail: TailValues) -> FloatArray:
        """``-(exp(rate * paid) * E[exp(rate * cost); goal] + bonus * goal)``."""
        return np.asarray(-(np.exp(self.rate * paid) * tail.moment + self.bonus * tail.goal))
