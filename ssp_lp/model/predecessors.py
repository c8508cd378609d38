"""For each state, the state-action pairs that may lead to it: the graph turned round."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    concatenated_ranges,
    pieces_of_chunks,
    read_only,
    segment_chunks,
    segment_ids,
    sorted_unique,
)
from ssp_lp.compiled.accelerator import accelerated


@dataclass(frozen=True, eq=False)
class Predecessors:
    """The pairs that lead to each state with positive probability, ascending.

    A pair is listed once for each of its outcomes that goes there.
    """

    offsets: IntArray  # [states + 1] entries of state s: offsets[s] : offsets[s + 1]
    pairs: IntArray  # [entries]

    def entering(self, states: IntArray, among: BoolArray) -> IntArray:
        """The pairs of ``among`` that may lead to one of the states, ascending, each once.

        Args:
            states: distinct states.
            among: [pairs].
        """
        first = self.offsets[states]
        lengths = self.offsets[states + 1] - first
        found = [self.pairs[:0]]
        for some in segment_chunks(np.concatenate([[0], np.cumsum(lengths)])):
            pairs = self.pairs[concatenated_ranges(first[some], lengths[some])]
            found.append(sorted_unique(pairs[among[pairs]]))
        return found[-1] if len(found) <= 2 else sorted_unique(np.concatenate(found))


@dataclass(frozen=True, eq=False, repr=False)
class Graph:
    """Which pairs lead where: of a model, or of a process."""

    pair_offsets: IntArray  # [states + 1] pairs of state s: pair_offsets[s] : pair_offsets[s + 1]
    outcome_offsets: IntArray  # [pairs + 1] outcomes of pair k, likewise
    successors: IntArray  # [outcomes]
    probabilities: FloatArray  # [outcomes], each pair's sum to one

    @cached_property
    def n_states(self) -> int:
        """Number of states, goals included."""
        return len(self.pair_offsets) - 1

    @cached_property
    def n_pairs(self) -> int:
        """Number of state-action pairs."""
        return len(self.outcome_offsets) - 1

    @cached_property
    def n_outcomes(self) -> int:
        """Number of outcomes over all pairs."""
        return len(self.successors)

    @cached_property
    def pair_state(self) -> IntArray:
        """The state of each pair, [pairs]."""
        return read_only(segment_ids(self.pair_offsets))

    @cached_property
    def predecessors(self) -> Predecessors:
        """For each state the pairs that may lead to it; found at first use, then kept."""
        return find_predecessors(
            self.n_states, self.outcome_offsets, self.successors, self.probabilities
        )


def find_predecessors(
    n_states: int, outcome_offsets: IntArray, successors: IntArray, probabilities: FloatArray
) -> Predecessors:
    """Turn the graph round.

    Args:
        n_states: number of states.
        outcome_offsets: [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
    """
    if accelerated(len(successors)):
        from ssp_lp.compiled.graphs import transpose_graph

        offsets, pairs = transpose_graph(n_states, outcome_offsets, successors, probabilities)
    else:
        # offsets, [states + 1], and pairs, [entries], by scipy's conversion from rows to columns
        ends, columns = possible_steps(outcome_offsets, successors, probabilities)
        present = np.ones(columns.size, dtype=np.bool_)
        shape = len(ends) - 1, n_states
        rows = sp.csr_array((present, columns, narrow(ends)), shape=shape).tocsc()
        offsets, pairs = rows.indptr.astype(np.int64), rows.indices.astype(np.int32, copy=False)
    return Predecessors(read_only(offsets), read_only(pairs))


def possible_steps(
    outcome_offsets: IntArray,
    successors: IntArray,
    probabilities: FloatArray,
    chosen: BoolArray | None = None,
) -> tuple[IntArray, IntArray]:
    """The outcomes of positive probability, of which predecessors are told.

    Args:
        outcome_offsets: [pairs + 1].
        successors: [outcomes].
        probabilities: [outcomes].
        chosen: [pairs]; all if left out.

    Returns:
        For each pair the end of its entries, after a leading 0, [pairs + 1]; and the successors,
        [entries].
    """
    counts = np.zeros(len(outcome_offsets), dtype=np.int64)
    found = [successors[:0]]
    for piece in pieces_of_chunks(outcome_offsets):
        kept = probabilities[piece.entries] > 0
        if chosen is not None:
            kept &= np.repeat(chosen[piece.segments], piece.lengths)
        some = successors[piece.entries]
        found.append(some if kept.all() else some[kept])
        filled = np.flatnonzero(piece.lengths)
        sums = np.add.reduceat(kept, piece.firsts[filled], dtype=np.int64) if filled.size else 0
        counts[1:][piece.segments][filled] = sums
    ends = np.cumsum(counts, out=counts)
    return ends, successors if ends[-1] == len(successors) else np.concatenate(found)


def narrow(offsets: IntArray) -> IntArray:
    """Offsets of predecessors in 32 bits where they fit, to match scipy's columns."""
    fits = int(offsets[-1]) <= np.iinfo(np.int32).max
    return offsets.astype(np.int32, copy=False) if fits else offsets
