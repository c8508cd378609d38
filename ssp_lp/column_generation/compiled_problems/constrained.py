"""A problem with rows compiled: its process written out, and what each row takes of its pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray
from ssp_lp.column_generation.compiled_problems.compiled_problem import (
    LeastFailure,
    checked_least_failure,
)
from ssp_lp.column_generation.compiled_problems.failure_label import CompiledFailureLabel
from ssp_lp.column_generation.pricing.constrained import ConstrainedPricing
from ssp_lp.errors import InfeasibleError, ModelError
from ssp_lp.model import SSP
from ssp_lp.processes.failure_label import FailureLabelled, counting_of, label_failure
from ssp_lp.processes.failure_semantics import Aim, FailureSemantics, survival_of
from ssp_lp.processes.goal_reach import (
    ReachPolicy,
    cheapest,
    greatest_goal_reach,
    least_goal_reach,
)
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost, accumulate_cost
from ssp_lp.processes.layered.arrival_cost import Charge
from ssp_lp.processes.layered.open_ended import OpenEnded
from ssp_lp.processes.quantities.conditions import FAILURE_ROW, UpperRow

ATTAINABLE = 1e-10
"""A bound this much below the least attainable total, relative to it, counts as equal to it."""

_MOST_PAIRS = 20_000_000
"""Pairs of a process that is written out."""

_FIRST_LAYERS = 64  # of accumulated cost, where nothing says how many are needed
_TYPICAL = 2.5  # layers of a first attempt, in costs given success of the safest policy


@dataclass(frozen=True, eq=False)
class CompiledConstrained:
    """Minimise a cost, failure and other quantities limited; a budget of None: at least failure.

    Without a charge this is case M and its kin: failure label (paper, section 3.1.2), nothing
    truncated. With one, arriving is charged for the total cost (section 3.1.1): the objective is
    E[charge; goal], or, as ``ratio``, E[charge | goal], on a process that is cut at ``cap`` layers.
    """

    model: SSP
    start: FloatArray  # [states]
    semantics: FailureSemantics
    discount: float | None
    side: tuple[UpperRow, ...]
    budget: float | None
    precise: bool = False  # compare pairs in twice the working precision
    charge: Charge | None = None
    ratio: bool = False
    cap: int | None = None  # layers; None: a first guess
    fixed_cap: float | None = None  # the user's cap on accumulated cost

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the rows: the failure row, limited or not, then the others."""
        return (FAILURE_ROW, *(row.name for row in self.side))

    @property
    def constant(self) -> float | None:
        """What is maximised is this, less what is minimised; None where little is better."""
        if self.semantics.aim is Aim.GREATEST_GOAL:
            return 1.0
        measure = self.semantics.measure
        if measure is None or not measure.maximised:
            return None
        return measure.failing + self.shift

    @property
    def shift(self) -> float:
        """What every episode is charged on top, so that no charge is negative."""
        return 0.0 if self.charge is None else max(-self.charge.lowest, 0.0)

    def worth(self, value: float) -> float:
        """The problem's objective where what is minimised has a value."""
        return value if self.constant is None else self.constant - value

    @property
    def told(self) -> tuple[str, ...]:
        """What the rows bound, in words."""
        return (FAILURE_ROW, *(row.told for row in self.side))

    @property
    def bounds(self) -> FloatArray:
        """Bound of each row, infinite where nothing is limited, [rows]."""
        unlimited = self.budget is None or self.budget >= 1.0
        budget = np.inf if unlimited or self.budget is None else max(self.budget, 0.0)
        return np.array([budget, *(row.bound for row in self.side)])

    @cached_property
    def least(self) -> LeastFailure:
        """The policy of least failure that is cheapest, whatever else it takes.

        Raises:
            InfeasibleError: the budget is below it.
        """
        return checked_least_failure(self._labelled_problem, self.budget)

    @property
    def _labelled_problem(self) -> CompiledFailureLabel:
        return CompiledFailureLabel(self.model, self.start, self.semantics, self.discount)

    def settled(self) -> CompiledConstrained:
        """The compiled at least failure, where the budget does not exceed that.

        However little it exceeds it, failing may be worth much more than that is.

        Raises:
            InfeasibleError: the budget is below the least failure by more than rounding; case S,
                and the goal cannot be reached; or failing is forbidden and cannot be avoided.
        """
        if self.semantics.forbids_failing:
            self._labelled_problem.check_sure()
        if self.ratio and self.greatest_goal <= 0.0:
            raise InfeasibleError(
                "the goal cannot be reached from the start: no cost given success exists",
                failure_budget=self.budget,
                least_failure=1.0,
            )
        if self.budget is None or self.budget >= 1.0:
            return self
        at_least = self.budget <= self.least.column.failure
        return replace(self, budget=None) if at_least else self

    @cached_property
    def greatest_goal(self) -> float:
        """The greatest goal probability, discounted where the problem is, bounded from above."""
        reach = greatest_goal_reach(self.model, survival_of(self.discount))
        return float(self.start @ np.maximum(reach.goal, reach.bound))

    @cached_property
    def least_goal(self) -> float:
        """A goal probability that every policy within the budget exceeds, or has."""
        survival = survival_of(self.discount)
        if self.budget is None:
            reach = greatest_goal_reach(self.model, survival).goal
            return float(self.start @ reach) * (1.0 - ATTAINABLE)
        least = float(self.start @ least_goal_reach(self.model, survival).bound)
        return max(1.0 - self.budget, least, 0.0)

    @cached_property
    def _usable(self) -> BoolArray | None:
        """Pairs that attain the least failure, where only they may be used, [model pairs]."""
        if self.budget is not None:
            return None
        return greatest_goal_reach(self.model, survival_of(self.discount)).usable

    @cached_property
    def _shared(self) -> BoolArray:
        """Pairs that are free in all rows, [model pairs]."""
        shared = np.ones(self.model.n_pairs, dtype=np.bool_)
        for row in self.side:
            shared &= row.free
        return shared

    @cached_property
    def augmented(self) -> FailureLabelled | OpenEnded:
        """The process, in which only what is free in everything counted is collapsed."""
        if self.charge is None:
            setting = self.start, self.semantics, self.discount
            return label_failure(self.model, *setting, self._usable, self._shared)
        return OpenEnded(self.base, self.charge, self.shift, self.layers, self.start)

    @cached_property
    def pricing(self) -> ConstrainedPricing:
        """Policy iteration on the process with a price for each row."""
        augmented = self.augmented
        process = augmented.process
        rewards = [process.cost, process.failure, *self.row_coefficients(self.side)]
        return ConstrainedPricing(augmented, np.stack(rewards, axis=1), self.precise)

    def row_coefficients(self, rows: Sequence[UpperRow]) -> list[FloatArray]:
        """What rows take of each pair of the process, [process pairs] each."""
        augmented = self.augmented
        if isinstance(augmented, OpenEnded):
            counting = augmented.counting()
            return [augmented.everywhere(*row.at(counting)) for row in rows]
        counting = counting_of(augmented, self.start, self.semantics, self.discount)
        n_pairs = augmented.process.n_pairs
        found = [row.at(counting) for row in rows]
        return [np.append(row, source)[:n_pairs] for row, source in found]

    @cached_property
    def base(self) -> AccumulatedCost:
        """One layer of the process on accumulated cost."""
        return accumulate_cost(
            self.model,
            self.start,
            self.discount,
            arrivals=self.semantics.measure is not None,
            usable=self._usable,
            also_free=self._shared,
        )

    @cached_property
    def _safest(self) -> ReachPolicy:
        survival = survival_of(self.discount)
        return cheapest(self.model, greatest_goal_reach(self.model, survival), survival)

    @cached_property
    def layers(self) -> int:
        """Layers of accumulated cost that are told apart.

        Raises:
            ModelError: the process would be too large to be written out.
        """
        layers = self._first_guess() if self.cap is None else self.cap
        n_pairs = (layers + 1) * len(self.base.gain)
        if n_pairs > _MOST_PAIRS:
            raise ModelError(
                f"{layers:,} layers of accumulated cost (unit {self.base.unit:g}) make {n_pairs:,} "
                "pairs, too many to be written out with rows; a coarser grid of costs makes it less"
            )
        return layers

    def _first_guess(self) -> int:
        """As many layers as the charge needs to settle, and some more where it still grows."""
        if self.charge is None:
            return 1
        unit = self.base.exact_unit
        if self.fixed_cap is not None:
            return max(int(np.ceil(self.fixed_cap / self.base.unit)), 1)
        settled = self.charge.settled(unit)
        if settled is None or not self._is_affine_from(settled):
            return _FIRST_LAYERS + self.base.width
        if self.charge.slope == 0.0:
            return max(settled, 1)
        cost, goal = (float(self.start @ v) for v in (self._safest.cost, self._safest.goal))
        typical = int(min(_TYPICAL * cost / max(goal, 1e-300) / self.base.unit, 1e15))
        return max(settled, 1) + typical + self.base.width

    def refined(self) -> CompiledConstrained | None:
        """Twice as many layers; None where nothing is truncated or no more can be written out."""
        if self.charge is None or self._is_lossless or self.fixed_cap is not None:
            return None
        wanted = 2 * self.layers
        if (wanted + 1) * len(self.base.gain) > _MOST_PAIRS:
            return None
        return self.with_layers(wanted)

    @property
    def _is_lossless(self) -> bool:
        """Whether the charge is constant from the cap on."""
        charge = self.charge
        if charge is None or charge.slope > 0.0:
            return charge is None
        settled = charge.settled(self.base.exact_unit)
        return settled is not None and self.layers >= settled and self._is_affine_from(settled)

    def _is_affine_from(self, layer: int) -> bool:
        """Whether the charge is its line there already; exponentials only come near to theirs."""
        charge, unit = self.charge, self.base.exact_unit
        if charge is None:
            return True
        line = charge.offset + charge.slope * float(layer * unit)
        return bool(np.isclose(float(charge.at(np.array([layer]), unit)[0]), line, rtol=1e-9))

    def with_layers(self, cap: int) -> CompiledConstrained:
        """The same with another cap."""
        return self._handing_on(replace(self, cap=cap))

    def matching(self, values: FloatArray) -> CompiledConstrained:
        """The same with as many layers as a value function of its process, [process states].

        Raises:
            ModelError: no number of layers makes so many states.
        """
        if self.charge is None:
            return self
        layers, odd = divmod(values.size - 1, max(self.base.n_nodes, 1))
        if values.ndim != 1 or odd or layers < 2:
            raise ModelError("a value function of [(layers + 1) x nodes + 1] is needed")
        return self.with_layers(layers - 1)

    def charging(self, charge: Charge) -> CompiledConstrained:
        """The same with another charge, if its arrivals lie on the lattice of costs."""
        return self._handing_on(replace(self, charge=charge, cap=None))

    def _handing_on(self, other: CompiledConstrained) -> CompiledConstrained:
        """Hand what depends on neither charge nor cap to a copy."""
        names = ("least", "greatest_goal", "least_goal", "_usable", "_shared", "_safest", "base")
        vars(other).update((name, vars(self)[name]) for name in names if name in vars(self))
        return other
