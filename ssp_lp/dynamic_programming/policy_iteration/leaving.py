"""Policies are evaluated only where they leave; what does not goes back to the pair it had."""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import IntArray
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.linear_systems.equations import HOLDS_MASS
from ssp_lp.dynamic_programming.linear_systems.system import System
from ssp_lp.errors import SolverError


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
