"""What a model's outcomes make of its pairs: expectations over them, and the rows of a process.

Neither makes large copies: expectations go through the outcomes piece by piece, and a process's
rows are the outcomes among live nodes, selected.
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
from ssp_lp.compiled.accelerator import accelerated
from ssp_lp.compiled.deadline import check_time, pieces
from ssp_lp.dynamic_programming.bellman import SharedRows, SparseRows
from ssp_lp.model import SSP


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


_WORTH_SHARING = 1_000_000
"""Entries from which rows are looked at for others that are equal."""

_TIMES_SHARED = 4
"""How often each number is to be shared on average: less gains too little."""

_MOST_NUMBERS = 2**19
"""Different rows' numbers: 4 MB, so that they stay near a core while columns stream by."""

_NOWHERE = np.zeros(0, dtype=np.int32)


@dataclass(frozen=True, eq=False)
class RowChoice:
    """Which outcomes make up the rows of a process, and in which columns they go."""

    model: SSP
    node_of: IntArray  # [states] int32 node, -1 where the process ends
    n_nodes: int
    pair_at: IntArray  # [rows] int32 pair of the model; negative: an empty row
    home: IntArray | None = None  # [rows] int32 node to be departed from; None: waiting is kept
    ahead: IntArray | None = None  # [outcomes] blocks of columns ahead; None: none
    width: int = 1  # blocks of columns


class LiveRows(NamedTuple):
    """Rows of a process, what they were divided by, and what leaves it."""

    matrix: sp.csr_array  # [rows, width * nodes], possibly several entries for one column
    departs: FloatArray  # [rows] probability of departing, 1 where nothing was divided
    exits: FloatArray  # [rows] probability of going where the process ends, or being discounted


def live_rows(rows: RowChoice, survival: float = 1.0) -> LiveRows:
    """Probabilities of going from each row's pair to each node.

    Where a home is given, rows are seen on departing only: waiting in place changes no total but
    divides everything else by the probability of departing. That is summed from what leaves,
    never formed as 1 - p, which would cancel for slow loops. A row that never departs is kept.

    Args:
        rows: the rows.
        survival: factor of every probability.
    """
    counts, departs, leaks = _count_live(rows)
    matrix = _filled_rows(rows, survival, departs, _row_bounds(rows, counts))
    exits = leaks if survival == 1.0 else (1.0 - survival) + survival * leaks
    return LiveRows(matrix, departs, exits / departs)


def shared_live_rows(rows: RowChoice, survival: float = 1.0) -> SparseRows:
    """The matrix of live rows alone, with each probability once where rows repeat each other.

    Args:
        rows: the rows.
        survival: factor of every probability.
    """
    counts, departs, _ = _count_live(rows)
    bounds, entries = _row_bounds(rows, counts), int(counts.sum())
    if entries < _WORTH_SHARING or not accelerated(entries):
        return _filled_rows(rows, survival, departs, bounds)
    from ssp_lp.compiled.rows import share_rows

    n_rows, n_outcomes = len(rows.pair_at), rows.model.n_outcomes
    indices = np.empty(entries, dtype=bounds.dtype)
    begins, data = np.empty(n_rows, dtype=np.int32), np.empty(_MOST_NUMBERS)
    slots, used = np.full(2 * _MOST_NUMBERS, -1, dtype=np.int32), 0
    numbers = np.zeros(0)  # of one piece
    for some in pieces(n_rows, n_outcomes):
        first, end = bounds[some.start], bounds[some.stop]
        own = bounds[some.start : some.stop + 1] - first
        numbers = np.empty(end - first) if end - first > numbers.size else numbers
        _fill_compiled(rows, some, departs, survival, own, indices[first:end], numbers)
        used = share_rows(own, numbers, begins[some], data, slots, used)
        if used < 0 or used > end // _TIMES_SHARED:  # few of them repeat each other
            return _filled_rows(rows, survival, departs, bounds)
    shape = n_rows, rows.width * rows.n_nodes
    return SharedRows(bounds, begins, indices, data[:used].copy(), shape)


def _row_bounds(rows: RowChoice, counts: IntArray) -> IntArray:
    """Where the entries of each row begin, and the end, [rows + 1]."""
    bounds = offsets_of(counts)
    small = max(int(bounds[-1]), rows.width * rows.n_nodes) < 2**31
    return bounds.astype(np.int32) if small else bounds


