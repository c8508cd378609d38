"""Bellman backups and policy products on sparse state-action pairs, compiled if large.

The rows of many pairs often have equal probabilities, as in the cells of a grid world.
``SharedRows`` stores them once. A sweep then reads hardly more than the column indices, a third of
the memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import (
    MACHINE_EPSILON,
    FloatArray,
    IntArray,
    concatenated_ranges,
    csr_of,
    exact_product,
    exact_sum,
    first_minimisers,
    offsets_of,
    segment_minima,
    unsigned,
)
from ssp_lp.compiled.accelerator import accelerated, with_twin
from ssp_lp.compiled.deadline import check_time, pieces

MOST_CACHED = 2**19
"""Most stored numbers: 4 MB, so that they stay in the cache of a core."""

_FEW_ENTRIES = 20_000
_NONE = np.zeros(0)
_NOBODY = np.zeros(0, dtype=np.uint32)


@dataclass(frozen=True)
class Work:
    """Work of a computation: its number of passes over a process, which take most of the time."""

    backups: int = 0  # passes over all pairs
    products: int = 0  # passes over one pair per state

    def __add__(self, other: Work) -> Work:
        return Work(self.backups + other.backups, self.products + other.products)


@dataclass(frozen=True, eq=False)
class Backup:
    """Result of one application of the Bellman operator."""

    minima: FloatArray  # [states] infinite if a state has no pairs
    choice: IntArray  # [states] the first pair that attains the minimum
    current_values: FloatArray  # [states] value of the held pair; empty if none was given


@dataclass(frozen=True)
class PairCost:
    """Costs of pairs that may grow linearly: ``fixed + factor * slope``."""

    fixed: FloatArray  # [pairs]
    slope: FloatArray | None = None  # [pairs]
    factor: float = 0.0

    @property
    def total(self) -> FloatArray:
        """Cost of each pair, [pairs]."""
        if self.slope is None or self.factor == 0.0:
            return self.fixed
        return self.fixed + self.factor * self.slope

    @property
    def parts(self) -> tuple[FloatArray, FloatArray, float]:
        """The fixed costs, the slopes (an empty array if there are none) and the factor."""
        return self.fixed, _NONE if self.slope is None else self.slope, float(self.factor)


@with_twin
def best_pairs(
    pair_offsets: IntArray,
    transitions: SparseRows,
    pair_cost: FloatArray | PairCost,
    values: FloatArray,
    current: IntArray | None = None,
) -> Backup:
    """Minimise ``pair_cost + transitions @ values`` over the pairs of each state: a Bellman backup.

    Args:
        pair_offsets: [states + 1].
        transitions: [pairs, columns].
        pair_cost: [pairs].
        values: [columns].
        current: one pair of each state, whose sum is returned as well, [states].
    """
    check_time()
    cost = pair_cost if isinstance(pair_cost, PairCost) else PairCost(pair_cost)
    n = len(pair_offsets) - 1
    if not accelerated(len(transitions.indices), "backups.back_up"):
        ahead = cost.total + transitions @ values
        minima = segment_minima(ahead, pair_offsets)
        choice = np.array(pair_offsets[:-1], dtype=np.int32)
        choice[np.diff(pair_offsets) > 0] = first_minimisers(ahead, minima, pair_offsets)
        return Backup(minima, choice, _NONE if current is None else ahead[current])
    from ssp_lp.compiled import backups as compiled

    minima, choice = np.empty(n), np.empty(n, dtype=np.int32)
    here = np.empty(0 if current is None else n)
    own = _NOBODY if current is None else unsigned(current)
    compiled.back_up(len(transitions.indices))(
        unsigned(pair_offsets), *row_parts(transitions), *cost.parts, values, own,
        minima, choice.view(np.uint32), here,
    )  # fmt: skip
    return Backup(minima, choice, here)


@with_twin
def safe_minima(
    pair_offsets: IntArray,
    transitions: SparseRows,
    pair_cost: PairCost,
    magnitude: FloatArray,
    largest_term: FloatArray,
    values: FloatArray,
    position: IntArray | None = None,
) -> FloatArray:
    """Compute a lower bound of a Bellman backup: each pair's sum, less a bound of its rounding.

    Args:
        pair_offsets: [states + 1].
        transitions: [pairs, columns].
        pair_cost: costs, positive or negative.
        magnitude: sum of the absolute values of the fixed cost's terms, [pairs].
        largest_term: greatest absolute value of one of these terms, [pairs]. A sum whose other
            terms are all 0 is not rounded.
        values: [columns].
        position: written, by compiled loops only: position of the first best pair among the pairs
            of its state, [states].

    Returns:
        The lower bounds, [states]; infinite if a state has no pairs.
    """
    check_time()
    if not accelerated(len(transitions.indices), "backups.back_up_safely"):
        growth = 0.0 if pair_cost.slope is None else pair_cost.factor * pair_cost.slope
        size = (magnitude + growth) + transitions @ np.abs(values)
        ahead = (pair_cost.fixed + growth) + transitions @ values
        ahead = np.where(size == largest_term, ahead, ahead - backup_rounding(transitions) * size)
        return segment_minima(ahead, pair_offsets)
    from ssp_lp.compiled import backups as compiled

    minima = np.empty(len(pair_offsets) - 1)
    fixed, slope, factor = pair_cost.parts
    compiled.back_up_safely(len(transitions.indices))(
        unsigned(pair_offsets), *row_parts(transitions), fixed, magnitude, slope, factor,
        largest_term, MACHINE_EPSILON, values, minima, _NOBODY if position is None else position,
    )  # fmt: skip
    return minima


def backup_rounding(transitions: SparseRows) -> FloatArray:
    """Return a bound of a backup's rounding, relative to the sum of its absolute terms, [pairs]."""
    return np.asarray((np.diff(transitions.indptr) + 4.0) * MACHINE_EPSILON)


