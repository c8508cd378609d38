"""Constraints on a model, checked, and the rows of a program that they become.

Every row reads ``<coefficients, x> <= bound`` with coefficients >= 0, so that every price of it
makes a cost: a lower bound on a probability is an upper bound on its complement. Visits and costs
have no upper limit of their own, so that nothing bounds them from below in this form.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph import pairs_into
from ssp_lp.processes.failure_semantics import RARE_GOAL, Counting
from ssp_lp.processes.live_rows import costless_pairs

FAILURE_ROW = "failure"
"""Name of the row of the failure budget; no other constraint may bear it."""

OBJECTIVE = "objective"
"""Name of what is minimised, where that is a quantity of its own."""

RESERVED = {
    FAILURE_ROW: "the failure budget",
    OBJECTIVE: "what is minimised",
    "balance": "the rows of flow balance",
    "normaliser": "the row that makes a ratio linear",
}
"""Names of rows that every program has."""


_ROOM = 1e-14  # of a bound and of what its complement is made from


@dataclass(frozen=True, eq=False)
class StepTerm:
    """A cost of steps, as the own cost of a copy of the model."""

    model: SSP
    through: bool = False  # also what is paid after failing

    @property
    def free(self) -> BoolArray:
        """Pairs that cost nothing in the condition, [pairs]."""
        return costless_pairs(self.model)

    def at(self, counting: Counting) -> tuple[FloatArray, float]:
        """Cost of each pair in the condition, [pairs], and at the source."""
        return counting.cost(self.model)


@dataclass(frozen=True, eq=False)
class ArrivalTerm:
    """Arrivals in some states, the start counted; or, as ``others``, endings anywhere else."""

    model: SSP
    states: BoolArray  # [states]
    final: bool = False  # episodes end in all of them
    others: bool = False
    through: bool = False  # also arrivals after failing; ends always are the true ones

    @property
    def free(self) -> BoolArray:
        """Pairs that never arrive where the condition counts, [pairs]; endings are no steps."""
        if self.final:
            return np.ones(self.model.n_pairs, dtype=np.bool_)
        return ~pairs_into(self.model, self.states)

    def at(self, counting: Counting) -> tuple[FloatArray, float]:
        """Probability of arriving where the condition counts, [pairs], and at the source."""
        if self.others:
            return counting.other_endings(self.states)
        return counting.arrivals(self.states)


Term = StepTerm | ArrivalTerm


@dataclass(frozen=True, eq=False)
class UpperRow:
    """``<coefficients, x> <= bound``: terms with weights > 0 and a constant >= 0."""

    name: str
    told: str  # what is bounded, in words
    terms: tuple[tuple[float, Term], ...]
    constant: float
    bound: float
    condition: Condition
    sign: float  # the row is ``offset + sign * quantity``
    offset: float
    direct: UpperRow | None = None  # the same by its own terms; None: no complement is in the row

    @property
    def by_digits(self) -> UpperRow:
        """The condition's row whose bound is not lost in what a complement is made from.

        Its own terms may be negative, where an episode ends.
        """
        direct = self.direct
        is_small = direct is not None and abs(direct.bound) < RARE_GOAL * abs(self.bound)
        return direct if direct is not None and is_small else self

    @property
    def size(self) -> float:
        """Size of the numbers whose rounding decides whether the condition's row is satisfied.

        Where terms of both signs cancel, that is the size of the terms, not of the bound.
        """
        gains = [weight for weight, _ in self.terms] + [self.offset]
        lost = -sum(gain for gain in gains if gain < 0.0)
        return max(abs(self.bound), lost if max(gains) > 0.0 else 0.0)

    @cached_property
    def free(self) -> BoolArray:
        """Pairs of the model that add nothing to the condition's row, [pairs]."""
        result = np.ones(self.condition.model.n_pairs, dtype=np.bool_)
        for _, term in self.terms:
            result &= term.free
        return result

    def activity(self, value: float) -> float:
        """Left side of the condition's row at a value of the quantity."""
        return self.offset + self.sign * value

    def at(self, counting: Counting) -> tuple[FloatArray, float]:
        """Coefficient of each pair in the condition's row, [pairs], and at the source."""
        row, source = np.zeros(len(counting.goal)), 0.0
        if self.constant > 0.0:
            ends, there = counting.endings()
            row, source = self.constant * ends, self.constant * there
        for weight, term in self.terms:
            pairs, there = term.at(counting)
            row, source = row + weight * pairs, source + weight * there
        return row, source


