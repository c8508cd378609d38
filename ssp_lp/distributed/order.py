"""Orders of a model's states in which few steps cross from one rank's states to another's."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.csgraph import reverse_cuthill_mckee

from ssp_lp.arrays import BoolArray, FloatArray, IntArray, entries_of, offsets_of
from ssp_lp.errors import ModelError, wrong_argument
from ssp_lp.model import SSP
from ssp_lp.model.graph import hopeless_states


def narrow_order(model: SSP) -> IntArray:
    """States of a model in Cuthill and McKee's order, reversed: what a step joins stands near.

    Goal states, and those that have lost the goal, come last: many steps lead to them, but ranks
    need not hear of their values.

    Returns:
        [states] the number of the state that comes first, second, ...

    Raises:
        ModelError: it is no model that this process holds whole.
    """
    if not isinstance(model, SSP):
        raise wrong_argument("model", "be an SSP", model)
    apart = model.goal_mask | hopeless_states(model)
    inside, starts = np.flatnonzero(~apart), model.outcome_offsets[model.pair_offsets]
    steps = np.ones(model.n_outcomes, dtype=np.int32), model.successors, starts
    if not inside.size:
        return np.arange(model.n_states)
    graph = sp.csr_matrix(steps, shape=(model.n_states, model.n_states))[inside][:, inside]
    return np.concatenate([inside[reverse_cuthill_mckee(graph)], np.flatnonzero(apart)])


def reordered(model: SSP, order: npt.ArrayLike) -> SSP:
    """A model with its states in another order; each keeps its label and its actions.

    Args:
        model: the model.
        order: [states] the number of the state that comes first, second, ...

    Raises:
        ModelError: some state does not come once.
    """
    places, n_states = np.asarray(order), model.n_states
    if places.dtype.kind not in "iu" or not np.array_equal(np.sort(places), np.arange(n_states)):
        raise ModelError(f"an order has each of the states 0 .. {n_states - 1} once")
    number = inverse(places).astype(np.int32)
    pairs, actions = entries_of(model.pair_offsets, places)
    outcomes, lengths = entries_of(model.outcome_offsets, pairs)
    kept = {one.name: getattr(model, one.name) for one in fields(SSP)}
    return SSP(**kept | {
        "pair_offsets": offsets_of(actions),
        "outcome_offsets": offsets_of(lengths),
        "pair_action": model.pair_action[pairs],
        "successors": number[model.successors[outcomes]],
        "goal_mask": model.goal_mask[places],
        "states": [model.states[k] for k in places.tolist()],
        "state_labels": {name: np.sort(number[of]) for name, of in model.state_labels.items()},
        "named_costs": {name: costs[outcomes] for name, costs in model.named_costs.items()},
        **{name: getattr(model, name)[outcomes] for name in ("probabilities", "costs")},
    })  # fmt: skip


def inverse(order: IntArray) -> IntArray:
    """Where each state comes in an order, [states]."""
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order))
    return number


def values_in_first_order(values: FloatArray, live: BoolArray, order: IntArray) -> FloatArray:
    """Values of a process's states in the order of the model from before it was reordered.

    Args:
        values: of the live states, and perhaps of a source behind them.
        live: states that the process has, as reordered, [states].
        order: in which they were put, [states].
    """
    places = np.argsort(order[live])
    return np.concatenate([values[places], values[len(places) :]])
