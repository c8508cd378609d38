"""Policy switching: in each state the action of the policy that is worth more there.

What it attains is no worse than any of the policies from any state (Chang, Givan and Chong 2004,
"Parallel rollout for online solution of partially observable Markov decision processes"). Between
two prices it is a start from which improvement has little left to do, where from either policy
alone a change would have to travel from state to state.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.policy_iteration.leaving import leaving_chain

_CLEARLY = 1e-9  # relative: values nearer to each other may differ by rounding alone


def switched(
    dynamics: Dynamics, choices: Sequence[IntArray], values: Sequence[FloatArray]
) -> tuple[IntArray, IntArray]:
    """A policy that is no worse than any of several, all of which leave the process.

    Args:
        dynamics: the process.
        choices: the policies, [states] each.
        values: their values, [states] each.

    Returns:
        The policy, and which of the given ones it follows in each state, [states] each.
    """
    choice, least = choices[0], values[0]
    follows = np.zeros(len(choice), dtype=np.int8)
    for k in range(1, len(choices)):
        better = values[k] < least - _CLEARLY * np.abs(least)
        if better.any():
            choice = np.where(better, choices[k], choice).astype(np.int32, copy=False)
            least = np.where(better, values[k], least)
            follows[better] = k
    if follows.any():
        choice = leaving_chain(dynamics, choice, choices[0])[1]
    return choice, follows
