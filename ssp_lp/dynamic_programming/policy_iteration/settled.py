"""What policy iteration ends with."""

from __future__ import annotations

from dataclasses import dataclass

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.dynamic_programming.work import Work

MOST_ROUNDS = 10_000
"""Rounds that only a defect could need: every round improves what the last one left."""


@dataclass(frozen=True, eq=False)
class Settled:
    """A policy that no single change of a pair improves, with its expected totals."""

    choice: IntArray  # [states]
    totals: FloatArray  # [states, rewards]
    values: FloatArray  # [states] the totals, weighted
    low: FloatArray  # [states] what the rounding of the values lost, where that was worked out
    runs: FloatArray  # [states] checked: twice this is at least the expected number of steps
    work: Work
