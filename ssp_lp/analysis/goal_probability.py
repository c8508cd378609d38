"""Greatest and least probability of reaching the goal (MAXPROB and MINPROB; paper, section 2.3)."""

from __future__ import annotations

from collections.abc import Hashable

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, read_only
from ssp_lp.model import SSP
from ssp_lp.model.graph.reachability import attention_states, dead_ends
from ssp_lp.processes.goal_reach import greatest_goal_reach, least_goal_reach


def max_goal_probability(model: SSP) -> FloatArray:
    """The greatest probability of reaching the goal from each state, [states].

    MAXPROB (Kolobov et al. 2011; paper, section 2.3), by policy iteration from a policy that
    reaches the goal from wherever it can be reached.
    """
    return read_only(greatest_goal_reach(model).goal)


def min_goal_probability(model: SSP) -> FloatArray:
    """The least probability of reaching the goal from each state, [states].

    MINPROB (paper, section 2.3); exactly 0 at the attention states, which are found on the graph.
    """
    return read_only(least_goal_reach(model).goal)


def dead_end_labels(model: SSP) -> frozenset[Hashable]:
    """The states from which no policy reaches the goal, X_{d,all} of the paper, by their labels."""
    return _labels_by_goal_probability(model, dead_ends(model))


def attention_labels(model: SSP) -> frozenset[Hashable]:
    """The states from which some policy surely avoids the goal, X_{d,or}, by their labels."""
    return _labels_by_goal_probability(model, attention_states(model))


def _labels_by_goal_probability(model: SSP, states: BoolArray) -> frozenset[Hashable]:
    """The labels of states of extreme goal probability."""
    return frozenset(model.states[i] for i in np.flatnonzero(states).tolist())
