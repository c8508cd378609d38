"""The law of success costs: the exact probability of the goal at each total cost."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from math import inf, isfinite, isnan, nan
from typing import NamedTuple, TypeVar

import numpy as np

from ssp_lp.accumulated_cost.arrivals import (
    UNLIKELY,
    Arrivals,
    LiveChain,
    SumArrivals,
    TooManySumsError,
    cost_of,
)
from ssp_lp.accumulated_cost.charges import Utility, utilities
from ssp_lp.arrays import QUANTILE, FloatArray
from ssp_lp.errors import ModelError, as_percentage, in_short, wrong_argument
from ssp_lp.model.arguments import explained
from ssp_lp.policies.chain import Chain

_UTILITY_LEFT = 1e-13  # relative error of an expected utility at which following ends
_MOST_SUMS = 10_000  # most sums followed one by one, some seconds
_MOST_SUMS_BESIDE = 5_000  # the same if layers, or a policy's own unit, are the alternative
_RAREST = 1e-9  # share of the successes below which the last sums are rounded
_FINE = 2_000  # units of rounded costs in the mean cost
_MOST_UNITS = 20_000  # most units in the most expensive step
_MOST_ROUNDED = 10_000_000  # most waiting masses of rounded costs

_Answer = TypeVar("_Answer")


class Atoms(NamedTuple):
    """Total costs that occur, increasing, with their probabilities."""

    costs: FloatArray  # [atoms]
    probabilities: FloatArray  # [atoms] Pr(goal, C = cost)


@dataclass(frozen=True, eq=False, repr=False)
class CostLaw:
    """The sub-probability law of the total cost C on the runs that reach the goal.

    The missing mass is the failure probability. :attr:`goal`, :attr:`cost` and :meth:`exponential`
    are linear solves on the policy's chain. All other numbers follow the chain's mass through
    layers of the costs' common unit, or through the sums of costs that occur, as far as each number
    needs. The mass followed so far is kept for the next call. This does not change any result.

    Very unlikely sums are rounded up. If there are too many likely sums, every cost is rounded up,
    by less than a two-thousandth of the mean. If the policy itself rounds costs up to a finer unit,
    this unit is used. Rounding never understates a total, a quantile, an excess or the probability
    to exceed a bound, and never overstates a utility.
    """

    _chains: tuple[Chain, ...]  # chains of the members of the lottery
    _weights: FloatArray  # [members]
    _rounded: tuple[Chain, ...] = ()  # chains with costs as the members round them up, if they do

    @property
    def is_finer(self) -> bool:
        """Whether the law has the true costs although the lottery's members round costs up."""
        return bool(self._rounded)

    @cached_property
    def goal(self) -> float:
        """Total mass: the probability of reaching the goal."""
        return self._mean(lambda chain: float(chain.start @ chain.arriving()[0]))

    @cached_property
    def cost(self) -> float:
        """E[C; goal]."""
        return self._mean(lambda chain: float(chain.start @ chain.arriving()[1]))

    @property
    def conditional_mean(self) -> float:
        """E[C | goal]; nan if the goal is never reached."""
        return self.cost / self.goal if self.goal > 0.0 else nan

    @explained
    def within(self, bound: float | Fraction) -> float:
        """Return the distribution function: Pr(goal, C <= bound).

        A float that is the double nearest to a multiple of the unit stands for this multiple: 2/3
        for the unit 1/3, and three steps of 0.1 are within 0.3. Any other float stands for its
        shortest decimal. Fractions are exact.
        """
        if bound == inf:
            return self.goal
        _check_cost_number(bound, "bound")

        def arrived(arrivals: Arrivals) -> float:
            last = arrivals.last_layer(bound)
            for _ in arrivals.followed(last + 1):
                if arrivals.leaps or arrivals.remaining()[0] <= UNLIKELY * self.goal:
                    break
            return arrivals.arrived(last + 1)

        return min(self._answer(arrived), self.goal)

    @explained
    def excess(self, threshold: float) -> float:
        """Return E[(C - threshold)^+; goal], also in the far tail without cancellation."""
        _check_cost_number(threshold, "threshold")
        if threshold == inf:
            return 0.0

        def beyond(arrivals: Arrivals) -> float:
            last = arrivals.last_layer(float(threshold))
            for settled in arrivals.followed(last + 1):
                if settled > last:
                    break
                if arrivals.remaining()[1] <= UNLIKELY * self.cost:
                    return 0.0
                if arrivals.leaps:
                    goal, cost = arrivals.remaining(last + 1)
                    return (cost_of(arrivals, last + 1) - threshold) * goal + cost
            layers, masses = arrivals.atoms()
            settled_excess = np.maximum(arrivals.cost_of(layers) - threshold, 0.0)
            goal, cost = arrivals.remaining()
            return float(masses @ settled_excess) + (arrivals.frontier - threshold) * goal + cost

        return self._answer(beyond)

    @explained
    def quantile(self, level: float) -> float:
        """Return the least B with Pr(C <= B | goal) >= level; nan if the goal is never reached.

        The comparison has a relative tolerance of 1e-12 (``arrays.QUANTILE``), so that an atom at
        which the mass equals the level is not missed. Level 0 gives the least cost.

        Raises:
            ModelError: the level does not lie in [0, 1).
        """
        if not 0.0 <= level < 1.0:
            raise wrong_argument("level", "lie in [0, 1)", level, as_percentage(level))
        if self.goal == 0.0:
            return nan
        needed = level * self.goal * (1.0 - QUANTILE)

        def reached(arrivals: Arrivals) -> float:
            for _ in arrivals.followed():
                layers, masses = arrivals.atoms()
                total = np.cumsum(masses)
                if total.size and total[-1] >= needed:
                    return cost_of(arrivals, layers[np.searchsorted(total, needed)])
                if arrivals.remaining()[0] <= 1e-3 * QUANTILE * self.goal:
                    break
                if arrivals.leaps:
                    return cost_of(arrivals, arrivals.first_reaching(needed))
            return cost_of(arrivals, arrivals.atoms()[0][-1])

        return self._answer(reached)

    @explained
    def tail_mean(self, level: float) -> float:
        """Return the tail mean (CVaR), over the costliest share ``1 - level`` of the successes.

        This is the conditional value at risk (Rockafellar and Uryasev 2000), in which an atom at
        the quantile counts with the part that belongs to the share; nan if the goal is never
        reached.

        Raises:
            ModelError: the level does not lie in [0, 1).
        """
        value = self.quantile(level)
        return value + self.excess(value) / ((1.0 - level) * self.goal) if self.goal > 0.0 else nan

    @explained
    def exponential(self, rate: float) -> float:
        """Return E[exp(rate * C); goal] for rate <= 0, by a linear solve.

        Raises:
            ModelError: a rate above 0, for which the expectation need not be finite.
        """
        if not -inf < rate <= 0.0:
            raise ModelError(f"rate must be a number of at most 0, not {in_short(rate)}")

        def discounted(chain: Chain) -> float:
            """Return E[exp(rate * C); goal] of a chain: exp(rate * cost) discounts each step."""
            lost, factor = chain.per_node(-np.expm1(rate * chain.cost)), np.exp(rate * chain.cost)
            chance, give_up = chain.probability * factor, chain.give_up + lost
            tilted = replace(chain, probability=chance, give_up=give_up)
            hits = tilted.per_node(chain.goal[chain.target])
            return float(chain.start @ (tilted.accumulate(hits, chain.alive) + chain.goal))

        return self._mean(discounted)

    @explained
    def expectation(self, utility: Utility, at_infinity: float) -> float:
        """Return E[utility(C); goal], followed until the rest is negligible.

        Args:
            utility: a non-increasing function of the total cost, on arrays.
            at_infinity: its limit at infinite cost.

        Raises:
            ModelError: the utility is not a finite number for each cost, or it falls so slowly, and
                runs are so long, that the table becomes too large.
        """
        if not isfinite(at_infinity):
            raise ModelError(f"at_infinity must be a finite number, not {in_short(at_infinity)}")
        if self.goal == 0.0:
            return 0.0

        def gain(costs: FloatArray) -> FloatArray:
            """Return the utility minus the utility of infinite cost."""
            return utilities(utility, costs) - at_infinity

        def gained(arrivals: Arrivals) -> float:
            """Return the expected gain, summed until the gain of later arrivals is negligible."""
            for _ in arrivals.followed():
                layers, masses = arrivals.atoms()
                settled_gain = float(masses @ gain(arrivals.cost_of(layers)))
                there = abs(float(gain(np.array([arrivals.frontier]))[0]))
                if arrivals.remaining()[0] * there <= _UTILITY_LEFT * abs(settled_gain):
                    break
            return settled_gain

        return at_infinity * self.goal + self._answer(gained)

    @explained
    def upto(self, bound: float | Fraction) -> Atoms:
        """Return the atoms up to a total cost ``bound``, compared as :meth:`within` does."""
        if bound == inf:
            raise ModelError("the bound must be finite: pass one, or use all_but(mass)")
        _check_cost_number(bound, "bound")

        def atoms(arrivals: Arrivals) -> Atoms:
            last = arrivals.last_layer(bound)
            for _ in arrivals.followed(last + 1):
                pass
            layers, masses = arrivals.atoms()
            within = np.asarray(layers <= last, dtype=np.bool_)
            return Atoms(arrivals.cost_of(layers[within]), masses[within])

        return self._answer(atoms)

    @explained
    def all_but(self, mass: float) -> Atoms:
        """Return the atoms by increasing cost, without the last ones of total mass up to ``mass``.

        Raises:
            ModelError: the mass is not above 0.
        """
        if not float(mass) > 0.0:
            raise wrong_argument("mass", "be above 0", mass, ": give a small one, such as 1e-9")

        def atoms(arrivals: Arrivals) -> Atoms:
            for _ in arrivals.followed():
                if arrivals.remaining()[0] <= mass:
                    break
            layers, masses = arrivals.atoms()
            beyond = np.append(np.cumsum(masses[::-1])[::-1], 0.0) + arrivals.remaining()[0]
            kept = int(np.argmax(beyond <= mass))
            return Atoms(arrivals.cost_of(layers[:kept]), masses[:kept])

        return self._answer(atoms)

    def _mean(self, of: Callable[[Chain], float]) -> float:
        """Return the mean of ``of(chain)`` over the chains of the lottery's members."""
        numbers = zip(self._chains, self._weights, strict=True)
        return sum((float(w) * of(p) for p, w in numbers), start=0.0)

    def _answer(self, function: Callable[[Arrivals], _Answer]) -> _Answer:
        """Return the result of a function on the first sweep for which it does not fail.

        Raises:
            ModelError: the function raises ModelError on every sweep.
        """
        refused = list[ModelError]()
        for sweep in self._sweeps():
            try:
                return function(sweep)
            except ModelError as error:
                refused.append(error)
        raise next(e for e in reversed(refused) if not isinstance(e, TooManySumsError))

    def _sweeps(self) -> Iterator[Arrivals]:
        """Yield the sweeps over the total cost in the order in which they are tried.

        Layers come first, or sums of costs if one step passes many layers. A sweep with rounded
        costs comes last. Each sweep is created when it is needed.
        """
        layers = self._layers
        is_narrow = layers is not None and layers.is_narrow
        if layers is not None and is_narrow:
            yield layers
        yield self._sums
        if layers is not None and not is_narrow:
            yield layers
        if self._rounded or not is_narrow:
            yield self._rounded_sweep

    @cached_property
    def _live(self) -> LiveChain:
        """The chains of the lottery's members as one, without nodes that cannot reach the goal."""
        return LiveChain.of(self._chains, self._weights)

    @cached_property
    def _layers(self) -> Arrivals | None:
        """Arrivals in layers of the common unit; None if there are too many layers."""
        try:
            return Arrivals(self._live, self._exact_costs)
        except ModelError:
            return None

    @cached_property
    def _sums(self) -> SumArrivals:
        """Arrivals at the sums of costs, with unlikely sums rounded up."""
        how = self._live, self._exact_costs, self._coarse_unit
        if (
            self._layers is not None and not self._layers.is_narrow
        ):  # which are exact, and come next
            return SumArrivals(*how, _MOST_SUMS_BESIDE)
        return SumArrivals(*how, _MOST_SUMS_BESIDE if self._rounded else _MOST_SUMS, _RAREST)

    @cached_property
    def _rounded_sweep(self) -> Arrivals:
        """Arrivals with costs rounded up to the finer of the policy's unit and the coarse unit."""
        if self._rounded:
            counted = Arrivals(LiveChain.of(self._rounded, self._weights), self._exact_costs)
            if counted.unit <= self._coarse_unit:
                return counted
        return Arrivals(self._live, {}, self._coarse_unit)

    @cached_property
    def _coarse_unit(self) -> Fraction:
        """Unit to which costs are rounded up if their exact sums are too many."""
        most = max(min(_MOST_UNITS, _MOST_ROUNDED // len(self._live.start)), 1)
        least_unit = float(self._live.paid.max(initial=0.0)) / most
        return Fraction(max(self.conditional_mean / _FINE, least_unit))

    @property
    def _exact_costs(self) -> Mapping[float, Fraction]:
        """Map from float costs of the model to the fractions that they stand for."""
        return self._chains[0].model.exact_costs

    def __repr__(self) -> str:
        """One line: the goal probability and the mean."""
        return f"CostLaw(goal {self.goal:.6g}, mean cost given success {self.conditional_mean:.6g})"


def _check_cost_number(value: float | Fraction, name: str) -> None:
    if isnan(value):
        raise ModelError(f"the {name} must be a number")