def _fill_compiled(
    rows: RowChoice,
    some: slice,
    departs: FloatArray,
    survival: float,
    bounds: IntArray,
    indices: IntArray,
    data: FloatArray,
) -> None:
    """Write columns and probabilities of some rows, whose entries lie at the bounds."""
    from ssp_lp.compiled.rows import fill_rows

    model, home = rows.model, _row_array(rows.home)
    fill_rows(
        model.outcome_offsets, model.successors.view(np.uint32), model.probabilities,
        _row_array(rows.ahead), rows.node_of, rows.n_nodes, rows.pair_at[some],
        home[some] if home.size else home, departs[some], survival, bounds, indices, data,
    )  # fmt: skip


def _filled_rows(
    rows: RowChoice, survival: float, departs: FloatArray, bounds: IntArray
) -> sp.csr_array:
    """The rows that were counted, each entry's probability beside its column."""
    n_rows, n_columns, model = len(rows.pair_at), rows.width * rows.n_nodes, rows.model
    indices = np.empty(int(bounds[-1]), dtype=bounds.dtype)
    data = np.empty(len(indices))
    if accelerated(model.n_outcomes):
        for some in pieces(n_rows, model.n_outcomes):
            own = bounds[some.start : some.stop + 1]
            _fill_compiled(rows, some, departs, survival, own, indices, data)
    else:
        for some in _row_chunks(rows):
            outcome, row = _outcomes_of_live_rows(rows, some)
            probability = model.probabilities[outcome]
            node = rows.node_of[model.successors[outcome]].astype(np.int64)
            kept = (node >= 0) & (probability > 0)
            if rows.home is not None:
                away = kept & (node != rows.home[some][row])
                counts = np.diff(bounds[some.start : some.stop + 1])
                departing = np.bincount(row[away], minlength=len(counts)) == counts
                kept = np.where(departing[row], away, kept)
            if rows.ahead is not None:
                node += rows.ahead[outcome].astype(np.int64) * rows.n_nodes
            place = slice(bounds[some.start], bounds[some.stop])
            indices[place] = node[kept]
            data[place] = probability[kept] / departs[some][row[kept]] * survival
    return csr_of(data, indices, bounds, (n_rows, n_columns))


def _count_live(rows: RowChoice) -> tuple[IntArray, FloatArray, FloatArray]:
    """Entries of each live row, its probability of departing, and what ends there, [rows] each."""
    counts, departs = np.zeros(len(rows.pair_at), dtype=np.int32), np.ones(len(rows.pair_at))
    leaks = np.ones(len(rows.pair_at))
    model = rows.model
    if accelerated(model.n_outcomes):
        from ssp_lp.compiled import rows as compiled

        home = _row_array(rows.home)
        for some in pieces(len(counts), model.n_outcomes):
            compiled.count_rows(
                model.outcome_offsets, model.successors.view(np.uint32), model.probabilities,
                rows.node_of, rows.pair_at[some], home[some] if home.size else home,
                counts[some], departs[some], leaks[some],
            )  # fmt: skip
        return counts, departs, leaks
    for some in _row_chunks(rows):
        outcome, row, size = *_outcomes_of_live_rows(rows, some), some.stop - some.start
        probability = model.probabilities[outcome]
        node = rows.node_of[model.successors[outcome]]
        live = (node >= 0) & (probability > 0)
        loop = np.zeros_like(live)
        if rows.home is not None:
            loop = live & (node == rows.home[some][row])
        away = live & ~loop
        leak = np.bincount(row[node < 0], probability[node < 0], size)
        leaks[some] = np.where(rows.pair_at[some] < 0, 1.0, leak)
        mass = leak + np.bincount(row[away], probability[away], size)
        loops = np.bincount(row[loop], minlength=size)
        entries = np.bincount(row[away], minlength=size)
        counts[some] = np.where(mass == 0, entries + loops, entries)
        departs[some] = np.where((loops > 0) & (mass > 0), mass, 1.0)
    return counts, departs, leaks


def _outcomes_of_live_rows(rows: RowChoice, some: slice) -> tuple[IntArray, IntArray]:
    """Outcomes of a chunk of rows, and the row within the chunk that each belongs to."""
    offsets, pair = rows.model.outcome_offsets, rows.pair_at[some]
    begin = np.where(pair < 0, 0, offsets[pair])
    lengths = np.where(pair < 0, 0, offsets[pair + 1] - begin)
    return concatenated_ranges(begin, lengths), segment_ids(offsets_of(lengths))


def _row_array(given: IntArray | None) -> IntArray:
    """An array that says where each live row goes on; none says nowhere."""
    return _NOWHERE if given is None else given


def _row_chunks(rows: RowChoice) -> list[slice]:
    """Chunks of live rows with about as many outcomes each."""
    pair, offsets = rows.pair_at, rows.model.outcome_offsets
    lengths = np.where(pair < 0, 0, offsets[pair + 1] - offsets[pair])
    return list(segment_chunks(offsets_of(lengths)))
