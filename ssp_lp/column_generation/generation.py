"""Column generation (Dantzig-Wolfe): one loop, at prices that a rule says.

Deterministic policies are the columns. A rule keeps the best lottery over those that are known,
and from it says at which prices of the rows the next one is sought; the loop ends when none lies
below the rule's own valuation. There are two: ``secant`` for the failure row alone, and
``stabilised_master`` for any rows.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ssp_lp.arrays import FloatArray
from ssp_lp.column_generation.pricing.pricing_problem import Column, PricingProblem
from ssp_lp.compiled.deadline import STOPS, heed, is_late
from ssp_lp.options import SolveOptions
from ssp_lp.policies import MixedPolicy

if TYPE_CHECKING:
    from ssp_lp.column_generation.secant import Secant
    from ssp_lp.column_generation.stabilised_master import StabilisedMaster


_NEVER = 1e-14  # a goal probability that is the rounding of none


@dataclass(frozen=True, eq=False)
class Generated:
    """What the loop ended with: the best lottery over columns, and prices that prove it."""

    columns: tuple[Column, ...]
    weights: FloatArray  # [columns]
    prices: FloatArray  # [rows] at which the bound holds
    objective: float  # of the lottery; in phase 1 by how much it violates the rows
    lower_bound: float  # of the optimum
    finished: bool  # false: stopped by the time limit
    values: FloatArray | None = None  # the checked sub-solution, where the bound is certified
    excess: FloatArray = field(default_factory=partial(np.zeros, 0))
    """Phase 1: the violation in units of the rows' scales, [rows]."""

    @property
    def price(self) -> float:
        """The price of the only row."""
        return float(self.prices[0])

    @property
    def figures(self) -> FloatArray:
        """Cost, failure and rows of the lottery, [rewards]."""
        if len(self.columns) == 1:
            return self.columns[0].figures
        return np.asarray(self.weights @ np.stack([column.figures for column in self.columns]))

    @property
    def failure(self) -> float:
        """What the lottery fails with."""
        return float(self.figures[1])

    @property
    def ratio(self) -> float:
        """Cost given success of the lottery; infinite where there is none.

        Summed over the members' own goal probabilities, which are exact where the sum is small.
        """
        goal = float(self.weights @ [column.goal for column in self.columns])
        return float(self.figures[0]) / goal if goal > _NEVER else float("inf")

    def lottery(self, pricing: PricingProblem) -> MixedPolicy:
        """The lottery on the model."""
        return MixedPolicy(tuple(pricing.policy(column) for column in self.columns), self.weights)


def generate(rule: Secant | StabilisedMaster, options: SolveOptions) -> Generated:
    """Add columns until the rule finds none that is worth having, or time is up.

    Args:
        rule: where to begin; it moves on.
        options: tolerance, deadline, and who is told after each pricing call.
    """
    begun, finished = rule.calls, False
    try:
        for _ in range(rule.most_rounds):
            if rule.calls > begun and is_late():
                break
            found = rule.seek(options.tolerance)
            told = None if found is None else rule.told()
            finished = found is None or rule.learn(found, options.tolerance)
            if options.progress is not None and told is not None:
                options.progress(rule.calls, *told)
            if finished:
                break
    except STOPS as stop:
        heed(stop)
    return rule.concluded(options.tolerance, finished=finished)
