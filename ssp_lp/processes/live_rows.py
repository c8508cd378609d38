"""Sums over the outcomes of each pair: expectations, and the transition matrix of a process.

The process lives on *nodes*: live states, or groups of them. Large copies are avoided: expectations
read the outcomes piece by piece, and the matrix has only outcomes that lead to nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    concatenated_ranges,
    csr_of,
    narrow,
    offsets_of,
    segment_chunks,
    segment_ids,
    segment_sums,
)
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import check_time, pieces
from ssp_lp.dynamic_programming.bellman import MOST_CACHED, SharedRows, SparseRows
from ssp_lp.model import SSP
from ssp_lp.model.graph import stored_with_model


def uniform_cost(model: SSP) -> float | None:
    """Return the cost of all outcomes if it was given as one number; else None."""
    same = model.n_outcomes > 0 and model.costs.strides == (0,)
    return float(model.costs[0]) if same else None


@with_twin
def successor_means(model: SSP, values: FloatArray | BoolArray) -> FloatArray:
    """Return E[value of the successor] of each pair, [pairs].

    Args:
        values: [states], finite.
    """
    check_time()
    values = np.asarray(values, dtype=np.float64)
    if not accelerated(model.n_outcomes, "matrix_rows.row_product"):
        shape = (model.n_pairs, model.n_states)
        matrix = sp.csr_array(
            (model.probabilities, model.successors, narrow(model.outcome_offsets)), shape=shape
        )
        return np.asarray(matrix @ values)
    from ssp_lp.compiled import matrix_rows as compiled

    every, result = np.arange(model.n_pairs, dtype=np.uint32), np.empty(model.n_pairs)
    offsets, successors = model.outcome_offsets.view(np.uint64), model.successors.view(np.uint32)
    run = compiled.row_product(model.n_outcomes)
    run(every, offsets, offsets[:-1], successors, model.probabilities, values, result)
    return result


def cost_means(model: SSP, weights: FloatArray | BoolArray | None = None) -> FloatArray:
    """Return E[stage cost * weight of the successor] of each pair, [pairs].

    Args:
        weights: [states]; None: 1, for the expected stage cost E[g(x, u, w)].
    """
    if weights is None:
        return mean_costs(model)
    cost = uniform_cost(model)
    return _summed_costs(model, weights) if cost is None else cost * successor_means(model, weights)


@stored_with_model
def mean_costs(model: SSP) -> FloatArray:
    """Return the expected stage cost E[g(x, u, w)] of each pair, cached, [pairs]."""
    cost = uniform_cost(model)
    return _summed_costs(model) if cost is None else np.full(model.n_pairs, cost)


def _summed_costs(model: SSP, weights: FloatArray | BoolArray | None = None) -> FloatArray:
    """Compute :func:`cost_means` from the outcomes, [pairs]."""
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
    """Return a mask of the pairs whose possible outcomes all cost 0, [pairs].

    Args:
        weights: factor of the costs by successor, [states]; None: 1.
    """
    return np.asarray(cost_means(model, None if weights is None else weights > 0) == 0.0)


_WORTH_SHARING = 1_000_000
"""Least number of entries for which equal rows are shared."""

_TIMES_SHARED = 4
"""Least average number of uses of each stored number: fewer save too little."""

_NOWHERE = np.zeros(0, dtype=np.int32)


@dataclass(frozen=True, eq=False)
class RowChoice:
    """The pairs of a model that are rows of a transition matrix, and the nodes that are columns."""

    model: SSP
    node_of: IntArray  # [states] int32 node, -1 where the process ends
    n_nodes: int
    pair_at: IntArray  # [rows] int32 pair of the model; negative: an empty row
    owner: IntArray | None = None  # [rows] int32 node to depart from; None: self-loops stay
    ahead: IntArray | None = None  # [outcomes] offset in blocks of columns; None: 0
    width: int = 1  # number of blocks of columns


class LiveRows(NamedTuple):
    """The transition matrix of a process, the divisors of its rows, and the mass that ends."""

    matrix: sp.csr_array  # [rows, width * nodes], possibly several entries for one column
    escape: FloatArray  # [rows] probability of departing, 1 without a self-loop
    exits: FloatArray  # [rows] probability that the process ends, or is discounted


@with_twin
def live_rows(rows: RowChoice, survival: float = 1.0) -> LiveRows:
    """Return the transition probabilities from the pair of each row to each node.

    If ``rows.owner`` is given, each row is conditioned on departing from its node: the self-loop is
    removed, and all other entries are divided by the probability of departing. This probability is
    a sum over the outcomes that depart, because 1 - (probability of the self-loop) would lose
    digits. A row that never departs is not changed.

    Args:
        rows: the pairs and the nodes.
        survival: factor of every probability, the discount or 1.
    """
    if accelerated(rows.model.n_outcomes, "matrix_rows.count_rows", "matrix_rows.fill_rows"):
        counts, escape, leaks = _count_live(rows)
        matrix = _filled_rows(rows, survival, escape, _row_bounds(rows, counts))
    else:
        matrix, escape, leaks = _live_rows_in_numpy(rows, survival)
    exits = leaks if survival == 1.0 else (1.0 - survival) + survival * leaks
    return LiveRows(matrix, escape, exits / escape)


@with_twin
def shared_live_rows(rows: RowChoice, survival: float = 1.0) -> SparseRows:
    """Return the matrix of ``live_rows``; if many rows have equal numbers, these are stored once.

    Args:
        rows: the pairs and the nodes.
        survival: factor of every probability, the discount or 1.
    """
    loops = "matrix_rows.count_rows", "matrix_rows.fill_rows", "matrix_rows.share_rows"
    if not accelerated(rows.model.n_outcomes, *loops):
        return _live_rows_in_numpy(rows, survival)[0]
    counts, escape, _ = _count_live(rows)
    bounds, entries = _row_bounds(rows, counts), int(counts.sum())
    if entries < _WORTH_SHARING:
        return _filled_rows(rows, survival, escape, bounds)
    from ssp_lp.compiled.matrix_rows import share_rows

    n_rows, n_outcomes = len(rows.pair_at), rows.model.n_outcomes
    indices = np.empty(entries, dtype=bounds.dtype)
    begins, data = np.empty(n_rows, dtype=np.int32), np.empty(MOST_CACHED)
    slots, used = np.full(2 * MOST_CACHED, -1, dtype=np.int32), 0
    numbers = np.zeros(0)  # of one piece
    for some in pieces(n_rows, n_outcomes):
        first, end = bounds[some.start], bounds[some.stop]
        own = bounds[some.start : some.stop + 1] - first
        numbers = np.empty(end - first) if end - first > numbers.size else numbers
        _fill_compiled(rows, some, escape, survival, own, indices[first:end], numbers)
        used = share_rows(own, numbers, begins[some], data, slots, used)
        if used < 0 or used > end // _TIMES_SHARED:  # few rows are equal
            return _filled_rows(rows, survival, escape, bounds)
    shape = n_rows, rows.width * rows.n_nodes
    return SharedRows(bounds, begins, indices, data[:used].copy(), shape)


def _row_bounds(rows: RowChoice, counts: IntArray) -> IntArray:
    """Return the row offsets of a CSR matrix from the number of entries of each row, [rows + 1]."""
    bounds = offsets_of(counts)
    small = max(int(bounds[-1]), rows.width * rows.n_nodes) < 2**31
    return bounds.astype(np.int32) if small else bounds


def _fill_compiled(
    rows: RowChoice,
    some: slice,
    escape: FloatArray,
    survival: float,
    bounds: IntArray,
    indices: IntArray,
    data: FloatArray,
) -> None:
    """Write the column indices and probabilities of some rows, in compiled loops.

    Args:
        rows: the pairs and the nodes.
        some: the rows to write.
        escape: probability of departing, [rows].
        survival: factor of every probability.
        bounds: offsets of these rows in the two arrays that are written.
        indices: written: column of each entry.
        data: written: probability of each entry.
    """
    from ssp_lp.compiled.matrix_rows import fill_rows

    model, home = rows.model, _row_array(rows.owner)
    fill_rows(
        model.outcome_offsets, model.successors.view(np.uint32), model.probabilities,
        _row_array(rows.ahead), rows.node_of, rows.n_nodes, rows.pair_at[some],
        home[some] if home.size else home, escape[some], survival, bounds, indices, data,
    )  # fmt: skip


def _filled_rows(
    rows: RowChoice, survival: float, escape: FloatArray, bounds: IntArray
) -> sp.csr_array:
    """Return all rows as a CSR matrix, written by compiled loops at known offsets."""
    n_rows, n_columns = len(rows.pair_at), rows.width * rows.n_nodes
    indices, data = np.empty(int(bounds[-1]), dtype=bounds.dtype), np.empty(int(bounds[-1]))
    for some in pieces(n_rows, rows.model.n_outcomes):
        own = bounds[some.start : some.stop + 1]
        _fill_compiled(rows, some, escape, survival, own, indices, data)
    return csr_of(data, indices, bounds, (n_rows, n_columns))


def _count_live(rows: RowChoice) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return number of entries, probability of departing and ending mass of each row, [rows]."""
    from ssp_lp.compiled.matrix_rows import count_rows

    n_rows, model, home = len(rows.pair_at), rows.model, _row_array(rows.owner)
    counts, escape, leaks = np.zeros(n_rows, dtype=np.int32), np.ones(n_rows), np.ones(n_rows)
    for some in pieces(n_rows, model.n_outcomes):
        count_rows(
            model.outcome_offsets, model.successors.view(np.uint32), model.probabilities,
            rows.node_of, rows.pair_at[some], home[some] if home.size else home,
            counts[some], escape[some], leaks[some],
        )  # fmt: skip
    return counts, escape, leaks


