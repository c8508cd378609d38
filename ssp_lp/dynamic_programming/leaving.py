"""Policies that leave a process: only of those are there totals."""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.linear_systems.direct_solvers import HOLDS_MASS
from ssp_lp.dynamic_programming.linear_systems.system import System
from ssp_lp.errors import SolverError
from ssp_lp.model.graph.reachability import nearer_pairs


def approach_leaving(dynamics: Dynamics, leaving: BoolArray) -> IntArray:
    """A policy under which every state leaves through one of the leaving pairs.

    Each state takes a pair by which it may come nearer, in number of steps, to such a pair.

    Args:
        dynamics: the process.
        leaving: pairs that leave with positive probability, [pairs].

    Returns:
        [states] the pair taken; -1 where no leaving pair can be reached.
    """
    return nearer_pairs(dynamics.predecessors, dynamics.pair_offsets, dynamics.pair_state, leaving)


def leaving_choice(
    dynamics: Dynamics, goal: FloatArray, to_goal: IntArray | None = None
) -> IntArray:
    """A policy that leaves from every state, towards the goal where it can be reached, [states].

    Args:
        dynamics: the process.
        goal: probability of reaching the goal by each pair, [pairs].
        to_goal: pairs that come nearer to the goal where that is known, -1: none, [states].
    """
    to_goal = approach_leaving(dynamics, goal > 0.0) if to_goal is None else to_goal
    if to_goal.min(initial=0) >= 0:
        return to_goal
    return np.where(to_goal >= 0, to_goal, approach_leaving(dynamics, dynamics.exits > 0.0))


def leaving_chain(
    dynamics: Dynamics, choice: IntArray, before: IntArray | None
) -> tuple[System, IntArray]:
    """The chain of a policy that leaves: states that no longer do keep the pair they had.

    Args:
        dynamics: the process.
        choice: the policy, [states].
        before: the policy that it is to improve; None: there is none.

    Returns:
        The chain and the policy whose chain it is.

    Raises:
        SolverError: they did not leave before either.
    """
    system = dynamics.chain(choice)
    while (closed := system.closed).size:
        if before is None or np.array_equal(choice[closed], before[closed]):
            raise SolverError(HOLDS_MASS)
        choice = choice.copy()
        choice[closed] = before[closed]
        system = dynamics.chain(choice)
    return system, choice
