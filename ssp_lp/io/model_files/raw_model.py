"""What a model file of another tool holds: arrays, labels, and labels with a meaning."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray

INITIAL, DEADLOCK, PAYING = "init", "deadlock", "paying"
"""Labels that the files give a meaning: initial states, dead-ends, and states between outcomes
and their successors that pay what the action has not paid yet."""

PAY = "pay"
"""The action of those states."""


class RawModel(NamedTuple):
    """A model as a file states it: goal states may act, and every state may."""

    pair_offsets: IntArray  # [states + 1]
    outcome_offsets: IntArray  # [pairs + 1]
    successors: IntArray  # [outcomes]
    probabilities: FloatArray  # [outcomes]
    costs: FloatArray  # [outcomes]
    actions: Sequence[Hashable] | None  # [pairs]
    labels: Mapping[str, IntArray]  # label -> states
    states: Sequence[Hashable] | None = None
    exact_costs: Mapping[float, Fraction] | None = None


def offsets_of(counts: IntArray) -> IntArray:
    """Where each of several segments in a row begins, and the end, [segments + 1]."""
    return np.concatenate([[0], np.cumsum(counts)])
