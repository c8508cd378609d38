"""The choice in one layer of accumulated cost: the best one, and what a choice is worth there."""

from __future__ import annotations

import numpy as np

from ssp_lp.arrays import TIED, FloatArray, IntArray, least_integer_type
from ssp_lp.compiled.deadline import check_time
from ssp_lp.dynamic_programming.bellman import PairCost, best_pairs, chosen_product
from ssp_lp.dynamic_programming.policy_iteration import iterate_policy
from ssp_lp.processes.layered.accumulated_cost import AccumulatedCost
from ssp_lp.processes.layered.layered_process import LayeredProcess

_ONE = np.ones(1)


def is_acyclic(base: AccumulatedCost) -> bool:
    """Whether every step between states costs something, so that layers need no solving."""
    return base.instant.nnz == 0


def room_for_choice(process: LayeredProcess) -> IntArray:
    """Room for positions among the pairs of each node, in the smallest integers, [cap, nodes]."""
    base = process.base
    most = int(np.diff(base.pair_offsets).max(initial=1))
    return np.empty((process.cap, base.n_nodes), dtype=least_integer_type(most))


def best_of_layer(
    base: AccumulatedCost, cost: PairCost, ahead: FloatArray, inner: IntArray
) -> tuple[IntArray, FloatArray]:
    """The pairs of least value in a layer and their values, [nodes] each.

    Args:
        base: one layer of the process.
        cost: of the pairs, priced.
        ahead: values of what steps lead to, [layers * nodes].
        inner: pairs to begin with where the layer has free steps, [nodes].
    """
    if is_acyclic(base):
        backup = best_pairs(base.pair_offsets, base.later, cost, ahead, tied=TIED)
        return backup.choice, backup.minima
    onward = (cost.total + base.later @ ahead)[:, None]
    settled = iterate_policy(base.instant_dynamics, onward, _ONE, inner)
    return settled.choice, settled.values


def measures_of_layer(
    base: AccumulatedCost, chosen: IntArray, charge: PairCost, ahead: FloatArray
) -> FloatArray:
    """(charge, failure, goal) of a layer's choice, [nodes, 3].

    Args:
        base: one layer of the process.
        chosen: a pair of each node, [nodes].
        charge: of arriving by the pairs.
        ahead: measures of what steps lead to, [layers * nodes, 3].
    """
    totals = np.empty((base.n_nodes, 3))
    totals[:, 0] = charge.fixed[chosen]
    if charge.slope is not None:
        totals[:, 0] += charge.factor * charge.slope[chosen]
    totals[:, 1] = base.failure[chosen]
    totals[:, 2] = base.survival * base.gain[chosen]
    totals += chosen_product(base.later, chosen, ahead)
    if not is_acyclic(base):
        totals = base.instant_dynamics.chain(chosen).solve(totals)
    return totals


def measures_backwards(process: LayeredProcess, choice: IntArray, beyond: FloatArray) -> FloatArray:
    """(charge, failure, goal) of a choice over all layers, from the first one, [nodes, 3].

    Args:
        process: the process.
        choice: position among the pairs of each node, [cap, nodes].
        beyond: the measures beyond the cap, [layers beyond, nodes, 3].
    """
    base = process.base
    measured, totals = process.window(beyond), np.zeros((base.n_nodes, 3))
    for layer in reversed(range(process.cap)):
        check_time()
        chosen = base.pair_offsets[:-1] + choice[layer]
        totals = measures_of_layer(base, chosen, process.charged(layer), measured.flat)
        measured.push(totals)
    return totals
