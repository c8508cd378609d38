"""A criterion as a user writes it, from public imports."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssp_lp import SSP, arrival_cost
from ssp_lp.formulation import Formulation, Quantity, Start


@dataclass(frozen=True, eq=False)
class Lateness(Formulation):
    """The least mean lateness beyond a due time, given success."""

    model: SSP
    start: Start
    due: float
    failure_budget: float | None = None
    cost_levels: int | None = None
    ratio = True

    @property
    def quantity(self) -> Quantity:
        return arrival_cost(lambda cost: np.maximum(cost - self.due, 0.0), affine_from=self.due)