@with_twin
def chosen_product(transitions: SparseRows, choice: IntArray, x: FloatArray) -> FloatArray:
    """Compute ``transitions[choice] @ x`` for one vector or several.

    For few entries all rows are multiplied, since selecting rows costs more.
    """
    check_time()
    if len(transitions.indices) <= _FEW_ENTRIES:
        return np.asarray((transitions @ x)[choice])
    loop = "matrix_rows.row_product" if x.ndim == 1 else "matrix_rows.row_products"
    if not accelerated(len(transitions.indices), loop):
        return np.asarray(chosen_rows(transitions, choice) @ x)
    from ssp_lp.compiled import matrix_rows as compiled

    result = np.empty((len(choice), *x.shape[1:]))
    run = compiled.row_product if x.ndim == 1 else compiled.row_products
    share = len(choice) / max(int(transitions.shape[0]), 1)
    entries = int(share * len(transitions.indices))
    run(entries)(unsigned(choice), *row_parts(transitions), x, result)
    return result


@with_twin
def chosen_rows(transitions: SparseRows, choice: IntArray) -> sp.csr_array:
    """Return a policy's rows, ``transitions[choice]``.

    Args:
        transitions: [pairs, columns].
        choice: [states].

    Returns:
        [states, columns].
    """
    if not accelerated(len(transitions.indices), "matrix_rows.copy_rows"):
        return sp.csr_array(written_out(transitions)[choice])
    from ssp_lp.compiled import matrix_rows as compiled

    begin = transitions.indptr
    indptr = offsets_of(begin[choice + 1] - begin[choice]).astype(begin.dtype)
    indices = np.empty(int(indptr[-1]), dtype=transitions.indices.dtype)
    data, run = np.empty(indices.size), compiled.copy_rows(indices.size)
    chosen, own, parts = unsigned(choice), unsigned(indptr), row_parts(transitions)
    for some in pieces(len(choice), indices.size):
        run(chosen[some], *parts, own[some.start : some.stop + 1], unsigned(indices), data)
    return csr_of(data, indices, indptr, (len(choice), int(transitions.shape[1])))


@dataclass(frozen=True, eq=False)
class SharedRows:
    """A sparse matrix in which several rows may share one stored list of values."""

    indptr: IntArray  # [rows + 1] position of each row's first column
    starts: IntArray  # [rows] position of its first number
    indices: IntArray  # [entries] columns
    data: FloatArray  # the numbers, fewer than entries
    shape: tuple[int, int]

    @property
    def nnz(self) -> int:
        """Number of entries, shared ones counted in each row."""
        return len(self.indices)

    def written_out(self) -> sp.csr_array:
        """Return the matrix in scipy's form, with the value of each entry stored separately."""
        data = self.data[concatenated_ranges(self.starts, np.diff(self.indptr))]
        return csr_of(data, self.indices, self.indptr, self.shape)

    def __matmul__(self, x: FloatArray) -> FloatArray:
        """Return the product with a vector, [columns], or several, [columns, vectors]."""
        return np.asarray(self.written_out() @ x)


SparseRows = sp.csr_array | SharedRows


def written_out(rows: SparseRows) -> sp.csr_array:
    """Return a CSR matrix of scipy; values that rows share are copied to each row."""
    return rows.written_out() if isinstance(rows, SharedRows) else rows


