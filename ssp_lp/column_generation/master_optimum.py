"""What the master program of column generation answers."""

from __future__ import annotations

from dataclasses import dataclass

from ssp_lp.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class MasterOptimum:
    """Weights of the policies and prices of the rows; at most (tight rows + 1) weights are > 0."""

    value: float
    weights: FloatArray  # [columns]
    prices: FloatArray  # [rows] >= 0
    excess: FloatArray  # [rows] violation in units of the scales; 0 unless elastic
