"""What it costs, from a node of a policy's chain on, that the goal is out of reach."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csgraph

from ssp_lp.analysis.chain import Chain, reaching_in_chain
from ssp_lp.arrays import BoolArray, FloatArray
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP
from ssp_lp.model.graph.end_components import end_components
from ssp_lp.model.graph.reachability import attention_states, dead_ends
from ssp_lp.processes.expectations import costless_pairs
from ssp_lp.processes.failure_semantics import (
    FailureSemantics,
    GiveUp,
    dead_end_charges,
    give_up_charges,
)


def give_up_costs(
    chain: Chain, semantics: FailureSemantics, free: BoolArray | None = None
) -> FloatArray:
    """Charge of giving up at each node that may do so, 0 elsewhere, [nodes]."""
    if not chain.give_up.any():
        return np.zeros(len(chain.give_up))
    charge = state_give_up_charges(chain.model, semantics, free)[chain.state]
    return np.where(chain.give_up > 0, charge, 0.0)


def check_giving_up(chain: Chain, semantics: FailureSemantics, free: BoolArray) -> None:
    """Check that a policy gives up only where it may, or may stay for ever.

    Args:
        chain: the policy's.
        semantics: where giving up is allowed.
        free: pairs that are free in all that is minimised and limited, [pairs].

    Raises:
        ModelError: it does elsewhere.
    """
    forbidden = np.isinf(give_up_costs(chain, semantics, free))
    if forbidden.any():
        state = chain.model.states[int(chain.state[int(np.argmax(forbidden))])]
        raise ModelError(f"the policy gives up in state {state!r}: not with {semantics.give_up!s}")


def lost_costs(
    chain: Chain,
    hopeful: BoolArray,
    semantics: FailureSemantics,
    survival: float,
    free: BoolArray | None = None,
) -> FloatArray:
    """Cost still to come at nodes from which the chain cannot reach the goal, [nodes].

    Failure is declared there at once, and charged as the semantics says; with ``DEAD_ENDS`` stage
    costs are paid until a dead-end is entered, which costs infinity where that is never.

    Args:
        hopeful: nodes from which the goal is reached with positive probability, [nodes].
        survival: discount of costs to come, 1 for none.
        free: see ``state_give_up_charges``.
    """
    entering = dead_end_charges(chain.model, dead_ends(chain.model), semantics)[chain.state]
    lost = ~hopeful & (chain.dead == 0)
    values = np.where(chain.dead > 0, entering, 0.0)
    if not lost.any():
        return values
    if semantics.give_up is not GiveUp.DEAD_ENDS:
        return np.where(
            lost, state_give_up_charges(chain.model, semantics, free)[chain.state], values
        )
    stage = chain.per_node(chain.cost) + survival * (chain.matrix @ values)
    if survival < 1.0:
        return values + chain.accumulate(np.where(lost, stage, 0.0), lost, survival)
    # lost nodes in closed classes that cost something, and in ones that cost nothing
    _, label = csgraph.connected_components(chain.matrix, connection="strong")
    leaves = (chain.dead > 0) | (chain.give_up > 0) | ~lost
    leaves[chain.source[label[chain.source] != label[chain.target]]] = True
    closed = ~np.isin(label, np.unique(label[leaves]))
    paying = np.isin(label, np.unique(label[chain.per_node(chain.cost) > 0]))
    endless, free = closed & paying, closed & ~paying
    infinite = reaching_in_chain(chain, endless) & lost if endless.any() else endless
    values = values + chain.accumulate(np.where(lost, stage, 0.0), lost & ~free & ~infinite)
    return np.where(infinite, np.inf, values)


def state_give_up_charges(
    model: SSP, semantics: FailureSemantics, free: BoolArray | None = None
) -> FloatArray:
    """What giving up in each state costs, infinite where it is not allowed, [states].

    Staying for ever in an end component that costs nothing is free whatever the semantics.

    Args:
        model: the model.
        semantics: where giving up is allowed and whether it is charged.
        free: pairs among which one may stay, [pairs]; None: those that cost nothing.
    """
    wandering = np.zeros(model.n_states, dtype=np.bool_)
    if semantics.give_up is GiveUp.DEAD_ENDS:  # else whoever may stay may give up for as little
        free = costless_pairs(model) if free is None else free
        wandering = end_components(model, free)[0] >= 0
    return give_up_charges(model, attention_states(model), wandering, semantics)
