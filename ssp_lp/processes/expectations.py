"""Expectations over the outcomes of each pair of a model, without arrays of the outcomes' size."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import BoolArray, FloatArray, segment_sums
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import check_time
from ssp_lp.model import SSP
from ssp_lp.model.chunks import segment_chunks
from ssp_lp.model.graph.predecessors import narrow


def uniform_cost(model: SSP) -> float | None:
    """The cost of every outcome, where it was given as one number; else None."""
    same = model.n_outcomes > 0 and model.costs.strides == (0,)
    return float(model.costs[0]) if same else None


def successor_means(model: SSP, values: FloatArray | BoolArray) -> FloatArray:
    """E[value of the successor] under each pair, [pairs].

    Args:
        values: [states], finite.
    """
    check_time()
    values = np.asarray(values, dtype=np.float64)
    if not accelerated(model.n_outcomes):
        shape = (model.n_pairs, model.n_states)
        matrix = sp.csr_array(
            (model.probabilities, model.successors, narrow(model.outcome_offsets)), shape=shape
        )
        return np.asarray(matrix @ values)
    from ssp_lp.compiled import rows as compiled

    every, result = np.arange(model.n_pairs, dtype=np.uint32), np.empty(model.n_pairs)
    offsets, successors = model.outcome_offsets.view(np.uint64), model.successors.view(np.uint32)
    run = compiled.row_product(model.n_outcomes)
    run(every, offsets, offsets[:-1], successors, model.probabilities, values, result)
    return result


def cost_means(model: SSP, weights: FloatArray | BoolArray | None = None) -> FloatArray:
    """E[stage cost * weight of the successor] under each pair, [pairs].

    Args:
        weights: [states]; 1 everywhere if left out: the expected stage cost E[g(x, u, w)].
    """
    cost = uniform_cost(model)
    if cost is not None and weights is None:
        return np.full(model.n_pairs, cost)
    if cost is not None and weights is not None:
        return cost * successor_means(model, weights)
    result = np.zeros(model.n_pairs)
    for pairs in segment_chunks(model.outcome_offsets):
        check_time()
        offsets = model.outcome_offsets[pairs.start : pairs.stop + 1]
        some = slice(offsets[0], offsets[-1])
        terms = model.probabilities[some] * model.costs[some]
        if weights is not None:
            terms *= weights[model.successors[some]]
        result[pairs] = segment_sums(terms, offsets - offsets[0])
    return result


def costless_pairs(model: SSP, weights: FloatArray | BoolArray | None = None) -> BoolArray:
    """Pairs whose every possible outcome costs nothing, [pairs].

    Args:
        weights: factor of the costs by successor, [states]; 1 everywhere if left out.
    """
    cost = uniform_cost(model)
    if cost is not None and cost > 0.0 and weights is None:
        return np.zeros(model.n_pairs, dtype=np.bool_)
    if cost is not None and cost > 0.0 and weights is not None:
        return np.asarray(successor_means(model, weights > 0) == 0.0)
    result = np.zeros(model.n_pairs, dtype=np.bool_)
    for pairs in segment_chunks(model.outcome_offsets):
        check_time()
        offsets = model.outcome_offsets[pairs.start : pairs.stop + 1]
        some = slice(offsets[0], offsets[-1])
        paid = (model.probabilities[some] > 0) & (model.costs[some] > 0)
        if weights is not None:
            paid &= weights[model.successors[some]] > 0
        result[pairs] = ~np.logical_or.reduceat(paid, offsets[:-1] - offsets[0])
    return result
