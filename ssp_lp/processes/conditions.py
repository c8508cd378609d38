"""Checked constraints on a model, and their rows in a program.

Every row is ``<coefficients, x> <= bound`` with coefficients >= 0, so that it adds a non-negative
cost at every price >= 0. A lower bound on a probability is stated as an upper bound on its
complement. Visits and costs are unbounded and have no complement, so they cannot be bounded from
below.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssp_lp.arrays import ROUNDED, BoolArray, FloatArray
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph import pairs_into
from ssp_lp.processes.failure_semantics import RARE_GOAL, Counting
from ssp_lp.processes.live_rows import costless_pairs

FAILURE_ROW = "failure"
"""Name of the row of the failure budget; no other constraint may have it."""

OBJECTIVE = "objective"
"""Name of the objective if it is a quantity."""

RESERVED = {
    FAILURE_ROW: "the failure budget",
    OBJECTIVE: "the objective",
    "balance": "the rows of flow balance",
    "normaliser": "the row that makes a ratio linear",
}
"""Names of rows that every program has, with their meaning."""


@dataclass(frozen=True, eq=False)
class StepTerm:
    """A total of step costs: the own cost of ``model``, a copy of the model with other costs."""

    model: SSP
    through: bool = False  # also costs after failing

    @property
    def free(self) -> BoolArray:
        """Mask of the pairs that cost nothing, [pairs]."""
        return costless_pairs(self.model)

    def at(self, counting: Counting) -> tuple[FloatArray, float]:
        """Return the expected cost of each process pair, [pairs], and a cost of the start.

        The cost of the start is due to episodes that begin in a dead-end and end there.
        """
        return counting.cost(self.model)


@dataclass(frozen=True, eq=False)
class ArrivalTerm:
    """A number of arrivals in a set of states; an episode that begins there has arrived once.

    If ``others``, the term is the number of episodes that end outside the set instead.
    """

    model: SSP
    states: BoolArray  # [states]
    final: bool = False  # episodes end in all of them
    others: bool = False
    through: bool = False  # also arrivals after failing; ends are always the true ends

    @property
    def free(self) -> BoolArray:
        """Mask of the pairs by which a policy may stay for ever without an arrival, [pairs].

        These are the pairs that cannot lead into the set; if episodes end in all states of the set,
        all pairs.
        """
        if self.final:
            return np.ones(self.model.n_pairs, dtype=np.bool_)
        return ~pairs_into(self.model, self.states)

    def at(self, counting: Counting) -> tuple[FloatArray, float]:
        """Return the probability that each process pair arrives in the set, [pairs].

        The second result is the probability that an episode begins in the set and ends there.
        """
        if self.others:
            return counting.other_endings(self.states)
        return counting.arrivals(self.states)


Term = StepTerm | ArrivalTerm


@dataclass(frozen=True, eq=False)
class UpperRow:
    """A row: the sum of weight * term over the terms, plus a constant >= 0, is at most the bound.

    The weights are > 0, except in ``direct``.
    """

    name: str
    text: str  # description of the limited quantity
    terms: tuple[tuple[float, Term], ...]
    constant: float
    bound: float
    condition: Condition
    sign: float  # the row is ``offset + sign * quantity``
    offset: float
    direct: UpperRow | None = None  # the row without complements; None: it has none

    @property
    def by_digits(self) -> UpperRow:
        """The row itself or, if its bound has few digits, the equivalent row without complements.

        A lower bound of a small probability is an upper bound near 1 of its complement, and loses
        digits. Without the complement the bound keeps its digits, but coefficients may be negative.
        """
        direct = self.direct
        is_small = direct is not None and abs(direct.bound) < RARE_GOAL * abs(self.bound)
        return direct if direct is not None and is_small else self

    @property
    def size(self) -> float:
        """Magnitude of the row, to which its feasibility tolerance is relative.

        It is the absolute value of the bound or, if terms of both signs cancel, the magnitude of
        the terms if this is greater.
        """
        gains = [weight for weight, _ in self.terms] + [self.offset]
        lost = -sum(gain for gain in gains if gain < 0.0)
        return max(abs(self.bound), lost if max(gains) > 0.0 else 0.0)

    @cached_property
    def free(self) -> BoolArray:
        """Mask of the pairs of the model that add nothing to the row, [pairs]."""
        result = np.ones(self.condition.model.n_pairs, dtype=np.bool_)
        for _, term in self.terms:
            result &= term.free
        return result

    def activity(self, value: float) -> float:
        """Return the left side of the row for a value of the limited quantity."""
        return self.offset + self.sign * value

    def at(self, counting: Counting) -> tuple[FloatArray, float]:
        """Return the coefficient of each process pair, [pairs], and an amount for the start.

        The amount is due to episodes that end where they begin.
        """
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
    """A constraint whose names of states, labels and costs have been looked up in a model."""

    name: str
    model: SSP
    terms: tuple[tuple[float, Term], ...]
    constant: float  # value of the quantity at the start
    lower: float | None
    upper: float | None

    @property
    def wants_ends(self) -> bool:
        """Whether the constraint counts ends other than the goal.

        If so, a policy that can no longer reach the goal goes on until an end, and fails only
        there.
        """
        goal = self.model.goal_mask
        return any(
            isinstance(term, ArrivalTerm) and term.others and (term.states & ~goal).any()
            for row in self.rows or (self.minimised(),)
            for _, term in row.terms
        )

    @property
    def least_goal(self) -> float:
        """Least goal probability that the constraint implies; 0 if it implies none."""
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
        """Rows of the constraint, one for each bound.

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
                room = ROUNDED * max(abs(row.offset), abs(row.bound))
                own = row.direct
                if own is not None:
                    own = replace(own, bound=own.bound + ROUNDED * abs(own.bound))
                row = replace(row, bound=row.bound + room, direct=own)
            rows.append(row)
        return tuple(rows)

    def minimised(self) -> UpperRow:
        """Return the quantity as a row without a bound, for an objective.

        Raises:
            ModelError: costs or visits would be maximised.
        """
        return self._row(self.name, 1.0, np.inf)

    def _row(self, name: str, sign: float, bound: float) -> UpperRow:
        """Return the row ``sign * quantity <= bound`` with weights >= 0."""
        terms, own, offset = [], [], 0.0
        for stated, term in self.terms:
            weight = sign * stated
            own.append((weight, term))
            if weight < 0.0:
                if not (isinstance(term, ArrivalTerm) and term.final):
                    raise ModelError(
                        f"constraint {self.name!r} bounds costs, visits or exceeds(...) from "
                        "below: add a row of your own to problem.program() instead (criteria of "
                        "the total cost have no such rows)"
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
        bound = 0.0 if -ROUNDED * size <= bound < 0.0 else bound  # rounding of the complement
        offset += shift
        told = f"{f'{offset:g} ' if offset else ''}{'+' if sign > 0.0 else '-'} {self.name}"
        told = self.name if sign > 0.0 and offset == 0.0 else told
        restated = tuple(terms), constant + shift, bound
        return UpperRow(name, told, *restated, self, sign, offset, direct)
