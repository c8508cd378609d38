"""The layered process written out state by state, for the methods that need it so."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.processes.layered.charges import TailValues
from ssp_lp.processes.layered.process import LayeredProcess


def materialise(process: LayeredProcess) -> ExplicitProcess:
    """Write all layers out: state = layer * nodes + node.

    The layers beyond the cap that a step can reach follow, with one pair for each tail policy,
    so that the written-out process can do all that either tail can; the source state comes last.

    Args:
        process: the layered process.
    """
    base, n, cap = process.base, process.base.n_nodes, process.cap
    n_beyond = (len(process.levels.totals) - cap) * n
    n_states = cap * n + n_beyond + 1
    tails_cost, tails_failure, tails_goal = _tail_pairs(process)
    steps = _layer_steps(process, n_states)
    entry = sp.csr_array(
        (base.start, (np.zeros(n, dtype=np.int64), np.arange(n))), shape=(1, n_states)
    )
    cost = np.stack([process.charged(layer).total for layer in range(cap)])
    own_pairs = np.tile(np.diff(base.pair_offsets), cap)
    counts = np.concatenate([own_pairs, np.full(n_beyond, tails_cost.shape[1]), [1]])
    start = np.zeros(n_states)
    start[-1] = 1.0
    return ExplicitProcess(
        pair_offsets=np.concatenate([[0], np.cumsum(counts)]),
        transitions=sp.csr_array(
            sp.vstack([steps, sp.csr_array((tails_cost.size, n_states)), entry])
        ),
        start=start,
        cost=np.concatenate([cost.ravel(), tails_cost.ravel(), [process.start_charge]]),
        failure=np.concatenate(
            [np.tile(base.failure, cap), tails_failure.ravel(), [base.start_failure]]
        ),
        goal=np.concatenate(
            [np.tile(base.survival * base.gain, cap), tails_goal.ravel(), [base.start_goal]]
        ),
    )


def chosen_pairs(process: LayeredProcess, choice: IntArray, tail_price: float) -> IntArray:
    """The pair that a policy takes in each state of the written-out process, [states].

    Args:
        process: the layered process.
        choice: position among the pairs of its node, [cap, nodes].
        tail_price: the price of failure by which tails are chosen beyond the cap.
    """
    base, cap, n_tails = process.base, process.cap, len(process.tails.goal)
    within = np.arange(cap)[:, None] * len(base.gain) + base.pair_offsets[:-1] + choice
    last = (process.beyond_units >= process.threshold(tail_price)).ravel()
    beyond = cap * len(base.gain) + np.arange(last.size) * n_tails + last * (n_tails - 1)
    source = cap * len(base.gain) + last.size * n_tails
    return np.concatenate([within.ravel(), beyond, [source]])


def _layer_steps(process: LayeredProcess, n_states: int) -> sp.csr_array:
    """Transitions of the pairs of all layers, [cap * pairs, states]."""
    base, n, cap = process.base, process.base.n_nodes, process.cap
    n_pairs, per_layer = len(base.gain), base.steps.nnz
    ahead, node = np.divmod(base.steps.indices.astype(np.int64), max(n, 1))
    columns = (process.levels.leads(base.width)[:, ahead] * n + node).ravel()
    row_ends = np.tile(base.steps.indptr[1:].astype(np.int64), cap)
    row_ends += np.repeat(np.arange(cap, dtype=np.int64) * per_layer, n_pairs)
    index = np.int32 if max(n_states, columns.size) <= np.iinfo(np.int32).max else np.int64
    indptr = np.concatenate([[0], row_ends]).astype(index)
    return sp.csr_array(
        (np.tile(base.steps.data, cap), columns.astype(index), indptr),
        shape=(cap * n_pairs, n_states),
    )


def _tail_pairs(process: LayeredProcess) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Charge, failure and goal mass of following each tail from beyond the cap.

    Returns:
        3 x [layers * nodes, tails].
    """
    tails = process.tails
    values = tails.values
    each = TailValues(
        values.goal.T, values.failure.T, values.early.T, values.cost.T, values.moment.T
    )
    cost = process.charge.beyond(process.levels.totals[process.cap :, None, None], each)
    all_three = (cost, *(np.broadcast_to(v[None], cost.shape) for v in (each.failure, each.goal)))
    failed, reached = (v.reshape(-1, cost.shape[-1]) for v in all_three[1:])
    return cost.reshape(-1, cost.shape[-1]), failed, reached
