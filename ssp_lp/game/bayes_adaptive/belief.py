"""The adversary's weight as a belief about which MDP is being played (paper, section 3.3).

Both MDPs move alike, but M_{d,gamma} ends with probability 1 - gamma in each step. So a run that
goes on is evidence for M_o, the same evidence whatever happens in it: the belief follows one
trajectory from each start.
"""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray


def posterior(alpha: float, discount: float) -> float:
    """nu(alpha)(M_o): the weight of M_o after one step of a run that goes on."""
    return alpha / (alpha + discount * (1.0 - alpha))


def belief_at(alpha: float, discount: float, time: IntArray) -> FloatArray:
    """The weight after so many steps: alpha / (alpha + gamma^t (1 - alpha)), like ``time``."""
    return np.asarray(alpha / (alpha + discount**time * (1.0 - alpha)), dtype=np.float64)


def horizon_of(discount: float, condition_weight: float, error: float) -> int:
    """Steps after which all that is left to fail, ``condition_weight * gamma^N``, is at most error.

    By then J of section 3.3 and that of a player who ignores failing differ by no more.
    """
    if condition_weight <= error:
        return 1
    return int(np.ceil(np.log(error / condition_weight) / np.log(discount))) + 1
