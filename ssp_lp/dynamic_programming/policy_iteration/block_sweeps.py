"""Improvement along the strong components of the policy's own chain, ends first and back.

What a state gains spreads in both directions: to the states that lead to it, which come later when
ends come first, and, once a better pair leads to a state that had none before, the other way round.
Components are few steps of a wave where single backups are many.
"""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import IMPROVEMENT, BoolArray, FloatArray, IntArray, unsigned
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.bellman import unsigned_parts
from ssp_lp.dynamic_programming.dynamics import Dynamics
from ssp_lp.dynamic_programming.linear_systems.components import Components, chosen_components

_SOLVED = 256
"""States of a component up to which a dense reduction costs no more than other ways."""

_PASSES = 20  # there and back


def improve_along_chain(
    dynamics: Dynamics,
    pair_cost: FloatArray,
    choice: IntArray,
    values: FloatArray,
) -> int | None:
    """Improve a policy, in place, until a pass there and back changes nothing.

    Each pass takes the components anew: those of the chain of the policy as it has become.

    Args:
        dynamics: the process.
        pair_cost: [pairs].
        choice: pair of each state of a policy that leaves, [states].
        values: of no better policy, [states].

    Returns:
        The number of backups of all states; None where the components are too large.
    """
    found = chosen_components(dynamics.transitions, choice)
    if found.largest > _SOLVED:
        return None
    run, stale = 0, np.ones(dynamics.n_states, dtype=np.bool_)
    for _ in range(_PASSES):
        check_time()
        changed = 0
        for is_forward in (True, False):
            changed += _pass(dynamics, found, pair_cost, choice, values, stale, is_forward)
        run += 2
        if not changed:
            break
        found = chosen_components(dynamics.transitions, choice)
        if found.largest > _SOLVED:
            break
    return run


def _pass(
    dynamics: Dynamics,
    found: Components,
    pair_cost: FloatArray,
    choice: IntArray,
    values: FloatArray,
    stale: BoolArray,
    is_forward: bool,
) -> int:
    """One pass, in place; how often a pair was changed."""
    from ssp_lp.compiled.linear_systems.blocks import improve_blocks

    before = dynamics.predecessors
    changed = improve_blocks(
        *unsigned_parts(dynamics.pair_offsets, dynamics.transitions), dynamics.exits,
        unsigned(found.order), found.offsets, is_forward, found.largest,
        pair_cost, IMPROVEMENT, unsigned(before.pairs), before.offsets,
        unsigned(dynamics.pair_state), choice.view(np.uint32), values, stale,
    )  # fmt: skip
    return int(changed)
