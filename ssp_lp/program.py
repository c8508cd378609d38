"""The constrained occupation-measure program that every formulation compiles to.

    minimise    <cost, x>                     (case S: <cost, x> / <goal, x>)
    subject to  outflow(x) - inflow(x) = start
                <failure, x> <= budget
                x >= 0

x counts the expected visits of each pair of the process. The ratio of case S becomes linear by
Charnes and Cooper's scaling: x and the start are scaled by t >= 0 so that <goal, x> = 1, and the
failure row becomes <failure, x> - budget * t <= 0. The normalising row then has the only nonzero
right side, so that its dual is c*.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import FloatArray
from ssp_lp.process.explicit import ExplicitProcess


@dataclass(frozen=True, eq=False)
class LinearProgram:
    """``minimise cost @ x`` with ``lower <= matrix @ x <= upper`` and ``x >= 0``, rows named."""

    cost: FloatArray  # [columns]
    matrix: sp.csc_array  # [rows, columns]
    lower: FloatArray  # [rows]
    upper: FloatArray  # [rows]
    rows: Mapping[str, slice]  # "balance", "failure" and, in case S, "normaliser"

    @property
    def equality(self) -> np.ndarray:
        """Rows whose two sides are equal, [rows]."""
        return np.asarray(self.lower == self.upper)


def occupation_program(process: ExplicitProcess, budget: float, ratio: bool) -> LinearProgram:
    """Compile a process to its program.

    Args:
        process: the substochastic process.
        budget: largest failure.
        ratio: case S, the objective <cost, x> / <goal, x>; the last column is then t.
    """
    n_states, n_pairs = process.n_states, process.n_pairs
    outflow = sp.csr_array(
        (np.ones(n_pairs), (process.pair_state, np.arange(n_pairs))), shape=(n_states, n_pairs)
    )
    balance = sp.csr_array(outflow - process.transitions.T)
    failure = sp.csr_array(process.failure[None, :])
    if not ratio:
        return LinearProgram(
            cost=process.cost,
            matrix=sp.csc_array(sp.vstack([balance, failure])),
            lower=np.append(process.start, -np.inf),
            upper=np.append(process.start, budget),
            rows={"balance": slice(0, n_states), "failure": slice(n_states, n_states + 1)},
        )
    body = sp.vstack([balance, failure, sp.csr_array(process.goal[None, :])])
    scale = sp.csr_array(np.concatenate([-process.start, [-budget, 0.0]])[:, None])
    zeros = np.zeros(n_states)
    return LinearProgram(
        cost=np.append(process.cost, 0.0),
        matrix=sp.csc_array(sp.hstack([body, scale])),
        lower=np.concatenate([zeros, [-np.inf, 1.0]]),
        upper=np.concatenate([zeros, [0.0, 1.0]]),
        rows={
            "balance": slice(0, n_states),
            "failure": slice(n_states, n_states + 1),
            "normaliser": slice(n_states + 1, n_states + 2),
        },
    )
