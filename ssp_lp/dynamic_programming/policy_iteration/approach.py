"""A policy that leaves a process from every state."""

from __future__ import annotations

from ssp_lp.arrays import BoolArray, IntArray
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.model.graph.approach import nearer_pairs


def approach(dynamics: Dynamics, leaving: BoolArray) -> IntArray:
    """A policy under which every state leaves through one of the leaving pairs.

    Each state takes a pair by which it may come nearer, in number of steps, to such a pair.

    Args:
        dynamics: the process.
        leaving: pairs that leave with positive probability, [pairs].

    Returns:
        [states] the pair taken; -1 where no leaving pair can be reached.
    """
    return nearer_pairs(dynamics.predecessors, dynamics.pair_offsets, dynamics.pair_state, leaving)
