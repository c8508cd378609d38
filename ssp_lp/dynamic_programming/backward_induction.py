"""Processes that fall into small components: each is solved once and for all, ends first."""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import (
    IMPROVEMENT,
    MACHINE_EPSILON,
    TIED,
    FloatArray,
    IntArray,
    first_minimisers,
    segment_minima,
    unsigned,
)
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.dynamic_programming.bellman import unsigned_parts
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.linear_systems.direct_solvers import HOLDS_MASS
from ssp_lp.dynamic_programming.linear_systems.system import DIRECT_STATES
from ssp_lp.dynamic_programming.linear_systems.totals import EVALUATED, Totals
from ssp_lp.errors import SolverError

_LAYERS = 500  # passes that a process is good for where it is one layer of many
_SMALL = 48
"""States of a component up to which it is solved by itself, by dense state reduction."""

_SMALL_OF_FEW = 256  # the same where there are few states in all


def is_solved_backwards(dynamics: Dynamics) -> bool:
    """Whether the process falls into components so small that each is solved once and for all."""
    if is_compiled_backwards(dynamics):
        few = dynamics.n_states <= DIRECT_STATES
        return dynamics.components.largest <= (_SMALL_OF_FEW if few else _SMALL)
    if dynamics.n_states <= DIRECT_STATES and not dynamics.is_reused:
        return False  # looking at the structure would take longer than it saves
    return dynamics.components.largest <= 1


def is_compiled_backwards(dynamics: Dynamics) -> bool:
    """Whether a pass over the process is run compiled: what is passed often is worth it sooner."""
    passes = _LAYERS if dynamics.is_reused else 1
    return accelerated(passes * len(dynamics.transitions.indices))


def least_backwards(
    dynamics: Dynamics, pair_cost: FloatArray, choice: IntArray
) -> tuple[IntArray, FloatArray]:
    """The best pairs of a process that is solved backwards, and their values, [states] each.

    Args:
        dynamics: the process.
        pair_cost: [pairs].
        choice: a policy that leaves, [states].

    Raises:
        SolverError: the policy does not leave.
    """
    values, choice = np.zeros(dynamics.n_states), choice.copy()
    tied = TIED if dynamics.is_reused else 0.0
    if is_compiled_backwards(dynamics):
        from ssp_lp.compiled.improvement import improve_components

        found = dynamics.components
        stuck = improve_components(
            *unsigned_parts(dynamics.pair_offsets, dynamics.transitions), dynamics.exits,
            unsigned(found.order), found.offsets, max(found.largest, 1),
            pair_cost, IMPROVEMENT, tied, choice.view(np.uint32), values,
        )  # fmt: skip
        if stuck >= 0:
            raise SolverError(HOLDS_MASS)
        return choice, values
    for states, pairs, offsets, rows, departs in dynamics.levels:
        total = pair_cost[pairs] + rows @ values
        ahead = np.full_like(total, np.inf)
        np.divide(total, departs, out=ahead, where=departs > 0.0)
        values[states] = segment_minima(ahead, offsets)
        choice[states] = pairs[first_minimisers(ahead, values[states], offsets, tied)]
    return choice, values


def acyclic_totals(
    dynamics: Dynamics, choice: IntArray, rewards: FloatArray, weights: FloatArray | None = None
) -> tuple[IntArray, Totals] | None:
    """The best pairs of a large process without cycles, and their verified totals, in one pass.

    Args:
        dynamics: the process.
        choice: pairs, which stay among equals, [states].
        rewards: [pairs, rewards].
        weights: of the rewards, whose sum is minimised, [rewards]; None: the pairs stay.

    Returns:
        None where the process is of another kind, or where rounding may exceed ``EVALUATED``.

    Raises:
        SolverError: some state is never left.
    """
    shape = dynamics.n_states, rewards.shape[1]
    if shape[0] <= DIRECT_STATES or not is_compiled_backwards(dynamics):
        return None
    if dynamics.components.largest > 1:
        return None
    from ssp_lp.compiled.improvement import improve_acyclic

    choice, runs, missed, x = choice.copy(), np.empty(shape[0]), np.empty(shape[1]), np.empty(shape)
    if not improve_acyclic(
        *unsigned_parts(dynamics.pair_offsets, dynamics.transitions), dynamics.exits,
        unsigned(dynamics.components.order),
        rewards, np.zeros(shape[1]) if weights is None else weights, weights is None,
        MACHINE_EPSILON, choice.view(np.uint32), x, runs, missed,
    ):  # fmt: skip
        raise SolverError(HOLDS_MASS)
    totals = Totals(x, np.zeros_like(x), runs, missed)
    return (choice, totals) if totals.are_within(EVALUATED) else None