def row_parts(rows: SparseRows) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """Return a matrix's arrays: ``indptr``, position of each row's first number, columns, numbers.

    These are the arrays of :class:`SharedRows`, with unsigned integers for compiled loops.
    """
    indptr = unsigned(rows.indptr)
    begins = unsigned(rows.starts) if isinstance(rows, SharedRows) else indptr[:-1]
    return indptr, begins, unsigned(rows.indices), rows.data


def unsigned_parts(
    offsets: IntArray, matrix: sp.csr_array
) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """Return offsets and a matrix's arrays in the types of compiled loops."""
    return unsigned(offsets), unsigned(matrix.indptr), unsigned(matrix.indices), matrix.data


class Moves(NamedTuple):
    """The pairs of a process, with methods for their advantages at given values.

    The advantage of a pair is its cost plus the expected value of its successor, minus the value of
    its state.
    """

    owner: IntArray  # [pairs] state of each pair
    transitions: sp.csr_array  # [pairs, states]
    exits: FloatArray  # [pairs] probability of leaving for good

    @with_twin
    def precise_advantages(
        self, cost: FloatArray, high: FloatArray, low: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Compute advantages at values ``high + low``, in twice the working precision.

        Args:
            cost: [pairs].
            high: [states].
            low: [states].

        Returns:
            Advantages and bounds of their errors, [pairs] each.
        """
        home, transitions, exits = self
        if accelerated(len(transitions.indices), "equations.advantages_precisely"):
            from ssp_lp.compiled.equations import advantages_precisely

            result, rounding = np.empty(len(cost)), np.empty(len(cost))
            parts = unsigned_parts(home, transitions)
            run = advantages_precisely(len(transitions.indices))
            run(*parts, exits, cost, high, low, MACHINE_EPSILON, result, rounding)
            return result, rounding
        here, here_low = high[home], low[home]
        term, lost = exact_product(-exits, here)
        total, slip = exact_sum(cost, term)
        bit = exits * here_low
        rest, small, whole = (
            slip + lost - bit,
            np.abs(slip) + np.abs(lost) + np.abs(bit),
            np.abs(term),
        )
        begin, lengths = transitions.indptr[:-1], np.diff(transitions.indptr)
        for k in range(int(lengths.max(initial=0))):
            rows = np.flatnonzero(lengths > k)
            entry = begin[rows] + k
            column, p = transitions.indices[entry], transitions.data[entry]
            step, missed = exact_sum(high[column], -here[rows])
            missed = missed + (low[column] - here_low[rows])
            term, lost = exact_product(p, step)
            total[rows], slip = exact_sum(total[rows], term)
            bit = p * missed
            rest[rows] += slip + lost + bit
            small[rows] += np.abs(slip) + np.abs(lost) + np.abs(bit)
            whole[rows] += np.abs(term)
        result = total + rest
        terms = lengths + 4.0
        rounding = np.abs(result) + terms * (small + MACHINE_EPSILON * whole)
        return result, MACHINE_EPSILON * rounding

    @with_twin
    def safe_advantages(self, cost: FloatArray, values: FloatArray) -> FloatArray:
        """Return lower bounds of advantages, with their rounding subtracted, [pairs].

        Args:
            cost: [pairs].
            values: [states].
        """
        home, transitions, exits = self
        if accelerated(len(transitions.indices), "equations.advantages_safely"):
            from ssp_lp.compiled.equations import advantages_safely

            result = np.empty(len(cost))
            parts = unsigned_parts(home, transitions)
            run = advantages_safely(len(transitions.indices))
            run(*parts, exits, cost, values, MACHINE_EPSILON, result)
            return result
        here, lengths = values[home], np.diff(transitions.indptr)
        terms = transitions.data * (values[transitions.indices] - np.repeat(here, lengths))
        places, shape = (transitions.indices, transitions.indptr), transitions.shape
        ones = np.ones(shape[1])
        total = sp.csr_array((terms, *places), shape) @ ones
        whole = sp.csr_array((np.abs(terms), *places), shape) @ ones
        leaving = exits * here
        at_once = cost - leaving
        result = at_once + total
        rounded = np.abs(at_once) + np.where(exits == 1.0, 0.0, np.abs(leaving))
        rounded[exits == 0.0] = 0.0
        rounded += np.where(whole == 0.0, 0.0, (lengths + 1.0) * whole + np.abs(result))
        lower: FloatArray = result - 0.51 * MACHINE_EPSILON * rounded  # half, and their products
        return lower

    def advantage_bounds(
        self, cost: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper bounds of advantages, [pairs] each.

        Args:
            cost: [pairs].
            values: [states].
        """
        return self.safe_advantages(cost, values), -self.safe_advantages(-cost, -values)