def _row_array(given: IntArray | None) -> IntArray:
    """Return an array; an empty one for None, which compiled loops do not accept."""
    return _NOWHERE if given is None else given


def _live_rows_in_numpy(
    rows: RowChoice, survival: float
) -> tuple[sp.csr_array, FloatArray, FloatArray]:
    """Return matrix, probability of departing and ending mass of all rows, by NumPy alone."""
    model, n_rows, pairs = rows.model, len(rows.pair_at), rows.pair_at
    begins = np.where(pairs < 0, 0, model.outcome_offsets[pairs])
    lengths = np.where(pairs < 0, 0, model.outcome_offsets[pairs + 1] - begins)
    escape, leaks, counts = np.ones(n_rows), np.ones(n_rows), np.zeros(n_rows, dtype=np.int64)
    columns, entries = [np.zeros(0, dtype=np.int64)], [np.zeros(0)]
    for some in segment_chunks(offsets_of(lengths)):
        outcome = concatenated_ranges(begins[some], lengths[some])
        row, size = segment_ids(offsets_of(lengths[some])), some.stop - some.start
        chance, node = model.probabilities[outcome], rows.node_of[model.successors[outcome]]
        live, ends = (node >= 0) & (chance > 0), node < 0
        loop = live & (False if rows.owner is None else node == rows.owner[some][row])
        leak = np.bincount(row[ends], chance[ends], size)
        away = live & ~loop
        mass = leak + np.bincount(row[away], chance[away], size)
        leaks[some] = np.where(pairs[some] < 0, 1.0, leak)
        waits = np.bincount(row[loop], minlength=size) > 0
        escape[some] = np.where(waits & (mass > 0), mass, 1.0)
        kept = np.where((mass == 0)[row], live, away)  # rows that never depart stay
        column = node[kept].astype(np.int64)
        if rows.ahead is not None:
            column += rows.ahead[outcome[kept]].astype(np.int64) * rows.n_nodes
        columns.append(column)
        entries.append(chance[kept] / escape[some][row[kept]] * survival)
        counts[some] = np.bincount(row[kept], minlength=size)
    bounds = _row_bounds(rows, counts)
    indices, shape = np.concatenate(columns).astype(bounds.dtype), rows.width * rows.n_nodes
    return csr_of(np.concatenate(entries), indices, bounds, (n_rows, shape)), escape, leaks
