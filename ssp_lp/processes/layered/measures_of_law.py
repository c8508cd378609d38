"""What is made of the law of the total cost: criteria beyond its mean.

Each measure is a number of the *law of success costs* of a policy, the sub-probability law of the
total cost C on the runs that reach the goal; what is missing from it is the failure probability.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import ClassVar, Protocol

from ssp_lp.processes.layered.charges import (
    TOTAL_COST,
    Charge,
    ExponentialCharge,
    LateCharge,
    Utility,
    UtilityCharge,
)


class Law(Protocol):
    """The law of success costs, as far as measures need it."""

    @property
    def goal(self) -> float:
        """The probability of reaching the goal."""
        ...

    @property
    def cost(self) -> float:
        """E[C; goal]."""
        ...

    def within(self, bound: float | Fraction) -> float:
        """Pr(goal, C <= bound), the comparison made exactly on the lattice of costs."""
        ...

    def excess(self, threshold: float) -> float:
        """E[(C - threshold)^+; goal]."""
        ...

    def quantile(self, level: float) -> float:
        """The least B with Pr(C <= B | goal) >= level; nan where the goal is never reached."""
        ...

    def exponential(self, rate: float) -> float:
        """E[exp(rate * C); goal], rate < 0."""
        ...

    def expectation(self, utility: Utility, at_infinity: float) -> float:
        """E[utility(C); goal], where the utility falls to ``at_infinity``."""
        ...


class Measure(Protocol):
    """A number of the law of success costs."""

    @property
    def maximised(self) -> bool:
        """Whether more is better."""
        ...

    @property
    def failing(self) -> float:
        """What a run that fails is worth, where the measure is an expectation."""
        ...

    @property
    def words(self) -> str:
        """What is asked, in words."""
        ...

    @property
    def charge(self) -> Charge:
        """What arriving at the goal is charged in the process; of a search, to begin with."""
        ...

    def of(self, law: Law) -> float:
        """The measure of a law of costs."""
        ...


@dataclass(frozen=True)
class WithinBound:
    """Pr(the goal is reached at a total cost of at most ``bound``)."""

    bound: float | Fraction
    maximised: ClassVar[bool] = True
    failing: ClassVar[float] = 0.0

    @property
    def words(self) -> str:
        """What is asked."""
        return f"goal within cost {float(self.bound):g}"

    @property
    def charge(self) -> Charge:
        """Minus 1 for arriving in time."""
        return LateCharge(self.bound, rewarded=True)

    def of(self, law: Law) -> float:
        """The probability."""
        return law.within(self.bound)


@dataclass(frozen=True)
class ExpectedUtility:
    """E[utility of the total cost] + bonus * Pr(goal); a run that fails costs infinity (GUBS)."""

    utility: Utility
    bonus: float
    at_infinity: float
    maximised: ClassVar[bool] = True

    @property
    def failing(self) -> float:
        """The utility of an infinite cost."""
        return self.at_infinity

    @property
    def words(self) -> str:
        """What is asked."""
        return f"expected utility, goal bonus {self.bonus:g}"

    @property
    def charge(self) -> Charge:
        """Minus what arriving is worth beyond failing."""
        return UtilityCharge(self.utility, self.at_infinity, self.bonus)

    def of(self, law: Law) -> float:
        """The expected utility."""
        reached = law.expectation(self.utility, self.at_infinity) + self.bonus * law.goal
        return reached + self.at_infinity * (1.0 - law.goal)


@dataclass(frozen=True)
class ExponentialUtility:
    """E[exp(rate * total cost); goal] + bonus * Pr(goal), rate < 0 (eGUBS)."""

    rate: float
    bonus: float
    maximised: ClassVar[bool] = True
    failing: ClassVar[float] = 0.0

    @property
    def words(self) -> str:
        """What is asked."""
        return f"utility exp({self.rate:g} cost), goal bonus {self.bonus:g}"

    @property
    def charge(self) -> Charge:
        """Minus what arriving is worth."""
        return ExponentialCharge(self.rate, self.bonus)

    def of(self, law: Law) -> float:
        """The expected utility."""
        return law.exponential(self.rate) + self.bonus * law.goal


@dataclass(frozen=True)
class CostQuantileOf:
    """The level-quantile of the total cost given success."""

    level: float
    maximised: ClassVar[bool] = False
    failing: ClassVar[float] = float("inf")

    @property
    def words(self) -> str:
        """What is asked."""
        return f"{self.level:g}-quantile of the cost given success"

    @property
    def charge(self) -> Charge:
        """The total cost."""
        return TOTAL_COST

    def of(self, law: Law) -> float:
        """The least B with Pr(C <= B | goal) >= level."""
        return law.quantile(self.level)


@dataclass(frozen=True)
class TailMeanOf:
    """The conditional value at risk of the total cost given success: the mean of its worst share.

    By Rockafellar and Uryasev's formula it is z + E[(C - z)^+ | goal] / (1 - level) at the
    quantile z, and the least of these over all z.
    """

    level: float
    maximised: ClassVar[bool] = False
    failing: ClassVar[float] = float("inf")

    @property
    def words(self) -> str:
        """What is asked."""
        return f"conditional value at risk {self.level:g} given success"

    @property
    def charge(self) -> Charge:
        """The total cost."""
        return TOTAL_COST

    def of(self, law: Law) -> float:
        """The mean of the worst ``1 - level`` of the runs that succeed; nan if none does."""
        if law.goal == 0.0:
            return float("nan")
        value = law.quantile(self.level)
        return value + law.excess(value) / ((1.0 - self.level) * law.goal)
