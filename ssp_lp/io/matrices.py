"""Models from a transition matrix for each action, as in pymdptoolbox."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from ssp_lp.arrays import FloatArray, IntArray, offsets_of, segment_ids
from ssp_lp.errors import ModelError, in_short
from ssp_lp.io.model_files.raw_model import GOAL, RawModel, finished
from ssp_lp.model import SSP
from ssp_lp.model.arguments import explained
from ssp_lp.model.ssp import DeadEnds, StateSet, goal_mask_of


@explained
def from_matrices(
    transitions: Sequence[Any] | npt.NDArray[Any],
    goal: npt.ArrayLike | Set[int],
    *,
    costs: Any = None,
    rewards: Any = None,
    actions: Sequence[str] | None = None,
    state_labels: Mapping[str, StateSet] | None = None,
    dead_ends: DeadEnds | None = None,
) -> SSP:
    """Build a model from a transition matrix for each action.

    An action is not available in a state whose row is zero, or whose cost is infinite; a state
    without actions is a dead-end. Actions of goal states are dropped.

    Args:
        transitions: [actions] matrices [states, states], dense or sparse, of probabilities. For
            QuantEcon's ``Q``, [states, actions, states], use ``numpy.moveaxis(Q, 1, 0)``.
        goal: indices of the goal states.
        costs: [states], [states, actions], or [actions] matrices [states, states]; either costs
            or rewards.
        rewards: minus the costs, in one of the same shapes; none may be positive.
        actions: [actions] names; None: their positions.
        state_labels: names for sets of states, as in ``SSP.from_transitions``.
        dead_ends: states from which no action reaches the goal, labels of them, or a predicate.
            Any other state without actions that is not a goal is then an error.

    Returns:
        The model; its states are the indices.

    Raises:
        ModelError: shapes that do not fit, or a wrong state and action, which the error names.
    """
    matrices = [_matrix(matrix) for matrix in transitions]
    n_states = matrices[0].shape[0] if matrices else 0
    if not matrices or any(matrix.shape != (n_states, n_states) for matrix in matrices):
        raise ModelError("transitions must be square matrices of one size, one for each action")
    if (costs is None) == (rewards is None):
        raise ModelError("give either costs or rewards")
    if actions is not None and len(actions) != len(matrices):
        raise ModelError(f"{len(actions)} names for {len(matrices)} actions")
    goals = np.flatnonzero(goal_mask_of([*goal] if isinstance(goal, Set) else goal, n_states))
    # one row for each state and action, sorted by state
    n_actions = len(matrices)
    order = np.arange(n_states * n_actions).reshape(n_actions, n_states).T.reshape(-1)
    rows = sp.csr_array(sp.vstack(matrices, format="csr")[order])
    row = segment_ids(rows.indptr)
    given = rewards if costs is None else costs
    paid = _paid_by_matrix(given, row // n_actions, row % n_actions, rows.indices, matrices)
    if costs is None and (paid > 0.0).any():
        at = int(np.argmax(paid > 0.0))
        state, action = divmod(int(row[at]), n_actions)
        raise ModelError(
            f"action {action} of state {state} has the reward {paid[at]:g}: rewards "
            "must not be positive, so that costs are not negative"
        )
    paid = 0.0 - paid if costs is None else paid
    kept = ~np.isposinf(paid)
    sizes = np.bincount(row[kept], minlength=order.size)
    pairs = np.flatnonzero(sizes)
    names = range(n_actions) if actions is None else actions
    raw = RawModel(
        pair_offsets=offsets_of(np.bincount(pairs // n_actions, minlength=n_states)),
        outcome_offsets=offsets_of(sizes[pairs]),
        successors=rows.indices[kept].astype(np.int64),
        probabilities=rows.data[kept],
        costs=paid[kept],
        actions=[names[k] for k in (pairs % n_actions).tolist()],
        labels={GOAL: goals},
    )
    model = finished(raw, GOAL, "the matrices").model
    return model.with_labels(state_labels or {}).with_dead_ends(dead_ends)


def _matrix(matrix: Any) -> Any:
    """Return a transition matrix as a sparse one without entries of 0."""
    try:
        entries = sp.csr_array(matrix, dtype=np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise ModelError(f"a matrix of transitions is not a matrix: {error}") from error
    entries.sum_duplicates()
    entries.eliminate_zeros()
    return entries


def _paid_by_matrix(
    given: Any, state: IntArray, action: IntArray, target: IntArray, matrices: Sequence[Any]
) -> FloatArray:
    """Return the cost or reward of each outcome, [outcomes], from an array of any supported shape.

    Args:
        given: the costs or rewards.
        state: state of each outcome, [outcomes].
        action: index of the action, [outcomes].
        target: successor, [outcomes].
        matrices: the transition matrix of each action, for their shape.
    """
    n_states, n_actions = matrices[0].shape[0], len(matrices)
    if isinstance(given, (list, tuple)) and any(sp.issparse(part) for part in given):
        if len(given) != n_actions or any(part.shape != matrices[0].shape for part in given):
            raise ModelError("sparse costs or rewards must be one matrix for each action")
        stacked = sp.csr_matrix(sp.vstack(list(given)))
        return np.asarray(stacked[action * n_states + state, target]).reshape(-1)
    try:
        table = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ModelError(f"costs or rewards must be numbers, not {in_short(given)}") from error
    if table.shape == (n_states,):
        return np.asarray(table[state])
    if table.shape == (n_states, n_actions):
        return np.asarray(table[state, action])
    if table.shape == (n_actions, n_states, n_states):
        return np.asarray(table[action, state, target])
    raise ModelError(
        f"costs or rewards of shape {table.shape} do not fit {n_states} states and {n_actions} "
        "actions: give [states], [states, actions] or [actions, states, states]"
    )
