"""Sparse rows that hold the same numbers in different columns; the numbers are stored once.

What an action does is often the same wherever it is taken: each cell of a grid has the same few
distributions, one row after another. A sweep then reads the columns alone, a third of the memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import FloatArray, IntArray, concatenated_ranges, csr_of, unsigned


@dataclass(frozen=True, eq=False)
class SharedRows:
    """A sparse matrix with rows that may lie anywhere among its numbers, several in one place."""

    indptr: IntArray  # [rows + 1] where each row's columns begin
    begins: IntArray  # [rows] where its numbers begin
    indices: IntArray  # [entries] columns
    data: FloatArray  # the numbers, fewer than entries
    shape: tuple[int, int]

    @property
    def nnz(self) -> int:
        """Entries, as if no number were shared."""
        return len(self.indices)

    def written_out(self) -> sp.csr_array:
        """The same matrix with each entry's number beside its column."""
        data = self.data[concatenated_ranges(self.begins, np.diff(self.indptr))]
        return csr_of(data, self.indices, self.indptr, self.shape)

    def __matmul__(self, x: FloatArray) -> FloatArray:
        """Product with a vector, [columns], or several, [columns, vectors]."""
        return np.asarray(self.written_out() @ x)


SparseRows = sp.csr_array | SharedRows


def written_out(rows: SparseRows) -> sp.csr_array:
    """Rows as scipy knows them."""
    return rows.written_out() if isinstance(rows, SharedRows) else rows


def row_parts(rows: SparseRows) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """Where each row's columns and its numbers begin, columns and numbers, for compiled loops."""
    indptr = unsigned(rows.indptr)
    begins = unsigned(rows.begins) if isinstance(rows, SharedRows) else indptr[:-1]
    return indptr, begins, unsigned(rows.indices), rows.data