@dataclass(frozen=True, eq=False)
class Condition:
    """A constraint whose words have been looked up in a model."""

    name: str
    model: SSP
    terms: tuple[tuple[float, Term], ...]
    constant: float  # what the quantity is at the start already
    lower: float | None
    upper: float | None

    @property
    def wants_ends(self) -> bool:
        """Whether the condition counts an end other than the goal.

        A policy on its way to such an end has not failed before it is there, though it will not
        reach the goal any more.
        """
        goal = self.model.goal_mask
        return any(
            isinstance(term, ArrivalTerm) and term.others and (term.states & ~goal).any()
            for row in self.rows or (self.minimised(),)
            for _, term in row.terms
        )

    @property
    def least_goal(self) -> float:
        """Goal probability of every policy that satisfies the condition; 0: nothing is implied."""
        goal, weights = self.model.goal_mask, [weight for weight, _ in self.terms]
        among = all(
            isinstance(term, ArrivalTerm) and term.final and not term.others
            and not (term.states & ~goal).any() for _, term in self.terms
        )  # fmt: skip
        if self.lower is None or not among or min(weights, default=0.0) <= 0.0:
            return 0.0
        return (self.lower - self.constant) / sum(weights)

    @cached_property
    def rows(self) -> tuple[UpperRow, ...]:
        """Rows of a condition, one for each bound.

        Raises:
            ModelError: costs or visits are bounded from below.
        """
        rows = []
        if self.upper is not None:
            rows.append(self._row(self.name, 1.0, self.upper))
        if self.lower is not None:
            name = self.name if self.upper is None else f"{self.name}, at least"
            row = self._row(name, -1.0, -self.lower)
            if self.lower == self.upper:  # rounded complements must not contradict each other
                room = _ROOM * max(abs(row.offset), abs(row.bound))
                own = row.direct
                if own is not None:
                    own = replace(own, bound=own.bound + _ROOM * abs(own.bound))
                row = replace(row, bound=row.bound + room, direct=own)
            rows.append(row)
        return tuple(rows)

    def minimised(self) -> UpperRow:
        """The condition's quantity as a row without a bound, to be minimised.

        Raises:
            ModelError: costs or visits would be maximised.
        """
        return self._row(self.name, 1.0, np.inf)

    def _row(self, name: str, sign: float, bound: float) -> UpperRow:
        """A condition's row ``sign * quantity <= bound`` with weights >= 0."""
        terms, own, offset = [], [], 0.0
        for stated, term in self.terms:
            weight = sign * stated
            own.append((weight, term))
            if weight < 0.0:
                if not (isinstance(term, ArrivalTerm) and term.final):
                    raise ModelError(
                        f"constraint {self.name!r} bounds costs, visits or exceeding from below, "
                        "which takes a policy that tosses coins on the way; without accumulated "
                        "costs, a row added to the linear program says so"
                    )
                offset -= weight
                term, weight = replace(term, others=not term.others), -weight
            if weight > 0.0:
                terms.append((weight, term))
        constant = sign * self.constant
        direct = None
        if offset or constant:
            told = self.name if sign > 0.0 else f"- {self.name}"
            less, plain = bound - constant, tuple(own)
            direct = UpperRow(name, told, plain, 0.0, less, self, sign, offset=-constant)
        shift = max(-constant, 0.0)  # no coefficient may be negative
        size, bound = max(offset, shift, abs(bound)), bound + offset + shift
        bound = 0.0 if -_ROOM * size <= bound < 0.0 else bound  # the rounding of a complement
        offset += shift
        told = f"{f'{offset:g} ' if offset else ''}{'+' if sign > 0.0 else '-'} {self.name}"
        told = self.name if sign > 0.0 and offset == 0.0 else told
        restated = tuple(terms), constant + shift, bound
        return UpperRow(name, told, *restated, self, sign, offset, direct)
