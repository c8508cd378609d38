"""How a chain's total costs are followed: in layers of a unit, sum by sum, or rounded up."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import TypeVar

import numpy as np

from ssp_lp.analysis.total_cost.arrivals import Arrivals
from ssp_lp.analysis.total_cost.live_chain import Live
from ssp_lp.analysis.total_cost.sums import Sums, TooManySumsError
from ssp_lp.errors import ModelError

Sweep = Arrivals | Sums
Answer = TypeVar("Answer")

_FINE = 2_000  # units in the mean of costs that are rounded
_MOST_UNITS = 20_000  # in the dearest step
_MOST_WAITING = 10_000_000  # masses kept at once


@dataclass(frozen=True, eq=False)
class Followed:
    """The sweeps over a chain's total cost, each begun when a question needs it."""

    live: Live
    exact_costs: Mapping[float, Fraction]  # float cost -> the fraction meant
    typical: float  # a total cost

    def asked(self, question: Callable[[Sweep], Answer]) -> Answer:
        """The answer to a question: exact, or of rounded costs where it needs too many sums."""
        try:
            return question(self._exact)
        except TooManySumsError:
            return question(self._rounded)

    @cached_property
    def _exact(self) -> Sweep:
        try:
            return Arrivals(self.live, self.exact_costs)
        except ModelError:  # no common unit that is worth counting in
            return Sums(self.live, self.exact_costs)

    @cached_property
    def _rounded(self) -> Arrivals:
        """Every cost rounded up to a multiple of a small unit."""
        most = max(min(_MOST_UNITS, _MOST_WAITING // len(self.live.start)), 1)
        least = float(self.live.paid.max(initial=0.0)) / most
        return Arrivals(self.live, {}, Fraction(max(self.typical / _FINE, least)))


def cost_of(sweep: Sweep, layer: int) -> float:
    """Total cost of a layer."""
    return float(sweep.cost_of(np.array(layer)))
