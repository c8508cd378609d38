"""A problem with rows compiled: its process written out, and what each row takes of its pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray
from ssp_lp.column_generation.compiled_problems.compiled_failure_label import CompiledFailureLabel
from ssp_lp.column_generation.compiled_problems.compiled_problem import (
    LeastFailure,
    checked_least_failure,
)
from ssp_lp.column_generation.pricing.explicit_pricing import ExplicitPricing
from ssp_lp.errors import InfeasibleError, ModelError
from ssp_lp.model import SSP
from ssp_lp.processes.failure_label import FailureLabelled, counting_of, label_failure
from ssp_lp.processes.failure_semantics import (
    Aim,
    FailureSemantics,
    ObjectiveSense,
    survival_of,
)
from ssp_lp.processes.goal_reach import (
    GoalReach,
    cheapest_reach,
    greatest_goal_reach,
    least_goal_reach,
)
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost, accumulate_cost
from ssp_lp.processes.layered.charges import Charge
from ssp_lp.processes.layered.open_ended import OpenEnded, first_cap, first_total, truncates
from ssp_lp.processes.quantities.conditions import FAILURE_ROW, UpperRow
from ssp_lp.processes.totals.ladder import Ladder, Rungs

ATTAINABLE = 1e-10
"""A bound this much below the least attainable total, relative to it, counts as equal to it."""

_MOST_PAIRS = 20_000_000
"""Pairs of a process that is written out."""

_ROOM = 6_000_000  # pairs of a process on levels, each of which is priced many times
_OWN = {"augmented", "pricing", "ladder", "layers"}  # what depends on charge, cap or rungs


@dataclass(frozen=True, eq=False)
class CompiledConstrained:
    """Minimise a cost, failure and other quantities limited; a budget of None: at least failure.

    Without a charge this is case M (paper, section 3.1.2), nothing truncated. With one, arriving is
    charged for the total cost (section 3.1.1), E[charge; goal], or E[charge | goal] as ``ratio``.
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
    objective: UpperRow | None = None  # minimised in place of the cost; no charge then
    rungs: Rungs | None = None  # totals that are no multiples of a unit

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the rows: the failure row, limited or not, then the others."""
        return (FAILURE_ROW, *(row.name for row in self.side))

    @property
    def sense(self) -> ObjectiveSense:
        """How what is minimised stands for what is asked."""
        measure, charge = self.semantics.measure, self.charge
        shift = 0.0 if charge is None else max(-charge.lowest, 0.0)
        if self.objective is not None:
            return ObjectiveSense(None, shift, self.objective.offset)
        if self.semantics.aim is Aim.GREATEST_GOAL:
            return ObjectiveSense(1.0, shift)
        maximised = measure is not None and measure.maximised
        return ObjectiveSense(measure.failing + shift if measure and maximised else None, shift)

    @property
    def wants_ends(self) -> bool:
        """Whether a row, or the objective, asks for an end that is not the goal."""
        rows = self.side if self.objective is None else (*self.side, self.objective)
        return any(row.condition.wants_ends for row in rows)

    @property
    def told(self) -> tuple[str, ...]:
        """What the rows bound, in words."""
        return (FAILURE_ROW, *(row.told for row in self.side))

    @property
    def bounds(self) -> FloatArray:
        """Bound of each row, infinite where nothing is limited, [rows]."""
        limited = self.budget is not None and self.budget < 1.0
        budget = max(self.budget or 0.0, 0.0) if limited else np.inf
        return np.array([budget, *(row.bound for row in self.side)])

    @cached_property
    def least(self) -> LeastFailure:
        """The cheapest policy of least failure; InfeasibleError where the budget is below it."""
        return checked_least_failure(self._labelled, self.budget)

    @property
    def _labelled(self) -> CompiledFailureLabel:
        """The compiled problem without constraints, with a label for failing."""
        return CompiledFailureLabel(self.model, self.start, self.semantics, self.discount)

    def settled(self) -> CompiledConstrained:
        """The same at least failure, where the budget does not exceed that.

        Raises:
            InfeasibleError: the budget is below the least failure by more than rounding; case S,
                and the goal cannot be reached; or failing is forbidden and cannot be avoided.
        """
        if self.semantics.forbids_failing:
            self._labelled.check_sure()
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
        reach = self.greatest
        return float(self.start @ np.maximum(reach.goal, reach.bound))

    @cached_property
    def greatest(self) -> GoalReach:
        """The greatest goal probability from the start, and the pairs that attain it."""
        return greatest_goal_reach(self.model, survival_of(self.discount), self.start)

    @cached_property
    def least_goal(self) -> float:
        """A goal probability that every policy within the budget exceeds, or has."""
        least = float(self.start @ self._least_goals)
        return max(least, 0.0) if self.budget is None else max(1.0 - self.budget, least, 0.0)

    @cached_property
    def _least_goals(self) -> FloatArray:
        """A goal probability that every policy that counts attains, [states]."""
        if self.budget is None:
            return self.greatest.goal * (1.0 - ATTAINABLE)
        return least_goal_reach(self.model, survival_of(self.discount)).bound

    @cached_property
    def _usable(self) -> BoolArray | None:
        """Pairs that attain the least failure, where only they may be used, [model pairs]."""
        return None if self.budget is not None else self.greatest.usable

    @cached_property
    def augmented(self) -> FailureLabelled | OpenEnded:
        """The process, in which only what is free in everything counted is collapsed."""
        if self.charge is None:
            setting = self.start, self.semantics, self.discount, self._usable
            return label_failure(self.model, *setting, self.side, self.objective)
        how = self.base, self.charge, self.sense.shift, self.layers, self.start
        return OpenEnded(*how, self.ladder, self._least_goals)

    @property
    def is_rounded(self) -> bool:
        """Whether totals are rounded, so that policies are other than the process has them."""
        return self.ladder is not None and not self.ladder.exact

    @cached_property
    def ladder(self) -> Ladder | None:
        """The totals that are told apart, where they are no multiples of a unit."""
        if self.rungs is None or self.charge is None:
            return None
        first = first_total(self.charge, self.typical_cost)
        return self.rungs.ladder(self.model, first, self._room, grows=self.charge.slope > 0.0)

    @property
    def _room(self) -> int:
        """How many levels of the total a constrained problem has room for."""
        return max(_ROOM // max(len(self.base.gain), 1), 2)  # levels

    @cached_property
    def pricing(self) -> ExplicitPricing:
        """Policy iteration on the process with a price for each row."""
        counted = None
        if self.objective is not None:
            (counted,) = self.row_coefficients((self.objective,))
        rows = tuple(self.row_coefficients(self.side))
        return ExplicitPricing(self.augmented, self.precise, rows, counted)

    @property
    def own_cost(self) -> FloatArray:
        """What is minimised without the shift, [process pairs]."""
        augmented = self.augmented
        return augmented.own_cost if isinstance(augmented, OpenEnded) else augmented.process.cost

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
            side=self.side,
            by_steps=self.rungs is not None,
        )

    @cached_property
    def typical_cost(self) -> float:
        """The cost given success of the policy that fails least."""
        survival = survival_of(self.discount)
        safest = cheapest_reach(self.model, self.greatest, survival)
        return float(self.start @ safest.cost) / max(float(self.start @ safest.goal), 1e-300)

    @cached_property
    def layers(self) -> int:
        """Layers of accumulated cost that are told apart; ModelError: too many to write out."""
        layers = self.cap if self.ladder is None else self.ladder.size
        if layers is None:
            layers = first_cap(self.base, self.charge, self.typical_cost, self.fixed_cap)
        n_pairs = (layers + 1) * len(self.base.gain)
        if n_pairs > _MOST_PAIRS:
            raise ModelError(
                f"{layers:,} layers of accumulated cost (unit {self.base.unit:g}) make {n_pairs:,} "
                "pairs, too many to be written out with rows; a coarser grid of costs makes it less"
            )
        return layers

    def refined(self, price: float) -> CompiledConstrained | None:
        """More layers; None where nothing is truncated or no more can be written out.

        Args:
            price: what failing is worth, from which accumulated cost on it is best to fail.
        """
        if self.charge is None or self.fixed_cap is not None:
            return None
        end = self.layers * self.base.unit if self.ladder is None else float(self.ladder.rungs[-1])
        cut = truncates(self.charge, end)
        if self.rungs is not None and self.ladder is not None:
            enough = self.charge.lossless(price) if cut else None
            finer = self.rungs.finer(self.ladder, enough, self._room)
            return None if finer is None else self._handing_on(replace(self, rungs=finer))
        wanted = 2 * self.layers
        if not cut or (wanted + 1) * len(self.base.gain) > _MOST_PAIRS:
            return None
        return self.with_layers(wanted)

    def up_to(self, price: float) -> CompiledConstrained:
        """The same with totals up to where failing is best, at a price that is about right."""
        if self.rungs is None or self.charge is None:
            return self
        return replace(self, rungs=self.rungs.up_to(self.charge.lossless(price)))

    def with_layers(self, cap: int) -> CompiledConstrained:
        """The same with another cap."""
        return self._handing_on(replace(self, cap=cap))

    def matching(self, values: FloatArray, levels: FloatArray | None = None) -> CompiledConstrained:
        """The same with as many layers as a value function has, [process states]; or ModelError."""
        if self.charge is None or self.rungs is not None:
            return self
        nodes = self.base.n_nodes
        layers, odd = divmod(values.size - 1, nodes) if nodes else (2, values.size - 1)
        if values.ndim != 1 or odd or layers < 2:
            raise ModelError("a value function of [(layers + 1) x nodes + 1] is needed")
        return self.with_layers(layers - 1)

    def charging(self, charge: Charge) -> CompiledConstrained:
        """The same with another charge, if its arrivals lie on the lattice of costs."""
        return self._handing_on(replace(self, charge=charge, cap=None))

    def _handing_on(self, other: CompiledConstrained) -> CompiledConstrained:
        """Hand what depends on neither charge nor cap to a copy."""
        shared = vars(self).keys() - vars(other).keys() - _OWN
        vars(other).update((name, vars(self)[name]) for name in shared)
        return other
